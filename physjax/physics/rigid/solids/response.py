"""A step of bodies that touch: sub-steps in which they move freely, bounce, and are held apart.

Worlds are the last axis of every array here, so that one contact of all worlds is one stretch of memory: contacts are
solved one group after the other, all worlds at the same time.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.backend import materialise
from physjax.compaction import map_worlds
from physjax.constraints.mechanism import find_constraints
from physjax.loops import Time, to_float_time
from physjax.physics.rigid.solids.impacts import ROUNDING, Bouncing, resolve_impacts
from physjax.physics.rigid.solids.links import Turns, find_links, flatten, plan_turns
from physjax.physics.rigid.solids.mechanics import (
    SOFT,
    Demand,
    Impulses,
    Kept,
    Points,
    Pose,
    Speeds,
    Touching,
    Velocity,
    by_world,
    find_largest,
    map_components,
)
from physjax.physics.rigid.solids.sweeps import measure_openings, measure_several, sum_impulses, sweep_contacts
from physjax.physics.rigid.solids.world import World, build_world
from physjax.scene import Scene

Motion = Callable[..., Scene]
REST_SPEED_STEPS = 2.0
"""What forces change in any speed within as many sub-steps is no impact: what approaches slower than that stays."""

FRICTION_LEARNED = 0.1
"""Share by which the friction that is kept follows that in the mean: without, boxes of a pyramid creep by 1.5 mm/s for ever,
with velocities of zero at the ends of sub-steps. Normal impulses that follow make towers sway more and more."""


def solve_contacts(motion: Motion, scene: Scene, t: Time, dt: ArrayLike) -> Scene:
    """The scene after a step of dt in sub-steps, each of them: the method's own step, impacts, and impulses at contacts."""
    number, *others = (i for i, contact in enumerate(scene.contacts) if contact.response is solve_contacts)
    if others:
        raise ValueError(
            f"contacts: got {1 + len(others)} Solids, expected one: it holds all bodies, shapes= one for each, and all surfaces."
        )
    solids: Any = scene.contacts[number]
    if not solids.pairs and not solids.surfaces:
        return motion(scene, t, dt)
    dt = jnp.asarray(dt, scene.state.dtype)
    h = dt / solids.substeps
    world = build_world(solids, scene, h)
    turns = plan_turns(scene, world.groups)
    driven = turns is not None and any(part.bounded for part in find_constraints(scene))
    memory = jnp.moveaxis(solids.impulses.reshape(-1, *solids.impulses.shape[-3:]), 0, -1)

    def take(carry: tuple[Any, Kept], substep: Array) -> tuple[tuple[Any, Kept], Array | None]:
        state, kept = carry
        start = t + substep.astype(h.dtype) * h
        now, joined, ahead, at = scene.replace(state=state), world, None, to_float_time(start)
        if turns is not None and driven:
            ahead, pushes = _look_ahead(world, turns, now, kept, at)
            now = _replace_solids(now, number, pushes=pushes)
        moved = motion(now, start, h).state
        if turns is not None:
            joined = world._replace(links=find_links(turns, now, moved, world.substep.reshape(-1)))
        after, kept, loads = _take_substep(joined, scene, (state, moved), (kept, ahead), at, h)
        return (after, kept), loads

    begun, substeps = (scene.state, world.mechanics.unpack(memory)), jnp.arange(solids.substeps, dtype=jnp.int32)
    (state, kept), loads = lax.scan(jax.checkpoint(take, prevent_cse=False), begun, substeps)
    after = jnp.moveaxis(world.mechanics.pack(kept), -1, 0).reshape(solids.impulses.shape)
    exerted = (
        solids.loads if loads is None else jnp.transpose(jnp.mean(loads, axis=0), (2, 1, 0)).reshape(solids.loads.shape)
    )
    return _replace_solids(scene.replace(state=state), number, impulses=after, loads=exerted)


