"""Speed against accuracy: how wrong is a run, what does it cost, and which method is cheapest for an error you can bear?

Everything is computed in float64 unless another dtype is asked for, errors are measured in positions, relative to how
far the reference moves, and a run that fails is kept and marked, never dropped.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from physjax.checks import real_quantity
from physjax.physics import contacts
from physjax.scene import Scene, as_module
from physjax.show.plot import PROJECTED
from physjax.show.report import seconds_text
from physjax.stepping.methods import METHODS, rk4
from physjax.stepping.reference import default_solver, in_dtype, reference, solve_ode
from physjax.stepping.simulate import sample
from physjax.study.energy import Conserved
from physjax.study.limits import name_of
from physjax.study.norms import energy, final, momentum, outcome, path, penetration
from physjax.study.problem import Problem
from physjax.study.recommend import recommend
from physjax.study.running import answers_late, depends_on_velocity, evaluations, promised_order, smallest_size
from physjax.study.work_precision import Run, WorkPrecision
from physjax.vectors import scale

TOLERANCES = tuple(10.0**-k for k in range(2, 13))
"""Tolerances at which the adaptive rivals run."""

DETAIL = 12
"""Moments of the reference path for every one at which errors are measured."""

FINE, COARSER = 16, 11
"""Steps between two of those moments where rk4 must be the reference since diffrax cannot be, and to estimate its error."""

LATE = 4
"""Times as many where rk4 is of first order, since something is answered at the end of a step."""


class Budget(NamedTuple):
    """How long a study may take: refine a step until one run costs `seconds`, time each run `repeats` times."""

    seconds: float = 0.05
    repeats: int = 5
    refinement: float = 1.5


THOROUGH = Budget()
"""Step sizes half an order apart, each timed well."""
QUICK = Budget(seconds=0.01, repeats=2, refinement=2.0)
"""A look in a few seconds."""


def work_precision(
    problem: Problem | Scene,
    methods: Sequence[Callable] | None = None,
    dts: ArrayLike | Sequence[float] | None = None,
    *,
    duration: float | None = None,
    exact: Callable | None = None,
    conserved: Sequence[Conserved] = (),
    rivals: Sequence[Any] | None = None,
    tolerances: Sequence[float] = TOLERANCES,
    dtype: Any = np.float64,
    budget: Budget = THOROUGH,
    name: str = "scene",
    progress: Callable[[str], None] = lambda what: None,
) -> WorkPrecision:
    """Run a scene under many methods and step sizes, and set error against cost.

    `problem` is a gallery problem, or a scene with its `duration` [s] and, if known, its closed form `exact(times)`.
    `methods`: all of the registry by default. `dts` [s]: from coarse to fine within the budget by default; each is
    rounded so that a whole number of steps fits between the moments compared. `rivals`: diffrax solvers, run adaptively
    at the `tolerances`; Tsit5 and Dopri8 by default, none where the scene has contacts or forces that remember. The
    truth is the closed form where there is one, else diffrax's Dopri8 at 1e-13, or, where diffrax has no rivals either,
    our own rk4 with fine steps; its own error is the floor of the result. Where impacts are timed (`contacts.impact`),
    every method runs once more with `contacts.project`, the lecture's answer at the end of the step, as "rk4,
    projected": what that does to the order. Compiles once per method and treatment. `progress(what)` is called before
    each method. Raises ValueError for a missing duration or bad steps.
    """
    problem = _as_problem(problem, duration, exact, conserved)
    methods = list(METHODS.values()) if methods is None else list(methods)
    if rivals is None:
        rivals = default_rivals() if problem.is_ode else ()
    if rivals and not problem.is_ode:
        raise ValueError(
            "work_precision: the scene has contacts, through which diffrax would pass, or forces that remember, which it "
            "would not let advance. Give rivals=()."
        )
    if dts is not None:
        dts = np.atleast_1d(np.asarray(real_quantity("dts [s]", dts, above=0.0), float))
    with jax.enable_x64(True):
        scene = in_dtype(problem.scene, dtype)
        progress("reference")
        path, floor, source = _truth(problem)
        truth = jax.tree.map(lambda leaf: leaf[::DETAIL], path)
        measure = _Errors(problem, scene, truth)
        runs = []
        treatments = _treatments(scene)
        for method in methods:
            progress(name_of(method))
            for treatment, treated in treatments.items():
                runs += _method_runs(problem, treated, method, name_of(method) + treatment, dts, measure, budget)
        for solver in rivals:
            progress(f"diffrax {type(solver).__name__}")
            runs += _rival_runs(problem, scene, solver, tolerances, measure, budget)
    velocity_dependent = depends_on_velocity(problem.scene)
    return WorkPrecision(
        name=name,
        runs=tuple(runs),
        promised={
            name_of(method) + treatment: promised_order(method, velocity_dependent, treated)
            for method in methods
            for treatment, treated in treatments.items()
        },
        truth=source,
        floor=floor,
        duration=problem.duration,
        conserved=tuple(quantity.name for quantity in problem.conserved),
        dtype=np.dtype(dtype).name,
        path=(_detailed(problem), path.position),
        scattered=answers_late(problem.scene),
    )


def _treatments(scene: Scene) -> dict[str, Scene]:
    """The scene, and where it times impacts also the scene that projects instead, by what is added to a method's name."""
    if not any(contact.response is contacts.impact for contact in scene.contacts):
        return {"": scene}
    project = [
        replace(contact, response=contacts.project, touching_since=None)
        if contact.response is contacts.impact
        else contact
        for contact in scene.contacts
    ]
    return {"": scene, PROJECTED: Scene(scene.state, scene.mass, scene.forces, project, scene.pinned)}


