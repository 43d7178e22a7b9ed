"""Springs that yield: the set of a bar that is bent, a crash and its heat, and what is left of a spring that breaks later."""

import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Pins, Scene, energy, lattices, methods, simulate, springs
from physjax.study.energy.audit import list_causes

K, LENGTH, STRAIN, M = 100.0, 2.0, 0.05, 1.0
MOST = STRAIN * LENGTH
"""The largest elastic stretch [m]."""
PULL, PUSH = 0.3, -0.25
LAYOUTS = pytest.mark.parametrize("layout", ["bands", "gather"])


def stretched(*amounts, speed=0.0):
    """Nodes in a row, with springs between them that are stretched by these amounts [m], the last node with a speed."""
    x = np.concatenate([[0.0], np.cumsum(LENGTH + np.asarray(amounts))])
    place = jnp.asarray(np.stack([x, 0 * x], axis=-1), float)
    return Particles(place, jnp.zeros_like(place).at[-1, 0].set(speed))


def bar(**options):
    return springs.Springs([[0, 1]], K, LENGTH, **({"yields_at": STRAIN} | options))


def crash(speed, part=None):
    """A mass that leaves a spring at rest at a speed [m/s]."""
    place = jnp.zeros((*jnp.shape(speed), 2, 2)).at[..., 1, 0].set(LENGTH)
    velocity = jnp.zeros_like(place).at[..., 1, 0].set(speed)
    held = np.broadcast_to([True, False], place.shape[:-1])
    return Scene(Particles(place, velocity), M, (bar() if part is None else part,), pinned=held)


def set_of_crash(speed, strain=STRAIN, length=LENGTH):
    """½mv² = ½ky² + k y set: elastic up to the yield y = ε L, and a constant force from there on."""
    most = strain * length
    return (M * speed**2 - K * most**2) / (2 * K * most)


def run_crash(speed, part=None, dt=1e-3, **options):
    return simulate(crash(speed, part), methods.rk4, dt=dt, duration=0.5, **options)


def path(t):
    """A stretch [m] that goes to and fro in straight lines, a second each."""
    return jnp.interp(t, jnp.arange(4.0), jnp.array([0.0, PULL, PUSH, 0.0]))


def lead(t):
    """The nodes of a bar on that path."""
    return jnp.zeros((2, 2)).at[1, 0].set(LENGTH + path(t))


@LAYOUTS
def test_a_bar_that_is_pulled_crushed_and_let_go_has_the_hysteresis_of_prandtl(layout, precision):
    scene = Scene(stretched(0.0), M, (bar(layout=layout),), pinned=Pins(np.ones(2, bool), lead))
    run = simulate(scene, methods.verlet, dt=1 / 32, duration=3.0)
    (part,) = run.parts
    assert part.permanent_set.dtype == precision.dtype
    left = np.asarray(part.permanent_set[:, 0])
    rounding = 20 * precision.eps
    np.testing.assert_allclose(left[32], PULL - MOST, atol=rounding)
    np.testing.assert_allclose(left[64], PUSH + MOST, atol=rounding)
    np.testing.assert_allclose(left[-1], 0.0 - MOST, atol=rounding)  # at its first length it is stretched to the yield
    force = part.tension(run.state)[:, 0]
    by_hand = np.clip(np.asarray(path(run.time)) - left, -MOST, MOST)
    np.testing.assert_allclose(force, K * by_hand, atol=K * rounding)
    np.testing.assert_allclose(np.abs(force).max(), K * MOST, rtol=1e-5)


def test_a_crash_leaves_the_set_of_its_energy_and_the_heat_is_force_times_set():
    wanted = set_of_crash(3.0)
    run = run_crash(3.0)
    end = run.final_scene
    np.testing.assert_allclose(run.parts[0].permanent_set[-1], [wanted], atol=1e-6)
    kinetic = 0.5 * M * float(jnp.sum(end.state.velocity**2))
    kept = kinetic + float(end.forces[0].energy(end.state)[0])
    np.testing.assert_allclose(kept, 0.5 * K * MOST**2, atol=1e-5)  # it swings within the yield from then on
    np.testing.assert_allclose(run_crash(-3.0).parts[0].permanent_set[-1], [-wanted], atol=1e-6)