def _replace_solids(scene: Scene, number: int, **parts: Array) -> Scene:
    """The scene with other arrays of the solids among its contacts."""
    where = lambda solids: [getattr(solids, name) for name in parts]  # noqa: E731
    contacts = list(scene.contacts)
    contacts[number] = eqx.tree_at(where, contacts[number], [*parts.values()], is_leaf=lambda leaf: leaf is None)
    return scene.replace(contacts=tuple(contacts))


class _Ahead(NamedTuple):
    """What is known of a sub-step before it is taken: contacts in turns, and the impulses with which they begin."""

    touching: Touching
    held: Impulses


def _look_ahead(world: World, turns: Turns, scene: Scene, kept: Kept, t: ArrayLike) -> tuple[_Ahead, Array]:
    """Contacts at the start of a sub-step, and what they are expected to exert on bodies `(freedoms, bodies, worlds)` [N, N m].

    Limits and drives of joints, which yield, have to know it.
    """
    mechanics = world.mechanics
    touching = mechanics.find_contacts(world, mechanics.read_pose(scene.state, scene).place, t)
    touching, kept = _arrange(turns, touching, kept)
    # every world has numbers of its own, as those have who are taken some at a time
    touching = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*leaf.shape[:-1], world.worlds)), touching)
    held = materialise(t, lambda: jax.vmap(mechanics.recall)(kept, touching.contacts))
    incidence = world.take_turns(turns).incidence
    pushes = flatten(sum_impulses(mechanics, mechanics.free(touching.contacts), held, incidence, None))
    return _Ahead(touching, held), 2 * pushes / world.substep.reshape(1, 1, -1)


def _take_substep(
    world: World, scene: Scene, states: tuple[Any, Any], known: tuple[Kept, _Ahead | None], t: ArrayLike, h: Array
) -> tuple[Any, Kept, Array | None]:
    """What a sub-step carries on, given the state at its start and where the method alone would bring it, and loads of joints."""
    mechanics = world.mechanics
    # the step of each world, as a row
    h = jnp.broadcast_to(h.reshape(1, -1), (1, world.worlds))
    # stored with worlds last: what is only seen so would be read across memory by all that follows
    start, moved = materialise(t, lambda: tuple(mechanics.read_pose(state, scene) for state in states))
    way = _Way(start, mechanics.find_mean_rate(start, moved, h), moved.rate, h)

    def hold(some: tuple[tuple, _Way, Kept, _Ahead | None]) -> tuple[Velocity, Velocity, Kept, Array | None]:
        of_worlds, way, kept, ahead = some
        return _hold(world.with_bodies(*of_worlds), way, kept, ahead, t)

    responses = None if world.links is None else (world.links.response, world.links.at_impacts)
    some = (world.mass, world.turning, responses), way, *known
    # worlds with steps of their own have times of their own, and surfaces may move with these
    together = jnp.ndim(t) == 0 and world.substep.ndim == 0
    places, rates, kept, loads = map_worlds(hold, some, world.worlds, world.groups.size) if together else hold(some)
    return mechanics.write_pose(states, places, rates, scene), kept, loads


class _Way(NamedTuple):
    """Where bodies start in a sub-step of h [s], and their mean velocities and those at its end if nothing touches."""

    start: Pose
    mean: Velocity
    end: Velocity
    h: Array


