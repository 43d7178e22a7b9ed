"""Linear systems solved without their matrix: conjugate gradients, and a method for those that are not symmetric.

Unknowns are lists of arrays, many systems side by side: `inner(a, b)` gives a number for each system, and each stops by
itself when its residual |b - A x| has fallen to `tolerance` |b|. Nothing raises: a solve that did not converge has a
larger residual. Not differentiable by themselves; `lax.custom_linear_solve` makes them so.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from physjax.backend import any_lane
from physjax.vectors import scale

Vector = list[Array]
MAX_RESIDUAL_CHECKS = 4
"""How often the residual of a system that seems solved is computed again; in float32 it may have to go on from there."""


class SolveReport(NamedTuple):
    """How a solve went: relative residual, products with the matrix, and whether the residual is what was asked for."""

    residual: Float[Array, "..."]
    products: Int[Array, "..."]
    ok: Bool[Array, "..."]


_ConjugateCarry = tuple[Vector, Vector, Vector, Array, Array, Array, Array, Array]
_BiconjugateCarry = tuple[Vector, Vector, Vector, Array, Array, Array, Array, Array, Array]
"""What an iteration hands on: three vectors and numbers for each system, of which the last counts products."""


def conjugate_gradients(
    matvec: Callable[[Vector], Vector], b: Vector, inner: Callable, tolerance: ArrayLike, most: int
) -> tuple[Vector, SolveReport]:
    """A x = b for A self-adjoint in `inner` and positive: one product an iteration (Hestenes and Stiefel 1952).

    Stops at a direction along which A is not positive, and after `most` products.
    """
    size = inner(b, b)
    goal = tolerance**2 * size

    def body(carry: _ConjugateCarry) -> _ConjugateCarry:
        x, r, p, square, going, count, looks, i = carry
        q = matvec(p)
        curvature = inner(p, q)
        going = going & (curvature > 0)
        alpha = _safe_ratio(square, curvature, going)
        x, r = _add_scaled(x, alpha, p), _add_scaled(r, -alpha, q)
        after = inner(r, r)
        looked = (going & (after <= goal) & (looks > 0)).astype(jnp.int32)
        r, after = _recompute_residual(looked, matvec, b, x, r, after, inner)
        p = _add_scaled(r, _safe_ratio(after, square, going & (looked == 0)), p)
        count = count + going.astype(jnp.int32) + looked
        return x, r, p, jnp.where(going, after, square), going & (after > goal), count, looks - looked, i + 1

    none = jnp.zeros(size.shape, jnp.int32)
    zero = [jnp.zeros_like(e) for e in b]
    start = (zero, b, b, size, size > goal, none, none + MAX_RESIDUAL_CHECKS, jnp.zeros((), jnp.int32))
    x, _, _, square, _, count, _, _ = lax.while_loop(lambda c: any_lane(c[4]) & (c[-1] < most), body, start)
    return x, build_report(square, size, goal, count)


def stabilised_biconjugate_gradients(
    matvec: Callable[[Vector], Vector], b: Vector, inner: Callable, tolerance: ArrayLike, most: int
) -> tuple[Vector, SolveReport]:
    """A x = b for any A that is not too far from 1: two products an iteration (BiCGSTAB, van der Vorst 1992)."""
    size = inner(b, b)
    goal = tolerance**2 * size

    def body(carry: _BiconjugateCarry) -> _BiconjugateCarry:
        x, r, p, rho, square, going, count, looks, i = carry
        v = matvec(p)
        alpha = _safe_ratio(rho, inner(b, v), going)
        s = _add_scaled(r, -alpha, v)
        w = matvec(s)
        omega = _safe_ratio(inner(w, s), inner(w, w), going)
        x = _add_scaled(_add_scaled(x, alpha, p), omega, s)
        r = _add_scaled(s, -omega, w)
        after = inner(r, r)
        looked = (going & (after <= goal) & (looks > 0)).astype(jnp.int32)
        r, after = _recompute_residual(looked, matvec, b, x, r, after, inner)
        shadow = inner(b, r)
        beta = _safe_ratio(shadow * alpha, rho * omega, going & (looked == 0))
        p = _add_scaled(r, beta, _add_scaled(p, -omega, v))
        count, square = count + 2 * going.astype(jnp.int32) + looked, jnp.where(going, after, square)
        going = going & (after > goal) & (shadow != 0) & (omega != 0)
        return x, r, p, jnp.where(going, shadow, rho), square, going, count, looks - looked, i + 2

    none = jnp.zeros(size.shape, jnp.int32)
    zero = [jnp.zeros_like(e) for e in b]
    start = (zero, b, b, size, size, size > goal, none, none + MAX_RESIDUAL_CHECKS, jnp.zeros((), jnp.int32))
    x, _, _, _, square, _, count, _, _ = lax.while_loop(lambda c: any_lane(c[5]) & (c[-1] < most), body, start)
    return x, build_report(square, size, goal, count)


def _recompute_residual(
    looked: Array, matvec: Callable, b: Vector, x: Vector, r: Vector, square: Array, inner: Callable
) -> tuple[Vector, Array]:
    """The residual b - A x itself, and its square, for systems that seem solved: the one carried along drifts by rounding."""

    def true():
        share = looked.astype(b[0].dtype)
        new = [c + scale(share, e - (q + c)) for e, q, c in zip(b, matvec(x), r, strict=True)]
        return new, inner(new, new)

    return lax.cond(any_lane(looked > 0), true, lambda: (r, square))


def _add_scaled(x: Vector, number: Array, y: Vector) -> Vector:
    """x + number·y, the number one for each system."""
    return [a + scale(number, b) for a, b in zip(x, y, strict=True)]


def _safe_ratio(above: Array, below: Array, going: Array) -> Array:
    """A quotient for the systems that go on, zero for the others and where it is none."""
    good = going & (below != 0)
    return jnp.where(good, above, 0.0) / jnp.where(good, below, 1.0)


def build_report(square: Array, size: Array, goal: ArrayLike, count: Array) -> SolveReport:
    """The report on a solve whose residual has the square `square`, of a right-hand side with the square `size`."""
    present = size > 0
    residual = jnp.sqrt(jnp.where(present, square, size) / jnp.where(present, size, 1.0))
    return SolveReport(residual, count, square <= goal)
