"""Where two convex polyhedra touch: along the normal of a face of either, or of an edge of each.

An edge of one and an edge of the other span a face of all differences of their points where the arcs between the normals
of their faces cross on the sphere (D. Gregorius, "The Separating Axis Test between Convex Polyhedra", 2013). Of all faces
of these differences the one counts along which the bodies are furthest apart. Everything is seen from the frame of the
first.
"""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.backend import materialise
from physjax.physics.rigid.space.boxes import PARALLEL_SHARE, SIDE_SHARE, Candidates, pick_four
from physjax.physics.rigid.space.components import (
    Vector,
    add,
    choose,
    combine,
    cross,
    dot,
    find_best,
    find_sign,
    put_in_front,
    scale,
    square_root,
    subtract,
    sum_parts,
    take_vector,
)
from physjax.physics.rigid.space.manifolds import Boxes, Frame, Manifold, see_direction
from physjax.physics.rigid.space.polyhedra import Polyhedra

PARALLEL = 1e-6
"""Square of the sine of the angle between edges below which they are parallel."""


class Hulls(NamedTuple):
    """Bodies in the world as `Boxes` around them, with their polyhedra."""

    boxes: Boxes
    polyhedra: Polyhedra


class _Axis(NamedTuple):
    """The axis along which polyhedra touch: whether of two edges, or of a face of a; and their numbers."""

    of_edges: Array
    on_a: Array
    faces: tuple[Array, Array]
    edges: tuple[Array, Array]


def find_hull_manifolds(t: ArrayLike, a: Hulls, b: Hulls) -> Manifold:
    """The points at which polyhedra touch at time t [s], which only orders the work."""
    store = partial(materialise, t)
    frame = Frame(a.boxes.center, a.boxes.axes)
    other = store(lambda: see_polyhedra(frame, b))
    axis = store(lambda: _find_axis(a, b, other))
    normal, point, gap = store(lambda: _meet_edges(a.polyhedra, other, axis.edges))
    by_face = store(lambda: _meet_face(store, a.polyhedra, other, axis))
    pick = lambda edge, face: jnp.where(axis.of_edges[None], edge[None], face)  # noqa: E731
    points = tuple(pick(edge, face) for edge, face in zip(point, by_face.points, strict=True))
    ways = jnp.stack(choose(axis.of_edges, normal, by_face.normal))
    placed = frame.place_several(jnp.stack(points))
    return Manifold(combine(ways, frame.axes), placed, pick(gap, by_face.gaps), axis.of_edges | by_face.is_point)


def see_polyhedra(frame: Frame, other: Hulls) -> Polyhedra:
    """The polyhedra of other bodies as seen from frames, `(..., pairs, worlds)`."""
    (x, y, z), own = other.boxes.axes, other.polyhedra
    axes = [see_direction(frame.axes, (x[k], y[k], z[k])) for k in range(3)]
    origin = frame.see(other.boxes.center)

    def turn(vector: Vector) -> Vector:
        x, y, z = (sum_parts([lift(axes[k][i], vector) * vector[k] for k in range(3)]) for i in range(3))
        return x, y, z

    def move(vector: Vector) -> Vector:
        return add(turn(vector), lift_vector((origin[0], origin[1], origin[2]), vector))

    normals = turn(own.normals)
    return Polyhedra(
        move(own.corners),
        normals,
        own.heights + dot(normals, put_in_front((origin[0], origin[1], origin[2]))),
        move(own.polygons),
        move(own.starts),
        *(turn(part) for part in (own.ways, own.right, own.left)),
    )


def lift(part: Array, like: Vector) -> Array:
    """A number of each pair with as many axes as a vector of several things of each."""
    return part.reshape((1,) * (like[0].ndim - part.ndim) + part.shape)


def lift_vector(vector: Vector, like: Vector) -> Vector:
    """A vector of each pair with as many axes as another of several things of each."""
    return lift(vector[0], like), lift(vector[1], like), lift(vector[2], like)


