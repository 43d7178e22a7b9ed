"""Methods whose force acts at the end of a stage, so that no step is too long for stiff springs.

Implicit Euler, linearised at the start of the step (D. Baraff and A. Witkin, "Large steps in cloth simulation", 1998), is
(1 - dt ∂a/∂v - dt² ∂a/∂x) Δv = dt (a + dt ∂a/∂x v), a and its derivatives at (t + dt, x, v). The methods of second order
linearise each stage where it would end without its force: what a linearisation leaves out then costs no order.
"""

from abc import abstractmethod
from functools import reduce
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import PyTree

from physjax.loops import Time
from physjax.scene import Scene
from physjax.stepping.dependence import find_kicked
from physjax.stepping.implicit_solution import SMALLEST_FORCING_TERM, StageSolver
from physjax.stepping.implicit_stage import Linearised, Stage, add_change, build_stage, take_kick
from physjax.stepping.krylov import SolveReport, Vector
from physjax.stepping.pairs import Attempt
from physjax.stepping.registry import Promises
from physjax.stepping.system import S, System, average_over_step, leaf_dtype, push_drift
from physjax.tracebacks import Module
from physjax.vectors import scale

DIAGONAL = 1 - 2**0.5 / 2
"""TR-BDF2: the share d of the implicit force in both stages, half of γ = 2 - √2, so that both have one matrix."""
WEIGHT = 2**0.5 / 4
"""TR-BDF2: the share w of the slopes at the start and at γ in the whole step; 2w + d = 1."""
ERROR_WEIGHTS = ((4 * WEIGHT - 1) / 3, -1 / 3, 2 * DIAGONAL / 3)
"""TR-BDF2: its weights less those of order 3 on the same slopes (M. E. Hosea and L. F. Shampine 1996)."""


class ImplicitMethod(Module):
    """A method that solves the equation of a stage, once or more often a step: its settings, and how it reports."""

    tolerance: float | None = eqx.field(static=True, default=None)
    iterations: int = eqx.field(static=True, default=1000)
    newton: int = eqx.field(static=True, default=0)

    name: ClassVar[str]
    exact_tangents: ClassVar[bool] = False

    def __check_init__(self):
        kind, given = type(self).__name__, 0.5 if self.tolerance is None else self.tolerance
        if not isinstance(given, int | float) or not 0 < given < 1:
            raise ValueError(
                f"{kind}: got tolerance={self.tolerance!r}, expected a number between 0 and 1: the relative residual."
            )
        for name, value, least in (("iterations", self.iterations, 1), ("newton", self.newton, 0)):
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ValueError(f"{kind}: got {name}={value!r}, expected an integer of at least {least}.")

    @property
    def __name__(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]  # of the instance, as a function has
        return self.name if not self.newton else f"{self.name}, converged"

    def __call__(self, system: System, t: Time, state: S, dt: ArrayLike) -> S:
        """The state after a step dt [s] from the time t [s]."""
        return self.solve_step(system, t, state, dt)[0]

    def report(self, scene: Scene, dt: ArrayLike, t: ArrayLike = 0.0) -> SolveReport:
        """How the step from `scene.state` is solved: relative residual, products with the matrix, ok; for each scene."""
        return _report_step(self, scene, jnp.asarray(t, scene.state.dtype), jnp.asarray(dt, scene.state.dtype))

    @abstractmethod
    def solve_step(self, system: System, t: Time, state: S, dt: ArrayLike) -> tuple[S, SolveReport]:
        """The state after a step dt [s] from the time t [s], and how it was solved."""

    @property
    def _solver(self) -> StageSolver:
        return StageSolver(self.tolerance, self.iterations, self.newton, self.exact_tangents)


class ImplicitEuler(ImplicitMethod):
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

    name = "implicit_euler"
    exact_tangents = True
    promises = Promises(order=1, evaluations=1, stability_limit=float("inf"), order_with_drag=1)

    def solve_step(self, system: System, t: Time, state: S, dt: ArrayLike) -> tuple[S, SolveReport]:
        """The state after a step dt [s] from the time t [s], and how it was solved."""
        h = jnp.asarray(dt, leaf_dtype(state))
        way, free = push_drift(system, state, 0.0, h), system.drift(state, h)
        stage = Stage(system, t + dt, state, h, state, way, free, find_kicked(system, state))
        u, reported = self._solver.solve(stage, stage.linearise())
        return stage.end_state(u), reported


