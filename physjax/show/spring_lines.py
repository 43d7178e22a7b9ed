"""Springs as lines, coloured by how far they are stretched."""

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from physjax.physics.springs.springs import Springs
from physjax.show import obstacles
from physjax.show.frames import Frames, find_batch_index, find_intact_springs, get_springs, pick_frames, take_frames
from physjax.show.panels import Scenery, build_scenery, draw_colour_bar, draw_panels
from physjax.trajectory import Trajectory

STRAIN_PERCENTILE = 99.0
"""The colours reach to this percentile of the strains; arrows on the colour bar say that some go beyond."""

MAX_BLOWN_UP_STRAIN = 1.0
"""The colours of a run that blew up reach no farther: a spring of twice its length."""


class SpringLines(NamedTuple):
    """How springs are drawn: pairs, rest lengths [m], which hold at each frame (None: all), and the colours' scale."""

    pairs: np.ndarray
    rest: np.ndarray
    held: np.ndarray | None
    limit: float

    def strain(self, position: np.ndarray) -> np.ndarray:
        """(l - L)/L for `(..., nodes, dim)` positions; infinite for a spring without rest length."""
        line = position[..., self.pairs[:, 1], :] - position[..., self.pairs[:, 0], :]
        length = np.sqrt((line * line).sum(axis=-1))
        has_rest = self.rest > 0
        return np.where(has_rest, (length - self.rest) / np.where(has_rest, self.rest, 1.0), np.inf)

    def colours(self) -> Any:
        """From strain to colour: blue is pressed, grey is at rest, orange is stretched."""
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import LinearSegmentedColormap, Normalize

        ramp = LinearSegmentedColormap.from_list("strain", ["#0072B2", "#6FA8CB", "0.78", "#E39A6B", "#D55E00"])
        return ScalarMappable(Normalize(-100 * self.limit, 100 * self.limit), ramp)


def springs(
    film: Trajectory,
    sheet: Any,
    frames: int | Iterable[int] | None = None,
    *,
    scene: int | Sequence[int] | None = None,
    limit: int | float | None = None,
    figure: Any = None,
) -> Any:
    """Draw springs in the plane or in space at chosen frames, coloured by strain; broken ones are dashed grey lines.

    `sheet` is a lattice or its springs. The colours go from -limit to limit, a strain; by default as far as 99 % of
    the springs that are shown. The others are as in `plot.cloth`. Returns the figure.

    Example:
        >>> figure = plot.springs(wave, sheet, frames=[0, 10])
        >>> len(figure.axes)
        3
    """
    who = "plot.springs"
    seen, given, index = take_springs(who, film, sheet, scene)
    chosen = pick_frames(who, seen, frames)
    spring_lines = build_spring_lines(who, film, given, index, seen, chosen, limit)
    bar = partial(draw_strain_bar, spring_lines=spring_lines)
    return draw_panels(
        build_scenery(seen, chosen), chosen, partial(draw_springs, spring_lines=spring_lines), figure, bar
    )


def take_springs(who: str, film: Any, sheet: Any, scene: Any) -> tuple[Frames, Springs, tuple[int, ...]]:
    """The film of one scene, the springs in it, and the place of that scene in a batch."""
    given = get_springs(who, sheet)
    seen = take_frames(who, film, scene=scene, nodes=given.nodes)
    return seen, given, find_batch_index(who, film, scene)


def build_spring_lines(
    who: str, film: Trajectory, given: Springs, index: tuple, seen: Frames, frames: Any, limit: int | float | None
) -> SpringLines:
    """What is known of the springs at all frames; the colours' scale fits the given frames."""
    held = find_intact_springs(who, film, given, index)
    rest = np.broadcast_to(_select_scene(np.asarray(given.rest_length, float), index), len(given.pairs))
    spring_lines = SpringLines(given.pairs, rest, held, 1.0)
    if limit is None:
        most = [_strain_percentile(spring_lines, seen.position[frame].astype(float), frame) for frame in frames]
        limit = min(max(most), MAX_BLOWN_UP_STRAIN if seen.blew_up else np.inf)
    elif not limit > 0:
        raise ValueError(f"{who}: got limit={limit}, expected a strain > 0, e.g. 0.05 for five per cent.")
    return spring_lines._replace(limit=float(limit) or 0.01)


def _select_scene(numbers: np.ndarray, index: tuple[int, ...]) -> np.ndarray:
    """The numbers of one scene, out of those for all springs or one each behind as many axes of scenes as it takes."""
    axes = max(numbers.ndim - 1, 0)
    return numbers[tuple(i if n > 1 else 0 for i, n in zip(index[len(index) - axes :], numbers.shape, strict=False))]


def _strain_percentile(spring_lines: SpringLines, position: np.ndarray, frame: int) -> float:
    """The strain that nearly all springs keep below in a frame, in either direction."""
    strain = np.abs(spring_lines.strain(position))
    shown = np.isfinite(strain) & (True if spring_lines.held is None else spring_lines.held[frame])
    return float(np.percentile(strain[shown], STRAIN_PERCENTILE)) if shown.any() else 0.0


def draw_springs(ax: Any, scenery: Scenery, frame: int, *, spring_lines: SpringLines) -> list[Any]:
    """Draw a frame: one collection of the springs that hold, and one, dashed and grey, of those that do not."""
    position = scenery.position(frame)
    ends = position[spring_lines.pairs]
    seen = scenery.stage.contains(position)[spring_lines.pairs].all(axis=1)
    held = seen if spring_lines.held is None else seen & spring_lines.held[frame]
    colours = spring_lines.colours().to_rgba(100 * spring_lines.strain(position)[held])
    width = float(np.clip(60 / np.sqrt(len(ends)), 0.5, 2.2))
    drawn = [_build_collection(ends[held], colors=colours, linewidths=width, zorder=3)] if held.any() else []
    if (seen & ~held).any():
        drawn.append(
            _build_collection(ends[seen & ~held], colors="0.75", linewidths=0.7, linestyles=(0, (3, 3)), zorder=2)
        )
    for collection in drawn:
        (ax.add_collection if scenery.flat else ax.add_collection3d)(collection)
    return (
        drawn
        if scenery.flat
        else drawn + obstacles.draw_balls(ax, scenery.stage, scenery.contacts, scenery.run.time[frame], scenery.up)
    )


def draw_strain_bar(figure: Any, where: dict[str, Any], *, spring_lines: SpringLines) -> None:
    """What the colours mean, below all panels."""
    draw_colour_bar(figure, where, spring_lines.colours(), "strain [%]", extend="both")


def _build_collection(ends: np.ndarray, **style: Any) -> Any:
    """Lines between ends `(draw_springs, 2, dim)`."""
    if ends.shape[-1] == 2:
        from matplotlib.collections import LineCollection

        return LineCollection(ends, **style)
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    return Line3DCollection(ends, **style)
