"""A step of bodies that touch: sub-steps in which they move freely, bounce, and are held apart.

Worlds are the last axis of every array here, so that one contact of all worlds is one stretch of memory: contacts are
solved one group after the other, all worlds at the same time.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.loops import Time, to_float_time
from physjax.physics.contacts.restitution import Coulomb
from physjax.physics.contacts.surface import Surface
from physjax.physics.rigid.planar.bodies import PlanarBodies
from physjax.physics.rigid.planar.impacts import Bouncing, resolve_impacts
from physjax.physics.rigid.planar.impulses import (
    SOFT,
    Contacts,
    Demand,
    Impulses,
    Points,
    Velocity,
    build_contacts,
    measure_speeds,
    sum_impulses,
    sweep_contacts,
)
from physjax.physics.rigid.planar.manifolds import Manifold, Outline, Vector, find_manifolds
from physjax.physics.rigid.planar.pairs import Groups, group_contacts
from physjax.physics.rigid.planar.shapes import PlanarShape, tabulate_shapes
from physjax.physics.rigid.planar.surfaces import Slot, find_surface_manifolds, list_slots
from physjax.scene import Scene

Motion = Callable[..., Scene]
REST_SPEED_STEPS = 2.0
"""What forces change in the speed of approach within as many sub-steps is no impact: a body that is slower stays."""


@runtime_checkable
class SolidContact(Protocol):
    """What a step needs of the contact; `impulses` are those of the step before, `(*worlds, 3, contacts)`."""

    shapes: tuple[PlanarShape, ...]
    surfaces: tuple[Surface, ...]
    restitution: Any
    coulomb: Coulomb | None
    pairs: tuple[tuple[int, int], ...]
    substeps: int
    impulses: Array | None


class Pose(NamedTuple):
    """Where bodies are and how fast they move, each number `(bodies, worlds)`: x, y [m], angle [rad] and their rates."""

    place: tuple[Array, Array, Array]
    rate: tuple[Array, Array, Array]


class World(NamedTuple):
    """What does not change in a step: the contact, 1/m and 1/I, 0 of what is held, `(bodies, worlds)`, and the groups."""

    solids: SolidContact
    mass: Array
    moment: Array
    slots: list[Slot]
    groups: Groups

    @property
    def size(self) -> int:
        """The number of bodies."""
        return len(self.mass)


def solve_contacts(motion: Motion, scene: Scene, t: Time, dt: ArrayLike) -> Scene:
    """The scene after a step of dt in sub-steps, each of them: the method's own step, impacts, and impulses at contacts."""
    (number,) = (i for i, contact in enumerate(scene.contacts) if contact.response is solve_contacts)
    solids: Any = scene.contacts[number]
    world = _build_world(solids, scene)
    dt = jnp.asarray(dt, scene.state.dtype)
    h = dt / solids.substeps
    across, first, second = jnp.moveaxis(solids.impulses.reshape(-1, *solids.impulses.shape[-2:]), 0, -1)

    h = jnp.broadcast_to(h.reshape(-1), world.mass.shape[-1:])
    touching = _find_contacts(world, _read_pose(scene.state, scene), to_float_time(t), scene.state.dtype)

    def take(carry: _Carry, substep: Array) -> tuple[_Carry, None]:
        state, impulses, gaps = carry
        start = t + substep.astype(h.dtype) * (dt / solids.substeps)
        moved = motion(scene.replace(state=state), start, dt / solids.substeps).state
        return _take_substep(world, scene, touching, (state, moved), (impulses, gaps), h), None

    gaps = _take_groups(world.groups, touching.gap[0]), _take_groups(world.groups, touching.gap[1])
    begun, substeps = (scene.state, (across, first, second), gaps), jnp.arange(solids.substeps, dtype=jnp.int32)
    (state, impulses, _), _ = lax.scan(take, begun, substeps)
    after = jnp.moveaxis(jnp.stack(impulses), -1, 0).reshape(solids.impulses.shape)
    contacts = list(scene.contacts)
    contacts[number] = eqx.tree_at(lambda solids: solids.impulses, solids, after)
    return scene.replace(state=state, contacts=tuple(contacts))