class _Errors:
    """Errors of a run against the truth, relative to the extent of the path, the worst lane and moment."""

    def __init__(self, problem: Problem, scene: Scene, truth: Any):
        place = np.asarray(truth.place, float)
        away = np.sqrt(np.sum((place - place[0]) ** 2, axis=-1))
        nodes = (0, -1) if scene.couples else (0,)
        extent = away.max(axis=nodes, keepdims=True)[0]
        self.extent = np.where(extent > 0, extent, 1.0)
        self.place = place
        self.drift = jax.jit(partial(_drifts, quantities=problem.conserved))
        self.scene, self.times = scene, jnp.asarray(problem.times)

    def __call__(self, states: Any) -> tuple[float, float, tuple[float, ...]]:
        """Final error, path error, and the relative drift of each conserved quantity."""
        off = np.asarray(states.place, float) - self.place
        with np.errstate(invalid="ignore", over="ignore"):
            error = np.sqrt(np.sum(off**2, axis=-1)) / self.extent
        drifts = tuple(float(d) for d in self.drift(self.scene, self.times, states))
        return float(error[-1].max()), float(error.max()), drifts


def _drifts(scene: Scene, times: Any, states: Any, quantities: tuple[Conserved, ...]) -> list:
    """Largest change of each conserved quantity over the path, relative to its size."""
    over_time = lambda f: jax.vmap(lambda t, state: f(scene, t, state))(times, states)  # noqa: E731
    drifts = []
    for quantity in quantities:
        value, size = over_time(quantity.value), jnp.max(over_time(quantity.size), axis=0)
        change = jnp.max(jnp.abs(value - value[:1]), axis=0)
        drifts.append(jnp.max(scale(1 / size, change)))
    return drifts


def _truth(problem: Problem) -> tuple[Any, float, str]:
    """The true path in detail, the error it has itself (relative; 0 for a closed form), and where it comes from."""
    times = _detailed(problem)
    if problem.exact is not None:
        return problem.exact(times), 0.0, "closed form"
    if not problem.is_ode:
        return _fine_path(problem)
    size = smallest_size(problem.scene)
    tolerance = {"rtol": 1e-13, "atol": 1e-13 * size}
    path = reference(problem.scene, times, **tolerance)
    # the same tolerance with longer steps, which need not land on the moments between: the difference is their error
    other = reference(problem.scene, problem.times, **tolerance)
    floor = _apart(path.state, jax.tree.map(lambda leaf: leaf[::DETAIL], path.state), other.state)
    return path.state, floor, "diffrax Dopri8, tolerance 1e-13"


def _fine_path(problem: Problem) -> tuple[Any, float, str]:
    """The path by rk4 with fine steps; its error is estimated by longer ones, which end at other moments."""
    scene, frames = in_dtype(problem.scene, jnp.float64), problem.frames * DETAIL
    run = lambda count: sample(scene, as_module(rk4), problem.duration / (frames * count), count, frames=frames)  # noqa: E731
    finer = LATE if answers_late(scene) else 1
    path, coarser = (jax.tree.map(np.asarray, run(jnp.asarray(finer * count))) for count in (FINE, COARSER))
    return (
        path,
        _apart(path, path, coarser),
        f"own rk4, step {seconds_text(problem.duration / (frames * finer * FINE))}",
    )


