"""The true path that errors are measured against, its own error, and how fast errors of the start grow along it.

A closed form where there is one; else diffrax; else, through contacts, with forces that remember and where the state is
so large that diffrax would take minutes, our own rk4 with far finer steps, whose last refinement shows its remaining
error (Richardson).
"""

from collections.abc import Callable
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, PyTree

from physjax.backend import read_work_clock
from physjax.scene import Scene
from physjax.stepping.methods import rk4
from physjax.stepping.reference import build_default_solver, cast_floats, solve_ode
from physjax.study.accuracy.compiled_run import CompiledRun, compile_run
from physjax.study.accuracy.error_measures import ErrorMeasure, extent, path
from physjax.study.accuracy.method_facts import smallest_sizes
from physjax.study.problem import Problem
from physjax.text import format_seconds

EXTENT_TOLERANCE = 1e-6
"""Tolerance of the quick solution that shows how far a path goes."""
TIGHT_TOLERANCE, LOOSE_TOLERANCE = 1e-13, 4e-13
"""Tolerances of the two references through diffrax: their steps differ by a tenth, and so do their errors."""
DIFFRAX_ORDER = 8
"""The order of Dopri8."""
MAX_DIFFRAX_NUMBERS = 20_000
"""Numbers in a state beyond which diffrax takes too long at such tolerances: a thousand ropes take a quarter of an hour."""
FIRST_STEPS_PER_FRAME = 8
"""Steps between two moments with which our own reference begins; they are doubled."""
NUDGE_SHARE = 1e-10
"""The change of the start, relative to the path, whose growth is measured: far from rounding and from curvature."""
NUDGE_RATIO = 10.0
"""A second nudge, this many times larger, confirms growth: what the nudge has caused is then as many times larger."""
SATURATED_SHARE = 1e-3
"""The size of a deviation, relative to the path, from which it no longer grows like a small one."""
INTERMEDIATE_TIME_RATIO = (1 + 5**0.5) / 4
"""Moments this many times as far apart see what a motion does between the moments: an irrational ratio, whatever its period."""
ROUNDING_EXTENT_SHARE = 1e-12
"""An extent, relative to the distance from the origin, that is rounding."""
CONVERGED_ERROR_SHARE = 1 / 50
"""Our own solution is fine enough when a refinement changes it by this share of the error that is to be measured."""
CHAOTIC_EFOLDINGS = 5.0
"""How many times an error must grow by e over a run for one to speak of chaos."""
CHAOTIC_GROWTH = 1e6
"""Growth of an error of the start from which on one speaks of chaos, however it grew; what drifts apart stays below."""
LARGEST_REGULAR_POWER = 2.5
"""The power of time with which errors may grow where there is no chaos: t at a constant rate, t² under a constant push."""
MAX_EXPONENT = 700.0
"""Exponents beyond this overflow float64."""


