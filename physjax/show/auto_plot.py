"""A run drawn as what its scene is: a surface, bodies with shapes, springs between nodes, or particles with their paths."""

import math
from typing import Any

import numpy as np

from physjax.show import animate, plot
from physjax.show.drawables import Bodies, Dots, Lines, Surface, own, subject
from physjax.show.films import Film
from physjax.show.frames import take_lanes
from physjax.show.panels import arranged, scenery_of
from physjax.trajectory import Trajectory

SHORTEST, LONGEST = 2.0, 5.0
"""A film plays in real time if it then lasts so many seconds, and faster or slower otherwise."""
FPS = 12.0
"""Pictures a second: enough to see what moves, and few enough for a page with dozens of films."""
TRAIL = 0.5
"""Behind a particle [s of film]."""
_PICTURES = {
    Surface: (plot.cloth, animate.cloth),
    Lines: (plot.springs, animate.springs),
    Bodies: (plot.bodies, animate.bodies),
}


def still(film: Trajectory, looks: Any = None) -> Any:
    """A picture of a run: how it ends, or the paths of its particles; the figure.

    `looks` is a lattice or shapes, as in `animate.view`; without it the scene says.
    """
    if _is_born(film):
        return plot.particles(film, frames=-1)
    kind, looks = _drawn_as(film, looks)
    if kind is Dots:
        return _paths(film)
    return _PICTURES[kind][0](film, looks, frames=-1)


def moving(film: Trajectory, looks: Any = None) -> Film:
    """The same as a short film."""
    duration = float(np.ptp(np.asarray(film.time)))
    pace = {"fps": FPS, "speed": duration / float(np.clip(duration, SHORTEST, LONGEST))}
    if _is_born(film):
        return animate.particles(film, **pace)
    kind, looks = _drawn_as(film, looks)
    if kind is Dots:
        return animate.paths(film, every=_every(film), trail=TRAIL, **pace)
    return _PICTURES[kind][1](film, looks, **pace)


def _is_born(film: Trajectory) -> bool:
    """Whether its particles are born and die, and have a size and a colour of their age."""
    return film.scene is not None and film.scene.emitter is not None


def _drawn_as(film: Trajectory, looks: Any) -> tuple[type, Any]:
    looks = own(film) if looks is None else looks
    return type(subject("portrait", film, looks, dims=(1, 2, 3))), looks


def _paths(film: Trajectory) -> Any:
    """Paths before what is in their way; on a line over the time."""
    from matplotlib import pyplot as plt

    seen = take_lanes("portrait", film)
    if seen.dim == 1:
        return plot.paths(film, every=_every(film)).figure
    figure = plt.figure()
    scenery = scenery_of(seen, list(range(seen.good)))
    (ax,) = arranged(figure, scenery, 1)
    scenery.obstacles(ax, 0)
    limits = [(name, getattr(ax, f"get_{name}lim")()) for name in "xyz"[: seen.dim]]
    plot.paths(film, every=_every(film), ax=ax)
    for name, limit in limits:  # paths take what room they need
        getattr(ax, f"set_{name}lim")(limit)
    if scenery.flat:
        ax.set_aspect("equal", adjustable="box")
    else:
        ax.set_box_aspect(scenery.stage.high - scenery.stage.low)
    ax.title.set_text("")
    return figure


def _every(film: Trajectory) -> int:
    """One lane in so many, that no more are drawn than the eye tells apart."""
    return math.ceil(math.prod(film.position.shape[1:-1]) / plot.MOST_LANES)
