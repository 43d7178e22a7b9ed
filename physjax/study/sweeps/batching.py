"""A measure as one compiled program over many lanes: traced once, with a status for each lane, run in blocks.

A block is a `vmap` over as many lanes as fit a cache; a batch is a few blocks in sequence, shared out over the devices.
"""

import functools
import hashlib
import inspect
import linecache
import math
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, Var, jaxpr_as_fun
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, PyTree

from physjax.backend import MAX_BATCH_LANES, choose_block_lanes
from physjax.study.sweeps.design import KeyPath, leaf_name
from physjax.study.sweeps.fingerprint import HostCall, find_host_calls, list_inner_jaxprs, persistent_digest
from physjax.trajectory import Trajectory
from physjax.xla_options import jit_untransformed

FAILURE_TEXTS = {
    "Run": "blew up: the run's state is not finite at its end",
    "Solution": "not solved: the search ended without a root",
    "Minimum": "not solved: the search ended without a minimum",
    "Crossing": "no crossing found",
    "BodyCrossing": "no crossing found",
    "Aimed": "out of reach",
    "Shot": "out of reach",
}
"""What it means that a result is not `ok`, by its type; of any other type, only that it is not."""


class Run(NamedTuple):
    """What is kept of a `Trajectory` that a measure returns: frames or what was recorded, and whether it stayed finite."""

    time: Array | None
    state: PyTree
    recorded: PyTree
    ok: Bool[Array | np.ndarray, "..."]


class LaneProgram(NamedTuple):
    """A measure as a program for one lane: `jaxpr` from the leaves of a point to those of its values and a status.

    `values` is the tree of the values, with shapes and dtypes in its leaves; status k means `reasons[k]`, 0 is good.
    `carried_bytes` and `peak_bytes` are the most bytes that its loops carry, and that are alive at once. `digest` is a
    hash of the program with the constants it closes over, `calls` what it calls on the host, which that hash leaves out.
    """

    jaxpr: ClosedJaxpr
    values: PyTree
    reasons: tuple[str, ...]
    digest: str
    calls: tuple[HostCall, ...] = ()

    def __eq__(self, other: object) -> bool:
        # functions that are called back must be the very same: equal ones may close over arrays that change later
        return isinstance(other, LaneProgram) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    @property
    def _key(self) -> tuple[object, ...]:
        return (self.digest, *((kind, id(called)) for kind, called in self.calls))

    @property
    def persistent_digest(self) -> str:
        """A hash by which another process knows the same measure; ValueError where it calls what has none."""
        return persistent_digest(self.digest, self.calls)

    @property
    def carried_bytes(self) -> int:
        """The most bytes that an iteration of a loop carries; without loops all that is alive."""
        return _max_carried_bytes(self.jaxpr.jaxpr) or self.peak_bytes

    @property
    def peak_bytes(self) -> int:
        """The most bytes alive at once, if nothing is fused."""
        return max(1, _max_peak_bytes(self.jaxpr.jaxpr))

    @property
    def transferred_bytes(self) -> int:
        """Bytes that go in and come out."""
        return _count_bytes(self.jaxpr.jaxpr.invars) + _count_bytes(self.jaxpr.jaxpr.outvars)


class Layout(NamedTuple):
    """How lanes are divided: `count` blocks of `size` lanes make a batch, of which `batch` lanes are used."""

    batch: int
    size: int
    count: int


def trace_measure(measure: Callable[..., PyTree], point: Mapping[str, PyTree]) -> LaneProgram:
    """Trace a measure at a point, given as shapes and dtypes by name."""
    traced = []

    def lane(point):
        values = jax.tree.map(jnp.asarray, _strip_runs(measure(**point)))
        reasons = _list_verdicts(values)
        status = jnp.zeros((), jnp.int16)
        for code in range(len(reasons), 0, -1):
            status = jnp.where(reasons[code - 1][1], status, jnp.int16(code))
        traced.append((jax.eval_shape(lambda: values), ("ok", *(reason for reason, _ in reasons))))
        return values, status

    leaves, tree = jax.tree.flatten(point)
    try:
        jaxpr = jax.make_jaxpr(lambda *flat: jax.tree.leaves(lane(jax.tree.unflatten(tree, flat))))(*leaves)
    except TypeError as error:
        raise TypeError(_trace_error_text(measure, point, error)) from error
    values, reasons = traced[-1]
    if not jax.tree.leaves(values):
        raise ValueError(f"measure: {_measure_name(measure)} returned {values!r}, expected at least one number.")
    digest, calls = _hash_program(jaxpr, leaves)
    return LaneProgram(jaxpr, values, reasons, digest, calls)


