"""Steps counted and repeated, so that time does not drift and reverse mode does not fill the memory."""

import math
from collections.abc import Callable
from functools import partial, reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array


def time_at(step: Array, dt: ArrayLike, dtype: np.dtype) -> Array:
    """Time is counted, t = i dt, never accumulated: accumulation drifts by a rounding error a step."""
    return step.astype(dtype) * dt


def repeat(step: Callable, carry: Any, first: Array, count: int) -> Any:
    """`step(i, carry)` for `count` steps from `first` on, in nested scans: reverse mode replays from √count checkpoints."""
    if count == 1:
        return step(first, carry)
    if jax.config.jax_disable_jit:  # a checkpoint would trace it all the same, and hide the numbers from who looks
        return reduce(lambda carry, i: step(first + i, carry), range(count), carry)
    inner = _near_root(count) if count > 16 else count
    outer, rest = divmod(count, inner)

    def run(carry, first, length):
        return lax.scan(lambda c, i: (step(first + i, c), None), carry, jnp.arange(length, dtype=jnp.int32))[0]

    if outer == 1 and not rest:
        return run(carry, first, count)
    chunk = jax.checkpoint(partial(run, length=inner), prevent_cse=False)
    carry, _ = lax.scan(lambda c, i: (chunk(c, first + i * inner), None), carry, jnp.arange(outer, dtype=jnp.int32))
    return run(carry, first + outer * inner, rest) if rest else carry


def _near_root(count: int) -> int:
    """A length for chunks of about √count: one that leaves no rest, if there is one, since a rest is compiled once more."""
    root = math.isqrt(count)
    exact = [length for length in range(root // 2, 2 * root + 1) if count % length == 0]
    return min(exact, key=lambda length: abs(length - root), default=root)
