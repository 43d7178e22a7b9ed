"""Which nodes are joined by springs, and in which layout (`neighbours`) they are kept."""

from functools import cached_property, partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from physjax.backend import SPRINGS_AT_BOTH_ENDS, splits_vectors
from physjax.checks import NestedArrayLike
from physjax.custom_transpose import apply_linear
from physjax.physics.springs.component_neighbours import GatheredNodes, ShiftedNodes
from physjax.physics.springs.neighbours import Bands, Table, rank_in_group

LAYOUTS = ("bands", "gather")
MAX_SLOTS_PER_SPRING = 8
"""Slots per spring up to which bands are the faster layout: a slot of a band costs an eighth of a gathered spring."""
MAX_BANDS = 48
"""Bands are unrolled in the program; with more of them than this it would compile for seconds."""


class SpringTopology:
    """Pairs of nodes in a layout, compared by content: the static part of springs, for which programs are compiled.

    `places` is where each spring is kept in slots × nodes, `present` `(slots, nodes)` where one is kept.
    """

    def __init__(self, pairs: NestedArrayLike, nodes: int | None, layout: str | None):
        self.pairs, self.nodes = check_pairs(pairs, nodes)
        if layout not in (None, *LAYOUTS):
            raise ValueError(f"layout: got {layout!r}, expected one of {', '.join(LAYOUTS)}, or None for the faster.")
        low, high = self.pairs.min(axis=1), self.pairs.max(axis=1)
        slot, offsets = _find_bands(low, high)
        fits = len(offsets) <= MAX_BANDS and len(offsets) * self.nodes <= MAX_SLOTS_PER_SPRING * len(low)
        self.layout = layout or ("bands" if fits else "gather")
        if self.layout == "bands":
            owner, self._whole = low, Bands(offsets)
        else:
            # a row of arrivals for the most that arrive anywhere: as many as leave, where owners are balanced
            owner, other = _balance_owners(self.pairs, self.nodes)
            slot = rank_in_group(owner, self.nodes)
            self._whole = _build_table(owner, other, slot, self.nodes)
        self.slots = int(slot.max()) + 1
        self.places = slot * self.nodes + owner
        self.present = np.zeros((self.slots, self.nodes), bool)
        self.present.flat[self.places] = True
        self._hash = hash((self.nodes, self.layout, self.pairs.tobytes()))

    def __eq__(self, other: object) -> bool:
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

    @property
    def neighbours(self) -> Bands | Table | ShiftedNodes | GatheredNodes:
        """How a step reads neighbours on the device that computes: of whole vectors, or by components."""
        return self._by_component if splits_vectors() else self._whole

    @cached_property
    def _by_component(self) -> ShiftedNodes | GatheredNodes:
        if isinstance(self._whole, Bands):
            return ShiftedNodes(self._whole.offsets, SPRINGS_AT_BOTH_ENDS)
        return GatheredNodes(*self._whole, SPRINGS_AT_BOTH_ENDS)

    def spread(self, number: Array) -> Array:
        """A number per spring, `(*scenes, springs)`, in its slots; one for all, `()` or `(*scenes, 1)`, stays one."""
        if number.ndim == 0 or (number.shape[-1] == 1 and len(self.pairs) > 1):
            return number if number.ndim == 0 else number[..., None]
        # by a gather from the springs and one zero, whose transpose is the gather of `collect`
        absent = jnp.zeros_like(number[..., :1])
        source = np.full(self.present.size, len(self.pairs), np.int32)
        source[self.places] = np.arange(len(self.pairs))
        return jnp.concatenate([number, absent], axis=-1)[..., source].reshape(
            (*number.shape[:-1], *self.present.shape)
        )

    def collect(self, slots: Array) -> Array:
        """The inverse of `spread`: a number per spring, in the order of the pairs."""
        if slots.ndim < 2 or slots.shape[-2:] != self.present.shape:
            return slots if slots.ndim == 0 else slots[..., 0]
        return slots.reshape((*slots.shape[:-2], -1))[..., self.places]

    def differences(self, *arrays: Float[Array, "*scenes nodes dim"]) -> tuple[list, list[list[list[Array]]]]:
        """Differences between both ends: of the first array, slot by slot, as `scale_edges` of the neighbours takes them;
        and of each array slot by slot, component by component.
        """
        near, dim = self.neighbours, arrays[0].shape[-1]
        if isinstance(near, ShiftedNodes | GatheredNodes):
            parts = near.differences(*arrays)
            return parts[0], parts
        edges = apply_linear(near.edges, near.ends, arrays[:1])
        if isinstance(near, Bands):
            found = apply_linear(near.parts, partial(near.transpose_parts, dim), arrays)
        else:
            found = [e[..., i] for e in apply_linear(near.edges, near.ends, arrays) for i in range(dim)]
        slots = [found[i : i + dim] for i in range(0, len(found), dim)]
        return edges, [slots[i : i + self.slots] for i in range(0, len(slots), self.slots)]

    def parts(self, x: Float[Array, "*scenes nodes dim"]) -> list[list[Array]]:
        """Differences between both ends, slot by slot, component by component."""
        return self.differences(x)[1][0]

    def resultant(self, pulls: list) -> Float[Array, "*scenes nodes dim"]:
        """The sum of the pulls on each node: plus those of the springs that it owns, minus those that arrive."""
        near = self.neighbours
        if isinstance(near, Bands | Table):
            return -apply_linear(near.ends, near.edges, tuple(pulls))[0]
        return near.resultant(pulls)

    def ends(self, a: Float[Array, "*scenes nodes dim"]) -> tuple[Array, Array]:
        """The vectors of the first and of the second node of each pair, `(*scenes, springs, dim)`."""
        return a[..., self.pairs[:, 0], :], a[..., self.pairs[:, 1], :]


def check_pairs(pairs: NestedArrayLike, nodes: int | None) -> tuple[np.ndarray, int]:
    """Pairs of different nodes as int32, and the number of nodes: by default one more than the largest index."""
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


def _find_bands(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, tuple[int, ...]]:
    """The band of each spring, and the offset of each band; parallel springs between two nodes get a band each."""
    _, same = np.unique(low.astype(np.int64) * (high.max() + 1) + high, return_inverse=True)
    side = rank_in_group(same.ravel(), int(same.max()) + 1)
    kinds, slot = np.unique((high - low).astype(np.int64) * (side.max() + 1) + side, return_inverse=True)
    return slot.ravel(), tuple(int(kind) for kind in kinds // (side.max() + 1))


def _balance_owners(pairs: np.ndarray, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """An owner and another end for each spring, such that each node owns as many springs as arrive at it, within one.

    The springs are traversed once each, from owner to other end, in trails that end only where no spring is left (Euler's
    bridges). Trails that cannot close begin at the nodes with an odd number of springs.
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
    """The tables of other ends and of arriving springs; an empty slot has its own node as the other end."""
    slots, arriving = int(slot.max()) + 1, rank_in_group(other, nodes)
    ends = np.tile(np.arange(nodes, dtype=np.int32), (slots, 1))
    ends[slot, owner] = other
    arrivals = np.full((int(arriving.max()) + 1, nodes), slots * nodes, np.int32)
    arrivals[arriving, other] = slot * nodes + owner
    return Table(ends, arrivals)
