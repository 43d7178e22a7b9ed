"""A run as the content of a page: what moves, frame by frame, the surfaces around it, and the box that is shown."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np
from jax.typing import ArrayLike

from physjax.parts import Contact
from physjax.physics.rigid.planar import PlanarBodies
from physjax.show import obstacles
from physjax.show.bodies import choose_body_colours
from physjax.show.drawables import Bodies, Dots, Drawable, Look, PlanarFigures, Surface, choose_drawable
from physjax.show.flat_page import CONTOUR_POINTS, describe_flat_obstacle, quantise_flat_bodies, take_flat_bodies
from physjax.show.frames import Frames
from physjax.show.lines import Lines
from physjax.show.links import Links
from physjax.show.page_data import (
    QUANTISATION_STEPS,
    Json,
    build_padded_box,
    describe_links,
    describe_obstacle,
    number_shapes,
    quantise_positions,
    to_hexes,
)
from physjax.show.panels import Scenery
from physjax.show.plot import MAX_DRAWN_LANES
from physjax.show.spring_lines import build_spring_lines
from physjax.show.stage import AZIMUTH, ELEVATION
from physjax.show.trails import build_trails
from physjax.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.typing import ColorType

COLOUR_COUNT = 256
"""Colours of a colour bar."""


class Pace(NamedTuple):
    """The frames of a run that a page shows, how many of them a second, and how many seconds of the run in one."""

    frames: list[int]
    fps: float
    speed: float


class Seen(NamedTuple):
    """A run as it is drawn: the record of its frames, bodies in the plane as a part of the page, and what is drawn.

    `colours` are those of bodies in space, `(bodies, 4)`.
    """

    run: Frames
    bodies: Json
    drawn: Drawable
    colours: np.ndarray | None = None

    @property
    def links(self) -> Links | None:
        """The rods and ropes between bodies."""
        return self.drawn.links if isinstance(self.drawn, Bodies | PlanarFigures) else None


def take_seen(
    who: str,
    film: Trajectory,
    shown: Look | None,
    scene: int | Sequence[int] | None,
    color: "ColorType | ArrayLike | None",
) -> Seen:
    """What a run is drawn as on a page; see `animate.view` for the errors."""
    seen = choose_drawable(who, film, shown, scene, dims=(2, 3))
    if isinstance(film.state, PlanarBodies) and isinstance(seen, PlanarFigures | Dots):
        shapes = seen.shapes if isinstance(seen, PlanarFigures) else None
        run, bodies = take_flat_bodies(who, film, shapes, color)
        links = seen.links if isinstance(seen, PlanarFigures) else None
        return Seen(run if links is None else links.add_nodes(run), bodies, seen)
    if isinstance(seen, Bodies):
        return Seen(seen.surface().run, {}, seen, choose_body_colours(who, film, color, len(seen.shapes)))
    return Seen(seen.run, {}, seen)


def describe_run(
    who: str,
    seen: Seen,
    pace: Pace,
    scenery: Scenery,
    color: "ColorType | ArrayLike | None" = None,
    describe_surface: Callable[[Contact, Scenery, list[int]], Json] | None = None,
) -> Json:
    """The content of a page, with its arrays still as arrays.

    `describe_surface` describes a contact, by default as the page in the plane or in space has it.
    """
    frames = pace.frames
    if seen.bodies:
        part = quantise_flat_bodies(seen.bodies, scenery, frames)
    elif isinstance(seen.drawn, Surface):
        part = _describe_surface(seen.drawn, scenery, frames, color)
    elif isinstance(seen.drawn, Bodies):
        assert seen.colours is not None
        part = _describe_bodies(seen.drawn, scenery, frames, seen.colours)
    elif isinstance(seen.drawn, Lines):
        part = _describe_lines(who, seen.drawn, scenery, frames)
    else:
        part = _describe_dots(who, cast("Dots", seen.drawn), scenery, frames, color)
    if seen.links is not None:
        part |= {"links": describe_links(seen.links, scenery, frames)}
    describe = describe_surface or describe_contact
    return {
        "frames": frames,
        "titles": scenery.run.titles(frames),
        "time": scenery.run.time[frames].tolist(),
        "fps": pace.fps,
        "speed": pace.speed,
        "low": scenery.stage.low.tolist(),
        "high": scenery.stage.high.tolist(),
        "reach": [end.tolist() for end in build_padded_box(scenery)],
        "from": [ELEVATION, AZIMUTH],
        "up": scenery.up,
        "light": obstacles.LIGHT_DIRECTION.tolist(),
        "part": part,
        "obstacles": [describe(contact, scenery, frames) for contact in scenery.contacts],
    }


def describe_contact(contact: Contact, scenery: Scenery, frames: list[int], points: int = CONTOUR_POINTS) -> Json:
    """A surface for a page in the plane, there found on a grid of `points` squared, or in space."""
    if scenery.flat:
        return describe_flat_obstacle(contact, scenery, frames, points)
    return describe_obstacle(contact, scenery, frames)


def _describe_surface(
    seen: Surface, scenery: Scenery, frames: list[int], color: "ColorType | ArrayLike | None"
) -> Json:
    return {
        "kind": "surface",
        "color": _to_hex(color),
        "faces": seen.faces.astype(np.int32),
        "nodes": seen.run.position.shape[1],
        "places": quantise_positions(scenery, seen.run.position[frames].astype(float)),
    }


def _describe_bodies(seen: Bodies, scenery: Scenery, frames: list[int], colours: np.ndarray) -> Json:
    """Centres, quaternions (x, y, z, w), which keep shapes rigid, and the triangles of each shape that differs."""
    turn = np.roll(seen.orientation[frames], -1, axis=-1)
    numbers, different = number_shapes(seen.shapes)
    return {
        "kind": "bodies",
        "colors": to_hexes(colours),
        "nodes": seen.run.position.shape[1],
        "places": quantise_positions(scenery, seen.run.position[frames].astype(float)),
        "turns": np.round(turn * QUANTISATION_STEPS).astype(np.int16),
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
        "pairs": spring_lines.pairs.astype(np.int32),
        "places": quantise_positions(scenery, position),
        "shades": np.round(shade * (COLOUR_COUNT - 1)).astype(np.uint8),
        "held": held.astype(np.uint8),
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
        "places": quantise_positions(scenery, seen.run.position[frames].astype(float)),
        "colors": trails.colours[:, :3].ravel().round(3).tolist(),
        "paths": seen.run.position.shape[1] <= MAX_DRAWN_LANES,
    }


def _to_hex(color: "ColorType | ArrayLike | None") -> str:
    from matplotlib.colors import to_hex

    return to_hex("#56B4E9" if color is None else cast("ColorType", color))
