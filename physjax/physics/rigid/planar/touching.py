"""What touches what: the contacts of bodies with each other and with surfaces, in the groups in which they are solved.

Worlds are the last axis of every array here, so that one contact of all worlds is one stretch of memory.
"""

from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.backend import materialise
from physjax.physics.contacts.restitution import Coulomb
from physjax.physics.contacts.surface import Surface
from physjax.physics.rigid.planar.impulses import Contacts, Points, Sides, Velocity, build_contacts, map_components
from physjax.physics.rigid.planar.manifolds import Manifold, Outline, Vector, find_manifolds
from physjax.physics.rigid.planar.pairs import Groups, group_contacts
from physjax.physics.rigid.planar.shapes import PlanarShape, tabulate_shapes
from physjax.physics.rigid.planar.surfaces import Slot, find_surface_manifolds, list_slots
from physjax.scene import Scene


@runtime_checkable
class SolidContact(Protocol):
    """What a step needs of the contact; `impulses` are those of the step before, `(*worlds, 3, groups, size)`."""

    shapes: tuple[PlanarShape, ...]
    surfaces: tuple[Surface, ...]
    restitution: Any
    coulomb: Coulomb | None
    pairs: tuple[tuple[int, int], ...]
    substeps: int
    impulses: Array | None


class Materials(NamedTuple):
    """Of contacts in groups `(groups, size, 1)`: static and kinetic friction, restitution, and the velocity of b's surface."""

    static: Array
    kinetic: Array
    restitution: Array
    carried: Vector


class World(NamedTuple):
    """What does not change in a step: the contact, its groups and materials, and 1/m and 1/I, 0 of what is held.

    `mass` and `moment` are of both bodies of each contact, `(groups, size, worlds)`; `incidence` says of each body of which
    places in the groups it is the first and the second shape, in ones and zeros.
    """

    solids: SolidContact
    size: int
    slots: list[Slot]
    groups: Groups
    mass: Sides
    moment: Sides
    materials: Materials
    incidence: Sides

    @property
    def worlds(self) -> int:
        """The number of worlds."""
        return self.mass[0].shape[-1]

    @property
    def dtype(self) -> np.dtype:
        """Floating-point type of all numbers."""
        return self.mass[0].dtype

    def pad(self, numbers: Array) -> Array:
        """Numbers of the bodies `(bodies, worlds)`, with rows of zeros after them of what does not move."""
        return jnp.pad(numbers, ((0, self.groups.rows - self.size), (0, 0)))

    def pad_all(self, velocity: Velocity) -> Velocity:
        """Velocities of the bodies, with those of what does not move."""
        return map_components(self.pad, velocity)

    def cut_all(self, velocity: Velocity) -> Velocity:
        """Velocities of the bodies alone."""
        return map_components(lambda part: part[: self.size], velocity)


class Touching(NamedTuple):
    """Contacts in groups, the gaps of both points [m], and the points [m], `(2, groups, size, worlds)`."""

    contacts: Contacts
    gap: Points
    points: Vector


def build_world(solids: SolidContact, scene: Scene) -> World:
    """What does not change in a step of the scene."""
    lanes, dtype = scene.state.lanes, scene.state.dtype
    bodies = lanes[-1]
    slots = list_slots(solids.surfaces)
    pairs = np.array(solids.pairs, int).reshape(-1, 2)
    groups = group_contacts(pairs, len(slots), bodies)
    free = jnp.ones(lanes, dtype) if scene.held is None else 1 - scene.held.astype(dtype)

    def take_sides(number: Array) -> Sides:
        inverse = (free / jnp.broadcast_to(number, lanes)).reshape(-1, bodies).T
        padded = jnp.pad(inverse, ((0, groups.rows - bodies), (0, 0)))
        return padded[jnp.asarray(groups.a)], padded[jnp.asarray(groups.b)]

    rows = np.arange(bodies)[:, None]
    on_a, on_b = (jnp.asarray(rows == side.ravel(), dtype) for side in (groups.a, groups.b))
    parts = take_sides(scene.mass.mass), take_sides(scene.mass.moment)
    materials = _mix_materials(solids, slots, groups, bodies, dtype)
    return World(solids, bodies, slots, groups, *parts, materials, (on_a, on_b))


