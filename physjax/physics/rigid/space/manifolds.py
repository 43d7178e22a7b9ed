"""Where two shapes in space touch, or would: what all kinds of pairs have in common.

Arrays are by components, `(pairs, worlds)`: what is next to each other in memory is one and the same pair of many worlds.
Axes of a body and points of a contact are an axis in front.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from physjax.physics.rigid.space.components import Vector, add, combine, cross, dot, put_in_front, scale, subtract

POINTS = 4
"""Points of a manifold: some are given twice where there are fewer."""


class Boxes(NamedTuple):
    """Boxes with a radius around them: centers [m], their axes, half edges `(3, pairs, 1)` [m], and radii `(pairs, 1)` [m]."""

    center: Vector
    axes: Vector
    half: Array
    radius: Array


class Manifold(NamedTuple):
    """Four points at which shapes a and b touch, or would.

    `normal`, `(pairs, worlds)`, points from a to b; `points` [m] are halfway between the surfaces and `gaps` [m] the signed
    distances there, each `(4, pairs, worlds)`; `is_point` says whether they are there, `(pairs, worlds)`.
    """

    normal: Vector
    points: Vector
    gaps: Array
    is_point: Array


class Frame(NamedTuple):
    """A place [m] and three directions at right angles, in an axis in front."""

    origin: Vector
    axes: Vector

    def see(self, point: Vector) -> Array:
        """A point of the world in the frame [m], its three numbers in front."""
        return see_direction(self.axes, subtract(point, self.origin))

    def place(self, numbers: Array) -> Vector:
        """A point of the frame in the world [m]."""
        return add(self.origin, combine(numbers, self.axes))

    def place_several(self, numbers: Array) -> Vector:
        """Several points of the frame in the world [m], `(3, points, ...)`."""
        x, y, z = (part[:, None] for part in self.axes)
        return add(put_in_front(self.origin), combine(numbers, (x, y, z)))


def see_direction(axes: Vector, vector: Vector) -> Array:
    """How much of a vector is along each of some axes, which are in front."""
    return dot(put_in_front(vector), axes)


def find_tangents(normal: Vector) -> Array:
    """Two unit vectors at right angles to a normal, and the normal, which is their cross product: rows of `(3, 3, ...)`."""
    x, y, z = normal
    # of the axes the one that is furthest from the normal
    ax, ay, az = abs(x), abs(y), abs(z)
    first, second = (ax <= ay) & (ax <= az), ay <= az
    zero, one = jnp.zeros_like(x), jnp.ones_like(x)
    axis = jnp.where(first, one, zero), jnp.where(~first & second, one, zero), jnp.where(~first & ~second, one, zero)
    across = cross(axis, normal)
    square = dot(across, across)
    # what is no contact has no normal
    tangent = scale(1 / jnp.sqrt(jnp.where(square > 0, square, 1.0)), across)
    return jnp.stack([jnp.stack(row) for row in (tangent, cross(normal, tangent), normal)])


__all__ = ["POINTS", "Boxes", "Frame", "Manifold", "find_tangents", "see_direction"]
