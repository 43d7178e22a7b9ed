"""Aimed shots drawn: both arcs, where they are fired, the targets, and by how much they miss."""

from typing import TYPE_CHECKING

import numpy as np
from jax.typing import ArrayLike

from physjax.show import obstacles
from physjax.show.stage import Stage, create_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from physjax.study.inverse.aim import Aimed, Shot

LOW_COLOUR, HIGH_COLOUR = "#0072B2", "#D55E00"
"""Colours of the arcs, colour-blind safe."""
FIGURE_WIDTH_INCHES = 7.2
"""Width of a figure of its own [inches]: a page of text."""


def draw_shots(aimed: "Aimed", *, every: int = 1, ax: "Axes | None" = None) -> "Axes":
    """Draw the shots of an `Aimed` at one target in `every`: arcs that hit are solid, misses dashed; returns the axes."""
    one = np.array_equal(aimed.low.time, aimed.high.time, equal_nan=True)
    arcs = {"both arcs": aimed.low} if one else {"low arc": aimed.low, "high arc": aimed.high}
    paths = {name: _flatten_lanes(aimed.flight(shot).position, 1)[:, ::every] for name, shot in arcs.items()}
    # what moves is drawn where each arc meets it
    places = [aimed.meeting_place(shot) for shot in arcs.values()] if aimed.shots.target_velocity is not None else []
    target = np.concatenate([_flatten_lanes(place)[::every] for place in places or [aimed.target]])
    points = np.concatenate([*(path.reshape(-1, target.shape[-1]) for path in paths.values()), target])
    points = points[np.isfinite(points).all(axis=-1)]
    contacts = obstacles.select_shared_surfaces(aimed.shots.scene.contacts, points.shape[-1])
    stage = obstacles.include_obstacles(Stage(points.min(axis=0), points.max(axis=0)), contacts).expand(0.05)
    own, above = ax is None, aimed.shots.scene.up
    ax = _create_shot_axes(stage, above) if ax is None else ax
    if target.shape[-1] == 2:
        obstacles.draw_flat(ax, stage, contacts, 0.0)
    else:
        obstacles.draw_in_space(ax, stage, contacts, 0.0, above)  # pyright: ignore[reportArgumentType]  # 3-D axes
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


def _create_shot_axes(stage: Stage, up: int) -> "Axes":
    """Axes of a figure that is as high as the stage asks for."""
    from matplotlib import pyplot as plt

    wide, high = (stage.high - stage.low)[:2]
    if len(stage.low) == 3:
        height = 0.8 * FIGURE_WIDTH_INCHES
    else:
        height = float(np.clip(0.9 * FIGURE_WIDTH_INCHES * high / wide, 2.2, FIGURE_WIDTH_INCHES)) + 1.2
    figure = plt.figure(figsize=(FIGURE_WIDTH_INCHES, height), layout="constrained")
    return create_axes(figure, (1, 1, 1), stage, up)


def _draw_arc(ax: "Axes", path: np.ndarray, ok: np.ndarray, colour: str, label: str) -> None:
    """The paths of an arc `(frames, lanes, dim)`, one entry in the legend for all."""
    for lane in range(path.shape[1]):
        line = "-" if ok[lane] else "--"
        ax.plot(*path[:, lane].T, line, color=colour, linewidth=1.6, label=label if lane == 0 else None)


def _describe_arc(name: str, shot: "Shot") -> str:
    """An arc in the legend, with numbers where it is a single shot."""
    if np.ndim(shot.time):
        return name if np.all(shot.ok) else f"{name} (dashed: nearest miss)"
    words = f"{name}: {np.degrees(shot.angle):.2f}°"
    if shot.azimuth is not None:
        words += f", azimuth {np.degrees(shot.azimuth):.2f}°"
    words += f", {float(shot.speed):.4g} m/s, {float(shot.time):.3g} s"
    return words if shot.ok else f"{words}, misses by {float(shot.miss):.3g} m"


def _flatten_lanes(array: ArrayLike, leading: int = 0) -> np.ndarray:
    """All lanes on one axis, behind the given number of leading ones."""
    array = np.asarray(array, float)
    return array.reshape(*array.shape[:leading], -1, array.shape[-1])
