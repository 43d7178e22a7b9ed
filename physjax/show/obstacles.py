"""What is in the way, drawn lightly behind what moves: floors, walls, balls, rooms.

In the plane any contact is drawn, by its gap; in space planes, slabs, spheres, rooms, and what has a `profile(low, high)`:
a line `(n, 2)` of x and y [m] from one x to another, the same at every z. Surfaces that differ from lane to lane are left
out.
"""

import math
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from physjax.parts import Contact
from physjax.physics.contacts.shapes import Plane, Room, Slab, Sphere
from physjax.physics.rigid.contact_points import SurfaceContact
from physjax.show.stage import Stage

GREY, STONE = "#9AA3AD", "#C9CDD2"
LIGHT_DIRECTION = np.array([0.3, 0.7, 0.65]) / np.sqrt(0.3**2 + 0.7**2 + 0.65**2)
"""Towards the lamp where y is up: from above, over the right shoulder of who looks."""
NEAR_FLOOR_SHARE = 0.3
"""A floor is worth showing when it is no farther from what moves than this share of the picture."""
DRAWN_BALL_SHARE = 0.985
"""A ball is drawn a little smaller, or flat faces of the cloth on it would cut into it."""


class Ball(NamedTuple):
    """A sphere as flat patches `(patches, corners, 3)` [m], the unit vector away from each, its center and radius [m]."""

    corners: np.ndarray
    normals: np.ndarray
    center: np.ndarray
    radius: float


def select_shared_surfaces(contacts: tuple) -> tuple[Contact, ...]:
    """The surfaces that are the same for all lanes; of what bodies touch with a hull, the surface."""
    surfaces = (contact.surface if isinstance(contact, SurfaceContact) else contact for contact in contacts)
    return tuple(surface for surface in surfaces if _is_shared(surface))


def include_obstacles(stage: Stage, contacts: tuple, times: Sequence[float] = (0.0,)) -> Stage:
    """The box with balls and rooms inside, at those times, and with floors that are near; far larger ones do not count."""
    low, high = stage
    for contact, t in product(contacts, times):
        for corner in _find_corners(contact, stage, t):
            if np.abs(corner - (low + high) / 2).max() <= 2.5 * max(stage.size, 1e-12):
                stage = stage.include(corner, corner)
    return stage


def draw_flat(ax: Any, stage: Stage, contacts: tuple, t: float) -> list[Any]:
    """The wrong side of each contact in the plane, shaded, and its edge."""
    count = 241
    x, y = (np.linspace(low, high, count) for low, high in zip(*stage, strict=True))
    points = np.stack(np.meshgrid(x, y), axis=-1)
    drawn = []
    for contact in contacts:
        signed_distance = np.asarray(contact.signed_distance(t, jnp.asarray(points)), float)
        if signed_distance.min() < 0:
            drawn.append(ax.contourf(x, y, signed_distance, levels=[-np.inf, 0], colors=[GREY], alpha=0.25, zorder=0))
        if signed_distance.min() < 0 < signed_distance.max():
            drawn.append(ax.contour(x, y, signed_distance, levels=[0], colors=[GREY], linewidths=1, zorder=0))
    return drawn


def draw_in_space(ax: Any, stage: Stage, contacts: tuple, t: float, up: int = 1) -> list[Any]:
    """Planes, slabs, rooms and bowls as sheets of glass behind everything; balls are drawn by `draw_balls`."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    drawn = []
    for contact in contacts:
        sheets = [polygon for polygon in build_sheets(contact, stage, t) if len(polygon) > 2]
        if sheets:
            glass = 0.16 / math.sqrt(len(sheets))  # as many as stand behind each other
            drawn.append(
                Poly3DCollection(sheets, facecolors=(GREY, glass), edgecolors=(GREY, 0.6), linewidths=0.8, zorder=0)
            )
            ax.add_collection3d(drawn[-1])
    for contact in contacts:
        if isinstance(contact, Sphere) and contact.inside:
            bowl = _crop_ball(stage, _build_ball(contact, t))
            far = (bowl.corners.mean(axis=1) - _center(contact, t))[:, up] < 0
            drawn.append(Poly3DCollection(bowl.corners[far], facecolors=GREY, linewidths=0, alpha=0.12, zorder=0))
            ax.add_collection3d(drawn[-1])
    return drawn


def find_balls(stage: Stage, contacts: tuple, t: float) -> list[Ball]:
    """The balls in the way at a time, as flat patches, as far as they are in the picture."""
    spheres = [_build_ball(c, t, DRAWN_BALL_SHARE) for c in contacts if isinstance(c, Sphere) and not c.inside]
    return [_crop_ball(stage, ball) for ball in spheres]


def draw_balls(ax: Any, stage: Stage, contacts: tuple, t: float, up: int = 1) -> list[Any]:
    """Draw the balls in the way, behind what moves."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    drawn = []
    for ball in find_balls(stage, contacts, t):
        lit = shade_ball(ball, up)
        drawn.append(Poly3DCollection(ball.corners, facecolors=lit, edgecolors=lit, linewidths=0.3, zorder=1))
        ax.add_collection3d(drawn[-1])
    return drawn


def find_hidden(balls: list[Ball], points: np.ndarray, ax: Any, up: int = 1) -> np.ndarray:
    """Which points `(points, 3)` stand behind one of the balls, as the axes are turned when they are drawn.

    Sorting polygons by depth, as matplotlib does, lets a ball show through the cloth that lies on it.
    """
    rise, turn = np.radians([ax.elev, ax.azim])
    eye = orient_up(np.array([np.cos(rise) * np.sin(turn), np.sin(rise), np.cos(rise) * np.cos(turn)]), up)
    behind = np.zeros(len(points), bool)
    for ball in balls:
        away = points - ball.center
        depth = away @ eye
        behind |= (depth < 0) & ((away * away).sum(axis=-1) - depth**2 < ball.radius**2)
    return behind


