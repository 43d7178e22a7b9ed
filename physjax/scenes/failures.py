"""Runs that must fail: most have a step beyond a stability limit that is known from theory."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from physjax.particles import Particles
from physjax.physics import forces
from physjax.physics.springs import lattices
from physjax.scene import Scene
from physjax.scenes.orbits import kepler
from physjax.scenes.registry import failure
from physjax.stepping import methods
from physjax.stepping.simulate import simulate
from physjax.trajectory import Trajectory

OMEGA = float(np.sqrt(15.0))
"""Rate of the spring of 15 N/m with 1 kg [1/s]."""


class Failure(NamedTuple):
    """A scene under a method with a step dt [s] that fails within `steps`, for a `cause` and due to a `force`.

    `limit` [s] is the longest stable step from theory (0: none is, None: it does not depend on dt alone).
    """

    scene: Scene
    method: Callable
    dt: float
    steps: int
    cause: str
    force: str
    limit: float | None

    def run(self, **options: Any) -> Trajectory:
        """The run that fails; options as for `simulate`."""
        return simulate(self.scene, self.method, dt=self.dt, steps=self.steps, **options)


@failure
def euler_on_a_spring(dt: float = 0.1) -> Failure:
    """Explicit Euler on an undamped spring: the amplitude grows by √(1 + ω²dt²) per step, for any dt."""
    return Failure(_build_spring(), methods.euler, dt, 1200, "stiffness", "Anchor", 0.0)


@failure
def midpoint_on_a_spring(dt: float = 0.1) -> Failure:
    """Midpoint on the same spring: the amplitude grows by √(1 + ω⁴dt⁴/4) per step, slowly but without limit."""
    return Failure(_build_spring(), methods.midpoint, dt, 1200, "stiffness", "Anchor", 0.0)


@failure
def semi_implicit_beyond_two(beyond: float = 1.01) -> Failure:
    """Semi-implicit Euler with ω dt just above 2: stable below, unstable beyond."""
    limit = 2 / OMEGA
    return Failure(_build_spring(), methods.semi_implicit_euler, beyond * limit, 1200, "stiffness", "Anchor", limit)


@failure
def rk4_beyond_two_root_two(beyond: float = 1.01) -> Failure:
    """Runge-Kutta 4 with ω dt just above 2√2, where it goes from losing energy to gaining it."""
    limit = 2 * np.sqrt(2.0) / OMEGA
    return Failure(_build_spring(), methods.rk4, beyond * limit, 1200, "stiffness", "Anchor", limit)


@failure
def euler_on_a_damped_spring(dt: float = 7e-3) -> Failure:
    """Explicit Euler with k = 15, b = 0.1, m = 1: the damping makes steps up to b/k = 6.67 ms stable, no longer ones."""
    return Failure(_build_spring(0.1), methods.euler, dt, 1200, "stiffness", "Anchor", 0.1 / 15)


@failure
def semi_implicit_on_a_damped_spring(dt: float = 0.515) -> Failure:
    """Semi-implicit Euler on the same spring: k dt² + 2b dt < 4 allows 509.8 ms, seventy times explicit Euler's step."""
    limit = (np.sqrt(0.1**2 + 4 * 15.0) - 0.1) / 15.0
    return Failure(_build_spring(0.1), methods.semi_implicit_euler, dt, 1200, "stiffness", "Anchor", limit)


@failure
def stiff_cloth(dt: float = 8e-3) -> Failure:
    """A cloth of 1000 N/m with 0.1 kg per node: undamped, 7 ms are stable under semi-implicit Euler, 8 ms are not."""
    return Failure(_build_cloth(None), methods.semi_implicit_euler, dt, 1200, "stiffness", "Springs", None)


@failure
def damped_cloth(dt: float = 4e-3) -> Failure:
    """The same cloth with damping, added to stabilise it: now the damping sets the limit, 2.2 ms."""
    return Failure(_build_cloth(10.0), methods.semi_implicit_euler, dt, 1200, "damping", "Springs", None)


@failure
def fast_drag(dt: float = 0.01, speed: float = 1000.0) -> Failure:
    """Quadratic drag on a fast light body: Euler's drag impulse in one step exceeds its momentum and reverses it."""
    drag = forces.QuadraticDrag(area=0.01, coefficient=0.5)
    scene = Scene(Particles(jnp.zeros(2), jnp.asarray([speed, 0.0])), mass=0.01, forces=(forces.Gravity(), drag))
    # F ∝ v²: the decay rate of small changes of speed is twice |F|/(m v), and Euler's limit 2 over that rate
    limit = 2 * 0.01 / (1.225 * 0.5 * 0.01 * speed)
    return Failure(scene, methods.euler, dt, 20, "damping", "QuadraticDrag", limit)


