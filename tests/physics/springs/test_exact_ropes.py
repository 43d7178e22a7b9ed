"""Ropes leave what they hold alone while they are slack, and stop it along themselves when they become taut."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, constraint_forces, forces, inertia, methods, rigid, simulate, springs

G, START, SPEED = 9.8, np.array([0.3, -0.2]), np.array([1.0, 2.0])


def throw(length, dt=1e-3, steps=700):
    """A ball thrown on a rope from the origin."""
    ropes = springs.Ropes([(-1, 0)], length, anchors=[(0.0, 0.0)])
    scene = Scene(Particles(jnp.array([START]), jnp.array([SPEED])), 2.0, (forces.Gravity(G), ropes))
    return simulate(scene, methods.verlet, dt=dt, steps=steps)


def test_a_ball_on_a_slack_rope_flies_freely_and_then_swings_with_what_the_tug_leaves_it():
    film = throw(1.0)
    t = np.asarray(film.time)[:, None]
    free = START + SPEED * t - 0.5 * np.array([0.0, G]) * t * t
    taut = int(np.argmax(np.linalg.norm(free, axis=-1) >= 1.0))
    np.testing.assert_allclose(film.position[: taut - 1, 0], free[: taut - 1], atol=1e-12)
    assert np.linalg.norm(film.position[:, 0], axis=-1).max() < 1.0 + 1e-11
    np.testing.assert_allclose(np.linalg.norm(film.position[taut:, 0], axis=-1), 1.0, atol=1e-11)
    # the tug takes what of the velocity is along the rope
    tug = np.interp(1.0, np.linalg.norm(free[taut - 1 : taut + 1], axis=-1), t[taut - 1 : taut + 1, 0])
    before = SPEED - np.array([0.0, G]) * tug
    along = START + 0.5 * (SPEED + before) * tug
    after = before - along * (before @ along)
    np.testing.assert_allclose(film.velocity[taut + 1, 0], after, atol=0.02)
    stored = 0.5 * after @ after + G * along[1]
    end = 0.5 * film.velocity[-1, 0] @ film.velocity[-1, 0] + G * film.position[-1, 0, 1]
    assert end == pytest.approx(stored, abs=5e-3)
    # taut it pulls as the string of a pendulum does, slack not at all
    x, v = (np.asarray(a)[-1, 0] for a in (film.position, film.velocity))
    pulls = [constraint_forces(film.scene, state=jax.tree.map(lambda a, i=i: a[i], film.state))[0] for i in (0, -1)]
    np.testing.assert_allclose(np.ravel(pulls), [0.0, 2.0 * (v @ v - G * x[1])], rtol=1e-6, atol=1e-12)


def test_where_the_ball_ends_has_a_gradient_by_the_length():
    end = jax.jit(lambda length: throw(length, dt=1e-2, steps=80).position[-1, 0, 0])
    expected = (end(1.0 + 1e-6) - end(1.0 - 1e-6)) / 2e-6
    assert jax.jit(jax.grad(end))(1.0) == pytest.approx(float(expected), rel=1e-6)


def test_two_bodies_on_a_rope_share_their_momentum_when_it_becomes_taut():
    bob = inertia.planar_disc(jnp.array([1.0, 3.0]), 0.1)
    start = rigid.planar_bodies(bob, [[0.0, 0.0], [0.5, 0.0]], velocity=[[0.0, 0.0], [2.0, 0.0]])
    ropes = rigid.Ropes([(0, 1)], jnp.zeros((1, 2, 2)), length=1.0)
    film = simulate(Scene(start, bob, (ropes,)), methods.verlet, dt=0.01, steps=50)
    np.testing.assert_allclose(film.state.momentum[20, :, 0], [0.0, 6.0], atol=1e-12)
    np.testing.assert_allclose(film.state.momentum[-1, :, 0], [1.5, 4.5], atol=1e-12)
    np.testing.assert_allclose(np.diff(film.position[-1, :, 0]), 1.0, atol=1e-11)
