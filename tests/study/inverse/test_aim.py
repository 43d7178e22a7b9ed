"""Aiming: against the closed form, against brute force, against diffrax; its derivatives, its edges, its errors."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from physjax import Particles, Scene, aim_at, contacts, forces, methods, projectile, reference, simulate
from physjax.parts import as_module
from physjax.study.inverse.shooting import AimProblem, Launch, find_nearest_launch
from physjax.vectors import norm

RNG = np.random.default_rng(7)
COUNT = 10_000
BASEBALL = {"area": 4.3e-3, "coefficient": 0.35}


def ball(dim=2, *more, position=None, mass=0.145, **parts):
    """A ball at rest at the origin under gravity."""
    position = jnp.zeros(dim) if position is None else jnp.asarray(position)
    return Scene(Particles(position, jnp.zeros_like(position)), mass=mass, forces=(forces.Gravity(), *more), **parts)


def around(a, b):
    """How far apart two angles are, whole turns aside."""
    return np.abs(np.angle(np.exp(1j * (np.asarray(a) - np.asarray(b)))))


def reachable(count, share):
    """Targets and speeds: a share of the reach at a height between far below and near the highest point, on either side."""
    speed = RNG.uniform(5, 60, count)
    rise = RNG.uniform(-2, 0.95, count)
    rise, farthest = rise * speed**2 / 19.6, speed**2 / 9.8 * np.sqrt(1 - rise)
    side = RNG.choice([-1, 1], count)
    return jnp.asarray(np.stack([side * share * farthest, rise], axis=-1)), jnp.asarray(speed)


# without drag: the closed form


def test_both_arcs_are_the_closed_form_for_ten_thousand_targets_and_none_is_missed():
    targets, speed = reachable(COUNT, RNG.uniform(0.01, 1, COUNT))
    aimed = aim_at(ball(), targets, speed=speed)
    truth = projectile.angles_for_target(targets[:, 0], targets[:, 1], speed)
    assert truth.ok.all()
    assert aimed.low.ok.all()
    assert aimed.high.ok.all()
    for shot, angle in ((aimed.low, truth.low), (aimed.high, truth.high)):
        assert around(shot.angle, angle).max() < 1e-10
        np.testing.assert_allclose(shot.time, targets[:, 0] / (speed * np.cos(angle)), rtol=1e-10)
        turned = shot.time > projectile.apex_time(speed, angle)
        top = np.where(np.sin(angle) > 0, np.where(turned, projectile.apex_height(speed, angle), targets[:, 1]), 0.0)
        np.testing.assert_allclose(shot.apex, top, atol=1e-9)
        assert shot.miss.max() < 1e-10


def test_out_of_reach_none_is_invented_and_the_miss_is_the_distance_to_the_envelope():
    """The envelope of all shots is y = s²/2g - gx²/2s²; a sweep of its points gives the distance from it."""
    targets, speed = reachable(1000, np.concatenate([RNG.uniform(1.0001, 3, 500), 1 + 10 ** RNG.uniform(-8, -4, 500)]))
    aimed = aim_at(ball(), targets, speed=speed)
    assert not aimed.ok.any()
    assert not aimed.low.ok.any()
    # the foot of the perpendicular in units of s²/g, by Newton's method on the cubic for its x
    x, y = np.abs(np.asarray(targets[:, 0])) * 9.8 / speed**2, np.asarray(targets[:, 1]) * 9.8 / speed**2
    foot = np.asarray(x)
    for _ in range(60):
        gap = 0.5 - foot**2 / 2 - y
        foot = foot - (foot - x - foot * gap) / (1 - gap + foot**2)
    away = np.hypot(foot - x, 0.5 - foot**2 / 2 - y) * np.asarray(speed) ** 2 / 9.8
    for shot in (aimed.low, aimed.high):
        np.testing.assert_allclose(shot.miss, away, rtol=1e-5)
        assert np.isfinite(shot.angle).all()


def test_near_the_edge_of_reach_exactly_those_in_reach_are_hit():
    share = 1 + RNG.choice([-1, 1], 1000) * 10 ** RNG.uniform(-9, -2, 1000)
    targets, speed = reachable(1000, share)
    aimed = aim_at(ball(), targets, speed=speed)
    np.testing.assert_array_equal(aimed.low.ok, share < 1)
    np.testing.assert_array_equal(aimed.high.ok, share < 1)
    truth = projectile.angles_for_target(targets[:, 0], targets[:, 1], speed)
    far = np.abs(share - 1) > 1e-6  # nearer, the closed form itself loses these digits
    for shot, angle in ((aimed.low, truth.low), (aimed.high, truth.high)):
        assert around(shot.angle, angle)[np.asarray(truth.ok) & far].max() < 1e-10


def test_the_least_speed_is_the_closed_form():
    targets, speed = reachable(1000, RNG.uniform(0.01, 1, 1000))
    aimed = aim_at(ball(), targets)
    truth = projectile.least_speed(targets[:, 0], targets[:, 1])
    assert aimed.ok.all()
    np.testing.assert_allclose(aimed.low.speed, truth.speed, rtol=1e-10)
    assert around(aimed.low.angle, truth.angle).max() < 1e-7  # the speed is flat there
    assert (aimed.low.speed <= speed).all()


def test_in_space_every_bearing_is_the_same():
    """Elevations are those in the vertical plane of the target, and the azimuth is the target's, from x towards z."""
    bearing = jnp.linspace(-3.1, 3.1, 50)
    flat, up = 40.0, 3.0
    targets = jnp.stack([flat * jnp.cos(bearing), jnp.full(50, up), flat * jnp.sin(bearing)], axis=-1)
    aimed = aim_at(ball(3), targets, speed=30.0)
    truth = projectile.angles_for_target(flat, up, 30.0)
    assert aimed.ok.all()
    for shot, angle in ((aimed.low, truth.low), (aimed.high, truth.high)):
        np.testing.assert_allclose(shot.angle, angle, atol=1e-12)
        assert around(shot.azimuth, bearing).max() < 1e-12