@pytest.mark.slow
def test_a_ledger_enters_what_yielding_costs():
    heat = energy.ledger(run_crash(3.0, dt=0.02)).energy.totals["Springs yielded"]
    np.testing.assert_allclose(heat, K * MOST * set_of_crash(3.0), rtol=0.02)
    causes = list_causes(crash(3.0, bar(breaks_at=9.0)))[2]
    assert causes[0] == "Springs yielded or parted"


def test_crashes_in_a_batch_and_under_vmap_are_as_each_alone():
    speeds, strains = jnp.array([2.0, 3.0]), jnp.array([0.05, 0.1])
    left = lambda v, strain: run_crash(v, bar(yields_at=strain), dt=5e-3, save_every=100).parts[0].permanent_set[-1]  # noqa: E731
    batch = left(speeds, strains[:, None])
    assert batch.shape == (2, 1)
    np.testing.assert_allclose(jax.vmap(left)(speeds, strains), batch, atol=1e-13)
    np.testing.assert_allclose(left(speeds[1], strains[1]), batch[1], atol=1e-13)


def test_the_derivatives_of_a_set_are_those_of_its_closed_form():
    """Where a bar is held at a stretch; after a crash the derivative knows the moment of the yield to a step."""

    def left(stretch, strain, length):
        bent, _ = springs.Springs([[0, 1]], K, length, yields_at=strain).advance(0.0, 0.1, ends(length + stretch))
        return bent.permanent_set[0]

    ends = lambda length: Particles(jnp.zeros((2, 2)).at[1, 0].set(length), jnp.zeros((2, 2)))  # noqa: E731
    found = jax.grad(left, argnums=(0, 1, 2))(0.3, STRAIN, LENGTH)
    np.testing.assert_allclose(found, [1.0, -LENGTH, -STRAIN], atol=1e-12)
    crashed = lambda v: run_crash(v, dt=5e-4, save_every=1000).final_scene.forces[0].permanent_set[0]  # noqa: E731
    np.testing.assert_allclose(jax.grad(crashed)(3.0), jax.grad(set_of_crash)(3.0), rtol=2e-3)


@LAYOUTS
def test_springs_yield_each_for_itself_though_they_share_their_numbers(layout):
    row = springs.Springs([[0, 1], [1, 2], [2, 3]], K, LENGTH, yields_at=STRAIN, layout=layout)
    state = stretched(0.25, 0.08, -0.3)
    bent, _ = row.advance(0.0, 0.1, state)
    np.testing.assert_allclose(bent.permanent_set, [0.25 - MOST, 0.0, MOST - 0.3], atol=1e-12)
    assert row.permanent_set.tolist() == [0.0, 0.0, 0.0]
    assert float(bent.rest_length) == LENGTH
    for part in (row, bent):  # what is beyond the yield pulls as it will when that has become its set
        np.testing.assert_allclose(part.tension(state), [K * MOST, K * 0.08, -K * MOST], atol=1e-10)
    np.testing.assert_allclose(bent.energy(state), 0.5 * K * np.array([MOST, 0.08, MOST]) ** 2, atol=1e-12)
    at_rest = stretched(0.25 - MOST, 0.0, MOST - 0.3)
    np.testing.assert_allclose(bent(0.0, at_rest, 1.0), 0.0, atol=1e-10)


def test_the_force_beyond_the_yield_is_the_slope_of_its_potential():
    state = stretched(0.25, 0.08, -0.3)
    row = springs.Springs([[0, 1], [1, 2], [2, 3]], K, LENGTH, yields_at=STRAIN)
    stored = lambda x: jnp.sum(row.potential(0.0, Particles(x, state.velocity), 1.0))  # noqa: E731
    np.testing.assert_allclose(row(0.0, state, 1.0), -jax.grad(stored)(state.position), atol=1e-11)
    linear = row.linearised_at(0.0, state, jnp.ones(4))
    np.testing.assert_allclose(linear(0.0, state, 1.0), row(0.0, state, 1.0), atol=1e-11)


