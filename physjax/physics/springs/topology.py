"""Who is tied to whom, laid out so that a step neither scatters nor, on a lattice, gathers.

Every spring is kept at one of its ends, its owner, in one of the owner's slots: a number for each spring is an array
`(*scenes, slots, nodes)`. In *bands* a slot is an index offset, the neighbours of all nodes are a shifted slice; a
lattice has few offsets. In a *table* a slot has any neighbours, which are gathered, and a second table says where the
springs that arrive at a node are kept. Both see a spring once and hand its force to both ends.
"""

from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from physjax.backend import block_fusion
from physjax.physics.springs.custom_transpose import apply_linear

LAYOUTS = ("bands", "gather")
MAX_SLOTS_PER_SPRING = 8
"""Slots for each spring up to which bands pay: a slot of a band costs an eighth of a gathered spring."""
MAX_BANDS = 48
"""Bands are written out one by one; more than this would compile for seconds."""


class Bands(NamedTuple):
    """Neighbours by shifted slices: the other end of a spring in slot s is `offsets[s]` nodes further on.

    What is known of a slot is an array `(*scenes, dim, offset + nodes)`, or without components: it begins with springs
    that would arrive at the first nodes from before them, which do not exist, so that both views of a spring are slices.
    """

    offsets: tuple[int, ...]

    def edges(self, *arrays: Array) -> list[Array]:
        """Differences between both ends, slot by slot, for each array in turn; where there is no spring, without meaning."""
        return [
            _forward_difference(self._slice_reachable(wide, d), d)
            for wide in map(self._pad_columns, arrays)
            for d in self.offsets
        ]

    def parts(self, *arrays: Array) -> list[Array]:
        """The differences again, component by component; not slices of `edges`, or a program would keep those in memory."""
        return [
            _forward_difference(self._slice_reachable(wide[..., i, :], d), d)
            for wide in map(self._pad_columns, arrays)
            for d in self.offsets
            for i in range(wide.shape[-2])
        ]

    def transpose_parts(self, dim: int, *parts: Array) -> list[Array]:
        """The transpose of `parts`, which are kept apart: each is used at both ends."""
        parts = block_fusion(parts)
        count, found = len(self.offsets) * dim, []
        for first in range(0, len(parts), count):
            sums = [
                sum(s[..., : s.shape[-1] - d] - s[..., d:] for s, d in zip(parts[i::dim], self.offsets, strict=False))
                for i in range(first, first + dim)
            ]
            found.append(jnp.stack(block_fusion(sums), axis=-1))
        return found

    def ends(self, *slots: Array) -> list[Array]:
        """The transpose of `edges`: what arrives at each node minus what leaves it."""
        count, found = len(self.offsets), []
        for first in range(0, len(slots), count):
            pairs = zip(slots[first : first + count], self.offsets, strict=True)
            total = sum(s[..., : s.shape[-1] - d] - s[..., d:] for s, d in pairs)
            found.append(jnp.swapaxes(block_fusion(total), -1, -2))
        return found

    def _pad_columns(self, a):
        """Components first and nodes last, with room for the furthest neighbour on both sides; kept apart from what uses it."""
        far, columns = max(self.offsets), jnp.swapaxes(a, -1, -2)
        return block_fusion(jnp.pad(columns, [(0, 0)] * (a.ndim - 1) + [(far, far)]))

    def _slice_reachable(self, wide, d):
        """All nodes, and as many before and behind them as an offset reaches."""
        far = max(self.offsets)
        return wide[..., far - d : wide.shape[-1] - far + d]

    def at(self, number: Any, slot: int) -> Any:
        """The part of a number in slots that belongs to one of them, where there is no spring as well."""
        pad = np.pad if isinstance(number, np.ndarray) else jnp.pad
        return pad(number[..., slot, :], [(0, 0)] * (number.ndim - 2) + [(self.offsets[slot], 0)])

    def scale_edges(self, number: Array, edge: Array) -> Array:
        """A number of each spring times a difference."""
        return number[..., None, :] * edge

    def sum_at_both_ends(self, numbers: list[Array]) -> Array:
        """Σ of a number of each spring over both of its ends, `(*scenes, nodes)`."""
        pairs = zip(numbers, self.offsets, strict=True)
        return sum(number[..., d:] + number[..., : number.shape[-1] - d] for number, d in pairs)

    def stack_slots(self, numbers: list[Array]) -> Array:
        """A number of each spring in its slots, `(*scenes, slots, nodes)`."""
        return jnp.stack([n[..., d:] for n, d in zip(numbers, self.offsets, strict=True)], axis=-2)


