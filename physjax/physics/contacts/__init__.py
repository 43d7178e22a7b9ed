"""Contact surfaces, and how contacts of particles with them are resolved.

A surface (`surface`, `shapes`) is a signed distance with restitution and friction. Its response is `project`, at the end
of a step, or `impact`, at the time of impact:

- `time_of_impact` flies a step leg by leg (`legs`), from one event (`events`, `path_search`) to the next;
- `impact_response` is what an event makes of a lane: `restitution` and friction, coming to rest, the end of a slide;
- `contact_mode` decides at the start of a leg which surfaces carry a lane, and `resting` has their reactions.

`segments` are contacts of edges and faces; `face` says what all this needs of a surface.
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
