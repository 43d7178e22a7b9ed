"""Vectors of two or three components, computed component by component.

Vectors live in the last axis of an array shaped `(*lanes, dim)`. Nothing here reduces over that axis: sums are written
out by components, which XLA fuses into straight-line code (a generic reduction over an axis of length 3 is 10 to 30
times slower on CPU). Derivatives are finite where those of the formulas are not: the norm of a zero vector has derivative
zero, to any order and in any nesting of forward and reverse mode.
"""

from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

AnyArray = TypeVar("AnyArray", Array, np.ndarray)


def dot(a: Float[Array, "*lanes dim"], b: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes"]:
    """Scalar product a·b, shaped like the lanes."""
    # the component stays an axis of length 1 until the end, which takes half of the operations of picking each one
    product = a * b
    total = product[..., :1]
    for i in range(1, product.shape[-1]):
        total = total + product[..., i : i + 1]
    return total.reshape(total.shape[:-1])


def components(v: Float[Array, "*lanes dim"]) -> list[Float[Array, "*lanes"]]:
    """The components one by one: XLA is faster with these where arithmetic alternates between vectors and numbers."""
    return [v[..., i] for i in range(v.shape[-1])]


def stack_components(parts: list[Float[Array, "*lanes"]]) -> Float[Array, "*lanes dim"]:
    """A vector from its components."""
    return jnp.stack(parts, axis=-1)


def split_components(v: Float[Array, "*lanes dim"]) -> list[Float[Array, "*lanes 1"]]:
    """The components one by one, each with an axis of length 1: half of the operations of `components`."""
    return [v[..., i : i + 1] for i in range(v.shape[-1])]


def join_components(parts: list[Float[Array, "*lanes 1"]]) -> Float[Array, "*lanes dim"]:
    """A vector from components that have kept their axis."""
    return jnp.concatenate(parts, axis=-1)


# The functions themselves take the plain root, which is fastest. Their derivative rules are written with values that are
# safe to differentiate again: a loop in reverse mode drops custom rules, and the next derivative would be the plain root's.


def root_and_inverse(square: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """√s and 1/√s of numbers s >= 0; both are zero where s is zero, and so are all their derivatives."""
    present = square > 0
    root = jnp.sqrt(jnp.where(present, square, 1.0))
    return jnp.where(present, root, 0.0), jnp.where(present, 1.0 / root, 0.0)


@jax.custom_jvp
def square_root(square: Float[Array, "..."]) -> Float[Array, "..."]:
    """Square root of a number >= 0, whose derivative at zero is zero instead of infinite."""
    return jnp.sqrt(square)


@square_root.defjvp
def _square_root_jvp(primals, tangents):
    (square,), (change,) = primals, tangents
    value, inverse = root_and_inverse(square)
    return value, 0.5 * change * inverse


@jax.custom_jvp
def norm(v: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes"]:
    """Length |v|, shaped like the lanes; its derivative at v = 0 is zero instead of NaN."""
    return jnp.sqrt(dot(v, v))


@norm.defjvp
def _norm_jvp(primals, tangents):
    (v,), (dv,) = primals, tangents
    length, inverse = root_and_inverse(dot(v, v))
    return length, dot(scale(inverse, v), dv)


@jax.custom_jvp
def unit(v: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
    """Direction v/|v|; the zero vector has the direction zero, and derivative zero.

    Vectors whose squares underflow (below 1e-19 in float32) have a rough direction, or a shorter one.
    """
    # at this floor the square underflows: the norm of what is shorter is zero, and its inverse would be anything
    return scale(1.0 / jnp.maximum(norm(v), jnp.finfo(v.dtype).tiny ** 0.5), v)


@unit.defjvp
def _unit_jvp(primals, tangents):
    (v,), (dv,) = primals, tangents
    _, inverse = root_and_inverse(dot(v, v))
    direction = scale(inverse, v)
    return direction, scale(inverse, dv - scale(dot(direction, dv), direction))


def cross(a: Float[Array, "*lanes 3"], b: Float[Array, "*lanes 3"]) -> Float[Array, "*lanes 3"]:
    """Vector product a × b in three dimensions."""
    (ax, ay, az), (bx, by, bz) = split_components(a), split_components(b)
    return join_components([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def turn_left(v: Float[Array, "*lanes 2"]) -> Float[Array, "*lanes 2"]:
    """e_z × v in the plane: v rotated by 90 degrees anticlockwise."""
    return jnp.concatenate([-v[..., 1:], v[..., :1]], axis=-1)


def spin(omega: Float[Array, "..."], v: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
    """ω × v: a vector ω, `(3,)` or per lane, in space; a number ω, scalar or per lane, in the plane."""
    if v.shape[-1] == 2:
        return scale(omega, turn_left(v))
    return cross(broadcast_vector(omega, v), v)


def scale(number: ArrayLike | Float[Array, "..."], array: Float[Array, "..."]) -> Float[Array, "..."]:
    """Product of a per-lane (or per-scene) number with an array: `number` is a scalar or has the leading axes of `array`."""
    number = jnp.asarray(number)
    if number.ndim == 0:
        return number * array
    return number.reshape(number.shape + (1,) * (array.ndim - number.ndim)) * array


def add_trailing_axes(number: AnyArray, ndim: int) -> AnyArray:
    """A number per scene with axes of length 1 after its own, `ndim` in all, so that it broadcasts with numbers per lane.

    A scalar stays one: it broadcasts with everything as it is, and the compiled program has one operation fewer.
    """
    return number.reshape(number.shape + (1,) * (ndim - number.ndim)) if number.ndim else number


def add_leading_axes(number: AnyArray, ndim: int) -> AnyArray:
    """A number per spring or per node with axes of length 1 before its own, `ndim` in all; a scalar stays one."""
    return number.reshape((1,) * (ndim - number.ndim) + number.shape) if number.ndim else number


def broadcast_vector(vector: Float[Array, "..."], like: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
    """One vector `(dim,)` for all lanes, or one per lane, broadcast to the shape of `like`.

    Raises ValueError for a number, or a vector of another length: broadcast, it would point in an unintended direction.
    """
    if vector.shape[-1:] != like.shape[-1:]:
        raise ValueError(
            f"got a vector of shape {vector.shape}, expected {like.shape[-1:]} for all lanes or {like.shape}, one per lane."
        )
    return jnp.broadcast_to(vector, like.shape)


def axis_vector(amount: Float[Array, "..."], up: int, like: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
    """A vector along axis `up` with the given amount, scalar or per lane, shaped like `like`.

    Raises ValueError where there is no such axis.
    """
    amount, dim = jnp.asarray(amount), like.shape[-1]
    if not 0 <= up < dim:
        raise ValueError(
            f"up: got axis {up}, but vectors here have {dim} components. Give an axis from 0 to {dim - 1}."
        )
    axis = np.eye(dim)[up].astype(like.dtype)
    if amount.ndim == 0:
        return jnp.broadcast_to(amount * axis, like.shape)
    return scale(amount, jnp.broadcast_to(axis, like.shape))


upward = axis_vector
"""The name of the first edition."""


# quaternions (w, x, y, z), as lists of components: XLA on CPU recomputes a vector for each use of a component


def multiply_quaternions(a: list, b: list) -> list:
    """Hamilton's product ab of quaternions in components: the rotation b, then the rotation a."""
    w, x, y, z = a
    s, u, v, n = b
    return [
        w * s - x * u - y * v - z * n,
        w * u + x * s + y * n - z * v,
        w * v - x * n + y * s + z * u,
        w * n + x * v - y * u + z * s,
    ]


def multiply_by_vector(q: list, v: list) -> list:
    """Hamilton's product q (0, v), in components: (-u·v, w v + u × v), u = (x, y, z)."""
    w, x, y, z = q
    a, b, c = v
    return [-(x * a + y * b + z * c), w * a + (y * c - z * b), w * b + (z * a - x * c), w * c + (x * b - y * a)]


def conjugate_quaternion(q: list) -> list:
    """The inverse rotation, in components: (w, -x, -y, -z)."""
    w, x, y, z = q
    return [w, -x, -y, -z]


def rotate_components(q: list, v: list) -> list:
    """The vector v rotated by the unit quaternion q, in components: v + w t + u × t, t = 2u × v, u = (x, y, z)."""
    w, x, y, z = q
    a, b, c = v
    # doubled by a sum: a literal 2 is two more operations of the program
    p, q, r = (part + part for part in (y * c - z * b, z * a - x * c, x * b - y * a))
    return [a + w * p + y * r - z * q, b + w * q + z * p - x * r, c + w * r + x * q - y * p]


def rotate_vector(q: Float[Array, "*lanes 4"], v: Float[Array, "*lanes 3"]) -> Float[Array, "*lanes 3"]:
    """The vector v rotated by the unit quaternion q: from the body frame to the world frame, for an orientation q."""
    return join_components(rotate_components(split_components(q), split_components(v)))


def rotate_vector_back(q: Float[Array, "*lanes 4"], v: Float[Array, "*lanes 3"]) -> Float[Array, "*lanes 3"]:
    """The vector v rotated by the inverse of the unit quaternion q: from the world frame to the body frame."""
    return join_components(rotate_components(conjugate_quaternion(split_components(q)), split_components(v)))
