"""What an impact makes of a lane and of its contacts: a bounce, coming to rest, or the end of a slide.

What happens is decided once, without derivatives (`judge_event`); what follows from it is a smooth function of
everything (`respond_to_event`), so that a replay with the same decisions can be differentiated.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Int

from physjax.particles import Particles
from physjax.physics.contacts.legs import SHORTEST_FLIGHT_SHARE, choose_lanes
from physjax.physics.contacts.resting import Reaction
from physjax.physics.contacts.restitution import apply_restitution
from physjax.physics.contacts.surfaces import Surfaces, Touch, relative_to, select_surface
from physjax.vectors import dot

STOPPED_SPEED_SQUARED_SHARE = 0.25
"""Share of its speed² at the start of the leg below which a slide has stopped; above, it only turned."""
LEAVING_ROUNDING = 16
"""Units of rounding of the speed that a step's load gives below which a lane does not leave a surface."""


class Verdict(NamedTuple):
    """What ends a leg: which guard, whether its lane bounces there, comes to rest by that bounce, or stops sliding."""

    guard: Int[Array, "*lanes"]
    bounces: Bool[Array, "*lanes"]
    rests: Bool[Array, "*lanes"]
    stops: Bool[Array, "*lanes"]


class _Dry(NamedTuple):
    """Coulomb's friction of the surface that each lane meets."""

    static: Array
    kinetic: Array


class Meeting(NamedTuple):
    """Where lanes are at the end of a leg: relative to every surface, and to the one that each meets.

    `chosen` says which that is; `distance` [m], `normal`, `relative` velocity [m/s] and material are of that one, and
    `turn` [m/s²] is what its curvature adds to the second derivative of the distance. `slip` is the velocity relative to
    the surface on which a slide ends [m/s]; None where nothing slides.
    """

    touch: Touch
    chosen: Bool[Array, "surfaces *lanes"]
    distance: Array
    normal: Array
    relative: Array
    turn: Array | None
    restitution: Array
    friction: Array | None
    coulomb: _Dry | None
    slip: Array | None


def measure_guards(faces: Surfaces, reaction: Reaction, t: ArrayLike, state: Particles) -> Array:
    """The guards of a leg at a time t [s]: the signed distances to the faces, then the speeds of the slides.

    The faces are those of the beginning of the leg: a moving slab may since have passed the place where a lane was, and
    would then show it the other face.
    """
    distance, slide = faces.signed_distance(t, state.position), reaction.measure_slides(t, state)
    return distance if slide is None else jnp.concatenate([distance, slide])


def select_guard(guards: Array, guard: Array) -> Array:
    """The value of the guard with this number, lane by lane."""
    own = guard[None] == jnp.arange(len(guards), dtype=guard.dtype).reshape(-1, *(1,) * guard.ndim)
    return jnp.sum(jnp.where(own, guards, 0.0), axis=0)


def meet_surface(
    faces: Surfaces, reaction: Reaction, guards: Array, guard: Array, t: ArrayLike, at: Particles
) -> Meeting:
    """Where lanes are at a time t [s] when this guard of theirs is zero, given the values of all guards."""
    count, lanes = len(faces), at.lanes
    numbers = jnp.arange(len(guards), dtype=guard.dtype).reshape(-1, *(1,) * guard.ndim)
    chosen = guard[None] == numbers[:count]
    pick = lambda values: None if values is None else select_surface(chosen, values)  # noqa: E731
    touch = Touch(guards[:count], faces.normal_at(t, at.position), faces.velocity_at(t, at.position))
    carried, static, kinetic = map(pick, (touch.carried, faces.static_friction(lanes), faces.kinetic_friction(lanes)))
    slip = None
    if reaction.slip is not None:
        belt = reaction.carry(t, at)
        slip = at.velocity if belt is None else at.velocity - select_surface(guard[None] == numbers[count:], belt)
    return Meeting(
        touch,
        chosen,
        select_surface(chosen, touch.distance),
        select_surface(chosen, touch.normal),
        at.velocity if carried is None else at.velocity - carried,
        pick(faces.distance_acceleration(t, at)),
        select_surface(chosen, faces.restitution(lanes)),
        pick(faces.friction(lanes)),
        None if static is None or kinetic is None else _Dry(static, kinetic),
        slip,
    )


