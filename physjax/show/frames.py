"""The frames of one scene of a run, checked before anything is drawn."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from physjax.parts import Contact
from physjax.physics.springs.assembly import Lattice
from physjax.trajectory import Trajectory

DAY_SECONDS = 86400.0
"""A run longer than a few of these has its time written in days."""
MIN_DURATION_SECONDS = 1e-12
"""A run of a single frame has no duration; its time is then written with all the decimals that a title may have."""


class Frames(NamedTuple):
    """One scene of a run: `time` `(frames,)` [s], `position` `(frames, nodes, dim)` [m], its contacts, and the axis `up`.

    The first `good_frames` can be drawn: in those all nodes are finite, or, where lanes are independent, at least one.
    `caption` is a line below the time in each title.
    """

    time: np.ndarray
    position: np.ndarray
    good_frames: int
    surfaces: tuple[Contact, ...]
    up: int = 1
    caption: str = ""

    @property
    def blew_up(self) -> bool:
        """Whether frames are missing at the end."""
        return self.good_frames < len(self.time)

    @property
    def dim(self) -> int:
        """Number of components."""
        return self.position.shape[-1]

    def title(self, frame: int) -> str:
        """The time of a frame, with three figures of the whole duration, and where the run ended if it blew up."""
        return self.titles([frame])[0]

    def titles(self, frames: Sequence[int]) -> list[str]:
        """The titles of several frames."""
        span = max(np.ptp(self.time), MIN_DURATION_SECONDS)
        unit, size = ("d", DAY_SECONDS) if span > 3 * DAY_SECONDS else ("s", 1.0)
        decimals = int(np.clip(2 - np.floor(np.log10(span / size)), 0, 12))
        end = f"\nblew up after t = {self.time[self.good_frames - 1] / size:.3g} {unit}" if self.blew_up else ""
        caption = f"\n{self.caption}" if self.caption else ""
        return [f"t = {self.time[frame] / size:.{decimals}f} {unit}{caption}{end}" for frame in frames]


def take_frames(
    who: str,
    film: Trajectory,
    *,
    scene: int | Sequence[int] | None = None,
    nodes: int | None = None,
    dims: tuple[int, ...] = (2, 3),
) -> Frames:
    """The frames of one scene; of a batch `(frames, *scenes, nodes, dim)`, the one with the number `scene`.

    `who` is named in errors. Raises TypeError for what is not a run, and ValueError for a run without positions, a
    batch of which none is picked, another number of `nodes`, or a dimension that is not among `dims`.
    """
    time, position = _read_frames(who, film)
    for number in find_batch_index(who, film, scene):
        position = position[:, number]
    if position.ndim != 3:
        raise ValueError(f"{who}: got positions {position.shape}, expected (frames, nodes, dim): several nodes.")
    if nodes not in (None, position.shape[1]):
        raise ValueError(
            f"{who}: got a film of {position.shape[1]} nodes and a sheet of {nodes}, expected the same number. "
            "Give the lattice the film's scene was made from."
        )
    whole = np.asarray(np.isfinite(position).all(axis=(-2, -1)))
    return _build_frames(who, film, time, position, whole, dims)


def take_lanes(who: str, film: Trajectory, dims: tuple[int, ...] = (1, 2, 3)) -> Frames:
    """The frames of a run with all its lanes side by side, `(frames, lanes, dim)`."""
    time, position = _read_frames(who, film)
    position = position.reshape(len(position), -1, position.shape[-1])
    some = np.asarray(np.isfinite(position).all(axis=-1))
    coupled = film.scene is not None and film.scene.couples and np.ndim(film.ok) == 0
    return _build_frames(
        who, film, time, position, np.asarray(some.all(axis=-1) if coupled else some.any(axis=-1)), dims
    )


def find_batch_index(who: str, film: Trajectory, scene: int | Sequence[int] | None) -> tuple[int, ...]:
    """The number of the chosen scene along each axis of a batch; empty for a single scene."""
    scenes = film.position.shape[1:-2]
    index = () if scene is None else tuple(np.atleast_1d(scene).tolist())
    if len(index) != len(scenes):
        raise ValueError(
            f"{who}: got positions {film.position.shape} and scene={scene}, expected the number of one scene of "
            f"{scenes}: {_format_example(scenes)}."
        )
    for number, count in zip(index, scenes, strict=True):
        if not -count <= number < count:
            raise ValueError(f"{who}: got scene={scene}, expected numbers below {scenes}, the batch of this film.")
    return index


def pick_frames(who: str, run: Frames, frames: int | Iterable[int] | None, default: int = 3) -> list[int]:
    """The numbers of the chosen frames, counted from the front; by default `default` of them, evenly over the good ones."""
    if frames is None:
        return sorted(set(np.linspace(0, run.good_frames - 1, default).round().astype(int).tolist()))
    asked = [frames] if isinstance(frames, int | np.integer) else list(frames)
    count = len(run.time)
    if not asked or any(isinstance(f, bool) or not isinstance(f, int | np.integer) for f in asked):
        raise TypeError(
            f"{who}: got frames={frames!r}, expected whole numbers of frames, e.g. frames=(0, {count - 1})."
        )
    for frame in asked:
        if not -count <= frame < count:
            raise IndexError(
                f"{who}: got frame {frame}, expected {-count} to {count - 1}: the film has {count} frames, "
                f"from t = {run.time[0]:g} to {run.time[-1]:g} s."
            )
        if frame % count >= run.good_frames:
            raise ValueError(
                f"{who}: got frame {frame}, t = {run.time[frame]:g} s, where the run has blown up; expected at most "
                f"{run.good_frames - 1}, the last good one. film.first_bad_step says when it happened; try a smaller dt."
            )
    return [int(frame) % count for frame in asked]


def get_faces(who: str, sheet: Lattice) -> tuple[np.ndarray, int]:
    """Triangles `(faces, 3)` of a lattice and its number of nodes; TypeError or ValueError if it has no faces."""
    if not isinstance(sheet, Lattice):
        raise TypeError(
            f"{who}: got {type(sheet).__name__}, expected a lattice with faces: from lattices.cloth, jelly or from_mesh."
        )
    if len(sheet.faces) == 0:
        raise ValueError(
            f"{who}: got a lattice without faces, expected a cloth, a jelly or a mesh. plot.springs and animate.springs "
            "draw ropes and bridges."
        )
    return np.asarray(sheet.faces), sheet.state.position.shape[-2]


def _read_frames(who: str, film: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Times and positions of a run, one time for all lanes."""
    if not isinstance(film, Trajectory):
        raise TypeError(f"{who}: got {type(film).__name__}, expected a film: the Trajectory that simulate returns.")
    if film.state is None:
        raise ValueError(
            f"{who}: got a film that holds .recorded only, expected positions. Simulate without record=, and with "
            "save_every= if it is too large."
        )
    if np.ndim(film.first_step):
        raise ValueError(
            f"{who}: got {np.shape(film.first_step)} films out of vmap, expected one. Pick one of them: "
            "jax.tree.map(lambda leaf: leaf[0], film)."
        )
    time, position = np.asarray(film.time, float), np.asarray(film.position)
    if time.ndim != 1:
        raise ValueError(
            f"{who}: got times {time.shape}, a step for each lane, expected one time for all. Simulate with one dt."
        )
    return time, position