def _hold(
    world: World, way: _Way, kept: Kept, ahead: _Ahead | None, t: ArrayLike
) -> tuple[Velocity, Velocity, Kept, Array | None]:
    """How much further bodies are [m, rad] and how much faster at the end than if nothing touched, and what is kept.

    Where bodies are joined, also what contacts have exerted on each in the mean [N, N m], `(freedoms, bodies, worlds)`.
    """
    mechanics, (start, mean, end, h), links = world.mechanics, way, world.links
    world, touching, struck, held = _begin(world, start, kept, ahead, t)
    push = sum_impulses(mechanics, touching.contacts, held, world.incidence, links)
    moved = mean, end
    if ahead is not None:
        # the step of the joints was taken with what they begin with
        mean, end = (map_components(lambda v, p, n=n: v - n * p, rates, push) for n, rates in ((1, mean), (2, end)))
    changes = map_components(lambda now, after: jnp.abs(after - now), start.rate, end)
    if touching.carried_at_end is not None:
        # as forces do, surfaces change speeds: by twice as much in a sub-step as in half of it
        of_surfaces = zip(touching.contacts.carried[: mechanics.straight], touching.carried_at_end, strict=False)
        changes = *changes[: mechanics.straight], *(2 * jnp.abs(end - mean) for mean, end in of_surfaces)
    slow = REST_SPEED_STEPS * find_largest(changes[: mechanics.straight])
    before = world.pad_all(start.rate)
    speeds = measure_several(mechanics, (before, world.pad_all(mean)), world.groups, touching.contacts)
    friction = _stick(world, touching.contacts, speeds[0], start.rate, slow)
    touching = touching._replace(contacts=touching.contacts._replace(friction=friction))
    struck = touching._replace(contacts=struck._replace(friction=friction))
    bounced, hits = _bounce(world, struck, (before, held), speeds, slow, h)
    bounced = world.cut_all(bounced)
    impact = map_components(jnp.subtract, bounced, start.rate)
    bounced = map_components(jnp.add, mean, impact), map_components(jnp.add, end, impact)
    moves, impulses, total = _hold_apart(world, touching, bounced, (held, push), h)
    ways, rates = (map_components(jnp.subtract, after, before) for after, before in zip(moves, moved, strict=True))
    places = map_components(lambda part: by_world(h[0], part) * part, ways)
    kept = jax.vmap(mechanics.keep)(impulses, touching.contacts)
    if links is None:
        return places, rates, kept, None
    exerted = map_components(jnp.add, hits, total)
    loads = sum_impulses(mechanics, mechanics.free(touching.contacts), exerted, world.incidence, None)
    return places, rates, links.turns.restore(kept), flatten(loads) / h[None]


def _begin(
    world: World, start: Pose, kept: Kept, ahead: _Ahead | None, t: ArrayLike
) -> tuple[World, Touching, Any, Impulses]:
    """The world as contacts are solved, these, the same as impacts find them, and the impulses with which they begin."""
    mechanics, links = world.mechanics, world.links
    touching = mechanics.find_contacts(world, start.place, t) if ahead is None else ahead.touching
    struck = touching.contacts
    if links is not None:
        if ahead is None:
            touching, kept = _arrange(links.turns, touching, kept)
        world, contacts = world.take_turns(links.turns), touching.contacts
        struck = mechanics.link(contacts, links.take_impacts().spread)
        touching = touching._replace(
            contacts=struck if links.at_impacts is None else mechanics.link(contacts, links.spread)
        )
    if ahead is not None:
        return world, touching, struck, ahead.held
    return world, touching, struck, materialise(t, lambda: jax.vmap(mechanics.recall)(kept, touching.contacts))


def _arrange(turns: Turns, touching: Touching, kept: Kept) -> tuple[Touching, Kept]:
    """Contacts, and what was kept of them, in turns."""
    contacts, gap, carried_at_end, kept = turns.arrange(
        (touching.contacts, touching.gap, touching.carried_at_end, kept)
    )
    return Touching(contacts, gap, touching.points, carried_at_end), kept


def _stick(world: World, contacts: Any, speeds: Speeds, rate: Velocity, slow: Array) -> Array:
    """The friction of contacts, static where they do not slip, or so slowly that forces may have just begun it."""
    rounding = ROUNDING * float(jnp.finfo(slow.dtype).eps)
    slip = jax.vmap(world.mechanics.find_slip)(speeds, contacts)
    fastest = find_largest([jnp.abs(part) for part in rate[: world.mechanics.straight]])
    sticks = slip <= by_world(slow + rounding * fastest, slip)
    return jnp.where(sticks, world.materials.static, contacts.friction)


class _Pass(NamedTuple):
    """What a sweep starts with, and what it is asked for."""

    velocity: Velocity
    impulses: Impulses
    demand: Demand


