"""Error against cost, step and drift: a work-precision study drawn."""

import math
from typing import Any

import numpy as np

from physjax.show.plot import MAX_DRAWN_LANES, draw_paths
from physjax.show.style import PROJECTED_SUFFIX, style
from physjax.text import format_seconds

FRONT_BAND_STYLE = {"color": "#F0E442", "linewidth": 9, "alpha": 0.5, "solid_capstyle": "round"}
"""Pareto's front."""


def draw_work_precision(result: Any, figure: Any = None) -> Any:
    """Four panels of an `accuracy.WorkPrecision`: path, error against time, error against step, drift (or evaluations).

    Runs that failed stand as crosses on the upper edge, where they died; Pareto's front is a band. Where gradients or
    other norms were studied, two more panels show them against time. Returns the figure.
    """
    from matplotlib import pyplot as plt

    more = bool(result.gradients or result.norms)
    figure = figure or plt.figure(figsize=(11, 13 if more else 9))
    bottom = _draw_legend(figure, result)
    grid = {
        "left": 0.08,
        "right": 0.98,
        "top": 0.945 if more else 0.92,
        "bottom": bottom,
        "wspace": 0.22,
        "hspace": 0.3,
    }
    panels = figure.subplots(2 + more, 2, gridspec_kw=grid)
    copies = f", {result.batch:,} copies at once" if result.batch > 1 else ""
    title = f"{result.name.replace('_', ' ')}: {format_seconds(result.duration)}, {result.dtype}{copies}"
    figure.suptitle(title, fontsize=14)
    time, position = result.path
    seen = position.reshape(position.shape[0], -1, position.shape[-1])[..., :2]  # space is seen from above
    draw_paths(time, seen, math.ceil(seen.shape[1] / MAX_DRAWN_LANES), None, panels[0, 0]).set_title(
        f"the path ({result.truth})", fontsize=11
    )
    if math.isfinite(result.horizon):
        _mark_horizon(panels[0, 0], time, seen, result.horizon)

    ax = panels[0, 1]
    _draw_curves(ax, result, "seconds", "path_error")
    ax.set(xlabel="run time [s]", ylabel="largest error on the path [path extent]")
    ax.set_title("speed against accuracy: lower left is better", fontsize=11)
    _draw_front(ax, result.front)

    ax = panels[1, 0]
    _draw_curves(ax, result, "dt", "path_error")
    ax.set(xlabel="step dt [s]", ylabel="largest error on the path [path extent]")
    ax.set_title("order: the slope of each line", fontsize=11)

    ax = panels[1, 1]
    if result.conserved:
        _draw_curves(ax, result, "dt", "drift")
        ax.set(xlabel="step dt [s]", ylabel=f"largest change of the {result.conserved[0]} [relative]")
        ax.set_title(f"what must be kept: {result.conserved[0]}", fontsize=11)
    else:
        _draw_curves(ax, result, "evaluations", "path_error")
        ax.set(xlabel="force evaluations", ylabel="largest error on the path [path extent]")
        ax.set_title("the same on any machine: error against evaluations", fontsize=11)
    if more:
        _draw_more_panels(panels[2], result)
    return figure


def _draw_front(ax: Any, front: Any) -> None:
    """Pareto's front, behind the lines."""
    across, up = [run.seconds for run in front], [max(run.path_error, 1e-17) for run in front]
    ax.plot(across, up, **FRONT_BAND_STYLE, zorder=0)


def _mark_horizon(ax: Any, time: np.ndarray, position: np.ndarray, horizon: float) -> None:
    """Where rounding has grown to a hundredth of the path: what follows is one of many paths."""
    if position.shape[-1] == 1:
        ax.axvline(horizon, color="0.2", linestyle="--")
    else:
        ax.plot(*position[np.searchsorted(time, horizon)].T, "o", color="0.2", markerfacecolor="white")
    words = f"chaos: beyond {format_seconds(horizon)} (marked) errors mean nothing"
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1}
    ax.annotate(words, (0.02, 0.02), xycoords="axes fraction", fontsize=8.5, bbox=box)


