"""Why a run blew up, or went astray: the step at which it happened, what is responsible, and the two cheapest cures."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.checks import as_positive_integer, as_real_quantity
from physjax.compiling import announce_compiling
from physjax.particles import demand_particles, view_centers
from physjax.physics.rigid.planar import PlanarBodies
from physjax.scene import Scene
from physjax.select import select_lane
from physjax.stepping.adaptive import Adaptive
from physjax.stepping.simulate import simulate
from physjax.study.stability.cures import list_cures, list_resolution_cures
from physjax.study.stability.limits import growth, limit
from physjax.study.stability.linearisation import rate_text
from physjax.study.stability.planar import State, count_substeps
from physjax.text import format_seconds
from physjax.tracebacks import shorten_tracebacks
from physjax.trajectory import Trajectory

INSPECTED_FRAMES = 12
"""Moments of a run at which its rates are computed."""
MAX_RESOLVED_RATE_STEP = 0.5
"""|λ| dt beyond which the fastest motion is stable at best, but not followed."""
LIMIT_TOLERANCE = 1e-9
"""Share by which dt may exceed a limit that was computed in rounded numbers."""
LOST_STEP_SHARE = 0.01
"""A step is lost in rounding where the last digit of a position is this share of the way gone in it."""
LARGEST_GROWN_SIZE = 1e4
"""A run that has grown to this many times its size is beyond its failure: what is found there says nothing of the cause."""
ERROR_TOLERANCE_RATIO = 10
"""An end this many times the tolerance away from a sound run's is elsewhere."""


class Explanation(NamedTuple):
    """What went wrong. Printed, it is a few sentences.

    `cause` is "stiffness", "damping", "resolution" (a motion too fast for dt, though bounded), "rounding" (positions so
    large that a step is lost in their last digits), "contact" (a surface that passed over a lane waiting for its next
    contact), "error measure" (an adaptive method that measures velocities alone), "input" (a traced number beyond its
    bounds) or "nothing". `first_bad_step` (-1: the run stayed finite) and `node` say where; `limit` [s] is the step that
    was too long, at time `t` [s]; `growth` a small deviation's growth in one step.

    Example:
        >>> found = stability.explain(swing, methods.verlet, dt=1.25)
        >>> isinstance(found, stability.Explanation), found.cause, round(found.growth, 3)
        (True, 'stiffness', 4.0)
    """

    cause: str
    force: str
    spring: tuple[int, int] | None
    rate: complex
    t: float
    dt: float
    limit: float
    growth: float
    first_bad_step: int
    node: tuple[int, ...]
    cures: tuple[str, ...]

    def __str__(self) -> str:
        return " ".join([self._describe_end(), self._describe_cause(), *(f"Cure: {cure}." for cure in self.cures)])

    def _describe_end(self) -> str:
        ended = "The run stayed finite."
        if self.first_bad_step >= 0:
            node = f", node {', '.join(map(str, self.node))} first" if self.node else ""
            ended = f"Not finite after step {self.first_bad_step}{node}."
        return ended

    def _describe_cause(self) -> str:
        if self.cause in ("stiffness", "damping"):
            where = "" if self.spring is None else f" (the spring between nodes {self.spring[0]} and {self.spring[1]})"
            longest = format_seconds(self.limit) if self.limit else "0 (no step is stable)"
            return (
                f"dt = {format_seconds(self.dt)} is beyond {longest}, the limit set at t = {self.t:.4g} s by the {self.cause} "
                f"of {self.force}{where}, λ = {rate_text(self.rate)} 1/s: deviations grow {self.growth:.6g} times a step."
            )
        return {
            "rounding": "Positions are so large that a step is lost in their rounding.",
            "contact": "A surface passed over a lane that had used up the contacts of a step and waited for the next.",
            "error measure": "The error looks at velocities alone and cannot see that positions are wrong.",
            "input": "It starts non-finite: a traced number beyond its bounds, or a start on the wrong side of a contact.",
            "nothing": "Nothing was found wrong with the step.",
            "resolution": f"{self.force} moves things at |λ| = {abs(self.rate):.4g} 1/s at t = {self.t:.4g} s, too fast for dt.",
        }[self.cause]


