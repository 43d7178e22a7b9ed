"""Each method against its promises: order, evaluations, stability, and the exact cases."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, forces, methods, simulate
from physjax.stepping.methods import METHODS

ALL = pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)


def thrown(method, dt, steps, dtype=float):
    """A ball thrown with (3, 4) m/s and the sum of its steps' position error under constant acceleration."""
    scene = Scene(Particles(jnp.zeros(2, dtype), jnp.asarray([3.0, 4.0], dtype)), forces=(forces.Gravity(),))
    return simulate(scene, method, dt=dt, steps=steps)


@pytest.mark.parametrize(
    ("name", "share"),
    [("euler", 0.5), ("semi_implicit_euler", -0.5), ("midpoint", 0), ("verlet", 0), ("leapfrog", 0), ("rk4", 0)],
)
def test_constant_acceleration_is_exact_or_off_by_exactly_half_a_step(name, share, precision):
    dt, steps = 0.125, 64
    flight = thrown(METHODS[name], dt, steps, precision.dtype)
    t = np.asarray(flight.time, float)
    exact = 4.0 * t - 4.9 * t**2 + share * 9.8 * dt * t
    np.testing.assert_allclose(flight.position[:, 1], exact, atol=64 * 400 * precision.eps, rtol=0)


def test_the_lectures_listing():
    scene = Scene(Particles(jnp.zeros(1), jnp.zeros(1)), forces=(forces.Constant(jnp.asarray([10.0])),))
    flight = simulate(scene, methods.euler, dt=1.0, steps=10)
    assert flight.velocity[-1, 0] == 100.0
    assert flight.position[-1, 0] == 450.0


@ALL
def test_evaluations_a_step(method):
    calls = []

    def counted(t, state, mass):
        calls.append(t)
        return -state.position

    scene = Scene(Particles(jnp.ones(1), jnp.zeros(1)), forces=(counted,))
    method(scene, 0.0, scene.state, 0.1)
    assert len(calls) == method.promises.evaluations


@ALL
def test_stable_to_its_limit_and_not_beyond(method):
    limit = method.promises.stable_to

    def radius(step):
        scene = Scene(Particles(jnp.zeros(1), jnp.zeros(1)), forces=(forces.Anchor(point=jnp.zeros(1), stiffness=1.0),))
        one_step = lambda y: jnp.concatenate(method(scene, 0.0, Particles(y[:1], y[1:]), step))  # noqa: E731
        return np.abs(np.linalg.eigvals(np.asarray(jax.jacfwd(one_step)(jnp.zeros(2))))).max()

    if limit:
        assert radius(0.98 * limit) <= 1 + 1e-12
        assert radius(1.02 * limit) > 1 + 1e-3
    else:
        assert radius(0.1) > 1 + 1e-6
