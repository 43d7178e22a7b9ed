"""The search behind a recommendation: runs from coarse to fine, the step for an error between them, times in turn."""

import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from physjax.backend import read_work_clock
from physjax.study.accuracy.error_measures import ErrorMeasure, path
from physjax.study.accuracy.method_facts import CompiledRun
from physjax.study.accuracy.reference_solution import ReferenceSolution
from physjax.study.problem import Problem

STEPS_FACTOR, TOLERANCE_FACTOR = 2.0, 10.0
"""From one exploring run to the next: so many times the steps, so many times less tolerance."""
MIN_TIMED_SECONDS, MAX_RUN_SECONDS = 20e-3, 2.0
"""Runs are timed again up to this [s] together, since clocks and neighbours blur short ones; one above ends an exploration."""
MAX_FINENESS = 1e12
"""Of tolerances; below is rounding."""
CLOSE_STEP_RATIO = 1.15
"""A step within this factor of the longest that would do is as good."""
MIN_TIMING_ROUNDS, MIN_TIMING_SECONDS = 7, 0.3
"""Turns that finalists take at least, and for how long [s]: what disturbs the machine comes in bursts."""
GRACE_SECONDS = 5.0
"""Beyond the deadline nothing is compiled; short runs may still settle an answer for so long [s]."""


class SearchTask(NamedTuple):
    """What is asked of a run, and until when (by `read_work_clock`) there is time to answer it."""

    problem: Problem
    truth: ReferenceSolution
    norm: ErrorMeasure
    scale: Any
    push: Any
    deadline: float

    def time_left(self) -> float:
        """Time left [s]: of processor time on a CPU."""
        return self.deadline - read_work_clock()

    def error(self, found: Any) -> float:
        """The error of a run; of what becomes of the push as well, if there is one."""
        if self.push is None:
            return self._finite_error(self.norm, found, self.truth.states, self.scale)
        states, slopes = found
        largest = float(np.abs(np.asarray(self.truth.slopes.place)).max())
        return max(
            self._finite_error(self.norm, states, self.truth.states, self.scale),
            self._finite_error(path, slopes, self.truth.slopes, largest),
        )

    def _finite_error(self, norm: ErrorMeasure, states: Any, truth: Any, scale: Any) -> float:
        error = norm.error(self.truth.scene, self.truth.times, states, truth, self.truth.size(norm, scale))
        return error if np.isfinite(error) else float("inf")


class Trial(NamedTuple):
    """One run: how fine, its error, and what it took [s]."""

    fineness: float
    error: float
    seconds: float


class Exploration(NamedTuple):
    """A method and its runs, from coarse to fine."""

    compiled_run: CompiledRun
    trials: tuple[Trial, ...]

    @property
    def slope(self) -> float:
        """The power of fineness with which errors fall, as seen in the last two runs that are far from rounding."""
        order = self.compiled_run.promised if np.isfinite(self.compiled_run.promised) else 1.0
        promised = order / (order + 1) if self.compiled_run.adaptive else order
        good = [t for t in self.trials if 1e-13 < t.error < 0.3]
        if len(good) < 2 or good[-1].error >= good[-2].error:
            return promised
        a, b = good[-2:]
        seen = float(np.log(a.error / b.error) / np.log(b.fineness / a.fineness))
        return min(max(seen, 0.5 * promised), 1.5 * promised)

    def fineness(self, goal: float) -> float:
        """How fine it must be for an error, by its runs: between two of them, or beyond the last by their slope."""
        good = [t for t in self.trials if t.error <= goal]
        if not good:
            last = self.trials[-1]
            return last.fineness * (last.error / (0.9 * goal)) ** (1 / self.slope) if last.error < 1 else np.inf
        best = min(good, key=lambda t: t.fineness)
        worse = [t for t in self.trials if t.fineness < best.fineness]
        if not worse:
            return best.fineness
        below = max(worse, key=lambda t: t.fineness)
        if not below.error < 1 or best.error <= 1e-3 * goal:
            return float(np.sqrt(best.fineness * below.fineness))
        share = np.log(below.error / (0.93 * goal)) / np.log(below.error / best.error)
        wanted = below.fineness * (best.fineness / below.fineness) ** min(max(share, 0.1), 1.0)
        return float(wanted)

    def seconds(self, fineness: float) -> float:
        """What a run takes [s], by the nearest run and how times grow with fineness."""
        if not np.isfinite(fineness):
            return np.inf
        nearest = min(self.trials, key=lambda t: abs(np.log(t.fineness / fineness)))
        order = self.compiled_run.promised if np.isfinite(self.compiled_run.promised) else 1.0
        power = 1 / (order + 1) if self.compiled_run.adaptive else 1.0
        return nearest.seconds * (fineness / nearest.fineness) ** (
            power if fineness > nearest.fineness else 0.5 * power
        )

    @property
    def longest_stable_step(self) -> float:
        """The longest step [s] that held, where longer ones were tried and did not; infinite if none failed."""
        failed = [t.fineness for t in self.trials if not t.error < 1]
        held = [t.fineness for t in self.trials if t.error < 1 and t.fineness > max(failed, default=0.0)]
        return self.compiled_run.dt(min(held)) if failed and held and not self.compiled_run.adaptive else float("inf")


