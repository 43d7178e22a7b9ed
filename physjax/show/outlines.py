"""The surfaces of a scene in space as polygons: in closed form where the shape is known, else from the signed distance."""

import math
from collections.abc import Callable, Sequence
from itertools import product
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from physjax.parts import Contact
from physjax.physics.contacts.shapes import Plane, Room, Slab, Sphere
from physjax.show import level_sets
from physjax.show.stage import NEAR_FLOOR_SHARE, Stage

DRAWN_BALL_SHARE = 0.985
"""A ball is drawn a little smaller, or flat faces of the cloth on it would cut into it."""
BALL_RINGS = 24
"""Rings of flat patches from pole to pole of a ball."""
PICTURE_CELLS = 32
"""Cells along the longest side of the box for a surface drawn from its signed distance: some 3 000 faces, a third of a
second in matplotlib."""
RAY_SAMPLES = 48
"""Points of a line of sight at which the signed distance is asked for what hides what."""


class Ball(NamedTuple):
    """A sphere that is known as one: its center and radius [m]."""

    center: np.ndarray
    radius: float


class Outline(NamedTuple):
    """What a surface looks like at a time: polygons `(corners, 3)` [m], and unit normals if they are patches of one that bends.

    What is `solid` hides what is behind it; the rest is drawn as glass. `ball` says that it is one. An outline with a
    `velocity` [m/s] moves on as it is; one without has to be asked for at every time.
    """

    polygons: Sequence[np.ndarray] | np.ndarray
    normals: np.ndarray | None = None
    solid: bool = False
    ball: Ball | None = None
    velocity: np.ndarray | None = None


class ClosedForm(NamedTuple):
    """A shape whose picture is known without asking its signed distance: points that belong into it, and its outline.

    Both are functions of the contact, the stage and the time [s].
    """

    corners: Callable[..., list[np.ndarray]]
    outline: Callable[..., Outline]


def find_corners(contact: Contact, stage: Stage, t: float) -> list[np.ndarray]:
    """Points of a surface that belong into the picture, in the plane or in space."""
    known = _get_closed_form(contact)
    return level_sets.find_corners(contact, stage, t) if known is None else known.corners(contact, stage, t)


def build_outline(contact: Contact, stage: Stage, t: float, cells: int = PICTURE_CELLS) -> Outline:
    """What of a surface is in a box in space at a time: the shape's own outline, its closed form, or its level set."""
    own = contact.outline(t, stage.low, stage.high)
    if own is not None:
        return Outline([np.asarray(polygon, float) for polygon in own])
    known = _get_closed_form(contact)
    if known is not None:
        return known.outline(contact, stage, t)
    vertices, faces = level_sets.extract_level_set(contact, stage, t, cells)
    patches = vertices[faces]
    across = np.cross(patches[:, 2] - patches[:, 0], patches[:, 3] - patches[:, 1])
    length = np.sqrt((across * across).sum(axis=-1, keepdims=True))
    # faces that are not wholly beyond one side of the box; of those few reach out of it
    near = ((patches.max(axis=1) >= stage.low) & (patches.min(axis=1) <= stage.high)).all(axis=-1) & (length[:, 0] > 0)
    patches, normals = patches[near], across[near] / length[near]
    whole = ((patches >= stage.low) & (patches <= stage.high)).all(axis=(1, 2))
    polygons = [*patches[whole], *(_clip_to_box(patch, stage) for patch in patches[~whole])]
    return Outline(
        polygons, np.concatenate([normals[whole], normals[~whole]]), level_sets.is_bounded(contact, stage, t)
    )


def _clip_to_box(polygon: np.ndarray, stage: Stage) -> np.ndarray:
    """The part of a convex polygon `(corners, 3)` that is in the box; without corners if none is."""
    for axis, side in product(range(3), (1.0, -1.0)):
        # Sutherland and Hodgman: side by side of the box, keep the corners on its inner side and the points in between
        room = side * ((stage.high if side > 0 else stage.low)[axis] - polygon[:, axis])
        corners = []
        for start, end, a, b in zip(polygon, [*polygon[1:], *polygon[:1]], room, [*room[1:], *room[:1]], strict=True):
            if a >= 0:
                corners.append(start)
            if (a < 0) != (b < 0):
                corners.append(start + a / (a - b) * (end - start))
        polygon = np.array(corners).reshape(-1, 3)
    return polygon


def find_hidden_points(contact: Contact, outline: Outline, stage: Stage, t: float, points: np.ndarray, eye: np.ndarray):
    """Which points `(n, 3)` a solid hides from who looks along -`eye`, a unit vector."""
    if outline.ball is not None:
        away = points - outline.ball.center
        depth = away @ eye
        radius = DRAWN_BALL_SHARE * outline.ball.radius
        return (depth < 0) & ((away * away).sum(axis=-1) - depth**2 < radius**2)
    # what lies on the surface itself is not hidden by it: the line of sight begins a little before the point
    steps = np.linspace(0.02, math.sqrt(3), RAY_SAMPLES) * stage.size
    sight = points[:, None] + steps[:, None] * eye
    return (level_sets.evaluate_distance(contact, t, sight) < 0).any(axis=1)


def _get_closed_form(contact: Contact) -> ClosedForm | None:
    """Looked up by the signed distance itself: a subclass that has another one is drawn from that."""
    return _CLOSED_FORMS.get(type(contact).signed_distance)


def _find_no_corners(contact: Contact, stage: Stage, t: float) -> list[np.ndarray]:
    return []


