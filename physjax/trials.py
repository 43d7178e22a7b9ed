"""A force of the user is tried once while its scene is built: what is wrong with it is said there, in a few lines.

It is traced and not compiled, a millisecond or two; a function that was tried with states of the same shapes is not tried again.
"""

import inspect
from collections.abc import Callable, Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from physjax.backend import jit_is_disabled
from physjax.particles import callable_name
from physjax.parts import Function, holds_user_code
from physjax.tracebacks import explain_tracer_error

MAX_REMEMBERED_TRIALS = 4096
"""Trials that are remembered; then all are forgotten."""
EXAMPLE = "A force is (t, state, mass) -> newtons, e.g. def drag(t, state, mass): return -0.1 * state.velocity"
"""What a force looks like, for messages."""
_tried: set[tuple] = set()


def find_faulty_force(state: PyTree, mass: PyTree, forces: Iterable[Callable]) -> str | None:
    """The name of the first force that cannot be evaluated, or has another shape, and what it must be; None where all work.

    Errors that are its own, such as a name that is not defined, are raised as they are. Not where `jit` is disabled, so
    that a debugger meets real numbers alone.
    """
    faults = (_try_force(state, mass, force) for force in forces if not jit_is_disabled() and holds_user_code(force))
    return next(filter(None, faults), None)


def _try_force(state: PyTree, mass: PyTree, force: Callable) -> str | None:
    key = _describe_structure((force, state, mass))
    if key in _tried:
        return None
    fault = _find_fault(state, mass, force)
    if fault is not None:
        return f"force {callable_name(force)}: {fault}\n{EXAMPLE}"
    if len(_tried) >= MAX_REMEMBERED_TRIALS:
        _tried.clear()
    _tried.add(key)
    return None


def _describe_structure(tree: PyTree) -> tuple:
    arrays, structure = jax.tree.flatten(eqx.filter(tree, eqx.is_array_like))
    return structure, tuple((jnp.shape(array), jnp.result_type(array)) for array in arrays)


def _find_fault(state: PyTree, mass: PyTree, force: Callable) -> str | None:
    """What is wrong with a force; None where nothing is."""
    fault = find_wrong_arguments(force, 3, "the three arguments (t, state, mass)")
    if fault is not None:
        return fault
    try:
        time = jax.ShapeDtypeStruct((), state.dtype)
        jax.eval_shape(lambda t, state, mass: state.evaluate_load(force, t, mass), time, state, mass)
    except (jax.errors.TracerArrayConversionError, jax.errors.ConcretizationTypeError) as error:
        return explain_tracer_error(error)
    except TypeError as error:
        text = str(error)
        if not text.startswith("force "):
            raise
        return text.partition(": ")[2]
    return None


def find_wrong_arguments(part: Callable, count: int, expected: str) -> str | None:
    """What a function of the user takes, where that is not `count` arguments, and what is expected; None where it is."""
    function = part.function if isinstance(part, Function) else part
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # made in C: it has none
        return None
    try:
        signature.bind(*(None,) * count)
    except TypeError:
        return f"takes {signature}, expected {expected}."
    return None


__all__ = ["find_faulty_force", "find_wrong_arguments"]
