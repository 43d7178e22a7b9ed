"""The runs of a work-precision study: each method, float type and rival from coarse to fine, its errors and its times."""

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, NamedTuple, TypedDict

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, PyTree

from physjax.particles import Particles
from physjax.scene import Scene
from physjax.show.style import AS_GIVEN, Variant
from physjax.stepping.adaptive import Adaptive, count_steps
from physjax.stepping.reference import solve_ode
from physjax.study.accuracy.compiled_run import (
    CompiledRun,
    compile_run,
    find_mapped_arrays,
    map_copies,
    stack_copies,
)
from physjax.study.accuracy.error_measures import ErrorMeasure, final, path
from physjax.study.accuracy.method_facts import count_evaluations, count_evaluations_per_try, smallest_size
from physjax.study.accuracy.options import Budget
from physjax.study.accuracy.reference_solution import ReferenceSolution
from physjax.study.accuracy.result import Run
from physjax.study.energy.quantities import Conserved
from physjax.study.problem import Problem
from physjax.timing import Result, time_repeatedly
from physjax.vectors import scale

if TYPE_CHECKING:
    import diffrax

MAX_STEPS_PER_FRAME = 10**8
"""Steps between two moments beyond which no budget reaches."""
ROUNDING_ERRORS = {"float64": 1e-7, "float32": 1e-3}
"""Errors below which refinements that bring nothing are put down to rounding, relative to the path."""
STALLED_ERROR_RATIO = 0.9
"""A refinement that leaves more than this share of the error has brought nothing."""
LONGEST_TIMING = 4.0
"""Time for all repeats of a run, in those that its budget allows to one."""


class Errors(TypedDict):
    """Errors of a run, by the fields of `Run`."""

    final_error: float
    path_error: float
    drifts: tuple[float, ...]
    errors: tuple[float, ...]


class Times(TypedDict):
    """Times of a run, by the fields of `Run`."""

    seconds: float
    seconds_median: float


class Effort(TypedDict):
    """What a run took, by the fields of `Run`."""

    dt: float | None
    tolerance: float | None
    steps: int
    evaluations: int


class Identity(TypedDict):
    """Which method a run is of, by the fields of `Run`."""

    method: str
    scheme: str
    treatment: str
    adaptive: bool
    dtype: str


class Comparison(NamedTuple):
    """What all contenders meet: the problem, its true path at its moments, the norms, and how much time there is.

    Times are those of `batch` copies at once, errors those of one. `dts` [s] are None where the budget chooses.
    """

    problem: Problem
    truth: ReferenceSolution
    norms: tuple[ErrorMeasure, ...]
    budget: Budget
    dts: np.ndarray | None
    tolerances: Sequence[float]
    batch: int

    def measure_errors(self, scene: Scene, states: PyTree) -> Errors:
        """Errors of a run in the final state, on the path and in each of the norms, and the drift of what is conserved."""
        at_end, on_path, *others = (
            norm.error(scene, self.truth.times, states, self.truth.states) for norm in (final, path, *self.norms)
        )
        drifts = ()
        if self.problem.conserved:
            times = jnp.asarray(self.truth.times, scene.state.dtype)
            drifts = tuple(float(d) for d in _measure_drifts(scene, times, states, self.problem.conserved))
        return {"final_error": at_end, "path_error": on_path, "drifts": drifts, "errors": tuple(others)}

    def measure_times(self, run: Callable[[], Result]) -> tuple[Result, Times]:
        """What a run returns, and its least and median time [s]."""
        # one that takes twice its budget is the last of its method: it need not be timed well; and the longer a run is, the
        # less a moment disturbs it, and the fewer repeats it needs
        seconds = self.budget.seconds
        result, timing = time_repeatedly(run, self.budget.repeats, longest=2 * seconds, total=LONGEST_TIMING * seconds)
        return result, {"seconds": timing.least, "seconds_median": timing.median}

    def is_fine_enough(self, runs: Sequence[Run]) -> bool:
        """Whether the budget or rounding ends the refinement; steps that were given all run."""
        return self.dts is None and (runs[-1].seconds > self.budget.seconds or _has_reached_rounding(runs))


