"""Where a run first crosses a surface: bracketed by its frames, then by its steps, to the accuracy of its method.

Between two frames the run is stepped again from the first of them, so the result does not depend on how many were saved. The
moment within the step is a root along the method's own path; it moves with every number that the run depends on.
"""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, PyTree

from physjax.backend import any_lane
from physjax.checks import Numbers, as_positive_integer, quantity
from physjax.closures import warn_of_recompilation
from physjax.compiling import announce_compiling
from physjax.cubics import Cubic
from physjax.loops import Moment, Time, moment_at, repeat_steps, to_float_time
from physjax.particles import Particles, view_centers
from physjax.parts import as_module
from physjax.roots import find_first_root
from physjax.summaries import Row, format_array, write_summary, write_table
from physjax.vectors import add_trailing_axes, norm

NODES_PER_BATCH = 64
"""Nodes of a coupled scene whose crossings are searched at once, each with a copy of the scene: a bound on memory."""


class Crossing(NamedTuple):
    """Time [s], position [m] and velocity [m/s] of a crossing of each lane; where it has none, `ok` False and NaN."""

    time: Float[Array, "*lanes"]
    position: Float[Array, "*lanes dim"]
    velocity: Float[Array, "*lanes dim"]
    ok: Bool[Array, "*lanes"]

    def __repr__(self) -> str:
        """When, where and how fast."""
        return write_summary("Crossing", describe_crossing(self))

    def _repr_html_(self) -> str:
        return write_table("Crossing", describe_crossing(self))


class BodyCrossing(NamedTuple):
    """What `Crossing` says of each rigid body, by its center of mass, and its `state`; where it has none, `ok` False and NaN.

    Of a number that is one for a whole scene of coupled bodies, one time for each scene, and all its bodies then.
    """

    time: Float[Array, "*scenes"]
    position: Float[Array, "*lanes dim"]
    velocity: Float[Array, "*lanes dim"]
    ok: Bool[Array, "*scenes"]
    state: Any

    def __repr__(self) -> str:
        """When, where and how fast."""
        return write_summary("BodyCrossing", describe_crossing(self))


def describe_crossing(found: Crossing | BodyCrossing) -> list[Row]:
    """What a summary says of a crossing."""
    rows = [("time", format_array(found.time, "s")), ("position", format_array(found.position, "m"))]
    return [*rows, ("velocity", format_array(found.velocity, "m/s")), ("ok", format_array(found.ok))]


class Height(eqx.Module):
    """All places at one height [m] along the axis `up`, a number or one per lane; in one dimension the coordinate itself."""

    height: Numbers = quantity("height", "m")
    up: int = eqx.field(static=True, default=1)

    def signed_distance(self, t: Time, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes"]:
        """Height above it [m]."""
        return position[..., self.up] - self.height.astype(position.dtype)


@runtime_checkable
class Distanced(Protocol):
    """A surface that knows the signed distance to it: a contact shape, a height, or one of the user's own."""

    def signed_distance(self, t: Time, position: Array) -> Array:
        """Signed distance of each lane [m]."""
        ...


@jax.transfer_guard("allow")  # what a call is given goes to the device on purpose
@announce_compiling("the crossing")
def find_crossing(
    run: PyTree, surface: PyTree, direction: int | None, nth: int | Sequence[int]
) -> Crossing | BodyCrossing:
    """See `Trajectory.crossing`; `run` is a trajectory that knows its scene and its method."""
    if direction not in (None, 1, -1):
        raise ValueError(
            f"direction: got {direction!r}, expected +1 (from negative to positive: upward), -1 (downward) or None."
        )
    if not isinstance(surface, Distanced):
        warn_of_recompilation("crossing", [surface])
        surface = as_module(surface) if callable(surface) else Height(surface, run.scene.up)
    many = not isinstance(nth, int)
    numbers = [as_positive_integer("nth", number) for number in (nth if many else [nth])]
    if not numbers:
        raise ValueError("nth: got no number, expected which crossings are wanted, such as 2 or range(1, 4).")
    wanted = jnp.asarray(numbers if many else numbers[0], jnp.int32)
    found = _find_crossings(run, surface, jnp.asarray(direction or 0, jnp.int32), wanted)
    return Crossing(*found[:-1]) if isinstance(found.state, Particles) else found


@eqx.filter_jit
def _find_crossings(run: PyTree, surface: PyTree, way: Array, nth: Array) -> BodyCrossing:
    find = lambda run, nth: _find_run_crossings(run, surface, _Wanted(way, nth))  # noqa: E731
    for _ in range(run.first_step.ndim):  # runs that came out of vmap
        find = jax.vmap(find, in_axes=(0, None))
    return lax.map(lambda number: find(run, number), nth) if nth.ndim else find(run, nth)


class _Wanted(NamedTuple):
    """Which crossing is wanted: in which direction (0: in either), and which of these, from 1."""

    way: Array
    nth: Array


def _find_run_crossings(run: PyTree, surface: PyTree, wanted: _Wanted) -> BodyCrossing:
    scene, measure = run.scene, _build_measure(surface, run.scene)
    scenes = len(scene.status_shape)
    # one ball is tied to nobody, whatever its forces say; a measure of a whole scene is one for all of its bodies
    if jax.eval_shape(measure, jnp.zeros(scene.status_shape, scene.state.dtype), scene.state).ndim == scenes:
        return _find_unit_crossings(run, measure, wanted, lambda leaf: leaf)

    def of_node(n):
        at_node = lambda leaf: jnp.take(leaf, n, axis=scenes)  # noqa: E731
        return _find_unit_crossings(run, lambda t, state: measure(t, state)[..., n], wanted, at_node)

    # a node's moment is its own, and the whole scene is stepped to it
    count = scene.state.lanes[-1]
    nodes = jnp.arange(count, dtype=jnp.int32)
    few = count <= NODES_PER_BATCH
    found = jax.vmap(of_node)(nodes) if few else lax.map(jax.checkpoint(of_node), nodes, batch_size=NODES_PER_BATCH)
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, scenes), found)


