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

from physjax.backend import materialise
from physjax.loops import Time, to_float_time
from physjax.physics.contacts.restitution import Coulomb
from physjax.physics.contacts.surface import Surface
from physjax.physics.rigid.planar.bodies import PlanarBodies
from physjax.physics.rigid.planar.impacts import ROUNDING, Bouncing, resolve_impacts
from physjax.physics.rigid.planar.impulses import (
    SOFT,
    Contacts,
    Demand,
    Impulses,
    Points,
    Velocity,
    build_contacts,
    map_components,
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
"""What forces change in any speed within as many sub-steps is no impact: what approaches slower than that stays."""


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
    number, *others = (i for i, contact in enumerate(scene.contacts) if contact.response is solve_contacts)
    if others:
        raise ValueError(
            f"contacts: got {1 + len(others)} Solids, expected one: it holds all bodies, shapes= one for each, and all surfaces."
        )
    solids: Any = scene.contacts[number]
    world = _build_world(solids, scene)
    dt = jnp.asarray(dt, scene.state.dtype)
    h = dt / solids.substeps
    across, first, second = jnp.moveaxis(solids.impulses.reshape(-1, *solids.impulses.shape[-3:]), 0, -1)

    def take(carry: tuple[PlanarBodies, Impulses], substep: Array) -> tuple[tuple[PlanarBodies, Impulses], None]:
        state, impulses = carry
        start = t + substep.astype(h.dtype) * h
        moved = motion(scene.replace(state=state), start, h).state
        return _take_substep(world, scene, (state, moved), impulses, to_float_time(start), h), None

    begun, substeps = (scene.state, (across, first, second)), jnp.arange(solids.substeps, dtype=jnp.int32)
    (state, impulses), _ = lax.scan(take, begun, substeps)
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
    """Contacts in groups, the gaps of both points [m], K_r, and μ_s; the contacts have μ_k."""

    contacts: Contacts
    gap: Points
    restitution: Array
    static: Array


def _take_substep(
    world: World,
    scene: Scene,
    states: tuple[PlanarBodies, PlanarBodies],
    impulses: Impulses,
    t: ArrayLike,
    h: Array,
) -> tuple[PlanarBodies, Impulses]:
    """What a sub-step carries on, given the state at its start and where the method alone would bring it."""
    # the step of each world, as a row
    h = jnp.broadcast_to(h.reshape(1, -1), (1, world.mass.shape[-1]))
    start, moved = (read_pose(state, scene) for state in states)
    touching = _find_contacts(world, start, t)
    free = mean, end = map_components(lambda a, b: (b - a) / h, start.place, moved.place), moved.rate
    changes = [jnp.max(jnp.abs(after - now), axis=0) for now, after in zip(start.rate[:2], end[:2], strict=True)]
    slow = REST_SPEED_STEPS * jnp.maximum(*changes)
    speeds = measure_speeds(_pad(world.groups, start.rate), world.groups, touching.contacts)
    touching = _stick(touching, speeds[0], start.rate, slow)
    impact = map_components(jnp.subtract, _bounce(world, touching, (start.rate, mean), speeds, slow, h), start.rate)
    bounced = map_components(jnp.add, mean, impact), map_components(jnp.add, end, impact)
    moves, impulses = _hold_apart(world, touching, bounced, impulses, h)
    places, rates = (map_components(jnp.subtract, after, before) for after, before in zip(moves, free, strict=True))
    return _write_pose(states[1], map_components(lambda part: h * part, places), rates, scene), impulses


def _stick(touching: _Touching, slip: Array, rate: Velocity, slow: Array) -> _Touching:
    """The contacts with static friction where they do not slip, or so slowly that forces may have just begun it."""
    contacts, rounding = touching.contacts, ROUNDING * float(jnp.finfo(slow.dtype).eps)
    fastest = jnp.maximum(*(jnp.max(jnp.abs(part), axis=0) for part in rate[:2]))
    sticks = jnp.abs(slip) <= (slow + rounding * fastest)[None, None]
    return touching._replace(contacts=contacts._replace(friction=jnp.where(sticks, touching.static, contacts.friction)))


def _hold_apart(
    world: World, touching: _Touching, velocities: tuple[Velocity, Velocity], held: Impulses, h: Array
) -> tuple[tuple[Velocity, Velocity], Impulses]:
    """The mean velocities and those at the end after contacts have acted, and what is kept of their impulses.

    What is kept is by how much the impulses at the end are more than those in the mean: that is half of what a constant force
    needs, and none of what stops a motion once, which both have in common. It is what the next sub-step starts with; its
    impulses at the end start with those that it has found in the mean. So errors of a sweep do not feed on themselves.
    """
    (mean, end), groups, (contacts, gap, *_) = velocities, world.groups, touching
    push = sum_impulses(contacts, held, _build_incidence(world, mean[0].dtype))
    overlaps = gap[0] <= 0, gap[1] <= 0
    each = h[None]
    cure = [jnp.where(over, -SOFT.cure * s, -s) / each for over, s in zip(overlaps, gap, strict=True)]
    demand = Demand((cure[0], cure[1]), overlaps, contacts.is_point)
    moves, pressed = sweep_contacts(_pad(groups, map_components(jnp.add, mean, push)), groups, contacts, demand, held)
    _, *opening = measure_speeds(moves, groups, contacts)
    cases = zip(contacts.is_point, pressed[1:], gap, opening, strict=True)
    first, second = (is_point & ((press > 0) | (s + each * v <= 0)) for is_point, press, s, v in cases)
    moves = _cut(world, moves)
    # the impulses in the mean act on the end as well
    end = map_components(lambda e, p, after, before: e + p + (after - before), end, push, moves, mean)
    still = jnp.zeros_like(gap[0])
    demand = Demand.hard((still, still), (first, second))
    stops, stopped = sweep_contacts(_pad(groups, end), groups, contacts, demand, map_components(jnp.add, held, pressed))
    stays = first | second, first, second
    left = map_components(lambda stay, stop, press: jnp.where(stay, stop - press, 0.0), stays, stopped, pressed)
    return (moves, _cut(world, stops)), left


def _bounce(
    world: World,
    touching: _Touching,
    velocities: tuple[Velocity, Velocity],
    speeds: Impulses,
    slow: Array,
    h: Array,
) -> Velocity:
    """Velocities at the start of a sub-step after the impacts of all that would reach each other in it."""
    groups, (contacts, gap, restitution, _) = world.groups, touching
    before, mean = (_pad(groups, velocity) for velocity in velocities)
    middle = measure_speeds(mean, groups, contacts)
    # forces change by `u - v` how fast the gap closes
    reach = [s / h[None] + (u - v) for s, u, v in zip(gap, middle[1:], speeds[1:], strict=True)]
    bouncing = Bouncing(restitution, slow, (reach[0], reach[1]))
    return _cut(world, resolve_impacts(before, groups, contacts, bouncing))


def _pad(groups: Groups, velocity: Velocity) -> Velocity:
    """The velocities with rows of what does not move after those of the bodies."""
    return map_components(lambda part: jnp.pad(part, ((0, groups.rows - len(part)), (0, 0))), velocity)


def _cut(world: World, velocity: Velocity) -> Velocity:
    return map_components(lambda part: part[: world.size], velocity)


def read_pose(state: PlanarBodies, scene: Scene) -> Pose:
    """Where the bodies of a scene are in a state, and how fast they move."""
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
    (x, y, angle), (vx, vy, omega) = map_components(by_lane, places), map_components(by_lane, rates)
    mass, moment = (jnp.broadcast_to(number, state.lanes) for number in (scene.mass.mass, scene.mass.moment))
    return PlanarBodies(
        state.position + jnp.stack([x, y], axis=-1),
        state.angle + angle,
        state.momentum + jnp.stack([mass * vx, mass * vy], axis=-1),
        state.angular_momentum + moment * omega,
    )


# contacts


def _find_contacts(world: World, pose: Pose, t: ArrayLike) -> _Touching:
    """All contacts, first those of pairs and then those with each surface, in groups."""
    solids, groups, dtype = world.solids, world.groups, world.mass.dtype
    outlines = materialise(t, lambda: place_shapes(solids, pose, dtype))
    a, b = np.array(solids.pairs, int).reshape(-1, 2).T
    found = [find_manifolds(select_shapes(outlines, a), select_shapes(outlines, b))] if len(a) else []
    if world.slots:
        found.append(find_surface_manifolds(world.slots, t, outlines))

    def group() -> Manifold:
        manifold = jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=-2), *found)
        return jax.tree.map(partial(_take_groups, groups), manifold)

    normal, points, gaps, is_point = materialise(t, group)
    (a_rows, b_rows), (x, y) = (groups.a, groups.b), pose.place[:2]
    pick = lambda part, rows: jnp.pad(part, ((0, groups.rows - world.size), (0, 0)))[jnp.asarray(rows)]  # noqa: E731
    reach = lambda rows: (points[0] - pick(x, rows)[None], points[1] - pick(y, rows)[None])  # noqa: E731
    arm = reach(a_rows), reach(b_rows)
    mass = pick(world.mass, a_rows), pick(world.mass, b_rows)
    moment = pick(world.moment, a_rows), pick(world.moment, b_rows)
    vx, vy = _find_surface_velocities(world, len(a))
    carried = _take_groups(groups, vx), _take_groups(groups, vy)
    numbers = _mix_materials(world, (a, b), dtype)
    static, kinetic, restitution = (_take_groups(groups, number) for number in numbers)
    contacts = build_contacts(normal, arm, carried, mass, moment, kinetic, is_point)
    return _Touching(contacts, (gaps[0], gaps[1]), restitution, static)


