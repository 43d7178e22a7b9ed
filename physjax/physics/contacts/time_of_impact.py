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

from physjax.backend import any_lane, apart, on_flagged
from physjax.loops import Time, now
from physjax.particles import Particles
from physjax.physics.contacts.resting import Held, carried, hold, nothing_held
from physjax.physics.contacts.restitution import rebound
from physjax.roots import first_root
from physjax.scene import Scene, traced_once
from physjax.vectors import dot

IMPACTS = 8
"""Touches that one lane may have within one step; after so many it stays where it is, with its velocity, until the next."""
SHORTEST_FLIGHT = 0.25
"""A bounce whose flight would be shorter than this share of the step is the last: what would follow is summed."""


@traced_once
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
    walls = _walls(scene)
    since = tuple(wall.touching_since for wall in walls)
    # a lane that is lost rests nowhere: the others must not take another path, in other roundings, because of it
    anywhere = any_lane(jnp.any(jnp.isfinite(jnp.stack(since)), axis=0) & scene.finite(scene.state))
    # a branch also keeps the step apart from what reads it: XLA would compute it again in every reader
    end, since = lax.cond(
        anywhere,
        lambda: _held_step(motion, scene, since, anywhere, t, dt),
        lambda: (motion(scene, t, dt).state, since),
    )
    meets = _may_meet(scene, since, end, now(t), dt)
    if scene.held is not None:
        meets = meets & ~scene.held
    others = (meets, scene, t, dt)
    cut, masks = scene.may_be_cut(), scene.lane_mask(others)
    end, since = on_flagged(partial(_through_touches, motion), meets, (end, since), *others, masks=masks, cut=cut)
    return scene.having(state=end, contacts=_remembered(scene.contacts, list(since)))


def _held_step(
    motion: Callable, scene: Scene, since: tuple, anywhere: Array, t: Time, dt: ArrayLike
) -> tuple[Particles, tuple]:
    """A step in which surfaces hold some lanes."""
    walls = _walls(scene)
    start = apart(anywhere, lambda: hold(scene, walls, since, t, dt), nothing_held(scene, walls, since))
    return motion(carried(scene, walls, start), t, dt).state, start.since


def _may_meet(scene: Scene, since: tuple, end: Particles, t: ArrayLike, dt: ArrayLike) -> Array:
    """Lanes that may meet something within the step: cheap, and never wrong about one that does not."""
    scene, since, end = lax.stop_gradient((scene, since, end))
    flags, since = [], list(since)
    for contact in scene.contacts:
        if contact.response is impact:
            touching = [jnp.isfinite(since.pop(0)) for _ in contact.walls()]
            flags.append(contact.may_meet(touching, t, dt, scene.state, end))
    return jnp.any(jnp.stack(flags), axis=0)


class _Leg(NamedTuple):
    """How far each lane has come in a step: the time so far, its state, since when it touches what, whether it is through."""

    elapsed: Array
    state: Particles
    since: tuple[Array, ...]
    arrived: Array


def _through_touches(
    motion: Callable, changing: tuple[Particles, tuple], meets: Array, scene: Scene, t: Time, dt: ArrayLike
) -> tuple[Particles, tuple]:
    """The step again, leg by leg from touch to touch, of lanes that may meet something; the others are where they arrived."""
    leg, dt = _beginning(scene, dt)
    state, since = chosen(meets, (leg.state, leg.since), changing)
    leg = leg._replace(state=state, since=since, arrived=~meets)

    def go_on(leg, _):
        more = any_lane(~leg.arrived)
        return lax.cond(more, lambda: chosen(leg.arrived, leg, _leg(motion, scene, leg, t, dt)), lambda: leg), None

    leg, _ = lax.scan(go_on, leg, length=IMPACTS + 1)
    return _waited(scene, leg, t, dt), leg.since


def _waited(scene: Scene, leg: _Leg, t: Time, dt: Array) -> Particles:
    """The lanes after a step; those that waited in it where a surface has moved over them are not finite any more."""

    def lost():
        begun = t + leg.elapsed
        return ~leg.arrived & passed_over(
            _faces(_walls(scene), now(begun), leg.state), now(begun), now(t + dt), leg.state
        )

    return without(apart(~leg.arrived, lost), leg.state)


def passed_over(surfaces: list, begun: Array, ended: Array, state: Any) -> Bool[Array, "*lanes"]:
    """Whether a surface moves over a lane that stays where it is from one moment [s] to another."""
    x = lax.stop_gradient(state.position)
    rounding = 64 * float(jnp.finfo(x.dtype).eps) * jnp.sqrt(dot(x, x))
    over = jnp.zeros(rounding.shape, bool)
    for surface in surfaces:
        before, after = (lax.stop_gradient(surface.clearance(t, state)) for t in (begun, ended))
        over = over | ((after < -rounding) & (after < before - rounding))
    return over


