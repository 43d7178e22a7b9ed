"""Projectiles without drag, in closed form: flight, apex, range, and the angles that hit.

A shot leaves with `speed` [m/s] at `angle` [rad] above the horizontal; x is forward, y up, g > 0 [m/s²]. Every argument
is a number or an array; arrays broadcast, results follow their dtype, and everything works under `jit`, `vmap` and
`grad`. What is out of reach is NaN, with `ok` False where it is returned; it never raises and does not affect other
entries of a batch, not even their gradients. NaN angles and times are therefore accepted and passed on; other non-finite
numbers, and g or speed <= 0, raise ValueError where they are concrete; where they are traced, the result is NaN.

At the edge of reach two solutions meet and their derivatives are infinite, with opposite signs; there the derivative is
that of the mean of both, which is finite.

The lecture has gravity both as g = -9.8 and as -½gt²; here g is positive and the minus sign is in the formula.
"""

import math
import warnings
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from physjax.checks import as_real_array, as_real_quantity, concrete_or_none
from physjax.name_hints import hint_at_names
from physjax.vectors import norm, square_root

__all__ = [
    "Aim",
    "Arcs",
    "LeastSpeed",
    "angle_for_apex",
    "angles_for_range",
    "angles_for_target",
    "apex_height",
    "apex_time",
    "flight_time",
    "horizontal_range",
    "least_speed",
    "position",
    "velocity",
]

EDGE_ROUNDINGS = 8
"""A target beyond reach by no more than n units of rounding counts as being on the edge of reach."""

FULL_TURN = 2 * math.pi * (1 + 1e-6)
"""A full turn [rad], with room for float32's rounding: a larger angle was meant in degrees."""

_UNITS = {"t": "s", "speed": "m/s", "angle": "rad", "g": "m/s²"}


class Aim(NamedTuple):
    """An angle [rad], and whether there is one; NaN where there is none.

    Example:
        >>> aim = projectile.angle_for_apex(11.0, speed=14.0)
        >>> isinstance(aim, projectile.Aim), bool(aim.ok)
        (True, False)
    """

    angle: Float[Array, "..."]
    ok: Bool[Array, "..."]


class Arcs(NamedTuple):
    """The flat and the steep angle [rad] that hit a target, and whether it is in reach; NaN where it is not.

    Example:
        >>> arcs = projectile.angles_for_range(21.0, speed=14.0)
        >>> isinstance(arcs, projectile.Arcs), bool(arcs.ok)
        (True, False)
    """

    low: Float[Array, "..."]
    high: Float[Array, "..."]
    ok: Bool[Array, "..."]


class LeastSpeed(NamedTuple):
    """The smallest speed [m/s] that reaches a target, and the angle [rad] it takes.

    Example:
        >>> needed = projectile.least_speed(5.0, 0.0)
        >>> isinstance(needed, projectile.LeastSpeed), round(float(np.rad2deg(needed.angle)), 3)
        (True, 45.0)
    """

    speed: Float[Array, "..."]
    angle: Float[Array, "..."]


def position(
    t: ArrayLike, speed: ArrayLike, angle: ArrayLike, *, height: ArrayLike = 0.0, g: ArrayLike = 9.8
) -> Float[Array, "*lanes 2"]:
    """Position: x = s cosθ t, y = y₀ + s sinθ t - ½gt² [m].

    Example:
        >>> print(projectile.position(1.0, speed=10.0, angle=0.0, height=4.9))
        [10.  0.]
    """
    t, s, theta, y0, g = _check_numbers(t=t, speed=speed, angle=angle, height=height, g=g)
    return jnp.stack([s * jnp.cos(theta) * t, y0 + (s * jnp.sin(theta) - 0.5 * g * t) * t], axis=-1)


def velocity(t: ArrayLike, speed: ArrayLike, angle: ArrayLike, *, g: ArrayLike = 9.8) -> Float[Array, "*lanes 2"]:
    """Velocity: v = (s cosθ, s sinθ - gt) [m/s].

    Example:
        >>> print(projectile.velocity(1.0, speed=10.0, angle=0.0))
        [10.  -9.8]
    """
    t, s, theta, g = _check_numbers(t=t, speed=speed, angle=angle, g=g)
    return jnp.stack([s * jnp.cos(theta), s * jnp.sin(theta) - g * t], axis=-1)


def apex_time(speed: ArrayLike, angle: ArrayLike, *, g: ArrayLike = 9.8) -> Float[Array, "..."]:
    """Time of the apex: v_y - gt = 0, so t = v_y/g [s]; negative for a shot aimed down, which would have had it earlier.

    The lecture prints `y(t) = v_y t - g t² = 0`; it means the velocity, v(t) = v_y - g t = 0.

    Example:
        >>> round(float(projectile.apex_time(9.8, np.deg2rad(90.0))), 3)
        1.0
    """
    s, theta, g = _check_numbers(speed=speed, angle=angle, g=g)
    return s * jnp.sin(theta) / g