class Table(NamedTuple):
    """Neighbours by gathering: `other` `(slots, nodes)`, and `arrivals` `(most, nodes)`, places in slots × nodes or one beyond.

    What is known of a slot is an array `(*scenes, nodes, dim)`, or without components.
    """

    other: np.ndarray
    arrivals: np.ndarray

    def edges(self, *arrays: Array) -> list[Array]:
        """Differences between both ends, slot by slot, for each array in turn; in an empty slot zero."""
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
        total = sum(take(rows, places) for places in self.arrivals)
        total = total - sum(rows[..., s * nodes : (s + 1) * nodes, :] for s in range(count))
        total = block_fusion(total)
        return [total[..., i : i + dim] for i in range(0, total.shape[-1], dim)]

    def at(self, number: Any, slot: int) -> Any:
        """The part of a number in slots that belongs to one of them."""
        return number[..., slot, :]

    def scale_edges(self, number: Array, edge: Array) -> Array:
        """A number of each spring times a difference."""
        return number[..., None] * edge

    def sum_at_both_ends(self, numbers: list[Array]) -> Array:
        """Σ of a number of each spring over both of its ends, `(*scenes, nodes)`."""
        flat = jnp.concatenate([*numbers, jnp.zeros_like(numbers[0][..., :1])], axis=-1)
        return sum(numbers) + jnp.sum(take(flat[..., None], self.arrivals)[..., 0], axis=-2)

    def stack_slots(self, numbers: list[Array]) -> Array:
        """A number of each spring in its slots, `(*scenes, slots, nodes)`."""
        return jnp.stack(numbers, axis=-2)


class SpringTopology:
    """Pairs of nodes in a layout: compared by content, so that it can be part of what a program is compiled for."""

    def __init__(self, pairs: Any, nodes: int | None, layout: str | None):
        self.pairs, self.nodes = check_pairs(pairs, nodes)
        if layout not in (None, *LAYOUTS):
            raise ValueError(f"layout: got {layout!r}, expected one of {', '.join(LAYOUTS)}, or None for the faster.")
        low, high = self.pairs.min(axis=1), self.pairs.max(axis=1)
        slot, offsets = _find_bands(low, high)
        fits = len(offsets) <= MAX_BANDS and len(offsets) * self.nodes <= MAX_SLOTS_PER_SPRING * len(low)
        self.layout = layout or ("bands" if fits else "gather")
        if self.layout == "bands":
            owner, self.neighbours = low, Bands(offsets)
        else:
            owner, other = _balance_owners(self.pairs, self.nodes)
            slot = rank_in_group(owner, self.nodes)
            self.neighbours = _build_table(owner, other, slot, self.nodes)
        self.slots = int(slot.max()) + 1
        self.places = slot * self.nodes + owner
        self.present = np.zeros((self.slots, self.nodes), bool)
        self.present.flat[self.places] = True
        self._hash = hash((self.nodes, self.layout, self.pairs.tobytes()))

    def __eq__(self, other: Any) -> bool:
        return self is other or (
            isinstance(other, SpringTopology)
            and self._hash == other._hash
            and (self.nodes, self.layout) == (other.nodes, other.layout)
            and np.array_equal(self.pairs, other.pairs)
        )

    def __hash__(self) -> int:
        return self._hash

    def __repr__(self) -> str:
        return f"<{len(self.pairs)} pairs of {self.nodes} nodes, {self.layout}: {self.slots}>"

    def spread(self, number: Array) -> Array:
        """A number for each spring, `(*scenes, springs)`, in its slots; one for all, `()` or `(*scenes, 1)`, stays one."""
        if number.ndim == 0 or (number.shape[-1] == 1 and len(self.pairs) > 1):
            return number if number.ndim == 0 else number[..., None]
        absent = jnp.zeros_like(number[..., :1])
        source = np.full(self.present.size, len(self.pairs), np.int32)
        source[self.places] = np.arange(len(self.pairs))
        return jnp.concatenate([number, absent], axis=-1)[..., source].reshape(
            (*number.shape[:-1], *self.present.shape)
        )

    def collect(self, slots: Array) -> Array:
        """The way back: the number of each spring, in the order of the pairs."""
        if slots.ndim < 2 or slots.shape[-2:] != self.present.shape:
            return slots if slots.ndim == 0 else slots[..., 0]
        return slots.reshape((*slots.shape[:-2], -1))[..., self.places]

    def edges(self, x: Float[Array, "*scenes nodes dim"]) -> list[Array]:
        """Differences along the springs, slot by slot, as the layout has them."""
        return apply_linear(self.neighbours.edges, self.neighbours.ends, (x,))

    def parts(self, *arrays: Float[Array, "*scenes nodes dim"]) -> list[list[list[Array]]]:
        """Differences along the springs of each array, slot by slot, component by component."""
        dim = arrays[0].shape[-1]
        if isinstance(self.neighbours, Bands):
            found = apply_linear(self.neighbours.parts, partial(self.neighbours.transpose_parts, dim), arrays)
        else:
            found = [
                e[..., i] for e in apply_linear(self.neighbours.edges, self.neighbours.ends, arrays) for i in range(dim)
            ]
        slots = [found[i : i + dim] for i in range(0, len(found), dim)]
        return [slots[i : i + self.slots] for i in range(0, len(slots), self.slots)]

    def resultant(self, pulls: list[Array]) -> Float[Array, "*scenes nodes dim"]:
        """What pulls each node: the sum over the springs that it owns minus that over the springs that arrive."""
        return -apply_linear(self.neighbours.ends, self.neighbours.edges, tuple(pulls))[0]

    def ends(self, a: Float[Array, "*scenes nodes dim"]) -> tuple[Array, Array]:
        """What the first and the second node of each pair have, `(*scenes, springs, dim)`."""
        return a[..., self.pairs[:, 0], :], a[..., self.pairs[:, 1], :]


