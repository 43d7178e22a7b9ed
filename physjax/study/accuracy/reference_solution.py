"""The true path that errors are measured by, with its own doubt, and how far the start's rounding carries.

A closed form where there is one; else diffrax; else, through contacts, with forces that remember and where the state is
so large that diffrax would take minutes, our own rk4 with far finer steps, whose last refinement tells how wrong it still
is (Richardson).
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from physjax.backend import read_work_clock
from physjax.scene import Scene
from physjax.stepping.methods import rk4
from physjax.stepping.reference import build_default_solver, cast_floats, solve_ode
from physjax.study.accuracy.error_measures import ErrorMeasure, extent, path
from physjax.study.accuracy.method_facts import CompiledRun, compile_run, smallest_sizes
from physjax.study.problem import Problem
from physjax.text import format_seconds

EXTENT_TOLERANCE = 1e-6
"""Tolerance of a glance at how far a path goes."""
TIGHT_TOLERANCE, LOOSE_TOLERANCE = 1e-13, 4e-13
"""Tolerances of the two references through diffrax: their steps differ by a tenth, and so do their errors."""
MAX_DIFFRAX_NUMBERS = 20_000
"""Numbers in a state beyond which nobody waits for diffrax at such tolerances: a thousand ropes take a quarter of an hour."""
FIRST_STEPS_PER_FRAME = 8
"""Steps between two moments with which our own reference begins; they are doubled."""
NUDGE_SHARE = 1e-10
"""The change of the start, in parts of the path, whose growth is looked at: far from rounding and from curvature."""
NUDGE_RATIO = 10.0
"""The parts of a nudge that growth is confirmed by: what is a nudge's doing is then as many times smaller."""
SATURATED_SHARE = 1e-3
"""What it has become, in parts of the path, when it no longer grows like a small one."""
INTERMEDIATE_TIME_RATIO = (1 + 5**0.5) / 4
"""Moments so many times as close together see what a motion does between the moments, whatever its period."""
ROUNDING_EXTENT_SHARE = 1e-12
"""An extent, in parts of the distance from the origin, that is rounding."""


class ReferenceSolution(NamedTuple):
    """States at the moments, those of a second and less fine solution, and those from a start that was nudged.

    `second` and `nudged` are None where the states are a closed form. `slopes` are what becomes of a push of the start.
    `reach` is how far each unit goes, at the moments and in between. `less_nudged()` solves from a start that was nudged
    by a tenth of that.
    """

    scene: Scene
    times: np.ndarray
    states: Any
    second: Any
    nudged: Any
    slopes: Any
    source: str
    reach: np.ndarray | None = None
    less_nudged: Callable | None = None

    def truth_error(self, norm: ErrorMeasure = path, scale: Any = None) -> np.ndarray:
        """How far the truth itself may be wrong at each moment, `(moments,)`; 0 for a closed form."""
        # where moments are close the two take the same steps: an error of the tolerance is then what grows
        return np.maximum(self._measure_deviation(self.second, norm, scale), TIGHT_TOLERANCE * self.growth(norm, scale))

    def growth(self, norm: ErrorMeasure = path, scale: Any = None) -> np.ndarray:
        """How many times larger a small error of the start has become at each moment; 1: it moves along."""
        return self._measure_deviation(self.nudged, norm, scale) / NUDGE_SHARE

    def horizon(self, error: float, eps: float, norm: ErrorMeasure = path, scale: Any = None) -> float:
        """The first moment [s] at which rounding of size `eps` has grown beyond an error; infinite if it does not.

        Where the nudged path is not known, or as far away when nudged by a tenth, nothing is known to have grown.
        """
        growth = self.growth(norm, scale)
        if not np.isfinite(growth).all():
            return float("inf")
        times = self.times[len(self.times) - len(growth) :]
        grown = growth * NUDGE_SHARE > SATURATED_SHARE
        if grown.any():
            # two paths that have parted part no further; rounding is still smaller, and grows on as the nudge did
            since = int(np.argmax(grown))
            rate = np.log(growth[since]) / times[since]
            growth = np.where(np.arange(len(times)) < since, growth, np.exp(np.minimum(rate * times, 700.0)))
        over = growth * eps > error
        if not over.any() or not self._is_proportional(norm, scale):
            return float("inf")
        return float(times[int(np.argmax(over))])

    def find_least_certain(self, norm: ErrorMeasure = path, scale: Any = None) -> int | None:
        """The unit (lane, or coupled scene) whose truth is most in doubt; None where there is one only, or none."""
        if self.second is None:
            return None
        off = norm.units(self.scene, self.times, self.second, self.states, self.size(norm, scale))
        worst = np.where(np.isfinite(off), off, np.inf).max(axis=0)
        return int(np.argmax(worst)) if worst.size > 1 else None

    def size(self, norm: ErrorMeasure, scale: Any) -> Any:
        """What errors are parts of, where no scale is given: how far the path goes in between the moments as well."""
        return self.reach if scale is None and norm.size is extent else scale

    def _is_proportional(self, norm: ErrorMeasure, scale: Any) -> bool:
        """Whether a smaller nudge leads less far away, in the last moment in which the larger was still small."""
        if self.less_nudged is None:
            return True
        far, near = (
            self._measure_deviation(self.nudged, norm, scale),
            self._measure_deviation(self.less_nudged(), norm, scale),
        )
        small = (far > 0) & (far < SATURATED_SHARE)
        if not small.any():
            return True
        last = np.flatnonzero(small)[-1]
        return bool(near[last] < far[last] / NUDGE_RATIO**0.5)

    def _measure_deviation(self, other: Any, norm: ErrorMeasure, scale: Any) -> np.ndarray:
        if other is None:
            return np.zeros(len(self.times))
        return norm.moments(self.scene, self.times, other, self.states, self.size(norm, scale))


