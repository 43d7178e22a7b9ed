"""The one place that knows the compiler and the device: what XLA needs to run physics fast that is written without it.

What the compiler is asked for is in `xla_options`.

Each policy has its reason and its measurement next to it. CPU figures are of two cores with AVX-512 and jax 0.10.1 or
0.12, unless they say otherwise.

- What is computed by components: `splits_vectors`.
- What is computed once: `any_lane`, `materialise`, `materialise_where`, `block_fusion`, `evaluate_coupled`,
  `store_on_any_device`, `SPRINGS_AT_BOTH_ENDS`.
- How a loop is compiled: `split_compilation`, `compiles_loop_in_pieces`, `needs_split_compilation`.
- How many steps are a kernel: `choose_unrolled_steps`, `runs_as_kernel`, `choose_kernel_shape`.
- How much is computed at once: `choose_group_lanes`, `count_lane_blocks`, `choose_block_lanes`, `choose_block_targets`,
  `choose_pair_kernel`, `choose_tile_sources`.
- Which clock a search goes by, and how a device is called: `read_work_clock`, `device_kind`, `describe_device`.
"""

import math
import platform
import time
from collections.abc import Callable, Iterable
from functools import partial
from importlib.util import find_spec
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Int, PyTree

T = TypeVar("T")
"""A tree of arrays that comes back with the same structure and shapes."""

MIN_LANES_TO_SELECT = 1024
"""Below this many lanes computing all of them costs less than gathering and scattering those that are flagged."""
GROUPS_PER_SCENE = 32
"""Flagged lanes are computed in groups of one lane in 32: a group's cost is paid whole, however few lanes are in it."""
MIN_GROUP_LANES_ON_GPU = 65_536
"""Fewer lanes do not fill a card of 132 multiprocessors."""
SINGLE_PIECE_NODES = 64
"""Coupled scenes with at most this many nodes are compiled as one piece, which runs faster and still compiles quickly."""
LANES_PER_BLOCK = 8192
"""Lanes in a block: 200 kB of state in 3-D and float32, which leaves room for the stages of a step in a 1 MB cache."""
MIN_LANES_TO_CUT = 6 * LANES_PER_BLOCK
"""Fewer lanes fit a cache as they are; 65 536 lanes of a flight run 20 % faster in blocks."""
MIN_STEPS_PER_FRAME = 8
"""With fewer steps between frames, copying into blocks and back costs more than the cache gives."""
MAX_CARRIED_BYTES = 64 * LANES_PER_BLOCK
"""Bytes of a sweep's block that one turn of a loop hands to the next, to stay in a core's cache with a step's stages."""
MAX_BATCH_LANES = 16 * LANES_PER_BLOCK
"""Lanes in a batch of a sweep at most: more gain nothing, and a batch is what a kill loses."""
MAX_UNROLLED_STEPS, MAX_UNROLLED_OPERATIONS = 16, 2500
"""Steps that a turn of a loop takes on a GPU at most, and operations in them."""
KERNEL_LANES = 128
"""Lanes in a block of a kernel, a thread each; 32 and 256 are no faster."""
MAX_KERNEL_OPERATIONS = 5000
"""The most operations in a kernel's step; a longer one takes the plain loop.

A bounce off a plane has 2300 and compiles in 1 s, one in a room 4000 in the plane and 10 000 in space, which takes 9 s; a
box that falls on a floor has 14 000, and takes 70.
"""
SOURCES_PER_TILE = 64
"""Bodies whose attraction is summed at once on a CPU: few enough for registers and caches, enough to hide the loop over tiles."""
PAIRS_PER_TILE = 2**19
"""Pairs in a tile elsewhere, where a tile's are stored: 2 MB for each array of them in float32, in each of many scenes."""
TARGETS_PER_BLOCK = 4096
"""Bodies for which the attraction of all others is one reduction, which may store its pairs: enough to fill a card."""
SPRINGS_AT_BOTH_ENDS = True
"""Whether a GPU computes each spring at both of its ends, or once and stores what both ends read.

At both ends a step is one kernel: for a cloth of six bands 12 roots and 119 reads a node. Once, it is two, with 6 numbers a
node between them. G node-steps/s of 128², 512² and 1024² nodes on an H200: 1.4, 12.9, 9.4 and 1.2, 10.6, 11.0.
"""
PAIR_TARGETS, PAIR_SOURCES, PAIR_WARPS, PAIR_PROGRAMS = 64, 32, 4, 1024
"""Targets and sources in a tile of that kernel, 16 pairs for each thread; warps that share it; how many tiles fill a card."""
MIN_BODIES_FOR_KERNEL = 256
"""With fewer bodies a reduction stores less than a card's cache holds."""


