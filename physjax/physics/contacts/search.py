"""The search for the events of a step: one loop in which every lane is in a state of its own, and all move once a turn.

A lane tries the rest of its step; if a guard falls on the way, it refines the moment at which that guard is zero; there
it bounces, comes to rest or stops sliding, and tries what is left. So the method's step stands in the program once,
however many surfaces there are. Nothing here has derivatives: those are carried by the replay.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Int

from physjax.backend import any_lane, materialise_where
from physjax.loops import Time, bounded_while_loop, to_float_time
from physjax.particles import Particles
from physjax.physics.contacts.contact_mode import (
    ContactMode,
    apply_contact_mode,
    decide_contact_mode,
    get_reaction,
    make_free_mode,
    put_on_surfaces,
)
from physjax.physics.contacts.events import Event, find_next_event
from physjax.physics.contacts.impact_response import (
    Verdict,
    judge_event,
    measure_guards,
    measure_last_flights,
    meet_surface,
    respond_to_event,
    update_contact_starts,
)
from physjax.physics.contacts.legs import MAX_IMPACTS, Motion, choose_lanes, shortest_duration
from physjax.physics.contacts.surfaces import Surfaces
from physjax.scene import Scene
from physjax.vectors import norm

MAX_TRIES = 64
"""Turns that one event may take on average: bisection alone needs 52 in float64, the usual is three to five."""
TIME_ROUNDING = 4
"""Units of rounding of the rest of a step within which the moment of an event is known."""
GUARD_ROUNDING = 2
"""Units of rounding of its place, or of its speed, within which a guard is zero."""
REACHED_ROUNDING = 64
"""Units of rounding of its place within which a lane has reached a surface."""

Tree = TypeVar("Tree")


class Bracket(NamedTuple):
    """Where the next event of a lane is sought: durations since the start of the leg [s], and the guard there.

    The guard is positive at `low` and not at `high`; `value` and `slope` [1/s] are those at the last `tried` duration, and
    `exact` is a value that is zero but for rounding. `refining` is false of lanes without an event.
    """

    refining: Bool[Array, "*lanes"]
    low: Array
    high: Array
    next: Array
    tried: Array
    value: Array
    slope: Array
    exact: Array
    reach: Array
    watched: Bool[Array, "guards *lanes"]


class Leg(NamedTuple):
    """How a leg was flown: for how long [s], in which contact mode, what ended it, and whether that was the step's end."""

    duration: Array
    mode: ContactMode
    verdict: Verdict
    arrives: Bool[Array, "*lanes"]


class Progress(NamedTuple):
    """How far each lane is in a step: time so far [s], the state that its leg began with, begin of contact [s], legs flown."""

    elapsed: Array
    state: Particles
    since: Array
    mode: ContactMode
    bracket: Bracket
    legs: Int[Array, "*lanes"]
    arrived: Bool[Array, "*lanes"]


def start_progress(scene: Scene, surfaces: Surfaces, dt: Array, active: Array) -> Progress:
    """Where the first leg of a step begins; lanes that are not active have arrived."""
    zero = jnp.zeros_like(dt)
    guards = len(surfaces) + (min(len(surfaces), scene.state.position.shape[-1]) if surfaces.rough.any() else 0)
    watched = jnp.zeros((guards, *dt.shape), bool)
    bracket = Bracket(jnp.zeros(dt.shape, bool), zero, zero, zero, zero, zero, zero, zero, zero, watched)
    none = jnp.zeros(dt.shape, jnp.int32)
    mode = make_free_mode(scene, surfaces)
    return Progress(zero, scene.state, surfaces.touching_since, mode, bracket, none, ~active)


def find_events(
    motion: Motion,
    scene: Scene,
    surfaces: Surfaces,
    t: Time,
    dt: Array,
    active: Array,
    log: Callable[[Tree, Progress, Progress, Leg], Tree],
    logged: Tree,
) -> tuple[Progress, Tree]:
    """The step of lanes that are active, from event to event, at most `MAX_IMPACTS` of them.

    Each turn is handed to `log(logged, before, after, leg)`: the leg has ended in the lanes that have more legs after it.
    """
    start = start_progress(scene, surfaces, dt, active)

    def going(carry: tuple[Progress, Tree]) -> Array:
        return any_lane(_is_under_way(carry[0]))

    def advance(carry: tuple[Progress, Tree]) -> tuple[Progress, Tree]:
        before, logged = carry
        after, leg = _advance(motion, scene, surfaces, t, dt, before)
        return after, log(logged, before, after, leg)

    return bounded_while_loop(going, advance, (start, logged), most=MAX_TRIES * (MAX_IMPACTS + 1))


