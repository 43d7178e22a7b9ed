"""A folder of finished chunks: each is whole or absent, names the sweep it belongs to, and is checked by its own name.

`manifest.json` says what the sweep is. `chunk-00000012-<sha256 of the file>.npz` holds lanes 12·batch and on, readable
by `numpy.load`: an array for each number that the measure returns, `status`, and `sweep`, the manifest's identity.
"""

import hashlib
import io
import json
import math
import os
import re
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any, Generic, TypeVar

import jax
import numpy as np

from physjax.backend import device_kind
from physjax.files import SWEEP_FORMAT, demand_known_format, ensure_writable_folder, write_atomically

CHUNK_FILE_PATTERN = re.compile(r"chunk-(\d{8})-([0-9a-f]{64})\.npz")
PARTIAL_FILE_PATTERN = re.compile(r"\.chunk-(\d{8})-.*")
"""What a killed process leaves of a chunk that it was writing."""
MANIFEST = "manifest.json"
Manifest = dict[str, Any]
"""What a sweep is, as JSON: names, hashes, shapes, counts."""
MISMATCH_TEXTS = {
    "axes": "other values on the axes",
    "design": "another design",
    "measure": "another measure, or one with other constants",
    "versions": "other versions",
    "backend": "another kind of device",
    "outputs": "other results",
    "batch": "another number of lanes in a chunk",
    "block": "another number of lanes in a block",
    "shape": "another shape",
}
"""What the entries of a manifest mean where they differ."""


def collect_versions() -> dict[str, str]:
    """Versions of the packages that determine the bits of a result."""
    return {name: version(name) for name in ("jax", "jaxlib", "numpy")}


def hash_manifest(manifest: Manifest) -> str:
    """A hash of a manifest."""
    return hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()


Place = TypeVar("Place")
"""Where a chunk is: a slice of arrays, or a file."""


