"""Shapes in the plane: convex polygons of up to 12 corners with a radius around them; discs and capsules are two of these."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from physjax.checks import NestedArrayLike, Numbers, as_real_quantity, unchecked_quantity
from physjax.physics.rigid.polygon_corners import demand_convex_corners
from physjax.summaries import represent_part
from physjax.tracebacks import Module


class PlanarShape(Module):
    """What a body fills: the convex hull of its corners [m], and all that is nearer to it than `radius` [m].

    Corners are `(corners, 2)` in the body's frame, about its center of mass, anticlockwise. One corner is a disc, two are a
    capsule.

    Example:
        >>> rigid.PlanarShape.box((2.0, 1.0)).corners.tolist()
        [[-1.0, -0.5], [1.0, -0.5], [1.0, 0.5], [-1.0, 0.5]]
    """

    corners: Float[Array, "corners 2"] = unchecked_quantity("corners", "m", per=None)
    radius: Numbers = unchecked_quantity("radius", "m", per=None, at_least=0)

    __repr__ = represent_part

    @classmethod
    def disc(cls, radius: float | Array) -> "PlanarShape":
        """A disc of a radius [m]."""
        return cls(jnp.zeros((1, 2)), as_real_quantity("radius [m]", radius, above=0.0))

    @classmethod
    def capsule(cls, radius: float | Array, length: float | Array) -> "PlanarShape":
        """All that is within a radius [m] of a segment along x of a `length` [m]."""
        half = as_real_quantity("length [m]", length, above=0.0) / 2
        ends = jnp.stack([jnp.stack([-half, 0 * half]), jnp.stack([half, 0 * half])])
        return cls(ends, as_real_quantity("radius [m]", radius, above=0.0))

    @classmethod
    def box(cls, size: NestedArrayLike) -> "PlanarShape":
        """A rectangle with sides a, b [m] along x and y."""
        size = as_real_quantity("size [m]", size, above=0.0)
        if size.shape != (2,):
            raise ValueError(f"size [m]: got the shape {size.shape}, expected two sides, (2,).")
        signs = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
        return cls(jnp.asarray(signs, size.dtype) * size[None], jnp.zeros((), size.dtype))

    @classmethod
    def polygon(cls, corners: NestedArrayLike, radius: float | Array = 0.0) -> "PlanarShape":
        """A convex polygon with these corners [m] about its center of mass, anticlockwise, rounded by a radius [m]."""
        corners = as_real_quantity("corners [m]", corners)
        demand_convex_corners(corners)
        return cls(corners, as_real_quantity("radius [m]", radius, at_least=0.0))


class ShapeTable(NamedTuple):
    """The shapes of all bodies: their corners and outward normals of edges, padded to as many for each, and their radii.

    `corners` and `normals` are `(corners, bodies, 2)`: edge i goes from corner i to the next. `is_edge` says which are;
    beyond a body's corners its last one is repeated.
    """

    corners: Array
    normals: Array
    is_edge: np.ndarray
    radius: Array


def tabulate_shapes(shapes: Sequence[PlanarShape], dtype: np.dtype) -> ShapeTable:
    """The table of these shapes, one for each body."""
    most = max(len(shape.corners) for shape in shapes)
    corners, normals, edges = [], [], []
    for shape in shapes:
        own, count = shape.corners.astype(dtype), len(shape.corners)
        along = jnp.roll(own, -1, axis=0) - own
        # a disc has no edge, and any direction for one
        along = along if count > 1 else jnp.asarray([[-1.0, 0.0]], dtype)
        out = jnp.stack([along[:, 1], -along[:, 0]], axis=-1) / jnp.sqrt(jnp.sum(along**2, axis=-1, keepdims=True))
        corners.append(_repeat_last(own, most))
        normals.append(_repeat_last(out, most))
        edges.append(np.arange(most) < (count if count > 1 else 0))
    radius = jnp.stack([jnp.asarray(shape.radius, dtype) for shape in shapes])
    return ShapeTable(jnp.stack(corners, axis=1), jnp.stack(normals, axis=1), np.stack(edges, axis=1), radius)


def _repeat_last(rows: Array, length: int) -> Array:
    return jnp.concatenate([rows, jnp.broadcast_to(rows[-1], (length - len(rows), 2))])


__all__ = ["PlanarShape", "ShapeTable", "tabulate_shapes"]
