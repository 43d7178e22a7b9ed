"""Contact surfaces, and how contacts of particles with them are resolved.

A surface (`surface`, `shapes`) is a signed distance with restitution and friction, and moves as its `motion` says. Its
response is `project`, at the end of a step, or `impact`, at the time of impact:

- `time_of_impact` flies a step leg by leg (`legs`), from one event (`events`, `path_search`) to the next;
- `impact_response` is what an event makes of a lane: `restitution` and friction, coming to rest, the end of a slide;
- `contact_mode` decides at the start of a leg which surfaces carry a lane, and `resting` has their reactions.

`segments` are contacts of edges and faces; `face` says what all this needs of a surface.
"""

from physjax.physics.contacts import segments, shapes
from physjax.physics.contacts.motion import Motion
from physjax.physics.contacts.restitution import Coulomb
from physjax.physics.contacts.segments import *  # noqa: F403
from physjax.physics.contacts.shapes import *  # noqa: F403
from physjax.physics.contacts.surface import Surface
from physjax.physics.contacts.time_of_impact import impact
from physjax.scene import project

# a new shape is written in `shapes`, with its name in the `__all__` there; no other file changes
__all__ = ["Coulomb", "Motion", "Surface", "impact", "project"]
__all__ += segments.__all__
__all__ += shapes.__all__


def __dir__() -> list[str]:
    return sorted(__all__)
