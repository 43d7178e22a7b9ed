"""Linear equations between the joints of a mechanism, solved directly, level by level of their elimination.

A matrix is a block for each joint and two for each edge between joints that share a body. Blocks are `(rows, columns,
joints, worlds)` arrays, so that one entry of all blocks is one stretch of memory.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from physjax.constraints.elimination import Elimination, Level
from physjax.linear import eliminate

MAX_DENSE_ROWS = 4
"""Up to here elimination row by row, written out, is the smaller program."""
MAX_UNROLLED_LEVELS = 2
"""So few levels are written out one after the other; more are a loop, whose program does not grow with them."""
MAX_UNROLLED_ROWS = 3
"""The same of the rows of a block."""
PIVOT_ROUNDINGS = 64
"""A pivot of no more than as many roundings of what stood there is zero: its row follows from the others."""


class Blocks(NamedTuple):
    """A matrix of joints: a block for each joint, and for each edge the one in the later row and that in the earlier row."""

    own: Float[Array, "rows rows joints worlds"]
    lower: Float[Array, "rows rows edges worlds"]
    upper: Float[Array, "rows rows edges worlds"]

    def transposed(self) -> "Blocks":
        """The transposed matrix."""
        turn = lambda a: jnp.swapaxes(a, 0, 1)  # noqa: E731
        return Blocks(turn(self.own), turn(self.upper), turn(self.lower))


def solve_blocks(plan: Elimination, matrix: Blocks, right: Float[Array, "rows joints worlds"]) -> Array:
    """The x with matrix x = right; zero in rows that follow from others, as those of joints which hold the same twice."""
    if right.shape[0] * right.shape[1] <= MAX_DENSE_ROWS:
        return _solve_densely(plan, matrix, right)
    # a joint and an edge more than there are, for what is none
    pad = lambda a: jnp.pad(a, [(0, 0)] * (a.ndim - 2) + [(0, 1), (0, 0)])  # noqa: E731
    size = pad(jnp.stack([jnp.abs(matrix.own[i, i]) for i in range(len(right))]))
    begun = (*map(pad, matrix), pad(right))

    def forward(carry: tuple, level: Level) -> tuple[tuple, tuple]:
        return _eliminate_level(carry, level, size)

    def backward(x: Array, step: tuple[Level, tuple]) -> tuple[Array, None]:
        return _substitute_level(x, *step), None

    start = jnp.zeros_like(begun[3])
    if len(plan.levels) <= MAX_UNROLLED_LEVELS:
        kept, carry, x = [], begun, start
        for level in plan.levels:
            carry, found = forward(carry, level)
            kept.append(found)
        for level, found in zip(reversed(plan.levels), reversed(kept), strict=True):
            x, _ = backward(x, (level, found))
        return x[:, :-1]
    levels = jax.tree.map(jnp.asarray, plan.stacked)
    _, found = lax.scan(forward, begun, levels)
    x, _ = lax.scan(backward, start, (levels, found), reverse=True)
    return x[:, :-1]


def _solve_densely(plan: Elimination, matrix: Blocks, right: Array) -> Array:
    """The same for a few rows."""
    height, joints, _ = right.shape
    index = [(row, joint) for joint in range(joints) for row in range(height)]
    edges = {(int(i), int(j)): edge for edge, (i, j) in enumerate(plan.edges)}
    zero = jnp.zeros_like(right[0, 0])

    def entry(a: tuple[int, int], b: tuple[int, int]) -> Array:
        (row, i), (column, j) = a, b
        if i == j:
            return matrix.own[row, column, i]
        if (i, j) in edges:
            return matrix.upper[row, column, edges[i, j]]
        return matrix.lower[row, column, edges[j, i]] if (j, i) in edges else zero

    rows = [[entry(a, b) for b in index] for a in index]
    rounding = PIVOT_ROUNDINGS * float(jnp.finfo(right.dtype).eps)
    usable = lambda i, pivot: jnp.abs(pivot) > rounding * jnp.abs(rows[i][i])  # noqa: E731
    x = eliminate(rows, [right[a] for a in index], usable)
    return jnp.stack([jnp.stack(x[row::height]) for row in range(height)])


def _eliminate_level(carry: tuple, level: Level, size: Array) -> tuple[tuple, tuple]:
    """What is left of matrix and right-hand side after a level, and what `_substitute_level` needs of it."""
    own, lower, upper, right = carry
    inverse = _invert(_take(own, level.joints), _take(size, level.joints))
    y, above = _take(right, level.joints), _take(upper, level.edges)
    share = _multiply(_take(lower, level.edges), _take_padded(inverse, level.from_joint))
    rows, columns = level.products
    change = _multiply(_take_padded(share, rows), _take_padded(above, columns))
    moved = _apply(share, _take_padded(y, level.from_joint))
    after = (
        own - _sum_terms(change, level.on_joints),
        lower - _sum_terms(change, level.on_lower),
        upper - _sum_terms(change, level.on_upper),
        right - _sum_terms(moved, level.on_right),
    )
    return after, (inverse, y, above)


def _substitute_level(x: Array, level: Level, found: tuple[Array, Array, Array]) -> Array:
    """The x with that of a level's joints, given that of all later ones."""
    inverse, y, above = found
    known = _apply(above, _take(x, level.to_joint))
    new = _apply(inverse, y - _sum_terms(known, level.back))
    return x + _take_padded(new, level.places)


def _take(array: Array, index: Array | np.ndarray) -> Array:
    """Entries of the last axis but one."""
    return jnp.take(array, index, axis=-2, mode="clip")


def _take_padded(array: Array, index: Array | np.ndarray) -> Array:
    """The same; an index beyond the last gives zero."""
    return _take(jnp.pad(array, [(0, 0)] * (array.ndim - 2) + [(0, 1), (0, 0)]), index)


def _sum_terms(array: Array, index: Array | np.ndarray) -> Array:
    """Σ of entries of the last axis but one, over the first axis of the index."""
    return jnp.sum(_take_padded(array, index), axis=-3)


def _multiply(a: Array, b: Array) -> Array:
    """Products of blocks."""
    return jnp.sum(a[:, :, None] * b[None], axis=1)


def _apply(a: Array, x: Array) -> Array:
    """Products of blocks and vectors."""
    return jnp.sum(a * x[None], axis=1)


def _invert(a: Array, size: Array) -> Array:
    """Inverses of blocks by Gauss and Jordan; a row whose pivot is zero within rounding stays out, with its column."""
    least = PIVOT_ROUNDINGS * float(jnp.finfo(a.dtype).eps) * size

    def sweep(k: Array, a: Array) -> Array:
        pick = lambda array, axis: lax.dynamic_index_in_dim(array, k, axis, keepdims=False)  # noqa: E731
        at = (jnp.arange(len(a)) == k)[:, None, None]
        row, column = pick(a, 0), pick(a, 1)
        pivot = pick(row, 0)
        good = jnp.abs(pivot) > pick(least, 0)
        inverse = jnp.where(good, 1.0 / jnp.where(good, pivot, 1.0), 0.0)
        row = jnp.where(at, 1.0, row) * inverse[None]
        column = jnp.where(at, -1.0, column)
        return jnp.where(at[:, None] | at[None], 0.0, a) - column[:, None] * row[None]

    return lax.fori_loop(0, len(a), sweep, a, unroll=len(a) <= MAX_UNROLLED_ROWS)


__all__ = ["Blocks", "solve_blocks"]