def test_a_spring_breaks_by_its_whole_strain_and_keeps_its_set():
    tin = bar(breaks_at=0.3)
    for stretch, holds in ((0.55, True), (0.0, True), (0.58, True), (0.61, False), (0.0, False)):
        tin, _ = tin.advance(0.0, 0.1, stretched(stretch))
        assert bool(tin.unbroken[0]) == holds, stretch
    np.testing.assert_allclose(tin.permanent_set, [0.58 - MOST], atol=1e-12)
    np.testing.assert_array_equal(tin.tension(stretched(0.1)), [0.0])


def test_what_is_cut_yields_no_more():
    row = springs.Springs([[0, 1], [1, 2]], K, LENGTH, yields_at=STRAIN).cut([True, False])
    bent, _ = row.advance(0.0, 0.1, stretched(0.3, 0.3))
    np.testing.assert_allclose(bent.permanent_set, [0.0, 0.3 - MOST], atol=1e-12)


def test_a_rope_yields_when_it_is_pulled_and_not_when_it_is_slack():
    rope = bar(tension_only=True)
    for stretch, left, pull in ((-0.5, 0.0, 0.0), (0.3, 0.3 - MOST, K * MOST), (0.1, 0.3 - MOST, 0.0)):
        rope, _ = rope.advance(0.0, 0.1, stretched(stretch))
        np.testing.assert_allclose(rope.permanent_set, [left], atol=1e-12)
        np.testing.assert_allclose(rope.tension(stretched(stretch)), [pull], atol=1e-10)
        np.testing.assert_allclose(rope(0.0, stretched(stretch), 1.0)[0, 0], pull, atol=1e-10)


def test_damping_is_added_to_the_force_of_the_yield():
    moving = stretched(0.3, speed=2.0)
    np.testing.assert_allclose(bar(damping=3.0).tension(moving), [K * MOST + 6.0], atol=1e-10)
    np.testing.assert_allclose(bar(damping=3.0)(0.0, moving, 1.0)[0, 0], K * MOST + 6.0, atol=1e-10)


def test_implicit_steps_yield_too():
    errors = [
        abs(
            float(simulate(crash(3.0), methods.implicit_euler, dt=dt, duration=0.5).parts[0].permanent_set[-1, 0])
            - set_of_crash(3.0)
        )
        for dt in (2e-3, 1e-3)
    ]
    assert 1.7 < errors[0] / errors[1] < 2.3  # first order
    assert errors[1] < 0.03 * set_of_crash(3.0)


@pytest.mark.parametrize(
    "build",
    [
        partial(lattices.rope, (0.0, 0.0), (1.0, 0.0), 3, stiffness=10.0),
        partial(lattices.cloth, 1.0, 1.0, 2, 2, structural=10.0),
        partial(lattices.jelly, (1.0, 1.0, 1.0), (2, 2, 2), structural=10.0),
        partial(lattices.bridge, 2.0, 1.0, 2, stiffness=10.0),
        partial(lattices.from_mesh, np.eye(3), [[0, 1, 2]], structural=10.0),
    ],
)
def test_lattices_yield(build):
    assert float(build(mass=1.0, yields_at=0.02).springs.yields_at) == 0.02


def test_bad_yields_are_answered_in_plain_words():
    with pytest.raises(ValueError, match=re.escape("yields_at [1]: got -0.1, expected numbers >= 0")):
        bar(yields_at=-0.1)
    with pytest.raises(ValueError, match=r"yields_at \[1\]: got shape \(3,\), expected \(\) .* or \(1,\)"):
        bar(yields_at=[0.1, 0.2, 0.3])
    with pytest.raises(ValueError, match=r"give yields_at the shape \(\*scenes, 1\)"):
        simulate(crash(jnp.array([1.0, 2.0])), methods.verlet, dt=1e-3, steps=1)


def test_springs_that_cannot_yield_have_no_set():
    stiff = springs.Springs([[0, 1]], K, LENGTH)
    assert not stiff.remembers
    assert stiff.yields_at is None
    assert stiff.permanent_set is None
