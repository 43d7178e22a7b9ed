"""Forces that depend on position and velocity alone: drag, lift, the loads of a rotating frame, a spring to a point.

A number is a scalar or has the shape of the lanes, a vector is `(dim,)` or one per lane. Values and derivatives are
finite at rest and at coincident points.
"""

import math
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.checks import NestedArrayLike, Numbers, OptionalNumbers, quantity
from physjax.particles import Particles
from physjax.parts import Field, Force, Function
from physjax.vectors import broadcast_vector, dot, norm, scale, spin, unit

LOWEST_REYNOLDS_NUMBER = 1e-24
"""Re^0.681 has an infinite slope at rest; from this Reynolds number on two derivatives of it still fit in float32."""


class StokesDrag(Force):
    """Drag at low velocity, creeping flow past a sphere: F = -b v with b = 6πηr [kg/s], v relative to the wind [m/s].

    Example:
        >>> print(forces.StokesDrag(0.5, wind=(1.0, 0.0))(0.0, ball, shot.mass))
        [-1. -2.]
    """

    dissipative_symmetric: ClassVar[bool] = True
    coefficient: Numbers = quantity("drag coefficient b", "kg/s", at_least=0)
    wind: OptionalNumbers = quantity("wind", "m/s", kind="vector", default=None)

    @classmethod
    def of_sphere(
        cls, radius: ArrayLike, viscosity: ArrayLike = 1.81e-5, wind: NestedArrayLike | None = None
    ) -> "StokesDrag":
        """The drag of a sphere: b = 6πηr, radius [m], viscosity [Pa s] (by default that of air at 20 °C)."""
        return cls(6 * math.pi * viscosity * jnp.asarray(radius), wind)

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """-b (v - wind) [N]."""
        return scale(-self.coefficient, _relative_velocity(state, self.wind))


class QuadraticDrag(Force):
    """Drag at high velocity: F = -½ρC_dA |v| v, v relative to the wind [m/s].

    Area A [m²], drag coefficient C_d [1], density of the fluid ρ [kg/m³].

    Example:
        >>> print(forces.QuadraticDrag(area=0.2, coefficient=1.0, density=2.0)(0.0, ball, shot.mass))
        [-3. -4.]
    """

    dissipative_symmetric: ClassVar[bool] = True
    area: Numbers = quantity("area", "m²", at_least=0)
    coefficient: Numbers = quantity("drag coefficient C_d", "1", at_least=0)
    density: Numbers = quantity("density of the fluid", "kg/m³", at_least=0, default=1.225)
    wind: OptionalNumbers = quantity("wind", "m/s", kind="vector", default=None)

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """-½ρC_dA |v - wind| (v - wind) [N]."""
        v = _relative_velocity(state, self.wind)
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
    radius: Numbers = quantity("radius", "m", above=0)
    density: Numbers = quantity("density of the fluid", "kg/m³", above=0, default=1.204)
    viscosity: Numbers = quantity("viscosity", "Pa s", above=0, default=1.81e-5)
    wind: OptionalNumbers = quantity("wind", "m/s", kind="vector", default=None)

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """The corrected Stokes force [N]."""
        v = _relative_velocity(state, self.wind)
        reynolds = 2 * self.density * self.radius / self.viscosity * norm(v)
        reynolds = jnp.maximum(reynolds, LOWEST_REYNOLDS_NUMBER)
        correction = 1 + 0.15 * reynolds**0.681 + (0.407 / 24) * reynolds**2 / (reynolds + 8710)
        return scale(-6 * math.pi * self.viscosity * self.radius * correction, v)


class Magnus(Force):
    """Lift of a spinning ball: F = ½ρAC_L |v|² ω̂×v̂, at right angles to the velocity, so that in still air it does no work.

    `axis` is the direction of the spin: a vector in space, a number in the plane (> 0: anticlockwise). Its magnitude does
    not matter. Area A [m²], lift coefficient C_L [1], density of the fluid ρ [kg/m³], wind [m/s].

    Example:
        >>> print(forces.Magnus(area=0.2, coefficient=1.0, axis=1.0, density=2.0)(0.0, ball, shot.mass))
        [-4.  3.]
    """

    area: Numbers = quantity("area", "m²", at_least=0)
    coefficient: Numbers = quantity("lift coefficient C_L", "1", at_least=0)
    axis: Numbers = quantity("spin axis", "1", kind="axial")
    density: Numbers = quantity("density of the fluid", "kg/m³", at_least=0, default=1.225)
    wind: OptionalNumbers = quantity("wind", "m/s", kind="vector", default=None)

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """½ρAC_L |v| ω̂×v [N], v relative to the wind."""
        v = _relative_velocity(state, self.wind)
        axis = jnp.sign(self.axis) if v.shape[-1] == 2 else unit(broadcast_vector(self.axis, v))
        return scale(0.5 * self.density * self.coefficient * self.area * norm(v), spin(axis, v))


