"""Run a scene under many methods and step sizes, and set error against cost."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import jax
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import PyTree

from physjax.checks import as_positive_integer, as_real_quantity
from physjax.compiling import announce_compiling
from physjax.particles import Particles
from physjax.scene import Scene
from physjax.stepping.reference import build_default_solver, cast_floats
from physjax.study.accuracy.compiled_run import draw_random_push, list_treatments
from physjax.study.accuracy.error_measures import as_error_measure
from physjax.study.accuracy.method_facts import list_adaptive_methods, list_methods, method_title
from physjax.study.accuracy.options import THOROUGH, Budget, Options, merge_options
from physjax.study.accuracy.reference_solution import ReferenceSolution, solve_reference
from physjax.study.accuracy.result import Run, WorkPrecision
from physjax.study.accuracy.runs import Comparison, run_gradient, run_method, run_rival
from physjax.study.energy.quantities import Conserved
from physjax.study.problem import Problem
from physjax.tracebacks import shorten_tracebacks

if TYPE_CHECKING:
    import diffrax

REFERENCE_FRAMES_PER_FRAME = 12
"""Moments of the reference path for every one at which errors are measured."""

REFERENCE_ERROR = 2.5e-11
"""Error for which our own rk4 is made fine enough where it must be the truth: its last refinement is then below 1e-12."""

HORIZON_ERROR_SHARE = 1e-2
"""Share of the path to which rounding may grow before errors from point to point mean nothing."""


@shorten_tracebacks
@announce_compiling("work_precision")
def work_precision(
    problem: Problem | Scene,
    methods: Sequence[Callable] | None = None,
    dts: ArrayLike | Sequence[float] | None = None,
    *,
    duration: float | None = None,
    exact: Callable[[np.ndarray], PyTree] | None = None,
    budget: Budget = THOROUGH,
    options: Options = Options(),  # noqa: B008  a record that nothing changes
    **more: object,
) -> WorkPrecision:
    """Run a scene under many methods and step sizes, and set error against cost.

    `problem` is a gallery problem, or a scene with its `duration` [s] and, if known, its closed form `exact(times)`.
    `methods`: all of the registry by default; `methods.adaptive(...)` runs at the `tolerances`. `dts` [s]: from coarse
    to fine within the budget by default; each is rounded so that a whole number of steps fits between the moments
    compared. Everything rarer is a field of `accuracy.Options`, accepted as a keyword as well: `conserved`, `norms`,
    `rivals`, `tolerances`, `dtype`, `batch`, `gradient`, `name`, `progress`.

    The truth is the closed form where there is one, else diffrax's Dopri8 at 1e-13, or, where diffrax has no rivals
    either, our own rk4 with fine steps; its own error is the floor of the result. Where impacts are timed
    (`contacts.impact`), every method runs once more with `contacts.project`, the lecture's response at the end of the
    step, as "rk4, projected": what that does to the order. Compiles once per method and treatment. Raises ValueError for
    a missing duration or bad steps, TypeError for an unknown option.

    Example:
        >>> chart = accuracy.work_precision(swing, [methods.verlet], [1 / 16, 1 / 32], duration=2.0, rivals=())
        >>> ratio = chart.runs[0].final_error / chart.runs[1].final_error
        >>> [run.steps for run in chart.runs], round(ratio, 1)
        ([32, 64], 4.0)
    """
    options = merge_options("work_precision", options, more)
    problem = _as_problem(problem, duration, exact, options.conserved)
    rivals, batch = _check_rivals(problem, options.rivals), as_positive_integer("batch", options.batch)
    norms = tuple(as_error_measure(norm) for norm in options.norms)
    if dts is not None:
        dts = np.atleast_1d(np.asarray(as_real_quantity("dts [s]", dts, above=0.0), float))
    with jax.enable_x64(True):
        options.progress("reference")
        push = draw_random_push(problem.scene) if options.gradient else None
        closer = problem._replace(frames=problem.frames * REFERENCE_FRAMES_PER_FRAME)
        detailed = solve_reference(closer, wanted=REFERENCE_ERROR, push=push)
        truth = _pick_frames(detailed)
        comparison = Comparison(problem, truth, norms, budget, dts, options.tolerances, batch)
        chosen = list_compared_methods(problem.scene) if methods is None else list(methods)
        runs, slopes, promised = _run_methods(comparison, chosen, options, push)
        for solver in rivals:
            options.progress(f"diffrax {type(solver).__name__}")
            runs += run_rival(comparison, cast_floats(problem.scene, _list_dtypes(options)[0]), solver)
    return _gather_result(comparison, detailed, options, runs, slopes, promised)


def list_compared_methods(scene: Scene) -> list[Callable]:
    """What is compared where no methods are given: all that a scene may be stepped by, and the best under error control.

    Example:
        >>> compared = accuracy.list_compared_methods(swing)
        >>> methods.verlet in compared, methods.dprkn6 in compared
        (True, True)
    """
    return [*list_methods(scene).values(), *list_adaptive_methods(scene)[:1]]


def _run_methods(
    comparison: Comparison, methods: Sequence[Callable], options: Options, push: Particles | None
) -> tuple[list[Run], list[Run], dict[str, float]]:
    """The runs of every method, treatment and float type, those of the gradient, and the orders promised."""
    runs, slopes, promised = [], [], {}
    for method in methods:
        options.progress(method_title(method))
        for treatment, scene in list_treatments(comparison.problem.scene).items():
            for dtype in _list_dtypes(options):
                found, order = run_method(comparison, scene, method, treatment, dtype)
                runs += found
                promised[found[-1].method] = order
            slopes += [] if push is None else run_gradient(comparison, scene, method, treatment, push)
    return runs, slopes, promised


def _gather_result(
    comparison: Comparison,
    detailed: ReferenceSolution,
    options: Options,
    runs: list[Run],
    slopes: list[Run],
    promised: dict[str, float],
) -> WorkPrecision:
    problem, dtypes = comparison.problem, _list_dtypes(options)
    return WorkPrecision(
        name=options.name,
        runs=tuple(runs),
        promised=promised,
        truth=detailed.source,
        floor=float(detailed.truth_error().max()),
        duration=problem.duration,
        conserved=tuple(quantity.name for quantity in problem.conserved),
        dtype=" and ".join(dtype.name for dtype in dtypes),
        path=(detailed.times, detailed.states.position),
        scattered=problem.scene.resolves_at_step_end,
        norms=tuple(norm.name for norm in comparison.norms),
        horizon=detailed.horizon(HORIZON_ERROR_SHARE, float(np.finfo(dtypes[0]).eps)),
        batch=comparison.batch,
        gradients=tuple(slopes),
    )


def _list_dtypes(options: Options) -> list[np.dtype]:
    given = options.dtype
    return [np.dtype(dtype) for dtype in (given if isinstance(given, list | tuple) else (given,))]


def _pick_frames(detailed: ReferenceSolution) -> ReferenceSolution:
    """The truth at the moments at which errors are measured."""
    pick = lambda tree: jax.tree.map(lambda leaf: leaf[::REFERENCE_FRAMES_PER_FRAME], tree)  # noqa: E731
    return detailed._replace(
        times=pick(detailed.times),
        states=pick(detailed.states),
        second=pick(detailed.second),
        nudged=pick(detailed.nudged),
        slopes=pick(detailed.slopes),
    )


def _as_problem(
    problem: Problem | Scene, duration: float | None, exact: Callable | None, conserved: Sequence[Conserved]
) -> Problem:
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


def _check_rivals(problem: Problem, rivals: "Sequence[diffrax.AbstractERK] | None") -> "Sequence[diffrax.AbstractERK]":
    if rivals is None:
        return default_rivals() if problem.is_ode else ()
    if rivals and not problem.is_ode:
        raise ValueError(
            "work_precision: the scene has contacts, through which diffrax would pass, or forces that remember, which it "
            "would not let advance. Give rivals=()."
        )
    return rivals


def default_rivals() -> "tuple[diffrax.AbstractERK, ...]":
    """The adaptive solvers that a user of diffrax would reach for first: Tsit5, and Dopri8 for many digits.

    Example:
        >>> [type(rival).__name__ for rival in accuracy.default_rivals()]
        ['Tsit5', 'Dopri8']
    """
    import diffrax

    return diffrax.Tsit5(), build_default_solver()
