"""A run as one HTML page on which it can be turned, zoomed and played, and which fetches nothing.

In space it is drawn by three.js (MIT, see web/vendor/), which is part of the page; in the plane on a canvas.
"""

import base64
import json
import os
import zlib
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from jax.typing import ArrayLike

from physjax.physics.rigid.planar import PlanarBodies
from physjax.show import obstacles
from physjax.show.bodies import choose_body_colours
from physjax.show.drawables import Bodies, Dots, Look, PlanarFigures, Surface, choose_drawable
from physjax.show.films import schedule
from physjax.show.flat_page import describe_flat_obstacle, pack_flat_bodies, take_flat_bodies
from physjax.show.lines import Lines
from physjax.show.page_data import (
    QUANTISATION_STEPS,
    Json,
    build_padded_box,
    describe_links,
    describe_obstacle,
    number_shapes,
    pack_frames,
    quantise_positions,
    to_hexes,
)
from physjax.show.pages import check_output_path, embed_page, fill_page, read_web_file, write_page
from physjax.show.panels import Scenery, build_scenery
from physjax.show.plot import MAX_DRAWN_LANES
from physjax.show.spring_lines import build_spring_lines
from physjax.show.stage import AZIMUTH, ELEVATION
from physjax.show.trails import build_trails
from physjax.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.typing import ColorType

NOTEBOOK_HEIGHT_PIXELS = 560
"""Height of the page inside a notebook [pixels]."""
COLOUR_COUNT = 256
"""Colours of a colour bar."""


class View:
    """A page with the frames of a run, to be looked at and played. A notebook shows it; `.save("x.html")` writes it.

    Example:
        >>> isinstance(animate.view(wave, sheet), animate.View)
        True
    """

    def __init__(self, content: Json):
        self._content = content
        self.frames = tuple(content["frames"])
        self.fps = content["fps"]

    def __repr__(self) -> str:
        return f"<View of {len(self.frames)} frames, a page of {len(self.page()) / 1e6:.2g} MB>"

    def page(self) -> str:
        """The HTML, which needs no other file."""
        data = json.dumps(self._content, separators=(",", ":")).replace("<", "\\u003c")
        if len(self._content["low"]) == 2:
            return fill_page("plane.html", FILM=data)
        return fill_page("view.html", THREE=_load_library(), FILM=data)

    def save(self, path: str | os.PathLike) -> Path:
        """Write the page, whole or not at all; returns the path.

        Raises ValueError for a name that does not end in .html and FileNotFoundError where there is no such folder.
        """
        return write_page(check_output_path(path, (".html",)), self.page())

    def _repr_html_(self) -> str:
        return embed_page(self.page(), NOTEBOOK_HEIGHT_PIXELS)


def view(
    film: Trajectory,
    shown: Look | None = None,
    *,
    scene: int | Sequence[int] | None = None,
    color: "ColorType | ArrayLike | None" = None,
    fps: int | float = 30.0,
    speed: int | float = 1.0,
) -> View:
    """A run as a page to turn (in space), zoom, pan and play, with its surfaces, axes in metres, and up as in the scene.

    `shown` is what the film is drawn as: a cloth, a jelly or a mesh as a surface, springs or a lattice without faces as
    lines coloured by strain, a `solids` shape or one for each body, in the plane a `rigid.PlanarShape`. Without it bodies
    are the shapes of the scene's `rigid.Solids` or boxes of their inertia, nodes are joined by the scene's springs or rods,
    and everything else is dots with their paths; rods and ropes between bodies are lines. `color` is one for surfaces and
    bodies, or a value for each lane for dots and bodies. The page plays `speed` seconds of the run a second, in `fps`
    frames. Positions are rounded to 1/65 534 of the sides of the box. A run that blew up is shown until its last good frame.

    Raises TypeError or ValueError for a film, `shown`, `color`, `fps` or `speed` that do not fit; runs in one dimension
    are for `animate.paths`.

    Example:
        >>> animate.view(wave, sheet).save("wave.html").name
        'wave.html'
    """
    who = "animate.view"
    seen = choose_drawable(who, film, shown, scene, dims=(2, 3))
    flat = isinstance(film.state, PlanarBodies) and isinstance(seen, PlanarFigures | Dots)
    links = seen.links if isinstance(seen, Bodies | PlanarFigures) else None
    if flat:
        shapes = seen.shapes if isinstance(seen, PlanarFigures) else None
        run, bodies = take_flat_bodies(who, film, shapes, color)
        run = run if links is None else links.add_nodes(run)
    else:
        run, bodies = (seen.surface() if isinstance(seen, Bodies) else seen).run, {}
    frames, fps = schedule(who, run, fps, speed)
    scenery = build_scenery(run, frames)
    if flat:
        part = pack_flat_bodies(bodies, scenery, frames)
    elif isinstance(seen, Surface):
        part = _describe_surface(seen, scenery, frames, color)
    elif isinstance(seen, Bodies):
        colours = choose_body_colours(who, film, color, len(seen.shapes))
        part = _describe_bodies(seen, scenery, frames, colours)
    elif isinstance(seen, Lines):
        part = _describe_lines(who, seen, scenery, frames)
    else:
        part = _describe_dots(who, cast("Dots", seen), scenery, frames, color)
    describe = describe_flat_obstacle if scenery.flat else describe_obstacle
    return View(
        {
            "frames": frames,
            "titles": [scenery.run.title(frame) for frame in frames],
            "time": scenery.run.time[frames].tolist(),
            "fps": fps,
            "speed": float(speed),
            "low": scenery.stage.low.tolist(),
            "high": scenery.stage.high.tolist(),
            "reach": [end.tolist() for end in build_padded_box(scenery)],
            "from": [ELEVATION, AZIMUTH],
            "up": scenery.up,
            "light": obstacles.LIGHT_DIRECTION.tolist(),
            "part": part,
            "links": None if links is None else describe_links(links, scenery, frames),
            "obstacles": [describe(contact, scenery, frames) for contact in scenery.contacts],
        }
    )


