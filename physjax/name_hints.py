"""The right name in the error of a wrong one: words that others use for the same thing, and slips of the keyboard."""

import sys
from collections.abc import Callable, Iterable
from difflib import get_close_matches
from opcode import opname
from types import FrameType
from typing import NamedTuple, NoReturn

MAX_HINTS, MAX_LISTED = 3, 12
"""Names that are suggested at most; where none is near, all are listed unless they are more than the second."""
CLOSE_SHARE = 0.6
"""Of its letters that a slip must have in common with a name."""

WRAPPERS = {"physjax", "jaxtyping", "beartype"}
"""Packages whose frames are between who asks for a name and the error of it."""

SYNONYMS: dict[str, tuple[str, ...]] = {
    # shapes and what is touched
    "circle": ("disc", "planar_disc", "Disc", "sphere", "Sphere"),
    "disk": ("disc", "planar_disc", "Disc", "cylinder"),
    "ball": ("sphere", "disc", "Sphere", "planar_disc", "Balls"),
    "disc": ("planar_disc", "sphere", "Sphere"),
    "cylinder": ("capsule", "hull"),
    "cube": ("box", "Box", "Room"),
    "cuboid": ("box", "Box", "Room"),
    "brick": ("box",),
    "block": ("box",),
    "square": ("box", "planar_plate"),
    "rectangle": ("box", "planar_plate"),
    "pill": ("capsule", "planar_capsule"),
    "stick": ("capsule", "rod", "Rods"),
    "line": ("planar_segment", "capsule", "rod"),
    "triangle": ("polygon", "planar_polygon"),
    "convexhull": ("hull", "polygon", "Hull"),
    "mesh": ("hull", "from_mesh"),
    "floor": ("Plane",),
    "ground": ("Plane",),
    "wall": ("Plane", "Room"),
    "halfspace": ("Plane",),
    "bowl": ("Sphere",),
    "container": ("Room",),
    "box": ("Room",),
    "friction": ("Coulomb",),
    "bounce": ("impact",),
    "collision": ("impact", "contacts"),
    # forces
    "weight": ("Gravity",),
    "nbody": ("Gravitation",),
    "attraction": ("Gravitation",),
    "drag": ("QuadraticDrag", "SphereDrag", "StokesDrag"),
    "airresistance": ("QuadraticDrag", "SphereDrag"),
    "lineardrag": ("StokesDrag",),
    "viscosity": ("StokesDrag",),
    "damping": ("StokesDrag",),
    "damper": ("StokesDrag", "Springs"),
    "wind": ("QuadraticDrag", "InAir"),
    "lift": ("Magnus", "SpinLift"),
    "spring": ("Springs", "Anchor", "springs"),
    "hooke": ("Springs", "Anchor"),
    "harmonic": ("Anchor",),
    "magnetic": ("Lorentz",),
    "electric": ("Lorentz",),
    "coriolis": ("RotatingFrame",),
    "centrifugal": ("RotatingFrame",),
    "explosion": ("Blast",),
    "impulse": ("Kick",),
    "thrust": ("Rocket", "Control"),
    "motor": ("Hinges", "Control", "Torque"),
    "archimedes": ("Buoyancy",),
    "uniform": ("Constant",),
    # methods
    "rungekutta": ("rk4",),
    "rk2": ("midpoint", "heun"),
    "rk45": ("tsit5", "adaptive"),
    "ode45": ("tsit5", "adaptive"),
    "dopri5": ("tsit5",),
    "dop853": ("dopri8",),
    "expliciteuler": ("euler",),
    "forwardeuler": ("euler",),
    "symplecticeuler": ("semi_implicit_euler",),
    "eulercromer": ("semi_implicit_euler",),
    "backwardeuler": ("implicit_euler",),
    "velocityverlet": ("verlet",),
    "stormerverlet": ("verlet",),
    "trapezoid": ("implicit_midpoint", "tr_bdf2"),
    "bdf2": ("tr_bdf2",),
    "yoshida": ("blanes_moan4", "kahan_li8"),
    "nystrom": ("dprkn6",),
    # springs and joints
    "rod": ("Rods", "rod"),
    "string": ("Ropes", "rope"),
    "cable": ("Ropes", "rope"),
    "chain": ("rope", "Rods", "Joints"),
    "flag": ("cloth",),
    "fabric": ("cloth",),
    "sheet": ("cloth",),
    "plank": ("bridge",),
    "ropebridge": ("bridge",),
    "softbody": ("jelly",),
    "grid": ("cloth", "jelly"),
    "obj": ("from_mesh",),
    "revolute": ("Hinges",),
    "ballandsocket": ("Joints",),
    "prismatic": ("Sliders",),
    "fixed": ("Welds", "Pins"),
    "rigidbody": ("RigidBodies", "bodies"),
    "body": ("RigidBodies", "PlanarBodies", "bodies"),
    "collider": ("Solids", "PlanarContacts"),
    # what is done with a scene
    "run": ("simulate",),
    "integrate": ("simulate",),
    "odeint": ("simulate", "ode_scene"),
    "world": ("Scene",),
    "system": ("Scene", "ode_scene"),
    "integrator": ("methods",),
    "solver": ("methods", "solve"),
    "optimise": ("minimise", "fit"),
    "optimize": ("minimise", "fit"),
    "viewer": ("animate", "view"),
    "render": ("animate", "view"),
    "video": ("animate",),
    "movie": ("animate",),
    "visualise": ("plot", "animate", "view"),
    "visualize": ("plot", "animate", "view"),
    # arguments
    "timestep": ("dt",),
    "stepsize": ("dt",),
    "h": ("dt",),
    "tend": ("duration",),
    "tmax": ("duration",),
    "time": ("duration",),
    "nsteps": ("steps",),
    "masses": ("mass",),
    "pins": ("pinned",),
    "fixednodes": ("pinned",),
    "mu": ("friction", "coulomb"),
    "spin": ("SpinLift", "Magnus", "angular_velocity", "axis"),
    "omega": ("angular_velocity",),
    "cd": ("coefficient",),
    "cl": ("coefficient",),
    "rho": ("density",),
    "anchors": ("points",),
    "k": ("stiffness",),
    "bounciness": ("restitution",),
    "elasticity": ("restitution", "stiffness"),
    "resolution": ("rows", "panels"),
    "segments": ("panels", "rows"),
    "planks": ("panels",),
}
"""What others call it, in lower case without underscores, and names of ours: those that are there are suggested."""