@shorten_tracebacks
@announce_compiling("explain")
def explain(
    run: Trajectory | Scene,
    method: Callable | None = None,
    dt: ArrayLike | None = None,
    *,
    steps: int = 1200,
    lane: int | tuple[int, ...] | None = None,
) -> Explanation:
    """Why a run blew up or went astray: where, the force and the eigenvalue responsible, the limit exceeded, two cures.

    Give a trajectory, or a scene with a method and a dt [s], which is then run for `steps`. Print the result. Of many lanes
    the first that failed is explained, or the given `lane` alone (of coupled ones a scene), as if it were run by itself:
    `explain(flight, lane=int(jnp.argmin(flight.ok)))`.

    Example:
        >>> found = stability.explain(swing, methods.verlet, dt=1.25)
        >>> found.cause, round(found.limit, 3), round(found.growth, 3)
        ('stiffness', 1.0, 4.0)
    """
    if isinstance(run, Trajectory) and run.scene is not None and not _starts_finite(run.scene, lane):
        first = int(run.first_step) + 1
        return _describe_sound_run(run, first, ())._replace(cause="input", cures=(_INPUT_CURE,))
    if lane is not None:
        return explain(_run_single_lane(run, method, dt, steps, lane))
    if isinstance(run, Scene):
        if method is None or dt is None:
            raise ValueError("explain: got a scene alone, expected its method and dt as well.")
        every = max(1, steps // INSPECTED_FRAMES)
        steps = as_positive_integer("steps", steps) // every * every
        run = simulate(run, method, dt=dt, steps=steps, save_every=every)
    if not isinstance(run, Trajectory) or run.scene is None or run.stepper is None or run.state is None:
        raise TypeError(_INCOMPLETE_RUN)
    if not isinstance(run.scene.state, PlanarBodies):
        demand_particles("explain", run.scene.state, "what turns in space is not linearised")
    return _explain_run(run)


_INCOMPLETE_RUN = "explain: expected a Trajectory that knows its scene and method, or a Scene with method and dt."
_INPUT_CURE = (
    "build the scene with its numbers outside jit, vmap and sweep, where the error names the one that is wrong"
)


def _explain_run(run: Trajectory) -> Explanation:
    """The first cause that fits, in an order in which none hides behind the consequences of another."""
    scene, method, step = _read_scene(run), run.method, float(np.min(np.asarray(run.dt)))
    as_real_quantity("dt [s]", step, above=0.0)
    first, node = _find_first_failure(run)
    sound = _describe_sound_run(run, first, node)
    if isinstance(method, Adaptive):
        return _check_error_measure(run, method, sound)
    if _fails_in_contact(run, first):
        return sound._replace(cause="contact", cures=("a shorter dt, with fewer contacts a step",))
    if _is_step_below_rounding(scene, step):
        return sound._replace(cause="rounding", cures=("compute in float64", "put the origin near the scene"))
    return _check_rates(run, sound)


def _describe_sound_run(run: Trajectory, first: int, node: tuple[int, ...]) -> Explanation:
    """The explanation of a run with whose step nothing is wrong."""
    return Explanation(
        cause="nothing",
        force="",
        spring=None,
        rate=0j,
        t=0.0,
        dt=float(np.nanmin(np.asarray(run.dt))),
        limit=float("inf"),
        growth=1.0,
        first_bad_step=first,
        node=node,
        cures=(),
    )


def _check_rates(run: Trajectory, sound: Explanation) -> Explanation:
    """Whether the step exceeds a limit at a moment of the run, or is too long to follow the fastest motion."""
    scene, method, step = _read_scene(run), _read_method(run), sound.dt
    found = [(t, limit(scene, method, at=state), state) for t, state in _pick_moments(run, scene)]
    exceeded = [moment for moment in found if step > moment[1].dt * (1 + LIMIT_TOLERANCE)]
    if exceeded:
        t, worst, state = exceeded[0]  # what follows may be its consequence
        return sound._replace(
            cause=worst.cause,
            force=worst.force,
            spring=worst.spring,
            rate=worst.rate,
            t=t,
            limit=worst.dt,
            growth=float(np.max(growth(scene, method, step, at=state))),
            cures=list_cures(scene, method, step, worst, state),
        )
    t, fastest, _ = max(found, key=lambda moment: abs(moment[1].rate))
    substeps = count_substeps(scene)
    if abs(fastest.rate) * step / substeps <= MAX_RESOLVED_RATE_STEP:
        return sound
    cures = list_resolution_cures(step, fastest, substeps)
    return sound._replace(
        cause="resolution", force=fastest.force, rate=fastest.rate, t=t, limit=fastest.dt, cures=cures
    )


def _demand(scene: Scene | None) -> Scene:
    if scene is None:
        raise TypeError(_INCOMPLETE_RUN)
    return scene


def _read_scene(run: Trajectory) -> Scene:
    """The scene that a run began with; a TypeError for a run without one."""
    return _demand(run.scene)


def _read_method(run: Trajectory) -> Callable:
    """The method of a run; a TypeError for a run without one."""
    if run.method is None:
        raise TypeError(_INCOMPLETE_RUN)
    return run.method


def _read_dt(run: Trajectory) -> Array | np.ndarray:
    """The steps of a run [s]; a TypeError for a run without any."""
    if run.dt is None:
        raise TypeError(_INCOMPLETE_RUN)
    return run.dt


def _starts_finite(scene: Scene, lane: int | tuple[int, ...] | None) -> bool:
    """Whether a scene, or one lane of it, starts with finite numbers."""
    finite = np.asarray(scene.finite(scene.state))
    index = () if lane is None else lane if isinstance(lane, tuple) else (lane,)
    known = len(index) <= finite.ndim and all(0 <= i < n for i, n in zip(index, finite.shape, strict=False))
    return not known or bool(finite[index].all())  # a bad index is reported where the lane is selected


def _run_single_lane(
    run: Trajectory | Scene, method: Callable | None, dt: ArrayLike | None, steps: int, lane: int | tuple[int, ...]
) -> Trajectory:
    """One lane of a run, run again by itself."""
    every, first_step = max(1, steps // INSPECTED_FRAMES), 0
    if isinstance(run, Trajectory):
        method, dt, steps, every, first_step = run.method, run.dt, run.steps, run.save_every, run.first_step
        run = _read_scene(run)
    if not isinstance(run, Scene) or method is None or dt is None:
        raise TypeError(_INCOMPLETE_RUN)
    step = np.asarray(dt)[lane] if np.ndim(dt) else dt
    scene = select_lane(run, lane)
    return simulate(scene, method, dt=step, steps=steps // every * every, save_every=every, first_step=first_step)


def _find_first_failure(run: Trajectory) -> tuple[int, tuple[int, ...]]:
    """The first bad step and the lane that moved fastest before it."""
    bad = np.asarray(run.first_bad_step)
    if not (bad >= 0).any():
        return -1, ()
    first = int(bad[bad >= 0].min())
    scene, dt = _read_scene(run), _read_dt(run)
    before = scene.state
    if first > int(run.first_step) + 1:
        flight = simulate(scene, _read_method(run), dt=dt, steps=first - int(run.first_step) - 1, record=_record_state)
        before = jax.tree.map(lambda leaf: leaf[-1], flight.recorded)
    speed = np.abs(np.asarray(view_centers(before, scene.mass).velocity, float)).max(axis=-1)
    return first, tuple(int(i) for i in np.unravel_index(np.argmax(speed), speed.shape))


def _fails_in_contact(run: Trajectory, first: int) -> bool:
    """Whether the first bad step is finite without the contacts; solids, which wait for no contact, never fail so."""
    scene, dt = _read_scene(run), _read_dt(run)
    if first < 0 or not scene.contacts or isinstance(scene.state, PlanarBodies):
        return False
    before = first - int(run.first_step) - 1
    if before:
        flight = simulate(
            scene, _read_method(run), dt=dt, steps=before, save_every=before, first_step=int(run.first_step)
        )
        scene = _demand(flight.final_scene)
    after = scene.replace(contacts=()).step(_read_method(run), (first - 1) * dt, dt)
    return bool(jnp.all(scene.finite(after.state)))


def _record_state(t: ArrayLike, state: State) -> State:
    return state


def _is_step_below_rounding(scene: Scene, dt: float) -> bool:
    """Whether a hundredth of the way gone in a step is lost in the last digit of a position."""
    x, v = (np.abs(np.asarray(leaf, float)) for leaf in view_centers(scene.state, scene.mass))
    spacing = float(jnp.finfo(scene.state.dtype).eps) * x
    moving = v > 0
    return bool(np.any(moving & (spacing > LOST_STEP_SHARE * v * dt)))


def _pick_moments(run: Trajectory, scene: Scene) -> Iterator[tuple[float, State]]:
    """The start, and some finite frames of a run up to ten thousand times its size: time [s] and state."""
    size = LARGEST_GROWN_SIZE * max(float(np.abs(np.asarray(scene.state.position)).max()), 1.0)
    for i in np.unique(np.linspace(0, len(run.time) - 1, INSPECTED_FRAMES).astype(int)):
        state = type(scene.state)(*(leaf[i] for leaf in run.state))
        if all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in state) and float(jnp.max(jnp.abs(state.position))) < size:
            yield float(np.min(np.asarray(run.time[i]))), state


def _check_error_measure(run: Trajectory, method: Adaptive, sound: Explanation) -> Explanation:
    """Whether an adaptive method that measures errors of velocities alone ends elsewhere than one that measures all."""
    if method.error != "velocity":
        return sound
    thorough = Adaptive(
        method.method, method.atol, method.atol, method.dt_min, method.dt_max, method.order, "state", None
    )
    flight = simulate(_read_scene(run), thorough, dt=_read_dt(run), steps=run.steps, save_every=run.steps)
    deviation = np.abs(np.asarray(flight.position[-1]) - np.asarray(_demand(run.final_scene).state.position))
    allowed = float(method.atol) * (1 + np.abs(np.asarray(flight.position[-1])))
    if np.all(deviation <= ERROR_TOLERANCE_RATIO * allowed):
        return sound
    return sound._replace(cause="error measure", cures=("adaptive(..., error='state')", "a method of higher order"))
