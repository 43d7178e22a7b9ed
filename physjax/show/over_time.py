"""Anything of a run over time, and phase portraits, of one run or of several in one picture."""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from physjax.lazy import call_late
from physjax.particles import callable_name
from physjax.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Runs = Trajectory | Sequence[Trajectory] | Mapping[str, Trajectory]
"""A run, several, or several by what they are called."""
MAX_LINES = 200
"""The most lines in a panel of each run; in more, single ones cannot be distinguished."""
UNITS = {
    "position": "m",
    "velocity": "m/s",
    "speed": "m/s",
    "energy": "J",
    "kinetic": "J",
    "potential": "J",
    "height": "m",
    "momentum": "kg m/s",
    "angular_momentum": "kg m²/s",
    "angle": "rad",
}
"""Units of what has a name."""
PANEL_INCHES = (6.4, 2.3)
"""Width and height of a panel [inches]."""


class Lines(NamedTuple):
    """A quantity of a run: values `(frames, lanes, components)`, and the names of its components."""

    values: np.ndarray
    components: tuple[str, ...]


def over_time(
    runs: Runs, *quantities: str | Callable, labels: Sequence[str] | None = None, figure: "Figure | None" = None
) -> "Figure":
    """Draw quantities of a run over time, a panel each; of several runs all in one picture. Returns the figure.

    A quantity is "position", "velocity", "speed", "height", "energy", "kinetic", "potential", another field of the state,
    or a function `(t, state) -> number or array` per lane; by default "position" and "energy". `runs` is a run, a
    list of runs, called after their methods and steps or by `labels`, or a dict of runs by name. Raises TypeError or
    ValueError for what does not fit.

    Example:
        >>> figure = plot.over_time(flight, "energy", "position")
        >>> [axes.get_ylabel() for axes in figure.axes]
        ['energy [J]', 'position [m]']
    """
    from matplotlib import pyplot as plt

    named = name_runs("plot.over_time", runs, labels)
    chosen = quantities or ("position", "energy")
    width, height = PANEL_INCHES
    figure = figure or plt.figure(figsize=(width, height * len(chosen)), layout="constrained")
    panels = figure.subplots(len(chosen), 1, sharex=True, squeeze=False)[:, 0]
    for ax, quantity in zip(panels, chosen, strict=True):
        for number, (name, run) in enumerate(named.items()):
            lines = read_quantity("plot.over_time", run, quantity)
            _draw_lines(ax, np.asarray(run.time), lines, name if len(named) > 1 else "", number, len(named))
        ax.set_ylabel(_title(quantity))
        if ax.get_legend_handles_labels()[0]:
            ax.legend(fontsize=8, frameon=False, loc="best")
    panels[-1].set_xlabel("time [s]")
    return figure


def phase(
    runs: Runs,
    x: str | Callable = "position",
    y: str | Callable = "velocity",
    *,
    component: int = 0,
    labels: Sequence[str] | None = None,
    ax: "Axes | None" = None,
) -> "Axes":
    """Draw a phase portrait: one quantity against another, of one `component` where they have several. Returns the axes.

    What quantities and runs are, see `plot.over_time`.

    Example:
        >>> ax = plot.phase(simulate(swing, methods.verlet, dt=0.1, steps=40))
        >>> ax.get_xlabel(), ax.get_ylabel()
        ('position [m]', 'velocity [m/s]')
    """
    from matplotlib import pyplot as plt

    named = name_runs("plot.phase", runs, labels)
    ax = ax or plt.figure(figsize=(5, 4.2), layout="constrained").add_subplot()
    many = max(read_quantity("plot.phase", run, x).values.shape[-1] for run in named.values()) > 1
    for number, (name, run) in enumerate(named.items()):
        across, upwards = (_pick_component(read_quantity("plot.phase", run, what), component) for what in (x, y))
        for lane in range(min(across.shape[1], MAX_LINES)):
            label = name if lane == 0 and len(named) > 1 else None
            color = f"C{number if len(named) > 1 else lane % 10}"
            ax.plot(across[:, lane], upwards[:, lane], color=color, linewidth=1.2, label=label)
            ax.plot(across[:1, lane], upwards[:1, lane], color=color, marker="o", markersize=3.5)
    side = f" {'xyz'[component]}" if many and component < 3 else ""
    ax.set(xlabel=_title(x, side), ylabel=_title(y, side))
    if len(named) > 1:
        ax.legend(fontsize=8, frameon=False)
    return ax


