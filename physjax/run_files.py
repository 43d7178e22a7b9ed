"""Runs from files: what `Trajectory.load` makes of the arrays that `Trajectory.save` wrote."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from physjax.checks import concrete_or_none
from physjax.memories import replace_memories, select_stateful_parts
from physjax.memory_masks import build_memory_mask
from physjax.particles import Particles, callable_name
from physjax.parts import Contact, as_module
from physjax.scene import Scene


def restore_run(cls: type, saved: dict[str, np.ndarray], scene: Scene | None, method: Callable | None) -> Any:
    """A trajectory from the arrays of a file: NumPy for a reference, which has no step, as it was before."""
    arrays: dict[str, Array | np.ndarray] = dict(saved)
    ours, made_by = "dt" in arrays, str(arrays.pop("method"))
    if ours and method is not None and made_by not in (callable_name(method), "NoneType"):
        raise ValueError(
            f"load: the run was made with the method {made_by}, got {callable_name(method)}. Give the method it was made "
            "with; to go on with another one, simulate(run.final_scene, ...)."
        )
    if scene is not None and ours:
        scene = _cast_to_run(scene, saved)
    # a run of float64 without 64-bit types stays in NumPy, where nothing is rounded
    exact = lambda array: ours and jax.dtypes.canonicalize_dtype(array.dtype) == array.dtype  # noqa: E731
    floats = [array for array in arrays.values() if array.dtype.kind == "f"]
    if all(map(exact, floats)):
        arrays = {name: jnp.asarray(array) if ours else array for name, array in arrays.items()}
    recorded = {name.removeprefix("recorded"): array for name, array in arrays.items() if name.startswith("recorded")}
    final_scene, parts = (None, ()) if scene is None or not ours else _restore_end(scene, arrays, not recorded)
    state = None
    if not recorded:
        state = _fill_tree("state", Particles(jnp.zeros(0), jnp.zeros(0)) if scene is None else scene.state, arrays)
    return cls(
        time=arrays["time"],
        state=state,
        parts=parts,
        recorded=recorded.get("", recorded) if recorded else None,
        ok=arrays["ok"],
        scene=scene,
        final_scene=final_scene,
        stepper=None if method is None else as_module(method),
        dt=arrays.get("dt"),
        first_step=arrays["first_step"],
        save_every=int(arrays["save_every"]),
        steps=int(arrays["steps"]),
    )


def _restore_end(scene: Scene, arrays: dict[str, Array | np.ndarray], filmed: bool) -> tuple[Scene, tuple]:
    """The scene at the end of the run, and the parts with memory over its frames, where these were `filmed`."""
    final_state = _fill_tree("final_state", scene.state, arrays)
    if final_state.position.shape != scene.state.position.shape:
        raise ValueError(
            f"load: the run has the shape {final_state.position.shape}, the given scene {scene.state.position.shape}. "
            "Give the scene the run was made with."
        )
    stateful = select_stateful_parts(scene)
    final_parts = _fill_tree("final_parts", stateful, arrays, shaped=True)
    _demand_same_contacts(stateful, final_parts)
    parts = ()
    if filmed:
        parts = _fill_tree("parts", stateful, arrays, shaped=True)
        _demand_same_contacts(stateful, parts)
    return replace_memories(scene, final_state, final_parts), parts


def _cast_to_run(scene: Scene, arrays: dict[str, np.ndarray]) -> Scene:
    """The scene with its numbers in the run's precision, as they were when it was made; ValueError where they are coarser."""
    run, here = arrays.get("final_state.position", arrays["time"]).dtype, scene.state.dtype
    if run == here:
        return scene
    if jnp.finfo(run).bits > jnp.finfo(here).bits:
        raise ValueError(
            f"load: the run is in {run}, the given scene in {here}, too coarse to go on from there. Build the scene in "
            f'{run}: jax.config.update("jax_enable_x64", True) first.'
        )
    return jax.tree.map(lambda leaf: leaf.astype(run) if eqx.is_inexact_array(leaf) else leaf, scene)


def _demand_same_contacts(given: tuple, found: tuple) -> None:
    """Raise a ValueError naming a number of a contact, which never changes, that is another one in the file."""
    still = [
        jax.tree.map(lambda changing: not changing, build_memory_mask(part))
        for part in given
        if isinstance(part, Contact)
    ]
    pick = lambda parts: [part for part in parts if isinstance(part, Contact)]  # noqa: E731
    here, there = eqx.filter(pick(given), still), eqx.filter(pick(found), still)
    for (keys, ours), theirs in zip(jax.tree_util.tree_leaves_with_path(here), jax.tree.leaves(there), strict=True):
        if concrete_or_none(ours) is not None and not np.array_equal(ours, theirs):
            name = jax.tree_util.keystr(keys, simple=True, separator=".").partition(".")[2]
            raise ValueError(
                f"load: the run was made with a contact whose {name} was {np.asarray(theirs)}, in the given scene it is "
                f"{np.asarray(ours)}. Give the scene the run was made with; to go on with another one, begin from its last frame."
            )


def _fill_tree(group: str, like: PyTree, arrays: dict[str, Array | np.ndarray], shaped: bool = False) -> PyTree:
    """The pytree `like` with its leaves replaced by that group of arrays, `shaped` as they are, of parts also with frames."""
    leaves, tree = jax.tree_util.tree_flatten_with_path(like)
    names = [group + jax.tree_util.keystr(keys) for keys, _ in leaves]
    # what rounding leaves out of a moment was nothing in files from before it was kept
    rests = [name for name in names if name.endswith("_rest") and name.removesuffix("_rest") in arrays]
    arrays = {name: np.zeros_like(arrays[name.removesuffix("_rest")]) for name in rests} | arrays
    missing = [name for name in names if name not in arrays]
    if missing:
        raise ValueError(
            f"load: the file lacks {missing[0]!r}, which the scene has. Give the scene the run was made with."
        )
    over_time = lambda shape: (*arrays["time"].shape[: axis + 1], *shape[axis:])  # noqa: E731
    axis = arrays["first_step"].ndim
    for name, (_, leaf) in zip(names, leaves, strict=True):
        shapes = (jnp.shape(leaf), over_time(jnp.shape(leaf)) if group == "parts" else jnp.shape(leaf))
        if shaped and (arrays[name].shape not in shapes or arrays[name].dtype != jnp.result_type(leaf)):
            raise ValueError(
                f"load: {name}: the file has {arrays[name].dtype} of shape {arrays[name].shape}, the given scene "
                f"{jnp.result_type(leaf)} of shape {jnp.shape(leaf)}. Give the scene the run was made with."
            )
    return jax.tree.unflatten(tree, [arrays[name] for name in names])
