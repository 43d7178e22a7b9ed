"""Time of impact: each touch is found inside the step, answered there, and the rest of the step goes on from it.

What a touch is, and what follows, is decided lane by lane; only the lanes that touch something are computed again. The
moment is a root of the signed distance along the method's own path, so a method keeps its order through a bounce; it
moves with every parameter, so that derivatives through a bounce are right, forward and reverse.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool

from physjax.backend import any_lane, compact_and_apply, materialise_where
from physjax.loops import Time, to_float_time
from physjax.particles import Particles
from physjax.physics.contacts.events import Event, collect_faces, evaluate_guards, find_next_event
from physjax.physics.contacts.resting import ContactMode, apply_contact_mode, decide_contact_mode, make_free_mode
from physjax.physics.contacts.restitution import apply_restitution
from physjax.roots import find_first_root
from physjax.scene import Scene, trace_once
from physjax.vectors import dot

MAX_IMPACTS = 8
"""Touches that one lane may have within one step; after so many it stays where it is, with its velocity, until the next."""
SHORTEST_FLIGHT_SHARE = 0.25
"""A bounce whose flight would be shorter than this share of the step is the last: what would follow is summed."""


@trace_once
def impact(motion: Callable, scene: Scene, t: Time, dt: ArrayLike) -> Scene:
    """The response that finds when each lane touches within the step, bounces it there, and goes on from there.

    For independent lanes. At most 8 touches a lane and step: a lane that would touch yet more often waits where it is,
    energy and all, for the next step, so nothing ever passes; where a moving surface comes over it as it waits, it
    becomes NaN, which its status tells. When a flight to the next bounce would be shorter than a
    quarter of a step, the lane comes to rest: the bounces that remain take 2v/(g(1 - K_r)) more, which
    `touching_since` records. From then on it is held by the surface, lies still or slides, until a force lifts it off.

    Example:
        >>> floor = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.5, response=contacts.impact)
        >>> falling = Scene(Particles(jnp.array([0.0, 1.0]), jnp.array([0.0, -2.0])), contacts=(floor,))
        >>> end = falling.step(methods.euler, 0.0, 1.0).state
        >>> print(end.position, end.velocity)
        [0.  0.5] [0. 1.]
    """
    walls = _collect_walls(scene)
    since = tuple(wall.touching_since for wall in walls)
    # a lane that is lost rests nowhere: the others must not take another path, in other roundings, because of it
    any_contact = any_lane(jnp.any(jnp.isfinite(jnp.stack(since)), axis=0) & scene.finite(scene.state))
    # a branch also keeps the step apart from what reads it: XLA would compute it again in every reader
    end, since = lax.cond(
        any_contact,
        lambda: _step_in_contact(motion, scene, since, any_contact, t, dt),
        lambda: (motion(scene, t, dt).state, since),
    )
    meets = _may_meet(scene, since, end, to_float_time(t), dt)
    if scene.held is not None:
        meets = meets & ~scene.held
    others = (meets, scene, t, dt)
    cut, masks = scene.may_be_cut(), scene.build_lane_mask(others)
    end, since = compact_and_apply(
        partial(_step_through_contacts, motion), meets, (end, since), *others, masks=masks, cut=cut
    )
    return scene.replace(state=end, contacts=_store_contact_starts(scene.contacts, list(since)))


def _step_in_contact(
    motion: Callable, scene: Scene, since: tuple, any_contact: Array, t: Time, dt: ArrayLike
) -> tuple[Particles, tuple]:
    """A step in which surfaces hold some lanes."""
    walls = _collect_walls(scene)
    start = materialise_where(
        any_contact, lambda: decide_contact_mode(scene, walls, since, t, dt), make_free_mode(scene, walls, since)
    )
    return motion(apply_contact_mode(scene, walls, start), t, dt).state, start.since


def _may_meet(scene: Scene, since: tuple, end: Particles, t: ArrayLike, dt: ArrayLike) -> Array:
    """Lanes that may meet something within the step: cheap, and never wrong about one that does not."""
    scene, since, end = lax.stop_gradient((scene, since, end))
    flags, since = [], list(since)
    for contact in scene.contacts:
        if contact.response is impact:
            touching = [jnp.isfinite(since.pop(0)) for _ in contact.walls()]
            flags.append(contact.may_meet(touching, t, dt, scene.state, end))
    return jnp.any(jnp.stack(flags), axis=0)


class _StepProgress(NamedTuple):
    """How far each lane has come in a step: the time so far, its state, since when it touches what, whether it is through."""

    elapsed: Array
    state: Particles
    since: tuple[Array, ...]
    arrived: Array


def _step_through_contacts(
    motion: Callable, changing: tuple[Particles, tuple], meets: Array, scene: Scene, t: Time, dt: ArrayLike
) -> tuple[Particles, tuple]:
    """The step again, leg by leg from touch to touch, of lanes that may meet something; the others are where they arrived."""
    leg, dt = _start_progress(scene, dt)
    state, since = choose_lanes(meets, (leg.state, leg.since), changing)
    leg = leg._replace(state=state, since=since, arrived=~meets)

    def go_on(leg, _):
        more = any_lane(~leg.arrived)
        return lax.cond(
            more, lambda: choose_lanes(leg.arrived, leg, _advance_leg(motion, scene, leg, t, dt)), lambda: leg
        ), None

    leg, _ = lax.scan(go_on, leg, length=MAX_IMPACTS + 1)
    return _invalidate_overrun_lanes(scene, leg, t, dt), leg.since


def _invalidate_overrun_lanes(scene: Scene, leg: _StepProgress, t: Time, dt: Array) -> Particles:
    """The lanes after a step; those that waited in it where a surface has moved over them are not finite any more."""

    def overrun():
        leg_start = t + leg.elapsed
        return ~leg.arrived & is_overrun(
            collect_faces(_collect_walls(scene), to_float_time(leg_start), leg.state),
            to_float_time(leg_start),
            to_float_time(t + dt),
            leg.state,
        )

    return invalidate_lanes(materialise_where(~leg.arrived, overrun), leg.state)


def is_overrun(surfaces: list, leg_start: Array, ended: Array, state: Any) -> Bool[Array, "*lanes"]:
    """Whether a surface moves over a lane that stays where it is from one moment [s] to another."""
    x = lax.stop_gradient(state.position)
    rounding = 64 * float(jnp.finfo(x.dtype).eps) * jnp.sqrt(dot(x, x))
    over = jnp.zeros(rounding.shape, bool)
    for surface in surfaces:
        before, after = (lax.stop_gradient(surface.clearance(t, state)) for t in (leg_start, ended))
        over = over | ((after < -rounding) & (after < before - rounding))
    return over


def invalidate_lanes(overrun: Bool[Array, "*lanes"], state: Any) -> Any:
    """The state with NaN in the lanes that are lost: their status tells, and they harm no other."""
    return jax.tree.map(lambda leaf: jnp.where(overrun[..., None], jnp.nan, leaf), state)


def _start_progress(scene: Scene, dt: ArrayLike) -> tuple[_StepProgress, Array]:
    """Where the first leg of a step begins, and the step of each lane."""
    dt = jnp.broadcast_to(dt, scene.state.lanes)
    since = tuple(wall.touching_since for wall in _collect_walls(scene))
    return _StepProgress(jnp.zeros_like(dt), scene.state, since, jnp.zeros(dt.shape, bool)), dt


def _begin_leg(scene: Scene, leg: _StepProgress, t: Time, dt: Array) -> tuple[Time, Array, ContactMode]:
    """When a leg begins, how much of the step is left, and what carries each lane through it."""
    walls, leg_start, rest = (
        _collect_walls(scene),
        t + leg.elapsed,
        jnp.maximum(dt - leg.elapsed, shortest_duration(dt)),
    )
    here = scene.replace(state=leg.state)
    start = materialise_where(
        ~leg.arrived,
        lambda: decide_contact_mode(here, walls, leg.since, leg_start, rest),
        make_free_mode(here, walls, leg.since),
    )
    return leg_start, rest, start


def _advance_leg(motion: Callable, scene: Scene, leg: _StepProgress, t: Time, dt: Array) -> _StepProgress:
    """From where the lanes are to the first touch of each, or to the end of the step."""
    walls, going = _collect_walls(scene), ~leg.arrived
    leg_start, rest, start = _begin_leg(scene, leg, t, dt)
    held = apply_contact_mode(scene, walls, start)
    end = materialise_where(going, lambda: motion(held, leg_start, rest).state, leg.state)
    event = materialise_where(going, lambda: find_next_event(walls, start, end, to_float_time(leg_start), rest))
    through = _StepProgress(leg.elapsed + rest, end, start.since, jnp.ones_like(leg.arrived))

    def touch():
        duration = jnp.maximum(_find_event_time(motion, held, start, event, leg_start, rest), shortest_duration(dt))
        touched = leg_start + duration
        at = materialise_where(event.hit, lambda: motion(held, leg_start, duration).state, leg.state)
        state, since = materialise_where(
            event.hit, lambda: _resolve_contact(held, start, event, leg_start, touched, at, dt), (leg.state, leg.since)
        )
        return choose_lanes(event.hit, _StepProgress(leg.elapsed + duration, state, since, leg.arrived), through)

    return lax.cond(any_lane(event.hit), touch, lambda: through)


class Flight(NamedTuple):
    """A leg of a step, from one touch to the next, as it was flown.

    `before` is the state that the touch before it left, `scene` begins with what the surfaces made of that and carries
    their reactions; `leg_start` [s] and `duration` [s] are of each lane; `end` is where the method came, `after` what the
    touch there made of it. Lanes that are not `active` had arrived before.
    """

    before: Particles
    scene: Scene
    leg_start: Time
    duration: Array
    end: Particles
    after: Particles
    active: Bool[Array, "*lanes"]


def fold_flights(motion: Callable, scene: Scene, t: Time, dt: ArrayLike, add: Callable, total: Any) -> Any:
    """The legs of the step that `impact` takes, told one by one: `total = add(total, flight)`, folded over them.

    Returns the total and the state after the step.
    """
    leg, dt = _start_progress(scene, dt)

    def fly(leg, total):
        leg_start, _, start = _begin_leg(scene, leg, t, dt)
        held = apply_contact_mode(scene, _collect_walls(scene), start)
        after = choose_lanes(leg.arrived, leg, _advance_leg(motion, scene, leg, t, dt))
        duration = jnp.maximum(after.elapsed - leg.elapsed, shortest_duration(dt))
        end = motion(held, leg_start, duration).state
        return after, add(total, Flight(leg.state, held, leg_start, duration, end, after.state, ~leg.arrived))

    def go_on(carry, _):
        return lax.cond(any_lane(~carry[0].arrived), fly, lambda *carry: carry, *carry), None

    (leg, total), _ = lax.scan(go_on, (leg, total), length=MAX_IMPACTS + 1)
    return total, _invalidate_overrun_lanes(scene, leg, t, dt)


def shortest_duration(dt: Array) -> Array:
    """The shortest stretch of time: none is quite zero, so that a mean over it is still a mean."""
    return float(jnp.finfo(dt.dtype).eps) * dt


def _resolve_contact(
    scene: Scene, start: ContactMode, event: "Event", leg_start: Time, t: Time, at: Particles, dt: Array
) -> tuple[Particles, tuple]:
    """State and memory after the touches: a bounce, coming to rest, or the end of a slide."""
    walls, acceleration, t = _collect_walls(scene), scene.acceleration(t, at), to_float_time(t)
    faces = collect_faces(walls, to_float_time(leg_start), start.state)
    guards = jnp.stack(evaluate_guards(faces, walls, start, event, t, at))
    which = jnp.argmin(guards, axis=0)
    # a path that only just misses, though the cubic touched, goes on as it was
    eps = float(jnp.finfo(at.dtype).eps)
    reached = 64 * eps * jnp.sqrt(dot(at.position, at.position)) + eps**0.5 * (event.above - event.below)
    touches = event.hit & (jnp.min(guards, axis=0) <= lax.stop_gradient(reached))
    state, since = at, list(start.since)
    # one guard a lane: each answer starts from the same state, and is taken where it applies
    for i, wall in enumerate(faces):
        here = touches & (which == i)
        normal, relative = wall.normal_at(t, at.position), wall.relative(at.velocity)
        inward = jnp.where(here, jnp.minimum(dot(relative, normal), 0.0), 0.0)
        lift = wall.restitution * -inward
        weight = -(dot(acceleration, normal) + wall.curvature_acceleration(t, at.position, relative))
        rests = here & (2 * lift <= SHORTEST_FLIGHT_SHARE * dt * weight) & ((wall.restitution < 1) | (lift == 0))
        touch = (wall.signed_distance(t, at.position), normal, relative)
        state = choose_lanes(here, apply_restitution(wall, at, touch, inward, rests), state)
        flights = 2 * lift / jnp.where(rests & (lift > 0), weight * (1 - wall.restitution), 1.0)
        since[i] = jnp.where(rests, t + flights, since[i])
    slides = [i for i, slip in enumerate(start.slip) if slip is not None]
    for guard, i in enumerate(slides, start=len(walls)):
        relative, before = walls[i].relative(at.velocity), walls[i].relative(start.state.velocity)
        slowed = dot(relative, relative) < 0.25 * dot(before, before)  # else it only turned
        stopped = Particles(at.position, at.velocity - relative)
        state = choose_lanes(touches & (which == guard) & slowed, stopped, state)
    bounced, load_speed_squared = touches & (which < len(walls)), dot(acceleration, acceleration) * (dt * dt)
    for i, wall in enumerate(walls):
        # a bounce elsewhere throws a lane off what it touched, or into it: then that is a new touch
        since[i] = jnp.where(
            bounced & (which != i) & _is_leaving(wall, t, state, load_speed_squared), jnp.inf, since[i]
        )
    return state, tuple(since)


def _find_event_time(
    motion: Callable, scene: Scene, start: ContactMode, event: Event, leg_start: Time, rest: Array
) -> Array:
    """When the first guard reaches zero on the method's own path [s after `leg_start`]; differentiable."""
    event, rest = lax.stop_gradient((event, rest))

    def nearest(duration, scene, start, event, leg_start):
        state, walls = motion(scene, leg_start, duration).state, _collect_walls(scene)
        faces = collect_faces(walls, to_float_time(leg_start), start.state)
        return jnp.min(
            jnp.stack(evaluate_guards(faces, walls, start, event, to_float_time(leg_start + duration), state)), axis=0
        )

    bracket = (event.first * rest, jnp.minimum(event.last, 1.0) * rest)
    tolerance = 4 * float(jnp.finfo(rest.dtype).eps) * rest
    search = (bracket, (event.above, event.below), event.hit, tolerance)
    return find_first_root(nearest, (scene, start, event, leg_start), search)


