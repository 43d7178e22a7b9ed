"""A drawn figure in the colours of a dark page: paper and ink change places, and colours that would be lost are lit."""

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.figure import Figure

DARK_PAGE, DARK_INK = np.array([22, 24, 27]) / 255, np.array([232, 234, 237]) / 255
"""Colours that take the places of white and black; those of the style sheet of our pages."""
LARGEST_GREY_CHROMA = 0.08
"""Colours whose components differ by no more are greys: paper, ink, grids."""
LEAST_CONTRAST = 4.0
"""Of a coloured line with the page, by the Web Content Accessibility Guidelines, which ask for 3."""


def turn_dark(figure: "Figure") -> None:
    """Change the colours of a figure to those for a dark page.

    Greys are mirrored, from paper to ink; other colours are mixed with white where they would be too dark. What a colour
    map or light colours, such as images, maps of errors and solids in space, stays as it is.
    """
    figure.draw_without_rendering()  # ticks and their labels come into being when they are drawn
    for artist in list(_find_artists(figure)):
        # all are read first: the colour of a marker may be that of its line
        changed = [(put, _find_dark_colours(colours)) for colours, put in _list_colours(artist)]
        for put, colours in changed:
            put(colours)


def shows_map(figure: "Figure") -> bool:
    """Whether areas are coloured by a map or an image, with words and lines on them: these are for light paper alone."""
    from matplotlib.collections import QuadMesh

    drawn = [ax for ax in figure.axes if ax.get_label() != "<colorbar>"]
    return any(ax.images or any(isinstance(part, QuadMesh) for part in ax.collections) for ax in drawn)


def _find_artists(figure: "Figure") -> "Iterator[Artist]":
    """All that is drawn, the boxes around words and the walls of boxes in space as well."""
    from matplotlib.text import Text
    from mpl_toolkits.mplot3d.axes3d import Axes3D

    for artist in figure.findobj():
        yield artist
        if isinstance(artist, Text) and (box := artist.get_bbox_patch()) is not None:
            yield box
        if isinstance(artist, Axes3D):
            axes = (artist.xaxis, artist.yaxis, artist.zaxis)
            yield from (axis.pane for axis in axes)  # pyright: ignore[reportAttributeAccessIssue]  # those of mplot3d


def _list_colours(artist: "Artist") -> list[tuple[Any, Callable[[Any], object]]]:
    """The colours of an artist, and how each is set: none where a colour map says what they mean, or light shades them."""
    from matplotlib.collections import Collection
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch
    from matplotlib.text import Text
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    match artist:
        case Text():
            return [(artist.get_color(), artist.set_color)]
        case Line2D():
            marker = (artist.get_markerfacecolor(), artist.set_markerfacecolor)
            edge = (artist.get_markeredgecolor(), artist.set_markeredgecolor)
            return [(artist.get_color(), artist.set_color), marker, edge]
        case Patch():
            return [(artist.get_facecolor(), artist.set_facecolor), (artist.get_edgecolor(), artist.set_edgecolor)]
        case Collection() if artist.get_array() is None and not isinstance(artist, Poly3DCollection):
            faces, edges = (
                (artist.get_facecolor(), artist.set_facecolor),
                (artist.get_edgecolor(), artist.set_edgecolor),
            )
            return [faces, edges]
        case _:
            return []


def _find_dark_colours(colours: Any) -> Any:
    """One colour, or a row for each, of those in any form of matplotlib's."""
    from matplotlib.colors import to_rgba_array

    rows = to_rgba_array(colours)
    found = np.array([_find_dark_colour(row) for row in rows]).reshape(-1, 4)
    one = isinstance(colours, str) or np.ndim(colours) < 2
    return tuple(found[0]) if one and len(found) else found


def _find_dark_colour(colour: np.ndarray) -> np.ndarray:
    """The colour on a dark page of one for a white page, red, green, blue and opacity."""
    share, opacity = colour[:3], colour[3:]
    if np.ptp(share) <= LARGEST_GREY_CHROMA:
        mirrored = DARK_INK + share.mean() * (DARK_PAGE - DARK_INK)
        return np.concatenate([mirrored, opacity])
    white = next(mix for mix in np.linspace(0, 1, 51) if _measure_contrast(share + mix * (1 - share)) >= LEAST_CONTRAST)
    return np.concatenate([share + white * (1 - share), opacity])


def _measure_contrast(share: np.ndarray) -> float:
    """Contrast of a colour with the dark page, as the Web Content Accessibility Guidelines define it."""
    return (_measure_luminance(share) + 0.05) / (_measure_luminance(DARK_PAGE) + 0.05)


def _measure_luminance(share: np.ndarray) -> float:
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


__all__ = ["shows_map", "turn_dark"]