def find_contacts(world: World, place: Velocity, t: ArrayLike) -> Touching:
    """All contacts of bodies at places x, y [m] and angles [rad], `(bodies, worlds)`: of pairs, then with each surface."""
    groups = world.groups
    # a turn once, not once for every corner
    turns = materialise(t, lambda: (jnp.cos(place[2]), jnp.sin(place[2])))
    outlines = materialise(t, lambda: _place_shapes(world, place[:2], turns))
    normal, points, gaps, is_point = materialise(t, lambda: _find_groups(world, outlines, t))
    x, y = map(world.pad, place[:2])
    reach = lambda rows: (points[0] - x[rows][None], points[1] - y[rows][None])  # noqa: E731
    arm = reach(jnp.asarray(groups.a)), reach(jnp.asarray(groups.b))
    of = world.materials
    contacts = build_contacts(t, normal, arm, of.carried, (world.mass, world.moment), of.kinetic, is_point)
    return Touching(contacts, (gaps[0], gaps[1]), points)


def _find_groups(world: World, outlines: Outline, t: ArrayLike) -> Manifold:
    """Manifolds `(groups, size, worlds)`."""
    groups, found = world.groups, []
    a, b = (np.where(rows < world.size, rows, 0)[: groups.of_pairs] for rows in (groups.a, groups.b))
    arrange = lambda part: part.reshape(*part.shape[:-2], -1, groups.size, part.shape[-1])  # noqa: E731
    if groups.of_pairs:
        pairs = materialise(t, lambda: find_manifolds(t, _select(outlines, a.ravel()), _select(outlines, b.ravel())))
        found.append(jax.tree.map(arrange, pairs))
    if world.slots:
        surfaces = materialise(t, lambda: find_surface_manifolds(world.slots, t, outlines))
        found.append(jax.tree.map(partial(_arrange_by_slot, world, arrange), surfaces))
    normal, points, gaps, is_point = jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=-3), *found)
    return Manifold(normal, points, gaps, is_point & jnp.asarray(groups.is_contact)[None, ..., None])


def _arrange_by_slot(world: World, arrange: Any, part: Array) -> Array:
    """Numbers of all slots, `(..., slots * bodies, worlds)`, in groups: each slot's bodies fill groups of their own."""
    apart = part.reshape(*part.shape[:-2], len(world.slots), world.size, part.shape[-1])
    spare = -world.size % world.groups.size
    padded = jnp.pad(apart, [(0, 0)] * (apart.ndim - 2) + [(0, spare), (0, 0)])
    return arrange(padded.reshape(*part.shape[:-2], -1, part.shape[-1]))


def _place_shapes(world: World, place: Vector, turns: Vector) -> Outline:
    """The shapes of all bodies, with cosines and sines of their angles, in the world: `(corners, bodies, worlds)`."""
    shapes = world.solids.shapes
    table = tabulate_shapes(shapes if len(shapes) == world.size else shapes * world.size, world.dtype)
    (x, y), (c, s) = place, (part[None] for part in turns)
    turn = lambda v: (c * v[..., 0, None] - s * v[..., 1, None], s * v[..., 0, None] + c * v[..., 1, None])  # noqa: E731
    (cx, cy), normals = turn(table.corners), turn(table.normals)
    is_edge = jnp.broadcast_to(jnp.asarray(table.is_edge)[..., None], cx.shape)
    return Outline((cx + x[None], cy + y[None]), normals, is_edge, jnp.broadcast_to(table.radius[:, None], x.shape))


def _select(outlines: Outline, bodies: np.ndarray) -> Outline:
    corners, normals, is_edge, radius = outlines
    pick = lambda v: (v[0][:, bodies], v[1][:, bodies])  # noqa: E731
    return Outline(pick(corners), pick(normals), is_edge[:, bodies], radius[bodies])


def _mix_materials(solids: SolidContact, slots: list[Slot], groups: Groups, bodies: int, dtype: np.dtype) -> Materials:
    """Of every contact the mean of its two bodies; of a surface its own."""
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
    speeds = [(zero, zero) if surface.velocity is None else surface.velocity for surface in surfaces]
    none = jnp.zeros(pairs.shape[1], dtype)
    carried = take_groups(none, [x for x, _ in speeds]), take_groups(none, [y for _, y in speeds])
    return Materials(static, kinetic, restitution, carried)


__all__ = ["SolidContact", "Touching", "World", "build_world", "find_contacts"]
