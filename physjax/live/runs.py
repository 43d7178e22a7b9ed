"""Runs for a live view: any dt and any duration by one compiled program, given up as soon as nobody asks for them."""

import math
import time
from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from physjax.live.sources import Built, Source
from physjax.parts import as_module
from physjax.scene import Scene
from physjax.stepping.frame_blocks import advance_block, begin_run
from physjax.stepping.frames import Moving
from physjax.stepping.simulate import start_memory
from physjax.study.energy.quantities import kinetic, total
from physjax.trajectory import Trajectory, select_stateful_parts

BLOCK_SECONDS, FIRST_BLOCKS = 0.04, 12
"""A run can be given up after each of its blocks, which take about this long [s]; so many where that is not known yet."""
MAX_STEPS = 2_000_000
"""Steps of the longest run: more take minutes for anything."""


class Overtaken(Exception):
    """A newer setting is asked for: this run is not needed any more."""


class Run(NamedTuple):
    """A run with `steps` of dt [s]: its frames as a trajectory, the arrays that changed in it, and its time [s] per step."""

    flight: Trajectory
    leaves: list[np.ndarray]
    steps: int
    dt: float
    step_seconds: float

    @property
    def failed(self) -> np.ndarray:
        """Which lanes (of coupled ones, whether the scene) did not stay finite."""
        return ~np.asarray(self.flight.ok)


def count_steps(duration: float, dt: float) -> int:
    """Whole steps that fill a duration, nearest to dt each."""
    return int(min(max(1, round(duration / dt)), MAX_STEPS))


def run_steps(
    built: Built,
    source: Source,
    method: Callable,
    steps: int,
    frames: int,
    overtaken: Callable[[], bool] = lambda: False,
    *,
    refined: int = 1,
    step_seconds: float | None = None,
) -> Run:
    """Take a number of steps, and keep the state at `frames` moments after the start; raises Overtaken between two blocks.

    A moment is the end of a step: with fewer steps than frames some are seen more than once. A run that is `refined` takes
    so many times the steps, and is seen at the same moments. `step_seconds` is what a step is known to take.
    """
    ends = refined * (np.arange(frames + 1, dtype=np.int64) * steps // frames).astype(np.int32)
    steps = refined * steps
    dt = jnp.asarray(built.duration / steps, jnp.float64)
    module = as_module(method)
    blocks = FIRST_BLOCKS if step_seconds is None else math.ceil(steps * step_seconds / BLOCK_SECONDS)
    cuts = np.linspace(0, frames, min(blocks, frames) + 1).round().astype(int)
    started = time.perf_counter()
    carried = _begin(source, module, dt)
    kept = []
    for first, last in pairwise(cuts):
        if overtaken():
            raise Overtaken
        # one program for a block of any length: no steps are taken before it and behind it
        carried, block = _advance(source, module, dt, carried, np.clip(ends, ends[first], ends[last]))
        kept.append([np.asarray(leaf)[first:last] for leaf in block])
    seconds = time.perf_counter() - started
    changing = built.scene.changing()
    start, still = eqx.partition(built.scene, changing)
    starts, structure = jax.tree.flatten(start)
    leaves = [np.concatenate([np.asarray(a)[None], *parts]) for a, *parts in zip(starts, *kept, strict=True)]
    film = eqx.combine(structure.unflatten(leaves), still)
    last = eqx.combine(structure.unflatten([leaf[-1] for leaf in leaves]), still)
    flight = Trajectory(
        time=ends * float(dt),
        state=film.state,
        parts=select_stateful_parts(film),
        recorded=None,
        ok=_find_finite(built.scene, last.state),
        scene=built.scene,
        final_scene=last,
        stepper=module,
        dt=np.asarray(dt),
        first_step=np.zeros((), np.int32),
        save_every=1,
        steps=steps,
    )
    return Run(flight, leaves, steps, float(dt), seconds / steps)


def measure_energies(source: Source, run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Total and kinetic energy [J] over time, per lane or per coupled scene."""
    found, motion = _measure_energies(source, np.asarray(run.flight.time), run.leaves)
    return np.asarray(found), np.asarray(motion)


def _find_finite(scene: Scene, state: PyTree) -> np.ndarray:
    """`scene.finite` in NumPy, which does not ask the device."""
    lanes = len(state.lanes)
    good = np.ones((), bool)
    for leaf in map(np.asarray, jax.tree.leaves(state)):
        finite = np.isfinite(leaf)
        good = good & (finite.all(axis=tuple(range(lanes, leaf.ndim))) if leaf.ndim > lanes else finite)
    return np.asarray(good.all(axis=-1) if scene.couples and good.ndim else good)


@eqx.filter_jit
def _begin(source: Source, method: Callable, dt: Array) -> tuple[list[Array], list[Array]]:
    moving = begin_run(source.make(), method, dt)
    return jax.tree.leaves(moving.arrays), jax.tree.leaves(moving.memory)


@eqx.filter_jit
def _advance(
    source: Source, method: Callable, dt: Array, carried: tuple[list[Array], list[Array]], ends: np.ndarray | Array
) -> tuple[tuple[list[Array], list[Array]], list[Array]]:
    """A block of frames. Leaves travel, not trees: a scene that is built in the program has functions of its own each time."""
    scene = source.make()
    memory = jax.eval_shape(lambda: start_memory(scene, method, jnp.zeros((), jnp.int32), dt))
    moving = Moving(_fill(scene, carried[0]), jax.tree.unflatten(jax.tree.structure(memory), carried[1]))
    moving, kept = advance_block(scene, method, dt, moving, jnp.asarray(ends))
    return (jax.tree.leaves(moving.arrays), jax.tree.leaves(moving.memory)), jax.tree.leaves(kept)


@eqx.filter_jit
def _measure_energies(
    source: Source, times: np.ndarray | Array, leaves: list[np.ndarray] | list[Array]
) -> tuple[Array, Array]:
    """Total and kinetic energy [J] at each moment, per lane or per coupled scene."""
    scene = source.make()
    still = eqx.filter(scene, scene.changing(), inverse=True)

    def measure(t: Array, leaves: list[Array]) -> tuple[Array, Array]:
        now = eqx.combine(_fill(scene, leaves), still)
        return total(now, t, now.state), kinetic(now, t, now.state)

    return jax.vmap(measure)(jnp.asarray(times), [jnp.asarray(leaf) for leaf in leaves])


def _fill(scene: Scene, leaves: list[Array]) -> PyTree:
    """What steps change of a scene, with other arrays in it."""
    return jax.tree.unflatten(jax.tree.structure(eqx.filter(scene, scene.changing())), leaves)


__all__ = ["Overtaken", "Run", "count_steps", "measure_energies", "run_steps"]
