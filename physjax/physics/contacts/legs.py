"""The legs of a step that is cut at its impacts: what particles and rigid bodies have in common.

A step is flown leg by leg, from one impact to the next. Every lane has its own legs, and all lanes are computed as long
as any of them has some of the step left.
"""

from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool

from physjax.loops import Time
from physjax.scene import Scene
from physjax.vectors import dot

MAX_IMPACTS = 64
"""Impacts that a particle may have within one step; after the last it stays where it is, with its velocity, until the next."""
MAX_DIFFERENTIATED_IMPACTS = 8
"""Impacts of one step that have derivatives: a step keeps room for all of them in reverse mode. With more they are NaN."""
SHORTEST_FLIGHT_SHARE = 0.25
"""A bounce whose flight would be shorter than this share of the step is the last: what would follow is summed up."""
OVERRUN_ROUNDING = 64
"""Units of rounding of its place by which a waiting lane may be on the wrong side of a surface."""

Motion = Callable[[Scene, Time, ArrayLike], Scene]
"""What moves a scene for a time dt [s] from t [s] on: a method's step, or a response around it."""
Tree = TypeVar("Tree")
State = TypeVar("State")


class Flight(NamedTuple, Generic[State]):
    """A leg of a step, from one impact to the next, as it was flown.

    `before` is the state that the impact before it left; `scene` begins with that state put onto the surfaces, and
    carries their reactions; `leg_start` [s] and `duration` [s] are per lane; `end` is where the method arrived, `after`
    the state after the impact there. Lanes that are not `active` had arrived at the end of the step before.
    """

    before: State
    scene: Scene
    leg_start: Time
    duration: Array
    end: State
    after: State
    active: Bool[Array, "*lanes"] | None


def shortest_duration(dt: Array) -> Array:
    """The shortest leg [s] of a step dt [s]: not quite zero, because forces that jump in time are averaged over it."""
    return float(jnp.finfo(dt.dtype).eps) * dt


def choose_lanes(flag: Array, a: Tree, b: Tree) -> Tree:
    """Lane by lane a where flagged, else b, for trees of numbers and vectors per lane."""
    pick = lambda x, y: jnp.where(flag if x.ndim == flag.ndim else flag[..., None], x, y)  # noqa: E731
    return jax.tree.map(pick, a, b)


def has_moved_over(before: Array, after: Array, position: Array) -> Bool[Array, "..."]:
    """Whether a surface is over a place that it was not over before, given its signed distances [m] then and now."""
    before, after, x = lax.stop_gradient((before, after, position))
    rounding = OVERRUN_ROUNDING * float(jnp.finfo(x.dtype).eps) * jnp.sqrt(dot(x, x))
    return (after < -rounding) & (after < before - rounding)


def invalidate_lanes(overrun: Bool[Array, "*lanes"], state: Tree) -> Tree:
    """The state with NaN in the lanes that were overrun: their status reports it, and other lanes go on."""
    return jax.tree.map(lambda leaf: jnp.where(overrun[..., None], jnp.nan, leaf), state)