def _build_frames(
    who: str, film: Trajectory, time: np.ndarray, position: np.ndarray, whole: np.ndarray, dims: tuple[int, ...]
) -> Frames:
    """The record of checked frames; `whole` says which of them can be drawn."""
    dim = position.shape[-1]
    if dim not in dims:
        known = " or ".join(map(str, dims))
        raise ValueError(
            f"{who}: got positions with {dim} component{'s' * (dim > 1)}, expected {known}. "
            f"{'plot.springs, animate.springs and animate.bodies draw' if dims == (3,) else 'plot.paths draws'} others."
        )
    if not whole[0]:
        raise ValueError(f"{who}: got a film whose first frame is not finite, expected a start that can be drawn.")
    good_frames = len(whole) if whole.all() else int(np.argmin(whole))
    return Frames(time, position, good_frames, () if film.scene is None else film.scene.contacts, find_up_axis(film))


def find_up_axis(film: Trajectory) -> int:
    """The axis that is up in the scene of a run; y (or x on a line) in a run without its scene."""
    return min(1, film.position.shape[-1] - 1) if film.scene is None else film.scene.up


def _format_example(scenes: tuple[int, ...]) -> str:
    if not scenes:
        return "there is only one, so leave scene= out"
    return f"scene={0 if len(scenes) == 1 else (0,) * len(scenes)}"
