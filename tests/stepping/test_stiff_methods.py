"""The implicit midpoint rule and TR-BDF2: order, damping, what they solve, the error they know, bodies, derivatives."""

import functools
import math
from itertools import pairwise, product

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Inertia, Particles, Pins, Scene, forces, lattices, methods, reference, rigid, simulate
from physjax.parts import as_module
from physjax.physics.forces import independent
from physjax.stepping.methods import ImplicitMidpoint, TrBdf2
from physjax.stepping.pairs import Pair, read_pair
from physjax.stepping.simulate import sample_states

LINEARISED = (methods.implicit_midpoint, methods.tr_bdf2)
CONVERGED = (ImplicitMidpoint(tolerance=1e-12, newton=20), TrBdf2(tolerance=1e-12, newton=20))
EACH = pytest.mark.parametrize("method", LINEARISED, ids=lambda method: method.__name__)
BOTH_WAYS = pytest.mark.parametrize("method", [*LINEARISED, *CONVERGED], ids=lambda method: method.__name__)
GAMMA = 2 - math.sqrt(2)


def demand_order(ends, wanted, tolerance=0.15):
    """Ends at steps halved each time differ by ever less, as the order says."""
    steps = [max(np.abs(a - b).max() for a, b in zip(*pair, strict=True)) for pair in pairwise(ends)]
    np.testing.assert_allclose(np.log2(np.divide(steps[:-1], steps[1:])), wanted, rtol=0, atol=tolerance)


def run_to(scene, method, time, counts):
    """The states at a time [s] after n steps, for each n."""
    found = [sample_states(scene, as_module(method), time / n, n, frames=1) for n in counts]
    return [jax.tree.map(lambda leaf: np.asarray(leaf[-1], float), tuple(state)) for state in found]


# promises


@independent
def wave(t, state, mass):
    """A push that changes with time: a method that looks at the wrong moment loses its order."""
    return jnp.broadcast_to(jnp.stack([jnp.cos(2.0 * t), jnp.sin(3.0 * t)], axis=-1), state.position.shape)


def shaken(drag, dtype=float, lanes=()):
    """An elastic pendulum, shaken, with and without drag; many of them differ in their push."""
    start = np.broadcast_to([0.8, -0.3], (*lanes, 2)), np.broadcast_to([0.4, 0.9], (*lanes, 2))
    pushes = 1.0 + 0.1 * np.arange(math.prod(lanes)).reshape((*lanes, 1)) if lanes else 1.0
    state = Particles(jnp.asarray(start[0], dtype), jnp.asarray(pushes * start[1], dtype))
    parts = (forces.Gravity(), forces.Anchor(point=(0.0, 0.0), stiffness=9.0, rest_length=0.6), wave)
    if drag:
        air = forces.QuadraticDrag(area=1.0, coefficient=0.5, wind=(1.0, 0.5))
        parts = (*parts, forces.StokesDrag(0.3), air)
    return Scene(state, mass=0.7, forces=parts)


@functools.cache
def truth(drag, lanes, time):
    """The state of the shaken pendulum at a time [s]."""
    return jax.tree.map(
        lambda leaf: leaf[-1], reference(shaken(drag, lanes=lanes), [time], rtol=1e-13, atol=1e-13).state
    )


@BOTH_WAYS
@pytest.mark.parametrize(("lanes", "drag"), [((), False), ((3,), True)], ids=["alone-position-only", "batch-drag"])
def test_order_is_the_promised_one(method, drag, lanes):
    errors = [
        max(np.abs(a - b).max() for a, b in zip(end, truth(drag, lanes, 2.0), strict=True))
        for end in run_to(shaken(drag, lanes=lanes), method, 2.0, (128, 256, 512))
    ]
    promised = method.promises.order_with_drag if drag else method.promises.order
    assert promised == 2
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), promised, rtol=0, atol=0.15)


@EACH
def test_order_in_float32(method):
    with jax.enable_x64(False):
        ends = run_to(shaken(True, np.float32), method, 2.0, (32, 64, 128, 256))
    demand_order(ends, 2)


