"""Equations and objectives made of simulations: roots, least squares, minima, with bounds and derivatives.

The functions take the unknown, a number or a pytree of real arrays, and may close over anything. The solution has
derivatives with respect to all of that, forward and reverse, by the implicit function theorem: one linear solve, however
long the search was. Everything works under `jit` and `vmap`; a solution that is not found is a status, never an
exception. optimistix does the search, and is imported when first used.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree

from physjax.checks import as_positive_integer, as_real_array, as_real_quantity, concrete_or_none, demand_all
from physjax.compiling import announce_compiling
from physjax.summaries import Row, format_array, format_tree, write_summary, write_table
from physjax.tracebacks import shorten_tracebacks

MAX_NEWTON_STEPS = 8
"""Newton steps at most from where the safe search ended to the last digits."""


class Solution(NamedTuple):
    """The unknown, the residual there, whether that is a root (or least squares), and the steps of the search."""

    value: PyTree
    residual: PyTree
    ok: Bool[Array, ""]
    steps: Int[Array, ""]

    def __repr__(self) -> str:
        """The unknown, the residual and the effort."""
        return write_summary("Solution", _describe(self, "residual", self.residual))

    def _repr_html_(self) -> str:
        return write_table("Solution", _describe(self, "residual", self.residual))


class Minimum(NamedTuple):
    """The unknown, the cost there, whether the search ended in a minimum, and its steps."""

    value: PyTree
    cost: Float[Array, ""]
    ok: Bool[Array, ""]
    steps: Int[Array, ""]

    def __repr__(self) -> str:
        """The unknown, the cost and the effort."""
        return write_summary("Minimum", _describe(self, "cost", self.cost))

    def _repr_html_(self) -> str:
        return write_table("Minimum", _describe(self, "cost", self.cost))


def _describe(found: Solution | Minimum, name: str, size: PyTree) -> list[Row]:
    rows = [("value", format_tree(found.value)), (name, format_tree(size)), ("steps", format_array(found.steps))]
    return [*rows, ("ok", format_array(found.ok))]


@shorten_tracebacks
@announce_compiling("solve")
def solve(
    residual: Callable[[PyTree], PyTree],
    guess: PyTree,
    *,
    lower: PyTree = None,
    upper: PyTree = None,
    rtol: float | None = None,
    atol: float | None = None,
    max_steps: int = 256,
) -> Solution:
    """A root of `residual(value)` or, where there are more equations than unknowns, the least of its squares.

    The method of Levenberg and Marquardt, and with as many equations as unknowns Newton's from there to the last digits;
    `ok` then says that the residual vanishes. The value stays between `lower` and `upper`, numbers or pytrees like the
    guess, which must lie strictly between them. The search ends where a step changes value and residual by less than
    `atol + rtol·|·|`, each √eps of the dtype unless given.

    Raises ValueError or TypeError for impossible guesses, bounds and tolerances, and for fewer equations than
    unknowns.

    Example:
        >>> round(float(solve(lambda x: x**2 - 2.0, guess=1.0).value), 3)
        1.414
    """
    import optimistix

    box, start = _build_bounds("solve", guess, lower, upper)
    rtol, atol = _choose_tolerances(rtol, atol, start)
    limits = {"max_steps": as_positive_integer("max_steps", max_steps), "throw": False}

    def equations(inner, _):
        return ravel_pytree(residual(box.value(inner)))[0]

    count = jax.eval_shape(equations, start, None).size
    if count < start.size:
        raise ValueError(
            f"solve: got {count} equations for {start.size} unknowns, expected at least as many. Leave unknowns out, or "
            "say with minimise which of the many solutions is wanted."
        )
    square = count == start.size
    searched = _stop_closure_gradients(equations, start) if square else equations
    found = optimistix.least_squares(searched, optimistix.LevenbergMarquardt(rtol, atol), start, **limits)
    if square:
        inner, ok = _polish_root(equations, searched, start, found.value, rtol, atol)
    else:
        inner, ok = found.value, found.result == optimistix.RESULTS.successful
    value = box.value(inner)
    return Solution(value, residual(value), ok & jnp.all(jnp.isfinite(inner)), found.stats["num_steps"])


def _polish_root(
    equations: Callable[[Array, None], Array],
    searched: Callable[[Array, None], Array],
    start: Array,
    found: Array,
    rtol: float,
    atol: float,
) -> tuple[Array, Bool[Array, ""]]:
    """The root that Newton's method finds from where the safe search ended, or that end; and whether it is a root.

    `searched` are the equations without the derivatives in what they close over.
    """
    import optimistix

    newton = optimistix.Newton(rtol, atol)
    root = optimistix.root_find(equations, newton, found, max_steps=MAX_NEWTON_STEPS, throw=False).value
    largest_residual = lambda at: jnp.max(jnp.abs(searched(lax.stop_gradient(at), None)))  # noqa: E731
    vanishing = atol + rtol * largest_residual(start)
    # the derivatives are those of the Newton step: the search's would take second derivatives of the equations
    inner = jnp.where(largest_residual(root) <= jnp.maximum(largest_residual(found), vanishing), root, found)
    return inner, largest_residual(inner) <= vanishing


@shorten_tracebacks
@announce_compiling("minimise")
def minimise(
    cost: Callable[[PyTree], Array],
    guess: PyTree,
    *,
    lower: PyTree = None,
    upper: PyTree = None,
    rtol: float | None = None,
    atol: float | None = None,
    max_steps: int = 256,
) -> Minimum:
    """A minimum of the number `cost(value)`, by the quasi-Newton method of Broyden, Fletcher, Goldfarb and Shanno.

    Bounds, tolerances and errors as in `solve`; at an active bound the minimum moves with the bound. A minimum whose
    second derivatives are singular has no derivatives.

    Example:
        >>> round(float(minimise(lambda x: (x - 3.0) ** 2, guess=1.0).value), 3)
        3.0
    """
    import optimistix

    box, start = _build_bounds("minimise", guess, lower, upper)
    rtol, atol = _choose_tolerances(rtol, atol, start)

    def objective(inner, _):
        return cost(box.value(inner))

    shape = jax.eval_shape(objective, start, None)
    if getattr(shape, "shape", None) != ():
        raise ValueError(
            f"minimise: got a cost of {shape}, expected one number. Sum up, or use solve for least squares."
        )
    limits = {"max_steps": as_positive_integer("max_steps", max_steps), "throw": False}
    found = optimistix.minimise(objective, optimistix.BFGS(rtol, atol), start, **limits)
    value = box.value(found.value)
    least = cost(value)
    ok = (found.result == optimistix.RESULTS.successful) & jnp.isfinite(least)
    return Minimum(value, least, ok, found.stats["num_steps"])


def _stop_closure_gradients(equations: Callable, start: Array) -> Callable:
    """The equations without derivatives in what they close over, so that none are carried through the search."""
    closed = eqx.filter_closure_convert(equations, start, None)
    return jax.tree.map(lambda leaf: lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf, closed)


class _Bounds(NamedTuple):
    """The value between its bounds as a smooth function of unbounded numbers, as in MINUIT, and back.

    Between two bounds a sine, above or below one a hyperbola that turns on it. Both reach the bound and turn back there,
    so that a minimum on it is a regular one and moves with it. F. James, MINUIT reference manual, CERN, 1994.
    """

    lower: Array | None
    upper: Array | None
    unit: Array
    unravel: Callable[[Array], PyTree]

    def value(self, inner: Array) -> PyTree:
        """The value for unbounded numbers."""
        if self.lower is None or self.upper is None:
            return self.unravel(inner)
        low, high, both = _replace_infinite(self.lower, self.upper)
        between = low + 0.5 * (high - low) * (jnp.sin(inner) + 1)
        away = self.unit * (jnp.sqrt(inner * inner + 1) - 1)
        above, below = jnp.isfinite(self.lower), jnp.isfinite(self.upper)
        return self.unravel(
            jnp.where(both, between, jnp.where(above, low + away, jnp.where(below, high - away, inner)))
        )

    def inner(self, value: Array) -> Array:
        """The unbounded numbers of a flat value strictly between the bounds."""
        if self.lower is None or self.upper is None:
            return value
        low, high, both = _replace_infinite(self.lower, self.upper)
        between = jnp.arcsin(jnp.clip(2 * (value - low) / (high - low) - 1, -1, 1))
        away = jnp.where(jnp.isfinite(self.lower), value - low, high - value) / self.unit + 1
        single = jnp.isfinite(self.lower) | jnp.isfinite(self.upper)
        hyperbola = jnp.sqrt(jnp.maximum(away * away - 1, 0))
        return jnp.where(both, between, jnp.where(single, hyperbola, value))


def _replace_infinite(lower: Array, upper: Array) -> tuple[Array, Array, Array]:
    """Finite stand-ins for both bounds, since a branch that is not taken must not be NaN either; and where both are given."""
    low, high = jnp.isfinite(lower), jnp.isfinite(upper)
    return jnp.where(low, lower, 0.0), jnp.where(high, upper, 1.0), low & high


def _build_bounds(who: str, guess: PyTree, lower: PyTree, upper: PyTree) -> tuple[_Bounds, Array]:
    """The bounds, and the unbounded numbers to start from."""
    guess = jax.tree.map(lambda leaf: as_real_quantity(f"{who}: guess", leaf), guess)
    flat, unravel = ravel_pytree(guess)
    if not flat.size:
        raise ValueError(f"{who}: got an empty guess, expected at least one number.")
    if lower is None and upper is None:
        return _Bounds(None, None, jnp.ones((), flat.dtype), unravel), flat
    low, high = (
        _flatten_bound(who, "lower", lower, guess, -jnp.inf),
        _flatten_bound(who, "upper", upper, guess, jnp.inf),
    )
    known_flat, known_low, known_high = map(concrete_or_none, (flat, low, high))
    if known_flat is not None and known_low is not None and known_high is not None:
        inside = (known_low < known_flat) & (known_flat < known_high)
        demand_all(f"{who}: guess", flat, inside, "values strictly between lower and upper")
    middle = lax.stop_gradient(flat)
    unit = jnp.where(jnp.isfinite(low), middle - low, jnp.where(jnp.isfinite(high), high - middle, 1.0))
    box = _Bounds(low, high, lax.stop_gradient(unit), unravel)
    return box, lax.stop_gradient(box.inner(flat))


def _flatten_bound(who: str, name: str, bound: PyTree, guess: PyTree, absent: float) -> Array:
    """A bound for every number of the guess, flat."""
    if bound is None:
        bound = absent
    leaves, tree = jax.tree.flatten(guess)
    given, shape = jax.tree.flatten(bound)
    if shape != tree:
        if not jax.tree_util.treedef_is_leaf(shape) or jnp.ndim(bound):
            raise ValueError(
                f"{who}: got {name}={bound!r}, expected a number or bounds in the same structure as the guess."
            )
        given = given * len(leaves)
    arrays = [as_real_array(f"{who}: {name}", one).astype(leaf.dtype) for one, leaf in zip(given, leaves, strict=True)]
    fitting = [a.shape in ((), leaf.shape) for a, leaf in zip(arrays, leaves, strict=True)]
    if not all(fitting):
        raise ValueError(
            f"{who}: got {name} of shapes {[a.shape for a in arrays]}, expected numbers or the guess's shapes "
            f"{[leaf.shape for leaf in leaves]}."
        )
    return ravel_pytree([jnp.broadcast_to(a, leaf.shape) for a, leaf in zip(arrays, leaves, strict=True)])[0]


def _choose_tolerances(rtol: float | None, atol: float | None, start: Array) -> tuple[float, float]:
    """Both tolerances, √eps unless given."""
    usual = float(jnp.finfo(start.dtype).eps) ** 0.5
    for name, tolerance in (("rtol", rtol), ("atol", atol)):
        if tolerance is not None:
            as_real_quantity(name, tolerance, above=0)
    return (usual if rtol is None else rtol), (usual if atol is None else atol)
