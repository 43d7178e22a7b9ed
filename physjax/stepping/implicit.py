"""Implicit Euler: the force at the end of the step moves the state, so that no step is too long for stiff springs.

The equation of a step is linear in what a kick changes, u: u = dt·K rate(t + dt, drift(state + u, dt)), with K what a
kick takes from a rate. For particles u = Δv, and linearised at the start (D. Baraff and A. Witkin, "Large steps in cloth
simulation", 1998) it is (1 - dt ∂a/∂v - dt² ∂a/∂x) Δv = dt (a + dt ∂a/∂x v), a and its derivatives at (t + dt, x, v).
"""

from collections.abc import Callable
from functools import reduce
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, PyTree

from physjax.backend import any_lane
from physjax.linear import MAX_CRAMER_UNKNOWNS, solve_columns
from physjax.loops import Time
from physjax.scene import Scene
from physjax.stepping.krylov import (
    SolveReport,
    Vector,
    build_report,
    conjugate_gradients,
    stabilised_biconjugate_gradients,
)
from physjax.stepping.registry import Promises
from physjax.stepping.system import S, System, has_no_lanes, linearise_at, read_traits
from physjax.vectors import components, scale, stack_components

LARGEST_FORCING_TERM, SMALLEST_FORCING_TERM = 0.1, 1e-3
"""Relative residuals of the linear systems around Newton's method: of the first guess, and three digits an iteration."""
MAX_HALVINGS = 8
"""How often a Newton step that does not lower the residual is halved before it is given up."""


