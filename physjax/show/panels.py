"""Chosen frames side by side, each in axes of its own with the same limits."""

import math
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from physjax.show import obstacles
from physjax.show.frames import Take
from physjax.show.stage import Stage, axes, stage_of

WIDTH = 7.2
"""A figure is at most so wide [inches], the width of a notebook."""
ABOVE = 0.38
"""Room for a line of title [inches]."""
GAP = 0.15
"""Between boxes in space that stand side by side [inches]."""
BAR = 0.62
"""Room for a colour bar [inches]."""


class Scenery(NamedTuple):
    """What stays the same from frame to frame: the film, the box that is shown, and what is in the way."""

    take: Take
    stage: Stage
    contacts: tuple

    @property
    def up(self) -> int:
        """The axis that is up."""
        return self.take.up

    @property
    def flat(self) -> bool:
        """Whether it is drawn in the plane."""
        return len(self.stage.low) == 2

    def position(self, frame: int) -> np.ndarray:
        """Positions of the nodes [m], `(nodes, dim)`."""
        return self.take.position[frame].astype(float)

    def obstacles(self, ax: Any, frame: int) -> list[Any]:
        """Draw what is in the way."""
        if self.flat:
            return obstacles.flat(ax, self.stage, self.contacts, self.take.time[frame])
        return obstacles.in_space(ax, self.stage, self.contacts, self.take.time[frame], self.up)


def scenery_of(take: Take, frames: Any) -> Scenery:
    """The film and a box that holds the given frames, with what is in the way."""
    contacts = obstacles.shown(take.surfaces)
    stage = obstacles.with_obstacles(stage_of(take, frames), contacts, take.time[[min(frames), max(frames)]])
    return Scenery(take, stage.grown(0.03), contacts)


def panels(scenery: Scenery, frames: Sequence[int], draw: Callable, figure: Any, bar: Any = None) -> Any:
    """A figure with a panel for each frame; `draw(ax, scenery, frame)` fills it, `bar(figure, axes)` draws a colour bar."""
    from matplotlib import pyplot as plt

    figure = figure or plt.figure(figsize=(WIDTH, WIDTH))
    for ax, frame in zip(arranged(figure, scenery, len(frames), bar), frames, strict=True):
        scenery.obstacles(ax, frame)
        draw(ax, scenery, frame)
        ax.title.set_text(scenery.take.title(frame))
    return figure


def arranged(figure: Any, scenery: Scenery, count: int, bar: Any = None) -> list[Any]:
    """Empty axes for so many panels; the figure becomes as high as they need."""
    rows, columns = _grid(scenery, count)
    drawn = [axes(figure, (rows, columns, place), scenery.stage, scenery.up) for place in range(1, count + 1)]
    lines = 1 + scenery.take.blew_up
    for ax in drawn:
        ax.set_title(scenery.take.title(0), fontsize=10, color="0.2")
    below, above = BAR * (bar is not None), ABOVE + 0.17 * (lines - 1)
    if scenery.flat:
        across, up = scenery.stage.high - scenery.stage.low
        width = WIDTH if columns * across > 0.8 * up else WIDTH * 0.7
        height = float(np.clip(width / columns * up / across, 1.0, 5.0)) + above + 0.35
        figure.set_size_inches(width, rows * height + below)
        figure.set_layout_engine("constrained", h_pad=0.08, w_pad=0.08)
        for ax in drawn[:-columns]:
            ax.set_xlabel("")
        for place, ax in enumerate(drawn):
            ax.set_ylabel(ax.get_ylabel() if place % columns == 0 else "")
    else:
        _fit(figure, drawn, (rows, columns), (above, below))
    if bar is not None:
        height = figure.get_size_inches()[1]
        bar(
            figure,
            {"ax": drawn} if scenery.flat else {"cax": figure.add_axes((0.25, 0.42 / height, 0.5, 0.1 / height))},
        )
    return drawn


def bar_below(figure: Any, where: dict[str, Any], colours: Any, label: str, *, extend: str) -> None:
    """A colour bar below all panels, where `arranged` has room for it."""
    size = {} if "cax" in where else {"shrink": 0.6, "aspect": 40, "pad": 0.04, "location": "bottom"}
    bar = figure.colorbar(colours, orientation="horizontal", extend=extend, **size, **where)
    bar.set_label(label, fontsize=9)
    bar.ax.tick_params(labelsize=8, colors="0.35")
    bar.outline.set_visible(False)


def _grid(scenery: Scenery, count: int) -> tuple[int, int]:
    """Rows and columns of panels: up to three side by side; in the plane what is wide one above the other, up to three."""
    across, up = (scenery.stage.high - scenery.stage.low)[:2] if scenery.flat else (1, 1)
    columns = min(count, math.ceil(count / 3) if across > 1.6 * up else 3)
    return math.ceil(count / columns), columns


def _fit(figure: Any, drawn: list[Any], grid: tuple[int, int], margins: tuple[float, float]) -> None:
    """Let each box in space fill its cell: axes in space know nothing of how large box and labels become on paper.

    The first panel of a row has the labels, the others stand close to it.
    """
    (rows, columns), (above, below) = grid, margins
    for place, ax in enumerate(drawn):
        if place % columns:
            _unlabel(ax)
    width = WIDTH if columns > 1 else 5.6
    figure.set_size_inches(width, width)
    side = width / columns
    for _ in range(3):
        drawn[0].set_position((0, 0, side / width, side / width))
        figure.draw_without_rendering()
        box = [edge * side for edge in _box(drawn[0])]
        left, bottom, right, top = _paper(figure, drawn[0], box)
        step = box[2] - box[0] + GAP
        needed = box[0] - left + (columns - 1) * step + right - box[0]
        side *= min((width - 0.1) / needed, 4.6 / (top - bottom))
    height = top - bottom + above
    total = rows * height + below + 0.05
    figure.set_size_inches(width, total)
    for place, ax in enumerate(drawn):
        row, column = divmod(place, columns)
        x, y = (width - needed) / 2 - left + column * step, total - above - row * height - top
        ax.set_position((x / width, y / total, side / width, side / total))
        ax.title.set_position((0.5 * (box[0] + box[2]) / side, (top + 0.02) / side))
        ax._autotitlepos = False


def _unlabel(ax: Any) -> None:
    """No numbers and names on axes whose neighbour has them."""
    for name in "xyz":
        getattr(ax, f"set_{name}label")("")
        getattr(ax, f"{name}axis").set_tick_params(labelbottom=False, labelleft=False, label1On=False)


def _paper(figure: Any, ax: Any, box: list[float]) -> np.ndarray:
    """Left, lower, right and upper end of a box with its labels [inches]."""
    renderer = figure.canvas.get_renderer()
    labels = [axis.get_tightbbox(renderer).extents / figure.dpi for axis in (ax.xaxis, ax.yaxis, ax.zaxis)]
    ends = np.array([box, *labels])
    return np.concatenate([ends[:, :2].min(axis=0), ends[:, 2:].max(axis=0)])


def _box(ax: Any) -> tuple[float, float, float, float]:
    """The same ends of the box alone, as shares of the axes."""
    from mpl_toolkits.mplot3d.proj3d import proj_transform

    corners = np.array(list(product(ax.get_xlim(), ax.get_ylim(), ax.get_zlim())))
    x, y, _ = proj_transform(*corners.T, ax.get_proj())
    points = ax.transAxes.inverted().transform(ax.transData.transform(np.stack([x, y], axis=-1)))
    return *points.min(axis=0), *points.max(axis=0)
