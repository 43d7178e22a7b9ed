"""Many independent lanes in blocks that fit a CPU's cache: a million lanes then run at the speed of ten thousand.

Between two frames each block is stepped on its own, so the state crosses main memory once a frame instead of once a
step.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import PyTree

from physjax.backend import count_lane_blocks
from physjax.scene import Scene


class Blocks(NamedTuple):
    """How the lanes of a scene are cut: `number` blocks of `size`, the last padded with copies of the first lanes."""

    lanes: tuple[int, ...]
    size: int
    number: int

    @classmethod
    def of(cls, scene: Scene, moving: Any, frame_steps: int) -> "Blocks | None":
        """The blocks for a scene, or None where they would not pay or could change its meaning.

        Lanes stay together where the scene may not be cut, and where they share an array that changes; `moving` are the
        arrays that a step changes.
        """
        total = math.prod(scene.state.lanes)
        count = count_lane_blocks(total, frame_steps)
        if count is None or not scene.may_be_cut():
            return None
        blocks = cls(scene.state.lanes, math.ceil(total / count), count)
        return blocks if all(jax.tree.leaves(scene.build_lane_mask(moving))) else None

    def cut(self, tree: Any) -> Any:
        """Trees of per-lane arrays as `(number, size, ...)`."""
        return jax.tree.map(self._cut_leaf, tree)

    def join(self, tree: Any, leading: int = 0) -> Any:
        """Undo `cut`, behind `leading` further axes."""
        return jax.tree.map(lambda leaf: self._join_leaf(leaf, leading), tree)

    def map(self, function: Callable, blocked: Any, *others: Any, masks: Any) -> Any:
        """`function(block, *others)` for each block in turn; `others` are uncut trees, of which it sees the block's part.

        `masks` say which of their arrays have an entry for each lane.
        """
        cut = lambda leaf, has_lanes: self._cut_leaf(leaf) if has_lanes else None  # noqa: E731
        parts = [jax.tree.map(cut, other, mask) for other, mask in zip(others, masks, strict=True)]

        def one(slices: tuple[PyTree, ...]) -> PyTree:
            block, *lanes = slices
            whole = [
                jax.tree.map(
                    lambda leaf, part: leaf if part is None else part, other, part, is_leaf=lambda x: x is None
                )
                for other, part in zip(others, lanes, strict=True)
            ]
            return function(block, *whole)

        return lax.map(one, (blocked, *parts))

    def _cut_leaf(self, leaf: Any) -> Any:
        n = len(self.lanes)
        flat = leaf.reshape((-1, *leaf.shape[n:]))
        filled = jnp.concatenate([flat, flat[: self.number * self.size - flat.shape[0]]])
        return filled.reshape((self.number, self.size, *leaf.shape[n:]))

    def _join_leaf(self, leaf: Any, leading: int) -> Any:
        front, rest = leaf.shape[:leading], leaf.shape[leading + 2 :]
        flat = leaf.reshape((*front, self.number * self.size, *rest))
        total = math.prod(self.lanes)
        return flat[(slice(None),) * leading + (slice(total),)].reshape((*front, *self.lanes, *rest))
