"""Which methods are compiled and run, in which order, and when to stop: as few as tell what the fastest is.

The most promising method is first, by what the runs before it have shown of the scene (`forecast.py`); what cannot be
faster by much is neither compiled nor run. While the true path is computed, another thread compiles the first.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree
from tqdm import tqdm

from physjax.backend import read_work_clock
from physjax.scene import Scene
from physjax.stepping.registry import read_promises
from physjax.study.accuracy.compiled_run import CompiledRun, compile_run
from physjax.study.accuracy.forecast import estimate_pace, predict_seconds, weigh_evaluations
from physjax.study.accuracy.method_facts import (
    depends_on_velocity,
    list_adaptive_methods,
    list_methods,
    method_title,
    promised_order,
)
from physjax.study.accuracy.search import Exploration, SearchTask, explore_method
from physjax.study.problem import Problem

WORTHWHILE_GAIN, GAIN_PER_EVALUATION = 1.25, 0.02
"""How many times as fast as the best so far a method must look to be compiled and run; and how much more for each evaluation
written out in its program, since it takes that much longer to compile."""
ROUGH_ERROR, ROUGH_ORDER = 1e-5, 6
"""Where no smaller error is asked for, methods of higher order cannot win: motion is not smooth over steps as long as theirs."""
LARGEST_COMPARED_LIMIT = 1e6
"""Stands for an infinite stability limit where methods are compared, so that two that are always stable are equals."""


class Candidate(NamedTuple):
    """A method and the power of the number of steps with which its errors are expected to fall on the scene."""

    method: Callable
    order: float


def list_candidates(scene: Scene, least: float = 0.0) -> list[Callable]:
    """Methods for a scene in the order in which they are tried: the likely winners first, without those that cannot win.

    `least` is the smallest error that is asked for.
    """
    late, velocity_dependent = scene.resolves_at_step_end, depends_on_velocity(scene)

    def rate_merit(method: Callable) -> tuple[float, ...]:
        promises = method.promises  # every method of the registry has them
        limit = min(promises.stability_limit, LARGEST_COMPARED_LIMIT)
        # of two that drag lowers alike, the one with the higher order without it
        return promised_order(method, velocity_dependent, scene), -promises.evaluations, limit, promises.order

    possible = [m for m in list_methods(scene).values() if m.promises.order <= ROUGH_ORDER or least < ROUGH_ERROR]
    chosen: list[Callable] = []
    # implicit methods do not end by stability and cost more than their promise says: last
    for method in sorted(possible, key=lambda m: (_is_implicit(m), *(-x for x in rate_merit(m)))):
        merit = rate_merit(method)
        if not any(all(a >= b for a, b in zip(rate_merit(other), merit, strict=True)) for other in chosen):
            chosen.append(method)
    # adaptive steps cannot see an error that a contact makes at the end of a step
    adaptives = (
        [] if late else [m for m in list_adaptive_methods(scene) if m.order <= ROUGH_ORDER or least < ROUGH_ERROR]
    )
    explicit = [method for method in chosen if not _is_implicit(method)]
    stiff = [method for method in chosen if _is_implicit(method)]
    return [*adaptives[:1], *explicit, *adaptives[1:], *stiff]


def _is_implicit(method: Callable) -> bool:
    promises = read_promises(method)
    return promises is not None and bool(np.isinf(promises.stability_limit))


def rate_candidates(scene: Scene, methods: Sequence[Callable]) -> list[Candidate]:
    """Methods with the orders to be expected on a scene.

    Drag that lowers an order is often weak: errors then fall as without it until they are small. In between is halfway.
    """
    ends = {False, depends_on_velocity(scene)}
    return [
        Candidate(method, float(np.mean([promised_order(method, end, scene) for end in ends]))) for method in methods
    ]


class Ready(NamedTuple):
    """A method whose program there is, or will be once `get` returns it."""

    method: Callable
    get: Callable[[], CompiledRun]


def compile_ahead(problem: Problem, candidates: Sequence[Candidate], errors: Sequence[float], push: PyTree) -> Ready:
    """Begin to compile the candidate that promises the least work for the errors, before anything is known of the scene."""
    pace = estimate_pace(problem.scene, None, ())

    def rate_work(candidate: Candidate) -> float:
        return float(np.prod([predict_seconds(pace, *candidate, error) for error in errors]) ** (1 / len(errors)))

    first = min(candidates, key=rate_work)

    def compile_first() -> CompiledRun:
        with jax.enable_x64(True):  # of each thread its own
            return compile_run(problem, first.method, push=push)

    pool = ThreadPoolExecutor(1, thread_name_prefix="physjax compiling ahead")
    compiled = pool.submit(compile_first)
    pool.shutdown(wait=False)
    return Ready(first.method, compiled.result)


def explore_methods(
    task: SearchTask,
    candidates: Sequence[Candidate],
    goals: Sequence[float],
    ahead: Ready | None,
    bar: tqdm,
    *,
    everything: bool,
) -> tuple[list[Exploration], tuple[str, ...]]:
    """The runs of every method that may win, as long as there is time, and the names of those for which there was none.

    `goals` are the errors that runs may have, those compiled `ahead` come first. `everything`: leave none out.
    """
    ready = _list_compiled(task, ahead)
    found: list[Exploration] = []
    waiting, longest = list(candidates), 0.0
    while waiting and goals:
        gains = [_predict_gain(task, candidate, found, goals) / _least_gain(candidate) for candidate in waiting]
        free = [i for i, candidate in enumerate(waiting) if _find_compiled(ready, candidate) is not None]
        i = free[0] if free else 0 if everything else int(np.argmax(gains))
        if not (free or everything) and gains[i] < 1:
            break
        # as much again is needed to verify
        if found and 2 * longest > task.time_left():
            late = [c for c, gain in zip(waiting, gains, strict=True) if everything or gain >= 1]
            return found, tuple(method_title(candidate.method) for candidate in late)
        candidate = waiting.pop(i)
        bar.set_postfix_str(method_title(candidate.method))
        started = read_work_clock()
        compiled = _find_compiled(ready, candidate)
        entry = compile_run(task.problem, candidate.method, push=task.push) if compiled is None else compiled()
        found.append(explore_method(task, entry, min(goals), found, _guess_fineness(found, entry)))
        longest = max(longest, read_work_clock() - started)
        bar.update()
    return found, ()


def _list_compiled(task: SearchTask, ahead: Ready | None) -> list[Ready]:
    """The methods whose programs there are already, or soon: the one compiled ahead, and that of the true path."""
    ready = [] if ahead is None else [ahead]
    own = task.truth.compiled_run
    return ready if own is None else [*ready, Ready(own.method, lambda: own)]


def _find_compiled(ready: Sequence[Ready], candidate: Candidate) -> Callable[[], CompiledRun] | None:
    return next((each.get for each in ready if each.method is candidate.method), None)


def _least_gain(candidate: Candidate) -> float:
    """How many times as fast as the best so far a method must look to be worth its compilation."""
    _, written = weigh_evaluations(candidate.method)
    return WORTHWHILE_GAIN + GAIN_PER_EVALUATION * written


def _predict_gain(
    task: SearchTask, candidate: Candidate, found: Sequence[Exploration], goals: Sequence[float]
) -> float:
    """How many times as fast as the best so far a method promises to be, at the error at which it is most."""
    unstable = any(np.isfinite(entry.longest_stable_step) for entry in found if entry.trials)
    if _is_implicit(candidate.method) and found and not unstable:
        return 0.0  # no step was too long for the others, so stability costs nothing here
    pace = estimate_pace(task.problem.scene, task.truth.difficulty, found)
    best = [min((e.seconds(e.fineness(goal)) for e in found), default=np.inf) for goal in goals]
    predicted = [predict_seconds(pace, *candidate, goal) for goal in goals]
    if not np.isfinite(best).all():  # what nothing reaches yet counts most: the least work for it
        return 1e300 / max(p for p, b in zip(predicted, best, strict=True) if not np.isfinite(b))
    return max(b / p for b, p in zip(best, predicted, strict=True))


def _guess_fineness(found: Sequence[Exploration], entry: CompiledRun) -> float:
    """The coarsest number of steps worth a run: with twice the step that was stable for a method with a like limit."""

    def read_limit(method: Callable) -> float:
        promises = read_promises(method)
        return 0.0 if promises is None else promises.stability_limit

    mine = read_limit(entry.method)
    limits = [
        e.longest_stable_step * mine / read_limit(e.compiled_run.method)
        for e in found
        if np.isfinite(e.longest_stable_step) and read_limit(e.compiled_run.method)
    ]
    if not limits or not 0 < mine < np.inf:
        return 1.0
    spacing = entry.problem.duration / entry.problem.frames
    return max(1.0, float(2.0 ** np.floor(np.log2(spacing / min(limits) / 2))))
