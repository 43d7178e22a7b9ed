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

from physjax.backend import any_lane, apart
from physjax.loops import Time, now
from physjax.particles import Particles
from physjax.physics.contacts.time_of_impact import (
    IMPACTS,
    SHORTEST_FLIGHT,
    Dip,
    Flight,
    chosen,
    dip_of,
    hair,
    passed_over,
    without,
)
from physjax.physics.rigid.impulses import Points, impulses
from physjax.physics.rigid.spatial import RigidBodies, angular_acceleration, angular_velocity
from physjax.roots import first_root
from physjax.scene import Scene, traced_once
from physjax.vectors import cross, dot, norm, scale

SLOW = 0.1
"""Share of the speed that a step's load gives below which a point that touches stays, neither bouncing nor leaving."""
NEAR = 1e-3
"""Share of the way that a step's load gives below which a point touches."""
AT_REST = 1e-6
"""Share of that speed below which a whole body is at rest, if its reactions balance the load: then it keeps its place."""


class Felt(NamedTuple):
    """The points of hulls as their surfaces feel them, the points first: `center` is where the gap is measured from.

    `turning` is how fast the normal turns there [1/s], and the radius [m] of what touches; None where all is flat.
    """

    points: Points
    center: Particles
    gap: Array
    restitution: Array
    turning: tuple[Array, Array] | None


class _Leg(NamedTuple):
    """How far each body has come in a step: time so far [s], its state, whether it is through."""

    elapsed: Array
    state: RigidBodies
    arrived: Array


@traced_once
def collide(motion: Callable, scene: Scene, t: Time, dt: ArrayLike) -> Scene:
    """The response of rigid bodies: from impact to impact, at most 8 a body and step, and held in between.

    A body that would have more impacts in a step waits where it is, with its velocity, for the next; where a moving
    surface comes over it as it waits, it becomes NaN, which its status tells. An impact after which a point would fly
    for less than a quarter of a step is the last, where K_r < 1. Coupled bodies share their step, which cannot be cut
    for one of them: they are held alike, but impacts are answered at its end, and a body that has passed through a ball
    by then becomes NaN.
    """
    leg, dt = _beginning(scene, dt)
    if scene.couples:
        return scene.having(state=_answered_at_the_end(motion, scene, t, dt))

    @jax.checkpoint  # reverse mode takes each leg again: what it would remember of one is more than the work
    def further(leg):
        return chosen(leg.arrived, leg, _leg(motion, scene, leg, t, dt))

    def go_on(leg, _):
        return lax.cond(any_lane(~leg.arrived), further, lambda leg: leg, leg), None

    leg, _ = lax.scan(go_on, leg, length=IMPACTS + 1)
    return scene.having(state=_waited(scene, leg, t, dt))


def collisions(motion: Callable, scene: Scene, t: Time, dt: ArrayLike, add: Callable, total: Any) -> Any:
    """The legs of the step that `collide` takes, told one by one as by `impact.flights`: what held the bodies is in them.

    Each begins with half of what the surfaces give through it; `after` is what the other half and the impact made of its
    end. Returns the total and the state after the step.
    """
    leg, dt = _beginning(scene, dt)

    def flown(here, thrust, begun, duration, after, flying):
        start = here.having(state=_pushed(here.state, thrust, duration))
        end = motion(start, begun, _own(scene, duration)).state
        return Flight(here.state, start, _own(scene, begun), _own(scene, duration), end, after, flying)

    if scene.couples:
        thrust = _thrust(_facing(scene, t), _on_now(_facing(scene, t), t, dt), t, dt)
        after = _answered_at_the_end(motion, scene, t, dt)
        begun = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, dt.shape), t)
        return add(total, flown(scene, thrust, begun, dt, after, None)), after

    def fly(leg, total):
        begun, rest = _left(leg, t, dt)
        here = scene.having(state=leg.state)
        seen = _facing(here, begun)
        thrust = _thrust(seen, _on_now(seen, begun, dt) & ~leg.arrived[None], begun, rest)
        after = chosen(leg.arrived, leg, _leg(motion, scene, leg, t, dt))
        duration = jnp.maximum(after.elapsed - leg.elapsed, hair(dt))
        return after, add(total, flown(here, thrust, begun, duration, after.state, ~leg.arrived))

    def go_on(carry, _):
        return lax.cond(any_lane(~carry[0].arrived), fly, lambda *carry: carry, *carry), None

    (leg, total), _ = lax.scan(go_on, (leg, total), length=IMPACTS + 1)
    return total, _waited(scene, leg, t, dt)


