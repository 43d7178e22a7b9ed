"""A number of steps that is data: the states of `simulate`, for every dt by one program, differentiable forwards."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, forces, methods, simulate, state_after


def ball(speed=8.0):
    launch = jnp.stack([jnp.asarray(3.0), jnp.asarray(speed)])
    return Scene(Particles(jnp.zeros(2), launch), forces=(forces.Gravity(), forces.QuadraticDrag(0.05, 0.4)))


def test_it_ends_where_the_run_of_as_many_steps_does():
    one_program = jax.jit(lambda dt: state_after(ball(), methods.rk4, duration=0.8, dt=dt))
    for count in (1, 5, 64):
        end = one_program(0.8 / count)
        run = simulate(ball(), methods.rk4, dt=0.8 / count, steps=count, save_every=count)
        np.testing.assert_allclose(end.state.position, run.position[-1], rtol=1e-13)
        assert int(end.steps) == count
        assert bool(end.ok)
    assert one_program._cache_size() == 1


def test_a_dt_that_does_not_fit_is_the_nearest_that_does():
    end = state_after(ball(), methods.euler, duration=1.0, dt=0.3)
    assert int(end.steps) == 3
    np.testing.assert_allclose(end.dt, 1 / 3)
    assert int(state_after(ball(), methods.euler, duration=1.0, dt=7.0).steps) == 1


def test_it_has_forward_derivatives():
    height = lambda speed: state_after(ball(speed), methods.rk4, duration=0.8, dt=0.01).state.position[1]  # noqa: E731
    h = 1e-5
    central = (height(8.0 + h) - height(8.0 - h)) / (2 * h)
    np.testing.assert_allclose(jax.jacfwd(height)(8.0), central, rtol=1e-7)


def test_what_blows_up_is_said_and_bad_numbers_are_refused():
    stiff = Scene(Particles(jnp.ones(1), jnp.zeros(1)), forces=(lambda t, state, mass: -1e9 * state.position,))
    assert not bool(state_after(stiff, methods.rk4, duration=90.0, dt=1.0).ok)
    with pytest.raises(ValueError, match=r"dt \[s\]: got 0.0, expected numbers > 0"):
        state_after(ball(), methods.rk4, duration=1.0, dt=0.0)
    with pytest.raises(ValueError, match=r"got shapes \(\) and \(2,\), expected one duration and one dt"):
        state_after(ball(), methods.rk4, duration=1.0, dt=np.array([0.1, 0.2]))
