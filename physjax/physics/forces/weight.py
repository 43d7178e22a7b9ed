"""Gravity near the ground, and the lift of a fluid that it presses: one g and one axis that is up for a whole scene."""

import math
from dataclasses import replace
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.checks import as_positive_integer, as_real_array, as_real_quantity, concrete_or_none, quantity
from physjax.particles import Particles
from physjax.parts import Field, Force
from physjax.vectors import axis_vector, broadcast_vector, dot

EARTH_GRAVITY = 9.8
"""Standard gravity as the lecture has it [m/s²]."""


class Gravity(Field):
    """Weight near the ground: F = m g, down the axis `up` (1: y). The lecture prints g = -9.8; here g > 0 and up is up.

    `g` is a number >= 0; a whole vector, as other engines take it, is `Gravity(vector=(0.0, -9.8))`, one for all lanes or
    one per lane. Up is then the axis against which it pulls most; a traced one has to be told (`up=2`) where that is not
    y. Of a scene, other forces that need g or up (`Buoyancy`) take those of its `Gravity`. Raises ValueError for a
    negative g, a g beside a vector, and an axis that a straight vector does not point down.

    Example:
        >>> print(forces.Gravity()(0.0, ball, shot.mass))
        [ -0.  -19.6]
    """

    dissipative_symmetric: ClassVar[bool] = True
    g: Float[Array, "..."] | None = quantity("g", "m/s²", at_least=0, default=None)
    up: int = eqx.field(static=True, default=1)
    vector: Float[Array, "..."] | None = quantity("gravity", "m/s²", kind="vector", default=None)

    def __init__(self, g: Any = 9.8, up: int | None = None, *, vector: Any = None):
        up = None if up is None else check_axis(up)
        if vector is None:
            self.g, self.up, self.vector = _check_g(g), 1 if up is None else up, None
            return
        if g is not None and not (isinstance(g, float) and g == EARTH_GRAVITY):
            raise ValueError(
                f"Gravity: got both g = {g} and a vector, expected one of them: Gravity(vector=...) has its g."
            )
        self.vector = as_real_quantity("gravity [m/s²]", vector)
        straight = _find_straight_axis(self.vector)
        if straight is None:
            self.g, self.up = None, _find_steepest_axis(self.vector) if up is None else up
            return
        self.g, self.up, self.vector = *straight, None
        if up not in (None, self.up):
            raise ValueError(
                f"Gravity: got up = {up}, but a vector down the axis {self.up}; expected one axis. Leave up out."
            )

    def acceleration(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """-g along the upward axis [m/s²]."""
        if self.vector is not None:
            return broadcast_vector(self.vector, state.velocity)
        return axis_vector(-self.g, self.up, state.velocity)

    def potential(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes"]:
        """m g y [J]."""
        if self.vector is not None:
            return -mass * dot(broadcast_vector(self.vector, state.position), state.position)
        return mass * self.g * state.position[..., self.up]

    @property
    def weight(self) -> tuple[Any, int]:
        """g [m/s²] and the axis that is up; of a slanting gravity no g."""
        return self.g, self.up

    @staticmethod
    def hint_for_misfit(shape: tuple[int, ...]) -> str:
        """What to write for a g of a wrong shape: most often it was meant as a vector."""
        return "For a vector write Gravity(vector=...)." if len(shape) == 1 else ""


class Buoyancy(Force):
    """Archimedes: F = ρ_f V g, upward (the lecture prints a minus sign). V is the volume of fluid displaced.

    g and the axis that is up are those of the scene's `Gravity` unless given (without one: 9.8 m/s², y). Immersed: give
    `volume` [m³]. A ball that crosses the fluid's surface: give its `radius` [m] and the height `surface` [m] of the
    fluid; the part below it counts, V = πh²(3r - h)/3 for a submerged depth h.

    Example:
        >>> print(forces.Buoyancy(density=1000.0, volume=0.002)(0.0, ball, shot.mass))
        [ 0.  19.6]
    """

    dissipative_symmetric: ClassVar[bool] = True
    density: Float[Array, "..."] = quantity("density of the fluid", "kg/m³", at_least=0)
    volume: Float[Array, "..."] | None = quantity("volume", "m³", at_least=0, default=None)
    radius: Float[Array, "..."] | None = quantity("radius", "m", above=0, default=None)
    surface: Float[Array, "..."] | None = quantity("surface of the fluid", "m", default=None)
    g: Float[Array, "..."] | None = quantity("g", "m/s²", at_least=0, default=None)
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

    def under(self, weight: tuple[Any, int]) -> "Buoyancy":
        """The buoyancy under the scene's weight, whose g and axis it takes over; ValueError where it was told others."""
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
            # traced numbers cannot raise: where they differ, the lane is spoilt
            return replace(self, g=jnp.where(self.g == g, self.g, jnp.nan), up=up)
        return replace(self, g=g if self.g is None else self.g, up=up)

    def displaced_volume(self, state: Particles) -> Float[Array, "..."]:
        """Volume below the surface [m³]."""
        if self.surface is None:
            return self.volume
        h = jnp.minimum(self._depth(state), 2 * self.radius)
        return math.pi / 3 * h**2 * (3 * self.radius - h)

    def potential(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes"]:
        """Energy of the displaced fluid [J]: minus the work of the buoyant force from the surface (or from y = 0) to here."""
        if self.surface is None:
            return -self.density * self._g * self.volume * state.position[..., self._up]
        depth, r = self._depth(state), self.radius
        h = jnp.minimum(depth, 2 * r)
        return self.density * self._g * math.pi / 3 * (r * h**3 - h**4 / 4 + 4 * r**3 * (depth - h))

    def _depth(self, state):
        """Depth of the ball's lowest point."""
        return jnp.maximum(self.surface - state.position[..., self._up] + self.radius, 0.0)

    @property
    def _g(self) -> ArrayLike:
        return EARTH_GRAVITY if self.g is None else self.g

    @property
    def _up(self) -> int:
        return 1 if self.up is None else self.up


def check_axis(up: Any) -> int:
    """An axis as a Python int, 0 for x; TypeError or ValueError for what is none."""
    return as_positive_integer("up (0: x, 1: y, 2: z)", up, at_least=0)


def _check_g(g: Any) -> Array:
    """g as a number >= 0; what other engines are given, a vector or a negative number, gets an error with the right call."""
    value = as_real_array("g [m/s²]", g)
    number = concrete_or_none(value)
    if number is not None and np.any(number < 0):
        if number.ndim == 1 and number.shape[0] in (2, 3):
            call = f"For a vector write Gravity(vector={tuple(number.tolist())})"
        else:
            call = f"Write Gravity({abs(float(number.min())):g}), with up=2 where z is up"
        raise ValueError(f"g [m/s²]: got {number}, expected a number >= 0: gravity points down by itself. {call}.")
    return as_real_quantity("g [m/s²]", value, at_least=0)


def _find_straight_axis(vector: Array) -> tuple[Array, int] | None:
    """g and the axis that is up of a gravity that points straight down one axis in all lanes; None of others, or a traced one."""
    values = concrete_or_none(vector)
    if values is None or not values.ndim or np.any(values > 0):
        return None
    axes = np.flatnonzero(np.any(values.reshape(-1, values.shape[-1]) != 0, axis=0))
    return (-vector[..., axes[0]], int(axes[0])) if len(axes) == 1 else None


def _find_steepest_axis(vector: Array) -> int:
    """The axis against which a slanting gravity pulls most, over all lanes; y of one that is traced, or pulls along axes only."""
    values = concrete_or_none(vector)
    if values is None or values.ndim == 0 or values.shape[-1] == 1:
        return 1
    pull = values.reshape(-1, values.shape[-1]).sum(axis=0)
    return 1 if pull[1] == pull.min() or pull.min() >= 0 else int(np.argmin(pull))