def _beginning(scene: Scene, dt: ArrayLike) -> tuple[_Leg, Array]:
    """Where the first leg of a step begins, and the step of each body."""
    dt = jnp.broadcast_to(dt, scene.state.lanes)
    arrived = jnp.zeros(dt.shape, bool) if scene.held is None else scene.held
    return _Leg(jnp.zeros_like(dt), scene.state, arrived), dt


def _left(leg: _Leg, t: Time, dt: Array) -> tuple[Time, Array]:
    """When a leg begins, and how much of the step is left."""
    return t + leg.elapsed, jnp.maximum(dt - leg.elapsed, hair(dt))


def _own(scene: Scene, number: Any) -> Any:
    """A number of each body; coupled ones share theirs, and a method that chooses its own steps may ask."""
    return jax.tree.map(lambda leaf: leaf[..., 0], number) if scene.couples else number


def _leg(motion: Callable, scene: Scene, leg: _Leg, t: Time, dt: Array) -> _Leg:
    """From where the bodies are to the first impact of each, or to the end of the step."""
    (begun, rest), going = _left(leg, t, dt), ~leg.arrived
    here = _facing(scene.having(state=leg.state), begun)
    kick = _kick(here, begun, dt)
    felt = lax.stop_gradient(felt_by(here, begun, leg.state))
    on = _on(felt, leg.state, kick, dt) & going[None]
    thrust = _thrust(here, on, begun, rest)
    end = apart(going, lambda: _carried(motion, here, thrust, begun, rest), leg.state)
    held = apart(on, lambda: _landed(here, end, on, kick, begun + rest), end)
    through = _Leg(leg.elapsed + rest, held, jnp.ones_like(leg.arrived))
    dip = lax.stop_gradient(_dips(here, on, felt, felt_by(here, begun + rest, held), begun, rest))
    hit = going & jnp.any(dip.last <= 1, axis=0)

    def touch():
        duration = jnp.maximum(_moment(motion, here, (dip, hit, on), thrust, begun, rest), hair(dt))
        at = apart(hit, lambda: _carried(motion, here, thrust, begun, duration), leg.state)
        struck = _struck(here, at, hit, kick, begun + duration, dt)
        return chosen(hit, _Leg(leg.elapsed + duration, struck, leg.arrived), through)

    return lax.cond(any_lane(hit), touch, lambda: through)


def _waited(scene: Scene, leg: _Leg, t: Time, dt: Array) -> RigidBodies:
    """The bodies after a step; those that waited in it where a surface has moved over them are not finite any more."""

    def lost():
        begun = t + leg.elapsed
        seen = _facing(scene.having(state=leg.state), begun)
        return ~leg.arrived & passed_over(_touches(seen), now(begun), now(t + dt), leg.state)

    return without(apart(~leg.arrived, lost), leg.state)


def _answered_at_the_end(motion: Callable, scene: Scene, t: Time, dt: Array) -> RigidBodies:
    """The whole step held by what touches from its start; impacts answered at its end, and what went in moved out."""
    scene = _facing(scene, t)
    kick, on = _kick(scene, t, dt), _on_now(scene, t, dt)
    end = _carried(motion, scene, _thrust(scene, on, t, dt), t, dt)
    end = apart(on, lambda: _landed(scene, end, on, kick, t + dt), end)
    struck = _struck(scene, end, jnp.ones(dt.shape, bool), kick, t + dt, dt)
    for contact in _touches(scene):
        struck = contact.respond(now(t + dt), struck)
    if not any(contact.narrow for contact in _touches(scene)):
        return struck
    return without(_passed_through(scene, on, end, t, dt), struck)


def _passed_through(scene: Scene, on: Array, end: RigidBodies, t: Time, dt: Array) -> Array:
    """Which bodies have a point that went deep through an obstacle and out again within a step, unseen at its end."""
    start, end = lax.stop_gradient((felt_by(scene, t, scene.state), felt_by(scene, t + dt, end)))
    dip = _dips(scene, on, start, end, t, dt)
    # a step fine enough for an answer at its end only grazes what it does not see
    deep = dip.below < -0.1 * norm(end.center.position - start.center.position)
    return jnp.any((dip.last < 1) & (start.gap >= 0) & (end.gap >= 0) & deep, axis=0)


def _touches(scene: Scene) -> list:
    return [contact for contact in scene.contacts if contact.response is collide]