def apex_height(
    speed: ArrayLike, angle: ArrayLike, *, height: ArrayLike = 0.0, g: ArrayLike = 9.8
) -> Float[Array, "..."]:
    """How high the parabola reaches: y₀ + v_y²/2g [m].

    Example:
        >>> round(float(projectile.apex_height(14.0, np.deg2rad(90.0))), 3)
        10.0
    """
    s, theta, y0, g = _check_numbers(speed=speed, angle=angle, height=height, g=g)
    return y0 + (s * jnp.sin(theta)) ** 2 / (2.0 * g)


def flight_time(
    speed: ArrayLike,
    angle: ArrayLike,
    *,
    height: ArrayLike = 0.0,
    target_height: ArrayLike = 0.0,
    g: ArrayLike = 9.8,
) -> Float[Array, "..."]:
    """Time until it falls to the target's height: t = (v_y + √(v_y² + 2g(y₀ - y)))/g [s]; on level ground 2v_y/g.

    The later of the two crossings. NaN for a height that is not reached from the launch on.

    Example:
        >>> round(float(projectile.flight_time(9.8, np.deg2rad(90.0))), 3)
        2.0
    """
    s, theta, y0, y, g = _check_numbers(speed=speed, angle=angle, height=height, target_height=target_height, g=g)
    return _later_crossing(s * jnp.sin(theta), y0, y, g)


def horizontal_range(
    speed: ArrayLike,
    angle: ArrayLike,
    *,
    height: ArrayLike = 0.0,
    target_height: ArrayLike = 0.0,
    g: ArrayLike = 9.8,
) -> Float[Array, "..."]:
    """Horizontal distance until it falls to the target's height: v_x times the flight time [m]; on level ground 2v_x v_y/g.

    Negative for angles beyond a right angle; NaN for a height that is not reached.

    Example:
        >>> round(float(projectile.horizontal_range(14.0, np.deg2rad(45.0))), 3)
        20.0
    """
    s, theta, y0, y, g = _check_numbers(speed=speed, angle=angle, height=height, target_height=target_height, g=g)
    return s * jnp.cos(theta) * _later_crossing(s * jnp.sin(theta), y0, y, g)


def angle_for_apex(apex_height: ArrayLike, speed: ArrayLike, *, height: ArrayLike = 0.0, g: ArrayLike = 9.8) -> Aim:
    """The angle whose apex is at a given height [m]: θ = asin(√(2g(h - y₀))/s), not beyond a right angle.

    The lecture prints v_z under the root's sign; it is the vertical component, v_y. Computed as an
    arctangent, which keeps its digits near the vertical.

    Example:
        >>> round(float(np.rad2deg(projectile.angle_for_apex(2.5, speed=14.0).angle)), 3)
        30.0
    """
    h, s, y0, g = _check_numbers(apex_height=apex_height, speed=speed, height=height, g=g)
    rising = 2.0 * g * (h - y0)  # v_y²
    heights = 2.0 * g * (jnp.abs(h) + jnp.abs(y0))  # the scale of its rounding: what was subtracted
    up, above = _root_or_zero(rising, heights)
    forward, fast_enough = _root_or_zero(s * s - rising, s * s + heights)
    ok = above & fast_enough
    theta = jnp.arctan2(jnp.where(ok, up, 0.0), jnp.where(ok, forward, 1.0))
    return Aim(_nan_unless(ok, theta), ok)


def angles_for_range(distance: ArrayLike, speed: ArrayLike, *, g: ArrayLike = 9.8) -> Arcs:
    """The angles that come down at a distance [m] on level ground: θ = ½ asin(rg/s²) and its complement to a right angle.

    A distance behind (negative) has the mirrored angles, beyond a right angle.

    Example:
        >>> arcs = projectile.angles_for_range(10.0, speed=14.0)
        >>> round(float(np.rad2deg(arcs.low)), 3), round(float(np.rad2deg(arcs.high)), 3)
        (15.0, 75.0)
    """
    r, s, g = _check_numbers(distance=distance, speed=speed, g=g)
    sine = g * r / (s * s)
    cosine, ok = _root_or_zero((1.0 - sine) * (1.0 + sine), 1.0)
    half = 0.5 * jnp.arctan2(jnp.where(ok, sine, 0.0), cosine)
    return Arcs(_nan_unless(ok, jnp.where(sine < 0, math.pi + half, half)), _nan_unless(ok, 0.5 * math.pi - half), ok)


