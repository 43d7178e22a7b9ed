"""A ledger drawn: who received the energy of a run, over time and in the end."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from physjax.show.style import PALETTE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from physjax.study.energy.budget import Ledger

NUMERICAL_COLOUR = "0.15"
LINE_STYLES = ("-", "--", ":")


def draw_energy_budget(result: "Ledger", figure: "Figure | None" = None) -> "Figure":
    """Energy received over time, and a bar for each total, summed over all lanes; returns the figure."""
    from matplotlib import pyplot as plt

    time = result.time.reshape(len(result.time), -1)[:, 0]
    account = result.energy
    lanes = tuple(range(1, account.size.ndim))
    series = {name: received.sum(axis=lanes) for name, received in account.received.items()}
    figure = figure or plt.figure(figsize=(9, 3.2 + 0.42 * len(series)), layout="constrained")
    over_time, bars = figure.subplots(2, 1, height_ratios=(7, 1 + len(series)))
    styles = _choose_styles(series)
    for name, received in series.items():
        over_time.plot(time, received, label=name, **styles[name])
    over_time.axhline(0, color="0.7", linewidth=0.8, zorder=0)
    over_time.set(xlabel="time [s]", ylabel="energy received [J]", xlim=(time[0], time[-1]))
    over_time.set_title(f"Where the energy went, stepped by {result.method}", fontsize=11)
    over_time.legend(fontsize=9, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    _draw_totals(bars, {name: received[-1] for name, received in series.items()}, styles)
    bars.set_title(
        f"Totals at {time[-1]:.4g} s; their sum is zero within {account.closure_error:.0e} of the largest", fontsize=11
    )
    return figure


def _choose_styles(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """A colour for each entry; the method's own error is black and thick."""
    colours = [colour for colour in PALETTE if colour != PALETTE[0]]
    styles = {}
    for i, name in enumerate(name for name in names if name != "numerical"):
        styles[name] = {
            "color": colours[i % len(colours)],
            "linestyle": LINE_STYLES[i // len(colours) % len(LINE_STYLES)],
        }
    return styles | {"numerical": {"color": NUMERICAL_COLOUR, "linestyle": "-", "linewidth": 2.2}}


def _draw_totals(ax: "Axes", totals: dict[str, float], styles: dict[str, dict[str, Any]]) -> None:
    """A bar for each entry with its number, the first on top."""
    places = np.arange(len(totals))
    values = np.array(list(totals.values()))
    ax.barh(places, values, color=[styles[name]["color"] for name in totals], height=0.65)
    ax.axvline(0, color="0.4", linewidth=0.8)
    reach = np.abs(values).max() or 1.0
    for place, value in enumerate(values):
        side = "left" if value >= 0 else "right"
        ax.text(
            value + 0.012 * reach * (1 if value >= 0 else -1), place, f"{value:.4g}", ha=side, va="center", fontsize=9
        )
    ax.set_yticks(places, list(totals))
    ax.set(
        xlabel="energy received [J]",
        xlim=(min(values.min(), 0.0) - 0.3 * reach, max(values.max(), 0.0) + 0.3 * reach),
    )
    ax.invert_yaxis()
    ax.tick_params(axis="y", length=0)
