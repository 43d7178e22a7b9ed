"""An ablation drawn: what each part changes, next to what counts and what is only numerical, and the time it takes."""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from physjax.study.ablation.ablate import Ablation

VERDICT_COLOURS = {
    "needed": "#D55E00",
    "shorter dt": "#E69F00",
    "costs more than it gives": "#CC79A7",
    "negligible": "#56B4E9",
    "none": "0.7",
}
"""Colour-blind safe; grey where there is nothing to see."""


def draw_ablation(result: "Ablation", figure: "Figure | None" = None) -> "Figure":
    """A row for each part left out: the largest change of the outcome, its numerical error, and the time saved."""
    from matplotlib import pyplot as plt
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    effects = result.effects
    timed = not np.isnan(result.whole.seconds)
    figure = figure or plt.figure(figsize=(9, 1.7 + 0.36 * len(effects)), layout="constrained")
    panels = figure.subplots(1, 1 + timed, sharey=True, squeeze=False, width_ratios=(3, 1)[: 1 + timed])[0]
    places, colours = np.arange(len(effects)), [VERDICT_COLOURS[effect.verdict] for effect in effects]
    _draw_changes(panels[0], result, places, colours)
    panels[0].set_yticks(places, [effect.name for effect in effects])
    panels[0].set_ylim(len(effects) - 0.4, -0.6)
    if timed:
        shares = [100 * effect.saved / result.whole.seconds for effect in effects]
        panels[1].barh(places, shares, color=colours, height=0.6)
        panels[1].axvline(0, color="0.4", linewidth=0.8)
        panels[1].set(xlabel="time saved [%]")
        panels[1].grid(axis="x", color="0.9")
        panels[1].set_axisbelow(True)
    shown = [verdict for verdict in VERDICT_COLOURS if verdict in {effect.verdict for effect in effects}]
    handles = [Patch(color=VERDICT_COLOURS[verdict], label=verdict) for verdict in shown]
    lines = [
        Line2D([], [], color="black", marker="|", linestyle="", markersize=11, label="numerical error"),
        Line2D([], [], color="black", linestyle="--", label="what counts"),
    ]
    figure.legend(handles=[*handles, *lines], loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    return figure


def _draw_changes(ax: "Axes", result: "Ablation", places: np.ndarray, colours: list[str]) -> None:
    """Bars of the largest changes in units of what counts; what is zero or not finite is written out."""
    relative = bool(np.all(result.threshold > 0))
    change, numerical, unit = np.array([result.worst_entry(effect) for effect in result.effects]).T
    change, numerical = (change / unit, numerical / unit) if relative else (change, numerical)
    known = np.concatenate([change, numerical, [1.0]])
    known = known[np.isfinite(known) & (known > 0)]
    low, high = known.min() / 5, known.max() * 5
    for place, value, colour in zip(places, change, colours, strict=True):
        if np.isfinite(value) and value > 0:
            ax.barh(place, value - low, left=low, color=colour, height=0.6)
        else:
            ax.text(low * 1.2, place, "no change" if value == 0 else "no longer runs", va="center", fontsize=9)
    ax.plot(numerical, places, "|", color="black", markersize=13, markeredgewidth=1.5)
    if relative:
        ax.axvline(1.0, color="black", linestyle="--", linewidth=1)
    ax.set(xscale="log", xlim=(low, high))
    ax.set_xlabel("change of the outcome / what counts" if relative else "change of the outcome [its unit]")
    ax.grid(axis="x", which="major", color="0.9")
    ax.set_axisbelow(True)