def test_overhead_below_and_without_gravity():
    aimed = aim_at(ball(), [[0.0, 20.0], [0.0, -20.0]], speed=30.0)
    assert aimed.low.ok.all()
    assert aimed.high.ok.all()
    np.testing.assert_allclose(aimed.low.angle, [math.pi / 2, -math.pi / 2], atol=1e-9)
    np.testing.assert_allclose(aimed.high.angle, math.pi / 2, atol=1e-9)
    assert (aimed.low.time < aimed.high.time).all()
    straight = aim_at(Scene(Particles(jnp.zeros(2), jnp.zeros(2))), (3.0, 4.0), speed=10.0)
    assert straight.low.ok
    assert straight.low.angle == pytest.approx(math.atan2(4, 3), abs=1e-12)
    assert straight.low.time == pytest.approx(0.5, abs=1e-12)
    assert straight.high.ok
    assert straight.high.time == pytest.approx(0.5, abs=1e-12)


# with drag and wind: no closed form


@pytest.fixture(scope="module")
def windy():
    """Ten thousand targets, each in a wind of its own: where a random shot comes by, so that all are in reach."""
    speed, angle = RNG.uniform(10, 50, COUNT), RNG.uniform(-1.2, 1.5, COUNT)
    wind = jnp.asarray(RNG.normal(size=(COUNT, 2)) * 4)
    scene = ball(2, forces.QuadraticDrag(**BASEBALL, wind=wind), position=np.zeros((COUNT, 2)))
    thrown = Particles(scene.state.position, jnp.asarray(speed[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)))
    time = jnp.asarray(RNG.uniform(0.2, 1.1, COUNT) * 2 * speed / 9.8)
    target = simulate(scene.replace(state=thrown), methods.rk4, dt=time / 400, steps=400, save_every=400).position[-1]
    return scene, target, jnp.asarray(speed), angle, aim_at(scene, target, speed=jnp.asarray(speed))


def test_drag_and_wind_every_target_in_reach_is_hit(windy):
    """One of the arcs is the shot that made the target; both end on it to far less than a micrometre."""
    _, _, _, angle, aimed = windy
    assert aimed.low.ok.all()
    assert aimed.high.ok.all()
    assert max(aimed.low.miss.max(), aimed.high.miss.max()) < 1e-10
    known = np.minimum(around(aimed.low.angle, angle), around(aimed.high.angle, angle))
    assert known.max() < 1e-5  # as near as the edge of reach lets two methods agree
    assert np.median(known) < 1e-9
    assert (aimed.low.time <= aimed.high.time * (1 + 1e-9)).all()