@EACH
@pytest.mark.parametrize("newton", [0, 20])
def test_evaluations_a_step(method, newton):
    calls = []

    def counted(t, state, mass):
        calls.append(t)
        return -state.position

    with jax.disable_jit():  # the scene does not try its force then
        scene = Scene(Particles(jnp.ones(1), jnp.zeros(1)), forces=(counted,))
        type(method)(newton=newton)(scene, 0.0, scene.state, 0.1)
    assert method.promises.evaluations == {"implicit_midpoint": 1, "tr_bdf2": 3}[method.__name__.split(",")[0]]
    assert len(calls) == method.promises.evaluations if not newton else len(calls) > method.promises.evaluations


def amplification(method, step, damping=0.0):
    """The matrix of a step ω·dt of an oscillator with ω = 1, and a damping [1/s]."""
    spring = forces.Anchor(point=jnp.zeros(1), stiffness=1.0, damping=damping)
    scene = Scene(Particles(jnp.zeros(1), jnp.zeros(1)), forces=(spring,))
    one_step = lambda y: jnp.concatenate(method(scene, 0.0, Particles(y[:1], y[1:]), step))  # noqa: E731
    return np.asarray(jax.jacfwd(one_step)(jnp.zeros(2)))


def stability_function(method, z):
    """What a step does to a mode e^(λt), z = λ dt."""
    if isinstance(method, ImplicitMidpoint):
        return (1 + z / 2) / (1 - z / 2)
    return (1 + (1 - GAMMA / 2 - GAMMA / 2) * z) / (1 - GAMMA / 2 * z) ** 2


@EACH
@pytest.mark.parametrize("damping", [0.0, 0.3, 5.0])
@pytest.mark.parametrize("step", [0.01, 0.5, 1.0, 30.0, 1e4])
def test_any_step_is_stable_and_damps_as_the_stability_function_says(method, step, damping):
    rates = np.linalg.eigvals([[0.0, 1.0], [-1.0, -damping]])
    wanted = np.sort_complex(stability_function(method, step * rates.astype(complex)))
    found = np.sort_complex(np.linalg.eigvals(amplification(method, step, damping)).astype(complex))
    np.testing.assert_allclose(np.abs(found), np.abs(wanted), rtol=0, atol=1e-12)
    assert np.isinf(method.promises.stability_limit)
    assert np.abs(found).max() < 1 + 2e-4


@pytest.mark.parametrize("converged", [0, 20])
def test_a_stiff_mode_is_damped_to_a_two_thousandth_a_step(converged, precision):
    state = Particles(jnp.zeros(1, precision.dtype), jnp.ones(1, precision.dtype))
    scene = Scene(state, forces=(forces.StokesDrag(1e4),))
    after = simulate(scene, TrBdf2(newton=converged), dt=1.0, steps=1).final_scene.state
    assert abs(float(after.velocity[0])) < 5e-4
    assert float(after.velocity[0]) == pytest.approx(stability_function(methods.tr_bdf2, -1e4), rel=1e-3)


def pull_neighbours(t, state, mass):
    """A taut string of weights that move sideways alone."""
    padded = jnp.pad(state.position, ((1, 1), (0, 0)))
    return padded[2:] - 2 * padded[1:-1] + padded[:-2]


@pytest.mark.parametrize("dt", [0.1, 10.0, 1e3])
def test_coupled_oscillators_keep_their_energy_to_the_residual_of_the_solver(dt):
    count, tolerance = 12, 1e-10

    start = np.random.default_rng(0).normal(size=(2, count, 1))
    scene = Scene(Particles(*map(jnp.asarray, start)), forces=(pull_neighbours,))

    def energy(x, v):
        return 0.5 * np.sum(v**2) + 0.5 * np.sum(np.diff(np.pad(x, ((1, 1), (0, 0))), axis=0) ** 2)

    film = simulate(scene, ImplicitMidpoint(tolerance=tolerance), dt=dt, steps=50)
    kept = [energy(x, v) for x, v in zip(np.asarray(film.position), np.asarray(film.velocity), strict=True)]
    # dt·a is up to 2 dt times as large as what it changes, and its error adds up
    np.testing.assert_allclose(kept, kept[0], rtol=50 * tolerance * (1 + 2 * dt))


