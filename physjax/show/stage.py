"""Axes in metres: up as in the scene, one scale in all directions, and limits that stay the same from frame to frame."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np

from physjax.show.frames import Frames

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator
    from mpl_toolkits.mplot3d import Axes3D
    from mpl_toolkits.mplot3d.axis3d import Axis as SpaceAxis

ELEVATION, AZIMUTH = 16.0, 28.0
"""The direction from which space is seen [degrees]: the height above the ground, and the turn about the axis that is up,
from the axis after it (z if y is up) towards the next (x)."""
REACH_SHARE = 2.5
"""What is farther from the middle of the picture than this times its longest side does not make the picture larger."""
NEAR_FLOOR_SHARE = 0.3
"""A floor is worth showing when it is no farther from what moves than this share of the picture."""
MAX_EXTENT_RATIO = 4.0
"""Frames of a run that blew up do not set the limits if they are more than this times as large as the first."""
MIN_SIDE_SHARE = 0.25
"""The shortest side of the box, as a share of the longest: a flat motion still gets room for its axis and numbers."""
EDGE_SLACK_SHARE = 0.05
"""What is outside of the box by less than this share of its longest side is still drawn."""


class Stage(NamedTuple):
    """The box that is drawn: its lower and its upper corner [m]."""

    low: np.ndarray
    high: np.ndarray

    @property
    def size(self) -> float:
        """The longest side [m]."""
        return float((self.high - self.low).max())

    def expand(self, share: float) -> "Stage":
        """The box with a margin all around, and no side much shorter than the longest."""
        middle, side = (self.low + self.high) / 2, self.high - self.low
        side = np.maximum(side, MIN_SIDE_SHARE * (side.max() or 1.0)) + 2 * share * (side.max() or 1.0)
        return Stage(middle - side / 2, middle + side / 2)

    def include(self, low: np.ndarray, high: np.ndarray) -> "Stage":
        """Large enough for another box as well."""
        return Stage(np.minimum(self.low, low), np.maximum(self.high, high))

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Which points `(..., dim)` are inside, or nearly."""
        slack = EDGE_SLACK_SHARE * self.size
        return np.asarray(((points >= self.low - slack) & (points <= self.high + slack)).all(axis=-1))


def build_stage(run: Frames, frames: Sequence[int]) -> Stage:
    """The box around all lanes at the given frames, as far as they are finite."""
    position = run.position[list(frames)].astype(float)
    position = np.where(np.isfinite(position), position, np.nan)
    low, high = np.nanmin(position, axis=1), np.nanmax(position, axis=1)
    if run.blew_up:
        # the last frames before a run is non-finite are huge: with them in the picture nothing else could be made out
        extent = (high - low).max(axis=-1)
        modest = extent <= MAX_EXTENT_RATIO * (extent[0] or extent[extent > 0].min(initial=np.inf))
        low, high = low[modest], high[modest]
    return Stage(low.min(axis=0), high.max(axis=0))


def create_axes(figure: "Figure", place: tuple[int, int, int], stage: Stage, up: int = 1) -> "Axes":
    """Axes for a box in the plane or in space, with the axis `up` upright; nothing that is drawn changes their limits."""
    flat = len(stage.low) == 2
    ax = figure.add_subplot(*place, projection=None if flat else "3d")
    axes = (ax.xaxis, ax.yaxis) if flat else (ax.xaxis, ax.yaxis, cast("Axes3D", ax).zaxis)
    for axis, name, low, high in zip(axes, "xyz"[: len(axes)], stage.low, stage.high, strict=True):
        ax.set(**{f"{name}lim": (low, high), f"{name}label": f"{name} [m]"})
        axis.set_major_locator(_choose_ticks((high - low) / stage.size, 2 if flat else 1))
    ax.set_autoscale_on(False)
    ax.tick_params(labelsize=8, colors="0.35")
    if flat:
        ax.set_aspect("equal")
        for edge in ax.spines.values():
            edge.set_color("0.75")
    else:
        _style_space_axes(cast("Axes3D", ax), stage, up)
    return ax


def _style_space_axes(ax: "Axes3D", stage: Stage, up: int) -> None:
    """Perspective, pale panes, and small labels close to their axes."""
    ax.view_init(elev=ELEVATION, azim=AZIMUTH, vertical_axis="xyz"[up])
    ax.set_proj_type("persp", focal_length=1.6)
    ax.computed_zorder = False  # by layers: sorted by depth, a floor would come before the cloth on it
    ax.patch.set_visible(False)  # boxes reach into their neighbours' axes
    for axis in get_space_axes(ax):
        axis.set_pane_color((0.98, 0.98, 0.985, 1.0))
        axis.line.set_color("0.75")
        axis._axinfo["grid"].update(color="0.9", linewidth=0.6)  # pyright: ignore[reportAttributeAccessIssue]  # not of the public face
    ax.tick_params(pad=0)
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.labelpad = 2
        axis.label.set_fontsize(8.5)
    ax.set_box_aspect(stage.high - stage.low, zoom=1)


def get_space_axes(ax: "Axes3D") -> "list[SpaceAxis]":
    """The three axes of axes in space; matplotlib's own types know only those of the plane."""
    return cast("list[SpaceAxis]", [ax.xaxis, ax.yaxis, ax.zaxis])


def _choose_ticks(share: float, fewest: int) -> "MaxNLocator":
    """Few ticks, and fewer on a side that is a small share of the longest."""
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(max(fewest, round(4 * share)), steps=[1, 2, 5, 10], min_n_ticks=fewest)
