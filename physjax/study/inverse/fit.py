"""Recover the numbers of a scene from observations of it, with their standard errors."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int, PyTree

from physjax.checks import as_positive_integer, as_real_quantity, concrete_or_none
from physjax.compiling import announce_compiling
from physjax.study.inverse.solve import solve
from physjax.tracebacks import shorten_tracebacks


class Fit(NamedTuple):
    """The numbers that fit best, shaped like the guess, with the `standard_error` of each and their `covariance` matrix.

    `residual` is observed - predicted, NaN where nothing was observed. `ok` is False where the search did not converge
    in its `steps`, or where the observations do not determine the numbers (their standard errors are then infinite).
    Rows of the covariance are in the order of `jax.flatten_util.ravel_pytree(value)`.
    """

    value: PyTree
    standard_error: PyTree
    residual: PyTree
    ok: Bool[Array, ""]
    steps: Int[Array, ""]
    covariance: Float[Array, "numbers numbers"]


@shorten_tracebacks
@announce_compiling("fit")
def fit(
    predict: Callable[[PyTree], PyTree],
    guess: PyTree,
    observed: PyTree,
    *,
    sigma: PyTree = None,
    max_steps: int = 100,
) -> Fit:
    """The numbers for which `predict(numbers)` is closest to what was observed, by least squares (Levenberg-Marquardt).

    `guess` is any pytree of numbers to start from; `predict` is any function of simulations that returns arrays shaped
    like `observed`, in which NaN marks what was not observed. `sigma` is the standard deviation of the noise, a number or
    shaped like `observed`; without it, it is estimated from the residuals, σ² = Σr²/(n - p). Standard errors are the
    square roots of the diagonal of σ² (JᵀJ)⁻¹, J the derivative of the prediction at the solution: the truth lies within
    two of them in 95 % of experiments, if the noise is normal and small enough for J to be constant over them.

    Under vmap, a thousand experiments in one call, each with its own `ok`; one that does not converge affects no other.
    The fitted numbers can be differentiated with respect to what was observed and to what `predict` closes over. Raises
    ValueError or TypeError for shapes that do not match, fewer observations than numbers, and sigma <= 0.

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
    predicted = jax.eval_shape(predict, guess)
    if isinstance(predicted, jax.ShapeDtypeStruct) and isinstance(observed, list | tuple):
        observed = np.asarray(observed)  # what NumPy takes for an array is one here too, not a tree of numbers
    observed = _match_structure("observed", jax.tree.map(lambda leaf: jnp.asarray(leaf), observed), predicted)
    data, unravel_data = ravel_pytree(observed)
    present = ~jnp.isnan(data)
    _demand_observations(present, start.size + (sigma is None))
    weight = present.astype(data.dtype)
    if sigma is not None:
        weight = weight / _expand_sigma(sigma, predicted)
    # the search runs in relative changes of the guess, so that numbers of any size weigh alike
    unit = jnp.where(start == 0, 1.0, jnp.abs(start))

    def residual(z):
        found = ravel_pytree(predict(unravel(start + unit * z)))[0]
        # what was not observed counts for nothing, in the derivative as well
        return jnp.where(present, found - jnp.where(present, data, 0.0), 0.0) * weight

    z, _, converged, steps = solve(residual, jnp.zeros_like(start), max_steps=max_steps)
    left, covariance, known = _estimate_errors(residual, z, present, unit, sigma is not None)
    spare = jnp.sum(present) - start.size
    value = start + unit * z
    return Fit(
        unravel(value),
        unravel(jnp.sqrt(jnp.diagonal(covariance))),
        unravel_data(jnp.where(present, -left / jnp.where(present, weight, 1.0), jnp.nan)),
        converged & known & jnp.all(jnp.isfinite(value)) & (spare >= int(sigma is None)),
        steps,
        covariance,
    )


def _estimate_errors(
    residual: Callable[[Array], Array], z: Array, present: Array, unit: Array, weighted: bool
) -> tuple[Array, Array, Array]:
    """The residual at the solution, the covariance of the numbers, and whether the data determine them.

    Without a sigma given the variance of the data is that of the residuals, over the degrees of freedom that are left.
    """
    left, jacobian = _linearise(residual, z)
    spare = jnp.sum(present) - z.size
    variance = jnp.ones((), left.dtype) if weighted else jnp.sum(left * left) / spare.astype(left.dtype)
    return left, *_covariance(jacobian, variance, unit)


def _linearise(residual: Callable[[Array], Array], z: Array) -> tuple[Array, Array]:
    """The residual and its Jacobian at once: compiling a simulation is what a single fit costs."""
    push = lambda direction: jax.jvp(residual, (z,), (direction,))  # noqa: E731
    return jax.vmap(push, out_axes=(None, 1))(jnp.eye(z.size, dtype=z.dtype))


def _covariance(jacobian: Array, variance: Array, unit: Array) -> tuple[Array, Array]:
    """σ² (JᵀJ)⁻¹ through J = QR, in units of the numbers, and whether J has full rank; infinite where it has not."""
    triangle = jnp.linalg.qr(jacobian, mode="r")
    # a pivot at the rounding of the largest entry means that two numbers act on the prediction alike
    size = jnp.abs(jnp.diagonal(triangle))
    rounding = len(jacobian) * float(jnp.finfo(unit.dtype).eps)
    known = jnp.all(size > rounding * jnp.max(jnp.abs(triangle)))
    safe = jnp.where(known, triangle, jnp.eye(unit.size, dtype=unit.dtype))
    inverse = solve_triangular(safe, jnp.eye(unit.size, dtype=unit.dtype)) * unit[:, None]
    return jnp.where(known, variance * (inverse @ inverse.T), jnp.inf), known


def _match_structure(name: str, tree: PyTree, predicted: PyTree) -> PyTree:
    """The tree as floating-point arrays, if it has the structure and the shapes of what is predicted."""
    shapes = lambda tree: jax.tree.map(lambda leaf: leaf.shape, tree)  # noqa: E731
    if shapes(tree) != shapes(predicted):
        raise ValueError(
            f"{name}: got the shape {shapes(tree)}, expected {shapes(predicted)}, that of the prediction; write NaN for what is "
            "missing."
        )
    return jax.tree.map(lambda leaf, like: leaf.astype(like.dtype), tree, predicted)


def _expand_sigma(sigma: PyTree, predicted: PyTree) -> Array:
    """The standard deviation of every observation."""
    sigma = jax.tree.map(lambda leaf: as_real_quantity("sigma", leaf, above=0.0), sigma)
    if eqx.is_array(sigma) and sigma.ndim == 0:
        sigma = jax.tree.map(lambda leaf: jnp.broadcast_to(sigma, leaf.shape), predicted)
    return ravel_pytree(_match_structure("sigma", sigma, predicted))[0]


def _demand_observations(present: Array, needed: int) -> None:
    given = concrete_or_none(present)
    if given is not None and given.sum() < needed:
        raise ValueError(
            f"observed: got {given.sum()} numbers that are not NaN, expected at least {needed}: one for each number to be "
            "fitted, and one more if sigma is to be estimated."
        )
