"""How much of a step a force with a beginning and an end acts, by exact differences of times.

A float32 clock after a day is known to 8 ms, so times are never compared as floats inside a run: a `Moment` counts
steps and keeps what rounding has taken, and a difference is formed before it is rounded.
"""

from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.checks import Numbers
from physjax.loops import Moment, Time, cast_remainder
from physjax.particles import Particles
from physjax.vectors import add_trailing_axes


@runtime_checkable
class Pulse(Protocol):
    """A force that begins `at` a time [s] and has a `duration` [s]; `at_rest` is what float32 cannot hold of `at`."""

    at: Numbers
    duration: Numbers
    at_rest: Numbers


def align_with_lanes(number: ArrayLike, state: Particles) -> Array:
    """A number per scene as one that meets numbers per lane; a number for all stays a scalar."""
    return add_trailing_axes(jnp.asarray(number, state.dtype), len(state.lanes))


def align_moment(t: Time, dt: ArrayLike, state: Particles) -> tuple[Moment, Array]:
    """A time [s] and the step from there [s], so that both meet numbers per lane."""
    moment = Moment.of(t, dt, state.dtype)
    return jax.tree.map(lambda number: align_with_lanes(number, state), moment), align_with_lanes(dt, state)


def is_acting(pulse: Pulse, t: Time, state: Particles) -> Array:
    """Whether a pulse acts at the time t [s], per lane."""
    if isinstance(t, Moment):
        ahead = align_moment(t, 1.0, state)[0].time_until_on_grid(pulse.at, cast_remainder(pulse.at, pulse.at_rest))
        return (ahead <= 0) & (ahead + pulse.duration > 0)
    t = align_with_lanes(t, state)
    return (pulse.at <= t) & (t < pulse.at + pulse.duration)


def acting_share(pulse: Pulse, t: Time, dt: ArrayLike, state: Particles) -> Array:
    """The share [1] of the step from t to t + dt during which a pulse acts, per lane."""
    t, dt = align_moment(t, dt, state)
    begins = t.time_until_on_grid(pulse.at, cast_remainder(pulse.at, pulse.at_rest))
    return share_before(begins + pulse.duration, dt, pulse.duration) - share_before(begins, dt, dt)


def share_before(ahead: Array, dt: Array, size: Array) -> Array:
    """The share [1] of a step of dt [s] that lies before a time `ahead` of its start [s], from 0 to 1.

    `ahead` is known to the rounding of a number as large as `size` [s]; a time that differs from an end of the step by
    no more than that is that end, and the share exactly 0 or 1. Its derivative at the start of a step is the one from
    the right, at the end of a step zero: a time at which two steps meet then counts once.
    """
    share = ahead / dt
    whole = jnp.round(share)
    rounding = 2 * float(jnp.finfo(share.dtype).eps) * (1 + size / dt)
    # added as a constant, so that the share keeps its derivative by the time
    move = jnp.where(jnp.abs(share - whole) <= rounding, whole - share, 0.0)
    share = share + lax.stop_gradient(move)
    # not `clip`, which halves the derivative at its bounds
    return jnp.where(share < 0, 0.0, jnp.where(share < 1, share, 1.0))