def run_trial(task: SearchTask, entry: CompiledRun, fineness: float) -> Trial:
    """Run a method once, and again where that was short."""
    times = []
    while not times or (len(times) < 16 and sum(times) < MIN_TIMED_SECONDS):
        started = time.perf_counter()
        found = jax.block_until_ready(entry(fineness))
        times.append(time.perf_counter() - started)
    exactly = fineness if entry.adaptive else float(entry.count(fineness))
    return Trial(exactly, task.error(jax.tree.map(np.asarray, found)), min(times))


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
    factor, fineness, trials = (TOLERANCE_FACTOR, 10.0, []) if entry.adaptive else (STEPS_FACTOR, start, [])
    while fineness <= MAX_FINENESS and (not trials or task.time_left() > -GRACE_SECONDS):
        trials.append(run_trial(task, entry, fineness))
        now = trials[-1]
        if now.error <= 0.5 * least or now.seconds > longest or _has_stalled(trials):
            break
        # where steps follow the state, loose tolerances say nothing of tight ones
        if not entry.adaptive and _is_outperformed(now, others):
            break
        fineness *= factor
    return Exploration(entry, tuple(trials))


def _has_stalled(trials: Sequence[Trial]) -> bool:
    """Whether three more runs brought nothing: rounding, or a truth that is another one."""
    if len(trials) < 5 or not trials[-4].error < 0.5:
        return False
    return min(t.error for t in trials[-3:]) > 0.7 * trials[-4].error


def _is_outperformed(now: Trial, others: Sequence[Exploration]) -> bool:
    """Whether another method has an error as small in a fifth of the time."""
    return any(t.error <= now.error and t.seconds < 0.2 * now.seconds for other in others for t in other.trials)


def refine_step(task: SearchTask, entry: Exploration, goal: float, most: float) -> tuple[Exploration, Trial | None]:
    """The longest step that keeps an error, verified: the runs with those made here, and that run; None if none keeps it.

    `most` [s] is what a run may take to be of interest.
    """
    for _ in range(6):
        good = [t for t in entry.trials if t.error <= goal]
        best = min(good, key=lambda t: t.fineness, default=None)
        guess = entry.fineness(goal)
        if not entry.compiled_run.adaptive:
            guess = float(max(1, round(guess))) if np.isfinite(guess) else guess
        if not np.isfinite(guess):
            return entry, None
        known = any(abs(np.log(t.fineness / guess)) < 1e-9 for t in entry.trials)
        if best is not None and (
            known or best.fineness / guess < CLOSE_STEP_RATIO or task.time_left() < -GRACE_SECONDS
        ):
            return entry, best
        if known:  # the guess itself failed, and nothing finer is known: a little finer
            guess *= CLOSE_STEP_RATIO
        if entry.seconds(guess) > most or task.time_left() < -GRACE_SECONDS:
            return entry, None
        trials = sorted((*entry.trials, run_trial(task, entry.compiled_run, guess)))
        entry = entry._replace(trials=tuple(trials))
    return entry, min((t for t in entry.trials if t.error <= goal), key=lambda t: t.fineness, default=None)


def time_in_turn(finalists: Sequence[tuple[CompiledRun, Trial]]) -> list[float]:
    """The least time of each finalist's run [s], all taking turns, so that whatever else the machine does meets all."""
    least = [trial.seconds for _, trial in finalists]
    begun, rounds = time.perf_counter(), 0
    while finalists and (rounds < MIN_TIMING_ROUNDS or time.perf_counter() - begun < MIN_TIMING_SECONDS):
        rounds += 1
        for i, (entry, trial) in enumerate(finalists):
            started = time.perf_counter()
            jax.block_until_ready(entry(trial.fineness))
            least[i] = min(least[i], time.perf_counter() - started)
    return least


def estimate_richardson_error(task: SearchTask, entry: CompiledRun, trial: Trial) -> float:
    """Richardson's word on the error of a run: how much half the step (a tenth of the tolerance) changes it."""
    order = entry.promised if np.isfinite(entry.promised) else 1.0
    factor = TOLERANCE_FACTOR ** (1 + 1 / order) if entry.adaptive else STEPS_FACTOR
    here, finer = (jax.tree.map(np.asarray, entry(f)) for f in (trial.fineness, trial.fineness * factor))
    here, finer = ((found if task.push is None else found[0]) for found in (here, finer))
    size = task.truth.size(task.norm, task.scale)
    change = task.norm.error(task.truth.scene, task.truth.times, here, finer, size)
    return change / (1 - 2.0**-order)
