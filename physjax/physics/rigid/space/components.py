"""Vectors in space as three arrays, which XLA computes side by side where it would compute a stacked one three times.

Several vectors of the same kind, the axes of a body or the points of a contact, are one vector of arrays with an axis in
front: so one loop of the compiled program computes them all.
"""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array

MOST_CHOICES = 4
"""Of more numbers in one array one is taken by a sum or a maximum over all, which is a third of the program."""

Vector = tuple[Array, Array, Array]
"""A vector by its components."""


def dot(a: Vector, b: Vector) -> Array:
    """a · b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """a × b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def add(a: Vector, b: Vector) -> Vector:
    """a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def subtract(a: Vector, b: Vector) -> Vector:
    """a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def scale(number: Array, a: Vector) -> Vector:
    """A number times a vector."""
    return number * a[0], number * a[1], number * a[2]


def choose(flag: Array, a: Vector, b: Vector) -> Vector:
    """a where flagged, else b."""
    return jnp.where(flag, a[0], b[0]), jnp.where(flag, a[1], b[1]), jnp.where(flag, a[2], b[2])


def put_in_front(a: Vector) -> Vector:
    """A vector with an axis of one in front of its arrays, next to several."""
    return a[0][None], a[1][None], a[2][None]


def combine(numbers: Array, vectors: Vector) -> Vector:
    """The sum of three vectors, each times its number; both have an axis of three in front."""
    x, y, z = (numbers[0] * part[0] + numbers[1] * part[1] + numbers[2] * part[2] for part in vectors)
    return x, y, z


def multiply(matrix: Array, vector: Array | Sequence[Array]) -> Array:
    """Matrices times vectors, `(3, 3, ...)` and three numbers."""
    return matrix[:, 0] * vector[0][None] + matrix[:, 1] * vector[1][None] + matrix[:, 2] * vector[2][None]


def multiply_back(matrix: Array, vector: Array | Sequence[Array]) -> Array:
    """Transposed matrices times vectors, `(3, 3, ...)` and three numbers."""
    return matrix[0] * vector[0][None] + matrix[1] * vector[1][None] + matrix[2] * vector[2][None]


def multiply_rows(a: Array, b: Array) -> Array:
    """Matrices times the transposed of others: the products of all rows, `(3, 3, ...)` each."""
    one, two = a[:, None], b[None]
    return one[:, :, 0] * two[:, :, 0] + one[:, :, 1] * two[:, :, 1] + one[:, :, 2] * two[:, :, 2]


def sum_parts(parts: Array | Sequence[Array]) -> Array:
    """The sum of several numbers, one after the other."""
    total = parts[0]
    for number in range(1, len(parts)):
        total = total + parts[number]
    return total


def take_part(index: Array, parts: Array | Sequence[Array]) -> Array:
    """The part with this number, of each lane: choices one after the other, which fuse where a gather would not."""
    if isinstance(parts, Array) and len(parts) > MOST_CHOICES:
        return jnp.sum(jnp.where(index[None] == _number(parts), parts, 0), axis=0)
    found = parts[0]
    for number in range(1, len(parts)):
        found = jnp.where(index == number, parts[number], found)
    return found


def _number(parts: Array) -> Array:
    """0, 1, 2, ... along the axis in front."""
    return jnp.arange(len(parts), dtype=jnp.int32).reshape(-1, *(1,) * (parts.ndim - 1))


def take_vector(index: Array, vectors: Vector) -> Vector:
    """Of several vectors the one with this number, of each lane."""
    return take_part(index, vectors[0]), take_part(index, vectors[1]), take_part(index, vectors[2])


def find_best(parts: Array | Sequence[Array]) -> tuple[Array, Array]:
    """The greatest of several numbers, and which one it is."""
    if isinstance(parts, Array) and len(parts) > MOST_CHOICES:
        best = jnp.max(parts, axis=0)
        return best, jnp.min(jnp.where(parts == best[None], _number(parts), len(parts) - 1), axis=0)
    best, index = parts[0], jnp.zeros(parts[0].shape, jnp.int32)
    for number in range(1, len(parts)):
        best, index = jnp.maximum(best, parts[number]), jnp.where(parts[number] > best, number, index)
    return best, index


def find_sign(number: Array) -> Array:
    """1 where not negative, else -1."""
    return jnp.where(number >= 0, 1.0, -1.0).astype(number.dtype)


def square_root(square: Array) -> Array:
    """The root, with a derivative of zero where it is zero."""
    there = square > 0
    return jnp.where(there, jnp.sqrt(jnp.where(there, square, 1.0)), 0.0)


__all__ = [
    "Vector",
    "add",
    "choose",
    "combine",
    "cross",
    "dot",
    "find_best",
    "find_sign",
    "multiply",
    "multiply_back",
    "multiply_rows",
    "put_in_front",
    "scale",
    "square_root",
    "subtract",
    "sum_parts",
    "take_part",
    "take_vector",
]
