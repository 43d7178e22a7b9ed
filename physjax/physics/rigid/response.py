"""Contact of rigid bodies: impacts in their moment, and what stays on a surface held there through the step.

A step of independent bodies is cut at the impacts of each, as for particles. In between, points that touch and do not
leave get half of the reaction's impulse at the start and half at the end of each leg (as RATTLE does, H. C. Andersen
1983): second order in dt whatever the method, and neither a rolling ball nor a face on a slope creeps.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.backend import any_lane, materialise_where
from physjax.loops import Time, to_float_time
from physjax.particles import Particles
from physjax.physics.contacts.events import Dip, find_dip
from physjax.physics.contacts.time_of_impact import (
    MAX_IMPACTS,
    SHORTEST_FLIGHT_SHARE,
    Flight,
    choose_lanes,
    invalidate_lanes,
    is_overrun,
    shortest_duration,
)
from physjax.physics.rigid.impulses import Points, apply_contact_impulses
from physjax.physics.rigid.spatial import RigidBodies, angular_acceleration, angular_velocity
from physjax.roots import find_first_root
from physjax.scene import Scene, trace_once
from physjax.vectors import cross, dot, norm, scale

RESTING_SPEED_SHARE = 0.1
"""Share of the speed that a step's load gives below which a point that touches stays, neither bouncing nor leaving."""
CONTACT_DISTANCE_SHARE = 1e-3
"""Share of the way that a step's load gives below which a point touches."""
BODY_AT_REST_SPEED_SHARE = 1e-6
"""Share of that speed below which a whole body is at rest, if its reactions balance the load: then it keeps its place."""


class ContactPointState(NamedTuple):
    """The points of hulls as their surfaces feel them, the points first: `center` is where the gap is measured from.

    `turning` is how fast the normal turns there [1/s], and the radius [m] of what touches; None where all is flat.
    """

    points: Points
    center: Particles
    signed_distance: Array
    restitution: Array
    turning: tuple[Array, Array] | None


class _StepProgress(NamedTuple):
    """How far each body has come in a step: time so far [s], its state, whether it is through."""

    elapsed: Array
    state: RigidBodies
    arrived: Array


@trace_once
def collide(motion: Callable, scene: Scene, t: Time, dt: ArrayLike) -> Scene:
    """The response of rigid bodies: from impact to impact, at most 8 a body and step, and held in between.

    A body that would have more impacts in a step waits where it is, with its velocity, for the next; where a moving
    surface comes over it as it waits, it becomes NaN, which its status tells. An impact after which a point would fly
    for less than a quarter of a step is the last, where K_r < 1. Coupled bodies share their step, which cannot be cut
    for one of them: they are held alike, but impacts are answered at its end, and a body that has passed through a ball
    by then becomes NaN.
    """
    leg, dt = _start_progress(scene, dt)
    if scene.couples:
        return scene.replace(state=_resolve_at_step_end(motion, scene, t, dt))

    @jax.checkpoint  # reverse mode takes each leg again: what it would remember of one is more than the work
    def further(leg):
        return choose_lanes(leg.arrived, leg, _advance_leg(motion, scene, leg, t, dt))

    def go_on(leg, _):
        return lax.cond(any_lane(~leg.arrived), further, lambda leg: leg, leg), None

    leg, _ = lax.scan(go_on, leg, length=MAX_IMPACTS + 1)
    return scene.replace(state=_invalidate_overrun_lanes(scene, leg, t, dt))


