"""Arrays by their components: what stands for a vector in a loop, and what the interpreter of a step knows of an array."""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import PyTree


class Split(eqx.Module):
    """A vector `(*lanes, dim)` as its components, each an array `(*lanes,)`; of a constant the whole is kept as well."""

    parts: tuple[Any, ...]
    whole: Any = None


class Even(eqx.Module):
    """An array whose entries along the last axis are equal: one of them, and how many there are."""

    part: Any
    size: int = eqx.field(static=True)


class Value:
    """An array as the interpreter knows it: whole, by its components (its entries along the last axis), or both.

    Each is made when it is asked for, and once. `is_vector`: the last axis counts the components of a vector, which are
    kept apart. `is_even`: all components are one. `is_lazy`: nothing is computed yet, so either form may be asked for.
    """

    __slots__ = ("_make_part", "_make_whole", "_parts", "_whole", "is_even", "is_lazy", "is_vector", "shape")
    missing: ClassVar[object] = object()

    def __init__(
        self,
        shape: tuple[int, ...],
        whole: Callable[[], Any],
        part: Callable[[int], Any],
        *,
        is_vector: bool = False,
        is_even: bool = False,
        is_lazy: bool = False,
    ):
        self.shape, self._make_whole, self._make_part = shape, whole, part
        self.is_vector, self.is_even, self.is_lazy = is_vector, is_even, is_lazy
        self._whole, self._parts = Value.missing, {}

    @property
    def size(self) -> int:
        """The number of components."""
        return self.shape[-1]

    @property
    def is_plain(self) -> bool:
        """Whether it is an array like any other, whole and nothing else."""
        return not (self.is_vector or self.is_even or self.is_lazy)

    def whole(self) -> Any:
        """The array itself."""
        if self._whole is Value.missing:
            self._whole = self._make_whole()
        return self._whole

    def part(self, i: int) -> Any:
        """Component i, without the last axis; the only one of an axis of length 1, for any i."""
        i = 0 if self.is_even or self.size == 1 else i
        if i not in self._parts:
            self._parts[i] = self._make_part(i)
        return self._parts[i]

    def parts(self) -> list[Any]:
        """All components."""
        return [self.part(i) for i in range(self.size)]


def from_array(array: Any) -> Value:
    """An array of which nothing else is known; its components are cut out of it."""
    return Value(np.shape(array), lambda: array, lambda i: _cut_component(array, i))


def from_parts(parts: Sequence[Any], whole: Any = None) -> Value:
    """A vector given by its components."""
    shape = (*np.shape(parts[0]), len(parts))
    return Value(shape, lambda: stack_parts(parts) if whole is None else whole, lambda i: parts[i], is_vector=True)


def from_even(shape: tuple[int, ...], part: Callable[[], Any]) -> Value:
    """An array whose components are all one, which `part` makes."""
    value = Value(shape, lambda: _repeat_part(value.part(0), shape), lambda _: part(), is_even=True, is_lazy=True)
    return value


def from_recipe(shape: tuple[int, ...], whole: Callable[[], Any], part: Callable[[int], Any]) -> Value:
    """An array that is computed whole or by components, as it is asked for."""
    return Value(shape, whole, part, is_lazy=True)


def stack_parts(parts: Sequence[Any]) -> Any:
    """A vector from its components."""
    shape = np.shape(parts[0])
    return lax.concatenate(
        [lax.broadcast_in_dim(part, (*shape, 1), range(len(shape))) for part in parts], dimension=len(shape)
    )


def _repeat_part(part: Any, shape: tuple[int, ...]) -> Any:
    return lax.broadcast_in_dim(part, shape, range(len(shape) - 1))


def _cut_component(array: Any, i: int) -> Any:
    if isinstance(array, Tracer):
        return lax.index_in_dim(array, i, axis=-1, keepdims=False)
    return np.asarray(array)[..., i]  # known while tracing, so that the loop has no operation for it


def is_stored(leaf: Any) -> bool:
    """Whether a node of a tree stands for one array."""
    return isinstance(leaf, Split | Even)


def restore_value(stored: Any) -> Value:
    """What the interpreter knows of an array as it is passed into and out of a loop."""
    if isinstance(stored, Split):
        return from_parts(stored.parts, stored.whole)
    if isinstance(stored, Even):
        return from_even((*np.shape(stored.part), stored.size), lambda: stored.part)
    return from_array(stored)


def store_value(value: Value, split: bool | None = None) -> Any:
    """An array as it is passed into a loop: split, whole, or (None) as it is."""
    if split is None and value.is_even:
        return Even(value.part(0), value.size)
    return store_result(value, split)


def store_result(value: Value, split: bool | None = None) -> Any:
    """An array as it comes out of a loop: split, whole, or (None) split where it is a vector."""
    return Split(tuple(value.parts())) if (value.is_vector if split is None else split) else value.whole()


def split_vectors(tree: PyTree, mask: PyTree) -> PyTree:
    """The tree with every array that the mask says is a vector split into its components."""
    return jax.tree.map(lambda leaf, is_vector: _split_array(leaf) if is_vector else leaf, tree, mask)


def _split_array(array: Any) -> Split:
    return Split(tuple(_cut_component(array, i) for i in range(np.shape(array)[-1])), array)


def forget_wholes(tree: PyTree) -> PyTree:
    """The tree with components alone, of arrays that will change."""
    return jax.tree.map(lambda leaf: Split(leaf.parts) if isinstance(leaf, Split) else leaf, tree, is_leaf=is_stored)


def join_vectors(tree: PyTree) -> PyTree:
    """The tree with every vector whole again."""
    return jax.tree.map(lambda leaf: restore_value(leaf).whole() if is_stored(leaf) else leaf, tree, is_leaf=is_stored)


def describe_whole(stored: Any) -> jax.ShapeDtypeStruct:
    """Shape and type of the whole array."""
    if not is_stored(stored):
        return describe_array(stored)
    part = describe_array(stored.parts[0] if isinstance(stored, Split) else stored.part)
    size = len(stored.parts) if isinstance(stored, Split) else stored.size
    return jax.ShapeDtypeStruct((*part.shape, size), part.dtype, weak_type=part.weak_type)


def describe_array(array: Any) -> jax.ShapeDtypeStruct:
    """Shape and type of an array."""
    kind = array if isinstance(array, jax.ShapeDtypeStruct) else jax.typeof(array)
    return jax.ShapeDtypeStruct(kind.shape, kind.dtype, weak_type=kind.weak_type)
