"""Triangle meshes from files, checked, and welded where faces do not share the vertices in which they meet."""

import os
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from physjax.checks import NestedArrayLike
from physjax.mesh_files import Polygons, read_obj, read_ply

_READERS = {".obj": read_obj, ".ply": read_ply}
_TRIMESH_SUFFIXES = (".stl", ".glb", ".gltf")
"""Suffixes of the files that are read by trimesh, where it is installed."""
WELD_DISTANCE_SHARE = 1e-6
"""Vertices closer to each other than this share of the size of a mesh are one [1]: float32 files round to a tenth of it."""
SHORTEST_EDGE_SHARE = WELD_DISTANCE_SHARE**2
"""Edges shorter than this share of the size of a mesh join two copies of a vertex and are no edges [1]."""
NEAR_PIECE_SHARE = 0.1
"""Pieces of a mesh that come closer than this share of its shortest edge were most likely one [1]."""
TURNED_TRIANGLE_SHARE = 1e-6
"""A fan may have triangles turned over by less than this share of its area squared [1]: those of collinear corners."""


def read_mesh(path: str | os.PathLike, *, triangulate: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Vertices `(n, 3)` and triangles `(m, 3)` of an .obj or .ply file; with trimesh also .stl, .glb and .gltf.

    With `triangulate`, faces of more than three corners are cut into triangles: fans around their first corner that sees
    all others. Files that trimesh reads are welded, since STL never and GLB seldom shares vertices between faces. Raises
    FileNotFoundError, ImportError without trimesh, or ValueError for a file that is truncated, not a mesh, not understood
    in full, or with faces that are not triangles and cannot be cut.
    """
    file = Path(path)
    ending = file.suffix.lower()
    if ending not in _READERS and ending not in _TRIMESH_SUFFIXES:
        raise ValueError(
            f"mesh: got {file.name}, expected a file that ends in {' or '.join(_READERS)}, or with trimesh "
            f"{', '.join(_TRIMESH_SUFFIXES)}."
        )
    if not file.is_file():
        raise FileNotFoundError(f"mesh: there is no file {file}.")
    if ending in _TRIMESH_SUFFIXES:
        welded = weld(*check_mesh(*_read_with_trimesh(file), file.name))
        return welded.vertices, welded.faces
    vertices, polygons = _READERS[ending](file, triangulate)
    return check_mesh(vertices, _triangulate(file.name, vertices, polygons), file.name)


def check_mesh(
    vertices: NestedArrayLike, faces: NestedArrayLike | None, name: str = "mesh"
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices `(n, 3)` and triangles `(m, 3)` as arrays, or a ValueError that says what is wrong with them."""
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
    """A mesh without coinciding vertices: `index[i]` is the new number of vertex i.

    `flat` is the number of triangles with two coinciding corners, which are left out.
    """

    vertices: np.ndarray
    faces: np.ndarray
    index: np.ndarray
    flat: int


def weld(vertices: NestedArrayLike, faces: NestedArrayLike, tolerance: float | None = None) -> WeldedMesh:
    """The mesh with vertices joined that are closer to each other than `tolerance` [m]; the first of each group is kept.

    The default is a millionth of the size of the mesh, or a tenth of its shortest edge where that is less.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    x, triangles = check_mesh(vertices, faces)
    count = len(x)
    if tolerance is None:
        edges = np.sqrt(((x[triangles] - x[np.roll(triangles, 1, axis=1)]) ** 2).sum(axis=-1))
        size = np.sqrt((np.ptp(x, axis=0) ** 2).sum())
        tolerance = min(WELD_DISTANCE_SHARE * size, edges[edges > SHORTEST_EDGE_SHARE * size].min(initial=np.inf) / 10)
    pairs = KDTree(x).query_pairs(tolerance, output_type="ndarray")
    _, group = connected_components(coo_array((np.ones(len(pairs)), pairs.T), (count, count)), directed=False)
    # renumbered by first occurrence, so that a mesh without coinciding vertices keeps its order
    _, first, group = np.unique(group, return_index=True, return_inverse=True)
    place = np.empty_like(first)
    place[np.argsort(first)] = np.arange(len(first))
    index = place[group.reshape(-1)]
    joined = index[triangles]
    flat = (joined == np.roll(joined, 1, axis=1)).any(axis=1)
    return WeldedMesh(x[np.sort(first)], joined[~flat], index, int(flat.sum()))


def find_near_pieces(vertices: np.ndarray, faces: np.ndarray) -> tuple[int, float]:
    """The number of pieces that share no vertex but come within a tenth of the shortest edge of another, and how close [m].

    (0, inf) if there are none. In such a mesh vertices were most likely rounded differently from face to face.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    ends = np.stack([faces.ravel(), np.roll(faces, 1, axis=1).ravel()])
    _, piece = connected_components(coo_array((np.ones(ends.shape[1]), ends), (len(vertices),) * 2), directed=False)
    if not piece[faces].any():
        return 0, np.inf
    edges = np.sqrt(((vertices[ends[0]] - vertices[ends[1]]) ** 2).sum(axis=-1))
    pairs = KDTree(vertices).query_pairs(edges.min() * NEAR_PIECE_SHARE, output_type="ndarray")
    pairs = pairs[piece[pairs[:, 0]] != piece[pairs[:, 1]]]
    if not len(pairs):
        return 0, np.inf
    apart = np.sqrt(((vertices[pairs[:, 0]] - vertices[pairs[:, 1]]) ** 2).sum(axis=-1))
    return len(np.unique(piece[pairs])), float(apart.max())


def _triangulate(name: str, vertices: np.ndarray, polygons: Polygons) -> np.ndarray:
    """Faces as triangles: those with more corners as fans around their first corner that sees all others."""
    if all(len(polygon) == 3 for polygon in polygons):
        return np.array(polygons, np.int64)
    lengths, fans = np.array([len(polygon) for polygon in polygons]), list(polygons)
    for length in np.unique(lengths[lengths > 3]):
        which = np.flatnonzero(lengths == length)
        corners = np.array([polygons[int(i)] for i in which], np.int64)
        # indices out of range are refused later, by the check that triangles go through
        known = ((corners >= 0) & (corners < len(vertices))).all(axis=1)
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
    """The first corner of each polygon `(polygons, corners, 3)` whose fan has no triangle turned over; -1 if there is none."""
    away = places - places[:, :1]
    normal = np.cross(away, np.roll(away, -1, axis=1)).sum(axis=1)
    least = -TURNED_TRIANGLE_SHARE * (normal**2).sum(axis=1)
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
    except Exception as error:  # trimesh raises many kinds; callers get one
        raise ValueError(f"{file.name}: trimesh cannot read it ({type(error).__name__}: {error}).") from error
    if not len(faces):
        raise ValueError(f"{file.name}: found {len(vertices)} vertices and no faces, expected a mesh.")
    return vertices, faces


def _demand_whole_stl(file: Path) -> None:
    """Raise a ValueError for a truncated STL file, which trimesh would read without complaint."""
    content = file.read_bytes()
    stated = int.from_bytes(content[80:84], "little")
    if len(content) == 84 + 50 * stated:
        return
    # a solid may have any name, also one that contains keywords
    unnamed = re.sub(rb"(?m)^([ \t]*(?:end)?solid)\b(?!.*\bfacet\s+normal\b).*", rb"\1", content.lower())
    words = re.findall(rb"\b(endfacet|vertex|endsolid|facet|solid)\b", unnamed)
    facets, corners = words.count(b"facet"), words.count(b"vertex")
    if words[:1] != [b"solid"] or words[-1:] != [b"endsolid"] or corners != 3 * facets:
        raise ValueError(
            f"{file.name}: is not an STL file, or truncated: as a binary one it has {len(content)} bytes and says {stated} "
            f"triangles, as text it has {facets} facets with {corners} vertices."
        )


__all__ = ["WeldedMesh", "check_mesh", "find_near_pieces", "read_mesh", "weld"]