@EACH
def test_constant_acceleration_is_exact(method, precision):
    state = Particles(jnp.zeros(2, precision.dtype), jnp.asarray([3.0, 4.0], precision.dtype))
    flight = simulate(Scene(state, forces=(forces.Gravity(),)), method, dt=0.125, steps=64)
    t = np.asarray(flight.time, float)
    np.testing.assert_allclose(flight.position[:, 1], 4.0 * t - 4.9 * t**2, rtol=0, atol=64 * 400 * precision.eps)


# springs, held and led nodes, wind


def hung(count, *others, stiffness=200.0, damping=None, dtype=float, pinned=None):
    """A cloth of count × count nodes hung by its upper edge, 1 kg a square metre."""
    stiff = {"structural": stiffness, "shear": stiffness, "bend": 0.1 * stiffness, "damping": damping}
    sheet = lattices.cloth(1.0, 1.0, count, count, mass=1.0, **stiff)
    state = Particles(*(jnp.asarray(leaf, dtype) for leaf in sheet.state))
    return sheet, Scene(
        state,
        sheet.mass,
        (forces.Gravity(), sheet.springs, *others),
        pinned=sheet.nodes["top"] if pinned is None else pinned,
    )


def crumpled(scene, size):
    """The scene with its free nodes pushed about: half the springs are compressed."""
    random, (x, v) = np.random.default_rng(0), scene.state
    free = 1.0 - np.asarray(scene.held)[:, None]
    push = lambda a, by: a + jnp.asarray(by * free * random.normal(size=a.shape), a.dtype)  # noqa: E731
    return eqx.tree_at(lambda scene: scene.state, scene, Particles(push(x, size), push(v, 0.3)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "case"),
    [*zip(LINEARISED, ["damped springs", "wind"], strict=True), *product(CONVERGED, ["springs"])],
    ids=lambda part: part if isinstance(part, str) else part.__name__,
)
def test_order_2_on_a_crumpled_cloth(method, case):
    """Also linearised once, although the matrix of a compressed spring is not its derivative."""
    sheet, scene = hung(4, damping=0.1 if case == "damped springs" else None)
    if case == "wind":
        scene = scene.replace(forces=(*scene.forces, sheet.wind((3.0, 0.0, 1.0))))
    demand_order(run_to(crumpled(scene, 0.02), method, 0.2, (128, 256, 512, 1024)), 2)


@EACH
def test_led_nodes_are_where_their_path_is_and_held_ones_stay(method):
    sheet, scene = hung(4)
    lead = sheet.nodes["top"]

    def path(t):
        return sheet.state.position + 0.1 * jnp.sin(3.0 * t) * jnp.asarray([[1.0, 0.0, 0.5]])

    led = Scene(
        Particles(scene.state.position, jnp.where(lead[:, None], jnp.asarray([[0.3, 0.0, 0.15]]), 0.0)),
        scene.mass,
        scene.forces,
        pinned=Pins(lead, path),
    )
    film = simulate(led, method, dt=0.05, steps=4)
    for t, frame in zip(film.time, film.position, strict=True):
        np.testing.assert_allclose(frame[lead], path(t)[lead], rtol=0, atol=1e-15)
    film = simulate(crumpled(scene, 0.01), method, dt=0.05, steps=4)
    np.testing.assert_array_equal(film.position[:, lead], np.tile(scene.state.position[lead], (5, 1, 1)))


@pytest.mark.slow
@EACH
def test_the_free_nodes_follow_led_ones_with_order_2(method):
    sheet, scene = hung(3)
    lead = sheet.nodes["top"]
    path = lambda t: sheet.state.position + 0.1 * (1 - jnp.cos(3.0 * t)) * jnp.asarray([[1.0, 0.0, 0.5]])  # noqa: E731
    led = Scene(scene.state, scene.mass, scene.forces, pinned=Pins(lead, path))
    demand_order(run_to(led, method, 0.2, (64, 128, 256, 512)), 2)


