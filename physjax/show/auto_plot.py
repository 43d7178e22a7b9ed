"""A run drawn by what its scene holds: a surface, bodies, springs or rods between nodes, or particles with their paths."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, cast

import numpy as np

from physjax.physics.rigid.planar import PlanarBodies
from physjax.show import animate, plot
from physjax.show.drawables import Bodies, Dots, Look, PlanarFigures, Surface, choose_drawable, find_default_look
from physjax.show.films import Film
from physjax.show.frames import take_lanes
from physjax.show.lines import Lines
from physjax.show.panels import arrange_panels, build_scenery
from physjax.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

MIN_PLAY_SECONDS, MAX_PLAY_SECONDS = 2.0, 5.0
"""A film plays in real time if it then lasts this long [s], and faster or slower otherwise."""
FPS = 12.0
"""Pictures a second: enough to follow a motion, and few enough for a page with dozens of films."""
TRAIL_SECONDS = 0.5
"""Length of the trail behind a particle [s of film]."""
_DRAWERS = {
    Surface: (plot.cloth, animate.cloth),
    Lines: (plot.springs, animate.springs),
    Bodies: (plot.bodies, animate.bodies),
    PlanarFigures: (plot.bodies, animate.bodies),
}


def plot_run(film: Trajectory, looks: Look | None = None) -> "Figure":
    """A picture of a run: its last frame, or the paths of its particles. Returns the figure.

    `looks` is a lattice or shapes, as `shown` in `animate.view`.
    """
    if _has_emitter(film):
        return plot.particles(film, frames=-1)
    kind, looks = _choose_drawable(film, looks)
    if kind is Dots:
        return _draw_paths(film)
    return _DRAWERS[kind][0](film, looks, frames=-1)


def animate_run(film: Trajectory, looks: Look | None = None, *, scene: int | Sequence[int] | None = None) -> Film:
    """A run as a short film; see `plot_run`. Of a batch of lattices `scene` picks one."""
    duration = float(np.ptp(np.asarray(film.time)))
    speed = duration / float(np.clip(duration, MIN_PLAY_SECONDS, MAX_PLAY_SECONDS))
    if _has_emitter(film):
        return animate.particles(film, fps=FPS, speed=speed)
    kind, looks = _choose_drawable(film, looks, scene)
    if kind is Dots and isinstance(film.state, PlanarBodies):
        return animate.bodies(film, fps=FPS, speed=speed)
    if kind is Dots:
        return animate.paths(film, every=_lane_stride(film), trail=TRAIL_SECONDS, fps=FPS, speed=speed)
    of_batch = {} if scene is None else {"scene": scene}
    return _DRAWERS[kind][1](film, looks, fps=FPS, speed=speed, **of_batch)


def draw_still(film: Trajectory, looks: Look | None = None, *, scene: int | Sequence[int] | None = None) -> "Figure":
    """A run as one picture, which pyplot does not show once more: the paths of particles, the middle of all else."""
    from matplotlib import pyplot as plt

    kind, _ = _choose_drawable(film, looks, scene)
    if kind is Dots and not isinstance(film.state, PlanarBodies) and not _has_emitter(film):
        figure = _draw_paths(film)
        plt.close(figure)
        return figure
    drawn = animate_run(film, looks, scene=scene)
    return drawn.still(len(drawn.frames) // 2)


def _has_emitter(film: Trajectory) -> bool:
    """Whether the particles of a run are born and die, with a size and a colour that depend on their age."""
    return film.scene is not None and film.scene.emitter is not None


def _choose_drawable(
    film: Trajectory, looks: Look | None, scene: int | Sequence[int] | None = None
) -> tuple[type, Look | None]:
    looks = find_default_look(film) if looks is None else looks
    return type(choose_drawable("plot_run", film, looks, scene, dims=(1, 2, 3))), looks


def _draw_paths(film: Trajectory) -> "Figure":
    """Paths in front of the surfaces of the scene; on a line the position over time."""
    from matplotlib import pyplot as plt

    run = take_lanes("plot_run", film)
    if run.dim == 1:
        return cast("Figure", plot.paths(film, every=_lane_stride(film)).figure)
    figure = plt.figure()
    scenery = build_scenery(run, list(range(run.good_frames)))
    (ax,) = arrange_panels(figure, scenery, 1)
    scenery.draw_obstacles(ax, 0)
    scenery.draw_solids(ax, 0)
    plot.paths(film, every=_lane_stride(film), ax=ax)
    # drawing paths moves the limits: back to those of the stage
    ax.set(**{f"{name}lim": ends for name, *ends in zip("xyz", *scenery.stage, strict=False)})
    if scenery.flat:
        ax.set_aspect("equal", adjustable="box")
    else:
        cast("Axes3D", ax).set_box_aspect(scenery.stage.high - scenery.stage.low)
    ax.title.set_text("")
    return figure


def _lane_stride(film: Trajectory) -> int:
    """The stride with which lanes are drawn, so that they are at most `MAX_DRAWN_LANES`."""
    return math.ceil(math.prod(film.position.shape[1:-1]) / plot.MAX_DRAWN_LANES)