def _build_world(solids: SolidContact, scene: Scene) -> World:
    lanes = scene.state.lanes
    bodies = lanes[-1]
    free = jnp.ones(lanes, scene.state.dtype) if scene.held is None else 1 - scene.held.astype(scene.state.dtype)
    by_body = lambda number: (free / jnp.broadcast_to(number, lanes)).reshape(-1, bodies).T  # noqa: E731
    slots = list_slots(solids.surfaces)
    groups = group_contacts(np.array(solids.pairs, int).reshape(-1, 2), len(slots), bodies)
    return World(solids, by_body(scene.mass.mass), by_body(scene.mass.moment), slots, groups)


class _Touching(NamedTuple):
    """Contacts in the order of the scene and in groups, the gaps of both points [m], and K_r where anything bounces."""

    contacts: Contacts
    grouped: Contacts
    gap: Points
    restitution: Array | None


_Carry = tuple[PlanarBodies, Impulses, Points]
"""The state, what is kept of impulses, and the gaps in groups."""


def _take_substep(
    world: World,
    scene: Scene,
    touching: _Touching,
    states: tuple[PlanarBodies, PlanarBodies],
    kept: tuple[Impulses, Points],
    h: Array,
) -> _Carry:
    """What a sub-step carries on, given the state at its start and where the method alone would bring it."""
    impulses, gaps = kept
    start, moved = (_read_pose(state, scene) for state in states)
    free = mean, end = _map(lambda a, b: (b - a) / h, start.place, moved.place), moved.rate
    if touching.restitution is not None:
        bounced = _bounce(world, touching, (start.rate, mean, end), gaps, h)
        impact = _map(jnp.subtract, bounced, start.rate)
        mean, end = _map(jnp.add, mean, impact), _map(jnp.add, end, impact)
    moves, impulses, gaps = _hold_apart(world, touching, (mean, end), (impulses, gaps), h)
    places, rates = (_map(jnp.subtract, after, before) for after, before in zip(moves, free, strict=True))
    return _write_pose(states[1], _map(lambda part: h * part, places), rates, scene), impulses, gaps


def _hold_apart(
    world: World, touching: _Touching, velocities: tuple[Velocity, Velocity], kept: tuple[Impulses, Points], h: Array
) -> tuple[tuple[Velocity, Velocity], Impulses, Points]:
    """The mean velocities and those at the end after contacts have acted, what is kept of their impulses, and the gaps.

    What is kept is by how much the impulses at the end are more than those in the mean: that is half of what a constant force
    needs, and none of what stops a motion once, which both have in common. It is what the next sub-step starts with; its
    impulses at the end start with those that it has found in the mean. So errors of a sweep do not feed on themselves.
    """
    (mean, end), (impulses, gap) = velocities, kept
    groups, grouped = world.groups, touching.grouped
    push = sum_impulses(touching.contacts, impulses, _build_incidence(world, mean[0].dtype))
    held = _map(partial(_take_groups, groups), impulses)
    overlaps = gap[0] <= 0, gap[1] <= 0
    cure = [jnp.where(over, -SOFT.cure * s, -s) / h for over, s in zip(overlaps, gap, strict=True)]
    demand = Demand((cure[0], cure[1]), overlaps, grouped.is_point)
    moves, pressed = sweep_contacts(_pad(groups, _map(jnp.add, mean, push)), groups, grouped, demand, held)
    opening = measure_speeds(moves, groups, grouped)
    gap = gap[0] + h * opening[0], gap[1] + h * opening[1]
    cases = zip(grouped.is_point, pressed[1:], gap, strict=True)
    first, second = (is_point & ((press > 0) | (s <= 0)) for is_point, press, s in cases)
    moves = _cut(world, moves)
    # the impulses in the mean act on the end as well
    end = _map(lambda e, p, after, before: e + p + (after - before), end, push, moves, mean)
    still = jnp.zeros_like(gap[0])
    demand = Demand.hard((still, still), (first, second))
    stops, stopped = sweep_contacts(_pad(groups, end), groups, grouped, demand, _map(jnp.add, held, pressed))
    stays = first | second, first, second
    left = _map(lambda stay, stop, press: jnp.where(stay, stop - press, 0.0), stays, stopped, pressed)
    return (moves, _cut(world, stops)), _map(lambda part: _ungroup(groups, part, len(impulses[0])), left), gap


