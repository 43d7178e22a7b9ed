"""Closed forms of a projectile: against each other, against stepping, at every edge, and with their derivatives."""

import math
from decimal import Decimal, localcontext
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from physjax import Particles, Scene, forces, methods, projectile, simulate

HALF_PI = 0.5 * math.pi
G = 9.8

speeds = st.floats(1.0, 300.0)
angles = st.floats(0.01, 1.56)
gravities = st.floats(0.1, 30.0)
fractions = st.floats(0.02, 0.999)
checked = settings(max_examples=60, deadline=None)

fast = SimpleNamespace(**{name: jax.jit(getattr(projectile, name)) for name in projectile.__all__ if name[0].islower()})
"""The module compiled: op by op the tests would take twice as long."""


def exact_low_arc(r, rise, s, g=G):
    """The low arc in 80 digits."""
    with localcontext() as context:
        context.prec = 80
        r, rise, s, g = (Decimal(float(number)) for number in (r, rise, s, g))
        return math.atan(float((s * s - (s**4 - g * (g * r * r + 2 * rise * s * s)).sqrt()) / (g * r)))


@given(speeds, angles, st.floats(-50, 50), gravities)
@checked
def test_the_apex_is_where_the_shot_stops_rising(s, angle, height, g):
    t = float(fast.apex_time(s, angle, g=g))
    top = float(fast.apex_height(s, angle, height=height, g=g))
    assert abs(fast.velocity(t, s, angle, g=g)[1]) <= 1e-13 * s
    assert fast.position(t, s, angle, height=height, g=g)[1] == pytest.approx(
        top, abs=1e-13 * (s * s / g + abs(height))
    )
    assert fast.position(1.01 * t, s, angle, height=height, g=g)[1] < top + 1e-13 * (s * s / g + abs(height))


@given(speeds, st.floats(-1.5, 1.5), st.floats(-50, 50), st.floats(-50, 50), gravities)
@checked
def test_the_flight_ends_at_the_targets_height_on_the_way_down(s, angle, height, target, g):
    t = float(fast.flight_time(s, angle, height=height, target_height=target, g=g))
    top = height + (max(s * math.sin(angle), 0.0) ** 2) / (2 * g)
    if math.isnan(t):
        assert target > top * (1 - 1e-12) - 1e-12
        return
    scale = s * s / g + abs(height) + abs(target)
    assert t >= 0
    assert fast.position(t, s, angle, height=height, g=g)[1] == pytest.approx(target, abs=1e-12 * scale)
    assert fast.velocity(t, s, angle, g=g)[1] <= 1e-6 * s
    reach = fast.horizontal_range(s, angle, height=height, target_height=target, g=g)
    assert reach == pytest.approx(float(fast.position(t, s, angle, height=height, g=g)[0]), abs=1e-13 * scale)


def test_level_ground(precision):
    angle = jnp.linspace(0.01, 1.56, 64, dtype=precision.dtype)
    up, along = 30 * np.sin(np.asarray(angle, float)), 30 * np.cos(np.asarray(angle, float))
    time, reach = fast.flight_time(30.0, angle), fast.horizontal_range(30.0, angle)
    assert time.dtype == reach.dtype == precision.dtype
    np.testing.assert_allclose(time, 2 * up / G, rtol=8 * precision.eps)
    np.testing.assert_allclose(reach, 2 * up * along / G, rtol=8 * precision.eps, atol=100 * precision.eps)


def test_thrown_down_keeps_its_digits(precision):
    """A steep, fast throw at a floor a micrometre below: the printed formula subtracts two equal numbers."""
    fall, speed = 1e-6, 100.0
    angle = jnp.asarray(-HALF_PI, precision.dtype)
    time = fast.flight_time(speed, angle, height=jnp.asarray(fall, precision.dtype))
    np.testing.assert_allclose(time, fall / speed * (1 - G * fall / (2 * speed**2)), rtol=8 * precision.eps)


