"""A run in three dimensions that can be turned, zoomed and played: one page of its own, which fetches nothing.

Drawn by three.js (MIT, see web/vendor/), which travels inside the page.
"""

import base64
import json
import os
import zlib
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from physjax.physics.contacts.shapes import Sphere
from physjax.show import obstacles
from physjax.show.drawables import Bodies, Dots, Lines, Surface, subject
from physjax.show.films import schedule
from physjax.show.frames import batch_index
from physjax.show.pages import demanded, filled, framed, shipped, write_page
from physjax.show.panels import Scenery, scenery_of
from physjax.show.plot import MOST_LANES
from physjax.show.spring_lines import strands_of
from physjax.show.stage import AZIMUTH, ELEVATION
from physjax.show.trails import swarm_of
from physjax.trajectory import Trajectory

FINEST = 32767
"""A place is one of so many steps to either side of the middle of the box, along each of its sides."""
HIDDEN = -32768
"""Stands for a place outside of the box, or for none: what touches it is not drawn."""
HEIGHT = 560
"""Of the page inside a notebook [pixels]."""
SHADES = 256
"""Colours of a colour bar."""


class View:
    """A page with the frames of a run, to be turned, zoomed and played. Shows itself in a notebook; `.save("x.html")`.

    Example:
        >>> isinstance(animate.view(wave, sheet), animate.View)
        True
    """

    def __init__(self, content: dict[str, Any]):
        self._content = content
        self.frames = tuple(content["frames"])
        self.fps = content["fps"]

    def __repr__(self) -> str:
        return f"<View of {len(self.frames)} frames, a page of {len(self.page()) / 1e6:.2g} MB>"

    def page(self) -> str:
        """The page: HTML that needs nothing else."""
        data = json.dumps(self._content, separators=(",", ":")).replace("<", "\\u003c")
        return filled("view.html", THREE=_library(), FILM=data)

    def save(self, path: str | os.PathLike) -> Path:
        """Write the page, whole or not at all; returns the path.

        Raises ValueError for a name that does not end in .html and FileNotFoundError where there is no such folder.
        """
        return write_page(demanded(path, (".html",)), self.page())

    def _repr_html_(self) -> str:
        return framed(self.page(), HEIGHT)


def view(
    film: Trajectory,
    shown: Any = None,
    *,
    scene: int | Sequence[int] | None = None,
    color: Any = None,
    fps: int | float = 30.0,
    speed: int | float = 1.0,
) -> View:
    """A run in space as a page to turn, zoom, pan and play, with floors, walls and balls, axes in metres, up as in the scene.

    `shown` is what the film is drawn as: a cloth, a jelly or a mesh as a surface, springs or a lattice without faces as
    lines coloured by strain, a `solids` shape or one for each body. Without it bodies are boxes of their inertia, nodes
    are joined by the scene's springs, and everything else is dots with their paths. `color` is one for surfaces and
    bodies, a value for each lane for dots. It plays `speed` seconds of the run a second, in `fps` frames. Places are
    rounded to 1/65 534 of the sides of the box. A run that blew up is shown until its last good frame.

    Raises TypeError or ValueError for a film, `shown`, `color`, `fps` or `speed` that do not fit; 2-D films are for
    `animate.paths` and `animate.springs`.

    Example:
        >>> animate.view(wave, sheet).save("wave.html").name
        'wave.html'
    """
    who = "animate.view"
    seen = subject(who, film, shown, scene)
    whole = seen.surface() if isinstance(seen, Bodies) else seen
    frames, fps = schedule(who, seen.take, fps, speed)
    scenery = scenery_of(whole.take, frames)
    index = batch_index(who, film, scene) if isinstance(seen, Lines) else ()
    part = {
        Surface: lambda: _surface(seen, scenery, frames, color),
        Bodies: lambda: _bodies(seen, scenery, frames, color),
        Lines: lambda: _lines(who, film, seen, index, scenery, frames),
        Dots: lambda: _dots(who, seen, scenery, frames, color),
    }[type(seen)]()
    low, high = scenery.stage
    return View(
        {
            "frames": frames,
            "titles": [scenery.take.title(frame) for frame in frames],
            "time": scenery.take.time[frames].tolist(),
            "fps": fps,
            "speed": float(speed),
            "low": low.tolist(),
            "high": high.tolist(),
            "reach": [end.tolist() for end in _reach(scenery)],
            "from": [ELEVATION, AZIMUTH],
            "up": scenery.up,
            "light": obstacles.LIGHT.tolist(),
            "part": part,
            "obstacles": [_obstacle(contact, scenery, frames) for contact in scenery.contacts],
        }
    )


def packed(array: np.ndarray) -> str:
    """Numbers as text: the change from frame to frame (whole numbers wrap around), deflated, in base 64."""
    steps = np.diff(array, axis=0, prepend=np.zeros_like(array[:1]))
    return base64.b64encode(zlib.compress(steps.tobytes(), 9)).decode()


