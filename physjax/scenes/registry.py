"""The registry of scenes and failures, filled by their decorators from any file of this folder."""

import functools
import inspect
from collections.abc import Callable
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np

from physjax.compiling import announce_compiling
from physjax.scenes.parameters import demand_sensible
from physjax.study.problem import Problem

if TYPE_CHECKING:
    from physjax.scenes.failures import Failure  # which imports this file

SCENES: dict[str, Callable[..., Problem]] = {}
"""Every scene by name: a function that builds its `Problem`, in float64 under `jax.enable_x64`, else in float32."""
FAILURES: dict[str, Callable[..., "Failure"]] = {}
"""Every run that must fail, by name: a function that builds its `Failure`."""


def scene(build: Callable[..., Problem]) -> Callable[..., Problem]:
    """Register a function that builds a problem under its own name; the first line of its docstring is its title.

    The problem bears that name, which is shown while it compiles. Numbers that make no sense are refused by name and unit.

    Example:
        >>> @scenes.scene
        ... def drop():
        ...     '''A ball that falls.'''
        >>> scenes.title("drop"), scenes.SCENES.pop("drop") is drop
        ('A ball that falls.', True)
    """

    @functools.wraps(build)
    def build_named(*arguments: Any, **numbers: Any) -> Problem:
        demand_sensible(build, arguments, numbers)
        with announce_compiling(build.__name__):
            return build(*arguments, **numbers)._replace(name=build.__name__)

    SCENES[build.__name__] = build_named
    return build_named


def failure(build: Callable[..., "Failure"]) -> Callable[..., "Failure"]:
    """Register a function that builds a failure, in the same way.

    Example:
        >>> @scenes.failure
        ... def blow_up():
        ...     '''A ball that becomes NaN.'''
        >>> scenes.title("blow_up"), scenes.FAILURES.pop("blow_up") is blow_up
        ('A ball that becomes NaN.', True)
    """
    FAILURES[build.__name__] = build
    return build


def title(name: str) -> str:
    """The title of a scene or a failure: the first line of its docstring.

    Example:
        >>> scenes.title("projectile")
        'A ball thrown in a vacuum: the parabola that every second-order method follows exactly.'
    """
    return (inspect.getdoc((SCENES | FAILURES)[name]) or "").partition("\n")[0]


def read_table(file: str) -> dict[str, np.ndarray]:
    """A CSV file of measured data that is part of the package, as arrays by column."""
    path = resources.files("physjax.scenes") / "data" / file
    with path.open(encoding="utf-8") as lines:
        rows = np.genfromtxt(lines, delimiter=",", names=True, dtype=None, encoding="utf-8")
    return {name: rows[name] for name in rows.dtype.names or ()}


__all__ = ["FAILURES", "SCENES", "failure", "read_table", "scene", "title"]


def __dir__() -> list[str]:
    return __all__
