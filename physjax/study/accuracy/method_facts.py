"""What a method promises for a scene, what a step of it costs, and the sizes by which its tolerances are set."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, PyTree

from physjax.constraints.mechanism import find_constraints
from physjax.particles import callable_name
from physjax.parts import Function
from physjax.programs import iterate_operations
from physjax.scene import Scene
from physjax.show.style import Variant
from physjax.stepping.adaptive import Adaptive, adaptive
from physjax.stepping.doubling import Doubling
from physjax.stepping.methods import METHODS, SPECIAL_METHODS
from physjax.stepping.pairs import read_pair
from physjax.stepping.reference import cast_floats
from physjax.stepping.registry import read_promises

COUNTED_RATE = "counted_rate"
"""What an evaluation of the right-hand side is called in the program of a step."""
CONTACT_ORDER = 4
"""The order to which the moment of a touch is found within a step."""


def describe_method(method: Callable) -> Variant:
    """A method's name, and whether it chooses its own steps: then it is named after the method that it subdivides."""
    if not isinstance(method, Adaptive):
        return Variant(callable_name(method))
    return Variant(callable_name(subdivided_method(method)), adaptive=True)


def method_title(method: Callable) -> str:
    """What a method is called in tables."""
    return describe_method(method).display_name


def subdivided_method(method: Adaptive) -> Callable:
    """The method that an adaptive one subdivides, as the user gave it."""
    inner = method.method
    return inner.function if isinstance(inner, Function) else inner


def smallest_size(scene: Scene) -> float:
    """Typical size of the smaller of position and velocity: the unit of an absolute tolerance."""
    leaves = jax.tree.leaves((scene.state, _measure_force(scene)))
    sizes = [np.sqrt(np.mean(np.square(np.asarray(leaf, float)))) for leaf in leaves]
    return float(min(size for size in sizes if size > 0)) if any(sizes) else 1.0


def smallest_sizes(scene: Scene) -> np.ndarray:
    """`smallest_size` for each lane, smaller where all of the lane is small next to the others; once per coupled scene.

    Shaped to broadcast with a leaf of the state; of one whose leaves differ in their axes, such as bodies in the plane, the
    smallest of all lanes.
    """
    axes, ratios = (-2, -1) if scene.couples else (-1,), []
    lanes = len(scene.state.lanes)
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves((scene.state, _measure_force(scene)))]
    alike = all(leaf.ndim > lanes for leaf in leaves)
    for leaf in (leaf if leaf.ndim > lanes else leaf[..., None] for leaf in leaves):
        whole = np.sqrt(np.mean(np.square(leaf)))
        if whole > 0:
            ratios.append(np.sqrt(np.mean(np.square(leaf), axis=axes, keepdims=True)) / whole)
    ratio = np.max(ratios, axis=0) if ratios else np.ones(1)
    # a lane at rest in the origin has no size of its own; a larger one never loosens its tolerance
    size = smallest_size(scene) * np.where(ratio > 0, np.minimum(ratio, 1.0), 1.0)
    return size if alike else np.asarray(size.min())


def depends_on_velocity(scene: Scene) -> bool:
    """Whether the forces depend on the velocity: then some methods promise a lower order."""
    with jax.enable_x64(True):
        scene = cast_floats(scene, jnp.float64)
        rng = np.random.default_rng(0)

        def draw_push(leaf: Array) -> np.ndarray:
            random = rng.normal(size=leaf.shape)
            return np.where(random > 0, 2 + random, random - 2) * (1 + np.abs(np.asarray(leaf)))

        push = jax.tree.map(draw_push, scene.state)
        # pushed one way and the other, every velocity changes its sign: a force that ignores it is the same to the last bit
        ends = (jax.tree.map(np.asarray, _probe_force(scene, push, np.asarray(sign))) for sign in (1.0, -1.0))
        return any(bool(np.any(a != b)) for a, b in zip(*map(jax.tree.leaves, ends), strict=True))


@jax.jit  # one compilation, for all probes, instead of one for each operation
def _probe_force(scene: Scene, push: PyTree, share: ArrayLike) -> PyTree:
    """The force after a share of a push."""
    state = scene.kick(scene.state, push, share)
    return state.generalised_force(scene, jnp.zeros((), state.dtype))


def _measure_force(scene: Scene) -> PyTree:
    """The force on the state as it is, by the program that probes it."""
    still = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), scene.state)
    return _probe_force(scene, still, np.zeros((), scene.state.dtype))


