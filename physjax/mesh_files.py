"""Plain OBJ and PLY files, read strictly: what is not understood to the last number is refused, and nothing is guessed.

OBJ: lines `v x y z` and `f a b c`. PLY 1.0, as text or binary of either order: elements `vertex` with x, y, z and `face`
with one list of vertices; whatever else there is, normals, colours, texture coordinates, other elements, is passed over.
"""

import codecs
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

_PLY_DTYPES = {
    **{name: "i1" for name in ("char", "int8")},
    **{name: "u1" for name in ("uchar", "uint8")},
    **{name: "i2" for name in ("short", "int16")},
    **{name: "u2" for name in ("ushort", "uint16")},
    **{name: "i4" for name in ("int", "int32")},
    **{name: "u4" for name in ("uint", "uint32")},
    **{name: "f4" for name in ("float", "float32")},
    **{name: "f8" for name in ("double", "float64")},
}
_PLY_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_BYTE_ORDER_MARKS = [
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF32_LE, "utf-32"),  # begins as UTF-16's does
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
]
_NUMBER_PATTERN = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf(inity)?)", re.ASCII | re.IGNORECASE)
_CORNER_PATTERN = re.compile(r"([+-]?\d+)(?:/([+-]?\d+)?(?:/([+-]?\d+)?)?)?", re.ASCII)
_CURVED_STATEMENTS = {"curv", "curv2", "surf", "bzp", "bsp", "cdc", "cdp", "call"}

Polygons = list[Sequence[int]]


def demand_corners(where: str, count: int, triangulate: bool) -> None:
    """Raise a ValueError for a face that is no triangle and cannot be cut into some, or is not to be."""
    if count < 3 or (count > 3 and not triangulate):
        way = ", or read it with triangulate=True" if count > 3 else ""
        raise ValueError(f"{where}: faces must be triangles. Triangulate the mesh first{way}.")


def read_obj(file: Path, triangulate: bool = False) -> tuple[np.ndarray, Polygons]:
    """Lines `v x y z` and `f a b c`, each a, a/t, a//n or a/t/n, counted from 1 or, if negative, back from the last."""
    vertices: list[list[float]] = []
    faces: Polygons = []
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


def _split_obj_statements(file: Path) -> Any:
    """Every statement with the number of its first line, its first word and the others; one may go on after a backslash."""
    content = _strip_byte_order_mark(file.read_bytes())
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
    if not all(map(_NUMBER_PATTERN.fullmatch, words)):
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
    """The corners of a face after so many vertices, counted from 0."""
    matched = [_CORNER_PATTERN.fullmatch(word) for word in words]
    if not all(matched):
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


class _Property(NamedTuple):
    """A column of a PLY element: its name, NumPy's kind, and for lists the kind of their length."""

    name: str
    kind: str
    length: str | None


def read_ply(file: Path, triangulate: bool = False) -> tuple[np.ndarray, Polygons]:
    """Elements `vertex` (with x, y, z) and `face` (with a list of indices), as text or binary of either order."""
    order, elements, body = _parse_ply_header(file.name, _strip_byte_order_mark(file.read_bytes()))
    read = _TextReader(file.name, body) if order == "" else _BinaryReader(file.name, body, order)
    found = {element: _read_ply_element(read, element, count, columns) for element, count, columns in elements}
    read.demand_end()
    if not {"vertex", "face"} <= set(found):
        raise ValueError(f"{file.name}: has the elements {sorted(found)}, expected vertex and face.")
    kinds = {column.name: column for element, _, columns in elements if element == "vertex" for column in columns}
    if any(axis not in kinds or kinds[axis].length for axis in "xyz"):
        raise ValueError(
            f"{file.name}: has vertices with {', '.join(kinds) or 'nothing'}, expected x, y and z, a number each."
        )
    polygons = _find_ply_corners(file.name, elements, found["face"])
    for i, polygon in enumerate(polygons):
        demand_corners(f"{file.name}: face {i} has {len(polygon)} corners", len(polygon), triangulate)
    return np.stack([found["vertex"][axis] for axis in "xyz"], axis=-1), polygons


