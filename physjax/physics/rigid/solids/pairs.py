"""Which contacts are solved at the same time: groups in which no body comes up twice, one after the other."""

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from physjax.checks import NestedArrayLike

MAX_BODIES_WITH_ALL_PAIRS = 64
"""Most bodies of which every pair is followed where none are given."""


class Groups(NamedTuple):
    """Contacts in groups: `contact`, `a` and `b` are `(groups, size)` numbers of contacts and of the rows of their bodies.

    Places that are left over have the number of contacts there are. Rows of `bodies` come first; each place of a group has
    two rows after these for what does not move, so that no row comes up twice. The first `of_pairs` groups are of pairs.
    """

    contact: np.ndarray
    a: np.ndarray
    b: np.ndarray
    rows: int
    of_pairs: int

    @property
    def size(self) -> int:
        """Places in a group."""
        return self.contact.shape[1]

    @property
    def is_contact(self) -> np.ndarray:
        """Which places have a contact, `(groups, size)`."""
        # of what is left over, both rows are of nothing
        return self.a < self.rows - 2 * self.size


def list_pairs(given: NestedArrayLike | None, bodies: int) -> np.ndarray:
    """The pairs of bodies that can touch, `(pairs, 2)`: those given, else all."""
    if given is None:
        if bodies > MAX_BODIES_WITH_ALL_PAIRS:
            raise ValueError(
                f"Solids: got {bodies} bodies and no pairs, expected at most {MAX_BODIES_WITH_ALL_PAIRS} bodies, or pairs= "
                "of those that can touch, (pairs, 2)."
            )
        pairs = np.array(list(combinations(range(bodies), 2)), int).reshape(-1, 2)
    else:
        pairs = np.asarray(given)
        pairs = pairs if pairs.size else np.zeros((0, 2), int)
        wrong = pairs.ndim != 2 or pairs.shape[-1:] != (2,) or pairs.dtype.kind not in "iu"
        if wrong or (pairs < 0).any() or (pairs >= bodies).any() or (pairs[:, 0] == pairs[:, 1]).any():
            raise ValueError(
                f"pairs: got {pairs.dtype} of shape {pairs.shape}, expected (pairs, 2) whole numbers from 0 to {bodies - 1}, "
                "each pair of two different bodies."
            )
        if len(np.unique(np.sort(pairs, axis=1), axis=0)) < len(pairs):
            raise ValueError("pairs: got a pair twice, expected each once.")
    return pairs


def group_contacts(pairs: np.ndarray, surfaces: int, bodies: int) -> Groups:
    """Groups of the contacts of pairs, followed by those of every body with each surface in turn."""
    size = max(1, -(-bodies // 2)) if len(pairs) else bodies
    grouped = _colour_pairs(pairs, size)
    of_pairs = len(grouped)
    for surface in range(surfaces):
        numbers = [(len(pairs) + surface * bodies + body, body, -1) for body in range(bodies)]
        grouped += [numbers[i : i + size] for i in range(0, len(numbers), size)]
    total = len(pairs) + surfaces * bodies
    contact, a, b = (np.zeros((len(grouped), size), int) for _ in range(3))
    for g, members in enumerate(grouped):
        for place in range(size):
            still = bodies + 2 * place
            number, first, second = members[place] if place < len(members) else (total, still, still + 1)
            contact[g, place], a[g, place] = number, first
            b[g, place] = second if second >= 0 else still
    return Groups(contact, a, b, bodies + 2 * size, of_pairs)


def _colour_pairs(pairs: np.ndarray, size: int) -> list[list[tuple[int, int, int]]]:
    """Each pair in the first group that has room and neither of its bodies."""
    groups = part_contacts([(a, b) for a, b in pairs.tolist()], size)
    return [[(number, *pairs[number].tolist()) for number in members] for members in groups]


def part_contacts(moves: Sequence[tuple[int, ...]], size: int) -> list[list[int]]:
    """Numbers of contacts in groups of no more than a size, each in the first that has nothing else which moves what it moves."""
    groups: list[list[int]] = []
    busy: list[set[int]] = []
    for number, names in enumerate(moves):
        fitting = (g for g, taken in enumerate(busy) if taken.isdisjoint(names) and len(groups[g]) < size)
        place = next(fitting, None)
        if place is None:
            groups.append([])
            busy.append(set())
            place = len(groups) - 1
        groups[place].append(number)
        busy[place].update(names)
    return groups


__all__ = ["Groups", "group_contacts", "list_pairs", "part_contacts"]