class ImplicitMidpoint(ImplicitMethod):
    """The implicit midpoint rule: order 2, and linear springs keep their energy at any step, to the residual of the solver.

    A stage of implicit Euler to the middle of the step, and as much again. Nothing is damped: what a step does not resolve
    goes on vibrating, and where springs turn in a step it may grow. A taut rope that swings by 0.3 rad keeps its energy in
    steps 20 times as long as verlet's, and breaks up at 100 times. Settings are those of `ImplicitEuler`: `newton` = 0 suits
    springs that hardly turn in a step, and drag; a cloth needs `newton` = 20 from 20 times verlet's step on, or `tr_bdf2`.
    Where bodies rotate in space the order is 2 as well. Newton's method takes the forces' own linearisation.

    Example:
        >>> end = swing.step(methods.implicit_midpoint, 0.0, 100.0).state
        >>> round(float(end.position[0] ** 2 + end.velocity[0] ** 2 / 4.0), 6)
        1.0
    """

    name = "implicit_midpoint"
    promises = Promises(order=2, evaluations=1, stability_limit=float("inf"), order_with_drag=2)

    def solve_step(self, system: System, t: Time, state: S, dt: ArrayLike) -> tuple[S, SolveReport]:
        """The state after a step dt [s] from the time t [s], and how it was solved."""
        half = dt / 2
        stage = build_stage(system, t + half, state, half)
        u, reported = self._solver.solve(stage, stage.linearise())
        return add_change(system.drift(stage.end_state(u), half), u, stage.kicked_leaves), reported