@runtime_checkable
class Device(Protocol):
    """A device as jax lists it, of which only the kind counts."""

    @property
    def platform(self) -> str:
        """The kind: "cpu", "gpu" or "tpu"."""
        ...


def device_kind() -> str:
    """The kind of the device that computes by default: "cpu", "gpu" or "tpu"."""
    return jax.default_backend()


def on_cpu() -> bool:
    """Whether the default device is a CPU."""
    return device_kind() == "cpu"


def jit_is_disabled() -> bool:
    """Whether programs run operation by operation, as under `jax.disable_jit()`, so that all numbers can be looked at."""
    return jax.config.jax_disable_jit  # pyright: ignore[reportAttributeAccessIssue] - jax adds its flags at run time


def describe_device() -> str:
    """The device that computes by default and the operating system, e.g. "CPU (x86_64), Linux"."""
    device = jax.devices()[0]
    chip = platform.machine() if device.platform == "cpu" else device.device_kind
    return f"{device.platform.upper()} ({chip}), {platform.system()}"


def read_work_clock() -> float:
    """Seconds by which a search is bounded: of processor time on a CPU, wall-clock time elsewhere.

    Processor time does not depend on what else the machine is doing. But a GPU's work takes none: a search that waits
    for one would never end.
    """
    return time.process_time() if on_cpu() else time.perf_counter()


# what is computed by components

BARRIER = "optimization_barrier"
"""The primitive that stands between what may not be fused, by its name in a program."""


def splits_vectors() -> bool:
    """Whether the vectors of a step are carried and computed as one array for each component.

    On a GPU an operation on `(lanes, dim)` arrays gives each component a thread of its own, which computes the whole
    lane again wherever a length is needed. On a CPU it is a matter of versions: 65 536 flights run 0.9 (jax 0.10) and 1.1
    times (0.12) as fast, timed impacts 0.8 times, and the first run takes up to 1.9 times as long.
    """
    return not on_cpu() and not jit_is_disabled()


# how many steps are a kernel


def choose_unrolled_steps(operations: int) -> int:
    """How many steps a turn of a loop takes, given the number of operations in a step.

    On a GPU a turn is a launch (10 µs) and takes the state through memory, and a step that reads its neighbours cannot
    write in place: an even number of steps needs no copy. On a CPU each step more halves the speed: XLA computes the chain
    of them again for every array that leaves it.
    """
    if on_cpu():
        return 1
    fitting = MAX_UNROLLED_OPERATIONS // operations
    return min(MAX_UNROLLED_STEPS, 2 ** max(1, int(math.log2(max(1, fitting)))))


def runs_as_kernel(arrays: Iterable[Any]) -> bool:
    """Whether the steps of independent lanes between two frames are one kernel: the arrays are all on one GPU.

    Flights by rk4 on an H200, G particle-steps/s, of 65 536, 10⁶ and 10⁷ lanes: 20, 111 and 177; with 2 ms more a call on the
    host in one kernel 5.4, 58 and 160, unrolled by 16 in a loop 5.0, 48 and 131, the plain loop 2.7, 36 and 68. Balls that
    bounce at the time of impact, M: in one kernel 5100 and 10 600 (10⁶), in the loop 32.
    """
    if device_kind() != "gpu" or jit_is_disabled() or find_spec("jax.experimental.pallas.triton") is None:
        return False
    places = {device for array in arrays if isinstance(array, jax.Array) for device in array.devices()}
    return len(places) <= 1 and all(device.platform == jax.default_backend() for device in places)


class KernelShape(NamedTuple):
    """How many lanes a block of a kernel has, and the options for Pallas."""

    lanes: int
    options: dict[str, Any]


