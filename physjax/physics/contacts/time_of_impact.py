"""Time of impact: each contact is found within the step and resolved there, and the rest of the step goes on from it.

The time is a root of the signed distance along the method's own path, so that a method keeps its order through a bounce.
It moves with every parameter, so that derivatives through a bounce are right, forward and reverse. All is decided lane
by lane, and only the lanes that meet something are computed again.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeVar

import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.backend import any_lane, compact_and_apply, materialise_where
from physjax.loops import Time, to_float_time
from physjax.particles import Particles
from physjax.physics.contacts.contact_mode import (
    ContactMode,
    apply_contact_mode,
    decide_contact_mode,
    make_free_mode,
)
from physjax.physics.contacts.events import Event, collect_faces, evaluate_guards, find_next_event
from physjax.physics.contacts.face import ContactFace
from physjax.physics.contacts.impact_response import resolve_contact
from physjax.physics.contacts.legs import (
    MAX_IMPACTS,
    Flight,
    Motion,
    choose_lanes,
    invalidate_lanes,
    is_overrun,
    shortest_duration,
)
from physjax.roots import find_first_root
from physjax.scene import Scene, trace_once

Total = TypeVar("Total")
Walls = tuple[ContactFace, ...]
"""The surfaces of a scene that are resolved at the time of impact."""


@trace_once
def impact(motion: Motion, scene: Scene, t: Time, dt: ArrayLike) -> Scene:
    """The response that finds the time of each impact within the step, bounces the lane there, and goes on from there.

    For independent lanes, at most 8 impacts per lane and step. A lane that would have more waits where it is, with its
    velocity, for the next step, so that nothing ever passes; where a moving surface overruns it as it waits, it becomes
    NaN, which its status reports. Where the flight to the next bounce would be shorter than a quarter of a step, the
    lane comes to rest: the bounces that remain take 2v/(g(1 - K_r)) more, which `touching_since` [s] records. From then
    on the surface carries it, at rest or sliding, until a force lifts it off.

    Example:
        >>> floor = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.5, response=contacts.impact)
        >>> falling = Scene(Particles(jnp.array([0.0, 1.0]), jnp.array([0.0, -2.0])), contacts=(floor,))
        >>> end = falling.step(methods.euler, 0.0, 1.0).state
        >>> print(end.position, end.velocity)
        [0.  0.5] [0. 1.]
    """
    walls = _collect_walls(scene)
    since = _list_contact_starts(walls)
    # a non-finite lane rests nowhere, or the others would take the other branch, with other rounding, because of it
    any_contact = any_lane(jnp.any(jnp.isfinite(jnp.stack(since)), axis=0) & scene.finite(scene.state))
    # the branch also keeps XLA from computing the step again in everything that reads its result
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
    motion: Motion, scene: Scene, since: tuple[Array, ...], any_contact: Array, t: Time, dt: ArrayLike
) -> tuple[Particles, tuple[Array, ...]]:
    """A step in which surfaces carry some lanes."""
    walls = _collect_walls(scene)
    start = materialise_where(
        any_contact, lambda: decide_contact_mode(scene, walls, since, t, dt), make_free_mode(scene, walls, since)
    )
    return motion(apply_contact_mode(scene, walls, start), t, dt).state, start.since


def _may_meet(scene: Scene, since: tuple[Array, ...], end: Particles, t: ArrayLike, dt: ArrayLike) -> Array:
    """Which lanes may meet something within the step: cheap, and true of every lane that does."""
    scene, since, end = lax.stop_gradient((scene, since, end))
    flags, remaining = [], list(since)
    for contact in scene.contacts:
        if contact.response is impact:
            touching = [jnp.isfinite(remaining.pop(0)) for _ in contact.walls()]
            flags.append(contact.may_meet(touching, t, dt, scene.state, end))
    return jnp.any(jnp.stack(flags), axis=0)


class _StepProgress(NamedTuple):
    """How far each lane is in a step: time so far [s], state, begin of contact with each wall [s], whether it arrived."""

    elapsed: Array
    state: Particles
    since: tuple[Array, ...]
    arrived: Array


def _step_through_contacts(
    motion: Motion,
    changing: tuple[Particles, tuple[Array, ...]],
    meets: Array,
    scene: Scene,
    t: Time,
    dt: ArrayLike,
) -> tuple[Particles, tuple[Array, ...]]:
    """The step again, leg by leg from impact to impact, of lanes that may meet something; the others have arrived."""
    leg, dt = _start_progress(scene, dt)
    state, since = choose_lanes(meets, (leg.state, leg.since), changing)
    leg = leg._replace(state=state, since=since, arrived=~meets)

    # a scan of fixed length and not a while loop, so that reverse mode goes through; a leg that no lane needs is a branch
    def go_on(leg: _StepProgress, _) -> tuple[_StepProgress, None]:
        more = any_lane(~leg.arrived)
        return lax.cond(
            more, lambda: choose_lanes(leg.arrived, leg, _advance_leg(motion, scene, leg, t, dt)), lambda: leg
        ), None

    leg, _ = lax.scan(go_on, leg, length=MAX_IMPACTS + 1)
    return _invalidate_overrun_lanes(scene, leg, t, dt), leg.since


def _invalidate_overrun_lanes(scene: Scene, leg: _StepProgress, t: Time, dt: Array) -> Particles:
    """The lanes after a step; those that wait where a surface has moved over them become NaN."""

    def overrun():
        leg_start = t + leg.elapsed
        return ~leg.arrived & is_overrun(
            collect_faces(_collect_walls(scene), to_float_time(leg_start), leg.state),
            to_float_time(leg_start),
            to_float_time(t + dt),
            leg.state,
        )

    return invalidate_lanes(materialise_where(~leg.arrived, overrun), leg.state)


def _start_progress(scene: Scene, dt: ArrayLike) -> tuple[_StepProgress, Array]:
    """Where the first leg of a step begins, and the step of each lane."""
    dt = jnp.broadcast_to(dt, scene.state.lanes)
    since = _list_contact_starts(_collect_walls(scene))
    return _StepProgress(jnp.zeros_like(dt), scene.state, since, jnp.zeros(dt.shape, bool)), dt


def _begin_leg(scene: Scene, leg: _StepProgress, t: Time, dt: Array) -> tuple[Time, Array, ContactMode]:
    """When a leg begins [s], how much of the step is left [s], and each lane's contact mode for it."""
    walls, leg_start = _collect_walls(scene), t + leg.elapsed
    rest = jnp.maximum(dt - leg.elapsed, shortest_duration(dt))
    here = scene.replace(state=leg.state)
    start = materialise_where(
        ~leg.arrived,
        lambda: decide_contact_mode(here, walls, leg.since, leg_start, rest),
        make_free_mode(here, walls, leg.since),
    )
    return leg_start, rest, start


