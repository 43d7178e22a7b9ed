"""Game physics in JAX: describe a scene once, run it under any method, batch it, differentiate it."""

from physjax.physics import contacts, forces
from physjax.scene import Contact, Field, Force, Particles, Scene, loads
from physjax.show import plot
from physjax.stepping import methods
from physjax.stepping.reference import ode_term, reference
from physjax.stepping.simulate import simulate
from physjax.study import accuracy, energy, projectile
from physjax.trajectory import Trajectory

__all__ = [
    "Contact",
    "Field",
    "Force",
    "Particles",
    "Scene",
    "Trajectory",
    "accuracy",
    "contacts",
    "energy",
    "forces",
    "loads",
    "methods",
    "ode_term",
    "plot",
    "projectile",
    "reference",
    "simulate",
]
__version__ = "0.1.0"
