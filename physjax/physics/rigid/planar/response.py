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

from physjax.loops import Time, to_float_time
from physjax.physics.rigid.planar.bodies import PlanarBodies
from physjax.physics.rigid.planar.impacts import ROUNDING, Bouncing, resolve_impacts
from physjax.physics.rigid.planar.impulses import (
    SOFT,
    Demand,
    Impulses,
    Points,
    Velocity,
    map_components,
    measure_several,
    measure_speeds,
    sum_impulses,
    sweep_contacts,
)
from physjax.physics.rigid.planar.touching import Touching, World, build_world, find_contacts
from physjax.scene import Scene

Motion = Callable[..., Scene]
REST_SPEED_STEPS = 2.0
"""What forces change in any speed within as many sub-steps is no impact: what approaches slower than that stays."""

FRICTION_LEARNED = 0.1
"""Share by which the friction that is kept follows that in the mean: without, boxes of a pyramid creep by 1.5 mm/s for ever,
with velocities of zero at the ends of sub-steps. Normal impulses that follow make towers sway more and more."""


class Pose(NamedTuple):
    """Where bodies are and how fast they move, each number `(bodies, worlds)`: x, y [m], angle [rad] and their rates."""

    place: tuple[Array, Array, Array]
    rate: tuple[Array, Array, Array]


def solve_contacts(motion: Motion, scene: Scene, t: Time, dt: ArrayLike) -> Scene:
    """The scene after a step of dt in sub-steps, each of them: the method's own step, impacts, and impulses at contacts."""
    number, *others = (i for i, contact in enumerate(scene.contacts) if contact.response is solve_contacts)
    if others:
        raise ValueError(
            f"contacts: got {1 + len(others)} Solids, expected one: it holds all bodies, shapes= one for each, and all surfaces."
        )
    solids: Any = scene.contacts[number]
    world = build_world(solids, scene)
    dt = jnp.asarray(dt, scene.state.dtype)
    h = dt / solids.substeps
    across, first, second = jnp.moveaxis(solids.impulses.reshape(-1, *solids.impulses.shape[-3:]), 0, -1)

    def take(carry: tuple[PlanarBodies, Impulses], substep: Array) -> tuple[tuple[PlanarBodies, Impulses], None]:
        state, impulses = carry
        start = t + substep.astype(h.dtype) * h
        moved = motion(scene.replace(state=state), start, h).state
        return _take_substep(world, scene, (state, moved), impulses, to_float_time(start), h), None

    begun, substeps = (scene.state, (across, first, second)), jnp.arange(solids.substeps, dtype=jnp.int32)
    (state, impulses), _ = lax.scan(jax.checkpoint(take, prevent_cse=False), begun, substeps)
    after = jnp.moveaxis(jnp.stack(impulses), -1, 0).reshape(solids.impulses.shape)
    contacts = list(scene.contacts)
    contacts[number] = eqx.tree_at(lambda solids: solids.impulses, solids, after)
    return scene.replace(state=state, contacts=tuple(contacts))


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
    h = jnp.broadcast_to(h.reshape(1, -1), (1, world.worlds))
    start, moved = (read_pose(state, scene) for state in states)
    touching = find_contacts(world, start.place, t)
    free = mean, end = map_components(lambda a, b: (b - a) / h, start.place, moved.place), moved.rate
    changes = [jnp.max(jnp.abs(after - now), axis=0) for now, after in zip(start.rate[:2], end[:2], strict=True)]
    slow = REST_SPEED_STEPS * jnp.maximum(*changes)
    before = world.pad_all(start.rate)
    speeds, middle = measure_several((before, world.pad_all(mean)), world.groups, touching.contacts)
    touching = _stick(world, touching, speeds[0], start.rate, slow)
    bounced = world.cut_all(_bounce(world, touching, before, (speeds, middle), slow, h))
    impact = map_components(jnp.subtract, bounced, start.rate)
    bounced = map_components(jnp.add, mean, impact), map_components(jnp.add, end, impact)
    moves, impulses = _hold_apart(world, touching, bounced, impulses, h)
    places, rates = (map_components(jnp.subtract, after, before) for after, before in zip(moves, free, strict=True))
    return _write_pose(states[1], map_components(lambda part: h * part, places), rates, scene), impulses