def _hold_apart(
    world: World,
    touching: Touching,
    velocities: tuple[Velocity, Velocity],
    begun: tuple[Impulses, Velocity],
    h: Array,
) -> tuple[tuple[Velocity, Velocity], Impulses, Impulses]:
    """The mean velocities and those at the end after contacts have acted, what is kept of their impulses, and these.

    Two passes of one and the same sweep: the first finds the mean velocities, in which gaps must not close nor overlaps
    stay; the second those at the end, with which nothing that touches may approach. What is kept is by how much the impulses
    at the end are more than those in the mean: that is half of what a constant force needs, and none of what stops a motion
    once, which both have in common. It is what the next sub-step starts with; its impulses at the end start with those that
    it has found in the mean. So errors of a sweep do not feed on themselves; friction alone follows that of the mean a little.
    """
    (mean, end), (held, push), (contacts, gap, _, at_end), mechanics = velocities, begun, touching, world.mechanics
    each, rubbing = by_world(h[0], gap[0]), mechanics.rubbing

    def sweep(this: _Pass, carried: tuple[Array, ...] | None) -> tuple[_Pass, tuple[Velocity, Impulses, Points]]:
        start, seen = world.pad_all(this.velocity), contacts if carried is None else contacts._replace(carried=carried)
        after, pressed = sweep_contacts(mechanics, start, world.groups, seen, this.demand, this.impulses, world.links)
        opening = measure_openings(mechanics, after, world.groups, seen)
        cases = zip(contacts.is_point, pressed[rubbing:], gap, opening, strict=True)
        touches = tuple(is_point & ((press > 0) | (s + each * v <= 0)) for is_point, press, s, v in cases)
        after = world.cut_all(after)
        # the impulses in the mean act on the end as well
        ahead = map_components(lambda a, e, m, p: a + (e - m) + p, after, end, mean, push)
        doubled = map_components(jnp.add, held, pressed)
        still = tuple(jnp.zeros_like(s) for s in gap)
        return _Pass(ahead, doubled, Demand.hard(still, touches)), (after, pressed, touches)

    overlaps = tuple(s <= 0 for s in gap)
    cure = tuple(jnp.where(over, -SOFT.cure * s, -s) / each for over, s in zip(overlaps, gap, strict=True))
    start = _Pass(map_components(jnp.add, mean, push), held, Demand(cure, overlaps, contacts.is_point))
    carried = None if at_end is None else jax.tree.map(lambda *both: jnp.stack(both), contacts.carried, at_end)
    _, (rates, impulses, touches) = lax.scan(sweep, start, carried, length=2)
    moves, stops = (map_components(lambda part, k=k: part[k], rates) for k in range(2))
    first = tuple(active[0] for active in touches)
    keep = lambda stay, impulse: jnp.where(stay, impulse[1] - impulse[0], 0.0)  # noqa: E731
    anywhere = jax.vmap(mechanics.find_any)(first)
    grip = [
        keep(anywhere, impulse) + jnp.where(anywhere, FRICTION_LEARNED * (impulse[0] - was), 0.0)
        for impulse, was in zip(impulses[:rubbing], held[:rubbing], strict=True)
    ]
    total = map_components(lambda part: part[1], impulses)
    return (moves, stops), (*grip, *map(keep, first, impulses[rubbing:])), total


def _bounce(
    world: World,
    touching: Touching,
    bodies: tuple[Velocity, Impulses],
    speeds: tuple[Speeds, ...],
    slow: Array,
    h: Array,
) -> tuple[Velocity, Impulses]:
    """Velocities at the start of a sub-step after the impacts of all that would reach each other in it, and their impulses.

    `speeds` of contacts are those at the start and the mean ones.
    """
    now, middle = (jax.vmap(world.mechanics.find_openings)(each, touching.contacts) for each in speeds)
    # forces change by `u - v` how fast the gap closes
    reach = tuple(s / by_world(h[0], s) + (u - v) for s, u, v in zip(touching.gap, middle, now, strict=True))
    bouncing = Bouncing(world.materials.restitution, slow, reach)
    links = None if world.links is None else world.links.take_impacts()
    return resolve_impacts(world.mechanics, bodies, now, world.groups, touching.contacts, bouncing, links)


__all__ = ["solve_contacts"]
