"""A method compiled once for a scene, to be run with as many steps as a study asks for, and what it promises there."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from physjax.particles import Particles, callable_name, demand_particles
from physjax.parts import as_module
from physjax.scene import Scene
from physjax.stepping.adaptive import Adaptive
from physjax.stepping.reference import cast_floats
from physjax.stepping.simulate import sample_states
from physjax.study.problem import Problem


class CompiledRun(NamedTuple):
    """A method compiled for a problem in a float type; call it with how fine it shall be.

    Fineness is the number of steps between two of the problem's moments, or one over the tolerance of a method that
    chooses its own steps, whose step is then that whole interval.
    """

    name: str
    method: Any
    dtype: str
    promised: float
    problem: Problem
    scene: Scene
    push: Any
    compiled: Callable
    compile_seconds: float

    @property
    def adaptive(self) -> bool:
        """Whether it chooses its own steps."""
        return isinstance(self.method, Adaptive)

    def count(self, fineness: float) -> int:
        """Steps between two moments."""
        return 1 if self.adaptive else max(1, round(fineness))

    def dt(self, fineness: float) -> float:
        """The step [s]."""
        return self.problem.duration / (self.problem.frames * self.count(fineness))

    def tune_method(self, fineness: float) -> Any:
        """The method as it is run, its tolerance relative to the size of what it moves."""
        if not self.adaptive:
            return self.method
        tolerance = jnp.asarray(1 / fineness, self.method.rtol.dtype)
        tolerances = (tolerance * smallest_size(self.scene), tolerance)
        return eqx.tree_at(lambda m: (m.atol, m.rtol), self.method, tolerances)

    def __call__(self, fineness: float) -> Any:
        """States at the problem's moments; with a push of the start (states, what becomes of the push)."""
        dt = jnp.asarray(self.dt(fineness), self.scene.state.dtype)
        # a duration or a count that grows with the method is data: nothing is compiled again
        return self.compiled(
            self.scene, as_module(self.tune_method(fineness)), dt, jnp.asarray(self.count(fineness)), self.push
        )


def compile_run(problem: Problem, method: Callable, dtype: Any = np.float64, *, push: Any = None) -> CompiledRun:
    """Compile a method for a problem; inside `jax.enable_x64(True)`.

    `push`, a change of the start, is carried along by forward differentiation.
    """
    scene = cast_floats(problem.scene, dtype)
    push = None if push is None else jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), push)
    dt = jnp.asarray(problem.duration / problem.frames, scene.state.dtype)
    started = time.perf_counter()
    compiled = _sample_compiled.lower(scene, as_module(method), dt, jnp.asarray(1), push, problem.frames).compile()
    seconds = time.perf_counter() - started
    promised = promised_order(method, depends_on_velocity(problem.scene), problem.scene)
    return CompiledRun(
        method_title(method), method, np.dtype(dtype).name, promised, problem, scene, push, compiled, seconds
    )


def _sample_with_push(scene: Scene, method: Any, dt: Any, count: Any, push: Any, frames: int) -> Any:
    """`sample_states`, and what becomes of a push of the start where there is one."""
    if push is None:
        return sample_states(scene, method, dt, count, frames=frames)
    run = lambda state: sample_states(scene.replace(state=state), method, dt, count, frames=frames)  # noqa: E731
    return jax.jvp(run, (scene.state,), (push,))


_sample_compiled = jax.jit(_sample_with_push, static_argnums=5)


def draw_random_push(scene: Scene) -> Any:
    """A random change of the start's velocity, of length 1 in each component on average; held lanes stay."""
    demand_particles("gradient", scene.state, "what turns cannot be pushed by its velocity alone")
    random = np.random.default_rng(0).normal(size=scene.state.position.shape)
    free = 1.0 if scene.held is None else 1.0 - np.asarray(scene.held, float)[..., None]
    return Particles(np.zeros_like(random), random * free)


