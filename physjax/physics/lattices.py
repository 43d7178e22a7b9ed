"""The old name of `physjax.physics.springs.lattices`."""

from physjax.physics.springs.lattices import *  # noqa: F403
from physjax.physics.springs.lattices import __all__ as __all__


def __dir__() -> list[str]:
    return __all__
