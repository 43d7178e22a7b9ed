"""The Runge-Kutta-Nyström pair of Dormand and Prince: its order conditions, its promises, and what it refuses."""

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Pins, Scene, contacts, forces, inertia, methods, rigid
from physjax.parts import as_module
from physjax.physics.forces import independent
from physjax.physics.springs import lattices
from physjax.programs import iterate_operations
from physjax.scenes import SCENES
from physjax.stepping.dependence import find_dependent, find_kicked
from physjax.stepping.nystrom import DPRKN6
from physjax.stepping.pairs import Pair, read_pair
from physjax.stepping.simulate import sample_states

PAIR = read_pair(methods.dprkn6)


def nystrom_trees(order):
    """Trees of derivatives of f along x'' = f(x): how often along x', and the trees whose x'' stand in the other places."""
    found = []
    for along in range(order):
        for n in range(order):
            for parts in itertools.combinations_with_replacement(range(1, order), n):
                if 1 + along + sum(size + 1 for size in parts) == order:
                    hung = itertools.product(*map(nystrom_trees, parts))
                    found += {(along, tuple(sorted(trees))) for trees in hung}
    return found


def size(tree):
    along, trees = tree
    return 1 + along + sum(size(branch) + 1 for branch in trees)


def density(tree):
    return size(tree) * math.prod((size(branch) + 1) * density(branch) for branch in tree[1])


def stage_weights(tree, a, c):
    along, trees = tree
    return c**along * math.prod((a @ stage_weights(branch, a, c) for branch in trees), start=np.ones_like(c))


def matrix():
    return np.array([[*row, *[0.0] * (6 - len(row))] for row in DPRKN6.rows]), np.array(DPRKN6.nodes)


def defects(place, velocity, order):
    """By how much weights miss the conditions of an order: of the velocity up to it, of the place up to one below."""
    a, c = matrix()
    trees = [tree for n in range(1, order + 1) for tree in nystrom_trees(n)]
    missing = [velocity @ stage_weights(tree, a, c) - 1 / density(tree) for tree in trees]
    return missing + [
        place @ stage_weights(tree, a, c) - 1 / ((size(tree) + 1) * density(tree))
        for tree in trees
        if size(tree) < order
    ]


def test_there_are_as_many_trees_as_hairer_norsett_and_wanner_counted():
    assert [len(nystrom_trees(n)) for n in range(1, 9)] == [1, 1, 2, 3, 6, 10, 20, 36]


def test_weights_satisfy_every_order_condition_and_no_higher_one():
    a, c = matrix()
    place, velocity = np.array(DPRKN6.place_weights), np.array(DPRKN6.velocity_weights)
    np.testing.assert_allclose(a.sum(axis=1), c**2 / 2, rtol=0, atol=1e-15)
    assert np.abs(defects(place, velocity, DPRKN6.order)).max() < 1e-15
    assert np.abs(defects(place, velocity, DPRKN6.order + 1)).max() > 1e-6
    assert DPRKN6.rows[-1] == DPRKN6.place_weights[:-1]  # the last stage is at the end


def test_the_lower_order_of_the_pair_is_four():
    place = np.subtract(DPRKN6.place_weights, DPRKN6.place_errors)
    velocity = np.subtract(DPRKN6.velocity_weights, DPRKN6.velocity_errors)
    assert np.abs(defects(place, velocity, DPRKN6.error_order)).max() < 2e-15
    assert np.abs(defects(place, velocity, DPRKN6.error_order + 1)).max() > 1e-3


@pytest.mark.parametrize("share", [0.1, 0.35, 0.8, 1.0])
def test_weights_within_a_step_satisfy_the_conditions_of_their_order(share):
    # as those of a step of that length: its nodes are those of the whole one over the share
    a, c = matrix()
    rows = [np.array([*row, *[0.0] * (5 - len(row))]) for row in DPRKN6.within]
    powers = share ** np.arange(5)
    place = np.array([row @ powers for row in rows])
    velocity = np.array([row @ (powers * np.arange(2, 7)) for row in rows])
    for n in range(1, DPRKN6.dense_order + 1):
        for tree in nystrom_trees(n):
            found = stage_weights(tree, a, c) / share ** (n - 1)
            assert velocity @ found == pytest.approx(1 / density(tree), abs=1e-12 / share**n)
            assert place @ found == pytest.approx(1 / ((n + 1) * density(tree)), abs=1e-12 / share**n)
    if share == 1.0:
        np.testing.assert_allclose(place, DPRKN6.place_weights, rtol=0, atol=2e-15)
        np.testing.assert_allclose(velocity, DPRKN6.velocity_weights, rtol=0, atol=1e-14)


