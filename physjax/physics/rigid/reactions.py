"""Reactions of surfaces on the contact points of bodies that stay: half of their impulse at each end of a leg.

As RATTLE does (H. C. Andersen 1983): second order in dt whatever the method, and neither a rolling ball nor a box on a
slope creeps.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from physjax.backend import materialise_where
from physjax.loops import Time
from physjax.physics.contacts.legs import Motion, Tree, choose_lanes
from physjax.physics.rigid.impulses import apply_contact_impulses
from physjax.physics.rigid.point_contacts import ContactPointState, gather_point_states
from physjax.physics.rigid.spatial import RigidBodies, angular_acceleration, angular_velocity
from physjax.scene import Scene
from physjax.vectors import cross, dot, scale

BODY_AT_REST_SPEED_SHARE = 1e-6
"""Share of the speed that a step's load gives below which a body that is held at rest keeps its place to the last bit."""

Thrust = tuple[Array, Array]
"""Force [N] and torque [N m] of the reactions on each body, constant through a leg."""


def take_shared_number(scene: Scene, number: Tree) -> Tree:
    """A number of each body, or of each scene where bodies are coupled: an adaptive method then wants one step for all."""
    return jax.tree.map(lambda leaf: leaf[..., 0], number) if scene.couples else number


def solve_reactions(scene: Scene, on: Array, t: Time, h: Array) -> Thrust:
    """Force and torque of the reactions at points that stay (`on`), over a leg of length h [s].

    Their impulse in h/2 is what keeps the points from going in by the middle of the leg.
    """

    def solve():
        start, state = _solve_resting_impulses(scene, scene.state, on, t, h / 2)[0], scene.state
        push, turn = start.momentum - state.momentum, start.angular_momentum - state.angular_momentum
        return scale(2 / h, push), scale(2 / h, turn)

    return materialise_where(on, solve)


def move_with_reactions(motion: Motion, scene: Scene, thrust: Thrust, t: Time, h: Array) -> RigidBodies:
    """The motion for a time h [s] that begins with half of the reactions' impulse."""
    return motion(
        scene.replace(state=apply_half_impulse(scene.state, thrust, h)), t, take_shared_number(scene, h)
    ).state


def apply_half_impulse(state: RigidBodies, thrust: Thrust, h: Array) -> RigidBodies:
    """The bodies with half of the reactions' impulse in a time h [s]."""
    x, q, p, spin = state
    return RigidBodies(x, q, p + scale(h / 2, thrust[0]), spin + scale(h / 2, thrust[1]))


def finish_resting_leg(scene: Scene, end: RigidBodies, on: Array, load_speed: Array, t: Time) -> RigidBodies:
    """The bodies after the other half, put onto what carries them; those at rest keep the place they had.

    The second half is whatever keeps the points from going in now: it is solved again and is not the first.
    """
    held, push = _solve_resting_impulses(scene, end, on, t, jnp.zeros_like(load_speed))
    held = _correct_penetration(held, gather_point_states(scene, t, held), on & (push > 0))
    # by energy, which sees rotation as well; at both ends, so that a body that turns back is not taken for one at rest
    slow = scene.mass.mass * (BODY_AT_REST_SPEED_SHARE * load_speed) ** 2
    rests = jnp.all(jnp.stack([2 * s.kinetic_energy(scene.mass) <= slow for s in (scene.state, held)]), axis=0)
    still, some = scene.state.hold_lanes(jnp.zeros_like(load_speed)), jnp.any(on, axis=0)
    return choose_lanes(some & rests, still, choose_lanes(some, held, end))


def _solve_resting_impulses(
    scene: Scene, state: RigidBodies, on: Array, t: Time, ahead: Array
) -> tuple[RigidBodies, Array]:
    """The impulses that keep the points from going in, for their velocities a time `ahead` [s], and each normal impulse.

    A point's acceleration is that of the free body: a + ω̇ × r + ω × (velocity of r). On curved ground the normal turns
    as well, which adds ṅ·v along it.
    """
    point_state, mass = gather_point_states(scene, t, state), scene.mass
    points = point_state.points
    force, torque = state.generalised_force(scene, t)
    omega, change = angular_velocity(state, mass), angular_acceleration(state, mass, torque)
    spread = lambda vector: jnp.broadcast_to(vector, points.arm.shape)  # noqa: E731
    # the point of a rolling ball that touches is always another: only the center of the radius turns with the body
    moves = cross(spread(omega), point_state.center.position - spread(state.position))
    if point_state.turning is not None:
        # over curved ground the point that touches moves around that center as the normal turns
        turning, radius = point_state.turning
        moves = moves - scale(radius, turning)
    faster = spread(scale(1 / mass.mass, force)) + cross(spread(change), points.arm) + cross(spread(omega), moves)
    if point_state.turning is not None:
        turning, _ = point_state.turning
        faster = faster + scale(dot(turning, points.velocity), points.normal)
    velocity = points.velocity + scale(jnp.broadcast_to(ahead, on.shape), faster)
    return apply_contact_impulses(points._replace(velocity=velocity), on, state, mass)[:2]


def _correct_penetration(state: RigidBodies, point_state: ContactPointState, pressed: Array) -> RigidBodies:
    """The bodies moved out by the truncation error of the step, at the lowest of the points that press."""
    # at the lowest point alone: moving out at every corner of a box on its face would lift it several times
    lowest = jnp.min(jnp.where(pressed, point_state.signed_distance, jnp.inf), axis=0)
    here = pressed & (point_state.signed_distance == lowest[None])
    share = (
        jnp.where(here, point_state.signed_distance, 0.0)
        / jnp.maximum(jnp.sum(here, axis=0), 1).astype(point_state.signed_distance.dtype)[None]
    )
    return state._replace(position=state.position - jnp.sum(scale(share, point_state.points.normal), axis=0))
