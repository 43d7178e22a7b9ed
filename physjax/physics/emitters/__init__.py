"""Particles that are born and die: the emitter, the sources they are born from, and their appearance over their life.

An emitter creates particles at a rate or in bursts. Births depend on the random key alone, not on the step, the batch, or
where a run was resumed. Particles of an emitter do not interact, smoke is drawn as a density and not simulated as one, and
`energy.ledger` does not follow births and deaths.
"""

from physjax.name_hints import hint_at_names
from physjax.physics.emitters.appearance import Appearance, Look
from physjax.physics.emitters.births import Birth
from physjax.physics.emitters.emitter import Emitter
from physjax.physics.emitters.shapes import Box, Disc, Mesh, Point, Source, Sphere

__all__ = ["Appearance", "Birth", "Box", "Disc", "Emitter", "Look", "Mesh", "Point", "Source", "Sphere"]


def __dir__() -> list[str]:
    return __all__


hint_at_names(__name__)
