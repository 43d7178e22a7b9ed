"""Cloth, jelly and meshes as shaded surfaces."""

from collections.abc import Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING, cast

import numpy as np

from physjax.physics.springs.assembly import Lattice
from physjax.show import obstacles
from physjax.show.frames import get_faces, pick_frames, take_frames
from physjax.show.obstacles import LIGHT_DIRECTION
from physjax.show.panels import Scenery, build_scenery, draw_panels
from physjax.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.figure import Figure
    from matplotlib.typing import ColorType
    from mpl_toolkits.mplot3d import Axes3D

AMBIENT_BRIGHTNESS = 0.5
"""Brightness of a face that stands edge on to the light."""
SMOOTH_EDGE_COSINE = 0.85
"""Cosine of the angle up to which faces are drawn as one smooth surface."""


def cloth(
    film: Trajectory,
    sheet: Lattice,
    frames: int | Iterable[int] | None = None,
    *,
    scene: int | Sequence[int] | None = None,
    color: "ColorType" = "#56B4E9",
    figure: "Figure | None" = None,
) -> "Figure":
    """Draw the faces of a cloth, a jelly or a mesh in space at chosen frames, side by side, shaded by Lambert's law.

    `sheet` is the lattice that the film's scene was made from. `frames` are numbers of frames, negative ones from the
    end; without them the first, the middle and the last good one. Of a batch of scenes `scene` picks one. Up is as in the scene,
    all directions have the same scale [m], and balls, floors and rooms of the scene are drawn lightly. Returns the figure.
    Raises TypeError, ValueError or IndexError for a film, a sheet or frames that do not fit.

    Example:
        >>> figure = plot.cloth(wave, sheet, frames=[0, 10])
        >>> len(figure.axes)
        2
    """
    who = "plot.cloth"
    faces, nodes = get_faces(who, sheet)
    seen = take_frames(who, film, scene=scene, nodes=nodes, dims=(3,))
    chosen = pick_frames(who, seen, frames)
    return draw_panels(build_scenery(seen, chosen), chosen, partial(draw_surface, faces=faces, color=color), figure)


def draw_surface(
    ax: "Axes3D",
    scenery: Scenery,
    frame: int,
    *,
    faces: np.ndarray,
    color: "ColorType | np.ndarray",
    closed: bool = False,
) -> "list[Artist]":
    """Draw a frame into axes in space: faces behind a solid obstacle, the obstacles, and the faces in front of them.

    Of a `closed` surface the far side comes first: sorted by depth with the near one, some of it would show through.
    `color` is one for all faces or, `(faces, 3)`, one for each.
    """
    from matplotlib.colors import to_rgb
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    position = scenery.position(frame)
    inside = scenery.stage.contains(position)[faces].all(axis=1)
    own = color[inside] if isinstance(color, np.ndarray) and color.ndim == 2 else to_rgb(cast("ColorType", color))
    faces = faces[inside]
    triangles, colours = position[faces], compute_brightness(position, faces, scenery.up)[:, None] * own
    solids = obstacles.find_solids(scenery.stage, scenery.contacts, scenery.run.time[frame])
    layers = np.where(obstacles.find_hidden(solids, triangles.mean(axis=1), ax, scenery.up), 2, 4)
    if closed:
        layers[find_back_faces(triangles, ax)] = 1
    groups = [(triangles[layers == layer], colours[layers == layer], layer) for layer in (1, 2, 4)]
    groups += [(solid.outline.polygons, obstacles.shade_solid(solid, scenery.up), 3) for solid in solids]
    drawn: list[Artist] = [
        Poly3DCollection(polygons, facecolors=shades, edgecolors=shades, linewidths=0.3, zorder=order)
        for polygons, shades, order in groups
        if len(polygons)
    ]
    for collection in drawn:
        ax.add_collection3d(collection)
    return drawn


def find_back_faces(triangles: np.ndarray, ax: "Axes3D") -> np.ndarray:
    """Which triangles `(n, 3, 3)` are seen from behind: their corners go round clockwise as the axes show them."""
    (xa, xb, xc), (ya, yb, yc), _ = _project(triangles, ax).transpose(2, 1, 0)
    return (xb - xa) * (yc - ya) < (xc - xa) * (yb - ya)


def find_covered_points(points: np.ndarray, triangles: np.ndarray, ax: "Axes3D") -> np.ndarray:
    """Which points `(points, 3)` are behind one of the triangles `(n, 3, 3)` as the axes show them."""
    # depth grows away from the eye, and is linear along a plane on paper as well
    (xa, xb, xc), (ya, yb, yc), (za, zb, zc) = _project(triangles, ax).transpose(2, 1, 0)
    area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
    some = np.abs(area) > 0
    xa, xb, xc, ya, yb, yc, za, zb, zc, area = (part[some] for part in (xa, xb, xc, ya, yb, yc, za, zb, zc, area))
    covered = np.zeros(len(points), bool)
    for i, (x, y, z) in enumerate(_project(points, ax)):
        to_b = ((x - xa) * (yc - ya) - (xc - xa) * (y - ya)) / area
        to_c = ((xb - xa) * (y - ya) - (x - xa) * (yb - ya)) / area
        inside = (to_b >= 0) & (to_c >= 0) & (to_b + to_c <= 1)
        covered[i] = (inside & (z > za + to_b * (zb - za) + to_c * (zc - za))).any()
    return covered


def _project(points: np.ndarray, ax: "Axes3D") -> np.ndarray:
    """Points `(..., 3)` as the axes show them: across and up on paper, and the depth."""
    from mpl_toolkits.mplot3d.proj3d import proj_transform

    x, y, z = points.reshape(-1, 3).T
    return np.stack(proj_transform(x, y, z, ax.get_proj()), axis=-1).reshape(points.shape)


def compute_brightness(position: np.ndarray, faces: np.ndarray, up: int = 1) -> np.ndarray:
    """Brightness of each face by Lambert's law, lit from both sides: a + (1 - a) |n·l|, with a the ambient light.

    The normal n at a corner is the mean of those of the faces around it, weighted by area, so that a coarse sheet looks
    smooth; where the faces meet at a sharp angle, as on the edge of a block, it is the face's own.
    """
    a, b, c = position[faces].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    corners, weights = faces.ravel(), np.repeat(normal, 3, axis=0)
    around = np.stack([np.bincount(corners, weights[:, i], len(position)) for i in range(3)], axis=-1)
    own, mean = _unit(normal)[:, None], _unit(around)[faces]
    smooth = (own * mean).sum(axis=-1, keepdims=True) > SMOOTH_EDGE_COSINE
    return AMBIENT_BRIGHTNESS + (1 - AMBIENT_BRIGHTNESS) * np.abs(
        np.where(smooth, mean, own) @ obstacles.orient_up(LIGHT_DIRECTION, up)
    ).mean(axis=1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.sqrt((vectors * vectors).sum(axis=-1, keepdims=True))
    return vectors / np.where(length > 0, length, 1.0)
