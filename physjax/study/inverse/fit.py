"""Recover the numbers of a scene from what was observed of it, and say how well they are known."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int

from physjax.checks import as_positive_integer, as_real_quantity, concrete_or_none
from physjax.study.inverse.solve import solve


class Fit(NamedTuple):
    """The numbers that fit best, shaped like the guess, with the `standard_error` of each and their `covariance` matrix.

    `residual` is observed - predicted, NaN where nothing was observed. `ok` is False where the search did not converge
    in its `steps`, or where the observations do not tell the numbers apart (their standard errors are then infinite).
    Rows of the covariance are in the order of `jax.flatten_util.ravel_pytree(value)`.
    """

    value: Any
    standard_error: Any
    residual: Any
    ok: Bool[Array, ""]
    steps: Int[Array, ""]
    covariance: Float[Array, "numbers numbers"]


def fit(predict: Callable, guess: Any, observed: Any, *, sigma: Any = None, max_steps: int = 100) -> Fit:
    """The numbers for which `predict(numbers)` comes closest to what was observed, by least squares (Levenberg-Marquardt).

    `guess` is any pytree of numbers to start from; `predict` is any function of simulations that returns arrays shaped
    like `observed`, in which NaN stands for what was not observed. `sigma` is the standard deviation of the noise, a
    number or shaped like `observed`; without it, it is estimated from what is left over, σ² = Σr²/(n - p). Standard
    errors are the square roots of the diagonal of σ² (JᵀJ)⁻¹, J the derivative of the prediction at the solution: two of
    them hold the truth in 95 % of experiments, where noise is normal and small enough for J to be constant over them.

    Under vmap, a thousand experiments in one call, each with its own `ok`; what does not converge harms no other. The
    fitted numbers can be differentiated by what was observed and by what `predict` closes over. Raises ValueError or
    TypeError for shapes that do not match, fewer observations than numbers, and sigma <= 0.

    Example:
        >>> fallen = lambda g: 0.5 * g * jnp.array([1.0, 4.0, 9.0])
        >>> round(float(fit(fallen, guess=5.0, observed=[4.9, 19.6, 44.1]).value), 3)
        9.8
    """
    if not callable(predict):
        raise TypeError(
            f"fit: got predict {predict!r}, expected a function of the numbers that returns the prediction."
        )
    max_steps = as_positive_integer("max_steps", max_steps)
    guess = jax.tree.map(lambda leaf: as_real_quantity("guess", leaf), guess)
    start, unravel = ravel_pytree(guess)
    seen = jax.eval_shape(predict, guess)
    if isinstance(seen, jax.ShapeDtypeStruct) and isinstance(observed, list | tuple):
        observed = np.asarray(observed)  # what NumPy takes for an array is one here too, not a tree of numbers
    observed = _match_structure("observed", jax.tree.map(lambda leaf: jnp.asarray(leaf), observed), seen)
    data, unravel_data = ravel_pytree(observed)
    present = ~jnp.isnan(data)
    _demand_observations(present, start.size + (sigma is None))
    weight = present.astype(data.dtype)
    if sigma is not None:
        weight = weight / _expand_sigma(sigma, seen)

    def residual(z):
        predicted = ravel_pytree(predict(unravel(start + unit * z)))[0]
        # what was not observed counts for nothing, in the derivative as well
        return jnp.where(present, predicted - jnp.where(present, data, 0.0), 0.0) * weight

    unit = jnp.where(start == 0, 1.0, jnp.abs(start))
    z, _, converged, steps = solve(residual, jnp.zeros_like(start), max_steps=max_steps)
    # the prediction and its derivative at once, since compiling a simulation is what a single fit costs
    left, jacobian = jax.vmap(lambda way: jax.jvp(residual, (z,), (way,)), out_axes=(None, 1))(
        jnp.eye(start.size, dtype=start.dtype)
    )
    spare = jnp.sum(present) - start.size
    variance = jnp.ones((), data.dtype)
    if sigma is None:
        variance = jnp.sum(left * left) / spare.astype(data.dtype)
    covariance, known = _covariance(jacobian, variance, unit)
    value = start + unit * z
    ok = converged & known & jnp.all(jnp.isfinite(value)) & (spare >= int(sigma is None))
    return Fit(
        unravel(value),
        unravel(jnp.sqrt(jnp.diagonal(covariance))),
        unravel_data(jnp.where(present, -left / jnp.where(present, weight, 1.0), jnp.nan)),
        ok,
        steps,
        covariance,
    )


def _covariance(jacobian: Array, variance: Array, unit: Array) -> tuple[Array, Array]:
    """σ² (JᵀJ)⁻¹ through J = QR, in units of the numbers, and whether J has full rank; infinite where it has not."""
    triangle = jnp.linalg.qr(jacobian, mode="r")
    size = jnp.abs(jnp.diagonal(triangle))
    rounding = len(jacobian) * float(jnp.finfo(unit.dtype).eps)
    known = jnp.all(size > rounding * jnp.max(jnp.abs(triangle)))
    safe = jnp.where(known, triangle, jnp.eye(unit.size, dtype=unit.dtype))
    inverse = solve_triangular(safe, jnp.eye(unit.size, dtype=unit.dtype)) * unit[:, None]
    return jnp.where(known, variance * (inverse @ inverse.T), jnp.inf), known


def _match_structure(name: str, tree: Any, seen: Any) -> Any:
    """The tree as floating-point arrays, if it has the structure and the shapes of what is predicted."""
    shapes = lambda tree: jax.tree.map(lambda leaf: leaf.shape, tree)  # noqa: E731
    if shapes(tree) != shapes(seen):
        raise ValueError(
            f"{name}: got the shape {shapes(tree)}, expected {shapes(seen)}, that of the prediction; write NaN for what is "
            "missing."
        )
    return jax.tree.map(lambda leaf, like: leaf.astype(like.dtype), tree, seen)


def _expand_sigma(sigma: Any, seen: Any) -> Array:
    """The standard deviation of every observation."""
    sigma = jax.tree.map(lambda leaf: as_real_quantity("sigma", leaf, above=0.0), sigma)
    if eqx.is_array(sigma) and sigma.ndim == 0:
        sigma = jax.tree.map(lambda leaf: jnp.broadcast_to(sigma, leaf.shape), seen)
    return ravel_pytree(_match_structure("sigma", sigma, seen))[0]


def _demand_observations(present: Array, needed: int) -> None:
    concrete_present = concrete_or_none(present)
    if concrete_present is not None and concrete_present.sum() < needed:
        raise ValueError(
            f"observed: got {concrete_present.sum()} numbers that are not NaN, expected at least {needed}: one for each number to be "
            "fitted, and one more if sigma is to be estimated."
        )
