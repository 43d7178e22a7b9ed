"""Lanes: which arrays have an entry for each, and how to work only on those that need it.

A rare branch is taken when any lane needs it. Under `vmap` JAX would turn a `cond` into a choice that computes both
sides; `any_lane` asks all scenes of the batch together instead, so the branch stays a branch.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool

MIN_LANES_TO_SELECT = 1024
"""Scenes with fewer lanes are not worth picking lanes from."""
GROUPS_PER_SCENE = 32
"""One lane in so many is room enough for the lanes that are picked at once."""
SINGLE_PIECE_NODES = 64
"""Scenes with no more coupled nodes are compiled as one piece, which for few nodes runs faster."""


@jax.custom_batching.custom_vmap
def any_lane(flag: Bool[Array, "..."]) -> Bool[Array, ""]:
    """Whether any lane is flagged, of this scene and of all that are batched with it: one answer for the whole batch."""
    return jnp.any(flag)


@any_lane.def_vmap
def _any_lane_of_a_batch(axis_size, batched, flag):
    return any_lane(jnp.any(flag, axis=0)), False


def materialise_where(flag: Bool[Array, "..."], function: Callable, like: Any = None) -> Any:
    """`function()`, kept apart from what reads it: XLA on CPU would compute it again in each of its many readers.

    Where no lane is flagged it may be `like` instead (zeros by default); the compiler cannot know whether there is one.
    """
    if like is None:
        like = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(function))
    return lax.cond(any_lane(flag), function, lambda: like)


def materialise(t: ArrayLike, function: Callable) -> Any:
    """`function()`, kept apart from what reads it at any finite time t; on CPU by a branch that the compiler must believe in."""
    if jax.default_backend() == "cpu":
        return materialise_where(jnp.isfinite(t), function)
    return lax.optimization_barrier(function())


def compact_and_apply(
    function: Callable, flag: Bool[Array, "*lanes"], changing: Any, *others: Any, masks: Any, cut: bool
) -> Any:
    """`function(changing, *others)`, computed only if a lane is flagged; it must leave the other lanes as they are.

    `changing` and what comes back are trees of per-lane arrays; `masks` say of `others` which arrays are. With `cut`, and
    many lanes, only the flagged ones are gathered, in groups of a fixed size, so that the work follows their number;
    reverse mode goes through.
    """
    lanes, total = flag.shape, flag.size
    if not cut or total < MIN_LANES_TO_SELECT:
        return lax.cond(any_lane(flag), lambda: function(changing, *others), lambda: changing)
    size = math.ceil(total / GROUPS_PER_SCENE)
    by_lane = lambda leaf: leaf.reshape((total, *leaf.shape[len(lanes) :]))  # noqa: E731
    flat = jax.tree.map(by_lane, changing)
    words, upto = _pack_flags(flag.ravel())

    def group(now, first):
        index = _find_flagged_lanes(words, upto, first + jnp.arange(size, dtype=jnp.int32))
        pick = lambda leaf: leaf.at[index].get(mode="clip")  # noqa: E731
        few = jax.tree.map(lambda a, has_lanes: pick(by_lane(a)) if has_lanes else a, others, masks)
        done = function(jax.tree.map(pick, now), *few)
        # beyond the last flagged lane there is none, and nothing is written
        return jax.tree.map(lambda a, b: a.at[index].set(b, mode="drop"), now, done)

    def groups(now, first):
        some = lambda now, first: (  # noqa: E731
            lax.cond(any_lane(first < upto[-1]), lambda: group(now, first), lambda: now),
            None,
        )
        return lax.scan(some, now, first)[0]

    firsts = jnp.arange(0, total, size, dtype=jnp.int32)
    end = groups(flat, firsts[:1])
    end = lax.cond(any_lane(upto[-1] > size), lambda: groups(end, firsts[1:]), lambda: end)
    return jax.tree.map(lambda a, was: a.reshape(was.shape), end, changing)


def compact_and_apply_runs(function: Callable, flagged: Callable, changing: Any, *others: Any) -> Any:
    """`function(changing, *others)`, computed only where `flagged(changing, *others)`, for flags that stand side by side.

    `changing` and what comes back are trees of arrays along one axis of lanes; the function must leave other lanes as they
    are, and do away with the flag of those it is for. Windows slide to the next flagged lane until there is none: a
    slice is copied where the lanes picked by `compact_and_apply` would be gathered and scattered. Reverse mode goes through.
    """
    total = len(jax.tree.leaves(changing)[0])
    if total < MIN_LANES_TO_SELECT:
        return lax.cond(any_lane(flagged(changing, *others)), lambda: function(changing, *others), lambda: changing)
    size = math.ceil(total / GROUPS_PER_SCENE)

    def window(now):
        first = jnp.minimum(jnp.argmax(flagged(now, *others)).astype(jnp.int32), total - size)
        cut = partial(jax.tree.map, lambda leaf: lax.dynamic_slice_in_dim(leaf, first, size))
        done = function(cut(now), *map(cut, others))
        return jax.tree.map(lambda a, b: lax.dynamic_update_slice_in_dim(a, b, first, 0), now, done)

    def where_left(go_on, now):
        return lax.cond(any_lane(flagged(now, *others)), lambda: go_on(now), lambda: now)

    once = partial(where_left, window)
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
    """The lanes of the flags with these numbers, counted from zero; the number of lanes or more where there are not so many."""
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
    return jnp.where(word < words.size, place * words.size + word, 32 * words.size)


def bounded_while_loop(going: Callable, body: Callable, start: Any, *, most: int) -> Any:
    """`lax.while_loop(going, body, start)`, at most so many times, which compiles in pieces where the lanes are few."""
    few = jax.default_backend() == "cpu" and max(leaf.size for leaf in jax.tree.leaves(start)) < MIN_LANES_TO_SELECT

    def again(state):
        return going(state[0]) & (state[1][0] < most)

    def once(state):
        carry, count = state
        return body(carry), lax.sort(count + 1) if few else count + 1

    return lax.while_loop(again, once, (start, jnp.arange(2, dtype=jnp.int32)))[0]


@partial(jax.checkpoint, prevent_cse=False)  # so that reverse mode has a sort in its loop as well
def split_compilation(array: Array, number: Array) -> Array:
    """The array as it is; a loop over `number` that has this in its body is compiled in pieces.

    XLA on CPU makes one function of a small loop and of everything in it. Few lines run faster so; many, such as the
    gradient of a cloth's step, take ten times as long to compile. A sort, be it of two numbers, is what it will not
    have there.
    """
    return array * (lax.sort(jnp.stack([number, number + 1]))[0] == number).astype(array.dtype)
