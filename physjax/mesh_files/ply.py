"""PLY 1.0 files, as text or binary of either byte order, read strictly: nothing is guessed.

Read are the elements `vertex` with x, y, z and `face` with one list of vertices; other properties and elements, such as
normals, colours and texture coordinates, are skipped.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from physjax.mesh_files.common import NUMBER_PATTERN, Polygons, demand_corners, strip_byte_order_mark

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


class _Property(NamedTuple):
    """A column of a PLY element: its name, NumPy's kind, and for lists the kind of their length."""

    name: str
    kind: str
    length: str | None


Element = tuple[str, int, list[_Property]]
"""An element of a PLY file: its name, its count, its columns."""
Columns = dict[str, np.ndarray | list[np.ndarray]]
"""The columns of an element by name."""


def read_ply(file: Path, triangulate: bool = False) -> tuple[np.ndarray, Polygons]:
    """The vertices `(n, 3)` and polygons of a PLY file, or a ValueError."""
    order, elements, body = _parse_ply_header(file.name, strip_byte_order_mark(file.read_bytes()))
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


def _find_ply_corners(name: str, elements: list[Element], faces: Columns) -> Polygons:
    """The property of faces that lists their vertices: by its name, or as the only list of integers."""
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


def _parse_ply_header(name: str, content: bytes) -> tuple[str, list[Element], bytes]:
    """The byte order, for each element its name, count and columns, and what comes after the header."""
    begin = re.match(rb"ply[ \t]*(\r\n|\n|\r)", content)
    end = re.search(begin[1] + rb"end_header[ \t]*(?:" + begin[1] + rb"|$)", content) if begin else None
    if begin is None or end is None:
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


def _read_ply_element(read: "_BinaryReader", element: str, count: int, columns: list[_Property]) -> Columns:
    """The columns of an element by name, arrays `(count, ...)`; lists of unequal lengths as a list of arrays."""
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
    """Reads the rows of PLY elements from bytes, one after the other."""

    def __init__(self, name: str, body: bytes, order: str):
        self.name, self.body, self.order, self.at = name, body, order, 0

    def lengths(self, element: str, columns: list[_Property]) -> list[int]:
        """The lengths of the lists in the next row, one for each column."""
        before = self.at
        lengths = [
            len(value) if column.length else 0
            for column, value in zip(columns, self.row(element, columns), strict=True)
        ]
        self.at = before
        return lengths

    def table(self, element: str, count: int, columns: list[_Property], lengths: list[int]) -> Columns | None:
        """All rows at once, if all their lists are as long as those of the first; else None."""
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

    def row(self, element: str, columns: list[_Property]) -> list[np.ndarray]:
        """The next row: a number or an array for each column."""
        found = []
        for column in columns:
            length = 1 if column.length is None else int(self._read_numbers(element, column.length, 1)[0])
            values = self._read_numbers(element, column.kind, length)
            found.append(values if column.length else values[0])
        return found

    def demand_end(self) -> None:
        """Raise a ValueError if there is more than the header says."""
        if rest := len(self.body[self.at :].strip(b"\0\r\n\t ")):
            raise ValueError(f"{self.name}: holds {rest} bytes more than its header says: its counts are wrong.")

    def _read_numbers(self, element: str, kind: str, count: int) -> np.ndarray:
        size = np.dtype(kind).itemsize
        if count < 0 or len(self.body) - self.at < count * size:
            raise ValueError(f"{self.name}: is truncated: the element {element!r} does not fit.")
        self.at += count * size
        return np.frombuffer(self.body, self.order + kind, count, self.at - count * size)


class _TextReader(_BinaryReader):
    """Reads the rows of PLY elements from words."""

    def __init__(self, name: str, body: bytes):
        super().__init__(name, body, "")
        self.words = body.decode("utf-8", errors="replace").split()

    def table(self, element: str, count: int, columns: list[_Property], lengths: list[int]) -> Columns | None:
        """All rows at once, if all their lists are as long as those of the first; else None."""
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
        """Raise a ValueError if there is more than the header says."""
        if rest := len(self.words) - self.at:
            raise ValueError(f"{self.name}: holds {rest} numbers more than its header says: its counts are wrong.")

    def _read_numbers(self, element: str, kind: str, count: int) -> np.ndarray:
        if count < 0 or len(self.words) - self.at < count:
            raise ValueError(f"{self.name}: is truncated: the element {element!r} does not fit.")
        self.at += count
        return self._convert(element, kind, self.words[self.at - count : self.at])

    def _convert(self, element: str, kind: str, words: Sequence[str] | np.ndarray) -> np.ndarray:
        """Words as numbers; integers must be whole and within the range of their type."""
        bad = next((word for word in words if not NUMBER_PATTERN.fullmatch(word)), None)
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
