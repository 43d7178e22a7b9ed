"""A scene with some of its lanes: every array that has an entry for each lane is cut to those selected."""

from collections.abc import Callable
from functools import partial

from physjax.quantities import select_lanes
from physjax.scene import Scene


def select_lane(scene: Scene, lane: int | tuple[int, ...]) -> Scene:
    """A single lane of a scene of independent ones, or a single scene of many coupled ones, by its index.

    What a plain function closes over cannot be cut. Raises IndexError where there is no such lane.
    """
    index = lane if isinstance(lane, tuple) else (lane,)
    shape = scene.status_shape
    if len(index) != len(shape) or any(not 0 <= i < n for i, n in zip(index, shape, strict=True)):
        what = "scenes" if scene.couples else "lanes"
        raise IndexError(f"lane: got {lane}, expected an index into the {what}, whose shape is {shape}.")
    return cut_lanes(scene, shape, lambda leaf: leaf[index])


def cut_lanes(scene: Scene, shape: tuple[int, ...], cut: Callable) -> Scene:
    """The scene with `cut(array)` for every array that has an entry for each of lanes of this shape."""
    if scene.emitter is not None:
        raise ValueError(
            "lanes: got a scene with an emitter, expected lanes that live from the start: births fill its whole pool."
        )
    select = partial(select_lanes, lanes=shape, dim=scene.state.position.shape[-1], cut=cut)
    parts = [select(part) for part in (*scene.forces, *scene.contacts)]
    count = len(scene.forces)
    pinned = select(scene.pinned)
    return Scene(select(scene.state), select(scene.mass), parts[:count], parts[count:], pinned)
