"""Where two convex shapes touch: one function over all pairs, by separating axes and clipping.

Arrays are by components, `(pairs, worlds)`, those of corners `(corners, pairs, worlds)`: what is next to each other in
memory is one and the same pair of many worlds. E. Catto (Box2D) describes the method.
"""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from physjax.backend import materialise

PARALLEL_SHARE = 1e-3
"""Share of a shape's size by which another face must be further out to be taken for the one that is touched."""
SAME_POINT_SHARE = 1e-6
"""Share of the touched edge within which two points are one."""

Vector = tuple[Array, Array]
"""A vector by its components."""


class Outline(NamedTuple):
    """One shape of every pair, in the world: corners [m] and normals of edges, which of these are edges, the radius [m]."""

    corners: Vector
    normals: Vector
    is_edge: Array
    radius: Array


class Manifold(NamedTuple):
    """Two points at which shapes a and b touch, or would.

    `normal`, `(pairs, worlds)`, points from a to b; `points` [m] are halfway between the surfaces and `gaps` [m] the signed
    distances there, both `(2, pairs, worlds)`, in order along the normal turned left; `is_point` says which are points.
    Keeping the order, points stay the same from step to step.
    """

    normal: Vector
    points: Vector
    gaps: Array
    is_point: Array


class _Edge(NamedTuple):
    """The ends of an edge [m], and its outward normal."""

    first: Vector
    second: Vector
    normal: Vector


def find_manifolds(a: Outline, b: Outline) -> Manifold:
    """The points at which shapes touch."""
    from_a, from_b = _find_separation(a, b), _find_separation(b, a)
    tolerance = PARALLEL_SHARE * _measure_size(a)
    # each stage is stored: every number of a manifold would compute all of it again
    store = partial(materialise, a.radius.ravel()[0])
    on_a = store(lambda: jnp.max(from_a, axis=0) >= jnp.max(from_b, axis=0) - tolerance)
    touched, other = _choose(on_a, a, b), _choose(on_a, b, a)
    face = store(lambda: _pick_edge(touched, jnp.where(on_a[None], from_a, from_b)))
    facing = -(face.normal[0][None] * other.normals[0] + face.normal[1][None] * other.normals[1])
    edge = store(lambda: _pick_edge(other, jnp.where(other.is_edge, facing, -jnp.inf)))
    return _orient(_touch_face(touched, other, face, edge), on_a)


def _find_separation(a: Outline, b: Outline) -> Array:
    """How far each edge of a is from what of b is deepest behind it [m], minus infinity where there is no edge."""
    (ax, ay), (nx, ny), (bx, by) = a.corners, a.normals, b.corners
    edges = []
    for i in range(len(ax)):
        heights = [nx[i] * (bx[j] - ax[i]) + ny[i] * (by[j] - ay[i]) for j in range(len(bx))]
        lowest = heights[0]
        for height in heights[1:]:
            lowest = jnp.minimum(lowest, height)
        edges.append(lowest)
    return jnp.where(a.is_edge, jnp.stack(edges), -jnp.inf)


def _measure_size(shape: Outline) -> Array:
    x, y = shape.corners
    return jnp.max(x, axis=0) - jnp.min(x, axis=0) + jnp.max(y, axis=0) - jnp.min(y, axis=0) + shape.radius


def _choose(flag: Array, a: Outline, b: Outline) -> Outline:
    each = lambda x, y: jnp.where(flag[None], x, y)  # noqa: E731
    return Outline(
        (each(a.corners[0], b.corners[0]), each(a.corners[1], b.corners[1])),
        (each(a.normals[0], b.normals[0]), each(a.normals[1], b.normals[1])),
        each(a.is_edge, b.is_edge),
        jnp.where(flag, a.radius, b.radius),
    )


def _pick_edge(shape: Outline, score: Array) -> _Edge:
    """The edge with the highest score; of a disc its center."""
    best = jnp.argmax(score, axis=0)
    corners = len(score)
    # an edge after the last corner ends at the first
    last = jnp.sum(shape.is_edge, axis=0) - 1
    after = jnp.where(best >= last, 0, best + 1)
    pick = lambda vector, index: tuple(_pick(part, index, corners) for part in vector)  # noqa: E731
    return _Edge(pick(shape.corners, best), pick(shape.corners, after), pick(shape.normals, best))  # pyright: ignore[reportArgumentType]


