"""Where a ball or a capsule touches another or a box: by the point of its segment that is nearest to a box.

Along the segment the distance to a box is convex, and half the derivative of its square is piecewise linear: its zero is
found exactly, between the places where the segment passes the planes of the box's faces. A ball or capsule is such a box
itself, without sides.
"""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.backend import materialise
from physjax.physics.rigid.space.boxes import clip_way
from physjax.physics.rigid.space.components import (
    combine,
    find_sign,
    square_root,
    sum_parts,
    take_part,
)
from physjax.physics.rigid.space.manifolds import POINTS, Boxes, Frame, Manifold, see_direction

LINE_SHARE = 1e-2
"""Share of the radii that a capsule's segment gains in distance times the sine of its slope, to either side of the nearest
point, at the ends of the line along which it touches: along another it touches with two points, across it with one."""
INSIDE_SHARE = 1e-6
"""Share of the radius within which the segment is in the box rather than above a face."""


class _Segment(NamedTuple):
    """A segment as seen from a box, three numbers in front: its middle [m], its direction, and half of its length [m]."""

    middle: Array
    along: Array
    half: Array

    def at(self, place: Array) -> Array:
        """The points that far from the middle [m], `(3, places, ...)`."""
        return self.middle[:, None] + place[None] * self.along[:, None]


def find_segment_manifolds(t: ArrayLike, box: Boxes, other: Boxes, has_sides: bool) -> Manifold:
    """Two points at which a ball or capsule `other` touches a box, or another of its kind, which has no sides."""
    store = partial(materialise, t)
    frame = Frame(box.center, box.axes)
    segment = store(lambda: _see_segment(frame, other))
    ends = store(lambda: _find_line(segment, box, other))
    way = store(lambda: _find_way(segment.at(jnp.mean(ends, axis=0, keepdims=True)), box.half)[:, 0])
    normal, apart = store(lambda: _find_normal(way, other.radius))
    if has_sides:
        normal, ends = store(lambda: _prefer_faces(segment, box.half, (apart, way, normal), ends))
    point, direction = segment.at(ends), normal[:, None]
    # of a face the height above it, of an edge or corner that above its nearest point
    side = jnp.where(abs(direction) > 1 - INSIDE_SHARE, find_sign(direction), 0.0) * box.half[:, None]
    below = jnp.where(side == 0, jnp.clip(point, -box.half[:, None], box.half[:, None]), side)
    heights = sum_parts(direction * (point - below))
    gaps = heights - (box.radius + other.radius)[None]
    middle = point - (other.radius[None] + gaps / 2)[None] * direction
    placed = frame.place_several(middle)
    twice = lambda part: jnp.concatenate([part] * (POINTS // 2))  # noqa: E731
    points = twice(placed[0]), twice(placed[1]), twice(placed[2])
    return Manifold(combine(normal, frame.axes), points, twice(gaps), jnp.ones(apart.shape, bool))


def _see_segment(frame: Frame, shape: Boxes) -> _Segment:
    """The segment within a ball or capsule, along the axis in which it has a length."""
    share = jnp.where(shape.half > 0, 1.0, 0.0).astype(shape.half.dtype)
    along = see_direction(frame.axes, combine(share, shape.axes))
    return _Segment(frame.see(shape.center), along, sum_parts(shape.half) + jnp.zeros_like(along[0]))


def _find_way(point: Array, half: Array) -> Array:
    """From the nearest points of the box to points `(3, places, ...)` [m]."""
    return point - jnp.clip(point, -half[:, None], half[:, None])


def _find_normal(way: Array, radius: Array) -> tuple[Array, Array]:
    """The direction from the box to the nearest point, and whether that is outside; two centers in one place part along x."""
    distance = square_root(sum_parts(way * way))
    apart = distance > INSIDE_SHARE * radius
    x = jnp.array([1.0, 0.0, 0.0], way.dtype).reshape(3, 1, 1)
    return jnp.where(apart[None], way / jnp.where(apart, distance, 1.0)[None], x), apart


def _find_line(segment: _Segment, box: Boxes, other: Boxes) -> Array:
    """Both ends of the line along which a segment is nearest to a box, as distances from its middle [m], `(2, ...)`.

    There half the derivative of the square of its distance is a little below and above zero, or the segment ends.
    """
    sign = jnp.array([-1.0, 1.0], segment.half.dtype).reshape(2, 1, 1)
    level = LINE_SHARE * sign * (box.radius + other.radius)[None]
    slope = lambda place: sum_parts(segment.along[:, None] * _find_way(segment.at(place), box.half))  # noqa: E731
    reach = segment.half[None]
    places = [-reach, reach]
    for middle, along, own in zip(segment.middle, segment.along, box.half, strict=True):
        step = jnp.where(abs(along) > INSIDE_SHARE, along, jnp.inf)
        places += [jnp.clip((side * own - middle) / step, -segment.half, segment.half)[None] for side in (-1.0, 1.0)]
    low = high = jnp.zeros_like(level + reach)
    low, high = low - reach, high + reach
    for place in places:
        below = slope(place) <= level
        low, high = jnp.where(below, jnp.maximum(low, place), low), jnp.where(below, high, jnp.minimum(high, place))
    at_low, at_high = slope(low), slope(high)
    rise = at_high - at_low
    share = jnp.where(rise > 0, (level - at_low) / jnp.where(rise > 0, rise, 1.0), 0.0)
    return low + jnp.clip(share, 0.0, 1.0) * (high - low)


def _prefer_faces(
    segment: _Segment, half: Array, nearest: tuple[Array, Array, Array], ends: Array
) -> tuple[Array, Array]:
    """The normal, and the places along the segment at which it touches: of a face what lies above it."""
    apart, way, normal = nearest
    beyond = way != 0
    over_face = apart & (sum_parts(beyond.astype(jnp.int32)) == 1)
    # inside, the face that is nearest to all of the segment
    depths = abs(segment.middle) - half - segment.half[None] * abs(segment.along)
    first = lambda flags: jnp.where(flags[0], 0, jnp.where(flags[1], 1, 2))  # noqa: E731
    deepest = depths[0] >= jnp.maximum(depths[1], depths[2]), depths[1] >= depths[2]
    face = jnp.where(over_face, first(beyond), first(deepest))
    on_face = over_face | ~apart
    sign = find_sign(jnp.where(over_face, take_part(face, way), take_part(face, segment.middle)))
    numbers = jnp.arange(3, dtype=face.dtype).reshape(3, 1, 1)
    normal = jnp.where(on_face[None], jnp.where(face[None] == numbers, sign[None], 0.0), normal)
    sides = [(face + by) % 3 for by in (1, 2)]
    start, length = segment.middle - segment.half[None] * segment.along, 2 * segment.half
    u, v = (take_part(side, start) for side in sides)
    du, dv = (length * take_part(side, segment.along) for side in sides)
    enters, leaves = clip_way((u, v), (du, dv), (take_part(sides[0], half), take_part(sides[1], half)))
    # what is nowhere above the face touches where it is nearest
    above = on_face & (enters <= leaves)
    clipped = jnp.stack([jnp.clip(share, 0.0, 1.0) * length - segment.half for share in (enters, leaves)])
    return normal, jnp.where(above[None], clipped, ends)


__all__ = ["find_segment_manifolds"]
