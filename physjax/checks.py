"""Checks of input, with errors in plain words: what was given, what was expected, what to do.

Values are checked only where they are concrete. Inside `jit`, `vmap` and `grad` shapes and dtypes are still checked; a
bad value there shows in the status of the run (`Trajectory.ok`) and never raises an exception.
"""

from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

NestedArrayLike = ArrayLike | Sequence[ArrayLike] | Sequence[Sequence[ArrayLike]]
"""Numbers as users give them: a number, an array, or lists of them."""


def concrete_or_none(value: object) -> np.ndarray | None:
    """The value as a NumPy array, or None while it is being traced."""
    if isinstance(value, Tracer):
        return None
    # device_get is an explicit transfer, which a transfer guard lets through
    return np.asarray(jax.device_get(value) if isinstance(value, jax.Array) else value)


def as_real_array(name: str, value: object) -> Array:
    """`value` as a floating-point array: Python numbers stay weakly typed, integers become floats, all else is a TypeError."""
    with jax.transfer_guard_host_to_device("allow"):  # arguments of a call are transferred on purpose
        if isinstance(value, int | float) and not isinstance(value, bool):
            return jnp.asarray(float(value))
        try:
            array = jnp.asarray(value)  # pyright: ignore[reportArgumentType, reportCallIssue]  # raises for what is none
        except (TypeError, ValueError) as error:
            raise TypeError(
                f"{name}: got {_describe_value(value)}, expected real numbers or an array of them."
            ) from error
    if jnp.issubdtype(array.dtype, jnp.integer):
        return array.astype(jnp.result_type(float))
    if not jnp.issubdtype(array.dtype, jnp.floating):
        raise TypeError(
            f"{name}: got dtype {array.dtype}, expected real floating-point numbers. Convert it first, e.g. with .real."
        )
    return array


def demand_all(name: str, array: Array | np.ndarray, good: ArrayLike, expected: str) -> None:
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


def as_real_quantity(
    name: str,
    value: object,
    *,
    above: int | float | None = None,
    at_least: int | float | None = None,
    at_most: int | float | None = None,
) -> Array:
    """A finite real array, optionally bounded from below (`above`: strictly) and from above."""
    array = as_real_array(name, value)
    values = concrete_or_none(array)
    if values is None:
        return array
    demand_all(name, array, np.isfinite(values), "finite numbers (no NaN or infinity)")
    if above is not None:
        demand_all(name, array, values > above, f"numbers > {above:g}")
    if at_least is not None and at_most is not None:
        demand_all(name, array, (values >= at_least) & (values <= at_most), f"numbers from {at_least:g} to {at_most:g}")
    elif at_least is not None:
        demand_all(name, array, values >= at_least, f"numbers >= {at_least:g}")
    elif at_most is not None:
        demand_all(name, array, values <= at_most, f"numbers <= {at_most:g}")
    return array


def as_real_argument(name: str, value: object, dtype: np.dtype, *, above: float) -> Array | np.ndarray:
    """A finite real array of a type, for a compiled call: on the host where it was given there.

    To look at a number that is on a GPU, and to convert it there, takes longer than a short run.
    """
    if isinstance(value, int | float | np.ndarray | np.generic) and np.asarray(value).dtype.kind in "iuf":
        array = np.asarray(value)
        demand_all(name, array, np.isfinite(array), "finite numbers (no NaN or infinity)")
        demand_all(name, array, array > above, f"numbers > {above:g}")
        return array.astype(dtype)
    return as_real_quantity(name, value, above=above).astype(dtype)


def demand_direction(name: str, vector: Array) -> None:
    """Raise a ValueError for a zero vector, which has no direction."""
    values = concrete_or_none(vector)
    if values is not None:
        demand_all(f"{name} [1]", vector, (values**2).sum(axis=-1, keepdims=True) > 0, "a vector that is not zero")


