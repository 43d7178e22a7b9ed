"""The true path that errors are measured by, with its own doubt, and how far the start's rounding carries.

A closed form where there is one; else diffrax; else, through contacts, with forces that remember and where the state is
so large that diffrax would take minutes, our own rk4 with far finer steps, whose last refinement tells how wrong it still
is (Richardson).
"""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from physjax.scene import Scene
from physjax.show.report import seconds_text
from physjax.stepping.methods import rk4
from physjax.stepping.reference import default_solver, in_dtype, solve_ode
from physjax.study.norms import Norm, path
from physjax.study.problem import Problem
from physjax.study.running import Contender, answers_late, contender, smallest_size

TIGHT, LESS = 1e-13, 4e-13
"""Tolerances of the two references through diffrax: their steps differ by a tenth, and so do their errors."""
LARGE = 20_000
"""Numbers in a state beyond which nobody waits for diffrax at such tolerances: a thousand ropes take a quarter of an hour."""
COARSE = 8
"""Steps between two moments with which our own reference begins; they are doubled."""
NUDGE = 1e-10
"""The change of the start, in parts of the path, whose growth is looked at: far from rounding and from curvature."""
FULL_GROWN = 1e-3
"""What it has become, in parts of the path, when it no longer grows like a small one."""


class Yardstick(NamedTuple):
    """States at the moments, those of a second and less fine solution, and those from a start that was nudged.

    `second` and `nudged` are None where the states are a closed form. `slopes` are what becomes of a push of the start.
    """

    scene: Scene
    times: np.ndarray
    states: Any
    second: Any
    nudged: Any
    slopes: Any
    source: str

    def doubt(self, norm: Norm = path, scale: Any = None) -> np.ndarray:
        """How far the truth itself may be wrong at each moment, `(moments,)`; 0 for a closed form."""
        # where moments are close the two take the same steps: an error of the tolerance is then what grows
        return np.maximum(self._apart(self.second, norm, scale), TIGHT * self.growth(norm, scale))

    def growth(self, norm: Norm = path, scale: Any = None) -> np.ndarray:
        """How many times larger a small error of the start has become at each moment; 1: it moves along."""
        return self._apart(self.nudged, norm, scale) / NUDGE

    def horizon(self, error: float, eps: float, norm: Norm = path, scale: Any = None) -> float:
        """The first moment [s] at which rounding of size `eps` has grown beyond an error; infinite if it does not."""
        growth = self.growth(norm, scale)
        times = self.times[len(self.times) - len(growth) :]
        grown = growth * NUDGE > FULL_GROWN
        if grown.any():
            # two paths that have parted part no further; rounding is still smaller, and grows on as the nudge did
            since = int(np.argmax(grown))
            rate = np.log(growth[since]) / times[since]
            growth = np.where(np.arange(len(times)) < since, growth, np.exp(np.minimum(rate * times, 700.0)))
        over = growth * eps > error
        return float(times[int(np.argmax(over))]) if over.any() else float("inf")

    def _apart(self, other: Any, norm: Norm, scale: Any) -> np.ndarray:
        if other is None:
            return np.zeros(len(self.times))
        return norm.moments(self.scene, self.times, other, self.states, scale)


def yardstick(
    problem: Problem, *, wanted: float = 1e-8, seconds: float = 3.0, push: Any = None, own: Callable | None = None
) -> Yardstick:
    """The true path of a problem at its moments, its doubt well below the error `wanted` if the processor has `seconds` [s].

    Inside `jax.enable_x64(True)`. Our own solution is refined until the last refinement changes it by less than a
    fiftieth of what is wanted; by `own`, a method, where given: for a second truth.
    """
    scene = in_dtype(problem.scene, jnp.float64)
    if problem.exact is not None and push is None and own is None:
        states = problem.exact(problem.times)
        return Yardstick(scene, problem.times, states, None, None, None, "closed form")
    by_diffrax = problem.is_ode and own is None and sum(leaf.size for leaf in jax.tree.leaves(scene.state)) <= LARGE
    solve = _by_diffrax(problem, push) if by_diffrax else _by_own(problem, own or rk4, wanted, seconds, push)
    states, second, slopes, source = solve(scene)
    return Yardstick(scene, problem.times, states, second, solve(nudged(scene, states))[0], slopes, source)


