"""Why a run blew up, or went astray: the step it happened, what is responsible, and the two cheapest cures."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from physjax.checks import as_positive_integer, as_real_quantity
from physjax.particles import Particles, demand_particles
from physjax.scene import Scene
from physjax.select import select_lane
from physjax.stepping.adaptive import Adaptive
from physjax.stepping.implicit import ImplicitEuler
from physjax.stepping.methods import METHODS
from physjax.stepping.simulate import simulate
from physjax.study.stability.limits import Limit, growth, limit
from physjax.study.stability.linearisation import rate_text
from physjax.text import format_seconds
from physjax.trajectory import Trajectory

INSPECTED_FRAMES = 12
"""Moments of a run at which its rates are looked at."""
EVALUATIONS_PER_SOLVE = 20
"""Evaluations that a linear solve is worth, when methods are compared: conjugate gradients take some dozens of products."""
MAX_RESOLVED_RATE_STEP = 0.5
"""|λ| dt beyond which the fastest motion is stable at best, but not followed."""


class Explanation(NamedTuple):
    """What went wrong. Printed, it is a few sentences.

    `cause` is "stiffness", "damping", "resolution" (a motion too fast for dt, though bounded), "rounding" (positions so
    large that a step is lost in their last digits), "contact" (a surface that came over a lane waiting for its next
    touch), "error measure" (an adaptive method that looks at velocities alone), "input" (a traced number beyond its
    bounds) or "nothing". `first_bad_step` (-1: the run stayed finite) and `node` say where; `limit` [s] is the step that
    was too long, at time `t` [s]; `growth` a small deviation's growth in one step.

    Example:
        >>> told = stability.explain(swing, methods.verlet, dt=1.25)
        >>> isinstance(told, stability.Explanation), told.cause, round(told.growth, 3)
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
        ended = "The run stayed finite."
        if self.first_bad_step >= 0:
            node = f", node {', '.join(map(str, self.node))} first" if self.node else ""
            ended = f"Not finite after step {self.first_bad_step}{node}."
        where = "" if self.spring is None else f" (the spring between nodes {self.spring[0]} and {self.spring[1]})"
        why = {
            "rounding": "Positions are so large that a step is lost in their rounding.",
            "contact": "A surface came over a lane that had used up the eight touches of a step and waited for the next.",
            "error measure": "The error looks at velocities alone and cannot see that positions are wrong.",
            "input": "It starts non-finite: a traced number beyond its bounds, or a start on the wrong side of a contact.",
            "nothing": "Nothing was found wrong with the step.",
            "resolution": f"{self.force} moves things at |λ| = {abs(self.rate):.4g} 1/s at t = {self.t:.4g} s, too fast for dt.",
        }.get(self.cause) or (
            f"dt = {format_seconds(self.dt)} is beyond {format_seconds(self.limit) if self.limit else '0 (no step is stable)'}, "
            f"the limit set at t = {self.t:.4g} s by the {self.cause} of {self.force}{where}, λ = {rate_text(self.rate)} 1/s: "
            f"deviations grow {self.growth:.6g} times a step."
        )
        return " ".join([ended, why, *(f"Cure: {cure}." for cure in self.cures)])


