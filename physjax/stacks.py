"""Parts of one kind as a single part whose arrays have an axis of parts in front: evaluated once, however many they are.

A room of sixty walls then costs what one wall costs to compile: only kinds are looped over in Python.
"""

from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

P = TypeVar("P")


class Stack(eqx.Module, Generic[P]):
    """Parts of one kind: one part whose arrays have them along a leading axis, and the places they had among all parts."""

    part: P
    places: tuple[int, ...] = eqx.field(static=True)


def stack_alike(parts: Sequence[P]) -> tuple[Stack[P], ...]:
    """The parts by kind, in the order in which the kinds first occur.

    Two are of one kind if they differ in nothing but the values of their arrays: the same class, the same static fields,
    the same fields left at None, the same shapes and dtypes.
    """
    kinds: dict[object, list[int]] = {}
    for place, part in enumerate(parts):
        leaves, structure = jax.tree.flatten(part)
        kinds.setdefault((structure, tuple((leaf.shape, leaf.dtype) for leaf in leaves)), []).append(place)
    stack = lambda places: jax.tree.map(lambda *leaves: jnp.stack(leaves), *[parts[place] for place in places])  # noqa: E731
    return tuple(Stack(stack(places), tuple(places)) for places in kinds.values())


def map_stacks(function: Callable[..., PyTree], stacks: Sequence[Stack[P]], *shared: PyTree) -> PyTree:
    """`function(part, *shared)` of every part, along a leading axis of all parts, kind after kind.

    What comes back must have the same structure, and the same shapes, for all kinds.
    """
    found = [jax.vmap(lambda part: function(part, *shared))(stack.part) for stack in stacks]
    return found[0] if len(found) == 1 else jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *found)
