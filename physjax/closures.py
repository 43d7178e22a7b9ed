"""Warnings of functions that are redefined at every call, so that the run recompiles each time; once for each of them.

JAX tells functions apart by identity: a lambda or a `def` inside a loop is another function in every iteration.
"""

import inspect
import sys
import warnings
from collections.abc import Iterable
from functools import partial
from types import CodeType
from weakref import WeakKeyDictionary

import jax.numpy as jnp
from jax.core import Tracer

from physjax.backend import jit_is_disabled
from physjax.tracebacks import WRAPPER_PACKAGES

_last_compiled: WeakKeyDictionary[CodeType, object] = WeakKeyDictionary()
"""The function that was last compiled from each code object."""
_warned_codes: WeakKeyDictionary[CodeType, bool] = WeakKeyDictionary()
"""The code objects that a warning has named."""


def warn_of_recompilation(who: str, functions: Iterable[object]) -> None:
    """Warn, once for each, of a user's function whose code was compiled before as another function.

    Only where the call itself compiles: not inside a user's `jit`, which is compiled once, nor under `disable_jit`.
    """
    found = [(function, code) for function in functions if (code := _find_code(function)) is not None]
    if not found or jit_is_disabled() or isinstance(jnp.zeros(()), Tracer):
        return  # within a `jit` even a constant is traced
    for function, code in found:
        before = _last_compiled.get(code, function)
        _last_compiled[code] = function
        if before != function and code not in _warned_codes:
            _warned_codes[code] = True
            _warn_user(_format_warning(who, code))


def _format_warning(who: str, code: CodeType) -> str:
    return (
        f"{who}: the function {code.co_name} ({code.co_filename}:{code.co_firstlineno}) is not the one of the call before, "
        "though its code is the same: it is redefined at each call, and each time the whole run recompiles, "
        "which can take hundreds of times as long as the run. Define it once, outside the loop. If it closes over "
        "numbers that change, make these the array fields of a module: class Pull(equinox.Module): strength: jax.Array, "
        "with def __call__(self, t, state, mass). Pull(jnp.asarray(2.0)) then compiles once for all strengths."
    )


def _warn_user(words: str) -> None:
    """Warn at the user's line that led here, past the library's frames and those of its wrappers."""
    frame, depth = sys._getframe(), 1
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in WRAPPER_PACKAGES:
        frame, depth = frame.f_back, depth + 1
    warnings.warn(words, stacklevel=depth)


def _find_code(function: object) -> CodeType | None:
    """The code object of a user's function, however it is wrapped; None for the library's own and for what has no code."""
    while isinstance(function, partial):
        function = function.func
    function = inspect.unwrap(function)  # pyright: ignore[reportArgumentType]  # anything without __wrapped__ comes back
    ours = (getattr(function, "__module__", None) or "").startswith("physjax.")
    return None if ours else getattr(function, "__code__", None)
