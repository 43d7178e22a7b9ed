"""Particles of an emitter: dots with the size, colour and opacity of their age, light that adds up, or their density."""

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, NamedTuple, cast

import jax
import numpy as np

from physjax.show import lights
from physjax.show.frames import Frames, pick_frames, take_lanes
from physjax.show.panels import Scenery, build_scenery, draw_colour_bar, draw_panels
from physjax.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

    from physjax.physics.emitters.emitter import Emitter

SMALLEST_DOT_POINTS = 1.5
"""Diameter of the smallest dot [points]."""
MIN_DENSITY_PARTICLES = 100_000
"""From this many particles on their density is drawn instead of each of them."""
FULL_SCALE_SHARE = 1 / 200
"""The share of all particles in one cell at which the colours of a density end."""


class ParticleDots(NamedTuple):
    """Draws frames: which particles are `alive`, their size [m], `(frames, lanes)` each, and their colour and opacity."""

    alive: np.ndarray
    size: np.ndarray
    colour: np.ndarray
    glows: bool

    def __call__(self, ax: "Axes", scenery: Scenery, frame: int) -> "list[Artist]":
        """Draw a frame into axes: all but the smallest are to scale in the plane, and nearly so in space."""
        seen, position = _select_visible(self.alive, scenery, frame)
        pixels = _pixels_per_metre(ax, scenery) * self.size[frame, seen]
        smallest, colour = SMALLEST_DOT_POINTS * ax.figure.dpi / 72, self.colour[frame, seen]
        wide = np.maximum(pixels, smallest)
        if self.glows:
            lights.darken_background(ax, scenery.flat)
            points, light = lights.project_to_pixels(ax, position), colour[:, :3] * colour[:, 3:]
            return [lights.draw_image(ax, lights.render_glow(points, wide, light, lights.count_cells(ax)))]
        dots = {"s": (wide * 72 / ax.figure.dpi) ** 2, "c": colour, "linewidths": 0, "zorder": 4}
        return [ax.scatter(*position.T, **dots | ({} if scenery.flat else {"depthshade": False}))]


class ParticleDensity(NamedTuple):
    """Draws the number of particles in each cell of the picture."""

    alive: np.ndarray

    def __call__(self, ax: "Axes", scenery: Scenery, frame: int) -> "list[Artist]":
        """Draw a frame into axes; cells without particles stay empty."""
        _, position = _select_visible(self.alive, scenery, frame)
        cell = lights.CELL_POINTS * ax.figure.dpi / 72
        count = lights.count_points(lights.project_to_pixels(ax, position), lights.count_cells(ax, cell), cell)
        colours = self.colours()
        return [lights.draw_image(ax, np.ma.masked_equal(count, 0), norm=colours.norm, cmap=colours.cmap)]

    def colours(self) -> "ScalarMappable":
        """From number to colour, the same for all frames: from one particle to a share of all."""
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import LogNorm

        return ScalarMappable(LogNorm(1, max(10, self.alive.shape[1] * FULL_SCALE_SHARE)), "viridis_r")


def _pixels_per_metre(ax: "Axes", scenery: Scenery) -> float:
    """The scale of axes; in space that of the longest side, whatever its perspective."""
    if not scenery.flat:
        return ax.bbox.width / scenery.stage.size
    ax.apply_aspect()
    left, right = ax.transData.transform([(0, 0), (1, 0)])
    return float(right[0] - left[0])


def _select_visible(alive: np.ndarray, scenery: Scenery, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Which particles are drawn, and the positions of those [m]."""
    position = scenery.position(frame)
    seen = alive[frame] & np.isfinite(position).all(axis=-1)
    return seen, position[seen]


def prepare_particles(
    who: str, film: Trajectory, density: bool | None
) -> tuple[Frames, ParticleDots | ParticleDensity, Callable | None]:
    """The frames of a run with an emitter, what draws them, and its colour bar. Raises ValueError for a run without."""
    seen = take_lanes(who, film, dims=(2, 3))
    if film.scene is None or film.scene.emitter is None:
        raise ValueError(f"{who}: got a run without an emitter, expected Scene(..., emitter=...).")
    emitter = cast("Emitter", film.film.emitter)
    # births are random numbers of the floating-point type of the run: another type would give other particles
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
    glows = emitter.look.glows
    return seen, ParticleDots(np.asarray(look.alive), np.asarray(look.size), np.clip(colour, 0.0, 1.0), glows), None


def particles(
    film: Trajectory,
    *,
    frames: int | Iterable[int] | None = None,
    density: bool | None = None,
    figure: "Figure | None" = None,
) -> "Figure":
    """Draw particles at some `frames` (by default three, the last of them the end): size, colour and opacity by age.

    Where their look `glows`, light adds up over a dark background. With `density`, by default for pools of 100 000 and
    more, colours show how many particles are in each cell of the picture instead. Returns the figure.

    Raises TypeError or ValueError for a run without positions or without an emitter.

    Example:
        >>> figure = plot.particles(jet, frames=[5, 10])
        >>> len(figure.axes)
        2
    """
    who = "plot.particles"
    seen, draw, bar = prepare_particles(who, film, density)
    # at the start no particle is born yet
    chosen = pick_frames(who, seen, frames) if frames is not None else pick_frames(who, seen, None, default=4)[1:]
    return draw_panels(build_scenery(seen, chosen), chosen, draw, figure, bar)