def place_shapes(solids: SolidContact, pose: Pose, dtype: np.dtype) -> Outline:
    """The shapes of all bodies in the world: `(corners, bodies, worlds)`."""
    bodies = len(pose.place[0])
    shapes = solids.shapes if len(solids.shapes) == bodies else solids.shapes * bodies
    table = tabulate_shapes(shapes, dtype)
    x, y, angle = pose.place
    c, s = jnp.cos(angle)[None], jnp.sin(angle)[None]
    turn = lambda v: (c * v[..., 0, None] - s * v[..., 1, None], s * v[..., 0, None] + c * v[..., 1, None])  # noqa: E731
    (cx, cy), normals = turn(table.corners), turn(table.normals)
    is_edge = jnp.broadcast_to(jnp.asarray(table.is_edge)[..., None], cx.shape)
    return Outline((cx + x[None], cy + y[None]), normals, is_edge, jnp.broadcast_to(table.radius[:, None], x.shape))


def select_shapes(outlines: Outline, bodies: np.ndarray) -> Outline:
    """The shapes of these bodies."""
    corners, normals, is_edge, radius = outlines
    pick = lambda v: (v[0][:, bodies], v[1][:, bodies])  # noqa: E731
    return Outline(pick(corners), pick(normals), is_edge[:, bodies], radius[bodies])


