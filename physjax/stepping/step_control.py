"""How long a step may be: errors in units of a tolerance, the next length, the first, and where a step must end."""

from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from physjax.loops import Time, to_float_time
from physjax.parts import Force
from physjax.stepping.system import S, System, read_traits
from physjax.vectors import add_trailing_axes

SAFETY_FACTOR, LECTURE_SAFETY_FACTOR = 0.77, 0.9
"""The next step relative to the one that would just keep the tolerance: ours rejects fewer steps than the lecture's."""
SMALLEST_STEP_FACTOR, LARGEST_STEP_FACTOR = 0.2, 5.0
"""Bounds of the next step relative to the last: one estimate of the error is not trusted further."""
NEGLIGIBLE_ERROR = 1e-10
"""An error, in units of the tolerance, that counts as none."""
SHORTEST_STEP_SHARE = 1e-6
"""The shortest step where none is given, relative to the dt that is subdivided."""


class Tolerance(NamedTuple):
    """What a step may be wrong by: atol + rtol |y|, absolute and relative to the larger of the states at its ends."""

    absolute: Array
    relative: Array

    def at(self, start: S, end: S) -> S:
        """The tolerance of each component of a step."""
        size = jax.tree.map(lambda a, b: jnp.maximum(jnp.abs(a), jnp.abs(b)), start, end)
        return jax.tree.map(lambda s: self.absolute.astype(s.dtype) + self.relative.astype(s.dtype) * s, size)


class StepRecord(NamedTuple):
    """A step's length [s] and its error in units of the tolerance."""

    length: Array
    error: Array


def choose_factor(step: StepRecord, before: StepRecord, good: Array, order: int) -> Array:
    """By how much longer the next step may be: as this error allows, or less where errors have been growing.

    The trend, from the accepted step before, is K. Gustafsson's (1994; Hairer and Wanner, section IV.8): without it
    a fifth of all tries is rejected where a body falls towards another, as each step is harder than the last.
    """
    power = 1 / (order + 1)
    now, then = jnp.maximum(step.error, NEGLIGIBLE_ERROR), jnp.maximum(before.error, NEGLIGIBLE_ERROR)
    factor = SAFETY_FACTOR * now**-power
    # no step before: its length is infinite, and nothing is known
    trend = jnp.where(jnp.isfinite(before.length), step.length / before.length * (then / now) ** power, 1.0)
    return limit_factor(jnp.where(good, factor * jnp.minimum(trend, 1.0), factor), step.error)


def choose_factor_of_lecture(error: Array) -> Array:
    """The lecture's dt √(E_tol/E), of first order, whatever the method."""
    return limit_factor(LECTURE_SAFETY_FACTOR * jnp.maximum(error, NEGLIGIBLE_ERROR) ** -0.5, error)


def limit_factor(factor: Array, error: Array) -> Array:
    """The factor within its bounds; after a step that is no number, the smallest."""
    limited = jnp.clip(factor, SMALLEST_STEP_FACTOR, LARGEST_STEP_FACTOR)
    return jnp.where(jnp.isfinite(error), limited, SMALLEST_STEP_FACTOR)


def choose_first_step(
    system: System, t: Time, state: S, dt: Array, tolerance: Tolerance, order: int
) -> tuple[Array, S]:
    """A first length from how fast the state and its rate change (Hairer, Nørsett, Wanner, section II.4); and the rate."""
    shape, allowed = dt.shape, tolerance.at(state, state)
    slope = system.rate(t, state)
    size, speed = scaled_norm(state, allowed, shape), scaled_norm(slope, allowed, shape)
    small = 0.01 * jnp.where(speed > 0, size / jnp.where(speed > 0, speed, 1.0), 1e30)
    small = jnp.clip(small, SHORTEST_STEP_SHARE * dt, dt)
    ahead = jax.tree.map(lambda y, k: y + add_trailing_axes(small, y.ndim) * k, state, slope)
    turn = jax.tree.map(lambda a, b: a - b, system.rate(t + small, ahead), slope)
    second_derivative = jnp.maximum(scaled_norm(turn, allowed, shape) / small, 1e-30)
    # half of y'' dt² is what a step of first order misses
    longest = (0.01 / jnp.maximum(second_derivative, speed)) ** (1 / (order + 1))
    return jnp.minimum(100 * small, longest), slope


def find_jumps(system: System, t: Time, shape: tuple[int, ...]) -> list[Array]:
    """When forces of a system jump, after t [s]: `(*shape, k)` each."""
    found = []
    for force in read_traits(system).forces:
        for times in map(jnp.asarray, force.discontinuities() if isinstance(force, Force) else ()):
            own = shape and times.shape[: len(shape)] == shape
            times = times.reshape((*shape, -1)) if own else times.reshape((1,) * len(shape) + (-1,))
            found.append(times - jnp.broadcast_to(to_float_time(t), shape)[..., None])
    return found


def find_next_stop(jumps: list[Array], end: Array, elapsed: Array) -> Array:
    """The end, or the first jump before it that has not been reached."""
    for times in jumps:
        ahead = jnp.where(times > elapsed[..., None], times, jnp.inf)
        end = jnp.minimum(end, jnp.min(ahead, axis=-1))
    return end


def scaled_norm(state: S, tolerance: S, shape: tuple[int, ...]) -> Array:
    """The largest component in units of its tolerance, for each scene or lane."""
    leaves = [jnp.abs(a / b) for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(tolerance), strict=True)]
    largest = reduce(jnp.maximum, [leaf[..., i] for leaf in leaves for i in range(leaf.shape[-1])])
    return max_over_shared_step(largest, shape)


def max_over_shared_step(number: Array, shape: tuple[int, ...]) -> Array:
    """The largest number of all lanes that share a step."""
    return jnp.max(number, axis=tuple(range(len(shape), number.ndim)))
