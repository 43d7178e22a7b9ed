"""Contact response of rigid bodies: impacts at their time, and reactions at the points that stay through the step.

A step of independent bodies is cut at the impacts of each, as for particles. In between, points that touch and do not
leave get half of the reaction's impulse at the start and half at the end of each leg.
"""

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, PyTree

from physjax.backend import any_lane, materialise_where
from physjax.loops import Time, to_float_time
from physjax.particles import Particles
from physjax.parts import holds_user_code
from physjax.physics.contacts.legs import Flight, Motion, choose_lanes, has_moved_over, invalidate_lanes
from physjax.physics.rigid.impact_search import Progress, find_impacts
from physjax.physics.rigid.point_contacts import (
    ContactKind,
    count_points,
    face_surfaces,
    find_dips,
    stack_body_contacts,
)
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
from physjax.physics.rigid.replay import REPLAY, fold_legs, record_legs
from physjax.physics.rigid.spatial import RigidBodies
from physjax.replays import Record, differentiate_by_replay, hoist_closures, trace_once
from physjax.scene import Scene
from physjax.vectors import norm

TUNNELLING_DEPTH_SHARE = 0.1
"""Share of its way in a step by which a point must have been below a surface for its body to have passed through."""
BEGINS, ARRIVES, STRIKES = range(3)
"""What the impulses at coupled bodies are for, one after the other in each step."""

Total = TypeVar("Total")


@trace_once
def collide(motion: Motion, scene: Scene, t: Time, dt: ArrayLike) -> Scene:
    """The response of rigid bodies: from impact to impact, at most 8 per body and step, with reactions in between.

    A body that would have more impacts in a step waits where it is, with its velocity, for the next; where a moving
    surface overruns it as it waits, it becomes NaN, which its status reports. An impact after which a point would fly
    for less than a quarter of a step is the last, where K_r < 1. Coupled bodies share their step, which cannot be cut
    for one of them: reactions are the same, but impacts are resolved at its end, and a body that has passed through a
    ball by then becomes NaN.

    The impacts are found without derivatives; where these are asked for, the step is flown again with its impacts known.
    """
    if scene.couples:
        return scene.replace(state=_resolve_at_step_end(motion, scene, t, dt)[0])
    inputs = (motion, scene, t, dt)
    if holds_user_code((motion, scene)):
        return scene.replace(state=hoist_closures(_call_functions, _find_end, _log_end, REPLAY, *inputs))
    return scene.replace(state=differentiate_by_replay(_find_end, _log_end, REPLAY, *inputs))


def _call_functions(motion: Motion, scene: Scene, t: Time, dt: ArrayLike) -> PyTree:
    """What calls every function of a user: the motion, and the distances to the surfaces."""
    time, state = to_float_time(t), scene.state
    return motion(scene, t, dt).state, [
        kind.map(lambda contact: contact.clearance(time, state)) for kind in stack_body_contacts(scene)
    ]


def _find_end(motion: Motion, scene: Scene, t: Time, dt: ArrayLike) -> RigidBodies:
    """The bodies after a step, found without derivatives."""
    kinds = stack_body_contacts(scene)
    return _carry_waiting_bodies(kinds, find_impacts(motion, scene, kinds, t, dt)[0], t, dt)


def _log_end(motion: Motion, scene: Scene, t: Time, dt: ArrayLike) -> tuple[RigidBodies, Record]:
    """The same, and a record for the replay."""
    kinds = stack_body_contacts(scene)
    progress, legs, log = find_impacts(motion, scene, kinds, t, dt, logged=True)
    assert log is not None
    return _carry_waiting_bodies(kinds, progress, t, dt), record_legs(log, legs)


def fold_body_flights(
    motion: Motion, scene: Scene, t: Time, dt: ArrayLike, add: Callable[[Total, Flight], Total], total: Total
) -> tuple[Total, RigidBodies]:
    """The total of `total = add(total, flight)` over the legs of the step that `collide` takes, and the state after it.

    Each flight begins with half of the reactions' impulse through it; `after` is what the other half and the impact made
    of its end.
    """
    if scene.couples:
        after, leg = _resolve_at_step_end(motion, scene, t, dt)
        return add(total, _build_whole_flight(motion, scene, leg, t, dt, after)), after
    after, record = _log_end(motion, scene, t, dt)
    return fold_legs(motion, scene, t, dt, record, add, total), after


def _build_whole_flight(
    motion: Motion, scene: Scene, leg: Leg, t: Time, dt: ArrayLike, after: RigidBodies
) -> Flight[RigidBodies]:
    """A step of coupled bodies as it was flown, with these reactions."""
    dt = jnp.broadcast_to(dt, scene.state.lanes)
    leg_start = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, dt.shape), t)
    start = scene.replace(state=apply_half_impulse(scene.state, leg.thrust, dt))
    shared = partial(take_shared_number, scene)
    end = motion(start, leg_start, shared(dt)).state
    return Flight(scene.state, start, shared(leg_start), shared(dt), end, after, None)


