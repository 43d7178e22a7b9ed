"""Steps that choose their own length: `adaptive(method, ...)` subdivides the dt it is given."""

from collections.abc import Callable
from functools import partial, reduce
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, PyTree

from physjax.checks import as_positive_integer, as_real_quantity, concrete_or_none
from physjax.loops import Time, moment_at
from physjax.particles import demand_particles
from physjax.parts import Force, as_module
from physjax.scene import Scene, project
from physjax.stepping.doubling import Doubling
from physjax.stepping.pairs import Attempt, Pair, read_pair
from physjax.stepping.registry import read_promises
from physjax.stepping.step_control import (
    SHORTEST_STEP_SHARE,
    StepRecord,
    Tolerance,
    choose_factor,
    choose_factor_of_lecture,
    choose_first_step,
    find_jumps,
    max_over_shared_step,
    scaled_norm,
)
from physjax.stepping.system import S, System, leaf_dtype, read_traits
from physjax.stepping.walk import Course, Walk, begin_walk, walk_on, walk_through
from physjax.tracebacks import Module, shorten_tracebacks
from physjax.vectors import add_trailing_axes, norm

MAX_FRAMES_PER_STEP = 64
"""The longest step where none is given, relative to dt: a path without any error would be left in one."""
LATE_STAGES = ("resolve contacts", "close joints", "advance memory")
"""What is done at the end of a step, whenever in it it was due."""
WHOLE_AND_HALVES = ((0.0, 1.0), (0.0, 0.5), (0.5, 0.5))
"""Start and length of the three steps of an attempt, relative to it."""


class Steps(NamedTuple):
    """What one subdivided dt took: steps accepted and rejected, the shortest accepted [s], and whether it reached the end.

    Shaped like the scene's status: for each lane where lanes are independent, for each scene where they are coupled.
    """

    state: PyTree
    accepted: Int[Array, "..."]
    rejected: Int[Array, "..."]
    shortest: Float[Array, "..."]
    ok: Bool[Array, "..."]


