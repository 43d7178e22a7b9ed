"""Predicted limits against measured ones, and what a prediction says of its cause."""

import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, forces, lattices, methods, springs, stability
from physjax.scenes import SCENES
from physjax.stepping.methods import METHODS

ALL = pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
BOUNDED = {name: method for name, method in METHODS.items() if np.isfinite(method.promises.stability_limit)}
SLOW_TO_GROW = {"euler", "midpoint", "dopri8"}
"""Just above their limit, by a thousandth a step or less."""


def oscillator(k=15.0, b=None, m=1.0):
    drag = () if b is None else (forces.StokesDrag(b),)
    return Scene(
        Particles(jnp.ones(1), jnp.zeros(1)), mass=m, forces=(forces.Anchor(point=jnp.zeros(1), stiffness=k), *drag)
    )


def networks(count, damped, nodes=8, dim=2):
    """Scenes of random nodes and springs at rest, each its own: of all pairs, those that are absent have no stiffness."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(count, nodes, dim))
    pairs = np.stack(np.triu_indices(nodes, 1), axis=1)
    there = rng.random((count, len(pairs))) < 0.6
    k, c = (np.where(there, rng.uniform(*span, there.shape), 0.0) for span in ((10, 1000), (0.1, 5)))
    rest = np.linalg.norm(x[:, pairs[:, 0]] - x[:, pairs[:, 1]], axis=-1)
    net = springs.Springs(pairs, k, rest, c if damped else None)
    state = Particles(jnp.asarray(x), jnp.zeros_like(jnp.asarray(x)))
    return Scene(state, mass=rng.uniform(0.1, 2, (count, nodes)), forces=(net,))


def sheet(count, damping):
    """NVIDIA's cloth at rest: 0.1 m and 0.1 kg for each node, k = 1000 N/m along all springs, two corners pinned."""
    side, stiff = 0.1 * (count - 1), {"structural": 1e3, "shear": 1e3, "bend": 1e3, "damping": damping}
    cloth = lattices.cloth(side, side, count, count, mass=0.1 * count**2, down=(0, 0, 1), **stiff)
    return Scene(cloth.state, mass=0.1, forces=(cloth.springs,), pinned=cloth.nodes["top"] & cloth.nodes["corners"])


def confirmed(scene, method, steps, within=0.02):
    """The prediction, and whether runs just below it keep a deviation small and runs just above do not, scene by scene."""
    predicted = stability.limit(scene, method)
    around = np.stack([(1 - within) * predicted.each, (1 + within) * predicted.each])
    below, above = stability.grows(scene, method, around, steps=steps)
    return predicted, ~below, above


# against measurement


@ALL
def test_the_lectures_oscillator_has_its_known_limits(method):
    known = {"euler": 0.1 / 15, "semi_implicit_euler": 0.50976}
    predicted = stability.limit(oscillator(b=0.1), method)
    assert predicted.dt == pytest.approx(known.get(method.__name__, predicted.dt), rel=1e-4)
    assert (predicted.cause, predicted.force) == ("stiffness", "Anchor")
    steps = 300_000 if method is methods.euler else 20_000 if method in BOUNDED.values() else 2000
    measured = stability.measure_limit(oscillator(b=0.1), method, steps=steps)
    assert measured == pytest.approx(predicted.dt, rel=0.02)


@ALL
@pytest.mark.parametrize("b", [None, 3.0, 20.0], ids=["undamped", "damped", "overdamped"])
def test_the_limit_of_an_oscillator_is_the_measured_one(method, b):
    if b is None and not method.promises.stability_limit:
        pytest.skip("never stable: see the test of its growth")
    if (b == 3.0 and method is not methods.rk4) or (b and method not in BOUNDED.values()):
        pytest.skip("as the lecture's, which is damped as well, and of which all are tried")
    predicted = stability.limit(oscillator(b=b), method)
    assert stability.measure_limit(oscillator(b=b), method) == pytest.approx(predicted.dt, rel=0.02)
    assert predicted.cause == ("damping" if b == 20.0 else "stiffness")


@pytest.mark.parametrize(
    "method", [pytest.param(m, id=name) for name, m in BOUNDED.items() if m.promises.stability_limit]
)
def test_the_limit_of_the_chain_of_fifty_is_the_measured_one(method):
    chain = SCENES["oscillator_chain"]().scene
    predicted = stability.limit(chain, method)
    omega = 2 * np.sqrt(400.0) * np.sin(50 * np.pi / 102)
    assert predicted.dt == pytest.approx(method.promises.stability_limit / omega, rel=1e-6)
    # near its limit tsit5 grows so slowly that how long a run lasts decides whether it shows
    steps, within = (6000, 0.3) if method is METHODS["tsit5"] else (2000, 0.02)
    assert confirmed(chain, method, steps, within)[1:] == (True, True)
    assert predicted.spring in [(i, i + 1) for i in range(20, 32)]


