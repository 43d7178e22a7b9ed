"""How many lanes are computed together: those that are flagged, in groups or windows, or a tile of worlds after another."""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int, PyTree

from physjax.backend import GROUPS_PER_SCENE, any_lane, choose_group_lanes, on_cpu
from physjax.loops import open_closure

WORLDS_PER_GROUP = 32
"""Worlds that are swept at a time, where only some have impacts."""

CONTACTS_PER_TILE = 640
"""Contacts of one group, over all worlds of a tile, of which what a sub-step computes stays in a core's cache.

1024 stacks of ten boxes, five contacts a group, a 60th of a second in four sub-steps: without tiles, and in tiles of 64, 128,
256 and 512 worlds, 0.90, 0.83, 1.09, 1.06 and 0.96 M boxes a second in the plane, and 0.047, 0.097, 0.116, 0.104 in space.
"""
MIN_WORLDS_PER_TILE = 32
"""With fewer worlds calls of kernels take longer than what they compute."""

T = TypeVar("T")
"""A tree of arrays that comes back with the same structure and shapes."""


def choose_group_worlds(worlds: int) -> int | None:
    """How many worlds of bodies that touch are solved at a time while impacts go on in some; None for all of them.

    On a CPU a sweep over 32 worlds takes little longer than over one, and over 1024 ten times as long: 1024 worlds of four bodies
    that tumble take 7.5 s for 150 steps in groups of 32, 14 in groups of 128, and 115 without.
    """
    return WORLDS_PER_GROUP if on_cpu() and worlds >= 2 * WORLDS_PER_GROUP else None


