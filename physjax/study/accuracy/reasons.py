"""Why a recommendation is what it is, in one sentence: what wins and by how much, or what stops every method."""

import numpy as np

from physjax.study.accuracy.compiled_run import CompiledRun
from physjax.study.accuracy.recommendation import Choice
from physjax.study.accuracy.search import MAX_RUN_SECONDS, Exploration, SearchTask
from physjax.text import format_seconds

SAFE_ERROR_SHARE = {"float64": 0.9, "float32": 0.6}
"""The share of an error that a run may have to be recommended; rounding differs from one compilation to the next."""
TRUTH_ERROR_SHARE = 0.3
"""An error can be promised if the truth itself is right to this share of it."""
ROUNDING_UNITS = 10
"""Rounding errors of the start, in units in the last place, that a run over many steps is taken to have."""


def explain_choice(choices: tuple[Choice, ...], winner: CompiledRun, found: list[Exploration]) -> str:
    """One sentence: the choice, the longest stable step, and who comes next."""
    best, *others = choices
    longest_stable_step = next(entry.longest_stable_step for entry in found if entry.compiled_run.name == winner.name)
    remarks = [f"steps up to {format_seconds(longest_stable_step)} hold"] if np.isfinite(longest_stable_step) else []
    other = next((c for c in others if c.name != best.name), None)
    if other is not None:
        remarks.append(f"{other.name} takes {other.seconds / best.seconds:.1f} times as long at this error")
    else:
        remarks.append("no other method came near in time")
    return f"{best.name} at {best.step} in {best.dtype}: {', '.join(remarks)}."


def explain_failure(task: SearchTask, found: list[Exploration], wanted: float, truth_error: float) -> str:
    """Why nothing keeps an error."""
    truth = task.truth
    horizon = truth.horizon(wanted, ROUNDING_UNITS * float(np.finfo(float).eps), task.norm, task.scale)
    least = min((t.error for entry in found for t in entry.trials), default=np.inf)
    if np.isfinite(horizon):
        what = "Chaos" if np.isfinite(truth.lyapunov_time(task.norm, task.scale)) else "Rounding"
        return f"{what}: beyond {format_seconds(horizon)} rounding alone has grown to an error of {wanted:g}; no method can."
    if truth_error > TRUTH_ERROR_SHARE * wanted:
        return _explain_uncertain_truth(task, wanted, truth_error)
    if least <= SAFE_ERROR_SHARE["float64"] * wanted - truth_error:
        accurate = is_float32_accurate(task, wanted)
        what = "no time was left to compile it in float32" if accurate else "float32 rounds too much"
        return f"In float64 an error of {wanted:g} is kept, but {what}. Allow float64 by dtypes."
    ended = "of the search" if task.time_left() < 0 else f"a run may take ({MAX_RUN_SECONDS:g} s)"
    if not np.isfinite(least):
        return f"No run stayed finite in the time {ended}. Give it more seconds, or fewer lanes: a few show the error of many."
    return f"No method came below {least:.1e} in the time {ended}; {wanted:g} was asked for."


def _explain_uncertain_truth(task: SearchTask, wanted: float, truth_error: float) -> str:
    """That the true path is not known well enough, why, and where it is known least."""
    scene, why, where = task.problem.scene, "", ""
    if scene.resolves_at_step_end:
        cause = "springs that break" if scene.remembers else "contacts resolved at the end of a step"
        why = f" ({cause} leave every method at first order)"
    unit = task.truth.find_least_certain(task.norm, task.scale)
    if unit is not None:
        where = f", worst in {'scene' if scene.couples else 'lane'} {unit}"
    return f"The true path itself is known only to {truth_error:.1e}{where}{why}; {wanted:g} cannot be promised."


def is_float32_accurate(task: SearchTask, wanted: float) -> bool:
    """Whether rounding in float32, grown as errors of the start grow, stays below the error."""
    eps = float(np.finfo(np.float32).eps)
    return float(task.truth.growth(task.norm, task.scale).max(initial=1.0)) * eps < wanted
