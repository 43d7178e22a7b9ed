"""Scenes to be changed while they are watched: an engine in plain Python, and pages and widgets around it.

`physjax.explore` is the way in.
"""

from physjax.live.engine import Engine
from physjax.live.explorer import Explorer, explore

__all__ = ["Engine", "Explorer", "explore"]


def __dir__() -> list[str]:
    return __all__
