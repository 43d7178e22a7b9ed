"""Counted time and repeated steps: time does not drift, and reverse mode stores √n states of n steps."""

import math
from collections.abc import Callable
from functools import partial, reduce
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from physjax.backend import any_lane, compiles_loop_in_pieces, jit_is_disabled

T = TypeVar("T")
"""What a loop carries."""
LAST_STEP = 2**31 - 1
"""The highest number that a step can have: steps are counted in 32 bits."""
LARGEST_SNAP_SHARE = 1 / 64
"""The largest share of a step by which a moment is moved to the end of one."""


def time_at(step: Array, dt: ArrayLike, dtype: np.dtype) -> Array:
    """Time is counted, t = i dt, never accumulated: accumulation drifts by a rounding error per step."""
    return step.astype(dtype) * dt


RECORD = {"record": True}
"""Metadata of a field that has the shape of the lanes because it records something of each: a state, mass, mask or time."""


class Moment(eqx.Module):
    """A time as steps count it: the start of step i, the rounding error of i dt in the scene's dtype, and the time since.

    Differences are taken before they are rounded, so that 5 ms are 5 ms after a day in float32, where the time itself is
    known to 8 ms. `moment + h` is a moment of the same step. Parts of a scene get `to_float_time(moment)`, a float.
    """

    start: Float[Array, "..."] = eqx.field(metadata=RECORD)
    rest: Float[Array, "..."] = eqx.field(metadata=RECORD)
    step: Float[Array, "..."] = eqx.field(metadata=RECORD)
    elapsed: ArrayLike | None = eqx.field(default=None, metadata=RECORD)

    @classmethod
    def of(cls, t: "Time", dt: ArrayLike, dtype: np.dtype | None = None) -> "Moment":
        """A moment as it is; a time given as a float is exact, the start of a step of length dt."""
        if isinstance(t, Moment):
            return t
        t = jnp.asarray(t, dtype)
        return cls(t, jnp.zeros_like(t), jnp.asarray(dt, t.dtype))

    def __add__(self, h: ArrayLike) -> "Moment":
        """A time h [s] later."""
        return Moment(self.start, self.rest, self.step, h if self.elapsed is None else self.elapsed + h)

    def __jax_array__(self) -> Array:
        """The time as a float."""
        return to_float_time(self)

    def time_until(self, time: Array, rest: ArrayLike = 0.0) -> Array:
        """Time until a moment [s], given as a number and its rounding error; negative where it has passed."""
        ahead = self._ahead(time, rest)
        return ahead if self.elapsed is None else ahead - self.elapsed

    def time_until_on_grid(self, time: Array, rest: ArrayLike = 0.0) -> Array:
        """Time until a moment [s], or until the end of a step that differs from it by no more than rounding."""
        ahead = self._ahead(time, rest)
        steps = lax.stop_gradient(ahead / self.step)
        near = jnp.round(steps)
        rounding = jnp.minimum(
            2 * float(jnp.finfo(ahead.dtype).eps) * (1 + jnp.abs(time) / self.step), LARGEST_SNAP_SHARE
        )
        # shifted by a constant, so that derivatives with respect to the time remain
        move = jnp.where(jnp.abs(steps - near) <= rounding, near * self.step - ahead, 0.0)
        ahead = ahead + lax.stop_gradient(move)
        return ahead if self.elapsed is None else ahead - self.elapsed

    def time_since(self, time: Array, rest: ArrayLike = 0.0) -> tuple[Array, Array]:
        """Time since a moment [s], and the rounding error of that."""
        whole, left = exact_sum(force_rounding(self.start), -time)
        left = left + (self.rest - rest)
        return whole, left if self.elapsed is None else left + self.elapsed

    def _ahead(self, time: Array, rest: ArrayLike) -> Array:
        return (time - force_rounding(self.start)) + (lax.stop_gradient(rest) - self.rest)


Time = ArrayLike | Moment
"""A time [s] as a float, or as steps count it."""


def moment_at(step: Array, dt: ArrayLike, dtype: np.dtype) -> Moment:
    """The start of a step, t = i dt, with its rounding error."""
    dt = jnp.asarray(dt, dtype)
    start, rest = exact_multiple(step, dt)
    return Moment(start, rest, dt)


def to_float_time(t: PyTree) -> PyTree:
    """The time as a float, which is what parts of a scene see."""
    if not isinstance(t, Moment):
        return t
    return t.start if t.elapsed is None else t.start + t.elapsed


def time_for_part(part: object, t: PyTree) -> PyTree:
    """The time as a part of a scene gets it: the moment itself only if it `sees_moments`, as parts of the library do."""
    return t if getattr(part, "sees_moments", False) is True else to_float_time(t)


def time_for_method(method: object, t: PyTree) -> PyTree:
    """The time as a method gets it, which may wrap another method: a user's method gets a float."""
    inner = getattr(method, "method", None)
    return t if is_library_part(method) and (inner is None or is_library_part(inner)) else to_float_time(t)