def _facing(scene: Scene, t: Time) -> Scene:
    """The scene with surfaces as its bodies see them from where they are: rooms taken apart, of a slab the nearer face."""
    seen = [
        wall.facing(now(t), scene.state) if contact.response is collide else wall
        for contact in scene.contacts
        for wall in (contact.walls() if contact.response is collide else (contact,))
    ]
    return scene.having(contacts=tuple(seen))


def _kick(scene: Scene, t: Time, dt: Array) -> Array:
    """The velocity that the loads give in a step [m/s]: what the smallness of speeds and gaps is measured by."""
    force, _ = scene.state.driven(scene, t)
    return lax.stop_gradient(dt * norm(force) / scene.mass.mass)


def felt_by(scene: Scene, t: Time, state: RigidBodies) -> Felt:
    """Every point of every hull, as its surface feels it."""
    parts = [contact.felt(now(t), state, scene.mass) for contact in _touches(scene)]
    if len(parts) > 1 and any(part.turning is not None for part in parts):
        flat = lambda part: (jnp.zeros_like(part.points.normal), jnp.zeros_like(part.gap))  # noqa: E731
        parts = [part._replace(turning=part.turning or flat(part)) for part in parts]
    if len(parts) > 1 and any(part.points.friction is not None for part in parts):
        zero = lambda part: (jnp.zeros_like(part.gap), jnp.zeros_like(part.gap))  # noqa: E731
        rough = [part.points._replace(friction=part.points.friction or zero(part)) for part in parts]
        parts = [part._replace(points=points) for part, points in zip(parts, rough, strict=True)]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


def _near(felt: Felt, state: RigidBodies, kick: Array, dt: Array) -> Array:
    """Which points touch: closer than a small share of a step's fall, or than rounding."""
    eps = float(jnp.finfo(state.dtype).eps)
    rounding = 64 * eps * (norm(felt.center.position) + dt[None] * norm(felt.center.velocity))
    return felt.gap <= (NEAR * kick * dt)[None] + rounding


def _on(felt: Felt, state: RigidBodies, kick: Array, dt: Array) -> Array:
    """Which points touch and stay: the others fly, or are about to strike."""
    speed = jnp.abs(dot(felt.points.velocity, felt.points.normal))
    rounding = 16 * float(jnp.finfo(state.dtype).eps) * norm(felt.center.velocity)
    return _near(felt, state, kick, dt) & (speed <= SLOW * kick[None] + rounding)


def _on_now(scene: Scene, t: Time, dt: Array) -> Array:
    """Which points touch and stay, at the scene's own state."""
    felt = lax.stop_gradient(felt_by(scene, t, scene.state))
    return _on(felt, scene.state, _kick(scene, t, dt), dt)


def _thrust(scene: Scene, on: Array, t: Time, h: Array) -> tuple[Array, Array]:
    """Force and torque of the reactions over a coming time h, of which the start gives h/2."""

    def pressed():
        start, state = _pressed(scene, scene.state, on, t, h / 2)[0], scene.state
        given = start.momentum - state.momentum, start.angular_momentum - state.angular_momentum
        return tuple(scale(2 / h, part) for part in given)

    return apart(on, pressed)


def _carried(motion: Callable, scene: Scene, thrust: tuple[Array, Array], t: Time, h: Array) -> RigidBodies:
    """The motion for a time h that begins with half of the reactions' impulse."""
    return motion(scene.having(state=_pushed(scene.state, thrust, h)), t, _own(scene, h)).state


def _pushed(state: RigidBodies, thrust: tuple[Array, Array], h: Array) -> RigidBodies:
    """The bodies with half of what the reactions give in a time h."""
    x, q, p, spin = state
    return RigidBodies(x, q, p + scale(h / 2, thrust[0]), spin + scale(h / 2, thrust[1]))


def _landed(scene: Scene, end: RigidBodies, on: Array, kick: Array, t: Time) -> RigidBodies:
    """The bodies after the other half, on what carries them; those at rest keep the place they had."""
    held, push = _pressed(scene, end, on, t, jnp.zeros_like(kick))
    held = _put_back(held, felt_by(scene, t, held), on & (push > 0))
    slow = scene.mass.mass * (AT_REST * kick) ** 2
    rests = jnp.all(jnp.stack([2 * s.kinetic_energy(scene.mass) <= slow for s in (scene.state, held)]), axis=0)
    still, some = scene.state.held(jnp.zeros_like(kick)), jnp.any(on, axis=0)
    return chosen(some & rests, still, chosen(some, held, end))


