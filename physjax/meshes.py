"""Triangle meshes from files, checked, and welded where faces do not share the vertices in which they meet."""

import os
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from physjax.mesh_files import Polygons, read_obj, read_ply

_READERS = {".obj": read_obj, ".ply": read_ply}
_TRIMESH_SUFFIXES = (".stl", ".glb", ".gltf")
"""Endings of files that trimesh reads, where it is installed."""
WELD_DISTANCE_SHARE = 1e-6
"""Vertices that are nearer than this, relative to the size of a mesh, are one, unless an edge is as short."""


def read_mesh(path: str | os.PathLike, *, triangulate: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Vertices `(n, 3)` and triangles `(m, 3)` of an .obj or .ply file; with trimesh also .stl, .glb and .gltf.

    With `triangulate` faces of more corners are cut into triangles, fans around their first corner that sees all the others,
    and refused where there is none; without it all of them are refused.
    What trimesh reads is welded, since STL never and GLB seldom shares vertices. Raises FileNotFoundError, ImportError
    without trimesh, or ValueError for a file that is truncated, not a mesh, or not understood in full.
    """
    file = Path(path)
    ending = file.suffix.lower()
    if ending not in _READERS and ending not in _TRIMESH_SUFFIXES:
        raise ValueError(
            f"mesh: got {file.name}, expected a file that ends in {' or '.join(_READERS)}, or with trimesh {', '.join(_TRIMESH_SUFFIXES)}."
        )
    if not file.is_file():
        raise FileNotFoundError(f"mesh: there is no file {file}.")
    if ending in _TRIMESH_SUFFIXES:
        welded = weld(*check_mesh(*_read_with_trimesh(file), file.name))
        return welded.vertices, welded.faces
    vertices, polygons = _READERS[ending](file, triangulate)
    return check_mesh(vertices, _triangulate(file.name, vertices, polygons), file.name)


def check_mesh(vertices: Any, faces: Any, name: str = "mesh") -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles as arrays, or a ValueError that says what is wrong with them."""
    vertices, faces = np.asarray(vertices), np.asarray(faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or vertices.dtype.kind not in "iuf":
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


class WeldedMesh(NamedTuple):
    """Vertices and triangles without vertices that stand in one place; `index[i]` is the vertex that i has become.

    `flat` triangles had two corners in one place and are left out.
    """

    vertices: np.ndarray
    faces: np.ndarray
    index: np.ndarray
    flat: int


def weld(vertices: Any, faces: Any, tolerance: float | None = None) -> WeldedMesh:
    """One vertex instead of several that are nearer than `tolerance` [m]; the first of them stays, in its order.

    Unless told, that is a millionth of the mesh's size, or a tenth of its shortest edge where that is less.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    vertices, faces = check_mesh(vertices, faces)
    count = len(vertices)
    if tolerance is None:
        edges = np.sqrt(((vertices[faces] - vertices[np.roll(faces, 1, axis=1)]) ** 2).sum(axis=-1))
        size = np.sqrt((np.ptp(vertices, axis=0) ** 2).sum())
        tolerance = min(
            WELD_DISTANCE_SHARE * size, edges[edges > WELD_DISTANCE_SHARE**2 * size].min(initial=np.inf) / 10
        )
    pairs = KDTree(vertices).query_pairs(tolerance, output_type="ndarray")
    _, group = connected_components(coo_array((np.ones(len(pairs)), pairs.T), (count, count)), directed=False)
    _, first, group = np.unique(group, return_index=True, return_inverse=True)
    place = np.empty_like(first)
    place[np.argsort(first)] = np.arange(len(first))
    index = place[group.reshape(-1)]
    joined = index[faces]
    flat = (joined == np.roll(joined, 1, axis=1)).any(axis=1)
    return WeldedMesh(vertices[np.sort(first)], joined[~flat], index, int(flat.sum()))


def find_near_pieces(vertices: np.ndarray, faces: np.ndarray) -> tuple[int, float]:
    """How many pieces, which share no vertex, come within a tenth of the shortest edge of another, and how near [m].

    (0, inf) where none do. Such a mesh is most often one whose vertices were rounded differently from face to face.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    ends = np.stack([faces.ravel(), np.roll(faces, 1, axis=1).ravel()])
    _, piece = connected_components(coo_array((np.ones(ends.shape[1]), ends), (len(vertices),) * 2), directed=False)
    if not piece[faces].any():
        return 0, np.inf
    edges = np.sqrt(((vertices[ends[0]] - vertices[ends[1]]) ** 2).sum(axis=-1))
    pairs = KDTree(vertices).query_pairs(edges.min() / 10, output_type="ndarray")
    pairs = pairs[piece[pairs[:, 0]] != piece[pairs[:, 1]]]
    if not len(pairs):
        return 0, np.inf
    apart = np.sqrt(((vertices[pairs[:, 0]] - vertices[pairs[:, 1]]) ** 2).sum(axis=-1))
    return len(np.unique(piece[pairs])), float(apart.max())


def _triangulate(name: str, vertices: np.ndarray, polygons: Polygons) -> np.ndarray:
    """Faces as triangles: those of more corners as fans around their first corner that sees all the others."""
    if all(len(polygon) == 3 for polygon in polygons):
        return np.array(polygons, np.int64)
    lengths, fans = np.array([len(polygon) for polygon in polygons]), list(polygons)
    for length in np.unique(lengths[lengths > 3]):
        which = np.flatnonzero(lengths == length)
        corners = np.array([polygons[i] for i in which], np.int64)
        known = ((corners >= 0) & (corners < len(vertices))).all(
            axis=1
        )  # others are refused with triangles of their kind
        begun = _find_fan_starts(vertices[corners[known]])
        if (begun < 0).any():
            first = which[known][int(np.argmax(begun < 0))]
            raise ValueError(
                f"{name}: face {first} has no corner that sees all its others, expected a fan. Triangulate the mesh first."
            )
        for i, polygon, start in zip(which[known], corners[known], begun, strict=True):
            fans[i] = np.roll(polygon, -start)
    return np.array([(p[0], p[i], p[i + 1]) for p in fans for i in range(1, len(p) - 1)], np.int64)


def _find_fan_starts(places: np.ndarray) -> np.ndarray:
    """The first corner of each polygon `(polygons, corners, 3)` whose fan has no triangle turned over; -1 without one."""
    away = places - places[:, :1]
    normal = np.cross(away, np.roll(away, -1, axis=1)).sum(axis=1)
    least = -1e-6 * (normal**2).sum(axis=1)  # of four corners in a line, by rounding
    starts = np.full(len(places), -1)
    for start in reversed(range(places.shape[1])):
        away = np.roll(places, -start, axis=1)[:, 1:] - places[:, start, None]
        along = (np.cross(away[:, :-1], away[:, 1:]) * normal[:, None]).sum(axis=-1)
        starts[(along >= least[:, None]).all(axis=1)] = start
    return starts


def _read_with_trimesh(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of all parts of a file, each where it stands."""
    try:
        import trimesh
    except ImportError as error:
        raise ImportError(f"mesh: {file.name} needs trimesh: pip install 'physjax[mesh]'.") from error
    if file.suffix.lower() == ".stl":
        _demand_whole_stl(file)
    try:
        mesh = trimesh.load_mesh(file, process=False)
        vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
    except Exception as error:  # of many kinds, none of which is for its callers
        raise ValueError(f"{file.name}: trimesh cannot read it ({type(error).__name__}: {error}).") from error
    if not len(faces):
        raise ValueError(f"{file.name}: found {len(vertices)} vertices and no faces, expected a mesh.")
    return vertices, faces


def _demand_whole_stl(file: Path) -> None:
    """Raise a ValueError for an STL file that is cut short, of which trimesh reads what is left."""
    content = file.read_bytes()
    stated = int.from_bytes(content[80:84], "little")
    if len(content) == 84 + 50 * stated:
        return
    # a solid may have any name
    unnamed = re.sub(rb"(?m)^([ \t]*(?:end)?solid)\b(?!.*\bfacet\s+normal\b).*", rb"\1", content.lower())
    words = re.findall(rb"\b(endfacet|vertex|endsolid|facet|solid)\b", unnamed)
    facets, corners = words.count(b"facet"), words.count(b"vertex")
    if words[:1] != [b"solid"] or words[-1:] != [b"endsolid"] or corners != 3 * facets:
        raise ValueError(
            f"{file.name}: is not an STL file, or truncated: as a binary one it has {len(content)} bytes and says {stated} "
            f"triangles, as text it has {facets} facets with {corners} vertices."
        )