def _advance_leg(motion: Motion, scene: Scene, leg: _StepProgress, t: Time, dt: Array) -> _StepProgress:
    """From where the lanes are to the next event of each, or to the end of the step."""
    walls, going = _collect_walls(scene), ~leg.arrived
    leg_start, rest, start = _begin_leg(scene, leg, t, dt)
    held = apply_contact_mode(scene, walls, start)
    end = materialise_where(going, lambda: motion(held, leg_start, rest).state, leg.state)
    event = materialise_where(going, lambda: find_next_event(walls, start, end, to_float_time(leg_start), rest))
    through = _StepProgress(leg.elapsed + rest, end, start.since, jnp.ones_like(leg.arrived))

    def resolve():
        # the step to the end of the leg, flown again only as far as the event
        duration = jnp.maximum(_find_event_time(motion, held, start, event, leg_start, rest), shortest_duration(dt))
        at = materialise_where(event.hit, lambda: motion(held, leg_start, duration).state, leg.state)
        state, since = materialise_where(
            event.hit,
            lambda: resolve_contact(held, walls, start, event, leg_start, leg_start + duration, at, dt),
            (leg.state, leg.since),
        )
        return choose_lanes(event.hit, _StepProgress(leg.elapsed + duration, state, since, leg.arrived), through)

    return lax.cond(any_lane(event.hit), resolve, lambda: through)


def fold_flights(
    motion: Motion, scene: Scene, t: Time, dt: ArrayLike, add: Callable[[Total, Flight], Total], total: Total
) -> tuple[Total, Particles]:
    """The total of `total = add(total, flight)` over the legs of the step that `impact` takes, and the state after it."""
    leg, dt = _start_progress(scene, dt)

    def fly(leg: _StepProgress, total: Total) -> tuple[_StepProgress, Total]:
        leg_start, _, start = _begin_leg(scene, leg, t, dt)
        held = apply_contact_mode(scene, _collect_walls(scene), start)
        after = choose_lanes(leg.arrived, leg, _advance_leg(motion, scene, leg, t, dt))
        duration = jnp.maximum(after.elapsed - leg.elapsed, shortest_duration(dt))
        end = motion(held, leg_start, duration).state
        return after, add(total, Flight(leg.state, held, leg_start, duration, end, after.state, ~leg.arrived))

    def go_on(carry: tuple[_StepProgress, Total], _) -> tuple[tuple[_StepProgress, Total], None]:
        return lax.cond(any_lane(~carry[0].arrived), fly, lambda *carry: carry, *carry), None

    (leg, total), _ = lax.scan(go_on, (leg, total), length=MAX_IMPACTS + 1)
    return total, _invalidate_overrun_lanes(scene, leg, t, dt)


def _find_event_time(
    motion: Motion, scene: Scene, start: ContactMode, event: Event, leg_start: Time, rest: Array
) -> Array:
    """When the first guard reaches zero on the method's own path [s after `leg_start`]; differentiable.

    The bracket comes from the cubic, and has no derivatives: those of the root follow from the guard's own.
    """
    event, rest = lax.stop_gradient((event, rest))

    def find_smallest_guard(duration: Array, scene: Scene, start: ContactMode, event: Event, leg_start: Time) -> Array:
        state, walls = motion(scene, leg_start, duration).state, _collect_walls(scene)
        faces = collect_faces(walls, to_float_time(leg_start), start.state)
        return jnp.min(
            jnp.stack(evaluate_guards(faces, walls, start, event, to_float_time(leg_start + duration), state)), axis=0
        )

    bracket = (event.first * rest, jnp.minimum(event.last, 1.0) * rest)
    # beyond this the time itself is not resolved
    tolerance = 4 * float(jnp.finfo(rest.dtype).eps) * rest
    search = (bracket, (event.above, event.below), event.hit, tolerance)
    return find_first_root(find_smallest_guard, (scene, start, event, leg_start), search)


def _collect_walls(scene: Scene) -> Walls:
    """The surfaces that are resolved at the time of impact; a room is its pairs of walls."""
    return tuple(wall for contact in scene.contacts if contact.response is impact for wall in contact.walls())


def _list_contact_starts(walls: Walls) -> tuple[Array, ...]:
    """Since when [s] each lane is in contact with each wall; a scene gives them all a memory of it."""
    return tuple(wall.touching_since for wall in walls if wall.touching_since is not None)


def _store_contact_starts(contacts: tuple, since: list[Array]) -> tuple:
    """The contacts with the times [s] since when each lane is in contact with them."""
    return tuple(
        contact.remember_since([since.pop(0) for _ in contact.walls()]) if contact.response is impact else contact
        for contact in contacts
    )