def solve_reference(
    problem: Problem, *, wanted: float = 1e-8, seconds: float = 3.0, push: Any = None, own: Callable | None = None
) -> ReferenceSolution:
    """The true path of a problem at its moments, its doubt well below the error `wanted` if the processor has `seconds` [s].

    Inside `jax.enable_x64(True)`. Our own solution is refined until the last refinement changes it by less than a
    fiftieth of what is wanted; by `own`, a method, where given: for a second truth.
    """
    scene = cast_floats(problem.scene, jnp.float64)
    if problem.exact is not None and push is None and own is None:
        states, between = problem.exact(problem.times), problem.exact(INTERMEDIATE_TIME_RATIO * problem.times)
        return ReferenceSolution(
            scene,
            problem.times,
            states,
            None,
            None,
            None,
            "closed form",
            _measure_reach(scene, problem.times, states, between),
        )
    by_diffrax = (
        problem.is_ode
        and own is None
        and sum(leaf.size for leaf in jax.tree.leaves(scene.state)) <= MAX_DIFFRAX_NUMBERS
    )
    found = None
    if by_diffrax:
        # what an adaptive solver gives up at, such as a force that chatters about zero, equal steps walk through
        found = _build_reference(problem, scene, *_make_diffrax_solver(problem, push), strict=True)
    return found or _build_reference(problem, scene, *_make_own_solver(problem, own or rk4, wanted, seconds, push))


def _build_reference(
    problem: Problem, scene: Scene, solve: Callable, glance: Callable, strict: bool = False
) -> ReferenceSolution | None:
    """What a solver knows of a problem; where it is `strict` None if any of that is not finite."""
    finite = lambda tree: not strict or all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))  # noqa: E731
    states, second, slopes, source = solve(scene)
    if not finite((states, second)):
        return None
    between = glance(scene)
    if not finite(between):
        return None
    seen = jax.tree.map(lambda a, b: np.concatenate([a, b]), states, between)
    part = lambda size: solve(nudged(scene, seen, size), alone=True)[0]  # noqa: E731
    reach = _measure_reach(scene, problem.times, states, between)
    less, moved = partial(part, NUDGE_SHARE / NUDGE_RATIO), part(NUDGE_SHARE)
    if not finite(moved):
        return None
    return ReferenceSolution(scene, problem.times, states, second, moved, slopes, source, reach, less)


def _measure_reach(scene: Scene, times: np.ndarray, *paths: Any) -> np.ndarray:
    """How far each unit ever is from where it began, on all of the paths; 0 where that is rounding."""
    far = np.fmax.reduce([extent(scene, times, states) for states in paths])
    place = np.abs(np.asarray(paths[0].place[0])).max(axis=(-2, -1) if scene.couples else -1)
    return np.where(far > ROUNDING_EXTENT_SHARE * place.reshape(far.shape), far, 0.0)