@given(speeds, angles, st.floats(-100, 100), gravities)
@checked
def test_angle_for_apex_undoes_apex_height(s, angle, height, g):
    top = float(fast.apex_height(s, angle, height=height, g=g))
    found, ok = fast.angle_for_apex(top, s, height=height, g=g)
    lost = 1e-15 * (s * s / g + abs(height)) * g / (s * s) / (math.sin(angle) * math.cos(angle))
    assert ok
    assert found == pytest.approx(angle, abs=1e-14 + 8 * lost)


def test_angle_for_apex_at_its_edges(precision):
    speed = jnp.asarray(20.0, precision.dtype)
    highest = fast.apex_height(speed, HALF_PI)
    heights = jnp.stack([jnp.zeros_like(highest), highest, 1.001 * highest, -0.001 * highest])
    found, ok = fast.angle_for_apex(heights, speed)
    assert found.dtype == precision.dtype
    np.testing.assert_allclose(found, [0.0, HALF_PI, np.nan, np.nan], atol=2 * math.sqrt(8 * precision.eps))
    np.testing.assert_array_equal(ok, [True, True, False, False])


@given(speeds, st.floats(-1, 0.999), fractions, gravities)
@checked
def test_both_arcs_pass_through_the_target(s, rise_fraction, fraction, g):
    """Targets all over the reachable region, in units of the height s²/2g of a shot straight up."""
    rise = rise_fraction * s * s / (2 * g)
    r = fraction * s * s / g * math.sqrt(1 - rise_fraction)
    low, high, ok = map(float, fast.angles_for_target(r, rise, s, g=g))
    assert ok
    assert -HALF_PI < low < high < HALF_PI
    for angle in (low, high):
        x, y = fast.position(r / (s * math.cos(angle)), s, angle, g=g)
        assert x == pytest.approx(r, rel=1e-14)
        assert y == pytest.approx(rise, abs=1e-12 * s * s / g)


@given(speeds, fractions, gravities, st.sampled_from([1.0, -1.0]))
@checked
def test_on_level_ground_both_formulas_agree(s, fraction, g, side):
    r = side * fraction * s * s / g
    arcs = fast.angles_for_target(r, 0.0, s, g=g)
    level = fast.angles_for_range(r, s, g=g)
    np.testing.assert_allclose(arcs.low, level.low, rtol=1e-13)
    np.testing.assert_allclose(arcs.high, level.high, rtol=1e-13)
    for angle in level[:2]:
        assert fast.horizontal_range(s, angle, g=g) == pytest.approx(r, abs=1e-13 * s * s / g)


@given(st.floats(1e-9, 1e2), st.floats(-1, 1), st.floats(50, 500))
@checked
def test_the_low_arc_is_good_to_its_last_digits(r, slope, s):
    """Tiny distances included, where the printed formula subtracts two equal numbers."""
    low = float(fast.angles_for_target(r, slope * r, s, g=G).low)
    assert low == pytest.approx(exact_low_arc(r, slope * r, s), rel=1e-14, abs=1e-16)


def test_the_printed_low_arc_is_not(precision):
    r, s = 1e-3 if precision.eps > 1e-10 else 1e-8, 100.0
    low = fast.angles_for_target(jnp.asarray(r, precision.dtype), 0.0, s).low
    exact = G * r / (2 * s * s)
    np.testing.assert_allclose(low, exact, rtol=4 * precision.eps)
    s4, gr = np.asarray([s**4, G * r], precision.dtype)
    printed = np.arctan((s * s - np.sqrt(s4 - gr * gr)) / gr)
    assert abs(printed / exact - 1) > 0.5


@given(st.floats(-100, 100), st.floats(-100, 100), gravities)
@checked
def test_the_least_speed_is_the_edge_of_reach(r, rise, g):
    if math.hypot(r, rise) < 0.01 or (abs(r) < 0.01 and rise < 0):
        return
    speed, angle = map(float, fast.least_speed(r, rise, g=g))
    edge = fast.angles_for_target(r, rise, speed, g=g)
    assert edge.ok
    for arc in edge[:2]:  # they meet there, up to the root of a rounding error
        assert arc == pytest.approx(angle, abs=1e-6 * max(1.0, math.sqrt(g * math.hypot(r, rise)) / speed))
    assert fast.angles_for_target(r, rise, 1.001 * speed, g=g).ok
    slower = fast.angles_for_target(r, rise, 0.999 * speed, g=g)
    assert not slower.ok
    assert jnp.isnan(slower.low)
    assert jnp.isnan(slower.high)