class _CrossingStep(NamedTuple):
    """The step in which a crossing was found, counted from a frame, and the signed distances at both its ends.

    `passed` counts the crossings up to it.
    """

    frame: Array
    step: Array
    before: Array
    after: Array
    found: Array
    passed: Array


class _Replay(NamedTuple):
    """A run to be stepped again: what changes in it at every frame, with its step, its measure and its rates as functions.

    `measure(t, state)` is what crosses zero, of particles their signed distance. Every number has the shape of what is
    stepped on its own: a lane, or a scene of coupled ones.
    """

    frames: PyTree
    step: Callable
    measure: Callable
    rate: Callable
    first_step: Array
    steps_per_frame: int
    dt: Array

    def stop_gradients(self) -> "_Replay":
        """The replay without derivatives."""
        moving = self.take_frame(jnp.zeros(self.dt.shape, jnp.int32))
        step = _stop_closure_gradients(self.step, moving, self.moment(jnp.zeros(self.dt.shape, jnp.int32), 0), self.dt)
        return _Replay(
            lax.stop_gradient(self.frames),
            step,
            _stop_closure_gradients(self.measure, self.dt, moving.state),
            _stop_closure_gradients(self.rate, self.dt, moving),
            self.first_step,
            self.steps_per_frame,
            lax.stop_gradient(self.dt),
        )

    def moment(self, frame: Array, i: ArrayLike) -> Moment:
        """The moment at which step i after a frame begins."""
        return moment_at(self.first_step + frame * self.steps_per_frame + i, self.dt, self.dt.dtype)

    def take_frame(self, frame: Array) -> PyTree:
        """What changes, for each lane at a frame of its own."""
        return jax.tree.map(lambda leaf: _take_frames(leaf, frame), self.frames)

    def measure_distance(self, t: Array, moving: PyTree) -> Array:
        """What crosses zero, zero within rounding: a lane that starts on the surface does not cross it at once."""
        value, state = self.measure(t, moving.state), moving.state
        size = _measure_size(state, value.ndim)
        return jnp.where(jnp.abs(value) <= 8 * float(jnp.finfo(state.dtype).eps) * size, 0.0, value)


def _measure_size(state: PyTree, axes: int) -> Array:
    """How large the numbers are that a measure is computed from, with so many axes: of particles positions [m]."""
    if isinstance(state, Particles):
        return norm(state.position) if state.position.ndim == axes + 1 else jnp.max(norm(state.position), axis=-1)
    largest = [jnp.max(jnp.abs(leaf), axis=tuple(range(axes, leaf.ndim))) for leaf in jax.tree.leaves(state)]
    return jnp.max(jnp.stack(largest), axis=0)


