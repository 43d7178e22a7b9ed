"""A method compiled once for a scene, to be run with as many steps as a study asks for; alone, or for many copies at once."""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, PyTree

from physjax.particles import Particles, demand_particles
from physjax.parts import Contact, Force, Function, as_module, find_plain_functions
from physjax.physics import contacts
from physjax.quantities import may_hide_lanes
from physjax.scene import Scene
from physjax.show.style import AS_GIVEN, PROJECTED, Variant
from physjax.stepping.adaptive import Adaptive
from physjax.stepping.reference import cast_floats
from physjax.stepping.simulate import sample_states
from physjax.study.accuracy.method_facts import depends_on_velocity, describe_method, promised_order, smallest_size
from physjax.study.problem import Problem


class CompiledRun(NamedTuple):
    """A method compiled for a problem in a float type; call it with its fineness.

    Fineness is the number of steps between two of the problem's moments, or one over the tolerance of an adaptive method,
    whose dt is then that whole interval. `promised` is the order of convergence that the method promises here.
    """

    variant: Variant
    method: Callable
    promised: float
    problem: Problem
    scene: Scene
    push: PyTree
    compiled: Callable
    compile_seconds: float

    @property
    def name(self) -> str:
        """The method in tables, without its float type: that has a column of its own."""
        return self.variant._replace(dtype="float64").display_name

    @property
    def dtype(self) -> str:
        """The float type."""
        return self.variant.dtype

    @property
    def adaptive(self) -> bool:
        """Whether it chooses its own steps."""
        return self.variant.adaptive

    @property
    def error_power(self) -> float:
        """With which power of the fineness errors should fall."""
        order = self.promised if np.isfinite(self.promised) else 1.0
        # a tolerance is on the error of a step: of order p it goes as dt^(p+1)
        return order * self.work_power if isinstance(self.method, Adaptive) else order

    @property
    def work_power(self) -> float:
        """With which power of the fineness the number of steps grows."""
        if not isinstance(self.method, Adaptive):
            return 1.0
        return 1 / (self.method.find_pair(self.scene).error_order + 1)

    def count(self, fineness: float) -> int:
        """Steps between two moments."""
        return 1 if self.adaptive else max(1, round(fineness))

    def dt(self, fineness: float) -> float:
        """The step [s]."""
        return self.problem.duration / (self.problem.frames * self.count(fineness))

    def tune_method(self, fineness: float) -> Callable:
        """The method with its tolerance set, relative to the size of what it moves."""
        if not isinstance(self.method, Adaptive):
            return self.method
        tolerance = jnp.asarray(1 / fineness, self.method.rtol.dtype)
        tolerances = (tolerance * smallest_size(self.scene), tolerance)
        return eqx.tree_at(lambda m: (m.atol, m.rtol), self.method, tolerances)

    def __call__(self, fineness: float) -> PyTree:
        """States at the problem's moments; with a push of the start (states, derivative along the push)."""
        dt = jnp.asarray(self.dt(fineness), self.scene.state.dtype)
        # step, count and tolerance are data: one compilation serves every fineness
        return self.compiled(
            self.scene, as_module(self.tune_method(fineness)), dt, jnp.asarray(self.count(fineness)), self.push
        )


def compile_run(
    problem: Problem,
    method: Callable,
    dtype: DTypeLike = np.float64,
    *,
    push: PyTree = None,
    treatment: str = AS_GIVEN,
    copies: int = 1,
) -> CompiledRun:
    """Compile a method for a problem; inside `jax.enable_x64(True)`.

    `push`, a change of the start, is carried along by forward differentiation. With `copies` the run is one of that many
    scenes at once. `treatment` names what has been done to the scene's contacts.
    """
    scene, copied = cast_floats(problem.scene, dtype), None
    if copies > 1:
        copied = find_mapped_arrays(scene)
        scene = stack_copies(scene, copies)
    push = None if push is None else jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), push)
    dt = jnp.asarray(problem.duration / problem.frames, scene.state.dtype)
    started = time.perf_counter()
    lowered = _sample_compiled.lower(scene, as_module(method), dt, jnp.asarray(1), push, problem.frames, copied)
    compiled = lowered.compile()
    seconds = time.perf_counter() - started
    variant = describe_method(method)._replace(treatment=treatment, dtype=np.dtype(dtype).name)
    promised = promised_order(method, depends_on_velocity(problem.scene), problem.scene)
    return CompiledRun(variant, method, promised, problem, scene, push, compiled, seconds)


