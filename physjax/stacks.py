"""Parts of one kind as a single part whose arrays have an axis of parts in front: evaluated once, however many they are.

A room of sixty walls then costs what one wall costs to compile: only kinds are looped over in Python.
"""

from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

P = TypeVar("P")


class Stack(eqx.Module, Generic[P]):
    """Parts of one kind: one part whose arrays have them along a leading axis, and the places they had among all parts.

    A single part keeps its arrays as they are, without the axis: `map` and `replace` know.
    """

    part: P
    places: tuple[int, ...] = eqx.field(static=True)

    @property
    def size(self) -> int:
        """How many parts there are."""
        return len(self.places)

    def map(self, function: Callable[..., PyTree], *each: PyTree) -> PyTree:
        """`function(part, *each)` of every part, along a leading axis; `each` has that axis as well."""
        if self.size > 1:
            return jax.vmap(function)(self.part, *each)
        own = jax.tree.map(lambda leaf: leaf[0], each)
        return jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], function(self.part, *own))

    def replace(self, function: Callable[[P], P]) -> "Stack[P]":
        """The stack with `function(part)` in place of every part."""
        return Stack((jax.vmap(function) if self.size > 1 else function)(self.part), self.places)


def stack_alike(parts: Sequence[P]) -> tuple[Stack[P], ...]:
    """The parts by kind, in the order in which the kinds first occur.

    Two are of one kind if they differ in nothing but the values of their arrays: the same class, the same static fields,
    the same fields left at None, the same shapes and dtypes.
    """
    kinds: dict[object, list[int]] = {}
    for place, part in enumerate(parts):
        leaves, structure = jax.tree.flatten(part)
        kinds.setdefault((structure, tuple((leaf.shape, leaf.dtype) for leaf in leaves)), []).append(place)

    def stack(places: list[int]) -> P:
        first, *others = [parts[place] for place in places]
        return jax.tree.map(_stack_leaves, first, *others) if others else first

    return tuple(Stack(stack(places), tuple(places)) for places in kinds.values())


def _stack_leaves(*leaves: Array) -> Array:
    """The leaves along a new leading axis: joined along the one they have, which takes no operation for each of them."""
    if leaves[0].ndim == 0:
        return jnp.stack(leaves)
    return jnp.concatenate(leaves).reshape(len(leaves), *leaves[0].shape)


def unstack(values: Array) -> list[Array]:
    """The entries along the leading axis, one by one: cut from the first two axes as one, which takes one operation each."""
    if values.ndim == 1:
        return list(values)
    count, size = values.shape[:2]
    joined = values.reshape(count * size, *values.shape[2:])
    return [joined[i * size : (i + 1) * size] for i in range(count)]


def map_stacks(function: Callable[..., PyTree], stacks: Sequence[Stack[P]], *shared: PyTree) -> PyTree:
    """`function(part, *shared)` of every part, along a leading axis of all parts, kind after kind.

    What comes back must have the same structure, and the same shapes, for all kinds.
    """
    found = [stack.map(lambda part: function(part, *shared)) for stack in stacks]
    return found[0] if len(found) == 1 else jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *found)
