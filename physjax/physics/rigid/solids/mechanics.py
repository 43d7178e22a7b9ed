"""What a step of solids asks of the plane or of space, and the words that both have in common.

Worlds are the last axis of every array, so that one contact of all worlds is one stretch of memory. Each array is one
component: XLA on a CPU computes what is stacked once for every part of it, and without vector instructions.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.physics.contacts.surface import Surface

Sides = tuple[Array, Array]
"""The same number of both bodies of each contact."""
Points = tuple[Array, ...]
"""The same number at each point of each contact: an array for each, or one with an axis of points in front of the contacts."""
Velocity = tuple[Array, ...]
"""Velocities of bodies `(..., bodies, worlds)`: those of the centers of mass [m/s], then the angular ones [rad/s]."""
Speeds = tuple[Array, ...]
"""How second bodies move relative to first ones at contacts, in the directions of each contact."""
Impulses = tuple[Array, ...]
"""Impulses [N s] of contacts on their second bodies: one array or more of friction, then those along the normal at each point."""
Kept = tuple[Array, ...]
"""What is kept of contacts in groups from one sub-step to the next."""


Spread = Callable[[tuple[Velocity, Velocity]], tuple[Velocity, Velocity]]
"""Of changes of the velocities of both bodies of contacts, were they free, what is left where they are joined to others."""


class Pose(NamedTuple):
    """Where bodies are and how fast they move, each component `(bodies, worlds)`."""

    place: tuple[Array, ...]
    rate: Velocity


class Demand(NamedTuple):
    """What a sweep asks of each point: its speed of separation [m/s] at least, and how.

    A point that `yields` is asked softly: its impulse is less by as much as a spring gives way (`Softness`). Where it is not
    `active` there is no impulse.
    """

    speed: Points
    yields: Points
    active: Points

    @classmethod
    def hard(cls, speed: Points, active: Points) -> "Demand":
        """These speeds, of those that are active."""
        none = jnp.zeros_like(active[0])
        return cls(speed, (none,) * len(active), active)


class Softness(NamedTuple):
    """A contact spring and damper as numbers of a solver: the share of an overlap cured in a sub-step, and how it yields.

    With ω h and ζ, cure = ωh/(2ζ + ωh), and the impulse is that of a hard contact whose matrix has a diagonal larger by the
    factor `yielding` = 1 + 1/(ωh (2ζ + ωh)): E. Catto, "Soft Constraints" (2011).
    """

    cure: float
    yielding: float

    @classmethod
    def of(cls, periods: float, damping_ratio: float) -> "Softness":
        """Of a spring with a period of as many sub-steps."""
        angle = 6.283185307179586 / periods
        return cls(angle / (2 * damping_ratio + angle), 1 + 1 / (angle * (2 * damping_ratio + angle)))


SOFT = Softness.of(periods=2.0, damping_ratio=0.5)
"""As stiff as a sub-step resolves: with a longer period towers lean and sway, and with more damping they take longer to stop."""

ALTERNATIONS = 2
"""Of normal and friction within a contact."""


class Touching(NamedTuple):
    """Contacts in groups, the gap of each point [m], and the points [m] by components, `(points, groups, size, worlds)`.

    `carried` of the contacts is how surfaces move in the mean of a sub-step, `carried_at_end` at its end: None where none
    turns or is driven.
    """

    contacts: Any
    gap: Points
    points: tuple[Array, ...]
    carried_at_end: tuple[Array, ...] | None = None


class Mechanics(ABC):
    """How bodies are placed, move and touch in the plane, or in space.

    `remembered` is how many numbers are kept of a contact from one step to the next, `freedoms` in how many ways a body
    moves, `rubbing` how many arrays of impulses are friction's, `straight` how many arrays of velocities are those of the
    centers of mass. What is asked of contacts is asked of one group: its arrays are `(..., size, worlds)`.
    """

    remembered: ClassVar[int]
    freedoms: ClassVar[int]
    rubbing: ClassVar[int]
    straight: ClassVar[int]

    # bodies

    @abstractmethod
    def read_pose(self, state: Any, scene: Any) -> Pose:
        """Where the bodies of a state of the scene are and how fast they move."""

    @abstractmethod
    def find_mean_rate(self, start: Pose, moved: Pose, h: Array) -> Velocity:
        """The mean velocities along the way from one pose to another in a time h [s], `(1, worlds)`."""

    @abstractmethod
    def write_pose(self, states: tuple[Any, Any], moves: Velocity, rates: Velocity, scene: Any) -> Any:
        """The second of two states with places moved on [m, rad] and velocities changed, by impulses where the first was."""

    @abstractmethod
    def read_turning(self, scene: Any, groups: Any, free: Array) -> Any:
        """What does not change in a step of how easily bodies are turned; `free` is 0 of those that are held."""

    # geometry

    @abstractmethod
    def list_slots(self, surfaces: Sequence[Surface], shapes: Sequence[Any]) -> list[Any]:
        """The places for contacts of every body with these surfaces, each with a `surface`."""

    @abstractmethod
    def find_contacts(self, world: Any, place: tuple[Array, ...], t: ArrayLike) -> Touching:
        """All contacts of bodies at these places, in groups: of pairs, then with each surface."""

    @abstractmethod
    def link(self, contacts: Any, spread: Spread) -> Any:
        """All contacts, of bodies that move otherwise than alone where impulses change the velocities of both."""

    @abstractmethod
    def free(self, contacts: Any) -> Any:
        """All contacts, of bodies whose masses and moments are one: what these change in velocities is what acts on bodies."""

    # contacts of one group

    @abstractmethod
    def find_speeds(self, ends: tuple[Velocity, Velocity], contacts: Any) -> Speeds:
        """How b moves relative to a along the directions of each contact."""

    @abstractmethod
    def find_openings(self, speeds: Speeds, contacts: Any) -> Points:
        """How fast b moves away from a along the normal at each point [m/s]."""

    @abstractmethod
    def find_slip(self, speeds: Speeds, contacts: Any) -> Array:
        """How fast b slides over a [m/s]."""

    @abstractmethod
    def solve_contact(self, speeds: Speeds, contacts: Any, demand: Demand, impulses: Impulses) -> Impulses:
        """The impulses that meet the demand, where `impulses` have brought about these speeds."""

    @abstractmethod
    def find_changes(self, contacts: Any, impulses: Impulses) -> tuple[Velocity, Velocity]:
        """What impulses on b, and the opposite ones on a, change in the velocities of both."""

    @abstractmethod
    def measure_size(self, impulses: Impulses, contacts: Any) -> Array:
        """The greatest of the impulses of each contact [N s]; what its points only share among each other is none."""

    @abstractmethod
    def find_any(self, points: Points) -> Array:
        """Whether any point of a contact is flagged, with as many axes as an array of friction."""

    @abstractmethod
    def spread(self, number: Array) -> Array:
        """A number of contacts with as many axes as one of points."""

    # memory

    @abstractmethod
    def recall(self, kept: Kept, contacts: Any) -> Impulses:
        """The impulses of contacts of which these numbers were kept."""

    @abstractmethod
    def keep(self, impulses: Impulses, contacts: Any) -> Kept:
        """The numbers that are kept of impulses."""

    @abstractmethod
    def unpack(self, memory: Array) -> Kept:
        """What is kept, of its numbers `(remembered, groups, size, worlds)`."""

    @abstractmethod
    def pack(self, kept: Kept) -> Array:
        """The numbers of what is kept, `(remembered, groups, size, worlds)`."""


def map_components(function: Callable[..., Array], *parts: tuple[Array, ...]) -> tuple[Array, ...]:
    """The function of the components, one by one."""
    return tuple(function(*each) for each in zip(*parts, strict=True))


def by_world(number: Array, like: Array) -> Array:
    """A number of each world with as many axes as another array."""
    return number.reshape((1,) * (like.ndim - 1) + (-1,))


def find_largest(parts: Sequence[Array]) -> Array:
    """The largest number of each world."""
    return reduce(jnp.maximum, [jnp.max(part, axis=tuple(range(part.ndim - 1))) for part in parts])


__all__ = [
    "ALTERNATIONS",
    "SOFT",
    "Demand",
    "Impulses",
    "Kept",
    "Mechanics",
    "Points",
    "Pose",
    "Sides",
    "Softness",
    "Speeds",
    "Touching",
    "Velocity",
    "by_world",
    "find_largest",
    "map_components",
]