def without(lost: Bool[Array, "*lanes"], state: Any) -> Any:
    """The state with NaN in the lanes that are lost: their status tells, and they harm no other."""
    return jax.tree.map(lambda leaf: jnp.where(lost[..., None], jnp.nan, leaf), state)


def _beginning(scene: Scene, dt: ArrayLike) -> tuple[_Leg, Array]:
    """Where the first leg of a step begins, and the step of each lane."""
    dt = jnp.broadcast_to(dt, scene.state.lanes)
    since = tuple(wall.touching_since for wall in _walls(scene))
    return _Leg(jnp.zeros_like(dt), scene.state, since, jnp.zeros(dt.shape, bool)), dt


def _begun(scene: Scene, leg: _Leg, t: Time, dt: Array) -> tuple[Time, Array, Held]:
    """When a leg begins, how much of the step is left, and what carries each lane through it."""
    walls, begun, rest = _walls(scene), t + leg.elapsed, jnp.maximum(dt - leg.elapsed, hair(dt))
    here = scene.having(state=leg.state)
    start = apart(~leg.arrived, lambda: hold(here, walls, leg.since, begun, rest), nothing_held(here, walls, leg.since))
    return begun, rest, start


def _leg(motion: Callable, scene: Scene, leg: _Leg, t: Time, dt: Array) -> _Leg:
    """From where the lanes are to the first touch of each, or to the end of the step."""
    walls, going = _walls(scene), ~leg.arrived
    begun, rest, start = _begun(scene, leg, t, dt)
    held = carried(scene, walls, start)
    end = apart(going, lambda: motion(held, begun, rest).state, leg.state)
    meeting = apart(going, lambda: _next_meeting(scene, start, end, now(begun), rest))
    through = _Leg(leg.elapsed + rest, end, start.since, jnp.ones_like(leg.arrived))

    def touch():
        duration = jnp.maximum(_moment(motion, held, start, meeting, begun, rest), hair(dt))
        touched = begun + duration
        at = apart(meeting.hit, lambda: motion(held, begun, duration).state, leg.state)
        state, since = apart(
            meeting.hit, lambda: _answer(held, start, meeting, begun, touched, at, dt), (leg.state, leg.since)
        )
        return chosen(meeting.hit, _Leg(leg.elapsed + duration, state, since, leg.arrived), through)

    return lax.cond(any_lane(meeting.hit), touch, lambda: through)


class Flight(NamedTuple):
    """A leg of a step, from one touch to the next, as it was flown.

    `before` is the state that the touch before it left, `scene` begins with what the surfaces made of that and carries
    their reactions; `begun` [s] and `duration` [s] are of each lane; `end` is where the method came, `after` what the
    touch there made of it. Lanes that are not `flying` had arrived before.
    """

    before: Particles
    scene: Scene
    begun: Time
    duration: Array
    end: Particles
    after: Particles
    flying: Bool[Array, "*lanes"]


def flights(motion: Callable, scene: Scene, t: Time, dt: ArrayLike, add: Callable, total: Any) -> Any:
    """The legs of the step that `impact` takes, told one by one: `total = add(total, flight)`, folded over them.

    Returns the total and the state after the step.
    """
    leg, dt = _beginning(scene, dt)

    def fly(leg, total):
        begun, _, start = _begun(scene, leg, t, dt)
        held = carried(scene, _walls(scene), start)
        after = chosen(leg.arrived, leg, _leg(motion, scene, leg, t, dt))
        duration = jnp.maximum(after.elapsed - leg.elapsed, hair(dt))
        end = motion(held, begun, duration).state
        return after, add(total, Flight(leg.state, held, begun, duration, end, after.state, ~leg.arrived))

    def go_on(carry, _):
        return lax.cond(any_lane(~carry[0].arrived), fly, lambda *carry: carry, *carry), None

    (leg, total), _ = lax.scan(go_on, (leg, total), length=IMPACTS + 1)
    return total, _waited(scene, leg, t, dt)


def hair(dt: Array) -> Array:
    """The shortest stretch of time: none is quite zero, so that a mean over it is still a mean."""
    return float(jnp.finfo(dt.dtype).eps) * dt


