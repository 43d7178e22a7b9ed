"""The error of a run: of its path, its end, its energy, its momentum, its penetration, or whatever you observe.

A measure compares a run with the true path at the same moments and gives one number, relative to a size that the true
path has. `path` is what advice is about unless you ask for another.
"""

from collections.abc import Callable
from functools import partial
from inspect import isroutine
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from physjax.scene import Scene
from physjax.stepping.reference import cast_floats
from physjax.study.energy.quantities import ENERGY, MOMENTUM, Conserved


class ErrorMeasure(NamedTuple):
    """A way to measure errors: `quantity(scene, times, states)` of a run less that of the true path, over its `size`.

    The quantity is NumPy, `(moments, *units, components)`; `size(scene, times, states)` is that of the true path, a
    number or one for each unit. The worst moment and unit count.
    """

    name: str
    quantity: Callable[[Scene, np.ndarray, PyTree], np.ndarray]
    size: Callable[[Scene, np.ndarray, PyTree], np.ndarray]

    def moments(
        self, scene: Scene, times: np.ndarray, states: PyTree, truth: PyTree, scale: ArrayLike | None = None
    ) -> np.ndarray:
        """The error at each moment, of the worst unit, `(moments,)`; relative to `scale` where it is given."""
        return self.units(scene, times, states, truth, scale).max(axis=1)

    def units(
        self, scene: Scene, times: np.ndarray, states: PyTree, truth: PyTree, scale: ArrayLike | None = None
    ) -> np.ndarray:
        """The error at each moment of each unit (a lane, or a coupled scene), `(moments, units)`."""
        off = self.quantity(scene, times, states) - self.quantity(scene, times, truth)
        with np.errstate(invalid="ignore", over="ignore"):  # a run that blew up has the error NaN or infinity
            length = np.sqrt(np.sum(off**2, axis=-1))
        size = self.size(scene, times, truth) if scale is None else np.asarray(scale, float)
        # a truth that stays where it is has no size: its errors are absolute
        return (length / np.where(size > 0, size, 1.0)).reshape(len(length), -1)

    def error(
        self, scene: Scene, times: np.ndarray, states: PyTree, truth: PyTree, scale: ArrayLike | None = None
    ) -> float:
        """The error of a run: at its worst moment."""
        return float(self.moments(scene, times, states, truth, scale).max())


def extent(scene: Scene, times: np.ndarray, states: PyTree) -> np.ndarray:
    """How far each lane (or the farthest node of each coupled scene) ever is from where it began [m]."""
    place = np.asarray(states.place, float)
    away = np.sqrt(np.sum((place - place[0]) ** 2, axis=-1)).max(axis=0)
    return away.max(axis=-1, keepdims=True) if scene.couples else away


def _read_positions(scene: Scene, times: np.ndarray, states: PyTree) -> np.ndarray:
    return np.asarray(states.place, float)


def _read_final_positions(scene: Scene, times: np.ndarray, states: PyTree) -> np.ndarray:
    return _read_positions(scene, times, states)[-1:]


@partial(jax.jit, static_argnames="function")
def _map_over_time(function: Callable, scene: Scene, times: Array, states: PyTree) -> Array:
    return jax.vmap(lambda t, state: function(scene, t, state))(times, states)


def _evaluate_over_time(function: Callable, scene: Scene, times: np.ndarray, states: PyTree) -> np.ndarray:
    """A function of the state at every moment, in float64."""
    with jax.enable_x64(True):
        states = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), states)
        return np.asarray(_map_over_time(function, cast_floats(scene, jnp.float64), jnp.asarray(times), states))


def _build_conserved_measure(conserved: Conserved) -> ErrorMeasure:
    """The error of a quantity, relative to the largest size it has on the true path."""

    def evaluate(scene: Scene, times: np.ndarray, states: PyTree) -> np.ndarray:
        found = _evaluate_over_time(conserved.value, scene, times, states)
        # a scalar per unit has one component
        return found[..., None] if found.ndim == 1 + len(scene.status_shape) else found

    def measure_size(scene: Scene, times: np.ndarray, states: PyTree) -> np.ndarray:
        return _evaluate_over_time(conserved.size, scene, times, states).max(axis=0)

    return ErrorMeasure(conserved.name, evaluate, measure_size)


def _penetration_depth(scene: Scene, t: ArrayLike, state: PyTree) -> Float[Array, "*lanes 1"]:
    """How far each lane is inside the contact in which it is deepest [m]."""
    if not scene.contacts:
        raise ValueError("penetration: the scene has no contacts, so nothing can sink in. Ask for another norm.")
    # a contact is asked for its distance alone, so that contact points and other lanes count only where it has them
    depths = [jnp.maximum(0.0, -contact.signed_distance(t, state.position)) for contact in scene.contacts]
    deepest = depths[0]
    for depth in depths[1:]:
        deepest = jnp.maximum(deepest, depth)
    return deepest[..., None]


path = ErrorMeasure("path", _read_positions, extent)
"""Largest distance from the true path at any moment, relative to how far the true path goes."""
final = ErrorMeasure("final", _read_final_positions, extent)
"""The same at the last moment alone."""
energy = _build_conserved_measure(ENERGY)
"""Total energy against the true path's, relative to the largest kinetic energy."""
momentum = _build_conserved_measure(MOMENTUM)
"""Total momentum against the true path's, relative to the largest Σm|v|."""
penetration = ErrorMeasure("penetration", partial(_evaluate_over_time, _penetration_depth), extent)
"""Largest penetration of any contact, less that of the true path, relative to how far the true path goes."""


def outcome(function: Callable, name: str | None = None) -> ErrorMeasure:
    """What you observe: `function(times, states) -> number or array`; its error relative to its own largest value.

    Example:
        >>> accuracy.outcome(lambda times, states: states.position[-1, 0], name="where it lands").name
        'where it lands'
    """
    if not callable(function):
        raise TypeError(f"outcome: got {function!r}, expected a function (times, states) -> number or array.")

    def evaluate(scene: Scene, times: np.ndarray, states: PyTree) -> np.ndarray:
        return np.asarray(function(times, states), float).reshape(1, 1, -1)

    def measure_size(scene: Scene, times: np.ndarray, states: PyTree) -> np.ndarray:
        return np.abs(evaluate(scene, times, states)).max()

    own_name = function.__name__ if isroutine(function) else "outcome"
    return ErrorMeasure(name or own_name, evaluate, measure_size)


ERROR_MEASURES = (path, final, energy, momentum, penetration)
"""The measures that every scene has (the last one only with contacts)."""


def as_error_measure(norm: ErrorMeasure | Callable) -> ErrorMeasure:
    """An error measure, or a user's function (times, states) as one."""
    if isinstance(norm, ErrorMeasure):
        return norm
    if not callable(norm):
        raise TypeError(
            f"norm: got {norm!r}, expected one such as accuracy.path, or a function (times, states) -> number or array."
        )
    return outcome(norm)