def check_pairs(pairs: Any, nodes: int | None) -> tuple[np.ndarray, int]:
    """Pairs of different nodes as int32, and the number of nodes: the largest index and one, unless given."""
    pairs = np.asarray(pairs)
    if pairs.size == 0:
        raise ValueError(f"pairs: got the empty shape {pairs.shape}, expected at least one spring (springs, 2).")
    if not np.issubdtype(pairs.dtype, np.integer):
        raise TypeError(f"pairs: got dtype {pairs.dtype}, expected integers: indices of the nodes that a spring joins.")
    if pairs.ndim != 2 or pairs.shape[1] != 2:
        raise ValueError(f"pairs: got shape {pairs.shape}, expected (springs, 2): the two nodes of each spring.")
    nodes = int(pairs.max()) + 1 if nodes is None else nodes
    wrong = ((pairs < 0) | (pairs >= nodes)).any(axis=1)
    if wrong.any():
        first = int(np.argmax(wrong))
        raise ValueError(
            f"pairs: got {pairs[first].tolist()} at index {first} ({wrong.sum()} of {len(pairs)} pairs are wrong), "
            f"expected nodes from 0 to {nodes - 1}."
        )
    same = pairs[:, 0] == pairs[:, 1]
    if same.any():
        first = int(np.argmax(same))
        raise ValueError(
            f"pairs: got a spring from node {pairs[first, 0]} to itself at index {first}, expected two different nodes."
        )
    return pairs.astype(np.int32), nodes


def _forward_difference(columns: Array, offset: int) -> Array:
    """The differences between each entry of the last axis and the one that is further on, `offset` fewer."""
    return columns[..., offset:] - columns[..., : columns.shape[-1] - offset]


def take(rows: Array, index: np.ndarray) -> Array:
    """`rows[..., index, :]`, the index known to be within bounds."""
    axis = rows.ndim - 2
    dims = lax.GatherDimensionNumbers(
        offset_dims=(*range(axis), axis + index.ndim), collapsed_slice_dims=(axis,), start_index_map=(axis,)
    )
    sizes = (*rows.shape[:axis], 1, rows.shape[-1])
    return lax.gather(rows, index[..., None], dims, sizes, mode=lax.GatherScatterMode.PROMISE_IN_BOUNDS)


def rank_in_group(keys: np.ndarray, count: int) -> np.ndarray:
    """How many earlier entries have the same key."""
    order = np.argsort(keys, kind="stable")
    sizes = np.bincount(keys, minlength=count)
    rank_in_group = np.empty(len(keys), np.int64)
    rank_in_group[order] = np.arange(len(keys)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return rank_in_group


def _find_bands(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, tuple[int, ...]]:
    """The band of each spring, and the offset of each band; springs between the same two nodes get a band each."""
    _, same = np.unique(low.astype(np.int64) * (high.max() + 1) + high, return_inverse=True)
    side = rank_in_group(same.ravel(), int(same.max()) + 1)
    kinds, slot = np.unique((high - low).astype(np.int64) * (side.max() + 1) + side, return_inverse=True)
    return slot.ravel(), tuple(int(kind) for kind in kinds // (side.max() + 1))


def _balance_owners(pairs: np.ndarray, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """An owner and another end for each spring, so that a node owns as many as arrive, give or take one.

    Every spring is walked along once, from its owner to the other end, in walks that only end where nothing is left
    (Euler's bridges); those that cannot close begin at nodes with an odd number of springs.
    """
    left = [[] for _ in range(nodes)]
    ends = pairs.tolist()
    for spring, (a, b) in enumerate(ends):
        left[a].append(spring)
        left[b].append(spring)
    walked = np.zeros(len(pairs), bool)
    owner, other = np.empty(len(pairs), np.int64), np.empty(len(pairs), np.int64)
    odd = [node for node in range(nodes) if len(left[node]) % 2]
    for start in (*odd, *range(nodes)):
        here = start
        while left[here]:
            spring = left[here].pop()
            if walked[spring]:
                continue
            walked[spring] = True
            a, b = ends[spring]
            owner[spring], other[spring] = (a, b) if here == a else (b, a)
            here = int(other[spring])
    return owner, other


def _build_table(owner: np.ndarray, other: np.ndarray, slot: np.ndarray, nodes: int) -> Table:
    """The tables of neighbours and of arriving springs."""
    slots, arriving = int(slot.max()) + 1, rank_in_group(other, nodes)
    ends = np.tile(np.arange(nodes, dtype=np.int32), (slots, 1))
    ends[slot, owner] = other
    arrivals = np.full((int(arriving.max()) + 1, nodes), slots * nodes, np.int32)
    arrivals[arriving, other] = slot * nodes + owner
    return Table(ends, arrivals)
