"""A run as the film that a live view shows: the box holds still while a slider is dragged, surfaces are described once."""

from collections import OrderedDict
from typing import Any

import jax
import numpy as np

from physjax.live.runs import Run
from physjax.parts import Contact
from physjax.show.drawables import Dots, Look
from physjax.show.frames import Frames, take_lanes
from physjax.show.page_content import Pace, Seen, describe_contact, describe_run, take_seen
from physjax.show.page_data import Json
from physjax.show.panels import Scenery, build_scenery
from physjax.show.stage import Stage

SNAPS = 12
"""The sides of the box are whole numbers of about this part of the longest, so that axes do not tremble with every number."""
REAL_TIME = (1.5, 12.0)
"""Runs of a length between these [s] are shown in real time, shorter and longer ones in the nearer of the two."""
LINE_ASPECT = 1.6
"""Particles on a line stand side by side over this times the height of what they do."""
LIVE_CONTOUR_POINTS = 121
"""Points along each side of the grid on which the edges of surfaces in the plane are found: a ninth of the work of a still."""
KEPT_SURFACES = 64
"""Described surfaces that are kept: those of the last boxes and settings."""

Box = tuple[list[float], list[float]]
"""The lower and the upper corner [m]."""


class Pictures:
    """Makes films of runs; keeps the surfaces that it has described."""

    def __init__(self) -> None:
        self._surfaces: OrderedDict[tuple, Json] = OrderedDict()

    def draw(self, run: Run, look: Look | None = None, ghost_box: Box | None = None) -> Json:
        """The film of a run, in a box that also holds that of the ghost; its arrays are still arrays."""
        who = "explore"
        flat_line = run.flight.position.shape[-1] == 1
        if flat_line:
            lanes = _stand_side_by_side(take_lanes(who, run.flight, (1,)))
            seen = Seen(lanes, {}, Dots(lanes))
        else:
            seen = take_seen(who, run.flight, look, None, None)
        frames = list(range(seen.run.good_frames))
        scenery = build_scenery(seen.run, frames)
        stage = scenery.stage
        if ghost_box is not None and len(ghost_box[0]) == len(stage.low):
            stage = stage.include(*(np.asarray(end, float) for end in ghost_box))
        scenery = scenery._replace(stage=snap(stage))
        film = describe_run(
            who, seen, _choose_pace(np.asarray(run.flight.time), frames), scenery, None, self._describe_surface
        )
        return film | ({"names": ["", "x [m]"]} if flat_line else {})

    def _describe_surface(self, contact: Contact, scenery: Scenery, frames: list[int]) -> Json:
        times = scenery.run.time[frames]
        leaves, structure = jax.tree.flatten(contact)
        numbers = tuple(np.asarray(leaf).tobytes() for leaf in leaves)
        box = scenery.stage.low.tobytes(), scenery.stage.high.tobytes()
        key = (structure, numbers, box, times.tobytes())
        if key not in self._surfaces:
            self._surfaces[key] = describe_contact(contact, scenery, frames, LIVE_CONTOUR_POINTS)
            if len(self._surfaces) > KEPT_SURFACES:
                self._surfaces.popitem(last=False)
        return self._surfaces[key]


def snap(stage: Stage) -> Stage:
    """The box with corners at round places outside of it: a little change of what is in it leaves it as it is."""
    unit = 10 ** np.floor(np.log10(stage.size / SNAPS))
    unit = unit * min(share for share in (1, 2, 5, 10) if share * unit * SNAPS >= stage.size)
    return Stage(np.floor(stage.low / unit) * unit, np.ceil(stage.high / unit) * unit)


def _stand_side_by_side(run: Frames) -> Frames:
    """Particles on a line as particles in the plane, each in a column of its own."""
    position = run.position.astype(float)
    good = position[: run.good_frames]  # what blows up may be infinite at last
    height = float(np.nanmax(good) - np.nanmin(good)) or 1.0
    lanes = position.shape[1]
    columns = (np.arange(lanes) - (lanes - 1) / 2) * LINE_ASPECT * height / max(lanes, 2)
    across = np.where(np.isfinite(position), columns[:, None], np.nan)
    return run._replace(position=np.concatenate([across, position], axis=-1), surfaces=(), up=1)


def _choose_pace(times: np.ndarray, frames: list[int]) -> Pace:
    """All frames, in real time where that is neither very short nor very long."""
    span = float(times[-1] - times[0])
    seconds = float(np.clip(span, *REAL_TIME))
    return Pace(frames, (len(times) - 1) / seconds, float(f"{span / seconds:.2g}"))


def list_arrays(content: Any) -> tuple[Any, list[np.ndarray]]:
    """The content with `{"array": number, "kind": type}` in place of each array, and the arrays."""
    arrays: list[np.ndarray] = []

    def take(node: Any) -> Any:
        if isinstance(node, np.ndarray):
            arrays.append(np.ascontiguousarray(node))
            return {"array": len(arrays) - 1, "kind": node.dtype.name}
        if isinstance(node, dict):
            return {name: take(part) for name, part in node.items()}
        return [take(part) for part in node] if isinstance(node, list) else node

    return take(content), arrays


__all__ = ["Box", "Pictures", "list_arrays", "snap"]