class Store(ABC, Generic[Place]):
    """Where the chunks of one sweep are kept."""

    def __init__(self, manifest: Manifest):
        self.manifest = manifest

    @property
    def chunks(self) -> int:
        """The number of chunks in the end."""
        return -(-self.lanes // self.manifest["batch"])

    @property
    def lanes(self) -> int:
        """The number of lanes."""
        return math.prod(self.manifest["shape"])

    def range(self, chunk: int) -> tuple[int, int]:
        """The first lane of a chunk, and the one after the last."""
        batch = self.manifest["batch"]
        return chunk * batch, min((chunk + 1) * batch, self.lanes)

    def allocate_arrays(self) -> dict[str, np.ndarray]:
        """Arrays for all lanes, none of which is computed: zeros, and a status of -1."""
        outputs = self.manifest["outputs"].items()
        whole = {name: np.zeros((self.lanes, *shape), dtype) for name, (shape, dtype) in outputs}
        whole["status"][:] = -1
        return whole

    @abstractmethod
    def find_finished(self) -> dict[int, Place]:
        """The finished chunks by number, each to be `read`."""

    @abstractmethod
    def read(self, place: Place) -> dict[str, np.ndarray]:
        """The arrays of a finished chunk."""

    @abstractmethod
    def write(self, chunk: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Keep a chunk."""

    @abstractmethod
    def gather(self) -> dict[str, np.ndarray]:
        """All lanes; those of missing chunks have status -1 and zeros."""

    @abstractmethod
    def share(self, processes: int) -> None:
        """Wait until all processes have finished, and let each have all chunks."""


class MemoryStore(Store[slice]):
    """Chunks as parts of whole arrays."""

    def __init__(self, manifest: Manifest):
        super().__init__(manifest)
        self.arrays = self.allocate_arrays()

    def find_finished(self) -> dict[int, slice]:
        """None: a sweep in memory starts from the beginning."""
        return {}

    def read(self, place: slice) -> dict[str, np.ndarray]:
        """Some lanes."""
        return {name: array[place] for name, array in self.arrays.items()}

    def write(self, chunk: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Put a chunk in its place."""
        for name, array in arrays.items():
            self.arrays[name][slice(*self.range(chunk))] = array

    def gather(self) -> dict[str, np.ndarray]:
        """The arrays as they are."""
        return self.arrays

    def share(self, processes: int) -> None:
        """Send every process the chunks of all, as bytes, which no conversion of numbers can change."""
        from jax.experimental.multihost_utils import process_allgather

        batch, most = self.manifest["batch"], -(-self.chunks // processes)

        def lanes(process: int) -> np.ndarray:
            ranges = [np.arange(*self.range(chunk)) for chunk in range(process, self.chunks, processes)]
            return np.concatenate(ranges or [np.zeros(0, int)])

        mine = lanes(jax.process_index())
        for array in self.arrays.values():
            sent = np.zeros((most * batch, *array.shape[1:]), array.dtype)
            sent[: mine.size] = array[mine]
            received = np.asarray(process_allgather(sent.reshape(-1).view(np.uint8)))
            for i, one in enumerate(received):
                array[lanes(i)] = np.ascontiguousarray(one).view(array.dtype).reshape(sent.shape)[: lanes(i).size]


class FolderStore(Store[Path]):
    """Chunks as files."""

    def __init__(self, path: Path, manifest: Manifest):
        super().__init__(manifest)
        self.path = path

    def find_finished(self) -> dict[int, Path]:
        """The files of finished chunks by number; ValueError for a file that is no chunk of this sweep by its name."""
        found: dict[int, Path] = {}
        for path in sorted(self.path.glob("chunk-*")):
            named = CHUNK_FILE_PATTERN.fullmatch(path.name)
            number = int(named[1]) if named else -1
            if not 0 <= number < self.chunks or number in found:
                raise ValueError(
                    f"sweep: {path} is not a chunk of this sweep of {self.chunks}. Move it out of the folder."
                )
            found[number] = path
        return found

    def write(self, chunk: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Write a chunk, whole and on the disk when this returns; OSError in plain words when it cannot be."""
        content = io.BytesIO()
        kept = {**arrays, "sweep": np.array(hash_manifest(self.manifest))}
        np.savez(content, **kept)  # pyright: ignore[reportArgumentType]  # NumPy's stubs take every keyword for allow_pickle
        name = f"chunk-{chunk:08d}-{hashlib.sha256(content.getbuffer()).hexdigest()}.npz"
        try:
            with write_atomically(self.path / name, "wb", durable=True) as file:
                file.write(content.getbuffer())
        except OSError as error:
            raise OSError(
                f"sweep: cannot write chunk {chunk} of {self.chunks} into {self.path}: {error.strerror or error}. The finished "
                "chunks are intact: make room, and run the same sweep again to continue."
            ) from error

    def read(self, path: Path) -> dict[str, np.ndarray]:
        """The arrays of a chunk; ValueError naming a file that is damaged or of another sweep."""
        content = path.read_bytes()
        named = CHUNK_FILE_PATTERN.fullmatch(path.name)
        if named is None or hashlib.sha256(content).hexdigest() != named[2]:
            raise ValueError(
                f"sweep: the chunk {path} is damaged: its content is not what was written. Delete it, and run the same sweep "
                "again to recompute it."
            )
        try:
            with np.load(io.BytesIO(content)) as archive:
                arrays = dict(archive)
        except (ValueError, zipfile.BadZipFile) as error:
            raise ValueError(f"sweep: the chunk {path} was not written by a sweep ({error}). Move it out.") from error
        if str(arrays.pop("sweep", "")) != hash_manifest(self.manifest):
            raise ValueError(f"sweep: the chunk {path} belongs to another sweep. Move it out of the folder.")
        return arrays

    def gather(self) -> dict[str, np.ndarray]:
        """All lanes of all finished chunks; lanes of others have status -1 and zeros."""
        whole = self.allocate_arrays()
        for chunk, path in self.find_finished().items():
            for name, array in self.read(path).items():
                whole[name][slice(*self.range(chunk))] = array
        return whole

    def share(self, processes: int) -> None:
        """Wait; the folder is there for all."""
        from jax.experimental.multihost_utils import sync_global_devices

        sync_global_devices(f"sweep {hash_manifest(self.manifest)}")


@contextmanager
def open_folder(
    path: str | os.PathLike, manifest: Manifest, shard: tuple[int, int], axes: Mapping
) -> Iterator[FolderStore]:
    """The folder of a sweep, locked for one process or shard; ValueError if it is in use or holds another sweep.

    The locks are the system's and go with the process, however it ends. A new folder also gets the axes, as `axes.npz`.
    """
    path = ensure_writable_folder(path)
    i, n = shard
    with (
        _lock_file(path / ".lock", shared=n > 1, who=path),
        _lock_file(path / f".lock-{i}-of-{n}", shared=False, who=path),
    ):
        with _lock_file(path / ".lock-manifest", shared=False, who=path, wait=True):
            folder = FolderStore(path, _read_or_write_manifest(path, manifest, axes))
        for half in path.iterdir():
            if (named := PARTIAL_FILE_PATTERN.fullmatch(half.name)) and int(named[1]) % n == i:
                half.unlink()
        yield folder


def found(path: str | os.PathLike) -> FolderStore:
    """A folder that a sweep has written into."""
    try:
        manifest = json.loads((Path(path) / MANIFEST).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise FileNotFoundError(f"sweep: there is no sweep in {path}: it has no {MANIFEST}.") from error
    except ValueError as error:
        raise ValueError(f"sweep: {Path(path) / MANIFEST} is damaged ({error}). Use another folder.") from error
    if isinstance(manifest, dict):  # the format first: in a newer one nothing else need be as here
        demand_known_format("sweep", Path(path) / MANIFEST, manifest.get("format", SWEEP_FORMAT), SWEEP_FORMAT)
    try:
        if hash_manifest(manifest["sweep"]) != manifest["identity"]:
            raise ValueError("it was changed")
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"sweep: {Path(path) / MANIFEST} is damaged ({error}). Use another folder.") from error
    return FolderStore(Path(path), manifest["sweep"])


def read_layout(path: str | os.PathLike) -> tuple[int, int] | None:
    """Lanes in a chunk and in a block of the sweep that has begun in a folder; None where there is none."""
    if not (Path(path) / MANIFEST).exists():
        return None
    manifest = found(path).manifest
    return manifest["batch"], manifest["block"]


def _read_or_write_manifest(path: Path, manifest: Manifest, axes: Mapping[str, np.ndarray]) -> Manifest:
    """The folder's manifest, written if there is none; ValueError saying how it differs from this one."""
    manifest = json.loads(json.dumps(manifest))
    if (path / MANIFEST).exists():
        old = found(path).manifest
        differing = [key for key in manifest if old.get(key) != manifest[key]]
        if differing:
            differences = "; ".join(
                f"{MISMATCH_TEXTS.get(key, key)} ({_describe_difference(old.get(key), manifest[key])})"
                for key in differing
            )
            raise ValueError(
                f"sweep: {path} holds another sweep: {differences}. Choose another folder, or sweep as before."
            )
        return old
    if any(path.glob("chunk-*")):
        raise ValueError(
            f"sweep: {path} holds chunks but no {MANIFEST}, so it is unknown of which sweep. Choose another folder."
        )
    with write_atomically(path / "axes.npz", "wb", durable=True) as file:
        np.savez(file, **axes)  # pyright: ignore[reportArgumentType]  # NumPy's stubs take every keyword for allow_pickle
    with write_atomically(path / MANIFEST, durable=True) as file:
        json.dump({"format": SWEEP_FORMAT, "identity": hash_manifest(manifest), "sweep": manifest}, file, indent=1)
    return manifest


def _describe_difference(old: object, new: object) -> str:
    """How two entries differ; long hashes are cut."""
    if isinstance(old, dict) and isinstance(new, dict):
        keys = [key for key in {**old, **new} if old.get(key) != new.get(key)]
        return ", ".join(f"{key}: {_describe_difference(old.get(key), new.get(key))}" for key in keys)
    return f"{str(old)[:16]} there, {str(new)[:16]} here"


@contextmanager
def _lock_file(path: Path, shared: bool, who: Path, wait: bool = False) -> Iterator[None]:
    """Hold a lock file; where another process does, wait, or raise a ValueError at once."""
    import fcntl  # POSIX: elsewhere sweeps are kept in memory

    with path.open("w") as file:
        try:
            fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError as error:
            raise ValueError(
                f"sweep: another process is working in {who}. Wait for it, or let both share the work: shard=(0, 2) in one, "
                "shard=(1, 2) in the other."
            ) from error
        yield


def describe_backend() -> str:
    """The kind of device and the precision, which determine the bits of a result."""
    return f"{device_kind()}, x64 {'on' if jax.config.read('jax_enable_x64') else 'off'}"
