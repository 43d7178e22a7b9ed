"""Shapes in space: balls, capsules and boxes, each a box of half extents with a radius around it."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from physjax.checks import NestedArrayLike, Numbers, as_real_quantity, unchecked_quantity

Kind = Literal["sphere", "capsule", "box"]


class Shape(eqx.Module):
    """What a body in space fills: a box with half edges `half` [m] about its center of mass, and all within a `radius` [m] of it.

    A sphere is a point with a radius, a capsule a segment with one; boxes have sharp edges.

    Example:
        >>> rigid.Shape.box((2.0, 1.0, 4.0)).half.tolist(), float(rigid.Shape.sphere(0.5).radius)
        ([1.0, 0.5, 2.0], 0.5)
    """

    kind: Kind = eqx.field(static=True)
    half: Float[Array, "3"] = unchecked_quantity("half edges", "m", per=None)
    radius: Numbers = unchecked_quantity("radius", "m", per=None, at_least=0)

    @classmethod
    def sphere(cls, radius: float | Array) -> "Shape":
        """A ball of a radius [m]."""
        return cls("sphere", jnp.zeros(3), as_real_quantity("radius [m]", radius, above=0.0))

    @classmethod
    def capsule(cls, radius: float | Array, length: float | Array, *, axis: int = 2) -> "Shape":
        """All that is within a radius [m] of a segment of a `length` [m] along an axis of the body's frame."""
        if axis not in (0, 1, 2):
            raise ValueError(f"axis: got {axis!r}, expected 0, 1 or 2: the axis of the body's frame that it is along.")
        along = as_real_quantity("length [m]", length, above=0.0) / 2
        half = jnp.stack([along if i == axis else jnp.zeros_like(along) for i in range(3)])
        return cls("capsule", half, as_real_quantity("radius [m]", radius, above=0.0))

    @classmethod
    def box(cls, size: NestedArrayLike) -> "Shape":
        """A box with edges a, b, c [m] along x, y and z."""
        size = as_real_quantity("size [m]", size, above=0.0)
        if size.shape != (3,):
            raise ValueError(f"size [m]: got the shape {size.shape}, expected three edges, (3,).")
        return cls("box", size / 2, jnp.zeros((), size.dtype))


class ShapeTable(NamedTuple):
    """The shapes of all bodies: half edges `(3, bodies)` and radii `(bodies,)` [m]."""

    half: Array
    radius: Array


def tabulate_shapes(shapes: Sequence[Shape], dtype: np.dtype) -> ShapeTable:
    """The table of these shapes, one for each body."""
    half = jnp.stack([shape.half.astype(dtype) for shape in shapes], axis=-1)
    radius = jnp.stack([jnp.asarray(shape.radius, dtype) for shape in shapes])
    return ShapeTable(half, radius)


__all__ = ["Shape", "ShapeTable", "tabulate_shapes"]
