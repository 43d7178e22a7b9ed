"""The cubic through the values and the rates at both ends of a step (Hermite): how a path runs between two states.

It differs from the path of any smooth motion by O(dt⁴), and costs nothing: what is at the ends is known.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.vectors import scale


class Cubic(NamedTuple):
    """y(s) = start + rate s + second s² + third s³, of numbers shaped like the lanes or of vectors; s goes from 0 to 1."""

    start: Float[Array, "..."]
    rate: Float[Array, "..."]
    second: Float[Array, "..."]
    third: Float[Array, "..."]

    @classmethod
    def through(cls, start: Array, end: Array, start_rate: Array, end_rate: Array) -> "Cubic":
        """The cubic with these values at s = 0 and 1, and these derivatives by s: dt times those by time."""
        chord = end - start
        second = 3.0 * chord - 2.0 * start_rate - end_rate
        return cls(start, start_rate, second, start_rate + end_rate - 2.0 * chord)

    def at(self, s: ArrayLike) -> Array:
        """y(s), by Horner's rule; s is a number or one per lane."""
        return self.start + scale(s, self.rate + scale(s, self.second + scale(s, self.third)))

    def slope(self, s: ArrayLike) -> Array:
        """dy/ds."""
        return self.rate + scale(s, 2.0 * self.second + scale(3.0 * s, self.third))

    def curvature(self, s: ArrayLike) -> Array:
        """d²y/ds²."""
        return 2.0 * self.second + scale(6.0 * s, self.third)

    def extrema(self) -> tuple[Array, Array]:
        """Where a cubic of numbers has its local minimum and its local maximum; infinite or NaN where it has none.

        Both are roots of y' = 0, each by the quotient whose numerator does not cancel.
        """
        rate, b, a = self.rate, self.second, self.third
        root = jnp.sqrt(jnp.maximum(b * b - 3 * a * rate, 0.0))
        lowest = jnp.where(b > 0, -rate / (b + root), (root - b) / (3 * a))
        highest = jnp.where(b < 0, rate / (root - b), -(root + b) / (3 * a))
        return lowest, highest
