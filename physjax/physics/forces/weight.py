"""Uniform gravity and the buoyancy that follows from it: one g and one upward axis for a whole scene."""

import math
from dataclasses import replace
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.checks import (
    NestedArrayLike,
    Numbers,
    OptionalNumbers,
    as_positive_integer,
    as_real_array,
    as_real_quantity,
    concrete_or_none,
    quantity,
)
from physjax.particles import Particles
from physjax.parts import Field, Force
from physjax.vectors import axis_vector, broadcast_vector, dot

EARTH_GRAVITY = 9.8
"""Gravity where nothing else is given [m/s²]."""


class Gravity(Field):
    """Weight near the ground: F = -m g ê_up, with g >= 0 [m/s²] and the upward axis `up` (0: x, 1: y, 2: z).

    A vector g instead, as other engines take it, is `Gravity(vector=(0.0, -9.8))`, one for all lanes or one per lane. Up
    is then the axis it points against most; for a traced vector that is not seen, so give `up` where it is not y. Other
    forces of the scene that need g or up (`Buoyancy`) use those of its `Gravity`. Raises ValueError for a negative g, for
    g and a vector together, and for an `up` that contradicts a vector along an axis.

    Example:
        >>> print(forces.Gravity()(0.0, ball, shot.mass))
        [ -0.  -19.6]
    """

    dissipative_symmetric: ClassVar[bool] = True
    g: OptionalNumbers = quantity("g", "m/s²", at_least=0, default=None)
    up: int = eqx.field(static=True, default=1)
    vector: OptionalNumbers = quantity("gravity", "m/s²", kind="vector", default=None)

    def __init__(
        self, g: NestedArrayLike | None = EARTH_GRAVITY, up: int | None = None, *, vector: NestedArrayLike | None = None
    ):
        up = None if up is None else check_axis(up)
        if vector is None:
            self.g, self.up, self.vector = _check_g(g), 1 if up is None else up, None
            return
        if g is not None and not (isinstance(g, float) and g == EARTH_GRAVITY):
            raise ValueError(
                f"Gravity: got both g = {g} and a vector, expected one of them: Gravity(vector=...) has its g."
            )
        vector = as_real_quantity("gravity [m/s²]", vector)
        # along an axis it is kept as a number: a scene then adds to one component, and g can be swept alone
        straight = _find_straight_axis(vector)
        if straight is None:
            self.g, self.up, self.vector = None, _find_steepest_axis(vector) if up is None else up, vector
            return
        self.g, self.up, self.vector = *straight, None
        if up not in (None, self.up):
            raise ValueError(
                f"Gravity: got up = {up}, but a vector down the axis {self.up}; expected one axis. Leave up out."
            )

    def acceleration(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """-g along the upward axis [m/s²]."""
        if self.g is None:
            return broadcast_vector(self._slanting_vector, state.velocity)
        return axis_vector(-self.g, self.up, state.velocity)

    def potential(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes"]:
        """m g y [J]."""
        if self.g is None:
            return -mass * dot(broadcast_vector(self._slanting_vector, state.position), state.position)
        return mass * self.g * state.position[..., self.up]

    @property
    def weight(self) -> tuple[Array | np.ndarray | None, int]:
        """g [m/s²] and the upward axis; g is None where gravity is not along an axis."""
        return self.g, self.up

    @property
    def _slanting_vector(self) -> Array:
        assert self.vector is not None  # there is a g or a vector
        return self.vector

    @staticmethod
    def hint_for_misfit(shape: tuple[int, ...]) -> str:
        """Advice for a g of a wrong shape: most often a vector was meant."""
        return "For a vector write Gravity(vector=...)." if len(shape) == 1 else ""


class Buoyancy(Force):
    """Archimedes' buoyancy: F = ρ_f V g upward, for a volume V of displaced fluid of density ρ_f [kg/m³].

    For an immersed body give `volume` [m³]. For a ball that crosses the fluid's surface give its `radius` r [m] and the
    height of the `surface` [m]: V = πh²(3r - h)/3 for a submerged depth h. g [m/s²] and the upward axis are those of the
    scene's `Gravity` unless given (without one: 9.8 m/s², y).

    Example:
        >>> print(forces.Buoyancy(density=1000.0, volume=0.002)(0.0, ball, shot.mass))
        [ 0.  19.6]
    """

    dissipative_symmetric: ClassVar[bool] = True
    density: Numbers = quantity("density of the fluid", "kg/m³", at_least=0)
    volume: OptionalNumbers = quantity("volume", "m³", at_least=0, default=None)
    radius: OptionalNumbers = quantity("radius", "m", above=0, default=None)
    surface: OptionalNumbers = quantity("surface of the fluid", "m", default=None)
    g: OptionalNumbers = quantity("g", "m/s²", at_least=0, default=None)
    up: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        if self.up is not None:
            check_axis(self.up)
        given = (self.volume is not None, self.radius is not None, self.surface is not None)
        if given not in ((True, False, False), (False, True, True)):
            raise ValueError(
                "Buoyancy: expected volume= (immersed), or radius= and surface= (a ball that crosses the surface); got "
                f"{[n for n, g in zip(('volume', 'radius', 'surface'), given, strict=True) if g] or 'none of them'}."
            )

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """ρ_f V g along the upward axis [N]."""
        return axis_vector(self.density * self._g * self.displaced_volume(state), self._up, state.velocity)

    def under(self, weight: tuple[ArrayLike | None, int]) -> "Buoyancy":
        """The buoyancy with g and the upward axis of the scene's gravity; ValueError where it was given others."""
        g, up = weight
        given, scene = (None if a is None else concrete_or_none(a) for a in (self.g, g))
        if (
            g is None
            or self.up not in (None, up)
            or (given is not None and scene is not None and np.any(given != scene))
        ):
            got = f"g = {'the same' if self.g is None else given} and up = {'the same' if self.up is None else self.up}"
            weighs = "a slanting vector" if g is None else f"g = {scene} and up = {up}"
            raise ValueError(
                f"Buoyancy: got {got}, but the scene's Gravity has {weighs}; expected one g and one axis for both. Leave "
                "them out of Buoyancy, which then takes those of the scene."
            )
        if self.g is not None and (given is None or scene is None):
            # traced numbers cannot raise: where they differ, the lane becomes NaN, which its status reports
            return replace(self, g=jnp.where(self.g == g, self.g, jnp.nan), up=up)
        return replace(self, g=g if self.g is None else self.g, up=up)

    def displaced_volume(self, state: Particles) -> Float[Array, "..."]:
        """Volume below the surface [m³]."""
        if self.volume is not None:
            return self.volume
        radius, depth = self._lowest_point(state)
        h = jnp.minimum(depth, 2 * radius)
        return math.pi / 3 * h**2 * (3 * radius - h)

    def potential(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes"]:
        """Energy of the displaced fluid [J]: minus the work of the buoyant force from the surface (immersed: from y = 0)."""
        if self.volume is not None:
            return -self.density * self._g * self.volume * state.position[..., self._up]
        r, depth = self._lowest_point(state)
        h = jnp.minimum(depth, 2 * r)
        return self.density * self._g * math.pi / 3 * (r * h**3 - h**4 / 4 + 4 * r**3 * (depth - h))

    def _lowest_point(self, state: Particles) -> tuple[Array, Array]:
        """Radius of the ball [m], and depth of its lowest point below the surface [m], at least 0."""
        assert self.surface is not None  # `__check_init__`: a volume, or both of these
        assert self.radius is not None
        return self.radius, jnp.maximum(self.surface - state.position[..., self._up] + self.radius, 0.0)

    @property
    def _g(self) -> ArrayLike:
        return EARTH_GRAVITY if self.g is None else self.g

    @property
    def _up(self) -> int:
        return 1 if self.up is None else self.up


def check_axis(up: int) -> int:
    """The upward axis as a Python int, 0 for x; TypeError or ValueError where it is not an axis."""
    return as_positive_integer("up (0: x, 1: y, 2: z)", up, at_least=0)


def _check_g(g: NestedArrayLike | None) -> Array:
    """g as a number >= 0; a vector or a negative g, as other engines take them, raises a ValueError with the right call."""
    value = as_real_array("g [m/s²]", g)
    number = concrete_or_none(value)
    if number is not None and np.any(number < 0):
        if number.ndim == 1 and number.shape[0] in (2, 3):
            call = f"For a vector write Gravity(vector={tuple(number.tolist())})"
        else:
            call = f"Write Gravity({abs(float(number.min())):g}), with up=2 where z is up"
        raise ValueError(f"g [m/s²]: got {number}, expected a number >= 0: gravity points down the axis `up`. {call}.")
    return as_real_quantity("g [m/s²]", value, at_least=0)


def _find_straight_axis(vector: Array) -> tuple[Array, int] | None:
    """g and the upward axis of a vector that points down the same axis in all lanes; None for others, and for a traced one."""
    values = concrete_or_none(vector)
    if values is None or not values.ndim or np.any(values > 0):
        return None
    axes = np.flatnonzero(np.any(values.reshape(-1, values.shape[-1]) != 0, axis=0))
    return (-vector[..., axes[0]], int(axes[0])) if len(axes) == 1 else None


def _find_steepest_axis(vector: Array) -> int:
    """The axis that a slanting vector points against most, summed over the lanes; y where it is traced or points up all axes."""
    values = concrete_or_none(vector)
    if values is None or values.ndim == 0 or values.shape[-1] == 1:
        return 1
    pull = values.reshape(-1, values.shape[-1]).sum(axis=0)
    return 1 if pull[1] == pull.min() or pull.min() >= 0 else int(np.argmin(pull))


__all__ = ["Buoyancy", "Gravity"]


def __dir__() -> list[str]:
    return __all__
