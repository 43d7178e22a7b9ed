"""`explore`: a scene with sliders, in a notebook or a browser; without what that needs, a page with the start setting."""

import base64
import os
import threading
import webbrowser
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from physjax.checks import demand_known
from physjax.live.engine import FRAMES, Engine
from physjax.live.pages import OFFLINE_NOTE, describe_view, write_page
from physjax.live.server import LiveServer
from physjax.live.worker import Worker
from physjax.scenes import SCENES
from physjax.scenes import title as scene_title
from physjax.scenes.parameters import read_parameters
from physjax.show.auto_plot import draw_still
from physjax.show.pages import check_output_path
from physjax.show.pages import write_page as write_file
from physjax.show.stills import bundle_page, encode_still
from physjax.tracebacks import shorten_tracebacks

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from physjax.live.widget import LiveWidget

INSTALL = 'explore: sliders in a notebook need anywidget: pip install "physjax[explore]". Until then here is the start setting.'
"""Said where the widget's libraries are missing."""
NOTEBOOK_HEIGHT_PIXELS = 760
"""Height of the page without sliders inside a notebook [pixels]."""


class Explorer:
    """A scene with sliders. A notebook shows it, `.serve()` opens it in a browser, `.save("x.html")` writes the start setting.

    `.engine` computes without either; `.widget` is the widget itself.
    """

    def __init__(self, engine: Engine, title: str = "", summary: str = ""):
        self.engine = engine
        self.first = engine.find_start()
        self._title, self._summary = title, summary

    def __repr__(self) -> str:
        sliders = ", ".join(
            f"{s.name} {s.low:g} to {s.high:g}{' ' + s.unit if s.unit else ''}" for s in self.engine.sliders
        )
        return (
            f"<Explorer of {self._title or getattr(self.engine.build, '__name__', 'a scene')}: {sliders or 'no number'}; "
            f"{', '.join(self.engine.methods)}. A notebook shows it; .serve() opens a browser.>"
        )

    def code(self) -> str:
        """The program of the start setting; a page has a button for that of the present one.

        Example:
            >>> print(explore("projectile").code().splitlines()[0])
            from physjax import methods, scenes, simulate
        """
        return self.engine.write_code(self.engine.start)

    def save(self, path: str | os.PathLike) -> Path:
        """Write the start setting as a page that needs nothing else: it plays, and its sliders rest.

        Raises ValueError for a name that does not end in .html and FileNotFoundError where there is no such folder.
        """
        return write_file(check_output_path(path, (".html",)), self._write_offline_page())

    def still(self) -> "Figure":
        """The start setting's run as a figure of matplotlib, with the setting below it."""
        flight, settings = self.first.run.flight, self.first.settings
        problem = self.first.built.problem
        figure = draw_still(flight, None if problem is None else problem.looks)
        numbers = [
            f"{slider.name} = {settings.numbers[slider.name]:.4g} {slider.unit}" for slider in self.engine.sliders
        ]
        setting = [*numbers, settings.method, f"dt = {settings.dt:.3g} s"]
        text = ", ".join(part.strip() for part in setting)
        figure.text(0.5, -0.02, f"{text}\nRun the cell to move the sliders.", ha="center", va="top", fontsize="small")
        return figure

    def serve(self, port: int = 0, *, browser: bool = True) -> None:
        """Open the view in a browser, from a web server of this machine alone, until Ctrl-C."""
        with self.start_server(port) as server:
            print(f"{self._title or 'explore'}: {server.address} (Ctrl-C ends it)", flush=True)
            if browser:
                threading.Thread(target=webbrowser.open, args=(server.address,), daemon=True).start()
            try:
                server.serve_forever()
            except KeyboardInterrupt:
                print("ended")

    def start_server(self, port: int = 0) -> LiveServer:
        """The server of the view, still to be run: `with explorer.start_server() as server: server.serve_forever()`."""
        return LiveServer(write_page(self._spec, 'connect("/ask")'), self._worker, port)

    @cached_property
    def widget(self) -> "LiveWidget":
        """The widget; ImportError where anywidget is missing."""
        try:
            from physjax.live.widget import LiveWidget
        except ImportError as error:
            raise ImportError(INSTALL) from error
        return LiveWidget(self._spec, self._worker)

    @cached_property
    def _worker(self) -> Worker:
        return Worker(self.engine)

    @cached_property
    def _spec(self) -> dict[str, Any]:
        return describe_view(self.engine, self.first, self._title, self._summary, self.engine.measure(self.first))

    def _write_offline_page(self) -> str:
        self.engine.find_limit(self.first)  # no later than here: nothing computes behind the page
        figures = [figure._asdict() for figure in self.engine.measure(self.first)]
        return write_page(self._spec | {"figures": figures, "note": OFFLINE_NOTE, "code": self.code()})

    def _repr_mimebundle_(self, **options: Any) -> Any:
        """The widget and a still; without its libraries the page of the start setting, and above it what is missing."""
        still = encode_still(self.still())
        try:
            widget = self.widget
        except ImportError:
            bundle = bundle_page(self._write_offline_page(), NOTEBOOK_HEIGHT_PIXELS, still, repr(self))
            return bundle | {"text/html": f"<p>{INSTALL}</p>{bundle['text/html']}"}
        shown = widget._repr_mimebundle_(**options)
        data, metadata = shown if isinstance(shown, tuple) else (shown or {}, {})
        return data | {"image/png": base64.b64encode(still).decode(), "text/plain": repr(self)}, metadata

    def _display_(self) -> Any:
        """What marimo shows."""
        return self.widget


