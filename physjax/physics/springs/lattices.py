"""Lattices of nodes and springs: rope, cloth, jelly, bridge, and the edges of a mesh.

Each function returns a `Lattice` at rest. Stiffness [N/m] and damping [kg/s] are those of a single spring; a stiffness of
None leaves that kind of spring out. Refined with the same numbers, a lattice grows softer or stiffer. With `continuum=True`
ropes, sheets and blocks are of a material instead, and stretch alike however many nodes they have: a stiffness is EA [N] of
a rope, the tension per width and strain C [N/m] of a sheet, the modulus E [Pa] of a block, and damping likewise. A spring of
length l that stands for a volume V (area, length) of them has k = E V/l²: structural and bend springs each resist a pull
along them with what they are given, and shear springs add to that. (A sheet of them is soft to bending where it is fine.)
`breaks_at` and `yields_at` are the strains at which any spring breaks or yields. `mass`
[kg] is the total, distributed to the nodes by length, area or volume.
"""

from collections.abc import Iterable, Sequence
from itertools import product

import numpy as np
from jax.typing import ArrayLike

from physjax.checks import NestedArrayLike, as_positive_integer, as_real_quantity
from physjax.name_hints import hint_at_names
from physjax.physics.springs.assembly import Lattice, build_lattice, vector_lengths
from physjax.physics.springs.mesh_sheets import from_mesh
from physjax.tracebacks import shorten_tracebacks


@shorten_tracebacks
def rope(
    start: NestedArrayLike,
    end: NestedArrayLike,
    nodes: int,
    *,
    mass: ArrayLike,
    stiffness: ArrayLike,
    bend: ArrayLike | None = None,
    damping: ArrayLike | None = None,
    length: ArrayLike | None = None,
    breaks_at: ArrayLike | None = None,
    yields_at: ArrayLike | None = None,
    continuum: bool = False,
) -> Lattice:
    """A rope from `start` to `end` [m], in the plane or in space, with equally spaced nodes.

    Its unstretched `length` [m] is by default the distance of its ends; a longer rope begins slack. Sets of nodes: start,
    end, ends.

    Example:
        >>> rope = lattices.rope((0.0, 0.0), (4.0, 0.0), nodes=5, mass=1.0, stiffness=100.0)
        >>> print(rope.state.position[:, 0], len(rope.springs.pairs))
        [0. 1. 2. 3. 4.] 4
        >>> rope = lattices.rope((0.0, 0.0), (4.0, 0.0), nodes=9, mass=1.0, stiffness=400.0, continuum=True)
        >>> print(rope.springs.stiffness)  # EA = 400 N, in eight pieces of half a metre
        [800. 800. 800. 800. 800. 800. 800. 800.]
    """
    nodes = as_positive_integer("nodes", nodes, at_least=2)
    ends = [np.asarray(as_real_quantity(name, value)) for name, value in (("start [m]", start), ("end [m]", end))]
    if ends[0].ndim != 1 or ends[0].shape != ends[1].shape:
        raise ValueError(f"rope: got start {ends[0].shape} and end {ends[1].shape}, expected two points (2,) or (3,).")
    x = np.linspace(ends[0], ends[1], nodes)
    distance = vector_lengths(ends[1] - ends[0])
    stretch = 1.0 if length is None else as_real_quantity("length [m]", length, above=0) / distance
    kinds = [(_pair_nodes((nodes,), [(1,)]), stiffness), (_pair_nodes((nodes,), [(2,)]), bend)]
    share = np.ones(nodes)
    share[[0, -1]] = 0.5
    index = np.arange(nodes)
    sets = {"start": index == 0, "end": index == nodes - 1}
    sets["ends"] = sets["start"] | sets["end"]
    volumes = _find_volumes((nodes,), [float(distance) / (nodes - 1)], kinds) if continuum else None
    return build_lattice(
        x,
        kinds,
        damping,
        breaks_at,
        mass,
        share,
        sets,
        shape=(nodes,),
        stretch=stretch,
        yields_at=yields_at,
        volumes=volumes,
    )


