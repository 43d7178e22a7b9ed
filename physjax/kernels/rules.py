"""What each operation does, number by number: arithmetic is written out, and what only moves numbers costs nothing."""

from collections.abc import Callable, Sequence
from functools import partial, reduce
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import JaxprEqn

from physjax.backend import BARRIER
from physjax.components.array_rules import ELEMENTWISE, REDUCTIONS
from physjax.kernels.numbers import (
    Numbers,
    UnsupportedError,
    bind_operation,
    combine,
    evaluate,
    from_known,
    from_list,
    is_known,
    list_entries,
    select,
    to_array,
)
from physjax.programs import describe_value

Rule = Callable[[JaxprEqn, list[Numbers]], list[Numbers]]
MAX_CHOICES = 64
"""The most places between which an index that differs from lane to lane chooses: each costs a selection."""
RUNNING = {"cumsum": lax.add, "cumprod": lax.mul, "cummax": lax.max, "cummin": lax.min}


def apply_elementwise(eqn: JaxprEqn, ins: list[Numbers]) -> list[Numbers]:
    """Arithmetic; the same on the same numbers is done once."""
    shape, done = describe_value(eqn.outvars[0]).shape, {}
    operands = [np.broadcast_to(a, shape) for a in ins]

    def compute(place: tuple[int, ...]) -> Any:
        numbers = [a[place] for a in operands]
        key = tuple(map(id, numbers))
        if key not in done:
            known = all(map(is_known, numbers))
            done[key] = evaluate(eqn, *numbers)[0][()] if known else combine(partial(bind_operation, eqn), *numbers)
        return done[key]

    return [from_list([compute(place) for place in np.ndindex(shape)], shape)]


def apply_reduced_precision(eqn: JaxprEqn, ins: list[Numbers]) -> list[Numbers]:
    """Rounding to fewer digits, by the bits, since no kernel has an operation for it."""
    (x,), digits = ins, jnp.finfo(describe_value(eqn.invars[0]).dtype)
    if eqn.params["exponent_bits"] != digits.nexp:
        raise UnsupportedError("a smaller exponent")
    dropped, whole = digits.nmant - eqn.params["mantissa_bits"], np.dtype(f"int{digits.bits}")

    def round_bits(number: Any) -> Any:
        bits = lax.bitcast_convert_type(number, whole)
        even = (bits >> dropped) & 1
        rounded = (bits + even + ((1 << (dropped - 1)) - 1)) & ~((1 << dropped) - 1)
        finite = jnp.abs(number) < jnp.inf
        return jnp.where(finite, lax.bitcast_convert_type(rounded, number.dtype), number)

    kept = [evaluate(eqn, n)[0][()] if is_known(n) else round_bits(n) for n in x.flat]
    return [from_list(kept, x.shape)]


def apply_rounding(eqn: JaxprEqn, ins: list[Numbers]) -> list[Numbers]:
    """Rounding to integers, a half to the even one or away from zero, from the integer below."""
    (x,), to_even = ins, eqn.params["rounding_method"] == lax.RoundingMethod.TO_NEAREST_EVEN

    def round_number(number: Any) -> Any:
        size = number if to_even else jnp.abs(number)
        below = jnp.floor(size)
        left, odd = size - below, below != 2 * jnp.floor(below / 2)
        up = (left > 0.5) | ((left == 0.5) & odd) if to_even else left >= 0.5
        rounded = jnp.where(up, below + 1, below)
        return rounded if to_even else jnp.sign(number) * rounded

    kept = [evaluate(eqn, n)[0][()] if is_known(n) else round_number(n) for n in x.flat]
    return [from_list(kept, x.shape)]


def apply_movement(eqn: JaxprEqn, ins: list[Numbers]) -> list[Numbers]:
    """What only moves numbers is done to their places."""
    return move(eqn, ins)


def move(eqn: JaxprEqn, operands: Sequence[Numbers | np.ndarray]) -> list[Numbers]:
    """The numbers of arrays where the operation brings them; operands that are no arrays of objects are known indices."""
    everything, given = [], []
    for operand in operands:
        moves = operand.dtype == object
        places = np.arange(len(everything), len(everything) + operand.size, dtype=np.int32).reshape(operand.shape)
        given.append(places if moves else operand)
        everything += list(operand.flat) if moves else []
    found = evaluate(eqn, *given)
    if any(((moved < 0) | (moved >= len(everything))).any() for moved in found):
        raise UnsupportedError(f"{eqn.primitive.name} with numbers from nowhere")
    return [from_list([everything[i] for i in moved.flat], moved.shape) for moved in found]


