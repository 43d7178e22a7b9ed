"""A scene with other lanes: every array that has an entry for each is cut to those that stay."""

from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from functools import partial
from typing import Any

import jax
import numpy as np

from physjax.lanes import is_per_lane
from physjax.physics.springs import Springs
from physjax.scene import Scene
from physjax.study.flattening import vectors_of


def one_lane(scene: Scene, lane: int | tuple[int, ...]) -> Scene:
    """A single lane of a scene of independent ones, or a single scene of many coupled ones, by its index.

    What a plain function holds nobody can see, so it stays as it is. Raises IndexError where there is no such lane.
    """
    index = lane if isinstance(lane, tuple) else (lane,)
    shape = scene.status_shape
    if len(index) != len(shape) or any(not 0 <= i < n for i, n in zip(index, shape, strict=True)):
        what = "scenes" if scene.couples else "lanes"
        raise IndexError(f"lane: got {lane}, expected an index into the {what}, whose shape is {shape}.")
    return with_lanes(scene, shape, lambda leaf: leaf[index])


def with_lanes(scene: Scene, shape: tuple[int, ...], cut: Callable) -> Scene:
    """The scene with `cut(array)` for every array that has an entry for each of lanes of this shape."""
    if scene.emitter is not None:
        raise ValueError(
            "lanes: got a scene with an emitter, expected lanes that live from the start: births fill its whole pool."
        )
    parts = [_part(part, shape, cut) for part in (*scene.forces, *scene.contacts)]
    count = len(scene.forces)
    numbers = partial(_cut, cut, shape, False)
    state = jax.tree.map(partial(_cut, cut, shape, True), scene.state)
    pinned = jax.tree.map(numbers, scene.pinned)
    return Scene(state, jax.tree.map(numbers, scene.mass), parts[:count], parts[count:], pinned)


def _part(part: Any, shape: tuple[int, ...], cut: Callable) -> Any:
    """A force or contact for other lanes; a contact forgets, since its memory belongs to a scene."""
    if isinstance(part, Springs) or not is_dataclass(part):
        return jax.tree.map(partial(_cut, cut, shape, False), part)
    vectors = vectors_of(part)
    changes = {
        f.name: jax.tree.map(partial(_cut, cut, shape, f.name in vectors), getattr(part, f.name))
        for f in fields(part)
        if f.init
    }
    if "touching_since" in changes:
        changes["touching_since"] = None
    return replace(part, **changes)


def _cut(cut: Callable, shape: tuple[int, ...], vector: bool, leaf: Any) -> Any:
    """One vector for all has no entry for each lane, though it may have as many components as there are lanes."""
    return cut(leaf) if is_per_lane(leaf, shape) and np.ndim(leaf) >= len(shape) + vector else leaf