def test_the_true_motion_ends_on_the_target_too(windy):
    """The same launches through diffrax at 1e-12: what the steps of rk4 leave is below a micrometre."""
    _, target, _, _, aimed = windy
    for lane in range(0, COUNT, 2000):
        for shot in (aimed.low, aimed.high):
            one = jax.tree.map(
                lambda leaf, lane=lane: leaf[lane] if leaf.shape[:1] == (COUNT,) else leaf, aimed.scene(shot)
            )
            end = reference(one, [float(shot.time[lane])], rtol=1e-12, atol=1e-12).position[-1]
            assert np.abs(end - np.asarray(target[lane])).max() < 1e-6


@pytest.mark.slow
def test_reach_with_drag_is_that_of_brute_force():
    """A fan of 4001 shots: the farthest that any of them comes down is where targets stop to be hit."""
    drag = forces.QuadraticDrag(**BASEBALL, wind=(-4.0, 0.0))
    angle = jnp.linspace(0.2, 1.2, 4001)
    fan = 30.0 * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    scene = ball(2, drag, position=jnp.zeros((4001, 2)))
    paths = simulate(
        scene.replace(state=Particles(jnp.zeros((4001, 2)), fan)), methods.rk4, dt=0.01, steps=700
    ).position
    x, y = np.asarray(paths[..., 0]), np.asarray(paths[..., 1])
    down = np.argmax((y[1:] < 0) & (y[:-1] >= 0), axis=0)[None]
    at = lambda a, i: np.take_along_axis(a, i, axis=0)[0]  # noqa: E731
    y0, y1, x0, x1 = at(y, down), at(y, down + 1), at(x, down), at(x, down + 1)
    farthest = (x0 + (x1 - x0) * y0 / (y0 - y1)).max()
    reach = farthest + jnp.array([-1e-3, 1e-3])
    aimed = aim_at(ball(2, drag), jnp.stack([reach, jnp.zeros(2)], axis=-1), speed=30.0)
    np.testing.assert_array_equal(aimed.ok, [True, False])
    assert 0 < aimed.low.miss[1] < 1e-3
    assert aimed.low.angle[1] == pytest.approx(float(aimed.low.angle[0]), abs=0.02)


@pytest.mark.slow
def test_magnus_buoyancy_and_crosswind_in_space():
    spin = forces.Magnus(area=0.038, coefficient=0.2, axis=(0.0, 1.0, 0.0))
    drag = forces.QuadraticDrag(area=0.038, coefficient=0.25, wind=(2.0, 0.0, -3.0))
    scene = ball(3, drag, spin, forces.Buoyancy(volume=5.6e-3, density=1.2), mass=0.43)
    aimed = aim_at(scene, (20.0, 2.0, 4.0), speed=25.0)
    assert aimed.low.ok
    assert aimed.high.ok
    assert aimed.low.time < aimed.high.time
    for shot in (aimed.low, aimed.high):
        assert norm_of(shot.velocity) == pytest.approx(25.0, rel=1e-12)
        end = reference(aimed.scene(shot), [float(shot.time)], rtol=1e-12, atol=1e-12).position[-1]
        np.testing.assert_allclose(end, [20.0, 2.0, 4.0], atol=1e-6)


def test_another_method_aims_by_its_own_path():
    scene = ball(2, forces.QuadraticDrag(**BASEBALL))
    aimed = aim_at(scene, (40.0, 3.0), speed=30.0, method=methods.semi_implicit_euler, steps=50)
    flight = aimed.flight(aimed.low)
    assert aimed.low.ok
    np.testing.assert_allclose(flight.position[-1], [40.0, 3.0], atol=1e-10)
    assert flight.position.shape == (51, 2)


# derivatives


def gusty(numbers):
    """Angles of both arcs in a wind, as a function of everything."""
    drag = forces.QuadraticDrag(4.3e-3, numbers["drag"], wind=numbers["wind"])
    aimed = aim_at(ball(2, drag), numbers["target"], speed=numbers["speed"])
    return jnp.stack([aimed.low.angle, aimed.high.angle])


