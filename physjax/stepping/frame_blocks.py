"""A run in blocks of frames, with the number of steps to each frame as data: it can be given up between two blocks.

What a live view needs: one compiled program for every step size and every duration, and an answer that does not wait
for a run that nobody asks for any more. Forward only; `simulate` is the run that is differentiated.
"""

from typing import TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int, PyTree

from physjax.scene import Scene
from physjax.stepping.frames import Moving
from physjax.stepping.simulate import start_memory, take_step

if TYPE_CHECKING:
    from collections.abc import Callable


def begin_run(scene: Scene, method: "Callable", dt: Array) -> Moving:
    """What a run carries before its first step: what steps change of the scene, and the memory of a method."""
    arrays = eqx.filter(scene, scene.changing())
    return Moving(arrays, start_memory(scene, method, jnp.zeros((), jnp.int32), dt))


def advance_block(
    scene: Scene, method: "Callable", dt: Array, moving: Moving, ends: Int[Array, "..."]
) -> tuple[Moving, PyTree]:
    """A run from the step `ends[0]` to `ends[-1]`, and what its steps change of the scene after each of `ends[1:]`.

    Where two of `ends` are the same no step is taken between them.
    """
    changing = scene.changing()
    still = eqx.filter(scene, changing, inverse=True)

    def step(i: Array, moving: Moving) -> Moving:
        stepped, memory = take_step(eqx.combine(moving.arrays, still), method, i, dt, moving.memory)
        return Moving(eqx.filter(stepped, changing), memory)

    def frame(moving: Moving, between: tuple[Array, Array]) -> tuple[Moving, PyTree]:
        moving = lax.fori_loop(*between, step, moving)
        return moving, moving.arrays

    return lax.scan(frame, moving, (ends[:-1], ends[1:]))
