"""Triangle meshes from OBJ and PLY files: a small reader that refuses what it does not understand."""

import os
from pathlib import Path
from typing import Any

import numpy as np

_KINDS = {
    **{name: "i1" for name in ("char", "int8")},
    **{name: "u1" for name in ("uchar", "uint8")},
    **{name: "i2" for name in ("short", "int16")},
    **{name: "u2" for name in ("ushort", "uint16")},
    **{name: "i4" for name in ("int", "int32")},
    **{name: "u4" for name in ("uint", "uint32")},
    **{name: "f4" for name in ("float", "float32")},
    **{name: "f8" for name in ("double", "float64")},
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def read_mesh(path: str | os.PathLike) -> tuple[np.ndarray, np.ndarray]:
    """Vertices `(n, 3)` and triangles `(m, 3)` of an .obj or .ply file.

    Raises FileNotFoundError, or ValueError for a file that is truncated, not a mesh, or has faces that are no triangles.
    """
    file = Path(path)
    readers = {".obj": _read_obj, ".ply": _read_ply}
    if file.suffix.lower() not in readers:
        raise ValueError(f"mesh: got {file.name}, expected a file that ends in {' or '.join(readers)}.")
    if not file.is_file():
        raise FileNotFoundError(f"mesh: there is no file {file}.")
    vertices, faces = readers[file.suffix.lower()](file)
    return checked_mesh(vertices, faces, file.name)


def checked_mesh(vertices: Any, faces: Any, name: str = "mesh") -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles as arrays, or a ValueError that says what is wrong with them."""
    vertices, faces = np.asarray(vertices), np.asarray(faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not np.issubdtype(vertices.dtype, np.number):
        raise ValueError(f"{name}: got vertices of shape {vertices.shape}, expected numbers of shape (vertices, 3).")
    if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0 or not np.issubdtype(faces.dtype, np.integer):
        raise ValueError(
            f"{name}: got faces of shape {faces.shape} and dtype {faces.dtype}, expected triangles: integers of shape "
            "(faces, 3). Triangulate the mesh first."
        )
    if not np.isfinite(vertices).all():
        raise ValueError(f"{name}: got vertices that are not finite, first {np.argwhere(~np.isfinite(vertices))[0]}.")
    bad = ((faces < 0) | (faces >= len(vertices))).any(axis=1)
    if bad.any():
        first = int(np.argmax(bad))
        raise ValueError(
            f"{name}: got face {first} with the vertices {faces[first].tolist()}, expected 0 to {len(vertices) - 1}."
        )
    flat = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    if flat.any():
        first = int(np.argmax(flat))
        raise ValueError(f"{name}: got face {first} with a vertex twice, {faces[first].tolist()}, expected triangles.")
    return vertices.astype(float), faces.astype(np.int64)


def _read_obj(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Lines `v x y z` and `f a b c`, each a, a/t, a//n or a/t/n, counted from 1 or, if negative, back from the last."""
    vertices, faces = [], []
    for number, line in enumerate(file.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        kind, *words = line.split("#")[0].split() or [""]
        if kind not in ("v", "f"):
            continue
        try:
            if kind == "v":
                vertices.append([float(word) for word in words[:3]])
            else:
                corners = [int(word.split("/")[0]) for word in words]
                faces.append([c - 1 if c > 0 else len(vertices) + c for c in corners])
        except ValueError as error:
            raise ValueError(f"{file.name}: line {number} is not a mesh's: {line[:60]!r}.") from error
        if len(words) < 3 or (kind == "f" and len(words) != 3):
            wanted = (
                "a vertex needs 3 numbers" if kind == "v" else "faces must be triangles. Triangulate the mesh first"
            )
            raise ValueError(f"{file.name}: line {number} has {len(words)} entries: {wanted}.")
    if not vertices or not faces:
        raise ValueError(f"{file.name}: found {len(vertices)} vertices and {len(faces)} faces, expected a mesh.")
    return np.array(vertices), np.array(faces)


def _read_ply(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Elements `vertex` (with x, y, z) and `face` (a list of 3 indices), as text or binary of either order."""
    content = file.read_bytes()
    head, mark, body = content.partition(b"end_header\n")
    if b"\r" in head:
        head, mark, body = content.partition(b"end_header\r\n")
    lines = head.decode("ascii", errors="replace").split("\n")
    if lines[0].strip() != "ply" or not mark:
        raise ValueError(f"{file.name}: is not a PLY file, or its header is truncated.")
    order, elements = _ply_header(file.name, [line.split() for line in lines[1:] if line.strip()])
    words, found = body.split() if order == "" else body, {}
    for name, count, properties in elements:
        found[name], words = (_text if order == "" else _binary)(file.name, words, name, count, properties, order)
    if not {"vertex", "face"} <= set(found):
        raise ValueError(f"{file.name}: has the elements {sorted(found)}, expected vertex and face.")
    lists = [values for values in found["face"].values() if values.ndim == 2]
    if {"x", "y", "z"} - set(found["vertex"]) or len(lists) != 1:
        raise ValueError(f"{file.name}: expected vertices with x, y and z, and faces with one list of vertices.")
    return np.stack([found["vertex"][axis] for axis in "xyz"], axis=-1), lists[0]


def _ply_header(name: str, lines: list[list[str]]) -> tuple[str, list]:
    """The byte order and, for each element, its name, count and properties (name, kind, kind of its length or None)."""
    order, elements = None, []
    try:
        for line in lines:
            if line[0] == "format":
                order = _ORDERS[line[1]]
            elif line[0] == "element":
                elements.append((line[1], int(line[2]), []))
            elif line[0] == "property" and line[1] == "list":
                elements[-1][2].append((line[4], _KINDS[line[3]], _KINDS[line[2]]))
            elif line[0] == "property":
                elements[-1][2].append((line[2], _KINDS[line[1]], None))
    except (KeyError, IndexError, ValueError) as error:
        raise ValueError(f"{name}: does not understand the header line {' '.join(line)!r}.") from error
    if order is None:
        raise ValueError(f"{name}: the header does not say its format.")
    return order, elements


def _row(name: str, element: str, properties: list, order: str) -> np.dtype:
    """A record of an element whose lists all hold three entries; only faces may have lists."""
    fields = []
    for title, kind, length in properties:
        if length is not None and element != "face":
            raise ValueError(f"{name}: does not understand lists in the element {element!r}.")
        fields += (
            [(title, order + kind)] if length is None else [(f"#{title}", order + length), (title, order + kind, 3)]
        )
    return np.dtype(fields)


def _binary(name, body, element, count, properties, order):
    row = _row(name, element, properties, order)
    if len(body) < count * row.itemsize:
        raise ValueError(f"{name}: is truncated, or its faces are no triangles: {element} {count} does not fit.")
    table = np.frombuffer(body, row, count)
    return _columns(name, element, table), body[count * row.itemsize :]


def _text(name, words, element, count, properties, order):
    row = _row(name, element, properties, "<")
    width = sum(int(np.prod(row[title].shape, dtype=int)) for title in row.names)
    if len(words) < count * width:
        raise ValueError(f"{name}: is truncated, or its faces are no triangles: {element} {count} does not fit.")
    try:
        numbers = np.array(words[: count * width], float).reshape(count, width)
    except ValueError as error:
        raise ValueError(f"{name}: holds something that is not a number in the element {element!r}.") from error
    table, at = np.empty(count, row), 0
    for title in row.names:
        size = int(np.prod(row[title].shape, dtype=int))
        table[title] = numbers[:, at : at + size].reshape((count, *row[title].shape))
        at += size
    return _columns(name, element, table), words[count * width :]


def _columns(name: str, element: str, table: np.ndarray) -> dict[str, np.ndarray]:
    for title in table.dtype.names:
        if title.startswith("#") and (table[title] != 3).any():
            raise ValueError(
                f"{name}: has a {element} with {table[title][table[title] != 3][0]} corners, expected triangles."
            )
    return {title: table[title] for title in table.dtype.names if not title.startswith("#")}
