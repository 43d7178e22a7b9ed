"""Loads on particles: each force is its formula, with the units of its numbers.

Every number is a scalar or has the shape of the lanes; every vector is `(dim,)` for all lanes or one per lane. All have
finite values and derivatives at rest and at coincident points.
"""

import math
from collections.abc import Callable
from typing import ClassVar

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.checks import quantity, unchecked_quantity
from physjax.loops import Time, float32_remainder
from physjax.particles import Particles
from physjax.parts import Field, Force, Function
from physjax.physics.forces.time_dependent import acting_share, is_acting
from physjax.vectors import broadcast_vector, dot, norm, scale, spin, unit


class Blast(Force):
    """An explosion: away from the `center`, impulse J/(1 + (d/r)²) [N s] at the distance d, spread over a `duration` [s].

    Half of J arrives at the `reach` r [m], and far out it thins as 1/d², like a wave that spreads. `impulse` J is a number
    or one per lane (a plate that shows more of its face gets more); what stands in the center itself stays. The force
    follows a lane that moves while it lasts. As with `Kick`, a step feels its mean in time.

    Example:
        >>> blast = forces.Blast(center=(0.0, 9.0), impulse=4.0, reach=1.0, at=0.0, duration=0.5)
        >>> print(blast(0.1, ball, shot.mass))
        [0. 4.]
    """

    sees_moments: ClassVar[bool] = True
    center: Float[Array, "..."] = quantity("center of the blast", "m", kind="place")
    impulse: Float[Array, "..."] = quantity("impulse", "N s")
    reach: Float[Array, "..."] = quantity("reach of the blast", "m", above=0)
    at: Float[Array, "..."] = quantity("start of the blast", "s")
    duration: Float[Array, "..."] = quantity("duration of the blast", "s", above=0)
    at_rest: Float[Array, "..."] | None = unchecked_quantity(
        "rest of the start", "s", per="memory", default=None, repr=False, kw_only=True
    )

    def __post_init__(self):
        self.at_rest = float32_remainder(self.at, self.at_rest)

    def __call__(self, t: Time, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """J/(1 + (d/r)²)/duration away from the center while the blast lasts [N]."""
        return scale(jnp.where(is_acting(self, t, state), 1 / self.duration, 0.0), self.lane_impulse(state))

    def lane_impulse(self, state: Particles) -> Float[Array, "*lanes dim"]:
        """The impulse that each lane gets if it stays where it is [N s]."""
        d = state.position - broadcast_vector(self.center, state.position)
        return scale(self.impulse / (1 + dot(d, d) / self.reach**2), unit(d))

    def averaged_over_step(self, t: Time, dt: Time, state: Particles) -> "_AveragedBlast":
        """The mean in time of the force over the step from t to t + dt."""
        return _AveragedBlast(self, acting_share(self, t, dt, state) / self.duration)

    def discontinuities(self) -> tuple[Float[Array, "..."], ...]:
        """Times at which the force jumps [s]; an adaptive solver must stop there, or it may step over the whole blast."""
        return self.at, self.at + self.duration


class _AveragedBlast(Force):
    """A blast that lasts: so many of its impulses a second."""

    blast: Blast
    rate: Float[Array, "..."] = unchecked_quantity("blasts a second", "1/s", per="memory")

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        return scale(self.rate, self.blast.lane_impulse(state))


class StokesDrag(Force):
    """Creeping flow past a sphere: F = -b v with b = 6πηr [kg/s], v relative to the wind [m/s].

    The lecture's drag at low velocity.

    Example:
        >>> print(forces.StokesDrag(0.5, wind=(1.0, 0.0))(0.0, ball, shot.mass))
        [-1. -2.]
    """

    dissipative_symmetric: ClassVar[bool] = True
    coefficient: Float[Array, "..."] = quantity("drag coefficient b", "kg/s", at_least=0)
    wind: Float[Array, "..."] | None = quantity("wind", "m/s", kind="vector", default=None)

    @classmethod
    def of_sphere(
        cls, radius: ArrayLike, viscosity: ArrayLike = 1.81e-5, wind: ArrayLike | None = None
    ) -> "StokesDrag":
        """The drag of a sphere: b = 6πηr, radius [m], viscosity [Pa s] (air at 20 °C by default)."""
        return cls(6 * math.pi * viscosity * jnp.asarray(radius), wind)

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """-b (v - wind) [N]."""
        return scale(-self.coefficient, _air_velocity(state, self.wind))


class QuadraticDrag(Force):
    """Drag at high velocity: F = -½ρC_dA |v| v, v relative to the wind. The lecture prints it without its minus sign.

    Example:
        >>> print(forces.QuadraticDrag(area=0.2, coefficient=1.0, density=2.0)(0.0, ball, shot.mass))
        [-3. -4.]
    """

    dissipative_symmetric: ClassVar[bool] = True
    area: Float[Array, "..."] = quantity("area", "m²", at_least=0)
    coefficient: Float[Array, "..."] = quantity("drag coefficient C_d", "1", at_least=0)
    density: Float[Array, "..."] = quantity("density of the fluid", "kg/m³", at_least=0, default=1.225)
    wind: Float[Array, "..."] | None = quantity("wind", "m/s", kind="vector", default=None)

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """-½ρC_dA |v - wind| (v - wind) [N]."""
        v = _air_velocity(state, self.wind)
        return scale(-0.5 * self.density * self.coefficient * self.area * norm(v), v)


class SphereDrag(Force):
    """Drag of a smooth sphere at any speed below the drag crisis (Reynolds number Re = ρ|v|d/η < 2e5), v relative to the wind.

    F = -3πηd v [1 + 0.15 Re^0.681 + (0.407 Re/24)/(1 + 8710/Re)]: Stokes' law with the correction of P. P. Brown and D.
    F. Lawler, "Sphere drag and settling velocity revisited", J. Environ. Eng. 129 (2003) 222. Radius [m], density
    [kg/m³], viscosity [Pa s].

    Example:
        >>> drop = Particles(jnp.zeros(3), jnp.array([0.0, 0.0, 1e-3]))
        >>> force = forces.SphereDrag(radius=1e-6)(0.0, drop, shot.mass)[2]
        >>> round(float(force / (-6 * np.pi * 1.81e-5 * 1e-6 * 1e-3)), 2)
        1.0
    """

    dissipative_symmetric: ClassVar[bool] = True
    radius: Float[Array, "..."] = quantity("radius", "m", above=0)
    density: Float[Array, "..."] = quantity("density of the fluid", "kg/m³", above=0, default=1.204)
    viscosity: Float[Array, "..."] = quantity("viscosity", "Pa s", above=0, default=1.81e-5)
    wind: Float[Array, "..."] | None = quantity("wind", "m/s", kind="vector", default=None)

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """The corrected Stokes force [N]."""
        v = _air_velocity(state, self.wind)
        reynolds = 2 * self.density * self.radius / self.viscosity * norm(v)
        reynolds = jnp.maximum(reynolds, 1e-24)  # its power has no slope at 0; two derivatives still fit in float32
        correction = 1 + 0.15 * reynolds**0.681 + (0.407 / 24) * reynolds**2 / (reynolds + 8710)
        return scale(-6 * math.pi * self.viscosity * self.radius * correction, v)


class Magnus(Force):
    """Lift of a spinning ball: F = ½ρAC_L |v|² ω̂×v̂, at right angles to the flight, so that it does no work.

    `axis` is the direction of the spin, a vector in space, a number (+1 anticlockwise) in the plane; its length is left
    out.

    Example:
        >>> print(forces.Magnus(area=0.2, coefficient=1.0, axis=1.0, density=2.0)(0.0, ball, shot.mass))
        [-4.  3.]
    """

    area: Float[Array, "..."] = quantity("area", "m²", at_least=0)
    coefficient: Float[Array, "..."] = quantity("lift coefficient C_L", "1", at_least=0)
    axis: Float[Array, "..."] = quantity("spin axis", "1", kind="axial")
    density: Float[Array, "..."] = quantity("density of the fluid", "kg/m³", at_least=0, default=1.225)
    wind: Float[Array, "..."] | None = quantity("wind", "m/s", kind="vector", default=None)

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """½ρAC_L |v| ω̂×v [N], v relative to the wind."""
        v = _air_velocity(state, self.wind)
        axis = jnp.sign(self.axis) if v.shape[-1] == 2 else unit(broadcast_vector(self.axis, v))
        return scale(0.5 * self.density * self.coefficient * self.area * norm(v), spin(axis, v))


class RotatingFrame(Field):
    """What a turning frame adds: centrifugal -mω×(ω×r), Coriolis -2mω×v and, where ω changes, Euler's -mω̇×r.

    `omega` [rad/s] is a vector in space, a number (anticlockwise) in the plane; `omega_rate` is its constant rate of
    change [rad/s²]. Positions are measured from the axis, omega is given at t = 0.

    Example:
        >>> print(forces.RotatingFrame(omega=1.0)(0.0, ball, shot.mass))
        [16.  8.]
    """

    omega: Float[Array, "..."] = quantity("omega", "rad/s", kind="axial")
    omega_rate: Float[Array, "..."] | None = quantity("omega_rate", "rad/s²", kind="axial", default=None)

    def acceleration(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """-ω×(ω×r) - 2ω×v - ω̇×r [m/s²]."""
        r, v = state.position, state.velocity
        if self.omega_rate is None:
            return -spin(self.omega, spin(self.omega, r) + 2 * v)
        rate = _broadcast_omega(self.omega_rate, r)
        omega = _broadcast_omega(self.omega, r) + scale(t, rate)
        return -spin(omega, spin(omega, r) + 2 * v) - spin(rate, r)


class Anchor(Force):
    """A spring from a fixed point: F = -k (|d| - L) d̂ - c (v·d̂) d̂, with d = x - point.

    Without a rest length L it pulls in all directions alike, F = -k d - c v: the harmonic oscillator. Stiffness [N/m],
    damping [kg/s].

    Example:
        >>> print(forces.Anchor(point=(1.0, 8.0), stiffness=5.0)(0.0, ball, shot.mass))
        [  5. -10.]
    """

    point: Float[Array, "..."] = quantity("anchor point", "m", kind="place")
    stiffness: Float[Array, "..."] = quantity("stiffness", "N/m", at_least=0)
    rest_length: Float[Array, "..."] | None = quantity("rest length", "m", at_least=0, default=None)
    damping: Float[Array, "..."] | None = quantity("damping", "kg/s", at_least=0, default=None)

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """The pull of the spring [N]."""
        d = state.position - broadcast_vector(self.point, state.position)
        if self.rest_length is None:
            pull = scale(-self.stiffness, d)
            return pull if self.damping is None else pull - scale(self.damping, state.velocity)
        along = unit(d)
        tension = self.stiffness * (norm(d) - self.rest_length)
        if self.damping is not None:
            tension = tension + self.damping * dot(state.velocity, along)
        return scale(-tension, along)

    def potential(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes"]:
        """½k(|d| - L)² [J]."""
        d = state.position - broadcast_vector(self.point, state.position)
        return 0.5 * self.stiffness * (dot(d, d) if self.rest_length is None else (norm(d) - self.rest_length) ** 2)


def independent(force: Callable) -> Function:
    """Say of a plain function `(t, state, mass) -> newtons` that no lane's force depends on another lane.

    The run then has a status and may have a step for each lane; a bare function counts as coupling.

    Example:
        >>> lift = forces.independent(lambda t, state, mass: 0.5 * state.velocity)
        >>> Scene(ball, forces=(lift,)).couples
        False
    """
    return Function(force, couples=False)


def _air_velocity(state: Particles, wind: Array | None) -> Array:
    """Velocity relative to the air."""
    return state.velocity if wind is None else state.velocity - broadcast_vector(wind, state.velocity)


def _broadcast_omega(omega: Array, r: Array) -> Array:
    """An angular velocity for every lane: a number in the plane, a vector in space."""
    return jnp.broadcast_to(omega, r.shape[:-1]) if r.shape[-1] == 2 else broadcast_vector(omega, r)
