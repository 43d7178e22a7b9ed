"""Points of bodies, in space and in the plane: where they are, how they move, and the torque of a force at one.

In the plane an angular velocity and a torque are numbers, anticlockwise, and a point of a body has two components.
"""

from typing import cast

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.checks import NestedArrayLike
from physjax.particles import Particles
from physjax.physics.rigid import spatial
from physjax.physics.rigid.inertia import Inertia
from physjax.physics.rigid.planar.bodies import PlanarBodies
from physjax.physics.rigid.planar_inertia import PlanarInertia
from physjax.physics.rigid.spatial import RigidBodies
from physjax.scene import Scene
from physjax.vectors import broadcast_vector, cross, scale, spin

Bodies = RigidBodies | PlanarBodies
"""The state of bodies in space or in the plane."""
AnyInertia = Inertia | PlanarInertia
"""The mass of such bodies."""


def to_world_frame(bodies: Bodies, vector: NestedArrayLike) -> Float[Array, "*lanes dim"]:
    """A vector of the body frame, one for all bodies or one per lane, in the world frame: R v."""
    if isinstance(bodies, RigidBodies):
        return spatial.to_world_frame(bodies, vector)
    own = broadcast_vector(jnp.asarray(vector, bodies.dtype), bodies.position)
    return scale(jnp.cos(bodies.angle), own) + spin(jnp.sin(bodies.angle), own)


def angular_velocity(bodies: Bodies, inertia: AnyInertia) -> Float[Array, "..."]:
    """ω = R I⁻¹ Rᵀ L [rad/s] in the world frame, `(*lanes, 3)`; in the plane L/I, one number for each lane.

    Example:
        >>> print(rigid.angular_velocity(body, brick))
        [0. 0. 2.]
    """
    if isinstance(bodies, PlanarBodies):
        return bodies.angular_momentum / cast("PlanarInertia", inertia).moment
    return spatial.angular_velocity(bodies, cast("Inertia", inertia))


def angular_acceleration(bodies: Bodies, inertia: AnyInertia, torque: Float[Array, "..."]) -> Float[Array, "..."]:
    """ω̇ = R I⁻¹ Rᵀ (τ - ω × L) [rad/s²] in the world frame, in the plane τ/I; τ [N m] is about the center of mass, or the pivot.

    Example:
        >>> print(rigid.angular_acceleration(body, brick, torque=jnp.array([0.0, 0.0, 10.0])))
        [0. 0. 2.]
    """
    if isinstance(bodies, PlanarBodies):
        return torque / cast("PlanarInertia", inertia).moment
    return spatial.angular_acceleration(bodies, cast("Inertia", inertia), torque)


def point(bodies: Bodies, place: NestedArrayLike) -> Float[Array, "*lanes dim"]:
    """Position of a point of each body [m]: x + R p.

    Example:
        >>> print(rigid.point(body, (0.5, 0.0, 0.0)))
        [0.5 0.  0. ]
    """
    return bodies.position + to_world_frame(bodies, place)


def point_velocity(bodies: Bodies, inertia: AnyInertia, place: NestedArrayLike) -> Float[Array, "*lanes dim"]:
    """Velocity of a point of each body [m/s]: v + ω × r.

    Example:
        >>> print(rigid.point_velocity(body, brick, (0.5, 0.0, 0.0)))
        [1. 1. 0.]
    """
    return follow_arm(bodies, inertia, to_world_frame(bodies, place)).velocity


def point_acceleration(
    scene: Scene, t: ArrayLike, place: NestedArrayLike, state: Bodies | None = None
) -> Float[Array, "*lanes dim"]:
    """Acceleration of a point of each body [m/s²]: a + ω̇ × r + ω × (ω × r), at `scene.state` unless a state is given.

    Example:
        >>> print(rigid.point_acceleration(Scene(body, brick), 0.0, (0.5, 0.0, 0.0)))
        [-2.  0.  0.]
    """
    bodies = scene.state if state is None else state
    rate, r = scene.rate(t, bodies), to_world_frame(bodies, place)
    omega = angular_velocity(bodies, scene.mass)
    change = angular_acceleration(bodies, scene.mass, rate.angular_momentum)
    return scale(1 / scene.mass.mass, rate.momentum) + spin(change, r) + spin(omega, spin(omega, r))


def follow_arm(bodies: Bodies, inertia: AnyInertia, arm: Float[Array, "*lanes dim"]) -> Particles:
    """The end of an arm [m] from each center of mass, in the world frame, as a particle: x + r, v + ω × r."""
    velocity = scale(1 / inertia.mass, bodies.momentum) + spin(angular_velocity(bodies, inertia), arm)
    return Particles(bodies.position + arm, velocity)


def measure_torque(arm: Float[Array, "*lanes dim"], force: Float[Array, "*lanes dim"]) -> Float[Array, "..."]:
    """The torque r × F of a force at the end of an arm [N m]: a vector in space, in the plane a number for each lane."""
    if arm.shape[-1] == 2:
        return arm[..., 0] * force[..., 1] - arm[..., 1] * force[..., 0]
    return cross(arm, force)


__all__ = [
    "angular_acceleration",
    "angular_velocity",
    "follow_arm",
    "measure_torque",
    "point",
    "point_acceleration",
    "point_velocity",
    "to_world_frame",
]
