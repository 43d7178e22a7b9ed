"""Chosen frames side by side, each in its own axes with the same limits."""

import math
from collections.abc import Callable, Sequence
from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from physjax.parts import Contact
from physjax.show import obstacles
from physjax.show.frames import Frames
from physjax.show.stage import Stage, build_stage, create_axes

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure
    from matplotlib.transforms import Bbox
    from mpl_toolkits.mplot3d import Axes3D

FIGURE_WIDTH_INCHES = 7.2
"""The largest width of a figure [inches], that of a notebook."""
TITLE_INCHES = 0.38
"""Room for a line of title [inches]."""
PANEL_GAP_INCHES = 0.15
"""Between boxes in space that stand side by side [inches]."""
COLOUR_BAR_INCHES = 0.62
"""Room for a colour bar [inches]."""
LINE_INCHES = 0.17
"""Room for each further line of a title [inches]."""
FIT_PASSES = 3
"""Times that boxes in space are drawn to fit them: their size on paper is not quite proportional to that of their axes."""


class Scenery(NamedTuple):
    """What stays the same from frame to frame: the run, the box that is shown, and the surfaces in it."""

    run: Frames
    stage: Stage
    contacts: tuple[Contact, ...]

    @property
    def up(self) -> int:
        """The axis that is up."""
        return self.run.up

    @property
    def flat(self) -> bool:
        """Whether it is drawn in the plane."""
        return len(self.stage.low) == 2

    def position(self, frame: int) -> np.ndarray:
        """Positions of the nodes [m], `(nodes, dim)`."""
        return self.run.position[frame].astype(float)

    def draw_obstacles(self, ax: "Axes", frame: int) -> "list[Artist]":
        """Draw the surfaces at a frame, behind what moves; in space those that hide nothing."""
        if self.flat:
            return obstacles.draw_flat(ax, self.stage, self.contacts, self.run.time[frame])
        return obstacles.draw_in_space(cast("Axes3D", ax), self.stage, self.contacts, self.run.time[frame], self.up)

    def draw_solids(self, ax: "Axes", frame: int) -> "list[Artist]":
        """Draw the surfaces in space that hide what is behind them; in the plane nothing does."""
        if self.flat:
            return []
        return obstacles.draw_solids(cast("Axes3D", ax), self.stage, self.contacts, self.run.time[frame], self.up)


def build_scenery(run: Frames, frames: Sequence[int]) -> Scenery:
    """The run and a box that holds the given frames and the surfaces near them."""
    contacts = obstacles.select_shared_surfaces(run.surfaces, run.dim)
    stage = obstacles.include_obstacles(build_stage(run, frames), contacts, run.time[[min(frames), max(frames)]])
    return Scenery(run, stage.expand(0.03), contacts)


def draw_panels(
    scenery: Scenery, frames: Sequence[int], draw: Callable, figure: "Figure | None", bar: Callable | None = None
) -> "Figure":
    """A figure with a panel for each frame; `draw(ax, scenery, frame)` fills it, `bar(figure, where)` draws a colour bar."""
    from matplotlib import pyplot as plt

    figure = figure or plt.figure(figsize=(FIGURE_WIDTH_INCHES, FIGURE_WIDTH_INCHES))
    for ax, frame in zip(arrange_panels(figure, scenery, len(frames), bar), frames, strict=True):
        scenery.draw_obstacles(ax, frame)
        draw(ax, scenery, frame)
        ax.title.set_text(scenery.run.title(frame))
    return figure


def arrange_panels(figure: "Figure", scenery: Scenery, count: int, bar: Callable | None = None) -> "list[Axes]":
    """Empty axes for `count` panels; the figure becomes as high as they need."""
    rows, columns = _choose_grid(scenery, count)
    drawn = [create_axes(figure, (rows, columns, place), scenery.stage, scenery.up) for place in range(1, count + 1)]
    lines = 1 + scenery.run.title(0).count("\n")
    for ax in drawn:
        ax.set_title(scenery.run.title(0), fontsize=10, color="0.2")
    below, above = COLOUR_BAR_INCHES * (bar is not None), TITLE_INCHES + LINE_INCHES * (lines - 1)
    if scenery.flat:
        _fit_flat_panels(figure, drawn, scenery.stage, (rows, columns), (above, below))
    else:
        _fit_boxes(figure, cast("list[Axes3D]", drawn), (rows, columns), (above, below))
    if bar is not None:
        height = figure.get_size_inches()[1]
        bar(
            figure,
            {"ax": drawn} if scenery.flat else {"cax": figure.add_axes((0.25, 0.42 / height, 0.5, 0.1 / height))},
        )
    return drawn


