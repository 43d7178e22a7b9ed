"""Atomic files and folders: complete or absent, because they are written under a temporary name and then renamed.

The temporary name is in the same folder, since a rename is atomic only within one file system. What is read is checked:
every array of a saved run against what a run can be, before it is used.
"""

import os
import shutil
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np

RUN_FORMAT = 1
"""Format version of the files that `Trajectory.save` writes; files of the first edition lack it and have this one."""
SWEEP_FORMAT = 1
"""Format version of the files that `Sweep.save` writes and of the folders of sweeps; those without one have this one."""

Verdict = bool | np.bool | np.ndarray
"""Whether an array of a file is as it must be, or which of its entries are."""
Demand = Callable[[str, Verdict, str], None]
"""Raises a ValueError for the array of this name where the verdict is not true, with what was expected."""


@contextmanager
def write_atomically(path: str | os.PathLike, mode: str = "w", *, durable: bool = False) -> Iterator[IO]:
    """Open a temporary file that replaces `path` when the block ends, and is removed when the block raises.

    A `durable` one is on the disk, with its name, before this returns: it survives a power failure.
    Raises FileNotFoundError when the folder of `path` does not exist.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: the folder {path.parent} does not exist. Create it first.")
    encoding, newline = (None, None) if "b" in mode else ("utf-8", "")
    handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, mode, encoding=encoding, newline=newline) as file:
            yield file
            if durable:
                file.flush()
                os.fsync(file.fileno())
        # mkstemp made it readable by its owner alone
        os.chmod(temporary, 0o666 & ~_read_umask())
        os.replace(temporary, path)
        if durable:
            _sync_folder(path.parent)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


@contextmanager
def write_folder_atomically(path: str | os.PathLike) -> Iterator[Path]:
    """Fill a temporary folder that becomes `path` when the block ends, and is removed when the block raises.

    Raises FileNotFoundError when the folder that `path` is to be in does not exist, and FileExistsError when there is
    something at `path` already, unless it is an empty folder.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: the folder {path.parent} does not exist. Create it first.")
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise FileExistsError(f"cannot write {path}: something is there. Choose a new or an empty folder.")
    temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        yield temporary
        temporary.chmod(0o777 & ~_read_umask())
        if path.exists():
            path.rmdir()
        os.replace(temporary, path)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


def ensure_writable_folder(path: str | os.PathLike) -> Path:
    """Create the folder if necessary and make sure that files can be written there; an OSError in plain words otherwise."""
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OSError(f"cannot write into {folder}: {error.strerror or error}. Choose another folder.") from error
    return folder


def read_arrays(path: str | os.PathLike, writer: str) -> dict[str, np.ndarray]:
    """The arrays of an .npz file by name; FileNotFoundError or a ValueError that says what is wrong with the file."""
    file = Path(path)
    if not file.is_file():
        raise FileNotFoundError(f"load: there is no file {file}. Expected {writer}.")
    try:
        with np.load(file) as archive:
            return {name: archive[name] for name in archive.files}
    except (ValueError, TypeError, EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"load: {file} is damaged or not an .npz file ({error}).") from error
    except AttributeError as error:  # a lone .npy is an array, not an archive
        raise ValueError(f"load: {file} is damaged or not an .npz file (it holds one array).") from error


def demand_known_format(who: str, file: str | os.PathLike, found: object, newest: int) -> None:
    """Raise a ValueError where a file's format version is none, or newer than what is known here: `newest`."""
    whole = isinstance(found, int) or (isinstance(found, np.ndarray) and found.ndim == 0 and found.dtype.kind in "iu")
    number = int(found) if whole else 0  # pyright: ignore[reportArgumentType]  # it is one of the two
    if number < 1:
        raise ValueError(
            f"{who}: {file}: format: got {found}, expected a whole number from 1 on. It is damaged: save it again."
        )
    if number > newest:
        raise ValueError(
            f"{who}: {file}: format: got {number}, expected at most {newest}: a newer physjax wrote it. "
            "Update physjax to read it."
        )