NUMBERS = {
    "drag": jnp.asarray(0.35),
    "wind": jnp.array([-4.0, 1.0]),
    "target": jnp.array([40.0, 3.0]),
    "speed": jnp.asarray(30.0),
}


def central_differences(function, numbers, step):
    """Derivatives by everything, of fourth order in the step."""
    flat, shaped = ravel_pytree(numbers)
    many = jax.jit(jax.vmap(lambda flat: function(shaped(flat))))
    shifts = step * jnp.eye(flat.size)
    stencil = jnp.concatenate([flat[None] + k * shifts for k in (-2, -1, 1, 2)])
    a, b, c, d = jnp.split(many(stencil), 4)
    return (a - 8 * b + 8 * c - d) / (12 * step)


def test_derivatives_forward_and_reverse_are_central_differences():
    expected = central_differences(gusty, NUMBERS, 1e-3)
    for derivative in (jax.jacfwd, jax.jacrev):
        found = jax.jit(derivative(gusty))(NUMBERS)
        flat = jnp.concatenate([jnp.reshape(leaf, (2, -1)).T for leaf in jax.tree.leaves(found)])
        np.testing.assert_allclose(flat, expected, atol=1e-6)
    assert np.abs(expected).max() > 0.1


def test_a_miss_has_zero_derivatives_and_spoils_no_neighbour():
    targets = jnp.array([[40.0, 3.0], [4000.0, 3.0]])
    total = lambda targets: aim_at(ball(), targets, speed=30.0).low.angle.sum()  # noqa: E731
    found = jax.jit(jax.grad(total))(targets)
    alone = jax.grad(lambda t: projectile.angles_for_target(*t, 30.0).low)(targets[0])
    np.testing.assert_allclose(found, jnp.stack([alone, jnp.zeros(2)]), atol=1e-12)


@pytest.mark.parametrize("precision", ["float64"], indirect=True)
def test_vmap_is_the_same_as_lanes(precision):
    targets = jnp.array([[20.0, 3.0], [25.0, -4.0], [70.0, 0.0]], precision.dtype)
    scene = ball(position=jnp.zeros(2, precision.dtype))
    lanes = aim_at(scene, targets, speed=20.0)
    mapped = jax.vmap(lambda target: aim_at(scene, target, speed=20.0))(targets)
    np.testing.assert_array_equal(lanes.ok, [True, True, False])
    np.testing.assert_array_equal(mapped.ok, lanes.ok)
    assert lanes.low.angle.dtype == precision.dtype
    np.testing.assert_allclose(mapped.low.angle[:2], lanes.low.angle[:2], rtol=200 * precision.eps)
    truth = projectile.angles_for_target(targets[:2, 0], targets[:2, 1], 20.0)
    np.testing.assert_allclose(lanes.high.angle[:2], truth.high, rtol=2000 * precision.eps)


# obstacles and errors


def test_a_wall_in_the_way_stops_the_low_arc_and_not_the_high_one():
    wall = contacts.Sphere(center=(20.0, 0.0), radius=7.0, response=contacts.project)
    aimed = aim_at(ball(contacts=(wall,)), (40.0, 0.0), speed=22.0)
    assert not aimed.low.ok
    assert aimed.high.ok
    assert aimed.low.miss > 1


def norm_of(vector):
    return float(np.sqrt((np.asarray(vector) ** 2).sum()))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"speed": 0.0}, "numbers > 0"),
        ({"speed": -3.0}, "numbers > 0"),
        ({"speed": jnp.ones(3)}, "one for each target"),
        ({"target": (0.0, 0.0)}, "a target away from the launch"),
        ({"target": (1.0, 2.0, 3.0)}, "as many components"),
        ({"target": (jnp.nan, 0.0)}, "finite"),
        ({"steps": 0}, "at least 1"),
        ({"scene": ball(pinned=jnp.asarray(True))}, "launch velocity that is free"),
        ({"scene": ball(2, lambda t, state, mass: 0 * state.velocity)}, "forces.independent"),
        ({"scene": ball(position=jnp.zeros((3, 2))), "target": jnp.ones((4, 2))}, "one for each"),
        ({"scene": Scene(Particles(jnp.zeros(1), jnp.zeros(1))), "target": (1.0,)}, "2 or 3"),
    ],
)
def test_bad_input_is_told_before_compiling(arguments, words):
    with pytest.raises(ValueError, match=words):
        aim_at(**{"scene": ball(), "target": (40.0, 0.0), "speed": 30.0, **arguments})


