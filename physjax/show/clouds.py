"""Particles that are born and die, as dots with the size, colour and opacity of their age."""

from typing import Any, NamedTuple

import numpy as np

from physjax.show.panels import Scenery, panels, scenery_of
from physjax.show.takes import Take, picked, take_lanes

SMALLEST = 1.5
"""Diameter of the smallest dot [points]."""


class Cloud(NamedTuple):
    """Draws one frame after the other: who is alive, size [m] and colours with opacity, `(frames, lanes)` each."""

    alive: np.ndarray
    size: np.ndarray
    colour: np.ndarray

    def __call__(self, ax: Any, scenery: Scenery, frame: int) -> list[Any]:
        """Draw a frame into axes: sizes are to scale in the plane, nearly so in space, but for the smallest."""
        alive, position = self.alive[frame], scenery.position(frame)
        seen = alive & np.isfinite(position).all(axis=-1)
        points = 72 / ax.figure.dpi * _pixels_per_metre(ax, scenery)
        wide = np.maximum(points * self.size[frame, seen], SMALLEST)
        dots = {"s": wide**2, "c": self.colour[frame, seen], "linewidths": 0, "zorder": 4}
        return [ax.scatter(*position[seen].T, **dots | ({} if scenery.flat else {"depthshade": False}))]


def _pixels_per_metre(ax: Any, scenery: Scenery) -> float:
    if not scenery.flat:
        return ax.bbox.width / scenery.stage.size
    ax.apply_aspect()
    left, right = ax.transData.transform([(0, 0), (1, 0)])
    return float(right[0] - left[0])


def cloud_of(who: str, film: Any) -> tuple[Take, Cloud]:
    """The frames of a run with an emitter, and how they look. Raises ValueError for a run without."""
    seen = take_lanes(who, film, dims=(2, 3))
    if film.scene is None or film.scene.emitter is None:
        raise ValueError(f"{who}: got a run without an emitter, expected Scene(..., emitter=...).")
    look = film.film.emitter.appearance(film.time)
    colour = np.concatenate([look.colour, np.asarray(look.opacity)[..., None]], axis=-1)
    return seen, Cloud(np.asarray(look.alive), np.asarray(look.size), np.clip(colour, 0.0, 1.0))


def particles(film: Any, *, frames: Any = None, figure: Any = None) -> Any:
    """Draw particles at some `frames` (by default three, the last of them the end): size, colour and opacity by age.

    Returns the figure. Raises TypeError or ValueError for a run without positions or without an emitter.

    Example:
        >>> figure = plot.particles(jet, frames=[5, 10])
        >>> len(figure.axes)
        2
    """
    who = "plot.particles"
    seen, draw = cloud_of(who, film)
    # at the start nobody is born
    chosen = picked(who, seen, frames) if frames is not None else picked(who, seen, None, default=4)[1:]
    return panels(scenery_of(seen, chosen), chosen, draw, figure)
