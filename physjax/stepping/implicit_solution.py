"""How the equation of an implicit stage is solved: linearised once, or by Newton's method; lane by lane, or iteratively.

Derivatives go through the solutions, by the implicit function theorem, and not through the iterations that find them.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.backend import any_lane
from physjax.linear import MAX_CRAMER_UNKNOWNS, solve_columns
from physjax.stepping.implicit_stage import Linearised, Stage, subtract
from physjax.stepping.krylov import (
    SolveReport,
    Vector,
    build_report,
    conjugate_gradients,
    stabilised_biconjugate_gradients,
)
from physjax.vectors import components, scale, stack_components

LARGEST_FORCING_TERM, SMALLEST_FORCING_TERM = 0.1, 1e-3
"""Relative residuals of the linear systems around Newton's method: of the first guess, and three digits an iteration."""
MAX_HALVINGS = 8
"""How often a Newton step that does not lower the residual is halved before it is given up."""


class StageSolver(NamedTuple):
    """Settings of the solution: the residual allowed (None: √ε), products with the matrix, steps of Newton's method.

    Newton's method takes the derivative of the forces themselves where it is `exact`, else that of their `linearised_at`:
    a compressed spring is unstable sideways, and the exact matrix of a large cloth in long steps can hardly be solved.
    """

    tolerance: float | None
    iterations: int
    newton: int
    exact: bool

    def solve(self, stage: Stage, linearised: Linearised) -> tuple[Vector, SolveReport]:
        """u of a stage, and how it was found."""
        if not self.newton:
            return self.solve_linearised(linearised, linearised.b, 0.0)
        guess, _ = self.solve_linearised(linearised, linearised.b, LARGEST_FORCING_TERM)
        return self._solve_converged(stage, lax.stop_gradient(guess))

    def solve_linearised(self, linearised: Linearised, b: Vector, rough: float) -> tuple[Vector, SolveReport]:
        """(1 - h K J) u = b, to the tolerance or to a `rough` one."""
        tolerance = max(rough, self._limit_tolerance(b))
        return self._solve_linear(linearised.stage, linearised.matvec, b, tolerance, linearised.dissipative_symmetric)

    def _solve_converged(self, stage: Stage, guess: Vector) -> tuple[Vector, SolveReport]:
        """u from the full equation, by Newton's method from a guess; its derivative by the implicit function theorem."""

        def tangent(g: Callable[[Vector], Vector], y: Vector) -> Vector:
            return self._solve_linear(stage, g, y, self._limit_tolerance(y), False)[0]

        def solve(f: Callable[[Vector], Vector], u: Vector) -> tuple[Vector, list[Array]]:
            u, reported = self._iterate_newton(stage, f, u)
            # as floats: jax 0.10 differentiates what comes along, and numbers that count have no derivative
            return u, [leaf.astype(u[0].dtype) for leaf in reported]

        u, (relative, products, ok) = lax.custom_root(stage.residual, guess, solve, tangent, has_aux=True)
        return u, SolveReport(relative, products.astype(jnp.int32), ok > 0)

    def _iterate_newton(self, stage: Stage, residual: Callable, u: Vector) -> tuple[Vector, SolveReport]:
        free = stage.free_kick()
        size = stage.inner(free, free)
        goal = self._limit_tolerance(u) ** 2 * size

        def body(carry: tuple[Vector, Array, Array, Array, Array]) -> tuple[Vector, Array, Array, Array, Array]:
            u, square, going, count, i = carry
            r, tangent, symmetric = self._linearise_residual(stage, residual, u)
            # solving for more digits than Newton's method still misses would be wasted
            missing = jnp.sqrt(goal / jnp.where(square > 0, square, 1.0))
            change, reported = self._solve_linear(
                stage, tangent, r, jnp.clip(0.1 * missing, SMALLEST_FORCING_TERM, LARGEST_FORCING_TERM), symmetric
            )
            u, after = _search_line(stage, residual, u, change, square, going)
            count = count + jnp.where(going, reported.products, 0)
            return u, after, going & (after > goal) & (after < square), count, i + 1

        r = residual(u)
        square = stage.inner(r, r)
        start = (u, square, square > goal, jnp.zeros(size.shape, jnp.int32), jnp.zeros((), jnp.int32))
        u, square, _, count, _ = lax.while_loop(lambda c: any_lane(c[2]) & (c[-1] < self.newton), body, start)
        return u, build_report(square, size, goal, count)

    def _linearise_residual(self, stage: Stage, residual: Callable, u: Vector) -> tuple[Vector, Callable, bool]:
        """The residual at u, the matrix of a step of Newton's method, and whether that is symmetric and positive."""
        if self.exact:
            return *jax.linearize(residual, u), False
        linearised = stage._replace(near=stage.end_state(u), way=None).linearise()
        return subtract(u, linearised.b), linearised.matvec, linearised.dissipative_symmetric

    def _limit_tolerance(self, b: Vector) -> float:
        """The tolerance, or what rounding leaves of it."""
        eps = float(jnp.finfo(b[0].dtype).eps)
        return eps**0.5 if self.tolerance is None else max(self.tolerance, 4 * eps)

    def _solve_linear(
        self, stage: Stage, matvec: Callable, b: Vector, tolerance: ArrayLike, dissipative_symmetric: bool
    ) -> tuple[Vector, SolveReport]:
        """matvec(u) = b: in closed form where lanes stand alone, else iteratively."""
        if stage.is_independent and len(b) == 1 and b[0].ndim and b[0].shape[-1] <= MAX_CRAMER_UNKNOWNS:
            u = _solve_per_lane(matvec, b[0])
            r, size = subtract(b, matvec([u])), stage.inner(b, b)
            products = jnp.full(size.shape, b[0].shape[-1], jnp.int32)
            return [u], build_report(stage.inner(r, r), size, tolerance**2 * size, products)
        iterate = conjugate_gradients if dissipative_symmetric else stabilised_biconjugate_gradients

        def solve(matvec: Callable[[Vector], Vector], b: Vector) -> tuple[Vector, SolveReport]:
            return iterate(matvec, b, stage.inner, tolerance, self.iterations)

        def transposed(matvec: Callable[[Vector], Vector], b: Vector) -> tuple[Vector, SolveReport]:
            # self-adjoint with the masses' inverse where the matrix is with the masses
            return iterate(matvec, b, stage.inner_of_dual, tolerance, self.iterations)

        return lax.custom_linear_solve(matvec, b, solve, transposed, has_aux=True)