def _answer(
    scene: Scene, start: Held, meeting: "_Meeting", begun: Time, t: Time, at: Particles, dt: Array
) -> tuple[Particles, tuple]:
    """State and memory after the touches: a bounce, coming to rest, or the end of a slide."""
    walls, acceleration, t = _walls(scene), scene.acceleration(t, at), now(t)
    faces = _faces(walls, now(begun), start.state)
    guards = jnp.stack(_guards(faces, walls, start, meeting, t, at))
    which = jnp.argmin(guards, axis=0)
    # a path that only just misses, though the cubic touched, goes on as it was
    eps = float(jnp.finfo(at.dtype).eps)
    reached = 64 * eps * jnp.sqrt(dot(at.position, at.position)) + eps**0.5 * (meeting.above - meeting.below)
    touches = meeting.hit & (jnp.min(guards, axis=0) <= lax.stop_gradient(reached))
    state, since = at, list(start.since)
    # one guard a lane: each answer starts from the same state, and is taken where it applies
    for i, wall in enumerate(faces):
        here = touches & (which == i)
        normal, relative = wall.outward(t, at.position), wall.relative(at.velocity)
        inward = jnp.where(here, jnp.minimum(dot(relative, normal), 0.0), 0.0)
        lift = wall.restitution * -inward
        weight = -(dot(acceleration, normal) + wall.bend(t, at.position, relative))
        rests = here & (2 * lift <= SHORTEST_FLIGHT * dt * weight) & ((wall.restitution < 1) | (lift == 0))
        touch = (wall.gap(t, at.position), normal, relative)
        state = chosen(here, rebound(wall, at, touch, inward, rests), state)
        flights = 2 * lift / jnp.where(rests & (lift > 0), weight * (1 - wall.restitution), 1.0)
        since[i] = jnp.where(rests, t + flights, since[i])
    slides = [i for i, slip in enumerate(start.slip) if slip is not None]
    for guard, i in enumerate(slides, start=len(walls)):
        relative, before = walls[i].relative(at.velocity), walls[i].relative(start.state.velocity)
        slowed = dot(relative, relative) < 0.25 * dot(before, before)  # else it only turned
        stopped = Particles(at.position, at.velocity - relative)
        state = chosen(touches & (which == guard) & slowed, stopped, state)
    bounced, kick = touches & (which < len(walls)), dot(acceleration, acceleration) * (dt * dt)
    for i, wall in enumerate(walls):
        # a bounce elsewhere throws a lane off what it touched, or into it: then that is a new touch
        since[i] = jnp.where(bounced & (which != i) & _leaves(wall, t, state, kick), jnp.inf, since[i])
    return state, tuple(since)


class _Meeting(NamedTuple):
    """Which lanes meet something within a leg, and between which shares of it; how far above and below zero its guard is.

    A guard is a number that is positive until something happens: the gap to a surface, or the speed of a slide along
    the direction it had. `watched` says which guards may end the leg; the others are not looked at.
    """

    hit: Bool[Array, "*lanes"]
    first: Array
    last: Array
    above: Array
    below: Array
    watched: tuple[Array, ...]


def _next_meeting(scene: Scene, start: Held, end: Particles, t: ArrayLike, dt: ArrayLike) -> _Meeting:
    """What the path from start to end meets, judged by the cubic through its ends; few operations, since every lane pays."""
    scene, start, end = lax.stop_gradient((scene, start, end))
    walls, dips = _walls(scene), []
    for face, pressed in zip(_faces(walls, t, start.state), start.pressed, strict=True):
        dip = dip_of(face, t, dt, start.state, end)
        dips.append(dip._replace(last=jnp.where(pressed > 0, jnp.inf, dip.last)))
    for wall, slip in zip(walls, start.slip, strict=True):
        if slip is not None:
            before, after = (dot(wall.relative(state.velocity), slip) for state in (start.state, end))
            last = jnp.where((before > 0) & (after <= 0), 1.0, jnp.inf)
            dips.append(Dip(jnp.zeros_like(last), last, before, after))
    last = jnp.min(jnp.stack([dip.last for dip in dips]), axis=0)
    first = jnp.min(jnp.stack([jnp.where(dip.last <= 1, dip.first, jnp.inf) for dip in dips]), axis=0)
    above, below = jnp.zeros_like(last), jnp.zeros_like(last)
    for dip in dips:
        above = jnp.where(dip.last == last, dip.above, above)
        below = jnp.where(dip.last == last, dip.below, below)
    return _Meeting(last <= 1, first, last, above, below, tuple(dip.last <= 1 for dip in dips))


class Dip(NamedTuple):
    """Where a gap goes below zero within a leg: after the share `first`, before `last` (infinite: nowhere), and how deep."""

    first: Array
    last: Array
    above: Array
    below: Array