@shorten_tracebacks
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
    yields_at: ArrayLike | None = None,
    corner: NestedArrayLike = (0.0, 0.0, 0.0),
    across: NestedArrayLike = (1.0, 0.0, 0.0),
    down: NestedArrayLike = (0.0, -1.0, 0.0),
    continuum: bool = False,
) -> Lattice:
    """A sheet of `width` × `height` [m], `rows` × `columns` nodes: node (i, j) is number i·columns + j.

    Structural springs join neighbours, shear springs the diagonals of cells, bend springs every second node. Node 0 is
    the upper left `corner` [m]; rows run `across` and columns `down` (with down=(0, 0, 1) the sheet is level). Sets of
    nodes: top, bottom, left, right, edge, corners, top_left, top_right, bottom_left, bottom_right.

    Example:
        >>> sail = lattices.cloth(2.0, 1.0, rows=2, columns=3, mass=0.6, structural=100.0, shear=50.0)
        >>> len(sail.state.position), len(sail.springs.pairs)
        (6, 11)
    """
    rows, columns = as_positive_integer("rows", rows, at_least=2), as_positive_integer("columns", columns, at_least=2)
    lengths = [float(as_real_quantity(f"{n} [m]", v, above=0)) for n, v in (("width", width), ("height", height))]
    origin, right, below = _check_sheet_frame(corner, across, down)
    i, j = (a.ravel() for a in np.indices((rows, columns)))
    x = origin + np.multiply.outer(j * lengths[0] / (columns - 1), right)
    x = x + np.multiply.outer(i * lengths[1] / (rows - 1), below)
    shape = (rows, columns)
    kinds = [
        (_pair_nodes(shape, [(0, 1), (1, 0)]), structural),
        (_pair_nodes(shape, [(1, 1), (1, -1)]), shear),
        (_pair_nodes(shape, [(0, 2), (2, 0)]), bend),
    ]
    sets = {"top": i == 0, "bottom": i == rows - 1, "left": j == 0, "right": j == columns - 1}
    sets |= {f"{a}_{b}": sets[a] & sets[b] for a in ("top", "bottom") for b in ("left", "right")}
    sets["edge"] = sets["top"] | sets["bottom"] | sets["left"] | sets["right"]
    sets["corners"] = (sets["top"] | sets["bottom"]) & (sets["left"] | sets["right"])
    faces = _triangulate_cells(np.arange(i.size).reshape(shape))
    spacing = lengths[1] / (rows - 1), lengths[0] / (columns - 1)
    return build_lattice(
        x,
        kinds,
        damping,
        breaks_at,
        mass,
        _compute_node_shares(shape),
        sets,
        faces,
        shape,
        yields_at=yields_at,
        volumes=_find_volumes(shape, spacing, kinds) if continuum else None,
    )


