"""Roots of functions of one variable, lane by lane; derivatives by the implicit function theorem."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from physjax.backend import any_lane, materialise_where
from physjax.loops import bounded_while_loop


class Bracket(NamedTuple):
    """Between which two places a function has a root, its values there, of opposite signs, and where to look next.

    `a` is the place that was looked at last; the next is a share of the way from there to `b`.
    """

    a: Array
    b: Array
    value_a: Array
    value_b: Array
    share: Array

    @property
    def proposal(self) -> Array:
        """The place to look at next."""
        return self.a + self.share * (self.b - self.a)

    def narrow(self, value: Array, tolerance: Array) -> tuple["Bracket", Bool[Array, "*lanes"]]:
        """The bracket after a look at the proposal, and whether that was the root within the tolerance.

        Chandrupatla's method: inverse quadratic interpolation where it is safe, else bisection (T. R. Chandrupatla,
        Advances in Engineering Software 28, 1997).
        """
        a, b, fa, fb, _ = self
        x, fx = self.proposal, value
        same = (fx < 0) == (fa < 0)
        c, fc = jnp.where(same, a, b), jnp.where(same, fa, fb)
        b, fb = jnp.where(same, b, a), jnp.where(same, fb, fa)
        width = jnp.abs(b - x)
        limit = jnp.where(width > 0, tolerance / jnp.where(width > 0, width, 1.0), 1.0)
        # his test: interpolate only where the inverse parabola through the three points is monotonic
        xi, phi = (x - b) / (c - b), (fx - fb) / (fc - fb)
        smooth = (phi * phi < xi) & ((1 - phi) * (1 - phi) < 1 - xi)
        inverse = fx / (fb - fx) * fc / (fb - fc) + (c - x) / (b - x) * fx / (fc - fx) * fb / (fc - fb)
        # at least a tolerance away from both ends, so that the bracket shrinks from both
        share = jnp.clip(jnp.where(smooth, inverse, 0.5), limit, 1 - limit)
        return Bracket(x, b, fx, fb, share), ~((limit <= 0.5) & (fx != 0))


def find_first_root(function: Callable, arguments: tuple, search: tuple) -> Array:
    """A root x of `function(x, *arguments)` per lane, differentiable in all that the function depends on: dx = -df/(∂f/∂x).

    `search` holds the bracket, a guess of the values at its ends (positive at the first, negative at the last), which
    lanes are wanted, and the tolerance. Where the function does not fall at the root, the derivative of the root is zero.
    """
    # a user's force may close over a number that is being differentiated, of which a custom rule knows nothing
    function, closed_over = jax.closure_convert(function, search[0][0], *arguments)
    return _find_first_root(function, (*arguments, *closed_over), search)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _find_first_root(function: Callable, arguments: tuple, search: tuple) -> Array:
    return _find_bracketed_root(lambda x: function(x, *arguments), *search)


@_find_first_root.defjvp
def _find_first_root_jvp(function, primals, tangents):
    (arguments, search), (moves, _) = primals, tangents
    x = _find_first_root(function, arguments, search)
    _, shift = jax.jvp(lambda *arguments: function(x, *arguments), arguments, moves)
    _, slope = jax.jvp(lambda x: function(x, *arguments), (x,), (jnp.ones_like(x),))
    falls = search[2] & (slope < 0)
    return x, jnp.where(falls, shift, 0.0) / jnp.where(falls, -slope, 1.0)


def _find_bracketed_root(
    function: Callable, bracket: tuple[Array, Array], values: tuple[Array, Array], active: Array, tolerance: Array
) -> Array:
    """The root in each active lane's bracket, within the tolerance."""
    (low, high), (above, below) = bracket, values
    tiny = float(jnp.finfo(low.dtype).tiny)
    # strictly of opposite signs: a guess of zero would divide by zero below
    above, below = jnp.maximum(above, tiny), jnp.minimum(below, -tiny)

    def closer(carry: tuple[Bracket, Array]) -> tuple[Bracket, Array]:
        before, going = carry
        x = before.proposal
        after, is_root = before.narrow(materialise_where(going, lambda: function(x), x), tolerance)
        return Bracket(*(jnp.where(going, new, old) for new, old in zip(after, before, strict=True))), going & ~is_root

    start = Bracket(high, low, below, above, below / (below - above)), active & (high > low)
    return bounded_while_loop(lambda carry: any_lane(carry[1]), closer, start, most=200)[0].a
