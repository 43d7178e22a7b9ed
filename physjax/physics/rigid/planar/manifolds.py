"""Where two convex shapes touch: one function over all pairs, by separating axes and clipping.

Arrays are by components, `(pairs, worlds)`, those of corners `(corners, pairs, worlds)`: what is next to each other in
memory is one and the same pair of many worlds. E. Catto (Box2D) describes the method.
"""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jax.typing import ArrayLike
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


class _Face(NamedTuple):
    """An edge that is touched: its first end [m], its length [m] and outward normal."""

    first: Vector
    length: Array
    normal: Vector


class _Edge(NamedTuple):
    """The ends of an edge as seen from a face [m]: how far along it, in order, and how far out of it."""

    along: tuple[Array, Array]
    out: tuple[Array, Array]


class _Corner(NamedTuple):
    """The end of an edge that is nearest to a face: where along the face its nearest point is, and the way there [m]."""

    place: Array
    way: Vector
    square: Array


class _Meeting(NamedTuple):
    """Whether an edge and a face overlap, the normal in the face's frame (along, out), and both distances [m]."""

    overlaps: Array
    normal: Vector
    distances: list[Array]


def find_manifolds(t: ArrayLike, a: Outline, b: Outline) -> Manifold:
    """The points at which shapes touch at time t [s], which only orders the work."""
    # each stage is stored: every number of a manifold would compute all of it again
    store = partial(materialise, t)
    from_a, from_b = store(lambda: _find_separations(a, b))
    on_a = store(lambda: _prefer_first(a, from_a, from_b))
    touched, other = _choose(on_a, a, b), _choose(on_a, b, a)
    face = store(lambda: _pick_face(touched, jnp.where(on_a[None], from_a, from_b)))
    edge = store(lambda: _find_edge(other, face))
    corner = store(lambda: _find_nearest_end(face, edge))
    meeting = store(lambda: _meet_face(face, edge, corner, jnp.any(touched.is_edge, axis=0)))
    return _orient(_list_points(face, edge, corner, meeting, (touched.radius, other.radius)), on_a)


def _find_separations(a: Outline, b: Outline) -> tuple[Array, Array]:
    """How far each edge of a is from what of b is deepest behind it [m], and of b from a; minus infinity without an edge."""
    return _find_separation(a, b), _find_separation(b, a)


def _find_separation(a: Outline, b: Outline) -> Array:
    (ax, ay), (nx, ny), (bx, by) = a.corners, a.normals, b.corners
    lowest = nx * (bx[0][None] - ax) + ny * (by[0][None] - ay)
    for x, y in zip(bx[1:], by[1:], strict=True):
        lowest = jnp.minimum(lowest, nx * (x[None] - ax) + ny * (y[None] - ay))
    return jnp.where(a.is_edge, lowest, -jnp.inf)


def _prefer_first(a: Outline, from_a: Array, from_b: Array) -> Array:
    """Whether a face of a is touched rather than one of b."""
    return jnp.max(from_a, axis=0) >= jnp.max(from_b, axis=0) - PARALLEL_SHARE * _measure_size(a)


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


def _pick_face(shape: Outline, separation: Array) -> _Face:
    """The face that is furthest out; of a disc its center."""
    first, (sx, sy), (nx, ny) = _pick_ends(shape, separation)
    length = jnp.maximum(nx * (sy - first[1]) - ny * (sx - first[0]), 0.0)
    return _Face(first, length, (nx, ny))


def _find_edge(shape: Outline, face: _Face) -> _Edge:
    """The edge that faces a face, as seen from there; of a disc its center, twice."""
    (nx, ny), (ox, oy) = face.normal, shape.normals
    facing = jnp.where(shape.is_edge, -(nx[None] * ox + ny[None] * oy), -jnp.inf)
    (one, out_one), (two, out_two) = (_see_from(face, end) for end in _pick_ends(shape, facing)[:2])
    swap = one > two
    choose = lambda a, b: (jnp.where(swap, b, a), jnp.where(swap, a, b))  # noqa: E731
    return _Edge(choose(one, two), choose(out_one, out_two))


