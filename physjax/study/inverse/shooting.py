"""The search behind `aim_at`: the launches that reach a target after some time of flight.

For every flight time T there is a launch velocity v(T) that is at the target then, and it depends smoothly on T: without
drag v(T) = Δ/T - ½aT. Its speed falls to a minimum and rises again, so a given speed is met twice, by the low arc before
that minimum and by the high arc after it, or never. In this formulation nothing is special about the edge of reach, a
target overhead, crosswind or the third dimension.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from physjax.backend import any_lane
from physjax.compaction import compact_and_apply
from physjax.linear import solve_columns
from physjax.loops import RECORD, bounded_while_loop
from physjax.particles import Particles
from physjax.scene import Scene
from physjax.stepping.simulate import sample_states, simulate
from physjax.trajectory import Trajectory
from physjax.vectors import components, cross, dot, norm, scale, stack_components, turn_left, unit

MAX_SEARCH_STEPS, MAX_DESCENT_STEPS = 40, 100
"""Most steps of a search, and of a descent to the nearest miss."""
COARSE_STEPS = 16
"""Steps of a flight while the shot is still far from its target: cheap, and near enough for the next phase to start."""
HIT_ROUNDINGS = 512
"""A target that is missed by at most this many roundings of the flight's extent is hit."""
MAX_TIME_FACTOR = math.e
"""A search changes the flight time by no more than this factor at once."""
SECANT_SLOPES = (0.3, 10.0)
"""Bounds of a secant's slope, which is 1 without drag: one taken across rounding may be anything."""
MAX_DESCENT_ANGLE = 0.5
"""A descent turns the launch by no more at once [rad], nor changes the log of the flight time by more."""
FIRST_DAMPING, MAX_DAMPING = 1e-2, 1e8
"""Damping of a descent's first step, relative to the largest square of a slope; and beyond which no step is small enough."""
DAMPING_DECREASE, DAMPING_INCREASE = 0.3, 3.0
"""Factors of the damping after a step that came closer, and after one that did not."""
SMALL_STEP_SHARE = 0.1
"""A descent's steps are small below this share of √eps: what is left of the miss is then quadratic in it."""


State = TypeVar("State")


class Launch(NamedTuple):
    """A launch velocity, relative to the launcher [m/s], and the time of flight [s]."""

    velocity: Float[Array, "*lanes dim"]
    time: Float[Array, "*lanes"]


