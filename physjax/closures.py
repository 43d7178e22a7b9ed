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

import jax.numpy as jnp
from jax.core import Tracer

from physjax.backend import jit_is_disabled

WRAPPER_PACKAGES = {"physjax", "contextlib", "equinox", "jaxtyping", "beartype"}
"""Whose frames stand between a user's call and the place where it is judged."""
_last_compiled: WeakKeyDictionary[CodeType, Callable] = WeakKeyDictionary()
"""The function that was last compiled of each piece of code."""
_warned_codes: WeakKeyDictionary[CodeType, bool] = WeakKeyDictionary()
"""The code whose user knows."""


def warn_of_recompilation(who: str, functions: Iterable[Any]) -> None:
    """Warn, once for each, of a user's function whose code was compiled before as another function.

    Only where the call itself compiles: not inside of a user's `jit`, which is compiled once, nor under `disable_jit`.
    """
    found = [(function, code) for function in functions if (code := _find_code(function)) is not None]
    if not found or jit_is_disabled() or isinstance(jnp.zeros(()), Tracer):
        return
    for function, code in found:
        before = _last_compiled.get(code, function)
        _last_compiled[code] = function
        if before != function and code not in _warned_codes:
            _warned_codes[code] = True
            _warn_user(_format_warning(who, code))


def _format_warning(who: str, code: CodeType) -> str:
    return (
        f"{who}: the function {code.co_name} ({code.co_filename}:{code.co_firstlineno}) is not the one of the call before, "
        "though its code is the same: it is defined anew at each call, and each time the whole run is compiled anew, "
        "which can take hundreds of times as long as the run. Define it once, outside of the loop. If it closes over "
        "numbers that change, make these the array fields of a module: class Pull(equinox.Module): strength: jax.Array, "
        "with def __call__(self, t, state, mass). Pull(jnp.asarray(2.0)) then compiles once for all strengths."
    )


def _warn_user(words: str) -> None:
    """Warn at the line of the user's own that led here, past ours and what wraps it."""
    frame, depth = sys._getframe(), 1
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in WRAPPER_PACKAGES:
        frame, depth = frame.f_back, depth + 1
    warnings.warn(words, stacklevel=depth)


def _find_code(function: Any) -> CodeType | None:
    """The code of a user's function, however it is wrapped; None of the library's own, and of what is not made of code."""
    while isinstance(function, partial):
        function = function.func
    function = inspect.unwrap(function)
    ours = (getattr(function, "__module__", None) or "").startswith("physjax.")
    return None if ours else getattr(function, "__code__", None)
