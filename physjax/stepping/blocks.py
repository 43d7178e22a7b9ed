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

from physjax.lanes import is_per_lane
from physjax.scene import Scene, plain_functions

BLOCK = 8192
"""Lanes in a block: 200 kB of state in 3-D and float32, which leaves room for the stages of a step in a 1 MB cache."""
SMALLEST = 6 * BLOCK
"""Fewer lanes than this fit a cache as they are."""
FEWEST_STEPS = 8
"""Fewer steps between frames do not pay for cutting."""


class Blocks(NamedTuple):
    """How the lanes of a scene are cut: `count` blocks of `size`, the last one filled up with copies of the first lanes."""

    lanes: tuple[int, ...]
    size: int
    count: int

    @classmethod
    def of(cls, scene: Scene, moving: Any, frame_steps: int) -> "Blocks | None":
        """The blocks for a scene, or None where they would not pay or could change its meaning.

        Lanes that are coupled stay together, and so do those of a plain function or a path, which may hold arrays that
        cannot be cut, and those that share something that changes: `moving` are the arrays that a step changes.
        """
        total = math.prod(scene.state.lanes)
        whole = scene.couples or scene.led is not None or bool(plain_functions(scene.forces))
        if whole or total < SMALLEST or frame_steps < FEWEST_STEPS or jax.default_backend() != "cpu":
            return None
        count = math.ceil(total / BLOCK)
        blocks = cls(scene.state.lanes, math.ceil(total / count), count)
        return blocks if all(map(blocks.is_cut, jax.tree.leaves(moving))) else None

    def is_cut(self, leaf: Any) -> bool:
        """Whether an array has an entry for each lane."""
        return is_per_lane(leaf, self.lanes)

    def cut(self, tree: Any) -> Any:
        """Per-lane arrays as `(count, size, ...)`, other leaves as they are."""
        return jax.tree.map(lambda leaf: self._cut(leaf) if self.is_cut(leaf) else leaf, tree)

    def join(self, tree: Any, like: Any, leading: int = 0) -> Any:
        """Undo `cut`, behind `leading` further axes; `like` is the tree before cutting."""
        return jax.tree.map(lambda leaf, was: self._join(leaf, leading) if self.is_cut(was) else leaf, tree, like)

    def map(self, function: Callable, blocked: Any, *others: Any) -> Any:
        """`function(block, *others)` for each block in turn; `others` are uncut trees, of which it sees the block's part."""
        cut = [jax.tree.map(self.is_cut, other) for other in others]
        parts = [
            jax.tree.map(lambda leaf, c: self._cut(leaf) if c else None, o, c) for o, c in zip(others, cut, strict=True)
        ]

        def one(slices):
            block, *lanes = slices
            whole = [
                jax.tree.map(
                    lambda leaf, part: leaf if part is None else part, other, part, is_leaf=lambda x: x is None
                )
                for other, part in zip(others, lanes, strict=True)
            ]
            return function(block, *whole)

        return lax.map(one, (blocked, *parts))

    def _cut(self, leaf: Any) -> Any:
        n = len(self.lanes)
        flat = leaf.reshape((-1, *leaf.shape[n:]))
        filled = jnp.concatenate([flat, flat[: self.count * self.size - flat.shape[0]]])
        return filled.reshape((self.count, self.size, *leaf.shape[n:]))

    def _join(self, leaf: Any, leading: int) -> Any:
        front, rest = leaf.shape[:leading], leaf.shape[leading + 2 :]
        flat = leaf.reshape((*front, self.count * self.size, *rest))
        total = math.prod(self.lanes)
        return flat[(slice(None),) * leading + (slice(total),)].reshape((*front, *self.lanes, *rest))