@pytest.mark.parametrize(
    ("count", "damped"), [(8, True), *(pytest.param(60, damped, marks=pytest.mark.slow) for damped in (False, True))]
)
def test_the_limits_of_random_networks_are_the_measured_ones(count, damped):
    many = networks(count, damped, *((5, 2) if count == 8 else (8, 2)))
    few = networks(min(count, 30), damped, *((5, 2) if count == 8 else (8, 2)))
    for name, method in BOUNDED.items():
        if name == "tsit5":  # near its limit it grows so slowly that how long a run lasts decides whether it shows
            continue
        if count == 8 and name not in {"euler" if damped else "verlet", "semi_implicit_euler"}:
            continue
        if name == "dopri8" and not damped:  # the chain of fifty is such a network
            continue
        scene = many if method.promises.evaluations <= 2 else few
        if not damped and not method.promises.stability_limit:
            assert not stability.limit(scene, method).each.any()
            continue
        steps = 4000 if name not in SLOW_TO_GROW else 12_000
        predicted, below, above = confirmed(scene, method, steps)
        assert below.all(), name
        # what grows by less than this all through the run is not seen in it
        seen = steps / 2 * np.log(stability.growth(scene, method, 1.02 * predicted.each)) > np.log(1000)
        assert above[seen].all(), name
        assert seen.mean() > 0.9 or name in {"euler", "midpoint"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("damping", "name"), [(None, "semi_implicit_euler"), (None, "rk4"), (10.0, "semi_implicit_euler")]
)
def test_the_limit_of_a_cloth_of_a_thousand_nodes_is_the_measured_one(name, damping):
    within = 0.02 if damping is None else 0.05
    predicted, below, above = confirmed(sheet(32, damping), METHODS[name], 200, within)
    assert (below, above) == (True, True)
    known = {(None, "semi_implicit_euler"): 6.3e-3, (10.0, "semi_implicit_euler"): 1.8e-3}
    assert predicted.dt == pytest.approx(known.get((damping, name), predicted.dt), rel=0.02)
    assert (predicted.cause, predicted.force) == ("stiffness" if damping is None else "damping", "Springs")


@pytest.mark.parametrize("name", ["euler", "midpoint"])
def test_a_method_without_a_stable_step_grows_as_predicted(name):
    method, scene = METHODS[name], oscillator()
    assert stability.limit(scene, method).dt == 0
    for dt in (0.02, 0.05, 0.1):
        predicted = stability.growth(scene, method, dt) - 1
        omega_dt = np.sqrt(15.0) * dt
        by_hand = np.sqrt(1 + omega_dt**2 if name == "euler" else 1 + omega_dt**4 / 4) - 1
        assert predicted == pytest.approx(by_hand, rel=1e-6)
        steps = int(min(40_000, 20 / predicted))
        assert stability.measure_growth(scene, method, dt, steps=steps) - 1 == pytest.approx(predicted, rel=0.02)


# the region


@ALL
def test_the_region_reaches_as_far_as_promised(method):
    region = stability.region(method, real=(-0.5, 0.5), imaginary=(-4.0, 4.0), points=(3, 801))
    axis, promised = region.radius[:, 1], method.promises.stability_limit
    # the promise allows for growth that no run shows, but not for one from the first step on
    stable = np.abs(region.z.imag[:, 1][axis <= 1 + (2e-4 if promised else 1e-9)]).max()
    assert stable == pytest.approx(min(promised, 4.0), abs=0.0101)


def test_the_region_of_rk4_is_that_of_its_polynomial():
    region = stability.region(methods.rk4)
    z = region.z
    polynomial = np.abs(1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24)
    np.testing.assert_allclose(region.radius, polynomial, rtol=1e-6, atol=1e-7)


# what is said


def test_a_limit_reads_as_a_sentence():
    assert str(stability.limit(oscillator(b=0.1), methods.euler)) == (
        "euler: 6.67 ms, set by the stiffness of Anchor, λ = -0.05 ± 3.873i 1/s"
    )
    assert "no step is stable" in str(stability.limit(oscillator(), methods.euler))
    free = Scene(Particles(jnp.ones(2), jnp.ones(2)), forces=(forces.Gravity(),))
    assert stability.limit(free, methods.euler).dt == np.inf
    assert "any step is stable" in str(stability.limit(free, methods.euler))


def test_independent_lanes_have_a_limit_each():
    scene = SCENES["oscillator"]().scene
    predicted = stability.limit(scene, methods.verlet)
    np.testing.assert_allclose(predicted.each, 2 / np.sqrt([1.0, 10.0, 100.0, 1000.0]), rtol=1e-5)
    assert predicted.dt == predicted.each.min()
    assert predicted.node == (3,)
    np.testing.assert_allclose(stability.measure_limit(scene, methods.verlet), predicted.each, rtol=0.02)


