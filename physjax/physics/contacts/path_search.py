"""Where a path first goes through a surface of which no more is known than the distance to it."""

from typing import Any

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.backend import any_lane, bounded_while_loop
from physjax.cubics import Cubic
from physjax.particles import Particles
from physjax.vectors import norm, scale

MAX_PATH_SAMPLES = 64
"""Most places of a path that are looked at, and the share of it that is gone over unseen from where it leaves a surface."""
MAX_NEWTON_STRETCH = 4.0
"""How much farther than the distance a path goes on where its slope promises that nothing is there."""


def find_path_dip(
    face: Any, t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles, dip: tuple[Array, Array]
) -> tuple[Array, Array]:
    """The first dip of the gap on the cubic path through the ends of a leg, as a share of it, and its gap; else `dip`.

    From each place the path goes on as far as the distance [m] says that the way is free, or by a Newton step where the
    gap falls slowly (J. C. Hart, The Visual Computer 12, 1996): however thin what is in the way, it is met. Then down to
    where the gap is least, in steps that double.
    """
    p = start.position
    path = Cubic.through(p, end.position, scale(dt, start.velocity), scale(dt, end.velocity))
    signed_distance = lambda s: face.signed_distance(t + s * dt, path.at(s))  # noqa: E731
    falling = lambda s: jax.jvp(signed_distance, (s,), (jnp.ones_like(s),))  # noqa: E731
    far = jnp.maximum(bound_path_length(face, dt, start, end), float(jnp.finfo(p.dtype).tiny))
    touch = 64 * float(jnp.finfo(p.dtype).eps) * (norm(p) + far)

    def go_on(carry):
        s, d, slope, _ = carry
        free = jnp.maximum(d, 0.0) / far
        newton = jnp.clip(d / jnp.where(slope < 0, -slope, 1.0), free, MAX_NEWTON_STRETCH * free)
        s = jnp.minimum(s + jnp.where(slope < 0, newton, jnp.maximum(free, 1 / MAX_PATH_SAMPLES)), 1.0)
        d, slope = falling(s)
        return s, d, slope, (s < 1) & ((d > touch) | (slope >= 0))

    begin = jnp.zeros_like(far)
    d, slope = falling(begin)
    s, d, slope, _ = bounded_while_loop(
        lambda carry: any_lane(carry[-1]),
        lambda carry: jax.tree.map(lambda new, old: jnp.where(carry[-1], new, old), go_on(carry), carry),
        (begin, d, slope, (d > touch) | (slope >= 0)),
        most=MAX_PATH_SAMPLES,
    )
    stride = jnp.clip(touch / jnp.where(slope < 0, -slope, 1.0), 0.0, 1 / MAX_PATH_SAMPLES)

    def go_down(carry):
        s, d, stride, _ = carry
        further = jnp.minimum(s + stride, 1.0)
        there = signed_distance(further)
        lower = carry[-1] & (there < d)
        return jnp.where(lower, further, s), jnp.where(lower, there, d), 2 * stride, lower

    s, d, _, _ = bounded_while_loop(
        lambda carry: any_lane(carry[-1]), go_down, (s, d, stride, (s < 1) & (slope < 0)), most=MAX_PATH_SAMPLES
    )
    found = (d < 0) & (s > 0)
    return jnp.where(found, s, dip[0]), jnp.where(found, d, dip[1])


def bound_path_length(face: Any, dt: ArrayLike, start: Particles, end: Particles) -> Float[Array, "*lanes"]:
    """How far at most the cubic path through the ends of a leg goes, as a surface sees it that may move [m]."""
    u, w = (scale(dt, face.relative(state.velocity)) for state in (start, end))
    chord = end.position - start.position + (u - scale(dt, start.velocity))
    return jnp.maximum(jnp.maximum(norm(u), norm(w)), norm(3.0 * chord - u - w))