def explain(
    run: Trajectory | Scene,
    method: Callable | None = None,
    dt: ArrayLike | None = None,
    *,
    steps: int = 1200,
    lane: int | tuple[int, ...] | None = None,
) -> Explanation:
    """Why a run blew up or went astray: where, the force and the eigenvalue responsible, the limit broken, two cures.

    Give a trajectory, or a scene with a method and a dt [s], which is then run for `steps`. Print the result. Of many lanes
    the first that failed is told, or the given `lane` alone (of coupled ones a scene), as if it were run by itself:
    `explain(flight, lane=int(jnp.argmin(flight.ok)))`.

    Example:
        >>> told = stability.explain(swing, methods.verlet, dt=1.25)
        >>> told.cause, round(told.limit, 3), round(told.growth, 3)
        ('stiffness', 1.0, 4.0)
    """
    if isinstance(run, Trajectory) and run.scene is not None and not _starts_finite(run.scene, lane):
        step, first = float(np.nanmin(np.asarray(run.dt))), int(run.first_step) + 1
        return Explanation("input", "", None, 0j, 0.0, step, float("inf"), 1.0, first, (), (_INPUT_CURE,))
    if lane is not None:
        return explain(_run_single_lane(run, method, dt, steps, lane))
    if isinstance(run, Scene):
        if method is None or dt is None:
            raise ValueError("explain: got a scene alone, expected its method and dt as well.")
        every = max(1, steps // INSPECTED_FRAMES)
        steps = as_positive_integer("steps", steps) // every * every
        run = simulate(run, method, dt=dt, steps=steps, save_every=every)
    if not isinstance(run, Trajectory) or run.scene is None or run.stepper is None or run.state is None:
        raise TypeError(
            "explain: expected a Trajectory that knows its scene and method, or a Scene with method and dt."
        )
    demand_particles("explain", run.scene.state, "what turns is not linearised")
    scene, method, step = run.scene, run.method, float(np.min(np.asarray(run.dt)))
    as_real_quantity("dt [s]", step, above=0.0)
    first, node = _find_first_failure(run)
    result = {"dt": step, "first_bad_step": first, "node": node}
    plain = Explanation("nothing", "", None, 0j, 0.0, step, float("inf"), 1.0, first, node, ())
    if isinstance(method, Adaptive):
        return _check_error_measure(run, method, plain)
    if _fails_in_contact(run, first):
        return plain._replace(cause="contact", cures=("a shorter dt, of no more than eight touches a step",))
    if _is_step_below_rounding(scene, step):
        return plain._replace(cause="rounding", cures=("compute in float64", "put the origin near the scene"))
    moments = list(_pick_moments(run, scene))
    found = [(t, limit(scene, method, at=state), state) for t, state in moments]
    broken = [moment for moment in found if step > moment[1].dt * (1 + 1e-9)]
    if broken:
        t, worst, state = broken[0]  # what follows may be its consequence
        grown = float(np.max(growth(scene, method, step, at=state)))
        return Explanation(
            worst.cause, worst.force, worst.spring, worst.rate, t, limit=worst.dt, growth=grown, **result,
            cures=_list_cures(scene, method, step, worst, state),
        )  # fmt: skip
    t, fastest, _ = max(found, key=lambda moment: abs(moment[1].rate))
    if abs(fastest.rate) * step > MAX_RESOLVED_RATE_STEP:
        finer = 0.1 / abs(fastest.rate)
        cures = (
            f"dt = {format_seconds(finer)}, {step / finer:.3g} times the cost",
            "methods.adaptive, short steps where it is fast",
        )
        return plain._replace(
            cause="resolution", force=fastest.force, rate=fastest.rate, t=t, limit=fastest.dt, cures=cures
        )
    return plain


_INPUT_CURE = (
    "build the scene with its numbers outside jit, vmap and sweep, where the error names the one that is wrong"
)


def _starts_finite(scene: Scene, lane: int | tuple[int, ...] | None) -> bool:
    """Whether a scene, or one lane of it, starts with finite numbers."""
    finite = np.asarray(scene.finite(scene.state))
    index = () if lane is None else lane if isinstance(lane, tuple) else (lane,)
    known = len(index) <= finite.ndim and all(0 <= i < n for i, n in zip(index, finite.shape, strict=False))
    return not known or bool(finite[index].all())  # an index that is none is told by what looks for the lane


def _run_single_lane(
    run: Trajectory | Scene, method: Callable | None, dt: ArrayLike | None, steps: int, lane: int | tuple[int, ...]
) -> Trajectory:
    """One lane of a run, run again by itself."""
    every, first_step = max(1, steps // INSPECTED_FRAMES), 0
    if isinstance(run, Trajectory):
        method, dt, steps, every, first_step = run.method, run.dt, run.steps, run.save_every, run.first_step
        run = run.scene
    if not isinstance(run, Scene) or method is None or dt is None:
        raise TypeError(
            "explain: expected a Trajectory that knows its scene and method, or a Scene with method and dt."
        )
    step = np.asarray(dt)[lane] if np.ndim(dt) else dt
    scene = select_lane(run, lane)
    return simulate(scene, method, dt=step, steps=steps // every * every, save_every=every, first_step=first_step)


def _find_first_failure(run: Trajectory) -> tuple[int, tuple[int, ...]]:
    """The first bad step and the lane that moved fastest before it."""
    bad = np.asarray(run.first_bad_step)
    if not (bad >= 0).any():
        return -1, ()
    first = int(bad[bad >= 0].min())
    before = run.scene.state
    if first > int(run.first_step) + 1:
        flight = simulate(run.scene, run.method, dt=run.dt, steps=first - int(run.first_step) - 1, record=_record_state)
        before = Particles(*(leaf[-1] for leaf in flight.recorded))
    speed = np.abs(np.asarray(before.velocity, float)).max(axis=-1)
    return first, tuple(int(i) for i in np.unravel_index(np.argmax(speed), speed.shape))


def _fails_in_contact(run: Trajectory, first: int) -> bool:
    """Whether the step that was the first bad one is finite if nothing is in the way."""
    if first < 0 or not run.scene.contacts:
        return False
    before, scene = first - int(run.first_step) - 1, run.scene
    if before:
        flight = simulate(scene, run.method, dt=run.dt, steps=before, save_every=before, first_step=int(run.first_step))
        scene = flight.final_scene
    after = scene.replace(contacts=()).step(run.method, (first - 1) * run.dt, run.dt)
    return bool(jnp.all(scene.finite(after.state)))


def _record_state(t: Any, state: Particles) -> Particles:
    return state


def _is_step_below_rounding(scene: Scene, dt: float) -> bool:
    """Whether a hundredth of a step is lost in the last digit of a position."""
    x, v = (np.abs(np.asarray(leaf, float)) for leaf in scene.state)
    spacing = float(jnp.finfo(scene.state.dtype).eps) * x
    moving = v > 0
    return bool(np.any(moving & (spacing > 0.01 * v * dt)))


def _pick_moments(run: Trajectory, scene: Scene) -> Any:
    """Start, and some finite frames of a run that went no further than ten thousand times its size."""
    size = 1e4 * max(float(np.abs(np.asarray(scene.state.position)).max()), 1.0)
    for i in np.unique(np.linspace(0, len(run.time) - 1, INSPECTED_FRAMES).astype(int)):
        state = Particles(*(leaf[i] for leaf in run.state))
        if all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in state) and float(jnp.max(jnp.abs(state.position))) < size:
            yield float(np.min(np.asarray(run.time[i]))), state


def _list_cures(scene: Scene, method: Any, dt: float, worst: Limit, state: Particles) -> tuple[str, ...]:
    """A shorter step of the same method, and the method that needs the fewest evaluations."""
    cures = []
    promised = getattr(method, "promises", None)
    if worst.dt > 0:
        cures.append(f"dt = {format_seconds(0.9 * worst.dt)}, {dt / (0.9 * worst.dt):.3g} times the cost")
    others = []
    for name, other in METHODS.items():
        longest = min(0.9 * limit(scene, other, at=state).dt, dt) if other is not method else 0.0
        if longest > 0:
            solves = isinstance(other, ImplicitEuler)
            others.append(
                ((EVALUATIONS_PER_SOLVE if solves else other.promises.evaluations) / longest, longest, name, solves)
            )
    for cost, longest, name, solves in sorted(others)[: 2 - len(cures)]:
        times = f", {cost * dt / promised.evaluations:.3g} times the cost" if promised else ""
        cures.append(f"{name} with dt = {format_seconds(longest)}{', a linear solve a step' if solves else times}")
    return tuple(cures)


def _check_error_measure(run: Trajectory, method: Adaptive, plain: Explanation) -> Explanation:
    """Whether an adaptive method that looks at velocities alone ends elsewhere than one that looks at all."""
    if method.error != "velocity":
        return plain
    sound = Adaptive(method.method, method.atol, method.atol, method.dt_min, method.dt_max, method.order, "state", None)
    flight = simulate(run.scene, sound, dt=run.dt, steps=run.steps, save_every=run.steps)
    apart = np.abs(np.asarray(flight.position[-1]) - np.asarray(run.final_scene.state.position))
    allowed = float(method.atol) * (1 + np.abs(np.asarray(flight.position[-1])))
    if np.all(apart <= 10 * allowed):
        return plain
    return plain._replace(cause="error measure", cures=("adaptive(..., error='state')", "a method of higher order"))