def _check_sheet_frame(
    corner: NestedArrayLike, across: NestedArrayLike, down: NestedArrayLike
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The corner of a sheet [m] and the unit vectors along its rows and columns, or a ValueError."""
    corner, across, down = (
        np.asarray(as_real_quantity(n, v)) for n, v in (("corner", corner), ("across", across), ("down", down))
    )
    if {across.shape, down.shape, corner.shape} != {(3,)}:
        raise ValueError(
            f"cloth: got across {across.shape}, down {down.shape} and corner {corner.shape}, expected vectors (3,)."
        )
    if vector_lengths(np.cross(across, down)) == 0:
        raise ValueError(f"cloth: got across {across} and down {down}, expected two different directions.")
    return corner, across / vector_lengths(across), down / vector_lengths(down)


@shorten_tracebacks
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
    yields_at: ArrayLike | None = None,
    corner: NestedArrayLike = (0.0, 0.0, 0.0),
    continuum: bool = False,
) -> Lattice:
    """A block of `size` (x, y, z) [m] with `nodes` (n_x, n_y, n_z) along its sides, its lowest corner at `corner` [m].

    Structural springs join neighbours, shear springs the diagonals of faces and cells, bend springs every second node.
    Sets of nodes: left and right (x), bottom and top (y), back and front (z), surface, corners.

    Example:
        >>> cube = lattices.jelly((1.0, 1.0, 1.0), (2, 2, 2), mass=1.0, structural=100.0)
        >>> len(cube.state.position), len(cube.springs.pairs)
        (8, 12)
    """
    shape = tuple(as_positive_integer("nodes", n, at_least=2) for n in nodes)
    lengths = np.asarray(as_real_quantity("size [m]", size, above=0))
    origin = np.asarray(as_real_quantity("corner [m]", corner))
    if (len(shape), lengths.shape, origin.shape) != (3, (3,), (3,)):
        raise ValueError(f"jelly: got {len(shape)} counts of nodes and size {lengths.shape}, expected three of each.")
    place = np.indices(shape).reshape(3, -1).T
    x = origin + place * (lengths / (np.array(shape) - 1))
    steps = [s for s in product((-1, 0, 1), repeat=3) if s > (0, 0, 0)]
    straight = [s for s in steps if sum(map(abs, s)) == 1]
    kinds = [
        (_pair_nodes(shape, straight), structural),
        (_pair_nodes(shape, [s for s in steps if s not in straight]), shear),
        (_pair_nodes(shape, [tuple(2 * a for a in s) for s in straight]), bend),
    ]
    first, last = place == 0, place == np.array(shape) - 1
    sides = [end[:, axis] for axis in range(3) for end in (first, last)]
    sets = dict(zip(("left", "right", "bottom", "top", "back", "front"), sides, strict=True))
    sets |= {"surface": (first | last).any(axis=1), "corners": (first | last).all(axis=1)}
    faces, spacing = _triangulate_surface(shape), lengths / (np.array(shape) - 1)
    return build_lattice(
        x,
        kinds,
        damping,
        breaks_at,
        mass,
        _compute_node_shares(shape),
        sets,
        faces,
        shape,
        yields_at=yields_at,
        volumes=_find_volumes(shape, spacing, kinds) if continuum else None,
    )


def _triangulate_surface(shape: tuple[int, ...]) -> np.ndarray:
    """Triangles of the six faces of a block of nodes, their normals outward."""
    number, faces = np.arange(np.prod(shape)).reshape(shape), []
    for axis in range(3):
        low, high = np.take(number, 0, axis), np.take(number, -1, axis)
        # the axes that are left are (y, z), (x, z), (x, y): for the middle pair x × z points down, else up
        faces += [_triangulate_cells(low if axis == 1 else low.T), _triangulate_cells(high.T if axis == 1 else high)]
    return np.concatenate(faces)


@shorten_tracebacks
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
    yields_at: ArrayLike | None = None,
) -> Lattice:
    """A truss bridge of a `span` [m] along x: two chords, posts, and both diagonals in every panel.

    With a `width` [m] there are two such trusses, at z = 0 and z = width, braced to each other at top and bottom. Mass is
    proportional to the length of the beams. Sets of nodes: deck (the lower chord), top, left, right, supports (the ends
    of the deck).

    Example:
        >>> truss = lattices.bridge(4.0, 1.0, panels=4, mass=100.0, stiffness=2e4)
        >>> len(truss.state.position), len(truss.springs.pairs), int(truss.nodes["supports"].sum())
        (10, 21, 2)

        Cut in two, where a vertical line crosses its beams:

        >>> x = truss.state.position[truss.springs.pairs][..., 0]
        >>> crossing = (x.min(axis=1) < 1.5) & (x.max(axis=1) > 1.5)
        >>> halves = truss.springs.cut(crossing)
        >>> int(crossing.sum()), int(halves.unbroken.sum())
        (4, 17)
    """
    panels = as_positive_integer("panels", panels, at_least=1)
    sides = [span, height] if width is None else [span, height, width]
    lengths = np.array([float(as_real_quantity("span, height and width [m]", side, above=0)) for side in sides])
    shape = (panels + 1, *[2] * (len(sides) - 1))
    place = np.indices(shape).reshape(len(shape), -1).T
    x = place * (lengths / (np.array(shape) - 1))
    steps = [s for s in product((-1, 0, 1), repeat=len(shape)) if s > (0,) * len(shape)]  # each direction once
    flat = [s for s in steps if sum(map(abs, s)) <= 2]  # along the edges and across the faces of each box
    pairs = _pair_nodes(shape, flat)
    along = vector_lengths(x[pairs[:, 0]] - x[pairs[:, 1]])
    share = np.bincount(pairs.ravel(), np.repeat(along, 2), len(x))
    sets = {"left": place[:, 0] == 0, "right": place[:, 0] == panels, "deck": place[:, 1] == 0, "top": place[:, 1] == 1}
    sets["supports"] = sets["deck"] & (sets["left"] | sets["right"])
    return build_lattice(
        x, [(pairs, stiffness)], damping, breaks_at, mass, share, sets, shape=shape, yields_at=yields_at
    )


def _pair_nodes(shape: tuple[int, ...], steps: Iterable[tuple[int, ...]]) -> np.ndarray:
    """All pairs of nodes of a lattice that are one of the given steps apart."""
    number, pairs = np.arange(np.prod(shape)).reshape(shape), []
    for step in steps:
        here = tuple(slice(max(0, -s), n - max(0, s)) for s, n in zip(step, shape, strict=True))
        there = tuple(slice(max(0, s), n - max(0, -s)) for s, n in zip(step, shape, strict=True))
        if all(abs(s) < n for s, n in zip(step, shape, strict=True)):
            pairs.append(np.stack([number[here].ravel(), number[there].ravel()], axis=1))
    return np.concatenate(pairs) if pairs else np.zeros((0, 2), int)


def _find_volumes(shape: tuple[int, ...], spacing: Sequence[float] | np.ndarray, kinds: Sequence) -> list[np.ndarray]:
    """The volume (area, length) that each spring of each kind stands for: on a side of the lattice it is half a cell wide."""
    found = []
    for pairs, _ in kinds:
        ends = zip(np.unravel_index(pairs[:, 0], shape), np.unravel_index(pairs[:, 1], shape), strict=True)
        volume = np.ones(len(pairs))
        for (i, j), count, step in zip(ends, shape, spacing, strict=True):
            on_side = (i == j) & ((i == 0) | (i == count - 1))
            volume = volume * np.where(on_side, step / 2, step)
        found.append(volume)
    return found


def _compute_node_shares(shape: tuple[int, ...]) -> np.ndarray:
    """Each node's share of the volume of a lattice: halved at the ends of every axis."""
    share = np.ones(1)
    for count in shape:
        ends = np.ones(count)
        ends[[0, -1]] = 0.5
        share = np.multiply.outer(share, ends).ravel()
    return share


def _triangulate_cells(number: np.ndarray) -> np.ndarray:
    """Two triangles for each cell of a sheet of nodes `(rows, columns)`."""
    a, b, c, d = (number[i : i - 1 or None, j : j - 1 or None].ravel() for i in (0, 1) for j in (0, 1))
    return np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])


__all__ = ["Lattice", "bridge", "cloth", "from_mesh", "jelly", "rope"]


def __dir__() -> list[str]:
    return __all__


hint_at_names(__name__)
