"""Sweeps drawn: a line over one axis, a map with contours over two, panels over three, points of a sampled design."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from matplotlib.contour import ContourSet
    from matplotlib.figure import Figure

    from physjax.study.sweeps.result import Sweep

NamedAxis = tuple[str, np.ndarray]
"""The label of an axis, and the numbers along it."""

GOOD_COLOUR, FAILED_COLOUR = "#0072B2", "#D55E00"
"""Good lanes and failed ones, colour-blind safe."""
FAILED_CELL_COLOUR = "0.8"
"""Failed cells of a map."""
MAX_CELLS = 1000
"""Cells of a map along an axis at most: more than a screen has pixels are never seen."""
MAX_PANELS = 6
"""Panels over the first of three axes at most, evenly spaced: each stays wide enough to be read."""
FIGURE_WIDTH_INCHES = 7.2
"""Width of a figure [inches]: a page of text."""


def draw_sweep(
    result: "Sweep",
    of: str | None = None,
    *,
    labels: dict[str, str] | None = None,
    ax: Any = None,
) -> "Axes | Figure":
    """Draw the number `of` a `Sweep`; `labels` are words with units for axes and numbers, by their names.

    Returns the axes; for panels over a third axis the figure, and there `ax` is a figure to draw into.
    """
    number, bad = np.asarray(result.number(of), float), ~np.asarray(result.ok)
    axes = [(_choose_label(axis.name, labels), np.asarray(axis.coordinate, float)) for axis in result.lanes.axes]
    what = _choose_label(of or "value", labels)
    number = np.where(bad, np.nan, number)
    if len(axes) == 1:
        return _draw_line(axes[0], number, bad, what, ax)
    if result.lanes.design == "zip":
        return _draw_points(axes[:2], number, bad, what, ax)
    if len(axes) == 2:
        return _draw_map(axes, number, bad, what, ax)
    if len(axes) == 3:
        return _draw_panels(axes, number, bad, what, ax)
    raise ValueError(
        f"plot: got {len(axes)} crossed axes, expected at most three. Sweep fewer, or plot to_xarray().sel(...)."
    )


def _choose_label(name: str, labels: dict[str, str] | None) -> str:
    return (labels or {}).get(name, name)


def _create_axes(ax: "Axes | None") -> "Axes":
    from matplotlib import pyplot as plt

    return ax or plt.figure(figsize=(FIGURE_WIDTH_INCHES, 4.4), layout="constrained").add_subplot()


def _draw_line(axis: NamedAxis, number: np.ndarray, bad: np.ndarray, what: str, ax: "Axes | None") -> "Axes":
    ax, (name, x) = _create_axes(ax), axis
    order = np.argsort(x, kind="stable")
    line = {"color": GOOD_COLOUR, "linewidth": 1.5, "marker": "." if x.size <= 100 else None}
    ax.plot(x[order], number[order], **line)
    if bad.any():
        edge = ax.get_xaxis_transform()
        words = f"failed ({bad.sum()} of {bad.size})"
        ax.plot(x[bad], np.full(bad.sum(), 0.02), "x", color=FAILED_COLOUR, transform=edge, label=words, clip_on=False)
        ax.legend(frameon=False)
    ax.set(xlabel=name, ylabel=what, xscale=_choose_scale(x))
    ax.grid(color="0.9")
    return ax


def _draw_map(axes: list[NamedAxis], number: np.ndarray, bad: np.ndarray, what: str, ax: "Axes | None") -> "Axes":
    """The first axis upwards, the second to the right, a colour bar."""
    ax = _create_axes(ax)
    mesh, lines = _draw_cells(ax, axes, number, *_find_range(number))
    if lines is not None:
        ax.clabel(lines, fontsize=8, fmt="%.4g")
    ax.figure.colorbar(mesh, ax=ax, label=what)
    if bad.any():
        ax.set_title(f"grey: failed ({bad.sum()} of {bad.size})", fontsize=10, color="0.3")
    return ax


def _draw_panels(
    axes: list[NamedAxis], number: np.ndarray, bad: np.ndarray, what: str, figure: "Figure | None"
) -> "Figure":
    """A map for each of a few values of the first axis, all on one scale of colours."""
    from matplotlib import pyplot as plt

    (name, values), *others = axes
    shown = np.unique(np.linspace(0, values.size - 1, min(values.size, MAX_PANELS)).round().astype(int))
    columns = min(3, shown.size)
    rows = math.ceil(shown.size / columns)
    figure = figure or plt.figure(figsize=(FIGURE_WIDTH_INCHES, 2.6 * rows + 0.5), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    span = _find_range(number[shown])
    for ax, i in zip(panels, shown, strict=False):
        mesh, _ = _draw_cells(ax, others, number[i], *span)
        ax.set_title(f"{name}: {values[i]:.4g}", fontsize=10)
    for ax in panels:
        ax.label_outer()
    for ax in panels[shown.size :]:
        ax.set_visible(False)
    grey = f"; grey: failed ({bad[shown].sum()} of {bad[shown].size})" if bad[shown].any() else ""
    figure.colorbar(mesh, ax=list(panels), label=what + grey)
    return figure


def _draw_cells(
    ax: "Axes", axes: list[NamedAxis], number: np.ndarray, low: float, high: float
) -> "tuple[QuadMesh, ContourSet | None]":
    """Cells coloured by the number, with a few lines of equal number (None where there are too few cells)."""
    from matplotlib.ticker import MaxNLocator

    (up, y), (right, x) = axes
    keep = tuple(slice(None, None, math.ceil(v.size / MAX_CELLS)) for v in (y, x))
    y, x, number = y[keep[0]], x[keep[1]], number[keep]
    ax.set_facecolor(FAILED_CELL_COLOUR)
    mesh = ax.pcolormesh(x, y, np.ma.masked_invalid(number), vmin=low, vmax=high, shading="nearest", rasterized=True)
    lines = None
    if min(number.shape) > 2 and low < high:
        levels = MaxNLocator(8).tick_values(low, high)
        lines = ax.contour(x, y, np.ma.masked_invalid(number), levels=levels, colors="white", linewidths=0.7)
    ax.set(xlabel=right, ylabel=up, xscale=_choose_scale(x), yscale=_choose_scale(y))
    return mesh, lines


def _draw_points(axes: list[NamedAxis], number: np.ndarray, bad: np.ndarray, what: str, ax: "Axes | None") -> "Axes":
    """Sampled points over the first two axes, coloured by the number."""
    ax, ((right, x), (up, y)) = _create_axes(ax), axes
    low, high = _find_range(number)
    dots = ax.scatter(x[~bad], y[~bad], c=number[~bad], s=max(4, min(30, 20_000 / x.size)), vmin=low, vmax=high)
    if bad.any():
        ax.scatter(x[bad], y[bad], marker="x", color=FAILED_COLOUR, s=25, label=f"failed ({bad.sum()} of {bad.size})")
        ax.figure.legend(loc="outside lower center", frameon=False)
    ax.figure.colorbar(dots, ax=ax, label=what)
    ax.set(xlabel=right, ylabel=up)
    return ax


def _find_range(number: np.ndarray) -> tuple[float, float]:
    good = number[np.isfinite(number)]
    return (float(good.min()), float(good.max())) if good.size else (0.0, 1.0)


def _choose_scale(values: np.ndarray) -> str:
    """Logarithmic where values grow by equal factors over more than a decade; equal to 0.1 %, as rounded numbers are."""
    positive = values.size > 2 and np.all(values > 0) and values.max() > 10 * values.min()
    return (
        "log" if positive and np.ptp(np.diff(np.log(values))) < 1e-3 * abs(np.diff(np.log(values))).max() else "linear"
    )
