"""In which order the joints of a mechanism are eliminated, worked out before compiling.

Two joints are neighbours where they share a body. Joints that are no neighbours of each other are eliminated at the same
time, those with the fewest neighbours first; the neighbours of an eliminated joint become each other's. A chain, whose
every other joint goes at once, and a tree take about log n such levels and work in proportion to n; loops, and bodies with
many joints, add neighbours.
"""

from collections.abc import Sequence
from functools import cache
from itertools import product
from typing import NamedTuple

import numpy as np

FEW_NEIGHBOURS = 2
"""Joints with no more neighbours than that are eliminated at once: the links of a chain, which gain none by it."""
Pairs = tuple[tuple[int, int], ...]
"""The bodies at both ends of each joint; below 0 is a place in the world."""
Sum = list[list[int]]
"""For each of several entries, which terms are added to it."""


class Level(NamedTuple):
    """What is eliminated at once, as indices into tables: of joints, of the edges between two joints, and of this level.

    `joints` `(width,)` are eliminated; `edges` `(edges,)` lead from them to later ones, `from_joint` says from which place of
    this level, `to_joint` to which joint. `products` `(2, products)` are pairs of places in `edges`, whose product changes what
    stands between their later joints. `on_joints` `(terms, joints + 1)`, `on_lower` and `on_upper` `(terms, all edges + 1)` say
    which products are taken from which block, `on_right` `(terms, joints + 1)` which edges from which right-hand side,
    `back` `(terms, width)` which edges lead from each place, and `places` `(joints + 1,)` where each joint is in the level.
    An index beyond the last is none. Where levels are stacked each array has an axis of levels in front.
    """

    joints: np.ndarray
    edges: np.ndarray
    from_joint: np.ndarray
    to_joint: np.ndarray
    products: np.ndarray
    on_joints: np.ndarray
    on_lower: np.ndarray
    on_upper: np.ndarray
    on_right: np.ndarray
    back: np.ndarray
    places: np.ndarray


class Elimination(NamedTuple):
    """The edges `(edges, 2)` between joints, the earlier first, and the levels, all of one shape.

    `shared` `(terms, 2, edges)` says which ends of the two joints of an edge are at one body: ends are counted first ends first,
    one beyond the last is none.
    """

    edges: np.ndarray
    shared: np.ndarray
    levels: tuple[Level, ...]

    @property
    def stacked(self) -> Level:
        """The levels as one, with an axis of levels in front of each array."""
        return Level(*(np.stack(arrays) for arrays in zip(*self.levels, strict=True)))


@cache
def plan_elimination(pairs: Pairs) -> Elimination:
    """The elimination of joints between these pairs of bodies."""
    neighbours = _find_neighbours(pairs)
    order, edges, groups = [], [], []
    remaining = set(range(len(pairs)))
    while remaining:
        group = _pick_independent(remaining, neighbours)
        groups.append(group)
        for joint in group:
            later = sorted(neighbours[joint])
            edges += [(joint, other) for other in later]
            for other in later:
                neighbours[other] |= set(later) - {other}
                neighbours[other].discard(joint)
        remaining -= set(group)
        order += group
    number = {edge: i for i, edge in enumerate(edges)}
    levels = _pad_levels([_tabulate(group, edges, number, len(pairs)) for group in groups])
    found = np.array(edges, np.int32).reshape(-1, 2)
    return Elimination(found, _find_shared_ends(pairs, edges), levels)


def _find_neighbours(pairs: Pairs) -> list[set[int]]:
    """The joints that share a body with each."""
    at: dict[int, set[int]] = {}
    for joint, pair in enumerate(pairs):
        for body in pair:
            if body >= 0:
                at.setdefault(body, set()).add(joint)
    return [set().union(*(at[body] for body in pair if body >= 0)) - {joint} for joint, pair in enumerate(pairs)]


def _pick_independent(remaining: set[int], neighbours: Sequence[set[int]]) -> list[int]:
    """Joints with few neighbours, of which no two are neighbours."""
    most = max(FEW_NEIGHBOURS, min(len(neighbours[joint]) for joint in remaining))
    picked, taken = [], set()
    for joint in sorted(remaining):
        if len(neighbours[joint]) <= most and joint not in taken:
            picked.append(joint)
            taken |= neighbours[joint]
    return picked


