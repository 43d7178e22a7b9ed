"""What is in the way, drawn lightly behind what moves: floors, walls, balls, rooms, and any shape that a user writes.

In the plane a surface is the contour of its signed distance, in space the polygons of its outline. Surfaces that differ
from lane to lane are left out.
"""

import math
from collections.abc import Sequence
from itertools import product
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np

from physjax.parts import Contact
from physjax.physics.rigid.solids.contact import Solids
from physjax.physics.rigid.surface_contact import SurfaceContact
from physjax.show import level_sets, outlines
from physjax.show.outlines import Outline
from physjax.show.stage import REACH_SHARE, Stage

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from mpl_toolkits.mplot3d import Axes3D

GREY, STONE = "#9AA3AD", "#C9CDD2"
LIGHT_DIRECTION = np.array([0.3, 0.7, 0.65]) / np.sqrt(0.3**2 + 0.7**2 + 0.65**2)
"""Towards the lamp where y is up: from above, over the right shoulder of who looks."""
CONTOUR_POINTS = 241
"""Points along each side of the grid on which a contour in the plane is found."""
SHEET_OPACITY, BENT_OPACITY = 0.16, 0.3
"""Of a flat sheet of glass, and of one that bends, which is lit."""


class Solid(NamedTuple):
    """A surface that hides what is behind it, with its outline in a box at a time."""

    contact: Contact
    outline: Outline
    stage: Stage
    t: float


def select_shared_surfaces(contacts: tuple[Contact, ...], dim: int = 3) -> tuple[Contact, ...]:
    """The surfaces that are the same for all lanes; of a contact of bodies with surfaces, these."""
    surfaces = (surface for contact in contacts for surface in _list_surfaces(contact))
    return tuple(surface for surface in surfaces if level_sets.is_shared(surface, dim))


def _list_surfaces(contact: Contact) -> tuple[Contact, ...]:
    """The surfaces that a contact is about: those of bodies with a surface, of solids with several, else itself."""
    if isinstance(contact, Solids):
        return contact.surfaces
    return (contact.surface,) if isinstance(contact, SurfaceContact) else (contact,)


def include_obstacles(
    stage: Stage, contacts: tuple[Contact, ...], times: Sequence[float] | np.ndarray = (0.0,)
) -> Stage:
    """The box with obstacles and rooms inside, at those times, and with floors that are near; far larger ones do not count."""
    low, high = stage
    for contact, t in product(contacts, times):
        for corner in outlines.find_corners(contact, stage, t):
            if np.abs(corner - (low + high) / 2).max() <= REACH_SHARE * max(stage.size, 1e-12):
                stage = stage.include(corner, corner)
    return stage


def any_moves(contacts: tuple[Contact, ...], stage: Stage, times: np.ndarray) -> bool:
    """Whether any of the surfaces has to be drawn again for every frame."""
    return any(level_sets.moves(contact, stage, times) for contact in contacts)


def draw_flat(ax: "Axes", stage: Stage, contacts: tuple[Contact, ...], t: float) -> "list[Artist]":
    """The wrong side of each contact in the plane, shaded, and its edge."""
    x, y = (np.linspace(low, high, CONTOUR_POINTS) for low, high in zip(*stage, strict=True))
    points = np.stack(np.meshgrid(x, y), axis=-1)
    drawn = []
    for contact in contacts:
        distance = level_sets.evaluate_distance(contact, t, points)
        if distance.min() < 0:
            drawn.append(ax.contourf(x, y, distance, levels=[-np.inf, 0], colors=[GREY], alpha=0.25, zorder=0))
        if distance.min() < 0 < distance.max():
            drawn.append(ax.contour(x, y, distance, levels=[0], colors=[GREY], linewidths=1, zorder=0))
    return drawn


def draw_in_space(ax: "Axes3D", stage: Stage, contacts: tuple[Contact, ...], t: float, up: int = 1) -> "list[Artist]":
    """Planes, rooms, bowls and hills as glass behind everything; what is solid is drawn by `draw_solids`."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    drawn = []
    for contact in contacts:
        outline = outlines.build_outline(contact, stage, t)
        if outline.solid or not len(outline.polygons):
            continue
        if outline.normals is None:
            glass = SHEET_OPACITY / math.sqrt(
                len(outline.polygons)
            )  # several sheets behind each other are as dark as one
            look = {"facecolors": (GREY, glass), "edgecolors": (GREY, 0.6), "linewidths": 0.8}
            polygons = outline.polygons
        else:
            # of a bowl or a cave only what is seen from its legal side: the near wall would hide what is in it
            open_side = outline.normals @ _find_eye(ax, up) > 0
            polygons = [polygon for polygon, is_open in zip(outline.polygons, open_side, strict=True) if is_open]
            look = {"facecolors": _shade(outline.normals[open_side], GREY, up), "linewidths": 0, "alpha": BENT_OPACITY}
        if len(polygons):  # matplotlib cannot add a collection of nothing in space
            drawn.append(Poly3DCollection(polygons, zorder=0, **look))
            ax.add_collection3d(drawn[-1])
    return drawn


def find_solids(stage: Stage, contacts: tuple[Contact, ...], t: float) -> list[Solid]:
    """The solid obstacles at a time, as far as they are in the picture."""
    found = ((contact, outlines.build_outline(contact, stage, t)) for contact in contacts)
    return [Solid(contact, outline, stage, t) for contact, outline in found if outline.solid]


def draw_solids(ax: "Axes3D", stage: Stage, contacts: tuple[Contact, ...], t: float, up: int = 1) -> "list[Artist]":
    """Draw the solid obstacles, behind what moves."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    drawn = []
    for solid in find_solids(stage, contacts, t):
        if not len(solid.outline.polygons):
            continue
        lit = shade_solid(solid, up)
        drawn.append(Poly3DCollection(solid.outline.polygons, facecolors=lit, edgecolors=lit, linewidths=0.3, zorder=1))
        ax.add_collection3d(drawn[-1])
    return drawn


def find_hidden(solids: list[Solid], points: np.ndarray, ax: "Axes3D", up: int = 1) -> np.ndarray:
    """Which points `(points, 3)` stand behind one of the solids, as the axes are turned when they are drawn.

    Sorting polygons by depth, as matplotlib does, lets a ball show through the cloth that lies on it.
    """
    eye, hidden = _find_eye(ax, up), np.zeros(len(points), bool)
    for solid in solids:
        hidden |= outlines.find_hidden_points(solid.contact, solid.outline, solid.stage, solid.t, points, eye)
    return hidden


def orient_up(vector: np.ndarray, up: int) -> np.ndarray:
    """A vector of a space in which y is up as one of a space in which another axis is: the three in the same cycle."""
    return np.roll(vector, up - 1)


def shade_solid(solid: Solid, up: int = 1) -> np.ndarray:
    """Colours of the patches of a solid, lighter towards the lamp."""
    return _shade(cast("np.ndarray", solid.outline.normals), STONE, up)


def _shade(normals: np.ndarray, color: str, up: int) -> np.ndarray:
    from matplotlib.colors import to_rgb

    return (0.72 + 0.28 * np.maximum(normals @ orient_up(LIGHT_DIRECTION, up), 0))[:, None] * to_rgb(color)


def _find_eye(ax: "Axes3D", up: int) -> np.ndarray:
    """The unit vector towards who looks at axes in space."""
    rise, turn = np.radians([ax.elev, ax.azim])
    return orient_up(np.array([np.cos(rise) * np.sin(turn), np.sin(rise), np.cos(rise) * np.cos(turn)]), up)
