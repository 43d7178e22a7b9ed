"""Springs pull both ends alike, in either layout, and keep what their closed forms say."""

import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from physjax import Particles, Scene, forces, methods, simulate
from physjax.physics.springs import Springs
from physjax.stepping.methods import METHODS

LAYOUTS = pytest.mark.parametrize("layout", ["bands", "gather"])
G = 9.8


def grid(rows, columns):
    """Pairs of a cloth: structural, shear and bend."""
    nodes = np.arange(rows * columns).reshape(rows, columns)
    steps = [(0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0)]
    pairs = []
    for down, right in steps:
        a = nodes[: rows - down, max(0, -right) : columns - max(0, right)]
        b = nodes[down:, max(0, right) : columns + min(0, right)]
        pairs.append(np.stack([a.ravel(), b.ravel()], axis=1))
    return np.concatenate(pairs)


def tangle(pairs, layout=None, *, seed=0, dim=3, nodes=None, dtype=float, **options):
    """A network with numbers and a state drawn at random."""
    random = np.random.default_rng(seed)
    count = len(pairs)
    numbers = [random.uniform(0.5, 2.0, count) for _ in range(3)]
    nodes = int(np.max(pairs)) + 1 if nodes is None else nodes
    state = Particles(*jnp.asarray(random.normal(size=(2, nodes, dim)), dtype))
    return Springs(pairs, *numbers, nodes=nodes, layout=layout, **options), state


@jax.jit
def newtons(springs, state):
    return springs(0.0, state, 1.0)


@jax.jit
def joules(springs, state):
    return springs.potential(0.0, state, 1.0)


def push(springs, state):
    """The force as the scene sees it."""
    scene = Scene(state, 1.0, (springs,))
    return np.asarray(newtons(scene.forces[0], scene.state))


def by_hand(springs, state):
    """Spring by spring, in NumPy; and the magnitudes that it sums at each node."""
    x, v = (np.asarray(a, float) for a in state)
    force, size = np.zeros_like(x), np.zeros(len(x))
    for (a, b), k, L, c in zip(springs.pairs, springs.stiffness, springs.rest_length, springs.damping, strict=True):
        d, w = x[b] - x[a], v[b] - v[a]
        length = np.linalg.norm(d)
        pull = (k * (length - L) + c * (d @ w) / length) * d / length
        force[a] += pull
        force[b] -= pull
        size[[a, b]] += np.linalg.norm(pull) + k * (length + L)
    return force, size[:, None]


# the force


@LAYOUTS
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_each_spring_pulls_both_ends_along_its_line(layout, dim, precision):
    pairs = np.concatenate([grid(4, 5), [[17, 3], [3, 17], [0, 19]]])  # and two springs side by side
    springs, state = tangle(pairs, layout, dim=dim, nodes=22, dtype=precision.dtype)
    found = push(springs, state)
    wanted, size = by_hand(springs, state)
    assert (springs.layout, found.dtype) == (layout, precision.dtype)
    assert np.all(np.abs(found - wanted) <= 16 * precision.eps * size + 1e-30)
    assert np.abs(found.astype(float).sum(axis=0)).max() <= 4 * precision.eps * size.sum()


@settings(max_examples=2, deadline=None)
@given(rows=st.integers(2, 4), columns=st.integers(3, 4), seed=st.integers(0, 2**32 - 1))
def test_the_layouts_agree_however_the_nodes_are_numbered(rows, columns, seed):
    random = np.random.default_rng(seed)
    nodes = rows * columns
    order, pairs = random.permutation(nodes), grid(rows, columns)
    springs, state = tangle(pairs, "bands", seed=seed)
    there = np.argsort(order)
    turned = np.where(random.random(len(pairs))[:, None] < 0.5, order[pairs], order[pairs][:, ::-1])
    numbers = springs.stiffness, springs.rest_length, springs.damping
    moved = Particles(state.position[there], state.velocity[there])
    found = np.asarray(newtons(springs, state))
    scale = np.abs(by_hand(springs, state)[1]).max()
    for layout in ("bands", "gather"):
        other = np.asarray(newtons(Springs(turned, *numbers, layout=layout), moved))[order]
        np.testing.assert_allclose(other, found, rtol=0, atol=1e-13 * scale)


