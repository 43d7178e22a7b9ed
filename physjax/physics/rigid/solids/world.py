"""What does not change in a step of solids: the groups in which contacts are solved, their materials, and the masses."""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from physjax.physics.contacts.restitution import Coulomb
from physjax.physics.contacts.surface import Surface
from physjax.physics.rigid.solids.links import Links, Response, Turns
from physjax.physics.rigid.solids.mechanics import Mechanics, Sides, Velocity, map_components
from physjax.physics.rigid.solids.pairs import Groups, group_contacts
from physjax.scene import Scene


@runtime_checkable
class SolidContact(Protocol):
    """What a step needs of the contact; `impulses` and `loads` are those of the step before, see `Solids`."""

    shapes: tuple[Any, ...]
    surfaces: tuple[Surface, ...]
    restitution: Any
    coulomb: Coulomb | None
    pairs: tuple[tuple[int, int], ...]
    substeps: int
    impulses: Array | None
    loads: Array | None

    @property
    def mechanics(self) -> Mechanics:
        """That of the plane or of space."""
        ...


class Materials(NamedTuple):
    """Of contacts in groups `(groups, size, 1)`: static and kinetic friction, restitution, and the velocity of b's surface."""

    static: Array
    kinetic: Array
    restitution: Array
    carried: tuple[Array, ...]


class World(NamedTuple):
    """What does not change in a step: the contact, its groups and materials, and how easily bodies are moved.

    `substep` is the length of a sub-step [s], `()` or one of each world; `mass` is 1/m of both bodies of each contact,
    `(groups, size, worlds)`, 0 of what is held; `turning` what the mechanics need of their inertia; `incidence` says of
    each body of which places in the groups it is the first and the second shape, in ones and zeros. `links` is what joints
    between the bodies do, None without.
    """

    solids: SolidContact
    mechanics: Mechanics
    size: int
    slots: list[Any]
    groups: Groups
    substep: Array
    mass: Sides
    turning: Any
    materials: Materials
    incidence: Sides
    links: Links | None = None

    @property
    def worlds(self) -> int:
        """The number of worlds."""
        return self.mass[0].shape[-1]

    @property
    def dtype(self) -> np.dtype:
        """Floating-point type of all numbers."""
        return self.mass[0].dtype

    def with_bodies(self, mass: Sides, turning: Any, responses: tuple[Response, Response | None] | None) -> "World":
        """The same contacts, of some of the worlds."""
        links = None if self.links is None or responses is None else Links(self.links.turns, *responses)
        return self._replace(mass=mass, turning=turning, links=links)

    def take_turns(self, turns: Turns) -> "World":
        """The contacts in turns, for what solves them; `mass` and `turning` stay those of the groups."""
        materials = turns.arrange(self.materials)
        return self._replace(
            groups=turns.groups, materials=materials, incidence=_find_incidence(turns.groups, self.size, self.dtype)
        )

    def pad(self, numbers: Array) -> Array:
        """Numbers of the bodies `(..., bodies, worlds)`, with rows of zeros after them of what does not move."""
        in_front = [(0, 0)] * (numbers.ndim - 2)
        return jnp.pad(numbers, [*in_front, (0, self.groups.rows - self.size), (0, 0)])

    def pad_all(self, velocity: Velocity) -> Velocity:
        """Velocities of the bodies, with those of what does not move."""
        return map_components(self.pad, velocity)

    def arrange_by_slot(self, arrange: Callable[[Array], Array], part: Array) -> Array:
        """Numbers of all slots, `(..., slots * bodies, worlds)`, in groups: each slot's bodies fill groups of their own."""
        apart = part.reshape(*part.shape[:-2], len(self.slots), self.size, part.shape[-1])
        spare = -self.size % self.groups.size
        padded = jnp.pad(apart, [(0, 0)] * (apart.ndim - 2) + [(0, spare), (0, 0)])
        return arrange(padded.reshape(*part.shape[:-2], -1, part.shape[-1]))

    def cut_all(self, velocity: Velocity) -> Velocity:
        """Velocities of the bodies alone."""
        return map_components(lambda part: part[..., : self.size, :], velocity)


def build_world(solids: SolidContact, scene: Scene, substep: Array) -> World:
    """What does not change in a step of the scene, given the length of its sub-steps [s]."""
    lanes, dtype, mechanics = scene.state.lanes, scene.state.dtype, solids.mechanics
    bodies = lanes[-1]
    slots = mechanics.list_slots(solids.surfaces, solids.shapes)
    pairs = np.array(solids.pairs, int).reshape(-1, 2)
    groups = group_contacts(pairs, len(slots), bodies)
    free = jnp.ones(lanes, dtype) if scene.held is None else 1 - scene.held.astype(dtype)
    mass, turning = take_sides(free / scene.mass.mass, groups), mechanics.read_turning(scene, groups, free)
    materials = _mix_materials(solids, slots, groups, (bodies, scene.state.position.shape[-1]), dtype)
    return World(
        solids,
        mechanics,
        bodies,
        slots,
        groups,
        substep,
        mass,
        turning,
        materials,
        _find_incidence(groups, bodies, dtype),
    )


def _find_incidence(groups: Groups, bodies: int, dtype: np.dtype) -> Sides:
    """Of which places in the groups each body is the first and the second shape, in ones and zeros."""
    rows = np.arange(bodies)[:, None]
    return jnp.asarray(rows == groups.a.ravel(), dtype), jnp.asarray(rows == groups.b.ravel(), dtype)


def take_sides(number: Array, groups: Groups) -> Sides:
    """A number of each lane `(*worlds, bodies)` of both bodies of each contact, `(groups, size, worlds)`; 0 of what is none."""
    by_body = number.reshape(-1, number.shape[-1]).T
    padded = jnp.pad(by_body, ((0, groups.rows - len(by_body)), (0, 0)))
    return padded[jnp.asarray(groups.a)], padded[jnp.asarray(groups.b)]


def _mix_materials(
    solids: SolidContact, slots: list[Any], groups: Groups, shape: tuple[int, int], dtype: np.dtype
) -> Materials:
    """Of every contact the mean of its two bodies; of a surface its own."""
    bodies, dim = shape
    pairs, zero = np.array(solids.pairs, int).reshape(-1, 2).T, jnp.zeros((), dtype)

    def take_groups(of_pairs: Array, of_surfaces: list) -> Array:
        # one number more for places without a contact
        parts = [of_pairs, *(jnp.full(bodies, number, dtype) for number in of_surfaces), zero[None]]
        return jnp.concatenate(parts)[jnp.asarray(groups.contact)][..., None]

    surfaces = [slot.surface for slot in slots]
    dry = [
        (zero, zero) if part.coulomb is None else (part.coulomb.static, part.coulomb.kinetic)
        for part in (solids, *surfaces)
    ]
    static, kinetic = (
        take_groups(jnp.full(pairs.shape[1], own, dtype), others) for own, *others in zip(*dry, strict=True)
    )
    own = jnp.broadcast_to(jnp.asarray(solids.restitution, dtype), (bodies,))
    restitution = take_groups((own[pairs[0]] + own[pairs[1]]) / 2, [surface.restitution for surface in surfaces])
    speeds = [jnp.zeros(dim, dtype) if surface.velocity is None else surface.velocity for surface in surfaces]
    none = jnp.zeros(pairs.shape[1], dtype)
    carried = tuple(take_groups(none, [speed[i] for speed in speeds]) for i in range(dim))
    return Materials(static, kinetic, restitution, carried)


__all__ = ["SolidContact", "World", "build_world", "take_sides"]