@independent
def wave(t, state, mass):
    """A push that changes with time: a method that looks at the wrong moment loses its order."""
    return jnp.stack([jnp.cos(2.0 * t), jnp.sin(3.0 * t)])


def shaken():
    state = Particles(jnp.asarray([0.8, -0.3]), jnp.asarray([0.4, 0.9]))
    anchor = forces.Anchor(point=jnp.zeros(2), stiffness=9.0, rest_length=0.6)
    return Scene(state, mass=0.7, forces=(forces.Gravity(), anchor, wave))


def exact(scene, time, steps=32):
    """Kahan and Li's composition, of order 8, with steps that leave rounding."""
    return end_of(scene, methods.kahan_li8, time, steps)


def end_of(scene, method, time, steps):
    return [leaf[-1] for leaf in sample_states(scene, as_module(method), time / steps, steps, frames=1)]


def distance(a, b):
    return max(np.abs(np.subtract(x, y)).max() for x, y in zip(a, b, strict=True))


def test_order_is_the_promised_one():
    scene, errors = shaken(), []
    truth = exact(scene, 2.0, steps=1024)
    for steps in (32, 64, 128):
        errors.append(distance(end_of(scene, methods.dprkn6, 2.0, steps), truth))
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), methods.dprkn6.promises.order, atol=0.3)


def local_errors(measure, steps, share=1.0):
    """What `measure(end, attempt, truth)` returns of single steps from the start."""
    scene = shaken()
    found = []
    for dt in steps:
        attempt = PAIR.attempt(scene, 0.0, scene.state, dt, None)
        within = PAIR.interpolate(scene, 0.0, scene.state, dt, attempt, share)
        found.append(measure(within, attempt, exact(scene, share * dt)))
    return found


def orders(errors):
    return np.log2(np.divide(errors[:-1], errors[1:]))


def test_the_estimated_error_is_that_of_the_lower_order_and_falls_as_promised():
    assert isinstance(PAIR, Pair)
    lower = lambda _, attempt, truth: distance(np.subtract(attempt.end, attempt.error), truth)  # noqa: E731
    estimate = lambda _, attempt, truth: distance(attempt.error, [0.0, 0.0])  # noqa: E731
    steps = (0.1, 0.05, 0.025)
    np.testing.assert_allclose(local_errors(estimate, steps), local_errors(lower, steps), rtol=0.02)
    np.testing.assert_allclose(orders(local_errors(estimate, steps)), PAIR.error_order + 1, atol=0.3)


@pytest.mark.parametrize("share", [0.25, 0.6])
def test_a_state_within_a_step_is_of_the_dense_order(share):
    errors = local_errors(lambda within, _, truth: distance(within, truth), (0.2, 0.1, 0.05), share)
    np.testing.assert_allclose(orders(errors), PAIR.dense_order + 1, atol=0.3)


def test_a_state_at_the_end_of_a_step_is_its_end_and_the_slope_there_the_rate():
    scene = shaken()
    attempt = PAIR.attempt(scene, 0.3, scene.state, 0.2, None)
    end = PAIR.interpolate(scene, 0.0, scene.state, 0.2, attempt, 1.0)
    assert distance(end, attempt.end) < 1e-14
    assert distance(attempt.slope, scene.rate(0.5, attempt.end)) < 1e-14
    assert distance(attempt.end, methods.dprkn6(scene, 0.3, scene.state, 0.2)) < 1e-15
    again = PAIR.attempt(scene, 0.5, attempt.end, 0.2, attempt.slope)
    assert distance(again.end, methods.dprkn6(scene, 0.5, attempt.end, 0.2)) < 1e-14


