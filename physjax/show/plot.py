"""Pictures of runs and of results: one call, units on every axis, the same colour for the same method everywhere.

Every function returns matplotlib axes or a figure and accepts one to draw into. matplotlib is imported when first used.
"""

from typing import TYPE_CHECKING, Protocol, cast

import numpy as np
from jax.typing import ArrayLike

from physjax.name_hints import hint_at_names
from physjax.show import solids
from physjax.show.bodies import bodies
from physjax.show.frames import find_up_axis
from physjax.show.over_time import over_time, phase
from physjax.show.particles import particles
from physjax.show.spring_lines import springs
from physjax.show.stage import AZIMUTH, ELEVATION
from physjax.show.style import style
from physjax.show.surfaces import cloth
from physjax.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

__all__ = [
    "bodies",
    "cloth",
    "gradient_health",
    "over_time",
    "particles",
    "paths",
    "phase",
    "solids",
    "springs",
    "style",
    "sweep",
    "work_precision",
]

MAX_DRAWN_LANES = 200
"""The most lanes of which paths are drawn; in a picture of more, single paths cannot be distinguished."""
MAX_OPAQUE_LANES = 60
"""From this many lanes on paths are drawn with some transparency, so that dense places look dense."""


class FigureResult(Protocol):
    """A result that draws itself as a figure."""

    def plot(self, figure: "Figure | None" = None) -> "Figure":
        """Draw it."""
        ...


class AxesResult(Protocol):
    """A result that draws itself into axes."""

    def plot(self, ax: "Axes | None" = None) -> "Axes":
        """Draw it."""
        ...


class SweepResult(Protocol):
    """A result that draws one of its numbers."""

    def plot(
        self, of: str | None = None, *, labels: dict[str, str] | None = None, ax: "Axes | Figure | None" = None
    ) -> "Axes | Figure":
        """Draw the number `of` it."""
        ...


def paths(flight: Trajectory, *, every: int = 1, color: ArrayLike | None = None, ax: "Axes | None" = None) -> "Axes":
    """Draw the paths of a run: height over time in one dimension, the plane in two, space in three, up as in the scene.

    Of the lanes one in `every` is drawn; `color` colours lanes by a value each. Returns the axes.

    Example:
        >>> ax = plot.paths(flight)
        >>> ax.get_xlabel(), ax.get_ylabel()
        ('x [m]', 'y [m]')
    """
    position = np.asarray(flight.position)
    position, up = position.reshape(position.shape[0], -1, position.shape[-1]), find_up_axis(flight)
    return draw_paths(np.asarray(flight.time), position, every, color, ax, up)


def draw_paths(
    time: np.ndarray, position: np.ndarray, every: int, color: ArrayLike | None, ax: "Axes | None", up: int = 1
) -> "Axes":
    """Draw lines through positions `(frames, lanes, dim)`, a colour for each lane, and a dot where each ends."""
    from matplotlib import colormaps
    from matplotlib import pyplot as plt

    dim = position.shape[-1]
    position = position[:, ::every]
    if ax is None:
        ax = plt.figure(figsize=(6, 4), layout="constrained").add_subplot(projection="3d" if dim == 3 else None)
        if dim == 3:
            cast("Axes3D", ax).view_init(elev=ELEVATION, azim=AZIMUTH, vertical_axis="xyz"[up])
    count = position.shape[1]
    shade = np.arange(count) if color is None else np.asarray(color).ravel()[::every]
    span = np.ptp(shade) or 1.0
    colours = colormaps["viridis"]((shade - shade.min()) / span * 0.9)
    for lane in range(count):
        track = position[:, lane]
        line = (time, track[:, 0]) if dim == 1 else track.T
        ax.plot(*line, color=colours[lane], linewidth=1.2, alpha=1.0 if count < MAX_OPAQUE_LANES else 0.6)
        if dim > 1:
            ax.plot(*track[-1:].T, color=colours[lane], marker="o", markersize=3.5)
    if dim == 1:
        ax.set(xlabel="time [s]", ylabel="position [m]")
    else:
        ax.set(xlabel="x [m]", ylabel="y [m]")
        ax.set_aspect("equal", adjustable="datalim")
        if dim == 3:
            cast("Axes3D", ax).set_zlabel("z [m]")
    return ax


def work_precision(result: FigureResult, figure: "Figure | None" = None) -> "Figure":
    """Draw an `accuracy.WorkPrecision`: its path, error against time, error against step, and drift. Returns the figure.

    Example:
        >>> chart = accuracy.work_precision(swing, [methods.verlet], [1 / 16, 1 / 32], duration=2.0, rivals=())
        >>> figure = plot.work_precision(chart)
        >>> len(figure.axes)
        4
    """
    return result.plot(figure)


def gradient_health(result: AxesResult, ax: "Axes | None" = None) -> "Axes":
    """Draw a `gradients.GradientHealth`: the growth of a small deviation, and how long gradients are valid. Returns the axes.

    Example:
        >>> ax = plot.gradient_health(gradients.health(shot, methods.verlet, dt=0.1, steps=20, of="velocity"))
        >>> ax.get_xlabel()
        'time [s]'
    """
    return result.plot(ax)


def sweep(
    result: SweepResult,
    of: str | None = None,
    *,
    labels: dict[str, str] | None = None,
    ax: "Axes | Figure | None" = None,
) -> "Axes | Figure":
    """Draw the number `of` a `Sweep`; `labels` are names with units for its axes and numbers.

    Returns the axes; for panels over a third axis the figure, and there `ax` is a figure to draw into.

    Example:
        >>> reach = lambda angle: projectile.horizontal_range(7.0, angle)
        >>> ax = plot.sweep(sweep(reach, {"angle": [0.5, 0.7, 0.9]}, progress=False), labels={"angle": "angle [rad]"})
        >>> ax.get_xlabel()
        'angle [rad]'
    """
    return result.plot(of, labels=labels, ax=ax)


def __dir__() -> list[str]:
    return __all__


hint_at_names(__name__)