def _apart(path: Any, one: Any, other: Any) -> float:
    """The largest difference of two paths, relative to the extent of one."""
    place = np.asarray(path.place)
    return float(np.abs(np.asarray(one.place) - other.place).max() / np.abs(place - place[0]).max())


def _detailed(problem: Problem) -> np.ndarray:
    """The problem's times and more between them, so that a picture of the path has no corners."""
    return np.linspace(0.0, problem.duration, problem.frames * DETAIL + 1)


def _method_runs(problem, scene, method, name, dts, measure, budget):
    """One method, from coarse to fine: one compilation, then runs until the budget or rounding ends the refinement."""
    dt = jnp.asarray(problem.duration / problem.frames, scene.state.dtype)
    module = as_module(method)
    started = time.perf_counter()
    compiled = sample.lower(scene, module, dt, jnp.asarray(1), frames=problem.frames).compile()
    compile_seconds = time.perf_counter() - started
    each = evaluations(method, scene)
    runs = []
    for count in _counts(problem, dts, budget):
        h = jnp.asarray(problem.duration / (problem.frames * count), scene.state.dtype)
        states, seconds = _timed(partial(compiled, scene, module, h, jnp.asarray(count)), budget)
        steps = count * problem.frames
        final, path, drifts = measure(states)
        runs.append(Run(name, float(h), None, steps, each * steps, *seconds, compile_seconds, final, path, drifts))
        if dts is None and (seconds[0] > budget.seconds or _at_rounding(runs)):
            break
    return runs


def _rival_runs(problem, scene, solver, tolerances, measure, budget):
    """A diffrax solver with adaptive steps, from loose to tight tolerance; one compilation."""
    size = smallest_size(scene)
    times = jnp.asarray(problem.times, scene.state.dtype)
    arguments = lambda tol: (scene, times, times[-1], jnp.asarray(tol), jnp.asarray(tol * size), solver, False)  # noqa: E731
    started = time.perf_counter()
    compiled = solve_ode.lower(*arguments(1e-3)).compile()
    compile_seconds = time.perf_counter() - started
    stages = solver.tableau.num_stages - (1 if solver.tableau.fsal else 0)
    name = f"diffrax {type(solver).__name__}"
    runs = []
    for tol in tolerances:
        (states, success, stats), seconds = _timed(partial(compiled, *arguments(tol)), budget)
        final, path, drifts = measure(states)
        steps = int(stats["num_steps"])
        if not success:
            final = path = float("nan")
        runs.append(Run(name, None, tol, steps, stages * steps + 1, *seconds, compile_seconds, final, path, drifts))
        if success and seconds[0] > budget.seconds:
            break
    return runs


def _timed(run, budget):
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


def _counts(problem, dts, budget):
    """Numbers of steps between two frames, from coarse to fine, without repeats."""
    if dts is not None:
        spacing = problem.duration / problem.frames
        return sorted({max(1, round(spacing / dt)) for dt in dts})
    counts = np.unique(np.round(budget.refinement ** np.arange(0, 60)).astype(int))
    return [int(c) for c in counts if c < 10**8]


def _at_rounding(runs):
    """Whether the last two refinements no longer reduced the error: rounding has taken over."""
    errors = [run.path_error for run in runs[-3:]]
    return len(errors) == 3 and max(errors) < 1e-7 and errors[1] > 0.9 * errors[0] and errors[2] > 0.9 * errors[1]


def _as_problem(problem, duration, exact, conserved):
    if isinstance(problem, Problem):
        return problem
    if not isinstance(problem, Scene):
        raise TypeError(
            f"work_precision: got a {type(problem).__name__}, expected a Scene or a Problem of the gallery."
        )
    if duration is None:
        raise ValueError("work_precision: got a scene without a duration, expected duration= [s].")
    real_quantity("duration [s]", duration, above=0.0)
    return Problem(problem, float(duration), exact, tuple(conserved))


def default_rivals() -> tuple:
    """The adaptive solvers that a user of diffrax would reach for first: Tsit5, and Dopri8 for many digits."""
    import diffrax

    return diffrax.Tsit5(), default_solver()


__all__ = [
    "QUICK",
    "THOROUGH",
    "TOLERANCES",
    "Budget",
    "Run",
    "WorkPrecision",
    "default_rivals",
    "energy",
    "final",
    "momentum",
    "outcome",
    "path",
    "penetration",
    "recommend",
    "work_precision",
]