def test_what_is_no_scene_or_no_method_is_told(unannotated):
    with pytest.raises(TypeError, match="expected a Scene"):
        aim_at("ball", (40.0, 0.0), speed=30.0)
    with pytest.raises(TypeError, match="expected a method"):
        aim_at(ball(), (40.0, 0.0), speed=30.0, method="rk4")


# to the last digits


def test_the_descent_to_a_hit_ends_at_rounding(precision):
    """Damped steps leave a share of the miss: it has to go on until nothing but rounding is left."""
    targets, speed = (jnp.asarray(part, precision.dtype) for part in reachable(64, RNG.uniform(0.1, 0.9, 64)))
    shots = AimProblem(ball(position=jnp.zeros((64, 2), precision.dtype)), targets, as_module(methods.rk4), 32)
    truth = projectile.angles_for_target(targets[:, 0], targets[:, 1], speed)
    time = targets[:, 0] / (speed * jnp.cos(truth.low))
    angle = truth.low + jnp.linspace(-0.05, 0.05, 64, dtype=precision.dtype)
    start = Launch(speed[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1), time)
    found, distance = jax.jit(find_nearest_launch)(shots, start, speed, jnp.ones(64, bool))
    extent = norm(targets) + speed * found.time
    assert (distance / extent).max() < 8 * precision.eps
    assert (distance <= shots.rounding(found)).all()


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["float32"], indirect=True)  # whose rounding is seen
def test_far_from_the_origin_a_hit_is_a_hit(precision):
    """Places are rounded by where they are, at every step; what that leaves of a miss is no miss."""
    targets, speed = (jnp.asarray(part, precision.dtype) for part in reachable(256, RNG.uniform(0.5, 0.9, 256)))
    # a flight so short that the rounding of places is no small share of it may be a miss
    targets, speed = targets[speed > 40], speed[speed > 40]
    far = jnp.full(2, 1000.0, precision.dtype)
    aimed = aim_at(ball(position=far), far[None] + targets, speed=speed)
    assert aimed.low.ok.all()
    assert aimed.high.ok.all()
    targets, speed = (jnp.asarray(part, precision.dtype) for part in reachable(64, 1.01))
    assert not aim_at(ball(position=far), far[None] + targets, speed=speed).ok.any()


def cycled(vector, up):
    """A vector of a world in which y is up, in one where another axis is."""
    return jnp.roll(jnp.asarray(vector), up - 1, axis=-1)


@pytest.mark.parametrize("up", [pytest.param(0, marks=pytest.mark.slow), 2])
def test_elevation_and_apex_are_along_the_axis_that_is_up(up):
    """The same shot with the axes exchanged in their cycle; the azimuth is from the first of the other two."""
    target, weight = (20.0, 3.0, -7.0), forces.Gravity(up=up)
    usual = aim_at(ball(3, forces.QuadraticDrag(**BASEBALL, wind=(1.0, 0.0, 2.0))), target, speed=25.0)
    drag = forces.QuadraticDrag(**BASEBALL, wind=cycled((1.0, 0.0, 2.0), up))
    scene = Scene(Particles(jnp.zeros(3), jnp.zeros(3)), 0.145, (drag, weight))
    turned = aim_at(scene, cycled(target, up), speed=25.0)
    assert scene.up == up
    for ours, theirs in ((turned.low, usual.low), (turned.high, usual.high)):
        assert ours.ok
        np.testing.assert_allclose(ours.velocity, cycled(theirs.velocity, up), atol=1e-11)
        np.testing.assert_allclose([ours.angle, ours.apex], [theirs.angle, theirs.apex], atol=1e-11)
        level = np.delete(np.asarray(ours.velocity), up)
        assert ours.azimuth == pytest.approx(math.atan2(level[1], level[0]), abs=1e-12)
