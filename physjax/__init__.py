"""Game physics in JAX: describe a scene once, run it under any method, batch it, differentiate it.

Nouns are records (`Particles`, `Scene`, `Trajectory`), verbs are functions (`simulate`, `sweep`, `solve`), and the modules
are namespaces: `forces`, `contacts`, `methods`, `plot`, ...

# Where to find what

- Describe a scene: `Particles`, `Scene`; the newtons of each of its forces at a moment: `loads`. Nodes that follow a
  prescribed path: `Pins`.
- Run it: `simulate`, with a method of `physjax.stepping.methods`; through diffrax: `reference`; our right-hand side under
  diffrax's own solvers: `ode_term`.
- Forces: `physjax.physics.forces`; velocity fields of the air: `fields`; a force of your own: subclass `Force`.
- Contacts and friction: `physjax.physics.contacts`. Springs, ropes, cloth and jelly: `physjax.physics.springs`, `lattices`.
- Rigid bodies in space and in the plane, their contacts and joints: `physjax.physics.rigid`, `inertia`.
- Particles that are born and die: `physjax.physics.emitters`.
- Read a run: `flight[-1]`, `flight.at(t)`, `flight.energy()`, `flight.to_xarray()`, and `Trajectory.crossing`: when, where and
  how fast it first crosses a height or a surface, with derivatives.
- Ask about it: `accuracy` (work-precision, the best method for an error, ablation), `stability` (the largest stable step, why a
  run diverged), `energy` (where the energy went), `gradients` (how far a derivative can be trusted).
- Ask backwards: `aim_at`, `solve`, `minimise`, `fit`. Over many parameters: `sweep`; to sweep dt: `state_after`.
- Look at it: `plot`, `animate`, `explore`; hand it to Blender or a game engine: `export`. Closed forms: `projectile`.
- The gallery: `scenes`. Compiled programs kept between sessions: `cache`. The command line: `physjax --help`.

# Arrays and units

Shapes are `(*lanes, dim)`, component last. A number of a force or contact has shape `()` or the lanes' shape, so a parameter
sweep is an array in place of a number; a vector is `(dim,)` or `(*lanes, dim)`. Any other shape is refused when the scene is
built. SI units, y up; with `forces.Gravity(up=2)` up is z, and aiming, heights, plots and pages follow (`scene.up`). The
dtype is that of the state: float32 unless `jax.config.update("jax_enable_x64", True)`.

Changing dt or any physical number recompiles nothing. A function that is defined again at each call does, with a warning:
define it once, or use a module whose fields are arrays. A number out of bounds (a mass <= 0, a restitution of 1.5, a start
below the floor) raises before anything is compiled; inside `jit`, `vmap` or a sweep it makes its own lane NaN. A run that
diverges does not raise: `flight.ok` and `flight.first_bad_step` say which lane and when, and its neighbours are untouched.
Under `jax.disable_jit()` a force sees numbers, so that `print` shows them.

# Glossary

- **lane**: one of many particles, bodies or nodes; an entry of the leading axes. **Coupled** lanes exert forces on each
  other and share step size and status (`Scene.couples`); **held** or **pinned** ones are moved by no force (`Scene.held`).
- **field**: a force proportional to mass, given as an acceleration (`Field`). **Potential**: the potential energy of a
  conservative force (`Force.potential`). **Memory**: arrays besides the state that a step changes (`Scene.changing`).
- **stage**: a named part of a step: move, resolve contacts, prescribe, advance memory (`Scene.stages`).
- **signed distance**: distance to a surface, positive on the legal side [m]. **Contact response**: when and how contacts are
  resolved. **Time of impact**: when, inside a step, a lane reaches a surface. **Leg**: the part of a step between contact events.
- **restitution**: K_r, the share of the normal speed that an impact returns. **Friction**: K_f, the share of the tangential
  velocity that an impact takes, or Coulomb's law. **Contact mode**: free, at rest, sticking or sliding.
- **order**: the global error falls as dt to this power. **Stability limit**: the largest stable ω·dt of a method, or the
  largest stable dt of a scene. **Evaluations**: force evaluations per step. All three are in `method.promises`.
- **work-precision**: run time against error, one curve per method. **Reference solution**: what errors are measured against:
  a closed form, diffrax at 1e-12, or finer steps. **Ablation**: a run with one part of the model left out.
- **status**: whether a lane stayed finite, and the first step at which it did not (`Trajectory.ok`).

# How the package is built

Folders carry the names of the public namespaces, and imports point down only: `cli`, `live`, `scenes` (the gallery), `study`
(what you ask of a scene), `show` (what you look at), then `physics` and `stepping` next to each other, then the nouns
(`scene.py`, `trajectory.py`, `particles.py`, ...), then `kernels` and `components` (a step rewritten for a GPU), then the ground.
Physics does not know how it is stepped; stepping does not know what acts. State and results are `NamedTuple`s; a scene, a
force, a contact is an `equinox.Module`; everything else is a function. `backend.py` and `xla_options.py` alone know what the
compiler needs on each device. `physjax.stepping` follows dt through a step, `physjax.physics` follows the value of a force.

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

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING

from physjax import physics, stepping
from physjax.checks import quantity
from physjax.compiling import cache
from physjax.name_hints import refuse_module_name
from physjax.particles import Particles
from physjax.parts import Contact, Field, Force
from physjax.physics import forces
from physjax.pins import Pins
from physjax.scene import Scene, loads
from physjax.stepping import methods
from physjax.stepping.reference import ode_term, reference
from physjax.stepping.simulate import simulate, state_after
from physjax.trajectory import Trajectory
from physjax.xla_options import ask_for_loop_emitter

ask_for_loop_emitter()

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

# Folders of modules, whose names are public elsewhere.
_FOLDERS = ("physics", "show", "stepping", "study")

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
    raise refuse_module_name(__name__, name, _list_names_with_places)


def __dir__() -> list[str]:
    return _PUBLIC


def _list_names_with_places() -> list[str]:
    """The public names, and those of the namespaces of functions and parts as `forces.Gravity`; it loads them all."""
    spaces = {name: getattr(sys.modules[__name__], name) for name in _PUBLIC}
    spaces = {name: space for name, space in spaces.items() if isinstance(space, ModuleType) and name not in _FOLDERS}
    return _PUBLIC + [f"{name}.{part}" for name, space in spaces.items() for part in dir(space)]