VECTOR_KINDS = ("vector", "place", "corner")
"""Kinds with one component for each dimension of space."""
KINDS = ("number", *VECTOR_KINDS, "axial", "rotation", "tensor")
ENTRY_AXIS_COUNT = {"lane": 0, "table": 1, "point": 1, "joint": 1, "spring": 2, "memory": 0, None: 0}
"""Number of axes that a quantity has after those of the lanes and before those of its kind."""


class Quantity(NamedTuple):
    """What a field of a part of a scene is: its name and unit, its kind of number, what there is one of it for, its bounds.

    `kind`: a "number", a "vector", a "place", a "corner" (a place of which each component bounds its own axis alone), an
    "axial" vector (a number in the plane), a "rotation" (a quaternion) or a "tensor" `(dim, dim)`.
    `per`: one for all lanes or one per "lane"; a "table" of any length, one for all lanes or one per lane; one per
    "point", "joint" or "spring"; "memory" of what each lane did in a run; None is shared by all lanes, whatever its shape.
    """

    name: str
    unit: str
    kind: str = "number"
    per: str | None = "lane"
    above: int | float | None = None
    at_least: int | float | None = None
    at_most: int | float | None = None

    def axes(self, dim: int) -> tuple[int, ...]:
        """The axes of its kind, in a space of `dim` dimensions."""
        if self.kind in VECTOR_KINDS:
            return (dim,)
        if self.kind == "tensor":
            return (dim, dim)
        if self.kind == "rotation":
            return (4,)
        return (3,) if self.kind == "axial" and dim == 3 else ()

    def within_bounds(self, value: Array) -> Array:
        """Which entries are finite and within the bounds, also of a traced value."""
        good = jnp.isfinite(value)
        if self.above is not None:
            good = good & (value > self.above)
        if self.at_least is not None:
            good = good & (value >= self.at_least)
        if self.at_most is not None:
            good = good & (value <= self.at_most)
        return good


if TYPE_CHECKING:
    # To a type checker these are descriptors: a field is given numbers of any kind, and read as the array that `quantity`
    # has converted them to. Checkers know of `converter=` only where it is written in the class itself. They are arrays
    # as well, because a record that is unpacked (`position, velocity = state`) does not go through the descriptor.

    class Numbers(Array):
        """The annotation of a field made with `quantity`: any numbers are given, an array is read."""

        def __get__(self, instance: object, owner: type | None = None) -> Array: ...
        def __set__(self, instance: object, value: NestedArrayLike) -> None: ...

    class OptionalNumbers:
        """The same where None means absent."""

        def __get__(self, instance: object, owner: type | None = None) -> Array | None: ...
        def __set__(self, instance: object, value: NestedArrayLike | None) -> None: ...

    Vectors = Numbers
else:
    Numbers = Float[Array, "..."]
    OptionalNumbers = Float[Array, "..."] | None
    Vectors = Float[Array, "*lanes dim"]


def quantity(
    name: str,
    unit: str,
    *,
    kind: str = "number",
    per: str | None = "lane",
    above: int | float | None = None,
    at_least: int | float | None = None,
    at_most: int | float | None = None,
    **options: Any,
) -> Any:
    """A field of a force, contact or path for a physical number: an array that can be swept and differentiated.

    It declares what it is (`kind`, `per`: see `Quantity`), so that a scene can check it against its lanes: per lane, a number
    is () or has the shape of the lanes, a vector is (dim,) or (*lanes, dim). Bounds are checked when the module is built;
    a traced number out of bounds makes its lanes NaN. Where the default is None, None means absent and passes through.

    Example:
        >>> class Engine(Force):
        ...     thrust: jax.Array = quantity("thrust", "N", at_least=0)
        ...     gears: jax.Array = quantity("gear ratios", "1", per="table")
        ...     def __call__(self, t, state, mass):
        ...         return self.thrust * self.gears[0] * state.velocity
        >>> print(Engine(2.0, [0.5, 1.2])(0.0, ball, shot.mass))
        [3. 4.]
    """
    optional = options.get("default", 0.0) is None
    bounds = {"above": above, "at_least": at_least, "at_most": at_most}

    def convert(value):
        if value is None and optional:
            return None
        return as_real_quantity(f"{name} [{unit}]", value, **bounds)

    return eqx.field(converter=convert, metadata=_build_metadata(Quantity(name, unit, kind, per, **bounds)), **options)