@shorten_tracebacks
def explore(
    build: "Callable | str",
    *,
    duration: float | None = None,
    methods: Sequence[Callable | str] | None = None,
    dt: Any = None,
    frames: int = FRAMES,
    title: str | None = None,
    **numbers: Any,
) -> Explorer:
    """A scene with a slider for every number, a choice of methods, and what the run is worth: error, energy, stability, cost.

    `build(**numbers)` returns a `Scene` or a gallery `Problem`; or `build` is the name of a gallery scene. A number is a range
    `(low, high)`, `(low, high, start)`, or a single one, which stays. `duration` [s], which a `Problem` knows itself;
    `methods`, by default four; `dt` [s], a range as well; and `frames` of the film belong to the view, so `build` has
    no parameters of these names. In a notebook the view is the last line of a cell; elsewhere `.serve()`.

    A changed number, dt or duration recompiles nothing; a number that decides a shape (a count of nodes) and
    another method do, once. Runs are in float64. The error is that against the scene's closed form, or against the
    same run with half the step. Raises TypeError or ValueError for ranges, methods or numbers that do not fit.

    Example:
        >>> def throw(speed, angle):
        ...     launch = speed * jnp.array([jnp.cos(angle), jnp.sin(angle)])
        ...     return Scene(Particles(jnp.zeros(2), launch), forces=(forces.Gravity(),))
        >>> explore(throw, speed=(10, 50), angle=(0.1, 1.4), duration=3.0, methods=[methods.verlet])
        <Explorer of throw: speed 10 to 50, angle 0.1 to 1.4; verlet. A notebook shows it; .serve() opens a browser.>
    """
    if isinstance(build, str):
        name = demand_known("scene", build, SCENES)
        known = {p.name: p for p in read_parameters(SCENES[name])}
        ranges = {p.name: (p.low, p.high, p.default) for p in known.values() if p.low is not None} | numbers
        units = {p.name: p.unit for p in known.values()}
        engine = Engine(
            SCENES[name], ranges, units=units, name=name, duration=duration, methods=methods, dt=dt, frames=frames
        )
        return Explorer(engine, title or name, scene_title(name))
    if not callable(build):
        raise TypeError(
            f"explore: got {build!r}, expected a function that returns a Scene, or the name of a gallery scene."
        )
    engine = Engine(build, numbers, duration=duration, methods=methods, dt=dt, frames=frames)
    return Explorer(engine, title if title is not None else getattr(build, "__name__", ""))


__all__ = ["Explorer", "explore"]
