"""Nodes and springs in good order: rope, cloth, jelly, bridge, and whatever a mesh describes.

Each returns a `Lattice` at rest. Stiffness [N/m] and damping [kg/s] are those of a single spring; springs whose
stiffness is None are absent. `mass` [kg] is that of the whole, and each node has its share of length, area or volume.
"""

import os
import warnings
from collections.abc import Iterable, Sequence
from itertools import product
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from physjax.checks import positive_integer, real_quantity
from physjax.physics.aerodynamics import Cells, Triangles, Wind
from physjax.physics.meshes import checked_mesh, near_pieces, read_mesh
from physjax.physics.meshes import weld as join_vertices
from physjax.physics.springs import Springs
from physjax.scene import Particles


class Lattice(NamedTuple):
    """Nodes at rest, the mass of each [kg], the springs between them, named sets of nodes, and faces for drawing.

    `nodes` are boolean masks by name; `faces` `(faces, 3)` are triangles of nodes. `shape` is that of a lattice, such
    as (rows, columns); None for a mesh.

    Example:
        >>> sheet.shape, np.flatnonzero(sheet.nodes["left"]).tolist()
        ((3, 3), [0, 3, 6])
    """

    state: Particles
    mass: Any
    springs: Springs
    nodes: dict[str, np.ndarray]
    faces: np.ndarray
    shape: tuple[int, ...] | None

    def wind(
        self,
        velocity: Any,
        density: ArrayLike = 1.225,
        normal: ArrayLike = 1.2,
        tangential: ArrayLike | None = 0.05,
    ) -> Wind:
        """The force of the air on the faces, moving with `velocity` [m/s]; see `Wind`."""
        if len(self.faces) == 0 or self.state.position.shape[-1] != 3:
            raise ValueError(
                "wind: this lattice has no faces in space to blow on; for points there is forces.QuadraticDrag."
            )
        cells = self.shape is not None and len(self.shape) == 2
        surface = Cells(*self.shape) if cells else Triangles(self.faces, self.state.lanes[-1])
        return Wind(surface, velocity, density, normal, tangential)


def rope(
    start: Any,
    end: Any,
    nodes: int,
    *,
    mass: ArrayLike,
    stiffness: ArrayLike,
    bend: ArrayLike | None = None,
    damping: ArrayLike | None = None,
    length: ArrayLike | None = None,
    breaks_at: ArrayLike | None = None,
) -> Lattice:
    """A rope from `start` to `end` [m], in the plane or in space, with its nodes at equal distances.

    It is as long as the way unless `length` [m] says otherwise; a longer one begins slack. Sets: start, end, ends.

    Example:
        >>> rope = lattices.rope((0.0, 0.0), (4.0, 0.0), nodes=5, mass=1.0, stiffness=100.0)
        >>> print(rope.state.position[:, 0], len(rope.springs.pairs))
        [0. 1. 2. 3. 4.] 4
    """
    nodes = positive_integer("nodes", nodes, at_least=2)
    ends = [np.asarray(real_quantity(name, value)) for name, value in (("start [m]", start), ("end [m]", end))]
    if ends[0].ndim != 1 or ends[0].shape != ends[1].shape:
        raise ValueError(f"rope: got start {ends[0].shape} and end {ends[1].shape}, expected two points (2,) or (3,).")
    x = np.linspace(*ends, nodes)
    way = _length(ends[1] - ends[0])
    stretch = 1.0 if length is None else real_quantity("length [m]", length, above=0) / way
    kinds = [(_tie((nodes,), [(1,)]), stiffness), (_tie((nodes,), [(2,)]), bend)]
    share = np.ones(nodes)
    share[[0, -1]] = 0.5
    index = np.arange(nodes)
    sets = {"start": index == 0, "end": index == nodes - 1}
    sets["ends"] = sets["start"] | sets["end"]
    return _built(x, kinds, damping, breaks_at, mass, share, sets, np.zeros((0, 3), int), (nodes,), stretch)


