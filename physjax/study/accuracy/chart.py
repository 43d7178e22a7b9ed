"""Error against cost, step and drift: a work-precision study drawn."""

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from physjax.show.plot import MAX_DRAWN_LANES, draw_paths
from physjax.show.style import PROJECTED, LineStyle, style
from physjax.study.accuracy.result import Run, WorkPrecision
from physjax.text import format_seconds

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FRONT_BAND_STYLE = {"color": "#F0E442", "linewidth": 9, "alpha": 0.5, "solid_capstyle": "round"}
"""The Pareto front."""
SMALLEST_DRAWN_ERROR = 1e-17
"""Errors of 0 are drawn here, below any rounding, since a logarithmic axis has no 0."""
LEGEND_LINE_INCHES, LEGEND_MARGIN_INCHES, SMALLEST_LEGEND_INCHES = 0.207, 0.63, 1.53
"""Heights [inch] of a line of the legend, of what is around it, and of the least that is left to it."""

PATH_ERROR_LABEL = "largest error on the path [path extent]"

Number = Callable[[Run], float | None]
"""A number of a run, which is drawn along an axis."""


def draw_work_precision(result: WorkPrecision, figure: "Figure | None" = None) -> "Figure":
    """Four panels of an `accuracy.WorkPrecision`: path, error against time, error against step, drift (or evaluations).

    Runs that failed stand as crosses on the upper edge, where they died; the Pareto front is a band. Where gradients or
    other norms were studied, two more panels show them against time. Returns the figure.
    """
    from matplotlib import pyplot as plt

    more = bool(result.gradients or result.norms)
    figure = figure or plt.figure(figsize=(11, 13 if more else 9))
    grid = {"left": 0.08, "right": 0.98, "top": 0.945 if more else 0.92, "wspace": 0.22, "hspace": 0.3}
    grid["bottom"] = _draw_legend(figure, result)
    panels = figure.subplots(2 + more, 2, gridspec_kw=grid)
    copies = f", {result.batch:,} copies at once" if result.batch > 1 else ""
    title = f"{result.name.replace('_', ' ')}: {format_seconds(result.duration)}, {result.dtype}{copies}"
    figure.suptitle(title, fontsize=14)
    _draw_path(panels[0, 0], result)
    _draw_errors(panels[0, 1], panels[1, 0], result)
    _draw_drift_or_evaluations(panels[1, 1], result)
    if more:
        _draw_more_panels(panels[2], result)
    return figure


def _draw_path(ax: "Axes", result: WorkPrecision) -> None:
    """The true path, and where chaos begins."""
    time, position = result.path
    seen = position.reshape(position.shape[0], -1, position.shape[-1])[..., :2]  # space is seen from above
    every = math.ceil(seen.shape[1] / MAX_DRAWN_LANES)
    draw_paths(time, seen, every, None, ax).set_title(f"the path ({result.truth})", fontsize=11)
    if math.isfinite(result.horizon):
        _mark_horizon(ax, time, seen, result.horizon)


def _draw_errors(against_time: "Axes", against_step: "Axes", result: WorkPrecision) -> None:
    """Error on the path against run time, with the Pareto front, and against the step."""
    _draw_curves(against_time, result, lambda run: run.seconds, _path_error, floor=result.floor)
    against_time.set(xlabel="run time [s]", ylabel=PATH_ERROR_LABEL)
    against_time.set_title("speed against accuracy: lower left is better", fontsize=11)
    _draw_front(against_time, result.front)
    _draw_curves(against_step, result, lambda run: run.dt, _path_error, floor=result.floor)
    against_step.set(xlabel="step dt [s]", ylabel=PATH_ERROR_LABEL)
    against_step.set_title("order: the slope of each line", fontsize=11)


def _draw_drift_or_evaluations(ax: "Axes", result: WorkPrecision) -> None:
    """The drift of the first conserved quantity against the step; where nothing is conserved, error against evaluations."""
    if result.conserved:
        _draw_curves(ax, result, lambda run: run.dt, lambda run: run.drifts[0])
        ax.set(xlabel="step dt [s]", ylabel=f"largest change of the {result.conserved[0]} [relative]")
        ax.set_title(f"what must be conserved: {result.conserved[0]}", fontsize=11)
    else:
        _draw_curves(ax, result, lambda run: run.evaluations, _path_error, floor=result.floor)
        ax.set(xlabel="force evaluations", ylabel=PATH_ERROR_LABEL)
        ax.set_title("the same on any machine: error against evaluations", fontsize=11)


def _draw_more_panels(panels: Sequence["Axes"], result: WorkPrecision) -> None:
    """Gradient error against gradient cost, and the first of the other norms against time."""
    left, right = panels
    if result.gradients:
        _draw_curves(left, result._replace(runs=result.gradients), lambda run: run.seconds, _path_error)
        left.set(xlabel="time of path and derivative [s]", ylabel="largest error of the derivative [its largest]")
        left.set_title("gradient error against gradient cost", fontsize=11)
    if result.norms:
        _draw_curves(right, result, lambda run: run.seconds, lambda run: run.errors[0])
        right.set(xlabel="run time [s]", ylabel=f"error of {result.norms[0]} [relative]")
        right.set_title(f"another norm: {result.norms[0]}", fontsize=11)
    left.set_visible(bool(result.gradients))
    right.set_visible(bool(result.norms))


