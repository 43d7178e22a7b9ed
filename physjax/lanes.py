"""Lanes: which arrays have an entry for each, and how to work only on those that need it.

A rare branch is taken when any lane needs it. Under `vmap` JAX would turn a `cond` into a choice that computes both
sides; `any_lane` asks all scenes of the batch together instead, so the branch stays a branch.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool

FEWEST = 1024
"""Scenes with fewer lanes are not worth picking lanes from."""
SHARE = 32
"""One lane in so many is room enough for the lanes that are picked at once."""


def is_per_lane(leaf: Any, lanes: tuple[int, ...]) -> bool:
    """Whether an array has an entry (a number, a vector, a matrix) for each lane."""
    return hasattr(leaf, "shape") and leaf.shape[: len(lanes)] == lanes


@jax.custom_batching.custom_vmap
def any_lane(flag: Bool[Array, "..."]) -> Bool[Array, ""]:
    """Whether any lane is flagged, of this scene and of all that are batched with it: one answer for the whole batch."""
    return jnp.any(flag)


@any_lane.def_vmap
def _any_lane_of_a_batch(axis_size, batched, flag):
    return any_lane(jnp.any(flag, axis=0)), False


def apart(flag: Bool[Array, "..."], function: Callable, like: Any = None) -> Any:
    """`function()`, kept apart from what reads it: XLA on CPU would compute it again in each of its many readers.

    Where no lane is flagged it may be `like` instead (zeros by default); the compiler cannot know whether there is one.
    """
    if like is None:
        like = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(function))
    return lax.cond(any_lane(flag), function, lambda: like)


def on_flagged(function: Callable, flag: Bool[Array, "*lanes"], changing: Any, *others: Any, cut: bool) -> Any:
    """`function(changing, *others)`, computed only if a lane is flagged; it must leave the other lanes as they are.

    `changing` and what comes back are trees of per-lane arrays. With `cut`, and many lanes, only the flagged ones are
    gathered, in groups of a fixed size, so that the work follows their number; reverse mode goes through.
    """
    lanes, total = flag.shape, flag.size
    if not cut or total < FEWEST:
        return lax.cond(any_lane(flag), lambda: function(changing, *others), lambda: changing)
    size = math.ceil(total / SHARE)
    by_lane = lambda leaf: leaf.reshape((total, *leaf.shape[len(lanes) :]))  # noqa: E731
    flat = jax.tree.map(by_lane, changing)
    rank = jnp.cumsum(flag.ravel(), dtype=jnp.int32)
    count = rank[-1]

    def group(now, first):
        # the k-th flagged lane is where the count reaches k; beyond the last there is none, and nothing is written
        index = jnp.searchsorted(rank, first + 1 + jnp.arange(size, dtype=jnp.int32)).astype(jnp.int32)
        pick = lambda leaf: leaf.at[index].get(mode="clip")  # noqa: E731
        few = [jax.tree.map(lambda a: pick(by_lane(a)) if is_per_lane(a, lanes) else a, other) for other in others]
        done = function(jax.tree.map(pick, now), *few)
        return jax.tree.map(lambda a, b: a.at[index].set(b, mode="drop"), now, done)

    def groups():
        firsts = jnp.arange(0, total, size, dtype=jnp.int32)
        some = lambda now, first: (  # noqa: E731
            lax.cond(any_lane(first < count), lambda: group(now, first), lambda: now),
            None,
        )
        end, _ = lax.scan(some, flat, firsts)
        return jax.tree.map(lambda a, was: a.reshape(was.shape), end, changing)

    return lax.cond(any_lane(flag), groups, lambda: changing)