def dip_of(face: eqx.Module, t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles) -> Dip:
    """The first dip of the gap, as the cubic d(s) = d₀ + r s + b s² + a s³ through the ends of the leg has it."""
    d0, d1 = face.gap(t, start.position), face.gap(t + dt, end.position)
    r0 = dt * dot(face.relative(start.velocity), face.outward(t, start.position))
    r1 = dt * dot(face.relative(end.velocity), face.outward(t + dt, end.position))
    b, a = 3 * (d1 - d0) - 2 * r0 - r1, r0 + r1 - 2 * (d1 - d0)
    cubic = lambda s: d0 + s * (r0 + s * (b + s * a))  # noqa: E731
    root = jnp.sqrt(jnp.maximum(b * b - 3 * a * r0, 0.0))
    # the quotient that does not cancel; where its denominator is zero the value is infinite and not taken
    lowest = jnp.where(b > 0, -r0 / (b + root), (root - b) / (3 * a))
    highest = jnp.where(b < 0, r0 / (root - b), -(root + b) / (3 * a))
    lowest, depth = face.deepest(t, dt, start, end, (lowest, cubic(lowest)))
    last = jnp.where(d1 < 0, 1.0, jnp.inf)
    last = jnp.where((lowest > 0) & (lowest < 1) & (depth < 0), lowest, last)
    last = jnp.where((d0 < 0) & (r0 < 0), 0.0, last)
    # a lane that just bounced is at zero now as well; behind a part of its way up only the next touch is left
    bounced = (d0 <= float(jnp.finfo(d0.dtype).eps) ** 0.5 * r0) & (r0 > 0) & (highest > 0) & (highest < last)
    first = jnp.where(bounced, 0.1 * highest, 0.0)
    below = jnp.where(last == 1.0, d1, depth)
    return Dip(first, last, jnp.where(first > 0, cubic(first), d0), below)


def _guards(faces: list, walls: tuple, start: Held, meeting: _Meeting, t: ArrayLike, state: Particles) -> list[Array]:
    """The guards of a leg at a moment; those not watched are infinite. The faces are those seen when the leg begins.

    Later a slab that moves may have gone past the place where the lane began.
    """
    values = [face.gap(t, state.position) for face in faces]
    for wall, slip in zip(walls, start.slip, strict=True):
        if slip is not None:
            values.append(dot(wall.relative(state.velocity), slip))
    return [jnp.where(seen, value, jnp.inf) for seen, value in zip(meeting.watched, values, strict=True)]


def _moment(motion: Callable, scene: Scene, start: Held, meeting: _Meeting, begun: Time, rest: Array) -> Array:
    """When the first guard reaches zero on the method's own path [s after `begun`]; differentiable."""
    meeting, rest = lax.stop_gradient((meeting, rest))

    def nearest(duration, scene, start, meeting, begun):
        state, walls = motion(scene, begun, duration).state, _walls(scene)
        faces = _faces(walls, now(begun), start.state)
        return jnp.min(jnp.stack(_guards(faces, walls, start, meeting, now(begun + duration), state)), axis=0)

    bracket = (meeting.first * rest, jnp.minimum(meeting.last, 1.0) * rest)
    tolerance = 4 * float(jnp.finfo(rest.dtype).eps) * rest
    search = (bracket, (meeting.above, meeting.below), meeting.hit, tolerance)
    return first_root(nearest, (scene, start, meeting, begun), search)


def _walls(scene: Scene) -> tuple:
    """The surfaces that answer at the moment of impact, rooms taken apart."""
    return tuple(wall for contact in scene.contacts if contact.response is impact for wall in contact.walls())


def _faces(walls: tuple, t: ArrayLike, state: Particles) -> list:
    """The surfaces as each lane sees them from where it is: of a slab, the nearer face."""
    return [wall.facing(t, state.position) for wall in walls]


def _leaves(wall: eqx.Module, t: ArrayLike, state: Particles, kick: Array) -> Array:
    """Whether a lane is moving off a surface, or into it, by more than rounding of its speed and of a step's `kick`²."""
    relative, eps = wall.relative(state.velocity), float(jnp.finfo(state.dtype).eps)
    normal_speed = dot(relative, wall.outward(t, state.position))
    return normal_speed * normal_speed > eps * dot(relative, relative) + (16 * eps) ** 2 * kick


def _remembered(contacts: tuple, since: list) -> tuple:
    """The contacts with their memory of who touches them."""
    return tuple(
        contact.remembering([since.pop(0) for _ in contact.walls()]) if contact.response is impact else contact
        for contact in contacts
    )


def chosen(flag: Array, a: Any, b: Any) -> Any:
    """Lane by lane a where flagged, else b, for trees of numbers and vectors."""
    pick = lambda x, y: jnp.where(flag if x.ndim == flag.ndim else flag[..., None], x, y)  # noqa: E731
    return jax.tree.map(pick, a, b)