class Adaptive(Module):
    """A method under error control, made by `adaptive`; `report` also returns the steps it took.

    Steps end where a force of the system jumps, and each sees the mean over itself of what jumps within it: the system is
    asked for that mean before every step.
    """

    method: Callable
    atol: Float[Array, ""]
    rtol: Float[Array, ""]
    dt_min: Float[Array, ""] | None
    dt_max: Float[Array, ""] | None
    order: int = eqx.field(static=True)
    error: str = eqx.field(static=True)
    tries: int | None = eqx.field(static=True)

    def find_pair(self, system: System) -> Pair:
        """What knows the error of a step: the method's own pair, or the method taken twice.

        Where contacts act after each step or memories advance, no pair knows what they do to the error.
        """
        alone = not isinstance(system, Scene) or system.only_moves or system.emitter is not None
        found = read_pair(self.method) if alone and self.error != "velocity" else None
        forces = [force for force in read_traits(system).forces if isinstance(force, Force) and force.jumps]
        # to a pair, the mean of a force over a step is a constant: what it jumps by it cannot see
        unseen = any(not force.discontinuities() for force in forces)
        return Doubling(self.method, self.order) if found is None or unseen else found

    def __call__(self, system: System, t: Time, state: S, dt: ArrayLike) -> S:
        """The state a dt later; NaN where steps became shorter than `dt_min`, or more than `tries` were needed."""
        return self.report(system, t, state, dt).state

    def _demand_steps_of_one_length(self, scene: Scene) -> None:
        """Raise a ValueError where what acts at the ends of steps is that of an emitter's particles."""
        late = [type(c).__name__ for c in scene.contacts if (c.response or project) is project]
        late += [type(f).__name__ for f in scene.forces if f.remembers]
        if late and scene.emitter is not None:
            raise ValueError(
                f"adaptive: got {late[0]}, which acts at the ends of steps, and an emitter, whose particles each have steps of "
                "their own; expected contacts timed by contacts.impact, and forces without memory. Use equal steps, such "
                "as methods.rk4 with a small dt."
            )

    def report(self, system: System, t: Time, state: PyTree, dt: Time) -> Steps:
        """The state a dt later, with the counts of accepted and rejected steps, the last of which ends there."""
        if isinstance(system, Scene):
            self._demand_steps_of_one_length(system)
        dt = jnp.broadcast_to(jnp.asarray(dt, leaf_dtype(state)), read_traits(system).status_shape)
        first, slope = self._choose_first_step(system, t, state, dt)
        course = self._plan(system, lambda frame: t, dt, lands=True)
        walk = walk_on(course, begin_walk(course, state, slope, first), dt)
        return self._report(walk, walk.attempt.end, dt)

    def start(self, system: System, t: Time, state: PyTree, dt: ArrayLike) -> Walk:
        """A walk before its first step, whose steps go on from one dt to the next."""
        dt = jnp.broadcast_to(jnp.asarray(dt, leaf_dtype(state)), read_traits(system).status_shape)
        first, slope = self._choose_first_step(system, t, state, dt)
        return begin_walk(self._plan(system, lambda frame: t, dt, lands=self._lands(system)), state, slope, first)

    def advance(self, system: System, t: Time, state: S, dt: ArrayLike, memory: Walk) -> tuple[S, Walk]:
        """The state a dt later, read off the step that reaches there, and the walk."""
        steps, walk = self.report_walk(system, t, dt, memory)
        return steps.state, walk

    def sample(
        self, system: System, clock: Callable[[Array], Time], dt: ArrayLike, frames: int, memory: Walk
    ) -> tuple[PyTree, Walk]:
        """The states at the ends of `frames` dt, the n-th of which begins at `clock(n)`, and the walk."""
        progress = memory.progress
        dt = jnp.broadcast_to(jnp.asarray(dt, progress.elapsed.dtype), progress.elapsed.shape)
        course = self._plan(system, clock, dt, lands=self._lands(system))
        states, walk = walk_through(course, memory, dt, frames, lambda walk: self._read(system, course, walk, dt))
        legal = self._is_legal(dt)
        return jax.tree.map(
            lambda leaf: jnp.where(add_trailing_axes(legal, leaf.ndim - 1), leaf, jnp.nan), states
        ), walk

    def report_walk(self, system: System, t: Time, dt: ArrayLike, walk: Walk) -> tuple[Steps, Walk]:
        """`advance`, with the counts of steps."""
        progress = walk.progress
        dt = jnp.broadcast_to(jnp.asarray(dt, progress.elapsed.dtype), progress.elapsed.shape)
        course = self._plan(system, lambda frame: t, dt, lands=self._lands(system))
        walk = walk_on(course, walk, dt)
        state = self._read(system, course, walk, dt)
        return self._report(walk, state, dt), walk._replace(progress=walk.progress.begin_next(dt))

    def _read(self, system: System, course: Course, walk: Walk, dt: Array) -> PyTree:
        """The state at the end of dt, within the step that reaches there."""
        progress = walk.progress
        if self._lands(system):
            return course.normalise(walk.attempt.end)
        share = jnp.clip((dt - progress.elapsed) / progress.length, 0.0, 1.0)
        begun, length = course.clock(progress.frame) + progress.elapsed, progress.length
        state = self.find_pair(system).interpolate(system, begun, walk.start, length, walk.attempt, share)
        return course.normalise(state)

    def step_scene(self, scene: Scene, t: Time, dt: ArrayLike) -> Scene:
        """The scene a dt later, in steps after each of which contacts act and forces remember, as after those of any method.

        The error of such a step is what two of half the length change. What is done at its end came late by up to all of
        it: that much of the change of the rates which it made counts as well.
        """
        return self.walk_scene(scene, t, dt)[0]

    def walk_scene(self, scene: Scene, t: Time, dt: ArrayLike) -> tuple[Scene, Steps]:
        """`step_scene`, with the counts of steps."""
        dt = jnp.broadcast_to(jnp.asarray(dt, scene.state.dtype), scene.status_shape)
        changing = scene.changing()
        moving, still = eqx.partition(scene, changing)
        join = lambda moving: eqx.combine(moving, still)  # noqa: E731

        def attempt(t: Time, start: PyTree, length: Array, slope: PyTree) -> Attempt:
            def part(middle: PyTree, share: Array) -> tuple[PyTree, PyTree]:
                begun = jax.tree.map(lambda a, b: jnp.where(share[0] > 0, a, b), middle, start)
                end, late = _step_with_lateness(join(begun), self.method, t + share[0] * length, share[1] * length)
                end = eqx.filter(end, changing)
                return end, (end, late)

            _, (ends, late) = lax.scan(part, start, jnp.asarray(WHOLE_AND_HALVES, dt.dtype))
            whole, end = (jax.tree.map(lambda leaf, i=i: leaf[i], ends) for i in (0, 2))
            error = jax.tree.map(
                lambda a, b, c: jnp.maximum(jnp.abs(a - b), jnp.max(c[1:], axis=0)), whole.state, end.state, late
            )
            return Attempt(end, error, None, ())

        first, _ = self._choose_first_step(scene, t, scene.state, dt)
        course = self._plan(scene, lambda frame: t, dt, lands=True)
        rounding = 16 * float(jnp.finfo(dt.dtype).eps) * dt
        course = course._replace(
            attempt=attempt,
            measure=lambda start, tried: self._measure_error(
                start.state, tried._replace(end=tried.end.state), dt.shape
            ),
            normalise=lambda moving: moving,
            # what comes late is cured by short steps alone
            floor=course.floor if self.dt_min is not None else rounding,
        )
        walk = walk_on(course, begin_walk(course, moving, None, first), dt)
        after = join(walk.attempt.end)
        steps = self._report(walk, after.state, dt)
        return after.replace(state=steps.state), steps

    def _lands(self, system: System) -> bool:
        """Whether steps end with dt: where the path within them is not as right as they are, or nobody knows how right."""
        pair = self.find_pair(system)
        return pair.dense_order < pair.error_order or self.error == "velocity"

    @property
    def _tolerance(self) -> Tolerance:
        return Tolerance(self.atol, self.rtol)

    def _choose_first_step(self, system: System, t: Time, state: S, dt: Array) -> tuple[Array, S | None]:
        """The length of the first step [s], and the slope at its start where steps begin with the last one of the one before."""
        pair = self.find_pair(system)
        first, slope = choose_first_step(system, t, state, dt, self._tolerance, pair.error_order)
        # at a jump the slope is another one after it than before
        jumps = any(isinstance(force, Force) and force.jumps for force in read_traits(system).forces)
        return first, slope if pair.keeps_slope and not jumps else None

    def _plan(self, system: System, clock: Callable[[Array], Time], dt: Array, *, lands: bool) -> Course:
        """How the steps of one dt are taken: the last of them `lands` on its end, or goes on beyond it."""
        kind, shape, pair = dt.dtype, dt.shape, self.find_pair(system)
        longest = dt if lands else MAX_FRAMES_PER_STEP * dt
        floor = SHORTEST_STEP_SHARE * dt if self.dt_min is None else jnp.minimum(self.dt_min.astype(kind), dt)

        return Course(
            clock=clock,
            attempt=partial(pair.attempt, system),
            measure=partial(self._measure_error, shape=shape),
            normalise=read_traits(system).normalised or (lambda state: state),
            choose_factor=partial(self._choose_factor, order=pair.error_order),
            find_jumps=lambda t: find_jumps(system, t, shape),
            end=dt if lands else jnp.full_like(dt, jnp.inf),
            # a step below rounding would leave the time where it is
            floor=jnp.maximum(floor, 16 * float(jnp.finfo(kind).eps) * dt),
            ceiling=longest if self.dt_max is None else jnp.minimum(self.dt_max.astype(kind), longest),
            tries=self.tries,
        )

    def _choose_factor(self, step: StepRecord, before: StepRecord, good: Array, order: int) -> Array:
        if self.error == "velocity":
            return choose_factor_of_lecture(step.error)
        return choose_factor(step, before, good, order)

    def _measure_error(self, start: PyTree, tried: Attempt, shape: tuple[int, ...]) -> Array:
        """The largest error in units of the tolerance; or, as in the lecture, |v₁ - v₂| alone over atol."""
        if self.error == "velocity":
            demand_particles("error='velocity'", tried.end, "bodies have momenta. Leave it out")
            worst = norm(tried.error.velocity)
            return max_over_shared_step(worst, shape) / self.atol.astype(worst.dtype)
        return scaled_norm(tried.error, self._tolerance.at(start, tried.end), shape)

    def _is_legal(self, dt: Array) -> Array:
        """Where a dt and tolerances that are traced, and so cannot raise, are > 0: others have no end and no error."""
        bounds = (dt, *(b for b in (self.atol, self.rtol, self.dt_min, self.dt_max) if b is not None))
        legal = [jnp.all(b > 0) if b.ndim == 0 else b > 0 for b in bounds if isinstance(b, Tracer)]
        return reduce(jnp.logical_and, legal, jnp.ones(dt.shape, bool))

    def _report(self, walk: Walk, state: PyTree, dt: Array) -> Steps:
        """The state, NaN where it was not reached, with the counts of steps."""
        progress = walk.progress
        ok = ~progress.failed & progress.has_arrived(dt) & self._is_legal(dt)
        # a product, not `where`: the derivatives of a failed lane must be NaN as well, and `where` would make them zero
        state = jax.tree.map(
            lambda leaf: leaf * add_trailing_axes(jnp.where(ok, 1.0, jnp.nan).astype(leaf.dtype), leaf.ndim), state
        )
        return Steps(state, progress.taken, progress.rejected, progress.shortest, ok)