def test_evaluations_a_step():
    scene = Scene(Particles(jnp.ones(1), jnp.zeros(1)), forces=(lambda t, state, mass: -jnp.sin(state.position),))

    def count(step, *arguments):
        return sum(eqn.primitive.name == "sin" for eqn in iterate_operations(jax.make_jaxpr(step)(*arguments)))

    state, slope = scene.state, scene.rate(0.0, scene.state)
    assert count(lambda y: methods.dprkn6(scene, 0.0, y, 0.1), state) == methods.dprkn6.promises.evaluations == 6
    assert count(lambda y, k: PAIR.attempt(scene, 0.0, y, 0.1, k), state, slope) == 5


def test_stable_to_its_limit_and_not_beyond():
    def radius(step):
        scene = Scene(Particles(jnp.zeros(1), jnp.zeros(1)), forces=(forces.Anchor(point=jnp.zeros(1), stiffness=1.0),))
        one_step = lambda y: jnp.concatenate(methods.dprkn6(scene, 0.0, Particles(y[:1], y[1:]), step))  # noqa: E731
        return np.abs(np.linalg.eigvals(np.asarray(jax.jacfwd(one_step)(jnp.zeros(2))))).max()

    limit = methods.dprkn6.promises.stability_limit
    assert radius(0.999 * limit) < 1 + 2e-4 < radius(1.001 * limit)
    assert radius(0.46) < 1 + 1e-8


def test_a_state_of_its_own_making_moves_as_told():
    class Pendulum:
        def rate(self, t, y):
            return {"angle": y["rate"], "rate": -jnp.sin(y["angle"])}

        def kick(self, y, slope, dt):
            return y | {"rate": y["rate"] + dt * slope["rate"]}

        def drift(self, y, dt):
            return y | {"angle": y["angle"] + dt * y["rate"]}

    y, told = {"angle": jnp.asarray(1.0), "rate": jnp.asarray(0.0)}, Particles(jnp.asarray([1.0]), jnp.asarray([0.0]))
    assert find_kicked(Pendulum(), y) == [False, True]
    scene = Scene(told, forces=(lambda t, state, mass: -jnp.sin(state.position),))
    for i in range(3):
        y, told = methods.dprkn6(Pendulum(), 0.1 * i, y, 0.1), methods.dprkn6(scene, 0.1 * i, told, 0.1)
    np.testing.assert_allclose([y["angle"], y["rate"]], np.ravel(told), rtol=1e-13)


def test_lanes_with_steps_of_their_own(precision):
    x, v = (
        jnp.asarray([[1.0, 0.0], [0.0, 2.0]], precision.dtype),
        jnp.asarray([[0.0, 1.0], [1.0, 1.0]], precision.dtype),
    )
    anchor = forces.Anchor(point=jnp.zeros(2), stiffness=4.0)
    scene, dt = Scene(Particles(x, v), forces=(anchor,)), jnp.asarray([0.05, 0.1], precision.dtype)
    attempt = PAIR.attempt(scene, 0.0, scene.state, dt, None)
    middle = PAIR.interpolate(scene, 0.0, scene.state, dt, attempt, jnp.asarray([0.5, 1.0], precision.dtype))
    for time, state in ((dt, attempt.end), (dt * jnp.asarray([0.5, 1.0], precision.dtype), middle)):
        angle = 2.0 * np.asarray(time)[:, None]
        np.testing.assert_allclose(
            state.position, x * np.cos(angle) + v / 2 * np.sin(angle), atol=1e-8 + 4 * precision.eps
        )
    assert attempt.error.position.dtype == precision.dtype


SHEET = lattices.cloth(1.0, 1.0, 6, 6, mass=0.2, structural=400.0, shear=100.0, bend=5.0)


def held_cloth(pinned):
    return Scene(SHEET.state, mass=SHEET.mass, forces=(SHEET.springs, forces.Gravity()), pinned=pinned)


def swing(t):
    return SHEET.state.position + jnp.sin(t) ** 2 * jnp.asarray([[0.0, 0.1, 0.0]])


