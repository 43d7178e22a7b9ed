"""Where two boxes touch: by the fifteen axes that can separate them, and by clipping one face against another.

The axes are the normals of three faces of each and the cross products of an edge of one with an edge of the other
(S. Gottschalk 1996). Where a face is touched the other's face is clipped against its sides, and four points remain: the
deepest, the one furthest from it, and those furthest to either side of the line through both.
"""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.backend import materialise
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
    subtract,
    sum_parts,
    take_part,
    take_vector,
)
from physjax.physics.rigid.space.manifolds import POINTS, Boxes, Frame, Manifold, see_direction

PARALLEL_SHARE = 1e-3
"""Share of the boxes' size by which another axis must be further out to be taken for the one that is touched along."""
SAME_DIRECTION = 1e-6
"""Square of the sine of the angle between edges below which they are parallel, and their cross product is no axis."""
SIDE_SHARE = 1e-6
"""Share of a side within which a point on it is inside."""
AROUND = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
"""The corners of a square, one after the other."""


class _Axis(NamedTuple):
    """The axis along which boxes touch: of a face of a or of b, or of two edges; and the numbers of both edges."""

    of_edges: Array
    on_a: Array
    face: Array
    edges: tuple[Array, Array]


class _Face(NamedTuple):
    """A face as seen from another, in a frame with its sides and its outward normal [m]: its middle and half of its sides.

    Each has three numbers in front.
    """

    middle: Array
    sides: tuple[Array, Array]


class Candidates(NamedTuple):
    """Points of which four are picked [m]: along both sides of the face that is touched and out of it; which ones are any."""

    u: Array
    v: Array
    out: Array
    valid: Array


def find_box_manifolds(t: ArrayLike, a: Boxes, b: Boxes) -> Manifold:
    """The points at which boxes touch at time t [s], which only orders the work."""
    store = partial(materialise, t)
    between = subtract(b.center, a.center)
    cosines = store(lambda: dot(_spread(a.axes, 1), _spread(b.axes, 0)))
    ways = store(lambda: (see_direction(a.axes, between), see_direction(b.axes, between)))
    axis = store(lambda: _find_axis(a, b, cosines, ways))
    normal, point, gap = store(lambda: _meet_edges(a, b, axis.edges, cosines))
    by_face = store(lambda: _meet_face(store, a, b, axis))
    pick = lambda edge, face: jnp.where(axis.of_edges[None], edge[None], face)  # noqa: E731
    x, y, z = (pick(edge, face) for edge, face in zip(point, by_face.points, strict=True))
    is_point = axis.of_edges | by_face.is_point
    return Manifold(choose(axis.of_edges, normal, by_face.normal), (x, y, z), pick(gap, by_face.gaps), is_point)


def _spread(axes: Vector, place: int) -> Vector:
    x, y, z = (jnp.expand_dims(part, place) for part in axes)
    return x, y, z


def _find_axis(a: Boxes, b: Boxes, cosines: Array, ways: tuple[Array, Array]) -> _Axis:
    size = abs(cosines)
    on_a = abs(ways[0]) - a.half - (size[:, 0] * b.half[:1] + size[:, 1] * b.half[1:2] + size[:, 2] * b.half[2:])
    on_b = abs(ways[1]) - b.half - (size[0] * a.half[:1] + size[1] * a.half[1:2] + size[2] * a.half[2:])
    best_a, best_b = find_best(on_a), find_best(on_b)
    edge, first, second = _find_edges(a.half, b.half, cosines, ways[0])
    share = PARALLEL_SHARE * (sum_parts(a.half) + sum_parts(b.half))
    prefers_a = best_a[0] >= best_b[0] - share
    of_edges = edge > jnp.maximum(best_a[0], best_b[0]) + share
    return _Axis(of_edges, prefers_a, jnp.where(prefers_a, best_a[1], best_b[1]), (first, second))


def _find_edges(half_a: Array, half_b: Array, cosines: Array, way: Array) -> tuple[Array, Array, Array]:
    """How far boxes are apart along the cross product of two edges [m], the furthest of nine, and the numbers of the edges."""
    separations = []
    for i in range(3):
        i1, i2 = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            j1, j2 = (j + 1) % 3, (j + 2) % 3
            c = cosines[i][j]
            square = 1 - c * c
            is_axis = square > SAME_DIRECTION
            apart = abs(way[i2] * cosines[i1][j] - way[i1] * cosines[i2][j])
            reach = half_a[i1] * abs(cosines[i2][j]) + half_a[i2] * abs(cosines[i1][j])
            reach = reach + half_b[j1] * abs(cosines[i][j2]) + half_b[j2] * abs(cosines[i][j1])
            distance = (apart - reach) / jnp.sqrt(jnp.where(is_axis, square, 1.0))
            separations.append(jnp.where(is_axis, distance, -jnp.inf))
    best, index = find_best(separations)
    return best, index // 3, index % 3