def cloth(
    width: float,
    height: float,
    rows: int,
    columns: int,
    *,
    mass: ArrayLike,
    structural: ArrayLike,
    shear: ArrayLike | None = None,
    bend: ArrayLike | None = None,
    damping: ArrayLike | None = None,
    breaks_at: ArrayLike | None = None,
    corner: Any = (0.0, 0.0, 0.0),
    across: Any = (1.0, 0.0, 0.0),
    down: Any = (0.0, -1.0, 0.0),
) -> Lattice:
    """A sheet of `width` × `height` [m], `rows` × `columns` nodes: node (i, j) is number i·columns + j.

    Structural springs tie neighbours, shear springs the diagonals, bend springs every other node. The upper left
    `corner` [m] is node 0; rows run `across`, columns `down`: with down=(0, 0, 1) it lies instead of hanging. Sets: top,
    bottom, left, right, edge, corners, top_left, top_right, bottom_left, bottom_right.

    Example:
        >>> sail = lattices.cloth(2.0, 1.0, rows=2, columns=3, mass=0.6, structural=100.0, shear=50.0)
        >>> len(sail.state.position), len(sail.springs.pairs)
        (6, 11)
    """
    rows, columns = positive_integer("rows", rows, at_least=2), positive_integer("columns", columns, at_least=2)
    lengths = [float(real_quantity(f"{n} [m]", v, above=0)) for n, v in (("width", width), ("height", height))]
    across, down, corner = (
        np.asarray(real_quantity(n, v)) for n, v in (("across", across), ("down", down), ("corner", corner))
    )
    if {across.shape, down.shape, corner.shape} != {(3,)}:
        raise ValueError(
            f"cloth: got across {across.shape}, down {down.shape} and corner {corner.shape}, expected vectors (3,)."
        )
    if _length(np.cross(across, down)) == 0:
        raise ValueError(f"cloth: got across {across} and down {down}, expected two different directions.")
    i, j = (a.ravel() for a in np.indices((rows, columns)))
    right, below = (a / _length(a) for a in (across, down))
    x = corner + np.multiply.outer(j * lengths[0] / (columns - 1), right)
    x = x + np.multiply.outer(i * lengths[1] / (rows - 1), below)
    shape = (rows, columns)
    kinds = [
        (_tie(shape, [(0, 1), (1, 0)]), structural),
        (_tie(shape, [(1, 1), (1, -1)]), shear),
        (_tie(shape, [(0, 2), (2, 0)]), bend),
    ]
    sets = {"top": i == 0, "bottom": i == rows - 1, "left": j == 0, "right": j == columns - 1}
    sets |= {f"{a}_{b}": sets[a] & sets[b] for a in ("top", "bottom") for b in ("left", "right")}
    sets["edge"] = sets["top"] | sets["bottom"] | sets["left"] | sets["right"]
    sets["corners"] = (sets["top"] | sets["bottom"]) & (sets["left"] | sets["right"])
    return _built(
        x, kinds, damping, breaks_at, mass, _shares(shape), sets, _cells(np.arange(i.size).reshape(shape)), shape
    )