def _find_ply_corners(name: str, elements: list, faces: dict[str, Any]) -> Polygons:
    """The list of vertices among the properties of a face: by its name, or as the only list of whole numbers."""
    columns = next(columns for element, _, columns in elements if element == "face")
    lists = [c.name for c in columns if c.length and c.kind[0] in "iu"]
    named = [title for title in lists if title in ("vertex_indices", "vertex_index")] or lists
    if len(named) != 1:
        raise ValueError(
            f"{name}: has faces with {', '.join(c.name for c in columns) or 'nothing'}, expected one list of whole numbers, "
            "vertex_indices."
        )
    if not len(faces[named[0]]):
        raise ValueError(f"{name}: has no faces, expected a mesh: a cloud of points has no edges.")
    return faces[named[0]]


def _parse_ply_header(name: str, content: bytes) -> tuple[str, list, bytes]:
    """The byte order, for each element its name, count and columns, and what comes after the header."""
    begin = re.match(rb"ply[ \t]*(\r\n|\n|\r)", content)
    end = begin and re.search(begin[1] + rb"end_header[ \t]*(?:" + begin[1] + rb"|$)", content)
    if not end:
        raise ValueError(f"{name}: is not a PLY file, or its header is truncated.")
    order, elements = None, []
    for line in content[begin.end() : end.start()].decode("utf-8", errors="replace").split(begin[1].decode()):
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                good = True
            case ["format", kind, "1.0"] if kind in _PLY_BYTE_ORDERS and order is None:
                order, good = _PLY_BYTE_ORDERS[kind], True
            case ["element", title, count] if re.fullmatch(r"\d+", count, re.ASCII):
                good = title not in [element for element, *_ in elements]
                elements.append((title, int(count), []))
            case ["property", "list", length, kind, title] if elements and {length, kind} <= _PLY_DTYPES.keys():
                good = _PLY_DTYPES[length][0] != "f" and title not in [column.name for column in elements[-1][2]]
                elements[-1][2].append(_Property(title, _PLY_DTYPES[kind], _PLY_DTYPES[length]))
            case ["property", kind, title] if elements and kind in _PLY_DTYPES:
                good = title not in [column.name for column in elements[-1][2]]
                elements[-1][2].append(_Property(title, _PLY_DTYPES[kind], None))
            case _:
                good = False
        if not good:
            raise ValueError(f"{name}: does not understand the header line {line.strip()!r}.")
    if order is None:
        raise ValueError(f"{name}: the header does not say its format.")
    return order, elements, content[end.end() :]


def _read_ply_element(read: Any, element: str, count: int, columns: list[_Property]) -> dict[str, Any]:
    """The columns of an element by name, arrays `(count, ...)`; lists of several lengths as a list of arrays."""
    if not count or not columns:
        return {column.name: np.zeros((0, 0) if column.length else 0) for column in columns}
    lengths = read.lengths(element, columns)
    table = read.table(element, count, columns, lengths)
    if table is not None:
        return table
    rows = [read.row(element, columns) for _ in range(count)]
    return {
        column.name: [row[i] for row in rows] if column.length else np.array([row[i] for row in rows])
        for i, column in enumerate(columns)
    }


