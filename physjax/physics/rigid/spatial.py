"""Rigid bodies: their state record, how loads move it, and how bodies rotate.

Quaternions are (w, x, y, z), of length 1, and rotate vectors from the body frame to the world frame. Angular momentum is
in the world frame, where only a torque changes it: there is no gyroscopic term to forget. The angular velocity is
ω = R I⁻¹ Rᵀ L, computed from L wherever it is needed.
"""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from physjax.checks import NestedArrayLike, Vectors, as_real_array, as_real_quantity
from physjax.loops import Time, time_for_part
from physjax.particles import Particles, check_load_shape, sum_terms
from physjax.parts import Force, Function
from physjax.physics.rigid.free_rotation import (
    apply_inverse_principal,
    principal_frame,
    rotate_freely,
    turn_rate,
)
from physjax.physics.rigid.inertia import Inertia, check_quaternion
from physjax.scene import loads
from physjax.vectors import (
    broadcast_vector,
    cross,
    dot,
    rotate_components,
    rotate_vector,
    scale,
    stack_components,
)


class Wrench(NamedTuple):
    """A force [N] and a torque about the center of mass [N m], in the world frame; None where there is none.

    Of bodies in the plane the torque is a number for each lane, anticlockwise.

    Example:
        >>> push = rigid.on_bodies(lambda t, bodies, inertia: rigid.Wrench(force=2.0 * bodies.momentum))
        >>> print(loads(Scene(body, brick, (push,)), 0.0).force)
        [24.  0.  0.]
    """

    force: Float[Array, "*lanes dim"] | None = None
    torque: Float[Array, "..."] | None = None


WholeWrench = tuple[Array, Array]
"""A `Wrench` with both parts present, as the sum of loads is."""


class Load(Force):
    """A load on rigid bodies, with a torque: `(t, bodies, inertia) -> Wrench`. Other forces act at the center of mass.

    Example:
        >>> isinstance(rigid.Torque((0.0, 0.0, 1.0)), rigid.Load)
        True
    """

    @abstractmethod
    def wrench(self, t: Time, bodies: PyTree, inertia: PyTree) -> Wrench:
        """Force [N] and torque about the center of mass [N m] on each body."""

    def __call__(self, t: Time, state: PyTree, mass: PyTree) -> Wrench:
        """The wrench; a TypeError for a state that is not of rigid bodies."""
        if not state.rotates:
            raise TypeError(
                f"{type(self).__name__}: got a state of type {type(state).__name__}, expected RigidBodies or "
                "PlanarBodies: it has a torque."
            )
        return self.wrench(t, state, mass)


class OnBodies(Load):
    """A plain function `(t, bodies, inertia) -> Wrench` as a load, independent for each body unless it `couples`."""

    function: Function
    couples: bool = eqx.field(static=True)

    def __init__(self, function: Callable[..., Wrench], couples: bool = False):
        self.function = Function(function)
        # a field where other forces have a class attribute: both are read the same way
        self.couples = couples  # pyright: ignore[reportIncompatibleVariableOverride]

    def wrench(self, t: Time, bodies: PyTree, inertia: PyTree) -> Wrench:
        """The function's wrench."""
        return self.function(t, bodies, inertia)


