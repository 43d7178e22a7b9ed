"""Speed against accuracy: how wrong is a run, what does it cost, and which method is cheapest for an error you can bear?

Everything is computed in float64 unless another dtype is asked for, errors are measured in positions, relative to how
far the reference moves, and a run that fails is kept and marked, never dropped.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.typing import ArrayLike

from physjax.checks import as_positive_integer, as_real_quantity
from physjax.scene import Scene
from physjax.stepping.methods import METHODS
from physjax.stepping.reference import build_default_solver, cast_floats
from physjax.study.accuracy.error_measures import ErrorMeasure, as_error_measure
from physjax.study.accuracy.method_facts import depends_on_velocity, draw_random_push, method_title, promised_order
from physjax.study.accuracy.reference_solution import ReferenceSolution, solve_reference
from physjax.study.accuracy.result import WorkPrecision
from physjax.study.accuracy.runs import Budget, Comparison, list_treatments, run_gradient, run_method, run_rival
from physjax.study.energy.quantities import Conserved
from physjax.study.problem import Problem

TOLERANCES = tuple(10.0**-k for k in range(2, 13))
"""Tolerances at which what chooses its own steps runs."""

REFERENCE_FRAMES_PER_FRAME = 12
"""Moments of the reference path for every one at which errors are measured."""

REFERENCE_ERROR = 2.5e-11
"""Error for which our own rk4 is made fine enough where it must be the truth: its last refinement is then below 1e-12."""

HORIZON_ERROR_SHARE = 1e-2
"""Rounding that has grown to this part of the path leaves no meaning to errors from point to point."""

THOROUGH = Budget()
"""Step sizes half an order apart, each timed well."""
QUICK = Budget(seconds=0.01, repeats=2, refinement=2.0)
"""A look in a few seconds."""


def work_precision(
    problem: Problem | Scene,
    methods: Sequence[Callable] | None = None,
    dts: ArrayLike | Sequence[float] | None = None,
    *,
    duration: float | None = None,
    exact: Callable | None = None,
    conserved: Sequence[Conserved] = (),
    norms: Sequence[ErrorMeasure | Callable] = (),
    rivals: Sequence[Any] | None = None,
    tolerances: Sequence[float] = TOLERANCES,
    dtype: Any = np.float64,
    batch: int = 1,
    gradient: bool = False,
    budget: Budget = THOROUGH,
    name: str = "scene",
    progress: Callable[[str], None] = lambda what: None,
) -> WorkPrecision:
    """Run a scene under many methods and step sizes, and set error against cost.

    `problem` is a gallery problem, or a scene with its `duration` [s] and, if known, its closed form `exact(times)`.
    `methods`: all of the registry by default; `methods.adaptive(...)` runs at the `tolerances`. `dts` [s]: from coarse
    to fine within the budget by default; each is rounded so that a whole number of steps fits between the moments
    compared. `norms`: errors to be measured besides those of the path and its end. `rivals`: diffrax solvers, run
    adaptively at the `tolerances`; Tsit5 and Dopri8 by default, none where the scene has contacts or forces that
    remember. `dtype` may be several, side by side. Times are those of `batch` copies at once. With `gradient` the
    derivative of the path by the start's velocity, in a random direction, is studied as well.

    The truth is the closed form where there is one, else diffrax's Dopri8 at 1e-13, or, where diffrax has no rivals
    either, our own rk4 with fine steps; its own error is the floor of the result. Where impacts are timed
    (`contacts.impact`), every method runs once more with `contacts.project`, the lecture's answer at the end of the
    step, as "rk4, projected": what that does to the order. Compiles once per method and treatment. `progress(what)` is
    called before each method. Raises ValueError for a missing duration or bad steps.

    Example:
        >>> chart = accuracy.work_precision(swing, [methods.verlet], [1 / 16, 1 / 32], duration=2.0, rivals=())
        >>> ratio = chart.runs[0].final_error / chart.runs[1].final_error
        >>> [run.steps for run in chart.runs], round(ratio, 1)
        ([32, 64], 4.0)
    """
    problem = _as_problem(problem, duration, exact, conserved)
    methods = list(METHODS.values()) if methods is None else list(methods)
    rivals = _check_rivals(problem, rivals)
    if dts is not None:
        dts = np.atleast_1d(np.asarray(as_real_quantity("dts [s]", dts, above=0.0), float))
    dtypes = [np.dtype(d) for d in (dtype if isinstance(dtype, list | tuple) else (dtype,))]
    batch, norms = as_positive_integer("batch", batch), tuple(as_error_measure(norm) for norm in norms)
    with jax.enable_x64(True):
        progress("reference")
        push = draw_random_push(problem.scene) if gradient else None
        detailed = solve_reference(
            problem._replace(frames=problem.frames * REFERENCE_FRAMES_PER_FRAME), wanted=REFERENCE_ERROR, push=push
        )
        contest = Comparison(problem, _pick_frames(detailed), norms, budget, dts, tolerances, batch)
        runs, slopes, promised = [], [], {}
        pulled = depends_on_velocity(problem.scene)
        for method in methods:
            progress(method_title(method))
            for suffix, treated in list_treatments(problem.scene).items():
                for kind in dtypes:
                    runs += run_method(contest, treated, method, suffix, kind)
                    promised[runs[-1].method] = promised_order(method, pulled, treated)
                slopes += run_gradient(contest, treated, method, suffix, push) if gradient else []
        for solver in rivals:
            progress(f"diffrax {type(solver).__name__}")
            runs += run_rival(contest, cast_floats(problem.scene, dtypes[0]), solver)
    return WorkPrecision(
        name=name,
        runs=tuple(runs),
        promised=promised,
        truth=detailed.source,
        floor=float(detailed.truth_error().max()),
        duration=problem.duration,
        conserved=tuple(quantity.name for quantity in problem.conserved),
        dtype=" and ".join(kind.name for kind in dtypes),
        path=(detailed.times, detailed.states.position),
        scattered=problem.scene.resolves_at_step_end,
        norms=tuple(norm.name for norm in norms),
        horizon=detailed.horizon(HORIZON_ERROR_SHARE, float(np.finfo(dtypes[0]).eps)),
        batch=batch,
        gradients=tuple(slopes),
    )


def _pick_frames(detailed: ReferenceSolution) -> ReferenceSolution:
    """The truth at the moments at which errors are measured."""
    fewer = lambda tree: jax.tree.map(lambda leaf: leaf[::REFERENCE_FRAMES_PER_FRAME], tree)  # noqa: E731
    parts = {name: fewer(getattr(detailed, name)) for name in ("states", "second", "nudged", "slopes")}
    return detailed._replace(times=detailed.times[::REFERENCE_FRAMES_PER_FRAME], **parts)


def _as_problem(problem, duration, exact, conserved):
    if isinstance(problem, Problem):
        return problem
    if not isinstance(problem, Scene):
        raise TypeError(
            f"work_precision: got a {type(problem).__name__}, expected a Scene or a Problem of the gallery."
        )
    if duration is None:
        raise ValueError("work_precision: got a scene without a duration, expected duration= [s].")
    as_real_quantity("duration [s]", duration, above=0.0)
    return Problem(problem, float(duration), exact, tuple(conserved))


def _check_rivals(problem, rivals):
    if rivals is None:
        return default_rivals() if problem.is_ode else ()
    if rivals and not problem.is_ode:
        raise ValueError(
            "work_precision: the scene has contacts, through which diffrax would pass, or forces that remember, which it "
            "would not let advance. Give rivals=()."
        )
    return rivals


def default_rivals() -> tuple:
    """The adaptive solvers that a user of diffrax would reach for first: Tsit5, and Dopri8 for many digits.

    Example:
        >>> [type(rival).__name__ for rival in accuracy.default_rivals()]
        ['Tsit5', 'Dopri8']
    """
    import diffrax

    return diffrax.Tsit5(), build_default_solver()
