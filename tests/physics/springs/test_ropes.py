"""Ropes that pull and do not push: a bungee jump and its derivatives, one that is slack, and damping that never pushes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, energy, forces, methods, simulate, springs

M, G, LENGTH = 70.0, 9.8, 20.0
MASS = jnp.asarray(M)


def lowest_in_truth(stiffness):
    """Free fall for L, then an oscillator about its equilibrium."""
    return -(LENGTH + M * G / stiffness * (1 + jnp.sqrt(1 + 2 * stiffness * LENGTH / (M * G))))


def time_of_lowest(stiffness):
    speed, omega = np.sqrt(2 * G * LENGTH), np.sqrt(stiffness / M)
    return speed / G + (np.pi - np.arctan(speed * omega / G)) / omega


def bridge_and_jumper(stiffness):
    """A jumper on a rope that is a spring between two nodes, the first of them held."""
    rope = springs.Springs([[0, 1]], stiffness, LENGTH, tension_only=True)
    state = Particles(jnp.array([[0.0, 0.0], [0.0, -1e-6]]), jnp.zeros((2, 2)))
    return Scene(state, M, (forces.Gravity(G), rope), pinned=np.array([True, False]))


def jumper(stiffness):
    rope = forces.Anchor((0.0, 0.0), stiffness, rest_length=LENGTH, tension_only=True)
    start = jnp.broadcast_to(jnp.array([0.0, -1e-6]), (*jnp.shape(stiffness), 2))
    return Scene(Particles(start, jnp.zeros_like(start)), M, (forces.Gravity(G), rope))


def height_at(build, stiffness, duration):
    return simulate(build(stiffness), methods.rk4, dt=duration / 2000, steps=2000, save_every=2000).position[-1, ..., 1]


@pytest.mark.parametrize("build", [jumper, bridge_and_jumper])
def test_a_bungee_jump_is_as_deep_as_its_energy_says_and_so_is_the_derivative(build):
    stiffness = 60.0
    duration = time_of_lowest(stiffness)
    last = lambda k: jnp.ravel(height_at(build, k, duration))[-1]  # noqa: E731
    depth, slope = jax.value_and_grad(last)(jnp.asarray(stiffness))
    np.testing.assert_allclose(depth, lowest_in_truth(stiffness), rtol=1e-6)
    # at the turning point the time does not matter
    np.testing.assert_allclose(slope, jax.grad(lowest_in_truth)(stiffness), rtol=1e-4)


def test_a_batch_of_ropes_and_ropes_under_vmap_are_as_each_alone():
    stiffness = jnp.array([40.0, 60.0])
    batch = height_at(jumper, stiffness, 4.0)
    np.testing.assert_allclose(jax.vmap(lambda k: height_at(jumper, k, 4.0))(stiffness), batch, atol=1e-10)
    np.testing.assert_allclose(height_at(jumper, stiffness[1], 4.0), batch[1], atol=1e-10)


def test_a_slack_rope_does_nothing_and_damping_never_makes_it_push():
    rope = springs.Springs([[0, 1]], 5.0, 2.0, damping=100.0, tension_only=True)
    anchor = forces.Anchor((0.0, 0.0), 5.0, rest_length=2.0, damping=100.0, tension_only=True)
    for length, rate, pull in ((1.5, 3.0, 0.0), (2.5, -3.0, 0.0), (2.5, 0.1, 12.5)):
        ends = Particles(jnp.array([[0.0, 0.0], [length, 0.0]]), jnp.array([[0.0, 0.0], [rate, 0.0]]))
        np.testing.assert_allclose(rope(0.0, ends, MASS)[:, 0], [pull, -pull], atol=1e-12)
        np.testing.assert_allclose(anchor(0.0, ends, MASS)[1, 0], -pull, atol=1e-12)
        np.testing.assert_allclose(rope.tension(ends), [pull], atol=1e-12)
        stored = 2.5 * max(length - 2.0, 0.0) ** 2
        np.testing.assert_allclose(rope.energy(ends), [stored], atol=1e-12)
        np.testing.assert_allclose(jnp.sum(rope.potential(0.0, ends, MASS)), stored, atol=1e-12)
        np.testing.assert_allclose(anchor.potential(0.0, ends, MASS)[1], stored, atol=1e-12)


def test_a_rope_keeps_the_energy_and_lets_implicit_steps_see_that_it_is_slack():
    scene = bridge_and_jumper(60.0)
    film = simulate(scene, methods.verlet, dt=2e-3, duration=12.0, save_every=1000)
    total = jax.vmap(lambda t, s: jnp.sum(energy.total(scene, t, s)))(film.time, film.state)
    np.testing.assert_allclose(total, total[0], atol=1e-4 * M * G * LENGTH)
    seen = scene.forces[1].linearised_at(0.0, scene.state, scene.mass)
    moved = scene.state._replace(position=scene.state.position.at[1, 1].add(-1.0))
    np.testing.assert_array_equal(seen(0.0, moved, scene.mass), 0.0)


def test_an_anchor_without_a_rest_length_is_no_rope():
    with pytest.raises(ValueError, match="expected rest_length="):
        forces.Anchor((0.0, 0.0), 5.0, tension_only=True)