@LAYOUTS
def test_scenes_vmap_and_one_by_one_agree(layout):
    springs, _ = tangle(grid(3, 4), layout)
    states = Particles(*np.random.default_rng(1).normal(size=(2, 5, 12, 3)))
    alone = np.stack([newtons(springs, jax.tree.map(lambda a, i=i: a[i], states)) for i in range(5)])
    np.testing.assert_allclose(newtons(springs, states), alone, rtol=0, atol=1e-14)
    np.testing.assert_allclose(jax.vmap(newtons, (None, 0))(springs, states), alone, rtol=0, atol=1e-14)
    assert jax.eval_shape(joules, springs, states).shape == (5, 12)
    # a sweep: an array where a number was
    build, swept = partial(Springs, springs.pairs, rest_length=1.0, layout=layout), jnp.linspace(1.0, 2.0, 5)
    whole = newtons(build(stiffness=swept[:, None]), states)
    each = jax.jit(jax.vmap(lambda k, state: newtons(build(stiffness=k), state)))(swept, states)
    np.testing.assert_allclose(whole, each, rtol=0, atol=1e-14)


@LAYOUTS
def test_the_force_is_minus_the_gradient_of_the_energy(layout):
    springs, state = tangle(grid(3, 3), layout)
    free = Springs(springs.pairs, springs.stiffness, springs.rest_length, layout=layout)
    slope = jax.jit(jax.grad(lambda x: jnp.sum(joules(free, Particles(x, x)))))(state.position)
    np.testing.assert_allclose(-slope, push(free, state), rtol=0, atol=1e-13)
    total = np.sum(np.asarray(free.energy(state)))
    np.testing.assert_allclose(np.sum(np.asarray(joules(free, state))), total, rtol=1e-14)


@LAYOUTS
def test_numbers_come_back_as_they_were_given(layout):
    springs, state = tangle(np.concatenate([grid(3, 4), [[0, 1], [11, 0]]]), layout)
    random = np.random.default_rng(0)
    for found in (springs.stiffness, springs.rest_length, springs.damping):
        np.testing.assert_array_equal(found, random.uniform(0.5, 2.0, len(springs.pairs)))
    x, v = (np.asarray(a) for a in state)
    d, w = (a[springs.pairs[:, 1]] - a[springs.pairs[:, 0]] for a in (x, v))
    length = np.linalg.norm(d, axis=1)
    rate = np.sum(d * w, axis=1) / length
    stretch = length - springs.rest_length
    np.testing.assert_allclose(springs.length(state), length, rtol=1e-15)
    np.testing.assert_allclose(springs.strain(state), stretch / springs.rest_length, rtol=0, atol=1e-14)
    np.testing.assert_allclose(springs.energy(state), springs.stiffness * stretch**2 / 2, rtol=1e-12, atol=1e-15)
    tension = springs.stiffness * stretch + springs.damping * rate
    np.testing.assert_allclose(springs.tension(state), tension, rtol=0, atol=1e-14)
    plain = Springs([[0, 1]], 3.0, 0.5)
    assert (plain.stiffness, plain.rest_length, plain.damping) == (3.0, 0.5, None)


@LAYOUTS
def test_ends_that_meet_have_finite_values_and_derivatives(layout, precision):
    def weighed(scene):
        pull = scene.acceleration(0.0, scene.state)
        return jnp.vdot(pull, jnp.arange(1.0, 1 + pull.size, dtype=pull.dtype).reshape(pull.shape))

    derivatives = jax.jit(lambda scene, change: jax.jvp(jax.value_and_grad(weighed), (scene,), (change,)))
    here = jnp.zeros((3, 3), precision.dtype)
    for rest, damping in ((0.0, None), (0.0, 0.3), (1.0, 0.3)):
        springs = Springs([[0, 1], [1, 2]], 5.0, rest, damping, layout=layout)
        scene = Scene(Particles(here, here + 1), 1.0, (springs,))
        found = derivatives(scene, jax.tree.map(jnp.ones_like, scene))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
        np.testing.assert_array_equal(newtons(scene.forces[0], scene.state), 0)
    linear = Springs([[0, 1]], 5.0, 0.0, layout=layout)  # without a rest length it is stiff in every direction
    stiffness = jax.jit(jax.jacobian(lambda x: newtons(linear, Particles(x, x))[0]))(here[:2])
    np.testing.assert_allclose(stiffness[:, 0], -5.0 * np.eye(3), rtol=1e-6)