def fold_body_flights(motion: Callable, scene: Scene, t: Time, dt: ArrayLike, add: Callable, total: Any) -> Any:
    """The legs of the step that `collide` takes, told one by one as by `impact.flights`: what held the bodies is in them.

    Each begins with half of what the surfaces give through it; `after` is what the other half and the impact made of its
    end. Returns the total and the state after the step.
    """
    leg, dt = _start_progress(scene, dt)

    def flown(here, thrust, leg_start, duration, after, active):
        start = here.replace(state=_apply_half_impulse(here.state, thrust, duration))
        end = motion(start, leg_start, _take_shared(scene, duration)).state
        return Flight(
            here.state, start, _take_shared(scene, leg_start), _take_shared(scene, duration), end, after, active
        )

    if scene.couples:
        thrust = _solve_reactions(
            _use_facing_surfaces(scene, t), _find_resting_points_now(_use_facing_surfaces(scene, t), t, dt), t, dt
        )
        after = _resolve_at_step_end(motion, scene, t, dt)
        leg_start = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, dt.shape), t)
        return add(total, flown(scene, thrust, leg_start, dt, after, None)), after

    def fly(leg, total):
        leg_start, rest = _split_remaining_step(leg, t, dt)
        here = scene.replace(state=leg.state)
        seen = _use_facing_surfaces(here, leg_start)
        thrust = _solve_reactions(
            seen, _find_resting_points_now(seen, leg_start, dt) & ~leg.arrived[None], leg_start, rest
        )
        after = choose_lanes(leg.arrived, leg, _advance_leg(motion, scene, leg, t, dt))
        duration = jnp.maximum(after.elapsed - leg.elapsed, shortest_duration(dt))
        return after, add(total, flown(here, thrust, leg_start, duration, after.state, ~leg.arrived))

    def go_on(carry, _):
        return lax.cond(any_lane(~carry[0].arrived), fly, lambda *carry: carry, *carry), None

    (leg, total), _ = lax.scan(go_on, (leg, total), length=MAX_IMPACTS + 1)
    return total, _invalidate_overrun_lanes(scene, leg, t, dt)


def _start_progress(scene: Scene, dt: ArrayLike) -> tuple[_StepProgress, Array]:
    """Where the first leg of a step begins, and the step of each body."""
    dt = jnp.broadcast_to(dt, scene.state.lanes)
    arrived = jnp.zeros(dt.shape, bool) if scene.held is None else scene.held
    return _StepProgress(jnp.zeros_like(dt), scene.state, arrived), dt


def _split_remaining_step(leg: _StepProgress, t: Time, dt: Array) -> tuple[Time, Array]:
    """When a leg begins, and how much of the step is left."""
    return t + leg.elapsed, jnp.maximum(dt - leg.elapsed, shortest_duration(dt))


def _take_shared(scene: Scene, number: Any) -> Any:
    """A number of each body; coupled ones share theirs, and a method that chooses its own steps may ask."""
    return jax.tree.map(lambda leaf: leaf[..., 0], number) if scene.couples else number


def _advance_leg(motion: Callable, scene: Scene, leg: _StepProgress, t: Time, dt: Array) -> _StepProgress:
    """From where the bodies are to the first impact of each, or to the end of the step."""
    (leg_start, rest), going = _split_remaining_step(leg, t, dt), ~leg.arrived
    here = _use_facing_surfaces(scene.replace(state=leg.state), leg_start)
    load_speed = _load_speed(here, leg_start, dt)
    point_state = lax.stop_gradient(gather_point_states(here, leg_start, leg.state))
    on = _find_resting_points(point_state, leg.state, load_speed, dt) & going[None]
    thrust = _solve_reactions(here, on, leg_start, rest)
    end = materialise_where(going, lambda: _move_with_reactions(motion, here, thrust, leg_start, rest), leg.state)
    held = materialise_where(on, lambda: _finish_resting_leg(here, end, on, load_speed, leg_start + rest), end)
    through = _StepProgress(leg.elapsed + rest, held, jnp.ones_like(leg.arrived))
    dip = lax.stop_gradient(
        _find_dips(here, on, point_state, gather_point_states(here, leg_start + rest, held), leg_start, rest)
    )
    hit = going & jnp.any(dip.last <= 1, axis=0)

    def touch():
        duration = jnp.maximum(
            _find_event_time(motion, here, (dip, hit, on), thrust, leg_start, rest), shortest_duration(dt)
        )
        at = materialise_where(hit, lambda: _move_with_reactions(motion, here, thrust, leg_start, duration), leg.state)
        struck = _resolve_impact(here, at, hit, load_speed, leg_start + duration, dt)
        return choose_lanes(hit, _StepProgress(leg.elapsed + duration, struck, leg.arrived), through)

    return lax.cond(any_lane(hit), touch, lambda: through)


