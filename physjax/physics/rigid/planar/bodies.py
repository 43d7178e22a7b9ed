"""The state record of rigid bodies in the plane: place, angle, momentum and angular momentum, and how loads move them."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.checks import NestedArrayLike, Numbers, Vectors, as_real_array, as_real_quantity
from physjax.loops import Time, time_for_part, to_float_time
from physjax.particles import Particles, check_load_shape, sum_terms
from physjax.parts import Force
from physjax.physics.rigid.planar_inertia import PlanarInertia
from physjax.physics.rigid.spatial import Load, Wrench
from physjax.tracebacks import shorten_tracebacks
from physjax.vectors import dot, scale


class PlanarBodies(NamedTuple):
    """The state of rigid bodies in the plane: position of the center of mass [m], angle [rad], and both momenta.

    Position and momentum [kg m/s] are `(*lanes, 2)`; the angle, anticlockwise, and the angular momentum about the center of
    mass [kg m²/s] have the shape of the lanes. `rigid.planar_bodies` builds the record from velocities. A scene of them has
    a `PlanarInertia` for its mass.

    Example:
        >>> spun = rigid.planar_bodies(inertia.planar_disc(2.0, 1.0), velocity=(3.0, 0.0), angular_velocity=5.0)
        >>> spun.momentum.tolist(), float(spun.angular_momentum)
        ([6.0, 0.0], 5.0)
    """

    position: Vectors
    angle: Numbers
    momentum: Vectors
    angular_momentum: Numbers

    @property
    def lanes(self) -> tuple[int, ...]:
        """Shape of the lanes: `()` for a single body."""
        return self.position.shape[:-1]

    @property
    def dtype(self) -> np.dtype:
        """Floating-point type of the state, and of all numbers of its scene."""
        return self.position.dtype

    @property
    def place(self) -> np.ndarray:
        """What path errors are measured in: position [m] next to the angle [rad], `(*lanes, 3)`."""
        return np.concatenate([self.position, np.asarray(self.angle)[..., None]], axis=-1)

    @property
    def rotates(self) -> bool:
        """Bodies rotate: their Jacobian is not symmetric."""
        return True

    # loads

    def view_for_force(self, force: Callable, mass: PlanarInertia) -> "tuple[PlanarBodies | Particles, Any]":
        """State and mass that a force sees: a load the bodies and their inertia, others particles at the centers of mass."""
        if isinstance(force, Load):
            return self, mass
        return Particles(self.position, scale(1 / mass.mass, self.momentum)), mass.mass

    def evaluate_load(self, force: Force, t: Time, mass: PlanarInertia) -> Wrench:
        """The wrench of a force on each body; a force on particles acts at the center of mass."""
        found = force(time_for_part(force, t), *self.view_for_force(force, mass))
        found = found if isinstance(found, Wrench) else Wrench(found)
        expected = (self.position, self.angle)
        pairs = zip(found, expected, strict=True)
        return Wrench(*(None if part is None else check_load_shape(force, part, like) for part, like in pairs))

    def sum_loads(self, terms: Sequence[Wrench]) -> Wrench:
        """The sum of wrenches, with both parts present."""
        kinds = zip(*terms, strict=True) if terms else ((), ())
        present = [[part for part in parts if part is not None] for parts in kinds]
        likes = (self.position, self.angle)
        return Wrench(
            *(sum_terms(parts) if parts else jnp.zeros_like(like) for parts, like in zip(present, likes, strict=True))
        )

    def generalised_force(self, scene: Any, t: Time) -> Wrench:
        """Total force [N] and torque [N m]; none on bodies that are held."""
        state = self
        if scene.prescribed_motion is not None:
            state = scene.prescribed_motion.prescribe(to_float_time(t), state)
        total = self.sum_loads([state.evaluate_load(force, t, scene.mass) for force in scene.forces])
        if scene.held is None:
            return total
        free = 1 - scene.held.astype(self.dtype)
        return Wrench(*(scale(free, part) for part in total if part is not None))

    # motion

    def rate(self, wrench: Wrench, inertia: PlanarInertia) -> "PlanarBodies":
        """Time derivative: x' = p/m, θ' = L/I, p' = F, L' = τ."""
        force, torque = wrench
        # the sum of loads has both parts
        assert force is not None
        assert torque is not None
        velocity = scale(1 / inertia.mass, self.momentum)
        return PlanarBodies(velocity, self.angular_momentum / inertia.moment, force, torque)

    def kick(self, rate: "PlanarBodies", dt: ArrayLike) -> "PlanarBodies":
        """p += F dt, L += τ dt, position and angle untouched."""
        momentum = self.momentum + scale(dt, rate.momentum)
        return PlanarBodies(
            self.position, self.angle, momentum, self.angular_momentum + scale(dt, rate.angular_momentum)
        )

    def drift(self, dt: ArrayLike, inertia: PlanarInertia) -> "PlanarBodies":
        """x += p/m dt, θ += L/I dt, both momenta untouched."""
        position = self.position + scale(dt, scale(1 / inertia.mass, self.momentum))
        return self._replace(position=position, angle=self.angle + scale(dt, self.angular_momentum / inertia.moment))

    def hold_lanes(self, free: Float[Array, "*lanes"]) -> "PlanarBodies":
        """The state with both momenta of held bodies (free = 0) set to zero."""
        return self._replace(momentum=scale(free, self.momentum), angular_momentum=free * self.angular_momentum)

    def normalised(self, inertia: PlanarInertia) -> "PlanarBodies":
        """The state itself: its arrays need not agree with each other."""
        return self

    # what is conserved

    def kinetic_energy(self, inertia: PlanarInertia) -> Float[Array, "*lanes"]:
        """½p²/m + ½L²/I [J]."""
        return 0.5 * (dot(self.momentum, self.momentum) / inertia.mass + self.angular_momentum**2 / inertia.moment)

    def linear_momentum(self, inertia: PlanarInertia) -> Float[Array, "*lanes 2"]:
        """p [kg m/s]."""
        return self.momentum

    def own_spin(self, inertia: PlanarInertia) -> Float[Array, "*lanes"]:
        """Angular momentum about the center of mass [kg m²/s]."""
        return self.angular_momentum

    # checks

    def validate(self, mass: object) -> tuple["PlanarBodies", PlanarInertia]:
        """State and inertia as arrays of one dtype that fit; a ValueError or TypeError in plain words otherwise."""
        if not isinstance(mass, PlanarInertia):
            raise TypeError(
                f"mass: got {type(mass).__name__}, expected a PlanarInertia for bodies in the plane, e.g. "
                "inertia.planar_plate(2.0, (1, 1))."
            )
        state = PlanarBodies(*(as_real_array(name, a) for name, a in zip(self._fields, self, strict=True)))
        lanes, dtype = state.lanes, state.dtype
        for name, array in state._asdict().items():
            expected = (*lanes, 2) if name in ("position", "momentum") else lanes
            if array.shape != expected or not array.size:
                raise ValueError(
                    f"PlanarBodies: got {name} of shape {array.shape}, expected {expected}: vectors in the plane, component "
                    "last, angles and angular momenta with the lanes of the position. Build them with rigid.planar_bodies."
                )
            if array.dtype != dtype:
                raise TypeError(f"PlanarBodies: got {name} of {array.dtype}, expected {dtype} like position. Cast it.")
            as_real_quantity(f"{name}", array)
        return PlanarBodies(*(a.astype(dtype) for a in state)), mass.validate(lanes, dtype)


@shorten_tracebacks
def planar_bodies(
    inertia: PlanarInertia,
    position: NestedArrayLike = (0.0, 0.0),
    angle: NestedArrayLike = 0.0,
    velocity: NestedArrayLike = (0.0, 0.0),
    angular_velocity: NestedArrayLike = 0.0,
) -> PlanarBodies:
    """Bodies in the plane with these initial velocities: p = m v, L = I ω.

    Vectors are `(2,)` for all or one per lane, `(*lanes, 2)`; angles [rad] and angular velocities [rad/s], anticlockwise, are
    scalars or per lane. The float type is that of the position.

    Example:
        >>> crates = rigid.planar_bodies(inertia.planar_plate(2.0, (1.0, 1.0)), [[0.0, 0.5], [0.0, 1.5]], velocity=(1.0, 0.0))
        >>> crates.momentum.tolist()
        [[2.0, 0.0], [2.0, 0.0]]
    """
    if not isinstance(inertia, PlanarInertia):
        raise TypeError(
            f"planar_bodies: got the inertia {inertia!r}, expected that of a shape in the plane, such as "
            "inertia.planar_disc(mass, radius). Bodies in space are made by rigid.bodies."
        )
    named = {
        "position [m]": position,
        "angle [rad]": angle,
        "velocity [m/s]": velocity,
        "angular velocity [rad/s]": angular_velocity,
    }
    x, theta, v, omega = (as_real_quantity(name, value) for name, value in named.items())
    if any(a.shape[-1:] != (2,) for a in (x, v)):
        raise ValueError(f"planar_bodies: got vectors of shapes {x.shape}, {v.shape}, expected (*lanes, 2).")
    parts = (x[..., 0], v[..., 0], theta, omega, inertia.mass, inertia.moment)
    lanes, dtype = jnp.broadcast_shapes(*(part.shape for part in parts)), x.dtype
    x, v = (jnp.broadcast_to(a, (*lanes, 2)).astype(dtype) for a in (x, v))
    theta, omega = (jnp.broadcast_to(a, lanes).astype(dtype) for a in (theta, omega))
    inertia = inertia.validate(lanes, dtype)
    return PlanarBodies(x, theta, scale(inertia.mass, v), inertia.moment * omega)


__all__ = ["PlanarBodies", "planar_bodies"]
