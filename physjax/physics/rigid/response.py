"""Contact response of rigid bodies: impacts at their time, and reactions at the points that stay through the step.

A step of independent bodies is cut at the impacts of each, as for particles. In between, points that touch and do not
leave get half of the reaction's impulse at the start and half at the end of each leg.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.backend import any_lane, materialise_where
from physjax.loops import Time, to_float_time
from physjax.physics.contacts.events import Dip
from physjax.physics.contacts.legs import (
    MAX_IMPACTS,
    SHORTEST_FLIGHT_SHARE,
    Flight,
    Motion,
    choose_lanes,
    invalidate_lanes,
    is_overrun,
    shortest_duration,
)
from physjax.physics.rigid.impulses import apply_contact_impulses
from physjax.physics.rigid.point_contacts import (
    find_dips,
    find_load_speed,
    find_resting_points,
    find_resting_points_now,
    find_touching_points,
    gather_point_states,
    list_body_contacts,
    use_facing_surfaces,
)
from physjax.physics.rigid.reactions import (
    Thrust,
    apply_half_impulse,
    finish_resting_leg,
    move_with_reactions,
    solve_reactions,
    take_shared_number,
)
from physjax.physics.rigid.spatial import RigidBodies
from physjax.roots import find_first_root
from physjax.scene import Scene, trace_once
from physjax.vectors import dot, norm

TUNNELLING_DEPTH_SHARE = 0.1
"""Share of its way in a step by which a point must have been below a surface for its body to have passed through."""

Total = TypeVar("Total")


class _StepProgress(NamedTuple):
    """How far each body is in a step: time so far [s], its state, whether it arrived at the end."""

    elapsed: Array
    state: RigidBodies
    arrived: Array


@trace_once
def collide(motion: Motion, scene: Scene, t: Time, dt: ArrayLike) -> Scene:
    """The response of rigid bodies: from impact to impact, at most 8 per body and step, with reactions in between.

    A body that would have more impacts in a step waits where it is, with its velocity, for the next; where a moving
    surface overruns it as it waits, it becomes NaN, which its status reports. An impact after which a point would fly
    for less than a quarter of a step is the last, where K_r < 1. Coupled bodies share their step, which cannot be cut
    for one of them: reactions are the same, but impacts are resolved at its end, and a body that has passed through a
    ball by then becomes NaN.
    """
    leg, dt = _start_progress(scene, dt)
    if scene.couples:
        return scene.replace(state=_resolve_at_step_end(motion, scene, t, dt))

    @jax.checkpoint  # reverse mode computes each leg again: storing what it needs of one costs more than the work
    def advance(leg: _StepProgress) -> _StepProgress:
        return choose_lanes(leg.arrived, leg, _advance_leg(motion, scene, leg, t, dt))

    def go_on(leg: _StepProgress, _) -> tuple[_StepProgress, None]:
        return lax.cond(any_lane(~leg.arrived), advance, lambda leg: leg, leg), None

    leg, _ = lax.scan(go_on, leg, length=MAX_IMPACTS + 1)
    return scene.replace(state=_invalidate_overrun_lanes(scene, leg, t, dt))


def fold_body_flights(
    motion: Motion, scene: Scene, t: Time, dt: ArrayLike, add: Callable[[Total, Flight], Total], total: Total
) -> tuple[Total, RigidBodies]:
    """The total of `total = add(total, flight)` over the legs of the step that `collide` takes, and the state after it.

    Each flight begins with half of the reactions' impulse through it; `after` is what the other half and the impact made
    of its end.
    """
    leg, dt = _start_progress(scene, dt)
    if scene.couples:
        facing = use_facing_surfaces(scene, t)
        thrust = solve_reactions(facing, find_resting_points_now(facing, t, dt), t, dt)
        after = _resolve_at_step_end(motion, scene, t, dt)
        leg_start = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, dt.shape), t)
        return add(total, _build_flight(motion, scene, thrust, leg_start, dt, after, None)), after

    def fly(leg: _StepProgress, total: Total) -> tuple[_StepProgress, Total]:
        leg_start, rest = _split_remaining_step(leg, t, dt)
        here = scene.replace(state=leg.state)
        facing = use_facing_surfaces(here, leg_start)
        on = find_resting_points_now(facing, leg_start, dt) & ~leg.arrived[None]
        thrust = solve_reactions(facing, on, leg_start, rest)
        after = choose_lanes(leg.arrived, leg, _advance_leg(motion, scene, leg, t, dt))
        duration = jnp.maximum(after.elapsed - leg.elapsed, shortest_duration(dt))
        flight = _build_flight(motion, here, thrust, leg_start, duration, after.state, ~leg.arrived)
        return after, add(total, flight)

    def go_on(carry: tuple[_StepProgress, Total], _) -> tuple[tuple[_StepProgress, Total], None]:
        return lax.cond(any_lane(~carry[0].arrived), fly, lambda *carry: carry, *carry), None

    (leg, total), _ = lax.scan(go_on, (leg, total), length=MAX_IMPACTS + 1)
    return total, _invalidate_overrun_lanes(scene, leg, t, dt)


def _build_flight(
    motion: Motion,
    scene: Scene,
    thrust: Thrust,
    leg_start: Time,
    duration: Array,
    after: RigidBodies,
    active: Array | None,
) -> Flight[RigidBodies]:
    """A leg as it was flown from the scene's state, with these reactions."""
    start = scene.replace(state=apply_half_impulse(scene.state, thrust, duration))
    shared = partial(take_shared_number, scene)
    end = motion(start, leg_start, shared(duration)).state
    return Flight(scene.state, start, shared(leg_start), shared(duration), end, after, active)


