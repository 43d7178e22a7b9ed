"""Contact points at their surfaces: where each is, and which of them touch and which of those stay.

What touches and what stays is judged by the load of a step: a point closer than a small share of the way that the load
moves a body in it, and slower than a share of the speed that it gives, would not get away within the step.
"""

from abc import abstractmethod
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from physjax.loops import Time, to_float_time
from physjax.particles import Particles
from physjax.parts import Contact
from physjax.physics.contacts.events import Dip, find_dip
from physjax.physics.contacts.face import LowestPoint
from physjax.physics.rigid.contact_points import ContactPoints
from physjax.physics.rigid.impulses import Points
from physjax.physics.rigid.inertia import Inertia
from physjax.physics.rigid.spatial import RigidBodies
from physjax.scene import Scene
from physjax.vectors import dot, norm

RESTING_SPEED_SHARE = 0.1
"""Share of the speed that a step's load gives below which a point that touches stays, neither bouncing nor leaving."""
CONTACT_DISTANCE_SHARE = 1e-3
"""Share of the way that a step's load gives below which a point touches."""
DISTANCE_ROUNDING = 64
"""Units of rounding of its place, and of its way in a step, below which a point touches."""
SPEED_ROUNDING = 16
"""Units of rounding of its speed below which a point stays."""


class ContactPointState(NamedTuple):
    """Contact points at their surfaces, the points first: `points` on the hull, `center` a radius [m] above each.

    `signed_distance` [m] is that of the hull. `turning` is how fast the normal turns below the moving center [1/s], with
    the radius; None where all surfaces are flat.
    """

    points: Points
    center: Particles
    signed_distance: Array
    restitution: Array
    turning: tuple[Array, Array] | None


class PointContact(Contact):
    """A contact of the points of bodies with a surface, which `collide` resolves."""

    hull: ContactPoints

    @property
    @abstractmethod
    def narrow(self) -> bool:
        """Whether a fast point may pass through the surface and out again within a step."""

    @abstractmethod
    def point_state(self, t: ArrayLike, bodies: RigidBodies, inertia: Inertia) -> ContactPointState:
        """The points of the hull at the surface."""

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
    def relative(self, velocity: Float[Array, "*lanes 3"]) -> Float[Array, "*lanes 3"]:
        """Velocities relative to the surface [m/s]."""

    @abstractmethod
    def deepest(self, t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles, dip: LowestPoint) -> LowestPoint:
        """Where in a leg a point comes lowest, as a share of it, and its distance there [m]."""


def list_body_contacts(scene: Scene) -> list[PointContact]:
    """The contacts of bodies with surfaces; not those of bodies with each other."""
    return [contact for contact in scene.contacts if isinstance(contact, PointContact)]


def use_facing_surfaces(scene: Scene, t: Time) -> Scene:
    """The scene with its surfaces as its bodies meet them from where they are: of a room its walls, of a slab the nearer face."""
    facing = []
    for contact in scene.contacts:
        if isinstance(contact, PointContact):
            facing += [wall.facing(to_float_time(t), scene.state) for wall in contact.walls()]
        else:
            facing.append(contact)
    return scene.replace(contacts=tuple(facing))


def find_load_speed(scene: Scene, t: Time, dt: Array) -> Array:
    """The speed that the loads give in a step [m/s], which is the measure of small speeds and distances."""
    force, _ = scene.state.generalised_force(scene, t)
    return lax.stop_gradient(dt * norm(force) / scene.mass.mass)


def gather_point_states(scene: Scene, t: Time, state: RigidBodies) -> ContactPointState:
    """Every point of every hull at its surface, joined along the axis of points.

    What only some surfaces have, curvature or friction, is zero at the others.
    """
    parts = [contact.point_state(to_float_time(t), state, scene.mass) for contact in list_body_contacts(scene)]
    if len(parts) > 1 and any(part.turning is not None for part in parts):
        flat = lambda part: (jnp.zeros_like(part.points.normal), jnp.zeros_like(part.signed_distance))  # noqa: E731
        parts = [part._replace(turning=part.turning or flat(part)) for part in parts]
    if len(parts) > 1 and any(part.points.friction is not None for part in parts):
        zero = lambda part: (jnp.zeros_like(part.signed_distance), jnp.zeros_like(part.signed_distance))  # noqa: E731
        rough = [part.points._replace(friction=part.points.friction or zero(part)) for part in parts]
        parts = [part._replace(points=points) for part, points in zip(parts, rough, strict=True)]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


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


def find_resting_points_now(scene: Scene, t: Time, dt: Array) -> Array:
    """Which points touch and stay at the scene's own state."""
    point_state = lax.stop_gradient(gather_point_states(scene, t, scene.state))
    return find_resting_points(point_state, scene.state, find_load_speed(scene, t, dt), dt)


def find_dips(scene: Scene, on: Array, start: ContactPointState, end: ContactPointState, t: Time, dt: Array) -> Dip:
    """Which points meet their surface within a leg, bracketed by the cubics of their signed distances.

    Points that rest (`on`) are carried and meet nothing.
    """
    parts, first = [], 0
    for contact in list_body_contacts(scene):
        some = slice(first, first := first + contact.hull.points.shape[-2])
        lanes = start.signed_distance[some].shape
        times, steps = (jnp.broadcast_to(number, lanes) for number in (to_float_time(t), dt))
        before, after = (Particles(*(leaf[some] for leaf in point_state.center)) for point_state in (start, end))
        parts.append(find_dip(contact, times, steps, before, after))
    dip = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    return dip._replace(last=jnp.where(on, jnp.inf, dip.last))
