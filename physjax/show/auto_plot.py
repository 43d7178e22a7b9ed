"""A run drawn as what its scene is: a surface, bodies with shapes, springs between nodes, or particles with their paths."""

import math
from typing import Any

import numpy as np

from physjax.show import animate, plot
from physjax.show.drawables import Bodies, Dots, Lines, Surface, choose_drawable, find_default_look
from physjax.show.films import Film
from physjax.show.frames import take_lanes
from physjax.show.panels import arrange_panels, build_scenery
from physjax.trajectory import Trajectory

MIN_PLAY_SECONDS, MAX_PLAY_SECONDS = 2.0, 5.0
"""A film plays in real time if it then lasts so many seconds, and faster or slower otherwise."""
FPS = 12.0
"""Pictures a second: enough to see what moves, and few enough for a page with dozens of films."""
TRAIL_SECONDS = 0.5
"""Behind a particle [s of film]."""
_DRAWERS = {
    Surface: (plot.cloth, animate.cloth),
    Lines: (plot.springs, animate.springs),
    Bodies: (plot.bodies, animate.bodies),
}


def plot_run(film: Trajectory, looks: Any = None) -> Any:
    """A picture of a run: how it ends, or the paths of its particles; the figure.

    `looks` is a lattice or shapes, as in `animate.view`; without it the scene says.
    """
    if _has_emitter(film):
        return plot.particles(film, frames=-1)
    kind, looks = _choose_drawable(film, looks)
    if kind is Dots:
        return _draw_paths(film)
    return _DRAWERS[kind][0](film, looks, frames=-1)


def animate_run(film: Trajectory, looks: Any = None) -> Film:
    """The same as a short film."""
    duration = float(np.ptp(np.asarray(film.time)))
    pace = {"fps": FPS, "speed": duration / float(np.clip(duration, MIN_PLAY_SECONDS, MAX_PLAY_SECONDS))}
    if _has_emitter(film):
        return animate.particles(film, **pace)
    kind, looks = _choose_drawable(film, looks)
    if kind is Dots:
        return animate.paths(film, every=_lane_stride(film), trail=TRAIL_SECONDS, **pace)
    return _DRAWERS[kind][1](film, looks, **pace)


def _has_emitter(film: Trajectory) -> bool:
    """Whether its particles are born and die, and have a size and a colour of their age."""
    return film.scene is not None and film.scene.emitter is not None


def _choose_drawable(film: Trajectory, looks: Any) -> tuple[type, Any]:
    looks = find_default_look(film) if looks is None else looks
    return type(choose_drawable("portrait", film, looks, dims=(1, 2, 3))), looks


def _draw_paths(film: Trajectory) -> Any:
    """Paths before what is in their way; on a line over the time."""
    from matplotlib import pyplot as plt

    seen = take_lanes("portrait", film)
    if seen.dim == 1:
        return plot.paths(film, every=_lane_stride(film)).figure
    figure = plt.figure()
    scenery = build_scenery(seen, list(range(seen.good_frames)))
    (ax,) = arrange_panels(figure, scenery, 1)
    scenery.obstacles(ax, 0)
    limits = [(name, getattr(ax, f"get_{name}lim")()) for name in "xyz"[: seen.dim]]
    plot.paths(film, every=_lane_stride(film), ax=ax)
    for name, limit in limits:  # paths take what room they need
        getattr(ax, f"set_{name}lim")(limit)
    if scenery.flat:
        ax.set_aspect("equal", adjustable="box")
    else:
        ax.set_box_aspect(scenery.stage.high - scenery.stage.low)
    ax.title.set_text("")
    return figure


def _lane_stride(film: Trajectory) -> int:
    """One lane in so many, that no more are drawn than the eye tells apart."""
    return math.ceil(math.prod(film.position.shape[1:-1]) / plot.MAX_DRAWN_LANES)
