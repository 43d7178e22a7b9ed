"""Reactions and impacts at the contact points of bodies: what a leg of a step begins with, and what it ends with.

Points that stay through a leg get half of the reaction's impulse at its start and half at its end, as RATTLE does (H. C.
Andersen 1983): second order in dt whatever the method, and neither a rolling ball nor a box on a slope creeps. Both
halves, and the impulses of an impact, are one problem with different numbers, which stands here once.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool

from physjax.backend import materialise, materialise_where
from physjax.loops import Time, to_float_time
from physjax.particles import Particles
from physjax.physics.contacts.legs import SHORTEST_FLIGHT_SHARE, Motion, Tree, choose_lanes
from physjax.physics.rigid.impulses import Impact, Points, apply_contact_impulses
from physjax.physics.rigid.inertia import Inertia
from physjax.physics.rigid.mobility import Mobility
from physjax.physics.rigid.point_contacts import (
    ContactKind,
    ContactPointState,
    find_resting_points,
    find_touching_points,
    gather_point_states,
)
from physjax.physics.rigid.spatial import RigidBodies, WholeWrench
from physjax.scene import Scene
from physjax.vectors import cross, dot, norm, scale

BODY_AT_REST_SPEED_SHARE = 1e-6
"""Share of the speed that a step's load gives below which a body that is held at rest keeps its place to the last bit."""

Thrust = tuple[Array, Array]
"""Force [N] and torque [N m] of the reactions on each body, constant through a leg."""


class Leg(NamedTuple):
    """A leg of a step as it began: the bodies, the reactions through it, which points stay, and which bodies are at rest.

    `load_speed` [m/s] is what the loads give in a whole step: the measure of small speeds and distances.
    """

    before: RigidBodies
    thrust: Thrust
    on: Bool[Array, "points *lanes"]
    rests: Bool[Array, "*lanes"]
    load_speed: Array


class Stage(NamedTuple):
    """What the impulses at each body are for, in flags per lane: a leg begins, or ends without an impact, or with one."""

    begins: Bool[Array, "*lanes"]
    arrives: Bool[Array, "*lanes"]
    strikes: Bool[Array, "*lanes"]


class Place(NamedTuple):
    """Bodies at a time t, how easily they are moved there, and their points at the surfaces."""

    t: Time
    state: RigidBodies
    mobility: Mobility
    points: ContactPointState

    @classmethod
    def find(cls, kinds: tuple[ContactKind, ...], t: Time, state: RigidBodies, inertia: Inertia) -> "Place":
        """Where bodies are at a time t."""

        def measure() -> tuple[Mobility, tuple[Array, Array]]:
            mobility = Mobility.of(state, inertia)
            return mobility, mobility.velocities(state)

        # stored, or every component of every point would compute both again, and every reader of a point all of it
        time = to_float_time(t)
        mobility, velocities = materialise(time, measure)
        points = materialise(time, lambda: gather_point_states(kinds, t, state, velocities))
        return cls(t, state, mobility, points)


class Meeting(NamedTuple):
    """What impulses at the points made of bodies: as a leg begins its reactions, as it ends the bodies after it.

    `held` are those that arrive, with the `center` of each point; `struck` are those that had an impact.
    """

    leg: Leg
    held: RigidBodies
    center: Particles
    struck: RigidBodies


def start_leg(state: RigidBodies, points: int) -> Leg:
    """A leg of which nothing is known yet but where the bodies are."""
    zero = jnp.zeros(state.lanes, state.dtype)
    thrust = (jnp.zeros_like(state.momentum), jnp.zeros_like(state.momentum))
    return Leg(state, thrust, jnp.zeros((points, *state.lanes), bool), jnp.zeros(state.lanes, bool), zero)


def take_shared_number(scene: Scene, number: Tree) -> Tree:
    """A number of each body, or of each scene where bodies are coupled: an adaptive method then wants one step for all."""
    return jax.tree.map(lambda leaf: leaf[..., 0], number) if scene.couples else number


def move_with_reactions(motion: Motion, scene: Scene, leg: Leg, t: Time, h: Array) -> RigidBodies:
    """The motion for a time h [s] that begins with half of the reactions' impulse."""
    start = scene.replace(state=apply_half_impulse(leg.before, leg.thrust, h))
    return motion(start, t, take_shared_number(scene, h)).state


def apply_half_impulse(state: RigidBodies, thrust: Thrust, h: Array) -> RigidBodies:
    """The bodies with half of the reactions' impulse in a time h [s]."""
    x, q, p, spin = state
    return RigidBodies(x, q, p + scale(h / 2, thrust[0]), spin + scale(h / 2, thrust[1]))