# closed forms


def chain(nodes, k, mass=1.0, rest=0.1, **options):
    """Nodes in a row, tied to the next."""
    x = np.zeros((nodes, 2))
    x[:, 1] = -rest * np.arange(nodes)
    pairs = np.stack([np.arange(nodes - 1), np.arange(1, nodes)], axis=1)
    return Springs(pairs, k, rest, **options), Particles(jnp.asarray(x), jnp.zeros((nodes, 2)))


def test_momentum_of_a_free_network_is_constant():
    springs, state = tangle(grid(6, 6))
    mass = np.random.default_rng(1).uniform(0.5, 2, 36)
    flight = simulate(Scene(state, mass, (springs,)), methods.rk4, dt=0.01, steps=300, save_every=10)
    momentum = np.einsum("n,fnd->fd", mass, flight.velocity)
    size = np.einsum("n,fnd->f", mass, np.abs(flight.velocity)).max()
    assert np.abs(momentum - momentum[0]).max() <= 1e-14 * size


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_a_chain_sags_as_much_under_every_method(method):
    n, k, mass = 5, 500.0, 0.05
    springs, state = chain(n + 1, k, damping=3.0)
    pinned = np.arange(n + 1) == 0
    scene = Scene(state, mass, (forces.Gravity(g=G), springs), pinned=pinned)
    end = simulate(scene, method, dt=2e-3, steps=5000, save_every=5000).final_scene.state
    sag = -float(end.position[-1, 1]) - 0.1 * n
    assert sag == pytest.approx(mass * G * n * (n + 1) / (2 * k), rel=1e-6)


# derivatives


