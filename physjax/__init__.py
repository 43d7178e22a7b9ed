"""Game physics in JAX: describe a scene once, run it under any method, batch it, differentiate it."""

from importlib import import_module
from typing import TYPE_CHECKING

from physjax.physics import forces
from physjax.pins import Pins
from physjax.scene import Contact, Field, Force, Particles, Scene, loads
from physjax.stepping import methods
from physjax.stepping.reference import ode_term, reference
from physjax.stepping.simulate import simulate, state_after
from physjax.trajectory import Trajectory

if TYPE_CHECKING:
    from physjax import scenes
    from physjax.physics import contacts, emitters, fields, inertia, lattices, rigid, springs
    from physjax.physics.inertia import Inertia
    from physjax.physics.rigid import RigidBodies
    from physjax.show import animate, export, plot
    from physjax.study import accuracy, energy, gradients, projectile, stability
    from physjax.study.aim import aim_at
    from physjax.study.fit import fit
    from physjax.study.solve import minimise, solve
    from physjax.study.sweep import sweep

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
    "aim_at",
    "animate",
    "contacts",
    "emitters",
    "energy",
    "export",
    "fields",
    "fit",
    "forces",
    "gradients",
    "inertia",
    "lattices",
    "loads",
    "methods",
    "minimise",
    "ode_term",
    "plot",
    "projectile",
    "reference",
    "rigid",
    "scenes",
    "simulate",
    "solve",
    "springs",
    "stability",
    "state_after",
    "sweep",
]
__version__ = "0.1.0"

# loaded when first named: what not every run needs should not make `import physjax` slower
_LATER = {
    "Inertia": "physjax.physics.inertia:Inertia",
    "RigidBodies": "physjax.physics.rigid:RigidBodies",
    "accuracy": "physjax.study.accuracy",
    "aim_at": "physjax.study.aim:aim_at",
    "animate": "physjax.show.animate",
    "contacts": "physjax.physics.contacts",
    "emitters": "physjax.physics.emitters",
    "energy": "physjax.study.energy",
    "export": "physjax.show.export",
    "fields": "physjax.physics.fields",
    "fit": "physjax.study.fit:fit",
    "gradients": "physjax.study.gradients",
    "inertia": "physjax.physics.inertia",
    "lattices": "physjax.physics.lattices",
    "minimise": "physjax.study.solve:minimise",
    "plot": "physjax.show.plot",
    "projectile": "physjax.study.projectile",
    "rigid": "physjax.physics.rigid",
    "scenes": "physjax.scenes",
    "solve": "physjax.study.solve:solve",
    "springs": "physjax.physics.springs",
    "stability": "physjax.study.stability",
    "sweep": "physjax.study.sweep:sweep",
}


def __getattr__(name: str) -> object:
    if name in _LATER:
        module, _, function = _LATER[name].partition(":")
        found = import_module(module)
        return getattr(found, function) if function else found
    raise AttributeError(f"module 'physjax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
