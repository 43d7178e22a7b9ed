"""The runs of a work-precision study: each method, float type and rival from coarse to fine, its errors and its times."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from physjax.physics import contacts
from physjax.scene import Scene
from physjax.show.style import FLOAT32_SUFFIX, PROJECTED_SUFFIX
from physjax.stepping.adaptive import count_steps
from physjax.stepping.reference import solve_ode
from physjax.study.accuracy.error_measures import ErrorMeasure, final, path
from physjax.study.accuracy.method_facts import CompiledRun, compile_run, evaluations, smallest_size, stack_copies
from physjax.study.accuracy.reference_solution import ReferenceSolution
from physjax.study.accuracy.result import Run
from physjax.study.energy.quantities import Conserved
from physjax.study.problem import Problem
from physjax.vectors import scale


class Budget(NamedTuple):
    """How long a study may take: refine a step until one run costs `seconds`, time each run `repeats` times.

    Example:
        >>> accuracy.Budget(seconds=0.2)
        Budget(seconds=0.2, repeats=5, refinement=1.5)
    """

    seconds: float = 0.05
    repeats: int = 5
    refinement: float = 1.5


class Comparison(NamedTuple):
    """What all contenders meet: the problem, its true path at its moments, the norms, and how much time there is.

    Times are those of `batch` copies at once, errors those of one. `dts` [s] and `tolerances` are given or None.
    """

    problem: Problem
    truth: ReferenceSolution
    norms: tuple[ErrorMeasure, ...]
    budget: Budget
    dts: np.ndarray | None
    tolerances: Sequence[float]
    batch: int

    def errors(self, scene: Scene, states: Any) -> dict[str, Any]:
        """Errors of a run in the final state, on the path, in each of the norms, and what it lost of what is kept."""
        judged = [norm.error(scene, self.truth.times, states, self.truth.states) for norm in (final, path, *self.norms)]
        kept = self.problem.conserved
        drifts = (
            tuple(float(d) for d in _measure_drifts(scene, self._reference_times(scene), states, kept)) if kept else ()
        )
        return {"final_error": judged[0], "path_error": judged[1], "drifts": drifts, "errors": tuple(judged[2:])}

    def _reference_times(self, scene: Scene) -> Any:
        return jnp.asarray(self.truth.times, scene.state.dtype)

    def times(self, name: str, run: Callable) -> dict[str, Any]:
        """Times of a run: the least and the median [s]."""
        seconds = time_run(run, self.budget)[1]
        return {"method": name, "seconds": seconds[0], "seconds_median": seconds[1]}


def list_treatments(scene: Scene) -> dict[str, Scene]:
    """The scene, and where it times impacts also the scene that projects instead, by what is added to a method's name."""
    if not any(contact.response is contacts.impact for contact in scene.contacts):
        return {"": scene}
    project = [
        replace(contact, response=contacts.project, touching_since=None)
        if contact.response is contacts.impact
        else contact
        for contact in scene.contacts
    ]
    return {
        "": scene,
        PROJECTED_SUFFIX: Scene(scene.state, scene.mass, scene.forces, project, scene.pinned, scene.emitter),
    }


def run_method(comparison: Comparison, scene: Scene, method: Callable, suffix: str, dtype: Any) -> list[Run]:
    """One method, from coarse to fine: one compilation, then runs until the budget or rounding ends the refinement."""
    entry = compile_run(comparison.problem._replace(scene=scene), method, dtype)
    many = entry if comparison.batch == 1 else _compile_copies(entry, comparison.batch)
    name = entry.name + suffix + (FLOAT32_SUFFIX if np.dtype(dtype) == np.float32 else "")
    runs = []
    for fineness in _list_finenesses(comparison, entry):
        states = entry(fineness)
        runs.append(
            Run(
                **comparison.times(name, partial(many, fineness)),
                **comparison.errors(entry.scene, states),
                **_count_effort(entry, fineness),
                compile_seconds=entry.compile_seconds,
                dtype=entry.dtype,
            )
        )
        if comparison.dts is None and (runs[-1].seconds > comparison.budget.seconds or _is_at_rounding(runs)):
            break
    return runs


def run_gradient(comparison: Comparison, scene: Scene, method: Callable, suffix: str, push: Any) -> list[Run]:
    """The same for the derivative of the path along a push of the start, by forward mode, against the true derivative.

    The error is relative to the largest the true derivative becomes; the time is that of path and derivative together.
    """
    entry = compile_run(comparison.problem._replace(scene=scene), method, push=push)
    truth, runs = comparison.truth, []
    largest = float(np.abs(np.asarray(truth.slopes.place)).max())
    for fineness in _list_finenesses(comparison, entry):
        _, slopes = entry(fineness)
        off = path.moments(truth.scene, truth.times, slopes, truth.slopes, largest)
        runs.append(
            Run(
                **comparison.times(entry.name + suffix, partial(entry, fineness)),
                **_count_effort(entry, fineness),
                final_error=float(off[-1]),
                path_error=float(off.max()),
                drifts=(),
                compile_seconds=entry.compile_seconds,
                dtype=entry.dtype,
            )
        )
        if comparison.dts is None and (runs[-1].seconds > comparison.budget.seconds or _is_at_rounding(runs)):
            break
    return runs


