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
from physjax.show.style import FLOAT32, PROJECTED
from physjax.stepping.adaptive import count_steps
from physjax.stepping.reference import solve_ode
from physjax.study.accuracy.error_measures import Norm, final, path
from physjax.study.accuracy.method_facts import Contender, contender, copies, evaluations, smallest_size
from physjax.study.accuracy.reference_solution import Yardstick
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


class Contest(NamedTuple):
    """What all contenders meet: the problem, its true path at its moments, the norms, and how much time there is.

    Times are those of `batch` copies at once, errors those of one. `dts` [s] and `tolerances` are given or None.
    """

    problem: Problem
    truth: Yardstick
    norms: tuple[Norm, ...]
    budget: Budget
    dts: np.ndarray | None
    tolerances: Sequence[float]
    batch: int

    def errors(self, scene: Scene, states: Any) -> dict[str, Any]:
        """Errors of a run in the final state, on the path, in each of the norms, and what it lost of what is kept."""
        judged = [norm.error(scene, self.truth.times, states, self.truth.states) for norm in (final, path, *self.norms)]
        kept = self.problem.conserved
        drifts = tuple(float(d) for d in _drifts(scene, self._clock(scene), states, kept)) if kept else ()
        return {"final_error": judged[0], "path_error": judged[1], "drifts": drifts, "errors": tuple(judged[2:])}

    def _clock(self, scene: Scene) -> Any:
        return jnp.asarray(self.truth.times, scene.state.dtype)

    def times(self, name: str, run: Callable) -> dict[str, Any]:
        """Times of a run: the least and the median [s]."""
        seconds = timed(run, self.budget)[1]
        return {"method": name, "seconds": seconds[0], "seconds_median": seconds[1]}


def treatments(scene: Scene) -> dict[str, Scene]:
    """The scene, and where it times impacts also the scene that projects instead, by what is added to a method's name."""
    if not any(contact.response is contacts.impact for contact in scene.contacts):
        return {"": scene}
    project = [
        replace(contact, response=contacts.project, touching_since=None)
        if contact.response is contacts.impact
        else contact
        for contact in scene.contacts
    ]
    return {"": scene, PROJECTED: Scene(scene.state, scene.mass, scene.forces, project, scene.pinned, scene.emitter)}


def method_runs(contest: Contest, scene: Scene, method: Callable, suffix: str, dtype: Any) -> list[Run]:
    """One method, from coarse to fine: one compilation, then runs until the budget or rounding ends the refinement."""
    entry = contender(contest.problem._replace(scene=scene), method, dtype)
    many = entry if contest.batch == 1 else _copied(entry, contest.batch)
    name = entry.name + suffix + (FLOAT32 if np.dtype(dtype) == np.float32 else "")
    runs = []
    for fineness in _finenesses(contest, entry):
        states = entry(fineness)
        runs.append(
            Run(
                **contest.times(name, partial(many, fineness)),
                **contest.errors(entry.scene, states),
                **_effort(entry, fineness),
                compile_seconds=entry.compile_seconds,
                dtype=entry.dtype,
            )
        )
        if contest.dts is None and (runs[-1].seconds > contest.budget.seconds or _at_rounding(runs)):
            break
    return runs


def gradient_runs(contest: Contest, scene: Scene, method: Callable, suffix: str, push: Any) -> list[Run]:
    """The same for the derivative of the path along a push of the start, by forward mode, against the true derivative.

    The error is relative to the largest the true derivative becomes; the time is that of path and derivative together.
    """
    entry = contender(contest.problem._replace(scene=scene), method, push=push)
    truth, runs = contest.truth, []
    largest = float(np.abs(np.asarray(truth.slopes.place)).max())
    for fineness in _finenesses(contest, entry):
        _, slopes = entry(fineness)
        off = path.moments(truth.scene, truth.times, slopes, truth.slopes, largest)
        runs.append(
            Run(
                **contest.times(entry.name + suffix, partial(entry, fineness)),
                **_effort(entry, fineness),
                final_error=float(off[-1]),
                path_error=float(off.max()),
                drifts=(),
                compile_seconds=entry.compile_seconds,
                dtype=entry.dtype,
            )
        )
        if contest.dts is None and (runs[-1].seconds > contest.budget.seconds or _at_rounding(runs)):
            break
    return runs


