"""Air that changes with time and place, and the lift of spin, against SciPy and closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from physjax import Particles, Scene, forces, methods, simulate

K = 0.5 * 1.225 * 0.01 * 0.4 / 2.0
"""½ρAC_d/m [1/m]."""


def test_a_shell_flies_through_thinner_air_and_a_shear_of_wind():
    def rate(t, s):
        x, v = s[:2], s[2:]
        w = v - [5.0 + 0.01 * x[1], np.sin(t)]
        return [*v, *(np.array([0.0, -9.8]) - K * np.exp(-x[1] / 8500) * np.hypot(*w) * w)]

    truth = solve_ivp(rate, (0.0, 20.0), [0.0, 0.0, 200.0, 300.0], rtol=1e-11, atol=1e-9).y[:2, -1]

    def wind(t, x):
        return jnp.stack([5.0 + 0.01 * x[..., 1], jnp.sin(t) + 0 * x[..., 1]], axis=-1)

    drag = forces.InAir(forces.QuadraticDrag(0.01, 0.4), wind=wind, thinning=lambda t, x: jnp.exp(-x[..., 1] / 8500.0))
    start = Particles(jnp.zeros((3, 2)), jnp.array([[200.0, 300.0]] * 3))
    run = simulate(Scene(start, 2.0, (forces.Gravity(9.8), drag)), methods.rk4, dt=0.05, steps=400, save_every=400)
    np.testing.assert_allclose(run.position[-1], [truth] * 3, rtol=1e-8)


@pytest.mark.parametrize("rate", [1e-3, 200.0, 1e7])
def test_the_lift_coefficient_is_that_of_its_spin(rate):
    radius, speed = 0.037, 40.0
    lift = forces.SpinLift(radius, jnp.array([0.0, 0.0, rate]))
    force = lift(0.0, Particles(jnp.zeros(3), jnp.array([speed, 0.0, 0.0])), jnp.ones(()))
    spin = radius * rate / speed
    right = 0.5 * 1.225 * np.pi * radius**2 * speed**2 * spin / (0.4 + 2.32 * spin)
    np.testing.assert_allclose(force, [0.0, right, 0.0], rtol=1e-12, atol=1e-18)


@pytest.mark.usefixtures("unannotated")
def test_air_that_makes_no_sense_is_refused():
    drag = forces.QuadraticDrag(0.01, 0.4)
    with pytest.raises(ValueError, match="neither wind= nor thinning="):
        forces.InAir(drag)
    with pytest.raises(TypeError, match="expected a function"):
        forces.InAir(drag, wind=(1.0, 0.0))
    with pytest.raises(TypeError, match="expected one such as"):
        forces.InAir(lambda t, state, mass: state.velocity, wind=lambda t, x: x)
    with pytest.raises(ValueError, match=r"expected \(2,\)"):
        Scene(Particles(jnp.ones((2, 3)), jnp.ones((2, 3))), 1.0, (forces.InAir(drag, thinning=lambda t, x: x[0]),))