@EACH
def test_lanes_of_a_batch_solve_by_themselves_and_a_broken_one_harms_no_other(method):
    _, scene = hung(4)
    states = [crumpled(scene, size).state for size in (0.0, 0.03, 0.01)]
    states[2] = states[2]._replace(velocity=states[2].velocity.at[9].set(np.nan))
    many = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    step = jax.jit(lambda state: method(scene, 0.0, state, 0.02))
    together = jax.jit(jax.vmap(step))(many)
    for i in (0, 1):
        np.testing.assert_allclose(together.position[i], step(states[i]).position, rtol=0, atol=1e-9)
    assert np.isnan(together.velocity[2]).any()


@EACH
def test_the_report_is_that_of_all_solves(method):
    _, scene = hung(5)
    scene = crumpled(scene, 0.01)
    good, cut = (type(method)(tolerance=1e-6, iterations=n).report(scene, 0.05) for n in (500, 5))
    assert good.ok
    assert good.residual <= 1e-6
    assert good.products > 20
    assert not cut.ok
    assert cut.products == 5 * {"implicit_midpoint": 1, "tr_bdf2": 2}[method.__name__]


@EACH
def test_float32_converges_as_far_as_float32_goes(method):
    with jax.enable_x64(False):
        _, scene = hung(6, dtype=np.float32)
        assert method.report(scene, 1 / 60).ok
        film = simulate(scene, method, dt=1 / 60, steps=10)
        assert film.ok
        assert film.position.dtype == np.float32


def test_bad_settings_are_named_with_their_method(unannotated):
    for kind in (ImplicitMidpoint, TrBdf2):
        for bad in ({"tolerance": 0.0}, {"iterations": 0}, {"newton": -1}):
            with pytest.raises(ValueError, match=f"{kind.__name__}: got {next(iter(bad))}=.*expected"):
                kind(**bad)


# bodies that rotate

TILT = np.array([0.8, 0.1, -0.4, 0.3])
ASKEW = Inertia(2.0, (1.0, 1.5, 2.2), TILT)
PIVOTED = ASKEW.about((0.2, 0.5, -0.3))
SPUN = {"orientation": TILT, "angular_velocity": (0.4, 2.0, 0.3)}
TURNED = (forces.Gravity(), rigid.Torque((0.3, 0.1, -0.2), "body"))
BODIES = {
    "free": Scene(rigid.bodies(ASKEW, **SPUN), ASKEW),
    "on a pivot": Scene(rigid.bodies(PIVOTED, **SPUN), PIVOTED, TURNED),
    "with drag": Scene(rigid.bodies(PIVOTED, **SPUN), PIVOTED, (*TURNED, rigid.RotationalDrag(0.6))),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "name"),
    [
        (methods.implicit_midpoint, "free"),
        (methods.implicit_midpoint, "with drag"),
        (methods.tr_bdf2, "on a pivot"),
    ],
    ids=lambda part: part if isinstance(part, str) else part.__name__,
)
def test_bodies_that_rotate_keep_order_2(method, name):
    demand_order(run_to(BODIES[name], method, 1.0, (50, 100, 200, 400)), 2, tolerance=0.3)


# the pair


def attempt(scene, state, dt, slope=None):
    return jax.jit(lambda state: methods.tr_bdf2.attempt(scene, 0.0, state, dt, slope))(state)


def test_tr_bdf2_is_a_pair_and_the_midpoint_rule_is_none():
    pair = read_pair(as_module(methods.tr_bdf2))
    assert isinstance(pair, Pair)
    assert (pair.error_order, pair.dense_order, pair.keeps_slope) == (2, 2, False)
    assert read_pair(methods.implicit_midpoint) is None