def _sample_with_push(
    scene: Scene,
    method: Callable,
    dt: Array,
    count: Array,
    push: PyTree,
    frames: int,
    copied: tuple[bool, ...] | None,
) -> PyTree:
    """`sample_states`, and the derivative along a push of the start where there is one."""

    def sample(scene: Scene) -> PyTree:
        return map_copies(lambda one: sample_states(one, method, dt, count, frames), scene, copied)

    if push is None:
        return sample(scene)
    return jax.jvp(lambda state: sample(scene.replace(state=state)), (scene.state,), (push,))


_sample_compiled = jax.jit(_sample_with_push, static_argnums=(5, 6))


def draw_random_push(scene: Scene) -> Particles:
    """A random change of the start's velocity, of length 1 in each component on average; held lanes stay."""
    demand_particles("gradient", scene.state, "the velocity alone does not push a body that turns")
    random = np.random.default_rng(0).normal(size=scene.state.position.shape)
    free = 1.0 if scene.held is None else 1.0 - np.asarray(scene.held, float)[..., None]
    return Particles(np.zeros_like(random), random * free)


# copies of a scene


def stack_copies(scene: Scene, count: int) -> Scene:
    """`count` copies of a scene, along a new leading axis of what a step changes and of every number per lane."""
    stack = lambda leaf, copied: jnp.broadcast_to(leaf, (count, *leaf.shape)) if copied else leaf  # noqa: E731
    return jax.tree.map(stack, scene, _find_copied_arrays(scene))


def find_mapped_arrays(scene: Scene) -> tuple[bool, ...] | None:
    """For copies of a scene that must be mapped one by one, which of its arrays each has for itself; None for a stack.

    A stack of scenes is a scene of its own, with one axis more, and runs as such. Not where a part is written for the
    lanes of one scene: an emitter counts the births of one pool; a plain function, or a module that declares nothing, may
    hold an array of all lanes or index them.
    """
    hidden = bool(find_plain_functions(scene.forces)) or may_hide_lanes(
        scene, scene.state.lanes, scene.state.position.shape[-1]
    )
    if scene.emitter is None and not hidden:
        return None
    return tuple(jax.tree.leaves(_find_copied_arrays(scene)))


def map_copies(function: Callable[[Scene], PyTree], scene: Scene, copied: tuple[bool, ...] | None) -> PyTree:
    """A function of a scene of stacked copies, or, where `copied` says which arrays each has for itself, of each of them.

    The copies are then the second axis of what it returns, behind that of the frames.
    """
    if copied is None:
        return function(scene)
    axes = jax.tree.unflatten(jax.tree.structure(scene), [0 if own else None for own in copied])
    return eqx.filter_vmap(function, in_axes=(axes,), out_axes=1)(scene)


def _find_copied_arrays(scene: Scene) -> Scene:
    """The scene with True in place of each array that every copy has for itself, False elsewhere."""
    changing = scene.changing()

    def mark(part, changes, per_lane):
        # without a lane axis the copies share numbers; so they do where a part ties lanes together, such as springs,
        # since their numbers belong to pairs of nodes and broadcast over leading axes
        own = bool(scene.state.lanes) and per_lane
        either = lambda changed, has_lanes: changed or (own and has_lanes)  # noqa: E731
        return jax.tree.map(either, changes, scene.build_lane_mask(part))

    marked = {
        name: mark(getattr(scene, name), getattr(changing, name), per_lane=True)
        for name in ("mass", "pinned", "emitter")
    }
    for name in ("forces", "contacts"):
        pairs = zip(getattr(scene, name), getattr(changing, name), strict=True)
        marked[name] = tuple(mark(part, changes, per_lane=not _couples(part)) for part, changes in pairs)
    return changing.replace(state=jax.tree.map(lambda _: True, scene.state), **marked)


def _couples(part: PyTree) -> bool:
    """Whether a force or contact ties lanes together; one that does not say counts as coupling."""
    return not isinstance(part, Force | Contact | Function) or part.couples


# treatments of contacts


def list_treatments(scene: Scene) -> dict[str, Scene]:
    """The scene as given, and where it times impacts also the scene that projects instead."""
    if not any(contact.response is contacts.impact for contact in scene.contacts):
        return {AS_GIVEN: scene}
    project = [
        replace(contact, response=contacts.project, touching_since=None)
        if contact.response is contacts.impact
        else contact
        for contact in scene.contacts
    ]
    projected = Scene(scene.state, scene.mass, scene.forces, project, scene.pinned, scene.emitter)
    return {AS_GIVEN: scene, PROJECTED: projected}
