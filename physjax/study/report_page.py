"""Results as one self-contained HTML page, whose tables and pictures fit a phone."""

import base64
import html
import io
import re
from collections.abc import Sequence
from datetime import date
from typing import TYPE_CHECKING, NamedTuple

from physjax.show.dark import shows_map, turn_dark
from physjax.show.pages import read_web_file
from physjax.text import describe_machine

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PHONE_WIDTH_INCHES, READABLE_PIXELS_PER_INCH = 6.5, 65
"""Width [inch] of a figure that still fits a phone; pixels an inch at which the letters of a wider one are legible."""
PIXELS_PER_INCH = 110
"""Of encoded figures."""
LONG_CELL = 20
"""A table with a cell of more letters than this is a list on a phone: its columns would not fit."""


class Picture(NamedTuple):
    """An encoded picture, what it shows in words, and the CSS pixels below which its letters are illegible.

    `dark` is the same picture for a dark page; without it there is one for both.
    """

    data: bytes
    alt: str
    width: int = 0
    kind: str = "png"
    dark: bytes = b""


class Table(NamedTuple):
    """Text whose columns are aligned, as `format_table` does it: below the headers a line of dashes."""

    text: str


class Section:
    """A part of a page: a heading, and below it sentences, `Picture`s and `Table`s in any order."""

    def __init__(self, heading: str, *blocks: str | Picture | Table):
        self.heading, self.blocks = heading, blocks


def encode_figure(figure: "Figure", alt: str) -> Picture:
    """A matplotlib figure as a picture, maps on light paper, others in dark too; it is closed.

    A wide one is whole on a phone, and is enlarged by a tap.
    """
    from matplotlib import pyplot as plt

    light, dark = io.BytesIO(), io.BytesIO()
    figure.savefig(light, dpi=PIXELS_PER_INCH)
    if not shows_map(figure):
        turn_dark(figure)
        figure.savefig(dark, dpi=PIXELS_PER_INCH)
    plt.close(figure)
    inches = figure.get_figwidth()
    width = round(READABLE_PIXELS_PER_INCH * inches) if inches > PHONE_WIDTH_INCHES else 0
    return Picture(light.getvalue(), alt, width, dark=dark.getvalue())


def build_page(title: str, summary: str, sections: Sequence[Section], *, guide: Sequence[str] = ()) -> str:
    """A self-contained HTML page, pictures inside, readable on a phone. The sentences of `guide` say how to read it."""
    parts = [
        f"<h1>{html.escape(title)}</h1>",
        *(_render_block(sentence) for sentence in guide),
        _render_block(Table(summary)) if summary else "",
        _render_contents(sections),
    ]
    for section in sections:
        blocks = "\n".join(map(_render_block, section.blocks))
        parts.append(
            f'<section id="{_make_anchor(section)}"><h2>{html.escape(section.heading)}</h2>\n{blocks}\n</section>'
        )
    parts.append(f"<footer>Measured {date.today():%Y-%m-%d} on {html.escape(describe_machine())}.</footer>")
    return _PAGE.format(title=html.escape(title), colors=read_web_file("colors.css"), body="\n".join(parts))


def _render_block(block: str | Picture | Table) -> str:
    if isinstance(block, Picture):
        return _render_picture(block)
    return _render_table(block.text) if isinstance(block, Table) else f"<p>{html.escape(block)}</p>"


def _render_picture(picture: Picture) -> str:
    encode = lambda data: f"data:image/{picture.kind};base64,{base64.b64encode(data).decode()}"  # noqa: E731
    alt = html.escape(picture.alt)
    width = f' style="--width: {picture.width}px"' if picture.width else ""
    image = f'<img alt="{alt}" src="{encode(picture.data)}"{width}>'
    if picture.dark:
        dark = f'<source media="(prefers-color-scheme: dark)" srcset="{encode(picture.dark)}">'
        image = f"<picture>{dark}{image}</picture>"
    if not picture.width:
        return image
    return f'<label class="wide"><input type="checkbox" aria-label="enlarge: {alt}">{image}</label>'