def _stick(world: World, touching: Touching, slip: Array, rate: Velocity, slow: Array) -> Touching:
    """The contacts with static friction where they do not slip, or so slowly that forces may have just begun it."""
    contacts, rounding = touching.contacts, ROUNDING * float(jnp.finfo(slow.dtype).eps)
    fastest = jnp.maximum(*(jnp.max(jnp.abs(part), axis=0) for part in rate[:2]))
    sticks = jnp.abs(slip) <= (slow + rounding * fastest)[None, None]
    return touching._replace(
        contacts=contacts._replace(friction=jnp.where(sticks, world.materials.static, contacts.friction))
    )


class _Pass(NamedTuple):
    """What a sweep starts with, and what it is asked for."""

    velocity: Velocity
    impulses: Impulses
    demand: Demand


def _hold_apart(
    world: World, touching: Touching, velocities: tuple[Velocity, Velocity], held: Impulses, h: Array
) -> tuple[tuple[Velocity, Velocity], Impulses]:
    """The mean velocities and those at the end after contacts have acted, and what is kept of their impulses.

    Two passes of one and the same sweep: the first finds the mean velocities, in which gaps must not close nor overlaps
    stay; the second those at the end, with which nothing that touches may approach. What is kept is by how much the impulses
    at the end are more than those in the mean: that is half of what a constant force needs, and none of what stops a motion
    once, which both have in common. It is what the next sub-step starts with; its impulses at the end start with those that
    it has found in the mean. So errors of a sweep do not feed on themselves; friction alone follows that of the mean a little.
    """
    (mean, end), groups, (contacts, gap, _) = velocities, world.groups, touching
    push = sum_impulses(contacts, held, world.incidence)
    each, still = h[None], jnp.zeros_like(gap[0])

    def sweep(this: _Pass, _: Any) -> tuple[_Pass, tuple[Velocity, Impulses, Points]]:
        after, pressed = sweep_contacts(world.pad_all(this.velocity), groups, contacts, this.demand, this.impulses)
        _, *opening = measure_speeds(after, groups, contacts)
        cases = zip(contacts.is_point, pressed[1:], gap, opening, strict=True)
        first, second = (is_point & ((press > 0) | (s + each * v <= 0)) for is_point, press, s, v in cases)
        after = world.cut_all(after)
        # the impulses in the mean act on the end as well
        ahead = map_components(lambda a, e, m, p: a + (e - m) + p, after, end, mean, push)
        doubled = map_components(jnp.add, held, pressed)
        following = _Pass(ahead, doubled, Demand.hard((still, still), (first, second)))
        return following, (after, pressed, (first, second))

    overlaps = gap[0] <= 0, gap[1] <= 0
    cure = [jnp.where(over, -SOFT.cure * s, -s) / each for over, s in zip(overlaps, gap, strict=True)]
    start = _Pass(map_components(jnp.add, mean, push), held, Demand((cure[0], cure[1]), overlaps, contacts.is_point))
    _, (rates, impulses, touches) = lax.scan(sweep, start, length=2)
    moves, stops = (map_components(lambda part, k=k: part[k], rates) for k in range(2))
    first, second = (active[0] for active in touches)
    keep = lambda stay, impulse: jnp.where(stay, impulse[1] - impulse[0], 0.0)  # noqa: E731
    grip, *press = map_components(keep, (first | second, first, second), impulses)
    follows = jnp.where(first | second, FRICTION_LEARNED * (impulses[0][0] - held[0]), 0.0)
    return (moves, stops), (grip + follows, press[0], press[1])


def _bounce(
    world: World,
    touching: Touching,
    before: Velocity,
    speeds: tuple[Impulses, Impulses],
    slow: Array,
    h: Array,
) -> Velocity:
    """Velocities at the start of a sub-step after the impacts of all that would reach each other in it.

    `speeds` of contacts are those at the start and the mean ones.
    """
    now, middle = (opening for _, *opening in speeds)
    # forces change by `u - v` how fast the gap closes
    reach = [s / h[None] + (u - v) for s, u, v in zip(touching.gap, middle, now, strict=True)]
    bouncing = Bouncing(world.materials.restitution, slow, (reach[0], reach[1]))
    return resolve_impacts(before, (now[0], now[1]), world.groups, touching.contacts, bouncing)


def read_pose(state: PlanarBodies, scene: Scene) -> Pose:
    """Where the bodies of a state of the scene are and how fast they move."""
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


__all__ = ["Pose", "read_pose", "solve_contacts"]
