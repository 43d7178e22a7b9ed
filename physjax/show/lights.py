"""Images of many particles at once: light that adds up, and how many particles there are in a place."""

from typing import TYPE_CHECKING, Any, cast

import numpy as np

from physjax.show.stage import get_space_axes

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from mpl_toolkits.mplot3d import Axes3D

CELL_POINTS = 2.0
"""Width of a cell in which particles are counted [points]."""
NIGHT_COLOUR = (0.06, 0.06, 0.09)
"""The background of particles that glow."""
SIZE_GROUPS = 5
"""Particles that glow are blurred in this many groups of about one size: a blur has one width for all that is in it."""
MIN_SPREAD_PIXELS = 0.6
"""The standard deviation of the smallest light [pixels]: a narrower one would flicker as it moves between pixels."""


def project_to_pixels(ax: "Axes", position: np.ndarray) -> np.ndarray:
    """Where points are in axes that have been laid out [pixels], from the lower left corner of the axes."""
    ax.apply_aspect()
    if position.shape[-1] == 3:
        from mpl_toolkits.mplot3d import proj3d

        x, y, z = position.T
        position = np.stack(proj3d.proj_transform(x, y, z, cast("Axes3D", ax).get_proj())[:2], axis=-1)
    return ax.transData.transform(position) - (ax.bbox.x0, ax.bbox.y0)


def count_cells(ax: "Axes", cell: float = 1.0) -> tuple[int, int]:
    """Rows and columns of the cells [pixels] that cover axes."""
    return int(np.ceil(ax.bbox.height / cell)), int(np.ceil(ax.bbox.width / cell))


def darken_background(ax: "Axes", flat: bool) -> None:
    """Darken the background of axes, in the plane (`flat`) or in space."""
    if flat:
        ax.set_facecolor(NIGHT_COLOUR)
        return
    for axis in get_space_axes(cast("Axes3D", ax)):
        axis.set_pane_color((*NIGHT_COLOUR, 1.0))
        axis._axinfo["grid"].update(color="0.3", linewidth=0.5)  # pyright: ignore[reportAttributeAccessIssue]  # not of the public face


def render_glow(points: np.ndarray, wide: np.ndarray, light: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The sum of the lights of particles, each a bell curve as wide as the particle [pixels], as colours and opacity.

    `light` is `(particles, 3)`, red, green and blue at the middle of a particle; what is brighter than 1 is seen as 1.
    """
    total = np.zeros((*shape, 3))
    spread = np.maximum(wide / 4, MIN_SPREAD_PIXELS)  # two standard deviations are its radius
    for group in np.array_split(np.argsort(spread), min(SIZE_GROUPS, max(len(spread), 1))):
        if not len(group):
            continue
        sigma = float(np.sqrt(np.mean(spread[group] ** 2)))
        for i in range(3):
            total[..., i] += _blur(count_points(points[group], shape, 1.0, light[group, i]), sigma) * (
                2 * np.pi * sigma**2
            )
    # black where there is light enough to hide the background, as the sum is over a dark one
    cover = np.clip(total.max(axis=-1), 0.0, 1.0)
    colour = np.clip(total, 0.0, 1.0) / np.maximum(cover, 1e-6)[..., None]
    return np.concatenate([colour, cover[..., None]], axis=-1)


def count_points(
    points: np.ndarray, shape: tuple[int, int], cell: float, weights: np.ndarray | None = None
) -> np.ndarray:
    """How many points are in each cell of a picture of `shape` (rows from below, columns), or the sum of their weights."""
    edges = [np.arange(n + 1) * cell for n in shape]
    return np.histogram2d(points[:, 1], points[:, 0], bins=edges, weights=weights)[0]


def _blur(picture: np.ndarray, sigma: float) -> np.ndarray:
    """The picture under a bell curve of area 1, by its Fourier transform."""
    margin = int(np.ceil(4 * sigma))  # the transform is periodic: light would come back in at the opposite edge
    padded = np.pad(picture, margin)
    rows, columns = np.fft.fftfreq(padded.shape[0]), np.fft.rfftfreq(padded.shape[1])
    damping = np.exp(-2 * (np.pi * sigma) ** 2 * (rows[:, None] ** 2 + columns**2))
    blurred = np.fft.irfft2(np.fft.rfft2(padded) * damping, s=padded.shape)
    return np.maximum(blurred[margin : margin + picture.shape[0], margin : margin + picture.shape[1]], 0.0)


def draw_image(ax: "Axes", pixels: np.ndarray, **options: Any) -> "Artist":
    """Lay an image over all of some axes, its first row below; returns the artist."""
    from matplotlib.image import BboxImage

    image = BboxImage(ax.bbox, origin="lower", interpolation="nearest", zorder=4, **options)
    image.set_data(pixels)
    return ax.add_artist(image)
