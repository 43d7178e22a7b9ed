"""Shots through bounces: a fan of directions is flown, and the best of it refined.

A path that bounces depends on its launch piecewise: a faster shot may go farther or not, arrive sooner or later, and
one more bounce is another piece. No solution can be continued from one shot to all others, so all directions are tried.
"""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from physjax.scene import Scene
from physjax.study.inverse.shooting import AimProblem, Launch, find_nearest_launch
from physjax.vectors import dot, norm, scale

PLANE_DIRECTIONS, SPACE_RINGS_AND_DIRECTIONS = 256, (24, 32)
"""Directions of the fan: around the circle in the plane; in space the rings, and the directions on each."""
FAN_STEPS = 96
"""Steps of a flight in the fan, growing with time."""
REFINED_DIRECTIONS = 8
"""Best directions of the fan that are refined."""
LATER_RANK = 1e6
"""Added to the rank [m] of what is a last resort: beyond any distance between a shot and its target."""


def find_ricochet(
    shots: AimProblem, speed: Float[Array, "*lanes"], late: Bool[Array, ""], bounces: int
) -> tuple[Launch, Bool[Array, "*lanes"]]:
    """The launch at a speed [m/s] that hits after `bounces`, the soonest or the latest; and whether it bounces that often.

    Where none hits, the one that comes nearest. What lies between the directions of the fan may be overlooked.
    """
    starts = _pick_launches(shots, speed, bounces)
    wanted = jnp.ones(speed.shape, bool)
    launches, distance = lax.map(lambda start: find_nearest_launch(shots, start, speed, wanted), starts)
    right = lax.map(lambda launch: _count_impacts(shots, launch), launches) == bounces
    extent = speed[None] * launches.time
    near = float(jnp.finfo(extent.dtype).eps) ** 0.75 * extent
    hit = right & (distance <= jnp.maximum(near, jax.vmap(shots.rounding)(launches)))
    order = jnp.where(late, -launches.time, launches.time)
    # hits come first, by time; then the nearest with the right number of bounces; then the others
    worst = 2 * jnp.max(jnp.where(jnp.isfinite(launches.time), launches.time, 0.0)) + 1
    rank = jnp.where(hit, order, worst + jnp.where(right, distance, LATER_RANK + distance))
    chosen = jnp.argmin(jnp.where(jnp.isfinite(rank), rank, jnp.inf), axis=0)
    return jax.tree.map(lambda leaf: _pick_by_lane(leaf, chosen), (launches, right))


def _count_impacts(shots: AimProblem, launch: Launch) -> Int[Array, "*lanes"]:
    """The number of the flight's steps with an impact in them; one at the very end, on the target, does not count."""
    dt, number = launch.time / shots.steps, jnp.arange(shots.steps, dtype=jnp.int32)

    def step(carry, i):
        scene, count = carry
        scene, struck, moved = _step_and_detect_impact(scene, shots.method, i.astype(dt.dtype) * dt, dt)
        last = i == shots.steps - 1
        return (scene, count + jnp.where(last, moved, struck).astype(count.dtype)), None

    begin = (shots.with_launch_velocity(launch.velocity), jnp.zeros(launch.time.shape, jnp.int32))
    return lax.scan(step, begin, number)[0][1]


def _step_and_detect_impact(
    scene: Scene, method: Callable[..., PyTree], t: Array, dt: Array
) -> tuple[Scene, Array, Array]:
    """A step; whether an impact in it changed position or velocity at its end, and whether the position."""
    # the same step without contacts differs exactly where there was an impact
    after, free = scene.step(method, t, dt), scene.replace(contacts=()).step(method, t, dt).state
    rounding = float(jnp.finfo(free.dtype).eps) ** 0.5
    fast = jnp.maximum(norm(free.velocity), norm(scene.state.velocity))
    moved = norm(after.state.position - free.position) > rounding * fast * dt
    return after, moved | (norm(after.state.velocity - free.velocity) > rounding * fast), moved


