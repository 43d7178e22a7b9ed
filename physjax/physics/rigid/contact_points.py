"""The points of a rigid body that can touch, each with a radius around it: boxes, balls, capsules, and sets of points.

A box touches a plane with its corners, a ball with its center at a radius, a capsule, or a cylinder that lies on its
side, with the two ends of its axis.
"""

from collections.abc import Sequence
from itertools import product

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.checks import Numbers, as_real_quantity, unchecked_quantity
from physjax.physics.rigid.spatial import RigidBodies, to_world_frame_each
from physjax.vectors import scale

_CORNERS = tuple(product((-1.0, 1.0), repeat=3))
"""The corners of a cube, in half its edges from its centre."""


class ContactPoints(eqx.Module):
    """Points of a body [m], in its frame and from its center of mass, each with a `radius` [m] around it.

    `points` are `(points, 3)`, or `(*lanes, points, 3)` where bodies differ; `radius` is a scalar or per lane.

    Example:
        >>> rigid.ContactPoints.box((1.0, 2.0, 3.0)).points.shape
        (8, 3)
    """

    points: Float[Array, "*lanes points 3"] = unchecked_quantity("points of the hull", "m", kind="place", per="point")
    radius: Numbers = unchecked_quantity("radius of the hull", "m", at_least=0)

    def __init__(self, points: ArrayLike | Sequence, radius: ArrayLike = 0.0):
        self.points = as_real_quantity("points of the hull [m]", points)
        self.radius = as_real_quantity("radius of the hull [m]", radius, at_least=0.0)
        if self.points.ndim < 2 or self.points.shape[-1] != 3 or not self.points.size:
            raise ValueError(
                f"ContactPoints: got points of shape {self.points.shape}, expected (points, 3), or (*lanes, points, 3): at least "
                "one. A ball is ContactPoints.sphere(radius)."
            )

    @classmethod
    def box(cls, size: ArrayLike) -> "ContactPoints":
        """The eight corners of a box with edges a, b, c [m], `(3,)` or `(*lanes, 3)`."""
        size = as_real_quantity("size [m]", size, above=0.0)
        corners = [scale(0.5, size * jnp.broadcast_to(jnp.asarray(c, size.dtype), size.shape)) for c in _CORNERS]
        return cls(jnp.stack(corners, axis=-2))

    @classmethod
    def sphere(cls, radius: ArrayLike) -> "ContactPoints":
        """A ball: its center, and a radius [m]."""
        return cls(jnp.zeros((1, 3)), as_real_quantity("radius [m]", radius, above=0.0))

    @classmethod
    def capsule(cls, radius: ArrayLike, length: float, *, axis: int = 2) -> "ContactPoints":
        """The ends of an axis of a `length` [m], and a radius [m] around it; so touches a cylinder on its side, too."""
        if axis not in (0, 1, 2):
            raise ValueError(f"axis: got {axis!r}, expected 0, 1 or 2: the axis of the body's frame that it is along.")
        end = as_real_quantity("length [m]", length, above=0.0) / 2
        along = jnp.stack([end if i == axis else jnp.zeros_like(end) for i in range(3)], axis=-1)
        return cls(jnp.stack([-along, along], axis=-2), as_real_quantity("radius [m]", radius, above=0.0))

    def arms(self, bodies: RigidBodies) -> Float[Array, "points *lanes 3"]:
        """From each body's center of mass to its points [m], in the world frame, the points first."""
        return to_world_frame_each(bodies, jnp.moveaxis(self.points, -2, 0))