def orient_up(vector: np.ndarray, up: int) -> np.ndarray:
    """A vector of a space in which y is up as one of a space in which another axis is: the three in the same cycle."""
    return np.roll(vector, up - 1)


def shade_ball(ball: Ball, up: int = 1) -> np.ndarray:
    """Colours of a ball's patches, lighter towards the lamp."""
    from matplotlib.colors import to_rgb

    return (0.72 + 0.28 * np.maximum(ball.normals @ orient_up(LIGHT_DIRECTION, up), 0))[:, None] * to_rgb(STONE)


def has_moving(contacts: tuple) -> bool:
    """Whether any of them has to be drawn anew for every frame; what does not say that it moves stands still."""
    return any(getattr(contact, "velocity", None) is not None for contact in contacts)


def _is_shared(contact: Contact) -> bool:
    vectors = [getattr(contact, name, None) for name in ("point", "normal", "center", "lower", "upper", "velocity")]
    numbers = [getattr(contact, name, None) for name in ("radius", "thickness")]
    return all(np.ndim(v) == 1 for v in vectors if v is not None) and all(
        np.ndim(n) == 0 for n in numbers if n is not None
    )


def _find_corners(contact: Contact, stage: Stage, t: float) -> list[np.ndarray]:
    """Points that belong into the picture."""
    if isinstance(contact, Sphere):
        center, radius = _center(contact, t), float(contact.radius)
        return [center - radius, center + radius]
    if isinstance(contact, Room):
        return [np.asarray(corner, float) + _shift(contact, t) for corner in (contact.lower, contact.upper)]
    if not isinstance(contact, Plane):
        return []
    normal, corners = _unit(contact.normal), np.array(list(product(*zip(*stage, strict=True))))
    gaps = (corners - _center(contact, t)) @ normal
    nearest = np.abs(gaps).argmin()
    near = gaps.min() > 0 and gaps[nearest] <= NEAR_FLOOR_SHARE * stage.size
    return [corners[nearest] - gaps[nearest] * normal] if near else []


def build_sheets(contact: Contact, stage: Stage, t: float) -> list[np.ndarray]:
    """The flat surfaces of a contact at a time as polygons `(corners, 3)` [m], where they cut the box; none of a ball."""
    if isinstance(contact, Plane):
        return [_cut_box(stage, _center(contact, t), _unit(contact.normal))]
    if isinstance(contact, Slab):
        normal, half = _unit(contact.normal), float(contact.thickness) / 2
        return [_cut_box(stage, _center(contact, t) + side * half * normal, normal) for side in (-1, 1)]
    if isinstance(contact, Room):
        return _build_walls(contact, t)
    return _extrude_profile(contact.profile, stage) if hasattr(contact, "profile") else []


def _extrude_profile(profile: Callable, stage: Stage) -> list[np.ndarray]:
    """The strips between the points of a line in the plane of x and y, from side to side of the box."""
    line = np.asarray(profile(stage.low[0], stage.high[0]), float)
    near, far = (np.column_stack([line, np.full(len(line), side)]) for side in (stage.low[2], stage.high[2]))
    return list(np.stack([near[:-1], near[1:], far[1:], far[:-1]], axis=1))


def _build_walls(room: Room, t: float) -> list[np.ndarray]:
    """The six faces of a room."""
    ends = np.stack([room.lower, room.upper]).astype(float) + _shift(room, t)
    faces = []
    for axis, side in product(range(3), (0, 1)):
        a, b = (i for i in range(3) if i != axis)
        face = np.tile(ends[side], (4, 1))
        face[:, a], face[:, b] = ends[[0, 1, 1, 0], a], ends[[0, 0, 1, 1], b]
        faces.append(face)
    return faces


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


def _build_ball(sphere: Sphere, t: float, shrunk: float = 1.0, rings: int = 24) -> Ball:
    polar, around = np.linspace(0, np.pi, rings + 1), np.linspace(0, 2 * np.pi, 2 * rings + 1)
    p, a = np.meshgrid(polar, around, indexing="ij")
    points = np.stack([np.sin(p) * np.cos(a), np.cos(p), np.sin(p) * np.sin(a)], axis=-1)
    quads = np.stack([points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]], axis=2).reshape(-1, 4, 3)
    normals = quads.mean(axis=1)
    normals /= np.sqrt((normals * normals).sum(axis=-1, keepdims=True))
    center, radius = _center(sphere, t), shrunk * float(sphere.radius)
    return Ball(center + radius * quads, normals, center, radius)


def _crop_ball(stage: Stage, ball: Ball) -> Ball:
    inside = stage.contains(ball.corners).all(axis=1)
    return ball._replace(corners=ball.corners[inside], normals=ball.normals[inside])


def _center(contact: Contact, t: float) -> np.ndarray:
    where = contact.center if isinstance(contact, Sphere) else contact.point
    return np.asarray(where, float) + _shift(contact, t)


def _shift(contact: Contact, t: float) -> np.ndarray | float:
    return 0.0 if contact.velocity is None else t * np.asarray(contact.velocity, float)


def _unit(vector: Any) -> np.ndarray:
    vector = np.asarray(vector, float)
    return vector / np.sqrt((vector * vector).sum())