def test_the_edge_of_reach_counts_as_reach(precision):
    """Distances and speeds that are on the edge but for a rounding error, in thousands."""
    r = jnp.linspace(0.5, 400.0, 2000, dtype=precision.dtype)
    slope = jnp.asarray([[-2.0], [-0.3], [0.0], [0.7], [4.0]], precision.dtype)
    r = jnp.broadcast_to(r, (5, 2000))
    best = fast.least_speed(r, slope * r)
    arcs = fast.angles_for_target(r, slope * r, best.speed)
    assert arcs.ok.all()
    for arc in arcs[:2]:
        np.testing.assert_allclose(arc, best.angle, atol=20 * math.sqrt(precision.eps))
    assert fast.angles_for_range(r, fast.least_speed(r, 0.0).speed).ok.all()
    tops = fast.apex_height(best.speed, best.angle, height=100.0)
    assert fast.angle_for_apex(tops, best.speed, height=100.0).ok.all()
    assert jnp.isfinite(fast.flight_time(best.speed, best.angle, height=100.0, target_height=tops)).all()


def test_straight_up_and_straight_down(precision):
    overhead, below = jnp.asarray([10.0, -10.0], precision.dtype)
    up = fast.angles_for_target(0.0, overhead, 20.0)
    down = fast.angles_for_target(0.0, below, 20.0)
    np.testing.assert_allclose([*up[:2], *down[:2]], [HALF_PI, HALF_PI, -HALF_PI, HALF_PI], rtol=precision.eps)
    assert not fast.angles_for_target(0.0, 3 * overhead, 20.0).ok
    np.testing.assert_allclose(fast.least_speed(0.0, overhead), [14.0, HALF_PI], rtol=2 * precision.eps)
    np.testing.assert_allclose(fast.least_speed(0.0, below), [0.0, 0.0], atol=precision.eps)
    launch = fast.angles_for_target(jnp.zeros((), precision.dtype), 0.0, 20.0)
    np.testing.assert_allclose(launch[:2], [0.0, HALF_PI], rtol=precision.eps)


def test_a_target_behind_has_the_mirrored_angles(precision):
    r = jnp.linspace(1.0, 35.0, 8, dtype=precision.dtype)
    rise = jnp.linspace(-9.0, 5.0, 8, dtype=precision.dtype)
    near = dict(rtol=8 * precision.eps)
    ahead, behind = (fast.angles_for_target(side * r, rise, 22.0) for side in (1.0, -1.0))
    facing_down = np.asarray(ahead.low) < 0
    mirrored = math.pi - np.asarray(ahead.low) - 2 * math.pi * facing_down
    np.testing.assert_allclose(behind.low, mirrored, **near)
    np.testing.assert_allclose(behind.high, math.pi - np.asarray(ahead.high), **near)
    ahead, behind = (fast.angles_for_range(side * r, 22.0) for side in (1.0, -1.0))
    np.testing.assert_allclose(behind.low, math.pi - np.asarray(ahead.low), **near)
    np.testing.assert_allclose(behind.high, math.pi - np.asarray(ahead.high), **near)
    ahead, behind = (fast.least_speed(side * r, rise) for side in (1.0, -1.0))
    np.testing.assert_allclose(behind.speed, ahead.speed, **near)
    np.testing.assert_allclose(behind.angle, math.pi - np.asarray(ahead.angle), **near)