def nudged(scene: Scene, states: Any, part: float = NUDGE_SHARE) -> Scene:
    """The scene with its velocities (of bodies, momenta) changed at random, by a part of the largest on each lane's path.

    Lanes that are coupled have their largest in common.
    """
    rng = np.random.default_rng(0)

    def random(leaf, over):
        lasting = np.abs(np.asarray(over)).max(axis=0)
        largest = lasting.max(axis=(-2, -1) if scene.couples else -1, keepdims=True)
        return jnp.asarray(rng.normal(size=leaf.shape) * largest)

    state = scene.kick(scene.state, jax.tree.map(random, scene.state, states), part)
    return scene.replace(state=state if scene.held is None else state.hold_lanes(1 - scene.held.astype(state.dtype)))


def _make_diffrax_solver(problem: Problem, push: Any) -> tuple[Callable, Callable]:
    """Dopri8 at two tolerances, and a glance in between the moments; compiles once."""
    times, end = jnp.asarray(problem.times), jnp.asarray(problem.duration)
    size = jnp.asarray(smallest_sizes(cast_floats(problem.scene, jnp.float64)))  # not a nudged one's, which may be tiny

    def once(scene, tolerance, times=times):
        run = lambda state: solve_ode(  # noqa: E731
            scene.replace(state=state), times, end, jnp.asarray(tolerance), jnp.asarray(tolerance * size), build_default_solver(), True
        )[0]  # fmt: skip
        return (run(scene.state), None) if push is None else jax.jvp(run, (scene.state,), (push,))

    def solve(scene, alone=False):
        states, slopes = jax.tree.map(np.asarray, once(scene, TIGHT_TOLERANCE))
        good = not alone and all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(states))
        second = jax.tree.map(np.asarray, once(scene, LOOSE_TOLERANCE))[0] if good else None
        return states, second, slopes, f"diffrax Dopri8, tolerance {TIGHT_TOLERANCE:.0e}"

    return solve, lambda scene: jax.tree.map(
        np.asarray, once(scene, EXTENT_TOLERANCE, INTERMEDIATE_TIME_RATIO * times)[0]
    )


def _make_own_solver(
    problem: Problem, method: Callable, wanted: float, seconds: float, push: Any
) -> tuple[Callable, Callable]:
    """Our own method, twice as fine again and again, until it no longer changes by what matters, or time is up.

    And a glance in between the moments, half as fine.
    """
    compiled = compile_run(problem, method, push=push)
    fineness = []  # of the first solution, which the nudged one shares

    def solve(scene, alone=False):
        runs, count, started = [], FIRST_STEPS_PER_FRAME, read_work_clock()
        if alone:
            runs.append(_run_compiled(compiled, scene, fineness[0]))
            return runs[0][0], None, None, ""
        while True:
            runs.append(_run_compiled(compiled, scene, count))
            if len(runs) >= 3 and _has_converged(problem, scene, runs, wanted / 50):
                break
            # the next takes twice as long as the last
            if len(runs) >= 3 and 3 * (read_work_clock() - started) > seconds:
                break
            count = 2 * count + 1  # steps that never end where the coarser ones did
        fineness.append(count)
        step = format_seconds(compiled.dt(count))
        states, slopes = runs[-1]
        return states, _pick_worse(problem, scene, runs), slopes, f"own {compiled.name}, step {step}, by Richardson"

    closer = compiled._replace(problem=problem._replace(duration=INTERMEDIATE_TIME_RATIO * problem.duration))
    return solve, lambda scene: _run_compiled(closer, scene, max(1, fineness[0] // 2))[0]


def _run_compiled(compiled: CompiledRun, scene: Scene, count: int) -> Any:
    found = jax.tree.map(np.asarray, compiled._replace(scene=scene)(count))
    return found if compiled.push is not None else (found, None)


def _has_converged(problem: Problem, scene: Scene, runs: list, enough: float) -> bool:
    last, before, first = (run[0] for run in (runs[-1], runs[-2], runs[-3]))
    changes = (path.error(scene, problem.times, other, last) for other in (before, first))
    return max(changes) < enough


def _pick_worse(problem: Problem, scene: Scene, runs: list) -> Any:
    """Of the two solutions before the last the one that tells of the larger error: what is answered late scatters."""
    last, before, first = (run[0] for run in (runs[-1], runs[-2], runs[-3]))
    if not problem.scene.resolves_at_step_end:
        return before
    changes = [path.error(scene, problem.times, other, last) for other in (before, first)]
    return before if changes[0] > changes[1] / 2 else first
