"""Where things are drawn: axes in metres, up as in the scene, the same scale in every direction, and limits that do not move."""

from typing import Any, NamedTuple

import numpy as np

from physjax.show.frames import Frames

ELEVATION, AZIMUTH = 16.0, 28.0
"""From where space is seen [degrees]: from above, and turned from the axis after the one that is up (z if y is) to the next."""
MAX_EXTENT_RATIO = 4.0
"""Of a run that blew up, frames so many times larger than its first do not set the limits."""


class Stage(NamedTuple):
    """The box that is drawn: its lower and its upper corner [m]."""

    low: np.ndarray
    high: np.ndarray

    @property
    def size(self) -> float:
        """The longest side [m]."""
        return float((self.high - self.low).max())

    def expand(self, share: float) -> "Stage":
        """A margin all around, and no side shorter than a part of the longest."""
        middle, side = (self.low + self.high) / 2, self.high - self.low
        side = np.maximum(side, 0.25 * (side.max() or 1.0)) + 2 * share * (side.max() or 1.0)
        return Stage(middle - side / 2, middle + side / 2)

    def include(self, low: np.ndarray, high: np.ndarray) -> "Stage":
        """Large enough for another box as well."""
        return Stage(np.minimum(self.low, low), np.maximum(self.high, high))

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Which points are inside, or nearly."""
        slack = 0.05 * self.size
        return ((points >= self.low - slack) & (points <= self.high + slack)).all(axis=-1)


def build_stage(run: Frames, frames: Any) -> Stage:
    """The box around all lanes at the given frames, as far as they are finite."""
    seen = run.position[frames].astype(float)
    seen = np.where(np.isfinite(seen), seen, np.nan)
    low, high = np.nanmin(seen, axis=1), np.nanmax(seen, axis=1)
    if run.blew_up:
        extent = (high - low).max(axis=-1)
        modest = extent <= MAX_EXTENT_RATIO * (extent[0] or extent[extent > 0].min(initial=np.inf))
        low, high = low[modest], high[modest]
    return Stage(low.min(axis=0), high.max(axis=0))


def create_axes(figure: Any, place: tuple[int, int, int], stage: Stage, up: int = 1) -> Any:
    """Axes for a box in the plane or in space, where one is `up`, which stay as they are whatever is drawn into them."""
    flat = len(stage.low) == 2
    ax = figure.add_subplot(*place, projection=None if flat else "3d")
    names = "xy" if flat else "xyz"
    for name, low, high in zip(names, stage.low, stage.high, strict=True):
        getattr(ax, f"set_{name}lim")(low, high)
        getattr(ax, f"set_{name}label")(f"{name} [m]")
        getattr(ax, f"{name}axis").set_major_locator(_choose_ticks((high - low) / stage.size, 2 if flat else 1))
    ax.set_autoscale_on(False)
    ax.tick_params(labelsize=8, colors="0.35")
    if flat:
        ax.set_aspect("equal")
        for edge in ax.spines.values():
            edge.set_color("0.75")
    else:
        _style_space_axes(ax, stage, up)
    return ax


def _style_space_axes(ax: Any, stage: Stage, up: int) -> None:
    ax.view_init(elev=ELEVATION, azim=AZIMUTH, vertical_axis="xyz"[up])
    ax.set_proj_type("persp", focal_length=1.6)
    ax.computed_zorder = False
    ax.patch.set_visible(False)  # boxes reach into their neighbours' axes
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.set_pane_color((0.98, 0.98, 0.985, 1.0))
        axis.line.set_color("0.75")
        axis._axinfo["grid"].update(color="0.9", linewidth=0.6)
    ax.tick_params(pad=0)
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.labelpad = 2
        axis.label.set_fontsize(8.5)
    ax.set_box_aspect(stage.high - stage.low, zoom=1.0)


def _choose_ticks(share: float, fewest: int) -> Any:
    """Few ticks, and fewer on a side that is only a share of the longest."""
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(max(fewest, round(4 * share)), steps=[1, 2, 5, 10], min_n_ticks=fewest)