def apply_indexed_movement(arrays: tuple[int, ...], eqn: JaxprEqn, ins: list[Numbers]) -> list[Numbers]:
    """What moves numbers of the operands `arrays` by indices: known ones, or each lane chooses among all there can be."""
    numbers = [number for i, operand in enumerate(ins) if i not in arrays for number in operand.flat]
    kinds = [*map(describe_value, eqn.invars)]

    def move_by(chosen: Sequence[Any]) -> Numbers:
        left = iter(chosen)
        index = lambda kind: np.asarray([next(left) for _ in range(kind.size)], kind.dtype).reshape(kind.shape)  # noqa: E731
        return move(eqn, [ins[i] if i in arrays else index(kind) for i, kind in enumerate(kinds)])[0]

    unknown = [i for i, number in enumerate(numbers) if not is_known(number)]
    most = max(ins[0].shape, default=1)
    if most ** len(unknown) > MAX_CHOICES:
        raise UnsupportedError(f"{eqn.primitive.name} by {len(unknown)} indices")
    choices = list(product(range(most), repeat=len(unknown)))
    moved = [move_by(_replace(numbers, unknown, values)) for values in choices]
    found = moved[0]  # an index before the first place is the first
    for values, there in zip(choices[1:], moved[1:], strict=True):
        here = [_is_at(numbers[i], value, most) for i, value in zip(unknown, values, strict=True)]
        found = select_all(reduce(partial(combine, lax.bitwise_and), here), there, found)
    return [found]


def _replace(numbers: list[Any], places: list[int], values: Sequence[int]) -> list[Any]:
    found = list(numbers)
    for place, value in zip(places, values, strict=True):
        found[place] = value
    return found


def _is_at(index: Any, value: int, most: int) -> Any:
    """Whether an index stands for a place; one beyond the last stands for that, one before the first for the first."""
    compare = lax.le if value == 0 else lax.ge if value == most - 1 else lax.eq
    return combine(compare, index, np.array(value, index.dtype)[()])


def select_all(flag: Any, yes: Numbers, no: Numbers) -> Numbers:
    """`yes` where flagged, else `no`, for all numbers of an array."""
    return from_list([select(flag, a, b) for a, b in zip(yes.flat, no.flat, strict=True)], yes.shape)


def apply_reduction(function: Callable, eqn: JaxprEqn, ins: list[Numbers]) -> list[Numbers]:
    """From the first number to the last."""
    (x,) = ins
    axes = eqn.params["axes"]
    kept = [axis for axis in range(x.ndim) if axis not in axes]
    rows = np.transpose(x, (*kept, *axes)).reshape((*(x.shape[axis] for axis in kept), -1))
    if not rows.shape[-1]:
        raise UnsupportedError(f"{eqn.primitive.name} of nothing")
    shape = rows.shape[:-1]
    fold = lambda row: reduce(partial(combine_known, function), row)  # noqa: E731
    return [from_list([fold(rows[place]) for place in np.ndindex(shape)], shape)]


def combine_known(function: Callable, a: Any, b: Any) -> Any:
    """An operation on two numbers of one type, now where both are known."""
    if not (is_known(a) and is_known(b)):
        return combine(function, a, b)
    with jax.ensure_compile_time_eval():
        return np.asarray(function(a, b))[()]


def apply_running(function: Callable, eqn: JaxprEqn, ins: list[Numbers]) -> list[Numbers]:
    """A running sum or extreme."""
    (x,), axis, found = ins, eqn.params["axis"], []
    along = list_entries(np.moveaxis(x, axis, 0))
    for entry in along[::-1] if eqn.params["reverse"] else along:
        found.append(entry if not found else _zip_combine(function, found[-1], entry))
    found = np.stack(found[::-1] if eqn.params["reverse"] else found)
    return [np.moveaxis(found, 0, axis)]


