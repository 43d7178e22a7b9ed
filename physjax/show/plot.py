"""Results draw themselves: one call, units on every axis, the same colour for the same method everywhere.

Every function returns matplotlib axes or a figure and accepts one to draw into. matplotlib is imported when first used.
"""

import math
from typing import Any

import numpy as np
from jax.typing import ArrayLike

from physjax.show import solids
from physjax.show.clouds import particles
from physjax.show.report import seconds_text
from physjax.show.solids import bodies
from physjax.show.stage import AZIMUTH, ELEVATION
from physjax.show.strands import springs
from physjax.show.surfaces import cloth
from physjax.show.sweeps import sweep
from physjax.show.takes import up_of
from physjax.stepping.methods import METHODS
from physjax.trajectory import Trajectory

__all__ = [
    "bodies",
    "cloth",
    "gradient_health",
    "particles",
    "paths",
    "solids",
    "springs",
    "style",
    "sweep",
    "work_precision",
]

PALETTE = ("#D55E00", "#E69F00", "#009E73", "#0072B2", "#56B4E9", "#CC79A7", "#8C6D31", "#6A51A3")
"""Okabe and Ito's colours, told apart by the colour-blind too; two more for methods to come."""
MARKERS = "osD^vPX*"
RIVALS = {"diffrax Tsit5": ("0.55", "--"), "diffrax Dopri8": ("0.15", "-.")}
PROJECTED = ", projected"
"""What is added to a method's name where its touches are answered at the end of the step."""
FLOAT32 = ", float32"
"""What is added where it ran in float32."""
BAND = {"color": "#F0E442", "linewidth": 9, "alpha": 0.5, "solid_capstyle": "round"}
"""Pareto's front."""
ADAPTIVE = "adaptive "
"""What stands before the name of a method that is subdivided."""
MOST_LANES = 200
"""Paths drawn of a scene with more lanes than this; the eye tells no more apart."""


def style(method: str) -> dict[str, Any]:
    """Line style of a method: colour and marker by its place in the registry, dashed and hollow where it is projected.

    Subdivided methods are dash-dotted with stars, those in float32 pale, rivals grey.

    Example:
        >>> plot.style("verlet")["marker"] != plot.style("euler")["marker"]
        True
    """
    narrow = method.endswith(FLOAT32)
    plain = method.removesuffix(FLOAT32)
    name = plain.removesuffix(PROJECTED).removeprefix(ADAPTIVE)
    if name in METHODS:
        place = list(METHODS).index(name)
        line = {
            "color": PALETTE[place % len(PALETTE)],
            "marker": MARKERS[place % len(MARKERS)],
            "linestyle": "-",
            "linewidth": 1.5,
            "markersize": 4.5,
        }
        if plain.endswith(PROJECTED):
            line |= {"linestyle": "--", "linewidth": 1.1, "markerfacecolor": "white"}
        if plain.startswith(ADAPTIVE):
            line |= {"linestyle": "-.", "marker": "*", "markersize": 7}
        return line | {"alpha": 0.45, "linewidth": 1.0, "markersize": 3} if narrow else line
    color, line = RIVALS.get(method, ("0.4", ":"))
    return {"color": color, "marker": ".", "linestyle": line, "linewidth": 1.2, "markersize": 5}


def paths(flight: Trajectory, *, every: int = 1, color: ArrayLike | None = None, ax: Any = None) -> Any:
    """Draw the paths of a run: height over time in one dimension, the plane in two, space in three, up as in the scene.

    `every` draws one lane in so many; `color` colours lanes by a value each. Returns the axes.

    Example:
        >>> ax = plot.paths(flight)
        >>> ax.get_xlabel(), ax.get_ylabel()
        ('x [m]', 'y [m]')
    """
    position = np.asarray(flight.position)
    position, up = position.reshape(position.shape[0], -1, position.shape[-1]), up_of(flight)
    return _paths(np.asarray(flight.time), position, every, color, ax, up)


def _paths(time: np.ndarray, position: np.ndarray, every: int, color: Any, ax: Any, up: int = 1) -> Any:
    """Lines through `(frames, lanes, dim)` positions."""
    from matplotlib import colormaps
    from matplotlib import pyplot as plt

    dim = position.shape[-1]
    position = position[:, ::every]
    if ax is None:
        ax = plt.figure(figsize=(6, 4), layout="constrained").add_subplot(projection="3d" if dim == 3 else None)
        if dim == 3:
            ax.view_init(elev=ELEVATION, azim=AZIMUTH, vertical_axis="xyz"[up])
    count = position.shape[1]
    shade = np.arange(count) if color is None else np.asarray(color).ravel()[::every]
    span = np.ptp(shade) or 1.0
    colours = colormaps["viridis"]((shade - shade.min()) / span * 0.9)
    for lane in range(count):
        track = position[:, lane]
        line = (time, track[:, 0]) if dim == 1 else track.T
        ax.plot(*line, color=colours[lane], linewidth=1.2, alpha=1.0 if count < 60 else 0.6)
        if dim > 1:
            ax.plot(*track[-1:].T, color=colours[lane], marker="o", markersize=3.5)
    if dim == 1:
        ax.set(xlabel="time [s]", ylabel="position [m]")
    else:
        ax.set(xlabel="x [m]", ylabel="y [m]")
        ax.set_aspect("equal", adjustable="datalim")
        if dim == 3:
            ax.set_zlabel("z [m]")
    return ax