def choose_kernel_shape() -> KernelShape:
    """A thread for each lane."""
    return KernelShape(KERNEL_LANES, _build_kernel_options(warps=KERNEL_LANES // 32))


def _build_kernel_options(warps: int) -> dict[str, Any]:
    """The options for Pallas: how many warps share a block. On a CPU, as if for a GPU in tests, kernels are interpreted."""
    if jax.default_backend() == "cpu":
        return {"interpret": True}
    from jax.experimental.pallas import triton

    return {"compiler_params": triton.CompilerParams(num_warps=warps, num_stages=1)}


# what is computed once


@jax.custom_batching.custom_vmap
def any_lane(flag: Bool[Array, "..."]) -> Bool[Array, ""]:
    """Whether any lane is flagged, of this scene and of all that are batched with it.

    A rare branch is taken when any lane needs it. Under `vmap` JAX would turn a `cond` on a batched predicate into a
    `select` that computes both sides; one predicate for the whole batch keeps it a branch.
    """
    return jnp.any(flag)


@any_lane.def_vmap
def _any_lane_of_a_batch(axis_size: int, batched: list[bool], flag: Bool[Array, "..."]) -> tuple[Array, bool]:
    return any_lane(jnp.any(flag, axis=0)), False


def materialise_where(flag: Bool[Array, "..."], function: Callable[[], T], like: T | None = None) -> T:
    """`function()`, computed once and stored before anything reads it; where no lane is flagged it may be `like` instead.

    XLA on a CPU computes a cheap producer again in each of its readers, and a chain of stages exponentially often. It
    does not move code out of a branch, so the result of one is stored. `like` is zero by default.
    """
    if like is None:
        like = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(function))
    return lax.cond(any_lane(flag), function, lambda: like)


def materialise(t: ArrayLike, function: Callable[[], T]) -> T:
    """`function()`, computed once and stored before anything reads it, at any finite time t.

    On a CPU by a branch whose predicate the compiler cannot evaluate: under jax 0.10 a barrier does not hold there. 200
    steps of rk4 of a flag of 16 x 24 nodes take 10 ms with it, 49 without and 51 with a barrier; under jax 0.12 8, 39
    and 9. On a GPU a branch would ask the host (tens of µs).
    """
    if on_cpu():
        return materialise_where(jnp.isfinite(t), function)
    return lax.optimization_barrier(function())


def hide_constant(number: ArrayLike, step: Array) -> Array:
    """The number, hidden on a CPU from the compiler's constant folding in a loop whose counter is `step`.

    Under a user's jit the time step is a constant, the branches of `materialise` at it are folded away, and nothing is stored:
    the gradient of ten steps of 1024 bodies in space under leapfrog then takes 23 s instead of 19 ms.
    """
    number = jnp.asarray(number)
    return jnp.where(step >= 0, number, jnp.zeros_like(number)) if on_cpu() else number


def block_fusion(tree: T) -> T:
    """The arrays as they are; on a CPU what computes them is not fused with what reads them.

    For what each reader would otherwise compute again: a spring's tension for every component and both ends, the
    padded copy of a sheet for each of its shifted slices, the path of a prescribed node for all of its neighbours. The
    flag of `materialise` takes 1.4 times as long without. On a GPU every barrier is one more kernel in a step, and costs
    more than it saves.
    """
    return lax.optimization_barrier(tree) if on_cpu() else tree


def store_on_any_device(tree: T) -> T:
    """The arrays as they are, stored before anything reads them, on a GPU too: for what is gathered from there."""
    return lax.optimization_barrier(tree)


def evaluate_coupled(t: ArrayLike, function: Callable[[PyTree], T], state: PyTree) -> T:
    """`function(state)` of coupled nodes, of which each reads the state of its neighbours, at any finite time t.

    Without a store between two evaluations a neighbour's stages would be computed by all that read it. On a CPU what is
    found is stored, on a GPU the state.
    """
    if on_cpu():
        return materialise(t, lambda: function(state))
    if jit_is_disabled():  # a checkpoint traces in any case, and would hide the numbers from a debugger
        return function(state)
    # computed again in reverse mode: storing what a spring's derivative needs takes longer than finding it
    return jax.checkpoint(function, prevent_cse=False)(store_on_any_device(state))


# how a loop is compiled


def needs_split_compilation(couples: bool, lanes: tuple[int, ...]) -> bool:
    """Whether the steps of a scene are compiled in pieces: where more than a few nodes are coupled."""
    return couples and lanes[-1:] > (SINGLE_PIECE_NODES,)


def split_compilation(state: PyTree, step: Int[Array, ""]) -> PyTree:
    """The state as it is; on a CPU a loop over `step` that has this in its body is compiled in pieces.

    XLA on a CPU makes one LLVM function of a small loop and of everything in it, whose compile time grows faster than
    its length: the gradient of 200 rk4 steps of a cloth took 136 s to compile, in pieces 9 s.
    """
    return jax.tree.map(lambda leaf: _sort_in_passing(leaf, step), state) if on_cpu() else state


@partial(jax.checkpoint, prevent_cse=False)  # so that reverse mode has a sort in its loop as well
def _sort_in_passing(array: Array, number: Int[Array, ""]) -> Array:
    """The array times one, which is found by sorting two numbers: no loop with a sort in it is made one function."""
    return array * (lax.sort(jnp.stack([number, number + 1]))[0] == number).astype(array.dtype)


def compiles_loop_in_pieces(carried: PyTree) -> bool:
    """Whether a loop needs a sort in it to be compiled in pieces: on a CPU with few lanes; with many XLA does so by itself."""
    return on_cpu() and max(leaf.size for leaf in jax.tree.leaves(carried)) < MIN_LANES_TO_SELECT


# how much is computed at once


def choose_group_lanes(lanes: int) -> int | None:
    """In groups of how many lanes the flagged ones of a scene are computed; None where all lanes are.

    A GPU that is not full takes no longer for all lanes than for one group, and each group is a queue of its own.
    """
    size = max(math.ceil(lanes / GROUPS_PER_SCENE), 1 if on_cpu() else MIN_GROUP_LANES_ON_GPU)
    return None if lanes < MIN_LANES_TO_SELECT or lanes <= 2 * size else size


def count_lane_blocks(lanes: int, steps_per_frame: int) -> int | None:
    """Into how many blocks independent lanes are cut that are stepped one after the other; None where that does not pay.

    A block stays in a CPU's cache between two frames, so the state crosses main memory once a frame instead of once a
    step: a million lanes run at the speed of ten thousand. A GPU has no such cache, and wants all lanes at once.
    """
    if not on_cpu() or lanes < MIN_LANES_TO_CUT or steps_per_frame < MIN_STEPS_PER_FRAME:
        return None
    return math.ceil(lanes / LANES_PER_BLOCK)


def choose_block_lanes(device: Device, carried_bytes: int) -> int:
    """Lanes in a block of a sweep on a device, given the bytes that each carries through a loop.

    A CPU is fastest in its cache, anything else with all that it can hold.
    """
    return min(MAX_CARRIED_BYTES // carried_bytes, LANES_PER_BLOCK) if device.platform == "cpu" else MAX_BATCH_LANES


def choose_block_targets(bodies: int) -> int | None:
    """For how many of so many bodies the attraction of all is summed at once; None: it is folded over tiles of sources.

    On a CPU the pairs of a tile stay in a cache. A GPU is faster with all sources at once: 24, 82 and 184 G pairs/s in
    tiles, 86, 350 and 363 in one reduction (4096, 16 384, 65 536 bodies, H200).
    """
    return None if on_cpu() else min(bodies, TARGETS_PER_BLOCK)


class PairKernel(NamedTuple):
    """Targets and sources in a tile, in how many shares the sources are summed side by side, and the options for Pallas."""

    targets: int
    sources: int
    shares: int
    options: dict[str, Any]


def choose_pair_kernel(bodies: int) -> PairKernel | None:
    """How a GPU sums over all pairs of bodies in one kernel; None where that is a reduction.

    In a reduction XLA stores what the components of a pair's pull share: 17 GB for 65 536 bodies without blocks.
    """
    if device_kind() != "gpu" or bodies < MIN_BODIES_FOR_KERNEL:
        return None
    shares = max(1, min(PAIR_PROGRAMS * PAIR_TARGETS // bodies, bodies // (4 * PAIR_SOURCES)))
    return PairKernel(PAIR_TARGETS, PAIR_SOURCES, shares, _build_kernel_options(PAIR_WARPS))


def choose_tile_sources(bodies: int) -> int:
    """How many sources are in a tile of a sum that is folded over tiles."""
    return SOURCES_PER_TILE if on_cpu() else max(SOURCES_PER_TILE, PAIRS_PER_TILE // bodies)
