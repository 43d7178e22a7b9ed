"""The step of rigid bodies flown again with its impacts known, which is what its derivatives go through.

The search finds without derivatives when bodies strike. With these times the step is a short scan over its legs. The moment
of an impact is h - d(h)/s, with d the distance of the lowest point on the method's own step, and s its derivative by h, which
is held: the value is only rounded again, but it moves with all that d depends on. By differences s is off by a share ε, and
the derivatives by ε²: the second pass corrects the first.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.backend import any_lane
from physjax.loops import Time
from physjax.physics.contacts.legs import Flight, Motion, choose_lanes
from physjax.physics.rigid.impact_search import MAX_LEGS, Progress, split_remaining_step, start_progress
from physjax.physics.rigid.point_contacts import ContactKind, count_points, face_surfaces
from physjax.physics.rigid.reactions import (
    Leg,
    Place,
    Stage,
    apply_half_impulse,
    exchange_impulses,
    move_with_reactions,
    start_leg,
    take_shared_number,
)
from physjax.scene import Scene

NEWTON_PASSES = 2
"""Newton steps for the moment of an impact: each gives one more order of its derivatives."""

Total = TypeVar("Total")
Observer = Callable[[Total, Flight], Total]


class _Replay(NamedTuple):
    """What one half of a leg hands to the next."""

    leg: Leg
    elapsed: Array
    arrived: Array


def replay_step(
    motion: Motion,
    scene: Scene,
    kinds: tuple[ContactKind, ...],
    durations: Array,
    t: Time,
    dt: ArrayLike,
    observe: tuple[Observer, Total] | None = None,
) -> tuple[Progress, Total | None]:
    """The step with these durations of the legs that end in an impact [s], and what an observer made of its flights.

    `durations` are `(legs, *lanes)` and infinite where a leg reaches the end of the step.
    """
    progress, dt = start_progress(scene, dt)
    add, total = (None, None) if observe is None else observe

    # reverse mode computes each half of a leg again: storing what it needs of one costs more than the work
    @jax.checkpoint
    def act(replay: _Replay, total: Total, duration: Array, ends: Array) -> tuple[_Replay, Total]:
        return _take_half_leg(motion, scene, kinds, replay, (duration, ends), t, dt, add, total)

    def go_on(carry: tuple[_Replay, Any], half: tuple[Array, Array]) -> tuple[tuple[_Replay, Any], None]:
        return lax.cond(
            any_lane(~carry[0].arrived), act, lambda replay, total, *_: (replay, total), *carry, *half
        ), None

    # a leg has two halves, in which impulses act: as it begins, and as it ends
    halves = jnp.repeat(durations, 2, axis=0), jnp.arange(2 * MAX_LEGS) % 2 == 1
    start: tuple[_Replay, Any] = (
        _Replay(start_leg(scene.state, count_points(kinds)), progress.elapsed, progress.arrived),
        total,
    )
    (end, total), _ = lax.scan(go_on, start, halves)
    return Progress(end.elapsed, end.leg.before, end.arrived), total


def _take_half_leg(
    motion: Motion,
    scene: Scene,
    kinds: tuple[ContactKind, ...],
    replay: _Replay,
    half: tuple[Array, Array],
    t: Time,
    dt: Array,
    add: Observer | None,
    total: Total,
) -> tuple[_Replay, Total]:
    """The beginning of a leg, with its reactions, or its flight and what it `ends` with: an impact, or the end of the step."""
    leg, (duration, ends) = replay.leg, half
    leg_start, rest = split_remaining_step(replay.elapsed, t, dt)
    facing = face_surfaces(kinds, leg_start, leg.before)
    going = ~replay.arrived
    strikes = going & ends & jnp.isfinite(duration)
    h = jnp.where(ends, jnp.where(strikes, duration, rest), 0.0)
    fly = partial(_fly_leg, motion, scene, facing, leg, leg_start)
    h, here = _find_moment(fly, h, strikes, ends)
    stage = Stage(going & ~ends, going & ends & ~strikes, strikes)
    met = exchange_impulses(scene, leg, stage, here, (dt, rest))
    after = choose_lanes(strikes, met.struck, choose_lanes(stage.arrives, met.held, leg.before))
    if add is not None:
        start = scene.replace(state=apply_half_impulse(leg.before, leg.thrust, h))
        shared = partial(take_shared_number, scene)
        flight = Flight(leg.before, start, shared(leg_start), shared(h), here.state, after, going)
        total = lax.cond(ends, lambda: add(total, flight), lambda: total)
    elapsed = replay.elapsed + jnp.where(going, h, 0.0)
    return _Replay(met.leg._replace(before=after), elapsed, replay.arrived | stage.arrives), total


def _fly_leg(
    motion: Motion,
    scene: Scene,
    kinds: tuple[ContactKind, ...],
    leg: Leg,
    leg_start: Time,
    ends: Array,
    h: Array,
) -> tuple[Array, Place]:
    """The distance of the lowest point that does not rest [m] after a time h [s], and where the bodies are then."""
    state = lax.cond(ends, lambda h: move_with_reactions(motion, scene, leg, leg_start, h), lambda _: leg.before, h)
    there = Place.find(kinds, leg_start + h, state, scene.mass)
    return jnp.min(jnp.where(leg.on, jnp.inf, there.points.signed_distance), axis=0), there


def _find_moment(fly: Callable, h: Array, strikes: Array, ends: Array) -> tuple[Array, Place]:
    """The durations with their derivatives, and where the bodies are after them.

    The first two of the loop's passes look a little before and after the moment, for the distance's derivative by h; the
    next are Newton's. In one loop the motion stands once; without an impact its last pass is enough.
    """
    nowhere = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(fly, ends, h))
    offset = float(jnp.finfo(h.dtype).eps) ** (1 / 3) * h
    passes = 2 + NEWTON_PASSES + 1

    def pass_(carry: tuple, number: Array) -> tuple[tuple, None]:
        def look(h: Array, slope: Array) -> tuple:
            before, after = number == 0, number == 1
            here = h + jnp.where(before, -offset, jnp.where(after, offset, 0.0))
            distance, there = fly(ends, here)
            # before the moment the distance itself is kept, after it the two make the derivative
            measured = lax.stop_gradient(
                jnp.where(before, distance, (distance - slope) / jnp.where(strikes, 2 * offset, 1.0))
            )
            falls = strikes & (slope < 0) & (number > 1) & (number < passes - 1)
            h = jnp.where(falls, h - distance / jnp.where(falls, slope, 1.0), h)
            return h, jnp.where(number < 2, measured, slope), (distance, there)

        skip = lambda h, slope: (h, slope, carry[-1])  # noqa: E731
        return lax.cond((number == passes - 1) | any_lane(strikes), look, skip, *carry[:-1]), None

    (h, _, (_, there)), _ = lax.scan(pass_, (h, jnp.zeros_like(h), nowhere), jnp.arange(passes))
    return h, there
