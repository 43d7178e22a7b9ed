"""Bodies in the plane as their shapes, filled in many colours, with a line that shows how each has turned."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple, cast

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from physjax.physics.rigid.body_joints import BodyJoints
from physjax.physics.rigid.planar import PlanarBodies, PlanarShape
from physjax.physics.rigid.solids.contact import Solids
from physjax.show.frames import Frames, take_lanes
from physjax.show.panels import Scenery
from physjax.show.stage import build_stage
from physjax.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.typing import ColorType

CIRCLE_CORNERS = 48
"""Corners of the polygon that is drawn for a circle."""
POINTER_SHARE = 0.05
"""Length of the line through a body without a shape, as a share of the box around the run."""
BAR_RADIUS_SHARE = 0.08
"""Radius of a bar that stands for a body with joints and without a shape, as a share of half its length."""
LONE_DISC_RADIUS = 0.05
"""Radius [m] of a disc that stands for a body without a shape that no joint is away from."""
EDGE_BRIGHTNESS = 0.45
"""Of an edge or a line on a body, as a share of that of its area."""


class PlanarOutline(NamedTuple):
    """What is drawn of a shape in the frame of its body [m]: the corners of its area, and the ends of a line on it."""

    corners: np.ndarray
    line: np.ndarray


class PlanarPicture(NamedTuple):
    """Draws frames of bodies in the plane: an outline and a colour for each, and their angles, `(frames, bodies)` [rad]."""

    angle: np.ndarray
    place: np.ndarray
    outlines: list[PlanarOutline]
    colours: np.ndarray

    def __call__(self, ax: "Axes", scenery: Scenery, frame: int) -> "list[Artist]":
        """Draw a frame into axes in the plane; bodies that blew up are left out."""
        from matplotlib.collections import LineCollection, PolyCollection

        place, angle = self.place[frame], self.angle[frame]
        seen = np.flatnonzero(np.isfinite(place).all(axis=-1) & np.isfinite(angle))
        put = lambda points, i: place[i] + turn_vectors(angle[i], points)  # noqa: E731
        areas = [put(self.outlines[i].corners, i) for i in seen]
        lines = [put(self.outlines[i].line, i) for i in seen]
        dark = self.colours[seen] * [EDGE_BRIGHTNESS, EDGE_BRIGHTNESS, EDGE_BRIGHTNESS, 1.0]
        fill = PolyCollection(areas, facecolors=self.colours[seen], edgecolors=dark, linewidths=0.6, zorder=3)
        return [
            ax.add_collection(fill),
            ax.add_collection(LineCollection(lines, colors=dark, linewidths=0.9, zorder=4)),
        ]


class PlanarPointers(NamedTuple):
    """Draws frames of bodies without a shape: points, `(frames, bodies, 2)`, with lines to their tips in the direction of x."""

    place: np.ndarray
    tips: np.ndarray
    colours: np.ndarray

    def __call__(self, ax: "Axes", scenery: Scenery, frame: int) -> "list[Artist]":
        """Draw a frame into axes in the plane."""
        from matplotlib.collections import LineCollection

        ends = np.stack([self.place[frame], self.tips[frame]], axis=1)
        seen = np.isfinite(ends).all(axis=(-1, -2))
        lines = LineCollection(list(ends[seen]), colors=self.colours[seen], zorder=3)
        dots = ax.scatter(*self.place[frame, seen].T, c=self.colours[seen], s=30, linewidths=0, zorder=4)
        return [ax.add_collection(lines), dots]


def turn_vectors(angle: ArrayLike, vectors: np.ndarray) -> np.ndarray:
    """Vectors `(..., 2)` turned anticlockwise by angles [rad] with the shape of their front axes, or one for all."""
    c, s = np.cos(angle), np.sin(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([c * x - s * y, s * x + c * y], axis=-1)


def find_planar_shapes(film: Trajectory) -> list[PlanarShape] | None:
    """The shapes that the `Solids` of a run's scene give its bodies, one for each, or bars from joint to joint; else None."""
    scene = film.scene
    if scene is None:
        return None
    *worlds, bodies = scene.state.lanes or (1,)
    solids = (contact for contact in scene.contacts if isinstance(contact, Solids))
    given = [shape for contact in solids for shape in contact.shapes if isinstance(shape, PlanarShape)]
    joints = [part for part in scene.constraints if isinstance(part, BodyJoints) and part.points.shape[-1] == 2]
    if not given and not joints:
        return None
    shapes = given or [_build_bar(joints, body) for body in range(bodies)]
    return (shapes * bodies if len(shapes) == 1 else shapes) * int(np.prod(worlds, dtype=int))


def _build_bar(joints: Sequence[BodyJoints], body: int) -> PlanarShape:
    """A bar about the centre of mass of a body without a shape, as long as its farthest joint is away; a disc without one."""
    points = np.concatenate([np.asarray(part.points, float)[np.asarray(part.pairs) == body] for part in joints])
    reach = np.hypot(*points.T)
    if not reach.max(initial=0.0) > 0:
        return PlanarShape.disc(LONE_DISC_RADIUS)
    end = points[np.argmax(reach)]
    return PlanarShape(jnp.asarray([-end, end]), jnp.asarray(BAR_RADIUS_SHARE * reach.max()))