def _bounce(
    world: World, touching: _Touching, velocities: tuple[Velocity, Velocity, Velocity], gap: Points, h: Array
) -> Velocity:
    """Velocities at the start of a sub-step after the impacts of all that would reach each other in it."""
    groups, grouped = world.groups, touching.grouped
    before, *_ = padded = [_pad(groups, part) for part in velocities]
    start, middle, last = (measure_speeds(part, groups, grouped) for part in padded)
    assert touching.restitution is not None
    restitution = _take_groups(groups, touching.restitution)
    bounces = restitution > 0
    slow = [REST_SPEED_STEPS * jnp.abs(b - a) for a, b in zip(start, last, strict=True)]
    # forces change by `u - v` how fast the gap closes
    reach = [s / h + (u - v) for s, u, v in zip(gap, middle, start, strict=True)]
    may = grouped.is_point[0] & bounces, grouped.is_point[1] & bounces
    bouncing = Bouncing(may, restitution, (slow[0], slow[1]), (reach[0], reach[1]))
    return _cut(world, resolve_impacts(before, groups, grouped, bouncing))


def _map(function: Callable[..., Array], *parts: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
    """The function of three components, one by one."""
    x, y, z = (function(*each) for each in zip(*parts, strict=True))
    return x, y, z


def _pad(groups: Groups, velocity: Velocity) -> Velocity:
    """The velocities with rows of what does not move after those of the bodies."""
    return _map(lambda part: jnp.pad(part, ((0, groups.rows - len(part)), (0, 0))), velocity)


def _cut(world: World, velocity: Velocity) -> Velocity:
    return _map(lambda part: part[: world.size], velocity)


def _read_pose(state: PlanarBodies, scene: Scene) -> Pose:
    bodies = state.lanes[-1]
    by_body = lambda number: number.reshape(-1, bodies).T  # noqa: E731
    mass, moment = (jnp.broadcast_to(number, state.lanes) for number in (scene.mass.mass, scene.mass.moment))
    x, y, px, py = state.position[..., 0], state.position[..., 1], state.momentum[..., 0], state.momentum[..., 1]
    return Pose(
        tuple(map(by_body, (x, y, state.angle))),
        tuple(map(by_body, (px / mass, py / mass, state.angular_momentum / moment))),
    )


def _write_pose(state: PlanarBodies, places: Velocity, rates: Velocity, scene: Scene) -> PlanarBodies:
    """The state with places [m, rad] and velocities changed."""
    by_lane = lambda number: number.T.reshape(state.lanes)  # noqa: E731
    (x, y, angle), (vx, vy, omega) = _map(by_lane, places), _map(by_lane, rates)
    mass, moment = (jnp.broadcast_to(number, state.lanes) for number in (scene.mass.mass, scene.mass.moment))
    return PlanarBodies(
        state.position + jnp.stack([x, y], axis=-1),
        state.angle + angle,
        state.momentum + jnp.stack([mass * vx, mass * vy], axis=-1),
        state.angular_momentum + moment * omega,
    )


# contacts


def _find_contacts(world: World, pose: Pose, t: ArrayLike, dtype: np.dtype) -> _Touching:
    """All contacts, first those of pairs and then those with each surface."""
    solids, bodies = world.solids, world.size
    outlines = _place_shapes(solids, pose, dtype)
    a, b = np.array(solids.pairs, int).reshape(-1, 2).T
    found = [find_manifolds(_select(outlines, a), _select(outlines, b))] if len(a) else []
    if world.slots:
        found.append(find_surface_manifolds(world.slots, t, outlines))
    manifold = jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=-2), *found)
    free = np.tile(np.arange(bodies), len(world.slots))
    first = np.concatenate([a, free])
    second = jnp.asarray(np.concatenate([b, np.full(len(free), bodies)]))
    still = lambda array: jnp.concatenate([array, jnp.zeros_like(array[:1])])  # noqa: E731
    (x, y), (cx, cy) = manifold.points, pose.place[:2]
    arm = (x - cx[first], y - cy[first]), (x - still(cx)[second], y - still(cy)[second])
    mass, moment = ((number[first], still(number)[second]) for number in (world.mass, world.moment))
    carried = _find_surface_velocities(world, manifold)
    friction, restitution = _mix_materials(world, (a, b), dtype)
    contacts = build_contacts(manifold.normal, arm, carried, mass, moment, friction, manifold.is_point)
    return _Touching(contacts, _group(world.groups, contacts), (manifold.gaps[0], manifold.gaps[1]), restitution)