def _step_with_lateness(scene: Scene, method: Callable, t: Time, dt: Array) -> tuple[Scene, PyTree]:
    """A step of the scene, and by how much the state may be wrong since contacts and memories act at the step's end."""
    late = jax.tree.map(jnp.zeros_like, scene.state)
    for stage in scene.stages(method, t, dt):
        before, scene = scene, stage.run(scene)
        if stage.name in LATE_STAGES:
            rates = (at.rate(t + dt, at.state) for at in (before, scene))
            late = jax.tree.map(lambda late, a, b: late + add_trailing_axes(dt, a.ndim) * jnp.abs(a - b), late, *rates)
    return scene, late


@shorten_tracebacks
def adaptive(
    method: Callable,
    atol: ArrayLike = 1e-6,
    rtol: ArrayLike = 1e-6,
    *,
    dt_min: ArrayLike | None = None,
    dt_max: ArrayLike | None = None,
    order: int | None = None,
    error: str = "state",
    tries: int | None = None,
) -> Adaptive:
    """A method that subdivides its own dt so that no step's error exceeds the tolerance.

    The error of a step is known where the method is a pair (`tsit5`, `dopri8`, `dprkn6`, `tr_bdf2`): it costs nothing.
    Any other method takes each step whole and in two halves, and the difference is the error, for three times the
    evaluations. E = max |error| / (atol + rtol |y|) over position and velocity; E <= 1 keeps the step, otherwise it is
    redone, and the next is 0.77 E^(-1/(p+1)) times as long, p the order of the error, at most 5 times, and less where
    the error has been growing. Every independent lane has steps of its own, which go on from one dt to the next: in
    between states are read off the path within a step, so that dt costs nothing, and may be as short as a film needs.

    Steps end where a force jumps (`Kick`, `Control`, `Blast`); a force of your own that jumps and gives neither
    `averaged_over_step` nor `discontinuities` (see `Force`) can be stepped over. Where there are contacts, prescribed motion,
    or forces that remember, these act after every step, steps are doubled, and the last of them ends with dt. What is
    resolved at the end of a step (`contacts.project`, springs that break) makes it as short as its lateness demands: timed
    contacts are far cheaper.

    `error="velocity"` is the lecture's E = |v₁ - v₂| / atol, the next step 0.9 E^(-1/2) times as long. It cannot see
    position: under gravity alone it is 0, and a throw of 2 s by Euler ends metres off. A step rejected at `dt_min` [s]
    (a millionth of dt, if not given) ends that lane as NaN: see `.ok` and `.first_bad_step` of a run. `tries` bounds
    the steps between two frames; where more are needed, the state is NaN. Derivatives, forward and reverse, are those of the
    steps taken, up to 16 384 of them between two frames, beyond which they are NaN. Symplectic methods (semi-implicit
    Euler, verlet, leapfrog) lose their bounded energy: with steps that depend on the state it drifts.

    Example:
        >>> careful = methods.adaptive(methods.rk4, atol=1e-5, rtol=1e-5)
        >>> end = simulate(swing, careful, dt=1.0, steps=1).position[-1, 0]
        >>> round(float(end), 3), round(float(np.cos(2.0 * 1.0)), 3)
        (-0.416, -0.416)
    """
    if not callable(method):
        raise TypeError(f"adaptive: got the method {method!r}, expected one such as methods.rk4.")
    module = as_module(method)
    if error not in ("state", "velocity"):
        raise ValueError(f"error: got {error!r}, expected 'state' or 'velocity' (the lecture's).")
    if order is None:
        promises = read_promises(method)
        if promises is None:
            raise ValueError("adaptive: the method promises no order. Give order=.")
        order = promises.order
    atol, rtol = as_real_quantity("atol", atol, above=0.0), as_real_quantity("rtol", rtol, above=0.0)
    dt_min, dt_max = (
        None if h is None else as_real_quantity(name, h, above=0.0)
        for name, h in (("dt_min", dt_min), ("dt_max", dt_max))
    )
    known = [concrete_or_none(h) for h in (dt_min, dt_max) if h is not None]
    shortest, longest = known if len(known) == 2 else (None, None)
    if shortest is not None and longest is not None and shortest > longest:
        raise ValueError(f"dt_min: got {shortest:g} s, which is more than dt_max {longest:g} s. Exchange them.")
    return Adaptive(
        module,
        atol,
        rtol,
        dt_min,
        dt_max,
        as_positive_integer("order", order),
        error,
        None if tries is None else as_positive_integer("tries", tries),
    )


