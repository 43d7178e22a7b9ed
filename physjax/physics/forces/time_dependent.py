"""Forces given as functions of time: constant, a kick or a blast that lasts for a while, a table of values."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.checks import Numbers, quantity, unchecked_quantity
from physjax.loops import Time, cast_remainder, float32_remainder, to_float_time
from physjax.particles import Particles
from physjax.parts import Force
from physjax.physics.forces.step_shares import acting_share, align_moment, align_with_lanes, is_acting, share_before
from physjax.vectors import add_leading_axes, broadcast_vector, dot, scale, unit


class Constant(Force):
    """A constant force: F = F₀ [N], `(dim,)` or one per lane.

    Example:
        >>> print(forces.Constant((1.0, -2.0))(0.0, ball, shot.mass))
        [ 1. -2.]
    """

    dissipative_symmetric: ClassVar[bool] = True
    force: Numbers = quantity("force", "N", kind="vector")

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """F₀ [N]."""
        return broadcast_vector(self.force, state.velocity)

    def potential(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes"]:
        """-F₀·x [J]."""
        return -dot(broadcast_vector(self.force, state.position), state.position)


class Kick(Force):
    """A constant force from the time `at` [s] on for a `duration` [s]: F = impulse/duration, as when a ball is kicked.

    `impulse` [N s] is `(dim,)` or one per lane. Steps use the mean of the force over the step, so that the whole impulse
    arrives under every method and at every step size.

    Example:
        >>> kick = forces.Kick(impulse=(6.0, 0.0), at=0.0, duration=0.5)
        >>> print(kick(0.1, ball, shot.mass), kick(0.6, ball, shot.mass))
        [12.  0.] [0. 0.]
    """

    sees_moments: ClassVar[bool] = True
    impulse: Numbers = quantity("impulse", "N s", kind="vector")
    at: Numbers = quantity("start of the kick", "s")
    duration: Numbers = quantity("duration of the kick", "s", above=0)
    at_rest: Numbers = unchecked_quantity(
        "rest of the start", "s", per="memory", default=None, repr=False, kw_only=True
    )

    def __post_init__(self):
        self.at_rest = float32_remainder(self.at, self.at_rest)

    def __call__(self, t: Time, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """impulse/duration while the kick lasts, else zero [N]."""
        share = jnp.where(is_acting(self, t, state), 1 / self.duration, 0.0)
        return scale(share, broadcast_vector(self.impulse, state.velocity))

    def averaged_over_step(self, t: Time, dt: ArrayLike, state: Particles) -> Constant:
        """Its mean over the step from t to t + dt [s]."""
        share = acting_share(self, t, dt, state)
        return Constant(scale(share / self.duration, broadcast_vector(self.impulse, state.velocity)))

    def discontinuities(self) -> tuple[Float[Array, "..."], ...]:
        """Start and end [s], at which the force jumps: an adaptive solver that does not stop there may step over it all."""
        return self.at, self.at + self.duration


class Blast(Force):
    """An explosion: an impulse J/(1 + (d/r)²) [N s] away from the `center` at the distance d [m], spread over a `duration` [s].

    At the `reach` r [m] it is half of J, and far out it falls as 1/d², like a spherical wave. `impulse` J is a number, or
    one per lane (a plate that turns its face to the blast gets more). A lane at the center itself gets none. While the
    blast lasts, d is measured to where the lane is. As with `Kick`, steps use the mean of the force over the step.

    Example:
        >>> blast = forces.Blast(center=(0.0, 9.0), impulse=4.0, reach=1.0, at=0.0, duration=0.5)
        >>> print(blast(0.1, ball, shot.mass))
        [0. 4.]
    """

    sees_moments: ClassVar[bool] = True
    center: Numbers = quantity("center of the blast", "m", kind="place")
    impulse: Numbers = quantity("impulse", "N s")
    reach: Numbers = quantity("reach of the blast", "m", above=0)
    at: Numbers = quantity("start of the blast", "s")
    duration: Numbers = quantity("duration of the blast", "s", above=0)
    at_rest: Numbers = unchecked_quantity(
        "rest of the start", "s", per="memory", default=None, repr=False, kw_only=True
    )

    def __post_init__(self):
        self.at_rest = float32_remainder(self.at, self.at_rest)

    def __call__(self, t: Time, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """J/(1 + (d/r)²)/duration away from the center while the blast lasts, else zero [N]."""
        return scale(jnp.where(is_acting(self, t, state), 1 / self.duration, 0.0), self.lane_impulse(state))

    def lane_impulse(self, state: Particles) -> Float[Array, "*lanes dim"]:
        """The impulse that each lane would get at its present place [N s]."""
        d = state.position - broadcast_vector(self.center, state.position)
        return scale(self.impulse / (1 + dot(d, d) / self.reach**2), unit(d))

    def averaged_over_step(self, t: Time, dt: ArrayLike, state: Particles) -> Force:
        """Its mean over the step from t to t + dt [s]; the place stays that of each stage."""
        return _AveragedBlast(self, acting_share(self, t, dt, state) / self.duration)

    def discontinuities(self) -> tuple[Float[Array, "..."], ...]:
        """Start and end [s], at which the force jumps."""
        return self.at, self.at + self.duration


class _AveragedBlast(Force):
    """A blast during one step: a constant `rate` of its impulses [1/s], in the direction of the moment."""

    blast: Blast
    rate: Numbers = unchecked_quantity("blasts a second", "1/s", per="memory")

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        return scale(self.rate, self.blast.lane_impulse(state))


class Control(Force):
    """A force tabulated over time, as of an engine or a hand: `values` [N] over a `duration` [s] from the time `at` [s] on.

    `values` is `(pieces, dim)` for all lanes or `(*lanes, pieces, dim)`: equally long pieces of constant force. With
    `linear=True` the values are knots instead, the first at the start and the last at the end, joined by straight lines.
    Before and after, the force is zero. Steps use the mean of constant pieces, so that the whole impulse arrives at every
    step size; methods keep their order where pieces end with steps. The cost of a step grows with the number of values,
    with `linear` once per force evaluation. Raises ValueError for other shapes.

    Example:
        >>> push = forces.Control([[1.0, 0.0], [3.0, 0.0]], duration=2.0)
        >>> print(push(0.5, ball, shot.mass), push(1.5, ball, shot.mass))
        [1. 0.] [3. 0.]
    """

    dissipative_symmetric: ClassVar[bool] = True
    sees_moments: ClassVar[bool] = True
    values: Float[Array, "*lanes pieces dim"] = quantity("force over time", "N", kind="vector", per="table")
    duration: Numbers = quantity("duration", "s", above=0)
    at: Numbers = quantity("start", "s", default=0.0)
    linear: bool = eqx.field(static=True, default=False)
    at_rest: Numbers = unchecked_quantity(
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
            return scale(lasts.astype(t.dtype), self.interpolate(t, state))
        here = (knots[..., :-1] <= t[..., None]) & (t[..., None] < knots[..., 1:])
        return self._weighted_sum(here.astype(t.dtype), state)

    def averaged_over_step(self, t: Time, dt: ArrayLike, state: Particles) -> Force:
        """Its mean over the step from t to t + dt [s]; of linear pieces the force itself, times the share in which it acts."""
        t, dt = align_moment(t, dt, state)
        begins, duration, dt = jnp.broadcast_arrays(
            t.time_until_on_grid(self.at, cast_remainder(self.at, self.at_rest)), self.duration, dt
        )
        before = share_before(self._knot_times(begins, duration), dt[..., None], duration[..., None])
        if self.linear:
            return _LinearControlStep(self, before[..., -1] - before[..., 0])
        return Constant(self._weighted_sum(before[..., 1:] - before[..., :-1], state))

    def discontinuities(self) -> tuple[Float[Array, "..."], ...]:
        """Times of the knots [s], at which the force or its slope jumps."""
        knots = self._knot_times(self.at, self.duration)
        # an axis in front: `(knots,)` would read as one time per lane where there are as many lanes as knots
        return (knots if knots.ndim > 1 else knots[None],)

    def _knot_times(self, at: Array, duration: Array) -> Array:
        """When the pieces begin, and when the last one ends [s], `(*lanes, pieces + 1)`."""
        pieces = self.values.shape[-2] - self.linear
        shares = add_leading_axes(jnp.arange(pieces + 1, dtype=at.dtype), at.ndim + 1) / pieces
        return at[..., None] + duration[..., None] * shares

    def _align_time_and_knots(self, t: ArrayLike, state: Particles) -> tuple[Array, Array]:
        """The time and those of the knots [s], so that they can be compared lane by lane."""
        t, at, duration = jnp.broadcast_arrays(align_with_lanes(t, state), self.at, self.duration)
        return t, self._knot_times(at, duration)

    def interpolate(self, t: Time, state: Particles) -> Array:
        """The value at a time on the straight lines between the knots, constant beyond the first and the last."""
        ahead = align_moment(t, 1.0, state)[0].time_until(self.at, cast_remainder(self.at, self.at_rest))
        ahead, duration = jnp.broadcast_arrays(ahead, self.duration)
        count = self.values.shape[-2]
        place = jnp.clip(-ahead / duration, 0.0, 1.0) * (count - 1)
        numbers = add_leading_axes(jnp.arange(count, dtype=place.dtype), place.ndim + 1)
        # weights of all knots instead of two looked up: a gather per lane costs more than a short sum
        return self._weighted_sum(jnp.maximum(1 - jnp.abs(place[..., None] - numbers), 0.0), state)

    def _weighted_sum(self, weights: Array, state: Particles) -> Array:
        """Σ weight·value over the pieces, per lane [N]."""
        shape = jnp.broadcast_shapes(weights.shape, self.values.shape[:-1])
        weights = jnp.broadcast_to(weights, shape)[..., None]
        values = jnp.broadcast_to(self.values, (*shape, self.values.shape[-1]))
        return broadcast_vector(jnp.sum(weights * values, axis=-2), state.velocity)


class _LinearControlStep(Force):
    """A linear control in a step of which it acts for a share only: the value at each stage, times that share."""

    dissipative_symmetric: ClassVar[bool] = True
    sees_moments: ClassVar[bool] = True
    control: Control
    share: Numbers = unchecked_quantity("share of the step", per="memory")

    def __call__(self, t: Time, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        return scale(self.share, self.control.interpolate(t, state))


__all__ = ["Blast", "Constant", "Control", "Kick"]


def __dir__() -> list[str]:
    return __all__
