"""The page of a live view: alone in a file, where nothing can be set, or on a web server of this machine."""

import html
import json
from functools import cache
from importlib import resources
from typing import Any

from physjax.live.engine import Answer, Engine
from physjax.show.page_data import pack_arrays
from physjax.show.pages import read_web_file
from physjax.show.view import write_player

OFFLINE_NOTE = "a still setting: nothing computes behind this page"
"""Shown where the sliders of a page without an engine are."""


@cache
def read_live_file(name: str) -> str:
    """A text file of this package's folder web/."""
    return (resources.files("physjax.live") / "web" / name).read_text(encoding="utf-8")


@cache
def read_style() -> str:
    """The style sheet, with the colours of the pages of `animate.view`."""
    return read_web_file("colors.css").replace(":root", ".physjax-live") + read_live_file("live.css")


def describe_view(engine: Engine, answer: Answer, title: str, summary: str, figures: list[Any]) -> dict[str, Any]:
    """What a page needs: the sliders, where they start, the player with the first film in it, and the first figures."""
    film = answer.film
    return {
        "title": title,
        "summary": summary,
        "sliders": [slider.describe() for slider in engine.sliders],
        "methods": list(engine.methods),
        "dt": engine.step_slider.describe(),
        "start": engine.start._asdict(),
        "page": write_player(pack_arrays(film)),
        "box": [film["low"], film["high"]],
        "figures": [figure._asdict() for figure in figures],
    }


def write_page(spec: dict[str, Any], channel: str = "null") -> str:
    """The HTML of a view; `channel` is the JavaScript of what answers it."""
    parts = {
        "TITLE": html.escape(f"physjax: {spec['title'] or 'explore'}"),
        "STYLE": read_web_file("colors.css") + read_style(),
        "PROGRAM": read_live_file("live.js").replace("export default", "const widget =").replace("export ", ""),
        "CHANNEL": channel,
        "SPEC": json.dumps(spec, separators=(",", ":")).replace("<", "\\u003c"),
    }
    page = read_live_file("live.html")
    for part, content in parts.items():
        page = page.replace(f"__{part}__", content)
    return page


__all__ = ["OFFLINE_NOTE", "describe_view", "read_live_file", "read_style", "write_page"]