def _fit_flat_panels(
    figure: "Figure", drawn: "list[Axes]", stage: Stage, grid: tuple[int, int], margins: tuple[float, float]
) -> None:
    """Make the figure as high as panels in the plane need; only those at the left and at the bottom name their axes."""
    (rows, columns), (above, below) = grid, margins
    across, up = stage.high - stage.low
    width = FIGURE_WIDTH_INCHES if columns * across > 0.8 * up else FIGURE_WIDTH_INCHES * 0.7
    height = float(np.clip(width / columns * up / across, 1.0, 5.0)) + above + 0.35
    figure.set_size_inches(width, rows * height + below)
    figure.set_layout_engine("constrained", h_pad=0.08, w_pad=0.08)
    for ax in drawn[:-columns]:
        ax.set_xlabel("")
    for place, ax in enumerate(drawn):
        ax.set_ylabel(ax.get_ylabel() if place % columns == 0 else "")


def draw_colour_bar(
    figure: "Figure", where: dict[str, Any], colours: "ScalarMappable", label: str, *, extend: str
) -> None:
    """A colour bar below all panels, in the room that `arrange_panels` leaves for it."""
    size = {} if "cax" in where else {"shrink": 0.6, "aspect": 40, "pad": 0.04, "location": "bottom"}
    bar = figure.colorbar(colours, orientation="horizontal", extend=extend, **size, **where)
    bar.set_label(label, fontsize=9)
    bar.ax.tick_params(labelsize=8, colors="0.35")
    bar.outline.set_visible(False)


def _choose_grid(scenery: Scenery, count: int) -> tuple[int, int]:
    """Rows and columns of panels: up to three side by side; wide ones in the plane up to three one above the other."""
    across, up = (scenery.stage.high - scenery.stage.low)[:2] if scenery.flat else (1, 1)
    columns = min(count, math.ceil(count / 3) if across > 1.6 * up else 3)
    return math.ceil(count / columns), columns


def _fit_boxes(figure: "Figure", drawn: "list[Axes3D]", grid: tuple[int, int], margins: tuple[float, float]) -> None:
    """Let each box in space fill its cell.

    matplotlib does not say how large a box and its labels become on paper, so the first is drawn and measured. Only the
    first panel of a row has labels; the others stand close to it.
    """
    (rows, columns), (above, below) = grid, margins
    for place, ax in enumerate(drawn):
        if place % columns:
            _clear_labels(ax)
    width = FIGURE_WIDTH_INCHES if columns > 1 else 5.6
    figure.set_size_inches(width, width)
    side, step, needed = width / columns, 0.0, width
    box, left, top, bottom = [0.0] * 4, 0.0, 0.0, 0.0
    for _ in range(FIT_PASSES):
        drawn[0].set_position((0, 0, side / width, side / width))
        figure.draw_without_rendering()
        box = [edge * side for edge in _measure_box(drawn[0])]
        left, bottom, right, top = _measure_labelled_box(figure, drawn[0], box)
        step = box[2] - box[0] + PANEL_GAP_INCHES
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
        ax._autotitlepos = False  # pyright: ignore[reportAttributeAccessIssue] private; or matplotlib would move the title back when it draws


def _clear_labels(ax: "Axes3D") -> None:
    """Remove the numbers and names of axes whose neighbour has them."""
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.set_label_text("")
        axis.set_tick_params(labelbottom=False, labelleft=False, label1On=False)


def _measure_labelled_box(figure: "Figure", ax: "Axes3D", box: list[float]) -> np.ndarray:
    """Left, lower, right and upper end of a box with its labels [inches]."""
    renderer = cast("FigureCanvasAgg", figure.canvas).get_renderer()
    labels = [
        np.array(cast("Bbox", axis.get_tightbbox(renderer)).extents) / figure.dpi
        for axis in (ax.xaxis, ax.yaxis, ax.zaxis)
    ]
    ends = np.array([box, *labels])
    return np.concatenate([ends[:, :2].min(axis=0), ends[:, 2:].max(axis=0)])


def _measure_box(ax: "Axes3D") -> tuple[float, float, float, float]:
    """Left, lower, right and upper end of the box alone, as shares of its axes."""
    from mpl_toolkits.mplot3d.proj3d import proj_transform

    corners = np.array(list(product(ax.get_xlim(), ax.get_ylim(), ax.get_zlim())))
    x, y, z = corners.T
    x, y, _ = proj_transform(x, y, z, ax.get_proj())
    points = ax.transAxes.inverted().transform(ax.transData.transform(np.stack([x, y], axis=-1)))
    return *points.min(axis=0), *points.max(axis=0)