def _find_surface_velocities(world: World, pairs: int) -> Vector:
    """The velocity of what the second shape of each contact is [m/s]: of a surface its own; bodies have theirs elsewhere."""
    moving = [slot.surface.velocity for slot in world.slots]
    zero = jnp.zeros((), world.mass.dtype)
    of = lambda axis: [zero if v is None else v[axis] for v in moving]  # noqa: E731
    each = lambda numbers: [jnp.full(world.size, number) for number in numbers]  # noqa: E731
    x, y = (jnp.concatenate([jnp.full(pairs, zero), *each(of(axis))])[:, None] for axis in range(2))
    return x, y


def _mix_materials(world: World, pairs: tuple[np.ndarray, np.ndarray], dtype: np.dtype) -> list[Array]:
    """μ_s, μ_k and K_r of every contact, `(contacts, 1)`: the mean of two bodies, of a surface its own."""
    solids, bodies = world.solids, world.size
    mean = lambda number: sum(jnp.broadcast_to(number, (bodies,))[rows] for rows in pairs) / 2  # noqa: E731
    own = lambda numbers: [jnp.full(bodies, number, dtype) for number in numbers]  # noqa: E731
    parts = [solids, *(slot.surface for slot in world.slots)]
    dry = [(0.0, 0.0) if part.coulomb is None else (part.coulomb.static, part.coulomb.kinetic) for part in parts]
    kinds = [*zip(*dry, strict=True), [part.restitution for part in parts]]
    each = [[mean(jnp.asarray(first, dtype)), *own(others)] for first, *others in kinds]
    return [jnp.concatenate(numbers)[:, None] for numbers in each]


def _build_incidence(world: World, dtype: np.dtype) -> tuple[Array, Array]:
    """Of each body of which places in the groups it is the first and the second shape: ones and zeros."""
    bodies = np.arange(world.size)[:, None]
    on_a, on_b = (jnp.asarray(bodies == rows.ravel(), dtype) for rows in (world.groups.a, world.groups.b))
    return on_a, on_b


def _take_groups(groups: Groups, array: Array) -> Array:
    """Numbers of contacts, `(..., contacts, worlds)`, in groups `(..., groups, size, worlds)`; zeros elsewhere."""
    padded = jnp.concatenate([array, jnp.zeros_like(array[..., :1, :])], axis=-2)
    return padded[..., jnp.asarray(groups.contact), :]


__all__ = ["SolidContact", "place_shapes", "read_pose", "select_shapes", "solve_contacts"]
