"""The mechanics of solids in the plane: a body turns by one angle, and touches with two points along one line."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.physics.contacts.surface import Surface
from physjax.physics.rigid.planar import impulses as impulses_of_contacts
from physjax.physics.rigid.planar.bodies import PlanarBodies
from physjax.physics.rigid.planar.impulses import Contacts
from physjax.physics.rigid.planar.surfaces import Slot, list_slots
from physjax.physics.rigid.planar.touching import find_contacts
from physjax.physics.rigid.solids.mechanics import (
    Demand,
    Impulses,
    Kept,
    Mechanics,
    Points,
    Pose,
    Sides,
    Speeds,
    Spread,
    Touching,
    Velocity,
    map_components,
)
from physjax.physics.rigid.solids.pairs import Groups
from physjax.physics.rigid.solids.world import World, take_sides
from physjax.scene import Scene


class PlanarMechanics(Mechanics):
    """Places and velocities are along x, y and anticlockwise; impulses along the tangent and the normal at both points."""

    remembered = 3
    freedoms = 3
    rubbing = 1
    straight = 2

    def read_pose(self, state: PlanarBodies, scene: Scene) -> Pose:
        """Where the bodies of a state of the scene are and how fast they move."""
        bodies = state.lanes[-1]
        by_body = lambda number: number.reshape(-1, bodies).T  # noqa: E731
        mass, moment = (jnp.broadcast_to(number, state.lanes) for number in (scene.mass.mass, scene.mass.moment))
        x, y, px, py = state.position[..., 0], state.position[..., 1], state.momentum[..., 0], state.momentum[..., 1]
        return Pose(
            tuple(map(by_body, (x, y, state.angle))),
            tuple(map(by_body, (px / mass, py / mass, state.angular_momentum / moment))),
        )

    def find_mean_rate(self, start: Pose, moved: Pose, h: Array) -> Velocity:
        """The change of places over the time [s]."""
        return map_components(lambda a, b: (b - a) / h, start.place, moved.place)

    def write_pose(
        self, states: tuple[PlanarBodies, PlanarBodies], moves: Velocity, rates: Velocity, scene: Scene
    ) -> PlanarBodies:
        """The second state with places [m, rad] and velocities changed."""
        _, state = states
        by_lane = lambda number: number.T.reshape(state.lanes)  # noqa: E731
        (x, y, angle), (vx, vy, omega) = map_components(by_lane, moves), map_components(by_lane, rates)
        mass, moment = (jnp.broadcast_to(number, state.lanes) for number in (scene.mass.mass, scene.mass.moment))
        return PlanarBodies(
            state.position + jnp.stack([x, y], axis=-1),
            state.angle + angle,
            state.momentum + jnp.stack([mass * vx, mass * vy], axis=-1),
            state.angular_momentum + moment * omega,
        )

    def read_turning(self, scene: Scene, groups: Groups, free: Array) -> Sides:
        """1/I of both bodies of each contact [1/(kg m²)], `(groups, size, worlds)`."""
        return take_sides(free / scene.mass.moment, groups)

    def list_slots(self, surfaces: Sequence[Surface], shapes: Sequence[Any]) -> list[Slot]:
        """The places for contacts of every body with these surfaces."""
        return list_slots(surfaces)

    def find_contacts(self, world: World, place: tuple[Array, ...], t: ArrayLike) -> Touching:
        """All contacts of bodies at these places: of pairs, then with each surface."""
        return find_contacts(world, place, t)

    def link(self, contacts: Contacts, spread: Spread) -> Contacts:
        """All contacts, of bodies that move otherwise than alone where impulses change the velocities of both."""
        return impulses_of_contacts.link(contacts, spread)

    def free(self, contacts: Contacts) -> Contacts:
        """All contacts, of bodies whose masses and moments are one."""
        one = jnp.ones_like(contacts.friction)
        return contacts._replace(mass=(one, one), moment=(one, one))

    def find_speeds(self, ends: tuple[Velocity, Velocity], contacts: Contacts) -> Speeds:
        """How fast b moves away from a along the tangent, and along the normal at both points [m/s]."""
        return impulses_of_contacts.find_speeds(ends, contacts)

    def find_openings(self, speeds: Speeds, contacts: Contacts) -> Points:
        """How fast b moves away from a along the normal at both points [m/s]."""
        return speeds[1:]

    def find_slip(self, speeds: Speeds, contacts: Contacts) -> Array:
        """How fast b slides over a [m/s]."""
        return jnp.abs(speeds[0])

    def solve_contact(self, speeds: Speeds, contacts: Contacts, demand: Demand, impulses: Impulses) -> Impulses:
        """Friction, then both normals together, in turns."""
        return impulses_of_contacts.solve_contact(speeds, contacts, demand, impulses)

    def find_changes(self, contacts: Contacts, impulses: Impulses) -> tuple[Velocity, Velocity]:
        """What impulses on b, and the opposite ones on a, change in the velocities of both."""
        return impulses_of_contacts.find_changes(contacts, impulses)

    def measure_size(self, impulses: Impulses, contacts: Contacts) -> Array:
        """The greatest of the three."""
        across, first, second = map(jnp.abs, impulses)
        return jnp.maximum(jnp.maximum(across, first), second)

    def find_any(self, points: Points) -> Array:
        """Whether one of both points is flagged."""
        return points[0] | points[1]

    def spread(self, number: Array) -> Array:
        """The number: each point has an array of its own."""
        return number

    def recall(self, kept: Kept, contacts: Contacts) -> Impulses:
        """The impulses as they were: points keep their order from step to step."""
        return kept

    def keep(self, impulses: Impulses, contacts: Contacts) -> Kept:
        """The impulses as they are."""
        return impulses

    def unpack(self, memory: Array) -> Kept:
        """Three arrays."""
        return tuple(memory)

    def pack(self, kept: Kept) -> Array:
        """The three arrays as one."""
        return jnp.stack(kept)


PLANE = PlanarMechanics()
"""The mechanics of `rigid.PlanarBodies`."""

__all__ = ["PLANE", "PlanarMechanics"]
