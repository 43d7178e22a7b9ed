"""Where shapes in space touch the surfaces of `contacts`: flat ones with the face that looks at them, others point by point."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.physics.contacts.surface import Surface
from physjax.physics.rigid.space.boxes import AROUND
from physjax.physics.rigid.space.components import (
    Vector,
    add,
    find_best,
    find_sign,
    put_in_front,
    scale,
    subtract,
    take_part,
    take_vector,
)
from physjax.physics.rigid.space.hulls import pick_face_corners
from physjax.physics.rigid.space.manifolds import POINTS, Boxes, Frame, Manifold, see_direction
from physjax.physics.rigid.space.polyhedra import Polyhedra
from physjax.physics.rigid.space.round_hulls import find_nearest_point
from physjax.physics.rigid.space.shapes import Shape, build_polyhedra

SEARCH_TURNS = 16
"""Turns of the search for a box's nearest point to a curved surface: to the surface, and back to the box."""
NEAREST = -1
"""The number of the point that is nearest, where others are those of a face's corners."""


class Slot(NamedTuple):
    """A place for contacts of every body with a surface: of a flat one with all points, of a curved one with one of them."""

    surface: Surface
    point: int | None


def list_slots(surfaces: Sequence[Surface], shapes: Sequence[Shape]) -> list[Slot]:
    """The places for contacts with these surfaces; a room is its pairs of walls."""
    walls = [wall for surface in surfaces for wall in surface.walls()]
    corners = [NEAREST] if all(shape.kind == "sphere" for shape in shapes) else [NEAREST, *range(POINTS)]
    return [Slot(wall, point) for wall in walls for point in (corners if wall.curved else [None])]


class _Solids(NamedTuple):
    """Bodies by the boxes they lie in, and the polyhedra of those that are hulls, with their numbers."""

    boxes: Boxes
    hulls: tuple[np.ndarray, Polyhedra] | None


def find_surface_manifolds(slots: Sequence[Slot], t: ArrayLike, boxes: Boxes, shapes: Sequence[Shape]) -> Manifold:
    """The points at which every body touches each surface, slot after slot, with normals from the body to the surface."""
    rows = np.array([row for row, shape in enumerate(shapes) if shape.kind == "hull"], int)
    hulls = (rows, build_polyhedra([shapes[row] for row in rows], boxes.half.dtype)) if len(rows) else None
    found = [_find_manifold(slot, t, _Solids(boxes, hulls)) for slot in slots]
    return jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=-2), *found)


def _find_manifold(slot: Slot, t: ArrayLike, solids: _Solids) -> Manifold:
    surface, (boxes, _) = slot.surface, solids
    if slot.point == NEAREST:
        points = put_in_front(_search_nearest(surface, t, solids))
    else:
        points = _list_corners(t, solids, _measure_normal(surface, t, boxes.center))
    if slot.point is not None and slot.point != NEAREST:
        x, y, z = (part[slot.point][None] for part in points)
        points = x, y, z
    # flat ones have one normal, of the others there is one point
    normal = _measure_normal(surface, t, (points[0][0], points[1][0], points[2][0]))
    gaps = _measure(surface, t, points) - boxes.radius[None]
    x, y, z = subtract(points, scale(boxes.radius[None] + gaps / 2, put_in_front(normal)))
    all_points = lambda part: jnp.broadcast_to(part, (POINTS, *part.shape[1:]))  # noqa: E731
    towards = scale(-jnp.ones_like(normal[0]), normal)
    placed = all_points(x), all_points(y), all_points(z)
    return Manifold(towards, placed, all_points(gaps), jnp.ones(normal[0].shape, bool))


def _list_corners(t: ArrayLike, solids: _Solids, normal: Vector) -> Vector:
    """Four corners of the face that looks against a normal, in front."""
    boxes, hulls = solids
    corners = _list_box_corners(boxes, normal)
    if hulls is None:
        return corners
    rows, polyhedra = hulls
    frame, way = _pick_frames(boxes, rows), (normal[0][rows], normal[1][rows], normal[2][rows])
    placed = frame.place_several(jnp.stack(pick_face_corners(t, polyhedra, see_direction(frame.axes, way))))
    x, y, z = (_replace_rows(part, rows, other) for part, other in zip(corners, placed, strict=True))
    return x, y, z


def _replace_rows(part: Array, rows: np.ndarray, others: Array) -> Array:
    """Numbers of all bodies `(..., bodies, worlds)` with those of some bodies in place of their own."""
    bodies = part.shape[-2]
    source = np.arange(bodies)
    source[rows] = bodies + np.arange(len(rows))
    return jnp.concatenate([part, others], axis=-2)[..., source, :]


def _pick_frames(boxes: Boxes, rows: np.ndarray) -> Frame:
    """The frames of some bodies."""
    x, y, z = (part[:, rows] for part in boxes.axes)
    return Frame((boxes.center[0][rows], boxes.center[1][rows], boxes.center[2][rows]), (x, y, z))


def _list_box_corners(shapes: Boxes, normal: Vector) -> Vector:
    """The corners of the face that looks against a normal, in front."""
    ways = see_direction(shapes.axes, normal)
    _, face = find_best(abs(ways))
    down = -find_sign(take_part(face, ways))
    out, p, q = (
        scale(take_part(number, shapes.half), take_vector(number, shapes.axes))
        for number in ((face + by) % 3 for by in range(3))
    )
    middle = put_in_front(add(shapes.center, scale(down, out)))
    r, s = (jnp.asarray(AROUND[:, k].reshape(-1, 1, 1), down.dtype) for k in (0, 1))
    return add(middle, add(scale(r, put_in_front(p)), scale(s, put_in_front(q))))


def _search_nearest(surface: Surface, t: ArrayLike, solids: _Solids) -> Vector:
    """The point of each body that is nearest to a surface: from the center to the surface and back to the body, in turns."""
    boxes, hulls = solids
    frame = Frame(boxes.center, boxes.axes)

    def narrow(place: Array, _: Any) -> tuple[Array, None]:
        point = frame.place(place)
        way = see_direction(frame.axes, _measure_normal(surface, t, point))
        beyond = place - _measure(surface, t, point)[None] * way
        back = jnp.clip(beyond, -boxes.half, boxes.half)
        if hulls is not None:
            rows, polyhedra = hulls
            x, y, z = beyond[:, rows]
            back = _replace_rows(back, rows, jnp.stack(find_nearest_point(polyhedra, (x, y, z))))
        return back, None

    # the nearest point moves across the normal, where the distance does not change: its derivative is that of a fixed place
    place, _ = lax.scan(narrow, jnp.zeros_like(boxes.axes[0]), length=SEARCH_TURNS)
    return frame.place(lax.stop_gradient(place))


def _measure(surface: Surface, t: ArrayLike, place: Vector) -> Array:
    return surface.signed_distance(t, jnp.stack(place, axis=-1))


def _measure_normal(surface: Surface, t: ArrayLike, place: Vector) -> Vector:
    normal = surface.normal_at(t, jnp.stack(place, axis=-1))
    return normal[..., 0], normal[..., 1], normal[..., 2]


__all__ = ["Slot", "find_surface_manifolds", "list_slots"]