def gradient_health(result: Any, ax: Any = None) -> Any:
    """Draw how a small deviation of the start grows (a `gradients.GradientHealth`), and where its gradient ends to be of use.

    A line for each lane, or for each scene of coupled ones; a ring where it reaches its limit, at the end of a dotted line
    if it will do so soon after the run. Returns the axes.

    Example:
        >>> ax = plot.gradient_health(gradients.health(shot, methods.verlet, dt=0.1, steps=20, of="velocity"))
        >>> ax.get_xlabel()
        'time [s]'
    """
    from matplotlib import pyplot as plt

    ax = ax or plt.figure(figsize=(6.5, 4.2), layout="constrained").add_subplot()
    grown = np.asarray(result.sensitivity, float).reshape(len(result.time), -1)
    time = np.broadcast_to(np.asarray(result.time, float).reshape(len(grown), -1), grown.shape)
    limit, horizon = (np.asarray(number, float).ravel() for number in (result.limit, result.horizon))
    one, end = grown.shape[1] == 1, time[-1]
    line = {"color": PALETTE[3], "linewidth": 1.5 if one else 0.8, "alpha": 1.0 if one else 0.6}
    for lane in range(0, grown.shape[1], math.ceil(grown.shape[1] / MOST_LANES)):
        seen = grown[:, lane] > 0
        ax.plot(time[seen, lane], grown[seen, lane], **line)
        if end[lane] < horizon[lane] < 3 * end[lane] and np.ravel(result.exponential)[lane]:
            ax.plot([end[lane], horizon[lane]], [grown[-1, lane], limit[lane]], **line | {"linestyle": ":"})
        if horizon[lane] < 3 * end[lane]:
            ax.plot(horizon[lane], limit[lane], "o", color=PALETTE[0], markerfacecolor="white", zorder=3)
    ax.axhline(limit.min(), color=PALETTE[0], linestyle="--", linewidth=1.2)
    words = f"above: errors of {100 * float(result.fraction):.3g} % of the path"
    place = {"xycoords": ax.get_yaxis_transform(), "xytext": (0, -3), "textcoords": "offset points", "va": "top"}
    ax.annotate(words, (0.02, limit.min()), fontsize=9, color=PALETTE[0], **place)
    first = horizon.min()
    until = f"up to {seconds_text(first)}" if first < 1e3 * end.max() else "for more than a thousand such runs"
    ax.set(
        yscale="log",
        xlabel="time [s]",
        title=f"{'the gradient is' if one else 'all gradients are'} to be trusted {until}",
    )
    ax.set_ylabel(f"growth of a deviation [m per {'m' if result.of == 'position' else 'm/s'}]")
    ax.set_ylim(top=5 * max(limit.max(), grown[np.isfinite(grown)].max()))
    ax.grid(which="major", color="0.9")
    return ax


def work_precision(result: Any, figure: Any = None) -> Any:
    """Four panels of an `accuracy.WorkPrecision`: path, error against time, error against step, drift (or evaluations).

    Runs that failed stand as crosses on the upper edge, where they died; Pareto's front is a band. Where gradients or
    other norms were studied, two more panels show them against time. Returns the figure.

    Example:
        >>> chart = accuracy.work_precision(swing, [methods.verlet], [1 / 16, 1 / 32], duration=2.0, rivals=())
        >>> figure = plot.work_precision(chart)
        >>> len(figure.axes)
        4
    """
    from matplotlib import pyplot as plt

    more = bool(result.gradients or result.norms)
    figure = figure or plt.figure(figsize=(11, 13 if more else 9))
    bottom = _below(figure, result)
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
    title = f"{result.name.replace('_', ' ')}: {seconds_text(result.duration)}, {result.dtype}{copies}"
    figure.suptitle(title, fontsize=14)
    time, position = result.path
    seen = position.reshape(position.shape[0], -1, position.shape[-1])[..., :2]  # space is seen from above
    _paths(time, seen, math.ceil(seen.shape[1] / MOST_LANES), None, panels[0, 0]).set_title(
        f"the path ({result.truth})", fontsize=11
    )
    if math.isfinite(result.horizon):
        _mark_horizon(panels[0, 0], time, seen, result.horizon)

    ax = panels[0, 1]
    _curves(ax, result, "seconds", "path_error")
    ax.set(xlabel="run time [s]", ylabel="largest error on the path [path extent]")
    ax.set_title("speed against accuracy: lower left is better", fontsize=11)
    _band(ax, result.front)

    ax = panels[1, 0]
    _curves(ax, result, "dt", "path_error")
    ax.set(xlabel="step dt [s]", ylabel="largest error on the path [path extent]")
    ax.set_title("order: the slope of each line", fontsize=11)

    ax = panels[1, 1]
    if result.conserved:
        _curves(ax, result, "dt", "drift")
        ax.set(xlabel="step dt [s]", ylabel=f"largest change of the {result.conserved[0]} [relative]")
        ax.set_title(f"what must be kept: {result.conserved[0]}", fontsize=11)
    else:
        _curves(ax, result, "evaluations", "path_error")
        ax.set(xlabel="force evaluations", ylabel="largest error on the path [path extent]")
        ax.set_title("the same on any machine: error against evaluations", fontsize=11)
    if more:
        _more(panels[2], result)
    return figure


