"""What the page of `animate.view` is made from: positions as 16-bit whole numbers, and the surfaces of the scene."""

import base64
import zlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from physjax.parts import Contact
from physjax.show import level_sets, outlines
from physjax.show.links import Links
from physjax.show.outlines import Outline
from physjax.show.panels import Scenery
from physjax.show.stage import EDGE_SLACK_SHARE

if TYPE_CHECKING:
    from matplotlib.typing import ColorType

T = TypeVar("T", bound=tuple)
Json = dict[str, Any]
"""An object of the page's JSON; arrays in it are sent as `pack_arrays` writes them."""
QUANTISATION_STEPS = 32767
"""A position is one of this many steps to either side of the middle of the box, along each of its sides."""
HIDDEN_CODE = -32768
"""Stands for a position outside of the box, or for none: nothing that is joined to it is drawn."""
PAGE_CELLS = 48
"""Cells along the longest side of the box for a surface drawn from its signed distance: some 8 000 faces, which a page
turns without effort. One that moves is sent many times and has `outlines.PICTURE_CELLS`."""
MAX_OBSTACLE_STATES = 60
"""A surface that changes in no simple way is sent at most this many times, at some 20 kB each; in between it stays."""


def pack_arrays(content: Any) -> Any:
    """The content of a page with the arrays in it as text."""
    if isinstance(content, np.ndarray):
        return pack_frames(content)
    if isinstance(content, dict):
        return {name: pack_arrays(part) for name, part in content.items()}
    return [pack_arrays(part) for part in content] if isinstance(content, list) else content


def pack_frames(array: np.ndarray) -> str:
    """Numbers as text: the change from row to row (whole numbers wrap around), deflated, in base 64."""
    steps = np.diff(array, axis=0, prepend=np.zeros_like(array[:1]))
    return base64.b64encode(zlib.compress(steps.tobytes(), 9)).decode()


def quantise_positions(scenery: Scenery, position: np.ndarray) -> np.ndarray:
    """Positions `(..., 3)` [m] as 16-bit whole numbers, `HIDDEN_CODE` where they are not inside of the box."""
    low, high = build_padded_box(scenery)
    inside = scenery.stage.contains(position)[..., None]
    share = (np.where(inside, position, low) - low) / (high - low)
    return np.where(inside, np.round((2 * share - 1) * QUANTISATION_STEPS), HIDDEN_CODE).astype(np.int16)


def build_padded_box(scenery: Scenery) -> tuple[np.ndarray, np.ndarray]:
    """The corners of a box that is a little larger than what counts as inside of the stage, so that no step is lost."""
    slack = (EDGE_SLACK_SHARE + 0.01) * scenery.stage.size
    return scenery.stage.low - slack, scenery.stage.high + slack


def number_shapes(shapes: Sequence[T]) -> tuple[list[int], list[T]]:
    """The number of the shape of each body, and the shapes that differ: tuples of two arrays."""
    keys = [b"".join(np.asarray(part).tobytes() for part in shape) for shape in shapes]
    first = {key: shape for key, shape in zip(keys, shapes, strict=True)}
    order = {key: number for number, key in enumerate(first)}
    return [order[key] for key in keys], list(first.values())


def to_hexes(colours: np.ndarray) -> list[str]:
    """Colours `(n, 3)` or with an opacity, which is left out, as the web writes them."""
    from matplotlib.colors import to_hex

    return [to_hex(cast("ColorType", tuple(colour[:3]))) for colour in colours]


def describe_links(links: Links, scenery: Scenery, frames: list[int]) -> Json:
    """The ends of lines between bodies, one after the other, and which lines are intact."""
    ends = links.ends[frames].reshape(len(frames), -1, links.ends.shape[-1])
    return {
        "nodes": ends.shape[1],
        "places": quantise_positions(scenery, ends),
        "held": links.held[frames].astype(np.uint8),
    }


def describe_obstacle(contact: Contact, scenery: Scenery, frames: list[int]) -> Json:
    """A ball; flat sheets, where they are at a time `since` and how fast they move on; or meshes, each from a frame on."""
    stage, times = scenery.stage, scenery.run.time[frames]
    first = outlines.build_outline(contact, stage, times[0])
    if first.velocity is None:
        moves = level_sets.moves(contact, stage, times)
        if first.normals is None and not moves:
            return _describe_sheets(first, times[0])
        if not moves:
            first = outlines.build_outline(contact, stage, times[0], PAGE_CELLS)
        return _describe_meshes(contact, first, scenery, frames, moves)
    if first.ball is not None:
        ball = {"center": first.ball.center.tolist(), "radius": first.ball.radius, "inside": not first.solid}
        return {"kind": "ball", "since": float(times[0]), "velocity": _spread_velocity(first)} | ball
    # a wall that comes in later is described as it is when it is first in the picture
    for since in times:
        found = outlines.build_outline(contact, stage, since)
        if len(found.polygons) or not np.any(first.velocity):
            return _describe_sheets(found, since)
    return _describe_sheets(first, times[0])


def _describe_sheets(outline: Outline, since: float) -> Json:
    sheets = [polygon.tolist() for polygon in outline.polygons]
    return {"kind": "sheets", "sheets": sheets, "since": float(since), "velocity": _spread_velocity(outline)}


def _spread_velocity(outline: Outline) -> list[float]:
    velocity = np.zeros(3) if outline.velocity is None else outline.velocity
    return np.broadcast_to(velocity, 3).tolist()


def _describe_meshes(contact: Contact, first: Outline, scenery: Scenery, frames: list[int], moves: bool) -> Json:
    """A surface as triangles, once or, if it moves, at moments spread evenly over the frames."""
    count = min(len(frames), MAX_OBSTACLE_STATES) if moves else 1
    chosen = np.linspace(0, len(frames), count, endpoint=False).astype(int)
    states = []
    for number in chosen.tolist():
        outline = first
        if number:
            outline = outlines.build_outline(contact, scenery.stage, float(scenery.run.time[frames[number]]))
        vertices, faces = _triangulate(outline)
        places = quantise_positions(scenery, vertices)
        states.append({"frame": number, "places": places, "faces": faces.astype(np.int32)})
    return {"kind": "mesh", "solid": first.solid, "one_sided": first.normals is not None, "states": states}


def _triangulate(outline: Outline) -> tuple[np.ndarray, np.ndarray]:
    """The different corners of polygons `(vertices, 3)`, and triangles between them that fan out from the first of each."""
    if not len(outline.polygons):
        return np.zeros((0, 3)), np.zeros((0, 3), int)
    vertices, numbers = np.unique(np.concatenate(list(outline.polygons)), axis=0, return_inverse=True)
    count = np.array([len(polygon) for polygon in outline.polygons])
    starts, fans = np.cumsum(count) - count, []
    for corner in range(1, count.max(initial=0) - 1):
        first = starts[count > corner + 1]
        fans.append(np.stack([first, first + corner, first + corner + 1], axis=1))
    return vertices, numbers.ravel()[np.concatenate(fans)]