class _BinaryReader:
    """Rows of a PLY element from bytes."""

    def __init__(self, name: str, body: bytes, order: str):
        self.name, self.body, self.order, self.at = name, body, order, 0

    def lengths(self, element: str, columns: list[_Property]) -> list[int]:
        """How long the lists of the next row are, one for each column."""
        before = self.at
        lengths = [
            len(value) if column.length else 0
            for column, value in zip(columns, self.row(element, columns), strict=True)
        ]
        self.at = before
        return lengths

    def table(self, element: str, count: int, columns: list[_Property], lengths: list[int]) -> dict[str, Any] | None:
        """All rows at once, if all their lists are as long as those of the first; None where they are not."""
        fields: list[tuple] = []
        for column, length in zip(columns, lengths, strict=True):
            fields += [(f"#{column.name}", self.order + column.length)] if column.length else []
            fields.append((column.name, self.order + column.kind, (length,) if column.length else ()))
        row = np.dtype(fields)
        if len(self.body) - self.at < count * row.itemsize:
            return None
        rows = np.frombuffer(self.body, row, count, self.at)
        if any((rows[f"#{c.name}"] != n).any() for c, n in zip(columns, lengths, strict=True) if c.length):
            return None
        self.at += count * row.itemsize
        return {column.name: rows[column.name] for column in columns}

    def row(self, element: str, columns: list[_Property]) -> list[Any]:
        """The next row: a number or an array for each column."""
        found = []
        for column in columns:
            length = 1 if column.length is None else int(self._read_numbers(element, column.length, 1)[0])
            values = self._read_numbers(element, column.kind, length)
            found.append(values if column.length else values[0])
        return found

    def demand_end(self) -> None:
        """Raise a ValueError where there is more than the header says."""
        if rest := len(self.body[self.at :].strip(b"\0\r\n\t ")):
            raise ValueError(f"{self.name}: holds {rest} bytes more than its header says: its counts are wrong.")

    def _read_numbers(self, element: str, kind: str, count: int) -> np.ndarray:
        size = np.dtype(kind).itemsize
        if count < 0 or len(self.body) - self.at < count * size:
            raise ValueError(f"{self.name}: is truncated: the element {element!r} does not fit.")
        self.at += count * size
        return np.frombuffer(self.body, self.order + kind, count, self.at - count * size)


class _TextReader(_BinaryReader):
    """Rows of a PLY element from words."""

    def __init__(self, name: str, body: bytes):
        super().__init__(name, body, "")
        self.words = body.decode("utf-8", errors="replace").split()

    def table(self, element: str, count: int, columns: list[_Property], lengths: list[int]) -> dict[str, Any] | None:
        """All rows at once, if all their lists are as long as those of the first; None where they are not."""
        widths = [1 + n if column.length else 1 for column, n in zip(columns, lengths, strict=True)]
        width, table, at = sum(widths), {}, 0
        if len(self.words) - self.at < count * width:
            return None
        words = np.array(self.words[self.at : self.at + count * width]).reshape(count, width)
        for column, wide, length in zip(columns, widths, lengths, strict=True):
            if column.length and (words[:, at] != str(length)).any():
                return None
            part = words[:, at + wide - length : at + wide] if column.length else words[:, at]
            table[column.name] = self._convert(element, column.kind, part.ravel()).reshape(part.shape)
            at += wide
        self.at += count * width
        return table

    def demand_end(self) -> None:
        """Raise a ValueError where there is more than the header says."""
        if rest := len(self.words) - self.at:
            raise ValueError(f"{self.name}: holds {rest} numbers more than its header says: its counts are wrong.")

    def _read_numbers(self, element: str, kind: str, count: int) -> np.ndarray:
        if count < 0 or len(self.words) - self.at < count:
            raise ValueError(f"{self.name}: is truncated: the element {element!r} does not fit.")
        self.at += count
        return self._convert(element, kind, self.words[self.at - count : self.at])

    def _convert(self, element: str, kind: str, words: Sequence[str]) -> np.ndarray:
        """Words as numbers; whole ones must be whole, and fit."""
        bad = next((word for word in words if not _NUMBER_PATTERN.fullmatch(word)), None)
        if bad is not None:
            raise ValueError(f"{self.name}: holds {str(bad)!r}, which is not a number, in the element {element!r}.")
        numbers = np.array(words, float)
        if kind[0] == "f":
            return numbers
        bounds = np.iinfo(kind)
        bad = ~((numbers == np.round(numbers)) & (numbers >= bounds.min) & (numbers <= bounds.max))
        if bad.any():
            raise ValueError(
                f"{self.name}: holds {words[int(np.argmax(bad))]} in the element {element!r}, expected whole numbers from "
                f"{bounds.min} to {bounds.max}."
            )
        return numbers.astype(np.int64)


def _strip_byte_order_mark(content: bytes) -> bytes:
    """The content without the mark that some editors begin a text with; other encodings that have one as UTF-8."""
    for mark, encoding in _BYTE_ORDER_MARKS:
        if content.startswith(mark):
            return content[len(mark) :] if encoding == "utf-8" else content.decode(encoding, errors="replace").encode()
    return content