@failure
def close_approach(dt: float = 0.02) -> Failure:
    """An orbit of eccentricity 0.9: no stability limit is exceeded, but the close approach has only a few steps."""
    return Failure(kepler().scene, methods.verlet, dt, 1200, "resolution", "Gravitation", None)


@failure
def far_from_the_origin(metres: float = 1e7) -> Failure:
    """A ball in float32 ten thousand kilometres from the origin: each step is rounded away, and it does not move."""
    position, velocity = (jnp.asarray([number, 0.0], jnp.float32) for number in (metres, 1.0))
    return Failure(Scene(Particles(position, velocity)), methods.rk4, 0.01, 100, "rounding", "", None)


@failure
def blind_throw() -> Failure:
    """Adaptive Euler with an error estimate from velocities alone: a throw of 2 s under gravity ends 4.5 m off."""
    scene = Scene(Particles(jnp.zeros(2), jnp.asarray([3.0, 10.0])), forces=(forces.Gravity(),))
    blind = methods.adaptive(methods.euler, 1e-3, 1e-3, error="velocity")
    return Failure(scene, blind, 2.0, 1, "error measure", "", None)


@failure
def implicit_midpoint_on_a_swinging_rope(beyond: float = 100.0, newton: int = 20) -> Failure:
    """A stiff rope that swings, by the implicit midpoint rule at a hundred times verlet's step: its links shake it apart.

    The rule is stable on linear springs at any step, and damps none of their motion. Here links turn within a step, and
    pull where they no longer point. At 20 times verlet's step it keeps the energy.
    """
    rope, longest = _build_swinging_rope(11)
    method = methods.ImplicitMidpoint(newton=newton)
    return Failure(rope, method, beyond * longest, 300, "resolution", "Springs", None)


@failure
def tr_bdf2_linearised_once(beyond: float = 100.0, newton: int = 0) -> Failure:
    """A finer rope by TR-BDF2 with forces linearised once a stage: it damps, and yet gains energy where links turn.

    With the equations solved in full, `newton=20`, a swing keeps 99.9 % of its energy.
    """
    rope, longest = _build_swinging_rope(25)
    method = methods.TrBdf2(newton=newton)
    return Failure(rope, method, beyond * longest, 1200, "resolution", "Springs", None)


def _build_swinging_rope(nodes: int, stiffness: float = 1e6, angle: float = 0.3) -> tuple[Scene, float]:
    """A rope of 1 m and 1 kg, taut by its weight and let go at an angle [rad], and verlet's longest stable step [s]."""
    rope = lattices.rope((0.0, 0.0), (0.0, -1.0), nodes, mass=1.0, stiffness=stiffness)
    carried = 9.8 * np.cumsum(np.asarray(rope.mass)[:0:-1])[::-1]
    along = np.append(0.0, np.cumsum(np.asarray(rope.springs.rest_length) + carried / stiffness))
    start = jnp.asarray(along[:, None] * np.array([np.sin(angle), -np.cos(angle)]))
    scene = Scene(
        Particles(start, jnp.zeros_like(start)),
        mass=rope.mass,
        forces=(forces.Gravity(), rope.springs),
        pinned=rope.nodes["start"],
    )
    # neighbours move against each other at ω = 2√(k/m)
    return scene, float(np.sqrt(1 / (nodes - 1) / stiffness))


def _build_spring(drag: float | None = None) -> Scene:
    parts = () if drag is None else (forces.StokesDrag(drag),)
    return Scene(
        Particles(jnp.ones(1), jnp.zeros(1)), forces=(forces.Anchor(point=jnp.zeros(1), stiffness=15.0), *parts)
    )


def _build_cloth(damping: float | None) -> Scene:
    stiff = {"structural": 1e3, "shear": 1e3, "bend": 1e3, "damping": damping}
    sheet = lattices.cloth(0.4, 0.4, 5, 5, mass=2.5, down=(0, 0, 1), **stiff)
    pinned = sheet.nodes["top"] & sheet.nodes["corners"]
    return Scene(sheet.state, mass=0.1, forces=(forces.Gravity(), sheet.springs), pinned=pinned)
