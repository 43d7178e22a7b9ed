"""Short tracebacks: what a user reads of a mistake is their own lines and the sentence that says what is wrong.

A mistake is found a dozen calls below the line that made it: in the checks of a part, inside of Equinox or of a trace by JAX.
At the public constructors and functions those frames are dropped; `JAX_TRACEBACK_FILTERING=off` keeps them.
"""

import functools
import inspect
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import equinox as eqx
import jax

from physjax.name_hints import refuse_name, suggest_names

WRAPPER_PACKAGES = {"physjax", "contextlib", "functools", "equinox", "jaxtyping", "beartype"}
"""Packages whose frames are between a user's line and a check of ours."""
HIDDEN_PACKAGES = WRAPPER_PACKAGES | {"jax", "jaxlib", "diffrax", "optimistix", "lineax", "numpy"}
"""Packages whose frames say nothing about a mistake of the user."""
JAX_NOTE = "JAX has removed its internal frames"
"""A part of what JAX adds where it has shortened a traceback: it is shorter now."""
DECIDES = (
    "decides by a number that is not known yet (`if`, `while`, `and`, `max`).\n"
    "Write jnp.where(condition, a, b) in place of `if`, & in place of `and`, jnp.maximum in place of max."
)
"""What is wrong where Python branches on a traced value."""
ASKS = (
    "asks for a number that is not known yet: NumPy and math, float() and int() cannot be given traced ones.\n"
    "Write jnp.sin in place of np.sin and math.sin, and leave float() and int() out."
)
"""What is wrong where a traced value is made a number."""

P = ParamSpec("P")
R = TypeVar("R")


def explain_tracer_error(error: Exception) -> str | None:
    """What to write in place of what asked a traced value for its number; None where that is not what went wrong."""
    if isinstance(error, jax.errors.TracerBoolConversionError):
        return DECIDES
    if isinstance(error, jax.errors.TracerArrayConversionError | jax.errors.ConcretizationTypeError):
        return ASKS
    return None


def shorten_tracebacks(function: Callable[P, R]) -> Callable[P, R]:
    """The function, whose errors are raised with the frames of the user alone."""

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return function(*args, **kwargs)
        except Exception as error:
            short = _shorten(error)
            if short is None:
                raise
            _add_signature(short, args[0] if args and isinstance(args[0], ShortModule) else function)
        raise short from short.__cause__  # JAX_TRACEBACK_FILTERING=off shows where

    return call


def _shorten(error: Exception) -> Exception | None:
    """The error with its frames of the user, or in its place one that says what to write; None where all is to be seen."""
    if jax.config.jax_traceback_filtering == "off":  # pyright: ignore[reportAttributeAccessIssue]  it is made at run time
        return None
    frames = _list_user_frames(error.__traceback__)
    words = explain_tracer_error(error)
    if words is not None and frames:
        code = frames[-1].tb_frame.f_code
        where = f"{code.co_name} ({Path(code.co_filename).name}, line {frames[-1].tb_lineno})"
        return TypeError(f"{where} {words}").with_traceback(_join(frames))
    if notes := getattr(error, "__notes__", None):
        notes[:] = [note for note in notes if JAX_NOTE not in note]
    if not _ends_in_user_code(error.__traceback__):  # our sentence says all
        error.__cause__ = None
    return error.with_traceback(_join(frames))


def _add_signature(error: Exception, called: Any) -> None:
    """Say what a function takes, or a module is built from, where it was called with something else."""
    name = f"{called.__name__}.__init__()" if isinstance(called, type) else f"{called.__name__}()"
    words = str(error)
    if isinstance(error, TypeError) and words.startswith((f"{name} got an unexpected", f"{name} missing")):
        taken = inspect.signature(called).parameters.values()
        shown = (p.name if p.default is p.empty else f"{p.name}=" for p in taken)
        unknown = re.search(r"unexpected keyword argument '(\w+)'", words)
        hint = suggest_names(unknown[1], [p.name for p in taken]) if unknown else ""
        words = words.partition(". Did you mean")[0]  # Python's own guess, from 3.13 on, knows no synonyms
        error.args = (
            " ".join([f"{words}.", *([hint] if hint.startswith("Did") else []), f"It takes {', '.join(shown)}."]),
        )


def _list_user_frames(trace: TracebackType | None) -> list[TracebackType]:
    """The frames that are in no package of `HIDDEN_PACKAGES`, outermost first."""
    return [trace for trace in _walk(trace) if _is_user_code(trace)]


def _ends_in_user_code(trace: TracebackType | None) -> bool:
    frames = list(_walk(trace))
    return bool(frames) and _is_user_code(frames[-1])


def _walk(trace: TracebackType | None) -> Iterator[TracebackType]:
    while trace is not None:
        yield trace
        trace = trace.tb_next


def _is_user_code(trace: TracebackType) -> bool:
    return trace.tb_frame.f_globals.get("__name__", "").partition(".")[0] not in HIDDEN_PACKAGES


def _join(frames: list[TracebackType]) -> TracebackType | None:
    joined = None
    for frame in reversed(frames):
        joined = TracebackType(joined, frame.tb_frame, frame.tb_lasti, frame.tb_lineno)
    return joined


if TYPE_CHECKING:
    from equinox import Module

    ShortModule = type
else:
    Base = type(eqx.Module)

    class ShortModule(Base):
        """The type of modules whose construction fails with a short traceback, and that know what a wrong name meant."""

        __call__ = shorten_tracebacks(Base.__call__)

        def __getattr__(cls, name):
            raise refuse_name(f"type object {cls.__name__!r}", name, lambda: dir(cls))

    class Module(eqx.Module, metaclass=ShortModule):
        """A module of Equinox whose construction fails with a short traceback."""


__all__ = ["WRAPPER_PACKAGES", "Module", "explain_tracer_error", "shorten_tracebacks"]