def nudged(scene: Scene, states: Any, part: float = NUDGE) -> Scene:
    """The scene with its velocities (of bodies, momenta) changed at random, by a part of the largest on the path."""
    rng = np.random.default_rng(0)
    largest = lambda leaf, over: jnp.asarray(rng.normal(size=leaf.shape) * np.abs(np.asarray(over)).max())  # noqa: E731
    state = scene.kick(scene.state, jax.tree.map(largest, scene.state, states), part)
    return scene.having(state=state if scene.held is None else state.held(1 - scene.held.astype(state.dtype)))


def _by_diffrax(problem: Problem, push: Any) -> Any:
    """Dopri8 at two tolerances; compiles once."""
    times, end = jnp.asarray(problem.times), jnp.asarray(problem.duration)
    size = smallest_size(in_dtype(problem.scene, jnp.float64))  # not a nudged one's, which may be tiny

    def once(scene, tolerance):
        run = lambda state: solve_ode(  # noqa: E731
            scene.having(state=state), times, end, jnp.asarray(tolerance), jnp.asarray(tolerance * size), default_solver(), True
        )[0]  # fmt: skip
        return (run(scene.state), None) if push is None else jax.jvp(run, (scene.state,), (push,))

    def solve(scene):
        (states, slopes), (second, _) = (jax.tree.map(np.asarray, once(scene, tol)) for tol in (TIGHT, LESS))
        return states, second, slopes, f"diffrax Dopri8, tolerance {TIGHT:.0e}"

    return solve


def _by_own(problem: Problem, method: Callable, wanted: float, seconds: float, push: Any) -> Any:
    """Our own method, twice as fine again and again, until it no longer changes by what matters, or time is up."""
    compiled = contender(problem, method, push=push)
    fineness = []  # of the first solution, which the nudged one shares

    def solve(scene):
        runs, count, started = [], COARSE, time.process_time()
        if fineness:
            runs.append(_run(compiled, scene, fineness[0]))
            return runs[0][0], None, None, ""
        while True:
            runs.append(_run(compiled, scene, count))
            if len(runs) >= 3 and _settled(problem, scene, runs, wanted / 50):
                break
            # the next takes twice as long as the last
            if len(runs) >= 3 and 3 * (time.process_time() - started) > seconds:
                break
            count = 2 * count + 1  # steps that never end where the coarser ones did
        fineness.append(count)
        step = seconds_text(compiled.dt(count))
        states, slopes = runs[-1]
        return states, _worse(problem, scene, runs), slopes, f"own {compiled.name}, step {step}, by Richardson"

    return solve


def _run(compiled: Contender, scene: Scene, count: int) -> Any:
    found = jax.tree.map(np.asarray, compiled._replace(scene=scene)(count))
    return found if compiled.push is not None else (found, None)


def _settled(problem: Problem, scene: Scene, runs: list, enough: float) -> bool:
    last, before, first = (run[0] for run in (runs[-1], runs[-2], runs[-3]))
    changes = (path.error(scene, problem.times, other, last) for other in (before, first))
    return max(changes) < enough


def _worse(problem: Problem, scene: Scene, runs: list) -> Any:
    """Of the two solutions before the last the one that tells of the larger error: what is answered late scatters."""
    last, before, first = (run[0] for run in (runs[-1], runs[-2], runs[-3]))
    if not answers_late(problem.scene):
        return before
    changes = [path.error(scene, problem.times, other, last) for other in (before, first)]
    return before if changes[0] > changes[1] / 2 else first


__all__ = ["Yardstick", "nudged", "yardstick"]
