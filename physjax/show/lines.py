"""What is drawn as lines: the springs, rods and ropes of a scene, the nodes that they join, and which are intact when."""

from collections.abc import Sequence
from typing import NamedTuple, cast

import numpy as np

from physjax.physics.springs.assembly import Lattice
from physjax.physics.springs.rods import Distances
from physjax.physics.springs.springs import Springs
from physjax.show.frames import Frames, find_batch_index, take_frames
from physjax.trajectory import Trajectory


class Lines(NamedTuple):
    """Nodes and the lines between them, `pairs` `(lines, 2)`: a rope, a bridge, a lattice without its faces, a pendulum.

    `rest` `(lines,)` are the lengths [m] of springs at rest; None for rods, which have no strain. `held` `(frames, lines)` says
    which are intact at each frame; None: all of them.
    """

    run: Frames
    pairs: np.ndarray
    rest: np.ndarray | None
    held: np.ndarray | None


def take_lines(
    who: str,
    film: Trajectory,
    shown: object,
    scene: int | Sequence[int] | None = None,
    dims: tuple[int, ...] = (2, 3),
) -> Lines:
    """The lines of a lattice, of springs, rods or ropes, or of several of them, in one scene of a run; else a TypeError."""
    if are_lines(shown):
        parts = cast("tuple", shown)
        return _join_lines([take_lines(who, film, part, scene, dims) for part in parts], parts)
    if isinstance(shown, Distances):
        return _take_rods(who, film, shown, scene, dims)
    springs = shown.springs if isinstance(shown, Lattice) else shown
    if not isinstance(springs, Springs):
        raise TypeError(
            f"{who}: got {type(shown).__name__}, expected springs.Springs, springs.Rods or a lattice that has springs, such "
            "as lattices.bridge(...)."
        )
    run = take_frames(who, film, scene=scene, nodes=springs.nodes, dims=dims)
    index = find_batch_index(who, film, scene)
    rest = np.broadcast_to(_select_scene(np.asarray(springs.rest_length, float), index), len(springs.pairs))
    return Lines(run, springs.pairs, rest, _find_unbroken(who, film, springs, index))


def are_lines(shown: object) -> bool:
    """Whether something is several parts of a scene that are drawn as lines."""
    if not isinstance(shown, tuple) or isinstance(shown, Lattice):
        return False
    return len(shown) > 0 and all(isinstance(part, Springs | Distances) for part in shown)


def _join_lines(several: list[Lines], parts: tuple) -> Lines:
    """The lines of several parts as one; rods among springs are as long as at rest, without a strain."""
    nodes = min(lines.run.position.shape[1] - _count_anchors(part) for lines, part in zip(several, parts, strict=True))
    places, pairs, begun = [several[0].run.position[:, :nodes]], [], nodes
    for lines, part in zip(several, parts, strict=True):
        pairs.append(np.where(lines.pairs >= nodes, lines.pairs - nodes + begun, lines.pairs))
        if _count_anchors(part):
            places.append(lines.run.position[:, nodes:])
            begun += _count_anchors(part)
    run = several[0].run._replace(position=np.concatenate(places, axis=1))
    rest, held = None, None
    if any(lines.rest is not None for lines in several):
        rest = np.concatenate([_find_rest(*both) for both in zip(several, parts, strict=True)])
    if any(lines.held is not None for lines in several):
        whole = [
            np.ones((len(run.time), len(lines.pairs)), bool) if lines.held is None else lines.held for lines in several
        ]
        held = np.concatenate(whole, axis=1)
    return Lines(run, np.concatenate(pairs), rest, held)


def _count_anchors(part: object) -> int:
    """How many places in the world a part has, which are nodes behind the others."""
    return len(part.anchors) if isinstance(part, Distances) and part.anchors is not None else 0


def _find_rest(lines: Lines, part: object) -> np.ndarray:
    """The lengths of lines without a strain."""
    if lines.rest is not None or not isinstance(part, Distances):
        return np.asarray(lines.rest)
    length = np.asarray(part.length)
    return np.broadcast_to(length.reshape(-1, *length.shape[-1:])[0] if length.ndim else length, len(lines.pairs))


def _take_rods(
    who: str, film: Trajectory, rods: Distances, scene: int | Sequence[int] | None, dims: tuple[int, ...]
) -> Lines:
    """Rods between particles, and to anchors, which are nodes that rest behind the others."""
    run = take_frames(who, film, scene=scene, dims=dims)
    pairs, nodes = np.asarray(rods.pairs), run.position.shape[1]
    if pairs.max() >= nodes:
        raise ValueError(f"{who}: got rods {rods.pairs} and {nodes} nodes, expected rods between them.")
    if rods.anchors is not None:
        anchors = np.broadcast_to(rods.anchors, (len(run.time), *rods.anchors.shape))
        run = run._replace(position=np.concatenate([run.position, anchors], axis=1))
    held = _find_unbroken(who, film, rods, find_batch_index(who, film, scene))
    return Lines(run, np.where(pairs < 0, nodes - 1 - pairs, pairs), None, held)


def _find_unbroken(who: str, film: Trajectory, lines: Springs | Distances, index: tuple[int, ...]) -> np.ndarray | None:
    """Which lines are intact at every frame, `(frames, lines)`: as the run recorded, or as they were cut; None: all of them."""
    if lines.breaks_at is None:
        if lines.unbroken is None:
            return None
        held = _select_scene(np.asarray(lines.unbroken), index)
        return np.broadcast_to(held, (len(film.time), len(held)))
    for part in film.parts:
        if type(part) is type(lines) and np.array_equal(part.pairs, lines.pairs):
            held = np.asarray(part.unbroken)
            return held[(slice(None), *index[: held.ndim - 2])]
    raise ValueError(
        f"{who}: got a film without a record of which of these {type(lines).__name__.lower()} broke, expected one of a "
        "scene with them among its forces. If it was loaded from a file, load it with scene=."
    )


def _select_scene(numbers: np.ndarray, index: tuple[int, ...]) -> np.ndarray:
    """The numbers for the lines of one scene: the same for all scenes, or with axes of scenes in front."""
    axes = max(numbers.ndim - 1, 0)
    return numbers[tuple(i if n > 1 else 0 for i, n in zip(index[len(index) - axes :], numbers.shape, strict=False))]


__all__ = ["Lines", "are_lines", "take_lines"]