def _carry_waiting_bodies(kinds: tuple[ContactKind, ...], progress: Progress, t: Time, dt: ArrayLike) -> RigidBodies:
    """The bodies after a step: those that wait where a surface moves over them are moved along by it.

    Where it moves them into another surface there is no way out: those become NaN.
    """
    moving = tuple(kind for kind in kinds if kind.part.moves)
    if not moving:
        return progress.state

    def carry() -> RigidBodies:
        state, end = progress.state, to_float_time(t + dt)
        leg_start = to_float_time(t + progress.elapsed)
        waits, moved = ~progress.arrived, state
        faces = face_surfaces(kinds, leg_start, state)
        before = _measure_clearances(faces, leg_start, state)
        over = has_moved_over(before, _measure_clearances(faces, end, state), state.position[None])
        for kind in faces:
            moved = _move_out(kind, end, moved)
        state = choose_lanes(waits & jnp.any(over, axis=0), moved, state)
        stuck = has_moved_over(before, _measure_clearances(faces, end, state), state.position[None])
        return invalidate_lanes(waits & jnp.any(stuck, axis=0), state)

    return materialise_where(~progress.arrived, carry, progress.state)


def _measure_clearances(kinds: tuple[ContactKind, ...], t: ArrayLike, state: RigidBodies) -> Array:
    """How far each body is from each surface at a time [m]."""
    return jnp.concatenate([kind.map(lambda contact: contact.clearance(t, state)) for kind in kinds])


def _resolve_at_step_end(motion: Motion, scene: Scene, t: Time, dt: ArrayLike) -> tuple[RigidBodies, Leg]:
    """The whole step with the reactions at points that stay; impacts are resolved at its end, and what went in moves out.

    One loop over what the impulses are for: the motion, the points and the impulses stand in it once.
    """
    dt = jnp.broadcast_to(dt, scene.state.lanes)
    kinds = face_surfaces(stack_body_contacts(scene), t, scene.state)
    narrow = any(kind.part.narrow for kind in kinds)

    def act(carry: tuple[Leg, RigidBodies], part: Array) -> tuple[tuple[Leg, RigidBodies], tuple | None]:
        leg, state = carry
        flags = [jnp.broadcast_to(part == kind, dt.shape) for kind in (BEGINS, ARRIVES, STRIKES)]
        move = lambda: move_with_reactions(motion, scene, leg, t, dt)  # noqa: E731
        state = lax.cond(any_lane(flags[ARRIVES]), move, lambda: state)
        now = t + jnp.where(flags[BEGINS], 0.0, dt)
        here = Place.find(kinds, now, state, scene.mass)
        met = exchange_impulses(scene, leg, Stage(*flags), here, (dt, dt))
        after = choose_lanes(flags[STRIKES], met.struck, choose_lanes(flags[ARRIVES], met.held, state))
        path = (here.points.center, here.points.signed_distance) if narrow else None
        return (met.leg, after), lax.stop_gradient(path)

    parts = jnp.array([BEGINS, ARRIVES, STRIKES])
    (leg, struck), path = lax.scan(act, (start_leg(scene.state, count_points(kinds)), scene.state), parts)
    for kind in kinds:
        struck = _move_out(kind, to_float_time(t + dt), struck)
    if path is None:
        return struck, leg
    before, after = (jax.tree.map(lambda leaf, part=part: leaf[part], path) for part in (BEGINS, ARRIVES))
    return invalidate_lanes(_detect_tunnelling(kinds, leg.on, (before, after), t, dt), struck), leg


def _move_out(kind: ContactKind, t: ArrayLike, state: RigidBodies) -> RigidBodies:
    """The bodies moved out of one surface after the other."""
    if kind.size == 1:
        return kind.part.respond(t, state)
    return lax.scan(lambda state, contact: (contact.respond(t, state), None), state, kind.part)[0]


def _detect_tunnelling(
    kinds: tuple[ContactKind, ...], on: Array, path: tuple[tuple[Particles, Array], ...], t: Time, dt: Array
) -> Array:
    """Which bodies have a point that went deep through an obstacle and out again within a step, unseen at its end."""
    (before, distance_before), (after, distance_after) = path
    dip = find_dips(kinds, on, before, after, t, dt)
    # steps fine enough for a response at their end only graze what they do not meet
    deep = dip.below < -TUNNELLING_DEPTH_SHARE * norm(after.position - before.position)
    return jnp.any((dip.last < 1) & (distance_before >= 0) & (distance_after >= 0) & deep, axis=0)
