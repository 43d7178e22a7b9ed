"""What the page of `animate.view` is made from where a run is in the plane: bodies as outlines, and surfaces as lines."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jax.typing import ArrayLike

from physjax.parts import Contact
from physjax.physics.rigid.planar import PlanarShape
from physjax.show import level_sets
from physjax.show.frames import Frames
from physjax.show.page_data import Json, number_shapes, quantise_positions, to_hexes
from physjax.show.panels import Scenery
from physjax.show.planar import EDGE_BRIGHTNESS, PlanarPicture, build_planar_outline, take_planar_bodies
from physjax.show.stage import Stage
from physjax.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.typing import ColorType

HALF_TURN_STEPS = 32768
"""An angle is one of this many steps of half a turn; whole turns are left out."""
CONTOUR_POINTS = 361
"""Points along each side of the grid on which the edge of a surface is found."""
ROOM_SHARE = 1.5
"""How far surfaces are drawn from the middle of the box, as a share of its longest side: a window is wider than the box."""
STRAIGHT_SHARE = 1e-4
"""A point of an edge that is off the line between its neighbours by less than this share of the box is left out."""
MAX_OBSTACLE_STATES = 240
"""A surface that moves is sent at most this many times; in between it stays."""


def take_flat_bodies(
    who: str, film: Trajectory, shapes: Sequence[PlanarShape] | None, color: "ColorType | ArrayLike | None"
) -> tuple[Frames, Json]:
    """The frames of a run with the corners of its bodies as nodes, and the bodies for the page, still without places.

    Bodies without a shape are discs as large as the lines that `plot.bodies` draws for them.
    """
    seen, picture = take_planar_bodies(who, film, shapes, color)
    if isinstance(picture, PlanarPicture):
        outlines, angle = picture.outlines, picture.angle
    else:
        ahead = picture.tips - picture.place
        angle, length = np.arctan2(ahead[..., 1], ahead[..., 0]), float(np.nanmax(np.hypot(*np.moveaxis(ahead, -1, 0))))
        outlines = [build_planar_outline(PlanarShape.disc(length / 2))] * angle.shape[1]
    numbers, different = number_shapes(outlines)
    dark = picture.colours[:, :3] * EDGE_BRIGHTNESS
    return seen, {
        "kind": "bodies",
        "nodes": angle.shape[1],
        "places": picture.place,
        "angles": angle,
        "colors": to_hexes(picture.colours),
        "edges": to_hexes(dark),
        "shape": numbers,
        "shapes": [{"corners": outline.corners.tolist(), "mark": outline.line.tolist()} for outline in different],
    }


def quantise_flat_bodies(part: Json, scenery: Scenery, frames: list[int]) -> Json:
    """The bodies with their places and angles at the given frames as 16-bit whole numbers."""
    angle = np.nan_to_num(part["angles"][frames])
    steps = np.round(angle / np.pi * HALF_TURN_STEPS) + HALF_TURN_STEPS
    turned = (np.mod(steps, 2 * HALF_TURN_STEPS) - HALF_TURN_STEPS).astype(np.int16)
    place = np.where(np.isfinite(part["angles"][frames])[..., None], part["places"][frames], np.nan)
    return part | {"places": quantise_positions(scenery, place), "angles": turned}


def describe_flat_obstacle(contact: Contact, scenery: Scenery, frames: list[int], points: int = CONTOUR_POINTS) -> Json:
    """A surface as areas behind it and lines along its edge [m], once or, if it moves, at moments spread over the frames."""
    times = scenery.run.time[frames]
    middle, reach = (scenery.stage.low + scenery.stage.high) / 2, ROOM_SHARE * scenery.stage.size
    wide = Stage(middle - reach, middle + reach)
    count = min(len(frames), MAX_OBSTACLE_STATES) if level_sets.moves(contact, wide, times) else 1
    chosen = np.linspace(0, len(frames), count, endpoint=False).astype(int)
    return {"states": [{"frame": int(i)} | _trace_contours(contact, wide, float(times[i]), points) for i in chosen]}


def _trace_contours(contact: Contact, stage: Stage, t: float, points: int) -> Json:
    """The polygons of the wrong side of a contact in a box, and the lines of its edge."""
    from matplotlib.figure import Figure

    x, y = (np.linspace(low, high, points) for low, high in zip(*stage, strict=True))
    distance = level_sets.evaluate_distance(contact, t, np.stack(np.meshgrid(x, y), axis=-1))
    if not distance.min() < 0:
        return {"areas": [], "edges": []}
    ax = Figure().add_subplot()
    areas = ax.contourf(x, y, distance, levels=[-np.inf, 0], colors=["0"]).get_paths()
    edges = ax.contour(x, y, distance, levels=[0]).get_paths() if distance.max() > 0 else []
    trace = lambda paths, closed: [  # noqa: E731
        _straighten(np.asarray(points), stage) for path in paths for points in path.to_polygons(closed_only=closed)
    ]
    return {"areas": trace(areas, True), "edges": trace(edges, False)}


def _straighten(points: np.ndarray, stage: Stage) -> list[list[float]]:
    """A line of few points that is nowhere further from the given one than a share of the box: Douglas and Peucker's."""
    kept = np.zeros(len(points), bool)
    # a closed line ends where it begins: it is cut where it is furthest from there
    closed = (points[0] == points[-1]).all()
    cut = int(np.argmax(np.hypot(*(points - points[0]).T))) if closed else 0
    kept[[0, cut, -1]] = True
    legs = [(0, cut), (cut, len(points) - 1)]
    while legs:
        start, end = legs.pop()
        if end - start < 2:
            continue
        along, off = points[end] - points[start], points[start + 1 : end] - points[start]
        far = np.abs(along[0] * off[:, 1] - along[1] * off[:, 0]) / (np.hypot(*along) or 1.0)
        worst = int(np.argmax(far))
        if far[worst] > STRAIGHT_SHARE * stage.size:
            kept[start + 1 + worst] = True
            legs += [(start, start + 1 + worst), (start + 1 + worst, end)]
    decimals = int(6 - np.floor(np.log10(stage.size)))
    return np.round(points[kept], decimals).tolist()
