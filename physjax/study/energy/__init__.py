"""Energy, momentum and angular momentum of a scene: what its physics conserves, and so what a method should."""

from physjax.name_hints import hint_at_names
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


hint_at_names(__name__)
