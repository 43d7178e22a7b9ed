"""Parameter sweeps: a measure at every point of a design, fast, resumable, and with a status for each failure.

```python
def landing(speed, angle):
    launch = speed * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    ball = Scene(Particles(jnp.zeros(2), launch), 0.145, (forces.Gravity(), forces.QuadraticDrag(4.3e-3, 0.35)))
    flight = simulate(ball, methods.rk4, dt=0.01, duration=10.0, save_every=50)
    return flight.crossing(0.0, direction=-1).position[0]

ranges = sweep(landing, dict(speed=jnp.linspace(10, 50, 1000), angle=jnp.linspace(0.1, 1.4, 1000)), out="ranges")
ranges.plot(labels=dict(speed="speed [m/s]", angle="angle [rad]", value="range [m]"))
```

Across machines every process starts `jax.distributed` and then calls the same `sweep`; each works on its share of the
chunks, on all of its devices. Under Slurm, with a folder that all machines see:

```sh
#!/bin/bash
#SBATCH --nodes=8 --ntasks-per-node=1 --exclusive --time=01:00:00
#SBATCH --requeue            # a sweep that is stopped continues where it was
srun python ranges.py        # jax.distributed.initialize(); sweep(landing, axes, out="/scratch/ranges")
```

Without a coordinator, as an array of jobs that know nothing of each other, `--array=0-7` and in the script
`sweep(..., out="/scratch/ranges", shard=(int(os.environ["SLURM_ARRAY_TASK_ID"]), 8))`; afterwards `sweep.load`.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext

import jax
import numpy as np
from jaxtyping import PyTree

from physjax.checks import as_positive_integer
from physjax.compiling import announce_compiling
from physjax.study.sweeps import store as chunks
from physjax.study.sweeps.batching import LaneProgram, Layout, choose_layout, compile_batch, trace_measure
from physjax.study.sweeps.design import Lanes, build_lanes, latin_hypercube, sobol
from physjax.study.sweeps.result import Sweep, load, value_names
from physjax.study.sweeps.store import Manifest, MemoryStore, Store
from physjax.text import progress_bar
from physjax.tracebacks import shorten_tracebacks

BATCH_MEMORY_BYTES = 1 << 30
"""Bytes that batches may take by default; the results themselves come on top where they are kept in memory."""


@shorten_tracebacks
@announce_compiling("the sweep")
def sweep(
    measure: Callable[..., PyTree],
    axes: Mapping[str, PyTree],
    *,
    design: str = "grid",
    batch: int | None = None,
    memory: int = BATCH_MEMORY_BYTES,
    out: str | os.PathLike | None = None,
    progress: bool = True,
    devices: Sequence[jax.Device] | None = None,  # pyright: ignore[reportInvalidTypeForm]  # no stub
    shard: tuple[int, int] | None = None,
) -> Sweep:
    """`measure(**point)` at every point of the axes: named arrays, crossed ("grid") or zipped ("zip").

    The measure takes one number for each axis and returns a pytree of arrays. An axis may also be a record of arrays (a
    NamedTuple, of which the measure gets one of numbers) or a list of records of the same shape, such as scenes. Sampled
    points come from `sweep.latin_hypercube` and `sweep.sobol`, to be zipped. A lane is bad where a result's own `ok`
    says so (a `Trajectory`, `solve`, a `crossing`, a dict with "ok") or where a number is not finite; it changes no bit of
    another lane (only contacts round a step differently while any lane of a block lies at rest on them).

    Lanes are computed `batch` at a time, by default as many as fit `memory` [bytes], in one compiled program on all local
    `devices`. With `out`, each batch is a file in that folder as soon as it is done, and the same call continues where a
    killed one stopped. `shard=(i, n)` does every n-th of them from the i-th, for processes that share a folder; with
    `jax.distributed` that is the default, and the processes' results are gathered, in the folder or in memory.

    A folder identifies a measure by its program and constants, and a `jax.pure_callback` in it by the code of its function
    with all that this closes over and reads; with `out`, a measure that calls what cannot be followed so is refused.

    A dt at a fixed duration is swept through `state_after`; what changes shapes or counts cannot be swept, and is refused.

    Raises TypeError for a measure that cannot be traced, with its line; ValueError or TypeError for axes that are empty
    or unequal, for too little memory, and for a folder that another process is using, that holds another sweep or could
    not tell this one from another, or whose chunks are damaged; OSError where it cannot be written.

    On paper: 10⁸ lanes of 400 rk4 steps of a ball with drag, in the plane and in float32, are 763 chunks of 131 072 lanes
    and 1.3 MB, 1 GB in all, and take 53 s of one core at the measured 1.9 million lanes a core second, files included
    (`benchmarks/sweep.py`); 8 such cores 7 s.

    Example:
        >>> axes = {"speed": [7.0, 14.0], "angle": np.deg2rad([15.0, 45.0])}
        >>> found = sweep(lambda speed, angle: projectile.horizontal_range(speed, angle), axes, progress=False)
        >>> print(found.values)
        [[ 2.5  5. ]
         [10.  20. ]]
    """
    lanes = build_lanes(axes, design)
    devices = _check_devices(devices)
    i, n = _check_shard(shard)
    if not callable(measure):
        raise TypeError(f"measure: got {measure!r}, expected a function of {', '.join(axes)}.")
    batch = None if batch is None else min(as_positive_integer("batch", batch), lanes.count)
    if out is not None:
        chunks.ensure_writable_folder(out)
    begun = None if out is None else chunks.read_layout(out)
    program = trace_measure(measure, _build_abstract_point(lanes))
    cut = choose_layout(program, lanes.count, as_positive_integer("memory [bytes]", memory), devices, batch, begun)
    manifest = _build_manifest(lanes, program, cut, program.digest if out is None else program.persistent_digest)
    rebuild = jax.tree.structure(program.values).unflatten
    with nullcontext() if out is None else chunks.open_folder(out, manifest, (i, n), lanes.arrays) as folder:
        store = MemoryStore(manifest) if folder is None else folder
        _compute_chunks(store, lanes, program, cut, devices, (i, n), progress)
    if jax.process_count() > 1 and shard is None:
        store.share(n)
    return Sweep(lanes, program.reasons, store.gather, rebuild)


def _compute_chunks(
    store: Store,
    lanes: Lanes,
    program: LaneProgram,
    cut: Layout,
    devices: tuple[jax.Device, ...],  # pyright: ignore[reportInvalidTypeForm]  # no stub
    shard: tuple[int, int],
    progress: bool,
) -> None:
    """Compute those of a shard's chunks that are missing, one after the other."""
    mine = range(shard[0], store.chunks, shard[1])
    done = {chunk for chunk, path in store.find_finished().items() if chunk in mine and store.read(path)}
    left = [chunk for chunk in mine if chunk not in done]
    count = lambda some: sum(stop - start for start, stop in map(store.range, some))  # noqa: E731
    with progress_bar(progress=progress, total=count(mine), initial=count(done), unit="lane", unit_scale=True) as shown:
        for chunk in left:
            start, stop = store.range(chunk)
            # the last batch is padded with its last lane: one shape is one compiled program
            inside = np.minimum(np.arange(start, start + cut.count * cut.size), stop - 1)
            # compiled once and cached; not at all where every chunk is there
            compute = compile_batch(program, cut, devices)
            points = [
                leaf.reshape(cut.count, cut.size, *leaf.shape[1:]) for leaf in jax.tree.leaves(lanes.points(inside))
            ]
            found = [np.asarray(leaf).reshape(-1, *leaf.shape[2:])[: stop - start] for leaf in compute(*points)]
            store.write(chunk, dict(zip(store.manifest["outputs"], found, strict=True)))
            shown.update(stop - start)


