"""Where a ball or a capsule touches a convex polyhedron: by the point of its segment that is nearest to a face or an edge."""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.backend import materialise
from physjax.physics.rigid.space.boxes import SIDE_SHARE
from physjax.physics.rigid.space.components import (
    Vector,
    add,
    choose,
    combine,
    cross,
    dot,
    find_best,
    put_in_front,
    scale,
    square_root,
    subtract,
    sum_parts,
    take_part,
    take_vector,
)
from physjax.physics.rigid.space.hulls import Hulls, find_inside, find_nearest, lift_vector
from physjax.physics.rigid.space.manifolds import POINTS, Boxes, Frame, Manifold, see_direction
from physjax.physics.rigid.space.polyhedra import Polyhedra

FLAT = 5e-5
"""One minus the cosine of the angle to a face below which a capsule lies along it, and touches it with two points."""


class _Nearest(NamedTuple):
    """The direction from the nearest point of a polyhedron, that point of the segment as a share of it, and the distance [m]."""

    normal: Vector
    share: Array
    distance: Array


def find_round_manifolds(t: ArrayLike, hull: Hulls, other: Boxes) -> Manifold:
    """Two points at which a ball or capsule `other` touches a polyhedron, at time t [s], which only orders the work."""
    store, own = partial(materialise, t), hull.polyhedra
    frame = Frame(hull.boxes.center, hull.boxes.axes)
    start, way = store(lambda: _see_segment(frame, other))
    nearest = store(lambda: _find_nearest(own, start, way))
    normal, shares = store(lambda: _prefer_faces(own, start, way, nearest))
    points = [part[None] + shares * along[None] for part, along in zip(start, way, strict=True)]
    face = store(lambda: find_best(dot(own.normals, put_in_front(normal)))[1])
    # of a face the height above it, else the distance of the one nearest point
    flat, plane = store(lambda: (_lies_flat(own, face, normal), take_part(face, own.heights)))
    above = sum_parts([n[None] * part for n, part in zip(normal, points, strict=True)]) - plane[None]
    gaps = jnp.where(flat[None], above, nearest.distance[None]) - other.radius[None]
    middle = [part - (other.radius[None] + gaps / 2) * n[None] for part, n in zip(points, normal, strict=True)]
    placed = frame.place_several(jnp.stack(middle))
    twice = lambda part: jnp.concatenate([part] * (POINTS // 2))  # noqa: E731
    found = twice(placed[0]), twice(placed[1]), twice(placed[2])
    return Manifold(combine(jnp.stack(normal), frame.axes), found, twice(gaps), jnp.ones(flat.shape, bool))


def find_nearest_point(polyhedra: Polyhedra, place: Vector) -> Vector:
    """The point of each polyhedron that is nearest to a place in its frame [m]: the place itself where that is inside."""
    nearest = _find_nearest(polyhedra, place, scale(jnp.zeros_like(place[0]), place))
    return subtract(place, scale(jnp.maximum(nearest.distance, 0.0), nearest.normal))


def _see_segment(frame: Frame, shape: Boxes) -> tuple[Vector, Vector]:
    """The segment within a ball or capsule as seen from frames [m]: its start, and the way to its end."""
    x, y, z = see_direction(frame.axes, combine(shape.half, shape.axes))
    middle = frame.see(shape.center)
    return (middle[0] - x, middle[1] - y, middle[2] - z), (2 * x, 2 * y, 2 * z)


def _find_nearest(own: Polyhedra, start: Vector, way: Vector) -> _Nearest:
    """From the edges, the faces, and within from the face that is nearest to all of the segment."""
    begin, run = lift_vector(start, own.starts), lift_vector(way, own.starts)
    on_edge, on_segment = find_nearest(own.starts, own.ways, begin, run)
    between = subtract(on_segment, on_edge)
    squares = dot(between, between)
    edge = find_best(-squares)[1]
    out, point = take_vector(edge, between), take_vector(edge, on_segment)
    distance = square_root(dot(out, out))
    length = dot(way, way)
    share = dot(subtract(point, start), way) / jnp.where(length > 0, length, 1.0)
    normal = scale(1 / jnp.where(distance > 0, distance, 1.0), out)
    shares = jnp.stack([jnp.zeros_like(share), jnp.ones_like(share)])
    for end in (0, 1):
        above, face = _rise_above(own, add(start, scale(shares[end], way)))
        nearer = above < distance
        distance, share = jnp.where(nearer, above, distance), jnp.where(nearer, shares[end], share)
        normal = choose(nearer, take_vector(face, own.normals), normal)
    first, last = _stand(own, start), _stand(own, add(start, way))
    depth, face = find_best(jnp.minimum(first, last))
    enters, leaves = find_inside(-first, first - last, axis=0)
    inside = (enters <= leaves) | (distance <= 0)
    lower = jnp.where(take_part(face, first) <= take_part(face, last), shares[0], shares[1])
    return _Nearest(
        choose(inside, take_vector(face, own.normals), normal),
        jnp.where(inside, lower, share),
        jnp.where(inside, depth, distance),
    )


def _stand(own: Polyhedra, place: Vector) -> Array:
    """How far a place is above the plane of each face [m]."""
    return dot(own.normals, put_in_front(place)) - own.heights


def _rise_above(own: Polyhedra, place: Vector) -> tuple[Array, Array]:
    """How far a place is above the face that it is right above [m], infinitely far where it is above none; and which one."""
    height, inside = _stand(own, place), _measure_within(own.polygons, own.normals, place)
    best, face = find_best(jnp.where((height >= 0) & jnp.all(inside >= 0, axis=1), -height, -jnp.inf))
    return -best, face


def _measure_within(polygons: Vector, normals: Vector, place: Vector) -> Array:
    """How far a place is within each side of each face, times the length of the side [m²], `(faces, sides, ...)`."""
    x, y, z = polygons
    corner = x, y, z
    after = tuple(jnp.concatenate([part[:, 1:], part[:, :1]], axis=1) for part in corner)
    side = subtract((after[0], after[1], after[2]), corner)
    normal = normals[0][:, None], normals[1][:, None], normals[2][:, None]
    return dot(cross(normal, side), subtract(lift_vector(place, corner), corner))


def _lies_flat(own: Polyhedra, face: Array, normal: Vector) -> Array:
    return dot(take_vector(face, own.normals), normal) > 1 - FLAT


def _prefer_faces(own: Polyhedra, start: Vector, way: Vector, nearest: _Nearest) -> tuple[Vector, Array]:
    """The normal, and the shares of the segment at which it touches, `(2, ...)`: of a face both ends of what is above it."""
    face = find_best(dot(own.normals, put_in_front(nearest.normal)))[1]
    flat, out = _lies_flat(own, face, nearest.normal), take_vector(face, own.normals)
    x, y, z = take_vector(face[None], own.polygons)
    polygon = x[None], y[None], z[None]
    lies = out[0][None], out[1][None], out[2][None]
    begin, end = (_measure_within(polygon, lies, place)[0] for place in (start, add(start, way)))
    reach = SIDE_SHARE * (dot(way, way) + own.heights[0] ** 2)[None]
    enters, leaves = find_inside(begin + reach, end - begin, axis=0)
    two = flat & (enters <= leaves)
    shares = [jnp.where(two, edge, nearest.share) for edge in (enters, leaves)]
    return choose(flat, out, nearest.normal), jnp.stack(shares)


__all__ = ["find_nearest_point", "find_round_manifolds"]
