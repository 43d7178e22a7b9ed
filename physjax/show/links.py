"""Rods and ropes between points of bodies: lines from point to point, in front of bodies or behind them as they are."""

from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from physjax.physics.rigid.joint_kinds import BodyDistances
from physjax.physics.rigid.planar import PlanarBodies
from physjax.show import obstacles
from physjax.show.frames import Frames
from physjax.show.panels import Scenery
from physjax.show.planar import turn_vectors
from physjax.show.solids import rotate_vectors
from physjax.show.spring_lines import BROKEN_LOOK, add_lines
from physjax.show.surfaces import find_covered_points
from physjax.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from mpl_toolkits.mplot3d import Axes3D

LINK_LOOK: dict[str, Any] = {"colors": "0.3", "linewidths": 1.6, "zorder": 5}
PIECES = 24
"""Pieces of a line in space, each of which is seen or hidden as its middle is."""


class Links(NamedTuple):
    """Lines between points of bodies: `ends` `(frames, links, 2, dim)` [m], and which are intact, `held` `(frames, links)`."""

    ends: np.ndarray
    held: np.ndarray

    def add_nodes(self, run: Frames) -> Frames:
        """The run with the ends of the lines as nodes behind its own: first and second of the first line, and so on."""
        ends = self.ends.reshape(len(run.time), -1, run.dim)
        return run._replace(position=np.concatenate([run.position.astype(float), ends], axis=1))

    def list_pairs(self, run: Frames) -> np.ndarray:
        """The nodes that each line joins, `(links, 2)`, of a run with `add_nodes`."""
        count = 2 * self.ends.shape[1]
        return np.arange(run.position.shape[1] - count, run.position.shape[1]).reshape(-1, 2)


class LinkPicture(NamedTuple):
    """Draws frames of lines between bodies; in space triangles `(faces, 3)` of the scenery's nodes hide what is behind them."""

    links: Links
    faces: np.ndarray

    def __call__(self, ax: "Axes", scenery: Scenery, frame: int) -> "list[Artist]":
        """Draw a frame: one collection of the lines that are intact, and one, dashed and grey, of the broken ones."""
        ends, held = self.links.ends[frame], self.links.held[frame]
        inside = np.isfinite(ends).all(axis=(1, 2))
        drawn = []
        for chosen, look in ((inside & held, LINK_LOOK), (inside & ~held, BROKEN_LOOK)):
            lines = ends[chosen]
            if len(lines) and not scenery.flat:
                lines = self._cut_hidden(cast("Axes3D", ax), scenery, frame, lines)
            if len(lines):
                drawn.append(add_lines(ax, lines, **look))
        return drawn

    def _cut_hidden(self, ax: "Axes3D", scenery: Scenery, frame: int, lines: np.ndarray) -> np.ndarray:
        """The parts of lines that neither a body nor a solid obstacle hides."""
        share = np.linspace(0.0, 1.0, PIECES + 1)[:, None]
        points = lines[:, :1] + share * (lines[:, 1:] - lines[:, :1])
        middle = ((points[:, :-1] + points[:, 1:]) / 2).reshape(-1, 3)
        triangles = scenery.position(frame)[self.faces]
        solids = obstacles.find_solids(scenery.stage, scenery.contacts, scenery.run.time[frame])
        hidden = obstacles.find_hidden(solids, middle, ax, scenery.up)
        hidden |= find_covered_points(middle, triangles[np.isfinite(triangles).all(axis=(1, 2))], ax)
        # seen pieces that follow each other are one line
        steps = np.diff(np.pad(~hidden.reshape(len(lines), PIECES), [(0, 0), (1, 1)]).astype(int), axis=1)
        starts, ends = (points[np.nonzero(steps == sign)] for sign in (1, -1))
        return np.stack([starts, ends], axis=1)


def find_links(film: Trajectory) -> Links | None:
    """The rods and ropes between the bodies of a run, of all worlds side by side; None where there are none."""
    if film.scene is None:
        return None
    parts = [part for part in film.scene.forces if isinstance(part, BodyDistances)]
    if not parts:
        return None
    ends = np.concatenate([_place_ends(film, part) for part in parts], axis=1)
    held = np.concatenate([_find_unbroken(film, number, part) for number, part in enumerate(parts)], axis=1)
    return Links(ends, held)


def _place_ends(film: Trajectory, part: BodyDistances) -> np.ndarray:
    """Where both ends of each rod are, `(frames, links, 2, dim)`."""
    state, pairs, points = film.state, np.asarray(part.pairs), np.asarray(part.points, float)
    assert film.scene is not None
    bodies = (film.scene.state.lanes or (1,))[-1]
    by_world = lambda numbers, axes: np.asarray(numbers, float).reshape(len(film.time), -1, bodies, *axes)  # noqa: E731
    place = by_world(state.position, points.shape[-1:])
    ends = []
    for side in range(2):
        body, own = pairs[:, side], points[:, side]
        if isinstance(state, PlanarBodies):
            arm = turn_vectors(by_world(state.angle, ())[:, :, body], own)
        else:
            arm = rotate_vectors(by_world(state.orientation, (4,))[:, :, body], own)
        # the points of the world are where they are
        ends.append(np.where((body < 0)[:, None], own, place[:, :, body] + arm))
    found = np.stack(ends, axis=-2)
    return found.reshape(len(found), -1, *found.shape[-2:])


def _find_unbroken(film: Trajectory, number: int, part: BodyDistances) -> np.ndarray:
    """Which are intact at every frame, `(frames, links)`, as the run recorded: all, where none can break."""
    frames, worlds = len(film.time), int(np.prod(film.position.shape[1:-2], dtype=int))
    if part.breaks_at is None:
        return np.ones((frames, worlds * len(part.pairs)), bool)
    recorded = [force for force in film.film.forces if isinstance(force, BodyDistances)][number]
    return np.asarray(recorded.unbroken).reshape(frames, -1)


__all__ = ["LINK_LOOK", "LinkPicture", "Links", "find_links"]
