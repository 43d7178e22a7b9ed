"""Springs between nodes, of which ropes, cloth, jelly and bridges are built, and rods and ropes of exact length."""

from physjax.physics.springs.rods import Rods, Ropes
from physjax.physics.springs.springs import Springs

__all__ = ["Rods", "Ropes", "Springs"]


def __dir__() -> list[str]:
    return __all__
