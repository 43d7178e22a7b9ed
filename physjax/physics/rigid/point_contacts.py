"""Contact points at their surfaces: where each is, and which of them touch and which of those stay.

What touches and what stays is judged by the load of a step: a point closer than a small share of the way that the load
moves a body in it, and slower than a share of the speed that it gives, would not get away within the step.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from physjax.loops import Time, to_float_time
from physjax.particles import Particles
from physjax.parts import Contact
from physjax.physics.contacts.events import Dip, find_dip
from physjax.physics.contacts.face import LowestPoint
from physjax.physics.rigid.contact_points import ContactPoints
from physjax.physics.rigid.impulses import Points
from physjax.physics.rigid.spatial import RigidBodies
from physjax.scene import Scene
from physjax.stacks import Stack, stack_alike
from physjax.vectors import dot, norm

RESTING_SPEED_SHARE = 0.1
"""Share of the speed that a step's load gives below which a point that touches stays, neither bouncing nor leaving."""
CONTACT_DISTANCE_SHARE = 1e-3
"""Share of the way that a step's load gives below which a point touches."""
DISTANCE_ROUNDING = 64
"""Units of rounding of its place, and of its way in a step, below which a point touches."""
SPEED_ROUNDING = 16
"""Units of rounding of its speed below which a point stays."""

T = TypeVar("T")


class ContactPointState(NamedTuple):
    """Contact points at their surfaces, the points first: `points` on the hull, `center` a radius [m] above each.

    `signed_distance` [m] is that of the hull. `turning` is how fast the normal turns below the moving center [1/s], with
    the radius; None where all surfaces are flat. `carried_rate` [m/s²] is how fast the velocity of the surface changes
    where the moving point touches it; None where none turns.
    """

    points: Points
    center: Particles
    signed_distance: Array
    restitution: Array
    turning: tuple[Array, Array] | None
    carried_rate: Array | None


class PointContact(Contact):
    """A contact of the points of bodies with a surface, which `collide` resolves."""

    hull: ContactPoints

    @property
    @abstractmethod
    def narrow(self) -> bool:
        """Whether a fast point may pass through the surface and out again within a step."""

    @property
    @abstractmethod
    def moves(self) -> bool:
        """Whether the surface may be elsewhere at another time."""

    @abstractmethod
    def point_state(self, t: ArrayLike, bodies: RigidBodies, velocities: tuple[Array, Array]) -> ContactPointState:
        """The points of the hull at the surface, of bodies with these velocities v and ω."""

    @abstractmethod
    def measure_points(self, t: ArrayLike, state: RigidBodies) -> Float[Array, "points *lanes"]:
        """Signed distance of each point of the hull to the surface [m]."""

    @abstractmethod
    def walls(self) -> tuple["PointContact", ...]:
        """A contact with each of the surfaces that its surface consists of."""

    @abstractmethod
    def facing(self, t: ArrayLike, state: RigidBodies) -> "PointContact":
        """The contact with the surface as each body meets it from where it is."""

    @abstractmethod
    def respond(self, t: ArrayLike, state: RigidBodies) -> RigidBodies:
        """The bodies on the wrong side moved out of the surface, their velocities unchanged."""

    @abstractmethod
    def normal_at(self, t: ArrayLike, position: Float[Array, "*lanes 3"]) -> Float[Array, "*lanes 3"]:
        """Unit vector away from the surface."""

    @abstractmethod
    def relative(
        self, t: ArrayLike, position: Float[Array, "*lanes 3"], velocity: Float[Array, "*lanes 3"]
    ) -> Float[Array, "*lanes 3"]:
        """Velocities relative to the surface [m/s]."""

    @abstractmethod
    def deepest(self, t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles, dip: LowestPoint) -> LowestPoint:
        """Where in a leg a point comes lowest, as a share of it, and its distance there [m]."""


ContactKind = Stack[PointContact]
"""Contacts that differ in numbers only."""


def stack_body_contacts(scene: Scene) -> tuple[ContactKind, ...]:
    """The contacts of bodies with surfaces by kind, of a room those with its walls; not those of bodies with each other.

    All points on all surfaces of a kind are evaluated at once: sixty walls cost what one costs to compile.
    """
    contacts = [wall for contact in scene.contacts if isinstance(contact, PointContact) for wall in contact.walls()]
    return stack_alike([jax.tree.map(jnp.asarray, contact) for contact in contacts])


def face_surfaces(kinds: tuple[ContactKind, ...], t: Time, state: RigidBodies) -> tuple[ContactKind, ...]:
    """The contacts as each body meets them from where it is."""
    time = to_float_time(t)
    return tuple(kind.replace(lambda contact: contact.facing(time, state)) for kind in kinds)