def _start_progress(scene: Scene, dt: ArrayLike) -> tuple[_StepProgress, Array]:
    """Where the first leg of a step begins, and the step of each body."""
    dt = jnp.broadcast_to(dt, scene.state.lanes)
    arrived = jnp.zeros(dt.shape, bool) if scene.held is None else scene.held
    return _StepProgress(jnp.zeros_like(dt), scene.state, arrived), dt


def _split_remaining_step(leg: _StepProgress, t: Time, dt: Array) -> tuple[Time, Array]:
    """When a leg begins [s], and how much of the step is left [s]."""
    return t + leg.elapsed, jnp.maximum(dt - leg.elapsed, shortest_duration(dt))


def _advance_leg(motion: Motion, scene: Scene, leg: _StepProgress, t: Time, dt: Array) -> _StepProgress:
    """From where the bodies are to the next impact of each, or to the end of the step."""
    (leg_start, rest), going = _split_remaining_step(leg, t, dt), ~leg.arrived
    here = use_facing_surfaces(scene.replace(state=leg.state), leg_start)
    load_speed = find_load_speed(here, leg_start, dt)
    point_state = lax.stop_gradient(gather_point_states(here, leg_start, leg.state))
    on = find_resting_points(point_state, leg.state, load_speed, dt) & going[None]
    thrust = solve_reactions(here, on, leg_start, rest)
    # computed apart: its many readers below would each repeat the motion, in XLA on a CPU
    end = materialise_where(going, lambda: move_with_reactions(motion, here, thrust, leg_start, rest), leg.state)
    held = materialise_where(on, lambda: finish_resting_leg(here, end, on, load_speed, leg_start + rest), end)
    through = _StepProgress(leg.elapsed + rest, held, jnp.ones_like(leg.arrived))
    dip = lax.stop_gradient(
        find_dips(here, on, point_state, gather_point_states(here, leg_start + rest, held), leg_start, rest)
    )
    hit = going & jnp.any(dip.last <= 1, axis=0)

    def resolve():
        # the leg flown again, only as far as the impact
        duration = jnp.maximum(
            _find_event_time(motion, here, (dip, hit, on), thrust, leg_start, rest), shortest_duration(dt)
        )
        at = materialise_where(hit, lambda: move_with_reactions(motion, here, thrust, leg_start, duration), leg.state)
        struck = _resolve_impact(here, at, hit, load_speed, leg_start + duration, dt)
        return choose_lanes(hit, _StepProgress(leg.elapsed + duration, struck, leg.arrived), through)

    return lax.cond(any_lane(hit), resolve, lambda: through)


def _invalidate_overrun_lanes(scene: Scene, leg: _StepProgress, t: Time, dt: Array) -> RigidBodies:
    """The bodies after a step; those that wait where a surface has moved over them become NaN."""

    def overrun():
        leg_start = t + leg.elapsed
        facing = use_facing_surfaces(scene.replace(state=leg.state), leg_start)
        return ~leg.arrived & is_overrun(
            list_body_contacts(facing), to_float_time(leg_start), to_float_time(t + dt), leg.state
        )

    return invalidate_lanes(materialise_where(~leg.arrived, overrun), leg.state)