def _find_axis(a: Hulls, b: Hulls, other: Polyhedra) -> _Axis:
    own = a.polyhedra
    best_a, best_b = find_best(_stand_off(own, other)), find_best(_stand_off(other, own))
    edge, number = _find_edges(own, other)
    share = PARALLEL_SHARE * (sum_parts(a.boxes.half) + sum_parts(b.boxes.half))
    on_a = best_a[0] >= best_b[0] - share
    facing_b = find_best(-_face_each_other(other, take_vector(best_a[1], own.normals)))[1]
    facing_a = find_best(-_face_each_other(own, take_vector(best_b[1], other.normals)))[1]
    faces = jnp.where(on_a, best_a[1], facing_a), jnp.where(on_a, facing_b, best_b[1])
    of_edges = edge > jnp.maximum(best_a[0], best_b[0]) + share
    count = len(other.starts[0])
    return _Axis(of_edges, on_a, faces, (number // count, number % count))


def _stand_off(one: Polyhedra, other: Polyhedra) -> Array:
    """How far all corners of another are from each face [m], below zero where one is behind it."""
    x, y, z = one.normals
    return jnp.min(dot((x[:, None], y[:, None], z[:, None]), put_in_front(other.corners)), axis=1) - one.heights


def _face_each_other(one: Polyhedra, normal: Vector) -> Array:
    """The cosines between a normal and that of each face."""
    return dot(one.normals, put_in_front(normal))


def _find_edges(one: Polyhedra, other: Polyhedra) -> tuple[Array, Array]:
    """How far polyhedra are apart along the cross product of two edges [m], the furthest of all, and its number."""
    start, way, right, left = (
        (part[0][:, None], part[1][:, None], part[2][:, None]) for part in (one.starts, one.ways, one.right, one.left)
    )
    begin, run, before, after = map(put_in_front, (other.starts, other.ways, other.right, other.left))
    # the arcs between the normals of one and those between the opposite ones of the other cross
    c, d, e, f = dot(before, way), dot(after, way), dot(right, run), dot(left, run)
    crosses = (c * d < 0) & (e * f < 0) & (c * f < 0)
    product = cross(way, run)
    square = dot(product, product)
    is_axis = crosses & (square > PARALLEL * dot(way, way) * dot(run, run))
    # both centers are inside: the normal leads out of the first
    toward = find_sign(dot(product, start))
    apart = toward * dot(product, subtract(begin, start)) / jnp.sqrt(jnp.where(is_axis, square, 1.0))
    found = jnp.where(is_axis, apart, -jnp.inf)
    return find_best(found.reshape(-1, *found.shape[2:]))


def _meet_edges(one: Polyhedra, other: Polyhedra, edges: tuple[Array, Array]) -> tuple[Vector, Vector, Array]:
    """Where two edges are next to each other: the normal, the one point [m], and the gap [m]."""
    (i, j), half = edges, jnp.asarray(0.5, one.heights.dtype)
    start, way = take_vector(i, one.starts), take_vector(i, one.ways)
    begin, run = take_vector(j, other.starts), take_vector(j, other.ways)
    product = cross(way, run)
    size = square_root(dot(product, product))
    normal = scale(find_sign(dot(product, start)) / jnp.where(size > 0, size, 1.0), product)
    on_a, on_b = find_nearest(start, way, begin, run)
    return normal, scale(half, add(on_a, on_b)), dot(normal, subtract(on_b, on_a))


def find_nearest(start: Vector, way: Vector, begin: Vector, run: Vector) -> tuple[Vector, Vector]:
    """The points [m] of two segments that are nearest to each other; the second may have no length."""
    a, b, e = dot(way, way), dot(way, run), dot(run, run)
    between = subtract(start, begin)
    c, f = dot(way, between), dot(run, between)
    square = a * e - b * b
    skew = square > PARALLEL * a * e
    share = jnp.clip(jnp.where(skew, (b * f - c * e) / jnp.where(skew, square, 1.0), 0.0), 0.0, 1.0)
    along = jnp.clip(jnp.where(e > 0, (b * share + f) / jnp.where(e > 0, e, 1.0), 0.0), 0.0, 1.0)
    share = jnp.clip((b * along - c) / jnp.where(a > 0, a, 1.0), 0.0, 1.0)
    return add(start, scale(share, way)), add(begin, scale(along, run))


def _meet_face(store: partial, one: Polyhedra, other: Polyhedra, axis: _Axis) -> Manifold:
    """Four points at which a face of one polyhedron meets one of the other."""
    (first, second), on_a = axis.faces, axis.on_a
    sides = max(len(one.polygons[0][0]), len(other.polygons[0][0]))
    polygons = (
        _take_polygon(first, one.polygons, sides),
        _take_polygon(second, other.polygons, sides),
    )
    normals = take_vector(first, one.normals), take_vector(second, other.normals)
    touched, facing = store(lambda: (choose(on_a[None], *polygons), choose(on_a[None], *polygons[::-1])))
    out, against = choose(on_a, *normals), choose(on_a, *normals[::-1])
    frame = store(lambda: _build_frame(touched, out))
    u, v, out_of = store(lambda: (*_see_all(frame, touched)[:2], see_direction(frame.axes, against)))
    places = store(lambda: _see_all(frame, facing))
    shares = store(lambda: clip_ways(_list_ways(places), (u, v)))
    candidates = store(lambda: _list_candidates((u, v), places, out_of, shares))
    along, across, gaps = pick_four(store, candidates)
    points = tuple(
        start[None] + along * axes[0][None] + across * axes[1][None] + (0.5 * gaps) * axes[2][None]
        for start, axes in zip(frame.origin, frame.axes, strict=True)
    )
    sign = find_sign(jnp.where(on_a, 1.0, -1.0).astype(gaps.dtype))
    x, y, z = points
    return Manifold(scale(sign, choose(on_a, *normals)), (x, y, z), gaps, jnp.any(candidates.valid, axis=0))


def pick_face_corners(t: ArrayLike, own: Polyhedra, normal: Array) -> Vector:
    """Four corners [m] of the face that looks against a normal of each body's frame, given by its numbers."""
    store, way = partial(materialise, t), (normal[0], normal[1], normal[2])
    face = store(lambda: find_best(-_face_each_other(own, way))[1])
    corners = store(lambda: _take_polygon(face, own.polygons, len(own.polygons[0][0])))
    frame = store(lambda: _build_frame(corners, take_vector(face, own.normals)))
    u, v, _ = store(lambda: _see_all(frame, corners))
    heights = dot(corners, put_in_front(way))
    along, across, _ = pick_four(store, Candidates(u, v, heights, jnp.ones(u.shape, bool)))
    # within the face: the heights only say which corners are deepest
    x, y, z = (
        start[None] + along * axes[0][None] + across * axes[1][None]
        for start, axes in zip(frame.origin, frame.axes, strict=True)
    )
    return x, y, z


def _take_polygon(face: Array, polygons: Vector, sides: int) -> Vector:
    """The corners of one face, `(sides, ...)`, the last given as often as there are fewer."""
    x, y, z = take_vector(face[None], polygons)
    more = [(0, sides - len(x)), (0, 0), (0, 0)]
    return jnp.pad(x, more, mode="edge"), jnp.pad(y, more, mode="edge"), jnp.pad(z, more, mode="edge")


def _build_frame(polygon: Vector, normal: Vector) -> Frame:
    """The first corner of a face with directions along its first side, across it and outward."""
    x, y, z = polygon
    side = x[1] - x[0], y[1] - y[0], z[1] - z[0]
    along = scale(1 / square_root(dot(side, side)), side)
    a, b, c = (jnp.stack(parts) for parts in zip(along, cross(normal, along), normal, strict=True))
    return Frame((x[0], y[0], z[0]), (a, b, c))


def _see_all(frame: Frame, points: Vector) -> tuple[Array, Array, Array]:
    """Several points in the frame [m], by their three numbers."""
    ways = subtract(points, put_in_front(frame.origin))
    u, v, out = (dot((x[k][None], y[k][None], z[k][None]), ways) for x, y, z in [frame.axes] for k in range(3))
    return u, v, out


def _next(corners: Array) -> Array:
    return jnp.concatenate([corners[1:], corners[:1]])


def _list_ways(places: tuple[Array, Array, Array]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Where the sides of a face start, and the ways to their ends [m], along both directions of the frame."""
    u, v, _ = places
    return (u, v), (_next(u) - u, _next(v) - v)


def clip_ways(
    ways: tuple[tuple[Array, Array], tuple[Array, Array]], corners: tuple[Array, Array]
) -> tuple[Array, Array]:
    """The shares of some ways `(ways, ...)` at which they enter and leave a polygon with corners anticlockwise, 0 to 1."""
    (u, v), (du, dv) = ways
    p, q = corners
    dp, dq = _next(p) - p, _next(q) - q
    length = square_root(dp * dp + dq * dq)[None]
    each = lambda part: part[:, None]  # noqa: E731
    inside = dp[None] * (each(v) - q[None]) - dq[None] * (each(u) - p[None])
    rate = dp[None] * each(dv) - dq[None] * each(du)
    return find_inside(inside + SIDE_SHARE * length * length, rate, axis=1)


def find_inside(begin: Array, rate: Array, axis: int) -> tuple[Array, Array]:
    """The shares of ways at which they enter and leave, 0 to 1, where no number along an axis is below zero.

    Each number is `begin` at the start of a way and changes at a `rate`. What is nowhere inside leaves before it enters.
    """
    crossing = -begin / jnp.where(rate == 0, 1.0, rate)
    never = (rate == 0) & (begin < 0)
    enters = jnp.max(jnp.where(rate > 0, crossing, jnp.where(never, 2.0, 0.0)), axis=axis)
    leaves = jnp.min(jnp.where(rate < 0, crossing, jnp.where(never, -1.0, 1.0)), axis=axis)
    return jnp.maximum(enters, 0.0), jnp.minimum(leaves, 1.0)


def _list_candidates(
    corners: tuple[Array, Array], places: tuple[Array, Array, Array], normal: Array, shares: tuple[Array, Array]
) -> Candidates:
    """Where the sides of the face that is clipped enter and leave the one that is touched, and the corners of that within it."""
    (u, v), (du, dv) = _list_ways(places)
    out = places[2]
    rise = _next(out) - out
    enters, leaves = shares
    clipped = [
        (u + share * du, v + share * dv, out + share * rise) for share in (jnp.clip(part, 0.0, 1.0) for part in shares)
    ]
    p, q = corners
    # seen from there the other face goes round clockwise
    turn = dv[None] * (p[:, None] - u[None]) - du[None] * (q[:, None] - v[None])
    steep = abs(normal[2]) > SIDE_SHARE
    within = jnp.all(turn >= -SIDE_SHARE * (du * du + dv * dv)[None], axis=1) & steep[None]
    height = out[:1] - ((p - u[:1]) * normal[:1] + (q - v[:1]) * normal[1:2]) / jnp.where(steep, normal[2], 1.0)[None]
    (u1, v1, out1), (u2, v2, out2) = clipped
    crosses = enters <= leaves
    return Candidates(
        jnp.concatenate([u1, u2, p]),
        jnp.concatenate([v1, v2, q]),
        jnp.concatenate([out1, out2, height]),
        jnp.concatenate([crosses, crosses, within]),
    )


__all__ = [
    "Hulls",
    "clip_ways",
    "find_hull_manifolds",
    "find_inside",
    "find_nearest",
    "lift",
    "lift_vector",
    "pick_face_corners",
    "see_polyhedra",
]
