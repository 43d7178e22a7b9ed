"""The registry of scenes: a scene enters it by its decorator, wherever in this folder it stands."""

from collections.abc import Callable
from importlib import resources

import numpy as np

from physjax.study.problem import Problem

SCENES: dict[str, Callable[..., Problem]] = {}
"""Every scene by name: a function that builds its `Problem`, in the float type of the moment (`jax.enable_x64`)."""


FAILURES: dict[str, Callable] = {}
"""Every run that must fail, by name: a function that builds its `Failure`."""


def scene(build: Callable[..., Problem]) -> Callable[..., Problem]:
    """Enter a function that builds a problem in the gallery, under its own name; the first line of its docstring describes it.

    Example:
        >>> @scenes.scene
        ... def drop():
        ...     '''A ball that falls.'''
        >>> scenes.title("drop"), scenes.SCENES.pop("drop") is drop
        ('A ball that falls.', True)
    """
    SCENES[build.__name__] = build
    return build


def failure(build: Callable) -> Callable:
    """Enter a function that builds a failure, in the same way.

    Example:
        >>> @scenes.failure
        ... def lost():
        ...     '''A ball that is lost.'''
        >>> scenes.title("lost"), scenes.FAILURES.pop("lost") is lost
        ('A ball that is lost.', True)
    """
    FAILURES[build.__name__] = build
    return build


def title(name: str) -> str:
    """One line about a scene or a failure.

    Example:
        >>> scenes.title("projectile")
        'A ball thrown in a vacuum: the parabola that every second-order method follows exactly.'
    """
    return (SCENES | FAILURES)[name].__doc__.strip().splitlines()[0]


def read_table(file: str) -> dict[str, np.ndarray]:
    """A CSV file of measurements that is shipped with the package, column by column."""
    path = resources.files("physjax.scenes") / "data" / file
    with path.open(encoding="utf-8") as lines:
        rows = np.genfromtxt(lines, delimiter=",", names=True, dtype=None, encoding="utf-8")
    return {name: rows[name] for name in rows.dtype.names}


__all__ = ["FAILURES", "SCENES", "failure", "read_table", "scene", "title"]


def __dir__() -> list[str]:
    return __all__
