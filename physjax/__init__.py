"""Game physics in JAX: describe a scene once, run it under any method, batch it, differentiate it.

Nouns are records (`Particles`, `Scene`, `Trajectory`), verbs are functions (`simulate`, `sweep`, `solve`), and the modules
are namespaces: `forces`, `contacts`, `methods`, `plot`, ... The README has the map of the package, two walks through it (dt,
and a force's value) and a glossary.

Every name has an example that runs after these lines: a shot, its flight, an oscillator, a flag, a tumbling brick, a
fountain.

Example:
    >>> import jax, jax.numpy as jnp, numpy as np
    >>> from physjax import *
    >>> _ = np.set_printoptions(precision=3, suppress=True)
    >>> ball = Particles(position=jnp.array([0.0, 10.0]), velocity=jnp.array([3.0, 4.0]))
    >>> shot = Scene(ball, mass=2.0, forces=(forces.Gravity(),))
    >>> flight = simulate(shot, methods.verlet, dt=0.1, steps=20)
    >>> spring = forces.Anchor(point=(0.0,), stiffness=4.0)
    >>> swing = Scene(Particles(jnp.array([1.0]), jnp.array([0.0])), mass=1.0, forces=(spring,))
    >>> sheet = lattices.cloth(1.0, 1.0, 3, 3, mass=0.9, structural=100.0)
    >>> flag = Scene(sheet.state, sheet.mass, (forces.Gravity(), sheet.springs), pinned=sheet.nodes["left"])
    >>> wave = simulate(flag, methods.verlet, dt=0.01, steps=10)
    >>> brick = inertia.box(12.0, (1.0, 2.0, 3.0))
    >>> body = rigid.bodies(brick, velocity=(1.0, 0.0, 0.0), angular_velocity=(0.0, 0.0, 2.0))
    >>> tumble = simulate(Scene(body, brick), methods.rk4, dt=0.1, steps=10)
    >>> nozzle = emitters.Disc((0.0, 0.0), normal=(0.0, 1.0), radius=0.1)
    >>> fountain = emitters.Emitter(8, nozzle, key=0, life=1.0, speed=5.0, rate=4.0)
    >>> spray = Scene(fountain.unborn(), forces=(forces.Gravity(),), emitter=fountain)
    >>> jet = simulate(spray, methods.verlet, dt=0.1, steps=10)
"""

from importlib import import_module
from typing import TYPE_CHECKING

from physjax import physics, stepping
from physjax.checks import quantity
from physjax.compiling import cache
from physjax.particles import Particles
from physjax.parts import Contact, Field, Force
from physjax.physics import forces
from physjax.pins import Pins
from physjax.scene import Scene, loads
from physjax.stepping import methods
from physjax.stepping.reference import ode_term, reference
from physjax.stepping.simulate import simulate, state_after
from physjax.trajectory import Trajectory

if TYPE_CHECKING:
    from physjax import projectile, scenes, show, study
    from physjax.constraints import constraint_forces
    from physjax.first_order import ode_scene
    from physjax.live import explore
    from physjax.physics import contacts, emitters, rigid, springs
    from physjax.physics.forces import flows as fields
    from physjax.physics.rigid import inertia
    from physjax.physics.rigid.inertia import Inertia
    from physjax.physics.rigid.planar import PlanarBodies
    from physjax.physics.rigid.spatial import RigidBodies
    from physjax.physics.springs import lattices
    from physjax.show import animate, export, plot
    from physjax.study import accuracy, energy, stability
    from physjax.study.inverse import gradients
    from physjax.study.inverse.aim import aim_at
    from physjax.study.inverse.fit import fit
    from physjax.study.inverse.solve import minimise, solve
    from physjax.study.sweeps.sweep import sweep

__all__ = [
    "Contact",
    "Field",
    "Force",
    "Inertia",
    "Particles",
    "Pins",
    "PlanarBodies",
    "RigidBodies",
    "Scene",
    "Trajectory",
    "accuracy",
    "aim_at",
    "animate",
    "cache",
    "constraint_forces",
    "contacts",
    "emitters",
    "energy",
    "explore",
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
    "ode_scene",
    "ode_term",
    "physics",
    "plot",
    "projectile",
    "quantity",
    "reference",
    "rigid",
    "scenes",
    "show",
    "simulate",
    "solve",
    "springs",
    "stability",
    "state_after",
    "stepping",
    "study",
    "sweep",
]
__version__ = "0.1.0"

# Where the names are that are loaded when they are first used: what not every run needs should not slow the import.
_LAZY = {
    "Inertia": "physjax.physics.rigid.inertia:Inertia",
    "PlanarBodies": "physjax.physics.rigid:PlanarBodies",
    "RigidBodies": "physjax.physics.rigid:RigidBodies",
    "accuracy": "physjax.study.accuracy",
    "aim_at": "physjax.study.inverse.aim:aim_at",
    "animate": "physjax.show.animate",
    "constraint_forces": "physjax.constraints:constraint_forces",
    "contacts": "physjax.physics.contacts",
    "emitters": "physjax.physics.emitters",
    "energy": "physjax.study.energy",
    "explore": "physjax.live:explore",
    "export": "physjax.show.export",
    "fields": "physjax.physics.forces.flows",
    "fit": "physjax.study.inverse.fit:fit",
    "gradients": "physjax.study.inverse.gradients",
    "inertia": "physjax.physics.rigid.inertia",
    "lattices": "physjax.physics.springs.lattices",
    "minimise": "physjax.study.inverse.solve:minimise",
    "ode_scene": "physjax.first_order:ode_scene",
    "plot": "physjax.show.plot",
    "projectile": "physjax.projectile",
    "rigid": "physjax.physics.rigid",
    "scenes": "physjax.scenes",
    "show": "physjax.show",
    "solve": "physjax.study.inverse.solve:solve",
    "springs": "physjax.physics.springs",
    "stability": "physjax.study.stability",
    "study": "physjax.study",
    "sweep": "physjax.study.sweeps.sweep:sweep",
}

# `__all__` is taken away once type checkers have read it, so that whoever asks for it comes to `__getattr__`: a star
# import, `help` and pdoc are about to name everything, and the last two look only at what the module already holds.
_PUBLIC = __all__
del __all__


def __getattr__(name: str) -> object:
    if name == "__all__":
        globals().update({lazy: __getattr__(lazy) for lazy in _LAZY}, __all__=_PUBLIC)
        return _PUBLIC
    if name in _LAZY:
        module, _, attribute = _LAZY[name].partition(":")
        found = import_module(module)
        return getattr(found, attribute) if attribute else found
    raise AttributeError(f"module 'physjax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return _PUBLIC