def jelly(
    size: Sequence[float],
    nodes: Sequence[int],
    *,
    mass: ArrayLike,
    structural: ArrayLike,
    shear: ArrayLike | None = None,
    bend: ArrayLike | None = None,
    damping: ArrayLike | None = None,
    breaks_at: ArrayLike | None = None,
    corner: Any = (0.0, 0.0, 0.0),
) -> Lattice:
    """A block of `size` (x, y, z) [m] with so many `nodes` along each side, its lowest corner at `corner` [m].

    Structural springs tie neighbours, shear springs the diagonals of faces and of the cells, bend springs every other
    node. Sets: left and right (x), bottom and top (y), back and front (z), surface, corners.

    Example:
        >>> cube = lattices.jelly((1.0, 1.0, 1.0), (2, 2, 2), mass=1.0, structural=100.0)
        >>> len(cube.state.position), len(cube.springs.pairs)
        (8, 12)
    """
    shape = tuple(positive_integer("nodes", n, at_least=2) for n in nodes)
    lengths, corner = (
        np.asarray(real_quantity("size [m]", size, above=0)),
        np.asarray(real_quantity("corner [m]", corner)),
    )
    if (len(shape), lengths.shape, corner.shape) != (3, (3,), (3,)):
        raise ValueError(f"jelly: got {len(shape)} counts of nodes and size {lengths.shape}, expected three of each.")
    place = np.indices(shape).reshape(3, -1).T
    x = corner + place * (lengths / (np.array(shape) - 1))
    steps = [s for s in product((-1, 0, 1), repeat=3) if s > (0, 0, 0)]
    straight = [s for s in steps if sum(map(abs, s)) == 1]
    kinds = [
        (_tie(shape, straight), structural),
        (_tie(shape, [s for s in steps if s not in straight]), shear),
        (_tie(shape, [tuple(2 * a for a in s) for s in straight]), bend),
    ]
    last = place == np.array(shape) - 1
    sides = [(place == 0)[:, a] if end == 0 else last[:, a] for a in range(3) for end in (0, 1)]
    sets = dict(zip(("left", "right", "bottom", "top", "back", "front"), sides, strict=True))
    at_end = (place == 0) | last
    sets |= {"surface": at_end.any(axis=1), "corners": at_end.all(axis=1)}
    number = np.arange(len(x)).reshape(shape)
    skin = []
    for axis in range(3):  # outward on both sides
        low, high = np.take(number, 0, axis), np.take(number, -1, axis)
        skin += [_cells(low if axis == 1 else low.T), _cells(high.T if axis == 1 else high)]
    return _built(x, kinds, damping, breaks_at, mass, _shares(shape), sets, np.concatenate(skin), shape)


def bridge(
    span: float,
    height: float,
    panels: int,
    *,
    mass: ArrayLike,
    stiffness: ArrayLike,
    width: float | None = None,
    damping: ArrayLike | None = None,
    breaks_at: ArrayLike | None = None,
) -> Lattice:
    """A truss over a `span` [m] along x: two chords, posts, and both diagonals in every panel; rigid when pinned at one end.

    With a `width` [m] there are two such trusses side by side, z = 0 and z = width, braced to each other above and
    below. Mass goes with the length of the beams. Sets: deck (the lower chord), top, left, right, supports (the ends of
    the deck).

    Example:
        >>> truss = lattices.bridge(4.0, 1.0, panels=4, mass=100.0, stiffness=2e4)
        >>> len(truss.state.position), len(truss.springs.pairs), int(truss.nodes["supports"].sum())
        (10, 21, 2)
    """
    panels = positive_integer("panels", panels, at_least=1)
    sides = [span, height] if width is None else [span, height, width]
    lengths = np.array([float(real_quantity("span, height and width [m]", side, above=0)) for side in sides])
    shape = (panels + 1, *[2] * (len(sides) - 1))
    place = np.indices(shape).reshape(len(shape), -1).T
    x = place * (lengths / (np.array(shape) - 1))
    steps = [s for s in product((-1, 0, 1), repeat=len(shape)) if s > (0,) * len(shape)]
    flat = [s for s in steps if sum(map(abs, s)) <= 2]  # along the edges and across the faces of each box
    pairs = _tie(shape, flat)
    along = _length(x[pairs[:, 0]] - x[pairs[:, 1]])
    share = np.bincount(pairs.ravel(), np.repeat(along, 2), len(x))
    sets = {"left": place[:, 0] == 0, "right": place[:, 0] == panels, "deck": place[:, 1] == 0, "top": place[:, 1] == 1}
    sets["supports"] = sets["deck"] & (sets["left"] | sets["right"])
    return _built(x, [(pairs, stiffness)], damping, breaks_at, mass, share, sets, np.zeros((0, 3), int), shape)