def places(scenery: Scenery, position: np.ndarray) -> np.ndarray:
    """Positions `(frames, nodes, 3)` [m] as 16-bit whole numbers, `HIDDEN` where they are not inside of the box."""
    low, high = _reach(scenery)
    inside = scenery.stage.holds(position)[..., None]
    share = (np.where(inside, position, low) - low) / (high - low)
    return np.where(inside, np.round((2 * share - 1) * FINEST), HIDDEN).astype(np.int16)


def _reach(scenery: Scenery) -> tuple[np.ndarray, np.ndarray]:
    """The box with the slack within which it `holds` a point."""
    slack = 0.06 * scenery.stage.size
    return scenery.stage.low - slack, scenery.stage.high + slack


def _surface(seen: Surface, scenery: Scenery, frames: list[int], color: Any) -> dict[str, Any]:
    return {
        "kind": "surface",
        "color": _hex(color),
        "faces": packed(seen.faces.astype(np.int32)),
        "nodes": seen.take.position.shape[1],
        "places": packed(places(scenery, seen.take.position[frames].astype(float))),
    }


def _bodies(seen: Bodies, scenery: Scenery, frames: list[int], color: Any) -> dict[str, Any]:
    """Centres and quaternions (x, y, z, w), which keep shapes rigid, and each shape's triangles."""
    turn = np.roll(seen.orientation[frames], -1, axis=-1)
    return {
        "kind": "bodies",
        "color": _hex(color),
        "nodes": seen.take.position.shape[1],
        "places": packed(places(scenery, seen.take.position[frames].astype(float))),
        "turns": packed(np.round(turn * FINEST).astype(np.int16)),
        "shapes": [{"vertices": s.vertices.ravel().tolist(), "faces": s.faces.ravel().tolist()} for s in seen.shapes],
    }


def _lines(
    who: str, film: Trajectory, seen: Lines, index: tuple[int, ...], scenery: Scenery, frames: list[int]
) -> dict[str, Any]:
    """Springs in colours of their strain; those that parted are grey."""
    strands = strands_of(who, film, seen.springs, index, seen.take, frames, None)
    position = seen.take.position[frames].astype(float)
    bar = strands.colours()
    shade = np.clip((strands.strain(position) / strands.limit + 1) / 2, 0, 1)
    held = np.ones(shade.shape, bool) if strands.held is None else strands.held[frames]
    return {
        "kind": "lines",
        "nodes": position.shape[1],
        "pairs": packed(strands.pairs.astype(np.int32)),
        "places": packed(places(scenery, position)),
        "shades": packed(np.round(shade * (SHADES - 1)).astype(np.uint8)),
        "held": packed(held.astype(np.uint8)),
        "ramp": (bar.cmap(np.linspace(0, 1, SHADES))[:, :3] * 255).round().astype(int).tolist(),
        "limit": 100 * strands.limit,
    }


def _dots(who: str, seen: Dots, scenery: Scenery, frames: list[int], color: Any) -> dict[str, Any]:
    """Lanes in colours of their own, with the whole of their paths if they are few."""
    _, swarm = swarm_of(who, seen.take, 1, color, 0.0)
    return {
        "kind": "dots",
        "nodes": seen.take.position.shape[1],
        "places": packed(places(scenery, seen.take.position[frames].astype(float))),
        "colors": swarm.colours[:, :3].ravel().round(3).tolist(),
        "paths": seen.take.position.shape[1] <= MOST_LANES,
    }


def _obstacle(contact: Any, scenery: Scenery, frames: list[int]) -> dict[str, Any]:
    """A ball, or sheets of glass where they are first seen, and how far they are then and how fast they go."""
    velocity = getattr(contact, "velocity", None)
    drift = {"velocity": np.zeros(3).tolist() if velocity is None else np.asarray(velocity, float).tolist()}
    if isinstance(contact, Sphere):
        ball = {"center": np.asarray(contact.center, float).tolist(), "radius": float(contact.radius)}
        return {"kind": "ball", "inside": bool(contact.inside), "since": 0.0} | ball | drift
    found: list[np.ndarray] = []
    for since in scenery.take.time[frames]:
        found = [sheet for sheet in obstacles.sheets_of(contact, scenery.stage, since) if len(sheet) > 2]
        if found or velocity is None:
            break
    return {"kind": "sheets", "sheets": [s.tolist() for s in found], "since": float(since)} | drift


def _hex(color: Any) -> str:
    from matplotlib.colors import to_hex

    return to_hex("#56B4E9" if color is None else color)


@cache
def _library() -> str:
    return base64.b64encode(zlib.compress(shipped("vendor/three.min.js").encode(), 9)).decode()