def _render_table(text: str) -> str:
    """Aligned text as a table; what is around it, or has no line of dashes, as it stands."""
    lines = text.splitlines()
    ruled = next((i for i, line in enumerate(lines) if i and re.fullmatch(r"-+(  -+)*", line)), None)
    if ruled is None:
        return f"<pre>{html.escape(text)}</pre>"
    columns = [slice(*dashes.span()) for dashes in re.finditer("-+", lines[ruled])]
    columns[-1] = slice(columns[-1].start, None)
    end = next((i for i in range(ruled, len(lines)) if not lines[i].strip()), len(lines))
    cells = [[line[column] for column in columns] for line in [lines[ruled - 1], *lines[ruled + 1 : end]]]
    headers = [cell.strip() for cell in cells[0]]
    right = [any(row[i][:1] == " " for row in cells) for i in range(len(columns))]
    long = max(len(cell.strip()) for row in cells[1:] for cell in row) > LONG_CELL if cells[1:] else False
    rows = [_render_row("th", cells[0], headers, right), *(_render_row("td", row, headers, right) for row in cells[1:])]
    table = f'<table class="{"list" if long else "grid"}">{"".join(rows)}</table>'
    around = ["\n".join(part).strip("\n") for part in (lines[: ruled - 1], lines[end:])]
    before, after = (f"<pre>{html.escape(part)}</pre>" if part else "" for part in around)
    return f'{before}<div class="table">{table}</div>{after}'


def _render_row(tag: str, cells: Sequence[str], headers: Sequence[str], right: Sequence[bool]) -> str:
    """A row; each cell bears its header, which a phone shows in front of it."""
    parts = []
    for cell, header, number in zip(cells, headers, right, strict=True):
        # names may be broken after an underscore
        words = html.escape(cell.strip()).replace("_", "_<wbr>")
        kind = ' class="number"' if number else ""
        parts.append(f'<{tag}{kind} data-header="{html.escape(header)}">{words}</{tag}>')
    return f"<tr>{''.join(parts)}</tr>"


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
{colors}body {{ color: var(--ink); background: var(--page); }}
a {{ color: var(--accent); }}
.wide {{ display: block; overflow-x: auto; position: relative; }}
.wide input {{ position: absolute; left: 0; top: 0; opacity: 0; }}
.wide input:focus-visible ~ :is(img, picture img) {{ outline: 2px solid var(--accent); }}
img {{ display: block; max-width: 100%; height: auto; border-radius: 4px; }}
pre {{ overflow-x: auto; background: var(--bar); padding: 1em; font-size: 13px; line-height: 1.4; white-space: pre-wrap; }}
.table {{ overflow-x: auto; }}
table {{ border-collapse: collapse; font-size: 14px; margin: 1em 0; }}
th, td {{ padding: 4px 12px 4px 0; text-align: left; border-bottom: 1px solid var(--line); vertical-align: top; }}
.number {{ text-align: right; font-variant-numeric: tabular-nums; }}
footer {{ color: var(--pale); margin: 3em 0; }}
@media (max-width: 745px) {{
  .wide img {{ cursor: zoom-in; }}
  .wide input:checked ~ :is(img, picture img) {{ max-width: none; width: var(--width); cursor: zoom-out; }}
  table {{ width: 100%; }}
  .wide::after {{ content: "tap to enlarge"; color: var(--pale); font-size: 12px; }}
  .grid {{ font-size: 11px; line-height: 1.3; }}
  .grid th, .grid td {{ padding: 4px 3px 4px 0; }}
  .grid td.number {{ white-space: nowrap; }}
  .list tr:first-child {{ display: none; }}
  .list tr, .list td {{ display: block; border: 0; padding: 0; text-align: left; }}
  .list tr {{ border-bottom: 1px solid var(--line); padding: 6px 0; }}
  .list td::before {{ content: attr(data-header) ": "; color: var(--pale); }}
}}
</style>
{body}
</html>
"""