def _meet_edges(a: Boxes, b: Boxes, edges: tuple[Array, Array], cosines: Array) -> tuple[Vector, Vector, Array]:
    """Where an edge of a meets an edge of b: the normal, the one point [m], and the gap [m]."""
    i, j = edges
    along_a, along_b = take_vector(i, a.axes), take_vector(j, b.axes)
    c = take_part(i, [take_part(j, cosines[k]) for k in range(3)])
    square = jnp.maximum(1 - c * c, SAME_DIRECTION)
    product = cross(along_a, along_b)
    toward = find_sign(dot(product, subtract(b.center, a.center)))
    normal = scale(toward / jnp.sqrt(square), product)
    on_a, on_b = _find_edge_center(a, i, normal, 1.0), _find_edge_center(b, j, normal, -1.0)
    between = subtract(on_b, on_a)
    da, db = dot(between, along_a), dot(between, along_b)
    reach_a, reach_b = take_part(i, a.half), take_part(j, b.half)
    on_a = add(on_a, scale(jnp.clip((da - c * db) / square, -reach_a, reach_a), along_a))
    on_b = add(on_b, scale(jnp.clip((c * da - db) / square, -reach_b, reach_b), along_b))
    middle = scale(jnp.asarray(0.5, c.dtype), add(on_a, on_b))
    return normal, middle, dot(normal, subtract(on_b, on_a))


def _find_edge_center(box: Boxes, edge: Array, normal: Vector, sign: float) -> Vector:
    """The middle of the edge along one axis that is furthest along the normal, or against it."""
    ways = find_sign(sign * see_direction(box.axes, normal)) * box.half
    numbers = jnp.arange(3, dtype=jnp.int32).reshape(3, 1, 1)
    return add(box.center, combine(jnp.where(edge[None] == numbers, 0.0, ways), box.axes))


def _meet_face(store: partial, a: Boxes, b: Boxes, axis: _Axis) -> Manifold:
    """Four points at which a face of one box meets one of the other."""
    touched, other = _choose_box(axis.on_a, a, b), _choose_box(axis.on_a, b, a)
    frame, sides = store(lambda: _build_face_frame(touched, other, axis.face))
    face = store(lambda: _find_facing(frame, other))
    shares = store(lambda: _clip_edges(face, sides))
    candidates = store(lambda: _list_candidates(face, sides, shares))
    u, v, out = pick_four(store, candidates)
    sign = jnp.where(axis.on_a, 1.0, -1.0).astype(out.dtype)
    x, y, z = (part[2] for part in frame.axes)
    origin, axes = put_in_front(frame.origin), frame.axes
    points = [
        start + u * along[:1] + v * along[1:2] + (0.5 * out) * along[2:]
        for start, along in zip(origin, axes, strict=True)
    ]
    return Manifold(scale(sign, (x, y, z)), (points[0], points[1], points[2]), out, jnp.any(candidates.valid, axis=0))


def _choose_box(flag: Array, a: Boxes, b: Boxes) -> Boxes:
    half = jnp.where(flag[None], a.half, b.half)
    return Boxes(choose(flag, a.center, b.center), choose(flag[None], a.axes, b.axes), half, a.radius)


def _build_face_frame(box: Boxes, other: Boxes, face: Array) -> tuple[Frame, Array]:
    """The middle of a face with directions along its sides and outward, towards the other box; and its half sides [m]."""
    out = take_vector(face, box.axes)
    sign = find_sign(dot(out, subtract(other.center, box.center)))
    out, along = scale(sign, out), take_vector((face + 1) % 3, box.axes)
    sides = take_part((face + 1) % 3, box.half), take_part((face + 2) % 3, box.half)
    middle = add(box.center, scale(take_part(face, box.half), out))
    x, y, z = (jnp.stack(parts) for parts in zip(along, cross(out, along), out, strict=True))
    return Frame(middle, (x, y, z)), jnp.stack(sides)


def _find_facing(frame: Frame, box: Boxes) -> _Face:
    """The box's face that looks at the frame, as seen from there."""
    # rows are the directions of the frame, columns the axes of the box
    axes = dot(_spread(frame.axes, 1), _spread(box.axes, 0))
    _, face = find_best(abs(axes[2]))
    numbers = [(face + by) % 3 for by in range(3)]
    out, p, q = (
        take_part(number, box.half)[None] * take_part(number[None], [axes[:, k] for k in range(3)])
        for number in numbers
    )
    return _Face(frame.see(box.center) - find_sign(out[2])[None] * out, (p, q))