def _pick(rows: Array, index: Array, count: int) -> Array:
    """The row of each pair: choices one after the other, which fuse where a gather would not."""
    found = rows[0]
    for i in range(1, count):
        found = jnp.where(index == i, rows[i], found)
    return found


def _touch_face(touched: Outline, other: Outline, face: _Edge, edge: _Edge) -> Manifold:
    """The points of an edge that face another one, or where none does the nearest ends of the two."""
    (nx, ny), (px, py) = face.normal, face.first
    length = jnp.maximum(-ny * (face.second[0] - px) + nx * (face.second[1] - py), 0.0)
    radii = touched.radius + other.radius
    ends = [_see_from(face, end) for end in (edge.first, edge.second)]
    swap = ends[0][0] > ends[1][0]
    (low, low_height), (high, high_height) = (
        tuple(jnp.where(swap, b, a) for a, b in zip(*pair, strict=True)) for pair in (ends, ends[::-1])
    )
    width = high - low
    slope = (high_height - low_height) / jnp.where(width > SAME_POINT_SHARE * length, width, jnp.inf)
    along = [jnp.clip(end, 0.0, length) for end in (low, high)]
    heights = [low_height + slope * (place - low) for place in along]
    # the end of the edge that is nearest, and the end of the face that it is beyond, if it is
    squares = [(x - jnp.clip(x, 0.0, length)) ** 2 + y * y for x, y in ((low, low_height), (high, high_height))]
    first = squares[0] <= squares[1]
    place, rise, square = (jnp.where(first, a, b) for a, b in ((low, high), (low_height, high_height), squares))
    corner = jnp.clip(place, 0.0, length)
    is_beyond = (place != corner) & (rise > 0) & (square < jnp.minimum(heights[0], heights[1]) ** 2)
    overlaps = (high >= 0) & (low <= length) & jnp.any(touched.is_edge, axis=0) & ~is_beyond
    reach, far = place - corner, square > 0
    distance = jnp.sqrt(jnp.where(far, square, 1.0))
    across, out = jnp.where(far, reach / distance, 0.0), jnp.where(far, rise / distance, 1.0)
    distance = jnp.where(far, distance, 0.0)
    # in the frame of the face: (along, out)
    normal_along, normal_out = jnp.where(overlaps, 0.0, across), jnp.where(overlaps, 1.0, out)
    gaps = [jnp.where(overlaps, height, distance) - radii for height in heights]
    places = [
        (jnp.where(overlaps, end, corner) + normal_along * middle, normal_out * middle)
        for end, middle in zip(along, (touched.radius + gap / 2 for gap in gaps), strict=True)
    ]
    is_point = jnp.stack([jnp.ones_like(overlaps), overlaps & (along[1] - along[0] > SAME_POINT_SHARE * length)])
    points = (
        jnp.stack([px - ny * x + nx * y for x, y in places]),
        jnp.stack([py + nx * x + ny * y for x, y in places]),
    )
    normal = nx * normal_out - ny * normal_along, ny * normal_out + nx * normal_along
    return Manifold(normal, points, jnp.stack(gaps), is_point)


def _see_from(face: _Edge, point: Vector) -> Vector:
    """A point in the frame of a face [m]: along it from its first end, and out of it."""
    (nx, ny), x, y = face.normal, point[0] - face.first[0], point[1] - face.first[1]
    return nx * y - ny * x, nx * x + ny * y


def _orient(found: Manifold, on_a: Array) -> Manifold:
    """The manifold of a touched by b, whose points come in the other order where b was touched by a."""
    turn = lambda array: jnp.where((on_a | ~found.is_point[1])[None], array, array[::-1])  # noqa: E731
    sign = jnp.where(on_a, 1.0, -1.0).astype(found.gaps.dtype)
    return Manifold(
        (sign * found.normal[0], sign * found.normal[1]),
        (turn(found.points[0]), turn(found.points[1])),
        turn(found.gaps),
        found.is_point,
    )


__all__ = ["Manifold", "Outline", "find_manifolds"]