@LAYOUTS
def test_gradients_of_a_run_are_those_of_its_differences(layout):
    pairs = grid(4, 4)
    nodes = np.arange(16)
    x = np.stack([0.1 * (nodes % 4), 0.02 * np.sin(nodes), 0.1 * (nodes // 4)], axis=-1)
    rest = np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1)
    weights = np.random.default_rng(0).normal(size=x.shape)

    @jax.jit
    def outcome(k, L, c, x):
        springs = Springs(pairs, k, L, c, layout=layout)
        scene = Scene(Particles(x, jnp.zeros_like(x)), 0.01, (forces.Gravity(g=G), springs), pinned=nodes < 2)
        run = simulate(scene, methods.semi_implicit_euler, dt=1e-3, steps=200, save_every=200)
        return jnp.sum(weights * run.final_scene.state.position)

    point = (np.full(len(pairs), 50.0), rest, np.asarray(0.05), x)
    slopes = jax.jit(jax.grad(outcome, argnums=(0, 1, 2, 3)))(*point)
    for i, (number, slope) in enumerate(zip(point, slopes, strict=True)):
        direction = np.random.default_rng(i).uniform(0.5, 1.5, np.shape(number))
        h = 1e-4 * np.abs(number).max()
        a, b, c, d = (float(outcome(*point[:i], number + s * h * direction, *point[i + 1 :])) for s in (-2, -1, 1, 2))
        assert np.sum(slope * direction) == pytest.approx((a - 8 * b + 8 * c - d) / (12 * h), rel=1e-6)


def test_a_gradient_by_a_scene_is_seen_spring_by_spring():
    springs, state = tangle(grid(3, 3))
    scene = Scene(state, 1.0, (springs,))
    by_scene = jax.jit(jax.grad(lambda scene: jnp.sum(newtons(scene.forces[0], scene.state)[0])))(scene).forces[0]
    build = partial(Springs, springs.pairs, rest_length=springs.rest_length, damping=springs.damping)
    by_number = jax.jit(jax.grad(lambda k: jnp.sum(newtons(build(k), state)[0])))(springs.stiffness)
    np.testing.assert_allclose(by_scene.stiffness, by_number, rtol=0, atol=1e-14)
    assert np.abs(by_number).max() > 0.1


# what it costs


def instructions(springs, state):
    scene = Scene(state, 0.1, (forces.Gravity(), springs), pinned=np.arange(springs.nodes) < 2)
    step = jax.jit(lambda scene: scene.step(methods.semi_implicit_euler, 0.0, 1e-3))
    text = step.lower(scene).compile().as_text()
    return set(re.findall(r"= .*? ([a-z][\w\-]*)\(", text))


@pytest.mark.parametrize("breaks_at", [None, 0.5])
def test_a_step_never_scatters_and_in_bands_never_gathers(breaks_at):
    pairs = grid(6, 7)
    bands = instructions(*tangle(pairs, breaks_at=breaks_at))
    assert not {"scatter", "gather", "while"} & bands
    table = instructions(*tangle(pairs, "gather", breaks_at=breaks_at))
    assert "gather" in table
    assert "scatter" not in table


def test_the_layout_follows_the_numbering():
    lattice, mess = grid(30, 30), np.random.default_rng(0).permutation(900)[grid(30, 30)]
    assert Springs(lattice, 1.0, 1.0).layout == "bands"
    assert Springs(mess, 1.0, 1.0).layout == "gather"
    assert Springs(mess, 1.0, 1.0, layout="bands").layout == "bands"


def test_the_same_network_built_twice_compiles_once():
    state = tangle(grid(3, 3))[1]
    count = []

    @jax.jit
    def push(springs):
        count.append(1)
        return springs(0.0, state, 1.0)

    for k in (1.0, 2.0):
        push(Springs(grid(3, 3), k, 1.0))
    assert len(count) == 1


# breaking


@LAYOUTS
def test_overstretched_springs_part_for_good(layout):
    springs, state = chain(4, 100.0, rest=1.0, breaks_at=0.5, layout=layout)
    x = state.position.at[3, 1].add(-0.6)  # the last one is 60 % too long
    scene = Scene(Particles(x, state.velocity), 1.0, (springs,), pinned=np.arange(4) < 3)
    flight = simulate(scene, methods.semi_implicit_euler, dt=1e-3, steps=100, save_every=10)
    (part,) = flight.parts
    np.testing.assert_array_equal(part.unbroken[0], [True, True, True])
    np.testing.assert_array_equal(part.unbroken[1:], np.tile([True, True, False], (10, 1)))
    end = flight.final_scene.forces[0]
    np.testing.assert_array_equal(end.tension(flight.final_scene.state), 0)
    np.testing.assert_allclose(flight.velocity[1:, 3], np.tile(flight.velocity[1, 3], (10, 1)), rtol=1e-14)
    assert float(jnp.sum(joules(end, flight.final_scene.state))) == 0
    assert float(end.breaks_at) == 0.5


def test_springs_that_cannot_break_remember_nothing():
    springs, state = chain(4, 100.0)
    assert not springs.remembers
    assert springs.unbroken is None
    assert springs.breaks_at is None
    assert simulate(Scene(state, 1.0, (springs,)), methods.euler, dt=0.1, steps=2).parts == ()


def test_scenes_break_each_for_itself():
    springs, state = chain(3, 100.0, rest=1.0, breaks_at=jnp.asarray([[0.5], [5.0]]))
    x = jnp.stack([state.position.at[2, 1].add(-1.0)] * 2)
    flight = simulate(Scene(Particles(x, 0 * x), 1.0, (springs,)), methods.verlet, dt=1e-3, steps=2)
    np.testing.assert_array_equal(flight.final_scene.forces[0].unbroken, [[True, False], [True, True]])
    shared = Scene(Particles(x, 0 * x), 1.0, (chain(3, 100.0, breaks_at=0.5)[0],))
    with pytest.raises(ValueError, match=r"give breaks_at the shape \(\*scenes, 1\)"):
        simulate(shared, methods.verlet, dt=1e-3, steps=2)


# bad input


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (([[0, 1], [1, 1]], 1.0, 1.0), ValueError, r"from node 1 to itself at index 1"),
        (([[0, -1]], 1.0, 1.0), ValueError, r"pairs: got \[0, -1\] at index 0 .* from 0 to"),
        (([], 1.0, 1.0), ValueError, r"pairs: got the empty shape"),
        (([[0, 1, 2]], 1.0, 1.0), ValueError, r"pairs: got shape \(1, 3\), expected \(springs, 2\)"),
        (([[0.0, 1.0]], 1.0, 1.0), TypeError, r"pairs: got dtype float64, expected integers"),
        (([[0, 1]], -1.0, 1.0), ValueError, r"stiffness \[N/m\]: got -1.0, expected numbers >= 0"),
        (([[0, 1]], 1.0, -1.0), ValueError, r"rest length \[m\]: got -1.0"),
        (([[0, 1]], 1.0, 1.0, -1.0), ValueError, r"damping \[kg/s\]: got -1.0"),
        (([[0, 1]], 1.0, 1.0, None, -0.1), ValueError, r"breaks_at \[1\]: got -0.1"),
        (([[0, 1]], np.ones(3), 1.0), ValueError, r"stiffness \[N/m\]: got shape \(3,\), expected \(\) .* or \(1,\)"),
        (([[0, 1]], np.nan, 1.0), ValueError, r"stiffness \[N/m\]: got nan, expected finite"),
    ],
)
def test_bad_input_is_answered_in_plain_words(arguments, error, message, unannotated):
    with pytest.raises(error, match=message):
        Springs(*arguments)


