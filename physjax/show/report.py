"""Results as text: tidy tables for a terminal, and one self-contained HTML page."""

import base64
import html
import platform
from collections.abc import Sequence
from datetime import date
from importlib.metadata import version

import jax


def table(headers: Sequence[str], rows: Sequence[Sequence[str]], *, align: str | None = None) -> str:
    """Columns aligned by `align`, a `<` or `>` for each; the first to the left and the others to the right by default."""
    align = align or "<" + ">" * (len(headers) - 1)
    widths = [max(len(str(row[i])) for row in (headers, *rows)) for i in range(len(headers))]

    def line(cells):
        return "  ".join(
            f"{cell!s:{side}{width}}" for cell, side, width in zip(cells, align, widths, strict=True)
        ).rstrip()

    return "\n".join([line(headers), "  ".join("-" * width for width in widths), *map(line, rows)])


def seconds_text(seconds: int | float) -> str:
    """A time with a unit that keeps it readable, from µs to days."""
    for unit, size in (("d", 86400.0), ("s", 1.0), ("ms", 1e-3)):
        if float(f"{seconds / size:.3g}") >= 1:  # as it is printed
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 1e-6:.3g} µs"


def machine() -> str:
    """One line about where numbers were measured: device, processor, versions."""
    device = jax.devices()[0]
    versions = ", ".join(f"{name} {version(name)}" for name in ("jax", "diffrax", "numpy"))
    chip = platform.machine() if device.platform == "cpu" else device.device_kind
    return f"{device.platform.upper()} ({chip}), {platform.system()}, Python {platform.python_version()}, {versions}"


class Section:
    """A part of a page: a heading, a sentence, a picture and a table."""

    def __init__(self, heading: str, sentence: str, png: bytes, text: str):
        self.heading, self.sentence, self.png, self.text = heading, sentence, png, text


def page(title: str, summary: str, sections: Sequence[Section]) -> str:
    """A self-contained HTML page, pictures inside, readable on a phone."""
    parts = [f"<h1>{html.escape(title)}</h1>", f"<pre>{html.escape(summary)}</pre>", _contents(sections)]
    for section in sections:
        picture = base64.b64encode(section.png).decode()
        parts.append(
            f'<section id="{html.escape(section.heading)}"><h2>{html.escape(section.heading)}</h2>'
            f"<p>{html.escape(section.sentence)}</p>"
            f'<img alt="charts of {html.escape(section.heading)}" src="data:image/png;base64,{picture}">'
            f"<pre>{html.escape(section.text)}</pre></section>"
        )
    parts.append(f"<footer>Measured {date.today():%Y-%m-%d} on {html.escape(machine())}.</footer>")
    return _PAGE.format(title=html.escape(title), body="\n".join(parts))


def _contents(sections: Sequence[Section]) -> str:
    links = (f'<a href="#{html.escape(s.heading)}">{html.escape(s.heading)}</a>' for s in sections)
    return f"<nav>{' · '.join(links)}</nav>"


_PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 1100px; margin: 2em auto; padding: 0 1em; color: #222; }}
img {{ width: 100%; height: auto; }}
pre {{ overflow-x: auto; background: #f6f6f6; padding: 1em; font-size: 13px; line-height: 1.4; }}
footer {{ color: #666; margin: 3em 0; }}
</style>
{body}
</html>
"""