def _is_under_way(progress: Progress) -> Array:
    return ~progress.arrived & (progress.legs <= MAX_IMPACTS)


def _advance(
    motion: Motion, scene: Scene, surfaces: Surfaces, t: Time, dt: Array, now: Progress
) -> tuple[Progress, Leg]:
    """A turn of every lane that is under way: it moves once, for the duration that it proposes."""
    going, refining = _is_under_way(now), now.bracket.refining & _is_under_way(now)
    # lanes wait for those that refine, so that what only a new leg needs is computed once for all of them
    tries, leg_start = going & ~any_lane(refining), t + now.elapsed
    rest = jnp.maximum(dt - now.elapsed, shortest_duration(dt))
    start_time = to_float_time(leg_start)
    faces = surfaces.facing(start_time, now.state.position)
    mode, state = _begin_leg(scene, faces, now, tries, leg_start, rest)
    since = jnp.where(mode.pressed, now.since, jnp.inf)
    held = apply_contact_mode(scene.replace(state=state), faces, mode)
    shortest = shortest_duration(dt)
    duration = jnp.where(refining, jnp.maximum(now.bracket.next, shortest), rest)
    end = materialise_where(tries | refining, lambda: motion(held, leg_start, duration).state, now.state)
    begin = lambda: _begin_bracket(held, faces, mode, tries, end, start_time, rest, now.bracket)  # noqa: E731
    bracket = materialise_where(tries, begin, now.bracket)
    arrives = tries & ~bracket.refining
    at_end = now._replace(
        elapsed=jnp.where(arrives, dt, now.elapsed),
        state=choose_lanes(arrives, end, held.state),
        since=jnp.where(tries[None], since, now.since),
        mode=mode,
        bracket=bracket,
        legs=now.legs + arrives.astype(now.legs.dtype),
        arrived=now.arrived | arrives,
    )
    nothing = jnp.zeros(dt.shape, bool)
    quiet = at_end, Verdict(jnp.zeros_like(now.legs), nothing, nothing, nothing)

    def refine() -> tuple[Progress, Verdict]:
        return _refine(held, faces, refining, leg_start, duration, end, dt, at_end)

    after, verdict = lax.cond(any_lane(refining), refine, lambda: quiet)
    return after, Leg(duration, mode, verdict, arrives)


def _begin_leg(
    scene: Scene, faces: Surfaces, now: Progress, tries: Array, leg_start: Time, rest: Array
) -> tuple[ContactMode, Particles]:
    """The contact mode of every lane, and its state put onto what it presses on; a lane that refines keeps its own."""
    # a non-finite lane rests nowhere, or the others would take the other branch, with other rounding, because of it
    touches = tries & jnp.any(jnp.isfinite(now.since), axis=0) & scene.finite(now.state)

    def decide() -> tuple[ContactMode, Particles]:
        here, touch = scene.replace(state=now.state), faces.measure(to_float_time(leg_start), now.state)
        mode = decide_contact_mode(here, faces, touch, now.since, leg_start, rest)
        return mode, put_on_surfaces(faces, touch, mode, now.state)

    mode, put = materialise_where(touches, decide, (make_free_mode(scene, faces), now.state))
    return choose_mode(tries, mode, now.mode), choose_lanes(tries, put, now.state)


def _begin_bracket(
    held: Scene,
    faces: Surfaces,
    mode: ContactMode,
    tries: Array,
    end: Particles,
    t: ArrayLike,
    rest: Array,
    bracket: Bracket,
) -> Bracket:
    """The brackets of the lanes that tried the rest of their step and have an event on the way."""
    start = held.state
    event = find_next_event(faces, get_reaction(held), mode.pressed, start, end, t, rest)
    hit = tries & event.hit
    if held.held is not None:
        hit = hit & ~held.held
    eps, fall = float(jnp.finfo(start.dtype).eps), event.above - event.below
    sized = norm(start.position) if event.watched.shape[0] == len(faces) else _measure_guard_size(event, faces, start)
    low, high, guess = (share * rest for share in (event.first, jnp.minimum(event.last, 1.0), event.guess))
    begun = Bracket(
        hit,
        low,
        high,
        jnp.clip(guess, low, high),
        jnp.full_like(low, jnp.nan),
        event.above,
        event.slope / rest,
        TIME_ROUNDING * eps * fall + GUARD_ROUNDING * eps * sized,
        REACHED_ROUNDING * eps * sized + eps**0.5 * fall,
        event.watched,
    )
    return _choose_bracket(tries, begun, bracket)