class RigidBodies(NamedTuple):
    """The state of rigid bodies in space: position of the center of mass [m], orientation, momentum, angular momentum.

    Shapes are `(*lanes, 3)`, of the orientation `(*lanes, 4)`; momentum [kg m/s] and angular momentum [kg m²/s] are about
    the center of mass, or about the pivot of a body that has one. `bodies` builds the record from velocities. A scene of
    rigid bodies has an `Inertia` for its mass. The orientation is normalised to length 1.

    As a state record it offers what `Particles` does: `lanes` and `dtype`; `rate`, its time derivative under a wrench;
    `kick` and `drift`, the parts of a step that change momenta and places; and `normalised`, after each step.

    Example:
        >>> isinstance(body, RigidBodies), body.momentum.tolist(), body.angular_momentum.tolist()
        (True, [12.0, 0.0, 0.0], [0.0, 0.0, 10.0])
    """

    position: Vectors
    orientation: Vectors
    momentum: Vectors
    angular_momentum: Vectors

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
        """What path errors are measured in: position [m] next to orientation [1], `(*lanes, 7)`."""
        return np.concatenate([self.position, self.orientation], axis=-1)

    @property
    def rotates(self) -> bool:
        """Bodies rotate: their Jacobian is not symmetric."""
        return True

    # loads

    def view_for_force(self, force: Callable, mass: Inertia) -> tuple["RigidBodies | Particles", Inertia | Array]:
        """State and mass that a force sees: a load the bodies and their inertia, others particles at the centers of mass."""
        if isinstance(force, Load):
            return self, mass
        return Particles(self.position, scale(1 / mass.mass, self.momentum)), mass.mass

    def evaluate_load(self, force: Callable, t: Time, mass: Inertia) -> Wrench:
        """The wrench of a force on each body; a force on particles acts at the center of mass."""
        found = force(time_for_part(force, t), *self.view_for_force(force, mass))
        found = found if isinstance(found, Wrench) else Wrench(found)
        return Wrench(*(None if part is None else check_load_shape(force, part, self.position) for part in found))

    def sum_loads(self, terms: Sequence[Wrench]) -> Wrench:
        """The sum of wrenches, with both parts present."""
        kinds = zip(*terms, strict=True) if terms else ((), ())
        present = ([part for part in parts if part is not None] for parts in kinds)
        return Wrench(*(sum_terms(parts) if parts else jnp.zeros_like(self.position) for parts in present))

    def generalised_force(self, scene: Any, t: Time) -> WholeWrench:
        """Total force and torque, a `Wrench` with both; none on bodies that are held."""
        total = loads(scene, t, self.on_pivot(scene.mass))
        if scene.held is None:
            return total
        free = 1 - scene.held.astype(self.dtype)
        return Wrench(*(scale(free, part) for part in total))  # pyright: ignore[reportReturnType]  # with both parts

    # motion

    def rate(self, wrench: WholeWrench, inertia: Inertia) -> "RigidBodies":
        """Time derivative: x' = p/m, q' = ½(0, ω)q, p' = F, L' = τ; on a pivot what follows from turning about it."""
        force, torque = wrench
        turning = turn_rate(self.orientation, self.angular_momentum, inertia)
        if inertia.arm is None:
            return RigidBodies(scale(1 / inertia.mass, self.momentum), turning, force, torque)
        omega = angular_velocity(self, inertia)
        arm = to_world_frame(self, inertia.arm)
        torque = torque + cross(arm, force)
        velocity = cross(omega, arm)
        change = angular_acceleration(self, inertia, torque)
        acceleration = cross(change, arm) + cross(omega, velocity)
        return RigidBodies(velocity, turning, scale(inertia.mass, acceleration), torque)

    def kick(self, rate: "RigidBodies", dt: ArrayLike) -> "RigidBodies":
        """p += F dt, L += τ dt, position and orientation untouched."""
        momentum = self.momentum + scale(dt, rate.momentum)
        return RigidBodies(
            self.position, self.orientation, momentum, self.angular_momentum + scale(dt, rate.angular_momentum)
        )

    def drift(self, dt: ArrayLike, inertia: Inertia) -> "RigidBodies":
        """x += p/m dt, and free rotation for a time dt, both momenta untouched."""
        position = self.position + scale(dt, scale(1 / inertia.mass, self.momentum))
        orientation = rotate_freely(self.orientation, self.angular_momentum, inertia, dt)
        return self._replace(position=position, orientation=orientation).on_pivot(inertia)

    def hold_lanes(self, free: Float[Array, "*lanes"]) -> "RigidBodies":
        """The state with both momenta of held bodies (free = 0) set to zero."""
        return self._replace(momentum=scale(free, self.momentum), angular_momentum=scale(free, self.angular_momentum))

    def on_pivot(self, inertia: Inertia) -> "RigidBodies":
        """The state with position and momentum that follow from orientation and angular momentum, where there is a pivot."""
        if inertia.arm is None or inertia.pivot is None:
            return self
        arm = to_world_frame(self, inertia.arm)
        velocity = cross(angular_velocity(self, inertia), arm)
        return self._replace(
            position=broadcast_vector(inertia.pivot, self.position) + arm, momentum=scale(inertia.mass, velocity)
        )

    def normalised(self, inertia: Inertia) -> "RigidBodies":
        """The state with the orientation scaled to length 1, and on its pivot, where there is one.

        A step ends with this, and none of its stages does, so that every method keeps its order.
        """
        q = self.orientation
        return self._replace(orientation=scale(1 / jnp.sqrt(dot(q, q)), q)).on_pivot(inertia)

    # what is conserved

    def kinetic_energy(self, inertia: Inertia) -> Float[Array, "*lanes"]:
        """½p²/m + ½ω·L [J]; on a pivot ½ω·L alone, which includes the motion of the center of mass."""
        turning = 0.5 * dot(angular_velocity(self, inertia), self.angular_momentum)
        return turning if inertia.arm is not None else turning + 0.5 / inertia.mass * dot(self.momentum, self.momentum)

    def linear_momentum(self, inertia: Inertia) -> Float[Array, "*lanes 3"]:
        """p [kg m/s]."""
        return self.momentum

    def own_spin(self, inertia: Inertia) -> Float[Array, "*lanes 3"]:
        """Angular momentum about the center of mass [kg m²/s], also where that of the state is about a pivot."""
        if inertia.arm is None:
            return self.angular_momentum
        arm = to_world_frame(self, inertia.arm)
        return self.angular_momentum - cross(arm, self.momentum)

    # checks

    def validate(self, mass: object) -> tuple["RigidBodies", Inertia]:
        """State and inertia as arrays of one dtype that fit; a ValueError or TypeError in plain words otherwise."""
        if not isinstance(mass, Inertia):
            raise TypeError(
                f"mass: got {type(mass).__name__}, expected an Inertia for rigid bodies, e.g. inertia.box(2.0, (1, 2, 3))."
            )
        state = RigidBodies(*(as_real_array(name, a) for name, a in zip(self._fields, self, strict=True)))
        lanes, dtype = state.lanes, state.dtype
        for name, array in state._asdict().items():
            expected = (*lanes, 4 if name == "orientation" else 3)
            if array.shape != expected or not array.size:
                raise ValueError(
                    f"RigidBodies: got {name} of shape {array.shape}, expected {expected}: vectors in space, component "
                    "last, quaternions (w, x, y, z), all with the lanes of the position. Build them with rigid.bodies."
                )
            if array.dtype != dtype:
                raise TypeError(f"RigidBodies: got {name} of {array.dtype}, expected {dtype} like position. Cast it.")
            as_real_quantity(f"{name}", array)
        state = RigidBodies(*(a.astype(dtype) for a in state))
        state = state._replace(orientation=check_quaternion("orientation", state.orientation))
        inertia = mass.validate(lanes, dtype)
        if inertia.arm is not None:
            pivot = state.position - to_world_frame(state, inertia.arm)
            inertia = inertia.place_pivot(pivot)
        return state.on_pivot(inertia), inertia


