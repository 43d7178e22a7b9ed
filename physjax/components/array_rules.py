"""What the operations on arrays are, component by component; each rule returns None where it does not apply.

A rule gets the equation and its operands, and gives its results. Where it gives none, the operation sees whole arrays.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from jax import lax
from jax.extend.core import JaxprEqn

from physjax.backend import BARRIER
from physjax.components.values import Value, from_array, from_even, from_parts, from_recipe

Results = list[Value] | None
MAX_STACKED_COMPONENTS = 16
"""The most components that a vector is put together from: more are a table."""
ELEMENTWISE = (
    "abs", "acos", "acosh", "add", "add_any", "and", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "ceil",
    "clamp", "clz", "convert_element_type", "copy", "copy_p", "cos", "cosh", "div", "eq", "erf", "erf_inv", "erfc",
    "exp", "exp2", "expm1", "floor", "ge", "gt", "integer_pow", "is_finite", "le", "lgamma", "log", "log1p", "log2",
    "logistic", "lt", "max", "min", "mul", "ne", "neg", "nextafter", "not", "or", "population_count", "pow",
    "reduce_precision", "rem", "round", "rsqrt", "select_n", "shift_left", "shift_right_arithmetic",
    "shift_right_logical", "sign", "sin", "sinh", "sqrt", "square", "stop_gradient", "sub", "tan", "tanh", "xor",
)  # fmt: skip
"""Arithmetic of which every entry of the result is that of the entries in the same place."""
REDUCTIONS = {
    "reduce_sum": lax.add,
    "reduce_prod": lax.mul,
    "reduce_max": lax.max,
    "reduce_min": lax.min,
    "reduce_and": lax.bitwise_and,
    "reduce_or": lax.bitwise_or,
}
SCANS = ("cumsum", "cumprod", "cummax", "cummin", "cumlogsumexp")
SCATTERS = ("scatter", "scatter-add", "scatter-mul", "scatter-min", "scatter-max")


def bind(eqn: JaxprEqn, *operands: Any, **changed: Any) -> Any:
    """The operation itself, with some of its parameters changed."""
    return eqn.primitive.bind(*operands, **{**eqn.params, **changed})


def result_shape(eqn: JaxprEqn) -> tuple[int, ...]:
    """The shape of what comes out."""
    return eqn.outvars[0].aval.shape  # pyright: ignore[reportAttributeAccessIssue]  # it is an array


def map_parts(value: Value, function: Callable[[Any], Any], shape: tuple[int, ...]) -> Results:
    """The same for every component of a vector, or for the one of an even array; None for other arrays."""
    if value.is_vector:
        return [from_parts([function(part) for part in value.parts()])]
    if value.is_even:
        return [from_even(shape, lambda: function(value.part(0)))]
    return None


def apply_elementwise(eqn: JaxprEqn, ins: list[Value]) -> Results:
    """Arithmetic: each component by itself. A scalar operand is for all of them, and so is one whose last axis has length 1."""
    shape = result_shape(eqn)
    shaped = [value for value in ins if value.shape]
    if not shape or any(len(value.shape) != len(shape) for value in shaped):
        return None

    def part(i: int) -> Any:
        return bind(eqn, *(value.part(i) if value.shape else value.whole() for value in ins))

    if all(value.is_even or value.size < shape[-1] for value in shaped):
        return [from_even(shape, lambda: part(0))]
    if any(value.is_vector and value.size == shape[-1] for value in shaped):
        return [from_parts([part(i) for i in range(shape[-1])])]
    if all(value.is_lazy for value in shaped):
        return [from_recipe(shape, lambda: bind(eqn, *(value.whole() for value in ins)), part)]
    return None


def apply_broadcast(eqn: JaxprEqn, ins: list[Value]) -> Results:
    """A new last axis makes an even array; what it is made of is broadcast where it is needed."""
    shape, dims = eqn.params["shape"], eqn.params["broadcast_dimensions"]
    if len(ins) > 1 or eqn.params.get("sharding") is not None or not shape:
        return None
    (x,) = ins
    spread = partial(lax.broadcast_in_dim, shape=shape[:-1])
    if not dims or dims[-1] != len(shape) - 1:
        return [from_even(shape, lambda: spread(x.whole(), broadcast_dimensions=dims))]
    part = lambda i: spread(x.part(i), broadcast_dimensions=dims[:-1])  # noqa: E731
    if x.is_even or x.size < shape[-1]:
        return [from_even(shape, lambda: part(0))]
    if x.is_vector:
        return [from_parts([part(i) for i in range(x.size)])]
    return [from_recipe(shape, lambda: bind(eqn, x.whole()), part)]


def apply_reshape(eqn: JaxprEqn, ins: list[Value]) -> Results:
    """Axes of lanes may be regrouped as long as the components stay the last axis; an axis of length 1 comes and goes."""
    (x, *sizes), shape = ins, eqn.params["new_sizes"]
    if sizes or eqn.params["dimensions"] is not None or eqn.params.get("sharding") is not None:
        return None
    if shape == (*x.shape, 1):
        return [from_even(shape, x.whole)]
    if x.is_plain or not x.shape:
        return None
    if shape and shape[-1] == x.size and np.prod(shape[:-1]) == np.prod(x.shape[:-1]):
        return map_parts(x, lambda part: lax.reshape(part, shape[:-1]), shape)
    return [from_array(lax.reshape(x.part(0), shape))] if x.size == 1 else None


def apply_squeeze(eqn: JaxprEqn, ins: list[Value]) -> Results:
    """The one component of an axis of length 1, or the same for all components."""
    (x,), dims = ins, eqn.params["dimensions"]
    if x.is_plain:
        return None
    lanes = tuple(axis for axis in dims if axis != len(x.shape) - 1)
    if len(lanes) < len(dims):
        return [from_array(lax.squeeze(x.part(0), lanes))]
    return map_parts(x, lambda part: lax.squeeze(part, lanes), result_shape(eqn))


def apply_slice(eqn: JaxprEqn, ins: list[Value]) -> Results:
    """Some components, and of each some lanes."""
    (x,), shape = ins, result_shape(eqn)
    if x.is_plain:
        return None
    starts, limits = eqn.params["start_indices"], eqn.params["limit_indices"]
    strides = eqn.params["strides"] or (1,) * len(starts)
    chosen = range(starts[-1], limits[-1], strides[-1])
    whole = limits[:-1] == x.shape[:-1] and not any(starts[:-1]) and all(stride == 1 for stride in strides[:-1])

    def part(i: int) -> Any:
        found = x.part(chosen[i])
        return found if whole else lax.slice(found, starts[:-1], limits[:-1], strides[:-1])

    if x.is_even:
        return [from_even(shape, lambda: part(0))]
    if x.is_vector:
        return [from_parts([part(i) for i in range(len(chosen))])] if len(chosen) else None
    return [from_recipe(shape, lambda: bind(eqn, x.whole()), part)]


def apply_concatenate(eqn: JaxprEqn, ins: list[Value]) -> Results:
    """Along the last axis components make a vector; along an axis of lanes each component is put together."""
    shape, axis = result_shape(eqn), eqn.params["dimension"]
    if axis < len(shape) - 1:
        join = lambda i: bind(eqn, *(value.part(i) for value in ins))  # noqa: E731
        if all(value.is_even for value in ins):
            return [from_even(shape, lambda: join(0))]
        return [from_parts([join(i) for i in range(shape[-1])])] if any(value.is_vector for value in ins) else None
    stacked = all(value.size == 1 and not value.is_plain for value in ins)
    if not (stacked or any(value.is_vector for value in ins)) or shape[-1] > MAX_STACKED_COMPONENTS:
        return None
    return [from_parts([value.part(i) for value in ins for i in range(value.size)])]


def apply_stack(eqn: JaxprEqn, ins: list[Value]) -> Results:
    """Numbers put next to each other make a vector; along an axis of lanes each component is put together."""
    shape, axis = result_shape(eqn), eqn.params["axis"]
    vector = any(value.is_vector for value in ins)
    if axis == len(shape) - 1:
        few = not vector and shape[-1] <= MAX_STACKED_COMPONENTS
        return [from_parts([value.whole() for value in ins])] if few else None
    if not vector:
        return None
    return [from_parts([bind(eqn, *(value.part(i) for value in ins)) for i in range(shape[-1])])]


def apply_to_several(eqn: JaxprEqn, ins: list[Value]) -> Results:
    """An array cut in several along an axis of lanes: so is each component."""
    (x,) = ins
    if not x.is_vector or eqn.params["axis"] == len(x.shape) - 1:
        return None
    cut = [bind(eqn, part) for part in x.parts()]
    return [from_parts(parts) for parts in zip(*cut, strict=True)]


def apply_tile(eqn: JaxprEqn, ins: list[Value]) -> Results:
    """Lanes repeated, those of each component."""
    (x,), times = ins, eqn.params["reps"]
    if not times or times[-1] != 1:
        return None
    return map_parts(x, lambda part: bind(eqn, part, reps=times[:-1]), result_shape(eqn))


def apply_pad(eqn: JaxprEqn, ins: list[Value]) -> Results:
    """Lanes before, after and between those of each component."""
    (x, filling), padding = ins, eqn.params["padding_config"]
    if not padding or padding[-1] != (0, 0, 0):
        return None
    pad = lambda part: bind(eqn, part, filling.whole(), padding_config=padding[:-1])  # noqa: E731
    return map_parts(x, pad, result_shape(eqn))


def apply_transpose(eqn: JaxprEqn, ins: list[Value]) -> Results:
    """Axes of lanes in another order."""
    (x,), order = ins, eqn.params["permutation"]
    if not order or order[-1] != len(order) - 1:
        return None
    return map_parts(x, lambda part: lax.transpose(part, order[:-1]), result_shape(eqn))


def apply_rev(eqn: JaxprEqn, ins: list[Value]) -> Results:
    """Lanes or components from the last to the first."""
    (x,), axes = ins, eqn.params["dimensions"]
    lanes = tuple(axis for axis in axes if axis != len(x.shape) - 1)
    found = map_parts(x, lambda part: lax.rev(part, lanes), x.shape)
    return [from_parts(found[0].parts()[::-1])] if found and x.is_vector and len(lanes) < len(axes) else found


def apply_reduction(eqn: JaxprEqn, ins: list[Value]) -> Results:
    """Over lanes each component by itself, over components from the first to the last."""
    (x,), axes = ins, eqn.params["axes"]
    lanes = tuple(axis for axis in axes if axis != len(x.shape) - 1)
    over = lambda part: bind(eqn, part, axes=lanes) if lanes else part  # noqa: E731
    if len(lanes) == len(axes):
        return map_parts(x, over, result_shape(eqn))
    if not x.is_vector:
        return None
    total, *others = x.parts()
    for part in others:
        total = REDUCTIONS[eqn.primitive.name](total, part)
    return [from_array(over(total))]


def apply_scan(eqn: JaxprEqn, ins: list[Value]) -> Results:
    """A running sum or extreme along lanes."""
    (x,) = ins
    if eqn.params["axis"] == len(x.shape) - 1:
        return None
    return map_parts(x, lambda part: bind(eqn, part), x.shape)


def apply_dynamic_slice(eqn: JaxprEqn, ins: list[Value]) -> Results:
    """Some lanes of each component."""
    (x, *starts), sizes = ins, eqn.params["slice_sizes"]
    if len(starts) != len(x.shape) or not sizes or sizes[-1] != x.size:
        return None
    first = [start.whole() for start in starts[:-1]]
    return map_parts(x, lambda part: lax.dynamic_slice(part, first, sizes[:-1]), result_shape(eqn))


def apply_dynamic_update_slice(eqn: JaxprEqn, ins: list[Value]) -> Results:
    """Some lanes of each component replaced."""
    x, update, *starts = ins
    if len(starts) != len(x.shape) or not x.shape or update.size != x.size or not (x.is_vector or update.is_vector):
        return None
    first = [start.whole() for start in starts[:-1]]
    return [from_parts([lax.dynamic_update_slice(x.part(i), update.part(i), first) for i in range(x.size)])]


def apply_gather(eqn: JaxprEqn, ins: list[Value]) -> Results:
    """The same lanes picked of each component."""
    (x, index), numbers, sizes = ins, eqn.params["dimension_numbers"], eqn.params["slice_sizes"]
    last, out = len(x.shape) - 1, result_shape(eqn)
    picked = (*numbers.collapsed_slice_dims, *numbers.start_index_map, *numbers.operand_batching_dims)
    if not sizes or sizes[-1] != x.size or last in picked or numbers.offset_dims[-1:] != (len(out) - 1,):
        return None
    numbers = numbers._replace(offset_dims=numbers.offset_dims[:-1])
    pick = lambda part: bind(eqn, part, index.whole(), dimension_numbers=numbers, slice_sizes=sizes[:-1])  # noqa: E731
    return map_parts(x, pick, out)


def apply_scatter(eqn: JaxprEqn, ins: list[Value]) -> Results:
    """The same lanes written in each component."""
    (x, index, update), numbers = ins, eqn.params["dimension_numbers"]
    last = len(x.shape) - 1
    written = (*numbers.inserted_window_dims, *numbers.scatter_dims_to_operand_dims, *numbers.operand_batching_dims)
    if not (x.is_vector or update.is_vector) or last in written or not update.shape or update.size != x.size:
        return None
    if numbers.update_window_dims[-1:] != (len(update.shape) - 1,):
        return None
    numbers = numbers._replace(update_window_dims=numbers.update_window_dims[:-1])
    write = lambda i: bind(eqn, x.part(i), index.whole(), update.part(i), dimension_numbers=numbers)  # noqa: E731
    return [from_parts([write(i) for i in range(x.size)])]


def apply_dot(eqn: JaxprEqn, ins: list[Value]) -> Results:
    """A matrix times vectors: each component by itself, where the components are a free axis and stay the last."""
    a, b = ins
    (_, contracted), (_, batch) = eqn.params["dimension_numbers"]
    if not b.is_vector or len(b.shape) - 1 in (*contracted, *batch) or eqn.params.get("out_sharding") is not None:
        return None
    return [from_parts([bind(eqn, a.whole(), part) for part in b.parts()])]


def apply_barrier(eqn: JaxprEqn, ins: list[Value]) -> Results:
    """One barrier for all components of all arrays."""
    groups = [v.parts() if v.is_vector else [v.part(0) if v.is_even else v.whole()] for v in ins]
    through = iter(bind(eqn, *(part for group in groups for part in group)))
    after = [[next(through) for _ in group] for group in groups]
    return [_restore_kind(value, group) for value, group in zip(ins, after, strict=True)]


def _restore_kind(value: Value, parts: list) -> Value:
    """What has become of a value of which these parts were passed through."""
    if value.is_vector:
        return from_parts(parts)
    return from_even(value.shape, lambda: parts[0]) if value.is_even else from_array(parts[0])


ARRAY_RULES: dict[str, Callable[[JaxprEqn, list[Value]], Results]] = {
    **dict.fromkeys(ELEMENTWISE, apply_elementwise),
    **dict.fromkeys(REDUCTIONS, apply_reduction),
    **dict.fromkeys(SCANS, apply_scan),
    **dict.fromkeys(SCATTERS, apply_scatter),
    "broadcast_in_dim": apply_broadcast,
    "reshape": apply_reshape,
    "squeeze": apply_squeeze,
    "slice": apply_slice,
    "concatenate": apply_concatenate,
    "stack": apply_stack,
    "split": apply_to_several,
    "unstack": apply_to_several,
    "tile": apply_tile,
    "pad": apply_pad,
    "transpose": apply_transpose,
    "rev": apply_rev,
    "dynamic_slice": apply_dynamic_slice,
    "dynamic_update_slice": apply_dynamic_update_slice,
    "gather": apply_gather,
    "dot_general": apply_dot,
    BARRIER: apply_barrier,
}
"""The rule for each primitive by its name."""
