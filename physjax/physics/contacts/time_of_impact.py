"""Time of impact: each contact is found within the step and resolved there, and the rest of the step goes on from it.

The time is a root of the signed distance along the method's own path, so that a method keeps its order through a bounce.
It moves with every parameter, so that derivatives through a bounce are right, forward and reverse. All is decided lane
by lane, and of many lanes only those that meet something are computed again.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, PyTree

from physjax.backend import MIN_LANES_TO_SELECT, any_lane, materialise_where
from physjax.compaction import compact_and_apply
from physjax.loops import Time, to_float_time
from physjax.particles import Particles
from physjax.parts import holds_user_code
from physjax.physics.contacts.contact_mode import ContactMode, decide_contact_mode, make_free_mode, start_leg
from physjax.physics.contacts.legs import (
    MAX_DIFFERENTIATED_IMPACTS,
    MAX_IMPACTS,
    Flight,
    Motion,
    choose_lanes,
    has_moved_over,
    invalidate_lanes,
)
from physjax.physics.contacts.replay import (
    FlownLeg,
    HeldLeg,
    LegStart,
    end_leg,
    fly_leg,
    fold_legs,
    hold_leg,
    log_events,
)
from physjax.physics.contacts.search import Progress, find_events
from physjax.physics.contacts.surfaces import Surfaces
from physjax.replays import Record, Replay, differentiate_by_replay, hoist_closures, trace_once
from physjax.scene import Scene
from physjax.vectors import scale

Total = TypeVar("Total")


@trace_once
def impact(motion: Motion, scene: Scene, t: Time, dt: ArrayLike) -> Scene:
    """The response that finds the time of each impact within the step, bounces the lane there, and goes on from there.

    For independent lanes, at most 64 impacts per lane and step. A lane that would have more waits where it is, with its
    velocity, for the next step, so that nothing ever passes; where a moving surface overruns it as it waits, it becomes
    NaN, which its status reports. Derivatives of a step are NaN where a lane has more than 8. Where the flight to the
    next bounce would be shorter than a quarter of a step, the lane comes to rest: the bounces that remain take
    2v/(g(1 - K_r)) more, which `touching_since` [s] records. From then on the surface carries it, at rest or sliding,
    until a force lifts it off.

    Example:
        >>> floor = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.5, response=contacts.impact)
        >>> falling = Scene(Particles(jnp.array([0.0, 1.0]), jnp.array([0.0, -2.0])), contacts=(floor,))
        >>> end = falling.step(methods.euler, 0.0, 1.0).state
        >>> print(end.position, end.velocity)
        [0.  0.5] [0. 1.]
    """
    surfaces, dt = _collect_surfaces(scene), jnp.broadcast_to(dt, scene.state.lanes)
    since, lanes = surfaces.touching_since, scene.state.lanes
    if dt.size < MIN_LANES_TO_SELECT:
        # few lanes: the search itself takes the first step of all of them, and the program has one step in it
        state, since = _step_through_contacts(motion, (scene.state, since), jnp.ones(lanes, bool), scene, t, dt)
        return _store(scene, state, since)
    end, since = _step_in_contact(motion, scene, surfaces, t, dt)
    meets = lax.stop_gradient(surfaces).may_meet(*lax.stop_gradient((since, to_float_time(t), dt, scene.state, end)))
    if scene.held is not None:
        meets = meets & ~scene.held
    others = (meets, scene, t, dt)
    cut, masks = scene.may_be_cut(), scene.build_lane_mask(others)

    def go_on(changing: tuple[Particles, tuple], *others: Any) -> tuple[Particles, tuple]:
        state, since = _step_through_contacts(motion, (changing[0], jnp.stack(changing[1])), *others)
        return state, tuple(since)

    # lanes are picked from arrays that have them first
    end, since = compact_and_apply(go_on, meets, (end, tuple(since)), *others, masks=masks, cut=cut)
    return _store(scene, end, jnp.stack(since))


def _step_in_contact(motion: Motion, scene: Scene, surfaces: Surfaces, t: Time, dt: Array) -> tuple[Particles, Array]:
    """A whole step of all lanes, as if nothing were met on the way; surfaces carry those that are in contact."""
    since = surfaces.touching_since
    # a non-finite lane rests nowhere, or the others would take the other branch, with other rounding, because of it
    touches = jnp.any(jnp.isfinite(since), axis=0) & scene.finite(scene.state)

    def decide() -> ContactMode:
        time = to_float_time(t)
        return decide_contact_mode(scene, surfaces, surfaces.measure(time, scene.state), since, t, dt)

    held, _ = start_leg(scene, surfaces, mode := materialise_where(touches, decide, make_free_mode(scene, surfaces)), t)
    # where no lane is in contact, a step without branches for reactions; and what a branch returns is computed once
    end = lax.cond(any_lane(mode.pressed), lambda: motion(held, t, dt).state, lambda: motion(scene, t, dt).state)
    return end, jnp.where(mode.pressed, since, jnp.inf)


class _Passage(NamedTuple):
    """A step of lanes that may meet something: `changing` is what they have if they do not."""

    motion: Motion
    changing: tuple[Particles, Array]
    meets: Array
    scene: Scene
    surfaces: Surfaces
    t: Time
    dt: Array


def _step_through_contacts(
    motion: Motion, changing: tuple[Particles, Array], meets: Array, scene: Scene, t: Time, dt: Array
) -> tuple[Particles, Array]:
    """The step, leg by leg from impact to impact, of lanes that may meet something; the others have arrived."""
    passage = _Passage(motion, changing, meets, scene, _collect_surfaces(scene), t, dt)
    if holds_user_code((motion, scene)):
        return hoist_closures(_call_functions, _find_end, _log_end, _REPLAY, passage)
    return differentiate_by_replay(_find_end, _log_end, _REPLAY, passage)


def _call_functions(passage: _Passage) -> PyTree:
    """What calls every function of a user: the motion, and the distances to the surfaces."""
    motion, _, _, scene, surfaces, t, dt = passage
    return motion(scene, t, dt).state, surfaces.measure(to_float_time(t), scene.state)


def _find_end(passage: _Passage) -> tuple[Particles, Array]:
    """State and begin of contact after the step, found without derivatives."""
    motion, _, meets, scene, surfaces, t, dt = passage
    progress, _ = find_events(motion, scene, surfaces, t, dt, meets, lambda nothing, *_: nothing, ())
    return _finish(passage, progress)


def _log_end(passage: _Passage) -> tuple[tuple[Particles, Array], Record]:
    """The same, and a record for the replay."""
    motion, _, meets, scene, surfaces, t, dt = passage
    progress, record = log_events(motion, scene, surfaces, t, dt, meets, MAX_DIFFERENTIATED_IMPACTS)
    return _finish(passage, progress), record


def _begin_replay(passage: _Passage) -> LegStart:
    """Where the first leg begins; lanes that meet nothing have arrived."""
    _, (state, since), meets, scene, surfaces, _, dt = passage
    since = jnp.where(meets[None], surfaces.touching_since, since)
    return LegStart(jnp.zeros_like(dt), choose_lanes(meets, scene.state, state), since)


def _hold_leg(choices: FlownLeg, start: LegStart, passage: _Passage) -> HeldLeg:
    motion, _, _, scene, surfaces, t, dt = passage
    return hold_leg(choices, start, motion, scene, surfaces, t, dt)


def _fly_leg(choices: FlownLeg, leg: HeldLeg, duration: Array, passage: _Passage) -> tuple[Particles, Array]:
    return fly_leg(choices, leg, duration, passage.motion)


def _end_leg(choices: FlownLeg, leg: HeldLeg, duration: Array, end: Particles, passage: _Passage) -> LegStart:
    del passage
    return end_leg(choices, leg, duration, end)


def _finish_replay(record: Record, end: LegStart) -> tuple[Particles, Array]:
    """State and begin of contact after the last leg: NaN where not all of the legs were logged."""
    lost = record.active[-1] & ~record.choices.arrives[-1]
    # a product: a NaN that is chosen has derivative zero
    known = jnp.where(lost, jnp.nan, jnp.ones_like(end.elapsed))
    return jax.tree.map(lambda leaf: scale(known, leaf), end.state), end.since


_REPLAY = Replay(_begin_replay, _hold_leg, _fly_leg, _end_leg, _finish_replay)


def _finish(passage: _Passage, progress: Progress) -> tuple[Particles, Array]:
    """The lanes after a step; those that wait where a surface has moved over them become NaN."""
    (_, changing, meets, _, surfaces, t, dt), state = passage, progress.state
    if surfaces.moves.any():
        waits = meets & ~progress.arrived

        def overrun() -> Array:
            now, x = to_float_time(t + progress.elapsed), progress.state.position
            faces = surfaces.facing(now, x)
            before, after = faces.signed_distance(now, x), faces.signed_distance(to_float_time(t + dt), x)
            return waits & jnp.any(has_moved_over(before, after, x[None]), axis=0)

        state = invalidate_lanes(materialise_where(waits, overrun), state)
    return choose_lanes(meets, state, changing[0]), jnp.where(meets[None], progress.since, changing[1])


def fold_flights(
    motion: Motion, scene: Scene, t: Time, dt: ArrayLike, add: Callable[[Total, Flight], Total], total: Total
) -> tuple[Total, Particles]:
    """The total of `total = add(total, flight)` over the legs of the step that `impact` takes, and the state after it."""
    surfaces, dt = _collect_surfaces(scene), jnp.broadcast_to(dt, scene.state.lanes)
    active = jnp.ones(dt.shape, bool)
    progress, record = log_events(motion, scene, surfaces, t, dt, active, MAX_IMPACTS)
    return fold_legs(motion, scene, surfaces, t, dt, record, add, total), progress.state


def _collect_surfaces(scene: Scene) -> Surfaces:
    """The surfaces that are resolved at the time of impact; a room is its pairs of walls."""
    return Surfaces.of([wall for contact in scene.contacts if contact.response is impact for wall in contact.walls()])


def _store(scene: Scene, state: Particles, since: Array) -> Scene:
    """The scene after a step, with the times [s] since when each lane is in contact with its surfaces."""
    starts = _collect_surfaces(scene).in_scene_order(since)
    contacts = tuple(
        contact.remember_since([starts.pop(0) for _ in contact.walls()]) if contact.response is impact else contact
        for contact in scene.contacts
    )
    return scene.replace(state=state, contacts=contacts)