def unchecked_quantity(
    name: str,
    unit: str = "1",
    *,
    kind: str = "number",
    per: str | None = "lane",
    above: int | float | None = None,
    at_least: int | float | None = None,
    **options: Any,
) -> Any:
    """A field that is declared as `quantity` declares it, and neither converted nor checked when the module is built."""
    return eqx.field(metadata=_build_metadata(Quantity(name, unit, kind, per, above, at_least)), **options)


def _build_metadata(quantity: Quantity) -> dict[str, Any]:
    if quantity.kind not in KINDS or quantity.per not in ENTRY_AXIS_COUNT:
        raise ValueError(
            f"{quantity.name}: got kind={quantity.kind!r} and per={quantity.per!r}, expected a kind of {KINDS} and "
            f"per one of {tuple(ENTRY_AXIS_COUNT)}."
        )
    return {"unit": quantity.unit, "quantity": quantity}


def as_positive_integer(name: str, value: object, *, at_least: int = 1) -> int:
    """A Python int of at least `at_least`; a count decides the shapes of the compiled program and cannot be traced."""
    if isinstance(value, Tracer):
        raise TypeError(
            f"{name}: got a traced value, expected a Python int: counts are shape. Pass it as a static argument."
        )
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise TypeError(f"{name}: got {_describe_value(value)}, expected an integer.")
    if value < at_least:
        raise ValueError(f"{name}: got {value}, expected at least {at_least}.")
    return int(value)


def demand_known(kind: str, name: str, names: Iterable[str]) -> str:
    """`name` if it is one of `names`; otherwise a ValueError that suggests the nearest ones."""
    names = sorted(names)
    if name in names:
        return name
    near = get_close_matches(name, names, n=3, cutoff=0.4)
    hint = f"Did you mean {' or '.join(near)}?" if near else f"Known: {', '.join(names)}."
    raise ValueError(f"unknown {kind} {name!r}. {hint}")


def _describe_value(value: object) -> str:
    text = repr(value)
    return f"{type(value).__name__} {text if len(text) <= 60 else text[:57] + '...'}"


def starts_outside(contact: PyTree, state: PyTree) -> Array:
    """Which lanes start on the legal side of a contact, within rounding."""
    signed_distance = contact.clearance(jnp.zeros((), state.dtype), state)
    position = jnp.where(jnp.isfinite(state.position), jnp.abs(state.position), 0.0)
    # the distance is a difference of coordinates, whose rounding is relative to the largest of them
    return signed_distance >= -8 * float(jnp.finfo(state.dtype).eps) * jnp.max(position)


def demand_start_outside(contact: PyTree, state: PyTree) -> None:
    """Raise a ValueError naming the lanes that start on the wrong side of a contact by more than rounding."""
    legal = concrete_or_none(starts_outside(contact, state))
    if legal is None or legal.all():
        return
    signed_distance = np.asarray(contact.clearance(jnp.zeros((), state.dtype), state))
    lanes = np.argwhere(~legal)
    where = (
        "it starts"
        if not signed_distance.ndim
        else f"{len(lanes)} of {signed_distance.size} lanes start, first {lanes[0].tolist()},"
    )
    raise ValueError(
        f"{type(contact).__name__}: {where} on the wrong side, {-signed_distance.min():.3g} m deep; expected gaps >= 0. "
        "Move them, or put them on the surface: state = contact.respond(0.0, state)."
    )
