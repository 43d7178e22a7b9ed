"""What the search for impacts and the forces of resting contact need of a surface, as protocols.

A `Surface` for particles has all of it. A hull of contact points on a surface (`rigid.SurfaceContact`) has the geometry
alone: it is searched for impacts like a surface that lies a radius higher, and has a response of its own.
"""

from typing import Any, Protocol, runtime_checkable

from jax.typing import ArrayLike
from jaxtyping import Array, Bool

from physjax.checks import OptionalNumbers
from physjax.particles import Particles
from physjax.physics.contacts.restitution import Material

LowestPoint = tuple[Array, Array]
"""Where a path comes lowest, as a share of the step, and the signed distance [m] there."""


@runtime_checkable
class Face(Protocol):
    """The geometry of a surface: signed distance, normal, its own motion, and where a path dips below it."""

    def signed_distance(self, t: ArrayLike, position: Array) -> Array:
        """Signed distance [m], > 0 on the legal side."""
        ...

    def normal_at(self, t: ArrayLike, position: Array) -> Array:
        """Unit vector towards the legal side."""
        ...

    def relative(self, t: ArrayLike, position: Array, velocity: Array) -> Array:
        """Velocities relative to the surface [m/s]."""
        ...

    def clearance(self, t: ArrayLike, state: Any) -> Array:
        """How far each lane is from the surface [m]."""
        ...

    def deepest(self, t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles, dip: LowestPoint) -> LowestPoint:
        """Where the path through the ends of a step comes lowest, given where a cubic in time does."""
        ...


@runtime_checkable
class ContactFace(Face, Material, Protocol):
    """A surface that particles can rest on: its geometry with its curvature, restitution and friction."""

    curved: bool
    motion: Any
    touching_since: OptionalNumbers

    @property
    def moves(self) -> bool:
        """Whether it moves, or turns within itself."""
        ...

    @property
    def accelerates(self) -> bool:
        """Whether what sticks to it is accelerated."""
        ...

    def facing(self, t: ArrayLike, position: Array) -> "ContactFace":
        """The surface as a lane at this position meets it."""
        ...

    def velocity_at(self, t: ArrayLike, position: Array) -> Array | None:
        """The velocity of the surface itself at positions on it [m/s]; None where it does not move."""
        ...

    def acceleration_at(self, t: ArrayLike, position: Array) -> Array | None:
        """The acceleration of what sticks to the surface there [m/s²]; None where it has none."""
        ...

    def distance_acceleration(self, t: ArrayLike, state: Particles) -> Array:
        """The second time derivative of the signed distance of lanes that are not accelerated [m/s²]."""
        ...

    def may_meet(
        self, touching: Array, t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles
    ) -> Bool[Array, "*lanes"]:
        """Whether a lane may meet the surface within a step."""
        ...
