"""The old name of `physjax.physics.forces.flows`."""

from physjax.physics.forces.flows import *  # noqa: F403
from physjax.physics.forces.flows import __all__ as __all__


def __dir__() -> list[str]:
    return __all__