def take_planar_bodies(
    who: str,
    film: Trajectory,
    shapes: PlanarShape | Sequence[PlanarShape] | None,
    color: "ColorType | ArrayLike | None",
) -> tuple[Frames, PlanarPicture | PlanarPointers]:
    """The frames of a run, with the corners of shapes as its nodes, and what draws them.

    Without `shapes` they are those of the scene's `Solids`, and where there are none bodies are points with a direction.
    """
    seen, angle = check_planar_bodies(who, film)
    shapes = find_planar_shapes(film) if shapes is None else shapes
    bodies = seen.position.shape[1]
    colours = choose_colours(who, color, bodies)
    place = seen.position.astype(float)
    if shapes is None:
        length = POINTER_SHARE * (build_stage(seen, range(seen.good_frames)).size or 1.0)
        tips = place + length * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return seen._replace(position=np.concatenate([place, tips], axis=1)), PlanarPointers(place, tips, colours)
    outlines = [build_planar_outline(shape) for shape in list_shapes(who, shapes, bodies)]
    corners = [
        place[:, i, None] + turn_vectors(angle[:, i, None], outline.corners[None]) for i, outline in enumerate(outlines)
    ]
    return seen._replace(position=np.concatenate(corners, axis=1)), PlanarPicture(angle, place, outlines, colours)


def check_planar_bodies(who: str, film: Trajectory) -> tuple[Frames, np.ndarray]:
    """Centres of mass of a run's bodies in the plane, and their angles `(frames, bodies)` [rad]; a TypeError for others."""
    seen = take_lanes(who, film, dims=(2,))
    if not isinstance(film.state, PlanarBodies):
        raise TypeError(
            f"{who}: got a film of {type(film.state).__name__}, expected PlanarBodies. plot.paths draws others."
        )
    return seen, np.asarray(film.state.angle, float).reshape(len(seen.time), -1)


def list_shapes(who: str, shapes: PlanarShape | Sequence[PlanarShape], bodies: int) -> list[PlanarShape]:
    """A shape for each body; a ValueError unless there is one for all or one for each."""
    found = [shapes] * bodies if isinstance(shapes, PlanarShape) else list(shapes)
    if len(found) != bodies or not all(isinstance(shape, PlanarShape) for shape in found):
        raise ValueError(
            f"{who}: got {len(found)} shapes, expected a rigid.PlanarShape for all {bodies} bodies or one for each."
        )
    return found


def build_planar_outline(shape: PlanarShape) -> PlanarOutline:
    """The outline of a convex polygon with a radius around it; of a disc, which looks the same however it turns, a radius."""
    corners, radius = np.asarray(shape.corners, float), float(shape.radius)
    area = corners
    if radius > 0:
        angle = np.linspace(0, 2 * np.pi, CIRCLE_CORNERS, endpoint=False)
        circle = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        area = corners + circle if len(corners) == 1 else _round_corners(corners, circle)
    return PlanarOutline(area, np.array([[0.0, 0.0], [radius if len(corners) == 1 else 0.0, 0.0]]))


def choose_colours(who: str, color: "ColorType | ArrayLike | None", bodies: int) -> np.ndarray:
    """A colour (red, green, blue, opacity) for each body: along a colormap by its number or its value, or one for all.

    As many numbers as bodies are their values, also where three or four of them could be a colour.
    """
    from matplotlib import colormaps
    from matplotlib.colors import is_color_like, to_rgba

    if color is not None and (isinstance(color, str) or (np.size(color) != bodies and is_color_like(color))):
        return np.tile(to_rgba(cast("ColorType", color)), (bodies, 1))
    value = np.arange(bodies, dtype=float) if color is None else np.asarray(color, float).ravel()
    if len(value) != bodies or not np.isfinite(value).all():
        raise ValueError(
            f"{who}: got color {np.asarray(color).shape}, expected a colour or a finite number for each of the {bodies} bodies."
        )
    return colormaps["viridis"](0.15 + 0.85 * (value - value.min()) / (np.ptp(value) or 1.0))


def _round_corners(corners: np.ndarray, circle: np.ndarray) -> np.ndarray:
    """The outermost corner in each direction of a circle, moved by it, and both ends of each edge moved along its normal."""
    along = np.roll(corners, -1, axis=0) - corners
    out = np.hypot(*circle[0]) * np.stack([along[:, 1], -along[:, 0]], axis=-1) / np.hypot(*along.T)[:, None]
    outermost = corners[np.argmax(circle @ corners.T, axis=1)]
    points = np.concatenate([outermost + circle, corners + out, np.roll(corners, -1, axis=0) + out])
    direction = np.concatenate([circle, out, out])
    # both ends of an edge have one direction: that of its first corner comes first
    rank = np.repeat([0, 0, 1], [len(circle), len(out), len(out)])
    return points[np.lexsort([rank, np.arctan2(direction[:, 1], direction[:, 0])])]
