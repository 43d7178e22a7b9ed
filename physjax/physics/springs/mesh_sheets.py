"""Sheets of springs along the edges of a triangle mesh."""

import os
import warnings

import numpy as np
from jax.typing import ArrayLike

from physjax.checks import NestedArrayLike, as_real_quantity
from physjax.meshes import check_mesh, find_near_pieces, read_mesh
from physjax.meshes import weld as join_vertices
from physjax.physics.springs.assembly import Lattice, build_lattice, vector_lengths
from physjax.tracebacks import shorten_tracebacks


@shorten_tracebacks
def from_mesh(
    mesh: str | os.PathLike[str] | NestedArrayLike,
    faces: NestedArrayLike | None = None,
    *,
    mass: ArrayLike,
    structural: ArrayLike,
    bend: ArrayLike | None = None,
    damping: ArrayLike | None = None,
    breaks_at: ArrayLike | None = None,
    yields_at: ArrayLike | None = None,
    weld: float | None = None,
    triangulate: bool = False,
) -> Lattice:
    """A sheet from `vertices, faces`, or from the path of a file that `meshes.read_mesh` reads (`triangulate` as there).

    Structural springs are the edges of the triangles, bend springs join the vertices opposite each inner edge. The mass of
    a node is proportional to a third of the area of its triangles. Set of nodes: edge (the boundary).

    Triangles are joined by the vertices they share. Vertices closer to each other than `weld` [m] (by default a millionth
    of the size of the mesh; 0: none) become one node, with a warning that says how many. Pieces that share no vertex but
    come within a tenth of the shortest edge are warned of. Raises ValueError where no two triangles share a vertex.

    Example:
        >>> square = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
        >>> net = lattices.from_mesh(square, [[0, 1, 2], [0, 2, 3]], mass=0.6, structural=100.0)
        >>> print(len(net.springs.pairs), net.mass)
        5 [0.2 0.1 0.2 0.1]
    """
    if isinstance(mesh, str | os.PathLike):
        if faces is not None:
            raise TypeError("from_mesh: got a file and faces, expected a file alone, or vertices and faces.")
        x, triangles = read_mesh(mesh, triangulate=triangulate)
    else:
        x, triangles = check_mesh(mesh, faces)
    x, triangles = _weld_mesh(x, triangles, weld)
    edges, opposite, boundary = _find_edges(triangles)
    a, b, c = (x[triangles[:, i]] for i in range(3))
    area = vector_lengths(np.cross(b - a, c - a)) / 2
    share = np.bincount(triangles.ravel(), np.repeat(area, 3), len(x))
    if (share == 0).any():
        raise ValueError(
            f"from_mesh: vertex {int(np.argmin(share))} has no area around it ({(share == 0).sum()} have none), expected "
            "every vertex in a triangle. Remove the others."
        )
    sets = {"edge": np.isin(np.arange(len(x)), boundary)}
    return build_lattice(
        x,
        [(edges, structural), (opposite, bend)],
        damping,
        breaks_at,
        mass,
        share,
        sets,
        triangles,
        yields_at=yields_at,
    )


def _weld_mesh(x: np.ndarray, faces: np.ndarray, tolerance: float | None) -> tuple[np.ndarray, np.ndarray]:
    """The mesh with one node per place; warns of what was joined, and raises a ValueError for unconnected triangles."""
    if tolerance is not None:
        tolerance = float(as_real_quantity("weld [m]", tolerance, at_least=0))
        if tolerance == 0:
            return x, faces
    found = join_vertices(x, faces, tolerance)
    if len(found.vertices) < len(x):
        left_out = f", {found.flat} faces without area were left out" if found.flat else ""
        warnings.warn(
            f"from_mesh: {len(x)} vertices stand in {len(found.vertices)} places and were welded to as many nodes{left_out}; "
            "nodes are renumbered. Weld it first with meshes.weld, or keep the vertices apart with weld=0.",
            stacklevel=3,
        )
    if len(found.faces) == 0:
        raise ValueError(
            f"from_mesh: got weld {tolerance} m, which leaves no triangle. Give a length below those of the edges."
        )
    if len(found.faces) > 1 and np.bincount(found.faces.ravel()).max() == 1:
        raise ValueError(
            f"from_mesh: none of the {len(found.faces)} triangles shares a vertex with another, so that the sheet would fall "
            "apart. Give weld=, a distance [m] within which vertices become one; weld=0 for separate triangles."
        )
    pieces, apart = find_near_pieces(found.vertices, found.faces) if tolerance is None else (0, 0.0)
    if pieces:
        warnings.warn(
            f"from_mesh: {pieces} pieces of the mesh share no vertex though they come within {apart:.3g} m of each other, and no "
            f"spring joins them. Give weld={1.01 * apart:.3g} [m] to join them, weld=0 to keep them separate.",
            stacklevel=3,
        )
    return found.vertices, found.faces


def _find_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges of triangles, pairs of vertices opposite an inner edge that are no edge themselves, vertices on the boundary."""
    # sorted by edge: the two triangles of an inner edge then follow each other
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    corner = np.concatenate([faces[:, 2], faces[:, 0], faces[:, 1]])
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, corner = edges[order], corner[order]
    again = (edges[1:] == edges[:-1]).all(axis=1)
    across = np.unique(np.sort(np.stack([corner[:-1], corner[1:]], axis=1)[again], axis=1), axis=0)
    single = ~np.append(again, False) & ~np.append(False, again)
    unique = np.unique(edges, axis=0)
    known = {tuple(edge) for edge in unique.tolist()}
    new = np.array([tuple(pair) not in known and pair[0] != pair[1] for pair in across.tolist()], bool)
    return unique, across[new], np.unique(edges[single])
