"""Forces that follow the clock: the same at all times, for a while, or as given over time."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.checks import declared, quantity
from physjax.scene import Force, Particles
from physjax.vectors import dot, over, scale


class Constant(Force):
    """The same force at all times: F = F₀ [N].

    Example:
        >>> print(forces.Constant((1.0, -2.0))(0.0, ball, shot.mass))
        [ 1. -2.]
    """

    definite: ClassVar[bool] = True
    force: Float[Array, "..."] = quantity("force", "N", kind="vector")

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """F₀ [N]."""
        return over(self.force, state.velocity)

    def potential(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes"]:
        """-F₀·x [J]."""
        return -dot(over(self.force, state.position), state.position)


class Kick(Force):
    """A force for a while, as when a ball is kicked: impulse [N s] = force × duration, from the time `at` [s] on.

    A step feels its mean over the step, so that the whole impulse arrives under every method and at every step size.
    A lane whose impulse is zero is not kicked.

    Example:
        >>> kick = forces.Kick(impulse=(6.0, 0.0), at=0.0, duration=0.5)
        >>> print(kick(0.1, ball, shot.mass), kick(0.6, ball, shot.mass))
        [12.  0.] [0. 0.]
    """

    impulse: Float[Array, "..."] = quantity("impulse", "N s", kind="vector")
    at: Float[Array, "..."] = quantity("start of the kick", "s")
    duration: Float[Array, "..."] = quantity("duration of the kick", "s", above=0)

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """impulse/duration while the kick lasts [N]."""
        t = per_lane(t, state)
        lasts = (self.at <= t) & (t < self.at + self.duration)
        return scale(jnp.where(lasts, 1 / self.duration, 0.0), over(self.impulse, state.velocity))

    def during(self, t: ArrayLike, dt: ArrayLike, state: Particles) -> Constant:
        """The mean of the force over the step from t to t + dt."""
        t, dt = per_lane(t, state), per_lane(dt, state)
        share = share_before(self.at + self.duration, t, dt) - share_before(self.at, t, dt)
        return Constant(scale(share / self.duration, over(self.impulse, state.velocity)))

    def discontinuities(self) -> tuple[Float[Array, "..."], ...]:
        """Times at which the force jumps [s]; an adaptive solver must stop there, or it may step over the whole kick."""
        return self.at, self.at + self.duration


class Control(Force):
    """A force given over time, as by an engine or a hand: `values` [N] over a `duration` [s] from the time `at` [s] on.

    `values` is `(pieces, dim)` for all lanes or `(*lanes, pieces, dim)`. The pieces are equally long and the force is
    constant in each; with `linear=True` it runs straight from each value to the next instead, the first at the start,
    the last at the end. Before and after there is none. Of constant pieces a step feels its mean, so that all of the
    impulse arrives at every step size; methods keep their order where steps end at the ends of the pieces. A step reads
    every value once (with `linear`, once a force evaluation). Raises ValueError for shapes that are none of these.

    Example:
        >>> push = forces.Control([[1.0, 0.0], [3.0, 0.0]], duration=2.0)
        >>> print(push(0.5, ball, shot.mass), push(1.5, ball, shot.mass))
        [1. 0.] [3. 0.]
    """

    definite: ClassVar[bool] = True
    values: Float[Array, "*lanes pieces dim"] = quantity("force over time", "N", kind="vector", per="table")
    duration: Float[Array, "..."] = quantity("duration", "s", above=0)
    at: Float[Array, "..."] = quantity("start", "s", default=0.0)
    linear: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        least = 1 + self.linear
        if self.values.ndim < 2 or self.values.shape[-2] < least:
            raise ValueError(
                f"force over time [N]: got the shape {self.values.shape}, expected (pieces, dim) or (*lanes, pieces, dim) "
                f"with at least {least} of them."
            )

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """The force at the time t [N]."""
        t, knots = self._clock(t, state)
        lasts = (knots[..., 0] <= t) & (t < knots[..., -1])
        if self.linear:
            return scale(lasts.astype(t.dtype), self._between(t, state))
        here = (knots[..., :-1] <= t[..., None]) & (t[..., None] < knots[..., 1:])
        return self._weighed(here.astype(t.dtype), state)

    def during(self, t: ArrayLike, dt: ArrayLike, state: Particles) -> Force:
        """The mean of the force over the step from t to t + dt; if it is linear, the force itself where the step is in it."""
        t, knots = self._clock(t, state)
        dt = jnp.broadcast_to(per_lane(dt, state), t.shape)
        before = share_before(knots, t[..., None], dt[..., None])
        if self.linear:
            return _Ramp(self, before[..., -1] - before[..., 0])
        return Constant(self._weighed(before[..., 1:] - before[..., :-1], state))

    def discontinuities(self) -> tuple[Float[Array, "..."], ...]:
        """Times at which the force jumps or bends [s]."""
        knots = self._knots(self.at, self.duration)
        return (knots if knots.ndim > 1 else knots[None],)  # the same for all lanes, however many knots there are

    def _knots(self, at: Array, duration: Array) -> Array:
        """When the pieces begin, and when the last one ends [s], behind the axes of the lanes."""
        pieces = self.values.shape[-2] - self.linear
        shares = jnp.arange(pieces + 1, dtype=at.dtype).reshape((1,) * at.ndim + (-1,)) / pieces
        return at[..., None] + duration[..., None] * shares

    def _clock(self, t: ArrayLike, state: Particles) -> tuple[Array, Array]:
        t, at, duration = jnp.broadcast_arrays(per_lane(t, state), self.at, self.duration)
        return t, self._knots(at, duration)

    def _between(self, t: ArrayLike, state: Particles) -> Array:
        """The straight line between two values; the first and the last one go on."""
        t, at, duration = jnp.broadcast_arrays(per_lane(t, state), self.at, self.duration)
        count = self.values.shape[-2]
        place = jnp.clip((t - at) / duration, 0.0, 1.0) * (count - 1)
        numbers = jnp.arange(count, dtype=t.dtype).reshape((1,) * t.ndim + (-1,))
        return self._weighed(jnp.maximum(1 - jnp.abs(place[..., None] - numbers), 0.0), state)

    def _weighed(self, weights: Array, state: Particles) -> Array:
        """The sum of the values, each with its weight, for every lane [N]."""
        shape = jnp.broadcast_shapes(weights.shape, self.values.shape[:-1])
        weights = jnp.broadcast_to(weights, shape)[..., None]
        values = jnp.broadcast_to(self.values, (*shape, self.values.shape[-1]))
        return over(jnp.sum(weights * values, axis=-2), state.velocity)


class _Ramp(Force):
    """A linear control as a step sees it that lies in it by a share."""

    definite: ClassVar[bool] = True
    control: Control
    share: Float[Array, "..."] = declared("share of the step", per="memory")

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        return scale(self.share, self.control._between(t, state))


def per_lane(number: ArrayLike, state: Particles) -> Array:
    """A number that every lane has in common, or the lanes of a scene, so that it meets numbers shaped like the lanes."""
    number = jnp.asarray(number, state.dtype)
    return number.reshape(number.shape + (1,) * (len(state.lanes) - number.ndim)) if number.ndim else number


def share_before(edge: Array, t: Array, dt: Array) -> Array:
    """The share of the step from t to t + dt that lies before a time; exactly 0 or 1 if it is one of the step's ends."""
    share = (edge - t) / dt
    whole = jnp.round(share)
    rounding = 4 * jnp.finfo(share.dtype).eps * (1 + jnp.abs(t) / dt)
    return jnp.clip(jnp.where(jnp.abs(share - whole) <= rounding, whole, share), 0.0, 1.0)
