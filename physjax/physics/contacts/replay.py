"""A step flown again with its events known, for derivatives and for the energy budget.

The search finds moments and choices without derivatives. With these given, the legs of a step are a smooth function of
everything: only the moment of an event still moves, h ← h - (g(h) - g)/s with g the guard and s its slope along the
method's own step. Its value stays; a pass gives it one order of derivatives (implicit function theorem), and two are made.
"""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from physjax.backend import MIN_LANES_TO_SELECT, any_lane
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
from physjax.physics.contacts.legs import Flight, Motion, choose_lanes, shortest_duration
from physjax.physics.contacts.search import Leg, Progress, find_events
from physjax.physics.contacts.surfaces import Surfaces
from physjax.scene import Scene

ORDERS = 2
"""Orders of derivatives that the moment of an event has."""

Total = TypeVar("Total")


def log_events(
    motion: Motion, scene: Scene, surfaces: Surfaces, t: Time, dt: Array, active: Array, most: int
) -> tuple[Progress, Leg]:
    """The step from event to event, and how the legs up to its first `most` impacts were flown, along a leading axis."""
    none = jnp.zeros(dt.shape, bool)
    verdict = Verdict(jnp.zeros(dt.shape, jnp.int32), none, none, none)
    blank = Leg(jnp.zeros_like(dt), make_free_mode(scene, surfaces), verdict, none, jnp.zeros_like(dt))
    empty = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (most + 1, *leaf.shape)), blank)
    return find_events(motion, scene, surfaces, t, dt, active, _log_leg, empty, slopes=True)


def _log_leg(legs: Leg, ends: Array, number: Array, leg: Leg) -> Leg:
    """The log with a leg written at its number in the lanes in which it ends."""
    here = ends[None] & (number[None] == jnp.arange(len(legs.slope), dtype=number.dtype).reshape(-1, *(1,) * ends.ndim))
    by_lane = lambda old, new: jnp.where(here, new[None], old)  # noqa: E731
    pressed = jnp.where(here[:, None], leg.mode.pressed[None], legs.mode.pressed)
    slip = legs.mode.slip
    if slip is not None and leg.mode.slip is not None:
        slip = jnp.where(here[:, None, ..., None], leg.mode.slip[None], slip)
    return Leg(
        by_lane(legs.duration, leg.duration),
        ContactMode(pressed, by_lane(legs.mode.still, leg.mode.still), slip),
        Verdict(*map(by_lane, legs.verdict, leg.verdict)),
        by_lane(legs.arrives, leg.arrives),
        by_lane(legs.slope, leg.slope),
    )


def replay_step(
    motion: Motion,
    scene: Scene,
    surfaces: Surfaces,
    t: Time,
    dt: Array,
    flown: tuple[Array, Leg],
    add: Callable[[Total, Flight], Total],
    total: Total,
) -> tuple[Particles, Array, Total]:
    """The state after the legs of a step, begin of contact [s], and the total of `total = add(total, flight)` over them.

    `flown` is how many legs each lane has, and what is logged of each.
    """

    @jax.checkpoint  # reverse mode computes each leg again: storing what it needs of one costs more than the work
    def fly(carry: tuple, leg: Leg, active: Array) -> tuple:
        elapsed, state, since, total = carry
        here = scene.replace(state=state)
        flight, since = _fly_leg(motion, here, surfaces, since, t + elapsed, dt - elapsed, leg, active)
        after = jnp.where(active, elapsed + flight.duration, elapsed), choose_lanes(active, flight.after, state)
        return (*after, since, add(total, flight))

    def go_on(carry: tuple, numbered: tuple[Array, Leg]) -> tuple[tuple, None]:
        number, leg = numbered
        active = number < flown[0]
        return lax.cond(any_lane(active), lambda: fly(carry, leg, active), lambda: carry), None

    numbers = jnp.arange(len(flown[1].slope), dtype=jnp.int32)
    start = jnp.zeros_like(dt), scene.state, surfaces.touching_since, total
    (_, state, since, total), _ = lax.scan(go_on, start, (numbers, flown[1]))
    return state, since, total


def _fly_leg(
    motion: Motion,
    scene: Scene,
    surfaces: Surfaces,
    since: Array,
    leg_start: Time,
    rest: Array,
    leg: Leg,
    active: Array,
) -> tuple[Flight, Array]:
    """A leg with its event known, from the scene's state to where the event has led; and begin of contact [s] after it."""
    held, faces = start_leg(scene, surfaces, leg.mode, leg_start)
    verdict = leg.verdict
    logged = jnp.where(leg.arrives, jnp.maximum(rest, shortest_duration(rest)), leg.duration)
    ends = active & (verdict.bounces | verdict.stops) & (leg.slope < 0)
    duration, end, guards = _find_moment(
        motion, held, faces, leg_start, logged, jnp.where(ends, leg.slope, -jnp.inf), verdict.guard
    )
    end_time = leg_start + duration
    meeting = meet_surface(faces, get_reaction(held), guards, verdict.guard, to_float_time(end_time), end)
    after = respond_to_event(meeting, verdict, end)
    rests = active & verdict.rests
    delay = measure_last_flights(meeting, rests, held.acceleration(end_time, end))
    since = jnp.where(meeting.chosen & rests[None], (to_float_time(end_time) + delay)[None], since)
    return Flight(scene.state, held, leg_start, duration, end, after, active), since


def _find_moment(
    motion: Motion, held: Scene, faces: Surfaces, leg_start: Time, logged: Array, slope: Array, guard: Array
) -> tuple[Array, Particles, Array]:
    """The duration of a leg [s] with its derivatives, and the state and the guards after it.

    The slope of the guard that ends it is infinite where nothing does.
    """

    def move(duration: Array) -> tuple[Particles, Array]:
        end = motion(held, leg_start, duration).state
        return end, measure_guards(faces, get_reaction(held), to_float_time(leg_start + duration), end)

    def improve(carry: tuple, last: Array) -> tuple[tuple, None]:
        def move_again() -> tuple:
            end, guards = move(carry[0])
            value = select_guard(guards, guard)
            # only derivatives move the moment, and not those of the last pass
            change = (value - lax.stop_gradient(value)) / slope
            return carry[0] - jnp.where(last, 0.0, change), end, guards

        if slope.size < MIN_LANES_TO_SELECT:  # moving few lanes again is less work than to ask, and sooner compiled
            return move_again(), None
        return lax.cond(last | any_lane(jnp.isfinite(slope)), move_again, lambda: carry), None

    blank = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(move, logged))
    last = jnp.arange(ORDERS + 1) == ORDERS
    return lax.scan(improve, (logged, *blank), last)[0]
