"""Springs between nodes; ropes, cloth, jelly and bridges are built of nothing else."""

from physjax.physics.springs.springs import Springs

__all__ = ["Springs"]


def __dir__() -> list[str]:
    return __all__