def test_the_stiff_spring_among_soft_ones_is_named():
    x = jnp.arange(6.0)[:, None]
    k = jnp.asarray([10.0, 10.0, 10.0, 500.0, 10.0])
    row = springs.Springs(np.stack([np.arange(5), np.arange(1, 6)], axis=1), k, 1.0)
    scene = Scene(Particles(x, jnp.zeros_like(x)), forces=(forces.independent(lambda t, s, m: -0.1 * s.velocity), row))
    predicted = stability.limit(scene, methods.semi_implicit_euler)
    assert (predicted.cause, predicted.force, predicted.spring) == ("stiffness", "Springs", (3, 4))
    assert predicted.node in {(3,), (4,)}


def test_bad_input_is_refused():
    with pytest.raises(TypeError, match="expected a Scene"):
        stability.limit("cloth", methods.rk4)
    with pytest.raises(TypeError, match=r"such as methods\.rk4"):
        stability.limit(oscillator(), "rk4")
    with pytest.raises(ValueError, match="expected the scene's"):
        stability.limit(oscillator(), methods.rk4, at=Particles(jnp.ones(2), jnp.ones(2)))
    with pytest.raises(ValueError, match="smaller step first"):
        stability.measure_limit(oscillator(), methods.rk4, between=(1.0, 0.1))


def test_a_scene_that_moves_is_measured_about_a_state_of_its_own():
    drag = forces.QuadraticDrag(area=0.7, coefficient=1.0)
    fall = Particles(jnp.zeros(2), jnp.asarray([0.0, -40.0]))
    scene = Scene(Particles(jnp.zeros(2), jnp.zeros(2)), mass=80.0, forces=(forces.Gravity(), drag))
    rate = 1.225 * 0.7 * 40.0 / 80.0
    assert np.isinf(stability.limit(scene, methods.euler).dt)
    assert stability.limit(scene, methods.euler, fall).dt == pytest.approx(2 / rate, rel=1e-6)
    assert stability.measure_limit(scene, methods.euler, fall) == pytest.approx(2 / rate, rel=0.02)


@pytest.mark.parametrize("method", [methods.semi_implicit_euler, methods.verlet, methods.rk4], ids=lambda m: m.__name__)
@pytest.mark.parametrize("b", [None, 0.2])
def test_what_grows_by_itself_sets_no_limit_and_does_not_hide_what_does(method, b):
    # a saddle: away from the hill at 1/s along x, to and fro at 10/s along y
    drag = () if b is None else (forces.StokesDrag(b),)
    hill = forces.Anchor(point=jnp.zeros(2), stiffness=100.0)
    push = forces.independent(
        lambda t, s, m: jnp.stack([101.0 * s.position[..., 0], 0.0 * s.position[..., 1]], axis=-1)
    )
    lanes = Particles(jnp.zeros((2, 2)), jnp.zeros((2, 2)))
    scene = Scene(lanes, forces=(hill, push, *drag))
    assert stability.grows_by_itself(scene).all()
    promised = method.promises.stability_limit / 10.0
    assert stability.limit(scene, method).dt == pytest.approx(promised, rel=0.05 if b else 1e-6)


@pytest.mark.parametrize("method", [methods.semi_implicit_euler, methods.verlet], ids=lambda m: m.__name__)
def test_a_very_slow_growth_of_the_scenes_own_does_not_excuse_the_method(method):
    # a damped ring: nodes that move leave a tension a hair below zero, which grows as slowly as the node moves
    count = 12
    angle = 2 * np.pi * np.arange(count) / count
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    pairs = [[i, (i + 1) % count] for i in range(count)]
    net = springs.Springs(pairs, 500.0, 2 * np.sin(np.pi / count), 0.2)
    mass = np.random.default_rng(7).uniform(0.1, 2, count)
    push = np.random.default_rng(3).normal(size=ring.shape)
    moving = [Scene(Particles(jnp.asarray(ring), jnp.asarray(v * push)), mass, (net,)) for v in (0, 1e-8, 1e-6, 1e-3)]
    still, *others = (stability.limit(scene, method).dt for scene in moving)
    np.testing.assert_allclose(others, still, rtol=1e-3)
    # confirmed where a growth of its own does not end the run
    at = still * np.array([0.98, 1.02])
    np.testing.assert_array_equal(stability.grows(moving[1], method, at, steps=4000), [False, True])


@pytest.mark.parametrize("method", [methods.verlet, methods.rk4], ids=lambda m: m.__name__)
def test_what_pulls_a_binary_apart_is_left_out_of_its_limit_and_of_the_measured_one(method):
    pair = Particles(jnp.asarray([[-0.5, 0.0], [0.5, 0.0]]), jnp.asarray([[0.0, -0.7], [0.0, 0.7]]))
    scene = Scene(pair, forces=(forces.Gravitation(G=1.0),))
    # √2/s across, which swings; 2/s along, which grows and has a partner that decays
    known = 2.0 / np.sqrt(2.0) if method is methods.verlet else 2.785293563 / 2.0
    assert stability.limit(scene, method).dt == pytest.approx(known, rel=1e-6)
    assert float(stability.measure_limit(scene, method, steps=1000)) == pytest.approx(known, rel=0.02)