NOTES = {"wind": "A cloth has a wind of its own: sheet.wind(velocity)."}
"""What else there is for such a word, as a sentence."""


class Hint(NamedTuple):
    """What is wrong with a name, and what was meant; found when it is read, since most wrong names are asked for in vain."""

    sentence: str
    name: str
    find_names: Callable[[], Iterable[str]]

    def __str__(self) -> str:
        words = suggest_names(self.name, self.find_names())
        return f"{self.sentence}. {words}" if words else self.sentence

    __repr__ = __str__


def suggest_names(name: str, names: Iterable[str]) -> str:
    """A sentence with those of `names` that were meant by another: by its meaning, then by its letters; else all, if few.

    A name may be dotted, `forces.Gravity`: its last part counts.
    """
    public = sorted((name for name in names if not name.startswith("_")), key=lambda name: (name.count("."), name))
    bare = {other: _strip(_take_last_part(other)) for other in public}
    asked = _strip(name)
    near = [other for other in public if bare[other].removesuffix("s") == asked.removesuffix("s")]
    for meant in (meant for word in (asked, asked.removesuffix("s")) for meant in SYNONYMS.get(word, ())):
        near += [other for other in public if _take_last_part(other) == meant]
    # the same name in another place, else a name of this place, else one of another place that means the same
    near = [o for o in near if _take_last_part(o) == name] or [o for o in near if "." not in o] or near
    if not near:
        close = get_close_matches(asked, bare.values(), n=MAX_HINTS, cutoff=CLOSE_SHARE)
        near = [other for word in close for other in public if bare[other] == word]
    # a class for a class, a function for a function
    near.sort(key=lambda other: _take_last_part(other)[0].isupper() != name[0].isupper())
    if near:
        hint = f"Did you mean {' or '.join(list(dict.fromkeys(near))[:MAX_HINTS])}?"
        return f"{hint} {NOTES[asked]}" if asked in NOTES else hint
    return f"It has {', '.join(public)}." if 0 < len(public) <= MAX_LISTED else ""


def refuse_name(owner: str, name: str, find_names: Callable[[], Iterable[str]]) -> AttributeError:
    """The error of a name that a module or a class does not have, with those that may have been meant."""
    sentence = f"{owner} has no attribute {name!r}"
    if name.startswith("_"):
        return AttributeError(sentence)
    # its own name and no object: or Python adds a guess of its own to the traceback
    return AttributeError(Hint(sentence, name, find_names), name=name, obj=None)


def refuse_module_name(module: str, name: str, find_names: Callable[[], Iterable[str]]) -> AttributeError | ImportError:
    """The error of a name that a module does not have, for the module's `__getattr__`.

    `from module import name` puts a sentence of its own in place of an AttributeError, but lets an ImportError pass.
    """
    if name.startswith("_") or not _is_import_from(_find_asker()):
        return refuse_name(f"module {module!r}", name, find_names)
    return ImportError(Hint(f"cannot import name {name!r} from {module!r}", name, find_names), name=module)


def _find_asker() -> FrameType | None:
    """The frame of who asked this package for a name, above those of checkers of types that wrap it."""
    frame = sys._getframe(1)
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] in WRAPPERS:
        frame = frame.f_back
    return frame


def _is_import_from(frame: FrameType | None) -> bool:
    return frame is not None and opname[frame.f_code.co_code[frame.f_lasti]] == "IMPORT_FROM"


def hint_at_names(module: str) -> None:
    """Let a module that is asked for what it does not have say what it has.

    Its `__getattr__` is set from outside: one that type checkers could see would let any name pass.
    """

    def refuse(name: str) -> NoReturn:
        raise refuse_module_name(module, name, sys.modules[module].__dir__)

    sys.modules[module].__getattr__ = refuse


def _take_last_part(name: str) -> str:
    return name.rpartition(".")[2]


def _strip(name: str) -> str:
    return name.replace("_", "").lower()


__all__ = ["SYNONYMS", "Hint", "hint_at_names", "refuse_module_name", "refuse_name", "suggest_names"]