def _place_shapes(solids: SolidContact, pose: Pose, dtype: np.dtype) -> Outline:
    """The shapes of all bodies in the world: `(corners, bodies, worlds)`."""
    bodies = len(pose.place[0])
    shapes = solids.shapes if len(solids.shapes) == bodies else solids.shapes * bodies
    table = tabulate_shapes(shapes, dtype)
    x, y, angle = pose.place
    c, s = jnp.cos(angle), jnp.sin(angle)
    turn = lambda v: (c * v[..., 0, None] - s * v[..., 1, None], s * v[..., 0, None] + c * v[..., 1, None])  # noqa: E731
    (cx, cy), normals = turn(table.corners), turn(table.normals)
    is_edge = jnp.broadcast_to(jnp.asarray(table.is_edge)[..., None], cx.shape)
    return Outline((cx + x, cy + y), normals, is_edge, jnp.broadcast_to(table.radius[:, None], x.shape))


def _select(outlines: Outline, bodies: np.ndarray) -> Outline:
    corners, normals, is_edge, radius = outlines
    pick = lambda v: (v[0][:, bodies], v[1][:, bodies])  # noqa: E731
    return Outline(pick(corners), pick(normals), is_edge[:, bodies], radius[bodies])


def _find_surface_velocities(world: World, manifold: Manifold) -> Vector:
    """The velocity of what the second shape of each contact is [m/s]: of a surface its own; bodies have theirs elsewhere."""
    pairs = len(manifold.gaps[0]) - len(world.slots) * world.size
    moving = [slot.surface.velocity for slot in world.slots]
    zero = jnp.zeros((), manifold.gaps.dtype)
    of = lambda axis: [zero if v is None else v[axis] for v in moving]  # noqa: E731
    each = lambda numbers: [jnp.full(world.size, number) for number in numbers]  # noqa: E731
    x, y = (jnp.concatenate([jnp.full(pairs, zero), *each(of(axis))])[:, None] for axis in range(2))
    return x, y


def _mix_materials(world: World, pairs: tuple[np.ndarray, np.ndarray], dtype: np.dtype) -> tuple[Array, Array | None]:
    """μ and K_r of every contact, `(contacts, 1)`: the mean of two bodies, of a surface its own; K_r is None where none is."""
    solids, bodies = world.solids, world.size
    mean = lambda number: sum(jnp.broadcast_to(number, (bodies,))[rows] for rows in pairs) / 2  # noqa: E731
    own = lambda numbers: [jnp.full(bodies, number, dtype) for number in numbers]  # noqa: E731
    rough = 0.0 if solids.coulomb is None else solids.coulomb.kinetic
    surfaces = [slot.surface for slot in world.slots]
    grips = [0.0 if surface.coulomb is None else surface.coulomb.kinetic for surface in surfaces]
    friction = jnp.concatenate([mean(jnp.asarray(rough, dtype)), *own(grips)])[:, None]
    if solids.restitution is None:
        return friction, None
    restitution = [mean(solids.restitution), *own([surface.restitution for surface in surfaces])]
    return friction, jnp.concatenate(restitution)[:, None]


def _build_incidence(world: World, dtype: np.dtype) -> tuple[Array, Array]:
    """Of each body which contacts it is the first and the second shape of, `(bodies, contacts)` of ones and zeros."""
    pairs, bodies = np.array(world.solids.pairs, int).reshape(-1, 2), world.size
    slots = len(world.slots)
    count = len(pairs) + slots * bodies
    on_a, on_b = np.zeros((bodies, count)), np.zeros((bodies, count))
    on_a[np.concatenate([pairs[:, 0], np.tile(np.arange(bodies), slots)]), np.arange(count)] = 1
    on_b[pairs[:, 1], np.arange(len(pairs))] = 1
    return jnp.asarray(on_a, dtype), jnp.asarray(on_b, dtype)


# groups


def _take_groups(groups: Groups, array: Array) -> Array:
    """Numbers of contacts, `(contacts, worlds)`, in groups `(groups, size, worlds)`; places that are left over have zeros."""
    padded = jnp.concatenate([array, jnp.zeros_like(array[:1])])
    return padded[jnp.asarray(groups.contact)]


def _group(groups: Groups, contacts: Contacts) -> Contacts:
    """All contacts in groups."""
    shape = contacts.normal[0].shape
    return jax.tree.map(lambda leaf: _take_groups(groups, jnp.broadcast_to(leaf, shape)), contacts)


def _ungroup(groups: Groups, grouped: Array, count: int) -> Array:
    """Numbers in groups as those of all contacts in their order."""
    contacts = groups.contact.ravel()
    places = np.zeros(count, int)
    places[contacts[contacts < count]] = np.flatnonzero(contacts < count)
    return grouped.reshape(-1, grouped.shape[-1])[places]


__all__ = ["solve_contacts"]