class TrBdf2(ImplicitMethod):
    """TR-BDF2: the trapezoidal rule to 0.586 of the step, then the backward difference of order 2. Damps what is stiff.

    L-stable: a mode at λdt = -10⁴ is damped to 5e-4 a step, while an oscillation that a step resolves loses only
    0.0037 (ωdt)⁴ of its amplitude (R. E. Bank et al. 1985). Two solves a step, with the same matrix where forces are linear,
    each with 0.29 of dt: together about as many products as one of implicit Euler. Settings are those of `ImplicitEuler`:
    `newton` = 0, linearised once a stage, suits steps to about 20 times verlet's; at 100 times a rope or a cloth that swings
    then gains energy, and `newton` = 20 keeps it stable and 99 % of its energy a period. Where bodies rotate in space the
    order is 2 as well. Newton's method takes the forces' own linearisation: of compressed springs it converges slowly.

    As a `pair` it knows its error, filtered through the matrix (M. E. Hosea and L. F. Shampine, "Analysis and implementation
    of TR-BDF2", Appl. Numer. Math. 20 (1996) 21), so that stiff motion which it damps does not shorten the steps of `adaptive`.

    Example:
        >>> end = swing.step(methods.tr_bdf2, 0.0, 0.05).state
        >>> bool(abs(end.position[0] - np.cos(2.0 * 0.05)) < 1e-4)
        True
    """

    name = "tr_bdf2"
    promises = Promises(order=2, evaluations=3, stability_limit=float("inf"), order_with_drag=2)
    error_order: ClassVar[int] = 2
    dense_order: ClassVar[int] = 2
    keeps_slope: ClassVar[bool] = False

    @property
    def pair(self) -> "TrBdf2":
        """The method itself knows the error of a step."""
        return self

    def solve_step(self, system: System, t: Time, state: S, dt: ArrayLike) -> tuple[S, SolveReport]:
        """The state after a step dt [s] from the time t [s], and how it was solved."""
        end, _, _, reported = self._take_stages(system, t, state, dt, None)
        return end, reported

    def attempt(self, system: System, t: Time, state: PyTree, dt: ArrayLike, slope: PyTree) -> Attempt:
        """A step dt [s] from the time t [s] with its error; `slope` is the rate there, None where it is to be computed."""
        end, ends, (kicks, last), _ = self._take_stages(average_over_step(system, t, dt), t, state, dt, slope)
        return Attempt(end, self._estimate_error(last, (state, *ends), kicks, dt), None, ends[0])

    def interpolate(
        self, system: System, t: Time, state: PyTree, dt: ArrayLike, attempt: Attempt, share: ArrayLike
    ) -> PyTree:
        """The state at a share [1] of an attempted step: the parabola through its start, its middle stage and its end."""
        node = 2 * DIAGONAL
        first, second = share * (1 - share) / (node * (1 - node)), share * (share - node) / (1 - node)

        def between(start: jax.Array, middle: jax.Array, end: jax.Array) -> jax.Array:
            return start + scale(first, middle - start) + scale(second, end - start)

        return jax.tree.map(between, state, attempt.stages, attempt.end)

    def _take_stages(
        self, system: System, t: Time, state: S, dt: ArrayLike, slope: S | None
    ) -> tuple[S, tuple[S, S], tuple[tuple[Vector, ...], Linearised], SolveReport]:
        """The end, the ends of both stages, the kicks h·K f of the three slopes with the last matrix, and the report."""
        h, across = DIAGONAL * dt, WEIGHT * dt
        kicked = find_kicked(system, state)
        first = take_kick(system, state, system.rate(t, state) if slope is None else slope, h, kicked)
        trapezoid = _build_trapezoid(system, t, state, jnp.asarray(h, leaf_dtype(state)), first, kicked)
        second, reported = self._solver.solve(trapezoid, trapezoid.linearise())

        both = jax.tree.map(jnp.add, first, second)
        onward = system.drift(add_change(system.drift(state, across), both, kicked), across)
        more = [(WEIGHT / DIAGONAL - 1) * u for u in both]
        stage = build_stage(system, t + dt, add_change(onward, more, kicked), h)
        linearised = stage.linearise()
        third, report = self._solver.solve(stage, linearised)
        end = stage.end_state(third)
        ends = (trapezoid.end_state(second), end)
        return end, ends, ((first, second, third), linearised), _join_reports(reported, report)

    def _estimate_error(
        self, last: Linearised, states: tuple[PyTree, ...], kicks: tuple[Vector, ...], dt: ArrayLike
    ) -> PyTree:
        """What the step may be wrong by: the difference from order 3, filtered through the matrix.

        Unfiltered it would be that of stiff motion which the step damps, and grow with the stiffness.
        """
        stage, system = last.stage, last.stage.system
        drifted = [push_drift(system, y, 0.0, weight * dt) for y, weight in zip(states, ERROR_WEIGHTS, strict=True)]
        moved = reduce(lambda a, b: jax.tree.map(jnp.add, a, b), drifted)
        shares = [weight / DIAGONAL for weight in ERROR_WEIGHTS]
        kicked = [
            sum(share * u for share, u in zip(shares, leaves, strict=True)) for leaves in zip(*kicks, strict=True)
        ]
        b = jax.tree.map(jnp.add, kicked, stage.kick(last.push(moved)))
        w, _ = self._solver.solve_linearised(last, b, SMALLEST_FORCING_TERM)
        return jax.tree.map(jnp.add, moved, last.move(w))


def _build_trapezoid(system: System, t: Time, state: PyTree, h: jax.Array, kick: Vector, kicked: list[bool]) -> Stage:
    """The trapezoidal rule over 2h: half of it by the force at the start, whose `kick` is known, half by that at the end.

    Linearised at the end of a free drift: the force at the start may be that of stiff springs, which the end damps.
    """
    middle = system.drift(state, h)
    near, way = jax.jvp(
        lambda u: system.drift(add_change(middle, u, kicked), h), ([jnp.zeros_like(u) for u in kick],), (kick,)
    )
    return Stage(system, t + 2 * h, add_change(middle, kick, kicked), h, near, way, near, kicked)


def _join_reports(first: SolveReport, second: SolveReport) -> SolveReport:
    """The report on two solves: the larger residual, the sum of products."""
    return SolveReport(
        jnp.maximum(first.residual, second.residual), first.products + second.products, first.ok & second.ok
    )


@jax.jit
def _report_step(method: Any, scene: Scene, t: jax.Array, dt: jax.Array) -> SolveReport:
    return method.solve_step(scene.averaged_over_step(t, dt), t, scene.state, dt)[1]