def _band(ax: Any, front: Any) -> None:
    """Pareto's front, behind the lines."""
    across, up = [run.seconds for run in front], [max(run.path_error, 1e-17) for run in front]
    ax.plot(across, up, **BAND, zorder=0)


def _mark_horizon(ax: Any, time: np.ndarray, position: np.ndarray, horizon: float) -> None:
    """Where rounding has grown to a hundredth of the path: what follows is one of many paths."""
    if position.shape[-1] == 1:
        ax.axvline(horizon, color="0.2", linestyle="--")
    else:
        ax.plot(*position[np.searchsorted(time, horizon)].T, "o", color="0.2", markerfacecolor="white")
    words = f"chaos: beyond {seconds_text(horizon)} (marked) errors mean nothing"
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1}
    ax.annotate(words, (0.02, 0.02), xycoords="axes fraction", fontsize=8.5, bbox=box)


def _more(panels: Any, result: Any) -> None:
    """Gradient error against gradient cost, and the first of the other norms against time."""
    left, right = panels
    if result.gradients:
        _curves(left, result._replace(runs=result.gradients, floor=0.0), "seconds", "path_error")
        left.set(xlabel="time of path and derivative [s]", ylabel="largest error of the derivative [its largest]")
        left.set_title("gradient error against gradient cost", fontsize=11)
    if result.norms:
        # as drifts are drawn: the number stands in a place of its own
        swapped = [run._replace(path_error=run.errors[0]) for run in result.runs]
        _curves(right, result._replace(runs=tuple(swapped), floor=0.0), "seconds", "path_error")
        right.set(xlabel="run time [s]", ylabel=f"error of {result.norms[0]} [relative]")
        right.set_title(f"another norm: {result.norms[0]}", fontsize=11)
    for ax, there in ((left, result.gradients), (right, result.norms)):
        ax.set_visible(bool(there))


def _below(figure: Any, result: Any) -> float:
    """The legend, which stands below the panels; returns the share of the figure's height that they must leave to it."""
    from matplotlib import pyplot as plt

    # where both treatments of contacts ran, each has a column of its own, a method to a line
    methods = sorted(result.methods, key=lambda method: method.endswith(PROJECTED))
    projected = methods[-1].endswith(PROJECTED)
    handles = [plt.Line2D([], [], **style(method), label=_legend(result, method)) for method in methods]
    failed = plt.Line2D([], [], color="0.2", marker="x", linestyle="", label="failed (upper edge)")
    handles.insert(len(methods) // 2 if projected else len(methods), failed)
    handles.append(plt.Line2D([], [], **BAND, label="Pareto's front"))
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


def _curves(ax: Any, result: Any, x: str, y: str) -> None:
    """A line for each method through the runs that held, and crosses on the upper edge for those that failed."""
    for method in result.methods:
        runs = [run for run in result.of(method) if getattr(run, x) is not None]
        good = [run for run in runs if run.status == "ok"]
        line = style(method)
        ax.plot([getattr(run, x) for run in good], [max(_value(run, y), 1e-17) for run in good], **line)
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


def _value(run: Any, y: str) -> float:
    return run.drifts[0] if y == "drift" else getattr(run, y)


def _legend(result: Any, method: str) -> str:
    if method not in result.promised:
        return f"{method} (adaptive)"
    order = result.observed_order(method)
    seen = "exact" if math.isinf(order) else "order unseen" if math.isnan(order) else f"order {order:.2f}"
    promised = result.promised[method]
    return f"{method}: {seen}" + ("" if math.isnan(promised) else f" (promised {promised:.0f})")
