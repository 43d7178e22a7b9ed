"""Step doubling: any method as a pair, a step taken whole and in two halves."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.loops import Time
from physjax.stepping.pairs import Attempt
from physjax.stepping.system import S, System, average_over_step
from physjax.vectors import scale


class Doubling(NamedTuple):
    """A method of some order whose step is taken whole and in two halves: the halves are kept, the difference is the error.

    Within a step the path is the polynomial of degree 5 that has the states and the slopes of its start, middle and end.
    """

    method: Callable
    order: int
    dense_order: int = 5
    keeps_slope: bool = False

    @property
    def error_order(self) -> int:
        """Of the method: the error is that of the whole step."""
        return self.order

    def attempt(self, system: System, t: Time, state: S, dt: ArrayLike, slope: S | None) -> Attempt:
        """A step whole and in halves."""
        take = lambda t, state, dt: self.method(average_over_step(system, t, dt), t, state, dt)  # noqa: E731
        whole, middle = take(t, state, dt), take(t, state, dt / 2)
        halves = take(t + dt / 2, middle, dt / 2)
        return Attempt(halves, jax.tree.map(jnp.subtract, whole, halves), None, middle)

    def interpolate(self, system: System, t: Time, state: S, dt: ArrayLike, attempt: Attempt, share: ArrayLike) -> S:
        """The state at a share of a step, from three states and the slopes there, which are computed here alone."""
        system = average_over_step(system, t, dt)
        nodes = ((0.0, state), (0.5, attempt.stages), (1.0, attempt.end))
        terms = []
        for (place, y), (value, slope) in zip(nodes, _weigh_hermite(jnp.asarray(share)), strict=True):
            rate = system.rate(t + place * dt, y)
            terms.append(jax.tree.map(lambda y, k, a=value, b=slope * dt: scale(a, y) + scale(b, k), y, rate))
        return jax.tree.map(lambda a, b, c: a + b + c, *terms)


def _weigh_hermite(x: Array) -> list[tuple[Array, Array]]:
    """Weights of values and of slopes at 0, 1/2 and 1, for a share x of the step (Hermite's interpolation)."""
    first, middle, last = 2 * (x - 0.5) * (x - 1), 4 * x * (1 - x), 2 * x * (x - 0.5)
    return [
        ((1 + 6 * x) * first**2, x * first**2),
        (middle**2, (x - 0.5) * middle**2),
        ((1 - 6 * (x - 1)) * last**2, (x - 1) * last**2),
    ]


__all__ = ["Doubling"]
