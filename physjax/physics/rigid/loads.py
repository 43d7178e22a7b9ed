"""Loads on rigid bodies in space and in the plane, and the initial state of those in space."""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.checks import Numbers, OptionalNumbers, as_real_quantity, quantity
from physjax.loops import Time
from physjax.particles import Particles
from physjax.parts import Force, adopt_force
from physjax.physics.rigid.body_points import (
    AnyInertia,
    Bodies,
    angular_velocity,
    follow_arm,
    measure_torque,
    point,
    to_world_frame,
)
from physjax.physics.rigid.inertia import Inertia, check_quaternion
from physjax.physics.rigid.planar.bodies import PlanarBodies
from physjax.physics.rigid.spatial import Load, OnBodies, RigidBodies, Wrench
from physjax.vectors import broadcast_vector, rotate_vector, rotate_vector_back, scale


def bodies(
    inertia: Inertia,
    position: ArrayLike | Sequence = (0.0, 0.0, 0.0),
    orientation: ArrayLike | Sequence = (1.0, 0.0, 0.0, 0.0),
    velocity: ArrayLike | Sequence = (0.0, 0.0, 0.0),
    angular_velocity: ArrayLike | Sequence = (0.0, 0.0, 0.0),
    *,
    frame: str = "world",
) -> RigidBodies:
    """Rigid bodies with these initial velocities: p = m v, L = R I Rᵀ ω.

    Vectors are `(3,)` for all or one per lane, `(*lanes, 3)`; the orientation is a quaternion (w, x, y, z) of any length,
    the real part first: (1, 0, 0, 0) is no rotation. The angular velocity [rad/s] is in the `frame` of the "world" or of
    the "body". On a pivot the velocity follows from it. The float type is that of the position.

    Example:
        >>> turning = rigid.bodies(brick, angular_velocity=(0.0, 0.0, 2.0))
        >>> print(turning.angular_momentum)
        [ 0.  0. 10.]
    """
    _demand_frame(frame)
    if not isinstance(inertia, Inertia):
        raise TypeError(
            f"bodies: got the inertia {inertia!r}, expected that of a solid, such as inertia.sphere(mass, radius). Bodies in "
            "the plane are made by rigid.planar_bodies."
        )
    named = {"position [m]": position, "velocity [m/s]": velocity, "angular velocity [rad/s]": angular_velocity}
    x, v, omega = (as_real_quantity(name, value) for name, value in named.items())
    q = check_quaternion("orientation", orientation)
    if any(a.shape[-1:] != (3,) for a in (x, v, omega)):
        raise ValueError(f"bodies: got vectors of shapes {x.shape}, {v.shape}, {omega.shape}, expected (*lanes, 3).")
    parts = (x[..., 0], v[..., 0], omega[..., 0], q[..., 0], inertia.mass, inertia.principal[..., 0])
    lanes, dtype = jnp.broadcast_shapes(*(part.shape for part in parts)), x.dtype
    x, v, omega, q = (jnp.broadcast_to(a, (*lanes, a.shape[-1])).astype(dtype) for a in (x, v, omega, q))
    inertia = inertia.validate(lanes, dtype)
    omega = omega if frame == "body" else rotate_vector_back(q, omega)
    axes = None if inertia.axes is None else broadcast_vector(inertia.axes, q)
    along = omega if axes is None else rotate_vector_back(axes, omega)
    spin = broadcast_vector(inertia.principal, omega) * along
    return RigidBodies(
        x, q, scale(inertia.mass, v), rotate_vector(q, spin if axes is None else rotate_vector(axes, spin))
    )


def on_bodies(function: Callable[..., Wrench], *, couples: bool = False) -> Load:
    """A plain function `(t, bodies, inertia) -> Wrench` as a load; `couples` if one body's load depends on another body.

    Example:
        >>> spin_up = rigid.on_bodies(lambda t, bodies, inertia: rigid.Wrench(torque=0.5 * bodies.angular_momentum))
        >>> print(loads(Scene(body, brick, (spin_up,)), 0.0).torque)
        [0. 0. 5.]
    """
    return OnBodies(function, couples)


# loads


class Torque(Load):
    """A constant torque [N m] in the frame of the "world" or of the "body"; in the plane a number, anticlockwise.

    Example:
        >>> print(loads(Scene(body, brick, (rigid.Torque((0.0, 0.0, 5.0)),)), 0.0).torque)
        [0. 0. 5.]
    """

    torque: Numbers = quantity("torque", "N m", kind="axial")
    frame: str = eqx.field(static=True, default="world")

    def __check_init__(self):
        _demand_frame(self.frame)

    def wrench(self, t: Time, bodies: Bodies, inertia: AnyInertia) -> Wrench:
        """The torque, and no force."""
        if isinstance(bodies, PlanarBodies):
            return Wrench(torque=jnp.broadcast_to(self.torque, bodies.lanes))
        world = self.frame == "world"
        return Wrench(
            torque=broadcast_vector(self.torque, bodies.position) if world else to_world_frame(bodies, self.torque)
        )


