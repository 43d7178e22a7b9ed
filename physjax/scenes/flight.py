"""Projectiles and falling bodies."""

import jax.numpy as jnp
import numpy as np

from physjax import projectile as closed_form
from physjax.particles import Particles
from physjax.physics import forces
from physjax.scene import Scene
from physjax.scenes.registry import read_table, scene
from physjax.study.energy.quantities import ENERGY
from physjax.study.problem import Problem, Truth


@scene
def projectile(speed: float = 30.0, angle: float = 0.9, g: float = 9.8) -> Problem:
    """A ball thrown in a vacuum: the parabola that every second-order method follows exactly."""
    launch = speed * np.array([np.cos(angle), np.sin(angle)])
    throw = Scene(Particles(jnp.zeros(2), jnp.asarray(launch)), mass=0.145, forces=(forces.Gravity(g),))

    def exact(t):
        t = t[:, None]
        down = np.array([0.0, -g])
        return Particles(launch * t + 0.5 * down * t**2, launch + down * t)

    return Problem(
        throw,
        duration=2 * launch[1] / g,
        exact=exact,
        conserved=(ENERGY,),
        truths=(
            Truth(
                "lands at the range 2 v_x v_y / g [m]",
                lambda flight: flight.position[-1, 0],
                float(closed_form.horizontal_range(speed, angle, g=g)),
                1e-9,
            ),
            Truth("lands on the ground [m]", lambda flight: flight.position[-1, 1], 0.0, 1e-9),
        ),
    )


@scene
def fall_with_drag(mass: float = 80.0, area: float = 0.7, coefficient: float = 1.0, g: float = 9.8) -> Problem:
    """A skydiver falling from rest against quadratic drag: v = v_t tanh(g t / v_t)."""
    density = 1.225
    dive = Scene(
        Particles(jnp.zeros(1), jnp.zeros(1)),
        mass=mass,
        forces=(forces.Gravity(g, up=0), forces.QuadraticDrag(area, coefficient, density)),
    )
    terminal = np.sqrt(2 * mass * g / (density * coefficient * area))

    def exact(t):
        u = g * t[:, None] / terminal
        return Particles(-(terminal**2) / g * np.log(np.cosh(u)), -terminal * np.tanh(u))

    return Problem(
        dive,
        duration=30.0,
        exact=exact,
        truths=(Truth("falls at the terminal speed [m/s]", lambda f: -f.velocity[-1, 0], terminal, 1e-5 * terminal),),
    )


@scene
def raindrop() -> Problem:
    """Raindrops of 34 sizes falling in still air, as measured by Gunn and Kinzer in 1949.

    The drag correction grows as |v|^1.681 from rest, which is not smooth: it limits every method to order 2.7.
    """
    measured = read_table("raindrop_terminal_velocity.csv")
    radius = measured["diameter_mm"] / 2000
    volume = 4 / 3 * np.pi * radius**3
    drops = Scene(
        Particles(jnp.zeros((radius.size, 1)), jnp.zeros((radius.size, 1))),
        mass=998.2 * volume,
        forces=(
            forces.Gravity(up=0),
            forces.Buoyancy(density=1.204, volume=volume, up=0),
            forces.SphereDrag(radius, density=1.204, viscosity=1.813e-5),
        ),
    )
    diameter, speed = measured["diameter_mm"], measured["terminal_velocity_m_s"]
    spherical = (diameter >= 0.2) & (diameter <= 2.2)
    large = diameter == 3.0
    ratio = lambda flight: -flight.velocity[-1, :, 0] / speed  # noqa: E731
    return Problem(
        drops,
        duration=6.0,
        truths=(
            Truth("0.2 to 2.2 mm: the measured speed within 5 %", lambda f: ratio(f)[spherical], 1.0, 0.05),
            Truth("3 mm: 10 % too fast, since large drops are flattened", lambda f: ratio(f)[large], 1.10, 0.02),
        ),
    )