def _invalidate_overrun_lanes(scene: Scene, leg: _StepProgress, t: Time, dt: Array) -> RigidBodies:
    """The bodies after a step; those that waited in it where a surface has moved over them are not finite any more."""

    def overrun():
        leg_start = t + leg.elapsed
        seen = _use_facing_surfaces(scene.replace(state=leg.state), leg_start)
        return ~leg.arrived & is_overrun(
            _list_body_contacts(seen), to_float_time(leg_start), to_float_time(t + dt), leg.state
        )

    return invalidate_lanes(materialise_where(~leg.arrived, overrun), leg.state)


def _resolve_at_step_end(motion: Callable, scene: Scene, t: Time, dt: Array) -> RigidBodies:
    """The whole step held by what touches from its start; impacts answered at its end, and what went in moved out."""
    scene = _use_facing_surfaces(scene, t)
    load_speed, on = _load_speed(scene, t, dt), _find_resting_points_now(scene, t, dt)
    end = _move_with_reactions(motion, scene, _solve_reactions(scene, on, t, dt), t, dt)
    end = materialise_where(on, lambda: _finish_resting_leg(scene, end, on, load_speed, t + dt), end)
    struck = _resolve_impact(scene, end, jnp.ones(dt.shape, bool), load_speed, t + dt, dt)
    for contact in _list_body_contacts(scene):
        struck = contact.respond(to_float_time(t + dt), struck)
    if not any(contact.narrow for contact in _list_body_contacts(scene)):
        return struck
    return invalidate_lanes(_detect_tunnelling(scene, on, end, t, dt), struck)


def _detect_tunnelling(scene: Scene, on: Array, end: RigidBodies, t: Time, dt: Array) -> Array:
    """Which bodies have a point that went deep through an obstacle and out again within a step, unseen at its end."""
    start, end = lax.stop_gradient(
        (gather_point_states(scene, t, scene.state), gather_point_states(scene, t + dt, end))
    )
    dip = _find_dips(scene, on, start, end, t, dt)
    # a step fine enough for an answer at its end only grazes what it does not see
    deep = dip.below < -0.1 * norm(end.center.position - start.center.position)
    return jnp.any((dip.last < 1) & (start.signed_distance >= 0) & (end.signed_distance >= 0) & deep, axis=0)


def _list_body_contacts(scene: Scene) -> list:
    return [contact for contact in scene.contacts if contact.response is collide]


def _use_facing_surfaces(scene: Scene, t: Time) -> Scene:
    """The scene with surfaces as its bodies see them from where they are: rooms taken apart, of a slab the nearer face."""
    seen = [
        wall.facing(to_float_time(t), scene.state) if contact.response is collide else wall
        for contact in scene.contacts
        for wall in (contact.walls() if contact.response is collide else (contact,))
    ]
    return scene.replace(contacts=tuple(seen))


def _load_speed(scene: Scene, t: Time, dt: Array) -> Array:
    """The velocity that the loads give in a step [m/s]: what the smallness of speeds and gaps is measured by."""
    force, _ = scene.state.generalised_force(scene, t)
    return lax.stop_gradient(dt * norm(force) / scene.mass.mass)


def gather_point_states(scene: Scene, t: Time, state: RigidBodies) -> ContactPointState:
    """Every point of every hull, as its surface feels it."""
    parts = [contact.point_state(to_float_time(t), state, scene.mass) for contact in _list_body_contacts(scene)]
    if len(parts) > 1 and any(part.turning is not None for part in parts):
        flat = lambda part: (jnp.zeros_like(part.points.normal), jnp.zeros_like(part.signed_distance))  # noqa: E731
        parts = [part._replace(turning=part.turning or flat(part)) for part in parts]
    if len(parts) > 1 and any(part.points.friction is not None for part in parts):
        zero = lambda part: (jnp.zeros_like(part.signed_distance), jnp.zeros_like(part.signed_distance))  # noqa: E731
        rough = [part.points._replace(friction=part.points.friction or zero(part)) for part in parts]
        parts = [part._replace(points=points) for part, points in zip(parts, rough, strict=True)]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


