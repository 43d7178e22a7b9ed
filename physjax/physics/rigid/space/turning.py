"""How easily bodies in space are turned, by their principal moments, in whatever way they lie."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from physjax.physics.rigid.inertia import Inertia
from physjax.physics.rigid.space.components import multiply_rows
from physjax.vectors import components, multiply_quaternions


class Turning(NamedTuple):
    """1/I about each principal axis [1/(kg m²)], 0 of what is held, and the quaternion of these axes in the body's frame.

    `inverse` is `(3, bodies, worlds)`, `axes` `(4, bodies, worlds)`, or None where they are the axes of the body.
    """

    inverse: Array
    axes: Array | None

    @classmethod
    def of(cls, inertia: Inertia, free: Array) -> "Turning":
        """Of bodies with this inertia, where `free`, `(*worlds, bodies)`, is 0 of those that are held."""
        by_body = lambda part: jnp.broadcast_to(part, free.shape).reshape(-1, free.shape[-1]).T  # noqa: E731
        inverse = jnp.stack([by_body(free * part) for part in components(inertia.inverse)])
        if inertia.axes is None:
            return cls(inverse, None)
        return cls(inverse, jnp.stack([by_body(part) for part in components(inertia.axes)]))

    def find_mobility(self, turn: Array) -> Array:
        """R I⁻¹ Rᵀ of bodies with these quaternions [1/(kg m²)], `(3, 3, bodies, worlds)`."""
        return _turn_moments(self.axes, turn, self.inverse)

    def find_inertia(self, turn: Array) -> Array:
        """R I Rᵀ of bodies with these quaternions [kg m²]; 0 of what is held, and about a line."""
        there = self.inverse > 0
        return _turn_moments(self.axes, turn, jnp.where(there, 1 / jnp.where(there, self.inverse, 1.0), 0.0))


def _turn_moments(axes: Array | None, turn: Array, moments: Array) -> Array:
    frame = turn if axes is None else jnp.stack(multiply_quaternions(list(turn), list(axes)))
    rows = find_rotation(frame)
    return multiply_rows(rows * moments[None], rows)


def find_rotation(turn: Array) -> Array:
    """The rotation matrices of quaternions `(4, ...)`: columns are the axes of the frame in the world."""
    w, x, y, z = turn
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return jnp.stack([jnp.stack(row) for row in rows])


__all__ = ["Turning", "find_rotation"]