def _pick_ends(shape: Outline, score: Array) -> tuple[Vector, Vector, Vector]:
    """Both ends of the edge with the highest score, and its normal."""
    best = jnp.argmax(score, axis=0)
    # an edge after the last corner ends at the first
    last = jnp.sum(shape.is_edge, axis=0) - 1
    after = jnp.where(best >= last, 0, best + 1)
    pick = lambda vector, index: (_pick(vector[0], index), _pick(vector[1], index))  # noqa: E731
    return pick(shape.corners, best), pick(shape.corners, after), pick(shape.normals, best)


def _pick(rows: Array, index: Array) -> Array:
    """The row of each pair: choices one after the other, which fuse where a gather would not."""
    found = rows[0]
    for i in range(1, len(rows)):
        found = jnp.where(index == i, rows[i], found)
    return found


def _see_from(face: _Face, point: Vector) -> Vector:
    """A point in the frame of a face [m]: along it from its first end, and out of it."""
    (nx, ny), x, y = face.normal, point[0] - face.first[0], point[1] - face.first[1]
    return nx * y - ny * x, nx * x + ny * y


def _find_nearest_end(face: _Face, edge: _Edge) -> _Corner:
    ways = [(x - jnp.clip(x, 0.0, face.length), y) for x, y in zip(edge.along, edge.out, strict=True)]
    squares = [x * x + y * y for x, y in ways]
    nearer = squares[0] <= squares[1]
    choose = lambda pair: jnp.where(nearer, *pair)  # noqa: E731
    way = choose([x for x, _ in ways]), choose(edge.out)
    return _Corner(jnp.clip(choose(edge.along), 0.0, face.length), way, choose(squares))


def _meet_face(face: _Face, edge: _Edge, corner: _Corner, is_edge: Array) -> _Meeting:
    """How an edge meets a face: along what they overlap, or where they do not, from the nearest end."""
    (low, high), (low_out, high_out) = edge
    width = high - low
    slope = (high_out - low_out) / jnp.where(width > SAME_POINT_SHARE * face.length, width, jnp.inf)
    heights = [low_out + slope * (jnp.clip(end, 0.0, face.length) - low) for end in (low, high)]
    # the nearest end may be beyond an end of the face
    reach, rise = corner.way
    is_beyond = (reach != 0) & (rise > 0) & (corner.square < jnp.minimum(heights[0], heights[1]) ** 2)
    overlaps = (high >= 0) & (low <= face.length) & is_edge & ~is_beyond
    far = corner.square > 0
    distance = jnp.sqrt(jnp.where(far, corner.square, 1.0))
    across, out = jnp.where(far, reach / distance, 0.0), jnp.where(far, rise / distance, 1.0)
    distance = jnp.where(far, distance, 0.0)
    normal = jnp.where(overlaps, 0.0, across), jnp.where(overlaps, 1.0, out)
    return _Meeting(overlaps, normal, [jnp.where(overlaps, height, distance) for height in heights])


def _list_points(face: _Face, edge: _Edge, corner: _Corner, meeting: _Meeting, radii: tuple[Array, Array]) -> Manifold:
    """The points at which an edge meets a face, in the world."""
    (nx, ny), (px, py), (overlaps, (along, out), distances) = face.normal, face.first, meeting
    gaps = [distance - (radii[0] + radii[1]) for distance in distances]
    ends = [jnp.clip(end, 0.0, face.length) for end in edge.along]
    places = [
        (jnp.where(overlaps, end, corner.place) + along * middle, out * middle)
        for end, middle in zip(ends, (radii[0] + gap / 2 for gap in gaps), strict=True)
    ]
    is_point = [jnp.ones_like(overlaps), overlaps & (ends[1] - ends[0] > SAME_POINT_SHARE * face.length)]
    points = (
        jnp.stack([px - ny * x + nx * y for x, y in places]),
        jnp.stack([py + nx * x + ny * y for x, y in places]),
    )
    normal = nx * out - ny * along, ny * out + nx * along
    return Manifold(normal, points, jnp.stack(gaps), jnp.stack(is_point))


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
