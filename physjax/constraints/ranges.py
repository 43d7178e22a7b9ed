"""Rows of joints that hold on one side alone, or are driven: limits, ropes, and motors that exert no more than they can.

A row with the value x, such as an angle, stays between `low` and `high`, where a limit pushes it away, and is driven to `aim`
by an impulse of at most `cap`. So its impulse λ falls with x as a staircase does, from any positive one at `low` over +cap,
0 and -cap to any negative one at `high`; on which step it stands is found by iteration, an active-set method (M. Hintermüller,
K. Ito, K. Kunisch, SIAM J. Optim. 13 (2002) 865). A row that is always held is one with low = high.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

Rows = Float[Array, "rows joints worlds"]
"""A number for each row of each joint."""
Steps = Int[Array, "rows joints worlds"]
"""Where each row is: at its lower (-2) or upper limit (2), driven up (-1) or down (1) with all its strength, at its aim (0)."""
FREE_TURNS = 6
"""After as many turns one row of a world changes at a time, the first that must: that ends for every mechanism, by the rule
of K. G. Murty, Opsearch 11 (1974) 123, and all at once may go round in circles."""


class Bounds(NamedTuple):
    """What rows are held to: limits, and a drive whose speed is `speed` - `gain` (x - `goal`), with at most `cap` [N or N m].

    Without limits `low` and `high` are infinite, without a drive `cap` is zero. A gain [1/s] makes it a servo.
    """

    low: Rows
    high: Rows
    speed: Rows
    goal: Rows
    gain: Rows
    cap: Rows

    @classmethod
    def hold(cls, like: Rows) -> "Bounds":
        """Rows that are always held at zero."""
        zero = jnp.zeros_like(like)
        return cls(zero, zero, zero, zero, zero, zero)

    def after(self, x: Rows, h: Float[Array, " worlds"]) -> "Range":
        """What a row with the value x may be after a time h [s], given half of what a drive transfers in it."""
        lag, h = x - self.goal, h[None, None]
        aim = self.goal + lag * jnp.exp(-self.gain * h) + self.speed * h
        return Range(self.low, self.high, aim, 0.5 * h * self.cap, jnp.zeros_like(x))

    def find_held(self, before: Rows, x: Rows, h: Float[Array, " worlds"], near: Float[Array, " worlds"]) -> Array:
        """Which rows a step of h [s] has left where they are held, at a limit or at their aim, or no more than `near` from it."""
        aim = jnp.clip(self.after(before, h).aim, self.low, self.high)
        at = lambda target: jnp.abs(x - target) <= near[None, None]  # noqa: E731
        return (self.low == self.high) | at(self.low) | at(self.high) | ((self.cap > 0) & at(aim))

    def speeds(self, x: Rows, h: Float[Array, " worlds"], near: Float[Array, " worlds"]) -> "Range":
        """At which speeds a row may change, which is at its limit where it is no more than `near` from it."""
        low, high = self._open(x, near, True)
        h = h[None, None]
        return Range(low, high, self.speed - self.gain * (x - self.goal), 0.5 * h * self.cap, jnp.zeros_like(x))

    def accelerations(self, x: Rows, v: Rows, near: Float[Array, " worlds"], slow: Float[Array, " worlds"]) -> "Range":
        """How its speed v may change: limits hold what rests at them, and a drive that is at its speed keeps it."""
        slow = slow[None, None]
        low, high = self._open(x, near, jnp.abs(v) <= slow)
        ahead = v - (self.speed - self.gain * (x - self.goal))
        aim = jnp.where(ahead < -slow, jnp.inf, jnp.where(ahead > slow, -jnp.inf, -self.gain * v))
        return Range(low, high, aim, self.cap, jnp.zeros_like(x))

    def _open(self, x: Rows, near: Array, rests: Array | bool) -> tuple[Rows, Rows]:
        """Limits of the rate of x: zero at a limit of x, else none."""
        held, near = self.low == self.high, near[None, None]
        low = jnp.where(held | ((x <= self.low + near) & rests), 0.0, -jnp.inf)
        high = jnp.where(held | ((x >= self.high - near) & rests), 0.0, jnp.inf)
        return low.astype(x.dtype), high.astype(x.dtype)


class Range(NamedTuple):
    """What rows may be, by which impulse they are driven to `aim` at most, and by how much a unit impulse moves each, `scale`."""

    low: Rows
    high: Rows
    aim: Rows
    cap: Rows
    scale: Rows

    def find_steps(self, x: Rows, λ: Rows) -> Steps:
        """Where each row is, judged by where it would be without its own impulse."""
        alone, reach, aim = x - self.scale * λ, self.scale * self.cap, jnp.clip(self.aim, self.low, self.high)
        driven = jnp.where(alone <= aim - reach, -1, jnp.where(alone >= aim + reach, 1, 0))
        steps = jnp.where(alone <= self.low - reach, -2, jnp.where(alone >= self.high + reach, 2, driven))
        return steps.astype(jnp.int32)

    def find_target(self, steps: Steps) -> Rows:
        """The value of rows that are held; zero for the others."""
        aim = jnp.clip(self.aim, self.low, self.high)
        return jnp.where(steps == -2, self.low, jnp.where(steps == 2, self.high, jnp.where(steps == 0, aim, 0.0)))

    def find_impulse(self, steps: Steps) -> Rows:
        """The impulse of rows that are not held."""
        return jnp.where(steps == -1, self.cap, jnp.where(steps == 1, -self.cap, 0.0))

    def measure_gap(self, x: Rows, λ: Rows) -> Rows:
        """By how much rows are off: from where they are held, or by their impulse, as far as it moves them."""
        steps = lax.stop_gradient(self.find_steps(x, λ))
        off = self.scale * (λ - self.find_impulse(steps))
        return jnp.where(are_held(steps), x - self.find_target(steps), off)


def are_held(steps: Steps) -> Array:
    """Which rows are held at a value."""
    return steps % 2 == 0


def change_steps(before: Steps, found: Steps, cap: Rows, turn: Array) -> Steps:
    """The steps that were found, or after `FREE_TURNS` the first of each world that differs from what it was before.

    A driven row goes one step of its staircase at a time: an impulse beyond its cap says that the drive gives way, and only
    where that leads says whether a limit is met.
    """
    found = jnp.where(cap > 0, before + jnp.clip(found - before, -1, 1), found)
    differ = (before != found).reshape(-1, found.shape[-1])
    first = (differ & (jnp.cumsum(differ, axis=0) == 1)).reshape(found.shape)
    return jnp.where((turn < FREE_TURNS) | first, found, before)


def spread_bounds(number: Array, shape: tuple[int, ...]) -> Array:
    """A number of joints, `()`, `(joints,)` or, one each in each scene, `(*scenes, joints)`, as `(joints, worlds)`."""
    joints, worlds = shape
    if number.ndim < 2:
        return jnp.broadcast_to(number.reshape(-1, 1), shape)
    wide = jnp.broadcast_to(number, (*number.shape[:-1], joints)).reshape(-1, joints).T
    return jnp.broadcast_to(wide, (joints, worlds))


__all__ = ["Bounds", "Range", "Steps", "are_held", "change_steps", "spread_bounds"]
