"""The mechanics of solids in space: a body turns by a quaternion, and touches with four points in a plane."""

from collections.abc import Sequence
from functools import reduce

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.physics.contacts.surface import Surface
from physjax.physics.rigid.solids.mechanics import (
    Demand,
    Impulses,
    Kept,
    Mechanics,
    Points,
    Pose,
    Speeds,
    Spread,
    Touching,
    Velocity,
)
from physjax.physics.rigid.solids.pairs import Groups
from physjax.physics.rigid.solids.world import World
from physjax.physics.rigid.space import impulses as impulses_of_contacts
from physjax.physics.rigid.space.components import multiply, multiply_back
from physjax.physics.rigid.space.impulses import Contacts
from physjax.physics.rigid.space.shapes import Shape
from physjax.physics.rigid.space.surfaces import Slot, list_slots
from physjax.physics.rigid.space.touching import find_contacts
from physjax.physics.rigid.space.turning import Turning
from physjax.physics.rigid.spatial import RigidBodies, angular_velocity
from physjax.scene import Scene
from physjax.vectors import multiply_quaternions


class SpatialMechanics(Mechanics):
    """Places are x, y, z and a quaternion, velocities along x, y, z and about them, in the world.

    Impulses are friction's along both tangents and about the normal, and the normal ones of four points. Of a contact the
    force and the torque about its middle are remembered, in the world: its points may change from step to step.
    """

    remembered = 6
    freedoms = 6
    rubbing = 3
    straight = 1

    def read_pose(self, state: RigidBodies, scene: Scene) -> Pose:
        """Where the bodies of a state of the scene are and how fast they move."""
        mass = jnp.broadcast_to(scene.mass.mass, state.lanes)
        velocity = state.momentum / mass[..., None]
        spin = angular_velocity(state, scene.mass)
        place, turn, velocity, spin = map(_by_body, (state.position, state.orientation, velocity, spin))
        return Pose((place, turn), (velocity, spin))

    def find_mean_rate(self, start: Pose, moved: Pose, h: Array) -> Velocity:
        """The change of places over the time [s], and the mean of both angular velocities."""
        return (moved.place[0] - start.place[0]) / h[None], (start.rate[1] + moved.rate[1]) / 2

    def write_pose(
        self, states: tuple[RigidBodies, RigidBodies], moves: Velocity, rates: Velocity, scene: Scene
    ) -> RigidBodies:
        """The second state moved and turned on [m, rad], with momenta changed by impulses where the first was."""
        start, state = states
        by_lane = lambda part: jnp.transpose(part, (2, 1, 0)).reshape(*state.lanes, -1)  # noqa: E731
        mass = jnp.broadcast_to(scene.mass.mass, state.lanes)
        turning = Turning.of(scene.mass, jnp.ones(state.lanes, state.dtype))
        spin = multiply(turning.find_inertia(_by_body(start.orientation)), rates[1])
        turned = multiply_quaternions(_find_rotation(list(moves[1])), list(_by_body(state.orientation)))
        return RigidBodies(
            state.position + by_lane(moves[0]),
            by_lane(jnp.stack(turned)),
            state.momentum + mass[..., None] * by_lane(rates[0]),
            state.angular_momentum + by_lane(spin),
        )

    def read_turning(self, scene: Scene, groups: Groups, free: Array) -> Turning:
        """The inverse moments of all bodies, and the axes they are about."""
        return Turning.of(scene.mass, free)

    def list_slots(self, surfaces: Sequence[Surface], shapes: Sequence[Shape]) -> list[Slot]:
        """The places for contacts of every body with these surfaces."""
        return list_slots(surfaces, shapes)

    def find_contacts(self, world: World, place: tuple[Array, ...], t: ArrayLike) -> Touching:
        """All contacts of bodies at these places: of pairs, then with each surface."""
        return find_contacts(world, place, t)

    def link(self, contacts: Contacts, spread: Spread) -> Contacts:
        """All contacts, of bodies that move otherwise than alone where impulses change the velocities of both."""
        return impulses_of_contacts.link(contacts, spread)

    def free(self, contacts: Contacts) -> Contacts:
        """All contacts, of bodies whose masses and moments are one."""
        one = jnp.ones_like(contacts.mass[0])
        turning = jnp.eye(3, dtype=one.dtype)[None, :, :, None, None] * one[:, None, None]
        return contacts._replace(mass=(one, one), turning=(turning, turning))

    def find_speeds(self, ends: tuple[Velocity, Velocity], contacts: Contacts) -> Speeds:
        """The twist of b relative to a in the frame of each contact."""
        return impulses_of_contacts.find_speeds(ends, contacts)

    def find_openings(self, speeds: Speeds, contacts: Contacts) -> Points:
        """How fast b moves away from a along the normal at each point [m/s]."""
        return (impulses_of_contacts.find_openings(speeds, contacts),)

    def find_slip(self, speeds: Speeds, contacts: Contacts) -> Array:
        """How fast the point that slides fastest does so [m/s]."""
        return impulses_of_contacts.find_slip(speeds, contacts)

    def solve_contact(self, speeds: Speeds, contacts: Contacts, demand: Demand, impulses: Impulses) -> Impulses:
        """All points that press together, then friction, in turns."""
        return impulses_of_contacts.solve_contact(speeds, contacts, demand, impulses)

    def find_changes(self, contacts: Contacts, impulses: Impulses) -> tuple[Velocity, Velocity]:
        """What impulses on b, and the opposite ones on a, change in the velocities of both."""
        return impulses_of_contacts.find_changes(contacts, impulses)

    def measure_size(self, impulses: Impulses, contacts: Contacts) -> Array:
        """The greatest part of the force, or of the torque over the distance of the points from the middle."""
        (x, y), parts = contacts.places, impulses_of_contacts.find_wrench(contacts, impulses)
        push, turn = (reduce(jnp.maximum, map(jnp.abs, part)) for part in parts)
        reach = jnp.max(jnp.maximum(jnp.abs(x), jnp.abs(y)), axis=0)
        return jnp.maximum(push, jnp.where(reach > 0, turn / jnp.where(reach > 0, reach, 1.0), 0.0))

    def find_any(self, points: Points) -> Array:
        """Whether any of four points is flagged."""
        return jnp.any(points[0], axis=0)

    def spread(self, number: Array) -> Array:
        """The number with an axis of points in front."""
        return number[None]

    def recall(self, kept: Kept, contacts: Contacts) -> Impulses:
        """The impulses with the force and torque that were kept, shared among the points as evenly as can be."""
        force, torque = (multiply(contacts.axes, part) for part in kept)
        return force[0], force[1], torque[2], impulses_of_contacts.share_push(contacts, force[2], torque)

    def keep(self, impulses: Impulses, contacts: Contacts) -> Kept:
        """The force and the torque about the middle of the contact, in the world [N s, N m s]."""
        force, torque = impulses_of_contacts.find_wrench(contacts, impulses)
        return multiply_back(contacts.axes, force), multiply_back(contacts.axes, torque)

    def unpack(self, memory: Array) -> Kept:
        """The force and the torque of contacts in groups, `(groups, 3, ...)` each."""
        return jnp.moveaxis(memory[:3], 0, 1), jnp.moveaxis(memory[3:], 0, 1)

    def pack(self, kept: Kept) -> Array:
        """Both with their numbers in front."""
        return jnp.moveaxis(jnp.concatenate(kept, axis=1), 1, 0)


def _by_body(array: Array) -> Array:
    """An array of vectors `(*worlds, bodies, dim)` as `(dim, bodies, worlds)`."""
    return jnp.transpose(array.reshape(-1, *array.shape[-2:]), (2, 1, 0))


def _find_rotation(angle: Sequence[Array]) -> list[Array]:
    """The quaternion of a rotation vector [rad]."""
    x, y, z = (part / 2 for part in angle)
    square = x * x + y * y + z * z
    there = square > 0
    half = jnp.sqrt(jnp.where(there, square, 1.0))
    share = jnp.where(there, jnp.sin(half) / half, 1.0)
    return [jnp.where(there, jnp.cos(half), 1.0), share * x, share * y, share * z]


SPACE = SpatialMechanics()
"""The mechanics of `RigidBodies`."""

__all__ = ["SPACE", "SpatialMechanics"]
