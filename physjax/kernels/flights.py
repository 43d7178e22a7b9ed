"""Many steps of independent lanes in one kernel: what a lane is, what all lanes share, and how a block of lanes is run."""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental import pallas as pl
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jaxtyping import Array, PyTree

from physjax.backend import MAX_KERNEL_OPERATIONS, KernelShape, choose_kernel_shape
from physjax.kernels.interpreter import LaneInterpreter
from physjax.kernels.numbers import Numbers, UnsupportedError, flatten_to_vectors, from_list
from physjax.programs import count_operations

MAX_SHARED_NUMBERS = 256
"""More numbers that all lanes share, a table of them, are no numbers for a kernel that writes each out."""


class Layout(NamedTuple):
    """How a tree of arrays becomes columns, an array of all lanes for each number of one, and numbers that all lanes share."""

    structure: Any
    shapes: list[tuple[int, ...]]
    kinds: list[Any]
    has_lanes: list[bool]
    lanes: tuple[int, ...]
    padded: int

    @classmethod
    def of(cls, tree: PyTree, mask: PyTree, lanes: tuple[int, ...], padded: int) -> "Layout":
        """The layout of a tree, whose mask says which arrays have an entry for each lane; columns are `padded` long."""
        leaves, structure = jax.tree.flatten(tree)
        has_lanes = jax.tree.leaves(mask)
        shapes = [np.shape(a)[len(lanes) :] if own else np.shape(a) for a, own in zip(leaves, has_lanes, strict=True)]
        return cls(structure, shapes, [jnp.result_type(a) for a in leaves], has_lanes, lanes, padded)

    def describe_lane(self) -> PyTree:
        """Shapes and types of the arrays of one lane."""
        arrays = map(jax.ShapeDtypeStruct, self.shapes, self.kinds)
        return self.structure.unflatten(arrays)

    def count_numbers(self, own: bool) -> int:
        """How many columns there are (`own`), or how many shared numbers."""
        return sum(math.prod(shape) for shape, has in zip(self.shapes, self.has_lanes, strict=True) if has is own)

    def split(self, tree: PyTree) -> tuple[list[Array], list[Array]]:
        """The columns of a tree and its shared numbers; columns are filled with copies of the last lane."""
        columns, shared = [], []
        for leaf, shape, own in zip(jax.tree.leaves(tree), self.shapes, self.has_lanes, strict=True):
            rows = jnp.reshape(leaf, (-1, math.prod(shape)))
            parts = [rows[:, i] for i in range(rows.shape[1])]
            missing = self.padded - len(rows)
            (columns if own else shared).extend(
                jnp.pad(p, (0, missing), mode="edge") if own and missing else p for p in parts
            )
        return columns, shared

    def arrange(self, columns: Iterable[Any], shared: Iterable[Any]) -> list[Numbers]:
        """The arrays of a lane, number by number, from its entries of the columns and from the shared numbers."""
        own, same = iter(columns), iter(shared)
        described = zip(self.shapes, self.has_lanes, strict=True)
        return [from_list([next(own if has else same) for _ in range(math.prod(s))], s) for s, has in described]

    def join(self, columns: Sequence[Array]) -> PyTree:
        """The tree that has these columns, behind as many leading axes as these have."""
        left, total = iter(columns), math.prod(self.lanes)
        leaves = []
        for shape in self.shapes:
            parts = [next(left)[..., :total] for _ in range(math.prod(shape))]
            front = parts[0].shape[:-1]
            leaves.append(jnp.stack(parts, axis=-1).reshape((*front, *self.lanes, *shape)))
        return self.structure.unflatten(leaves)