def demand_saved_run(file: str | os.PathLike, arrays: Mapping[str, np.ndarray]) -> None:
    """Raise a ValueError that names the file and the array that no run could have written."""
    demand_known_format("load", file, arrays.get("format", RUN_FORMAT), RUN_FORMAT)
    needed = {"time", "ok", "first_step", "save_every", "steps", "method"}
    # a run of ours: that of a reference solver has no dt
    if any(name.startswith(("final_state.", "first_bad_step")) for name in arrays):
        needed |= {"dt"}
    missing = needed - set(arrays)
    if missing:
        raise ValueError(f"load: {file} is not a saved run: it lacks {', '.join(sorted(missing))}.")

    def demand(name: str, good: Verdict, expected: str) -> None:
        if not np.all(good):
            array = arrays[name]
            shown = f"{array}" if array.size < 5 else f"{array.dtype} of shape {array.shape}"
            raise ValueError(
                f"load: {file}: {name}: got {shown}, expected {expected}. The file is not as it was saved: save the run again."
            )

    is_count = lambda name, least: arrays[name].ndim == 0 and arrays[name].dtype.kind in "iu" and arrays[name] >= least  # noqa: E731
    demand("save_every", is_count("save_every", 1), "a whole number from 1 on")
    demand("steps", is_count("steps", 0), "a whole number of steps")
    steps, save_every = int(arrays["steps"]), int(arrays["save_every"])
    demand("steps", steps % save_every == 0, f"a multiple of save_every, {save_every}")
    demand("method", arrays["method"].dtype.kind == "U" and arrays["method"].ndim == 0, "the name of a method")
    demand("first_step", arrays["first_step"].dtype.kind in "iu", "whole numbers")
    demand("ok", arrays["ok"].dtype == bool, "booleans")
    _demand_frames(arrays, demand, steps // save_every + 1)
    _demand_times(arrays, demand, steps)


def _demand_frames(arrays: Mapping[str, np.ndarray], demand: Demand, frames: int) -> None:
    """The same number of frames everywhere, after the axes of a vmap, if any; real numbers; finite at the end of a good run."""
    outside = arrays["first_step"].shape
    axis, ok = len(outside), arrays["ok"]
    demand("ok", ok.shape[:axis] == outside, f"a shape that begins with first_step's, {outside}")
    groups = ("state", "recorded", "parts", "final_state", "final_parts")
    named = {name: name.partition(".")[0].partition("[")[0] for name in arrays}
    for name in [name for name in arrays if named[name] in groups or name == "time"]:
        array = arrays[name]
        demand(name, array.dtype.kind in "fiubc", "numbers")
        if name == "time" or named[name] in ("state", "recorded"):
            right = array.shape[: axis + 1] == (*outside, frames)
            demand(
                name,
                right,
                f"{frames} frames, as steps and save_every have it: a shape that begins with {(*outside, frames)}",
            )
        if named[name] == "state" and ok.all():
            demand(name, np.isfinite(np.moveaxis(array, axis, 0)[-1]), "finite numbers at the end, since ok is true")
        if named[name] == "final_state" and ok.all():
            demand(name, np.isfinite(array), "finite numbers, since ok is true")
    for group in ("state", "final_state"):
        if {f"{group}.position", f"{group}.velocity"} <= set(arrays):
            place, speed = arrays[f"{group}.position"], arrays[f"{group}.velocity"]
            demand(f"{group}.position", place.dtype.kind == "f", "real numbers")
            agree = (place.shape, place.dtype) == (speed.shape, speed.dtype)
            demand(f"{group}.velocity", agree, f"{place.dtype} of shape {place.shape}, as {group}.position")
    for name in [name for name in arrays if name.startswith("final_state.") and name.removeprefix("final_") in arrays]:
        last = np.moveaxis(arrays[name.removeprefix("final_")], axis, 0)[-1]
        same = np.array_equal(last, arrays[name], equal_nan=last.dtype.kind in "fc")
        demand(name, same, f"the {name.removeprefix('final_state.').replace('_', ' ')} of the last frame")
    if "state.position" in arrays:
        lanes = (*outside, *arrays["state.position"].shape[axis + 1 : -1])
        demand("ok", ok.shape in (lanes, lanes[:-1]), f"one for each lane or scene, {lanes}")
    if "first_bad_step" in arrays:
        good = arrays["first_bad_step"].dtype.kind in "iu" and arrays["first_bad_step"].shape == ok.shape
        demand("first_bad_step", good, f"whole numbers of ok's shape, {ok.shape}")


def _demand_times(arrays: Mapping[str, np.ndarray], demand: Demand, steps: int) -> None:
    """Time that increases by as much as the steps take; not checked where a lane failed, which may be because of its dt."""
    time, ok, axis = arrays["time"], arrays["ok"], arrays["first_step"].ndim
    demand("time", time.dtype.kind == "f", "real numbers")
    if "dt" in arrays:
        demand("dt", arrays["dt"].dtype.kind == "f", "real numbers")
        per_frame = time.shape[:axis] + time.shape[axis + 1 :]
        demand("dt", arrays["dt"].shape == per_frame, f"one for each that has a time of its own, of shape {per_frame}")
    if not ok.all():
        return
    demand("time", np.isfinite(time) & np.all(np.diff(time, axis=axis) >= 0), "finite and ascending numbers")
    if "dt" in arrays:
        dt = arrays["dt"].astype(float)
        demand("dt", np.isfinite(dt) & (dt > 0), "finite numbers > 0")
        run, rounding = np.moveaxis(time.astype(float), axis, 0), 8 * np.finfo(time.dtype).eps * np.abs(time).max()
        demand("dt", np.abs(run[-1] - run[0] - steps * dt) <= rounding, f"{steps} steps to take as long as time says")
        first = arrays["first_step"].astype(float)
        first = first.reshape(first.shape + (1,) * (dt.ndim - axis))
        demand("first_step", np.abs(run[0] - first * dt) <= rounding, "the step at which time begins")


def _sync_folder(folder: Path) -> None:
    """Flush the names in a folder to the disk; a system that cannot open folders does that by itself."""
    if os.name == "posix":
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _read_umask() -> int:
    """The umask of the process, which can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
