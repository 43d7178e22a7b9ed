"""What an impact makes of a lane and of its contacts: a bounce, coming to rest, or the end of a slide."""

import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.loops import Time, to_float_time
from physjax.particles import Particles
from physjax.physics.contacts.contact_mode import ContactMode
from physjax.physics.contacts.events import Event, collect_faces, evaluate_guards
from physjax.physics.contacts.face import ContactFace
from physjax.physics.contacts.legs import SHORTEST_FLIGHT_SHARE, choose_lanes
from physjax.physics.contacts.restitution import apply_restitution
from physjax.scene import Scene
from physjax.vectors import dot

REACHED_ROUNDING = 64
"""Units of rounding of its place within which a lane has reached a surface."""
STOPPED_SPEED_SQUARED_SHARE = 0.25
"""Share of its speed² at the start of the leg below which a slide has stopped; above, it only turned."""
LEAVING_ROUNDING = 16
"""Units of rounding of the speed that a step's load gives below which a lane does not leave a surface."""


def resolve_contact(
    scene: Scene,
    walls: tuple[ContactFace, ...],
    start: ContactMode,
    event: Event,
    leg_start: Time,
    impact_time: Time,
    at: Particles,
    dt: Array,
) -> tuple[Particles, tuple[Array, ...]]:
    """State after the events that end a leg, and since when [s] each lane is in contact with each wall."""
    acceleration, t = scene.acceleration(impact_time, at), to_float_time(impact_time)
    faces = collect_faces(walls, to_float_time(leg_start), start.state)
    guards = jnp.stack(evaluate_guards(faces, walls, start, event, t, at))
    # the root search ended at one guard's zero: that is the smallest
    which = jnp.argmin(guards, axis=0)
    # a path that just misses a surface, though its cubic did not, goes on as it was
    eps = float(jnp.finfo(at.dtype).eps)
    reached = REACHED_ROUNDING * eps * jnp.sqrt(dot(at.position, at.position)) + eps**0.5 * (event.above - event.below)
    touches = event.hit & (jnp.min(guards, axis=0) <= lax.stop_gradient(reached))
    state, since = at, list(start.since)
    # one guard ends the leg of a lane: each response starts from the same state, and is taken where it applies
    for i, face in enumerate(faces):
        state, since[i] = _bounce(face, touches & (which == i), acceleration, t, (at, state), since[i], dt)
    state = _stop_slides(walls, touches, which, start, at, state)
    bounced, load_speed_squared = touches & (which < len(walls)), dot(acceleration, acceleration) * (dt * dt)
    for i, wall in enumerate(walls):
        # a bounce off one surface throws a lane off another, or into it, which then is a new contact
        since[i] = jnp.where(
            bounced & (which != i) & _is_leaving(wall, t, state, load_speed_squared), jnp.inf, since[i]
        )
    return state, tuple(since)


def _bounce(
    face: ContactFace,
    here: Array,
    acceleration: Array,
    t: ArrayLike,
    states: tuple[Particles, Particles],
    since: Array,
    dt: Array,
) -> tuple[Particles, Array]:
    """The lanes that are `here` after a bounce, and their begin of contact [s], if it was the last bounce.

    `states` are that at the impact, and what other surfaces have made of it in other lanes. The flights that would follow
    a last bounce with the speed v take 2v/(g(1 - K_r)) together, a geometric series: the lane is at rest after that.
    """
    at, state = states
    normal, relative = face.normal_at(t, at.position), face.relative(at.velocity)
    inward = jnp.where(here, jnp.minimum(dot(relative, normal), 0.0), 0.0)
    lift = face.restitution * -inward
    weight = -(dot(acceleration, normal) + face.curvature_acceleration(t, at.position, relative))
    # K_r = 1 never rests, unless it came with no normal velocity at all
    rests = here & (2 * lift <= SHORTEST_FLIGHT_SHARE * dt * weight) & ((face.restitution < 1) | (lift == 0))
    contact = (face.signed_distance(t, at.position), normal, relative)
    state = choose_lanes(here, apply_restitution(face, at, contact, inward, rests), state)
    flights = 2 * lift / jnp.where(rests & (lift > 0), weight * (1 - face.restitution), 1.0)
    return state, jnp.where(rests, t + flights, since)


def _stop_slides(
    walls: tuple[ContactFace, ...], touches: Array, which: Array, start: ContactMode, at: Particles, state: Particles
) -> Particles:
    """The lanes whose slide ends the leg brought to rest on their surface: friction does not push them back."""
    slides = [i for i, slip in enumerate(start.slip) if slip is not None]
    for guard, i in enumerate(slides, start=len(walls)):
        relative, before = walls[i].relative(at.velocity), walls[i].relative(start.state.velocity)
        # a slide that only turned, on a curved surface, also crosses zero along its first direction
        slowed = dot(relative, relative) < STOPPED_SPEED_SQUARED_SHARE * dot(before, before)
        stopped = Particles(at.position, at.velocity - relative)
        state = choose_lanes(touches & (which == guard) & slowed, stopped, state)
    return state


def _is_leaving(wall: ContactFace, t: ArrayLike, state: Particles, load_speed_squared: Array) -> Array:
    """Whether a lane moves off a surface, or into it, faster than rounding of its speed and of a step's load."""
    relative, eps = wall.relative(state.velocity), float(jnp.finfo(state.dtype).eps)
    normal_speed = dot(relative, wall.normal_at(t, state.position))
    return (
        normal_speed * normal_speed > eps * dot(relative, relative) + (LEAVING_ROUNDING * eps) ** 2 * load_speed_squared
    )
