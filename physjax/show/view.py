"""A run as one HTML page on which it can be turned, zoomed and played, and which fetches nothing.

In space it is drawn by three.js (MIT, see web/vendor/), which is part of the page; in the plane on a canvas.
"""

import base64
import json
import os
import zlib
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

from jax.typing import ArrayLike

from physjax.show.drawables import Look
from physjax.show.films import schedule
from physjax.show.page_content import Pace, describe_run, take_seen
from physjax.show.page_data import Json, pack_arrays
from physjax.show.pages import check_output_path, fill_page, read_web_file, write_page
from physjax.show.panels import build_scenery
from physjax.show.stills import bundle_page, embed_page, encode_still
from physjax.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.typing import ColorType

NOTEBOOK_HEIGHT_PIXELS = 560
"""Height of the page inside a notebook [pixels]."""


class View:
    """A page with the frames of a run, to be looked at and played. A notebook shows it; `.save("x.html")` writes it.

    Example:
        >>> isinstance(animate.view(wave, sheet), animate.View)
        True
    """

    def __init__(self, content: Json, still: "Callable[[], Figure]"):
        self._content, self._still = pack_arrays(content), still
        self.frames = tuple(content["frames"])
        self.fps = content["fps"]

    def __repr__(self) -> str:
        return f"<View of {len(self.frames)} frames, a page of {len(self.page()) / 1e6:.2g} MB>"

    def page(self) -> str:
        """The HTML, which needs no other file."""
        return write_player(self._content)

    def still(self) -> "Figure":
        """The middle of the run as a figure of matplotlib: what is seen where no scripts run."""
        return self._still()

    def save(self, path: str | os.PathLike) -> Path:
        """Write the page, whole or not at all; returns the path.

        Raises ValueError for a name that does not end in .html and FileNotFoundError where there is no such folder.
        """
        return write_page(check_output_path(path, (".html",)), self.page())

    def _repr_html_(self) -> str:
        return embed_page(self.page(), NOTEBOOK_HEIGHT_PIXELS, encode_still(self.still()))

    def _repr_mimebundle_(self, **options: object) -> dict[str, str]:
        return bundle_page(self.page(), NOTEBOOK_HEIGHT_PIXELS, encode_still(self.still()), repr(self))


def view(
    film: Trajectory,
    shown: Look | None = None,
    *,
    scene: int | Sequence[int] | None = None,
    color: "ColorType | ArrayLike | None" = None,
    fps: int | float = 30.0,
    speed: int | float = 1.0,
) -> View:
    """A run as a page to turn (in space), zoom, pan and play, with its surfaces, axes in metres, and up as in the scene.

    `shown` is what the film is drawn as: a cloth, a jelly or a mesh as a surface, springs or a lattice without faces as
    lines coloured by strain, a `solids` shape or one for each body, in the plane a `rigid.PlanarShape`. Without it bodies
    are the shapes of the scene's `rigid.Solids` or boxes of their inertia, nodes are joined by the scene's springs or rods,
    and everything else is dots with their paths; rods and ropes between bodies are lines. `color` is one for surfaces and
    bodies, or a value for each lane for dots and bodies. The page plays `speed` seconds of the run a second, in `fps`
    frames. Positions are rounded to 1/65 534 of the sides of the box. A run that blew up is shown until its last good frame.

    Raises TypeError or ValueError for a film, `shown`, `color`, `fps` or `speed` that do not fit; runs in one dimension
    are for `animate.paths`.

    Example:
        >>> animate.view(wave, sheet).save("wave.html").name
        'wave.html'
    """
    who = "animate.view"
    seen = take_seen(who, film, shown, scene, color)
    frames, fps = schedule(who, seen.run, fps, speed)
    pace = Pace(frames, fps, float(speed))
    content = describe_run(who, seen, pace, build_scenery(seen.run, frames), color)
    return View(content, partial(_draw_still, film, shown, scene))


def _draw_still(film: Trajectory, shown: Look | None, scene: int | Sequence[int] | None) -> "Figure":
    from physjax.show.auto_plot import draw_still  # above this, since it draws films

    return draw_still(film, shown, scene=scene)


def write_player(content: Json) -> str:
    """The HTML that plays a run; the arrays of its content are packed."""
    data = json.dumps(content, separators=(",", ":")).replace("<", "\\u003c")
    if len(content["low"]) == 2:
        return fill_page("plane.html", FILM=data)
    return fill_page("view.html", THREE=_load_library(), FILM=data)


@cache
def _load_library() -> str:
    return base64.b64encode(zlib.compress(read_web_file("vendor/three.min.js").encode(), 9)).decode()