def run_method(
    comparison: Comparison, scene: Scene, method: Callable, treatment: str, dtype: DTypeLike
) -> tuple[list[Run], float]:
    """One method from coarse to fine, and the order that it promises: one compilation, then runs until it is fine enough."""
    problem = comparison.problem._replace(scene=scene)
    entry = compile_run(problem, method, dtype, treatment=treatment)
    many = entry if comparison.batch == 1 else compile_run(problem, method, dtype, copies=comparison.batch)
    runs: list[Run] = []
    for fineness in _list_finenesses(comparison, entry):
        found, times = comparison.measure_times(partial(many, fineness))
        states = found if many is entry else entry(fineness)
        runs.append(
            Run(
                **_identify(entry.variant),
                **times,
                **comparison.measure_errors(entry.scene, states),
                **_count_effort(entry, fineness),
                compile_seconds=entry.compile_seconds,
            )
        )
        if comparison.is_fine_enough(runs):
            break
    return runs, entry.promised


def run_gradient(comparison: Comparison, scene: Scene, method: Callable, treatment: str, push: Particles) -> list[Run]:
    """The same for the derivative of the path along a push of the start, by forward mode, against the true derivative.

    The error is relative to the largest the true derivative becomes; the time is that of path and derivative together.
    """
    entry = compile_run(comparison.problem._replace(scene=scene), method, push=push, treatment=treatment)
    truth, runs = comparison.truth, []
    largest = float(np.abs(np.asarray(truth.slopes.place)).max())
    for fineness in _list_finenesses(comparison, entry):
        (_, slopes), times = comparison.measure_times(partial(entry, fineness))
        off = path.moments(truth.scene, truth.times, slopes, truth.slopes, largest)
        runs.append(
            Run(
                **_identify(entry.variant),
                **times,
                **_count_effort(entry, fineness),
                final_error=float(off[-1]),
                path_error=float(off.max()),
                drifts=(),
                compile_seconds=entry.compile_seconds,
            )
        )
        if comparison.is_fine_enough(runs):
            break
    return runs


def run_rival(comparison: Comparison, scene: Scene, solver: "diffrax.AbstractERK") -> list[Run]:
    """A diffrax solver with adaptive steps, from loose to tight tolerance; one compilation."""
    size = smallest_size(scene)
    moments = jnp.asarray(comparison.truth.times, scene.state.dtype)
    arguments = lambda tol: (moments, moments[-1], jnp.asarray(tol), jnp.asarray(tol * size), solver, False)  # noqa: E731
    started = time.perf_counter()
    compiled = solve_ode.lower(scene, *arguments(1e-3)).compile()
    compile_seconds = time.perf_counter() - started
    timed = partial(compiled, scene)
    if comparison.batch > 1:
        timed = partial(_solve_copies, stack_copies(scene, comparison.batch), find_mapped_arrays(scene))
    # first same as last: the last stage of a step is the first of the next
    tableau = solver.tableau  # of an explicit solver there is one
    stages = tableau.num_stages - (1 if tableau.fsal else 0)  # pyright: ignore[reportAttributeAccessIssue]  see above
    name, dtype = f"diffrax {type(solver).__name__}", np.dtype(scene.state.dtype).name
    runs: list[Run] = []
    for tol in comparison.tolerances:
        found, times = comparison.measure_times(partial(timed, *arguments(tol)))
        states, success, stats = found if comparison.batch == 1 else compiled(scene, *arguments(tol))
        steps, measured = int(stats["num_steps"]), comparison.measure_errors(scene, states)
        if not success:
            measured["final_error"] = measured["path_error"] = float("nan")
        runs.append(
            Run(
                method=name,
                scheme=name,
                treatment=AS_GIVEN,
                adaptive=True,
                dtype=dtype,
                **times,
                **measured,
                dt=None,
                tolerance=tol,
                steps=steps,
                evaluations=stages * steps + 1,
                compile_seconds=compile_seconds,
            )
        )
        if success and runs[-1].seconds > comparison.budget.seconds:
            break
    return runs


