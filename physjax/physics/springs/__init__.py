"""Springs between nodes, of which ropes, cloth, jelly and bridges are built, and rods, which keep their length exactly."""

from physjax.physics.springs.rods import Rods
from physjax.physics.springs.springs import Springs

__all__ = ["Rods", "Springs"]


def __dir__() -> list[str]:
    return __all__