def choose_tile_worlds(worlds: int, contacts: int) -> int | None:
    """How many worlds of as many contacts a group go through a sub-step together; None for all of them."""
    most = max(MIN_WORLDS_PER_TILE, CONTACTS_PER_TILE // contacts)
    if not on_cpu() or worlds < 2 * most:
        return None
    return math.ceil(worlds / math.ceil(worlds / most))


def map_worlds(function: Callable[[PyTree], T], worlds: PyTree, count: int, contacts: int) -> T:
    """`function(worlds)`, tile after tile of them; they are the last axis of all arrays, of those given and those returned.

    `contacts` are those of a world in a group.
    """
    size = choose_tile_worlds(count, contacts)
    if size is None:
        return function(worlds)
    tiles = -(-count // size)

    def split(leaf: Array) -> Array:
        padded = jnp.pad(leaf, [(0, 0)] * (leaf.ndim - 1) + [(0, tiles * size - count)], mode="edge")
        return jnp.moveaxis(padded.reshape(*leaf.shape[:-1], tiles, size), -2, 0)

    def join(leaf: Array) -> Array:
        return jnp.moveaxis(leaf, 0, -2).reshape(*leaf.shape[1:-1], -1)[..., :count]

    return jax.tree.map(join, lax.map(function, jax.tree.map(split, worlds)))


def compact_and_apply(
    function: Callable[..., T],
    flag: Bool[Array, "*lanes"],
    changing: T,
    *others: PyTree,
    masks: PyTree,
    cut: bool,
) -> T:
    """`function(changing, *others)`, computed only if a lane is flagged; it must leave the other lanes as they are.

    `changing` and what comes back are trees of per-lane arrays; `masks` say of `others` which arrays are. With `cut`, and
    many lanes, only the flagged ones are gathered, in groups of a fixed size, so that the work follows their number;
    reverse mode goes through.
    """
    lanes, total = flag.shape, flag.size
    size = choose_group_lanes(total) if cut else None
    if size is None:
        function = jax.checkpoint(function)
        return lax.cond(any_lane(flag), lambda: function(changing, *others), lambda: changing)
    by_lane = lambda leaf: leaf.reshape((total, *leaf.shape[len(lanes) :]))  # noqa: E731
    flat, flags = jax.tree.map(by_lane, changing), jax.tree.leaves(masks)
    leaves, structure = jax.tree.flatten(others)
    own = [by_lane(leaf) for leaf, has_lanes in zip(leaves, flags, strict=True) if has_lanes]

    def call(now: T, few: list) -> T:
        some = iter(few)
        cut = [next(some) if has_lanes else leaf for leaf, has_lanes in zip(leaves, flags, strict=True)]
        return function(now, *structure.unflatten(cut))

    few = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((size, *leaf.shape[1:]), leaf.dtype), (flat, own))
    opened, known = open_closure(call, *few)
    groups = _Groups(opened, size)
    words, upto = _pack_flags(flag.ravel())

    @jax.custom_jvp
    def run(known, flat, own, words, upto):
        return groups.apply_in_place(known, flat, own, (words, upto))

    @run.defjvp
    def push(given, changes):
        apply = lambda known, flat, own, words, upto: groups.apply_at_once(known, flat, own, (words, upto))  # noqa: E731
        return jax.jvp(apply, given, changes)

    flat = run(known, flat, own, words, upto)
    return jax.tree.map(lambda a, was: a.reshape(was.shape), flat, changing)


class _Groups(NamedTuple):
    """Flagged lanes in groups of a size, and what is computed of one, with what it closes over in front."""

    function: Callable[..., PyTree]
    size: int

    def number(self, flat: PyTree) -> Array:
        """The numbers of flagged lanes, a row for each group."""
        total = len(jax.tree.leaves(flat)[0])
        return jnp.arange(-(-total // self.size) * self.size, dtype=jnp.int32).reshape(-1, self.size)

    def apply_in_place(self, known: list, flat: T, own: list, packed: tuple[Array, Array]) -> T:
        """The arrays with one group after the other written into them."""
        words, upto = packed

        def apply_to_group(flat, numbers):
            index = _find_flagged_lanes(words, upto, numbers)
            return _put(flat, index, self.function(known, *_pick((flat, own), index)))

        def apply(flat, numbers):
            applies = any_lane(numbers[0] < upto[-1])
            return lax.cond(applies, lambda: apply_to_group(flat, numbers), lambda: flat), None

        numbers = self.number(flat)
        flat, _ = apply(flat, numbers[0])
        more = lambda: lax.scan(apply, flat, numbers[1:])[0]  # noqa: E731
        return lax.cond(any_lane(upto[-1] > self.size), more, lambda: flat)

    def apply_at_once(self, known: list, flat: T, own: list, packed: tuple[Array, Array]) -> T:
        """The same with derivatives: all groups are picked before and written after.

        A loop that does it adds up derivatives of all lanes in every turn. Reverse mode computes a group again: zeros in place
        of what others would have stored cost more than the work.
        """
        words, upto = packed
        compute = jax.checkpoint(self.function)

        def apply_to_groups(flat, numbers):
            index = _find_flagged_lanes(words, upto, numbers)

            def apply(_, group):
                first, now, few = group
                return None, lax.cond(any_lane(first < upto[-1]), lambda: compute(known, now, few), lambda: now)

            return _put(flat, index, lax.scan(apply, None, (numbers[:, 0], *_pick((flat, own), index)))[1])

        numbers = self.number(flat)
        flat = apply_to_groups(flat, numbers[:1])
        more = jax.checkpoint(partial(apply_to_groups, numbers=numbers[1:]))
        return lax.cond(any_lane(upto[-1] > self.size), more, lambda flat: flat, flat)


def _pick(tree: T, index: Array) -> T:
    """Some lanes of arrays; an index beyond the last is the last."""
    return jax.tree.map(lambda leaf: leaf.at[index].get(mode="clip"), tree)


def _put(flat: T, index: Array, done: T) -> T:
    """The arrays with what was done to some lanes; an index beyond the last is none."""
    return jax.tree.map(lambda a, b: a.at[index].set(b, mode="drop", unique_indices=True), flat, done)


def compact_and_apply_runs(
    function: Callable[..., T], flagged: Callable[..., Bool[Array, "lanes"]], changing: T, *others: PyTree
) -> T:
    """`function(changing, *others)`, computed only where `flagged(changing, *others)`, for flags that come in runs.

    `changing` and what comes back are trees of arrays along one axis of lanes; the function must leave other lanes as they
    are, and clear the flag of those it is for. Windows slide to the next flagged lane until there is none: a slice is
    copied where the lanes picked by `compact_and_apply` would be gathered and scattered. Reverse mode goes through.
    """
    total = len(jax.tree.leaves(changing)[0])
    size = choose_group_lanes(total)
    if size is None:
        return lax.cond(any_lane(flagged(changing, *others)), lambda: function(changing, *others), lambda: changing)

    def apply_to_window(now):
        first = jnp.minimum(jnp.argmax(flagged(now, *others)).astype(jnp.int32), total - size)
        cut = partial(jax.tree.map, lambda leaf: lax.dynamic_slice_in_dim(leaf, first, size))
        done = function(cut(now), *map(cut, others))
        return jax.tree.map(lambda a, b: lax.dynamic_update_slice_in_dim(a, b, first, 0), now, done)

    def where_left(go_on, now):
        return lax.cond(any_lane(flagged(now, *others)), lambda: go_on(now), lambda: now)

    once = partial(where_left, apply_to_window)
    # the last window is moved back to fit, and so may be one more for lanes that come round to the first
    rest = lambda now: lax.scan(lambda now, _: (once(now), None), now, length=GROUPS_PER_SCENE)[0]  # noqa: E731
    return where_left(rest, once(changing))


def _pack_flags(flag: Bool[Array, "lanes"]) -> tuple[Array, Array]:
    """The flags as words of 32 bits, and how many are set up to and in each word: bit b of word w is lane b·words + w."""
    length = math.ceil(flag.size / 32)
    bits = jnp.pad(flag, (0, 32 * length - flag.size)).reshape(32, length).astype(jnp.uint32)
    words = bits[0]
    for place in range(1, 32):
        words = words | (bits[place] << place)
    return words, jnp.cumsum(lax.population_count(words).astype(jnp.int32), dtype=jnp.int32)


def _find_flagged_lanes(words: Array, upto: Array, number: Array) -> Array:
    """The lanes of the flags with these numbers, counted from zero; different ones beyond all where there are fewer."""
    word = jnp.searchsorted(upto, number + 1, method="scan_unrolled").astype(jnp.int32)
    left = words.at[word].get(mode="clip")
    rank = number - upto.at[word].get(mode="clip") + lax.population_count(left).astype(jnp.int32)
    place = jnp.zeros_like(number)
    for width in (16, 8, 4, 2, 1):
        below = lax.population_count(left & jnp.uint32((1 << width) - 1)).astype(jnp.int32)
        above = rank >= below
        rank = rank - jnp.where(above, below, 0)
        place = place + jnp.where(above, width, 0)
        left = jnp.where(above, left >> width, left)
    return jnp.where(word < words.size, place * words.size + word, 32 * words.size + number)


def write_entries(table: Array, place: Int[Array, "*lanes"], entries: Array) -> Array:
    """A table `(length, *lanes, ...)` with an entry of each lane written at a place of its own; beyond its length, none."""
    lanes = jnp.meshgrid(*map(jnp.arange, place.shape), indexing="ij")
    return table.at[(place, *lanes)].set(entries, mode="drop", unique_indices=True)