def rival_runs(contest: Contest, scene: Scene, solver: Any) -> list[Run]:
    """A diffrax solver with adaptive steps, from loose to tight tolerance; one compilation."""
    size = smallest_size(scene)
    times = jnp.asarray(contest.truth.times, scene.state.dtype)
    many = copies(scene, contest.batch) if contest.batch > 1 else scene
    arguments = lambda scene, tol: (scene, times, times[-1], jnp.asarray(tol), jnp.asarray(tol * size), solver, False)  # noqa: E731
    started = time.perf_counter()
    compiled = solve_ode.lower(*arguments(scene, 1e-3)).compile()
    compile_seconds = time.perf_counter() - started
    stages = solver.tableau.num_stages - (1 if solver.tableau.fsal else 0)
    runs = []
    for tol in contest.tolerances:
        states, success, stats = compiled(*arguments(scene, tol))
        run = partial(solve_ode if contest.batch > 1 else compiled, *arguments(many, tol))
        steps, told = int(stats["num_steps"]), contest.errors(scene, states)
        if not success:
            told |= {"final_error": float("nan"), "path_error": float("nan")}
        runs.append(
            Run(
                **contest.times(f"diffrax {type(solver).__name__}", run),
                **told,
                dt=None,
                tolerance=tol,
                steps=steps,
                evaluations=stages * steps + 1,
                compile_seconds=compile_seconds,
                dtype=np.dtype(scene.state.dtype).name,
            )
        )
        if success and runs[-1].seconds > contest.budget.seconds:
            break
    return runs


def timed(run: Callable, budget: Budget) -> tuple[Any, tuple[float, float]]:
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


def _copied(entry: Contender, count: int) -> Contender:
    """The method compiled for so many copies of the scene."""
    problem = entry.problem._replace(scene=copies(entry.scene, count))
    return contender(problem, entry.method, entry.dtype)


def _effort(entry: Contender, fineness: float) -> dict[str, Any]:
    """Step or tolerance of a run, its steps and evaluations; counted, where a method chooses its own steps."""
    frames = entry.problem.frames
    if not entry.adaptive:
        steps = frames * entry.count(fineness)
        each = evaluations(entry.method, entry.scene)
        return {"dt": entry.dt(fineness), "tolerance": None, "steps": steps, "evaluations": each * steps}
    told = count_steps(entry.scene, entry.tuned(fineness), dt=entry.dt(fineness), steps=frames)
    tries = np.asarray(told.accepted + told.rejected).reshape(frames, -1).max(axis=1).sum()
    each = 3 * evaluations(getattr(entry.method.method, "function", entry.method.method), entry.scene)
    # whole and in halves, and two to begin each dt with
    counts = {"steps": int(tries), "evaluations": int(each * tries + 2 * frames)}
    return {"dt": None, "tolerance": 1 / fineness} | counts


def _finenesses(contest: Contest, entry: Contender) -> list[float]:
    """From coarse to fine, without repeats."""
    if entry.adaptive:
        return [1 / tolerance for tolerance in contest.tolerances]
    if contest.dts is not None:
        spacing = contest.problem.duration / contest.problem.frames
        return sorted({float(max(1, round(spacing / dt))) for dt in contest.dts})
    counts = np.unique(np.round(contest.budget.refinement ** np.arange(0, 60)).astype(int))
    return [float(c) for c in counts if c < 10**8]


def _at_rounding(runs: Sequence[Run]) -> bool:
    """Whether the last two refinements no longer reduced the error: rounding has taken over."""
    errors = [run.path_error for run in runs[-3:]]
    close = 1e-7 if runs[-1].dtype == "float64" else 1e-3
    return len(errors) == 3 and max(errors) < close and errors[1] > 0.9 * errors[0] and errors[2] > 0.9 * errors[1]


@partial(jax.jit, static_argnames="quantities")
def _drifts(scene: Scene, times: Any, states: Any, quantities: tuple[Conserved, ...]) -> list:
    """Largest change of each conserved quantity over the path, relative to its size."""
    over_time = lambda f: jax.vmap(lambda t, state: f(scene, t, state))(times, states)  # noqa: E731
    drifts = []
    for quantity in quantities:
        value, size = over_time(quantity.value), jnp.max(over_time(quantity.size), axis=0)
        change = jnp.max(jnp.abs(value - value[:1]), axis=0)
        drifts.append(jnp.max(scale(1 / size, change)))
    return drifts
