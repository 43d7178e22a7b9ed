"""Which method, which step, which float type: measured on your own scene, on this machine, with the reason.

A few runs of each method from coarse to fine show its error and its cost; between them lies the step for the error
that is asked for, which is then verified by a run. Only what can still win is verified, and only that is timed well.
"""

from collections.abc import Callable, Sequence

import jax
import numpy as np
from tqdm import tqdm

from physjax.backend import read_work_clock
from physjax.checks import as_positive_integer, as_real_quantity
from physjax.compiling import announce_compiling
from physjax.scene import Scene
from physjax.study.accuracy.bounds import NO_BOUND, Nearby, bound_error, list_nearby
from physjax.study.accuracy.compiled_run import CompiledRun, compile_run, draw_random_push
from physjax.study.accuracy.error_measures import ErrorMeasure, as_error_measure, path
from physjax.study.accuracy.exploring import compile_ahead, explore_methods, list_candidates, rate_candidates
from physjax.study.accuracy.options import SearchOptions, merge_options
from physjax.study.accuracy.reasons import (
    SAFE_ERROR_SHARE,
    TRUTH_ERROR_SHARE,
    explain_choice,
    explain_failure,
    is_float32_accurate,
)
from physjax.study.accuracy.recommendation import Choice, Recommendation
from physjax.study.accuracy.reference_solution import solve_reference, suits_diffrax
from physjax.study.accuracy.search import (
    MAX_RUN_SECONDS,
    Exploration,
    SearchTask,
    Trial,
    estimate_richardson_error,
    refine_step,
    run_trial,
    time_finalists,
)
from physjax.study.problem import Problem
from physjax.text import progress_bar
from physjax.tracebacks import shorten_tracebacks

MAX_FINALISTS, FINALIST_TIME_RATIO = 3, 2.0
"""Methods that are verified and timed for an error, by what their runs predict, if at most this many times slower than others."""
REFERENCE_TIME_SHARE = 0.2
"""Share of the search's time that the true path may take, where our own steps are refined for it."""
FLOAT32_FINENESS_FACTORS = (1.0, 1.25)
"""How much finer than in float64 a run in float32 is tried: its rounding takes a part of the error."""
MIN_NUMBERS_FOR_FLOAT32 = 512
"""Numbers in a state below which a run takes as long in either precision, to a tenth (measured with drag on 16 to 8192)."""


@shorten_tracebacks
@announce_compiling("recommend")
def recommend(
    scene: Scene,
    *,
    error: float | Sequence[float],
    horizon: float,
    norm: ErrorMeasure | Callable = path,
    methods: Sequence[Callable] | None = None,
    seconds: float = 15.0,
    options: SearchOptions = SearchOptions(),  # noqa: B008  a record that nothing changes
    **more: object,
) -> Recommendation | tuple[Recommendation, ...]:
    """The fastest way to run a scene for `horizon` [s] with at most this `error`; for several errors a tuple, by one search.

    Errors are relative to the extent of the true path (`norm`: see `accuracy.path` and its neighbours; or your own
    function (times, states)), or in units of `scale`, at `frames` equally spaced moments. The truth is diffrax's Dopri8;
    with contacts, forces that remember or more than 20 000 numbers, our rk4 with far finer steps, judged by Richardson:
    the answer says which. `methods`: those of the registry that suit the scene, with equal steps and, where they know their
    errors, with steps of their own, unless given; those that promise no more than another in any respect are left out,
    adaptive ones also where there are contacts, implicit ones where accuracy limits the step before stability does, and
    what the runs of others show to be slower is not even compiled.
    `seconds` of processor time (of wall-clock time where the work is not on a CPU) bound the search: what is not reached
    is reported. Everything rarer is a field of `accuracy.SearchOptions`, accepted as a keyword as well: `gradient`,
    `scale`, `dtypes`, `frames`, `progress`.
    Each answer has a bound on its error with a confidence (`error_bound`), from runs of starts that differ by a percent, and
    says where motion is chaotic (`lyapunov_time`).
    Raises ValueError or TypeError for bad input; where nothing keeps the error, the answer says what stops it.

    Example:
        >>> advice = accuracy.recommend(
        ...     swing, error=1e-3, horizon=2.0, methods=[methods.verlet], dtypes=[np.float64], seconds=1.0, progress=False
        ... )
        >>> advice.best.name, advice.best.error < 1e-3
        ('verlet', True)
    """
    options = merge_options("recommend", options, more)
    problem, errors = _check_request(scene, error, horizon, options.frames)
    norm, dtypes = as_error_measure(norm), [np.dtype(dtype).name for dtype in options.dtypes]
    deadline = read_work_clock() + float(as_real_quantity("seconds [s]", seconds, above=0.0))
    shown = progress_bar(progress=options.progress, desc="recommend", unit="method", leave=False)
    with jax.enable_x64(True), shown as bar:
        bar.set_postfix_str("the true path")
        push = draw_random_push(scene) if options.gradient else None
        candidates = rate_candidates(scene, list_candidates(scene, min(errors)) if methods is None else methods)
        # what diffrax takes to compile, another thread uses for the likely winner
        ahead = compile_ahead(problem, candidates, errors, push) if suits_diffrax(problem) else None
        truth = solve_reference(problem, wanted=min(errors), seconds=REFERENCE_TIME_SHARE * seconds, push=push)
        task = SearchTask(problem, truth, norm, options.scale, push, deadline)
        goals = _list_goals(task, errors)
        found, untried = explore_methods(task, candidates, goals, ahead, bar, everything=methods is not None)
        nearby = list_nearby(task, options.starts, seconds)
        answers = _answer_errors(task, found, errors, dtypes, untried, nearby, bar)
    return answers[0] if np.ndim(error) == 0 else tuple(answers)


