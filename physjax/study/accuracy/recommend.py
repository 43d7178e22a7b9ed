"""Which method, which step, which float type: measured on your own scene, on this machine, with the reason.

A few runs of each method from coarse to fine show its error and its cost; between them lies the step for the error
that is asked for, which is then verified by a run. Only what can still win is verified, and only that is timed well.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from physjax.backend import read_work_clock
from physjax.checks import as_positive_integer, as_real_quantity
from physjax.scene import Scene
from physjax.stepping.adaptive import adaptive
from physjax.stepping.methods import METHODS, rk4
from physjax.stepping.reference import cast_floats
from physjax.stepping.simulate import simulate
from physjax.study.accuracy.error_measures import ErrorMeasure, as_error_measure, path
from physjax.study.accuracy.method_facts import (
    CompiledRun,
    compile_run,
    depends_on_velocity,
    draw_random_push,
    method_title,
    promised_order,
)
from physjax.study.accuracy.reference_solution import solve_reference
from physjax.study.accuracy.search import (
    MAX_RUN_SECONDS,
    Exploration,
    SearchTask,
    Trial,
    estimate_richardson_error,
    explore_method,
    refine_step,
    run_trial,
    time_in_turn,
)
from physjax.study.problem import Problem
from physjax.text import format_seconds, format_table, progress_bar
from physjax.trajectory import Trajectory

SAFE_ERROR_SHARE = {"float64": 0.9, "float32": 0.6}
"""The part of an error that a run may have to be recommended; rounding differs from one compilation to the next."""
TRUTH_ERROR_SHARE = 0.3
"""An error can be promised if the truth itself is right to this part of it."""
CHAOTIC_GROWTH = 1e6
"""So many times an error of the start has grown where one speaks of chaos; what drifts apart in time stays below."""
MAX_FINALISTS, FINALIST_TIME_RATIO = 3, 4.0
"""Methods that are verified and timed for an error, by what their runs predict, if not so many times slower than others."""


class Choice(NamedTuple):
    """A way to run the scene that keeps the error: `error` as measured, `seconds` for each second simulated.

    `dt` [s]; `tolerance` is that of a method that chooses its own steps inside dt, otherwise None.
    """

    name: str
    method: Any
    dtype: str
    dt: float
    steps_per_frame: int
    tolerance: float | None
    error: float
    seconds: float

    @property
    def step(self) -> str:
        """Step or tolerance in words."""
        return format_seconds(self.dt) if self.tolerance is None else f"tolerance {self.tolerance:.1e}"


class Recommendation(NamedTuple):
    """What to run for an error over a horizon [s], why, and what else would do. Printed, it is a table and a sentence.

    `best` is None, and `reason` says what stops it, where nothing keeps the error. `richardson` is the error of the best
    as its own run with half the step tells it, `truth_error` that of the truth; `untried` the methods for which there was no
    time.
    """

    scene: Scene
    error: float
    horizon: float
    frames: int
    norm: str
    best: Choice | None
    runners_up: tuple[Choice, ...]
    reason: str
    truth: str
    truth_error: float
    richardson: float
    untried: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """Whether anything keeps the error."""
        return self.best is not None

    @property
    def evidence(self) -> str:
        """How the error of the best is known."""
        if self.best is None:
            return f"truth: {self.truth}, itself right to {self.truth_error:.1e}"
        remarks = "" if np.isnan(self.richardson) else f"; against its own half step it reads {self.richardson:.1e}"
        return f"{self.best.error:.1e} measured against {self.truth}, itself right to {self.truth_error:.1e}{remarks}"

    def simulate(self, **options: Any) -> Trajectory:
        """Run the scene as recommended, over the horizon; options as for `simulate`. ValueError where nothing keeps the error."""
        if self.best is None:
            raise ValueError(f"recommend: nothing keeps an error of {self.error:g}: {self.reason}")
        best, steps = self.best, self.best.steps_per_frame
        with jax.enable_x64(best.dtype == "float64"):
            scene = cast_floats(self.scene, best.dtype)
            options = {"save_every": steps} | options
            return simulate(scene, best.method, dt=best.dt, steps=steps * self.frames, **options)

    def __str__(self) -> str:
        title = f"error {self.error:g} ({self.norm}) over {format_seconds(self.horizon)}"
        rows = [
            [c.name, c.dtype, c.step, f"{c.error:.1e}", format_seconds(c.seconds)]
            for c in (self.best, *self.runners_up)
            if c is not None
        ]
        body = (
            [format_table(["method", "float", "step", "error", "run time per s"], rows, align="<<>>>")] if rows else []
        )
        rest = [f"Not tried for lack of time: {', '.join(self.untried)}."] if self.untried else []
        return "\n".join([title, *body, f"{self.reason}", f"Evidence: {self.evidence}.", *rest])


def recommend(
    scene: Scene,
    *,
    error: float | Sequence[float],
    horizon: float,
    norm: ErrorMeasure | Callable = path,
    gradient: bool = False,
    scale: Any = None,
    methods: Sequence[Callable] | None = None,
    dtypes: Sequence[Any] = (np.float64, np.float32),
    frames: int = 32,
    seconds: float = 15.0,
    progress: bool = True,
) -> Recommendation | tuple[Recommendation, ...]:
    """The fastest way to run a scene for `horizon` [s] with at most this `error`; for several errors a tuple, by one search.

    Errors are relative to the extent of the true path (`norm`: see `norms`; or a function (times, states) of your
    own), or in units of `scale`, at `frames` equally spaced moments. The truth is diffrax's Dopri8; with contacts,
    forces that remember or more than 20 000 numbers, our rk4 with far finer steps, judged by Richardson: the answer
    says which. `methods`: the registry and adaptive rk4, unless given; those that promise no more than another in any
    respect are left out, adaptive ones also where touches are answered at the end of a step, implicit ones where no
    error leaves the step to stability. With `gradient` the derivative of the path by the start's velocity, in a
    random direction, must keep the error as well, and its time by forward mode counts. `seconds` of processor time
    (of wall-clock time where the work is not on a CPU) bound the search: what is not reached is said.
    Raises ValueError or TypeError for bad input; where nothing keeps the error, the answer says what stops it.

    Example:
        >>> advice = accuracy.recommend(
        ...     swing, error=1e-3, horizon=2.0, methods=[methods.verlet], dtypes=[np.float64], seconds=1.0, progress=False
        ... )
        >>> advice.best.name, advice.best.error < 1e-3
        ('verlet', True)
    """
    problem, errors = _check_request(scene, error, horizon, frames)
    norm, dtypes = as_error_measure(norm), [np.dtype(dtype).name for dtype in dtypes]
    deadline = read_work_clock() + float(as_real_quantity("seconds [s]", seconds, above=0.0))
    with jax.enable_x64(True), progress_bar(progress=progress, desc="recommend", unit="method", leave=False) as shown:
        shown.set_postfix_str("the true path")
        push = draw_random_push(scene) if gradient else None
        truth = solve_reference(problem, wanted=min(errors), seconds=seconds / 5, push=push)
        task = SearchTask(problem, truth, norm, scale, push, deadline)
        truth_error = float(truth.truth_error(norm, scale).max())
        found, untried = _explore_methods(
            task, list_candidates(scene) if methods is None else list(methods), min(errors), shown
        )
        answers, compiled = [], {}
        for wanted in errors:
            shown.set_postfix_str(f"error {wanted:g}")
            kept = (
                _verify_finalists(task, found, wanted, truth_error, dtypes, compiled)
                if truth_error < TRUTH_ERROR_SHARE * wanted
                else []
            )
            answers.append(_build_recommendation(task, found, kept, wanted, truth_error, untried))
    return answers[0] if np.ndim(error) == 0 else tuple(answers)


def _check_request(scene: Scene, error: Any, horizon: float, frames: int) -> tuple[Problem, list[float]]:
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


def list_candidates(scene: Scene) -> list[Callable]:
    """Methods for a scene in the order in which they are tried: what is likely to win first, what cannot win not at all."""
    late, pulled = scene.resolves_at_step_end, depends_on_velocity(scene)

    def merit(method):
        promises = method.promises
        return promised_order(method, pulled, scene), -promises.evaluations, min(promises.stability_limit, 1e6)

    chosen = []
    # what is implicit does not end by stability and costs more than its promise says: last
    for method in sorted(METHODS.values(), key=lambda m: (_is_implicit(m), *(-x for x in merit(m)))):
        if not any(all(a >= b for a, b in zip(merit(other), merit(method), strict=True)) for other in chosen):
            chosen.append(method)
    return chosen if late else [*chosen[:2], adaptive(rk4), *chosen[2:]]


def _explore_methods(task: SearchTask, methods: Sequence, least: float, bar: Any) -> tuple[list, tuple[str, ...]]:
    """The runs of every method, as long as there is time, and the names of those for which there was none."""
    found: list[Exploration] = []
    untried, longest = [], 0.0
    for method in methods:
        name = method_title(method)
        bar.set_postfix_str(name)
        if (
            _is_implicit(method)
            and not any(np.isfinite(entry.longest_stable_step) for entry in found if entry.trials)
            and found
        ):
            continue  # no step was too long for the others, so stability costs nothing here
        # as much again is needed to verify
        if found and 2 * longest > task.time_left():
            untried.append(name)
            continue
        started = read_work_clock()
        entry = compile_run(task.problem, method, push=task.push)
        found.append(explore_method(task, entry, least, found, _guess_fineness(found, entry)))
        longest = max(longest, read_work_clock() - started)
        bar.update()
    return found, tuple(untried)


def _is_implicit(method: Any) -> bool:
    promises = getattr(method, "promises", None)
    return promises is not None and bool(np.isinf(promises.stability_limit))


def _guess_fineness(found: Sequence[Exploration], entry: CompiledRun) -> float:
    """The coarsest number of steps worth a run: twice as long as the longest that held for a method like it."""
    reach = lambda method: getattr(getattr(method, "promises", None), "stable_to", 0.0)  # noqa: E731
    mine = reach(entry.method)
    limits = [
        e.longest_stable_step * mine / reach(e.compiled_run.method)
        for e in found
        if np.isfinite(e.longest_stable_step) and reach(e.compiled_run.method)
    ]
    spacing = entry.problem.duration / entry.problem.frames
    return max(1.0, float(2.0 ** np.floor(np.log2(spacing / min(limits) / 2)))) if limits and 0 < mine < np.inf else 1.0


def _verify_finalists(
    task: SearchTask, found: list[Exploration], wanted: float, truth_error: float, dtypes: Sequence[str], compiled: dict
) -> list[tuple[CompiledRun, Trial]]:
    """The runs that keep an error, at most one of each method and float type, of those that may be the fastest."""
    goals = {dtype: SAFE_ERROR_SHARE[dtype] * wanted - truth_error for dtype in SAFE_ERROR_SHARE}
    ranked = sorted(range(len(found)), key=lambda i: found[i].seconds(found[i].fineness(goals["float64"])))
    kept, most = [], np.inf
    for i in ranked[:MAX_FINALISTS]:
        found[i], trial = refine_step(task, found[i], goals["float64"], min(most, 4 * MAX_RUN_SECONDS))
        if trial is None:
            continue
        most = min(most, FINALIST_TIME_RATIO * trial.seconds)
        if "float64" in dtypes:
            kept.append((found[i].compiled_run, trial))
        if "float32" in dtypes and _is_float32_accurate(task, wanted):
            kept += _try_float32(task, found[i], trial, goals["float32"], compiled)
    return kept


def _is_float32_accurate(task: SearchTask, wanted: float) -> bool:
    """Whether rounding in float32, grown as errors of the start grow, stays below the error."""
    eps = float(np.finfo(np.float32).eps)
    return float(task.truth.growth(task.norm, task.scale).max(initial=1.0)) * eps < wanted


def _try_float32(task: SearchTask, entry: Exploration, trial: Trial, goal: float, compiled: dict) -> list:
    """The same method in float32, as fine as it must be there, if it keeps the error and there is time to compile it."""
    wide = entry.compiled_run
    if wide.adaptive and trial.fineness * float(np.finfo(np.float32).eps) > 1:
        return []  # a tolerance below rounding: steps would shrink without end
    if wide.name not in compiled:
        if 1.5 * wide.compile_seconds > task.time_left():
            return []
        compiled[wide.name] = compile_run(task.problem, wide.method, np.float32, push=task.push)
    narrow = compiled[wide.name]
    for factor in (1.0, 1.25):
        found = run_trial(task, narrow, trial.fineness * factor)
        if found.error <= goal:
            return [(narrow, found)]
    return []


def _build_recommendation(
    task: SearchTask, found: list[Exploration], kept: list, wanted: float, truth_error: float, untried: tuple[str, ...]
) -> Recommendation:
    """The fastest of what keeps the error, by times taken in turn, with the reason; or what stops it."""
    problem = task.problem
    seconds = time_in_turn(kept)
    ranked = sorted(range(len(kept)), key=lambda i: seconds[i])
    choices = tuple(_build_choice(*kept[i], seconds[i]) for i in ranked)
    reason = (
        _explain_choice(choices, kept[ranked[0]][0], found)
        if kept
        else _explain_failure(task, found, wanted, truth_error)
    )
    return Recommendation(
        scene=problem.scene,
        error=wanted,
        horizon=problem.duration,
        frames=problem.frames,
        norm=task.norm.name + (" and its gradient" if task.push is not None else ""),
        best=choices[0] if choices else None,
        runners_up=choices[1:],
        reason=reason,
        truth=task.truth.source,
        truth_error=truth_error,
        richardson=estimate_richardson_error(task, *kept[ranked[0]]) if kept else float("nan"),
        untried=untried,
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


def _explain_choice(choices: tuple[Choice, ...], winner: CompiledRun, found: list[Exploration]) -> str:
    """One sentence: the choice, the longest step that holds, and who comes next."""
    best, *others = choices
    longest_stable_step = next(entry.longest_stable_step for entry in found if entry.compiled_run.name == winner.name)
    remarks = [f"steps up to {format_seconds(longest_stable_step)} hold"] if np.isfinite(longest_stable_step) else []
    other = next((c for c in others if c.name != best.name), None)
    if other is not None:
        remarks.append(f"{other.name} takes {other.seconds / best.seconds:.1f} times as long at this error")
    else:
        remarks.append("no other method came near in time")
    return f"{best.name} at {best.step} in {best.dtype}: {', '.join(remarks)}."


def _explain_failure(task: SearchTask, found: list[Exploration], wanted: float, truth_error: float) -> str:
    """Why nothing keeps an error."""
    scene, truth = task.problem.scene, task.truth
    horizon = truth.horizon(wanted, 10 * float(np.finfo(float).eps), task.norm, task.scale)
    least = min((t.error for entry in found for t in entry.trials), default=np.inf)
    if np.isfinite(horizon):
        grown = float(truth.growth(task.norm, task.scale).max())
        what = "Chaos" if grown > CHAOTIC_GROWTH else "Rounding"
        return f"{what}: beyond {format_seconds(horizon)} rounding alone has grown to an error of {wanted:g}; no method can."
    if truth_error > TRUTH_ERROR_SHARE * wanted:
        cause = "springs that break" if scene.has_memory else "touches answered at the end of a step"
        why = f" ({cause} leave every method at first order)" if scene.resolves_at_step_end else ""
        unit, kind = truth.find_least_certain(task.norm, task.scale), "scene" if scene.couples else "lane"
        where = "" if unit is None else f", worst in {kind} {unit}"
        return f"The true path itself is known only to {truth_error:.1e}{where}{why}; {wanted:g} cannot be promised."
    if least <= SAFE_ERROR_SHARE["float64"] * wanted - truth_error:
        what = (
            "no time was left to compile it in float32"
            if _is_float32_accurate(task, wanted)
            else "float32 rounds too much"
        )
        return f"In float64 an error of {wanted:g} is kept, but {what}. Allow float64 by dtypes."
    ended = "of the search" if task.time_left() < 0 else f"a run may take ({MAX_RUN_SECONDS:g} s)"
    if not np.isfinite(least):
        return f"No run held in the time {ended}. Give it more seconds, or fewer lanes: a few tell the error of many."
    return f"No method came below {least:.1e} in the time {ended}; {wanted:g} was asked for."
