"""The search for the impacts of rigid bodies within a step: one loop, in which every body is at its own point of the step.

Each turn of the loop proposes a duration for each body, moves it with the reactions that it has, looks at its points, and
lets impulses act on it where they have to. So the method's step, the points at their surfaces and the impulses stand in the
program once, however many impacts there are. A body begins a leg, tries the rest of the step, seeks the time of the impact
that it found on the way, strikes and begins the next leg, or arrives at the end of the step.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Int

from physjax.backend import any_lane, materialise_where
from physjax.loops import Time, bounded_while_loop
from physjax.particles import Particles
from physjax.physics.contacts.events import Dip
from physjax.physics.contacts.legs import MAX_DIFFERENTIATED_IMPACTS, Motion, choose_lanes, shortest_duration
from physjax.physics.rigid.point_contacts import (
    ContactKind,
    count_points,
    face_surfaces,
    find_dips,
)
from physjax.physics.rigid.reactions import (
    Leg,
    Meeting,
    Place,
    Stage,
    exchange_impulses,
    move_with_reactions,
    start_leg,
)
from physjax.physics.rigid.spatial import RigidBodies
from physjax.roots import Bracket
from physjax.scene import Scene

MAX_LEGS = MAX_DIFFERENTIATED_IMPACTS + 1
"""Legs of a step: from its start, and from each impact."""
MAX_TURNS_PER_LEG = 64
"""Turns of the search that a leg may take, more than the bisection of a bracket down to rounding needs in float64."""
ROOT_ROUNDING = 4
"""Units of rounding of the rest of a step within which the time of an impact is found."""


class Progress(NamedTuple):
    """How far each body is in a step: time so far [s], its state, whether it arrived at the end."""

    elapsed: Array
    state: RigidBodies
    arrived: Bool[Array, "*lanes"]


class LegLog(NamedTuple):
    """How legs began and how long they took [s], along a first axis, and which of them ended with an impact."""

    leg: Leg
    elapsed: Array
    duration: Array
    strikes: Bool[Array, "legs *lanes"]


class _Search(NamedTuple):
    """What a turn hands to the next, of each body: its leg, when that began [s], and what the body is about to do."""

    leg: Leg
    center: Particles
    elapsed: Array
    begins: Bool[Array, "*lanes"]
    seeks: Bool[Array, "*lanes"]
    found: Bool[Array, "*lanes"]
    arrived: Bool[Array, "*lanes"]
    impacts: Int[Array, "*lanes"]
    bracket: Bracket
    log: LegLog | None


def split_remaining_step(elapsed: Array, t: Time, dt: Array) -> tuple[Time, Array]:
    """When a leg begins [s], and how much of the step is left [s]."""
    return t + elapsed, jnp.maximum(dt - elapsed, shortest_duration(dt))


def start_progress(scene: Scene, dt: ArrayLike) -> tuple[Progress, Array]:
    """Where the first leg of a step begins, and the step of each body."""
    dt = jnp.broadcast_to(dt, scene.state.lanes)
    arrived = jnp.zeros(dt.shape, bool) if scene.held is None else scene.held
    return Progress(jnp.zeros_like(dt), scene.state, arrived), dt


def find_impacts(
    motion: Motion, scene: Scene, kinds: tuple[ContactKind, ...], t: Time, dt: ArrayLike, *, logged: bool = False
) -> tuple[Progress, Array, LegLog | None]:
    """Where the bodies are at the end of a step, how many legs took them there, and, `logged`, these.

    Nothing here has derivatives.
    """
    progress, dt = start_progress(scene, dt)
    scene = scene.replace(state=progress.state)
    points, zero, no = count_points(kinds), jnp.zeros_like(dt), jnp.zeros(dt.shape, bool)
    nowhere = jnp.zeros((points, *scene.state.position.shape), scene.state.dtype)
    leg, log = start_leg(scene.state, points), None
    if logged:
        blank = LegLog(leg, zero, dt, no)
        log = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (MAX_LEGS, *leaf.shape)), blank)
    start = _Search(
        leg=leg,
        center=Particles(nowhere, nowhere),
        elapsed=zero,
        begins=~no,
        seeks=no,
        found=no,
        arrived=progress.arrived,
        impacts=jnp.zeros(dt.shape, jnp.int32),
        bracket=Bracket(zero, zero, zero, zero, zero),
        log=log,
    )
    end = bounded_while_loop(
        lambda search: any_lane(_goes_on(search)),
        lambda search: _take_turn(motion, scene, kinds, search, t, dt),
        start,
        most=MAX_LEGS * MAX_TURNS_PER_LEG,
    )
    # the last leg of those that arrived, and did not before they began
    legs = end.impacts + (end.arrived & ~progress.arrived).astype(jnp.int32)
    return Progress(end.elapsed, end.leg.before, end.arrived), legs, end.log


def _goes_on(search: _Search) -> Array:
    """Which bodies have some of the step left, and impacts that they may have in it."""
    return ~search.arrived & (search.impacts < MAX_LEGS)


def _take_turn(
    motion: Motion, scene: Scene, kinds: tuple[ContactKind, ...], search: _Search, t: Time, dt: Array
) -> _Search:
    """Every body after the next thing that it does."""
    leg, goes_on = search.leg, _goes_on(search)
    begins, seeks = search.begins & goes_on, search.seeks & goes_on
    tries = goes_on & ~begins & ~seeks
    leg_start, rest = split_remaining_step(search.elapsed, t, dt)
    h = jnp.where(seeks, jnp.maximum(search.bracket.proposal, shortest_duration(dt)), jnp.where(tries, rest, 0.0))

    def move() -> RigidBodies:
        moved = move_with_reactions(motion, scene, leg, leg_start, jnp.where(h > 0, h, rest))
        return choose_lanes(tries | seeks, moved, leg.before)

    state, now = materialise_where(tries | seeks, move, leg.before), leg_start + h
    facing = face_surfaces(kinds, leg_start, leg.before)
    here = Place.find(facing, now, state, scene.mass)
    lowest = jnp.min(jnp.where(leg.on, jnp.inf, here.points.signed_distance), axis=0)
    tolerance = ROOT_ROUNDING * float(jnp.finfo(rest.dtype).eps) * rest
    narrower, is_root = search.bracket.narrow(lowest, tolerance)
    found = seeks & (search.found | is_root)
    # who has found the time of an impact waits there until all have, so that impulses are solved for once and not many times
    stage = Stage(begins, tries, found & ~any_lane(seeks & ~found))
    met = materialise_where(
        begins | tries | stage.strikes,
        lambda: exchange_impulses(scene, leg, stage, here, (dt, rest)),
        Meeting(leg, state, here.points.center, state),
    )
    center = choose_lanes(begins[None], here.points.center, search.center)
    bracket, hit = _bracket_impact(facing, met.leg.on, (center, met.center), leg_start, rest, tries)
    ends = tries & ~hit
    narrower = narrower._replace(share=jnp.where(is_root, 0.0, narrower.share))
    bracket = choose_lanes(hit, bracket, choose_lanes(seeks & ~search.found, narrower, search.bracket))
    before = choose_lanes(stage.strikes, met.struck, choose_lanes(ends, met.held, leg.before))
    log = search.log
    if log is not None:
        numbers = jnp.arange(MAX_LEGS, dtype=jnp.int32).reshape(-1, *(1,) * dt.ndim)
        slot = (numbers == search.impacts[None]) & (stage.strikes | ends)[None]
        log = _write_leg(log, slot, LegLog(met.leg, search.elapsed, h, stage.strikes))
    return _Search(
        leg=met.leg._replace(before=before),
        center=center,
        elapsed=search.elapsed + jnp.where(ends, rest, jnp.where(stage.strikes, h, 0.0)),
        begins=stage.strikes | (search.begins & ~goes_on),
        seeks=(seeks & ~stage.strikes) | hit,
        found=found & ~stage.strikes,
        arrived=search.arrived | ends,
        impacts=search.impacts + stage.strikes.astype(jnp.int32),
        bracket=bracket,
        log=log,
    )


def _write_leg(log: LegLog, slot: Array, leg: LegLog) -> LegLog:
    """The log with a leg written into the slots, of some legs and bodies, that are flagged."""
    new = jax.tree.map(lambda leaf: leaf[None], leg)
    # `on` has an axis of points between those of legs and bodies
    flags = lambda logged: logged._replace(leg=logged.leg._replace(on=slot))  # noqa: E731
    written = choose_lanes(slot, flags(new), flags(log))
    on = jnp.where(slot[:, None], new.leg.on, log.leg.on)
    return written._replace(leg=written.leg._replace(on=on))


def _bracket_impact(
    kinds: tuple[ContactKind, ...], on: Array, path: tuple[Particles, Particles], t: Time, rest: Array, tries: Array
) -> tuple[Bracket, Array]:
    """Which bodies that tried the rest of a step met a surface on the way, and a bracket of the time of the first impact.

    All points count then that do not rest, not only those whose cubic dips: a point that turns fast leaves its cubic.
    """
    like = jax.eval_shape(lambda: find_dips(kinds, on, *path, t, rest))
    none = Dip(*(jnp.full(leaf.shape, jnp.inf, leaf.dtype) for leaf in like))
    dip = lax.cond(any_lane(tries), lambda: find_dips(kinds, on, *path, t, rest), lambda: none)
    falls = dip.last <= 1
    hit = tries & jnp.any(falls, axis=0)
    last = jnp.min(dip.last, axis=0)
    first = jnp.min(jnp.where(falls, dip.first, jnp.inf), axis=0)
    # the guard's values at the ends of the bracket are those of the point that falls first
    soonest = falls & (dip.last == last[None])
    above, below = (jnp.min(jnp.where(soonest, part, jnp.inf), axis=0) for part in (dip.above, dip.below))
    tiny = float(jnp.finfo(rest.dtype).tiny)
    # strictly of opposite signs: a guess of zero would divide by zero below
    above, below = jnp.maximum(jnp.where(hit, above, 1.0), tiny), jnp.minimum(jnp.where(hit, below, -1.0), -tiny)
    low, high = jnp.where(hit, first, 0.0) * rest, jnp.where(hit, jnp.minimum(last, 1.0), 1.0) * rest
    share = jnp.where(high > low, below / (below - above), 0.0)
    return Bracket(high, low, below, above, share), hit
