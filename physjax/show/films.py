"""Films: pictures in real time that show themselves in a notebook and are saved as a GIF or as an HTML page."""

import base64
import io
import json
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import IO, TYPE_CHECKING, cast

import numpy as np

from physjax.checks import as_real_quantity
from physjax.files import write_atomically
from physjax.show import obstacles
from physjax.show.frames import Frames
from physjax.show.pages import check_output_path, fill_page, write_page
from physjax.show.panels import Scenery, arrange_panels
from physjax.show.stills import bundle_page, embed_page, encode_still
from physjax.text import progress_bar

if TYPE_CHECKING:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL.Image import Image

LOSSLESS_LIMIT_BYTES = 12_000
"""A picture that takes more bytes than this in lossless compression is compressed with some loss."""
LOSSY_QUALITY = 85
"""Of WebP, from 0 to 100: shaded surfaces show no difference, at a tenth of the bytes."""
MAX_FILM_SECONDS = 600.0
"""A film that plays longer than this [s] is taken for a mistake in `speed`."""
MIN_PICTURE_MILLISECONDS = 10
"""The shortest time for which a GIF may show a picture; browsers slow down those that ask for less."""
GREY_COUNT, GREY_CHANNEL_SPREAD = 32, 8
"""How many of the 256 colours of a GIF are greys, and how close the channels of a colour are for it to count as one.

The colours are the same for all frames, so that nothing flickers."""
TOOLBAR_PIXELS = 70
"""Room for the buttons below a film in a notebook [pixels]."""
GIF_TICK_SECONDS = 0.01
"""A GIF counts time in hundredths of a second."""


