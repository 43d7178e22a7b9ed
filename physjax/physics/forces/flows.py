"""Velocity fields that carry particles along, and a centre of attraction.

A flow gives the velocity u of the air, `flow(t, position)` [m/s]. As a force it is b u, the part of Stokes' drag
-b (v - u) due to the air's motion, to be used together with a `StokesDrag` of the same coefficient b [kg/s].
"""

import math
from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.checks import Numbers, OptionalNumbers, as_positive_integer, quantity, unchecked_quantity
from physjax.name_hints import hint_at_names
from physjax.particles import Particles
from physjax.parts import Field, Force
from physjax.vectors import broadcast_vector, components, cross, dot, norm, scale, stack_components, turn_left, unit


class Flow(Force):
    """The drag due to moving air: F = b u(t, x), to be used together with `StokesDrag(b)`.

    A flow of your own gives `flow` and has a field `coefficient`, b [kg/s].

    Example:
        >>> class Wind(fields.Flow):
        ...     coefficient: float
        ...     def flow(self, t, position):
        ...         return jnp.full_like(position, 4.0)
        >>> print(Wind(0.5)(0.0, ball, shot.mass))
        [2. 2.]
    """

    coefficient: eqx.AbstractVar[Numbers]

    @abstractmethod
    def flow(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """Velocity of the air [m/s]."""

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """b u [N]."""
        return scale(self.coefficient, self.flow(t, state.position))


class Turbulence(Flow):
    """Incompressible turbulence: u = Σ aᵢ cos(kᵢ·x + ωᵢt + φᵢ) with every aᵢ normal to its kᵢ, so that ∇·u = 0 exactly.

    `speed` [m/s] is the root mean square of |u| over time and space. Eddies are about `size` [m] wide: |kᵢ| is uniform
    from 0.5 to 1.5 times 2π/size, and ωᵢ = |kᵢ| speed. A few random Fourier `modes` after R. H. Kraichnan, "Diffusion by a
    random velocity field", Phys. Fluids 13 (1970) 22. `key` is a seed or a `jax.random.key`; `dim` is 2 or 3.

    Example:
        >>> eddies = fields.Turbulence(coefficient=1.0, speed=2.0, size=0.5, key=0, dim=2)
        >>> slopes = jax.jit(jax.jacfwd(lambda x: eddies.flow(0.0, x)))(ball.position)
        >>> bool(abs(slopes[0, 0] + slopes[1, 1]) < 1e-4)
        True
    """

    coefficient: Numbers = quantity("drag coefficient b", "kg/s", at_least=0)
    speed: Numbers = quantity("speed of the eddies", "m/s", per=None, at_least=0)
    size: Numbers = quantity("size of the eddies", "m", per=None, above=0)
    waves: Float[Array, "modes dim"] = unchecked_quantity("wave vectors", "1/m", kind="vector", per=None)
    amplitudes: Float[Array, "modes dim"] = unchecked_quantity("amplitudes", kind="vector", per=None)
    phases: Float[Array, "modes"] = unchecked_quantity("phases", "rad", per=None)

    def __init__(
        self,
        coefficient: ArrayLike,
        speed: ArrayLike,
        size: ArrayLike,
        *,
        key: int | Array,
        dim: int = 3,
        modes: int = 8,
    ):
        if dim not in (2, 3):
            raise ValueError(f"Turbulence: got dim {dim}, expected 2 or 3.")
        self.coefficient, self.speed, self.size = coefficient, speed, size
        modes = as_positive_integer("modes", modes)
        key = jax.random.key(key) if isinstance(key, int) else key
        along, across, long, late = jax.random.split(key, 4)
        waves = unit(jax.random.normal(along, (modes, dim)))
        # any direction normal to the wave vector: in space a random one around it
        other = turn_left(waves) if dim == 2 else unit(cross(waves, jax.random.normal(across, (modes, dim))))
        # each mode has the mean square a²/2, and all of them together 1
        self.amplitudes = math.sqrt(2 / modes) * other
        self.waves = scale(2 * math.pi * jax.random.uniform(long, (modes,), minval=0.5, maxval=1.5), waves)
        self.phases = 2 * math.pi * jax.random.uniform(late, (modes,))

    def flow(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """The sum of the modes [m/s]."""
        x = components(position / self.size)
        turned = jnp.asarray(t, position.dtype) * (self.speed / self.size)
        total = [jnp.zeros_like(x[0])] * len(x)
        for i in range(self.phases.shape[0]):
            wave, pace = components(self.waves[i]), norm(self.waves[i])
            swing = jnp.cos(sum(k * a for k, a in zip(wave, x, strict=True)) + (pace * turned + self.phases[i]))
            total = [u + a * swing for u, a in zip(total, components(self.amplitudes[i]), strict=True)]
        return self.speed * stack_components(total)


SMALLEST_CORE_RATIO = 1e-12
"""r²/c² below which a vortex turns as a solid body [1]: its difference from one is less than half of that."""


class Vortex(Flow):
    """A Lamb-Oseen vortex: azimuthal u = Γ/(2πr)·(1 - exp(-r²/c²)), solid rotation within the core radius c [m].

    A `circulation` Γ > 0 [m²/s] turns anticlockwise about the `axis` through the `center`: a vector in space, absent in
    the plane.

    Example:
        >>> whirl = fields.Vortex(coefficient=1.0, circulation=20.0 * np.pi, core=0.1, center=(0.0, 0.0))
        >>> print(whirl(0.0, ball, shot.mass))
        [-1.  0.]
    """

    coefficient: Numbers = quantity("drag coefficient b", "kg/s", at_least=0)
    circulation: Numbers = quantity("circulation", "m²/s")
    core: Numbers = quantity("radius of the core", "m", above=0)
    center: Numbers = quantity("center of the vortex", "m", kind="place")
    axis: OptionalNumbers = quantity("axis of the vortex", "1", kind="vector", default=None)

    def __check_init__(self):
        if (self.axis is None) != (self.center.shape[-1:] == (2,)):
            raise ValueError(
                f"Vortex: got center {self.center.shape} and axis {None if self.axis is None else self.axis.shape}, "
                "expected an axis in space, none in the plane."
            )

    def flow(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """Γ/(2πr²)·(1 - exp(-r²/c²)) n × r [m/s]."""
        away = position - broadcast_vector(self.center, position)
        around = turn_left(away) if self.axis is None else cross(broadcast_vector(unit(self.axis), position), away)
        turns = dot(around, around) / self.core**2
        # (1 - e^-s)/s is 1 - s/2 + ...: 1 to rounding long before 0/0 threatens, and its derivative stays finite
        small = turns < SMALLEST_CORE_RATIO
        share = jnp.where(small, 1.0, -jnp.expm1(-turns) / jnp.where(small, 1.0, turns))
        return scale(self.circulation / (2 * math.pi * self.core**2) * share, around)


class Attractor(Field):
    """Gravitation of a fixed centre: a = -μ d/(d² + ε²)^(3/2), d from the `center` [m]; `strength` μ = GM [m³/s²].

    Plummer's `softening` ε [m] keeps the acceleration finite at the centre.

    Example:
        >>> sun = fields.Attractor(strength=1000.0, softening=1e-3, center=(0.0, 0.0))
        >>> print(sun.acceleration(0.0, ball, shot.mass))
        [ -0. -10.]
    """

    strength: Numbers = quantity("strength μ", "m³/s²")
    softening: Numbers = quantity("softening", "m", above=0)
    center: Numbers = quantity("center of the attractor", "m", kind="place")

    def acceleration(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """-μ d/(d² + ε²)^(3/2) [m/s²]."""
        d = state.position - broadcast_vector(self.center, state.position)
        near = 1 / jnp.sqrt(dot(d, d) + self.softening**2)
        return scale(-self.strength * near**3, d)

    def potential(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes"]:
        """-mμ/√(d² + ε²) [J]."""
        d = state.position - broadcast_vector(self.center, state.position)
        return -mass * self.strength / jnp.sqrt(dot(d, d) + self.softening**2)


__all__ = ["Attractor", "Flow", "Turbulence", "Vortex"]


def __dir__() -> list[str]:
    return __all__


hint_at_names(__name__)