def _check_request(
    scene: Scene, error: float | Sequence[float], horizon: float, frames: int
) -> tuple[Problem, list[float]]:
    if not isinstance(scene, Scene):
        raise TypeError(f"recommend: got a {type(scene).__name__}, expected a Scene.")
    as_real_quantity("error", error, above=0.0)
    errors = np.atleast_1d(np.asarray(error, float))  # as given: outside float64 an array has other numbers
    if errors.ndim != 1 or not errors.size:
        raise ValueError(f"error: got an array of shape {errors.shape}, expected a number or a list of them.")
    span = as_real_quantity("horizon [s]", horizon, above=0.0)
    if span.ndim:
        raise ValueError(f"horizon [s]: got shape {span.shape}, expected one number.")
    return Problem(scene, float(horizon), frames=as_positive_integer("frames", frames)), [float(e) for e in errors]


def _list_goals(task: SearchTask, errors: Sequence[float]) -> list[float]:
    """The errors that a run in float64 may have, for each of those asked for that can be promised at all."""
    truth_error = float(task.truth.truth_error(task.norm, task.scale).max())
    share = SAFE_ERROR_SHARE["float64"]
    return [share * wanted - truth_error for wanted in errors if truth_error < TRUTH_ERROR_SHARE * wanted]


def _answer_errors(
    task: SearchTask,
    found: list[Exploration],
    errors: Sequence[float],
    dtypes: Sequence[str],
    untried: tuple[str, ...],
    nearby: Nearby,
    bar: tqdm,
) -> list[Recommendation]:
    """A recommendation for each error, from the runs of all methods."""
    truth_error = float(task.truth.truth_error(task.norm, task.scale).max())
    answers, compiled = [], {}
    for wanted in errors:
        bar.set_postfix_str(f"error {wanted:g}")
        kept = []
        if truth_error < TRUTH_ERROR_SHARE * wanted:
            kept = _verify_finalists(task, found, wanted, truth_error, dtypes, compiled)
        answers.append(_build_recommendation(task, found, kept, wanted, truth_error, untried, nearby))
    return answers