class ReferenceSolution(NamedTuple):
    """States at the moments, those of a second, coarser solution, and those from a start that was nudged.

    `second` and `nudged` are None where the states are a closed form. `slopes` is the derivative along a push of the start.
    `reach` is how far each unit goes, at the moments and in between. `more_nudged()` solves from a start that was nudged
    ten times as far, `solve_start(scene)` solves from any, states and slopes, and takes about `seconds` [s].
    `compiled_run` is what it was solved by, where that is a method of our own; `steps` between two moments are those of
    diffrax otherwise.
    """

    scene: Scene
    times: np.ndarray
    states: PyTree
    second: PyTree
    nudged: PyTree
    slopes: PyTree
    source: str
    reach: np.ndarray | None = None
    more_nudged: Callable[[], PyTree] | None = None
    solve_start: Callable[[Scene], tuple[PyTree, PyTree]] | None = None
    seconds: float = 0.0
    compiled_run: CompiledRun | None = None
    steps: float | None = None

    @property
    def difficulty(self) -> float | None:
        """The steps between two moments at which errors would be as large as the path; None where that is not known.

        Those that an error of the tolerance takes, brought to an error of 1 by the order of the solver.
        """
        return None if self.steps is None else self.steps * TIGHT_TOLERANCE ** (1 / DIFFRAX_ORDER)

    def truth_error(self, norm: ErrorMeasure = path, scale: ArrayLike | None = None) -> np.ndarray:
        """How far the truth itself may be wrong at each moment, `(moments,)`; 0 for a closed form."""
        # where moments are close the two solutions take the same steps and agree: then an error of the tolerance grows
        return np.maximum(self._measure_deviation(self.second, norm, scale), TIGHT_TOLERANCE * self.growth(norm, scale))

    def growth(self, norm: ErrorMeasure = path, scale: ArrayLike | None = None) -> np.ndarray:
        """The factor by which a small error of the start has grown at each moment; 1: it moves along."""
        return self._measure_deviation(self.nudged, norm, scale) / NUDGE_SHARE

    def horizon(self, error: float, eps: float, norm: ErrorMeasure = path, scale: ArrayLike | None = None) -> float:
        """The first moment [s] at which rounding of size `eps` has grown beyond an error; infinite if it does not.

        Where the nudged path is not known, or no farther away when nudged more, nothing is known to have grown.
        """
        growth = self.growth(norm, scale)
        if not np.isfinite(growth).all():
            return float("inf")
        times = self.times[len(self.times) - len(growth) :]
        grown = growth * NUDGE_SHARE > SATURATED_SHARE
        if grown.any():
            # two paths as far apart as the path is long separate no further; rounding is still small, and keeps growing at
            # the rate that the nudge grew with until then
            since = int(np.argmax(grown))
            rate = np.log(growth[since]) / times[since]
            growth = np.where(np.arange(len(times)) < since, growth, np.exp(np.minimum(rate * times, MAX_EXPONENT)))
        over = growth * eps > error
        if not over.any() or not self._is_proportional(norm, scale):
            return float("inf")
        return float(times[int(np.argmax(over))])

    def lyapunov_time(self, norm: ErrorMeasure = path, scale: ArrayLike | None = None) -> float:
        """The time [s] in which small errors of the start grow by a factor of e; infinite where the motion is not chaotic.

        Chaotic is what grows by e⁵ over the run, and exponentially, or a millionfold. What drifts apart at a constant rate
        grows as t, under a constant push as t²; five e-foldings look like t³ or more, from whichever moment of the second
        quarter on. (Of an eccentric orbit errors are large at each pericentre: growth from one to the next is what counts.)
        """
        growth = np.maximum.accumulate(self.growth(norm, scale))
        times = self.times[len(self.times) - len(growth) :]
        far = growth * NUDGE_SHARE > SATURATED_SHARE  # two paths separate no further from there on
        last = int(np.argmax(far)) if far.any() else len(far) - 1
        first, until = (int(np.searchsorted(times, share * times[last])) for share in (0.25, 0.5))
        if not np.isfinite(growth).all() or not 0 < first < until < last or not growth[first] > 0:
            return float("inf")
        time = times[last] / max(np.log(growth[last]), 1e-300)
        early = slice(first, until + 1)
        power = np.min(np.log(growth[last] / growth[early]) / np.log(times[last] / times[early]))
        exponential = power > LARGEST_REGULAR_POWER or growth[last] > CHAOTIC_GROWTH
        chaotic = times[-1] > CHAOTIC_EFOLDINGS * time and exponential
        return float(time) if chaotic and self._is_proportional(norm, scale) else float("inf")

    def find_least_certain(self, norm: ErrorMeasure = path, scale: ArrayLike | None = None) -> int | None:
        """The unit (lane, or coupled scene) whose truth is least certain; None where there is one only, or a closed form."""
        if self.second is None:
            return None
        off = norm.units(self.scene, self.times, self.second, self.states, self.size(norm, scale))
        worst = np.where(np.isfinite(off), off, np.inf).max(axis=0)
        return int(np.argmax(worst)) if worst.size > 1 else None

    def size(self, norm: ErrorMeasure, scale: ArrayLike | None) -> ArrayLike | None:
        """What errors are relative to, where no scale is given: how far the path goes in between the moments as well."""
        return self.reach if scale is None and norm.size is extent else scale

    def _is_proportional(self, norm: ErrorMeasure, scale: ArrayLike | None) -> bool:
        """Whether a larger nudge leads farther away, at the last moment at which what it causes is still small.

        Where it does not, as with dry friction, the deviation is noise of the solver and says nothing about growth.
        """
        if self.more_nudged is None:
            return True
        near = self._measure_deviation(self.nudged, norm, scale)
        far = self._measure_deviation(self.more_nudged(), norm, scale)
        small = (far > 0) & (far < SATURATED_SHARE)
        if not small.any():
            return True
        last = np.flatnonzero(small)[-1]
        # halfway, as logarithms go, between in proportion and not at all
        return bool(near[last] < far[last] / NUDGE_RATIO**0.5)

    def _measure_deviation(self, other: PyTree, norm: ErrorMeasure, scale: ArrayLike | None) -> np.ndarray:
        if other is None:
            return np.zeros(len(self.times))
        return norm.moments(self.scene, self.times, other, self.states, self.size(norm, scale))