class ImplicitEuler(eqx.Module):
    """Implicit Euler: kick with the force at the end of the step, then drift. Stable at any step on linear springs.

    Damps an oscillation by 1/√(1 + ω²dt²) a step, also where no damping is wanted. Once a step the force is linearised
    (`newton` = 0); `newton` > 0 converges the full equation in at most `newton` steps of Newton's method. Independent
    lanes solve a small system each, coupled scenes one for each scene by at most `iterations` products with its matrix:
    conjugate gradients where every force is `dissipative_symmetric` (springs are, by their `linearised_at`), BiCGSTAB otherwise.
    `tolerance` is the residual allowed, relative to dt·a, in the 2-norm weighted by mass: √ε of the float type by
    default. A solve that does not converge raises nothing: `report` returns its residual. Derivatives go through
    the solution, not the iterations. Raises ValueError or TypeError for bad settings.

    Example:
        >>> print(swing.step(methods.ImplicitEuler(newton=4), 0.0, 0.5).state.position)
        [0.5]
    """

    tolerance: float | None = eqx.field(static=True, default=None)
    iterations: int = eqx.field(static=True, default=1000)
    newton: int = eqx.field(static=True, default=0)

    promises = Promises(order=1, evaluations=1, stability_limit=float("inf"), order_with_drag=1)

    def __check_init__(self):
        given = 0.5 if self.tolerance is None else self.tolerance
        if not isinstance(given, int | float) or not 0 < given < 1:
            raise ValueError(
                f"ImplicitEuler: got tolerance={self.tolerance!r}, expected a number between 0 and 1: the relative residual."
            )
        for name, value, least in (("iterations", self.iterations, 1), ("newton", self.newton, 0)):
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ValueError(f"ImplicitEuler: got {name}={value!r}, expected an integer of at least {least}.")

    @property
    def __name__(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]  # of the instance, as a function has
        return "implicit_euler" if not self.newton else "implicit_euler, converged"

    def __call__(self, system: System, t: Time, state: S, dt: ArrayLike) -> S:
        """The state after a step dt [s] from the time t [s]."""
        return self.solve_step(system, t, state, dt)[0]

    def report(self, scene: Scene, dt: ArrayLike, t: ArrayLike = 0.0) -> SolveReport:
        """How the step from `scene.state` is solved: relative residual, products with the matrix, ok; for each scene."""
        return _report_step(self, scene, jnp.asarray(t, scene.state.dtype), jnp.asarray(dt, scene.state.dtype))

    def solve_step(self, system: System, t: Time, state: S, dt: ArrayLike) -> tuple[S, SolveReport]:
        """The state after a step dt [s] from the time t [s], and how it was solved."""
        step = _Step.of(system, t, state, dt)
        if self.newton:
            guess, _ = self._solve_linearised(step, LARGEST_FORCING_TERM)
            u, reported = self._solve_converged(step, lax.stop_gradient(guess))
        else:
            u, reported = self._solve_linearised(step, 0.0)
        return step.end_state(u), reported

    def _solve_linearised(self, step: "_Step", rough: float) -> tuple[Vector, SolveReport]:
        """u from the equation linearised at the start of the step."""
        linearised, state, dt = step.linearised(), step.state, step.dt
        rate, push = jax.linearize(lambda y: linearised.rate(step.end, y), state)
        _, ahead = jax.jvp(lambda h: step.system.drift(state, h), (jnp.zeros_like(dt),), (dt,))
        _, move = jax.linearize(lambda u: step.system.drift(step.add_change(u), dt), step.zero_change())
        b = step.kick(jax.tree.map(jnp.add, rate, push(ahead)))
        matvec = lambda u: _subtract(u, step.kick(push(move(step.mask_held(u)))))  # noqa: E731
        return self._solve_linear(
            step, matvec, b, max(rough, self._limit_tolerance(b)), read_traits(linearised).dissipative_symmetric
        )

    def _solve_converged(self, step: "_Step", guess: Vector) -> tuple[Vector, SolveReport]:
        """u from the full equation, by Newton's method from a guess; its derivative by the implicit function theorem."""

        def residual(u: Vector) -> Vector:
            return _subtract(u, step.kick(step.system.rate(step.end, step.end_state(u))))

        def tangent(g: Callable[[Vector], Vector], y: Vector) -> Vector:
            return self._solve_linear(step, g, y, self._limit_tolerance(y), False)[0]

        def solve(f: Callable[[Vector], Vector], u: Vector) -> tuple[Vector, list[Array]]:
            u, reported = self._iterate_newton(step, f, u)
            # as floats: jax 0.10 differentiates what comes along, and numbers that count have no derivative
            return u, [leaf.astype(u[0].dtype) for leaf in reported]

        u, (relative, products, ok) = lax.custom_root(residual, guess, solve, tangent, has_aux=True)
        return u, SolveReport(relative, products.astype(jnp.int32), ok > 0)

    def _iterate_newton(self, step: "_Step", residual: Callable, u: Vector) -> tuple[Vector, SolveReport]:
        zero = residual(step.zero_change())
        size = step.inner(zero, zero)
        goal = self._limit_tolerance(u) ** 2 * size

        def body(carry: tuple[Vector, Array, Array, Array, Array]) -> tuple[Vector, Array, Array, Array, Array]:
            u, square, going, count, i = carry
            r, tangent = jax.linearize(residual, u)
            # solving for more digits than Newton's method still misses would be wasted
            missing = jnp.sqrt(goal / jnp.where(square > 0, square, 1.0))
            change, reported = self._solve_linear(
                step, tangent, r, jnp.clip(0.1 * missing, SMALLEST_FORCING_TERM, LARGEST_FORCING_TERM), False
            )
            u, after = _search_line(step, residual, u, change, square, going)
            count = count + jnp.where(going, reported.products, 0)
            return u, after, going & (after > goal) & (after < square), count, i + 1

        r = residual(u)
        square = step.inner(r, r)
        start = (u, square, square > goal, jnp.zeros(size.shape, jnp.int32), jnp.zeros((), jnp.int32))
        u, square, _, count, _ = lax.while_loop(lambda c: any_lane(c[2]) & (c[-1] < self.newton), body, start)
        return u, build_report(square, size, goal, count)

    def _limit_tolerance(self, b: Vector) -> float:
        """The tolerance, or what rounding leaves of it."""
        eps = float(jnp.finfo(b[0].dtype).eps)
        return eps**0.5 if self.tolerance is None else max(self.tolerance, 4 * eps)

    def _solve_linear(
        self, step: "_Step", matvec: Callable, b: Vector, tolerance: ArrayLike, dissipative_symmetric: bool
    ) -> tuple[Vector, SolveReport]:
        """matvec(u) = b: in closed form where lanes stand alone, else iteratively."""
        if step.is_independent and len(b) == 1 and b[0].ndim and b[0].shape[-1] <= MAX_CRAMER_UNKNOWNS:
            u = _solve_per_lane(matvec, b[0])
            r, size = _subtract(b, matvec([u])), step.inner(b, b)
            products = jnp.full(size.shape, b[0].shape[-1], jnp.int32)
            return [u], build_report(step.inner(r, r), size, tolerance**2 * size, products)
        iterate = conjugate_gradients if dissipative_symmetric else stabilised_biconjugate_gradients

        def solve(matvec: Callable[[Vector], Vector], b: Vector) -> tuple[Vector, SolveReport]:
            return iterate(matvec, b, step.inner, tolerance, self.iterations)

        def transposed(matvec: Callable[[Vector], Vector], b: Vector) -> tuple[Vector, SolveReport]:
            # self-adjoint with the masses' inverse where the matrix is with the masses
            return iterate(matvec, b, step.inner_of_dual, tolerance, self.iterations)

        return lax.custom_linear_solve(matvec, b, solve, transposed, has_aux=True)


