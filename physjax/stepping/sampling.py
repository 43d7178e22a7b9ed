"""Frames of a run whose method goes its own way: no lane waits for another at a frame, also where derivatives are asked for.

Each lane writes its frames when it gets there, in one loop without derivatives. Where something is differentiated the
frames are taken one after the other, from the same steps.
"""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, PyTree

from physjax.backend import splits_vectors
from physjax.components import compute_by_components, forget_wholes, split_vectors
from physjax.loops import Time, moment_at
from physjax.parts import holds_user_code, is_untransformed
from physjax.scene import Scene
from physjax.stepping.blocks import Blocks
from physjax.stepping.pairs import Remembering


@runtime_checkable
class Sampling(Remembering, Protocol):
    """A method with a memory that can take all frames of a run in one loop."""

    def sample(
        self, system: Any, clock: Callable[[Array], Time], dt: ArrayLike, frames: int, memory: Any
    ) -> tuple[Any, Any]:
        """The states at the ends of `frames` dt, the n-th of which begins at `clock(n)`, and the memory."""
        ...


def sample_frames(
    scene: Scene, method: Sampling, dt: Array, first_step: Array, frames: int, save_every: ArrayLike
) -> PyTree:
    """The states after every `save_every` dt [s], along a leading axis."""
    arguments = scene, method, dt, first_step, jnp.asarray(save_every, jnp.int32)
    # a number that a user's function closes over is differentiated as well, which a custom rule does not allow
    if holds_user_code((scene, method)) and not is_untransformed(arguments):
        return _take_one_by_one(frames, *arguments)
    leaves, structure = jax.tree.flatten(arguments)

    @jax.custom_jvp
    def run(*leaves: Array) -> PyTree:
        return _take_in_one_loop(frames, *structure.unflatten(leaves))

    @run.defjvp
    def push(leaves: tuple, changes: tuple) -> tuple:
        return jax.jvp(lambda *leaves: _take_one_by_one(frames, *structure.unflatten(leaves)), leaves, changes)

    return run(*leaves)


def _take_in_one_loop(
    frames: int, scene: Scene, method: Sampling, dt: Array, first_step: Array, save_every: Array
) -> PyTree:
    """All frames in one loop, of blocks of lanes one after the other where there are many."""
    arrays, still = eqx.partition(scene, scene.changing())

    def run_whole(arrays: PyTree, still: PyTree, dt: Array) -> PyTree:
        part = eqx.combine(arrays, still)
        clock = lambda n: moment_at(first_step + n * save_every, dt, part.state.dtype)  # noqa: E731
        span = dt * save_every.astype(dt.dtype)
        memory = method.start(part, clock(jnp.zeros((), jnp.int32)), part.state, span)
        return method.sample(part, clock, span, frames, memory)[0]

    def run(arrays: PyTree, still: PyTree, dt: Array) -> PyTree:
        if not splits_vectors():
            return run_whole(arrays, still, dt)
        vectors = scene.build_vector_mask((arrays, still))
        moving, constant = (split_vectors(*pair) for pair in zip((arrays, still), vectors, strict=True))
        moving = forget_wholes(moving)
        return compute_by_components(run_whole, moving, constant, dt)(moving, constant, dt)

    # steps of its own are more than those of a block must be for it to pay
    blocks = Blocks.of(scene, arrays, frames * 8)
    if blocks is None:
        return run(arrays, still, dt)
    masks = scene.build_lane_mask((still, dt))
    taken = blocks.map(run, blocks.cut(arrays), still, dt, masks=masks)
    return blocks.join(jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 1, 0), taken), leading=1)


def _take_one_by_one(
    frames: int, scene: Scene, method: Sampling, dt: Array, first_step: Array, save_every: Array
) -> PyTree:
    """A frame after the other, differentiable."""
    clock = lambda n: moment_at(first_step + n * save_every, dt, scene.state.dtype)  # noqa: E731
    span = dt * save_every.astype(dt.dtype)

    def frame(carried: tuple[PyTree, PyTree], n: Array) -> tuple[tuple[PyTree, PyTree], PyTree]:
        state, memory = carried
        state, memory = method.advance(scene, clock(n), state, span, memory)
        return (state, memory), state

    memory = method.start(scene, clock(jnp.zeros((), jnp.int32)), scene.state, span)
    return lax.scan(frame, (scene.state, memory), jnp.arange(frames, dtype=jnp.int32))[1]


__all__ = ["Sampling", "sample_frames"]