@eqx.filter_jit
def _solve_copies(
    scene: Scene,
    copied: tuple[bool, ...] | None,
    times: Array,
    end: Array,
    rtol: Array,
    atol: Array,
    solver: "diffrax.AbstractERK",
    strict: bool,
) -> PyTree:
    """States of stacked copies by a diffrax solver."""
    return map_copies(lambda one: solve_ode(one, times, end, rtol, atol, solver, strict)[0], scene, copied)


def _identify(variant: Variant) -> Identity:
    """The fields of a run that say of which variant of a method it is."""
    return {
        "method": variant.display_name,
        "scheme": variant.method,
        "treatment": variant.treatment,
        "adaptive": variant.adaptive,
        "dtype": variant.dtype,
    }


def _count_effort(entry: CompiledRun, fineness: float) -> Effort:
    """Step or tolerance of a run, its steps and evaluations; counted, where a method chooses its own steps."""
    frames, method = entry.problem.frames, entry.tune_method(fineness)
    if not isinstance(method, Adaptive):
        steps = frames * entry.count(fineness)
        each = count_evaluations(method, entry.scene)
        return {"dt": entry.dt(fineness), "tolerance": None, "steps": steps, "evaluations": each * steps}
    measured = count_steps(entry.scene, method, dt=entry.dt(fineness), steps=frames)
    each = np.asarray(measured.accepted + measured.rejected).reshape(frames, -1)
    # the slowest lane sets the count: of the run, or of each dt where contacts make lanes run in step
    tries = each.sum(axis=0).max() if entry.scene.only_moves else each.max(axis=1).sum()
    # and two for the length of the first step: of the run, or of each dt where steps start over with it
    evaluations = int(
        count_evaluations_per_try(method, entry.scene) * tries + 2 * (1 if entry.scene.only_moves else frames)
    )
    return {"dt": None, "tolerance": 1 / fineness, "steps": int(tries), "evaluations": evaluations}


def _list_finenesses(comparison: Comparison, entry: CompiledRun) -> list[float]:
    """From coarse to fine, without repeats."""
    if entry.adaptive:
        return [1 / tolerance for tolerance in comparison.tolerances]
    if comparison.dts is not None:
        spacing = comparison.problem.duration / comparison.problem.frames
        return sorted({float(max(1, round(spacing / dt))) for dt in comparison.dts})
    counts = np.unique(np.round(comparison.budget.refinement ** np.arange(0, 60)).astype(int))
    return [float(c) for c in counts if c < MAX_STEPS_PER_FRAME]


def _has_reached_rounding(runs: Sequence[Run]) -> bool:
    """Whether the last two refinements no longer reduced the error: rounding has taken over."""
    if len(runs) < 3:
        return False
    first, second, third = (run.path_error for run in runs[-3:])
    small = max(first, second, third) < ROUNDING_ERRORS.get(runs[-1].dtype, ROUNDING_ERRORS["float32"])
    return small and second > STALLED_ERROR_RATIO * first and third > STALLED_ERROR_RATIO * second


@partial(jax.jit, static_argnames="quantities")
def _measure_drifts(scene: Scene, times: Array, states: PyTree, quantities: tuple[Conserved, ...]) -> list[Array]:
    """Largest change of each conserved quantity over the path, relative to its size."""
    over_time = lambda f: jax.vmap(lambda t, state: f(scene, t, state))(times, states)  # noqa: E731
    drifts = []
    for quantity in quantities:
        value, size = over_time(quantity.value), jnp.max(over_time(quantity.size), axis=0)
        change = jnp.max(jnp.abs(value - value[:1]), axis=0)
        drifts.append(jnp.max(scale(1 / size, change)))
    return drifts
