"""The old name of `physjax.meshes`."""

from physjax.meshes import *  # noqa: F403
from physjax.meshes import __all__ as __all__


def __dir__() -> list[str]:
    return __all__