# rotation


def to_world_frame(bodies: RigidBodies, vector: NestedArrayLike) -> Float[Array, "*lanes 3"]:
    """A vector of the body frame, one for all bodies or one per lane, in the world frame: R v."""
    return rotate_vector(bodies.orientation, broadcast_vector(jnp.asarray(vector, bodies.dtype), bodies.position))


def to_world_frame_each(bodies: RigidBodies, vectors: NestedArrayLike) -> Float[Array, "vectors *lanes 3"]:
    """Several vectors of the body frame, `(vectors, 3)` or `(vectors, *lanes, 3)`, in the world frame in one evaluation."""
    vectors, lanes = jnp.asarray(vectors, bodies.dtype), bodies.lanes
    if vectors.ndim == 2:
        vectors = vectors.reshape(len(vectors), *(1 for _ in lanes), 3)
    shape = (len(vectors), *lanes)
    return rotate_vector(jnp.broadcast_to(bodies.orientation, (*shape, 4)), jnp.broadcast_to(vectors, (*shape, 3)))


def angular_velocity(bodies: RigidBodies, inertia: Inertia) -> Float[Array, "*lanes 3"]:
    """ω = R I⁻¹ Rᵀ L [rad/s], in the world frame.

    Example:
        >>> print(rigid.angular_velocity(body, brick))
        [0. 0. 2.]
    """
    return apply_inverse_inertia(bodies, inertia, bodies.angular_momentum)


def angular_acceleration(
    bodies: RigidBodies, inertia: Inertia, torque: Float[Array, "*lanes 3"]
) -> Float[Array, "*lanes 3"]:
    """ω̇ = R I⁻¹ Rᵀ (τ - ω × L) [rad/s²], in the world frame; the torque [N m] is about the center of mass, or the pivot.

    Example:
        >>> print(rigid.angular_acceleration(body, brick, torque=jnp.array([0.0, 0.0, 10.0])))
        [0. 0. 2.]
    """
    gyroscopic = cross(angular_velocity(bodies, inertia), bodies.angular_momentum)
    return apply_inverse_inertia(bodies, inertia, torque - gyroscopic)


def apply_inverse_inertia(bodies: RigidBodies, inertia: Inertia, vector: Array) -> Array:
    """R I⁻¹ Rᵀ times a vector of the world frame: the change of ω by an angular impulse."""
    frame = principal_frame(bodies.orientation, inertia)
    return stack_components(rotate_components(frame, apply_inverse_principal(frame, inertia.inverse, vector)))