class Lorentz(Force):
    """The force of electric and magnetic fields on a charge: F = q (E + v×B).

    Charge q [C]. The magnetic field B [T] is a vector in space; in the plane it is a number, its component towards the
    viewer. The electric field E [V/m] is a vector, by default none. Fields that depend on the place are a force of your
    own. `methods.boris` keeps the speed in a magnetic field to rounding; others lose or gain it.

    Example:
        >>> print(forces.Lorentz(charge=2.0, magnetic=1.5, electric=(1.0, 0.0))(0.0, ball, shot.mass))
        [14. -9.]
    """

    charge: Numbers = quantity("charge q", "C")
    magnetic: Numbers = quantity("magnetic field B", "T", kind="axial")
    electric: OptionalNumbers = quantity("electric field E", "V/m", kind="vector", default=None)

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """q (E + v×B) [N]."""
        field = -spin(self.magnetic, state.velocity)
        if self.electric is not None:
            field = field + broadcast_vector(self.electric, state.velocity)
        return scale(self.charge, field)


class RotatingFrame(Field):
    """The inertial forces of a rotating frame: centrifugal -mω×(ω×r), Coriolis -2mω×v and, where ω changes, Euler's -mω̇×r.

    `omega` [rad/s] at t = 0 is a vector in space, a number in the plane (> 0: anticlockwise); `omega_rate` [rad/s²] is its
    constant rate of change. Positions are measured from the axis.

    Example:
        >>> print(forces.RotatingFrame(omega=1.0)(0.0, ball, shot.mass))
        [16.  8.]
    """

    omega: Numbers = quantity("omega", "rad/s", kind="axial")
    omega_rate: OptionalNumbers = quantity("omega_rate", "rad/s²", kind="axial", default=None)

    def acceleration(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """-ω×(ω×r) - 2ω×v - ω̇×r [m/s²]."""
        r, v = state.position, state.velocity
        if self.omega_rate is None:
            return -spin(self.omega, spin(self.omega, r) + 2 * v)
        rate = _broadcast_omega(self.omega_rate, r)
        omega = _broadcast_omega(self.omega, r) + scale(t, rate)
        return -spin(omega, spin(omega, r) + 2 * v) - spin(rate, r)


class Anchor(Force):
    """A damped spring from a fixed point: F = -k (|d| - L) d̂ - c (v·d̂) d̂, with d = x - point.

    Without a rest length L [m] it is the isotropic harmonic oscillator, F = -k d - c v. Stiffness k [N/m], damping c
    [kg/s]. With `tension_only` it is a rope, which pulls where it is longer than L and is slack where it is not; damping
    then never makes it push. Raises ValueError for a rope without a rest length.

    Example:
        >>> print(forces.Anchor(point=(1.0, 8.0), stiffness=5.0)(0.0, ball, shot.mass))
        [  5. -10.]
        >>> rope = forces.Anchor(point=(3.0, 10.0), stiffness=5.0, rest_length=4.0, tension_only=True)
        >>> slack, taut = (Particles(jnp.array(place), jnp.zeros(2)) for place in ((3.0, 7.0), (0.0, 6.0)))
        >>> print(jnp.linalg.norm(rope(0.0, slack, shot.mass)), rope(0.0, taut, shot.mass))
        0.0 [3. 4.]
    """

    point: Numbers = quantity("anchor point", "m", kind="place")
    stiffness: Numbers = quantity("stiffness", "N/m", at_least=0)
    rest_length: OptionalNumbers = quantity("rest length", "m", at_least=0, default=None)
    damping: OptionalNumbers = quantity("damping", "kg/s", at_least=0, default=None)
    tension_only: bool = eqx.field(static=True, default=False, kw_only=True)

    def __check_init__(self):
        if self.tension_only and self.rest_length is None:
            raise ValueError(
                "Anchor: got tension_only=True without a rest length, expected rest_length= [m]: a rope is slack below it."
            )

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
        if self.tension_only:
            tension = jnp.where(norm(d) > self.rest_length, jnp.maximum(tension, 0.0), 0.0)
        return scale(-tension, along)

    def potential(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes"]:
        """½k(|d| - L)² [J], zero where a rope is slack."""
        d = state.position - broadcast_vector(self.point, state.position)
        if self.rest_length is None:
            return 0.5 * self.stiffness * dot(d, d)
        stretch = norm(d) - self.rest_length
        if self.tension_only:
            stretch = jnp.maximum(stretch, 0.0)
        return 0.5 * self.stiffness * stretch**2


def independent(force: Callable[..., Array]) -> Function:
    """A plain function `(t, state, mass) -> newtons`, declared to give each lane a force that depends on that lane alone.

    The run then has a status, and under an adaptive method a step size, for each lane. An undeclared function counts as
    coupling its lanes.

    Example:
        >>> lift = forces.independent(lambda t, state, mass: 0.5 * state.velocity)
        >>> Scene(ball, forces=(lift,)).couples
        False
    """
    return Function(force, couples=False)


def _relative_velocity(state: Particles, wind: Array | None) -> Array:
    """Velocity relative to the air [m/s]."""
    return state.velocity if wind is None else state.velocity - broadcast_vector(wind, state.velocity)


def _broadcast_omega(omega: Array, r: Array) -> Array:
    """An angular velocity per lane [rad/s]: a number in the plane, a vector in space."""
    return jnp.broadcast_to(omega, r.shape[:-1]) if r.shape[-1] == 2 else broadcast_vector(omega, r)


__all__ = ["Anchor", "Lorentz", "Magnus", "QuadraticDrag", "RotatingFrame", "SphereDrag", "StokesDrag", "independent"]


def __dir__() -> list[str]:
    return __all__