def planets():
    state = Particles(jnp.asarray(np.random.default_rng(0).normal(size=(80, 3))), jnp.zeros((80, 3)))
    return Scene(state, mass=1.0, forces=(forces.Gravitation(G=1.0, softening=0.1),))


TAKEN = {
    "gravity and anchor": shaken,
    "bodies that attract each other": planets,
    "pinned cloth": lambda: held_cloth(SHEET.nodes["left"]),
    "cloth on a path": lambda: held_cloth(Pins(SHEET.nodes["left"], path=swing)),
    "kick": lambda: Scene(shaken().state, forces=(forces.Kick((1.0, 0.0), at=0.5, duration=0.1),)),
}


@pytest.mark.parametrize("name", TAKEN)
def test_what_depends_on_place_and_time_is_taken(name):
    jax.make_jaxpr(lambda scene: scene.step(methods.dprkn6, 0.0, 1e-3).state)(TAKEN[name]())


def damped():
    sheet = lattices.cloth(1.0, 1.0, 3, 3, mass=0.2, structural=400.0, damping=0.1)
    return Scene(sheet.state, mass=sheet.mass, forces=(forces.Gravity(), sheet.springs))


def dragged():
    return Scene(shaken().state, forces=(forces.Gravity(), forces.StokesDrag(0.0), forces.QuadraticDrag(1.0, 0.5)))


def turning():
    brick = inertia.box(2.0, (1.0, 2.0, 3.0))
    return Scene(rigid.bodies(brick, jnp.zeros(3)), brick, (forces.Gravity(),))


def resting():
    floor = contacts.Sphere((0.0, -4.0), radius=3.0, response=contacts.impact)
    return Scene(shaken().state, forces=(forces.Gravity(),), contacts=(floor,))


@pytest.mark.parametrize(
    ("scene", "words"),
    [
        (damped, r"\(Springs\)"),
        (dragged, r"\(StokesDrag, QuadraticDrag\)"),
        (turning, "rotate in space"),
        (resting, "holds it to a surface"),
    ],
)
def test_what_looks_at_the_velocity_is_refused_before_it_is_compiled(scene, words):
    with pytest.raises(ValueError, match=words):
        jax.make_jaxpr(lambda scene: scene.step(methods.dprkn6, 0.0, 1e-3).state)(scene())


def test_dependence_is_followed_through_calls_branches_and_loops():
    def program(x, y, n):
        branch = jax.lax.cond(n > 0, lambda: (x, y), lambda: (y, x))
        turned = jax.lax.fori_loop(0, 3, lambda _, c: (c[1], c[2], c[2]), (x, x, y))  # of y from the second turn on
        counted = jax.lax.while_loop(lambda c: c[0] < n, lambda c: (c[0] + 1, 2.0 * c[1]), (0, x))
        called = jax.jit(lambda a, b: (jnp.zeros_like(a), b))(y, x)
        barrier = jax.lax.optimization_barrier((x, y))
        return branch, turned, counted, called, barrier

    arguments = jnp.ones(2), jnp.ones(2), jnp.asarray(2)
    found = find_dependent(program, *arguments, marked=[False, True, False])
    assert found == [True, True, True, True, True, False, False, False, False, False, True]
    found = find_dependent(program, *arguments, marked=[False, False, True])
    assert found == [True, True, False, False, False, True, True, False, False, False, False]


def test_under_error_control_it_beats_the_pair_of_order_5_where_bodies_fly_by():
    problem, works = SCENES["kepler"](), {}
    exact = problem.exact(np.linspace(0.0, problem.duration, 33)).position
    for method, each, tolerance in ((methods.tsit5, 6, 1e-9), (methods.dprkn6, 5, 3e-8)):
        chooser = methods.adaptive(method, tolerance, tolerance)
        counted = methods.count_steps(problem.scene, chooser, dt=problem.duration / 32, steps=32)
        errors = np.abs(np.asarray(counted.state.position) - exact[1:])
        assert errors.max() < 1e-6
        works[method] = each * int(jnp.sum(counted.accepted + counted.rejected))
    assert works[methods.dprkn6] < 0.7 * works[methods.tsit5]
