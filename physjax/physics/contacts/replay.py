"""A step flown again with its events known, for derivatives and for the energy budget.

The search finds moments and choices without derivatives. With these given, the legs of a step are a smooth function of
everything: only the moment of an event still moves, along the zero of its guard.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool

from physjax.backend import any_lane
from physjax.loops import Time, to_float_time
from physjax.particles import Particles
from physjax.physics.contacts.contact_mode import ContactMode, get_reaction, make_free_mode, start_leg
from physjax.physics.contacts.impact_response import (
    Verdict,
    measure_guards,
    measure_last_flights,
    meet_surface,
    respond_to_event,
    select_guard,
)
from physjax.physics.contacts.legs import Flight, Motion, choose_lanes
from physjax.physics.contacts.search import Leg, Progress, find_events
from physjax.physics.contacts.surfaces import Surfaces
from physjax.replays import Record
from physjax.scene import Scene

Total = TypeVar("Total")


class LegStart(NamedTuple):
    """Where a leg begins: time since the step's start [s], state before it is put onto surfaces, begin of contact [s]."""

    elapsed: Array
    state: Particles
    since: Array


class FlownLeg(NamedTuple):
    """What is decided of a leg, without derivatives, and the lanes that have it."""

    mode: ContactMode
    verdict: Verdict
    arrives: Bool[Array, "*lanes"]
    active: Bool[Array, "*lanes"]


class HeldLeg(NamedTuple):
    """A leg as it begins: its start, the scene put onto what carries it, the faces that it meets, when [s], and the rest."""

    start: LegStart
    held: Scene
    faces: Surfaces
    leg_start: Time
    rest: Array


def log_events(
    motion: Motion, scene: Scene, surfaces: Surfaces, t: Time, dt: Array, active: Array, most: int
) -> tuple[Progress, Record]:
    """The step from event to event, and the legs up to its first `most` impacts."""
    none = jnp.zeros(dt.shape, bool)
    verdict = Verdict(jnp.zeros(dt.shape, jnp.int32), none, none, none)
    blank = Leg(jnp.zeros_like(dt), make_free_mode(scene, surfaces), verdict, none)
    every_leg = lambda tree: jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (most + 1, *leaf.shape)), tree)  # noqa: E731
    empty = every_leg(((jnp.zeros_like(dt), scene.state), blank))
    progress, ((elapsed, states), legs) = find_events(motion, scene, surfaces, t, dt, active, _log_leg, empty)
    flown = _number_legs(most + 1, dt) < progress.legs[None]
    # of begins of contact only the last is asked for, and a leg's own does not depend on those before
    starts = LegStart(elapsed, states, every_leg(surfaces.touching_since))
    return progress, Record(starts, legs.duration, FlownLeg(legs.mode, legs.verdict, legs.arrives, flown), flown)


Logged = tuple[tuple[Array, Particles], Leg]
"""When [s] and in which state the legs of a step began, and how they were flown, along a leading axis."""


def _log_leg(logged: Logged, before: Progress, after: Progress, leg: Leg) -> Logged:
    """The log with a leg written at its number in the lanes in which it has ended, and the start of the next."""
    starts, legs = logged
    ends, numbers = (after.legs > before.legs)[None], _number_legs(len(legs.duration), leg.duration)
    here, next_ = ends & (numbers == before.legs[None]), ends & (numbers == after.legs[None])
    by_lane = lambda old, new: jnp.where(here, new[None], old)  # noqa: E731
    pressed = jnp.where(here[:, None], leg.mode.pressed[None], legs.mode.pressed)
    slip = legs.mode.slip
    if slip is not None and leg.mode.slip is not None:
        slip = jnp.where(here[:, None, ..., None], leg.mode.slip[None], slip)
    started = jax.tree.map(lambda leaf: leaf[None], (after.elapsed, after.state))
    return choose_lanes(next_, started, starts), Leg(
        by_lane(legs.duration, leg.duration),
        ContactMode(pressed, by_lane(legs.mode.still, leg.mode.still), slip),
        Verdict(*map(by_lane, legs.verdict, leg.verdict)),
        by_lane(legs.arrives, leg.arrives),
    )


def _number_legs(legs: int, like: Array) -> Array:
    return jnp.arange(legs, dtype=jnp.int32).reshape(-1, *(1,) * like.ndim)


def hold_leg(
    choices: FlownLeg, start: LegStart, motion: Motion, scene: Scene, surfaces: Surfaces, t: Time, dt: Array
) -> HeldLeg:
    """A leg in its known contact mode, from where it starts."""
    del motion
    leg_start = t + start.elapsed
    held, faces = start_leg(scene.replace(state=start.state), surfaces, choices.mode, leg_start)
    return HeldLeg(start, held, faces, leg_start, dt - start.elapsed)


def fly_leg(choices: FlownLeg, leg: HeldLeg, duration: Array, motion: Motion) -> tuple[Particles, Array]:
    """The state after a duration [s], and what is zero when the leg ends: its guard, or the rest of the step [s]."""
    end = motion(leg.held, leg.leg_start, duration).state
    guards = measure_guards(leg.faces, get_reaction(leg.held), to_float_time(leg.leg_start + duration), end)
    verdict = choices.verdict
    falls = jnp.where(choices.arrives, leg.rest - duration, -duration)
    return end, jnp.where(verdict.bounces | verdict.stops, select_guard(guards, verdict.guard), falls)


def end_leg(choices: FlownLeg, leg: HeldLeg, duration: Array, end: Particles) -> LegStart:
    """Where the event that ends a leg leads: the start of the next."""
    (start, held, faces, leg_start, _), (_, verdict, _, active) = leg, choices
    end_time = leg_start + duration
    reaction, time = get_reaction(held), to_float_time(end_time)
    meeting = meet_surface(faces, reaction, measure_guards(faces, reaction, time, end), verdict.guard, time, end)
    after = respond_to_event(meeting, verdict, end)
    rests = active & verdict.rests
    delay = measure_last_flights(meeting, rests, held.acceleration(end_time, end))
    since = jnp.where(meeting.chosen & rests[None], (time + delay)[None], start.since)
    elapsed, state = choose_lanes(active, (start.elapsed + duration, after), (start.elapsed, start.state))
    return LegStart(elapsed, state, since)


def fold_legs(
    motion: Motion,
    scene: Scene,
    surfaces: Surfaces,
    t: Time,
    dt: Array,
    record: Record,
    add: Callable[[Total, Flight], Total],
    total: Total,
) -> Total:
    """The total of `total = add(total, flight)` over the legs of a step."""

    def fly(total: Total, leg: Record) -> Total:
        choices, duration = leg.choices, leg.durations
        held_leg = hold_leg(choices, leg.starts, motion, scene, surfaces, t, dt)
        end, _ = fly_leg(choices, held_leg, duration, motion)
        after = end_leg(choices, held_leg, duration, end).state
        held, leg_start = held_leg.held, held_leg.leg_start
        return add(total, Flight(leg.starts.state, held, leg_start, duration, end, after, leg.active))

    def go_on(total: Total, leg: Record) -> tuple[Total, None]:
        return lax.cond(any_lane(leg.active), lambda: fly(total, leg), lambda: total), None

    return lax.scan(go_on, total, record)[0]
