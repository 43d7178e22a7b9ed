"""Conserved quantities are kept by an accurate run, and their values are the textbook's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, forces, methods, simulate
from physjax.scenes import SCENES
from physjax.study import energy


@pytest.mark.parametrize(
    ("name", "numbers"), [("projectile", {}), ("oscillator", {"stiffness": (1.0, 9.0)}), ("figure_eight", {})]
)
def test_an_accurate_run_keeps_what_is_conserved(name, numbers):
    problem = SCENES[name](**numbers)
    flight = simulate(problem.scene, methods.rk4, dt=problem.duration / 8192, steps=8192, save_every=1024)
    for quantity in problem.conserved:
        value = jax.vmap(lambda t, s, q=quantity: q.value(problem.scene, t, s))(flight.time, flight.state)
        size = jnp.max(quantity.size(problem.scene, 0.0, problem.scene.state)) + 1.0
        assert np.abs(np.asarray(value - value[:1])).max() < 1e-9 * float(size), quantity.name


def test_values_for_two_balls():
    state = Particles(jnp.asarray([[1.0, 2.0], [0.0, 3.0]]), jnp.asarray([[3.0, 4.0], [1.0, 0.0]]))
    balls = Scene(state, mass=jnp.asarray([2.0, 4.0]), forces=(forces.Gravity(10.0),))
    np.testing.assert_allclose(energy.kinetic(balls, 0.0, state), [25.0, 2.0])
    np.testing.assert_allclose(energy.potential(balls, 0.0, state), [40.0, 120.0])
    np.testing.assert_allclose(energy.total(balls, 0.0, state), [65.0, 122.0])
    np.testing.assert_allclose(energy.momentum(balls, 0.0, state), [[6.0, 8.0], [4.0, 0.0]])
    np.testing.assert_allclose(energy.angular_momentum(balls, 0.0, state), [2 * (4 - 6), -4 * 3])


def test_coupled_lanes_are_summed():
    state = Particles(jnp.asarray([[1.0, 0, 0], [-1.0, 0, 0]]), jnp.asarray([[0.0, 1, 0], [0, -1.0, 0]]))
    pair = Scene(state, mass=2.0, forces=(forces.Gravitation(G=1.0),))
    assert energy.kinetic(pair, 0.0, state) == 2.0
    assert energy.potential(pair, 0.0, state) == -2.0  # -G m m / d
    np.testing.assert_allclose(energy.momentum(pair, 0.0, state), np.zeros(3))
    np.testing.assert_allclose(energy.angular_momentum(pair, 0.0, state), [0, 0, 4.0])