class Film:
    """Frames of a run as a film of `fps` pictures a second, drawn when it is shown or saved.

    In a notebook it shows itself, with buttons; `.save` writes it, `.still` draws a single picture. `frames` are the
    numbers of the frames of the run that are shown. All pictures have the same limits.

    Example:
        >>> film = animate.paths(flight)
        >>> isinstance(film, animate.Film), len(film.frames)
        (True, 21)
    """

    def __init__(
        self,
        scenery: Scenery,
        frames: Sequence[int],
        fps: int | float,
        draw: Callable,
        *,
        bar: Callable | None = None,
        axes: Callable = arrange_panels,
        dpi: int = 100,
    ):
        self.scenery, self.frames, self.fps, self.dpi = scenery, tuple(frames), fps, dpi
        self._draw, self._bar, self._axes = draw, bar, axes

    def __repr__(self) -> str:
        return f"<Film of {len(self.frames)} pictures, {len(self.frames) / self.fps:.3g} s at {self.fps:.3g} a second>"

    def still(self, number: int) -> "Figure":
        """The figure of one picture, counted from 0 or, if negative, from the end."""
        if not -len(self.frames) <= number < len(self.frames):
            raise IndexError(f"still: got picture {number}, expected {-len(self.frames)} to {len(self.frames) - 1}.")
        figure, show = self._build_renderer()
        show(self.frames[number])
        return figure

    def save(self, path: str | os.PathLike, *, progress: bool = True) -> Path:
        """Write a GIF or an HTML page that needs nothing else, by the ending of `path`; the file is whole or absent.

        Raises ValueError for another ending and FileNotFoundError where there is no such folder, before anything is
        drawn. Returns the path.
        """
        path = check_output_path(path, (".gif", ".html"))
        if path.suffix.lower() == ".html":
            return write_page(path, self._build_player(progress)[0])
        with write_atomically(path, "wb") as file:
            self._write_gif(file, progress)
        return path

    def gif(self) -> bytes:
        """The film as a GIF in memory, for a page that holds it."""
        file = io.BytesIO()
        self._write_gif(file, progress=False)
        return file.getvalue()

    def _repr_html_(self) -> str:
        page, height = self._build_player(progress=True)
        return embed_page(page, height + TOOLBAR_PIXELS, self._encode_still())

    def _repr_mimebundle_(self, **options: object) -> dict[str, str]:
        page, height = self._build_player(progress=True)
        return bundle_page(page, height + TOOLBAR_PIXELS, self._encode_still(), repr(self))

    def _encode_still(self) -> bytes:
        return encode_still(self.still(len(self.frames) // 2))

    def _build_renderer(self) -> "tuple[Figure, Callable[[int], None]]":
        """A figure, and the function that shows a frame of the run in it.

        The figure is unknown to pyplot, which would show it once more at the end of a notebook's cell.
        """
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(dpi=self.dpi)
        FigureCanvasAgg(figure)
        (ax,) = self._axes(figure, self.scenery, 1, self._bar)
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # laid out once: nothing moves but what moves
        times = self.scenery.run.time[list(self.frames)]
        moves = obstacles.any_moves(self.scenery.contacts, self.scenery.stage, times)
        if not moves:
            self.scenery.draw_obstacles(ax, self.frames[0])
        on_screen: list = []

        def show(frame: int) -> None:
            for artist in on_screen:
                artist.remove()
            on_screen[:] = self.scenery.draw_obstacles(ax, frame) if moves else []
            on_screen.extend(self._draw(ax, self.scenery, frame))
            ax.title.set_text(self.scenery.run.title(frame))

        return figure, show

    def _write_gif(self, file: IO[bytes], progress: bool) -> None:
        pictures = self._render_pictures(progress)
        next(pictures).save(
            file,
            "GIF",
            save_all=True,
            append_images=pictures,
            duration=self._compute_durations(),
            loop=0,
            optimize=False,
        )

    def _render_pictures(self, progress: bool) -> "Iterator[Image]":
        """The pictures, in the 256 colours that all of them share."""
        from PIL.Image import Dither

        figure, show = self._build_renderer()
        palette = _build_palette(
            [_render_picture(figure, show, self.frames[int(i)]) for i in np.linspace(0, len(self.frames) - 1, 3)]
        )
        for frame in _track_progress(self.frames, progress):
            yield _render_picture(figure, show, frame).quantize(palette=palette, dither=Dither.NONE)

    def _compute_durations(self) -> list[int]:
        """How long each picture is shown [ms]: whole hundredths of a second that add up to real time."""
        ends = np.round(np.arange(len(self.frames) + 1) / self.fps / GIF_TICK_SECONDS)
        return np.maximum(10 * np.diff(ends), MIN_PICTURE_MILLISECONDS).astype(int).tolist()

    def _build_player(self, progress: bool) -> tuple[str, int]:
        """A page with all pictures in it, and buttons; and the height of a picture [pixels]."""
        figure, show = self._build_renderer()
        middle = _render_picture(figure, show, self.frames[len(self.frames) // 2])
        width, height = middle.size
        # lines and points are small in lossless compression, and suffer from loss; shaded surfaces are the opposite,
        # and would be lit from behind if a dark page mirrored their colours
        kind = "lines" if len(_encode_webp(middle.quantize(), lossless=True)) <= LOSSLESS_LIMIT_BYTES else "shaded"
        if kind == "lines":
            codes = (_encode_webp(picture, lossless=True) for picture in self._render_pictures(progress))
        else:
            drawn = (_render_picture(figure, show, frame) for frame in _track_progress(self.frames, progress))
            codes = (_encode_webp(picture, quality=LOSSY_QUALITY) for picture in drawn)
        pictures = ["data:image/webp;base64," + base64.b64encode(code).decode() for code in codes]
        time = self.scenery.run.time[list(self.frames)]
        paced = time[:-1] if len(time) > 2 else time  # the end is shown when it is due, or a little early
        speed = float(f"{np.polyfit(np.arange(len(paced)), paced, 1)[0] * self.fps:.2g}")
        parts = {"WIDTH": width, "HEIGHT": height, "FPS": self.fps, "SPEED": speed, "KIND": kind}
        return fill_page("film.html", **parts, PICTURES=json.dumps(pictures)), height


def schedule(who: str, run: Frames, fps: int | float, speed: float) -> tuple[list[int], float]:
    """The frames of a run that a film shows, and its pictures a second: `fps`, or fewer if the run has fewer frames.

    Raises ValueError for a film that would be a single picture or play for longer than ten minutes.
    """
    fps, speed = (
        float(as_real_quantity(f"{who}: {n}", v, above=0)) for n, v in (("fps [1/s]", fps), ("speed [1]", speed))
    )
    time = run.time[: run.good_frames]
    if len(time) == 1:
        raise ValueError(f"{who}: got a film with one good frame, expected at least two; plot shows a single one.")
    span = (time[-1] - time[0]) / speed
    fps = min(fps, (len(time) - 1) / span)
    count = round(span * fps)
    if count < 1 or span > MAX_FILM_SECONDS:
        raise ValueError(
            f"{who}: got a run of {time[-1] - time[0]:.3g} s, which at speed={speed:g} plays for {span:.3g} s; expected "
            f"two pictures to {MAX_FILM_SECONDS:g} s. With speed={(time[-1] - time[0]) / 10:.2g} it takes ten seconds."
        )
    wanted = time[0] + np.arange(count + 1) * speed / fps
    after = np.clip(np.searchsorted(time, wanted), 1, len(time) - 1)
    nearest = after - (wanted - time[after - 1] < time[after] - wanted)
    nearest[-1] = len(time) - 1  # the end is always seen
    return nearest.tolist(), fps


def _render_picture(figure: "Figure", show: Callable[[int], None], frame: int) -> "Image":
    from PIL import Image

    show(frame)
    figure.canvas.draw()
    return Image.fromarray(np.asarray(cast("FigureCanvasAgg", figure.canvas).buffer_rgba())[..., :3].copy())


def _encode_webp(picture: "Image", **options: bool | int) -> bytes:
    data = io.BytesIO()
    picture.save(data, "WEBP", **options)
    return data.getvalue()


def _build_palette(pictures: "list[Image]") -> "Image":
    """A palette of greys, from black to white, and of the colours that some pictures have in common."""
    from PIL import Image

    width, height = pictures[0].size
    together = Image.new("RGB", (width, height * len(pictures)))
    for place, picture in enumerate(pictures):
        together.paste(picture, (0, place * height))
    # Pillow takes any colour that is close enough: one that is almost grey would be taken for the greys of the axes
    wanted = 256 - GREY_COUNT
    found = np.array((together.quantize(wanted).getpalette() or [])[: 3 * wanted]).reshape(-1, 3)
    colours = found[np.ptp(found, axis=1) > GREY_CHANNEL_SPREAD]
    greys = np.repeat(np.linspace(0, 255, GREY_COUNT).round().astype(int), 3)
    palette = Image.new("P", (1, 1))
    palette.putpalette([*greys.tolist(), *colours.ravel().tolist()])
    return palette


def _track_progress(frames: Sequence[int], progress: bool) -> Iterator[int]:
    return iter(progress_bar(frames, progress=progress, desc="drawing", unit="picture", leave=False))