class RotationalDrag(Load):
    """Drag of a fluid on rotation: τ = -c ω, c [N m s]; for a ball in creeping flow c = 8πηr³.

    Example:
        >>> brake = rigid.RotationalDrag(0.5)
        >>> print(loads(Scene(body, brick, (brake,)), 0.0).torque)
        [-0. -0. -1.]
    """

    coefficient: Numbers = quantity("drag coefficient c", "N m s", at_least=0)

    def wrench(self, t: Time, bodies: Bodies, inertia: AnyInertia) -> Wrench:
        """The torque, and no force."""
        return Wrench(torque=scale(-self.coefficient, angular_velocity(bodies, inertia)))


class Thrust(Load):
    """A force [N] fixed to the body, at a `point` [m] of it, like that of an engine: F = R f, τ = r × F.

    Without a point it acts at the center of mass.

    Example:
        >>> engine = rigid.Thrust((3.0, 0.0, 0.0), point=(0.0, 2.0, 0.0))
        >>> print(*loads(Scene(body, brick, (engine,)), 0.0))
        [3. 0. 0.] [ 0.  0. -6.]
    """

    force: Numbers = quantity("thrust", "N", kind="vector")
    point: OptionalNumbers = quantity("point of the body", "m", kind="place", default=None)

    def wrench(self, t: Time, bodies: Bodies, inertia: AnyInertia) -> Wrench:
        """The force and its torque."""
        force = to_world_frame(bodies, self.force)
        if self.point is None:
            return Wrench(force)
        return Wrench(force, measure_torque(to_world_frame(bodies, self.point), force))


class AtPoint(Load):
    """Any force on particles, acting at a `point` [m] of each body, whose position and velocity it sees: τ = r × F.

    A spring to the world is `AtPoint(point, forces.Anchor(...))`, a spring between points of two bodies
    `AtPoint(points, springs.Springs(pairs, ...))` with a point for each lane, an off-center kick `AtPoint(point,
    forces.Kick(...))`. Forces with a memory (springs that break) cannot be used here.

    Example:
        >>> off_center = rigid.AtPoint((0.0, 1.0, 0.0), forces.Constant((6.0, 0.0, 0.0)))
        >>> print(loads(Scene(body, brick, (off_center,)), 0.0).torque)
        [ 0.  0. -6.]
    """

    point: Numbers = quantity("point of the body", "m", kind="place")
    force: Force = eqx.field(converter=adopt_force)  # pyright: ignore[reportGeneralTypeIssues]  # `point` has no default

    def __check_init__(self):
        if isinstance(self.force, Load) or self.force.remembers:
            raise TypeError(f"AtPoint: got {type(self.force).__name__}, expected a force on particles that forgets.")

    # a class attribute of other forces, a property of this one: both are read the same way

    @property
    def couples(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether the force ties bodies together."""
        return self.force.couples

    @property
    def sees_moments(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether the force asks for the time as a moment."""
        return self.force.sees_moments

    def discontinuities(self) -> tuple[Array, ...]:
        """Times at which the force jumps [s]."""
        return self.force.discontinuities()

    @property
    def jumps(self) -> bool:
        """Whether the force jumps in time."""
        return self.force.jumps

    def averaged_over_step(self, t: Time, dt: ArrayLike, state: Bodies) -> "AtPoint":
        """The mean of the force over a step; it depends on where the point is, not on how fast it moves."""
        where = point(state, self.point)
        return AtPoint(self.point, self.force.averaged_over_step(t, dt, Particles(where, jnp.zeros_like(where))))

    @property
    def has_potential(self) -> bool:
        """Whether the force is conservative."""
        return self.force.has_potential

    def potential(self, t: ArrayLike, state: Bodies, mass: AnyInertia) -> Array | None:
        """Its potential energy [J], if it has one."""
        return self.force.potential(t, follow_arm(state, mass, to_world_frame(state, self.point)), mass.mass)

    def wrench(self, t: Time, bodies: Bodies, inertia: AnyInertia) -> Wrench:
        """The force and its torque."""
        # a moment comes only where the force `sees_moments`
        arm = to_world_frame(bodies, self.point)
        force = self.force(t, follow_arm(bodies, inertia, arm), inertia.mass)  # pyright: ignore[reportArgumentType]
        return Wrench(force, measure_torque(arm, force))


def _demand_frame(frame: str) -> None:
    if frame not in ("world", "body"):
        raise ValueError(f"frame: got {frame!r}, expected 'world' or 'body'.")