def from_mesh(
    mesh: Any,
    faces: Any = None,
    *,
    mass: ArrayLike,
    structural: ArrayLike,
    bend: ArrayLike | None = None,
    damping: ArrayLike | None = None,
    breaks_at: ArrayLike | None = None,
    weld: float | None = None,
    triangulate: bool = False,
) -> Lattice:
    """A sheet from `vertices, faces`, or from the path of a file that `meshes.read_mesh` reads (`triangulate` as there).

    Structural springs are the edges of the triangles, bend springs tie the vertices opposite each inner edge. A node
    has a third of the area around it. Sets: edge (on the boundary).

    Triangles hold together by the vertices they share. Vertices in one place become one node, with a warning that says
    how many: those nearer than `weld` [m], unless told a millionth of the mesh's size. With `weld=0` all stay apart. Pieces
    that share none, though they come within a tenth of the shortest edge, are warned of.
    Raises ValueError where no two triangles share a vertex even so.

    Example:
        >>> square = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
        >>> net = lattices.from_mesh(square, [[0, 1, 2], [0, 2, 3]], mass=0.6, structural=100.0)
        >>> print(len(net.springs.pairs), net.mass)
        5 [0.2 0.1 0.2 0.1]
    """
    if isinstance(mesh, str | os.PathLike):
        if faces is not None:
            raise TypeError("from_mesh: got a file and faces, expected a file alone, or vertices and faces.")
        x, faces = read_mesh(mesh, triangulate=triangulate)
    else:
        x, faces = checked_mesh(mesh, faces)
    x, faces = _welded(x, faces, weld)
    edges, opposite, lonely = _edges(faces)
    a, b, c = (x[faces[:, i]] for i in range(3))
    area = _length(np.cross(b - a, c - a)) / 2
    share = np.bincount(faces.ravel(), np.repeat(area, 3), len(x))
    if (share == 0).any():
        raise ValueError(
            f"from_mesh: vertex {int(np.argmin(share))} has no area around it ({(share == 0).sum()} have none), expected "
            "every vertex in a triangle. Remove the loose ones."
        )
    sets = {"edge": np.isin(np.arange(len(x)), lonely)}
    return _built(x, [(edges, structural), (opposite, bend)], damping, breaks_at, mass, share, sets, faces, None)


def _welded(x: np.ndarray, faces: np.ndarray, tolerance: float | None) -> tuple[np.ndarray, np.ndarray]:
    """The mesh with one node for each place; says what was joined, and refuses what falls apart into single triangles."""
    if tolerance is not None:
        tolerance = float(real_quantity("weld [m]", tolerance, at_least=0))
        if tolerance == 0:
            return x, faces
    found = join_vertices(x, faces, tolerance)
    if len(found.vertices) < len(x):
        left_out = f", {found.flat} faces without area were left out" if found.flat else ""
        warnings.warn(
            f"from_mesh: {len(x)} vertices stand in {len(found.vertices)} places and were welded to as many nodes{left_out}; "
            "nodes are numbered anew. Weld it first with meshes.weld, or keep the vertices apart with weld=0.",
            stacklevel=3,
        )
    if len(found.faces) == 0:
        raise ValueError(
            f"from_mesh: got weld {tolerance} m, which leaves no triangle. Give a length below those of the edges."
        )
    if len(found.faces) > 1 and np.bincount(found.faces.ravel()).max() == 1:
        raise ValueError(
            f"from_mesh: none of the {len(found.faces)} triangles shares a vertex with another, so that the sheet would fall "
            "apart. Give weld=, a distance [m] within which vertices are one; weld=0 if they are to be single triangles."
        )
    pieces, apart = near_pieces(found.vertices, found.faces) if tolerance is None else (0, 0.0)
    if pieces:
        warnings.warn(
            f"from_mesh: {pieces} pieces of the mesh share no vertex though they come within {apart:.3g} m of each other, and no "
            f"spring holds them together. Give weld={1.01 * apart:.3g} [m] to join them, weld=0 if they are to be apart.",
            stacklevel=3,
        )
    return found.vertices, found.faces


