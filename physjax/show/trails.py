"""Particles as dots, each with the last part of its path behind it."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np
from jax.typing import ArrayLike

from physjax.show.frames import Frames
from physjax.show.panels import Scenery, arrange_panels, build_scenery
from physjax.show.stage import Stage, build_stage

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

MAX_TRAIL_PIECES = 16
"""A trail has at most this many straight pieces: more are not seen, and each is drawn in every picture."""


class Trails(NamedTuple):
    """Draws frames: a dot in its colour (red, green, blue, opacity) for each lane, and its path in the last `trail` seconds."""

    colours: np.ndarray
    trail: float

    def __call__(self, ax: "Axes", scenery: Scenery, frame: int) -> "list[Artist]":
        """Draw a frame into axes in the plane or in space."""
        from matplotlib.collections import LineCollection

        position = scenery.position(frame)
        alive = np.asarray(np.isfinite(position).all(axis=-1))
        # the area of a dot [points²]: about the same ink, however many there are
        dots = dict(c=self.colours[alive], s=float(np.clip(4000 / len(alive), 5, 45)), linewidths=0, zorder=4)
        pieces, colours = self._build_pieces(scenery.run, frame)
        if scenery.flat:
            trail = ax.add_collection(LineCollection(list(pieces), colors=colours, linewidths=1.2, zorder=3))
            return [trail, ax.scatter(*position[alive].T, **dots)]
        from mpl_toolkits.mplot3d.art3d import Line3DCollection

        # matplotlib cannot add a collection of nothing in space
        lines = [Line3DCollection(pieces, colors=colours, linewidths=1.2, zorder=3)] if len(pieces) else []
        trail = [cast("Axes3D", ax).add_collection3d(line) for line in lines]
        return [*trail, ax.scatter(*position[alive].T, depthshade=True, **dots), *scenery.draw_solids(ax, frame)]

    def _build_pieces(self, run: Frames, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Pieces `(pieces, 2, dim)` of the paths up to a frame, and their colours, which fade towards the past."""
        first = int(np.searchsorted(run.time, run.time[frame] - self.trail))
        steps = np.unique(np.linspace(first, frame, min(MAX_TRAIL_PIECES, frame - first) + 1).round().astype(int))
        path = run.position[steps].astype(float)
        pieces = np.stack([path[:-1], path[1:]], axis=2)
        colours = np.broadcast_to(self.colours, (*pieces.shape[:2], 4)).copy()
        colours[..., 3] *= np.linspace(0, 0.6, len(pieces) + 1)[1:, None]
        whole = np.isfinite(pieces).all(axis=(-1, -2))
        return pieces[whole], colours[whole]


def build_trails(who: str, run: Frames, every: int, color: ArrayLike | None, trail: float) -> tuple[Frames, Trails]:
    """One lane in `every`, and how it is drawn. Raises ValueError where `color` is not one finite value for each lane."""
    from matplotlib import colormaps

    lanes = run.position.shape[1]
    shade = np.arange(lanes, dtype=float) if color is None else np.asarray(color, float).ravel()
    if len(shade) != lanes or not np.isfinite(shade).all():
        raise ValueError(
            f"{who}: got color {np.asarray(color).shape}, expected a finite number for each of the {lanes} lanes."
        )
    shade = shade[::every]
    colours = colormaps["viridis"]((shade - shade.min()) / (np.ptp(shade) or 1.0) * 0.9)
    return run._replace(position=run.position[:, ::every]), Trails(colours, trail)


def build_trail_scenery(run: Frames, frames: Sequence[int]) -> tuple[Scenery, Callable]:
    """The scenery, and the function that arranges the axes; particles on a line stand side by side and move up and down."""
    if run.dim > 1:
        return build_scenery(run, frames), arrange_panels
    lanes = run.position.shape[1]
    lane_numbers = np.broadcast_to(np.arange(lanes, dtype=run.position.dtype)[:, None], run.position.shape)
    run = run._replace(position=np.concatenate([lane_numbers, run.position], axis=-1), surfaces=())
    stage = build_stage(run, frames)
    margin = np.array([0.03 * lanes + 0.5, 0.04 * (stage.high[1] - stage.low[1]) or 0.5])
    return Scenery(run, Stage(stage.low - margin, stage.high + margin), ()), _arrange_lanes


def _arrange_lanes(figure: "Figure", scenery: Scenery, count: int, bar: Callable | None = None) -> "list[Axes]":
    """Axes for particles on a line: lanes across, positions upwards, each with a scale of its own."""
    drawn = arrange_panels(figure, scenery, count, bar)
    figure.set_size_inches(5.6, 4.0)
    for ax in drawn:
        ax.set_aspect("auto")
        ax.locator_params(nbins=4)
        ax.set(xlabel="lane", ylabel="position [m]")
    return drawn