def choose_layout(
    program: LaneProgram,
    lanes: int,
    memory: int,
    devices: Sequence[jax.Device],  # pyright: ignore[reportInvalidTypeForm]  # no stub
    batch: int | None = None,
    begun: tuple[int, int] | None = None,
) -> Layout:
    """Blocks for a number of lanes, such that program and batch fit into `memory` [bytes].

    `begun` are the lanes in a batch and in a block of a sweep that is being continued, which keeps them.
    """
    needed = program.peak_bytes + program.transferred_bytes
    if needed > memory:
        raise ValueError(
            f"memory: got {memory:,} bytes, expected at least {needed:,}, which one lane of the measure may take. Give more, "
            "or keep fewer frames (save_every, record)."
        )
    if begun is not None and batch in (None, begun[0]):
        batch, size = begun
    else:
        share = math.ceil(min(lanes, batch or lanes) / len(devices))
        best = choose_block_lanes(devices[0], program.carried_bytes)
        fitting = min(best, memory // (2 * len(devices) * program.peak_bytes))
        size = min(share, 1 << max(0, fitting.bit_length() - 1))
        left = memory - len(devices) * size * program.peak_bytes
        most = max(size, min(MAX_BATCH_LANES, left // (2 * program.transferred_bytes)) // size * size)
        # batches of equal length in whole blocks, so that none is nearly empty
        batch = batch or math.ceil(lanes / math.ceil(lanes / most) / size) * size
        size = math.ceil(batch / math.ceil(batch / size))
    return Layout(batch, size, math.ceil(math.ceil(batch / size) / len(devices)) * len(devices))


@functools.lru_cache(maxsize=16)
def compile_batch(
    program: LaneProgram,
    cut: Layout,
    devices: tuple[jax.Device, ...],  # pyright: ignore[reportInvalidTypeForm]  # no stub
) -> Callable[..., Sequence[Array]]:
    """The batch as one executable: leaves `(count, size, ...)` of points to those of values, and status."""
    one = jax.vmap(jaxpr_as_fun(program.jaxpr))

    def batch(*flat):
        # blocks in sequence: a core's cache then holds all that a step of one block touches
        return lax.map(lambda block: one(*block), flat)

    mesh = Mesh(np.asarray(devices), ("lanes",))
    spec = PartitionSpec("lanes")
    first = devices[0]
    if len(devices) > 1:
        batch = jax.shard_map(batch, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    shapes = [
        jax.ShapeDtypeStruct((cut.count, cut.size, *v.aval.shape), v.aval.dtype) for v in program.jaxpr.jaxpr.invars
    ]
    placed = NamedSharding(mesh, spec)
    whole = jit_untransformed(batch, first, in_shardings=placed, out_shardings=placed)
    executable = whole.lower(*shapes).compile()
    return lambda *flat: executable(*jax.device_put(flat, placed))


def _strip_runs(outcome: PyTree) -> PyTree:
    """A measure's outcome with every run reduced to its frames and status: its scene is the same in all lanes."""
    is_run = lambda node: isinstance(node, Trajectory)  # noqa: E731
    shorten = lambda node: Run(node.time, node.state, node.recorded, node.ok) if is_run(node) else node  # noqa: E731
    return jax.tree.map(shorten, outcome, is_leaf=is_run)


def _list_verdicts(values: PyTree) -> list[tuple[str, Array]]:
    """Reasons why a lane may be bad, each with whether it is good: the results' own `ok` first, then finite numbers."""
    judged = [
        (f"{FAILURE_TEXTS.get(type(node).__name__, 'not ok')}{_format_path(path)}", jnp.all(ok))
        for path, node in _list_nodes(values)
        if (ok := _read_ok(node)) is not None
    ]
    return judged + [
        (f"not finite{_format_path(path)}", jnp.all(jnp.isfinite(leaf)))
        for path, leaf in jax.tree_util.tree_leaves_with_path(values)
        if jnp.issubdtype(leaf.dtype, jnp.inexact)
    ]


def _list_nodes(tree: PyTree, path: KeyPath = ()) -> list[tuple[KeyPath, PyTree]]:
    """Every node of a tree that is not a leaf, with its path, the outer ones first."""
    below = jax.tree_util.tree_leaves_with_path(tree, is_leaf=lambda node: node is not tree)
    if len(below) == 1 and below[0][1] is tree:
        return []
    return [(path, tree)] + [found for keys, child in below for found in _list_nodes(child, (*path, *keys))]


def _read_ok(node: PyTree) -> ArrayLike | None:
    """The `ok` of a result of ours or of a user's own record; None where there is none."""
    return node.get("ok") if isinstance(node, dict) else getattr(node, "ok", None)


def _format_path(path: KeyPath) -> str:
    return f" (at {leaf_name(path)})" if path else ""


def _hash_program(
    jaxpr: ClosedJaxpr, leaves: Sequence[ArrayLike | jax.ShapeDtypeStruct]
) -> tuple[str, tuple[HostCall, ...]]:
    """A hash of what is computed, constants included, whatever the code is called and looks like; and its host calls.

    Of a host call the program's text has no more than a number.
    """
    text = jax.jit(jaxpr_as_fun(jaxpr)).lower(*leaves).as_text()
    found = hashlib.sha256(text.encode())
    for constant in jaxpr.consts:
        if jnp.issubdtype(getattr(constant, "dtype", float), jax.dtypes.prng_key):
            constant = jax.random.key_data(constant)
        found.update(np.asarray(constant).tobytes())
    calls = tuple(find_host_calls(jaxpr.jaxpr))
    if not calls and "python" in text and "callback" in text:
        calls = (("unknown", None),)
    return found.hexdigest(), calls


def _measure_name(measure: Callable[..., PyTree]) -> str:
    return getattr(_unwrap_measure(measure), "__qualname__", type(measure).__name__)


def _unwrap_measure(measure: Callable[..., PyTree]) -> Callable[..., PyTree]:
    """The user's own function inside partials and wrappers."""
    while isinstance(measure, functools.partial):
        measure = measure.func
    return inspect.unwrap(measure) if callable(measure) else measure


def _trace_error_text(measure: Callable[..., PyTree], point: Mapping[str, PyTree], error: TypeError) -> str:
    """Which line of the measure cannot be traced, and why."""
    plain = _unwrap_measure(measure)
    code = getattr(plain if hasattr(plain, "__code__") else type(plain).__call__, "__code__", None)
    frames = traceback.extract_tb(error.__traceback__)
    here = [frame for frame in frames if code is not None and frame.filename == code.co_filename]
    reason = str(error).splitlines()[0]
    if not here:
        return f"measure: {_measure_name(measure)} cannot be called with {', '.join(point)}, one number each: {reason}"
    line = here[-1]
    source = linecache.getline(line.filename, line.lineno or 0).strip()
    return (
        f"measure: {_measure_name(measure)} cannot be traced at {line.filename}, line {line.lineno}: `{source}`. {reason} "
        "A sweep is one compiled program for all lanes, in which a swept number has no single value: expected jnp functions, "
        "jnp.where and lax.cond instead of Python's branches and float(), and shapes and counts that no axis changes."
    )


def _count_bytes(variables: Iterable[Var | Literal]) -> int:
    """Bytes of arrays; a random key's dtype has no size of its own, and counts as eight."""
    sized = [v.aval for v in variables if isinstance(v.aval, ShapedArray)]
    return sum(math.prod(aval.shape) * getattr(aval.dtype, "itemsize", 8) for aval in sized)


def _max_carried_bytes(jaxpr: Jaxpr) -> int:
    """The most bytes that an iteration of any loop hands on: what it carries, and what it stacks."""
    most = 0
    for equation in jaxpr.eqns:
        bodies = list_inner_jaxprs(equation)
        loops = bodies if equation.primitive.name in ("scan", "while") else []
        most = max([most, *(_count_bytes(body.outvars) for body in loops), *map(_max_carried_bytes, bodies)])
    return most


def _max_peak_bytes(jaxpr: Jaxpr) -> int:
    """The most bytes alive at once: of every operation its results, what is still to be used, and what it needs inside."""
    last = {v: i for i, equation in enumerate(jaxpr.eqns) for v in equation.invars if not isinstance(v, Literal)}
    kept = {v for v in jaxpr.outvars if not isinstance(v, Literal)}
    alive, most = _count_bytes(jaxpr.invars), 0
    for i, equation in enumerate(jaxpr.eqns):
        alive += _count_bytes(equation.outvars)
        most = max(most, alive + max(map(_max_peak_bytes, list_inner_jaxprs(equation)), default=0))
        used = {v for v in equation.invars if not isinstance(v, Literal)}
        alive -= _count_bytes([v for v in used if last[v] == i and v not in kept])
        alive -= _count_bytes([v for v in equation.outvars if v not in last and v not in kept])
    return max(most, alive)
