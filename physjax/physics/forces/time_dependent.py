"""Forces that follow the clock: the same at all times, for a while, or as given over time."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.checks import quantity, unchecked_quantity
from physjax.loops import Moment, Time, cast_remainder, float32_remainder, to_float_time
from physjax.particles import Particles
from physjax.parts import Force
from physjax.vectors import broadcast_vector, dot, scale


class Constant(Force):
    """The same force at all times: F = F₀ [N].

    Example:
        >>> print(forces.Constant((1.0, -2.0))(0.0, ball, shot.mass))
        [ 1. -2.]
    """

    dissipative_symmetric: ClassVar[bool] = True
    force: Float[Array, "..."] = quantity("force", "N", kind="vector")

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """F₀ [N]."""
        return broadcast_vector(self.force, state.velocity)

    def potential(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes"]:
        """-F₀·x [J]."""
        return -dot(broadcast_vector(self.force, state.position), state.position)


class Kick(Force):
    """A force for a while, as when a ball is kicked: impulse [N s] = force × duration, from the time `at` [s] on.

    A step feels its mean over the step, so that the whole impulse arrives under every method and at every step size.
    A lane whose impulse is zero is not kicked.

    Example:
        >>> kick = forces.Kick(impulse=(6.0, 0.0), at=0.0, duration=0.5)
        >>> print(kick(0.1, ball, shot.mass), kick(0.6, ball, shot.mass))
        [12.  0.] [0. 0.]
    """

    sees_moments: ClassVar[bool] = True
    impulse: Float[Array, "..."] = quantity("impulse", "N s", kind="vector")
    at: Float[Array, "..."] = quantity("start of the kick", "s")
    duration: Float[Array, "..."] = quantity("duration of the kick", "s", above=0)
    at_rest: Float[Array, "..."] | None = unchecked_quantity(
        "rest of the start", "s", per="memory", default=None, repr=False, kw_only=True
    )

    def __post_init__(self):
        self.at_rest = float32_remainder(self.at, self.at_rest)

    def __call__(self, t: Time, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """impulse/duration while the kick lasts [N]."""
        share = jnp.where(is_acting(self, t, state), 1 / self.duration, 0.0)
        return scale(share, broadcast_vector(self.impulse, state.velocity))

    def averaged_over_step(self, t: Time, dt: ArrayLike, state: Particles) -> Constant:
        """The mean of the force over the step from t to t + dt."""
        share = acting_share(self, t, dt, state)
        return Constant(scale(share / self.duration, broadcast_vector(self.impulse, state.velocity)))

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

    dissipative_symmetric: ClassVar[bool] = True
    sees_moments: ClassVar[bool] = True
    values: Float[Array, "*lanes pieces dim"] = quantity("force over time", "N", kind="vector", per="table")
    duration: Float[Array, "..."] = quantity("duration", "s", above=0)
    at: Float[Array, "..."] = quantity("start", "s", default=0.0)
    linear: bool = eqx.field(static=True, default=False)
    at_rest: Float[Array, "..."] | None = unchecked_quantity(
        "rest of the start", "s", per="memory", default=None, repr=False, kw_only=True
    )

    def __post_init__(self):
        self.at_rest = float32_remainder(self.at, self.at_rest)

    def __check_init__(self):
        least = 1 + self.linear
        if self.values.ndim < 2 or self.values.shape[-2] < least:
            raise ValueError(
                f"force over time [N]: got the shape {self.values.shape}, expected (pieces, dim) or (*lanes, pieces, dim) "
                f"with at least {least} of them."
            )

    def __call__(self, t: Time, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """The force at the time t [N]."""
        t, knots = self._align_time_and_knots(to_float_time(t), state)
        lasts = (knots[..., 0] <= t) & (t < knots[..., -1])
        if self.linear:
            return scale(lasts.astype(t.dtype), self._interpolate(t, state))
        here = (knots[..., :-1] <= t[..., None]) & (t[..., None] < knots[..., 1:])
        return self._weighted_sum(here.astype(t.dtype), state)

    def averaged_over_step(self, t: Time, dt: ArrayLike, state: Particles) -> Force:
        """The mean of the force over the step from t to t + dt; if it is linear, the force itself where the step is in it."""
        t, dt = align_moment(t, dt, state)
        begins, duration, dt = jnp.broadcast_arrays(
            t.time_until_on_grid(self.at, cast_remainder(self.at, self.at_rest)), self.duration, dt
        )
        before = share_before(self._knot_times(begins, duration), dt[..., None], duration[..., None])
        if self.linear:
            return _LinearControlStep(self, before[..., -1] - before[..., 0])
        return Constant(self._weighted_sum(before[..., 1:] - before[..., :-1], state))

    def discontinuities(self) -> tuple[Float[Array, "..."], ...]:
        """Times at which the force jumps or bends [s]."""
        knots = self._knot_times(self.at, self.duration)
        return (knots if knots.ndim > 1 else knots[None],)  # the same for all lanes, however many knots there are

    def _knot_times(self, at: Array, duration: Array) -> Array:
        """When the pieces begin, and when the last one ends [s], behind the axes of the lanes."""
        pieces = self.values.shape[-2] - self.linear
        shares = jnp.arange(pieces + 1, dtype=at.dtype).reshape((1,) * at.ndim + (-1,)) / pieces
        return at[..., None] + duration[..., None] * shares

    def _align_time_and_knots(self, t: ArrayLike, state: Particles) -> tuple[Array, Array]:
        t, at, duration = jnp.broadcast_arrays(align_with_lanes(t, state), self.at, self.duration)
        return t, self._knot_times(at, duration)

    def _interpolate(self, t: Time, state: Particles) -> Array:
        """The straight line between two values; the first and the last one go on."""
        ahead = align_moment(t, 1.0, state)[0].time_until(self.at, cast_remainder(self.at, self.at_rest))
        ahead, duration = jnp.broadcast_arrays(ahead, self.duration)
        count = self.values.shape[-2]
        place = jnp.clip(-ahead / duration, 0.0, 1.0) * (count - 1)
        numbers = jnp.arange(count, dtype=place.dtype).reshape((1,) * place.ndim + (-1,))
        return self._weighted_sum(jnp.maximum(1 - jnp.abs(place[..., None] - numbers), 0.0), state)

    def _weighted_sum(self, weights: Array, state: Particles) -> Array:
        """The sum of the values, each with its weight, for every lane [N]."""
        shape = jnp.broadcast_shapes(weights.shape, self.values.shape[:-1])
        weights = jnp.broadcast_to(weights, shape)[..., None]
        values = jnp.broadcast_to(self.values, (*shape, self.values.shape[-1]))
        return broadcast_vector(jnp.sum(weights * values, axis=-2), state.velocity)


class _LinearControlStep(Force):
    """A linear control as a step sees it that lies in it by a share."""

    dissipative_symmetric: ClassVar[bool] = True
    sees_moments: ClassVar[bool] = True
    control: Control
    share: Float[Array, "..."] = unchecked_quantity("share of the step", per="memory")

    def __call__(self, t: Time, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        return scale(self.share, self.control._interpolate(t, state))


def align_with_lanes(number: ArrayLike, state: Particles) -> Array:
    """A number that every lane has in common, or the lanes of a scene, so that it meets numbers shaped like the lanes."""
    number = jnp.asarray(number, state.dtype)
    return number.reshape(number.shape + (1,) * (len(state.lanes) - number.ndim)) if number.ndim else number


def align_moment(t: Time, dt: ArrayLike, state: Particles) -> tuple[Moment, Array]:
    """A time, and how long a step takes from there, so that they meet numbers shaped like the lanes."""
    t = jax.tree.map(lambda number: align_with_lanes(number, state), Moment.of(t, dt, state.dtype))
    return t, align_with_lanes(dt, state)


def is_acting(force: Any, t: Time, state: Particles) -> Array:
    """Whether a force acts that begins `at` a time and has a `duration`."""
    if isinstance(t, Moment):
        ahead = align_moment(t, 1.0, state)[0].time_until_on_grid(force.at, cast_remainder(force.at, force.at_rest))
        return (ahead <= 0) & (ahead + force.duration > 0)
    t = align_with_lanes(t, state)
    return (force.at <= t) & (t < force.at + force.duration)


def acting_share(force: Any, t: Time, dt: ArrayLike, state: Particles) -> Array:
    """The share of the step from t to t + dt in which a force lasts that begins `at` a time and has a `duration`."""
    t, dt = align_moment(t, dt, state)
    begins = t.time_until_on_grid(force.at, cast_remainder(force.at, force.at_rest))
    return share_before(begins + force.duration, dt, force.duration) - share_before(begins, dt, dt)


def share_before(ahead: Array, dt: Array, size: Array) -> Array:
    """The share of a step that lies before a time so far ahead of its start; exactly 0 or 1 if it is one of its ends.

    The time is known to rounding of a `size` [s]. At the start of a step derivatives are those of a time within it, at
    the end those of a time that is over: a time that is both counts once.
    """
    share = ahead / dt
    whole = jnp.round(share)
    rounding = 2 * float(jnp.finfo(share.dtype).eps) * (1 + size / dt)
    move = jnp.where(jnp.abs(share - whole) <= rounding, whole - share, 0.0)
    share = share + lax.stop_gradient(move)
    return jnp.where(share < 0, 0.0, jnp.where(share < 1, share, 1.0))