def _draw_more_panels(panels: Any, result: Any) -> None:
    """Gradient error against gradient cost, and the first of the other norms against time."""
    left, right = panels
    if result.gradients:
        _draw_curves(left, result._replace(runs=result.gradients, floor=0.0), "seconds", "path_error")
        left.set(xlabel="time of path and derivative [s]", ylabel="largest error of the derivative [its largest]")
        left.set_title("gradient error against gradient cost", fontsize=11)
    if result.norms:
        # as drifts are drawn: the number stands in a place of its own
        swapped = [run._replace(path_error=run.errors[0]) for run in result.runs]
        _draw_curves(right, result._replace(runs=tuple(swapped), floor=0.0), "seconds", "path_error")
        right.set(xlabel="run time [s]", ylabel=f"error of {result.norms[0]} [relative]")
        right.set_title(f"another norm: {result.norms[0]}", fontsize=11)
    for ax, there in ((left, result.gradients), (right, result.norms)):
        ax.set_visible(bool(there))


def _draw_legend(figure: Any, result: Any) -> float:
    """The legend, which stands below the panels; returns the share of the figure's height that they must leave to it."""
    from matplotlib import pyplot as plt

    # where both treatments of contacts ran, each has a column of its own, a method to a line
    methods = sorted(result.methods, key=lambda method: method.endswith(PROJECTED_SUFFIX))
    projected = methods[-1].endswith(PROJECTED_SUFFIX)
    handles = [plt.Line2D([], [], **style(method), label=_format_label(result, method)) for method in methods]
    failed = plt.Line2D([], [], color="0.2", marker="x", linestyle="", label="failed (upper edge)")
    handles.insert(len(methods) // 2 if projected else len(methods), failed)
    handles.append(plt.Line2D([], [], **FRONT_BAND_STYLE, label="Pareto's front"))
    columns = 2 if projected else 3
    what = (
        "solid: impacts found inside the step; dashed, hollow: projected at the end of the step" if projected else None
    )
    figure.legend(
        handles=handles,
        loc="lower center",
        ncols=columns,
        fontsize=9.5,
        frameon=False,
        title=what,
        title_fontsize=9.5,
    )
    high = 9 / figure.get_size_inches()[1]
    return high * max(0.17, 0.07 + 0.023 * (projected + math.ceil(len(handles) / columns)))


def _draw_curves(ax: Any, result: Any, x: str, y: str) -> None:
    """A line for each method through the runs that held, and crosses on the upper edge for those that failed."""
    for method in result.methods:
        runs = [run for run in result.of(method) if getattr(run, x) is not None]
        good = [run for run in runs if run.status == "ok"]
        line = style(method)
        ax.plot([getattr(run, x) for run in good], [max(_read_value(run, y), 1e-17) for run in good], **line)
        failed = [getattr(run, x) for run in runs if run.status != "ok"]
        edge = ax.get_xaxis_transform()
        ax.plot(failed, [0.975] * len(failed), "x", color=line["color"], transform=edge, markersize=6, clip_on=False)
    if result.floor and y == "path_error":
        ax.axhline(result.floor, color="0.5", linestyle=":", linewidth=1)
        ax.annotate(
            "error of the reference", (0.02, result.floor), xycoords=ax.get_yaxis_transform(), fontsize=8, va="bottom"
        )
    ax.set(xscale="log", yscale="log")
    bottom, top = ax.get_ylim()
    ax.set_ylim(max(bottom, 1e-17), max(top, 1.0) * 4)
    ax.grid(which="major", color="0.9")


def _read_value(run: Any, y: str) -> float:
    return run.drifts[0] if y == "drift" else getattr(run, y)


def _format_label(result: Any, method: str) -> str:
    if method not in result.promised:
        return f"{method} (adaptive)"
    order = result.observed_order(method)
    seen = "exact" if math.isinf(order) else "order unseen" if math.isnan(order) else f"order {order:.2f}"
    promised = result.promised[method]
    return f"{method}: {seen}" + ("" if math.isnan(promised) else f" (promised {promised:.0f})")
