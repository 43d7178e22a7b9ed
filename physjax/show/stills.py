"""A still picture of a run, for readers whose page runs no scripts, and the page of the run on top of it for the others."""

import base64
import html
import io
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STILL_DPI = 80
"""Resolution of a still [pixels an inch]: half the width of a page, at a few kilobytes."""
STILL_COLOURS = 128
"""Colours of a still: enough for shaded surfaces."""


def encode_still(figure: "Figure") -> bytes:
    """A figure as a PNG of few colours."""
    from PIL import Image

    written = io.BytesIO()
    figure.savefig(written, format="png", dpi=STILL_DPI, bbox_inches="tight")
    still = io.BytesIO()
    picture = Image.open(written).convert("RGB").quantize(STILL_COLOURS, dither=Image.Dither.NONE)
    picture.save(still, "PNG", optimize=True)
    return still.getvalue()


def embed_page(page: str, height: int, still: bytes) -> str:
    """A page inside a notebook, `height` pixels high, on top of its still picture.

    Notebooks that are not trusted, and code hosts, take the page away and leave the picture.
    """
    source, place = f"data:image/png;base64,{base64.b64encode(still).decode()}", "grid-area:1/1;"
    picture = f'<img src="{source}" alt="a still of the run" style="{place}max-width:100%;max-height:{height}px">'
    style = f"{place}width:100%;height:{height}px;border:0"
    frame = f'<iframe srcdoc="{html.escape(page)}" style="{style}" allowfullscreen></iframe>'
    return f'<div style="display:grid">{picture}{frame}</div>'


def bundle_page(page: str, height: int, still: bytes, text: str) -> dict[str, str]:
    """What a notebook is given to show: the page on top of its still, the still alone, and a line of text."""
    return {
        "text/html": embed_page(page, height, still),
        "image/png": base64.b64encode(still).decode(),
        "text/plain": text,
    }
