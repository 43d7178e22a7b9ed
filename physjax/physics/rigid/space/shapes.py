"""Shapes in space: balls, capsules and boxes, each a box of half extents with a radius around it, and convex hulls."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from physjax.checks import NestedArrayLike, Numbers, as_real_quantity, unchecked_quantity
from physjax.physics.rigid.space.polyhedra import (
    BOX_CORNERS,
    MAX_CORNERS,
    Polyhedra,
    Topology,
    find_box_topology,
    find_topology,
    tabulate_polyhedra,
)
from physjax.summaries import represent_part
from physjax.tracebacks import Module

Kind = Literal["sphere", "capsule", "box", "hull"]


class Shape(Module):
    """What a body in space fills: a box with half edges `half` [m] about its center of mass, and all within a `radius` [m] of it.

    A sphere is a point with a radius, a capsule a segment with one; boxes have sharp edges. A hull has `corners` [m] and lies
    in the box.

    Example:
        >>> rigid.Shape.box((2.0, 1.0, 4.0)).half.tolist(), float(rigid.Shape.sphere(0.5).radius)
        ([1.0, 0.5, 2.0], 0.5)
    """

    kind: Kind = eqx.field(static=True)
    half: Float[Array, "3"] = unchecked_quantity("half edges", "m", per=None)
    radius: Numbers = unchecked_quantity("radius", "m", per=None, at_least=0)
    corners: Float[Array, "corners 3"] | None = unchecked_quantity("corners", "m", per=None, default=None)
    topology: Topology | None = eqx.field(static=True, default=None, repr=False)

    __repr__ = represent_part

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

    @classmethod
    def hull(cls, points: NestedArrayLike) -> "Shape":
        """The convex hull of 4 to 32 points [m], `(points, 3)`, about the center of mass.

        `triangles` are those of its surface, as `inertia.mesh` takes them: its `center` is what to take from the points.

        Example:
            >>> wedge = np.array([[0, 0, 0], [3, 0, 0], [0, 2, 0], [0, 0, 1], [3, 0, 1], [0, 2, 1], [0.5, 0.5, 0.5]])
            >>> solid = inertia.mesh(wedge[:6], rigid.Shape.hull(wedge[:6]).triangles, density=1.0)
            >>> ramp = rigid.Shape.hull(wedge - solid.center)
            >>> len(ramp.corners), len(ramp.topology.faces), round(float(solid.inertia.mass), 6)
            (6, 5, 3.0)
        """
        points = as_real_quantity("points [m]", points)
        if isinstance(points, Tracer):
            raise TypeError("Shape.hull: got traced points, expected numbers: which of them share a face is structure.")
        if points.ndim != 2 or points.shape[1:] != (3,) or not 4 <= len(points) <= MAX_CORNERS:
            raise ValueError(
                f"Shape.hull: got points of shape {points.shape}, expected (points, 3) of 4 to {MAX_CORNERS} points: leave out "
                "those that matter least."
            )
        kept, topology = find_topology(np.asarray(points, float))
        corners = points[kept]
        return cls("hull", jnp.max(jnp.abs(corners), axis=0), jnp.zeros((), corners.dtype), corners, topology)

    @property
    def triangles(self) -> np.ndarray:
        """The surface of a box or a hull as numbers of its corners, anticlockwise from outside, `(triangles, 3)`."""
        return self.polyhedron[1].triangles

    @property
    def polyhedron(self) -> tuple[Array, Topology]:
        """The corners [m] of a box or a hull, and how they hang together."""
        if self.corners is not None and self.topology is not None:
            return self.corners, self.topology
        if self.kind != "box":
            raise ValueError(f"Shape: got a {self.kind}, which is round, expected a box or a hull.")
        return jnp.asarray(BOX_CORNERS, self.half.dtype) * self.half[None], find_box_topology()


class ShapeTable(NamedTuple):
    """The shapes of all bodies: half edges `(3, bodies)` and radii `(bodies,)` [m]."""

    half: Array
    radius: Array


def tabulate_shapes(shapes: Sequence[Shape], dtype: np.dtype) -> ShapeTable:
    """The table of these shapes, one for each body."""
    half = jnp.stack([shape.half.astype(dtype) for shape in shapes], axis=-1)
    radius = jnp.stack([jnp.asarray(shape.radius, dtype) for shape in shapes])
    return ShapeTable(half, radius)


def build_polyhedra(shapes: Sequence[Shape], dtype: np.dtype) -> Polyhedra:
    """The table of boxes and hulls, one for each body."""
    corners, topologies = zip(*(shape.polyhedron for shape in shapes), strict=True)
    return tabulate_polyhedra([part.astype(dtype) for part in corners], topologies)


__all__ = ["Shape", "ShapeTable", "build_polyhedra", "tabulate_shapes"]