def _describe_surface(
    seen: Surface, scenery: Scenery, frames: list[int], color: "ColorType | ArrayLike | None"
) -> Json:
    return {
        "kind": "surface",
        "color": _to_hex(color),
        "faces": pack_frames(seen.faces.astype(np.int32)),
        "nodes": seen.run.position.shape[1],
        "places": pack_frames(quantise_positions(scenery, seen.run.position[frames].astype(float))),
    }


def _describe_bodies(seen: Bodies, scenery: Scenery, frames: list[int], colours: np.ndarray) -> Json:
    """Centres, quaternions (x, y, z, w), which keep shapes rigid, and the triangles of each shape that differs."""
    turn = np.roll(seen.orientation[frames], -1, axis=-1)
    numbers, different = number_shapes(seen.shapes)
    return {
        "kind": "bodies",
        "colors": to_hexes(colours),
        "nodes": seen.run.position.shape[1],
        "places": pack_frames(quantise_positions(scenery, seen.run.position[frames].astype(float))),
        "turns": pack_frames(np.round(turn * QUANTISATION_STEPS).astype(np.int16)),
        "shape": numbers,
        "shapes": [{"vertices": s.vertices.ravel().tolist(), "faces": s.faces.ravel().tolist()} for s in different],
    }


def _describe_lines(who: str, seen: Lines, scenery: Scenery, frames: list[int]) -> Json:
    """Springs in the colours of their strain, rods without a limit of it; broken ones are grey."""
    spring_lines = build_spring_lines(who, seen, frames)
    position = seen.run.position[frames].astype(float)
    bar = spring_lines.colours()
    shade = np.clip((spring_lines.strain(position) / spring_lines.limit + 1) / 2, 0, 1)
    held = np.ones(shade.shape, bool) if spring_lines.held is None else spring_lines.held[frames]
    return {
        "kind": "lines",
        "nodes": position.shape[1],
        "pairs": pack_frames(spring_lines.pairs.astype(np.int32)),
        "places": pack_frames(quantise_positions(scenery, position)),
        "shades": pack_frames(np.round(shade * (COLOUR_COUNT - 1)).astype(np.uint8)),
        "held": pack_frames(held.astype(np.uint8)),
        "ramp": (bar.cmap(np.linspace(0, 1, COLOUR_COUNT))[:, :3] * 255).round().astype(int).tolist(),
        "limit": None if spring_lines.rest is None else 100 * spring_lines.limit,
    }


def _describe_dots(
    who: str, seen: Dots, scenery: Scenery, frames: list[int], color: "ColorType | ArrayLike | None"
) -> Json:
    """Lanes in colours of their own, with their whole paths if there are few of them."""
    _, trails = build_trails(who, seen.run, 1, cast("ArrayLike | None", color), 0.0)
    return {
        "kind": "dots",
        "nodes": seen.run.position.shape[1],
        "places": pack_frames(quantise_positions(scenery, seen.run.position[frames].astype(float))),
        "colors": trails.colours[:, :3].ravel().round(3).tolist(),
        "paths": seen.run.position.shape[1] <= MAX_DRAWN_LANES,
    }


def _to_hex(color: "ColorType | ArrayLike | None") -> str:
    from matplotlib.colors import to_hex

    return to_hex("#56B4E9" if color is None else cast("ColorType", color))


@cache
def _load_library() -> str:
    return base64.b64encode(zlib.compress(read_web_file("vendor/three.min.js").encode(), 9)).decode()
