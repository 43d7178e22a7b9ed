"""A bound on the error of a run that holds with a stated confidence: from starts nudged by a percent, each with its truth.

The error of one run may be small by chance: errors of opposite sign meet at the moments, a contact falls on the end of a
step. Runs from nudged starts show what the method does about here. By the programs that there are: they compile nothing.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from physjax.backend import read_work_clock
from physjax.scene import Scene
from physjax.stepping.reference import cast_floats
from physjax.study.accuracy.compiled_run import CompiledRun
from physjax.study.accuracy.reference_solution import ReferenceSolution, nudge_start
from physjax.study.accuracy.search import SearchTask, Trial

NEARBY_SHARE = 0.01
"""The change of a nearby start's velocities, relative to the largest on the path."""
TRUTHS_TIME_SHARE, RUNS_TIME_SHARE = 0.1, 0.05
"""Shares of the search's time that the true paths of nearby starts may take, and the runs from them for one answer."""


class ErrorBound(NamedTuple):
    """An error that a run from a start nearby stays below, with this confidence; by runs from that many starts.

    Of n + 1 starts drawn alike each is as likely as the others to have the largest error, whatever the distribution. So
    the largest of n bounds that of another with confidence n / (n + 1): 19 starts give 95 %. To it is added what the
    truth may be wrong by. NaN and 0 where there was no time for any.
    """

    error: float
    confidence: float
    starts: int

    def __str__(self) -> str:
        return (
            f"{self.error:.1e} with {self.confidence:.0%} confidence, for starts whose velocities differ by"
            f" {NEARBY_SHARE:.0%} ({self.starts} runs)"
        )


NO_BOUND = ErrorBound(float("nan"), 0.0, 0)
"""Where no start nearby was run."""


class Nearby(NamedTuple):
    """Starts near the scene's own with their true paths, solved one by one as they are asked for."""

    truths: Iterator[ReferenceSolution]
    known: list[ReferenceSolution]
    seconds: float
    """For the runs of one answer."""

    def __iter__(self) -> Iterator[ReferenceSolution]:
        yield from self.known
        for truth in self.truths:
            self.known.append(truth)
            yield truth


def list_nearby(task: SearchTask, count: int, seconds: float) -> Nearby:
    """At most `count` starts near the scene's own with their true paths, as many as there is time for.

    `seconds` is what the whole search may take.
    """
    truth = task.truth
    solve = truth.solve_start
    truths = iter(()) if solve is None else _solve_truths(truth, solve, count, TRUTHS_TIME_SHARE * seconds)
    return Nearby(truths, [], RUNS_TIME_SHARE * seconds)


def _solve_truths(
    truth: ReferenceSolution, solve: Callable[[Scene], tuple[PyTree, PyTree]], count: int, seconds: float
) -> Iterator[ReferenceSolution]:
    """True paths from nearby starts, until the next would not be done in time."""
    longest, spent = truth.seconds, 0.0
    for seed in range(1, count + 1):
        if spent + longest > seconds:
            return
        started = read_work_clock()
        scene = nudge_start(truth.scene, truth.states, NEARBY_SHARE, seed=seed)
        states, slopes = solve(scene)
        found = read_work_clock() - started
        longest, spent = max(longest, found), spent + found
        yield truth._replace(scene=scene, states=states, slopes=slopes)


def bound_error(task: SearchTask, nearby: Nearby, entry: CompiledRun, trial: Trial, doubt: float) -> ErrorBound:
    """The bound for a run, as measured from as many nearby starts as there is time for; `doubt` is the truth's own error."""
    errors, started = [], read_work_clock()
    run = partial(run_from, entry, trial.fineness)
    for truth in nearby:
        errors.append(task._replace(truth=truth).error(run(truth.scene)))
        if read_work_clock() - started + trial.seconds > nearby.seconds:
            break
    if not errors:
        return NO_BOUND
    return ErrorBound(max(trial.error, *errors) + doubt, len(errors) / (len(errors) + 1), len(errors))


def run_from(entry: CompiledRun, fineness: float, scene: Scene) -> PyTree:
    """A compiled run from the start of another scene of the same kind, as NumPy."""
    return jax.tree.map(np.asarray, entry._replace(scene=cast_floats(scene, entry.dtype))(fineness))
