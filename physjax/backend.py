"""The one place that knows the compiler and the device: what XLA needs to run physics fast that is written without it.

Each policy has its reason and its measurement next to it. CPU figures are of two cores with AVX-512 and jax 0.10.1 or
0.12, unless they say otherwise.

- What is computed by components: `splits_vectors`.
- What is computed once: `any_lane`, `materialise`, `materialise_where`, `block_fusion`, `evaluate_coupled`,
  `store_on_any_device`, `SPRINGS_AT_BOTH_ENDS`.
- How a loop is compiled: `split_compilation`, `bounded_while_loop`, `needs_split_compilation`.
- Which lanes are computed: `compact_and_apply`, `compact_and_apply_runs`.
- How much is computed at once: `count_lane_blocks`, `choose_block_lanes`, `choose_block_targets`, `choose_pair_kernel`,
  `choose_tile_sources`.
- What the compiler is asked for: `jit_untransformed`.
- What its programs depend on: `name_compiler_target`.
- Which clock a search goes by, and how a device is called: `read_work_clock`, `device_kind`, `describe_device`.
"""

import functools
import hashlib
import math
import platform
import time
import warnings
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Int, PyTree

S = TypeVar("S")
"""A tree of arrays that goes in."""
T = TypeVar("T")
"""A tree of arrays that comes back with the same structure and shapes."""

MIN_LANES_TO_SELECT = 1024
"""Below this many lanes computing all of them costs less than gathering and scattering those that are flagged."""
GROUPS_PER_SCENE = 32
"""Flagged lanes are computed in groups of one lane in 32: a group's cost is paid whole, however few lanes are in it."""
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
SOURCES_PER_TILE = 64
"""Bodies whose attraction is summed at once on a CPU: few enough for registers and caches, enough to hide the loop over tiles."""
PAIRS_PER_TILE = 2**19
"""Pairs in a tile elsewhere, where a tile's are stored: 2 MB for each array of them in float32, in each of many scenes."""
TARGETS_PER_BLOCK = 4096
"""Bodies for which the attraction of all others is one reduction, which may store its pairs: enough to fill a card."""
SPRINGS_AT_BOTH_ENDS = True
"""Whether a GPU computes each spring at both of its ends, or once and stores what both ends read.

At both ends a step is one kernel: for a cloth of six bands 12 roots and 119 reads a node. Once, it is two, with 6 numbers a
node written and read back between them.
"""
PAIRS_IN_KERNEL = True
"""Whether a GPU sums over pairs in a kernel.

In a reduction XLA stores what the components of a pair's pull share: 17 GB for 65 536 bodies without blocks.
"""
PAIR_TARGETS, PAIR_SOURCES, PAIR_WARPS, PAIR_PROGRAMS = 64, 32, 4, 1024
"""Targets and sources in a tile of that kernel, 16 pairs for each thread; warps that share it; and how many tiles fill a card."""
MIN_BODIES_FOR_KERNEL = 256
"""With fewer bodies a reduction stores less than a card's cache holds."""
WIDE_VECTOR_OPTIONS = {"xla_cpu_prefer_vector_width": 512}
"""XLA fills half of an AVX-512 register unless asked for more, which makes a step 1.4 to 1.5 times faster."""
OLDER_EMITTER_OPTIONS = {"xla_cpu_use_fusion_emitters": False}
"""Timed contacts are many small kernels, over which the emitters of jax 0.10 take twice the compile time of the older ones.

From jax 0.11 on there are no others, and the option is gone.
"""


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


