"""Functions that are made anew at every call, each of which is compiled anew: said once, with the way out.

JAX knows a function by its identity. A lambda or a `def` inside of a loop is another function at every turn, and the run
is compiled for each of them.
"""

import inspect
import sys
import warnings
from collections.abc import Callable, Iterable
from functools import partial
from types import CodeType
from typing import Any
from weakref import WeakKeyDictionary

import jax
import jax.numpy as jnp

WRAPPERS = {"physjax", "contextlib", "equinox", "jaxtyping", "beartype"}
"""Whose frames stand between a user's call and the place where it is judged."""
_latest: WeakKeyDictionary[CodeType, Callable] = WeakKeyDictionary()
"""The function that was last compiled of each piece of code."""
_told: WeakKeyDictionary[CodeType, bool] = WeakKeyDictionary()
"""The code whose user knows."""


def warn_of_remade(who: str, functions: Iterable[Any]) -> None:
    """Warn, once for each, of a user's function whose code was compiled before as another function.

    Only where the call itself compiles: not inside of a user's `jit`, which is compiled once, nor under `disable_jit`.
    """
    found = [(function, code) for function in functions if (code := _code_of(function)) is not None]
    if not found or jax.config.jax_disable_jit or isinstance(jnp.zeros(()), jax.core.Tracer):
        return
    for function, code in found:
        before = _latest.get(code, function)
        _latest[code] = function
        if before != function and code not in _told:
            _told[code] = True
            _tell_user(_words(who, code))


def _words(who: str, code: CodeType) -> str:
    return (
        f"{who}: the function {code.co_name} ({code.co_filename}:{code.co_firstlineno}) is not the one of the call before, "
        "though its code is the same: it is defined anew at each call, and each time the whole run is compiled anew, "
        "which can take hundreds of times as long as the run. Define it once, outside of the loop. If it closes over "
        "numbers that change, make these the array fields of a module: class Pull(equinox.Module): strength: jax.Array, "
        "with def __call__(self, t, state, mass). Pull(jnp.asarray(2.0)) then compiles once for all strengths."
    )


def _tell_user(words: str) -> None:
    """Warn at the line of the user's own that led here, past ours and what wraps it."""
    frame, depth = sys._getframe(), 1
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in WRAPPERS:
        frame, depth = frame.f_back, depth + 1
    warnings.warn(words, stacklevel=depth)


def _code_of(function: Any) -> CodeType | None:
    """The code of a user's function, however it is wrapped; None of the library's own, and of what is not made of code."""
    while isinstance(function, partial):
        function = function.func
    function = inspect.unwrap(function)
    ours = (getattr(function, "__module__", None) or "").startswith("physjax.")
    return None if ours else getattr(function, "__code__", None)
