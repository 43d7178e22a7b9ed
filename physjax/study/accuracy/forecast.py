"""How long a method would take for an error, before it is compiled: from its promises, and from the runs of others.

On one scene the steps that methods need for an error e are alike: N = θ e^(-1/p), with p the order promised and θ the
steps at which errors would be as large as the path is long. Of methods at equal steps θ differs by a factor of two from
rk4's, seldom more (random scenes of `tests/random_scenes.py`), however their orders differ; a method made for long steps
says so in its promises. So a run of one method tells of all: what cannot be faster is not compiled.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np

from physjax.scene import Scene
from physjax.stepping.adaptive import Adaptive
from physjax.stepping.registry import read_promises
from physjax.study.accuracy.method_facts import subdivided_method
from physjax.study.accuracy.search import COARSE_ERROR, ROUNDING_ERROR, Exploration

USUAL_DIFFICULTY = 0.1
"""θ, in steps between two moments, where nothing has been run: typical of motion that 32 moments show well."""
FRAME_EVALUATIONS = 16.0
"""What keeping a frame costs, in evaluations of a force on a few numbers (5 µs to 0.3 µs)."""
ENTRY_EVALUATIONS = 3.0
"""What entering the loop between two moments adds for each evaluation that is written out in the program of a step."""
CONTACT_EVALUATIONS = 10.0
"""What looking for contacts adds to a step, in evaluations."""
NUMBERS_PER_EVALUATION = 1000.0
"""Numbers in a state whose evaluation takes as much longer as there is to a call of it."""
ADAPTIVE_COST, DENSE_FRAME_COST, IMPLICIT_COST = 1.7, 1.5, 6.0
"""How many times as much an evaluation costs under error control, a frame that is read off between steps, and an evaluation
of a method that solves for the end of its step."""
LEAST_STEPS_RATIO = 4.0
"""Two runs show what a step costs if one takes at least this many times the steps of the other."""


class Costs(NamedTuple):
    """What a run is made of: keeping its frames, entering the loops between them, and in these steps and evaluations.

    The time of one such part between each two moments of the run [s]; in evaluations, where nothing has been timed. `entry`
    is for each evaluation written out in a step.
    """

    frame: float
    entry: float
    step: float
    evaluation: float

    def scale(self, unit: float) -> "Costs":
        """All of them in another unit."""
        return Costs(*(unit * part for part in self))


class Pace(NamedTuple):
    """What is known of a scene before a method is run on it: how hard it is, and what its steps cost.

    `equal` pairs orders with the θ seen at them with equal steps, `varied` is θ under error control [steps between two
    moments]. `stiffness` is the stability limit times the fewest stable steps between two moments; 0 where none was too few.
    """

    equal: tuple[tuple[float, float], ...]
    varied: float
    stiffness: float
    costs: Costs

    def difficulty(self, order: float) -> float:
        """θ for equal steps, as seen at the nearest order."""
        return min(self.equal, key=lambda seen: abs(seen[0] - order))[1]


def estimate_pace(scene: Scene, varied: float | None, found: Sequence[Exploration]) -> Pace:
    """The pace of a scene, from the runs there are; before the first from what is usual, with an evaluation as the unit.

    `varied` is θ under error control, where the reference shows it.
    """
    size = 1 + sum(leaf.size for leaf in jax.tree.leaves(scene.state)) / NUMBERS_PER_EVALUATION
    # next to the evaluations of many numbers the rest is small
    usual = Costs(FRAME_EVALUATIONS / size, ENTRY_EVALUATIONS / size, CONTACT_EVALUATIONS * len(scene.contacts), 1.0)
    equal = [entry for entry in found if not entry.compiled_run.adaptive]
    seen = tuple((entry.compiled_run.error_power, _measure_difficulty(entry)) for entry in equal)
    if not seen:
        seen = ((1.0, USUAL_DIFFICULTY),)
    stiffness = max((_measure_stiffness(entry) for entry in equal), default=0.0)
    return Pace(seen, seen[0][1] if varied is None else varied, stiffness, _measure_costs(equal, usual))


def _measure_difficulty(entry: Exploration) -> float:
    """θ from the run whose error is the smallest that is not rounding."""
    power = entry.compiled_run.error_power
    clear = [t for t in entry.trials if t.error < COARSE_ERROR]
    if not clear:
        return entry.trials[-1].fineness
    last = next((t for t in reversed(clear) if t.error > ROUNDING_ERROR), clear[0])
    return last.fineness * max(last.error, ROUNDING_ERROR) ** (1 / power)


def _measure_stiffness(entry: Exploration) -> float:
    """The stability limit times the fewest steps between two moments that stayed on the path, where fewer did not."""
    promises = read_promises(entry.compiled_run.method)
    longest = entry.longest_stable_step
    if promises is None or not np.isfinite(longest) or not np.isfinite(promises.stability_limit):
        return 0.0
    return promises.stability_limit * entry.compiled_run.dt(1.0) / longest


def _measure_costs(found: Sequence[Exploration], usual: Costs) -> Costs:
    """What frames, steps and evaluations cost [s], from runs with few and with many steps; else in the usual proportions."""
    slopes, firsts = [], []
    for entry in found:
        evaluations, written = weigh_evaluations(entry.compiled_run.method)
        if not evaluations:
            continue
        few, many = entry.trials[0], entry.trials[-1]
        fixed = usual.frame + usual.entry * written
        firsts.append(few.seconds / (fixed + few.fineness * (usual.step + evaluations)))
        slope = (many.seconds - few.seconds) / max(many.fineness - few.fineness, 1e-9)
        if many.fineness >= LEAST_STEPS_RATIO * few.fineness and slope > 0:
            slopes.append((evaluations, slope, max(few.seconds - few.fineness * slope, 0.0) / fixed))
    if not slopes:
        return usual.scale(min(firsts, default=1.0))
    evaluations, slope, fixed = (np.asarray(column) for column in zip(*slopes, strict=True))
    unit = float(np.exp(np.mean(np.log(slope / (usual.step + evaluations)))))
    step, begun = usual.step * unit, float(fixed.min())
    if usual.step and np.ptp(evaluations) > 0:  # two methods tell how much of a step is not evaluations
        unit, step = (max(float(part), 0.0) for part in np.polyfit(evaluations, slope, 1))
    return Costs(begun * usual.frame, begun * usual.entry, step, unit)


def weigh_evaluations(method: Callable) -> tuple[float, float]:
    """What a step costs in evaluations, solves and error control included, and how many are written out in its program.

    Both 0 for a method that promises nothing.
    """
    promises = read_promises(subdivided_method(method) if isinstance(method, Adaptive) else method)
    if promises is None:
        return 0.0, 0.0
    share = IMPLICIT_COST if np.isinf(promises.stability_limit) else 1.0
    cost = promises.evaluations * share * (ADAPTIVE_COST if isinstance(method, Adaptive) else 1.0)
    return cost, 1.0 if promises.looped else cost


def predict_seconds(pace: Pace, method: Callable, order: float, error: float) -> float:
    """The time of a run that keeps an error [s], or in evaluations between two moments where nothing has been timed."""
    (evaluations, written), costs = weigh_evaluations(method), pace.costs
    promises = read_promises(subdivided_method(method) if isinstance(method, Adaptive) else method)
    if promises is None or not order > 0:
        return costs.frame  # nothing is known against it
    frame, difficulty, longest = costs.frame, pace.difficulty(order), promises.stability_limit
    if isinstance(method, Adaptive):
        frame, difficulty = DENSE_FRAME_COST * frame, pace.varied
    steps = max(1.0, difficulty * error ** (-1 / order) / promises.relative_step)
    if longest and not isinstance(method, Adaptive):
        steps = max(steps, pace.stiffness / longest)
    return frame + written * costs.entry + steps * (costs.step + evaluations * costs.evaluation)
