"""Loads on particles: what pulls, pushes, brakes and carries them.

`laws` are formulas of place and velocity, `weight` is gravity near the ground and the lift of fluids, `gravitation` acts
between all pairs, `time_dependent` follows the clock, and `flows` are media that carry particles along.
"""

from physjax.physics.forces.gravitation import Gravitation
from physjax.physics.forces.laws import (
    Anchor,
    Blast,
    Magnus,
    QuadraticDrag,
    RotatingFrame,
    SphereDrag,
    StokesDrag,
    independent,
)
from physjax.physics.forces.time_dependent import Constant, Control, Kick
from physjax.physics.forces.weight import Buoyancy, Gravity
from physjax.scene import loads

__all__ = [
    "Anchor",
    "Blast",
    "Buoyancy",
    "Constant",
    "Control",
    "Gravitation",
    "Gravity",
    "Kick",
    "Magnus",
    "QuadraticDrag",
    "RotatingFrame",
    "SphereDrag",
    "StokesDrag",
    "independent",
    "loads",
]


def __dir__() -> list[str]:
    return __all__