def solve_reference(
    problem: Problem, *, wanted: float = 1e-8, seconds: float = 3.0, push: PyTree = None, own: Callable | None = None
) -> ReferenceSolution:
    """The true path of a problem at its moments, its own error well below `wanted` if that takes the processor `seconds` [s].

    Inside `jax.enable_x64(True)`. Our own solution is refined until the last refinement changes it by less than a
    fiftieth of `wanted`; by the method `own` where given, for a second truth.
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
    if own is None and suits_diffrax(problem):
        # equal steps get through where an adaptive solver gives up, such as a force that switches about zero
        found = _build_reference(problem, scene, _make_diffrax_solver(problem, push), strict=True)
        if found is not None:
            return found
    found = _build_reference(problem, scene, _make_own_solver(problem, own or rk4, wanted, seconds, push))
    assert found is not None  # only a strict one may be
    return found


def suits_diffrax(problem: Problem) -> bool:
    """Whether diffrax can solve a problem, in a time that one may wait."""
    few = sum(leaf.size for leaf in jax.tree.leaves(problem.scene.state)) <= MAX_DIFFRAX_NUMBERS
    return problem.is_ode and few


class _Solution(NamedTuple):
    """What a solver finds for the scene itself; `steps` between two moments, where it counts them."""

    states: PyTree
    second: PyTree
    slopes: PyTree
    source: str
    steps: float | None = None


class _Solver(NamedTuple):
    """A way to solve a problem, compiled once: the scene itself with a second, coarser solution; other starts; in between.

    `solve_start(scene)` is as good as the first solution, `sample_between(scene)` a quick look at other moments.
    """

    solve: Callable[[Scene], _Solution]
    solve_start: Callable[[Scene], tuple[PyTree, PyTree]]
    sample_between: Callable[[Scene], PyTree]
    compiled_run: CompiledRun | None = None


def _build_reference(problem: Problem, scene: Scene, solver: _Solver, strict: bool = False) -> ReferenceSolution | None:
    """The reference that a solver gives for a problem; where it is `strict`, None if any of that is not finite."""
    finite = lambda tree: not strict or all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))  # noqa: E731
    found = solver.solve(scene)
    states = found.states
    if not finite((states, found.second)):
        return None
    between = solver.sample_between(scene)
    if not finite(between):
        return None
    visited = jax.tree.map(lambda a, b: np.concatenate([a, b]), states, between)
    solve_nudged = lambda share: solver.solve_start(nudge_start(scene, visited, share))[0]  # noqa: E731
    reach = _measure_reach(scene, problem.times, states, between)
    # asked for once for each error, if at all
    more, started = cache(partial(solve_nudged, NUDGE_SHARE * NUDGE_RATIO)), read_work_clock()
    moved = solve_nudged(NUDGE_SHARE)
    seconds = read_work_clock() - started
    if not finite(moved):
        return None
    return ReferenceSolution(
        scene,
        problem.times,
        states,
        found.second,
        moved,
        found.slopes,
        found.source,
        reach,
        more,
        solver.solve_start,
        seconds,
        solver.compiled_run,
        found.steps,
    )


def _measure_reach(scene: Scene, times: np.ndarray, *paths: PyTree) -> np.ndarray:
    """How far each unit ever is from where it began, on all of the paths; 0 where that is rounding."""
    far = np.fmax.reduce([extent(scene, times, states) for states in paths])
    place = np.abs(np.asarray(paths[0].place[0])).max(axis=(-2, -1) if scene.couples else -1)
    return np.where(far > ROUNDING_EXTENT_SHARE * place.reshape(far.shape), far, 0.0)


def nudge_start(scene: Scene, states: PyTree, share: float = NUDGE_SHARE, seed: int = 0) -> Scene:
    """The scene with its velocities (of bodies, momenta) changed at random, by a share of the largest on each lane's path.

    Lanes that are coupled have their largest in common.
    """
    rng, lanes = np.random.default_rng(seed), len(scene.state.lanes)

    def draw_change(leaf: Array, over: np.ndarray) -> np.ndarray:
        over_time = np.abs(np.asarray(over)).max(axis=0)
        # an angle is a number for each lane, without an axis of components
        own = tuple(range(lanes - 1 if scene.couples else lanes, over_time.ndim))
        largest = over_time.max(axis=own, keepdims=True)
        return rng.normal(size=leaf.shape) * largest

    change = jax.tree.map(draw_change, scene.state, states)
    return scene.replace(state=_kick_start(scene, change, np.asarray(share)))


@jax.jit  # one small program instead of one for each operation
def _kick_start(scene: Scene, change: PyTree, share: Array) -> PyTree:
    state = scene.kick(scene.state, change, share)
    return state if scene.held is None else state.hold_lanes(1 - scene.held.astype(state.dtype))


def _make_diffrax_solver(problem: Problem, push: PyTree) -> _Solver:
    """Dopri8 at two tolerances, and a quick solution in between the moments; compiles once."""
    times, end = jnp.asarray(problem.times), jnp.asarray(problem.duration)
    # sizes of the scene as given: those of a nudged one that starts at rest are tiny
    size, solver = np.asarray(smallest_sizes(cast_floats(problem.scene, jnp.float64))), build_default_solver()

    def solve_at(scene: Scene, tolerance: float, times: Array = times) -> tuple[PyTree, PyTree, int]:
        rtol, atol = jnp.asarray(tolerance), jnp.asarray(tolerance * size)

        def run(state: PyTree) -> tuple[PyTree, Array]:
            states, _, counted = solve_ode(scene.replace(state=state), times, end, rtol, atol, solver, True)
            return states, counted["num_steps"]

        if push is None:
            states, steps = run(scene.state)
            return *jax.tree.map(np.asarray, (states, None)), int(steps)
        states, slopes, steps = jax.jvp(run, (scene.state,), (push,), has_aux=True)
        return *jax.tree.map(np.asarray, (states, slopes)), int(steps)

    def solve(scene: Scene) -> _Solution:
        states, slopes, steps = solve_at(scene, TIGHT_TOLERANCE)
        good = all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(states))
        second = solve_at(scene, LOOSE_TOLERANCE)[0] if good else None
        source = f"diffrax Dopri8, tolerance {TIGHT_TOLERANCE:.0e}"
        return _Solution(states, second, slopes, source, steps / problem.frames)

    return _Solver(
        solve,
        lambda scene: solve_at(scene, TIGHT_TOLERANCE)[:2],
        lambda scene: solve_at(scene, EXTENT_TOLERANCE, INTERMEDIATE_TIME_RATIO * times)[0],
    )


def _make_own_solver(problem: Problem, method: Callable, wanted: float, seconds: float, push: PyTree) -> _Solver:
    """Our own method with twice the steps again and again, until it no longer changes by what matters, or time is up.

    And a quick solution in between the moments, half as fine.
    """
    compiled = compile_run(problem, method, push=push)
    fineness: list[int] = []  # of the first solution; other starts take the same steps, so their errors cancel

    def solve(scene: Scene) -> _Solution:
        runs, count, started = [], FIRST_STEPS_PER_FRAME, read_work_clock()
        while True:
            runs.append(_run_compiled(compiled, scene, count))
            if len(runs) >= 3 and _has_converged(problem, scene, runs, CONVERGED_ERROR_SHARE * wanted):
                break
            # the next takes twice as long as the last
            if len(runs) >= 3 and 3 * (read_work_clock() - started) > seconds:
                break
            count = 2 * count + 1  # steps that never end where the coarser ones did
        fineness.append(count)
        step = format_seconds(compiled.dt(count))
        states, slopes = runs[-1]
        source = f"own {compiled.name}, step {step}, by Richardson"
        return _Solution(states, _pick_worse(problem, scene, runs), slopes, source)

    closer = compiled._replace(problem=problem._replace(duration=INTERMEDIATE_TIME_RATIO * problem.duration))
    return _Solver(
        solve,
        lambda scene: _run_compiled(compiled, scene, fineness[0]),
        lambda scene: _run_compiled(closer, scene, max(1, fineness[0] // 2))[0],
        compiled,
    )


def _run_compiled(compiled: CompiledRun, scene: Scene, count: int) -> tuple[PyTree, PyTree]:
    found = jax.tree.map(np.asarray, compiled._replace(scene=scene)(count))
    return found if compiled.push is not None else (found, None)


def _has_converged(problem: Problem, scene: Scene, runs: list[tuple[PyTree, PyTree]], enough: float) -> bool:
    last, before, first = (run[0] for run in (runs[-1], runs[-2], runs[-3]))
    changes = (path.error(scene, problem.times, other, last) for other in (before, first))
    return max(changes) < enough


def _pick_worse(problem: Problem, scene: Scene, runs: list[tuple[PyTree, PyTree]]) -> PyTree:
    """Of the two solutions before the last the one that shows the larger error.

    Where something is resolved at the end of a step the error scatters, and the last refinement may show little by chance.
    """
    last, before, first = (run[0] for run in (runs[-1], runs[-2], runs[-3]))
    if not problem.scene.resolves_at_step_end:
        return before
    changes = [path.error(scene, problem.times, other, last) for other in (before, first)]
    return before if changes[0] > changes[1] / 2 else first