def _find_unit_crossings(run: PyTree, measure: Callable, wanted: _Wanted, own: Callable) -> BodyCrossing:
    """The wanted crossing of every lane or, in a coupled scene, of the node in every scene that `own` picks."""
    replay = _build_replay(run, measure)
    place = _find_crossing_step(replay.stop_gradients(), wanted)
    moving = replay.take_frame(place.frame)

    def forward(i, moving):
        after = replay.step(moving, replay.moment(place.frame, i), replay.dt)
        return jax.tree.map(lambda a, b: jnp.where(add_trailing_axes(i < place.step, a.ndim), a, b), after, moving)

    if replay.steps_per_frame > 1:
        moving = repeat_steps(forward, moving, jnp.zeros((), jnp.int32), replay.steps_per_frame - 1)
    begun = replay.moment(place.frame, place.step)
    side = jnp.where(place.before < 0, -1.0, 1.0).astype(replay.dt.dtype)

    def left(duration):
        return side * replay.measure(to_float_time(begun + duration), replay.step(moving, begun, duration).state)

    numbers, left = _hoist_closure(left, replay.dt)  # the root moves with all that the path depends on
    tolerance = 4 * float(jnp.finfo(replay.dt.dtype).eps) * replay.dt
    values = (side * place.before, side * place.after)
    search = ((jnp.zeros_like(replay.dt), replay.dt), values, place.found, tolerance)
    duration = find_first_root(lambda x, numbers: left(numbers, x), (numbers,), lax.stop_gradient(search))  # pyright: ignore[reportCallIssue]  # a custom derivative hides its signature
    reached = replay.step(moving, begun, duration).state
    seen = view_centers(reached, run.scene.mass)
    reported = lambda leaf: jnp.where(add_trailing_axes(place.found, leaf.ndim), leaf, jnp.nan)  # noqa: E731
    x, v, state = jax.tree.map(lambda leaf: reported(own(leaf)), (seen.position, seen.velocity, reached))
    return BodyCrossing(reported(to_float_time(begun + duration)), x, v, place.found, state)


def _build_replay(run: PyTree, measure: Callable) -> _Replay:
    """The run as a replay: what changes at its frames, and how it is stepped."""
    scene, film, shape = run.scene, run.film, run.scene.status_shape
    changes = scene.changing()
    frames, (first, still) = eqx.filter(film, changes), eqx.partition(scene, changes)
    _demand_unshared_memory(first, shape)
    dt = jnp.broadcast_to(run.dt, shape)

    def step(moving, t, dt):
        return eqx.filter(eqx.combine(moving, still).step(run.stepper, t, dt), changes)

    def rate(t, moving):
        if isinstance(moving.state, Particles):
            return Particles(moving.state.velocity, jnp.zeros_like(moving.state.velocity))
        return eqx.combine(moving, still).rate(t, moving.state)

    return _Replay(frames, step, measure, rate, run.first_step, run.save_every, dt)


def _find_crossing_step(replay: _Replay, wanted: _Wanted) -> _CrossingStep:
    """Frame and step of the wanted crossing, by stepping again between the frames that may bracket one."""
    shape, zero = replay.dt.shape, jnp.zeros(replay.dt.shape, jnp.int32)
    candidates = _find_candidate_intervals(replay, wanted.way)
    numbers = jnp.arange(len(candidates), dtype=jnp.int32).reshape(-1, *(1 for _ in shape))
    ahead = lambda cursor: candidates & (numbers >= cursor[None])  # noqa: E731

    def going(carry):
        cursor, place = carry
        return any_lane(jnp.any(ahead(cursor), axis=0) & ~place.found)

    def look(carry):
        cursor, place = carry
        frame = jnp.argmax(ahead(cursor), axis=0).astype(jnp.int32)
        seen = _search_interval(replay, frame, place.passed, wanted)
        more = jnp.any(ahead(cursor), axis=0)
        new = more & ~place.found
        # a lane that has searched all of its own waits for the others
        return jnp.where(more, frame + 1, cursor), jax.tree.map(lambda a, b: jnp.where(new, a, b), seen, place)

    nothing = jnp.zeros(shape, replay.dt.dtype)
    place = _CrossingStep(zero, zero, nothing + 1.0, nothing - 1.0, jnp.zeros(shape, bool), zero)
    return lax.while_loop(going, look, (zero, place))[1]


def _search_interval(replay: _Replay, frame: Array, passed: Array, wanted: _Wanted) -> _CrossingStep:
    """The step after a frame over which the signed distance changes its sign for the wanted time, so many having passed."""

    def one(i, carry):
        moving, before, place = carry
        t = replay.moment(frame, i)
        moving = replay.step(moving, t, replay.dt)
        after = replay.measure_distance(to_float_time(t + replay.dt), moving)
        crosses = _crosses(before, after, wanted.way) & ~place.found
        passed = place.passed + crosses.astype(jnp.int32)
        here = crosses & (passed == wanted.nth)
        new = _CrossingStep(frame, jnp.full_like(frame, i), before, after, here, passed)
        place = jax.tree.map(lambda a, b: jnp.where(here, a, b), new, place)
        return moving, after, place._replace(passed=passed)

    moving = replay.take_frame(frame)
    distance = replay.measure_distance(to_float_time(replay.moment(frame, 0)), moving)
    nowhere = _CrossingStep(frame, jnp.zeros_like(frame), distance, distance, jnp.zeros(distance.shape, bool), passed)
    return lax.fori_loop(0, replay.steps_per_frame, one, (moving, distance, nowhere))[2]