def _verify_finalists(
    task: SearchTask,
    found: list[Exploration],
    wanted: float,
    truth_error: float,
    dtypes: Sequence[str],
    compiled: dict[str, CompiledRun],
) -> list[tuple[CompiledRun, Trial]]:
    """The runs that keep an error, at most one of each method and float type, of those that may be the fastest."""
    goals = {dtype: SAFE_ERROR_SHARE[dtype] * wanted - truth_error for dtype in SAFE_ERROR_SHARE}
    ranked = sorted(range(len(found)), key=lambda i: found[i].seconds(found[i].fineness(goals["float64"])))
    wide, most = [], np.inf
    for i in ranked[:MAX_FINALISTS]:
        found[i], trial = refine_step(task, found[i], goals["float64"], min(most, 4 * MAX_RUN_SECONDS))
        if trial is not None:
            most = min(most, FINALIST_TIME_RATIO * trial.seconds)
            wide.append((found[i], trial))
    kept = [(entry.compiled_run, trial) for entry, trial in wide] if "float64" in dtypes else []
    # of a few numbers float32 saves nothing that compiling another program would not cost
    worth = "float64" not in dtypes or _count_numbers(task.problem.scene) >= MIN_NUMBERS_FOR_FLOAT32
    if "float32" in dtypes and worth and is_float32_accurate(task, wanted):
        fast = sorted(wide, key=lambda pair: pair[1].seconds)
        for entry, trial in fast[:1] if "float64" in dtypes else fast:
            kept += _try_float32(task, entry, trial, goals["float32"], compiled)
    return kept


def _count_numbers(scene: Scene) -> int:
    return sum(leaf.size for leaf in jax.tree.leaves(scene.state))


def _try_float32(
    task: SearchTask, entry: Exploration, trial: Trial, goal: float, compiled: dict[str, CompiledRun]
) -> list[tuple[CompiledRun, Trial]]:
    """The same method in float32, as fine as it must be there, if it keeps the error and there is time to compile it."""
    wide = entry.compiled_run
    if wide.adaptive and trial.fineness * float(np.finfo(np.float32).eps) > 1:
        return []  # a tolerance below rounding: steps would shrink without end
    if wide.name not in compiled:
        if 1.5 * wide.compile_seconds > task.time_left():
            return []
        compiled[wide.name] = compile_run(task.problem, wide.method, np.float32, push=task.push)
    narrow = compiled[wide.name]
    for factor in FLOAT32_FINENESS_FACTORS:
        found = run_trial(task, narrow, trial.fineness * factor)
        if found.error <= goal:
            return [(narrow, found)]
    return []


def _build_recommendation(
    task: SearchTask,
    found: list[Exploration],
    kept: list[tuple[CompiledRun, Trial]],
    wanted: float,
    truth_error: float,
    untried: tuple[str, ...],
    nearby: Nearby,
) -> Recommendation:
    """The fastest of the runs that keep the error, by times taken in turn, with the reason; or what stops it."""
    problem = task.problem
    seconds = time_finalists(kept)
    ranked = sorted(range(len(kept)), key=lambda i: seconds[i])
    choices = tuple(_build_choice(*kept[i], seconds[i]) for i in ranked)
    stopped = None if kept else explain_failure(task, found, wanted, truth_error)
    return Recommendation(
        scene=problem.scene,
        error=wanted,
        horizon=problem.duration,
        frames=problem.frames,
        norm=task.norm.name + (" and its gradient" if task.push is not None else ""),
        best=choices[0] if choices else None,
        runners_up=choices[1:],
        reason=stopped or explain_choice(choices, kept[ranked[0]][0], found),
        truth=task.truth.source,
        truth_error=truth_error,
        richardson=estimate_richardson_error(task, *kept[ranked[0]]) if kept else float("nan"),
        untried=untried,
        bound=bound_error(task, nearby, *kept[ranked[0]], truth_error) if kept else NO_BOUND,
        lyapunov_time=task.truth.lyapunov_time(task.norm, task.scale),
    )


def _build_choice(entry: CompiledRun, trial: Trial, seconds: float) -> Choice:
    return Choice(
        name=entry.name,
        method=entry.tune_method(trial.fineness),
        dtype=entry.dtype,
        dt=entry.dt(trial.fineness),
        steps_per_frame=entry.count(trial.fineness),
        tolerance=1 / trial.fineness if entry.adaptive else None,
        error=trial.error,
        seconds=seconds / entry.problem.duration,
    )
