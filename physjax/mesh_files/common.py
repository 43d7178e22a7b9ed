"""What files of meshes have in common: polygons, byte order marks, and the spelling of numbers."""

import codecs
import re
from collections.abc import Sequence

import numpy as np

BYTE_ORDER_MARKS = [
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF32_LE, "utf-32"),  # begins as UTF-16's does
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
]
NUMBER_PATTERN = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf(inity)?)", re.ASCII | re.IGNORECASE)

Polygons = Sequence[Sequence[int]] | Sequence[np.ndarray] | np.ndarray
"""The corners of each face, as numbers of vertices from 0 on."""


def demand_corners(where: str, count: int, triangulate: bool) -> None:
    """Raise a ValueError for a face that is not a triangle, unless it can be cut into triangles and should be."""
    if count < 3 or (count > 3 and not triangulate):
        way = ", or read it with triangulate=True" if count > 3 else ""
        raise ValueError(f"{where}: faces must be triangles. Triangulate the mesh first{way}.")


def strip_byte_order_mark(content: bytes) -> bytes:
    """The content as UTF-8 without the byte order mark that some editors write at the start of a text."""
    for mark, encoding in BYTE_ORDER_MARKS:
        if content.startswith(mark):
            return content[len(mark) :] if encoding == "utf-8" else content.decode(encoding, errors="replace").encode()
    return content