class AimProblem(eqx.Module):
    """Where shots are fired: a scene with a lane for every target [m], the method of the flights and their steps.

    `launcher` is the velocity of what they are fired from, `target_velocity` that of the targets [m/s]; None: at rest.
    `path(t)` is where a target is that moves in any way; its `target_velocity` is then that at the launch.
    """

    scene: Scene = eqx.field(metadata=RECORD)
    target: Float[Array, "*lanes dim"] = eqx.field(metadata=RECORD)
    method: Callable[..., PyTree]
    steps: int = eqx.field(static=True)
    launcher: Float[Array, "*lanes dim"] | None = eqx.field(metadata=RECORD, default=None)
    target_velocity: Float[Array, "*lanes dim"] | None = eqx.field(metadata=RECORD, default=None)
    path: Callable | None = None

    @property
    def offset(self) -> Float[Array, "*lanes dim"]:
        """From the launch to the target, at the launch [m]."""
        return self.target - self.scene.state.position

    def target_at(self, time: Float[Array, "*lanes"]) -> Float[Array, "*lanes dim"]:
        """Where the targets are at a time after the launch [m]."""
        if self.path is not None:
            return jax.vmap(self.path)(time.reshape(-1)).astype(time.dtype).reshape(self.target.shape)
        return self.target if self.target_velocity is None else self.target + scale(time, self.target_velocity)

    @property
    def rest_acceleration(self) -> Float[Array, "*lanes dim"]:
        """The acceleration of a lane at rest at the launch [m/s²]."""
        position = self.scene.state.position
        return self.scene.acceleration(0.0, Particles(position, jnp.zeros_like(position)))

    def with_launch_velocity(self, velocity: Float[Array, "*lanes dim"]) -> Scene:
        """The scene with these launch velocities, relative to the launcher [m/s]."""
        scene, velocity = self.scene, self.over_ground(velocity)
        return Scene(Particles(scene.state.position, velocity), scene.mass, scene.forces, scene.contacts)

    def over_ground(self, velocity: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """The velocity over ground [m/s] of a launch at a velocity relative to the launcher."""
        return velocity if self.launcher is None else velocity + self.launcher

    def flight(
        self, launch: Launch, *, save_every: int | None = None, record: Callable[..., PyTree] | None = None
    ) -> Trajectory:
        """The flight in equal steps that end at its time; only its ends are kept by default."""
        dt, steps = launch.time / self.steps, self.steps
        scene = self.with_launch_velocity(launch.velocity)
        return simulate(scene, self.method, dt=dt, steps=steps, save_every=save_every or steps, record=record)

    def miss(self, launch: Launch, steps: Array | None = None) -> Float[Array, "*lanes dim"]:
        """From the target to where a shot is at its time [m]; with another number of steps, which may be traced.

        Those have no reverse mode.
        """
        if steps is None:
            end = self.flight(launch).final_scene
            assert end is not None
            return end.state.position - self.target_at(launch.time)
        dt = launch.time / steps.astype(launch.time.dtype)
        flights = sample_states(self.with_launch_velocity(launch.velocity), self.method, dt, steps, 1)
        return flights.position[1] - self.target_at(launch.time)

    def rounding(self, launch: Launch) -> Float[Array, "*lanes"]:
        """The miss that rounding leaves [m]: of the flight's extent and, far from the origin, of a place at every step.

        A miss beyond the square root of a rounding of the extent is one, wherever the shot is fired.
        """
        extent = norm(self.offset) + norm(self.over_ground(launch.velocity)) * launch.time
        away = jnp.maximum(norm(self.scene.state.position), norm(self.target))
        eps = float(jnp.finfo(extent.dtype).eps)
        left = eps * jnp.maximum(HIT_ROUNDINGS * extent, self.steps * away)
        return lax.stop_gradient(jnp.minimum(left, eps**0.5 * extent))

    def sensitivity(self, launch: Launch, directions: list[Launch], steps: Array | None) -> tuple[Array, list[Array]]:
        """The miss [m], and its derivative along each direction."""
        along = lambda direction: jax.jvp(lambda at: self.miss(at, steps), (launch,), (direction,))  # noqa: E731
        many = jax.tree.map(lambda *leaves: jnp.stack(leaves), *directions)
        miss, slopes = jax.vmap(along, out_axes=(None, 0))(many)
        return miss, list(slopes)

    def newton_correction(self, launch: Launch, steps: Array | None = None) -> tuple[Array, Array]:
        """How far the velocity is from the one that is at the target at this time, and dv/d(log T) of that one [m/s]."""
        v, time = launch
        axes = [jnp.broadcast_to(row, v.shape) for row in jnp.eye(v.shape[-1], dtype=v.dtype)]
        directions = [Launch(axis, jnp.zeros_like(time)) for axis in axes] + [Launch(jnp.zeros_like(v), time)]
        miss, (*by_velocity, by_time) = self.sensitivity(launch, directions, steps)
        return _solve_vectors(by_velocity, miss), -_solve_vectors(by_velocity, by_time)


class _Search(NamedTuple):
    """Where the search of each lane is, its last error and step in the log of time, and whether it continues."""

    launch: Launch
    log_time_error: Array
    log_time_step: Array
    active: Bool[Array, "*lanes"]


def guess_launch(shots: AimProblem, speed: Float[Array, "*lanes"] | None) -> Launch:
    """The launch of least speed under the constant acceleration at rest: T = √(2|Δ|/a), v = Δ/T - ½aT, at most the speed."""
    rest_acceleration = shots.rest_acceleration
    distance, strength = norm(shots.offset), norm(rest_acceleration)
    pulled = strength > 0
    idle = distance if speed is None else distance / speed
    time = jnp.where(pulled, jnp.sqrt(2 * distance / jnp.where(pulled, strength, 1.0)), idle)
    velocity = scale(1 / time, shots.offset) - scale(0.5 * time, rest_acceleration)
    if shots.target_velocity is not None:
        velocity = velocity + shots.target_velocity
    if shots.launcher is not None:
        velocity = velocity - shots.launcher
    if speed is not None:
        velocity = scale(jnp.minimum(1.0, speed / norm(velocity)), velocity)
    return Launch(velocity, time)


def find_launch(
    shots: AimProblem, speed: Float[Array, "*lanes"] | None, late: Bool[Array, ""] | None
) -> tuple[Launch, Bool[Array, "*lanes"]]:
    """The launch that hits at a speed [m/s], on the low arc or the `late` one, and whether it was found.

    Without a speed, the one that hits at the least. A lane whose target is out of reach ends at the minimum, with the
    least speed that would reach it. Flights of few steps lead near the solution, those of all steps to its last digits.
    """
    guess = guess_launch(shots, speed)
    # convergence is quadratic: a step from this near leads to the last digits; a secant's converges slower
    enough = float(jnp.finfo(guess.time.dtype).eps) ** (0.5 if speed is not None else 0.75)
    steps = jnp.array([min(COARSE_STEPS, shots.steps), shots.steps], jnp.int32)
    phases = (steps, jnp.array([1e-3, enough], guess.time.dtype))

    def phase(search, precision):
        sound = jnp.isfinite(search.launch.time) & jnp.isfinite(norm(search.launch.velocity))
        search = search._replace(
            launch=select_where(sound, search.launch, guess),
            active=jnp.ones_like(search.active),
        )
        return _iterate_lanes(partial(_advance_search, late, precision), search, shots, speed, MAX_SEARCH_STEPS), None

    nothing = jnp.zeros_like(guess.time)
    search, _ = lax.scan(phase, _Search(guess, nothing, nothing, nothing < 0), phases)
    return search.launch, ~search.active


def _advance_search(
    late: Array | None, precision: tuple[Array, Array], search: _Search, shots: AimProblem, speed: Array | None
) -> _Search:
    """A step of the search."""
    steps, enough = precision
    launch, log_time_error, correction = _estimate_launch(shots, search, speed, late, steps)
    log_time_step = jnp.log(launch.time / search.launch.time)
    return _Search(launch, log_time_error, log_time_step, ~(jnp.maximum(jnp.abs(log_time_step), correction) <= enough))


def _iterate_lanes(
    improve: Callable[[State, AimProblem, Array | None], State],
    begin: State,
    shots: AimProblem,
    speed: Array | None,
    most: int,
) -> State:
    """Repeat `improve(search, shots, speed)` for the lanes that are `active`: a few hard ones do not hold up the others."""
    others = (shots, speed)
    cut, masks = shots.scene.may_be_cut(), shots.scene.build_lane_mask(others)

    def once(search, shots, speed):
        after = improve(search, shots, speed)
        return select_where(search.active, after, search)

    def body(search):
        return compact_and_apply(once, search.active, search, *others, masks=masks, cut=cut)

    going = lambda search: any_lane(search.active)  # noqa: E731
    return bounded_while_loop(going, body, begin, most=most)


def _estimate_launch(
    shots: AimProblem, search: _Search, speed: Array | None, late: Array | None, steps: Array
) -> tuple[Launch, Array, Array]:
    """The launch that is right if v(T) is as without drag from here, the error in log T, and the correction of v.

    With u = log T, v = A exp(-u) + B exp(u) has the value and slope found here; it is exact without drag.
    """
    v, time = search.launch
    correction, turn = shots.newton_correction(search.launch, steps)
    size, most = norm(correction), 0.5 * (norm(v) + (norm(shots.offset) / time if speed is None else speed))
    v = v - scale(jnp.minimum(1.0, most / jnp.where(size > 0, size, 1.0)), correction)
    falling, rising = 0.5 * (v - turn), 0.5 * (v + turn)
    a, b, both = norm(falling), norm(rising), dot(falling, rising)
    if speed is None:
        log_time_error = 0.5 * jnp.log(a / b)
        # the secant through this point and the last, since v(u) bends more with drag than without
        slope = jnp.where(
            search.log_time_step != 0,
            (search.log_time_error - log_time_error) / jnp.where(search.log_time_step != 0, search.log_time_step, 1),
            1,
        )
        change = log_time_error / jnp.clip(slope, *SECANT_SLOPES)
    else:
        assert late is not None
        middle = jnp.maximum(speed * speed - 2 * both, 2 * a * b)
        total = middle + jnp.sqrt((middle - 2 * a * b) * (middle + 2 * a * b))
        change = log_time_error = 0.5 * jnp.log(jnp.where(late, total / (2 * b * b), 2 * a * a / total))
    factor = jnp.exp(jnp.clip(change, -math.log(MAX_TIME_FACTOR), math.log(MAX_TIME_FACTOR)))
    launch = Launch(scale(1 / factor, falling) + scale(factor, rising), time * factor)
    return launch, log_time_error, size / jnp.maximum(most, norm(v))


class _Descent(NamedTuple):
    """Where the descent of each lane is, its miss, slopes and damping, and whether it continues."""

    launch: Launch
    distance: Array
    miss: Float[Array, "*lanes dim"]
    slopes: tuple[Array, ...]
    damping: Array
    active: Bool[Array, "*lanes"]


def find_nearest_launch(
    shots: AimProblem, start: Launch, speed: Float[Array, "*lanes"], wanted: Bool[Array, "*lanes"]
) -> tuple[Launch, Float[Array, "*lanes"]]:
    """The launch that comes nearest the target, from a start on, at a speed, and its distance [m].

    The method of Levenberg and Marquardt. Unknown are the direction, as turns about it, and the logarithm of the flight
    time. Only the `wanted` lanes leave their start, and have a distance that is finite. A lane is done when its steps
    are small and, where it hits, when they no longer halve the distance: then only rounding is left of it.
    """
    still, zero = jnp.zeros_like(start.time), jnp.zeros_like(start.velocity)
    steps, least = jnp.array(shots.steps, jnp.int32), SMALL_STEP_SHARE * float(jnp.finfo(still.dtype).eps) ** 0.5

    def descend(now, shots, speed):
        step = [
            jnp.clip(part, -MAX_DESCENT_ANGLE, MAX_DESCENT_ANGLE)
            for part in components(_solve_damped_step(now.slopes, now.miss, now.damping))
        ]
        aside = sum(
            scale(angle, turn) for angle, turn in zip(step, perpendicular_axes(now.launch.velocity), strict=False)
        )
        velocity = scale(speed, unit(unit(now.launch.velocity) + aside))
        tried = Launch(velocity, now.launch.time * jnp.exp(step[-1]))
        still, zero = jnp.zeros_like(tried.time), jnp.zeros_like(velocity)
        directions = [Launch(scale(speed, turn), still) for turn in perpendicular_axes(velocity)]
        miss, slopes = shots.sensitivity(tried, [*directions, Launch(zero, tried.time)], steps)
        better = norm(miss) < now.distance
        small = (norm(stack_components(step)) <= least) & jnp.isfinite(now.distance)
        # a damped step leaves a share of the miss; the distance of a nearest miss stays, that of a hit goes on falling
        falls = norm(miss) < 0.5 * now.distance
        after = _Descent(tried, norm(miss), miss, tuple(slopes), DAMPING_DECREASE * now.damping, now.active)
        worse = now._replace(damping=DAMPING_INCREASE * now.damping)
        after = select_where(better, after, worse)
        return after._replace(active=~(small & ~falls) & (after.damping < MAX_DAMPING))

    # the first step is none at all, and finds the slopes
    axes = tuple(jnp.broadcast_to(row, zero.shape) for row in jnp.eye(zero.shape[-1], dtype=zero.dtype))
    start = Launch(scale(speed, unit(start.velocity)), start.time)
    begin = _Descent(start, still + jnp.inf, zero, axes, still + FIRST_DAMPING, wanted)
    end = _iterate_lanes(descend, begin, shots, speed, MAX_DESCENT_STEPS)
    return end.launch, end.distance


def _solve_damped_step(slopes: tuple[Array, ...], miss: Array, damping: Array) -> Array:
    """The damped Gauss-Newton step: (JᵀJ + λ max(JᵀJ)) δ = -Jᵀr."""
    squares = [dot(slope, slope) for slope in slopes]
    largest = squares[0]
    for square in squares[1:]:
        largest = jnp.maximum(largest, square)
    normal = [
        stack_components([dot(a, b) + (damping * largest if i == j else 0.0) for i, a in enumerate(slopes)])
        for j, b in enumerate(slopes)
    ]
    return -_solve_vectors(normal, stack_components([dot(slope, miss) for slope in slopes]))


def perpendicular_axes(velocity: Float[Array, "*lanes dim"]) -> list[Float[Array, "*lanes dim"]]:
    """Unit vectors across a velocity: one in the plane, two in space."""
    along = unit(velocity)
    if velocity.shape[-1] == 2:
        return [turn_left(along)]
    # across the axis that it follows least, so that the product is far from zero
    x, y, z = (jnp.abs(part) for part in components(along))
    least_x, least_y = (x <= y) & (x <= z), y <= z
    axis = stack_components([part.astype(x.dtype) for part in (least_x, ~least_x & least_y, ~least_x & ~least_y)])
    first = unit(cross(along, axis))
    return [first, cross(along, first)]


def _solve_vectors(
    columns: list[Float[Array, "*lanes dim"]], b: Float[Array, "*lanes dim"]
) -> Float[Array, "*lanes dim"]:
    """The solution of Σ xᵢ columnᵢ = b, for each lane."""
    return stack_components(solve_columns([components(column) for column in columns], components(b)))


def select_where(flag: Bool[Array, "*lanes"], new: State, old: State) -> State:
    """Lane by lane the new where flagged, else the old, for trees of numbers and vectors."""
    one = lambda a, b: jnp.where(flag if a.ndim == flag.ndim else flag[..., None], a, b)  # noqa: E731
    return jax.tree.map(one, new, old)