def test_verlet_flies_the_closed_forms(precision):
    """Both arcs to many targets and to the apex, each lane with its own step: verlet is exact under constant acceleration."""
    r = jnp.linspace(5.0, 60.0, 40, dtype=precision.dtype)
    rise = jnp.linspace(-10.0, 8.0, 40, dtype=precision.dtype)
    low, high, ok = fast.angles_for_target(r, rise, 30.0)
    assert ok.all()
    angle = jnp.concatenate([low, high, high])
    time = jnp.concatenate([r / (30.0 * jnp.cos(low)), r / (30.0 * jnp.cos(high)), fast.apex_time(30.0, high)])
    aim = fast.velocity(0.0, 30.0, angle)
    shots = Scene(Particles(jnp.zeros_like(aim), aim), forces=(forces.Gravity(),))
    flown = simulate(shots, methods.verlet, dt=time / 64, steps=64, save_every=16)
    close = dict(
        rtol=0, atol=200 * (30.0**2 / G) * precision.eps
    )  # near the vertical an angle's last digit moves the target
    np.testing.assert_allclose(flown.position, fast.position(flown.time, 30.0, angle[None]), **close)
    np.testing.assert_allclose(flown.velocity, fast.velocity(flown.time, 30.0, angle[None]), **close)
    last, target = flown.position[-1], np.stack([r, rise], axis=-1)
    np.testing.assert_allclose(last[:40], target, **close)
    np.testing.assert_allclose(last[40:80], target, **close)
    np.testing.assert_allclose(last[80:, 1], fast.apex_height(30.0, high), **close)
    np.testing.assert_allclose(flown.velocity[-1, 80:, 1], 0.0, **close)


SMOOTH = {
    "position": (lambda t, s, a, y0, g: projectile.position(t, s, a, height=y0, g=g), (1.3, 20.0, 0.7, 2.0, 9.8)),
    "velocity": (lambda t, s, a, g: projectile.velocity(t, s, a, g=g), (1.3, 20.0, 0.7, 9.8)),
    "apex_time": (lambda s, a, g: projectile.apex_time(s, a, g=g), (20.0, 0.7, 9.8)),
    "apex_height": (lambda s, a, y0, g: projectile.apex_height(s, a, height=y0, g=g), (20.0, 0.7, 2.0, 9.8)),
    "flight_time": (
        lambda s, a, y0, y, g: projectile.flight_time(s, a, height=y0, target_height=y, g=g),
        (20.0, 0.7, 2.0, 5.0, 9.8),
    ),
    "flight_time, thrown down": (
        lambda s, a, y0, y, g: projectile.flight_time(s, a, height=y0, target_height=y, g=g),
        (20.0, -0.7, 6.0, 1.0, 9.8),
    ),
    "horizontal_range": (
        lambda s, a, y0, y, g: projectile.horizontal_range(s, a, height=y0, target_height=y, g=g),
        (20.0, 0.7, 2.0, 5.0, 9.8),
    ),
    "angle_for_apex": (lambda h, s, y0, g: projectile.angle_for_apex(h, s, height=y0, g=g)[0], (9.0, 20.0, 2.0, 9.8)),
    "angles_for_range": (lambda r, s, g: projectile.angles_for_range(r, s, g=g)[:2], (30.0, 20.0, 9.8)),
    "angles_for_target": (lambda *a: projectile.angles_for_target(*a[:3], g=a[3])[:2], (20.0, 6.0, 20.0, 9.8)),
    "angles_for_target, down": (lambda *a: projectile.angles_for_target(*a[:3], g=a[3])[:2], (20.0, -9.0, 20.0, 9.8)),
    "angles_for_target, overhead": (lambda *a: projectile.angles_for_target(*a[:3], g=a[3])[:2], (0.0, 9.0, 20.0, 9.8)),
    "least_speed": (lambda r, rise, g: tuple(projectile.least_speed(r, rise, g=g)), (20.0, 6.0, 9.8)),
    "least_speed, down": (lambda r, rise, g: tuple(projectile.least_speed(r, rise, g=g)), (20.0, -6.0, 9.8)),
    "least_speed, behind": (lambda r, rise, g: tuple(projectile.least_speed(r, rise, g=g)), (-20.0, -6.0, 9.8)),
    "least_speed, overhead": (lambda r, rise, g: tuple(projectile.least_speed(r, rise, g=g)), (0.0, 6.0, 9.8)),
}