def _zip_combine(function: Callable, a: Numbers, b: Numbers) -> Numbers:
    return from_list([combine_known(function, p, q) for p, q in zip(a.flat, b.flat, strict=True)], a.shape)


def apply_arg_extreme(before: Callable, eqn: JaxprEqn, ins: list[Numbers]) -> list[Numbers]:
    """The place of the first extreme along an axis; one that is not a number counts as one."""
    (x,), (axis,), dtype = ins, eqn.params["axes"], eqn.params["index_dtype"]
    along = list_entries(np.moveaxis(x, axis, 0))
    best, at = along[0], from_list([np.zeros((), dtype)[()]] * along[0].size, along[0].shape)
    for place, entry in enumerate(along[1:], 1):
        here = np.array(place, dtype)[()]
        better = from_list(
            [_comes_first(before, a, b) for a, b in zip(entry.flat, best.flat, strict=True)], entry.shape
        )
        at = from_list([select(f, here, was) for f, was in zip(better.flat, at.flat, strict=True)], at.shape)
        best = from_list([select(*three) for three in zip(better.flat, entry.flat, best.flat, strict=True)], best.shape)
    return [at]


def _comes_first(before: Callable, number: Any, best: Any) -> Any:
    first = lambda a, b: before(a, b) | ((a != a) & (b == b))  # noqa: E731 - not a number
    return combine_known(first, number, best)


def apply_dot(eqn: JaxprEqn, ins: list[Numbers]) -> list[Numbers]:
    """A product of small matrices, term by term."""
    (a, b), ((ca, cb), (ba, bb)) = ins, eqn.params["dimension_numbers"]
    fa, fb = ([i for i in range(x.ndim) if i not in (*c, *d)] for x, c, d in ((a, ca, ba), (b, cb, bb)))
    shape = (*(a.shape[i] for i in (*ba, *fa)), *(b.shape[i] for i in fb))
    batch, rows, columns = (int(np.prod([x.shape[i] for i in some])) for x, some in ((a, ba), (a, fa), (b, fb)))
    left = np.transpose(a, (*ba, *fa, *ca)).reshape((batch, rows, -1))
    right = np.transpose(b, (*bb, *fb, *cb)).reshape((batch, columns, -1))

    def entry(i: int, j: int, k: int) -> Any:
        terms = [combine_known(lax.mul, p, q) for p, q in zip(left[i, j], right[i, k], strict=True)]
        return reduce(partial(combine_known, lax.add), terms)

    return [from_list([entry(*place) for place in np.ndindex((batch, rows, columns))], shape)]


def apply_known(eqn: JaxprEqn, ins: list[Numbers]) -> list[Numbers]:
    """Any operation on known numbers, now."""
    return [from_known(array) for array in evaluate(eqn, *map(to_array, ins))]


def pass_on(eqn: JaxprEqn, ins: list[Numbers]) -> list[Numbers]:
    """What says something to the compiler alone."""
    return ins


ARITHMETIC = set(ELEMENTWISE) - {"clz", "erf", "erf_inv", "erfc", "lgamma", "population_count"}
"""Arithmetic that a card's compiler has."""
MOVEMENTS = (
    "broadcast_in_dim", "concatenate", "copy", "copy_p", "expand_dims", "pad", "reshape", "rev", "slice", "split", "squeeze",
    "stack", "tile", "transpose", "unstack",
)  # fmt: skip
RULES: dict[str, Rule] = {
    **dict.fromkeys(ARITHMETIC, apply_elementwise),
    **dict.fromkeys(MOVEMENTS, apply_movement),
    **{name: partial(apply_reduction, function) for name, function in REDUCTIONS.items()},
    **{name: partial(apply_running, function) for name, function in RUNNING.items()},
    **dict.fromkeys(("dynamic_slice", "gather"), partial(apply_indexed_movement, (0,))),
    "dynamic_update_slice": partial(apply_indexed_movement, (0, 1)),
    "scatter": partial(apply_indexed_movement, (0, 2)),
    "argmin": partial(apply_arg_extreme, lax.lt),
    "argmax": partial(apply_arg_extreme, lax.gt),
    "reduce_precision": apply_reduced_precision,
    "round": apply_rounding,
    "dot_general": apply_dot,
    BARRIER: pass_on,
}
"""The rule for each operation by its name."""