def stack_copies(scene: Scene, count: int) -> Scene:
    """So many of a scene at once, along a new leading axis of what a step changes and of every number that each lane has."""
    many = lambda leaf: jnp.broadcast_to(leaf, (count, *leaf.shape))  # noqa: E731
    lanes, remembered = scene.state.lanes, scene.changing()

    def wider(part, changes):
        # what couples lanes, such as springs, has numbers of its own that serve all scenes as they are
        own = bool(lanes) and not getattr(part, "couples", False)
        each = lambda leaf, changed, has_lanes: many(leaf) if changed or (own and has_lanes) else leaf  # noqa: E731
        return jax.tree.map(each, part, changes, scene.build_lane_mask(part))

    parts = {name: getattr(scene, name) for name in ("mass", "pinned", "emitter")}
    found = {n: wider(part, getattr(remembered, n)) for n, part in parts.items() if part is not None}
    for name in ("forces", "contacts"):
        pairs = zip(getattr(scene, name), getattr(remembered, name), strict=True)
        found[name] = tuple(wider(part, changes) for part, changes in pairs)
    return scene.replace(state=jax.tree.map(many, scene.state), **found)


def method_title(method: Callable) -> str:
    """What a method is called in tables, an adaptive one after what it subdivides."""
    if not isinstance(method, Adaptive):
        return callable_name(method)
    return f"adaptive {callable_name(getattr(method.method, 'function', method.method))}"


def smallest_size(scene: Scene) -> float:
    """Typical size of the smaller of position and velocity: what an absolute tolerance is measured by."""
    leaves = jax.tree.leaves((scene.state, _generalised_force(scene, scene.state)))
    sizes = [np.sqrt(np.mean(np.square(np.asarray(leaf, float)))) for leaf in leaves]
    return float(min(size for size in sizes if size > 0)) if any(sizes) else 1.0


def smallest_sizes(scene: Scene) -> np.ndarray:
    """`smallest_size` for each lane, smaller where all of the lane is small beside the others; once a coupled scene.

    Shaped to meet a leaf of the state.
    """
    axes, ratios = (-2, -1) if scene.couples else (-1,), []
    for leaf in map(np.asarray, jax.tree.leaves((scene.state, _generalised_force(scene, scene.state)))):
        whole = np.sqrt(np.mean(np.square(leaf)))
        if whole > 0:
            ratios.append(np.sqrt(np.mean(np.square(leaf), axis=axes, keepdims=True)) / whole)
    ratio = np.max(ratios, axis=0) if ratios else np.ones(1)
    return smallest_size(scene) * np.where(ratio > 0, np.minimum(ratio, 1.0), 1.0)


def depends_on_velocity(scene: Scene) -> bool:
    """Whether the forces look at the velocity: the promise of some methods depends on it."""
    with jax.enable_x64(True):
        scene = cast_floats(scene, jnp.float64)
        rng = np.random.default_rng(0)
        push = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)) * (1 + jnp.abs(leaf)), scene.state)
        ends = (_generalised_force(scene, scene.kick(scene.state, push, sign)) for sign in (1.0, -1.0))
        return any(bool(jnp.any(a != b)) for a, b in zip(*map(jax.tree.leaves, ends), strict=True))


@jax.jit  # one compilation instead of one for each operation
def _generalised_force(scene: Scene, state: Any) -> Any:
    return state.generalised_force(scene, jnp.zeros((), state.dtype))


def promised_order(method: Callable, velocity_dependent: bool, scene: Scene) -> float:
    """The order that a method promises for a scene; at most 1 where something is answered at the end of a step."""
    if isinstance(method, Adaptive):
        return float(method.order)
    promises = getattr(method, "promises", None)
    if promises is None:
        return float("nan")
    order = float(promises.order_with_drag if velocity_dependent else promises.order)
    return min(order, 1.0) if scene.resolves_at_step_end else order


class _CountingSystem(NamedTuple):
    """A system that counts how often a method asks for the right-hand side."""

    scene: Scene
    calls: list

    def rate(self, t: ArrayLike, state: Any) -> Any:
        self.calls.append(t)
        return self.scene.rate(t, state)

    def kick(self, state: Any, rate: Any, dt: ArrayLike) -> Any:
        return self.scene.kick(state, rate, dt)

    def drift(self, state: Any, dt: ArrayLike) -> Any:
        return self.scene.drift(state, dt)


def evaluations(method: Callable, scene: Scene) -> int:
    """Force evaluations a step: promised, or counted for a method that promises nothing."""
    if hasattr(method, "promises"):
        return method.promises.evaluations
    counter = _CountingSystem(scene, [])
    jax.eval_shape(lambda state: method(counter, jnp.zeros((), scene.state.dtype), state, 1.0), scene.state)
    return len(counter.calls)