def _collect_walls(scene: Scene) -> tuple:
    """The surfaces that answer at the moment of impact, rooms taken apart."""
    return tuple(wall for contact in scene.contacts if contact.response is impact for wall in contact.walls())


def _is_leaving(wall: eqx.Module, t: ArrayLike, state: Particles, load_speed_squared: Array) -> Array:
    """Whether a lane is moving off a surface, or into it, by more than rounding of its speed and of a step's `load_speed_squared`²."""
    relative, eps = wall.relative(state.velocity), float(jnp.finfo(state.dtype).eps)
    normal_speed = dot(relative, wall.normal_at(t, state.position))
    return normal_speed * normal_speed > eps * dot(relative, relative) + (16 * eps) ** 2 * load_speed_squared


def _store_contact_starts(contacts: tuple, since: list) -> tuple:
    """The contacts with their memory of who touches them."""
    return tuple(
        contact.remember_since([since.pop(0) for _ in contact.walls()]) if contact.response is impact else contact
        for contact in contacts
    )


def choose_lanes(flag: Array, a: Any, b: Any) -> Any:
    """Lane by lane a where flagged, else b, for trees of numbers and vectors."""
    pick = lambda x, y: jnp.where(flag if x.ndim == flag.ndim else flag[..., None], x, y)  # noqa: E731
    return jax.tree.map(pick, a, b)
