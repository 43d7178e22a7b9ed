"""The arrays of one lane's program, number by number.

An array is a NumPy array of objects, each a number: known while tracing (a NumPy scalar), the same for all lanes (a
traced scalar), or one for each lane of the block (a traced vector).
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import JaxprEqn

Numbers = np.ndarray
"""An array of the program, an object for each of its numbers."""


class UnsupportedError(Exception):
    """A program holds an operation that no kernel has: the run takes the plain loop."""


def is_known(number: Any) -> bool:
    """Whether the number is known while tracing."""
    return isinstance(number, np.generic)


def all_known(arrays: Sequence[Numbers]) -> bool:
    """Whether all numbers of all arrays are known."""
    return all(is_known(number) for array in arrays for number in array.flat)


def from_known(array: Any) -> Numbers:
    """The numbers of an array that is known while tracing."""
    array = np.asarray(array)
    found = np.empty(array.shape, object)
    for place in np.ndindex(array.shape):
        found[place] = array[place]
    return found


def to_array(numbers: Numbers) -> np.ndarray:
    """An array whose numbers are all known."""
    return np.stack([*numbers.flat]).reshape(numbers.shape)


def from_list(numbers: Sequence[Any], shape: tuple[int, ...]) -> Numbers:
    """The array of a shape with these numbers."""
    found = np.empty(len(numbers), object)
    for place, number in enumerate(numbers):  # a slice would ask each for an array
        found[place] = number
    return found.reshape(shape)


def list_entries(array: Numbers) -> list[Numbers]:
    """The entries along the first axis, arrays as well."""
    return [array[i : i + 1].reshape(array.shape[1:]) for i in range(len(array))]


def bind_operation(eqn: JaxprEqn, *operands: Any) -> Any:
    """The operation itself on arrays or numbers."""
    return eqn.primitive.bind(*operands, **eqn.primitive.get_bind_params(eqn.params))


def evaluate(eqn: JaxprEqn, *arrays: Any) -> list[np.ndarray]:
    """The results of an operation on arrays that are known while tracing."""
    with jax.ensure_compile_time_eval():
        found = bind_operation(eqn, *arrays)
        found = found if eqn.primitive.multiple_results else [found]
        if any(jnp.issubdtype(array.dtype, jax.dtypes.extended) for array in found):
            raise UnsupportedError("keys of random numbers")
        return [*map(np.asarray, found)]


def spread(number: Any, like: Sequence[Any]) -> Any:
    """The number as a vector where one of the others is one."""
    shapes = [np.shape(other) for other in like]
    widest = max(shapes, key=len, default=())
    return number if np.shape(number) == widest else lax.broadcast(number, widest)


def combine(function: Callable[..., Any], *numbers: Any) -> Any:
    """An operation on numbers: what is one for all lanes is spread where another is not."""
    return function(*(spread(number, numbers) for number in numbers))


def as_vector(number: Any, block: int) -> Any:
    """The number as one for each lane."""
    return number if np.shape(number) else lax.broadcast(number, (block,))


def flatten_to_vectors(arrays: Sequence[Numbers], kinds: Sequence[Any], block: int) -> list[Any]:
    """All numbers of all arrays, of these types, as vectors of a block."""
    return [
        as_vector(np.asarray(number, kind) if is_known(number) else number, block)
        for numbers, kind in zip(arrays, kinds, strict=True)
        for number in numbers.flat
    ]


def select(flag: Any, yes: Any, no: Any) -> Any:
    """`yes` where flagged, else `no`."""
    if yes is no:
        return yes
    if is_known(flag):
        return yes if flag else no
    return combine(lambda f, a, b: lax.select_n(f, b, a), flag, yes, no)


def any_of_block(flag: Any) -> Any:
    """Whether any lane of the block is flagged."""
    return flag if not np.shape(flag) else jnp.max(flag.astype(jnp.int32)) > 0