def _find_candidate_intervals(replay: _Replay, way: Array) -> Bool[Array, "intervals *lanes"]:
    """Between which frames there may be a crossing: where the cubic through them changes sign, if only in between."""

    def gap_and_rate(frame, moving):
        t, one = to_float_time(replay.moment(jnp.full(replay.dt.shape, frame), 0)), jnp.ones_like(replay.dt)
        _, rate = jax.jvp(replay.measure, (t, moving.state), (one, replay.rate(t, moving)))
        return replay.measure_distance(t, moving), replay.steps_per_frame * replay.dt * rate

    numbers = jnp.arange(len(replay.frames.state.position), dtype=jnp.int32)
    signed_distance, rate = jax.vmap(gap_and_rate)(numbers, replay.frames)
    d0, d1, r0, r1 = signed_distance[:-1], signed_distance[1:], rate[:-1], rate[1:]
    cubic = Cubic.through(d0, d1, r0, r1)
    # an extremum that does not exist is moved to the end of the interval, where it divides nothing
    level = [jnp.clip(jnp.nan_to_num(s, nan=1.0), 0.0, 1.0) for s in cubic.extrema()]
    middle = [cubic.at(s) for s in (jnp.minimum(*level), jnp.maximum(*level))]
    ends = [d0, *middle, d1]
    pieces = [_crosses(before, after, way) for before, after in pairwise(ends)]
    return jnp.any(jnp.stack([_crosses(d0, d1, way), *pieces]), axis=0)


def _crosses(before: Array, after: Array, way: Array) -> Array:
    """Whether a signed distance changes its sign in the wanted direction; starting at zero is no crossing, arriving there is."""
    falls, rises = (before > 0) & (after <= 0), (before < 0) & (after >= 0)
    return (falls & (way <= 0)) | (rises & (way >= 0))


def _stop_closure_gradients(function: Callable, *examples: PyTree) -> Callable:
    """The function without derivatives with respect to what it closes over."""
    numbers, pure = _hoist_closure(function, *examples)
    return partial(pure, lax.stop_gradient(numbers))


def _hoist_closure(function: Callable, *examples: PyTree) -> tuple[PyTree, Callable]:
    """Every array that a function closes over, and the function with these as its first argument."""
    numbers, rest = eqx.partition(
        eqx.filter_closure_convert(lambda *arguments: function(*arguments), *examples), eqx.is_array
    )
    return numbers, lambda numbers, *arguments: eqx.combine(numbers, rest)(*arguments)


def _take_frames(leaf: Array, frame: Array) -> Array:
    """The entry of each lane, at a frame of its own."""
    if not frame.ndim:
        return leaf[frame]
    index = frame.reshape(1, *frame.shape, *(1 for _ in range(leaf.ndim - 1 - frame.ndim)))
    return jnp.take_along_axis(leaf, index, axis=0)[0]


def _build_measure(surface: PyTree, scene: PyTree) -> Callable:
    """What crosses zero, a function of time and state, if it gives a number for each lane; of bodies also one for a scene."""
    if isinstance(surface, Distanced):
        measure = lambda t, state: surface.signed_distance(t, state.position)  # noqa: E731
    elif isinstance(scene.state, Particles):
        measure = lambda t, state: surface(t, state.position)  # noqa: E731
    else:
        measure = surface
    t, lanes = jnp.zeros(scene.status_shape, scene.state.dtype), scene.state.lanes
    seen = jax.eval_shape(measure, t, scene.state)
    if isinstance(scene.state, Particles):
        if seen.shape != lanes:
            raise ValueError(
                f"crossing: signed_distance(t, position) has the shape {seen.shape}, expected the lanes' {lanes}: "
                "one distance [m] for each, e.g. position[..., 1] - 2.0."
            )
    elif seen.shape not in (lanes, scene.status_shape):
        raise ValueError(
            f"crossing: the function (t, bodies) has the shape {seen.shape}, expected {lanes}, a number for each body, "
            f"or {scene.status_shape}, one for each scene, e.g. bodies.position[..., 1] - 2.0."
        )
    return measure


def _demand_unshared_memory(changing: PyTree, shape: tuple[int, ...]) -> None:
    """Raise a ValueError if lanes share something that changes: they are stepped from different frames."""
    if any(leaf.shape[: len(shape)] != shape for leaf in jax.tree.leaves(changing)):
        raise ValueError(
            "crossing: a part of the scene remembers something that its lanes share, but each lane is stepped again from a "
            "frame of its own. Give its memory an entry for each lane, or run the lanes one by one."
        )