def _find_foot(plane: Plane, stage: Stage, t: float) -> list[np.ndarray]:
    """The point of a plane below the corner of the box that is nearest to it, if the box is near."""
    normal, corners = _find_normal(plane, t), np.array(list(product(*zip(*stage, strict=True))))
    distance = (corners - _move(plane.point, plane, t)) @ normal
    nearest = np.abs(distance).argmin()
    near = distance.min() > 0 and distance[nearest] <= NEAR_FLOOR_SHARE * stage.size
    return [corners[nearest] - distance[nearest] * normal] if near else []


def _cut_plane(plane: Plane, stage: Stage, t: float) -> Outline:
    return _build_sheets([_cut_box(stage, _move(plane.point, plane, t), _find_normal(plane, t))], plane)


def _cut_slab(slab: Slab, stage: Stage, t: float) -> Outline:
    normal, half = _find_normal(slab, t), float(slab.thickness) / 2
    middle = _move(slab.point, slab, t)
    return _build_sheets([_cut_box(stage, middle + side * half * normal, normal) for side in (-1, 1)], slab)


def _find_room_ends(room: Room, stage: Stage, t: float) -> list[np.ndarray]:
    corners = product(*np.stack([room.lower, room.upper], axis=-1))
    return [_move(np.array(corner), room, t) for corner in corners]


def _build_walls(room: Room, stage: Stage, t: float) -> Outline:
    """The six faces of a room."""
    ends = np.stack([room.lower, room.upper])
    faces = []
    for axis, side in product(range(3), (0, 1)):
        a, b = (i for i in range(3) if i != axis)
        face = np.tile(ends[side], (4, 1))
        face[:, a], face[:, b] = ends[[0, 1, 1, 0], a], ends[[0, 0, 1, 1], b]
        faces.append(_move(face, room, t))
    return _build_sheets(faces, room)


def _find_ball_ends(sphere: Sphere, stage: Stage, t: float) -> list[np.ndarray]:
    center, radius = _move(sphere.center, sphere, t), float(sphere.radius)
    return [center - radius, center + radius]


def _build_ball(sphere: Sphere, stage: Stage, t: float) -> Outline:
    """A ball or a bowl as flat patches, as far as they are in the box, with normals to the legal side."""
    p, a = np.meshgrid(
        np.linspace(0, np.pi, BALL_RINGS + 1), np.linspace(0, 2 * np.pi, 2 * BALL_RINGS + 1), indexing="ij"
    )
    points = np.stack([np.sin(p) * np.cos(a), np.cos(p), np.sin(p) * np.sin(a)], axis=-1)
    patches = np.stack([points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]], axis=2).reshape(-1, 4, 3)
    normals = patches.mean(axis=1)
    normals /= np.sqrt((normals * normals).sum(axis=-1, keepdims=True))
    center, radius = _move(sphere.center, sphere, t), float(sphere.radius)
    drawn_radius = radius if sphere.inside else DRAWN_BALL_SHARE * radius
    patches = center + drawn_radius * patches
    seen = stage.contains(patches).all(axis=1)
    normals = -normals[seen] if sphere.inside else normals[seen]
    return Outline(patches[seen], normals, not sphere.inside, Ball(center, radius), _get_velocity(sphere))


def _build_sheets(polygons: list[np.ndarray], contact: Plane | Slab | Room) -> Outline:
    return Outline([polygon for polygon in polygons if len(polygon) > 2], velocity=_get_velocity(contact))


def _cut_box(stage: Stage, point: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """The polygon in which a plane cuts the box: where it meets the edges, in order around their middle."""
    ends = np.array(list(product(*zip(*stage, strict=True))))
    ends = [(a, b) for i, a in enumerate(ends) for b in ends[i + 1 :] if (a != b).sum() == 1]
    a, b = np.array(ends).transpose(1, 0, 2)
    before, after = (a - point) @ normal, (b - point) @ normal
    meets = (before * after <= 0) & (before != after)
    share = before[meets] / (before - after)[meets]
    found = a[meets] + share[:, None] * (b - a)[meets]
    if len(found) < 3:
        return np.zeros((0, 3))
    along = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    spokes = found - found.mean(axis=0)
    angle = np.arctan2(spokes @ np.cross(normal, along), spokes @ along)
    return found[np.argsort(angle)]


def _move(place: ArrayLike, contact: Plane | Slab | Room | Sphere, t: float) -> np.ndarray:
    """Where places of a surface are at a time [m]."""
    place = np.asarray(place, float)
    if contact.motion is not None:
        return np.asarray(contact.motion.place(t, jnp.asarray(place)), float)
    return place if contact.velocity is None else place + t * np.asarray(contact.velocity, float)


def _find_normal(contact: Plane | Slab, t: float) -> np.ndarray:
    """The normal of a flat surface at a time."""
    normal = _unit(contact.normal)
    return normal if contact.motion is None else np.asarray(contact.motion.turn(t, jnp.asarray(normal)), float)


def _get_velocity(contact: Plane | Slab | Room | Sphere) -> np.ndarray | None:
    """How fast it moves [m/s], zero where it stands still; None where it has a motion, so that it does not move on as it is."""
    if contact.motion is not None:
        return None
    return np.zeros(()) if contact.velocity is None else np.asarray(contact.velocity, float)


def _unit(vector: ArrayLike) -> np.ndarray:
    vector = np.asarray(vector, float)
    return vector / np.sqrt((vector * vector).sum())


_CLOSED_FORMS = {
    Plane.signed_distance: ClosedForm(_find_foot, _cut_plane),
    Slab.signed_distance: ClosedForm(_find_no_corners, _cut_slab),
    Room.signed_distance: ClosedForm(_find_room_ends, _build_walls),
    Sphere.signed_distance: ClosedForm(_find_ball_ends, _build_ball),
}
"""The shapes of `contacts` that are cheaper and sharper drawn as what they are."""
