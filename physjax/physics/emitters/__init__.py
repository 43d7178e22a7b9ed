"""Particles that are born and die: the emitter, the sources they are born from, and their appearance over their life."""

from physjax.physics.emitters.appearance import Appearance, Look
from physjax.physics.emitters.births import Birth
from physjax.physics.emitters.emitter import Emitter
from physjax.physics.emitters.shapes import Box, Disc, Mesh, Point, Source, Sphere

__all__ = ["Appearance", "Birth", "Box", "Disc", "Emitter", "Look", "Mesh", "Point", "Source", "Sphere"]


def __dir__() -> list[str]:
    return __all__