def _path_error(run: Run) -> float:
    return run.path_error


def _draw_front(ax: "Axes", front: Sequence[Run]) -> None:
    """The Pareto front, behind the lines."""
    errors = [max(run.path_error, SMALLEST_DRAWN_ERROR) for run in front]
    ax.plot([run.seconds for run in front], errors, **FRONT_BAND_STYLE, zorder=0)


def _mark_horizon(ax: "Axes", time: np.ndarray, position: np.ndarray, horizon: float) -> None:
    """Where rounding has grown to a hundredth of the path: what follows is one of many paths."""
    if position.shape[-1] == 1:
        ax.axvline(horizon, color="0.2", linestyle="--")
    else:
        ax.plot(*position[np.searchsorted(time, horizon)].T, "o", color="0.2", markerfacecolor="white")
    words = f"chaos: beyond {format_seconds(horizon)} (marked) errors mean nothing"
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1}
    ax.annotate(words, (0.02, 0.02), xycoords="axes fraction", fontsize=8.5, bbox=box)


def _draw_curves(ax: "Axes", result: WorkPrecision, x: Number, y: Callable[[Run], float], floor: float = 0.0) -> None:
    """A line for each method through the runs that stayed on the path, and crosses on the upper edge for the others."""
    for method in result.methods:
        runs = [(across, run) for run in result.of(method) if (across := x(run)) is not None]
        good = [(across, max(y(run), SMALLEST_DRAWN_ERROR)) for across, run in runs if run.status == "ok"]
        line = _style_of(result, method)
        ax.plot([across for across, _ in good], [up for _, up in good], **line)
        failed = [across for across, run in runs if run.status != "ok"]
        edge = ax.get_xaxis_transform()
        ax.plot(failed, [0.975] * len(failed), "x", color=line["color"], transform=edge, markersize=6, clip_on=False)
    if floor:
        ax.axhline(floor, color="0.5", linestyle=":", linewidth=1)
        words = "error of the reference"
        ax.annotate(words, (0.02, floor), xycoords=ax.get_yaxis_transform(), fontsize=8, va="bottom")
    ax.set(xscale="log", yscale="log")
    bottom, top = ax.get_ylim()
    ax.set_ylim(max(bottom, SMALLEST_DRAWN_ERROR), max(top, 1.0) * 4)
    ax.grid(which="major", color="0.9")


def _style_of(result: WorkPrecision, method: str) -> LineStyle:
    """Line style of the runs of a name in tables, by what they are."""
    run = result.of(method)[0]
    return style(run.scheme or run.method, treatment=run.treatment, dtype=run.dtype, adaptive=run.adaptive)


def _draw_legend(figure: "Figure", result: WorkPrecision) -> float:
    """The legend, which stands below the panels; returns the share of the figure's height that they must leave to it."""
    from matplotlib.lines import Line2D

    # where both treatments of contacts ran, each has a column of its own, a method to a line
    methods = sorted(result.methods, key=lambda method: result.of(method)[0].treatment == PROJECTED)
    projected = result.of(methods[-1])[0].treatment == PROJECTED
    handles = [Line2D([], [], **_style_of(result, method), label=_format_label(result, method)) for method in methods]
    failed = Line2D([], [], color="0.2", marker="x", linestyle="", label="failed (upper edge)")
    handles.insert(len(methods) // 2 if projected else len(methods), failed)
    handles.append(Line2D([], [], **FRONT_BAND_STYLE, label="Pareto front"))
    columns = 2 if projected else 3
    title = (
        "solid: impacts found inside the step; dashed, hollow: projected at the end of the step" if projected else None
    )
    figure.legend(
        handles=handles,
        loc="lower center",
        ncols=columns,
        fontsize=9.5,
        frameon=False,
        title=title,
        title_fontsize=9.5,
    )
    lines = projected + math.ceil(len(handles) / columns)
    inches = max(SMALLEST_LEGEND_INCHES, LEGEND_MARGIN_INCHES + LEGEND_LINE_INCHES * lines)
    return inches / figure.get_size_inches()[1]


def _format_label(result: WorkPrecision, method: str) -> str:
    if all(run.dt is None for run in result.of(method)):  # no step, no slope
        return method if method.startswith("adaptive") else f"{method} (adaptive)"
    order = result.observed_order(method)
    observed = "exact" if math.isinf(order) else "order unseen" if math.isnan(order) else f"order {order:.2f}"
    promised = result.promised.get(method, math.nan)
    return f"{method}: {observed}" + ("" if math.isnan(promised) else f" (promised {promised:.0f})")