class LaneKernel(NamedTuple):
    """A kernel that takes steps of independent lanes.

    `step` is one step of a block of lanes, number by number: of its number, the columns that move, those that do not
    (`columns`) and the numbers that all lanes share (`shared`).
    """

    step: ClosedJaxpr
    moving: Layout
    columns: list[Array]
    shared: list[Array]
    shape: KernelShape

    @classmethod
    def of(
        cls, step: Callable, lanes: tuple[int, ...], moving: PyTree, still: PyTree, masks: tuple[PyTree, PyTree]
    ) -> "LaneKernel | None":
        """The kernel for a step `(number, moving, still) -> moving`; None where something in it is not for a kernel.

        `masks` say of `moving` and of `still` which arrays have an entry for each lane; all that moves must.
        """
        shape = choose_kernel_shape()
        padded = -(-math.prod(lanes) // shape.lanes) * shape.lanes
        carried, constant = (
            Layout.of(tree, mask, lanes, padded) for tree, mask in zip((moving, still), masks, strict=True)
        )
        if not all(carried.has_lanes) or constant.count_numbers(own=False) > MAX_SHARED_NUMBERS:
            return None
        one = jax.make_jaxpr(step)(jnp.zeros((), jnp.int32), carried.describe_lane(), constant.describe_lane())
        columns, shared = constant.split(still)
        # what a step closes over, such as a tolerance, is shared as well
        sizes = [np.size(known) for known in one.consts]
        if sum(sizes) > MAX_SHARED_NUMBERS:
            return None
        closed_over = [jnp.ravel(known)[i] for known, size in zip(one.consts, sizes, strict=True) for i in range(size)]

        def take_step(number: Any, now: list, rest: list, same: list) -> list:
            same, held = same[: len(shared)], iter(same[len(shared) :])
            constants = [
                from_list([next(held) for _ in range(n)], np.shape(c)) for c, n in zip(one.consts, sizes, strict=True)
            ]
            ins = [from_list([number], ()), *carried.arrange(now, ()), *constant.arrange(rest, same)]
            found = LaneInterpreter(shape.lanes).run(one.jaxpr, constants, ins)
            return flatten_to_vectors(found, carried.kinds, shape.lanes)

        block = lambda kinds: [jax.ShapeDtypeStruct((shape.lanes,), kind) for kind in kinds]  # noqa: E731
        same = [jax.ShapeDtypeStruct((), number.dtype) for number in (*shared, *closed_over)]
        begun = block(
            kind for kind, rest in zip(carried.kinds, carried.shapes, strict=True) for _ in range(math.prod(rest))
        )
        try:
            written = jax.make_jaxpr(take_step)(jnp.zeros((), jnp.int32), begun, block(c.dtype for c in columns), same)
        except UnsupportedError:
            return None
        if count_operations(written) > MAX_KERNEL_OPERATIONS:
            return None
        return cls(written, carried, columns, [*shared, *closed_over], shape)

    def start(self, moving: PyTree) -> list[Array]:
        """What a run carries: an array of all lanes for each number of one."""
        return self.moving.split(moving)[0]

    def advance(self, carried: Sequence[Array], first: Array, count: int) -> list[Array]:
        """`count` steps from number `first` on, in one kernel."""
        lanes, moved, own = self.shape.lanes, len(carried), len(self.columns)
        by_lane, single = pl.BlockSpec((lanes,), lambda i: (i,)), pl.BlockSpec((1,), lambda i: (0,))
        step = jaxpr_as_fun(self.step)

        def kernel(*refs: Any) -> None:
            begun, rest = ([ref[...] for ref in some] for some in (refs[:moved], refs[moved : moved + own]))
            number, *same = (ref[0] for ref in refs[moved + own : -moved])
            end = lax.fori_loop(0, count, lambda i, now: step(number + i, *now, *rest, *same), begun)
            for ref, array in zip(refs[-moved:], end, strict=True):
                ref[...] = array

        shared = [jnp.reshape(number, (1,)) for number in (first, *self.shared)]
        end = pl.pallas_call(
            kernel,
            grid=(carried[0].shape[0] // lanes,),
            in_specs=[*[by_lane] * (moved + own), *[single] * len(shared)],
            out_specs=[by_lane] * moved,
            out_shape=[jax.ShapeDtypeStruct(a.shape, a.dtype) for a in carried],
            input_output_aliases={i: i for i in range(moved)},
            **self.shape.options,
        )(*carried, *self.columns, *shared)
        return list(end)