def exchange_impulses(scene: Scene, leg: Leg, stage: Stage, here: Place, times: tuple[Array, Array]) -> Meeting:
    """The impulses at the points of bodies that are `here`, in a step dt of which a time is left (`times`) [s].

    As a leg begins they are what keeps the points from going in by its middle; half of the reaction. As it ends they are
    whatever keeps them from going in now: that half is solved again and is not the first.
    """
    state, point_state, (dt, rest) = here.state, here.points, times
    load = state.generalised_force(scene, here.t)
    # what stays and what touches are choices, which have no derivatives
    measured = lax.stop_gradient((point_state, state))
    load_speed = jnp.where(
        stage.begins, lax.stop_gradient(dt * norm(load[0]) * here.mobility.inverse_mass), leg.load_speed
    )
    on = jnp.where(stage.begins[None], find_resting_points(*measured, load_speed, dt), leg.on)
    touching = find_touching_points(*measured, load_speed, dt)
    active = jnp.where(stage.strikes[None], touching, on & (stage.begins | stage.arrives)[None])
    ahead = jnp.where(stage.begins, rest / 2, 0.0)

    def solve() -> Impact:
        points = _advance_points(here, load, ahead)
        restitution = _find_restitution(point_state, stage.strikes, load_speed)
        return apply_contact_impulses(points, active, state, here.mobility, restitution, stage.strikes)

    zero = jnp.zeros_like(state.momentum)
    impact = materialise_where(active, solve, Impact(state, jnp.zeros_like(point_state.signed_distance), (zero, zero)))
    gained = impact.bodies.momentum - state.momentum, impact.bodies.angular_momentum - state.angular_momentum
    thrust = choose_lanes(stage.begins, (scale(2 / rest, gained[0]), scale(2 / rest, gained[1])), leg.thrust)
    leg = Leg(leg.before, thrust, on, leg.rests, load_speed)
    held, center = _push_out(leg, impact, here)
    # by energy, which sees rotation as well; at both ends, so that a body that turns back is not taken for one at rest
    slow = scene.mass.mass * (BODY_AT_REST_SPEED_SHARE * load_speed) ** 2
    ends = choose_lanes(stage.begins, (state.momentum, state.angular_momentum), (held.momentum, held.angular_momentum))
    slow = 2 * here.mobility.kinetic_energy(RigidBodies(*state[:2], *ends)) <= slow
    still = leg.before.hold_lanes(jnp.zeros_like(load_speed))
    some = jnp.any(on, axis=0)
    held = choose_lanes(some, choose_lanes(leg.rests & slow, still, held), state)
    return Meeting(leg._replace(rests=jnp.where(stage.begins, slow, leg.rests)), held, center, impact.bodies)


def _advance_points(here: Place, load: WholeWrench, ahead: Array) -> Points:
    """The points with the velocities that they will have a time `ahead` [s].

    A point's acceleration is that of the free body: a + ω̇ × r + ω × (velocity of r). On curved ground the normal turns
    as well, which adds ṅ·v along it.
    """
    _, state, mobility, point_state = here
    points, (force, torque) = point_state.points, load
    _, omega = mobility.velocities(state)
    change = mobility.turn(torque - cross(omega, state.angular_momentum))
    spread = lambda vector: jnp.broadcast_to(vector, points.arm.shape)  # noqa: E731
    # the point of a rolling ball that touches is always another: only the center of the radius turns with the body
    moves = cross(spread(omega), point_state.center.position - spread(state.position))
    if point_state.turning is not None:
        # over curved ground the point that touches moves around that center as the normal turns
        turning, radius = point_state.turning
        moves = moves - scale(radius, turning)
    faster = (
        spread(scale(mobility.inverse_mass, force)) + cross(spread(change), points.arm) + cross(spread(omega), moves)
    )
    if point_state.turning is not None:
        turning, _ = point_state.turning
        faster = faster + scale(dot(turning, points.velocity), points.normal)
    if point_state.carried_rate is not None:
        # a surface that turns is faster further out, where the point that touches will be
        faster = faster - point_state.carried_rate
    return points._replace(velocity=points.velocity + scale(jnp.broadcast_to(ahead, faster.shape[:-1]), faster))


def _find_restitution(point_state: ContactPointState, strikes: Array, load_speed: Array) -> Array:
    """K_r of each point in an impact; a point whose next flight would be shorter than a share of the step bounces no more."""
    lift = -point_state.restitution * dot(point_state.points.velocity, point_state.points.normal)
    last = (2 * lift <= SHORTEST_FLIGHT_SHARE * load_speed[None]) & (point_state.restitution < 1)
    return jnp.where(strikes[None] & ~last, point_state.restitution, 0.0)


def _push_out(leg: Leg, impact: Impact, here: Place) -> tuple[RigidBodies, Particles]:
    """The bodies after the impulses, put onto what carries them, and the centers of their points then."""
    held, (faster, spun), center = impact.bodies, impact.change, here.points.center
    shift = _find_penetration(here.points, leg.on & (impact.push > 0))
    spread = lambda vector: jnp.broadcast_to(vector, center.position.shape)  # noqa: E731
    turned = cross(spread(spun), center.position - spread(held.position))
    center = Particles(center.position - spread(shift), center.velocity + spread(faster) + turned)
    return held._replace(position=held.position - shift), center


def _find_penetration(point_state: ContactPointState, pressed: Array) -> Array:
    """The truncation error of the step by which the lowest of the points that press is on the wrong side [m]."""
    # at the lowest point alone: moving out at every corner of a box on its face would lift it several times
    distance = jnp.where(pressed, point_state.signed_distance, jnp.inf)
    here = pressed & (distance == jnp.min(distance, axis=0, keepdims=True))
    count = jnp.maximum(jnp.sum(here, axis=0, keepdims=True), 1).astype(distance.dtype)
    return jnp.sum(scale(jnp.where(here, point_state.signed_distance, 0.0) / count, point_state.points.normal), axis=0)