def _find_touching_points(point_state: ContactPointState, state: RigidBodies, load_speed: Array, dt: Array) -> Array:
    """Which points touch: closer than a small share of a step's fall, or than rounding."""
    eps = float(jnp.finfo(state.dtype).eps)
    rounding = 64 * eps * (norm(point_state.center.position) + dt[None] * norm(point_state.center.velocity))
    return point_state.signed_distance <= (CONTACT_DISTANCE_SHARE * load_speed * dt)[None] + rounding


def _find_resting_points(point_state: ContactPointState, state: RigidBodies, load_speed: Array, dt: Array) -> Array:
    """Which points touch and stay: the others fly, or are about to strike."""
    speed = jnp.abs(dot(point_state.points.velocity, point_state.points.normal))
    rounding = 16 * float(jnp.finfo(state.dtype).eps) * norm(point_state.center.velocity)
    return _find_touching_points(point_state, state, load_speed, dt) & (
        speed <= RESTING_SPEED_SHARE * load_speed[None] + rounding
    )


def _find_resting_points_now(scene: Scene, t: Time, dt: Array) -> Array:
    """Which points touch and stay, at the scene's own state."""
    point_state = lax.stop_gradient(gather_point_states(scene, t, scene.state))
    return _find_resting_points(point_state, scene.state, _load_speed(scene, t, dt), dt)


def _solve_reactions(scene: Scene, on: Array, t: Time, h: Array) -> tuple[Array, Array]:
    """Force and torque of the reactions over a coming time h, of which the start gives h/2."""

    def pressed():
        start, state = _solve_resting_impulses(scene, scene.state, on, t, h / 2)[0], scene.state
        given = start.momentum - state.momentum, start.angular_momentum - state.angular_momentum
        return tuple(scale(2 / h, part) for part in given)

    return materialise_where(on, pressed)


def _move_with_reactions(motion: Callable, scene: Scene, thrust: tuple[Array, Array], t: Time, h: Array) -> RigidBodies:
    """The motion for a time h that begins with half of the reactions' impulse."""
    return motion(scene.replace(state=_apply_half_impulse(scene.state, thrust, h)), t, _take_shared(scene, h)).state


def _apply_half_impulse(state: RigidBodies, thrust: tuple[Array, Array], h: Array) -> RigidBodies:
    """The bodies with half of what the reactions give in a time h."""
    x, q, p, spin = state
    return RigidBodies(x, q, p + scale(h / 2, thrust[0]), spin + scale(h / 2, thrust[1]))


def _finish_resting_leg(scene: Scene, end: RigidBodies, on: Array, load_speed: Array, t: Time) -> RigidBodies:
    """The bodies after the other half, on what carries them; those at rest keep the place they had."""
    held, push = _solve_resting_impulses(scene, end, on, t, jnp.zeros_like(load_speed))
    held = _correct_penetration(held, gather_point_states(scene, t, held), on & (push > 0))
    slow = scene.mass.mass * (BODY_AT_REST_SPEED_SHARE * load_speed) ** 2
    rests = jnp.all(jnp.stack([2 * s.kinetic_energy(scene.mass) <= slow for s in (scene.state, held)]), axis=0)
    still, some = scene.state.hold_lanes(jnp.zeros_like(load_speed)), jnp.any(on, axis=0)
    return choose_lanes(some & rests, still, choose_lanes(some, held, end))


def _solve_resting_impulses(
    scene: Scene, state: RigidBodies, on: Array, t: Time, ahead: Array
) -> tuple[RigidBodies, Array]:
    """The impulses that keep the points from going in, as their velocities will be a time `ahead` if nothing does."""
    point_state, mass = gather_point_states(scene, t, state), scene.mass
    points = point_state.points
    force, torque = state.generalised_force(scene, t)
    omega, change = angular_velocity(state, mass), angular_acceleration(state, mass, torque)
    spread = lambda vector: jnp.broadcast_to(vector, points.arm.shape)  # noqa: E731
    # a ball touches ever other points of itself: what moves on a circle is the point in its middle
    moves = cross(spread(omega), point_state.center.position - spread(state.position))
    if point_state.turning is not None:
        # and over curved ground the point that touches moves around it as the normal turns
        turning, radius = point_state.turning
        moves = moves - scale(radius, turning)
    faster = spread(scale(1 / mass.mass, force)) + cross(spread(change), points.arm) + cross(spread(omega), moves)
    if point_state.turning is not None:
        faster = faster + scale(dot(turning, points.velocity), points.normal)
    velocity = points.velocity + scale(jnp.broadcast_to(ahead, on.shape), faster)
    return apply_contact_impulses(points._replace(velocity=velocity), on, state, mass)