def name_runs(who: str, runs: Runs, labels: Sequence[str] | None) -> dict[str, Trajectory]:
    """Runs by what they are called: after their methods, and their steps where methods are the same."""
    if isinstance(runs, Mapping):
        named = dict(runs)
    else:
        several = list(runs) if isinstance(runs, Sequence) else [runs]
        if labels is not None and len(labels) != len(several):
            raise ValueError(f"{who}: got {len(labels)} labels, expected one for each of the {len(several)} runs.")
        names = list(labels) if labels is not None else _list_names(several)
        named = dict(zip(names, several, strict=True))
    wrong = [run for run in named.values() if not isinstance(run, Trajectory)]
    if wrong or not named:
        got = type(wrong[0]).__name__ if wrong else "nothing"
        raise TypeError(f"{who}: got {got}, expected runs: what simulate returns, one, a list, or a dict by name.")
    return named


def _list_names(runs: list[Trajectory]) -> list[str]:
    names = [_name_method(run) for run in runs]
    if len(set(names)) < len(names):
        names = [
            f"{name}, dt = {float(np.min(run.dt)):g} s" if run.dt is not None else name
            for name, run in zip(names, runs, strict=True)
        ]
    return names if len(set(names)) == len(names) else [f"{i + 1}: {name}" for i, name in enumerate(names)]


def _name_method(run: Trajectory) -> str:
    if not isinstance(run, Trajectory):
        return ""
    return "reference" if run.method is None else callable_name(run.method)


def read_quantity(who: str, run: Trajectory, quantity: str | Callable) -> Lines:
    """A quantity at the frames of a run."""
    if np.ndim(run.time) != 1:
        raise ValueError(f"{who}: got times {np.shape(run.time)}, expected one run with one time for all lanes.")
    lanes = np.shape(run.position)[1:-1]
    if callable(quantity):
        import jax

        found = np.asarray(jax.vmap(quantity)(run.time, run.state))
        return _shape_lines(found, lanes)
    if quantity in ("energy", "kinetic", "potential"):
        found = np.asarray(call_late("physjax.study.energy.over_time:measure_energy", run, quantity))
        return Lines(found.reshape(len(found), -1, 1), ("",))
    if quantity == "height":
        up = run.scene.up if run.scene is not None else min(1, np.shape(run.position)[-1] - 1)
        return _shape_lines(np.asarray(run.position)[..., up], lanes)
    if quantity == "speed":
        return _shape_lines(np.sqrt(np.sum(np.asarray(run.velocity) ** 2, axis=-1)), lanes)
    if quantity in ("position", "velocity"):
        return _shape_lines(np.asarray(getattr(run, quantity)), lanes)
    fields = run.state._fields
    if quantity not in fields:
        known = ", ".join(
            dict.fromkeys(["position", "velocity", "speed", "height", "energy", "kinetic", "potential", *fields])
        )
        raise ValueError(f"{who}: got {quantity!r}, expected one of {known}, or a function (t, state) -> number.")
    return _shape_lines(np.asarray(getattr(run.state, quantity)), lanes)


def _shape_lines(found: np.ndarray, lanes: tuple[int, ...]) -> Lines:
    """Values with lanes side by side; what has no lanes is one."""
    if found.shape[1 : 1 + len(lanes)] != lanes:
        found, lanes = found.reshape(len(found), -1), ()
    whole = found.reshape(len(found), int(np.prod(lanes)), -1)
    names = tuple("xyz"[: whole.shape[-1]]) if 1 < whole.shape[-1] <= 3 else tuple(map(str, range(whole.shape[-1])))
    return Lines(whole, ("",) if whole.shape[-1] == 1 else names)


def _pick_component(lines: Lines, component: int) -> np.ndarray:
    count = lines.values.shape[-1]
    if count > 1 and not 0 <= component < count:
        raise ValueError(f"plot.phase: got component={component}, expected 0 to {count - 1}.")
    return lines.values[..., component if count > 1 else 0]


def _draw_lines(ax: "Axes", time: np.ndarray, lines: Lines, name: str, number: int, runs: int) -> None:
    """Lanes of one run: colours for runs where there are several, else for components or lanes."""
    _, lanes, components = lines.values.shape
    dashes = ("-", "--", ":", "-.")
    for lane in range(min(lanes, MAX_LINES)):
        for i in range(components):
            color = f"C{number if runs > 1 else i if components > 1 else lane % 10}"
            style = dashes[i % 4] if runs > 1 and components > 1 else "-"
            label = ", ".join(filter(None, (name, lines.components[i]))) if lane == 0 else ""
            ax.plot(time, lines.values[:, lane, i], style, color=color, linewidth=1.2, label=label or None)


def _title(quantity: str | Callable, component: str = "") -> str:
    if callable(quantity):
        return callable_name(quantity)
    unit = UNITS.get(quantity, "")
    named = quantity.replace("_", " ") + (component if quantity in ("position", "velocity") else "")
    return f"{named} [{unit}]" if unit else named


__all__ = ["over_time", "phase"]