@pytest.mark.parametrize(("function", "point"), SMOOTH.values(), ids=SMOOTH)
def test_derivatives_against_central_differences(function, point):
    """The gradient, forward and reverse, and all second derivatives."""
    flat = lambda p: jnp.concatenate([jnp.atleast_1d(leaf) for leaf in jax.tree.leaves(function(*p))])  # noqa: E731
    slope = jax.jacfwd(flat)
    everything = jax.jit(jax.vmap(lambda p: (flat(p), slope(p), jax.jacrev(flat)(p), jax.jacfwd(slope)(p))))
    h, n = 1e-5, len(point)
    offsets = h * np.concatenate([np.zeros((1, n)), np.eye(n), -np.eye(n)])
    values, forward, reverse, second = everything(jnp.asarray(np.asarray(point) + offsets))
    for f, derivative in ((values, forward), (values, reverse), (forward, second)):
        central = np.moveaxis(np.asarray(f[1 : n + 1] - f[n + 1 :]) / (2 * h), 0, -1)
        np.testing.assert_allclose(derivative[0], central, rtol=1e-6, atol=1e-8)


EDGES = {
    "no height to fall": (lambda s, a, y: projectile.flight_time(s, a, target_height=y), (20.0, 0.0, 0.0)),
    "the target at the apex": (
        lambda s, a, y: projectile.flight_time(s, a, target_height=y),
        (14.0, HALF_PI, 10.0),
    ),
    "an apex at the launch": (lambda h, s: projectile.angle_for_apex(h, s).angle, (0.0, 14.0)),
    "an apex straight up": (lambda h, s: projectile.angle_for_apex(h, s).angle, (10.0, 14.0)),
    "no distance": (lambda r, s: projectile.angles_for_range(r, s)[:2], (0.0, 14.0)),
    "the farthest distance": (lambda r, s: projectile.angles_for_range(r, s)[:2], (20.0, 14.0)),
    "the launch point": (lambda *a: projectile.angles_for_target(*a)[:2], (0.0, 0.0, 14.0)),
    "straight up": (lambda *a: projectile.angles_for_target(*a)[:2], (0.0, 5.0, 14.0)),
    "straight up to the apex": (lambda *a: projectile.angles_for_target(*a)[:2], (0.0, 10.0, 14.0)),
    "straight down": (lambda *a: projectile.angles_for_target(*a)[:2], (0.0, -5.0, 14.0)),
    "the edge of reach": (lambda *a: projectile.angles_for_target(*a)[:2], (20.0, 0.0, 14.0)),
    "slowest to the launch point": (lambda *a: tuple(projectile.least_speed(*a)), (0.0, 0.0)),
    "slowest straight up": (lambda *a: tuple(projectile.least_speed(*a)), (0.0, 5.0)),
    "slowest straight down": (lambda *a: tuple(projectile.least_speed(*a)), (0.0, -5.0)),
}


@pytest.mark.parametrize(("function", "point"), EDGES.values(), ids=EDGES)
def test_derivatives_are_finite_at_every_edge(function, point, precision):
    point = tuple(jnp.asarray(number, precision.dtype) for number in point)
    every = tuple(range(len(point)))
    forward, reverse = jax.jacfwd(function, every), jax.jacrev(function, every)
    found = jax.jit(lambda *p: (function(*p), forward(*p), reverse(*p)))(*point)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))


def test_a_near_target_turns_the_low_arc_as_level_ground_does():
    slope = jax.jit(jax.grad(lambda r: projectile.angles_for_target(r, 0.0, 14.0).low))
    assert slope(0.0) == pytest.approx(G / (2 * 14.0**2), rel=1e-14)


UNREACHABLE = {
    "angles_for_target": lambda s, r: projectile.angles_for_target(r, 0.0, s).low,
    "angles_for_range": lambda s, r: projectile.angles_for_range(r, s).high,
    "angle_for_apex": lambda s, r: projectile.angle_for_apex(r / 2, s).angle,
    "flight_time": lambda s, r: projectile.flight_time(s, HALF_PI, target_height=r / 2),
}


