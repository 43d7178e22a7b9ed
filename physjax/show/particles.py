"""Particles that are born and die: dots with the size, colour and opacity of their age, lights, or how many there are."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from physjax.show import lights
from physjax.show.frames import Frames, pick_frames, take_lanes
from physjax.show.panels import Scenery, build_scenery, draw_colour_bar, draw_panels

SMALLEST_DOT_POINTS = 1.5
"""Diameter of the smallest dot [points]."""
MIN_DENSITY_PARTICLES = 100_000
"""So many particles are counted, not drawn one by one."""


class ParticleDots(NamedTuple):
    """Draws one frame after the other: who is alive, size [m] and colours with opacity, `(frames, lanes)` each."""

    alive: np.ndarray
    size: np.ndarray
    colour: np.ndarray
    glows: bool

    def __call__(self, ax: Any, scenery: Scenery, frame: int) -> list[Any]:
        """Draw a frame into axes: sizes are to scale in the plane, nearly so in space, but for the smallest."""
        seen, position = _select_visible(self.alive, scenery, frame)
        pixels = _pixels_per_metre(ax, scenery) * self.size[frame, seen]
        smallest, colour = SMALLEST_DOT_POINTS * ax.figure.dpi / 72, self.colour[frame, seen]
        wide = np.maximum(pixels, smallest)
        if self.glows:
            lights.darken_background(ax, scenery.flat)
            light = colour[:, :3] * colour[:, 3:]
            return [
                lights.draw_image(
                    ax, lights.render_glow(lights.project_to_pixels(ax, position), wide, light, lights.count_cells(ax))
                )
            ]
        dots = {"s": (wide * 72 / ax.figure.dpi) ** 2, "c": colour, "linewidths": 0, "zorder": 4}
        return [ax.scatter(*position.T, **dots | ({} if scenery.flat else {"depthshade": False}))]


class ParticleDensity(NamedTuple):
    """Draws how many particles are in each cell of the picture."""

    alive: np.ndarray

    def __call__(self, ax: Any, scenery: Scenery, frame: int) -> list[Any]:
        """Count a frame; cells without particles stay free."""
        _, position = _select_visible(self.alive, scenery, frame)
        cell = lights.CELL_POINTS * ax.figure.dpi / 72
        count = lights.count_points(lights.project_to_pixels(ax, position), lights.count_cells(ax, cell), cell)
        colours = self.colours()
        return [lights.draw_image(ax, np.ma.masked_equal(count, 0), norm=colours.norm, cmap=colours.cmap)]

    def colours(self) -> Any:
        """The same for all frames: one particle to a two hundredth of all."""
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import LogNorm

        return ScalarMappable(LogNorm(1, max(10, self.alive.shape[1] / 200)), "viridis_r")


def _pixels_per_metre(ax: Any, scenery: Scenery) -> float:
    if not scenery.flat:
        return ax.bbox.width / scenery.stage.size
    ax.apply_aspect()
    left, right = ax.transData.transform([(0, 0), (1, 0)])
    return float(right[0] - left[0])


def _select_visible(alive: np.ndarray, scenery: Scenery, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Who is drawn, and where those are [m]."""
    position = scenery.position(frame)
    seen = alive[frame] & np.isfinite(position).all(axis=-1)
    return seen, position[seen]


def prepare_particles(
    who: str, film: Any, density: bool | None
) -> tuple[Frames, ParticleDots | ParticleDensity, Callable | None]:
    """The frames of a run with an emitter, what draws them, and its colour bar. Raises ValueError for a run without."""
    seen = take_lanes(who, film, dims=(2, 3))
    if film.scene is None or film.scene.emitter is None:
        raise ValueError(f"{who}: got a run without an emitter, expected Scene(..., emitter=...).")
    emitter = film.film.emitter
    # births are drawn at random in the run's own floats: in others they are others
    with jax.enable_x64(film.time.dtype == np.float64):
        alive, look = emitter.alive(film.time), emitter.appearance(film.time)
    if emitter.pool >= MIN_DENSITY_PARTICLES if density is None else density:
        density_map = ParticleDensity(np.asarray(alive))
        label = f"particles in a cell of {lights.CELL_POINTS:g} x {lights.CELL_POINTS:g} points"
        return (
            seen,
            density_map,
            lambda figure, where: draw_colour_bar(figure, where, density_map.colours(), label, extend="max"),
        )
    colour = np.concatenate([look.colour, np.asarray(look.opacity)[..., None]], axis=-1)
    glows = film.scene.emitter.look.glows
    return seen, ParticleDots(np.asarray(look.alive), np.asarray(look.size), np.clip(colour, 0.0, 1.0), glows), None


def particles(film: Any, *, frames: Any = None, density: bool | None = None, figure: Any = None) -> Any:
    """Draw particles at some `frames` (by default three, the last of them the end): size, colour and opacity by age.

    Where their look `glows`, lights add up before a dark background. With `density`, by default of pools of 100 000 and
    more, colours say how many particles are in a place instead. Returns the figure. Raises TypeError or ValueError for a
    run without positions or without an emitter.

    Example:
        >>> figure = plot.particles(jet, frames=[5, 10])
        >>> len(figure.axes)
        2
    """
    who = "plot.particles"
    seen, draw, bar = prepare_particles(who, film, density)
    # at the start nobody is born
    chosen = pick_frames(who, seen, frames) if frames is not None else pick_frames(who, seen, None, default=4)[1:]
    return draw_panels(build_scenery(seen, chosen), chosen, draw, figure, bar)