def count_steps(scene: Scene, method: Adaptive, *, dt: ArrayLike, steps: int) -> Steps:
    """Accepted and rejected steps of a run, dt by dt along a leading axis, the states at its ends with them.

    Example:
        >>> counts = methods.count_steps(swing, methods.adaptive(methods.rk4, atol=1e-5, rtol=1e-5), dt=1.0, steps=1)
        >>> bool(counts.accepted[0] > 1)
        True
    """
    if not isinstance(method, Adaptive):
        raise TypeError(f"count_steps: got {type(method).__name__}, expected methods.adaptive(...).")
    return _count_steps(scene, method, as_real_quantity("dt [s]", dt, above=0.0), as_positive_integer("steps", steps))


@eqx.filter_jit
def _count_steps(scene: Scene, method: Adaptive, dt: Array, steps: int) -> Steps:
    dt = dt.astype(scene.state.dtype)
    arrays, still = eqx.partition(scene, eqx.is_array)
    walk = (
        method.start(scene, moment_at(jnp.zeros((), jnp.int32), dt, dt.dtype), scene.state, dt)
        if scene.only_moves
        else None
    )

    def one(carried: tuple[Scene, Walk | None], i: Array) -> tuple[tuple[Scene, Walk | None], Steps]:
        arrays, walk = carried
        scene = eqx.combine(arrays, still)
        t = moment_at(i, dt, scene.state.dtype)
        if walk is not None:
            steps, walk = method.report_walk(scene, t, dt, walk)
            after = scene.replace(state=steps.state)
        elif scene.emitter is not None:
            steps = method.report(scene, t, scene.state, dt)
            after = scene.step(method, t, dt)
        else:
            after, steps = method.walk_scene(scene, t, dt)
        return (eqx.filter(after, eqx.is_array), walk), steps._replace(state=after.state)

    return lax.scan(one, (arrays, walk), jnp.arange(steps, dtype=jnp.int32))[1]


__all__ = ["Adaptive", "Steps", "adaptive", "count_steps"]
