"""Rigid bodies as solids: triangles that are fixed to each body and turn with it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from physjax.checks import NestedArrayLike, as_real_quantity
from physjax.physics.rigid.inertia import Inertia
from physjax.physics.rigid.space import shapes as space
from physjax.show.frames import Frames

__all__ = ["Shape", "box", "capsule", "cylinder", "sphere"]

CIRCLE_CORNERS = 24
"""Corners of the polygon that is drawn for a circle."""
MIN_EDGE_SHARE = 0.02
"""The thinnest edge that is drawn of a body without extent in that direction, as a share of its longest."""
MIN_AREA_SHARE = 1e-12
"""A triangle with an area below this share of the square of the shape's size has collapsed to a line, as at a pole."""
_CUBE = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
"""The corners of a cube of edge 1 about the origin."""
_CUBE_FACES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ]
)
"""The twelve triangles of that cube, counterclockwise seen from outside."""


class Shape(NamedTuple):
    """The surface of a body in its own frame, from its centre of mass: vertices `(n, 3)` [m], triangles `(m, 3)`."""

    vertices: np.ndarray
    faces: np.ndarray

    def at(self, place: NestedArrayLike) -> "Shape":
        """The shape moved by a vector [m] in the frame of the body."""
        return self._replace(vertices=self.vertices + np.asarray(place, float))

    def joined(self, *others: "Shape") -> "Shape":
        """This shape and others as one."""
        vertices, faces = zip(self, *others, strict=True)
        starts = np.cumsum([0, *(len(part) for part in vertices[:-1])])
        return Shape(np.concatenate(vertices), np.concatenate([f + s for f, s in zip(faces, starts, strict=True)]))


def box(size: NestedArrayLike) -> Shape:
    """A box with edges along the axes [m], `(3,)`."""
    return Shape(_CUBE * np.asarray(as_real_quantity("size [m]", size, above=0.0), float), _CUBE_FACES)


def cylinder(radius: float, length: float, *, axis: int = 2) -> Shape:
    """A cylinder along an axis of the body (2: z), radius and length [m]."""
    return _revolve_outline(
        [(0.0, -0.5 * length), (radius, -0.5 * length), (radius, 0.5 * length), (0.0, 0.5 * length)], axis
    )


def capsule(radius: float, length: float, *, axis: int = 2) -> Shape:
    """A cylinder of a `length` between two hemispheres [m]."""
    angle = np.linspace(0, np.pi / 2, CIRCLE_CORNERS // 4 + 1)
    cap = np.stack([radius * np.sin(angle), 0.5 * length + radius * np.cos(angle)], axis=1)
    return _revolve_outline([*(cap * [1, -1]), *cap[::-1]], axis)


def sphere(radius: float) -> Shape:
    """A ball [m]."""
    return capsule(radius, 0.0)


def triangulate_shape(shape: space.Shape) -> Shape:
    """The surface of a shape that keeps bodies apart in a scene, a `rigid.Shape`."""
    half, radius = np.asarray(shape.half, float), float(shape.radius)
    if shape.kind == "box":
        return box(2 * half)
    if shape.kind == "hull":
        return Shape(np.asarray(shape.corners, float), shape.triangles)
    axis = int(np.argmax(half))
    return sphere(radius) if shape.kind == "sphere" else capsule(radius, 2 * half[axis], axis=axis)


def place_shapes(seen: Frames, orientation: np.ndarray, shapes: list[Shape]) -> tuple[Frames, np.ndarray]:
    """The shapes of bodies moved and turned with them: frames of all their vertices, and the triangles between them."""
    corners = [
        seen.position[:, i, None] + rotate_vectors(orientation[:, i, None], shape.vertices[None])
        for i, shape in enumerate(shapes)
    ]
    whole = shapes[0].joined(*shapes[1:])
    return seen._replace(position=np.concatenate(corners, axis=1)), whole.faces


def build_inertia_box(inertia: Inertia, lane: tuple[int, ...] = ()) -> Shape:
    """The uniform box with a body's mass and principal moments: edges a² = 6 (I₂ + I₃ - I₁)/m, and so on.

    Of a body with a pivot the moments about its centre of mass are taken, I - m (|r|² 1 - r rᵀ). An edge of length zero is
    drawn thin. `lane` is the index of the body in a batch.
    """
    own = lambda leaf, axes: np.asarray(leaf, float)[lane if np.ndim(leaf) > axes else ()]  # noqa: E731
    mass, tensor = own(inertia.mass, 0), own(inertia.tensor, 2)
    if inertia.arm is not None:
        arm = own(inertia.arm, 1)
        tensor = tensor - mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    moments, axes = np.linalg.eigh(tensor)
    edges = np.sqrt(np.maximum(6 / mass * (moments.sum() - 2 * moments), 0.0))
    edges = np.maximum(edges, MIN_EDGE_SHARE * edges.max())
    axes[:, 0] *= np.sign(np.linalg.det(axes))  # a rotation, not a mirror: faces keep their outer side
    solid = box(edges)
    return solid._replace(vertices=solid.vertices @ axes.T)


def rotate_vectors(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Vectors turned by unit quaternions (w, x, y, z): v + 2w (u × v) + 2u × (u × v)."""
    twice = 2 * np.cross(q[..., 1:], v)
    return v + q[..., :1] * twice + np.cross(q[..., 1:], twice)


def _revolve_outline(outline: Sequence[Sequence[float] | np.ndarray], axis: int) -> Shape:
    """The solid of revolution of an outline of points (distance from the axis, place along it)."""
    angle = np.linspace(0, 2 * np.pi, CIRCLE_CORNERS, endpoint=False)
    rings = [np.stack([r * np.cos(angle), r * np.sin(angle), np.full(CIRCLE_CORNERS, z)], axis=1) for r, z in outline]
    here, there = np.arange(CIRCLE_CORNERS), np.roll(np.arange(CIRCLE_CORNERS), -1)
    faces = []
    for start in range(0, CIRCLE_CORNERS * (len(outline) - 1), CIRCLE_CORNERS):
        low, high = start, start + CIRCLE_CORNERS
        faces += [
            np.stack([low + here, low + there, high + there], 1),
            np.stack([low + here, high + there, high + here], 1),
        ]
    vertices, faces = np.roll(np.concatenate(rings), axis - 2, axis=1), np.concatenate(faces)
    a, b, c = vertices[faces].transpose(1, 0, 2)
    has_area = np.abs(np.cross(b - a, c - a)).max(axis=1) > MIN_AREA_SHARE * np.abs(vertices).max() ** 2
    return Shape(vertices, faces[has_area])


def __dir__() -> list[str]:
    return __all__
