"""Particles as dots with a trail."""

from typing import Any, NamedTuple

import numpy as np

from physjax.show import obstacles
from physjax.show.frames import Frames
from physjax.show.panels import Scenery, arrange_panels, build_scenery
from physjax.show.stage import Stage, build_stage

MAX_TRAIL_PIECES = 16
"""A trail has at most so many pieces."""


class Trails(NamedTuple):
    """Draws one frame after the other: a dot for each lane, and the way that it came in the last `trail` seconds."""

    colours: np.ndarray
    trail: float

    def __call__(self, ax: Any, scenery: Scenery, frame: int) -> list[Any]:
        """Draw a frame into axes in the plane or in space."""
        from matplotlib.collections import LineCollection

        position = scenery.position(frame)
        seen = np.isfinite(position).all(axis=-1)
        dots = dict(c=self.colours[seen], s=float(np.clip(4000 / len(seen), 5, 45)), linewidths=0, zorder=4)
        pieces, colours = self._build_pieces(scenery.run, frame)
        if scenery.flat:
            trail = ax.add_collection(LineCollection(pieces, colors=colours, linewidths=1.2, zorder=3))
            return [trail, ax.scatter(*position[seen].T, **dots)]
        from mpl_toolkits.mplot3d.art3d import Line3DCollection

        # matplotlib cannot add a collection of nothing in space
        lines = [Line3DCollection(pieces, colors=colours, linewidths=1.2, zorder=3)] if len(pieces) else []
        trail = [ax.add_collection3d(line) for line in lines]
        balls = obstacles.draw_balls(ax, scenery.stage, scenery.contacts, scenery.run.time[frame], scenery.up)
        return [*trail, ax.scatter(*position[seen].T, depthshade=True, **dots), *balls]

    def _build_pieces(self, run: Frames, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Pieces `(pieces, 2, dim)` of the way up to a frame, and their colours, which fade towards the past."""
        first = int(np.searchsorted(run.time, run.time[frame] - self.trail))
        steps = np.unique(np.linspace(first, frame, min(MAX_TRAIL_PIECES, frame - first) + 1).round().astype(int))
        way = run.position[steps].astype(float)
        pieces = np.stack([way[:-1], way[1:]], axis=2)
        colours = np.broadcast_to(self.colours, (*pieces.shape[:2], 4)).copy()
        colours[..., 3] *= np.linspace(0, 0.6, len(pieces) + 1)[1:, None]
        whole = np.isfinite(pieces).all(axis=(-1, -2))
        return pieces[whole], colours[whole]


def build_trails(who: str, seen: Frames, every: int, color: Any, trail: float) -> tuple[Frames, Trails]:
    """The lanes that are drawn, and how. Raises ValueError where `color` is not one finite value for each lane."""
    from matplotlib import colormaps

    lanes = seen.position.shape[1]
    shade = np.arange(lanes, dtype=float) if color is None else np.asarray(color, float).ravel()
    if len(shade) != lanes or not np.isfinite(shade).all():
        raise ValueError(f"{who}: got color {np.shape(color)}, expected a finite number for each of the {lanes} lanes.")
    shade = shade[::every]
    colours = colormaps["viridis"]((shade - shade.min()) / (np.ptp(shade) or 1.0) * 0.9)
    return seen._replace(position=seen.position[:, ::every]), Trails(colours, trail)


def build_trail_scenery(seen: Frames, frames: Any) -> tuple[Scenery, Any]:
    """What stays the same, and what makes the axes; particles on a line stand side by side and move up and down."""
    if seen.dim > 1:
        return build_scenery(seen, frames), arrange_panels
    lanes = seen.position.shape[1]
    lane_numbers = np.broadcast_to(np.arange(lanes, dtype=seen.position.dtype)[:, None], seen.position.shape)
    seen = seen._replace(position=np.concatenate([lane_numbers, seen.position], axis=-1), surfaces=())
    stage = build_stage(seen, frames)
    margin = np.array([0.03 * lanes + 0.5, 0.04 * (stage.high[1] - stage.low[1]) or 0.5])
    return Scenery(seen, Stage(stage.low - margin, stage.high + margin), ()), _arrange_lanes


def _arrange_lanes(figure: Any, scenery: Scenery, count: int, bar: Any) -> list[Any]:
    drawn = arrange_panels(figure, scenery, count, bar)
    figure.set_size_inches(5.6, 4.0)
    for ax in drawn:
        ax.set_aspect("auto")
        ax.locator_params(nbins=4)
        ax.set(xlabel="lane", ylabel="position [m]")
    return drawn
