"""Plain words for bad input: what was given, what was expected, what to do.

Values are looked at only where they are concrete. Inside `jit`, `vmap` and `grad` shapes and dtypes are still checked;
a bad value there becomes a status of the run (`Trajectory.ok`), never an exception.
"""

from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array


def concrete(value: Any) -> np.ndarray | None:
    """The value as a NumPy array, or None while it is being traced."""
    return None if isinstance(value, jax.core.Tracer) else np.asarray(jax.device_get(value))


def real_array(name: str, value: Any) -> Array:
    """`value` as a floating-point array; Python numbers stay weakly typed, integers become floats, else a TypeError."""
    with jax.transfer_guard_host_to_device("allow"):  # what a call is given goes to the device on purpose
        if isinstance(value, int | float) and not isinstance(value, bool):
            return jnp.asarray(float(value))
        try:
            array = jnp.asarray(value)
        except (TypeError, ValueError) as error:
            raise TypeError(f"{name}: got {_shown(value)}, expected real numbers or an array of them.") from error
    if jnp.issubdtype(array.dtype, jnp.integer):
        return array.astype(jnp.result_type(float))
    if not jnp.issubdtype(array.dtype, jnp.floating):
        raise TypeError(
            f"{name}: got dtype {array.dtype}, expected real floating-point numbers. Convert it first, e.g. with .real."
        )
    return array


def demand(name: str, array: Array, good: ArrayLike, expected: str) -> None:
    """Raise a ValueError naming the first offending entry unless all of `good` holds."""
    if np.all(good):
        return
    values = np.asarray(array)
    if values.ndim == 0:
        raise ValueError(f"{name}: got {values}, expected {expected}.")
    bad = np.argwhere(~np.asarray(good))
    first = tuple(int(i) for i in bad[0])
    where = first[0] if len(first) == 1 else first
    raise ValueError(
        f"{name}: got {values[first]} at index {where} ({len(bad)} of {values.size} entries are wrong), expected {expected}."
    )


def real_quantity(
    name: str, value: Any, *, above: int | float | None = None, at_least: int | float | None = None
) -> Array:
    """A finite real array, optionally bounded from below (`above`: strictly)."""
    array = real_array(name, value)
    values = concrete(array)
    if values is None:
        return array
    demand(name, array, np.isfinite(values), "finite numbers (no NaN or infinity)")
    if above is not None:
        demand(name, array, values > above, f"numbers > {above:g}")
    if at_least is not None:
        demand(name, array, values >= at_least, f"numbers >= {at_least:g}")
    return array


def demand_direction(name: str, vector: Array) -> None:
    """Raise a ValueError for a zero vector, which has none."""
    values = concrete(vector)
    if values is not None:
        demand(f"{name} [1]", vector, (values**2).sum(axis=-1, keepdims=True) > 0, "a vector that is not zero")


def quantity(
    name: str, unit: str, *, above: int | float | None = None, at_least: int | float | None = None, **options: Any
) -> Any:
    """A dataclass field for a physical number: an array leaf, checked when the module is built.

    Where the default is None, None means absent and passes through.
    """
    optional = options.get("default", 0.0) is None

    def convert(value):
        if value is None and optional:
            return None
        return real_quantity(f"{name} [{unit}]", value, above=above, at_least=at_least)

    return eqx.field(converter=convert, metadata={"unit": unit}, **options)


def positive_integer(name: str, value: Any, *, at_least: int = 1) -> int:
    """A Python int of at least `at_least`; a count is part of the program's shape and cannot be traced."""
    if isinstance(value, jax.core.Tracer):
        raise TypeError(
            f"{name}: got a traced value, expected a Python int: counts are shape. Pass it as a static argument."
        )
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise TypeError(f"{name}: got {_shown(value)}, expected an integer.")
    if value < at_least:
        raise ValueError(f"{name}: got {value}, expected at least {at_least}.")
    return int(value)


def known(kind: str, name: str, names: Iterable[str]) -> str:
    """`name` if it is one of `names`; otherwise a ValueError with the nearest ones."""
    names = sorted(names)
    if name in names:
        return name
    near = get_close_matches(name, names, n=3, cutoff=0.4)
    hint = f"Did you mean {' or '.join(near)}?" if near else f"Known: {', '.join(names)}."
    raise ValueError(f"unknown {kind} {name!r}. {hint}")


def _shown(value: Any) -> str:
    text = repr(value)
    return f"{type(value).__name__} {text if len(text) <= 60 else text[:57] + '...'}"


def demand_legal(contact: Any, state: Any) -> None:
    """Raise a ValueError naming the lanes that start on the wrong side of a contact by more than rounding."""
    gap = concrete(contact.clearance(jnp.zeros((), state.dtype), state))
    if gap is None:
        return
    rounding = 8 * float(jnp.finfo(state.dtype).eps) * float(np.abs(np.asarray(state.position)).max())
    if (gap < -rounding).any():
        lanes = np.argwhere(gap < -rounding)
        where = "it starts" if not gap.ndim else f"{len(lanes)} of {gap.size} lanes start, first {lanes[0].tolist()},"
        raise ValueError(
            f"{type(contact).__name__}: {where} on the wrong side, {-gap.min():.3g} m deep; expected gaps >= 0. "
            "Move them, or put them on the surface: state = contact.respond(0.0, state)."
        )
