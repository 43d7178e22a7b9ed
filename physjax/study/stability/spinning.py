"""How far bodies in space may spin in a step: beyond, a method gives them energy until it is some other motion.

Free bodies whose moments differ do not spin steadily: what they spin about moves within them. Methods that drift take their
free rotation as turns about one axis after another, which resonate where one drift makes half a turn; others follow the
rate of a quaternion, and lose or gain a little in every step. What a method bears is measured on two bodies, a needle that
spins about its axis and a plate that tumbles.
"""

from collections.abc import Callable
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

from physjax.physics import inertia, rigid
from physjax.scene import Scene
from physjax.stepping.simulate import simulate

TRIED_ANGLES = np.geomspace(0.1, 12.8, 43)
"""Turns in a step that are tried [rad]: a method that cannot take the first has no stable step."""
TRIED_STEPS = 4000
"""Steps of each run: as many as a minute at 60 Hz has, or more."""
MAX_ENERGY_CHANGE = 0.1
"""Share of the energy of a free body that may come or go in these."""
TRIED_SIZES = np.array([[2.0, 0.0173, 0.0173], [1.0, 0.02, 0.6]])
"""Edges of the needle and of the plate [m]."""
TRIED_SPINS = np.array([[300.0, 20.0, 5.0], [40.0, 60.0, 30.0]])
"""Their angular velocities in the body's frame [rad/s]."""


def find_fastest_spin(state: rigid.RigidBodies, mass: inertia.Inertia) -> np.ndarray:
    """The fastest that bodies get to spin as they turn freely [rad/s].

    With xᵢ = ℓᵢ², Σ xᵢ = L² and Σ xᵢ/Iᵢ = 2E, |ω|² = Σ xᵢ/Iᵢ² is largest where one of the three is zero.
    """
    spin = rigid.angular_velocity(state, mass)
    square = np.sum(np.asarray(state.angular_momentum, float) ** 2, axis=-1)
    energy = np.sum(np.asarray(spin * state.angular_momentum, float), axis=-1)
    inverse = np.broadcast_to(np.asarray(1 / mass.principal, float), (*state.lanes, 3))
    fastest = np.sum(np.asarray(spin, float) ** 2, axis=-1)
    for i, j in ((0, 1), (0, 2), (1, 2)):
        a, b = inverse[..., i], inverse[..., j]
        differ = np.abs(a - b) > 1e-9 * (a + b)
        x = np.where(differ, (energy - b * square) / np.where(differ, a - b, 1.0), -1.0)
        there = (x >= 0) & (x <= square)
        fastest = np.maximum(fastest, np.where(there, a * a * x + b * b * (square - x), 0.0))
    return np.sqrt(fastest)


@cache
def measure_spin_limit(method: Callable) -> float:
    """The largest turn of a free body in a step [rad] up to which its energy stays within a tenth; 0 if there is none."""
    shape = (len(TRIED_ANGLES), len(TRIED_SIZES))
    boxes = inertia.box(1.0, jnp.broadcast_to(TRIED_SIZES, (*shape, 3)))
    spins = np.broadcast_to(TRIED_SPINS, (*shape, 3))
    state = rigid.bodies(boxes, jnp.zeros((*shape, 3)), angular_velocity=spins, frame="body")
    dt = TRIED_ANGLES[:, None] / find_fastest_spin(state, boxes)
    run = simulate(Scene(state, boxes), method, dt=jnp.asarray(dt), steps=TRIED_STEPS, save_every=TRIED_STEPS // 200)
    energy = np.asarray(jax.vmap(lambda state: state.kinetic_energy(boxes))(run.state), float)
    kept = (np.abs(energy / energy[0] - 1) <= MAX_ENERGY_CHANGE).all(axis=(0, 2))
    if kept.all():
        return np.inf
    return float(TRIED_ANGLES[np.argmin(kept) - 1]) if kept[0] else 0.0


__all__ = ["find_fastest_spin", "measure_spin_limit"]