@pytest.mark.parametrize("function", UNREACHABLE.values(), ids=UNREACHABLE)
def test_what_is_out_of_reach_harms_no_neighbour(function):
    """A shared speed, one target in reach and one not: the gradient is that of the one in reach."""

    def total(s, r):
        found = function(s, r)
        return jnp.sum(jnp.where(jnp.isnan(found), 0.0, found))

    both = jnp.asarray([10.0, 1e3])
    np.testing.assert_array_equal(jnp.isnan(function(14.0, both)), [False, True])
    for slope in (jax.jit(jax.grad(total)), jax.jit(jax.jacfwd(total))):
        assert slope(14.0, both) == pytest.approx(float(slope(14.0, both[:1])), rel=1e-14)


def test_batches_agree_with_single_shots_under_jit_and_vmap(precision):
    r = jnp.linspace(-60.0, 60.0, 12, dtype=precision.dtype)[:, None]
    s = jnp.linspace(10.0, 40.0, 5, dtype=precision.dtype)[None, :]
    arcs = fast.angles_for_target(r, 3.0, s)
    one_by_one = jax.vmap(jax.vmap(projectile.angles_for_target, (None, None, 0)), (0, None, None))(r[:, 0], 3.0, s[0])
    assert arcs.low.shape == arcs.ok.shape == (12, 5)
    for batch, single in zip(arcs, one_by_one, strict=True):
        assert batch.dtype == single.dtype
        np.testing.assert_allclose(batch, single, rtol=16 * precision.eps)
    assert projectile.position(0.5, s, r).shape == (12, 5, 2)
    assert projectile.least_speed(r, 1.0).speed.dtype == precision.dtype


def test_python_numbers_stay_weak():
    single = jnp.asarray(20.0, jnp.float32)
    assert (projectile.flight_time(20, 0.5) * single).dtype == jnp.float32
    assert projectile.position(1, single, 0.5, height=2, g=10).dtype == jnp.float32


def test_nan_angles_are_passed_on():
    arcs = projectile.angles_for_target(jnp.asarray([10.0, 1e3]), 0.0, 14.0)
    for result in (
        projectile.flight_time(14.0, arcs.low),
        projectile.apex_height(14.0, arcs.high),
        projectile.position(projectile.flight_time(14.0, arcs.low), 14.0, arcs.low)[:, 0],
    ):
        np.testing.assert_array_equal(jnp.isnan(result), [False, True])


BAD = {
    "g negative, as the lecture prints it": (
        lambda: projectile.flight_time(20.0, 0.5, g=-9.8),
        r"g \[m/s²\].*-9.8.*> 0",
    ),
    "g zero": (lambda: projectile.least_speed(10.0, 1.0, g=0), r"g \[m/s²\].*> 0"),
    "speed zero": (lambda: projectile.angles_for_target(10.0, 1.0, 0.0), r"speed \[m/s\].*> 0"),
    "a speed negative": (lambda: projectile.apex_time(jnp.asarray([3.0, -1.0]), 0.5), r"speed \[m/s\].*index 1"),
    "distance NaN": (lambda: projectile.angles_for_range(math.nan, 20.0), r"distance \[m\].*finite"),
    "height infinite": (lambda: projectile.position(1.0, 20.0, 0.5, height=math.inf), r"height \[m\].*finite"),
    "shapes": (lambda: projectile.position(jnp.ones(3), 20.0, jnp.ones(4)), r"t \(3,\).*angle \(4,\).*broadcast"),
}


@pytest.mark.parametrize(("call", "message"), BAD.values(), ids=BAD)
def test_bad_numbers_are_told_in_plain_words(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.usefixtures("unannotated")
def test_what_is_no_number_is_a_type_error():
    with pytest.raises(TypeError, match=r"angle \[rad\]"):
        projectile.apex_time(20.0, "steep")


def test_traced_bad_numbers_become_nan_and_not_ok():
    arcs = jax.jit(projectile.angles_for_target)(10.0, 1.0, jnp.asarray([0.0, jnp.nan, 20.0]))
    np.testing.assert_array_equal(arcs.ok, [False, False, True])
    np.testing.assert_array_equal(jnp.isnan(arcs.low), [True, True, False])