def _tabulate(group: list[int], edges: list[tuple[int, int]], number: dict[tuple[int, int], int], size: int) -> dict:
    """The lists of a level, by the names of its arrays."""
    place = {joint: i for i, joint in enumerate(group)}
    own = [i for i, (joint, _) in enumerate(edges) if joint in place]
    leaving: list[list[int]] = [[] for _ in group]
    for a, i in enumerate(own):
        leaving[place[edges[i][0]]].append(a)
    products: list[tuple[int, int]] = []
    on_joints: Sum = [[] for _ in range(size + 1)]
    on_lower: Sum = [[] for _ in range(len(edges) + 1)]
    on_upper: Sum = [[] for _ in range(len(edges) + 1)]
    on_right: Sum = [[] for _ in range(size + 1)]
    for a, b in (both for several in leaving for both in product(several, repeat=2)):
        row, column = edges[own[a]][1], edges[own[b]][1]
        if row == column:
            on_joints[row].append(len(products))
        elif (column, row) in number:
            on_lower[number[column, row]].append(len(products))
        else:
            on_upper[number[row, column]].append(len(products))
        products.append((a, b))
    for a, i in enumerate(own):
        on_right[edges[i][1]].append(a)
    return {
        "joints": group,
        "edges": own,
        "from_joint": [place[edges[i][0]] for i in own],
        "to_joint": [edges[i][1] for i in own],
        "products": products,
        "sums": (on_joints, on_lower, on_upper, on_right, leaving),
        "places": [place.get(joint) for joint in range(size + 1)],
    }


def _pad_levels(lists: list[dict]) -> tuple[Level, ...]:
    """The levels as arrays of one shape; what is missing has an index beyond the last."""
    width, own, pairs = (max(len(each[name]) for each in lists) for name in ("joints", "edges", "products"))
    terms = [max(max(map(len, each["sums"][i]), default=0) for each in lists) for i in range(5)]
    ends = (pairs, pairs, pairs, own, own)
    size, edges = len(lists[0]["sums"][0]) - 1, len(lists[0]["sums"][1]) - 1

    def pad(numbers: list[int], length: int, none: int) -> np.ndarray:
        return np.array([*numbers, *[none] * (length - len(numbers))], np.int32)

    def build(each: dict) -> Level:
        products = (
            np.array([*each["products"], *[(own, own)] * (pairs - len(each["products"]))], np.int32).reshape(-1, 2).T
        )
        sums = zip(each["sums"], terms, ends, strict=True)
        on_joints, on_lower, on_upper, on_right, back = (_tabulate_sum(s, n, end) for s, n, end in sums)
        return Level(
            pad(each["joints"], width, size),
            pad(each["edges"], own, edges),
            pad(each["from_joint"], own, width),
            pad(each["to_joint"], own, size),
            products,
            on_joints,
            on_lower,
            on_upper,
            on_right,
            np.pad(back, ((0, 0), (0, width - back.shape[1])), constant_values=own),
            np.array([width if place is None else place for place in each["places"]], np.int32),
        )

    return tuple(build(each) for each in lists)


def _tabulate_sum(entries: Sum, terms: int, none: int) -> np.ndarray:
    """The terms of each entry as `(terms, entries)`."""
    table = np.full((terms, len(entries)), none, np.int32)
    for i, entry in enumerate(entries):
        table[: len(entry), i] = entry
    return table


def _find_shared_ends(pairs: Pairs, edges: list[tuple[int, int]]) -> np.ndarray:
    """Which ends of the two joints of each edge are at one body, `(terms, 2, edges)`."""
    size = len(pairs)
    ends = lambda joint: [(body, joint + side * size) for side, body in enumerate(pairs[joint]) if body >= 0]  # noqa: E731
    found = [[(p, q) for (a, p), (b, q) in product(ends(i), ends(j)) if a == b] for i, j in edges]
    table = np.full((max(map(len, found), default=0), 2, len(edges)), 2 * size, np.int32)
    for edge, shared in enumerate(found):
        for term, both in enumerate(shared):
            table[term, :, edge] = both
    return table


__all__ = ["Elimination", "Level", "Pairs", "plan_elimination"]