def run_rival(comparison: Comparison, scene: Scene, solver: Any) -> list[Run]:
    """A diffrax solver with adaptive steps, from loose to tight tolerance; one compilation."""
    size = smallest_size(scene)
    times = jnp.asarray(comparison.truth.times, scene.state.dtype)
    many = stack_copies(scene, comparison.batch) if comparison.batch > 1 else scene
    arguments = lambda scene, tol: (scene, times, times[-1], jnp.asarray(tol), jnp.asarray(tol * size), solver, False)  # noqa: E731
    started = time.perf_counter()
    compiled = solve_ode.lower(*arguments(scene, 1e-3)).compile()
    compile_seconds = time.perf_counter() - started
    stages = solver.tableau.num_stages - (1 if solver.tableau.fsal else 0)
    runs = []
    for tol in comparison.tolerances:
        states, success, stats = compiled(*arguments(scene, tol))
        run = partial(solve_ode if comparison.batch > 1 else compiled, *arguments(many, tol))
        steps, measured = int(stats["num_steps"]), comparison.errors(scene, states)
        if not success:
            measured |= {"final_error": float("nan"), "path_error": float("nan")}
        runs.append(
            Run(
                **comparison.times(f"diffrax {type(solver).__name__}", run),
                **measured,
                dt=None,
                tolerance=tol,
                steps=steps,
                evaluations=stages * steps + 1,
                compile_seconds=compile_seconds,
                dtype=np.dtype(scene.state.dtype).name,
            )
        )
        if success and runs[-1].seconds > comparison.budget.seconds:
            break
    return runs


def time_run(run: Callable, budget: Budget) -> tuple[Any, tuple[float, float]]:
    """The result of a run, and the least and the median of its times [s]; the first counts only where it is long."""
    times = []
    for _ in range(budget.repeats + 1):
        started = time.perf_counter()
        result = jax.block_until_ready(run())
        times.append(time.perf_counter() - started)
        if times[-1] > 2 * budget.seconds:
            break
    times = times[1:] or times
    return result, (min(times), float(np.median(times)))


def _compile_copies(entry: CompiledRun, count: int) -> CompiledRun:
    """The method compiled for so many copies of the scene."""
    problem = entry.problem._replace(scene=stack_copies(entry.scene, count))
    return compile_run(problem, entry.method, entry.dtype)


def _count_effort(entry: CompiledRun, fineness: float) -> dict[str, Any]:
    """Step or tolerance of a run, its steps and evaluations; counted, where a method chooses its own steps."""
    frames = entry.problem.frames
    if not entry.adaptive:
        steps = frames * entry.count(fineness)
        each = evaluations(entry.method, entry.scene)
        return {"dt": entry.dt(fineness), "tolerance": None, "steps": steps, "evaluations": each * steps}
    measured = count_steps(entry.scene, entry.tune_method(fineness), dt=entry.dt(fineness), steps=frames)
    tries = np.asarray(measured.accepted + measured.rejected).reshape(frames, -1).max(axis=1).sum()
    each = 3 * evaluations(getattr(entry.method.method, "function", entry.method.method), entry.scene)
    # whole and in halves, and two to begin each dt with
    counts = {"steps": int(tries), "evaluations": int(each * tries + 2 * frames)}
    return {"dt": None, "tolerance": 1 / fineness} | counts


def _list_finenesses(comparison: Comparison, entry: CompiledRun) -> list[float]:
    """From coarse to fine, without repeats."""
    if entry.adaptive:
        return [1 / tolerance for tolerance in comparison.tolerances]
    if comparison.dts is not None:
        spacing = comparison.problem.duration / comparison.problem.frames
        return sorted({float(max(1, round(spacing / dt))) for dt in comparison.dts})
    counts = np.unique(np.round(comparison.budget.refinement ** np.arange(0, 60)).astype(int))
    return [float(c) for c in counts if c < 10**8]


def _is_at_rounding(runs: Sequence[Run]) -> bool:
    """Whether the last two refinements no longer reduced the error: rounding has taken over."""
    errors = [run.path_error for run in runs[-3:]]
    close = 1e-7 if runs[-1].dtype == "float64" else 1e-3
    return len(errors) == 3 and max(errors) < close and errors[1] > 0.9 * errors[0] and errors[2] > 0.9 * errors[1]


@partial(jax.jit, static_argnames="quantities")
def _measure_drifts(scene: Scene, times: Any, states: Any, quantities: tuple[Conserved, ...]) -> list:
    """Largest change of each conserved quantity over the path, relative to its size."""
    over_time = lambda f: jax.vmap(lambda t, state: f(scene, t, state))(times, states)  # noqa: E731
    drifts = []
    for quantity in quantities:
        value, size = over_time(quantity.value), jnp.max(over_time(quantity.size), axis=0)
        change = jnp.max(jnp.abs(value - value[:1]), axis=0)
        drifts.append(jnp.max(scale(1 / size, change)))
    return drifts