def _correct_penetration(state: RigidBodies, point_state: ContactPointState, pressed: Array) -> RigidBodies:
    """What the truncation of a step left between a body and what it presses on, taken away at its lowest point."""
    lowest = jnp.min(jnp.where(pressed, point_state.signed_distance, jnp.inf), axis=0)
    here = pressed & (point_state.signed_distance == lowest[None])
    share = (
        jnp.where(here, point_state.signed_distance, 0.0)
        / jnp.maximum(jnp.sum(here, axis=0), 1).astype(point_state.signed_distance.dtype)[None]
    )
    return state._replace(position=state.position - jnp.sum(scale(share, point_state.points.normal), axis=0))


def _find_dips(scene: Scene, on: Array, start: ContactPointState, end: ContactPointState, t: Time, dt: Array) -> Dip:
    """Which points meet their surface within a leg, and between which shares of it, as the cubics of their gaps have it."""
    parts, first = [], 0
    for contact in _list_body_contacts(scene):
        some = slice(first, first := first + contact.hull.points.shape[-2])
        lanes = start.signed_distance[some].shape
        wide = [jnp.broadcast_to(number, lanes) for number in (to_float_time(t), dt)]
        ends = [jax.tree.map(lambda leaf, some=some: leaf[some], point_state.center) for point_state in (start, end)]
        parts.append(find_dip(contact, *wide, *ends))
    dip = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    return dip._replace(last=jnp.where(on, jnp.inf, dip.last))


def _find_event_time(
    motion: Callable, scene: Scene, watched: tuple, thrust: tuple, leg_start: Time, rest: Array
) -> Array:
    """When the first point reaches its surface on the method's own path [s after `leg_start`]; differentiable.

    Every point is looked at that nothing holds: one that turns fast may go in where its cubic has not foreseen it.
    """
    (dip, hit, on), rest = lax.stop_gradient((watched, rest))
    falls = dip.last <= 1

    def lowest(duration, scene, thrust, on, leg_start):
        state = _move_with_reactions(motion, scene, thrust, leg_start, duration)
        return jnp.min(
            jnp.where(on, jnp.inf, gather_point_states(scene, leg_start + duration, state).signed_distance), axis=0
        )

    last = jnp.min(dip.last, axis=0)
    first = jnp.min(jnp.where(falls, dip.first, jnp.inf), axis=0)
    soonest = falls & (dip.last == last[None])
    above, below = (jnp.min(jnp.where(soonest, part, jnp.inf), axis=0) for part in (dip.above, dip.below))
    bracket = (jnp.where(hit, first, 0.0) * rest, jnp.minimum(last, 1.0) * rest)
    tolerance = 4 * float(jnp.finfo(rest.dtype).eps) * rest
    above, below = jnp.where(hit, above, 1.0), jnp.where(hit, below, -1.0)
    return find_first_root(lowest, (scene, thrust, on, leg_start), (bracket, (above, below), hit, tolerance))


def _resolve_impact(scene: Scene, state: RigidBodies, hit: Array, load_speed: Array, t: Time, dt: Array) -> RigidBodies:
    """The bodies that are hit after the impact of all their points that touch."""
    point_state = gather_point_states(scene, t, state)
    active = lax.stop_gradient(_find_touching_points(point_state, state, load_speed, dt)) & hit[None]
    lift = -point_state.restitution * dot(point_state.points.velocity, point_state.points.normal)
    last = (2 * lift <= SHORTEST_FLIGHT_SHARE * load_speed[None]) & (point_state.restitution < 1)
    return materialise_where(
        active,
        lambda: apply_contact_impulses(
            point_state.points, active, state, scene.mass, jnp.where(last, 0.0, point_state.restitution)
        )[0],
        state,
    )
