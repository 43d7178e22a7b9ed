"""A glTF 2.0 file in one piece (.glb): arrays in one binary chunk, and the JSON that describes them.

Metres, seconds and y up; quaternions are (x, y, z, w). Source: the Khronos glTF 2.0 specification.
"""

import json
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

Json = dict[str, Any]
"""A JSON object."""
POINTS, LINES, TRIANGLES = 0, 1, 4
"""What a primitive is made of, as glTF numbers it."""
_FLOAT, _UINT = 5126, 5125
"""Component types, as glTF numbers them."""
_VERTICES, _INDICES = 34962, 34963
"""Targets of a buffer view, as glTF numbers them."""
_UPRIGHT_ROTATIONS = {0: [0.0, 0.0, 0.5**0.5, 0.5**0.5], 2: [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]}
"""The turn by a right angle that brings x, about z, or z, about x, to y."""
_ACCESSOR_TYPES = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4"}
"""What glTF calls the entries of an array, by their shape."""


class Document:
    """A scene under construction: add meshes, nodes and channels, then take its `.bytes()`.

    Its own axis `up` becomes the file's y by a turn about a level axis, as a node that holds all others.
    """

    def __init__(self, up: int = 1) -> None:
        self._up = up
        self._json: Json = {
            "asset": {"version": "2.0", "generator": "physjax"},
            "scene": 0,
            "scenes": [{"nodes": []}],
        }
        self._chunks: list[bytes] = []
        self._channels: list[Json] = []
        self._samplers: list[Json] = []

    def accessor(self, array: np.ndarray, target: int | None = None) -> int:
        """Add an array of numbers, vectors or quaternions as float32, whole numbers as uint32; returns its index."""
        array = np.asarray(array)
        whole = np.issubdtype(array.dtype, np.integer)
        array = np.ascontiguousarray(array, "<u4" if whole else "<f4")
        rows = array.reshape(len(array), -1)
        span = {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        view = {"buffer": 0, "byteOffset": sum(map(len, self._chunks)), "byteLength": array.nbytes}
        self._chunks.append(array.tobytes())
        entry = {
            "componentType": _UINT if whole else _FLOAT,
            "count": len(array),
            "type": _ACCESSOR_TYPES[array.shape[1:]],
        }
        where = self._append("bufferViews", view if target is None else view | {"target": target})
        return self._append("accessors", {"bufferView": where} | entry | span)

    def vertices(self, array: np.ndarray) -> int:
        """Add an array with a row for each vertex; returns its index."""
        return self.accessor(array, _VERTICES)

    def indices(self, array: np.ndarray) -> int:
        """Add the numbers of the vertices that make triangles or lines; returns the index of the array."""
        return self.accessor(np.asarray(array).ravel(), _INDICES)

    def material(self, color: Sequence[float]) -> int:
        """Add a dull material that is seen from both sides, of an sRGB colour (glTF's own are linear); returns its index."""
        rgb = np.asarray(color, float)
        linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
        look = {"baseColorFactor": [*linear.tolist(), 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.8}
        return self._append("materials", {"pbrMetallicRoughness": look, "doubleSided": True})

    def mesh(self, primitive: Json, **more: object) -> int:
        """Add a mesh of one primitive; returns its index."""
        return self._append("meshes", {"primitives": [primitive]} | more)

    def node(self, **what: object) -> int:
        """Add a node to the scene; returns its index."""
        node = self._append("nodes", what)
        self._json["scenes"][0]["nodes"].append(node)
        return node

    def animate(self, node: int, path: str, times: int, values: int) -> None:
        """Animate the translation, rotation or weights of a node through values at times, linear in between."""
        self._samplers.append({"input": times, "output": values, "interpolation": "LINEAR"})
        target = {"node": node, "path": path}
        self._channels.append({"sampler": len(self._samplers) - 1, "target": target})

    def bytes(self) -> bytes:
        """The file: a header, the JSON padded with blanks, and the arrays."""
        binary = b"".join(self._chunks)
        content = self._json | {"buffers": [{"byteLength": len(binary)}]}
        if self._up in _UPRIGHT_ROTATIONS and "nodes" in self._json:
            children, nodes = self._json["scenes"][0]["nodes"], self._json["nodes"]
            content["nodes"] = [
                *nodes,
                {"name": "upright", "children": children, "rotation": _UPRIGHT_ROTATIONS[self._up]},
            ]
            content["scenes"] = [{"nodes": [len(nodes)]}]
        if self._channels:
            content["animations"] = [{"name": "run", "channels": self._channels, "samplers": self._samplers}]
        text = json.dumps(content, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)  # chunks begin at multiples of four bytes
        size = 12 + 8 + len(text) + 8 + len(binary)
        header = struct.pack("<4sII", b"glTF", 2, size)
        return (
            header
            + struct.pack("<I4s", len(text), b"JSON")
            + text
            + struct.pack("<I4s", len(binary), b"BIN\0")
            + binary
        )

    def _append(self, kind: str, entry: Json) -> int:
        entries = self._json.setdefault(kind, [])
        entries.append(entry)
        return len(entries) - 1