def _length(v: np.ndarray) -> np.ndarray:
    return np.sqrt(np.sum(v * v, axis=-1))


def _tie(shape: tuple[int, ...], steps: Iterable[tuple[int, ...]]) -> np.ndarray:
    """Pairs of all nodes of a lattice that are the given steps apart."""
    number, pairs = np.arange(np.prod(shape)).reshape(shape), []
    for step in steps:
        here = tuple(slice(max(0, -s), n - max(0, s)) for s, n in zip(step, shape, strict=True))
        there = tuple(slice(max(0, s), n - max(0, -s)) for s, n in zip(step, shape, strict=True))
        if all(abs(s) < n for s, n in zip(step, shape, strict=True)):
            pairs.append(np.stack([number[here].ravel(), number[there].ravel()], axis=1))
    return np.concatenate(pairs) if pairs else np.zeros((0, 2), int)


def _shares(shape: tuple[int, ...]) -> np.ndarray:
    """Each node's share of a lattice: half as much at the end of a row, in every direction."""
    share = np.ones(1)
    for count in shape:
        ends = np.ones(count)
        ends[[0, -1]] = 0.5
        share = np.multiply.outer(share, ends).ravel()
    return share


def _cells(number: np.ndarray) -> np.ndarray:
    """Two triangles for each cell of a sheet of nodes."""
    a, b, c, d = (number[i : i - 1 or None, j : j - 1 or None].ravel() for i in (0, 1) for j in (0, 1))
    return np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])


def _edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges of triangles, pairs of vertices opposite an inner edge (no edges themselves), and vertices on the boundary."""
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


def _built(x, kinds, damping, breaks_at, mass, share, sets, faces, shape, stretch=1.0) -> Lattice:
    """The lattice of nodes at x with those kinds of springs that have a stiffness."""
    present = [(pairs, stiffness) for pairs, stiffness in kinds if stiffness is not None and len(pairs)]
    if not present:
        raise ValueError("lattice: got no stiffness, expected at least that of the structural springs.")
    pairs = np.concatenate([pairs for pairs, _ in present])
    rest = _length(x[pairs[:, 0]] - x[pairs[:, 1]]) * stretch
    state = Particles(jnp.asarray(x, jnp.result_type(float)), jnp.zeros(x.shape, jnp.result_type(float)))
    mass = real_quantity("mass [kg]", mass, above=0)
    springs = Springs(pairs, _joined(present), rest, damping, breaks_at, nodes=len(x))
    share = jnp.asarray(share / share.sum(), mass.dtype)
    return Lattice(state, mass * share, springs, sets, faces, shape)


def _joined(kinds: list[tuple[np.ndarray, Any]]) -> Any:
    """The stiffness of each spring; a number alone where there is only one kind."""
    numbers = [real_quantity("stiffness [N/m]", stiffness, at_least=0) for _, stiffness in kinds]
    if len(kinds) == 1:
        return numbers[0]
    for number in numbers:
        if number.ndim and number.shape[-1] != 1:
            raise ValueError(
                f"stiffness [N/m]: got shape {number.shape}, expected a number, or (*scenes, 1) for a sweep."
            )
    scenes = jnp.broadcast_shapes(*(number.shape[:-1] for number in numbers))
    parts = [jnp.broadcast_to(n, (*scenes, len(pairs))) for n, (pairs, _) in zip(numbers, kinds, strict=True)]
    return jnp.concatenate(parts, axis=-1)