def angles_for_target(distance: ArrayLike, rise: ArrayLike, speed: ArrayLike, *, g: ArrayLike = 9.8) -> Arcs:
    """The angles that hit a target at (r, Δy) [m] from the launch: tanθ = (s² ± √(s⁴ - g(gr² + 2Δy s²)))/(gr).

    The low arc is the root without cancellation, tanθ = (gr² + 2Δy s²)/(r(s² + √…)), good to the last digits at any
    distance. Both arcs go straight up to a target overhead, and to one straight below the low arc goes down and the
    high arc up first. A target behind (r < 0) has the mirrored angles, beyond a right angle. At the launch point itself
    the answers are those of a near point on level ground, 0 and a right angle.

    Example:
        >>> arcs = projectile.angles_for_target(10.0, 5.0, speed=14.0)
        >>> print(projectile.position(10.0 / (14.0 * np.cos(arcs.low)), 14.0, arcs.low))
        [10.  5.]
    """
    r, rise, s, g = _check_numbers(distance=distance, rise=rise, speed=speed, g=g)
    a, b = g * r / (s * s), g * rise / (s * s)  # the formula divided by s²: a tanθ = 1 ± √(1 - 2b - a²)
    root, ok = _root_or_zero(1.0 - 2.0 * b - a * a, 1.0 + 2.0 * jnp.abs(b) + a * a)
    # out of reach the formula is evaluated at a harmless point, or its NaN would spoil the gradients of the others
    a, b = jnp.where(ok, a, 1.0), jnp.where(ok, b, 0.0)
    here = (a == 0) & (b == 0)
    rises, runs = a * a + 2.0 * b, a * (1.0 + root)
    low = jnp.arctan2(jnp.where(here, a, rises), jnp.where(here, 1.0 + root, runs))
    return Arcs(_nan_unless(ok, low), _nan_unless(ok, jnp.arctan2(1.0 + root, a)), ok)


def least_speed(distance: ArrayLike, rise: ArrayLike, *, g: ArrayLike = 9.8) -> LeastSpeed:
    """The slowest shot that still hits a target at (r, Δy) [m]: s² = g(Δy + √(r² + Δy²)), halfway between target and vertical.

    θ = π/4 + ½ atan(Δy/r), mirrored for a target behind (r < 0). A target straight below needs no speed at all.

    Example:
        >>> round(float(projectile.least_speed(20.0, 0.0).speed), 3)
        14.0
    """
    r, rise, g = _check_numbers(distance=distance, rise=rise, g=g)
    behind = r < 0
    r = jnp.where(behind, -r, r)  # not abs, whose derivative at 0 is 0
    away = norm(jnp.stack([r, rise], axis=-1))
    below = rise < 0
    square = jnp.where(
        below, r * r / jnp.where(below, away - rise, 1.0), away + rise
    )  # each without cancellation on its side
    speed, _ = _root_or_zero(g * square, 0.0)
    theta = 0.25 * math.pi + 0.5 * jnp.arctan2(rise, jnp.where((r == 0) & (rise == 0), 1.0, r))
    return LeastSpeed(speed, jnp.where(behind, math.pi - theta, theta))


def _check_numbers(**given: ArrayLike) -> tuple[Array, ...]:
    """The numbers as arrays of one shape; bad ones raise where they are concrete and become NaN where they are traced."""
    arrays = {name: _check_number(name, value) for name, value in given.items()}
    if "angle" in arrays:
        _warn_of_degrees(concrete_or_none(arrays["angle"]))
    try:
        return tuple(jnp.broadcast_arrays(*arrays.values()))  # a list in older versions
    except ValueError as error:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
        raise ValueError(f"projectile: got {shapes}, expected shapes that broadcast together.") from error


def _warn_of_degrees(angle: np.ndarray | None) -> None:
    """Warn of an angle of more than a full turn, which is usually one in degrees."""
    if angle is not None and np.any(np.abs(angle) > FULL_TURN):
        worst = angle.flat[np.nanargmax(np.abs(angle))]
        words = f"angle [rad]: got {worst:g}, more than a full turn; expected radians. For degrees use np.deg2rad."
        warnings.warn(words, stacklevel=4)


def _check_number(name: str, value: ArrayLike) -> Array:
    label = f"{name} [{_UNITS.get(name, 'm')}]"
    if name in ("angle", "t"):
        return as_real_array(label, value)
    if name not in ("speed", "g"):
        return as_real_quantity(label, value)
    array = as_real_quantity(label, value, above=0)
    return jnp.where(array > 0, array, jnp.nan) if concrete_or_none(array) is None else array


def _later_crossing(v_y: Array, y0: Array, y: Array, g: Array) -> Array:
    """The later solution of y₀ + v_y t - ½gt² = y; NaN where it is before the launch or does not exist."""
    fall = y0 - y
    root, crosses = _root_or_zero(v_y * v_y + 2.0 * g * fall, v_y * v_y + 2.0 * g * (jnp.abs(y0) + jnp.abs(y)))
    down = v_y < 0
    falling = 2.0 * fall / jnp.where(down, root - v_y, 1.0)  # the same root without cancellation
    return _nan_unless(crosses & ~(down & (fall < 0)), jnp.where(down, falling, (v_y + root) / g))


def _root_or_zero(square: Array, scale: ArrayLike) -> tuple[Array, Array]:
    """The square root and whether it is real: 0 where negative within rounding relative to `scale`, a stand-in of 1 beyond."""
    slack = EDGE_ROUNDINGS * float(jnp.finfo(square.dtype).eps) * scale
    real = square >= -slack
    return square_root(jnp.where(real, jnp.maximum(square, 0.0), 1.0)), real


def _nan_unless(ok: Array, value: Array) -> Array:
    return jnp.where(ok, value, jnp.nan)


def __dir__() -> list[str]:
    return __all__


hint_at_names(__name__)
