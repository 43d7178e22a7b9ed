"""Stability drawn: the region of a method, and the map of a scene."""

from typing import TYPE_CHECKING

import numpy as np

from physjax.show.style import style
from physjax.study.stability.limits import Region
from physjax.study.stability.map import INACCURATE_ERROR, StabilityMap

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

VERDICT_COLOURS = ("#CFE8D5", "#F6D98B", "#C9736A")
"""Stable, inaccurate, diverged: distinguished by their lightness as well."""
BOUNDARY_RADIUS = 1 + 1e-9
"""The spectral radius at which the region is drawn to end: rounding must not hide that a method keeps the axis at 1."""
LARGEST_LINEAR_RATIO = 20
"""Parameters over a wider range than this ratio are drawn on a logarithmic axis."""


def draw_region(result: Region, ax: "Axes | None" = None) -> "Axes":
    """Where a method is stable in the plane of λ dt; returns the axes."""
    from matplotlib import pyplot as plt

    if ax is None:
        ax = plt.figure(figsize=(5, 5), layout="constrained").add_subplot()
    x, y = np.real(result.z), np.imag(result.z)
    ax.contourf(x, y, result.radius, levels=[0, BOUNDARY_RADIUS], colors=[VERDICT_COLOURS[0]])
    ax.contour(x, y, result.radius, levels=[BOUNDARY_RADIUS], colors=[style(result.name)["color"]], linewidths=1.5)
    ax.axhline(0, color="0.7", linewidth=0.8)
    ax.axvline(0, color="0.7", linewidth=0.8)
    ax.set(xlabel="Re λ dt (damping)", ylabel="Im λ dt (ω dt)", title=f"{result.name}: stable inside")
    ax.set_aspect("equal")
    return ax


def draw_stability_map(result: StabilityMap, figure: "Figure | None" = None) -> "Figure":
    """Verdicts over dt: a row for each method, or a panel for each where a parameter changes; returns the figure."""
    from matplotlib import pyplot as plt
    from matplotlib.lines import Line2D
    from matplotlib.patches import Rectangle

    swept = bool(result.parameter)
    count = len(result.methods) if swept else 1
    columns = min(count, 3)
    rows = -(-count // columns)
    size = (4 * columns, 3.3 * rows + 0.7) if swept else (9, 1.6 + 0.45 * len(result.methods))
    figure = figure or plt.figure(figsize=size, layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax in panels[count:]:
        ax.set_visible(False)
    if swept:
        for i, ax in enumerate(panels[:count]):
            _draw_verdicts(ax, result.dts[i], result.values, result.verdict[i])
            ax.plot(result.predicted[i], result.values, color="black", linewidth=1.8, clip_on=True)
            ax.set(title=result.methods[i], ylabel=result.parameter)
            if result.values.min() > 0 and result.values.max() > LARGEST_LINEAR_RATIO * result.values.min():
                ax.set_yscale("log")
    else:
        _draw_strips(panels[0], result)
    handles = [Rectangle((0, 0), 1, 1, color=c) for c in VERDICT_COLOURS] + [
        Line2D([], [], color="black", linewidth=1.8)
    ]
    accurate = f"error < {100 * INACCURATE_ERROR:g} % of the way"
    words = (accurate, "inaccurate", "diverged", "predicted limit of stability")
    figure.legend(handles, words, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


def _draw_verdicts(ax: "Axes", dts: np.ndarray, values: np.ndarray, verdict: np.ndarray) -> None:
    from matplotlib.colors import ListedColormap

    ax.set_xscale("log")
    rows = np.broadcast_to(values[:, None], dts.shape)
    ax.pcolormesh(dts, rows, verdict, cmap=ListedColormap(VERDICT_COLOURS), vmin=-0.5, vmax=2.5, shading="nearest")
    ax.set(xlabel="dt [s]", xlim=(dts.min(), dts.max()))


def _draw_strips(ax: "Axes", result: StabilityMap) -> None:
    """A row for each method, the first on top."""
    places = np.arange(len(result.methods))
    _draw_verdicts(ax, result.dts[:, 0], places, result.verdict[:, 0])
    for place, limit in zip(places, result.predicted[:, 0], strict=True):
        if result.dts.min() <= limit <= result.dts.max():
            ax.plot([limit, limit], [place - 0.5, place + 0.5], color="black", linewidth=2.2)
        else:
            edge, side = (0.01, "left") if limit == 0 or limit < result.dts.min() else (0.99, "right")
            text = {0.0: "never stable", np.inf: "any step is stable"}.get(float(limit), "limit beyond this edge")
            ax.text(edge, float(place), text, transform=ax.get_yaxis_transform(), ha=side, va="center", fontsize=8.5)
    ax.hlines(places[:-1] + 0.5, *ax.get_xlim(), color="white", linewidth=2)
    ax.set_yticks(places, [name.replace("_", " ") for name in result.methods])
    ax.set_ylim(len(places) - 0.5, -0.5)
    ax.set_title(f"runs of {result.duration:.3g} s", fontsize=11)
