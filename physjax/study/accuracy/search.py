"""The search behind a recommendation: runs from coarse to fine, the step for an error between them, times in turn."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import PyTree

from physjax.backend import read_work_clock
from physjax.particles import Particles
from physjax.study.accuracy.compiled_run import CompiledRun
from physjax.study.accuracy.error_measures import ErrorMeasure, path
from physjax.study.accuracy.reference_solution import ReferenceSolution
from physjax.study.problem import Problem
from physjax.timing import time_in_turn, time_repeatedly

STEPS_FACTOR, TOLERANCE_FACTOR = 2.0, 10.0
"""From one exploring run to the next: this many times the steps, and the tolerance divided by this."""
MIN_TIMED_SECONDS, MAX_TIMED_CALLS, MAX_RUN_SECONDS = 20e-3, 16, 2.0
"""Calls of a run are timed up to this [s] together, or this many, since clocks and other work blur short ones; a run above
the last [s] ends an exploration."""
MAX_FINENESS = 1e12
"""Of tolerances; below is rounding."""
CLOSE_STEP_RATIO = 1.15
"""A step within this factor of the longest that would do is as good."""
TURN_SECONDS, MIN_TIMING_ROUNDS, MAX_TIMING_ROUNDS, MIN_TIMING_SECONDS = 1e-3, 7, 1000, 0.1
"""Finalists take turns of this length [s], for at least this many rounds and seconds each: disturbances come in bursts."""
GRACE_SECONDS = 5.0
"""Beyond the deadline nothing is compiled; short runs may still decide between finalists for this long [s]."""
ROUNDING_ERROR, COARSE_ERROR = 1e-13, 0.3
"""Between these errors, relative to the path, two runs show with which power of fineness errors fall."""
ERROR_MARGIN, INTERPOLATED_ERROR_MARGIN = 0.9, 0.93
"""Shares of an error aimed at, so that the first guess keeps it: beyond the runs known, and between two of them."""
MAX_REFINEMENTS = 6
"""Runs in which the longest step that keeps an error is closed in on."""


class SearchTask(NamedTuple):
    """What is asked of a run, and the deadline (by `read_work_clock`) of the search."""

    problem: Problem
    truth: ReferenceSolution
    norm: ErrorMeasure
    scale: ArrayLike | None
    push: Particles | None
    deadline: float

    def time_left(self) -> float:
        """Time left [s]: of processor time on a CPU."""
        return self.deadline - read_work_clock()

    def error(self, found: PyTree) -> float:
        """The error of a run; of the derivative along the push as well, if there is one."""
        if self.push is None:
            return self._finite_error(self.norm, found, self.truth.states, self.scale)
        states, slopes = found
        largest = float(np.abs(np.asarray(self.truth.slopes.place)).max())
        return max(
            self._finite_error(self.norm, states, self.truth.states, self.scale),
            self._finite_error(path, slopes, self.truth.slopes, largest),
        )

    def _finite_error(self, norm: ErrorMeasure, states: PyTree, truth: PyTree, scale: ArrayLike | None) -> float:
        error = norm.error(self.truth.scene, self.truth.times, states, truth, self.truth.size(norm, scale))
        return error if np.isfinite(error) else float("inf")


class Trial(NamedTuple):
    """One run: its fineness, its error, and the time it took [s]."""

    fineness: float
    error: float
    seconds: float


class Exploration(NamedTuple):
    """A method and its runs, from coarse to fine."""

    compiled_run: CompiledRun
    trials: tuple[Trial, ...]

    @property
    def slope(self) -> float:
        """The power of fineness with which errors fall, as observed in the last two runs that are far from rounding."""
        promised = self.compiled_run.error_power
        good = [t for t in self.trials if ROUNDING_ERROR < t.error < COARSE_ERROR]
        if len(good) < 2 or good[-1].error >= good[-2].error:
            return promised
        a, b = good[-2:]
        observed = float(np.log(a.error / b.error) / np.log(b.fineness / a.fineness))
        return min(max(observed, 0.5 * promised), 1.5 * promised)

    def fineness(self, goal: float) -> float:
        """The fineness for an error, from the runs: between two of them, or beyond the last by their slope."""
        good = [t for t in self.trials if t.error <= goal]
        if not good:
            last = self.trials[-1]
            if not last.error < 1:
                return np.inf
            return last.fineness * (last.error / (ERROR_MARGIN * goal)) ** (1 / self.slope)
        best = min(good, key=lambda t: t.fineness)
        worse = [t for t in self.trials if t.fineness < best.fineness]
        if not worse:
            return best.fineness
        below = max(worse, key=lambda t: t.fineness)
        # next to a run that failed, or far below the error, no power law holds: halve the gap
        if not below.error < 1 or best.error <= 1e-3 * goal:
            return float(np.sqrt(best.fineness * below.fineness))
        share = np.log(below.error / (INTERPOLATED_ERROR_MARGIN * goal)) / np.log(below.error / best.error)
        wanted = below.fineness * (best.fineness / below.fineness) ** min(max(share, 0.1), 1.0)
        return float(wanted)

    def seconds(self, fineness: float) -> float:
        """The predicted time of a run [s], from the nearest run and how times grow with fineness."""
        if not np.isfinite(fineness):
            return np.inf
        nearest = min(self.trials, key=lambda t: abs(np.log(t.fineness / fineness)))
        power = self.compiled_run.work_power
        # towards coarser runs less is saved than steps are: every run has a part that does not depend on them
        power = power if fineness > nearest.fineness else 0.5 * power
        return nearest.seconds * (fineness / nearest.fineness) ** power

    @property
    def longest_stable_step(self) -> float:
        """The longest step [s] that stayed on the path, where longer ones did not; infinite if none failed."""
        failed = [t.fineness for t in self.trials if not t.error < 1]
        good = [t.fineness for t in self.trials if t.error < 1 and t.fineness > max(failed, default=0.0)]
        return self.compiled_run.dt(min(good)) if failed and good and not self.compiled_run.adaptive else float("inf")


def run_trial(task: SearchTask, entry: CompiledRun, fineness: float) -> Trial:
    """Run a method once, and again where that was short."""
    found, timing = time_repeatedly(
        partial(entry, fineness), MAX_TIMED_CALLS - 1, longest=MIN_TIMED_SECONDS, total=MIN_TIMED_SECONDS
    )
    exactly = fineness if entry.adaptive else float(entry.count(fineness))
    return Trial(exactly, task.error(jax.tree.map(np.asarray, found)), timing.least)


def explore_method(
    task: SearchTask,
    entry: CompiledRun,
    least: float,
    others: Sequence[Exploration],
    start: float,
    longest: float = MAX_RUN_SECONDS,
) -> Exploration:
    """Runs of a method from coarse to fine, until the least error is met, rounding stops it, or others are faster.

    A run that takes `longest` [s] is the last.
    """
    trials: list[Trial] = []
    factor, fineness = (TOLERANCE_FACTOR, 10.0) if entry.adaptive else (STEPS_FACTOR, start)
    while fineness <= MAX_FINENESS and (not trials or task.time_left() > -GRACE_SECONDS):
        trials.append(run_trial(task, entry, fineness))
        now = trials[-1]
        if now.error <= 0.5 * least or now.seconds > longest or _has_stalled(trials):
            break
        # adaptive steps follow the state: loose tolerances predict nothing about tight ones
        if not entry.adaptive and _is_outperformed(now, others):
            break
        fineness *= factor
    return Exploration(entry, tuple(trials))


def _has_stalled(trials: Sequence[Trial]) -> bool:
    """Whether three more runs brought nothing: rounding, or a run that converges to another path than the truth."""
    if len(trials) < 5 or not trials[-4].error < 0.5:
        return False
    return min(t.error for t in trials[-3:]) > 0.7 * trials[-4].error


def _is_outperformed(now: Trial, others: Sequence[Exploration]) -> bool:
    """Whether another method has an error as small in a fifth of the time."""
    return any(t.error <= now.error and t.seconds < 0.2 * now.seconds for other in others for t in other.trials)


def refine_step(task: SearchTask, entry: Exploration, goal: float, most: float) -> tuple[Exploration, Trial | None]:
    """The longest step that keeps an error, verified: the runs with those made here, and that run; None if none keeps it.

    A run that takes more than `most` [s] is of no interest.
    """
    for _ in range(MAX_REFINEMENTS):
        good = [t for t in entry.trials if t.error <= goal]
        best = min(good, key=lambda t: t.fineness, default=None)
        guess = entry.fineness(goal)
        if not entry.compiled_run.adaptive:
            guess = float(max(1, round(guess))) if np.isfinite(guess) else guess
        if not np.isfinite(guess):
            return entry, None
        known = any(abs(np.log(t.fineness / guess)) < 1e-9 for t in entry.trials)
        late = task.time_left() < -GRACE_SECONDS
        if best is not None and (known or best.fineness / guess < CLOSE_STEP_RATIO or late):
            return entry, best
        if known:  # the guess itself failed, and nothing finer is known: a little finer
            guess *= CLOSE_STEP_RATIO
        if entry.seconds(guess) > most or late:
            return entry, None
        trials = sorted((*entry.trials, run_trial(task, entry.compiled_run, guess)))
        entry = entry._replace(trials=tuple(trials))
    return entry, min((t for t in entry.trials if t.error <= goal), key=lambda t: t.fineness, default=None)


def time_finalists(finalists: Sequence[tuple[CompiledRun, Trial]]) -> list[float]:
    """The least time of each finalist's run [s], all taking turns; or that of its trial, where that was less."""
    timings = time_in_turn(
        [partial(entry, trial.fineness) for entry, trial in finalists],
        slice_seconds=TURN_SECONDS,
        seconds=MIN_TIMING_SECONDS * len(finalists),
        rounds=(MIN_TIMING_ROUNDS, MAX_TIMING_ROUNDS),
    )
    return [min(trial.seconds, timing.least) for (_, trial), timing in zip(finalists, timings, strict=True)]


def estimate_richardson_error(task: SearchTask, entry: CompiledRun, trial: Trial) -> float:
    """Richardson's estimate of a run's error: how much half the step (a tolerance for a tenth of the error) changes it."""
    # a tenth of the error, or that of half the step
    factor = TOLERANCE_FACTOR ** (1 / entry.error_power) if entry.adaptive else STEPS_FACTOR
    here, finer = (jax.tree.map(np.asarray, entry(f)) for f in (trial.fineness, trial.fineness * factor))
    here, finer = ((found if task.push is None else found[0]) for found in (here, finer))
    size = task.truth.size(task.norm, task.scale)
    change = task.norm.error(task.truth.scene, task.truth.times, here, finer, size)
    # of the error the finer run still has a share: what changed is the rest
    return change / (1 - factor**-entry.error_power)
