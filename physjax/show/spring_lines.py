"""Springs as lines, coloured by their strain, and rods as grey ones."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from physjax.physics.springs.assembly import Lattice
from physjax.physics.springs.rods import Distances
from physjax.physics.springs.springs import Springs
from physjax.show.frames import pick_frames
from physjax.show.lines import Lines, take_lines
from physjax.show.panels import Scenery, build_scenery, draw_colour_bar, draw_panels
from physjax.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

STRAIN_PERCENTILE = 99.0
"""The colours reach to this percentile of the strains; arrows on the colour bar say that some go beyond."""
MAX_BLOWN_UP_STRAIN = 1.0
"""The largest strain that has a colour in a run that blew up: a spring of twice its length."""
MIN_STRAIN_LIMIT = 0.01
"""The largest strain that has a colour where no spring is stretched at all."""
BROKEN_LOOK: dict[str, Any] = {"colors": "0.75", "linewidths": 0.7, "linestyles": (0, (3, 3)), "zorder": 2}
"""Of what is broken: thin, dashed and grey."""


class SpringLines(NamedTuple):
    """How springs are drawn: pairs of nodes, rest lengths [m], which are intact, and the strain at which the colours end.

    `held` `(frames, springs)` says which are intact at each frame; None: all of them. Rods have no rest lengths and no strain.
    """

    pairs: np.ndarray
    rest: np.ndarray | None
    held: np.ndarray | None
    limit: float

    def strain(self, position: np.ndarray) -> np.ndarray:
        """(l - L)/L for `(..., nodes, dim)` positions; infinite for a spring without rest length, zero for rods."""
        if self.rest is None:
            return np.zeros((*position.shape[:-2], len(self.pairs)))
        line = position[..., self.pairs[:, 1], :] - position[..., self.pairs[:, 0], :]
        length = np.sqrt((line * line).sum(axis=-1))
        has_rest = self.rest > 0
        return np.where(has_rest, (length - self.rest) / np.where(has_rest, self.rest, 1.0), np.inf)

    def colours(self) -> "ScalarMappable":
        """From strain [%] to colour: blue is compressed, grey is at rest, orange is stretched."""
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import LinearSegmentedColormap, Normalize

        ramp = LinearSegmentedColormap.from_list("strain", ["#0072B2", "#6FA8CB", "0.78", "#E39A6B", "#D55E00"])
        return ScalarMappable(Normalize(-100 * self.limit, 100 * self.limit), ramp)


def springs(
    film: Trajectory,
    sheet: Lattice | Springs | Distances | tuple[Springs | Distances, ...],
    frames: int | Iterable[int] | None = None,
    *,
    scene: int | Sequence[int] | None = None,
    limit: int | float | None = None,
    figure: "Figure | None" = None,
) -> "Figure":
    """Draw springs in the plane or in space at chosen frames, coloured by strain; broken ones are dashed grey lines.

    `sheet` is a lattice or its springs, or rods, which have no strain. The colours go from -limit to limit, a strain; by
    default as far as that of 99 % of the springs that are shown. The other arguments are as in `plot.cloth`. Returns the
    figure.

    Example:
        >>> figure = plot.springs(wave, sheet, frames=[0, 10])
        >>> len(figure.axes)
        3
    """
    who = "plot.springs"
    lines = take_lines(who, film, sheet, scene)
    chosen = pick_frames(who, lines.run, frames)
    spring_lines = build_spring_lines(who, lines, chosen, limit)
    draw = partial(draw_springs, spring_lines=spring_lines)
    return draw_panels(build_scenery(lines.run, chosen), chosen, draw, figure, choose_strain_bar(spring_lines))


def build_spring_lines(who: str, lines: Lines, frames: Sequence[int], limit: int | float | None = None) -> SpringLines:
    """How lines are drawn; the colours end at `limit`, or fit the given frames."""
    spring_lines = SpringLines(lines.pairs, lines.rest, lines.held, MIN_STRAIN_LIMIT)
    if limit is None and lines.rest is None:
        return spring_lines
    if limit is None:
        most = _measure_most_strain(spring_lines, lines.run.position[list(frames)].astype(float), list(frames))
        limit = min(most, MAX_BLOWN_UP_STRAIN if lines.run.blew_up else np.inf) or MIN_STRAIN_LIMIT
    elif not limit > 0:
        raise ValueError(f"{who}: got limit={limit}, expected a strain > 0, e.g. 0.05 for five per cent.")
    return spring_lines._replace(limit=float(limit))


def _measure_most_strain(spring_lines: SpringLines, positions: np.ndarray, frames: list[int]) -> float:
    """The most, over frames, of the strain that nearly all springs stay below in each, stretched or compressed."""
    strain = np.abs(spring_lines.strain(positions))
    hidden = ~np.isfinite(strain) if spring_lines.held is None else ~(np.isfinite(strain) & spring_lines.held[frames])
    if not hidden.any():
        return float(np.percentile(strain, STRAIN_PERCENTILE, axis=1).max())
    seen = [row[~gone] for row, gone in zip(strain, hidden, strict=True) if not gone.all()]
    return max((float(np.percentile(row, STRAIN_PERCENTILE)) for row in seen), default=0.0)


def draw_springs(ax: "Axes", scenery: Scenery, frame: int, *, spring_lines: SpringLines) -> "list[Artist]":
    """Draw a frame: one collection of the intact springs, and one, dashed and grey, of the broken ones."""
    position = scenery.position(frame)
    ends = position[spring_lines.pairs]
    inside = scenery.stage.contains(position)[spring_lines.pairs].all(axis=1)
    held = inside if spring_lines.held is None else inside & spring_lines.held[frame]
    colours = spring_lines.colours().to_rgba(100 * spring_lines.strain(position)[held])
    width = float(np.clip(60 / np.sqrt(len(ends)), 0.5, 2.2))
    drawn = [add_lines(ax, ends[held], colors=colours, linewidths=width, zorder=3)] if held.any() else []
    broken = inside & ~held
    if broken.any():
        drawn.append(add_lines(ax, ends[broken], **BROKEN_LOOK))
    return [*drawn, *scenery.draw_solids(ax, frame)]


def choose_strain_bar(spring_lines: SpringLines) -> "Callable[[Figure, dict[str, Any]], None] | None":
    """What draws the colour bar of the strains, below all panels; None for rods."""
    if spring_lines.rest is None:
        return None
    return lambda figure, where: draw_colour_bar(figure, where, spring_lines.colours(), "strain [%]", extend="both")


def add_lines(ax: "Axes", ends: np.ndarray, **style: Any) -> "Artist":
    """Add lines between ends `(lines, 2, dim)` to axes in the plane or in space."""
    if ends.shape[-1] == 2:
        from matplotlib.collections import LineCollection

        return ax.add_collection(LineCollection(list(ends), **style))
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    lines = Line3DCollection(ends, **style)
    cast("Axes3D", ax).add_collection3d(lines)
    return lines
