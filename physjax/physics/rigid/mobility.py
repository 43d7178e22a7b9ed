"""How easily a rigid body is moved: 1/m and R I⁻¹ Rᵀ where it is, computed once for all that asks for it there."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from physjax.physics.rigid.inertia import Inertia
from physjax.physics.rigid.spatial import RigidBodies, apply_inverse_inertia
from physjax.vectors import dot, scale


class Mobility(NamedTuple):
    """1/m [1/kg] and the columns of R I⁻¹ Rᵀ [1/(kg m²)] of bodies without a pivot, in the world frame."""

    inverse_mass: Float[Array, "*lanes"]
    columns: tuple[Float[Array, "*lanes 3"], Float[Array, "*lanes 3"], Float[Array, "*lanes 3"]]

    @classmethod
    def of(cls, bodies: RigidBodies, inertia: Inertia) -> "Mobility":
        """The mobility of bodies where they are: the tensor's columns are what it makes of the three axes."""
        axes = jnp.eye(3, dtype=bodies.dtype).reshape(3, *(1,) * len(bodies.lanes), 3)
        axes = jnp.broadcast_to(axes, (3, *bodies.position.shape))
        a, b, c = jax.vmap(lambda axis: apply_inverse_inertia(bodies, inertia, axis))(axes)
        return cls(jnp.broadcast_to(1 / inertia.mass, bodies.lanes), (a, b, c))

    def turn(self, vector: Float[Array, "*lanes 3"]) -> Float[Array, "*lanes 3"]:
        """R I⁻¹ Rᵀ times a vector: the ω of an angular momentum, the ω̇ of a torque."""
        a, b, c = self.columns
        return a * vector[..., :1] + b * vector[..., 1:2] + c * vector[..., 2:]

    def velocities(self, bodies: RigidBodies) -> tuple[Float[Array, "*lanes 3"], Float[Array, "*lanes 3"]]:
        """Velocity [m/s] and angular velocity [rad/s]."""
        return scale(self.inverse_mass, bodies.momentum), self.turn(bodies.angular_momentum)

    def kinetic_energy(self, bodies: RigidBodies) -> Float[Array, "*lanes"]:
        """½p·v + ½L·ω [J]."""
        velocity, omega = self.velocities(bodies)
        return 0.5 * (dot(bodies.momentum, velocity) + dot(bodies.angular_momentum, omega))
