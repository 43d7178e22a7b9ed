"""Game physics in JAX: describe a scene once, run it under any method, batch it, differentiate it."""

from importlib import import_module
from typing import TYPE_CHECKING

from physjax.physics import forces
from physjax.pins import Pins
from physjax.scene import Contact, Field, Force, Particles, Scene, loads
from physjax.stepping import methods
from physjax.stepping.reference import ode_term, reference
from physjax.stepping.simulate import simulate
from physjax.trajectory import Trajectory

if TYPE_CHECKING:
    from physjax import scenes
    from physjax.physics import contacts, inertia, lattices, rigid, springs
    from physjax.physics.inertia import Inertia
    from physjax.physics.rigid import RigidBodies
    from physjax.show import animate, plot
    from physjax.study import accuracy, energy, projectile, stability

__all__ = [
    "Contact",
    "Field",
    "Force",
    "Inertia",
    "Particles",
    "Pins",
    "RigidBodies",
    "Scene",
    "Trajectory",
    "accuracy",
    "animate",
    "contacts",
    "energy",
    "forces",
    "inertia",
    "lattices",
    "loads",
    "methods",
    "ode_term",
    "plot",
    "projectile",
    "reference",
    "rigid",
    "scenes",
    "simulate",
    "springs",
    "stability",
]
__version__ = "0.1.0"

# loaded when first named: what not every run needs should not make `import physjax` slower
_LATER = {
    "accuracy": "physjax.study.accuracy",
    "animate": "physjax.show.animate",
    "contacts": "physjax.physics.contacts",
    "energy": "physjax.study.energy",
    "inertia": "physjax.physics.inertia",
    "lattices": "physjax.physics.lattices",
    "plot": "physjax.show.plot",
    "projectile": "physjax.study.projectile",
    "rigid": "physjax.physics.rigid",
    "scenes": "physjax.scenes",
    "springs": "physjax.physics.springs",
    "stability": "physjax.study.stability",
}


_PARTS = {"Inertia": "inertia", "RigidBodies": "rigid"}


def __getattr__(name: str) -> object:
    if name in _LATER:
        return import_module(_LATER[name])
    if name in _PARTS:
        return getattr(import_module(_LATER[_PARTS[name]]), name)
    raise AttributeError(f"module 'physjax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