def judge_event(
    meeting: Meeting,
    guard: Array,
    reached: Array,
    load: Array,
    before: Particles,
    at: Particles,
    dt: Array,
) -> Verdict:
    """What happens to lanes that have `reached` the zero of a guard.

    `load` is the acceleration there, `before` and `at` are the states at both ends of the leg. A lane comes to rest where
    the flight to the next bounce would be shorter than a share of the step dt.
    """
    on_surface = jnp.any(meeting.chosen, axis=0)
    bounces = reached & on_surface
    lift, weight = _measure_flight(meeting, bounces, load)
    # K_r = 1 never rests, unless it came with no normal velocity at all
    rests = bounces & (2 * lift <= SHORTEST_FLIGHT_SHARE * dt * weight) & ((meeting.restitution < 1) | (lift == 0))
    stops = jnp.zeros_like(reached)
    if meeting.slip is not None:
        # one that only turned, on a curved surface, also crosses zero along its first direction
        then = meeting.slip + (before.velocity - at.velocity)
        slip_squared, eps = dot(meeting.slip, meeting.slip), float(jnp.finfo(at.dtype).eps)
        slowed = slip_squared < STOPPED_SPEED_SQUARED_SHARE * dot(then, then)
        # on a surface that moves, what is left of a slide may be the rounding of both velocities
        rounding = slip_squared <= (LEAVING_ROUNDING * eps) ** 2 * dot(at.velocity, at.velocity)
        stops = reached & ~on_surface & (slowed | rounding)
    return Verdict(guard, bounces, rests, stops)


def measure_last_flights(meeting: Meeting, rests: Array, load: Array) -> Array:
    """How long all flights take that would follow the last bounce of lanes that come to rest [s].

    They take 2v/(g(1 - K_r)) together, with v the speed of the last bounce: a geometric series.
    """
    lift, weight = _measure_flight(meeting, rests, load)
    return 2 * lift / jnp.where(lift > 0, weight * (1 - meeting.restitution), 1.0)


def _measure_flight(meeting: Meeting, bounces: Array, load: Array) -> tuple[Array, Array]:
    """The speed with which lanes leave the surface [m/s], and how strongly they are pulled back [m/s²]."""
    weight = -dot(load, meeting.normal)
    lift = meeting.restitution * -_find_inward_speed(meeting, bounces)
    return lift, weight if meeting.turn is None else weight - meeting.turn


def respond_to_event(meeting: Meeting, verdict: Verdict, at: Particles) -> Particles:
    """The state after the event that ends a leg; a slide that stops is not pushed back by friction."""
    contact = (meeting.distance, meeting.normal, meeting.relative)
    bounced = apply_restitution(meeting, at, contact, _find_inward_speed(meeting, verdict.bounces), verdict.rests)
    state = choose_lanes(verdict.bounces, bounced, at)
    if meeting.slip is None:
        return state
    return choose_lanes(verdict.stops, Particles(at.position, at.velocity - meeting.slip), state)


def update_contact_starts(
    since: Array, meeting: Meeting, verdict: Verdict, rest_time: Array, state: Particles, load_speed: Array
) -> Array:
    """Since when [s] each lane is in contact with each surface, after the event that ends a leg."""
    here, touch = meeting.chosen & verdict.bounces[None], meeting.touch
    since = jnp.where(here & verdict.rests[None], rest_time[None], since)
    # a bounce off one surface throws a lane off another, or into it, which then is a new contact
    relative, eps = relative_to(touch.carried, state.velocity, len(since)), float(jnp.finfo(state.dtype).eps)
    speed = dot(relative, touch.normal)
    leaves = speed * speed > eps * dot(relative, relative) + ((LEAVING_ROUNDING * eps * load_speed) ** 2)[None]
    return jnp.where(verdict.bounces[None] & ~here & leaves, jnp.inf, since)


def _find_inward_speed(meeting: Meeting, bounces: Array) -> Array:
    """The normal velocity <= 0 with which lanes go into what they bounce off [m/s], zero for all others."""
    return jnp.where(bounces, jnp.minimum(dot(meeting.relative, meeting.normal), 0.0), 0.0)
