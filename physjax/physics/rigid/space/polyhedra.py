"""Convex polyhedra by their corners: which of them share a face or an edge, and tables of those of several bodies."""

from collections.abc import Sequence
from functools import cache
from itertools import combinations, pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from physjax.physics.rigid.space.components import Vector, cross, dot, scale, square_root, subtract

MAX_CORNERS = 32
"""Most corners of a hull: each edge of one is held against each edge of the other."""
ROUNDING = 1e-6
"""Share of the size within which corners lie in one plane."""


class Topology(NamedTuple):
    """What does not change when corners move a little: each face's corners, anticlockwise from outside, and the edges.

    Of an edge `(start, end, right, left)` the last two are the faces to both sides, seen from outside on the way from the
    start to the end.
    """

    faces: tuple[tuple[int, ...], ...]
    edges: tuple[tuple[int, int, int, int], ...]

    @property
    def triangles(self) -> np.ndarray:
        """The faces cut into triangles, `(triangles, 3)`."""
        return np.array([(face[0], *pair) for face in self.faces for pair in pairwise(face[1:])])


class Polyhedra(NamedTuple):
    """The polyhedra of several bodies in their own frames [m], `(..., bodies, 1)`, as many of each kind for all: some are
    given twice.

    `corners`; faces by their outward `normals` and how far they are from the origin, `heights`, and by their corners
    `(faces, corners, bodies, 1)`; edges by their `starts` and `ways` to the end, with the normals to the `right` and `left`.
    """

    corners: Vector
    normals: Vector
    heights: Array
    polygons: Vector
    starts: Vector
    ways: Vector
    right: Vector
    left: Vector


def find_topology(corners: np.ndarray) -> tuple[np.ndarray, Topology]:
    """Which of some points are the corners of their convex hull, in their order, and its faces and edges.

    Every plane through three points with none beyond it is a face.
    """
    middle, size = corners.mean(axis=0), np.ptp(corners, axis=0).max()
    normals: dict[frozenset[int], np.ndarray] = {}
    for three in combinations(range(len(corners)), 3):
        a, b, c = corners[list(three)]
        normal = np.cross(b - a, c - a)
        length = np.sqrt(np.inner(normal, normal))
        if length <= ROUNDING * size**2:
            continue
        normal = normal / length * (1 if np.inner(normal, a - middle) >= 0 else -1)
        heights = np.inner(corners - a, normal)
        if heights.max() <= ROUNDING * size:
            normals.setdefault(frozenset(np.flatnonzero(heights >= -ROUNDING * size).tolist()), normal)
    if len(normals) < 4:
        raise ValueError("Shape.hull: got points in one plane, expected some out of it: a hull is a solid.")
    faces = [_go_round(corners, np.array(sorted(members)), normal) for members, normal in normals.items()]
    # a point that lies on an edge or within a face is no corner
    kept = sorted({number for face in faces for number in face})
    renumbered = {number: place for place, number in enumerate(kept)}
    around = tuple(tuple(renumbered[number] for number in face) for face in faces)
    beside = {edge: f for f, face in enumerate(around) for edge in zip(face, (*face[1:], face[0]), strict=True)}
    edges = tuple((i, j, beside[j, i], f) for (i, j), f in beside.items() if i < j)
    return np.array(kept), Topology(around, edges)


def _go_round(corners: np.ndarray, members: np.ndarray, normal: np.ndarray) -> list[int]:
    """The corners of a face anticlockwise, without points on the way between two of them."""
    ways = corners[members] - corners[members].mean(axis=0)
    along = ways[np.argmax((ways**2).sum(axis=1))]
    along = along / np.sqrt(np.inner(along, along))
    order = members[np.argsort(np.arctan2(np.inner(ways, np.cross(normal, along)), np.inner(ways, along)))]
    size = np.abs(ways).max()
    turns = [
        np.inner(np.cross(corners[here] - corners[before], corners[after] - corners[here]), normal)
        for before, here, after in zip(np.roll(order, 1), order, np.roll(order, -1), strict=True)
    ]
    return [int(number) for number, turn in zip(order, turns, strict=True) if turn > ROUNDING * size**2]


BOX_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
"""The corners of a box as shares of its half edges."""


@cache
def find_box_topology() -> Topology:
    """That of every box."""
    return find_topology(BOX_CORNERS)[1]


def tabulate_polyhedra(corners: Sequence[Array], topologies: Sequence[Topology]) -> Polyhedra:
    """The table of polyhedra with these corners `(n, 3)` [m], one for each body."""
    faces, edges = (max(map(len, parts)) for parts in zip(*topologies, strict=True))
    sides = max(len(face) for topology in topologies for face in topology.faces)
    counts = max(map(len, corners)), faces, edges, sides
    each = [_tabulate(own, topology, counts) for own, topology in zip(corners, topologies, strict=True)]
    return jax.tree.map(lambda *parts: jnp.stack(parts, axis=-1)[..., None], *each)


def _tabulate(corners: Array, topology: Topology, counts: tuple[int, int, int, int]) -> Polyhedra:
    most, faces, edges, sides = counts
    fill = lambda numbers, count: np.array([*numbers, *[numbers[-1]] * (count - len(numbers))])  # noqa: E731
    polygon = fill([fill(face, sides) for face in topology.faces], faces)
    start, end, right, left = fill(topology.edges, edges).T
    at = lambda places: (corners[places, 0], corners[places, 1], corners[places, 2])  # noqa: E731
    first, second, third = (at(np.array([face[k] for face in topology.faces])) for k in range(3))
    product = cross(subtract(second, first), subtract(third, first))
    normal = scale(1 / square_root(dot(product, product)), product)
    x, y, z = (part[fill(range(len(topology.faces)), faces)] for part in normal)
    side = lambda face: (x[face], y[face], z[face])  # noqa: E731
    beginning = at(start)
    return Polyhedra(
        at(fill(range(len(corners)), most)),
        (x, y, z),
        dot((x, y, z), at(polygon[:, 0])),
        at(polygon),
        beginning,
        subtract(at(end), beginning),
        side(right),
        side(left),
    )


__all__ = [
    "BOX_CORNERS",
    "MAX_CORNERS",
    "Polyhedra",
    "Topology",
    "find_box_topology",
    "find_topology",
    "tabulate_polyhedra",
]
