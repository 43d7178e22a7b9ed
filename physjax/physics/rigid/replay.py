"""The step of rigid bodies flown again with its impacts known, which is what its derivatives go through.

A leg has two halves, in which impulses act: as it begins, and as it ends. The search finds without derivatives when bodies
strike; the moment of an impact moves along the zero of the distance of the lowest point.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool

from physjax.backend import any_lane
from physjax.loops import Time
from physjax.physics.contacts.legs import Flight, Motion, choose_lanes
from physjax.physics.rigid.impact_search import MAX_LEGS, LegLog, split_remaining_step
from physjax.physics.rigid.point_contacts import ContactKind, face_surfaces, measure_points, stack_body_contacts
from physjax.physics.rigid.reactions import (
    Leg,
    Place,
    Stage,
    Thrust,
    apply_half_impulse,
    exchange_impulses,
    move_with_reactions,
    take_shared_number,
)
from physjax.physics.rigid.spatial import RigidBodies
from physjax.replays import Record, Replay
from physjax.scene import Scene

Total = TypeVar("Total")


class HalfStart(NamedTuple):
    """Where half a leg begins: time since the step's start [s], the bodies as the leg began, and the reactions through it."""

    elapsed: Array
    before: RigidBodies
    thrust: Thrust


class HalfLeg(NamedTuple):
    """What is decided of half a leg, without derivatives: which points stay, which bodies are at rest, what they measure.

    `ends` says for all bodies which half it is. Those that are `active` have this leg.
    """

    on: Bool[Array, "points *lanes"]
    rests: Bool[Array, "*lanes"]
    load_speed: Array
    ends: Bool[Array, ""]
    strikes: Bool[Array, "*lanes"]
    active: Bool[Array, "*lanes"]


class HeldLeg(NamedTuple):
    """A leg: time before it [s], how it began, the surfaces that it meets, when it began [s], what was left of the step [s]."""

    elapsed: Array
    leg: Leg
    facing: tuple[ContactKind, ...]
    leg_start: Time
    rest: Array


def record_legs(log: LegLog, legs: Array) -> Record:
    """What a replay needs of the legs that a search has logged, of which each body has this number."""
    numbers = jnp.arange(2 * MAX_LEGS, dtype=jnp.int32)
    by_half = lambda number: number.reshape(-1, *(1,) * legs.ndim)  # noqa: E731
    (leg, elapsed, duration, strikes) = jax.tree.map(lambda leaf: jnp.repeat(leaf, 2, axis=0), log)
    ends, active = numbers % 2 == 1, by_half(numbers // 2) < legs[None]
    choices = HalfLeg(leg.on, leg.rests, leg.load_speed, ends, strikes & by_half(ends), active)
    return Record(HalfStart(elapsed, leg.before, leg.thrust), jnp.where(by_half(ends), duration, 0.0), choices, active)


def _begin(motion: Motion, scene: Scene, t: Time, dt: ArrayLike) -> HalfStart:
    state, none = scene.state, jnp.zeros_like(scene.state.momentum)
    return HalfStart(jnp.zeros(state.lanes, state.dtype), state, (none, none))


def _hold(choices: HalfLeg, start: HalfStart, motion: Motion, scene: Scene, t: Time, dt: ArrayLike) -> HeldLeg:
    elapsed, before, thrust = start
    leg_start, rest = split_remaining_step(elapsed, t, jnp.broadcast_to(dt, elapsed.shape))
    facing = face_surfaces(stack_body_contacts(scene), leg_start, before)
    leg = Leg(before, thrust, choices.on, choices.rests, choices.load_speed)
    return HeldLeg(elapsed, leg, facing, leg_start, rest)


def _fly(
    choices: HalfLeg, held: HeldLeg, duration: Array, motion: Motion, scene: Scene, t: Time, dt: ArrayLike
) -> tuple[RigidBodies, Array]:
    """The bodies after a duration [s]; and the distance of the lowest point that does not rest [m], or the rest of the step."""
    move = lambda: move_with_reactions(motion, scene, held.leg, held.leg_start, duration)  # noqa: E731
    end = lax.cond(choices.ends, move, lambda: held.leg.before)
    distance = measure_points(held.facing, held.leg_start + duration, end)
    lowest = jnp.min(jnp.where(choices.on, jnp.inf, distance), axis=0)
    left = jnp.where(choices.ends, held.rest, 0.0) - duration
    return end, jnp.where(choices.strikes, lowest, left)


def _end(
    choices: HalfLeg,
    held: HeldLeg,
    duration: Array,
    end: RigidBodies,
    motion: Motion,
    scene: Scene,
    t: Time,
    dt: ArrayLike,
) -> HalfStart:
    """The start of the next half: after the reactions have begun, or after an impact."""
    active, strikes, leg = choices.active, choices.strikes, held.leg
    here = Place.find(held.facing, held.leg_start + duration, end, scene.mass)
    stage = Stage(active & ~choices.ends, active & choices.ends & ~strikes, active & strikes)
    dt = jnp.broadcast_to(dt, held.rest.shape)
    met = exchange_impulses(scene, leg, stage, here, (dt, held.rest))
    after = choose_lanes(stage.strikes, met.struck, choose_lanes(stage.arrives, met.held, leg.before))
    return HalfStart(jnp.where(active, held.elapsed + duration, held.elapsed), after, met.leg.thrust)


REPLAY = Replay(_begin, _hold, _fly, _end, lambda record, end: end.before)
"""A step of rigid bodies, half a leg at a time."""


def fold_legs(
    motion: Motion,
    scene: Scene,
    t: Time,
    dt: ArrayLike,
    record: Record,
    add: Callable[[Total, Flight], Total],
    total: Total,
) -> Total:
    """The total of `total = add(total, flight)` over the legs of a step."""
    shared = partial(take_shared_number, scene)

    def fly(total: Total, half: Record) -> Total:
        choices, h = half.choices, half.durations
        held = _hold(choices, half.starts, motion, scene, t, dt)
        leg = held.leg
        end, _ = _fly(choices, held, h, motion, scene, t, dt)
        after = _end(choices, held, h, end, motion, scene, t, dt).before
        start = scene.replace(state=apply_half_impulse(leg.before, leg.thrust, h))
        return add(total, Flight(leg.before, start, shared(held.leg_start), shared(h), end, after, half.active))

    def go_on(total: Total, half: Record) -> tuple[Total, None]:
        return lax.cond(half.choices.ends & any_lane(half.active), lambda: fly(total, half), lambda: total), None

    return lax.scan(go_on, total, record)[0]