def test_the_number_of_nodes_must_be_the_scene_s(unannotated):
    springs, state = chain(4, 100.0)
    with pytest.raises(ValueError, match=r"expected \(\*scenes, 4, dim\): the pairs join 4 nodes. .* nodes="):
        simulate(
            Scene(Particles(state.position[:3], state.velocity[:3]), 1.0, (springs,)), methods.rk4, dt=0.1, steps=1
        )
    with pytest.raises(ValueError, match=r"pairs: got \[0, 3\] at index 1 .* from 0 to 2"):
        Springs([[0, 1], [0, 3]], 1.0, 1.0, nodes=3)
    with pytest.raises(ValueError, match=r"layout: got 'lists', expected one of bands, gather"):
        Springs([[0, 1]], 1.0, 1.0, layout="lists")


@LAYOUTS
def test_what_is_cut_falls_freely_and_the_rest_holds(layout):
    """Two weights one below the other, each at rest on its spring: below the cut one falls, the upper swings about its own."""
    chain = Springs([[0, 1], [1, 2]], 100.0, 1.0, nodes=3, layout=layout, breaks_at=2.0)
    sag = G / 100.0 * np.array([0.0, 2.0, 3.0])
    place = jnp.asarray(np.stack([np.zeros(3), -np.arange(3) - sag], axis=-1))
    cut = chain.cut(np.array([[False, True], [False, False], [True, False]]))
    start = Particles(jnp.broadcast_to(place, (3, 3, 2)), jnp.zeros((3, 3, 2)))
    pinned = jnp.broadcast_to(jnp.arange(3) == 0, (3, 3))
    run = simulate(Scene(start, 1.0, (forces.Gravity(G), cut), pinned=pinned), methods.rk4, dt=1e-3, steps=300)
    t, y = np.asarray(run.time), np.asarray(run.position[..., 1])
    np.testing.assert_allclose(y[:, 0, 2], place[2, 1] - G * t**2 / 2, atol=1e-12)
    np.testing.assert_allclose(y[:, 0, 1], -1 - G / 100 * (1 + np.cos(10 * t)), atol=1e-9)
    np.testing.assert_allclose(y[:, 1], np.broadcast_to(place[:, 1], (301, 3)), atol=1e-12)
    np.testing.assert_array_equal(run.final_scene.forces[1].unbroken, [[True, False], [True, True], [False, True]])


def test_a_cut_that_is_no_mask_of_the_springs_is_refused():
    with pytest.raises(ValueError, match=re.escape("booleans of shape (2,)")):
        Springs([[0, 1], [1, 2]], 1.0, 1.0).cut([1])
