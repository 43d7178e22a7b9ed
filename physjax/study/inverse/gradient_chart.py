"""How a small deviation of the start grows, and until when the gradient of a run can be trusted, drawn."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from physjax.show.plot import MAX_DRAWN_LANES
from physjax.show.style import PALETTE
from physjax.text import format_seconds

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from physjax.study.inverse.gradients import GradientHealth


def draw_gradient_health(result: "GradientHealth", ax: "Axes | None" = None) -> "Axes":
    """Draw how a small deviation of the start grows (a `gradients.GradientHealth`), and until when its gradient is of use.

    A line for each lane, or for each scene of coupled ones; a ring where it reaches its limit, at the end of a dotted line
    if it will do so soon after the run. Returns the axes.
    """
    from matplotlib import pyplot as plt

    ax = ax or plt.figure(figsize=(6.5, 4.2), layout="constrained").add_subplot()
    grown = np.asarray(result.sensitivity, float).reshape(len(result.time), -1)
    time = np.broadcast_to(np.asarray(result.time, float).reshape(len(grown), -1), grown.shape)
    limit, horizon = (np.asarray(number, float).ravel() for number in (result.limit, result.horizon))
    one, end = grown.shape[1] == 1, time[-1]
    line: dict[str, Any] = {"color": PALETTE[3], "linewidth": 1.5 if one else 0.8, "alpha": 1.0 if one else 0.6}
    for lane in range(0, grown.shape[1], math.ceil(grown.shape[1] / MAX_DRAWN_LANES)):
        positive = grown[:, lane] > 0
        ax.plot(time[positive, lane], grown[positive, lane], **line)
        if end[lane] < horizon[lane] < 3 * end[lane] and np.ravel(result.exponential)[lane]:
            ax.plot([end[lane], horizon[lane]], [grown[-1, lane], limit[lane]], **{**line, "linestyle": ":"})
        if horizon[lane] < 3 * end[lane]:
            ax.plot(horizon[lane], limit[lane], "o", color=PALETTE[0], markerfacecolor="white", zorder=3)
    ax.axhline(limit.min(), color=PALETTE[0], linestyle="--", linewidth=1.2)
    words = f"above: errors of {100 * float(result.fraction):.3g} % of the path"
    place: dict[str, Any] = {
        "xycoords": ax.get_yaxis_transform(),
        "xytext": (0, -3),
        "textcoords": "offset points",
        "va": "top",
    }
    ax.annotate(words, (0.02, limit.min()), fontsize=9, color=PALETTE[0], **place)
    first = horizon.min()
    until = f"up to {format_seconds(first)}" if first < 1e3 * end.max() else "for more than a thousand such runs"
    ax.set(
        yscale="log",
        xlabel="time [s]",
        title=f"{'the gradient is' if one else 'all gradients are'} to be trusted {until}",
    )
    ax.set_ylabel(f"growth of a deviation [m per {'m' if result.of == 'position' else 'm/s'}]")
    ax.set_ylim(top=5 * max(limit.max(), grown[np.isfinite(grown)].max()))
    ax.grid(which="major", color="0.9")
    return ax