def _number(values: np.ndarray, like: Array) -> Array:
    return jnp.asarray(values.reshape(-1, *(1,) * like.ndim), like.dtype)


def _list_edges(face: _Face) -> tuple[list[Array], list[Array]]:
    """The edges of a face, in front: where each starts, and the way to its end [m]."""
    p, q = face.sides
    turn = 0.5 * (np.roll(AROUND, -1, axis=0) - AROUND)
    corner = [_number(AROUND[:, k], p[0]) for k in (0, 1)]
    step = [_number(2 * turn[:, k], p[0]) for k in (0, 1)]
    starts = [m[None] + corner[0] * i[None] + corner[1] * j[None] for m, i, j in zip(face.middle, p, q, strict=True)]
    return starts, [step[0] * i[None] + step[1] * j[None] for i, j in zip(p, q, strict=True)]


def _clip_edges(face: _Face, sides: Array) -> tuple[Array, Array]:
    """The shares of the edges of a face at which they enter and leave a rectangle, `(4, ...)`."""
    starts, ways = _list_edges(face)
    return clip_way((starts[0], starts[1]), (ways[0], ways[1]), (sides[:1], sides[1:]))


def clip_way(start: tuple[Array, Array], way: tuple[Array, Array], sides: tuple[Array, Array]) -> tuple[Array, Array]:
    """The shares of a way at which it enters and leaves a rectangle with these half sides, from 0 to 1."""
    enters, leaves = jnp.zeros_like(start[0]), jnp.ones_like(start[0])
    for place, step, side in zip(start, way, sides, strict=True):
        within, small = side * (1 + SIDE_SHARE), SIDE_SHARE * SIDE_SHARE * side
        step = jnp.where(abs(step) < small, small, step)
        one, two = (-within - place) / step, (within - place) / step
        enters, leaves = jnp.maximum(enters, jnp.minimum(one, two)), jnp.minimum(leaves, jnp.maximum(one, two))
    return enters, leaves


def _list_candidates(face: _Face, sides: Array, shares: tuple[Array, Array]) -> Candidates:
    """Where the edges of a face enter and leave a rectangle, and the corners of the rectangle that lie within the face."""
    (starts, ways), (enters, leaves) = _list_edges(face), shares
    on_edges = [
        start + jnp.clip(share, 0.0, 1.0) * way for share in shares for start, way in zip(starts, ways, strict=True)
    ]
    corners = [_number(AROUND[:, k], sides[0]) * sides[k : k + 1] for k in (0, 1)]
    (p, q), middle = face.sides, face.middle
    area = p[0] * q[1] - p[1] * q[0]
    is_face = abs(area) > SIDE_SHARE * sides[0] * sides[1]
    inverse = (1 / jnp.where(is_face, area, jnp.inf))[None]
    du, dv = corners[0] - middle[:1], corners[1] - middle[1:2]
    r, s = (du * q[1:2] - dv * q[:1]) * inverse, (p[:1] * dv - p[1:2] * du) * inverse
    within = is_face[None] & (abs(r) <= 1 + SIDE_SHARE) & (abs(s) <= 1 + SIDE_SHARE)
    out = middle[2:] + r * p[2:] + s * q[2:]
    join = lambda k, last: jnp.concatenate([on_edges[k], on_edges[3 + k], last])  # noqa: E731
    crosses = enters <= leaves
    valid = jnp.concatenate([crosses, crosses, within])
    return Candidates(join(0, corners[0]), join(1, corners[1]), join(2, out), valid)


def pick_four(store: partial, of: Candidates) -> tuple[Array, Array, Array]:
    """The deepest of some points, the one furthest from it, and those furthest to either side of the line through both."""
    pick = lambda score: find_best(jnp.where(of.valid, score, -jnp.inf))[1]  # noqa: E731
    first = store(lambda: pick(-of.out))
    du, dv = of.u - take_part(first, of.u)[None], of.v - take_part(first, of.v)[None]
    second = store(lambda: pick(du * du + dv * dv))
    side = lambda: take_part(second, du)[None] * dv - take_part(second, dv)[None] * du  # noqa: E731
    third, fourth = store(lambda: (pick(side()), pick(-side())))
    chosen = store(lambda: jnp.stack([first, third, second, fourth]))
    each = lambda part: take_part(chosen, part[:, None])  # noqa: E731
    return each(of.u), each(of.v), each(of.out)


assert len(AROUND) == POINTS

__all__ = ["AROUND", "PARALLEL_SHARE", "SIDE_SHARE", "Candidates", "clip_way", "find_box_manifolds", "pick_four"]
