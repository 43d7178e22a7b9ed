"""The impulses that bring joints back together at the end of a step, found by iteration; derivatives by the implicit function."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, PyTree

from physjax.loops import open_closure

MAX_STEPS = 12
"""Steps that are taken with other impulses until the joints are closed."""
MAX_REFINEMENTS = 12
"""Corrections of a derivative, each of which takes a step's tangent."""
REFINED_SHARE = 1e-13
"""A derivative is right where this share of what it began with is left of the residual, or that of rounding."""


class ClosingStep(NamedTuple):
    """A step with impulses at its start: `take(λ) -> (gap, end)`; a better λ `correct(λ, end)`; and, of what the gap changes with
    λ, the approximate inverse `invert(λ, end, gap, transposed)`. `tolerance` is the gap of a closed joint.
    """

    take: Callable[[Array], tuple[Array, PyTree]]
    correct: Callable[[Array, PyTree], Array]
    invert: Callable[[Array, PyTree, Array, bool], Array]
    tolerance: Array


def close_joints(step: ClosingStep, start: Array) -> tuple[Array, Array, PyTree]:
    """The impulses λ `(rows, joints, worlds)` with which a step leaves joints closed, the gap that is left, and the end."""
    _, end = jax.eval_shape(step.take, start)
    (take, taken), (correct, corrected) = open_closure(step.take, start), open_closure(step.correct, start, end)
    known = taken, corrected, step.tolerance
    (invert, inverted), (back, backed) = (
        open_closure(lambda λ, end, gap, way=way: step.invert(λ, end, gap, way), start, end, start)
        for way in (False, True)
    )

    @jax.custom_jvp
    def run(known: tuple, inverses: tuple, start: Array) -> tuple[Array, Array, PyTree]:
        taken, corrected, tolerance = known

        def turn(carry: tuple) -> tuple:
            better, *_, count = carry
            gap, end = take(taken, better)
            return correct(corrected, better, end), better, gap, end, count + 1

        def goes_on(carry: tuple) -> Array:
            _, _, gap, _, count = carry
            return jnp.any(jnp.max(jnp.abs(gap), axis=(0, 1)) > tolerance) & (count < MAX_STEPS)

        zero = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), end)
        begun = (start, start, jnp.full_like(start, jnp.inf), zero, jnp.zeros((), jnp.int32))
        _, λ, gap, found, _ = lax.while_loop(goes_on, turn, begun)
        return λ, gap, found

    @run.defjvp
    def push(given: tuple, changes: tuple) -> tuple:
        (known, inverses, _), (moved, _, _) = given, changes
        λ, gap, end = run(*given)
        _, (opened, follows) = jax.jvp(lambda taken: take(taken, λ), (known[0],), (moved[0],))
        _, linear = jax.linearize(lambda λ: take(known[0], λ), λ)
        change = _solve_refined(
            lambda λ: linear(λ)[0],
            lambda gap: invert(inverses[0], λ, end, gap),
            lambda gap: back(inverses[1], λ, end, gap),
            -opened,
        )
        still, more = linear(change)
        return (λ, gap, end), (change, opened + still, jax.tree.map(jnp.add, follows, more))

    return run(known, (inverted, backed), start)


def _solve_refined(apply: Callable, invert: Callable, back: Callable, right: Array) -> Array:
    """The x with apply(x) = right, by iteration with an approximate inverse, whose transpose is `back`."""

    def refine(inverse: Callable, apply: Callable, right: Array) -> Array:
        def turn(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            x, left, count = carry
            x = x + inverse(left)
            return x, right - apply(x), count + 1

        size = jnp.max(jnp.abs(right))
        share = max(REFINED_SHARE, 4 * float(jnp.finfo(right.dtype).eps))
        goes_on = lambda carry: (jnp.max(jnp.abs(carry[1])) > share * size) & (carry[2] < MAX_REFINEMENTS)  # noqa: E731
        begun = (jnp.zeros_like(right), right, jnp.zeros((), jnp.int32))
        return lax.while_loop(goes_on, turn, begun)[0]

    return lax.custom_linear_solve(
        apply,
        right,
        solve=lambda apply, right: refine(invert, apply, right),
        transpose_solve=lambda apply, right: refine(back, apply, right),
    )


__all__ = ["ClosingStep", "close_joints"]
