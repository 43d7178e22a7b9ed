"""Neighbours of nodes in two layouts, so that a step neither scatters nor, on a lattice, gathers.

Every spring is kept at one of its ends, its owner, in one of the owner's slots: a number for each spring is an array
`(*scenes, slots, nodes)`. In *bands* a slot is an index offset, and the neighbours of all nodes are a shifted slice; a
lattice has few offsets. In a *table* a slot has any neighbours, which are gathered, and a second table says where the
springs that arrive at a node are kept. Both compute a spring once and apply its force at both ends.

XLA on CPU fuses whatever it can, and then computes a shared term again for every one of its readers. Each
`block_fusion` here is at a point where one array has many readers: nodes read by several slots, a pull read at
both ends.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from physjax.backend import block_fusion
from physjax.particles import sum_terms
from physjax.vectors import AnyArray


class Bands(NamedTuple):
    """Neighbours by shifted slices: the other end of a spring in slot s is `offsets[s]` nodes further on.

    An array of a slot is `(*scenes, dim, offset + nodes)`, or without components `(*scenes, offset + nodes)`. Its first
    `offset` entries stand for springs that would arrive at the first nodes from before them, which do not exist: so what
    leaves a node and what arrives at it are both slices of one array.
    """

    offsets: tuple[int, ...]

    def edges(self, *arrays: Array) -> list[Array]:
        """Differences between both ends, slot by slot, for each array in turn; arbitrary where there is no spring."""
        return [
            _forward_difference(self._slice_reachable(wide, d), d)
            for wide in map(self._pad_columns, arrays)
            for d in self.offsets
        ]

    def parts(self, *arrays: Array) -> list[Array]:
        """The same differences, component by component: slices of `edges` would keep all of those in memory."""
        return [
            _forward_difference(self._slice_reachable(wide[..., i, :], d), d)
            for wide in map(self._pad_columns, arrays)
            for d in self.offsets
            for i in range(wide.shape[-2])
        ]

    def transpose_parts(self, dim: int, *parts: Array) -> list[Array]:
        """The transpose of `parts`."""
        parts = block_fusion(parts)
        count, found = len(self.offsets) * dim, []
        for first in range(0, len(parts), count):
            sums = [
                sum_terms(
                    [s[..., : s.shape[-1] - d] - s[..., d:] for s, d in zip(parts[i::dim], self.offsets, strict=False)]
                )
                for i in range(first, first + dim)
            ]
            found.append(jnp.stack(block_fusion(sums), axis=-1))
        return found

    def ends(self, *slots: Array) -> list[Array]:
        """The transpose of `edges`: what arrives at each node minus what leaves it."""
        count, found = len(self.offsets), []
        for first in range(0, len(slots), count):
            pairs = zip(slots[first : first + count], self.offsets, strict=True)
            total = sum_terms([s[..., : s.shape[-1] - d] - s[..., d:] for s, d in pairs])
            found.append(jnp.swapaxes(block_fusion(total), -1, -2))
        return found

    def _pad_columns(self, a: Array) -> Array:
        """Components first and nodes last, padded on both sides by the largest offset."""
        far, columns = max(self.offsets), jnp.swapaxes(a, -1, -2)
        return block_fusion(jnp.pad(columns, [(0, 0)] * (a.ndim - 1) + [(far, far)]))

    def _slice_reachable(self, wide: Array, d: int) -> Array:
        """All nodes, and d more before and behind them."""
        far = max(self.offsets)
        return wide[..., far - d : wide.shape[-1] - far + d]

    def at(self, number: AnyArray, slot: int) -> AnyArray:
        """A number in slots, taken at one of them; zero where a spring would arrive from before the first node."""
        width = [(0, 0)] * (number.ndim - 2) + [(self.offsets[slot], 0)]
        if isinstance(number, np.ndarray):
            return np.pad(number[..., slot, :], width)  # of the topology: a constant of the program
        return jnp.pad(number[..., slot, :], width)

    def store(self, weights: list[Array]) -> list[Array]:
        """The weights of all springs, stored: else XLA on CPU computes them again for every component and both ends."""
        return [block_fusion(weight) for weight in weights]

    def scale_edges(self, number: Array, edge: Array) -> Array:
        """A number of each spring times a difference."""
        return number[..., None, :] * edge

    def sum_at_both_ends(self, numbers: list[Array]) -> Array:
        """Σ of a number of each spring over both of its ends, `(*scenes, nodes)`."""
        pairs = zip(numbers, self.offsets, strict=True)
        return sum_terms([number[..., d:] + number[..., : number.shape[-1] - d] for number, d in pairs])

    def stack_slots(self, numbers: list[Array]) -> Array:
        """A number of each spring in its slots, `(*scenes, slots, nodes)`."""
        return jnp.stack([n[..., d:] for n, d in zip(numbers, self.offsets, strict=True)], axis=-2)


class Table(NamedTuple):
    """Neighbours by gathering: `other` `(slots, nodes)` are the other ends, `arrivals` `(most, nodes)` the springs that arrive.

    Arrivals are places in slots × nodes, or the one beyond them, which holds zero. An array of a slot is `(*scenes, nodes,
    dim)`, or without components `(*scenes, nodes)`.
    """

    other: np.ndarray
    arrivals: np.ndarray

    def edges(self, *arrays: Array) -> list[Array]:
        """Differences between both ends, slot by slot, for each array in turn; zero in an empty slot."""
        # one gather for all arrays: position and velocity of a neighbour lie next to each other
        rows = block_fusion(jnp.concatenate(arrays, axis=-1))
        difference = block_fusion(take(rows, self.other) - rows[..., None, :, :])
        dim = arrays[0].shape[-1]
        return [
            difference[..., s, :, i : i + dim] for i in range(0, rows.shape[-1], dim) for s in range(len(self.other))
        ]

    def ends(self, *slots: Array) -> list[Array]:
        """The transpose of `edges`: what arrives at each node minus what leaves it."""
        count, dim, nodes = len(self.other), slots[0].shape[-1], slots[0].shape[-2]
        parts = [slots[i : i + count] for i in range(0, len(slots), count)]
        rows = [jnp.concatenate(row, axis=-1) for row in zip(*parts, strict=True)]
        rows = block_fusion(jnp.concatenate([*rows, jnp.zeros_like(rows[0][..., :1, :])], axis=-2))
        total = sum_terms([take(rows, places) for places in self.arrivals])
        total = total - sum_terms([rows[..., s * nodes : (s + 1) * nodes, :] for s in range(count)])
        total = block_fusion(total)
        return [total[..., i : i + dim] for i in range(0, total.shape[-1], dim)]

    def at(self, number: AnyArray, slot: int) -> AnyArray:
        """A number in slots, taken at one of them."""
        return number[..., slot, :]

    def store(self, weights: list[Array]) -> list[Array]:
        """The weights of all springs, stored: else XLA on CPU computes them again for every component and both ends."""
        return [block_fusion(weight) for weight in weights]

    def scale_edges(self, number: Array, edge: Array) -> Array:
        """A number of each spring times a difference."""
        return number[..., None] * edge

    def sum_at_both_ends(self, numbers: list[Array]) -> Array:
        """Σ of a number of each spring over both of its ends, `(*scenes, nodes)`."""
        flat = jnp.concatenate([*numbers, jnp.zeros_like(numbers[0][..., :1])], axis=-1)
        return sum_terms(numbers) + jnp.sum(take(flat[..., None], self.arrivals)[..., 0], axis=-2)

    def stack_slots(self, numbers: list[Array]) -> Array:
        """A number of each spring in its slots, `(*scenes, slots, nodes)`."""
        return jnp.stack(numbers, axis=-2)


def _forward_difference(columns: Array, offset: int) -> Array:
    """Each entry of the last axis from `offset` on, minus the one `offset` before it."""
    return columns[..., offset:] - columns[..., : columns.shape[-1] - offset]


def take(rows: Array, index: np.ndarray) -> Array:
    """`rows[..., index, :]` without the clamping and wrapping of indices, which are known to be within bounds."""
    axis = rows.ndim - 2
    dims = lax.GatherDimensionNumbers(
        offset_dims=(*range(axis), axis + index.ndim), collapsed_slice_dims=(axis,), start_index_map=(axis,)
    )
    sizes = (*rows.shape[:axis], 1, rows.shape[-1])
    return lax.gather(rows, index[..., None], dims, sizes, mode=lax.GatherScatterMode.PROMISE_IN_BOUNDS)


def rank_in_group(keys: np.ndarray, count: int) -> np.ndarray:
    """How many earlier entries have the same key, for each entry of `keys` from 0 to `count` - 1."""
    order = np.argsort(keys, kind="stable")
    sizes = np.bincount(keys, minlength=count)
    rank = np.empty(len(keys), np.int64)
    rank[order] = np.arange(len(keys)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return rank
