"""Energy, momentum and angular momentum of a scene: what its physics conserves, and so what a method should."""

from physjax.study.energy.quantities import (
    ANGULAR_MOMENTUM,
    ENERGY,
    MOMENTUM,
    Conserved,
    angular_momentum,
    kinetic,
    ledger,
    momentum,
    potential,
    summed,
    total,
)

__all__ = [
    "ANGULAR_MOMENTUM",
    "ENERGY",
    "MOMENTUM",
    "Conserved",
    "angular_momentum",
    "kinetic",
    "ledger",
    "momentum",
    "potential",
    "summed",
    "total",
]


def __dir__() -> list[str]:
    return __all__