@pytest.mark.parametrize("drag", [False, True], ids=["position-only", "drag"])
def test_the_error_estimate_has_its_order_and_is_about_the_error(drag):
    scene = shaken(drag)
    found, true = [], []
    for dt in (0.02, 0.01, 0.005, 0.0025):
        tried = attempt(scene, scene.state, dt)
        exact = truth(drag, (), dt)
        found.append(max(np.abs(leaf).max() for leaf in tried.error))
        true.append(max(np.abs(a - b).max() for a, b in zip(tried.end, exact, strict=True)))
        np.testing.assert_allclose(tried.end, methods.tr_bdf2(scene, 0.0, scene.state, dt), rtol=0, atol=1e-14)
    order = methods.tr_bdf2.pair.error_order + 1
    np.testing.assert_allclose(np.log2(np.divide(found[:-1], found[1:])), order, rtol=0, atol=0.3)
    np.testing.assert_allclose(np.divide(found, true), 1.0, rtol=0, atol=0.3)


def test_the_error_of_stiff_motion_that_the_step_damps_is_no_larger_than_the_motion():
    for z in (1e2, 1e4, 1e6):
        spring = forces.Anchor(point=(0.0,), stiffness=z**2)
        scene = Scene(Particles(jnp.ones(1), jnp.zeros(1)), forces=(spring,))
        error = attempt(scene, scene.state, 1.0).error
        # unfiltered the velocity's would be of the size of z²
        assert abs(error.position[0]) < 2
        assert abs(error.velocity[0]) < 20


def test_a_slope_that_is_known_is_used():
    scene = shaken(True)
    slope = scene.rate(0.0, scene.state)
    given, computed = attempt(scene, scene.state, 0.1, slope), attempt(scene, scene.state, 0.1)
    for a, b in zip(jax.tree.leaves(given), jax.tree.leaves(computed), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-14)
    other = attempt(scene, scene.state, 0.1, jax.tree.map(lambda leaf: 1.1 * leaf, slope))
    assert np.abs(other.end.velocity - given.end.velocity).max() > 1e-3


@pytest.mark.parametrize("share", [0.1, 0.5, 0.8])
def test_states_within_a_step_have_the_order_of_the_step(share):
    scene, errors = shaken(True), []
    for dt in (0.02, 0.01, 0.005, 0.0025):
        tried = attempt(scene, scene.state, dt)
        within = methods.tr_bdf2.interpolate(scene, 0.0, scene.state, dt, tried, share)
        exact = truth(True, (), share * dt)
        errors.append(max(np.abs(a - b).max() for a, b in zip(within, exact, strict=True)))
    order = methods.tr_bdf2.pair.dense_order + 1
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), order, rtol=0, atol=0.3)


def test_the_interpolant_meets_the_ends_of_the_step_and_takes_a_share_for_each_lane():
    scene = shaken(True, lanes=(3,))
    tried = attempt(scene, scene.state, 0.1)
    found = methods.tr_bdf2.interpolate(scene, 0.0, scene.state, 0.1, tried, jnp.asarray([0.0, GAMMA, 1.0]))
    for leaf, start, middle, end in zip(found, scene.state, tried.stages, tried.end, strict=True):
        np.testing.assert_allclose(leaf, [start[0], middle[1], end[2]], rtol=0, atol=1e-14)


# derivatives


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "newton", "modes"), [(ImplicitMidpoint, 20, [jax.grad]), (TrBdf2, 0, [jax.grad, jax.jacfwd])]
)
def test_derivatives_agree_with_central_differences(method, newton, modes):
    _, scene = hung(3, damping=0.02)
    start = crumpled(scene, 2e-3)
    method = method(tolerance=1e-13, newton=newton)

    @jax.jit
    def measure(numbers):
        stiff, push = numbers
        parts = lambda s: (s.forces[1].k, s.state.velocity)  # noqa: E731
        k, v = parts(start)
        scene = eqx.tree_at(parts, start, (k * stiff, v * push))
        x, v = simulate(scene, method, dt=1 / 60, steps=2, save_every=2).final_scene.state
        return jnp.sum(x[..., 1] ** 2) + 0.1 * jnp.sum(v[..., 0] * x[..., 2])

    at, h = np.asarray([1.0, 1.0]), 1e-5
    central = [(measure(at + h * e) - measure(at - h * e)) / (2 * h) for e in np.eye(2)]
    for mode in modes:
        np.testing.assert_allclose(mode(measure)(at), central, rtol=1e-5)
