"""Segments and flat faces against surfaces: where an edge comes nearest, how its ends respond, which corners touch."""

from typing import NamedTuple

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from physjax.particles import Particles
from physjax.physics.contacts.surface import Surface
from physjax.vectors import scale

__all__ = ["Corners", "Nearest", "nearest_on_segment", "respond_segment", "touching_corners"]


class Nearest(NamedTuple):
    """The point of a segment nearest to a surface: its share of the way from the first end, place and distance [m].

    Example:
        >>> way = jnp.array([0.0, 2.0]), jnp.array([4.0, 2.0])
        >>> near = contacts.nearest_on_segment(contacts.Sphere((1.0, 0.0), 0.5), 0.0, *way)
        >>> isinstance(near, contacts.Nearest), float(near.share), float(near.signed_distance)
        (True, 0.25, 1.5)
    """

    share: Float[Array, "*lanes"]
    point: Float[Array, "*lanes dim"]
    signed_distance: Float[Array, "*lanes"]


class Corners(NamedTuple):
    """The corners of a flat face at a surface: the signed distance of each [m], and which of them touch.

    Example:
        >>> feet = jnp.array([[0.0, 0.0], [1.0, 0.5]])
        >>> found = contacts.touching_corners(contacts.Plane((0.0, 0.0), (0.0, 1.0)), 0.0, feet)
        >>> isinstance(found, contacts.Corners), found.signed_distance.tolist(), found.touching.tolist()
        (True, [0.0, 0.5], [True, False])
    """

    signed_distance: Float[Array, "*lanes corners"]
    touching: Bool[Array, "*lanes corners"]


def nearest_on_segment(
    surface: Surface, t: ArrayLike, start: Float[Array, "*lanes dim"], end: Float[Array, "*lanes dim"]
) -> Nearest:
    """The deepest point of the segment from `start` to `end` [m]: an end, or at a ball or a slab a point in between.

    Example:
        >>> floor = contacts.Plane((0.0, 0.0), (0.0, 1.0))
        >>> contacts.nearest_on_segment(floor, 0.0, jnp.array([0.0, 2.0]), jnp.array([4.0, 1.0])).point.tolist()
        [4.0, 1.0]
    """
    best = Nearest(jnp.zeros_like(start[..., 0]), start, surface.signed_distance(t, start))
    for share in (jnp.ones_like(best.share), *surface.nearest_shares(t, start, end)):
        point = start + scale(share, end - start)
        signed_distance = surface.signed_distance(t, point)
        deeper = signed_distance < best.signed_distance
        best = Nearest(
            jnp.where(deeper, share, best.share),
            jnp.where(deeper[..., None], point, best.point),
            jnp.where(deeper, signed_distance, best.signed_distance),
        )
    return best


def respond_segment(
    surface: Surface,
    t: ArrayLike,
    start: Particles,
    end: Particles,
    masses: tuple[ArrayLike, ArrayLike] = (1.0, 1.0),
) -> tuple[Particles, Particles]:
    """The two ends of a segment after a contact at its deepest point, which responds like a particle there.

    The impulse is shared by leverage: an end of mass m and weight w at the contact point takes w/m of it. Momentum changes
    along that impulse alone, and an elastic bounce keeps the energy. `masses` [kg] are scalars or per lane.

    Example:
        >>> floor = contacts.Plane((0.0, 0.0), (0.0, 1.0))
        >>> up, down = (Particles(jnp.array([0.0, y]), jnp.array([0.0, -1.0])) for y in (1.0, -0.1))
        >>> print(*(end.velocity for end in contacts.respond_segment(floor, 0.0, up, down)))
        [ 0. -1.] [0. 1.]
    """
    share = nearest_on_segment(surface, t, start.position, end.position).share
    near, far = 1 - share, share
    between = lambda a, b: scale(near, a) + scale(far, b)  # noqa: E731
    point = Particles(between(start.position, end.position), between(start.velocity, end.velocity))
    after = surface.respond(t, point)
    mobility = near * near / masses[0] + far * far / masses[1]
    ends = []
    for state, lever, mass in ((start, near, masses[0]), (end, far, masses[1])):
        part = lever / mass / mobility
        ends.append(Particles(*(s + scale(part, a - p) for s, a, p in zip(state, after, point, strict=True))))
    return ends[0], ends[1]


def touching_corners(
    surface: Surface, t: ArrayLike, corners: Float[Array, "*lanes corners dim"], tolerance: ArrayLike = 1e-9
) -> Corners:
    """Which corners [m] of a flat face touch a flat surface within `tolerance` [m]: none, one, an edge or all.

    Example:
        >>> floor = contacts.Plane((0.0, 0.0), (0.0, 1.0))
        >>> contacts.touching_corners(floor, 0.0, jnp.array([[0.0, 0.0], [1.0, 0.0]])).touching.tolist()
        [True, True]
    """
    signed_distance = surface.signed_distance(t, corners)
    return Corners(signed_distance, signed_distance <= tolerance)
