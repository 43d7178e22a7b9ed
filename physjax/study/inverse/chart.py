"""Aimed shots drawn: both arcs, where they are fired, the targets, and by how much they miss."""

from typing import Any

import numpy as np

from physjax.show import obstacles
from physjax.show.stage import Stage, create_axes

LOW_COLOUR, HIGH_COLOUR = "#0072B2", "#D55E00"
"""Colours of the arcs, told apart by the colour-blind too."""
FIGURE_WIDTH_INCHES = 7.2
"""Of a figure of its own [inches]."""


def draw_shots(aimed: Any, *, every: int = 1, ax: Any = None) -> Any:
    """Draw the shots of an `Aimed` at one target in so many: arcs that hit are solid, misses dashed; returns the axes."""
    from matplotlib import pyplot as plt

    one = np.array_equal(aimed.low.time, aimed.high.time, equal_nan=True)
    arcs = {"both arcs": aimed.low} if one else {"low arc": aimed.low, "high arc": aimed.high}
    paths = {name: _flatten_lanes(aimed.flight(shot).position, 1)[:, ::every] for name, shot in arcs.items()}
    target = _flatten_lanes(aimed.target)[::every]
    points = np.concatenate([*(path.reshape(-1, target.shape[-1]) for path in paths.values()), target])
    points = points[np.isfinite(points).all(axis=-1)]
    contacts = obstacles.select_shared_surfaces(aimed.shots.scene.contacts, points.shape[-1])
    stage = obstacles.include_obstacles(Stage(points.min(axis=0), points.max(axis=0)), contacts).expand(0.05)
    own, above = ax is None, aimed.shots.scene.up
    if own:
        across, up = (stage.high - stage.low)[:2]
        height = (
            0.8 * FIGURE_WIDTH_INCHES
            if target.shape[-1] == 3
            else float(np.clip(0.9 * FIGURE_WIDTH_INCHES * up / across, 2.2, FIGURE_WIDTH_INCHES)) + 1.2
        )
        ax = create_axes(
            plt.figure(figsize=(FIGURE_WIDTH_INCHES, height), layout="constrained"), (1, 1, 1), stage, above
        )
    if target.shape[-1] == 2:
        obstacles.draw_flat(ax, stage, contacts, 0.0)
    else:
        obstacles.draw_in_space(ax, stage, contacts, 0.0, above)
    for (name, shot), colour in zip(arcs.items(), (LOW_COLOUR, HIGH_COLOUR), strict=False):
        _draw_arc(ax, paths[name], np.asarray(shot.ok).ravel()[::every], colour, _describe_arc(name, shot))
    start = next(iter(paths.values()))[0]
    ax.plot(*start.T, "o", color="0.25", markersize=4, linestyle="")
    ax.plot(*target.T, "x", color="black", markersize=8, markeredgewidth=2, linestyle="", label="target", zorder=5)
    if own:
        ax.figure.legend(loc="outside lower center", frameon=False)
    else:
        ax.legend(frameon=False)
    return ax


def _draw_arc(ax: Any, path: np.ndarray, ok: np.ndarray, colour: str, label: str) -> None:
    """The paths of an arc `(frames, lanes, dim)`, one entry in the legend for all."""
    for lane in range(path.shape[1]):
        line = "-" if ok[lane] else "--"
        ax.plot(*path[:, lane].T, line, color=colour, linewidth=1.6, label=label if lane == 0 else None)


def _describe_arc(name: str, shot: Any) -> str:
    """What the legend says of an arc; with numbers where it is one."""
    if np.ndim(shot.time):
        return name if np.all(shot.ok) else f"{name} (dashed: nearest miss)"
    words = f"{name}: {np.degrees(shot.angle):.2f}°"
    if shot.azimuth is not None:
        words += f", azimuth {np.degrees(shot.azimuth):.2f}°"
    words += f", {float(shot.speed):.4g} m/s, {float(shot.time):.3g} s"
    return words if shot.ok else f"{words}, misses by {float(shot.miss):.3g} m"


def _flatten_lanes(array: Any, leading: int = 0) -> np.ndarray:
    """All lanes on one axis, behind so many leading ones."""
    array = np.asarray(array, float)
    return array.reshape(*array.shape[:leading], -1, array.shape[-1])
