"""Where a path first goes through a curved surface of which only the signed distance is known."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.backend import any_lane
from physjax.cubics import Cubic
from physjax.loops import bounded_while_loop
from physjax.particles import Particles
from physjax.physics.contacts.face import Face, LowestPoint
from physjax.vectors import norm, scale

MAX_PATH_SAMPLES = 64
"""Most evaluations along a path; its inverse is the share that a path leaving a surface advances without looking."""
MAX_NEWTON_STRETCH = 4.0
"""Longest Newton step, in units of the distance that is certainly free."""
TOUCH_ROUNDING = 64
"""Units of rounding of place and path length below which a distance is zero."""


def find_path_dip(
    face: Face, t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles, dip: LowestPoint
) -> LowestPoint:
    """The first dip on the cubic path through the ends of a leg: its share of the leg, and the distance; else `dip`.

    Sphere tracing (J. C. Hart, The Visual Computer 12, 1996): from each place the path advances by the signed distance,
    which is free whatever the shape, or by a Newton step where the distance falls slowly. However thin an obstacle is,
    it is met. From there the lowest point is approached in steps that double.
    """
    p = start.position
    path = Cubic.through(p, end.position, scale(dt, start.velocity), scale(dt, end.velocity))
    signed_distance = lambda s: face.signed_distance(t + s * dt, path.at(s))  # noqa: E731
    far = jnp.maximum(bound_path_length(face, t, dt, start, end), float(jnp.finfo(p.dtype).tiny))
    touch = TOUCH_ROUNDING * float(jnp.finfo(p.dtype).eps) * (norm(p) + far)
    met = _advance_to_surface(signed_distance, far, touch)
    s, d = _descend_to_lowest_point(signed_distance, met, touch)
    found = (d < 0) & (s > 0)
    return jnp.where(found, s, dip[0]), jnp.where(found, d, dip[1])


def _advance_to_surface(signed_distance: Callable[[Array], Array], far: Array, touch: Array) -> tuple[Array, ...]:
    """The first share of a path of length `far` at which the distance is less than `touch` and falls, else 1.

    Returns the share, the distance there and its slope along the path.
    """
    with_slope = lambda s: jax.jvp(signed_distance, (s,), (jnp.ones_like(s),))  # noqa: E731

    def advance(carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        s, d, slope, _ = carry
        free = jnp.maximum(d, 0.0) / far
        newton = jnp.clip(d / jnp.where(slope < 0, -slope, 1.0), free, MAX_NEWTON_STRETCH * free)
        # a path that leaves the surface has no distance to advance by yet, and needs a smallest step
        s = jnp.minimum(s + jnp.where(slope < 0, newton, jnp.maximum(free, 1 / MAX_PATH_SAMPLES)), 1.0)
        d, slope = with_slope(s)
        return s, d, slope, (s < 1) & ((d > touch) | (slope >= 0))

    begin = jnp.zeros_like(far)
    d, slope = with_slope(begin)
    s, d, slope, _ = bounded_while_loop(
        lambda carry: any_lane(carry[-1]),
        lambda carry: jax.tree.map(lambda new, old: jnp.where(carry[-1], new, old), advance(carry), carry),
        (begin, d, slope, (d > touch) | (slope >= 0)),
        most=MAX_PATH_SAMPLES,
    )
    return s, d, slope


def _descend_to_lowest_point(
    signed_distance: Callable[[Array], Array], met: tuple[Array, ...], touch: Array
) -> LowestPoint:
    """From where a path meets the surface on, the first share at which the distance rises again.

    The first stride is what takes the path from `touch` above zero to below it; then strides double, which needs few
    evaluations and cannot step over a dip that is wider than the way into it.
    """
    s, d, slope = met
    stride = jnp.clip(touch / jnp.where(slope < 0, -slope, 1.0), 0.0, 1 / MAX_PATH_SAMPLES)

    def descend(carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        s, d, stride, _ = carry
        further = jnp.minimum(s + stride, 1.0)
        there = signed_distance(further)
        lower = carry[-1] & (there < d)
        return jnp.where(lower, further, s), jnp.where(lower, there, d), 2 * stride, lower

    s, d, _, _ = bounded_while_loop(
        lambda carry: any_lane(carry[-1]), descend, (s, d, stride, (s < 1) & (slope < 0)), most=MAX_PATH_SAMPLES
    )
    return s, d


def bound_path_length(
    face: Face, t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles
) -> Float[Array, "*lanes"]:
    """Upper bound of the length of the cubic path through the ends of a leg, relative to the surface [m]."""
    u, w = (scale(dt, face.relative(at, *state)) for at, state in ((t, start), (t + dt, end)))
    chord = end.position - start.position + (u - scale(dt, start.velocity))
    return jnp.maximum(jnp.maximum(norm(u), norm(w)), norm(3.0 * chord - u - w))
