"""Drag by a table: a rifle bullet against published ballistics, its derivative, and tables that do not fit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, forces, methods, simulate

FOOT, INCH, YARD = 0.3048, 0.0254, 0.9144
POUND_PER_SQUARE_INCH = 0.45359237 / INCH**2
WIND = 5 * 0.44704 * np.sqrt(0.5) * np.array([1.0, 0.0, -1.0])


def speed_and_drop(coefficient, yards):
    """A bullet at 2750 ft/s, sighted 2 in above the bore; BC [lb/in²]."""
    start = Particles(
        jnp.array([0.0, -2 * INCH, 0.0]), 2750 * FOOT * jnp.array([np.cos(0.001228), np.sin(0.001228), 0.0])
    )
    drag = forces.TabulatedDrag.g1(coefficient * POUND_PER_SQUARE_INCH, 0.01, WIND)
    shot = Scene(start, 0.01, (forces.Gravity(9.80665), drag))
    at = simulate(shot, methods.rk4, dt=2e-3, steps=450).crossing(lambda t, x: x[..., 0] - yards * YARD)
    return jnp.stack([jnp.hypot(at.velocity[0], at.velocity[1]) / FOOT, at.position[1] / INCH])


def test_a_bullet_is_as_fast_and_as_low_as_published():
    """py-ballisticcalc's tables for G1, BC 0.223, 5 mph at 45 degrees: within its 5 ft/s and an inch, alone and under vmap."""
    found = jax.vmap(lambda c: speed_and_drop(c, 500))(jnp.array([0.223, 0.3]))
    np.testing.assert_array_less(np.abs(found[0] - np.array([1169.1, -87.9])), [5.0, 1.0])
    assert (found[1] > found[0]).all()


def test_the_law_is_that_of_its_table_in_lanes_and_its_derivative_the_slope():
    drag = forces.TabulatedDrag([0.0, 1.0, 2.0], [0.5, 1.5, 0.7], area=0.2, density=2.0, speed_of_sound=10.0)
    speed = jnp.array([5.0, 15.0, 30.0])

    def push(speed):
        v = jnp.stack([speed, 0.0 * speed], axis=-1)
        return drag(0.0, Particles(jnp.zeros_like(v), v), jnp.ones(()))[..., 0]

    np.testing.assert_allclose(push(speed), -0.2 * np.array([1.0, 1.1, 0.7]) * speed**2, rtol=1e-14)
    slope = jax.vmap(jax.grad(push))(speed)
    right = -0.2 * (np.array([0.1, -0.08, 0.0]) * speed**2 + 2 * np.array([1.0, 1.1, 0.7]) * speed)
    np.testing.assert_allclose(slope, right, rtol=1e-13)
    still = Particles(jnp.zeros(2), jnp.zeros(2))
    assert jnp.isfinite(jax.jacfwd(lambda v: drag(0.0, still._replace(velocity=v), jnp.ones(())))(still.velocity)).all()


@pytest.mark.parametrize(
    ("mach", "words"), [([0.0, 1.0, 1.0], "numbers that rise"), ([0.0, 1.0], "two tables of equal length")]
)
def test_tables_that_do_not_fit_are_refused(mach, words):
    with pytest.raises(ValueError, match=words):
        forces.TabulatedDrag(mach, [0.1, 0.2, 0.3], area=1.0)