def _measure_guard_size(event: Event, faces: Surfaces, start: Particles) -> Array:
    """What the rounding of a guard is relative to: the place of a lane for a distance, its speed for a slide."""
    distances = jnp.any(event.watched[: len(faces)], axis=0)
    return jnp.where(distances, norm(start.position), norm(start.velocity))


def _refine(
    held: Scene,
    faces: Surfaces,
    refining: Array,
    leg_start: Time,
    duration: Array,
    end: Particles,
    dt: Array,
    now: Progress,
) -> tuple[Progress, Verdict]:
    """The lanes that seek the moment of an event, with a closer bracket, or after the event if they have found it."""
    bracket, impact_time = now.bracket, leg_start + duration
    guards = measure_guards(faces, get_reaction(held), to_float_time(impact_time), end)
    watched = jnp.where(bracket.watched, guards, jnp.inf)
    value, guard = jnp.min(watched, axis=0), jnp.argmin(watched, axis=0).astype(jnp.int32)
    closer = _close_bracket(bracket, value)
    width = closer.high - closer.low
    # a NaN is nowhere near zero: what is not finite goes on as it is
    found = (jnp.abs(value) <= bracket.exact) | (width <= 2 * TIME_ROUNDING * float(jnp.finfo(dt.dtype).eps) * dt)
    found = refining & (found | ~jnp.isfinite(value))
    # a path that just misses a surface, though its cubic did not, goes on as it was
    reached = found & (value <= bracket.reach)

    def resolve() -> tuple[Particles, Array, Verdict]:
        meeting = meet_surface(faces, get_reaction(held), guards, guard, to_float_time(impact_time), end)
        load = held.acceleration(impact_time, end)
        verdict = judge_event(meeting, guard, reached, load, held.state, end, dt)
        state = respond_to_event(meeting, verdict, end)
        rest_time = to_float_time(impact_time) + measure_last_flights(meeting, verdict.rests, load)
        load_speed = norm(load) * dt
        since = update_contact_starts(now.since, meeting, verdict, rest_time, state, load_speed)
        return choose_lanes(found, state, now.state), jnp.where(found[None], since, now.since), verdict

    nothing = jnp.zeros(found.shape, bool)
    quiet = now.state, now.since, Verdict(guard, nothing, nothing, nothing)
    state, since, verdict = materialise_where(found, resolve, quiet)
    after = now._replace(
        elapsed=jnp.where(found, now.elapsed + duration, now.elapsed),
        state=state,
        since=since,
        bracket=_choose_bracket(refining, closer._replace(refining=closer.refining & ~found), bracket),
        legs=now.legs + found.astype(now.legs.dtype),
    )
    return after, verdict


def _close_bracket(bracket: Bracket, value: Array) -> Bracket:
    """The bracket closed by the value at its `next` duration, with what to try after that.

    A secant step where it stays inside and the last one has at least halved the value, else the middle.
    """
    tried, falls = bracket.next, value > 0
    low, high = jnp.where(falls, tried, bracket.low), jnp.where(falls, bracket.high, tried)
    step = tried - bracket.tried
    # nothing was tried before the first: the slope of the cubic is closer than a secant over the whole bracket
    secant = (value - bracket.value) / jnp.where(step == 0, jnp.nan, step)
    slope = jnp.where(secant < 0, secant, bracket.slope)
    target = tried - value / jnp.where(slope < 0, slope, -jnp.inf)
    safe = (target > low) & (target < high) & (jnp.abs(value) <= 0.5 * jnp.abs(bracket.value))
    return bracket._replace(
        low=low,
        high=high,
        next=jnp.where(safe, target, 0.5 * (low + high)),
        tried=tried,
        value=value,
        slope=slope,
    )


def choose_mode(flag: Array, a: ContactMode, b: ContactMode) -> ContactMode:
    """Lane by lane the mode a where flagged, else b."""
    slip = None if a.slip is None or b.slip is None else jnp.where(flag[None, ..., None], a.slip, b.slip)
    return ContactMode(jnp.where(flag[None], a.pressed, b.pressed), jnp.where(flag, a.still, b.still), slip)


def _choose_bracket(flag: Array, a: Bracket, b: Bracket) -> Bracket:
    """Lane by lane the bracket a where flagged, else b."""
    numbers = Bracket(
        *(jnp.where(flag, x, y) for x, y in zip(a._replace(watched=flag), b._replace(watched=flag), strict=True))
    )
    return numbers._replace(watched=jnp.where(flag[None], a.watched, b.watched))
