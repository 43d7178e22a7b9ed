"""What the page of `animate.view` is made from where a run is in the plane: bodies as outlines, and surfaces as lines."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.parts import Contact
from physjax.physics.contacts.surface import Surface
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
MAX_REST_RATIO = 4.0
"""A driven surface is found once, at rest, unless this many times the window would have to be searched for it."""


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
    states = _drive_contours(contact, wide, times[chosen], points) if count > 1 else None
    states = states or [_trace_contours(contact, wide, float(times[i]), points) for i in chosen]
    return {"states": [{"frame": int(i)} | state for i, state in zip(chosen, states, strict=True)]}


def _drive_contours(contact: Contact, stage: Stage, times: np.ndarray, points: int) -> list[Json] | None:
    """The contours of a surface that moves as a rigid body, found once and placed; None for any other."""
    if not isinstance(contact, Surface) or (contact.motion is None and contact.velocity is None):
        return None
    rest = eqx.tree_at(lambda s: (s.motion, s.velocity), contact, (None, None), is_leaf=lambda leaf: leaf is None)
    with jax.enable_x64(True):
        axes = np.asarray(_find_rest_axes(contact, jnp.asarray(times, float)))
    origins, turns = axes[:, 0], axes[:, 1:] - axes[:, :1]  # at rest is o + x T what is at x, and T is a rotation
    corners = np.stack(np.meshgrid(*zip(*stage, strict=True)), axis=-1).reshape(-1, 2)
    seen = (origins[:, None] + corners @ turns).reshape(-1, 2)
    middle, half = (seen.min(axis=0) + seen.max(axis=0)) / 2, float(np.ptp(seen, axis=0).max()) / 2
    ratio = 2 * half / stage.size
    if not ratio <= MAX_REST_RATIO or level_sets.moves(rest, stage, times):
        return None
    found = _trace_contours(rest, Stage(middle - half, middle + half), float(times[0]), int(np.ceil(ratio * points)))
    decimals = _count_decimals(stage)
    return [
        {
            kind: [np.round((line - origin) @ turn.T, decimals).tolist() for line in lines]
            for kind, lines in found.items()
        }
        for origin, turn in zip(origins, turns, strict=True)
    ]


@eqx.filter_jit
def _find_rest_axes(surface: Surface, times: Float[Array, " times"]) -> Float[Array, "times 3 2"]:
    """Where the origin and the ends of both unit vectors are, seen from the surface."""
    axes = jnp.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], times.dtype)
    return jax.vmap(lambda t: surface.rest_place(t, axes))(times)


def _trace_contours(contact: Contact, stage: Stage, t: float, points: int) -> dict[str, list[list[list[float]]]]:
    """The polygons of the wrong side of a contact in a box, and the lines of its edge."""
    from contourpy import FillType, LineType, contour_generator

    x, y = (np.linspace(low, high, points) for low, high in zip(*stage, strict=True))
    distance = level_sets.evaluate_distance(contact, t, np.stack(np.meshgrid(x, y), axis=-1))
    if not distance.min() < 0:
        return {"areas": [], "edges": []}
    distance = np.minimum(distance, 4 * stage.size)  # where it is no number it is infinite
    found = contour_generator(x, y, distance, fill_type=FillType.OuterOffset, line_type=LineType.Separate)
    # neither is None without chunks, as its types allow
    polygons, offsets = cast(
        "tuple[list[np.ndarray], list[np.ndarray]]", found.filled(distance.min() - stage.size, 0.0)
    )
    rings = [ring for points, ends in zip(polygons, offsets, strict=True) for ring in np.split(points, ends[1:-1])]
    edges = cast("list[np.ndarray]", found.lines(0.0)) if distance.max() > 0 else []
    return {"areas": [_straighten(ring, stage) for ring in rings], "edges": [_straighten(e, stage) for e in edges]}


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
    return np.round(points[kept], _count_decimals(stage)).tolist()


def _count_decimals(stage: Stage) -> int:
    """Of a number of metres in a box: a millionth of it."""
    return int(6 - np.floor(np.log10(stage.size)))