def evaluate_coupled(t: ArrayLike, function: Callable[[S], T], state: S) -> T:
    """`function(state)` of coupled nodes, of which each reads the state of its neighbours, at any finite time t.

    Without a store between two evaluations a neighbour's stages would be computed again by all that read it. On a CPU
    what is found is stored, on a GPU what is read: the state, of which the first of a step is in memory already.
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


def bounded_while_loop(going: Callable[[T], Array], body: Callable[[T], T], start: T, *, most: int) -> T:
    """`lax.while_loop(going, body, start)` with at most `most` turns.

    On a CPU it is compiled in pieces where lanes are few, by a sort of two counters: with many lanes XLA does that by
    itself. Two rough balls took half a minute to compile while each of their small loops was one function.
    """
    few = on_cpu() and max(leaf.size for leaf in jax.tree.leaves(start)) < MIN_LANES_TO_SELECT

    def goes_on(state):
        return going(state[0]) & (state[1][0] < most)

    def turn(state):
        carry, count = state
        return body(carry), lax.sort(count + 1) if few else count + 1

    return lax.while_loop(goes_on, turn, (start, jnp.arange(2, dtype=jnp.int32)))[0]


# which lanes are computed


def compact_and_apply(
    function: Callable[..., T],
    flag: Bool[Array, "*lanes"],
    changing: T,
    *others: PyTree,
    masks: PyTree,
    cut: bool,
) -> T:
    """`function(changing, *others)`, computed only if a lane is flagged; it must leave the other lanes as they are.

    `changing` and what comes back are trees of per-lane arrays; `masks` say of `others` which arrays are. With `cut`, and
    many lanes, only the flagged ones are gathered, in groups of a fixed size, so that the work follows their number;
    reverse mode goes through.
    """
    lanes, total = flag.shape, flag.size
    if not cut or total < MIN_LANES_TO_SELECT:
        return lax.cond(any_lane(flag), lambda: function(changing, *others), lambda: changing)
    size = math.ceil(total / GROUPS_PER_SCENE)
    by_lane = lambda leaf: leaf.reshape((total, *leaf.shape[len(lanes) :]))  # noqa: E731
    flat = jax.tree.map(by_lane, changing)
    words, upto = _pack_flags(flag.ravel())

    def apply_to_group(now, first):
        index = _find_flagged_lanes(words, upto, first + jnp.arange(size, dtype=jnp.int32))
        pick = lambda leaf: leaf.at[index].get(mode="clip")  # noqa: E731
        few = jax.tree.map(lambda a, has_lanes: pick(by_lane(a)) if has_lanes else a, others, masks)
        done = function(jax.tree.map(pick, now), *few)
        # beyond the last flagged lane there is none, and nothing is written
        return jax.tree.map(lambda a, b: a.at[index].set(b, mode="drop"), now, done)

    def apply_to_groups(now, first):
        apply = lambda now, first: (  # noqa: E731
            lax.cond(any_lane(first < upto[-1]), lambda: apply_to_group(now, first), lambda: now),
            None,
        )
        return lax.scan(apply, now, first)[0]

    firsts = jnp.arange(0, total, size, dtype=jnp.int32)
    end = apply_to_groups(flat, firsts[:1])
    end = lax.cond(any_lane(upto[-1] > size), lambda: apply_to_groups(end, firsts[1:]), lambda: end)
    return jax.tree.map(lambda a, was: a.reshape(was.shape), end, changing)


def compact_and_apply_runs(
    function: Callable[..., T], flagged: Callable[..., Bool[Array, "lanes"]], changing: T, *others: PyTree
) -> T:
    """`function(changing, *others)`, computed only where `flagged(changing, *others)`, for flags that come in runs.

    `changing` and what comes back are trees of arrays along one axis of lanes; the function must leave other lanes as they
    are, and clear the flag of those it is for. Windows slide to the next flagged lane until there is none: a slice is
    copied where the lanes picked by `compact_and_apply` would be gathered and scattered. Reverse mode goes through.
    """
    total = len(jax.tree.leaves(changing)[0])
    if total < MIN_LANES_TO_SELECT:
        return lax.cond(any_lane(flagged(changing, *others)), lambda: function(changing, *others), lambda: changing)
    size = math.ceil(total / GROUPS_PER_SCENE)

    def apply_to_window(now):
        first = jnp.minimum(jnp.argmax(flagged(now, *others)).astype(jnp.int32), total - size)
        cut = partial(jax.tree.map, lambda leaf: lax.dynamic_slice_in_dim(leaf, first, size))
        done = function(cut(now), *map(cut, others))
        return jax.tree.map(lambda a, b: lax.dynamic_update_slice_in_dim(a, b, first, 0), now, done)

    def where_left(go_on, now):
        return lax.cond(any_lane(flagged(now, *others)), lambda: go_on(now), lambda: now)

    once = partial(where_left, apply_to_window)
    # the last window is moved back to fit, and so may be one more for lanes that come round to the first
    rest = lambda now: lax.scan(lambda now, _: (once(now), None), now, length=GROUPS_PER_SCENE)[0]  # noqa: E731
    return where_left(rest, once(changing))


def _pack_flags(flag: Bool[Array, "lanes"]) -> tuple[Array, Array]:
    """The flags as words of 32 bits, and how many are set up to and in each word: bit b of word w is lane b·words + w."""
    length = math.ceil(flag.size / 32)
    bits = jnp.pad(flag, (0, 32 * length - flag.size)).reshape(32, length).astype(jnp.uint32)
    words = bits[0]
    for place in range(1, 32):
        words = words | (bits[place] << place)
    return words, jnp.cumsum(lax.population_count(words).astype(jnp.int32), dtype=jnp.int32)


def _find_flagged_lanes(words: Array, upto: Array, number: Array) -> Array:
    """The lanes of the flags with these numbers, counted from zero; at least the number of lanes where there are fewer flags."""
    word = jnp.searchsorted(upto, number + 1, method="scan_unrolled").astype(jnp.int32)
    left = words.at[word].get(mode="clip")
    rank = number - upto.at[word].get(mode="clip") + lax.population_count(left).astype(jnp.int32)
    place = jnp.zeros_like(number)
    for width in (16, 8, 4, 2, 1):
        below = lax.population_count(left & jnp.uint32((1 << width) - 1)).astype(jnp.int32)
        above = rank >= below
        rank = rank - jnp.where(above, below, 0)
        place = place + jnp.where(above, width, 0)
        left = jnp.where(above, left >> width, left)
    return jnp.where(word < words.size, place * words.size + word, 32 * words.size)


# how much is computed at once


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
    """Targets and sources in a tile, in how many shares the sources are summed side by side, and what Pallas is told."""

    targets: int
    sources: int
    shares: int
    options: dict[str, Any]


def choose_pair_kernel(bodies: int) -> PairKernel | None:
    """How a GPU sums over all pairs of bodies in one kernel; None where that is a reduction."""
    if device_kind() != "gpu" or not PAIRS_IN_KERNEL or bodies < MIN_BODIES_FOR_KERNEL:
        return None
    shares = max(1, min(PAIR_PROGRAMS * PAIR_TARGETS // bodies, bodies // (4 * PAIR_SOURCES)))
    if jax.default_backend() == "cpu":  # as if for a GPU, in tests
        return PairKernel(PAIR_TARGETS, PAIR_SOURCES, shares, {"interpret": True})
    from jax.experimental.pallas import triton

    options = {"compiler_params": triton.CompilerParams(num_warps=PAIR_WARPS, num_stages=1)}
    return PairKernel(PAIR_TARGETS, PAIR_SOURCES, shares, options)


def choose_tile_sources(bodies: int) -> int:
    """How many sources are in a tile of a sum that is folded over tiles."""
    return SOURCES_PER_TILE if on_cpu() else max(SOURCES_PER_TILE, PAIRS_PER_TILE // bodies)


# what the compiler is asked for


def jit_untransformed(
    function: Callable[..., T], device: Device | None = None, *, many_small_kernels: bool = False, **options: Any
) -> Callable[..., T]:
    """`jax.jit(function, **options)` with what makes a program fast on a device, the default one unless given.

    For functions that no `jit`, `vmap` or `grad` is around: XLA's options belong to a whole program, and JAX refuses
    them inside of another. An option that the installed compiler does not know is left out with a warning.
    `many_small_kernels` asks for what compiles those sooner.
    """
    kind = device_kind() if device is None else device.platform
    if kind != "cpu":
        return jax.jit(function, **options)
    wanted = dict(WIDE_VECTOR_OPTIONS)
    if many_small_kernels and jax.__version_info__ < (0, 11):
        wanted |= OLDER_EMITTER_OPTIONS
    known = {name: value for name, value in wanted.items() if _is_known_option(name, value)}
    return jax.jit(function, compiler_options=known or None, **options)


@functools.cache
def _is_known_option(name: str, value: int | bool) -> bool:
    """Whether the compiler takes an option, found once by compiling a program without operations (15 ms)."""
    try:
        probe = jax.jit(lambda x: x, compiler_options={name: value})
        probe.lower(jax.ShapeDtypeStruct((), jnp.float32)).compile()
    except jax.errors.JaxRuntimeError as error:
        warnings.warn(
            f"jax {jax.__version__} does not take the compiler option {name}={value}: {error}. Runs are as right without "
            "it, but may be slower.",
            stacklevel=2,
        )
        return False
    return True


# what compiled programs depend on


def name_compiler_target() -> str:
    """What compiled programs depend on, as the name of a folder: jaxlib's version, and the kind and features of the CPU.

    JAX tells the devices of its cache apart by their kind alone, and code for one CPU stops another that lacks an
    instruction.
    """
    features = hashlib.sha256(_read_cpu_features().encode()).hexdigest()[:12]
    return f"jaxlib-{version('jaxlib')}-{platform.machine()}-{features}"


def _read_cpu_features() -> str:
    """The model and instruction sets of the first CPU, where Linux lists them; elsewhere the name that the system gives it."""
    listed = Path("/proc/cpuinfo")
    if not listed.exists():
        return platform.processor()
    first = listed.read_text(encoding="utf-8").partition("\n\n")[0].splitlines()
    return "\n".join(
        line for line in first if line.split(":")[0].strip() in ("model name", "flags", "Features", "CPU part")
    )
