"""The old name of `physjax.scenes.registry`."""

from physjax.scenes.registry import *  # noqa: F403
from physjax.scenes.registry import __all__ as __all__


def __dir__() -> list[str]:
    return __all__