def respond_at_float_time(response: Callable, motion: Callable, scene: PyTree, t: PyTree, dt: ArrayLike) -> PyTree:
    """A user's contact response, which gets the time as a float."""
    return response(motion, scene, to_float_time(t), dt)


def is_library_part(part: object) -> bool:
    """Whether a function or a module is the library's own, which may get a moment instead of a float."""
    module = getattr(getattr(part, "function", part), "__module__", None)  # None: made by exec
    return (module or "").startswith("physjax.")


def force_rounding(number: Float[Array, "..."]) -> Float[Array, "..."]:
    """The number itself, rounded before anything is added to it: no compiler may fuse a product with a sum across the max."""
    return jnp.maximum(number, jnp.finfo(number.dtype).min)


def exact_sum(a: Array, b: Array) -> tuple[Array, Array]:
    """a + b and its rounding error (D. E. Knuth's TwoSum); the derivative is that of the sum."""
    total = a + b
    x, y, s = lax.stop_gradient((a, b, force_rounding(total)))
    part = s - x
    return total, (x - (s - part)) + (y - part)


def exact_multiple(count: Array, number: Array) -> tuple[Array, Array]:
    """count·number and its rounding error, for a count in 32 bits; the derivative is that of the product.

    The parts have so few digits that their products are exact, and are added in an order in which their sum is exact.
    """
    dtype = number.dtype
    product = count.astype(dtype) * number
    low = count & 0xFFFF
    low, high = low.astype(dtype), (count - low).astype(dtype)
    a, b, c = _split_in_three(lax.stop_gradient(number))
    rest = high * a - force_rounding(lax.stop_gradient(product))
    return product, ((((rest + high * b) + low * a) + high * c) + low * b) + low * c


def exact_quotient(count: Array, number: Array) -> tuple[Array, Array]:
    """count/number and its rounding error, for a count in 32 bits; the derivative is that of the quotient."""
    whole = count.astype(number.dtype)
    quotient = whole / number
    q, d = lax.stop_gradient((quotient, number))
    low = count & 0xFFFF
    left = ((count - low).astype(d.dtype) - whole) + low.astype(d.dtype)
    (qa, qb), (da, db) = _split_in_two(q), _split_in_two(d)
    rest = ((whole - qa * da) - qa * db) - qb * da
    return quotient, ((rest - qb * db) + left) / d


