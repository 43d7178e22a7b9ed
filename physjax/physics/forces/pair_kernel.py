"""A sum over all pairs as one kernel of a GPU, in which no pair is stored.

A block of targets goes over tiles of sources, each pair of which is a number of a thread, and adds them up at the end.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.experimental import pallas as pl
from jaxtyping import Array

from physjax.backend import PairKernel


def sum_pairs_in_kernel(
    term: Callable[[list[Array], Array, Array | None], list[Array]],
    bodies: list[Array],
    strength: Array,
    softening: Array | None,
    shape: PairKernel,
) -> list[Array]:
    """The sum over all sources of a term of offsets, strength and softening, for each body `(nodes,)`."""
    count, dim = strength.shape[-1], len(bodies)
    blocks = -(-count // shape.targets)
    share = -(-count // (shape.shares * shape.sources)) * shape.sources
    targets = [_fill(x, blocks * shape.targets) for x in bodies]
    sources = [_fill(a, shape.shares * share) for a in (*bodies, strength)]
    numbers = [] if softening is None else [jnp.reshape(softening, (1,))]
    tile = jax.ShapeDtypeStruct((shape.targets, shape.sources), strength.dtype)
    row = jax.ShapeDtypeStruct((1, shape.sources), strength.dtype)
    kinds = jax.eval_shape(term, [tile] * dim, row, softening)

    def kernel(*refs: Any) -> None:
        here = [ref[...][:, None] for ref in refs[:dim]]
        there, given, sums = refs[dim : 2 * dim + 1], refs[2 * dim + 1 : -len(kinds)], refs[-len(kinds) :]
        first = pl.program_id(1) * share
        number = given[0][0] if given else None

        def add_tile(turn: Array, total: list[Array]) -> list[Array]:
            at = pl.ds(first + turn * shape.sources, shape.sources)
            *x, weight = (ref[at][None, :] for ref in there)
            parts = term([s - t for s, t in zip(x, here, strict=True)], weight, number)
            return [a + b for a, b in zip(total, parts, strict=True)]

        nothing = [jnp.zeros(kind.shape, kind.dtype) for kind in kinds]
        total = lax.fori_loop(0, share // shape.sources, add_tile, nothing)
        for ref, part in zip(sums, total, strict=True):
            ref[0, :] = jnp.sum(part, axis=1)

    block = pl.BlockSpec((shape.targets,), lambda i, j: (i,))
    whole = pl.BlockSpec((shape.shares * share,), lambda i, j: (0,))
    found = pl.pallas_call(
        kernel,
        grid=(blocks, shape.shares),
        in_specs=[*[block] * dim, *[whole] * (dim + 1), *[pl.BlockSpec((1,), lambda i, j: (0,)) for _ in numbers]],
        out_specs=[pl.BlockSpec((1, shape.targets), lambda i, j: (j, i)) for _ in kinds],
        out_shape=[jax.ShapeDtypeStruct((shape.shares, blocks * shape.targets), kind.dtype) for kind in kinds],
        **shape.options,
    )(*targets, *sources, *numbers)
    return [jnp.sum(part, axis=0)[:count] for part in found]


def _fill(a: Array, size: int) -> Array:
    """An array as long as it must be; what is beyond its end is zero."""
    return jnp.pad(a, (0, size - a.shape[-1]))