def _pressed(scene: Scene, state: RigidBodies, on: Array, t: Time, ahead: Array) -> tuple[RigidBodies, Array]:
    """The impulses that keep the points from going in, as their velocities will be a time `ahead` if nothing does."""
    felt, mass = felt_by(scene, t, state), scene.mass
    points = felt.points
    force, torque = state.driven(scene, t)
    omega, change = angular_velocity(state, mass), angular_acceleration(state, mass, torque)
    spread = lambda vector: jnp.broadcast_to(vector, points.arm.shape)  # noqa: E731
    # a ball touches ever other points of itself: what moves on a circle is the point in its middle
    moves = cross(spread(omega), felt.center.position - spread(state.position))
    if felt.turning is not None:
        # and over curved ground the point that touches moves around it as the normal turns
        turning, radius = felt.turning
        moves = moves - scale(radius, turning)
    faster = spread(scale(1 / mass.mass, force)) + cross(spread(change), points.arm) + cross(spread(omega), moves)
    if felt.turning is not None:
        faster = faster + scale(dot(turning, points.velocity), points.normal)
    velocity = points.velocity + scale(jnp.broadcast_to(ahead, on.shape), faster)
    return impulses(points._replace(velocity=velocity), on, state, mass)


def _put_back(state: RigidBodies, felt: Felt, pressed: Array) -> RigidBodies:
    """What the truncation of a step left between a body and what it presses on, taken away at its lowest point."""
    lowest = jnp.min(jnp.where(pressed, felt.gap, jnp.inf), axis=0)
    here = pressed & (felt.gap == lowest[None])
    share = jnp.where(here, felt.gap, 0.0) / jnp.maximum(jnp.sum(here, axis=0), 1).astype(felt.gap.dtype)[None]
    return state._replace(position=state.position - jnp.sum(scale(share, felt.points.normal), axis=0))


def _dips(scene: Scene, on: Array, start: Felt, end: Felt, t: Time, dt: Array) -> Dip:
    """Which points meet their surface within a leg, and between which shares of it, as the cubics of their gaps have it."""
    parts, first = [], 0
    for contact in _touches(scene):
        some = slice(first, first := first + contact.hull.points.shape[-2])
        lanes = start.gap[some].shape
        wide = [jnp.broadcast_to(number, lanes) for number in (now(t), dt)]
        ends = [jax.tree.map(lambda leaf, some=some: leaf[some], felt.center) for felt in (start, end)]
        parts.append(dip_of(contact, *wide, *ends))
    dip = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    return dip._replace(last=jnp.where(on, jnp.inf, dip.last))


def _moment(motion: Callable, scene: Scene, watched: tuple, thrust: tuple, begun: Time, rest: Array) -> Array:
    """When the first point reaches its surface on the method's own path [s after `begun`]; differentiable.

    Every point is looked at that nothing holds: one that turns fast may go in where its cubic has not foreseen it.
    """
    (dip, hit, on), rest = lax.stop_gradient((watched, rest))
    falls = dip.last <= 1

    def lowest(duration, scene, thrust, on, begun):
        state = _carried(motion, scene, thrust, begun, duration)
        return jnp.min(jnp.where(on, jnp.inf, felt_by(scene, begun + duration, state).gap), axis=0)

    last = jnp.min(dip.last, axis=0)
    first = jnp.min(jnp.where(falls, dip.first, jnp.inf), axis=0)
    soonest = falls & (dip.last == last[None])
    above, below = (jnp.min(jnp.where(soonest, part, jnp.inf), axis=0) for part in (dip.above, dip.below))
    bracket = (jnp.where(hit, first, 0.0) * rest, jnp.minimum(last, 1.0) * rest)
    tolerance = 4 * float(jnp.finfo(rest.dtype).eps) * rest
    above, below = jnp.where(hit, above, 1.0), jnp.where(hit, below, -1.0)
    return first_root(lowest, (scene, thrust, on, begun), (bracket, (above, below), hit, tolerance))


def _struck(scene: Scene, state: RigidBodies, hit: Array, kick: Array, t: Time, dt: Array) -> RigidBodies:
    """The bodies that are hit after the impact of all their points that touch."""
    felt = felt_by(scene, t, state)
    active = lax.stop_gradient(_near(felt, state, kick, dt)) & hit[None]
    lift = -felt.restitution * dot(felt.points.velocity, felt.points.normal)
    last = (2 * lift <= SHORTEST_FLIGHT * kick[None]) & (felt.restitution < 1)
    return apart(
        active,
        lambda: impulses(felt.points, active, state, scene.mass, jnp.where(last, 0.0, felt.restitution))[0],
        state,
    )