def float32_remainder(value: object, known: Array | None = None) -> Array:
    """The rounding error of a user's number in float32, so that a moment far from t = 0 is not shifted.

    Zero, or what is `known` of it, where the number is float32 already.
    """
    if isinstance(value, jax.Array):
        if value.dtype == np.float64:
            return (value - value.astype(np.float32).astype(value.dtype)).astype(np.float32)
        return jnp.zeros(value.shape, np.float32) if known is None else known
    try:
        exact = np.asarray(value, np.float64)
    except (TypeError, ValueError):  # the check of the number reports what is wrong with it
        return jnp.zeros((), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        rest = (exact - exact.astype(np.float32)).astype(np.float32)
    return jnp.asarray(np.where(np.isfinite(rest), rest, 0.0), np.float32)


def cast_remainder(value: Array, rest: Array) -> Array:
    """The rounding error of a number in its dtype: zero where the number holds it already, or was replaced since."""
    value, rest = lax.stop_gradient((value, rest.astype(value.dtype)))
    bare = value.astype(np.float32).astype(value.dtype) == value
    half = float(jnp.finfo(np.float32).eps) / 2
    return jnp.where(bare & (jnp.abs(rest) <= half * jnp.abs(value)), rest, 0.0)


def _split_in_three(number: Array) -> tuple[Array, Array, Array]:
    """A number as the sum of three with a third of its digits each."""
    bits = jnp.finfo(number.dtype)
    short = partial(lax.reduce_precision, exponent_bits=bits.nexp, mantissa_bits=bits.nmant // 3)
    first = short(number)
    second = short(number - first)
    return first, second, number - first - second


def _split_in_two(number: Array) -> tuple[Array, Array]:
    """A number as the sum of two with half of its digits each."""
    bits = jnp.finfo(number.dtype)
    first = lax.reduce_precision(number, exponent_bits=bits.nexp, mantissa_bits=bits.nmant // 2)
    return first, number - first


def repeat_steps(step: Callable, carry: PyTree, first: Array, count: int, *, unrolled: int = 1) -> PyTree:
    """`step(i, carry)` for `count` steps from `first` on, in nested scans: reverse mode replays from √count checkpoints.

    A turn of the loop takes `unrolled` steps.
    """
    if count == 1:
        return step(first, carry)
    if jit_is_disabled():  # a checkpoint traces in any case, and would hide the numbers from a debugger
        return reduce(lambda carry, i: step(first + i, carry), range(count), carry)
    inner = _choose_chunk_length(count) if count > 16 else count
    outer, rest = divmod(count, inner)

    def run(carry, first, length):
        numbers = jnp.arange(length, dtype=jnp.int32)
        return lax.scan(
            lambda c, i: (step(first + i, c), None), carry, numbers, unroll=_fit_unrolled(unrolled, length)
        )[0]

    if outer == 1 and not rest:
        return run(carry, first, count)
    chunk = jax.checkpoint(partial(run, length=inner), prevent_cse=False)
    carry, _ = lax.scan(lambda c, i: (chunk(c, first + i * inner), None), carry, jnp.arange(outer, dtype=jnp.int32))
    return run(carry, first + outer * inner, rest) if rest else carry


def bounded_while_loop(going: Callable[[T], Array], body: Callable[[T], T], start: T, *, most: int) -> T:
    """`lax.while_loop(going, body, start)` with at most `most` turns.

    It is compiled in pieces by a sort of two counters: two rough balls took half a minute to compile while each of their
    small loops was one function.
    """
    few = compiles_loop_in_pieces(start)

    def goes_on(state):
        return going(state[0]) & (state[1][0] < most)

    def turn(state):
        carry, count = state
        return body(carry), lax.sort(count + 1) if few else count + 1

    return lax.while_loop(goes_on, turn, (start, jnp.arange(2, dtype=jnp.int32)))[0]


def differentiable_while_loop(
    going: Callable[[T], Array], turn: Callable[[T], T], start: T, *, most: int, lanes_last: bool = False
) -> T:
    """`lax.while_loop(going, turn, start)`, with derivatives forward and reverse, of any order.

    `going` has one flag a lane; lanes are the first axes of all arrays, or the last ones. Where something is differentiated
    the loop is one over chunks of turns, left out from where no lane is going; reverse mode stores √`most` carries.
    Derivatives of lanes that need more than `most` turns are NaN.
    """
    if jit_is_disabled():  # so that all numbers can be looked at
        while any_lane(going(start)):
            start = turn(start)
        return start
    # what they close over may be differentiated as well
    (go, known), (move, closed_over) = open_closure(going, start), open_closure(turn, start)

    @jax.custom_jvp
    def run(known: list, closed_over: list, start: T) -> T:
        return lax.while_loop(lambda carry: any_lane(go(known, carry)), partial(move, closed_over), start)

    @run.defjvp
    def push(given: tuple, changes: tuple) -> tuple:
        def bounded(known: list, closed_over: list, start: T) -> T:
            return _repeat_while(partial(go, known), partial(move, closed_over), start, most)

        end, change = jax.jvp(bounded, given, changes)
        lost = go(given[0], end)
        return end, jax.tree.map(lambda leaf: _invalidate(leaf, lost, lanes_last), change)

    return run(known, closed_over, start)


def open_closure(function: Callable, *examples: PyTree) -> tuple[Callable, list]:
    """The function with what it closes over as its first argument, and that."""
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*examples)
    structure = jax.tree.structure(shape)

    def opened(numbers: list, *arguments: PyTree) -> PyTree:
        program = jaxpr_as_fun(ClosedJaxpr(closed.jaxpr, numbers))
        return structure.unflatten(program(*jax.tree.leaves(arguments)))

    return opened, list(closed.consts)


def _repeat_while(going: Callable, turn: Callable, start: T, most: int) -> T:
    """At most as many turns in two nested scans, those after the last that is needed left out."""
    length = math.isqrt(most - 1) + 1
    # what a turn computes is not kept either: what keeps it is most of a program
    turn = jax.checkpoint(turn, prevent_cse=False)

    def go_on(carry: T, turn: Callable) -> T:
        return lax.cond(any_lane(going(carry)), turn, lambda carry: carry, carry)

    def chunk(carry: T) -> T:
        return lax.scan(lambda carry, _: (go_on(carry, turn), None), carry, None, length=length)[0]

    chunk = jax.checkpoint(chunk, prevent_cse=False)
    return lax.scan(lambda carry, _: (go_on(carry, chunk), None), start, None, length=-(-most // length))[0]


def _invalidate(leaf: Array | np.ndarray, lost: Array, lanes_last: bool) -> Array | np.ndarray:
    """The derivative, NaN for lanes that are lost."""
    if leaf.dtype == jax.dtypes.float0:
        return leaf
    kept = jnp.where(lost, jnp.nan, 1.0).astype(leaf.dtype)
    others = (1,) * (leaf.ndim - kept.ndim)
    return leaf * kept.reshape(others + kept.shape if lanes_last else kept.shape + others)


def _fit_unrolled(unrolled: int, length: int) -> int:
    """About as many steps a turn, such that no turn is left over where that is possible: it would be compiled as well."""
    unrolled = min(unrolled, length)
    fitting = max(steps for steps in range(1, unrolled + 1) if length % steps == 0)
    return fitting if 2 * fitting >= unrolled else unrolled


def _choose_chunk_length(count: int) -> int:
    """A chunk length of about √count, one that divides the count if possible, since a remainder compiles a second program."""
    root = math.isqrt(count)
    exact = [length for length in range(root // 2, 2 * root + 1) if count % length == 0]
    return min(exact, key=lambda length: abs(length - root), default=root)