def count_points(kinds: tuple[ContactKind, ...]) -> int:
    """How many points all contacts together have."""
    return sum(kind.size * kind.part.hull.points.shape[-2] for kind in kinds)


def gather_point_states(
    kinds: tuple[ContactKind, ...], t: Time, state: RigidBodies, velocities: tuple[Array, Array]
) -> ContactPointState:
    """Every point of every hull at its surface, joined along the axis of points.

    What only some surfaces have, curvature, friction or a turn of their own, is zero at the others.
    """
    parts = _map_points(kinds, lambda contact: contact.point_state(to_float_time(t), state, velocities))
    if len(parts) == 1:
        return parts[0]
    if any(part.turning is not None for part in parts):
        flat = lambda part: (jnp.zeros_like(part.points.normal), jnp.zeros_like(part.signed_distance))  # noqa: E731
        parts = [part._replace(turning=part.turning or flat(part)) for part in parts]
    if any(part.points.friction is not None for part in parts):
        zero = lambda part: (jnp.zeros_like(part.signed_distance), jnp.zeros_like(part.signed_distance))  # noqa: E731
        rough = [part.points._replace(friction=part.points.friction or zero(part)) for part in parts]
        parts = [part._replace(points=points) for part, points in zip(parts, rough, strict=True)]
    if any(part.carried_rate is not None for part in parts):
        still = lambda part: jnp.zeros_like(part.points.normal)  # noqa: E731
        parts = [p if p.carried_rate is not None else p._replace(carried_rate=still(p)) for p in parts]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


def measure_points(kinds: tuple[ContactKind, ...], t: Time, state: RigidBodies) -> Float[Array, "points *lanes"]:
    """The signed distance of every point of every hull to its surface [m]."""
    return jnp.concatenate(_map_points(kinds, lambda contact: contact.measure_points(to_float_time(t), state)))


def _map_points(kinds: tuple[ContactKind, ...], function: Callable[[PointContact], T]) -> list[T]:
    """What a function makes of the points of each kind of contacts, all of a kind along one axis."""
    return [function(kind.part) if kind.size == 1 else _join_contacts(kind.map(function)) for kind in kinds]


def _join_contacts(tree: T) -> T:
    """Arrays `(contacts, points, ...)` with all points along one axis."""
    return jax.tree.map(lambda leaf: leaf.reshape(leaf.shape[0] * leaf.shape[1], *leaf.shape[2:]), tree)


def find_touching_points(
    point_state: ContactPointState, state: RigidBodies, load_speed: Array, dt: Array
) -> Bool[Array, "points *lanes"]:
    """Which points touch: closer than a small share of the way that a step's load gives, or than rounding."""
    eps = float(jnp.finfo(state.dtype).eps)
    # by the places that the distance was computed from: far from the origin it is known less well
    rounding = (
        DISTANCE_ROUNDING * eps * (norm(point_state.center.position) + dt[None] * norm(point_state.center.velocity))
    )
    return point_state.signed_distance <= (CONTACT_DISTANCE_SHARE * load_speed * dt)[None] + rounding


def find_resting_points(
    point_state: ContactPointState, state: RigidBodies, load_speed: Array, dt: Array
) -> Bool[Array, "points *lanes"]:
    """Which points touch and stay: the others leave, or are about to strike."""
    speed = jnp.abs(dot(point_state.points.velocity, point_state.points.normal))
    rounding = SPEED_ROUNDING * float(jnp.finfo(state.dtype).eps) * norm(point_state.center.velocity)
    return find_touching_points(point_state, state, load_speed, dt) & (
        speed <= RESTING_SPEED_SHARE * load_speed[None] + rounding
    )


def find_dips(kinds: tuple[ContactKind, ...], on: Array, start: Particles, end: Particles, t: Time, dt: Array) -> Dip:
    """Which points meet their surface within a leg, bracketed by the cubics of their signed distances.

    The points are where the centers of their radii are. Those that rest (`on`) are carried and meet nothing.
    """
    parts, first = [], 0
    for kind in kinds:
        points = kind.part.hull.points.shape[-2]
        some = slice(first, first := first + kind.size * points)
        before, after = (
            Particles(*(leaf[some].reshape(kind.size, points, *leaf.shape[1:]) for leaf in places))
            for places in (start, end)
        )
        lanes = before.position.shape[1:-1]
        times, steps = (jnp.broadcast_to(number, lanes) for number in (to_float_time(t), dt))
        find = lambda contact, before, after, times=times, steps=steps: find_dip(contact, times, steps, before, after)  # noqa: E731
        parts.append(_join_contacts(kind.map(find, before, after)))
    dip = parts[0] if len(parts) == 1 else jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    return dip._replace(last=jnp.where(on, jnp.inf, dip.last))