def _resolve_at_step_end(motion: Motion, scene: Scene, t: Time, dt: Array) -> RigidBodies:
    """The whole step with the reactions at points that stay; impacts are resolved at its end, and what went in moves out."""
    scene = use_facing_surfaces(scene, t)
    load_speed, on = find_load_speed(scene, t, dt), find_resting_points_now(scene, t, dt)
    end = move_with_reactions(motion, scene, solve_reactions(scene, on, t, dt), t, dt)
    end = materialise_where(on, lambda: finish_resting_leg(scene, end, on, load_speed, t + dt), end)
    struck = _resolve_impact(scene, end, jnp.ones(dt.shape, bool), load_speed, t + dt, dt)
    for contact in list_body_contacts(scene):
        struck = contact.respond(to_float_time(t + dt), struck)
    if not any(contact.narrow for contact in list_body_contacts(scene)):
        return struck
    return invalidate_lanes(_detect_tunnelling(scene, on, end, t, dt), struck)


def _detect_tunnelling(scene: Scene, on: Array, end: RigidBodies, t: Time, dt: Array) -> Array:
    """Which bodies have a point that went deep through an obstacle and out again within a step, unseen at its end."""
    before, after = lax.stop_gradient(
        (gather_point_states(scene, t, scene.state), gather_point_states(scene, t + dt, end))
    )
    dip = find_dips(scene, on, before, after, t, dt)
    # steps fine enough for a response at their end only graze what they do not meet
    deep = dip.below < -TUNNELLING_DEPTH_SHARE * norm(after.center.position - before.center.position)
    return jnp.any((dip.last < 1) & (before.signed_distance >= 0) & (after.signed_distance >= 0) & deep, axis=0)


def _find_event_time(
    motion: Motion, scene: Scene, watched: tuple[Dip, Array, Array], thrust: Thrust, leg_start: Time, rest: Array
) -> Array:
    """When the first point reaches its surface on the method's own path [s after `leg_start`]; differentiable.

    All points count that do not rest, not only those whose cubic dips: a point that turns fast leaves its cubic.
    """
    (dip, hit, on), rest = lax.stop_gradient((watched, rest))
    falls = dip.last <= 1

    def find_lowest_point(duration: Array, scene: Scene, thrust: Thrust, on: Array, leg_start: Time) -> Array:
        state = move_with_reactions(motion, scene, thrust, leg_start, duration)
        return jnp.min(
            jnp.where(on, jnp.inf, gather_point_states(scene, leg_start + duration, state).signed_distance), axis=0
        )

    last = jnp.min(dip.last, axis=0)
    first = jnp.min(jnp.where(falls, dip.first, jnp.inf), axis=0)
    # the guard's values at the ends of the bracket are those of the point that falls first
    soonest = falls & (dip.last == last[None])
    above, below = (jnp.min(jnp.where(soonest, part, jnp.inf), axis=0) for part in (dip.above, dip.below))
    bracket = (jnp.where(hit, first, 0.0) * rest, jnp.minimum(last, 1.0) * rest)
    tolerance = 4 * float(jnp.finfo(rest.dtype).eps) * rest
    above, below = jnp.where(hit, above, 1.0), jnp.where(hit, below, -1.0)
    return find_first_root(find_lowest_point, (scene, thrust, on, leg_start), (bracket, (above, below), hit, tolerance))


def _resolve_impact(scene: Scene, state: RigidBodies, hit: Array, load_speed: Array, t: Time, dt: Array) -> RigidBodies:
    """The bodies that are hit, after the impact of all their points that touch.

    A point whose next flight would be shorter than a share of the step bounces no more.
    """
    point_state = gather_point_states(scene, t, state)
    active = lax.stop_gradient(find_touching_points(point_state, state, load_speed, dt)) & hit[None]
    lift = -point_state.restitution * dot(point_state.points.velocity, point_state.points.normal)
    last = (2 * lift <= SHORTEST_FLIGHT_SHARE * load_speed[None]) & (point_state.restitution < 1)
    return materialise_where(
        active,
        lambda: apply_contact_impulses(
            point_state.points, active, state, scene.mass, jnp.where(last, 0.0, point_state.restitution)
        )[0],
        state,
    )