def _search_line(
    stage: Stage, residual: Callable, u: Vector, change: Vector, square: jax.Array, going: jax.Array
) -> tuple[Vector, jax.Array]:
    """u - change, each system's change halved until its residual falls, left out where that does not help."""

    def tried(share: Array) -> Array:
        new = [a - scale(share, b) for a, b in zip(u, change, strict=True)]
        r = residual(new)
        return stage.inner(r, r)

    def halve(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        share, found, i = carry
        share = jnp.where(found < square, share, share / 2)
        return share, tried(share), i + 1

    whole = going.astype(square.dtype)
    start = (whole, tried(whole), jnp.zeros((), jnp.int32))
    share, found, _ = lax.while_loop(
        lambda c: any_lane(going & ~(c[1] < square)) & (c[-1] < MAX_HALVINGS), halve, start
    )
    share = jnp.where(found < square, share, 0.0)
    new = [a - scale(share, b) for a, b in zip(u, change, strict=True)]
    return new, jnp.where(found < square, found, square)


def _solve_per_lane(matvec: Callable, b: jax.Array) -> jax.Array:
    """The solution of a system of up to three unknowns for each lane, its columns read off by multiplying unit vectors."""
    dim = b.shape[-1]
    units = [jnp.broadcast_to(jnp.eye(dim, dtype=b.dtype)[i], b.shape) for i in range(dim)]
    columns = [components(matvec([e])[0]) for e in units]
    return stack_components(solve_columns(columns, components(b)))
