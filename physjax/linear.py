"""Small systems of linear equations, one for each lane, written out by components.

A matrix is a list of columns (or of rows, where it says so), a vector the list of its components, each shaped like the
lanes. XLA then makes straight-line code of a solve, fused with what is around it; `jnp.linalg.solve` calls LAPACK once
for every lane and leaves the fused loop.
"""

from collections.abc import Callable, Sequence

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

Components = Sequence[Float[Array, "..."]]
"""A small vector as its components, each shaped like the lanes."""
MAX_CRAMER_UNKNOWNS = 3
"""Up to here Cramer's rule takes fewer operations than elimination, and no choice of a pivot."""


def solve_columns(columns: Sequence[Components], b: Components) -> list[Array]:
    """The x with Σ xᵢ columnᵢ = b, in components; not finite where the matrix is singular.

    Cramer's rule for up to three unknowns, beyond that elimination with the largest pivot of each column.
    """
    if len(columns) > MAX_CRAMER_UNKNOWNS:
        rows = [[column[i] for column in columns] for i in range(len(columns))]
        return eliminate(rows, b, pivoting=True)
    cofactors = build_cofactors(columns)
    volume = _dot(columns[0], cofactors[0])
    return [_dot(row, b) / volume for row in cofactors]


def build_cofactors(columns: Sequence[Components]) -> list[list[Array]]:
    """The rows of the inverse times the determinant, of up to three columns: rowᵢ·columnⱼ is the determinant or zero."""
    if len(columns) == 1:
        return [[jnp.ones_like(columns[0][0])]]
    if len(columns) == 2:
        (p, q), (r, s) = columns
        return [[s, -r], [-q, p]]
    first, second, third = columns
    return [_cross(second, third), _cross(third, first), _cross(first, second)]


def eliminate(
    rows: Sequence[Components],
    right: Components,
    usable: Callable[[int, Array], Bool[Array, "..."]] | None = None,
    *,
    pivoting: bool = False,
) -> list[Array]:
    """The x with Σⱼ rowsᵢⱼ xⱼ = rightᵢ by Gaussian elimination, in components.

    `usable(i, pivot)` says in which lanes the i-th pivot may be divided by; elsewhere xᵢ is zero and its equation left
    out. Without it every pivot is used, and a zero one leaves what is not finite. With `pivoting` the largest pivot of
    each column is taken; a matrix that is symmetric and positive does not need that.
    """
    rows, right, inverse, size = [list(row) for row in rows], list(right), [], len(rows)
    for i in range(size):
        if pivoting:
            _exchange_for_largest_pivot(rows, right, i)
        if usable is None:
            inverse.append(1.0 / rows[i][i])
        else:
            take = usable(i, rows[i][i])
            inverse.append(jnp.where(take, 1.0 / jnp.where(take, rows[i][i], 1.0), 0.0))
        for j in range(i + 1, size):
            share = rows[j][i] * inverse[i]
            rows[j] = [a + -share * b for a, b in zip(rows[j], rows[i], strict=True)]
            right[j] = right[j] - share * right[i]
    x = list(right)
    for i in reversed(range(size)):
        known = sum(rows[i][k] * x[k] for k in range(i + 1, size))
        x[i] = (right[i] - known) * inverse[i]
    return x


def _exchange_for_largest_pivot(rows: list[list[Array]], right: list[Array], i: int) -> None:
    """Bring the row with the largest entry of column i to place i, lane by lane, by exchanges with every later row."""
    for j in range(i + 1, len(rows)):
        exchange = jnp.abs(rows[j][i]) > jnp.abs(rows[i][i])
        pairs = [*zip(rows[i], rows[j], strict=True), (right[i], right[j])]
        *rows[i], right[i] = (jnp.where(exchange, b, a) for a, b in pairs)
        *rows[j], right[j] = (jnp.where(exchange, a, b) for a, b in pairs)


def _dot(a: Components, b: Components) -> Array:
    total = a[0] * b[0]
    for p, q in zip(a[1:], b[1:], strict=True):
        total = total + p * q
    return total


def _cross(a: Components, b: Components) -> list[Array]:
    return [a[i - 2] * b[i - 1] - a[i - 1] * b[i - 2] for i in range(3)]
