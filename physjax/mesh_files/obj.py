"""OBJ files, read strictly: what is not understood in full raises a ValueError, and nothing is guessed.

Read are lines `v x y z` and `f a b c`; normals, texture coordinates, groups and materials are skipped.
"""

import math
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from physjax.mesh_files.common import NUMBER_PATTERN, Polygons, demand_corners, strip_byte_order_mark

_CORNER_PATTERN = re.compile(r"([+-]?\d+)(?:/([+-]?\d+)?(?:/([+-]?\d+)?)?)?", re.ASCII)
_CURVED_STATEMENTS = {"curv", "curv2", "surf", "bzp", "bsp", "cdc", "cdp", "call"}


def read_obj(file: Path, triangulate: bool = False) -> tuple[np.ndarray, Polygons]:
    """Lines `v x y z` and `f a b c`, each a, a/t, a//n or a/t/n, counted from 1 or, if negative, back from the last."""
    vertices: list[list[float]] = []
    faces: list[list[int]] = []
    for number, kind, words in _split_obj_statements(file):
        if kind == "v":
            vertices.append(_parse_obj_vertex(file, number, words))
        elif kind in ("f", "fo"):
            faces.append(_parse_obj_face(file, number, words, len(vertices)))
            demand_corners(f"{file.name}: line {number} has {len(words)} entries", len(words), triangulate)
        elif kind in _CURVED_STATEMENTS or kind in ("V", "F"):
            raise ValueError(
                f"{file.name}: line {number} begins with {kind!r}, expected vertices (v) and flat faces (f)."
            )
    if not vertices or not faces:
        raise ValueError(f"{file.name}: found {len(vertices)} vertices and {len(faces)} faces, expected a mesh.")
    return np.array(vertices), faces


def _split_obj_statements(file: Path) -> Iterator[tuple[int, str, list[str]]]:
    """Every statement: the number of its first line, its first word, the others. A backslash continues it on the next line."""
    content = strip_byte_order_mark(file.read_bytes())
    if b"\0" in content:
        raise ValueError(f"{file.name}: holds zero bytes, expected text: UTF-8, or UTF-16 with its byte order mark.")
    begun, first = "", 0
    lines = re.split(r"\r\n|\r|\n", content.decode("utf-8", errors="replace"))
    for number, line in enumerate(lines, 1):
        first = first if begun else number
        statement, comment, _ = line.partition("#")
        if not comment and statement.rstrip().endswith("\\") and number < len(lines):
            begun += statement.rstrip()[:-1] + " "
            continue
        kind, *words = (begun + statement).split() or [""]
        begun = ""
        yield first, kind, words


def _parse_obj_vertex(file: Path, number: int, words: list[str]) -> list[float]:
    """The coordinates of a vertex; a weight or a colour behind them is skipped."""
    if not all(map(NUMBER_PATTERN.fullmatch, words)):
        raise ValueError(f"{file.name}: line {number} is not a mesh's: 'v {' '.join(words)[:60]}', expected numbers.")
    if len(words) not in (3, 4, 6, 7):
        raise ValueError(
            f"{file.name}: line {number} has {len(words)} entries: a vertex needs 3 numbers, and may have a weight and a colour."
        )
    place = [float(word) for word in words[:3]]
    if not all(map(math.isfinite, place)):
        raise ValueError(f"{file.name}: line {number} has the vertex {place}, expected finite numbers.")
    return place


def _parse_obj_face(file: Path, number: int, words: list[str], known: int) -> list[int]:
    """The corners of a face, from 0 on, after `known` vertices."""
    matched = [match for word in words if (match := _CORNER_PATTERN.fullmatch(word))]
    if len(matched) < len(words):
        raise ValueError(
            f"{file.name}: line {number} is not a mesh's: 'f {' '.join(words)[:60]}', expected corners a, a/t, a//n or a/t/n."
        )
    if any(int(index) == 0 for match in matched for index in match.groups() if index is not None):
        raise ValueError(
            f"{file.name}: line {number} has the index 0: 'f {' '.join(words)[:60]}', expected vertices counted from 1, or back "
            "from -1."
        )
    corners = [int(match[1]) for match in matched]
    if min(corners, default=0) < -known:
        raise ValueError(
            f"{file.name}: line {number} has the index {min(corners)}, expected at least {-known}, as there are vertices above."
        )
    return [c - 1 if c > 0 else known + c for c in corners]
