"""How bodies in space rotate when no torque acts on them: by a splitting.

The rotational energy Σ ½ℓᵢ²/Iᵢ, with ℓ the angular momentum in the body frame, is |L|²/2I of a sphere plus what the moments
differ by. A sphere turns about L in space, whatever else the body does; the difference about two principal axes is split.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.backend import materialise
from physjax.physics.rigid.inertia import Inertia
from physjax.vectors import (
    broadcast_vector,
    components,
    conjugate_quaternion,
    multiply_by_vector,
    multiply_quaternions,
    rotate_components,
    scale,
    stack_components,
)

SERIES_BOUND = 1e-6
"""Squares of angles [rad²] below which the series of sine and cosine are exact to rounding, derivatives included."""


def rotate_freely(
    orientation: Float[Array, "*lanes 4"], spin: Float[Array, "*lanes 3"], inertia: Inertia, dt: ArrayLike
) -> Float[Array, "*lanes 4"]:
    """The orientation after free rotation for a time dt [s] with the angular momentum `spin` constant, to second order.

    The sphere has the middle moment: one of the differences is then zero where two moments are equal (a needle, a coin, a
    ball), and the turn exact at any step. Of other bodies the two turns about principal axes are taken half, whole, half,
    each in closed form: exactly reversible in time, and without drift of the energy as long as a step is shorter than
    `stability.limit` says (F. Fassò, J. Comput. Phys. 189 (2003) 527).
    """
    frame, along, order = principal_frame(orientation, inertia), components(spin), _Order.of(inertia)
    middle, a, b = order.enter(components(inertia.inverse))
    x, y, z = order.enter(rotate_components(conjugate_quaternion(frame), along))
    # half angles, by which a quaternion rotates; the vector takes the whole, by the double-angle formulas
    slow, fast = 0.25 * (a - middle), 0.5 * (b - middle)
    half = scale(dt, jnp.broadcast_to(0.5 * middle, x.shape))
    angle, square = scale(dt, slow * y), half * half * (along[0] ** 2 + along[1] ** 2 + along[2] ** 2)
    # computed once: XLA on a CPU would repeat sines for each of their readers
    (c, s), (cosine, share) = materialise(dt, lambda: (_cosine_and_sine(angle), _cosine_and_sinc(square)))
    x, z = _turn((c, s), x, z)
    k, n = materialise(dt, lambda: _cosine_and_sine(scale(dt, fast * z)))
    y, _ = _turn((k, n), y, x)
    d, e = materialise(dt, lambda: _cosine_and_sine(scale(dt, slow * y)))
    turn = [k * (c * d - s * e), *order.leave([n * (s * d - c * e), k * (c * e + s * d), n * (c * d + s * e)])]
    whole = [cosine, *(half * share * part for part in along)]
    return _body_frame(multiply_quaternions(whole, multiply_quaternions(frame, turn)), orientation, inertia)


def _turn(half: tuple[Array, Array], first: Array, second: Array) -> tuple[Array, Array]:
    """Two components of a fixed vector in a frame that turns, by the cosine and the sine of half the angle."""
    c, s = half
    # doubled by a sum: a literal 2 is two more operations of the program
    cosine, sine = c * c - s * s, c * s + c * s
    return cosine * first - sine * second, cosine * second + sine * first


def turn_rate(orientation: Array, spin: Array, inertia: Inertia) -> Array:
    """q' = ½ q (0, ω) with ω in the body frame, which is cheaper than ½ (0, ω) q with ω in the world frame."""
    frame = principal_frame(orientation, inertia)
    half = apply_inverse_principal(frame, 0.5 * inertia.inverse, spin)
    return _body_frame(multiply_by_vector(frame, half), orientation, inertia)


def principal_frame(orientation: Array, inertia: Inertia) -> list[Array]:
    """The quaternion from the principal axes to the world, in components."""
    q = components(orientation)
    if inertia.axes is None:
        return q
    return multiply_quaternions(q, components(broadcast_vector(inertia.axes, orientation)))


def _body_frame(frame: list[Array], orientation: Array, inertia: Inertia) -> Array:
    """What is shaped like `orientation`, of bodies whose principal axes have the quaternion `frame`: back from there."""
    if inertia.axes is not None:
        axes = components(broadcast_vector(inertia.axes, orientation))
        frame = multiply_quaternions(frame, conjugate_quaternion(axes))
    return stack_components(frame)


def apply_inverse_principal(frame: list[Array], inverse: Array, vector: Array) -> list[Array]:
    """I⁻¹ Rᵀ times a vector of the world frame, in components along the principal axes."""
    turned = rotate_components(conjugate_quaternion(frame), components(vector))
    numbers = components(broadcast_vector(inverse, vector))
    return [number * part for number, part in zip(numbers, turned, strict=True)]


# the axes in the order in which they are split


class _Order(NamedTuple):
    """Whether the first and whether the second principal axis has the middle moment; otherwise the third has."""

    first: Array
    second: Array

    @classmethod
    def of(cls, inertia: Inertia) -> "_Order":
        """That of a body, or of each."""
        a, b, c = components(inertia.inverse)
        return cls((a - b) * (c - a) >= 0, (b - a) * (c - b) >= 0)

    def enter(self, parts: list[Array]) -> list[Array]:
        """Components in cyclic order from the axis of the middle moment on."""
        return [self._choose(parts[i], parts[(i + 1) % 3], parts[(i + 2) % 3]) for i in range(3)]

    def leave(self, parts: list[Array]) -> list[Array]:
        """Components in the order of the principal axes again."""
        return [self._choose(parts[i], parts[(i + 2) % 3], parts[(i + 1) % 3]) for i in range(3)]

    def _choose(self, a: Array, b: Array, c: Array) -> Array:
        return lax.select(self.first, a, lax.select(self.second, b, c))


# turns


def _cosine_and_sine(angle: Array) -> tuple[Array, Array]:
    return jnp.cos(angle), jnp.sin(angle)


def _cosine_and_sinc(square: Array) -> tuple[Array, Array]:
    """cos a and sin a / a [1] of the square of an angle [rad²], with the right derivatives where that is zero."""
    small = square < SERIES_BOUND
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    cosine = jnp.where(small, 1 - square * (1 / 2 - square * (1 / 24)), jnp.cos(angle))
    return cosine, jnp.where(small, 1 - square * (1 / 6 - square * (1 / 120)), jnp.sin(angle) / angle)


__all__ = [
    "apply_inverse_principal",
    "principal_frame",
    "rotate_freely",
    "turn_rate",
]
