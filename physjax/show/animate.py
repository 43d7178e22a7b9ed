"""Runs as films in real time: cloth, rigid bodies, springs, and particles with a trail behind them.

All functions but `view` return a `Film`, which a notebook shows and which has `.save("name.gif")` and
`.save("name.html")`. It plays `speed` seconds of the run a second, in `fps` pictures, picked by the time of the frames.
`view` returns a page on which the run can be turned as well.
"""

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

from jax.typing import ArrayLike

from physjax.checks import as_positive_integer, as_real_quantity
from physjax.name_hints import hint_at_names
from physjax.physics.springs.assembly import Lattice
from physjax.physics.springs.rods import Distances
from physjax.physics.springs.springs import Springs
from physjax.show.bodies import BodyShapes, prepare_bodies
from physjax.show.films import Film, schedule
from physjax.show.frames import get_faces, take_frames, take_lanes
from physjax.show.lines import take_lines
from physjax.show.panels import build_scenery
from physjax.show.particles import prepare_particles
from physjax.show.spring_lines import build_spring_lines, choose_strain_bar, draw_springs
from physjax.show.surfaces import draw_surface
from physjax.show.trails import build_trail_scenery, build_trails
from physjax.show.view import View, view
from physjax.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.typing import ColorType

__all__ = ["Film", "View", "bodies", "cloth", "particles", "paths", "springs", "view"]


def cloth(
    film: Trajectory,
    sheet: Lattice,
    *,
    scene: int | Sequence[int] | None = None,
    color: "ColorType" = "#56B4E9",
    fps: int | float = 30.0,
    speed: int | float = 1.0,
) -> Film:
    """A cloth, a jelly or a mesh as a shaded surface; see `plot.cloth`.

    A run that blew up is shown until its last good frame, and the title says so. Raises TypeError or ValueError for a
    film, a sheet, `fps` or `speed` that do not fit.

    Example:
        >>> film = animate.cloth(wave, sheet, speed=0.1)
        >>> len(film.frames)
        11
    """
    who = "animate.cloth"
    faces, nodes = get_faces(who, sheet)
    seen = take_frames(who, film, scene=scene, nodes=nodes, dims=(3,))
    frames, fps = schedule(who, seen, fps, speed)
    return Film(build_scenery(seen, frames), frames, fps, partial(draw_surface, faces=faces, color=color))


def bodies(
    film: Trajectory,
    shapes: BodyShapes | None = None,
    *,
    color: "ColorType | ArrayLike | None" = None,
    contacts: bool = False,
    fps: int | float = 30.0,
    speed: int | float = 1.0,
) -> Film:
    """Rigid bodies in the plane or in space, as their shapes; see `plot.bodies`, and `animate.cloth` for the errors.

    Example:
        >>> from physjax.show import solids
        >>> film = animate.bodies(tumble, solids.box((1.0, 2.0, 3.0)))
        >>> len(film.frames)
        11
    """
    who = "animate.bodies"
    seen, draw = prepare_bodies(who, film, shapes, color, contacts)
    frames, fps = schedule(who, seen, fps, speed)
    return Film(build_scenery(seen, frames), frames, fps, draw)


def springs(
    film: Trajectory,
    sheet: Lattice | Springs | Distances | tuple[Springs | Distances, ...],
    *,
    scene: int | Sequence[int] | None = None,
    limit: int | float | None = None,
    fps: int | float = 30.0,
    speed: int | float = 1.0,
) -> Film:
    """Springs in the plane or in space, coloured by strain, or rods; see `plot.springs`, and `animate.cloth` for the errors.

    Example:
        >>> film = animate.springs(wave, sheet, speed=0.1)
        >>> len(film.frames)
        11
    """
    who = "animate.springs"
    lines = take_lines(who, film, sheet, scene)
    frames, fps = schedule(who, lines.run, fps, speed)
    spring_lines = build_spring_lines(who, lines, frames, limit)
    draw = partial(draw_springs, spring_lines=spring_lines)
    return Film(build_scenery(lines.run, frames), frames, fps, draw, bar=choose_strain_bar(spring_lines))


def paths(
    film: Trajectory,
    *,
    every: int = 1,
    color: ArrayLike | None = None,
    trail: int | float = 0.12,
    fps: int | float = 30.0,
    speed: int | float = 1.0,
) -> Film:
    """Particles as dots, with their paths of the last `trail` seconds of film behind them, in one, two or three dimensions.

    In one dimension they stand side by side and move up and down. Of the lanes one in `every` is drawn; `color` colours
    lanes by a value each. Lanes that blew up disappear. Raises TypeError or ValueError for what does not fit.

    Example:
        >>> film = animate.paths(flight, fps=10.0)
        >>> film.save("flight.gif", progress=False).name
        'flight.gif'
    """
    who = "animate.paths"
    every, trail = as_positive_integer("every", every), float(as_real_quantity("trail [s]", trail, at_least=0))
    seen = take_lanes(who, film)
    frames, fps = schedule(who, seen, fps, speed)
    seen, draw = build_trails(who, seen, every, color, trail * speed)
    scenery, axes = build_trail_scenery(seen, frames)
    return Film(scenery, frames, fps, draw, axes=axes)


def particles(
    film: Trajectory, *, density: bool | None = None, fps: int | float = 30.0, speed: int | float = 1.0
) -> Film:
    """Particles that are born and die, with the size, colour and opacity of their age, or their `density`; see `plot.particles`.

    Raises TypeError or ValueError for a run without an emitter, and for `fps` or `speed` that do not fit.

    Example:
        >>> film = animate.particles(jet)
        >>> len(film.frames)
        11
    """
    who = "animate.particles"
    seen, draw, bar = prepare_particles(who, film, density)
    frames, fps = schedule(who, seen, fps, speed)
    return Film(build_scenery(seen, frames), frames, fps, draw, bar=bar)


def __dir__() -> list[str]:
    return __all__


hint_at_names(__name__)
