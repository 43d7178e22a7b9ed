"""Surfaces that nothing may pass, and how a contact with them is resolved.

`shapes` are signed distances, `restitution` is what an impact does to a velocity, `time_of_impact` resolves a contact in its
moment, `resting` what stays in contact, and `segments` where edges and faces come nearest.
"""

from physjax.physics.contacts.restitution import Coulomb
from physjax.physics.contacts.segments import Corners, Nearest, nearest_on_segment, respond_segment, touching_corners
from physjax.physics.contacts.shapes import Plane, Room, Slab, Sphere
from physjax.physics.contacts.surface import Surface
from physjax.physics.contacts.time_of_impact import impact
from physjax.scene import project

__all__ = [
    "Corners",
    "Coulomb",
    "Nearest",
    "Plane",
    "Room",
    "Slab",
    "Sphere",
    "Surface",
    "impact",
    "nearest_on_segment",
    "project",
    "respond_segment",
    "touching_corners",
]


def __dir__() -> list[str]:
    return __all__