def _pick_launches(shots: AimProblem, speed: Array, bounces: int) -> Launch:
    """The launches of the fan that come nearest among the local minima over directions; stacked along the first axis."""
    fan = _build_directions(shots.target.shape[-1], shots.scene.up, speed.dtype)
    shape = fan.shape[:2]
    launch = lambda direction: scale(speed, jnp.broadcast_to(direction, shots.target.shape))  # noqa: E731
    rows = fan.reshape(-1, fan.shape[-1])
    distance, time = lax.map(lambda direction: _find_closest_approach(shots, launch(direction), speed, bounces), rows)
    grid = distance.reshape(*shape, *distance.shape[1:])
    edge = jnp.full((1, *grid.shape[1:]), jnp.inf, grid.dtype)
    neighbours = [jnp.roll(grid, 1, axis=1), jnp.roll(grid, -1, axis=1)]
    neighbours += [jnp.concatenate([edge, grid[:-1]]), jnp.concatenate([grid[1:], edge])]
    lowest = jnp.isfinite(grid)
    for neighbour in neighbours:
        lowest = lowest & (grid <= neighbour)
    # local minima first, then the others, so that there is always something to refine
    rank = jnp.where(lowest, grid, LATER_RANK + grid).reshape(distance.shape)
    best = jnp.moveaxis(lax.top_k(-jnp.moveaxis(rank, 0, -1), REFINED_DIRECTIONS)[1], -1, 0)
    velocity = jax.vmap(lambda chosen: scale(speed, rows[chosen]))(best)
    return Launch(velocity, jax.vmap(lambda chosen: _pick_by_lane(time, chosen))(best))


def _build_directions(dim: int, up: int, dtype: np.dtype) -> Float[Array, "up around dim"]:
    """Unit vectors, evenly around a circle, or on rings from nearly straight down to nearly straight up."""
    around = lambda count: 2 * math.pi / count * (jnp.arange(count, dtype=dtype) + 0.5)  # noqa: E731
    if dim == 2:
        return jnp.stack([jnp.cos(around(PLANE_DIRECTIONS)), jnp.sin(around(PLANE_DIRECTIONS))], axis=-1)[None]
    rise, turn = 0.5 * (around(SPACE_RINGS_AND_DIRECTIONS[0]) - math.pi), around(SPACE_RINGS_AND_DIRECTIONS[1])
    rise, turn = jnp.meshgrid(rise, turn, indexing="ij")
    level = [jnp.cos(rise) * jnp.cos(turn), jnp.cos(rise) * jnp.sin(turn)]
    return jnp.stack([*level[:up], jnp.sin(rise), *level[up:]], axis=-1)


def _find_closest_approach(shots: AimProblem, velocity: Array, speed: Array, bounces: int) -> tuple[Array, Array]:
    """How near a shot comes after exactly `bounces` [m], and when [s]: the nearest point of the chord of each step."""
    first, growth = _choose_time_grid(shots, speed, bounces)

    def step(carry, i):
        scene, count, t, best, when = carry
        after = first * growth**i
        dt, x = after - t, scene.state.position
        scene, struck, _ = _step_and_detect_impact(scene, shots.method, t, dt)
        # as the target sees it
        way = x - shots.target_at(t)
        chord = scene.state.position - shots.target_at(after) - way
        length = dot(chord, chord)
        share = jnp.clip(-dot(way, chord) / jnp.where(length > 0, length, 1.0), 0.0, 1.0)
        away = norm(way + scale(share, chord))
        better = (count == bounces) & ~struck & (away < best)
        best, when = jnp.where(better, away, best), jnp.where(better, t + share * dt, when)
        return (scene, count + struck.astype(count.dtype), after, best, when), None

    still = jnp.zeros_like(speed)
    begin = (shots.with_launch_velocity(velocity), jnp.zeros(still.shape, jnp.int32), still, still + jnp.inf, first)
    (*_, best, when), _ = lax.scan(step, begin, jnp.arange(FAN_STEPS, dtype=speed.dtype))
    return best, when


def _choose_time_grid(shots: AimProblem, speed: Array, bounces: int) -> tuple[Array, Array]:
    """The first moment of a fan's flight [s], and the ratio of each to the one before.

    The last is the latest that a flight at this speed can last without drag, from bounce to bounce.
    """
    distance, rest_acceleration = norm(shots.offset), norm(shots.rest_acceleration)
    fastest = speed if shots.launcher is None else speed + norm(shots.launcher)
    first = distance / (8 * fastest)
    idle = 16 * (bounces + 1) * distance / speed
    arcs = (bounces + 1) * (
        2 * fastest / jnp.where(rest_acceleration > 0, rest_acceleration, 1.0)
    ) + 2 * distance / speed
    last = jnp.where(rest_acceleration > 0, jnp.maximum(arcs, idle / 4), idle)
    return first, (last / first) ** (1 / (FAN_STEPS - 1))


def _pick_by_lane(leaves: Array, chosen: Array) -> Array:
    """From arrays stacked along the first axis, the chosen one for each lane."""
    index = chosen.reshape((1,) + chosen.shape + (1,) * (leaves.ndim - 1 - chosen.ndim))
    return jnp.take_along_axis(leaves, index, axis=0)[0]
