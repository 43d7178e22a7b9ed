"""Results as text: tidy tables for a terminal, and one self-contained HTML page."""

import base64
import html
import io
from collections.abc import Sequence
from datetime import date
from typing import TYPE_CHECKING, NamedTuple

from physjax.text import describe_machine

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PHONE_WIDTH_INCHES, READABLE_PIXELS_PER_INCH = 6.5, 65
"""Width [inch] of a figure that still fits a phone; pixels an inch at which the letters of a wider one are legible."""
PIXELS_PER_INCH = 110
"""Of encoded figures."""


class Picture(NamedTuple):
    """An encoded picture, what it shows in words, and the CSS pixels below which its letters are illegible."""

    data: bytes
    alt: str
    width: int = 0
    kind: str = "png"


class Table(NamedTuple):
    """Text whose columns are aligned."""

    text: str


class Section:
    """A part of a page: a heading, and below it sentences, `Picture`s and `Table`s in any order."""

    def __init__(self, heading: str, *blocks: str | Picture | Table):
        self.heading, self.blocks = heading, blocks


def encode_figure(figure: "Figure", alt: str) -> Picture:
    """A matplotlib figure as a picture; the figure is closed. On a phone a wide one scrolls, so that it stays legible."""
    from matplotlib import pyplot as plt

    file = io.BytesIO()
    figure.savefig(file, dpi=PIXELS_PER_INCH)
    plt.close(figure)
    inches = figure.get_figwidth()
    return Picture(file.getvalue(), alt, round(READABLE_PIXELS_PER_INCH * inches) if inches > PHONE_WIDTH_INCHES else 0)


def build_page(title: str, summary: str, sections: Sequence[Section]) -> str:
    """A self-contained HTML page, pictures inside, readable on a phone."""
    parts = [
        f"<h1>{html.escape(title)}</h1>",
        _render_block(Table(summary)) if summary else "",
        _render_contents(sections),
    ]
    for section in sections:
        blocks = "\n".join(map(_render_block, section.blocks))
        parts.append(
            f'<section id="{_make_anchor(section)}"><h2>{html.escape(section.heading)}</h2>\n{blocks}\n</section>'
        )
    parts.append(f"<footer>Measured {date.today():%Y-%m-%d} on {html.escape(describe_machine())}.</footer>")
    return _PAGE.format(title=html.escape(title), body="\n".join(parts))


def _render_block(block: str | Picture | Table) -> str:
    if isinstance(block, Picture):
        source = f"data:image/{block.kind};base64,{base64.b64encode(block.data).decode()}"
        style = f' style="min-width: {block.width}px"' if block.width else ""
        return f'<div class="wide"><img alt="{html.escape(block.alt)}" src="{source}"{style}></div>'
    tag, text = ("pre", block.text) if isinstance(block, Table) else ("p", block)
    return f"<{tag}>{html.escape(text)}</{tag}>"


def _make_anchor(section: Section) -> str:
    return html.escape(section.heading.replace(" ", "-"))


def _render_contents(sections: Sequence[Section]) -> str:
    links = (f'<a href="#{_make_anchor(section)}">{html.escape(section.heading)}</a>' for section in sections)
    return f"<nav>{' · '.join(links)}</nav>"


_PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 1100px; margin: 2em auto; padding: 0 1em; }}
body {{ color: #222; background: #fff; }}
.wide {{ overflow-x: auto; }}
img {{ display: block; max-width: 100%; height: auto; }}
pre {{ overflow-x: auto; background: #f6f6f6; padding: 1em; font-size: 13px; line-height: 1.4; }}
footer {{ color: #666; margin: 3em 0; }}
</style>
{body}
</html>
"""