def _build_manifest(lanes: Lanes, program: LaneProgram, cut: Layout, digest: str) -> Manifest:
    """What the sweep is, down to everything that determines its bits."""
    outputs = jax.tree.leaves(program.values)
    names = value_names(program.values)
    return {
        "versions": chunks.collect_versions(),
        "backend": chunks.describe_backend(),
        "design": lanes.design,
        "axes": {axis.name: axis.digest for axis in lanes.axes},
        "shape": list(lanes.shape),
        "measure": digest,
        "outputs": {
            **{name: [list(leaf.shape), str(leaf.dtype)] for name, leaf in zip(names, outputs, strict=True)},
            "status": [[], "int16"],
        },
        "reasons": list(program.reasons),
        "batch": cut.batch,
        "block": cut.size,
    }


def _build_abstract_point(lanes: Lanes) -> dict[str, PyTree]:
    """A point of the design as shapes and dtypes."""
    one = lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype)  # noqa: E731
    return {axis.name: jax.tree.map(one, axis.values) for axis in lanes.axes}


def _check_devices(
    devices: Sequence[jax.Device] | None,  # pyright: ignore[reportInvalidTypeForm]  # no stub
) -> tuple[jax.Device, ...]:  # pyright: ignore[reportInvalidTypeForm]  # no stub
    devices = tuple(jax.local_devices() if devices is None else devices)
    if not devices or not all(device in jax.local_devices() for device in devices):
        raise ValueError(f"devices: got {devices}, expected some of jax.local_devices(): {jax.local_devices()}.")
    return devices


def _check_shard(shard: tuple[int, int] | None) -> tuple[int, int]:
    i, n = (jax.process_index(), jax.process_count()) if shard is None else shard
    if not 0 <= as_positive_integer("shard: i", i, at_least=0) < as_positive_integer("shard: n", n):
        raise ValueError(f"shard: got {(i, n)}, expected (i, n) with i in 0 .. n - 1.")
    return i, n


sweep.load, sweep.latin_hypercube, sweep.sobol = load, latin_hypercube, sobol
