"""Neighbours of nodes on a GPU: a node is one thread, and each component an array of its own, `(*scenes, nodes)`.

Nothing that a few operations compute is worth storing there. By default a node visits all of its neighbours and computes
the springs that arrive at it as well as its own: twice the arithmetic, and one kernel for the whole step. With
`twice` = False it computes its own springs alone, and reads those that arrive.

Both layouts of `neighbours` have their likeness here. The slots of springs that arrive come after those of a node's own.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from physjax.backend import store_on_any_device
from physjax.custom_transpose import apply_linear
from physjax.particles import sum_terms
from physjax.vectors import AnyArray, components, stack_components

Vector = list[Array]
"""The components of a vector at each node."""


class ShiftedNodes(NamedTuple):
    """Neighbours by shifts, as `Bands`: the other end of a spring in slot s is `offsets[s]` nodes further on."""

    offsets: tuple[int, ...]
    twice: bool

    @property
    def shifts(self) -> tuple[int, ...]:
        """How far the other end is from a node, for each slot that it computes."""
        return (*self.offsets, *(-d for d in self.offsets)) if self.twice else self.offsets

    def differences(self, *arrays: Array) -> list[list[Vector]]:
        """Differences between both ends for each array, slot by slot; arbitrary where there is no spring."""
        vectors = [components(array) for array in arrays]
        return [[[_shift(c, -d) - c for c in vector] for d in self.shifts] for vector in vectors]

    def resultant(self, pulls: list[Vector]) -> Array:
        """The sum of the pulls on each node."""
        if not self.twice:
            pulls = [[p - _shift(p, d) for p in pull] for pull, d in zip(pulls, self.offsets, strict=True)]
        return stack_components([sum_terms(list(parts)) for parts in zip(*pulls, strict=True)])

    def at(self, number: AnyArray, slot: int) -> AnyArray:
        """A number in slots, taken at one of them."""
        own = number[..., slot % len(self.offsets), :]
        return own if slot < len(self.offsets) else _shift(own, -self.shifts[slot])

    def sum_at_both_ends(self, numbers: list[Array]) -> Array:
        """Σ of a number of each spring over both of its ends, `(*scenes, nodes)`."""
        if not self.twice:
            numbers = [number + _shift(number, d) for number, d in zip(numbers, self.offsets, strict=True)]
        return sum_terms(numbers)

    def stack_slots(self, numbers: list[Array]) -> Array:
        """A number of each spring in its slots, `(*scenes, slots, nodes)`."""
        return jnp.stack(numbers[: len(self.offsets)], axis=-2)

    def store(self, weights: list[Array]) -> list[Array]:
        """The weights of all springs, stored if both ends are to read them."""
        return weights if self.twice else store_on_any_device(weights)

    def scale_edges(self, number: Array, edge: Vector) -> Vector:
        """A number of each spring times a difference."""
        return [number * part for part in edge]


class GatheredNodes:
    """Neighbours by gathering, as `Table`, with one table of other ends for all slots.

    `partners` `(slots, nodes)` says for each place where the other end keeps the same spring, in slots × nodes, or the place
    beyond all of them.
    """

    def __init__(self, other: np.ndarray, arrivals: np.ndarray, twice: bool):
        self.own, self.twice = len(other), twice
        nodes, self.arrivals = other.shape[1], arrivals
        none, here = other.size, np.arange(nodes, dtype=np.int32)
        self.places = np.concatenate([np.arange(none, dtype=np.int32).reshape(other.shape), arrivals])
        self.other = np.concatenate([other, np.where(arrivals == none, here, arrivals % nodes)])
        beyond = self.other.size
        self.partners = np.full(self.other.shape, beyond, np.int32)
        row, node = np.nonzero(arrivals < none)
        self.partners.flat[arrivals[row, node]] = (self.own + row) * nodes + node
        self.partners[self.own + row, node] = arrivals[row, node]
        if not twice:
            self.other = other

    def differences(self, *arrays: Array) -> list[list[Vector]]:
        """Differences between both ends for each array, slot by slot; zero in an empty slot."""
        dim, slots = arrays[0].shape[-1], len(self.other)
        found = apply_linear(self._gather, self._collect, [c for array in arrays for c in components(array)])
        by_component = [found[i : i + slots] for i in range(0, len(found), slots)]
        return [
            [list(parts) for parts in zip(*by_component[i : i + dim], strict=True)]
            for i in range(0, len(by_component), dim)
        ]

    def _gather(self, *nodes: Array) -> list[Array]:
        """The differences of each component, slot by slot."""
        return [_take(a, other) - a for a in nodes for other in self.other]

    def _collect(self, *slots: Array) -> list[Array]:
        """The transpose of `_gather`: what arrives at each node minus what leaves it."""
        count = len(self.other)
        parts = [list(slots[i : i + count]) for i in range(0, len(slots), count)]
        return [self._sum_arriving(part) - sum_terms(part) for part in parts]

    def _sum_arriving(self, numbers: list[Array]) -> Array:
        """The sum of what the other ends of a node's springs have for it."""
        flat = store_on_any_device(jnp.concatenate([*numbers, jnp.zeros_like(numbers[0][..., :1])], axis=-1))
        return sum_terms([_take(flat, places) for places in (self.partners if self.twice else self.arrivals)])

    def resultant(self, pulls: list[Vector]) -> Array:
        """The sum of the pulls on each node."""
        parts = [list(parts) for parts in zip(*pulls, strict=True)]
        if self.twice:
            return stack_components([sum_terms(part) for part in parts])
        arriving = apply_linear(self._collect, self._gather, [p for part in parts for p in part])
        return stack_components([-total for total in arriving])

    def at(self, number: AnyArray, slot: int) -> AnyArray:
        """A number in slots, taken at one of them; zero in an empty slot."""
        if slot < self.own:
            return number[..., slot, :]
        flat = number.reshape((*number.shape[:-2], -1))
        width = [(0, 0)] * (flat.ndim - 1) + [(0, 1)]
        if isinstance(flat, np.ndarray):
            return np.pad(flat, width)[..., self.places[slot]]
        return _take(jnp.pad(flat, width), self.places[slot])

    def sum_at_both_ends(self, numbers: list[Array]) -> Array:
        """Σ of a number of each spring over both of its ends, `(*scenes, nodes)`."""
        return sum_terms(numbers) if self.twice else sum_terms(numbers) + self._sum_arriving(numbers)

    def stack_slots(self, numbers: list[Array]) -> Array:
        """A number of each spring in its slots, `(*scenes, slots, nodes)`."""
        return jnp.stack(numbers[: self.own], axis=-2)

    def store(self, weights: list[Array]) -> list[Array]:
        """The weights of all springs as they are: the pulls are stored if both ends are to read them."""
        return weights

    def scale_edges(self, number: Array, edge: Vector) -> Vector:
        """A number of each spring times a difference."""
        return [number * part for part in edge]


def _shift(number: AnyArray, d: int) -> AnyArray:
    """What is d nodes further back, at every node; zero where there is no such node."""
    filling = np.zeros((), number.dtype)
    still = [(0, 0, 0)] * (number.ndim - 1)
    if isinstance(number, np.ndarray):
        found = np.full_like(number, filling)
        size = number.shape[-1] - abs(d)
        found[..., max(d, 0) : max(d, 0) + size] = number[..., max(-d, 0) : max(-d, 0) + size]
        return found
    return lax.pad(number, filling, [*still, (d, -d, 0)])


def _take(number: Array, index: np.ndarray) -> Array:
    """`number[..., index]` without the clamping and wrapping of indices, which are known to be within bounds."""
    axis = number.ndim - 1
    dims = lax.GatherDimensionNumbers(
        offset_dims=tuple(range(axis)), collapsed_slice_dims=(axis,), start_index_map=(axis,)
    )
    return lax.gather(
        number, index[:, None], dims, (*number.shape[:-1], 1), mode=lax.GatherScatterMode.PROMISE_IN_BOUNDS
    )