class _Step(NamedTuple):
    """A step to be solved: the system, the end of the step [s], the start's state, and which of its leaves a kick changes."""

    system: System
    end: Time
    state: PyTree
    dt: jax.Array
    kicked_leaves: tuple[bool, ...]

    @classmethod
    def of(cls, system: System, t: Time, state: PyTree, dt: ArrayLike) -> "_Step":
        kicked_leaves = []

        def kick(state: PyTree) -> PyTree:
            after = system.kick(state, state, dt)
            pairs = zip(jax.tree.leaves(state), jax.tree.leaves(after), strict=True)
            kicked_leaves.extend(before is not now for before, now in pairs)
            return after

        jax.eval_shape(kick, state)
        dtype = jax.tree.leaves(state)[0].dtype
        return cls(system, t + dt, state, jnp.asarray(dt, dtype), tuple(kicked_leaves))

    @property
    def is_independent(self) -> bool:
        """Whether each lane is a system of its own."""
        return not read_traits(self.system).couples or has_no_lanes(self.state)

    def linearised(self) -> System:
        """The system that is linearised."""
        return linearise_at(self.system, self.end, self.state)

    def select_kicked(self, tree: PyTree) -> Vector:
        """The leaves of a state that a kick changes."""
        return [leaf for leaf, place in zip(jax.tree.leaves(tree), self.kicked_leaves, strict=True) if place]

    def kick(self, rate: PyTree) -> Vector:
        """dt·rate, of the leaves that a kick changes."""
        return self.select_kicked(self.system.kick(jax.tree.map(jnp.zeros_like, self.state), rate, self.dt))

    def zero_change(self) -> Vector:
        """No change."""
        return [jnp.zeros_like(leaf) for leaf in self.select_kicked(self.state)]

    def mask_held(self, u: Vector) -> Vector:
        """u with zero for held lanes, which do not move: the matrix is then symmetric in them as well."""
        held = read_traits(self.system).held
        return u if held is None else [scale(1 - held.astype(leaf.dtype), leaf) for leaf in u]

    def add_change(self, u: Vector) -> PyTree:
        """The state with u added to what a kick changes."""
        leaves, tree = jax.tree.flatten(self.state)
        more = iter(u)
        return jax.tree.unflatten(
            tree, [leaf + next(more) if place else leaf for leaf, place in zip(leaves, self.kicked_leaves, strict=True)]
        )

    def end_state(self, u: Vector) -> PyTree:
        """The state at the end of the step."""
        return self.system.drift(self.add_change(u), self.dt)

    def inner(self, a: Vector, b: Vector) -> jax.Array:
        """Σ m a·b for each system."""
        return self._sum([scale(self._mass(), p) for p in a], b)

    def inner_of_dual(self, a: Vector, b: Vector) -> jax.Array:
        """Σ a·b/m for each system."""
        return self._sum([scale(1 / self._mass(), p) for p in a], b)

    def _mass(self) -> jax.Array:
        """The mass of each lane; one for bodies, whose momenta are not velocities, and for a system without masses."""
        mass = read_traits(self.system).mass
        return jnp.asarray(mass) if isinstance(mass, jax.Array | np.ndarray) else jnp.ones((), self.dt.dtype)

    def _sum(self, a: Vector, b: Vector) -> jax.Array:
        kept = len(read_traits(self.system).status_shape)
        return reduce(jnp.add, [_sum_trailing_axes(p * q, kept) for p, q in zip(a, b, strict=True)])


def _sum_trailing_axes(a: jax.Array, kept: int) -> jax.Array:
    """The sum over all axes but the first `kept`."""
    return jnp.sum(a, axis=tuple(range(kept, a.ndim)))


def _subtract(a: Vector, b: Vector) -> Vector:
    return [p - q for p, q in zip(a, b, strict=True)]


def _search_line(
    step: _Step, residual: Callable, u: Vector, change: Vector, square: jax.Array, going: jax.Array
) -> tuple[Vector, jax.Array]:
    """u - change, each system's change halved until its residual falls, left out where that does not help."""

    def tried(share: Array) -> Array:
        new = [a - scale(share, b) for a, b in zip(u, change, strict=True)]
        r = residual(new)
        return step.inner(r, r)

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


@jax.jit
def _report_step(method: ImplicitEuler, scene: Scene, t: jax.Array, dt: jax.Array) -> SolveReport:
    return method.solve_step(scene.averaged_over_step(t, dt), t, scene.state, dt)[1]
