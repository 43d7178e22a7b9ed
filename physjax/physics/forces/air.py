"""Air that is not the same everywhere, and the lift of balls that spin in it."""

import math
from collections.abc import Callable

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.checks import Numbers, OptionalNumbers, quantity
from physjax.particles import Particles
from physjax.parts import Force, as_module
from physjax.vectors import broadcast_vector, norm, scale, spin

SMALLEST_SPEED = 1e-12
"""A speed [m/s] of nothing, added where speeds divide: two derivatives of its inverse still fit in float32."""


class InAir(Force):
    """A drag or lift in air whose wind and density change with time and place.

    `wind(t, position)` [m/s] is a vector for each lane; the force then sees the velocity relative to it. `thinning(t,
    position)` [1] is the density as a share of the force's own, such as `jnp.exp(-position[..., 1] / 8500.0)`: it scales
    the force, as is right for `QuadraticDrag`, `TabulatedDrag`, `Magnus` and `SpinLift`, not for `SphereDrag`. t [s] is
    a scalar or per lane. Numbers of a function that is an `equinox.Module` can be swept and differentiated. Raises
    TypeError for what are no functions, ValueError where neither is given.

    Example:
        >>> drag = forces.QuadraticDrag(area=0.2, coefficient=1.0, density=2.0)
        >>> print(drag(0.0, ball, shot.mass))
        [-3. -4.]
        >>> gusts = forces.InAir(drag, wind=lambda t, x: jnp.array([1.0, 0.0]) * x[..., 1:] / 10)
        >>> high = forces.InAir(drag, thinning=lambda t, x: jnp.where(x[..., 1] > 5.0, 0.5, 1.0))
        >>> print(high(0.0, ball, shot.mass))
        [-1.5 -2. ]
    """

    force: Force
    wind: Callable | None
    thinning: Callable | None

    def __init__(self, force: Force, wind: Callable | None = None, thinning: Callable | None = None):
        if not isinstance(force, Force):
            raise TypeError(f"InAir: got the force {force!r}, expected one such as forces.QuadraticDrag(4.3e-3, 0.35).")
        for name, function in (("wind", wind), ("thinning", thinning)):
            if function is not None and (not callable(function) or isinstance(function, type)):
                raise TypeError(f"InAir: got {name}={function!r}, expected a function (t, position) of time and place.")
        if wind is None and thinning is None:
            raise ValueError("InAir: got neither wind= nor thinning=, expected at least one function (t, position).")
        self.force = force
        self.wind = None if wind is None else as_module(wind)
        self.thinning = None if thinning is None else as_module(thinning)

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """The force [N] at the velocity relative to the wind, times the share of the density."""
        x, v = state
        if self.wind is not None:
            v = v - self._ask("wind", self.wind, t, x, v.shape)
        push = self.force(t, Particles(x, v), mass)
        return push if self.thinning is None else scale(self._ask("thinning", self.thinning, t, x, v.shape[:-1]), push)

    def _ask(self, name: str, function: Callable, t: ArrayLike, position: Array, shape: tuple[int, ...]) -> Array:
        """What a function of time and place returns for each lane."""
        found = jnp.asarray(function(t, position), position.dtype)
        if found.ndim > len(shape) or found.shape != shape[len(shape) - found.ndim :]:
            raise ValueError(
                f"InAir: got {name}(t, position) of shape {found.shape} for positions of shape {position.shape}, expected "
                f"{shape}."
            )
        return jnp.broadcast_to(found, shape)


class SpinLift(Force):
    """Lift of a spinning ball by how fast it spins: F = ½ρAC_L |v|² ω̂×v̂ with C_L = S/(a + bS), S = r|ω|/|v|.

    `angular_velocity` ω [rad/s] is a vector in space, a number in the plane (> 0: anticlockwise); radius r [m], density of
    the fluid ρ [kg/m³], v relative to the wind [m/s]. `offset` a = 0.4 and `slope` b = 2.32 fit measured baseballs
    (A. M. Nathan, Am. J. Phys. 76 (2008) 119). Nothing divides by zero where the ball neither moves nor spins.

    Example:
        >>> lift = forces.SpinLift(radius=0.037, angular_velocity=100.0)(0.0, ball, shot.mass)
        >>> print(jnp.round(1000 * lift, 1))
        [-18.4  13.8]
    """

    radius: Numbers = quantity("radius", "m", above=0)
    angular_velocity: Numbers = quantity("angular velocity", "rad/s", kind="axial")
    density: Numbers = quantity("density of the fluid", "kg/m³", at_least=0, default=1.225)
    wind: OptionalNumbers = quantity("wind", "m/s", kind="vector", default=None)
    offset: Numbers = quantity("offset a of the lift", "1", above=0, default=0.4, kw_only=True)
    slope: Numbers = quantity("slope b of the lift", "1", at_least=0, default=2.32, kw_only=True)

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """½ρA r |v|/(a|v| + b r|ω|) ω×v [N], v relative to the wind."""
        v = state.velocity if self.wind is None else state.velocity - broadcast_vector(self.wind, state.velocity)
        omega = self.angular_velocity
        rate = jnp.abs(omega) if v.shape[-1] == 2 else norm(broadcast_vector(omega, v))
        speed, rim = norm(v), self.radius * rate
        share = speed / (self.offset * speed + self.slope * rim + SMALLEST_SPEED)
        return scale(0.5 * math.pi * self.density * self.radius**3 * share, spin(omega, v))


__all__ = ["InAir", "SpinLift"]