def list_methods(scene: Scene) -> dict[str, Callable]:
    """Methods to be compared on a scene by name: those for any scene, and for forces of place alone also the special ones.

    Of contacts timed within a step the moment is known to order 4: methods of higher order would gain nothing by theirs. Nor
    do implicit ones of order 2 by taking longer steps, and their solves are part of every leg.
    """
    if scene.contacts or scene.emitter is not None:
        suits = lambda promises: promises.order <= (1 if np.isinf(promises.stability_limit) else CONTACT_ORDER)  # noqa: E731
        return {name: method for name, method in METHODS.items() if suits(method.promises)}
    special = not scene.state.rotates and not depends_on_velocity(scene)
    # one that keeps its order with drag is made for forces of velocity
    of_place = {name: m for name, m in SPECIAL_METHODS.items() if m.promises.order_with_drag < m.promises.order}
    return METHODS | of_place if special else dict(METHODS)


def list_adaptive_methods(scene: Scene) -> list[Adaptive]:
    """The methods that know the errors of their steps and are made for such a scene, under error control; the best first."""
    if scene.contacts or scene.emitter is not None:
        return []
    pairs = [method for method in list_methods(scene).values() if read_pair(method) is not None]
    explicit = [method for method in pairs if np.isfinite(method.promises.stability_limit)]
    # one of fewer evaluations a step is cheaper until errors are tiny; of as many the higher order wins
    best: list[Callable] = []
    for method in sorted(explicit, key=lambda m: (m.promises.evaluations, -m.promises.order)):
        if not best or method.promises.order > best[-1].promises.order:
            best.append(method)
    return [adaptive(method) for method in best]


def promised_order(method: Callable, velocity_dependent: bool, scene: Scene) -> float:
    """The order that a method promises for a scene.

    At most that of the step of joints and rods, whatever moves between them; at most 1 where something is resolved at the
    end of a step.
    """
    if isinstance(method, Adaptive):
        return float(method.order)
    promises = read_promises(method)
    if promises is None:
        return float("nan")
    order = float(promises.order_with_drag if velocity_dependent else promises.order)
    constraints = find_constraints(scene)
    if constraints:
        order = min(order, float(max(part.order for part in constraints)))
    # what happens within a step but is resolved at its end is late by up to dt
    return min(order, 1.0) if scene.resolves_at_step_end else order


class _CountingSystem(NamedTuple):
    """A system that counts how often a method asks for the right-hand side."""

    scene: Scene
    calls: list

    def rate(self, t: ArrayLike, state: PyTree) -> PyTree:
        self.calls.append(t)

        def evaluate(t: ArrayLike, state: PyTree) -> PyTree:
            return self.scene.rate(t, state)

        evaluate.__name__ = COUNTED_RATE
        return jax.jit(evaluate)(t, state)

    def kick(self, state: PyTree, rate: PyTree, dt: ArrayLike) -> PyTree:
        return self.scene.kick(state, rate, dt)

    def drift(self, state: PyTree, dt: ArrayLike) -> PyTree:
        return self.scene.drift(state, dt)


def count_evaluations_per_try(method: Adaptive, scene: Scene) -> int:
    """Force evaluations of each step that an adaptive method tries, accepted or not."""
    pair = method.find_pair(scene)
    if isinstance(pair, Doubling):
        return 3 * count_evaluations(subdivided_method(method), scene)
    promises = read_promises(subdivided_method(method))
    if promises is not None and np.isinf(promises.stability_limit):
        return promises.evaluations  # the products of its solves are no evaluations
    counter = _CountingSystem(scene, [])
    # a step begins with the last slope of the one before, where that is kept
    slope = scene.state if pair.keeps_slope else None
    attempt = lambda y, k: pair.attempt(counter, jnp.zeros((), y.dtype), y, 1.0, k)  # noqa: E731
    # in the program: a method may trace the forces once more, to see what they depend on
    operations = iterate_operations(jax.make_jaxpr(attempt)(scene.state, slope).jaxpr)
    return sum(operation.params.get("name") == COUNTED_RATE for operation in operations)


def count_evaluations(method: Callable, scene: Scene) -> int:
    """Force evaluations a step: promised, or counted for a method that promises nothing."""
    promises = read_promises(method)
    if promises is not None:
        return promises.evaluations
    counter = _CountingSystem(scene, [])
    jax.eval_shape(lambda state: method(counter, jnp.zeros((), scene.state.dtype), state, 1.0), scene.state)
    return len(counter.calls)
