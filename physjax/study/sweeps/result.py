"""What a sweep returns: values by axis, and a status with its reason for each lane; to be drawn, saved and exported."""

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import PyTree

from physjax.files import SWEEP_FORMAT, demand_known_format, read_arrays, write_atomically
from physjax.study.sweeps import store as chunks
from physjax.study.sweeps.design import DESIGNS, Axis, Lanes, leaf_name
from physjax.summaries import Row, format_array, format_tree, write_summary, write_table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from xarray import Dataset

_EXPECTED_SOURCE = "one written by Sweep.save, or a sweep's folder"
MISSING_REASON = "not computed yet"
"""Status -1: lanes of missing chunks."""


class Best(NamedTuple):
    """The best point of a sweep, the measure's values there, its index in the results, and the number compared."""

    point: dict[str, PyTree]
    values: PyTree
    index: tuple[int, ...]
    score: float

    def __str__(self) -> str:
        """The point, and the values where they have names."""
        parts = [self.point, self.values] if isinstance(self.values, dict) else [self.point]
        return ": ".join(", ".join(f"{name} = {np.asarray(value)}" for name, value in part.items()) for part in parts)


@dataclass(frozen=True, eq=False, repr=False)
class Sweep:
    """The results of a sweep. `axes` are the swept values by name; `shape` is that of the results, an axis each.

    `values` is what the measure returned, every array with `shape` as its leading axes; from a file or folder a dict by
    name, or the array itself where it is one. `status` is 0 where a lane is good; otherwise `reasons[status]` says what
    went wrong there; -1 is a lane that is not computed yet, whose values are zeros.
    Results in a folder are read when first used.
    """

    lanes: Lanes
    reasons: tuple[str, ...]
    source: Callable[[], dict[str, np.ndarray]] = field(repr=False)
    rebuild: Callable[[list[np.ndarray]], PyTree] | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        """Its axes, what was measured, and what failed."""
        return write_summary(*self._describe())

    def _repr_html_(self) -> str:
        return write_table(*self._describe())

    def _describe(self) -> tuple[str, list[Row]]:
        rows = [(name, format_tree(values)) for name, values in self.axes.items()]
        rows += [("->  " + name.removeprefix("value."), format_array(array)) for name, array in self.arrays.items()]
        codes, counts = np.unique(self.status, return_counts=True)
        reason = lambda code: MISSING_REASON if code < 0 else self.reasons[code]  # noqa: E731
        status = ", ".join(f"{n} {reason(code)}" for code, n in zip(codes.tolist(), counts.tolist(), strict=True))
        return f"Sweep: {'×'.join(map(str, self.shape))} points, {self.lanes.design}", [*rows, ("status", status)]

    def __getstate__(self) -> dict[str, Any]:
        """What is pickled: the results themselves, wherever they are kept."""
        return {"lanes": self.lanes, "reasons": self.reasons, "_flat": self._flat, "values": self.values}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, source=partial(dict, state["_flat"]), rebuild=None)

    @cached_property
    def _flat(self) -> dict[str, np.ndarray]:
        found = self.source()
        return {name: array.reshape(*self.shape, *array.shape[1:]) for name, array in found.items()}

    @property
    def axes(self) -> dict[str, PyTree]:
        """The swept values by name."""
        return {axis.name: axis.values for axis in self.lanes.axes}

    @property
    def shape(self) -> tuple[int, ...]:
        """The lengths of the axes; of zipped ones the one they have in common."""
        return self.lanes.shape

    @property
    def status(self) -> np.ndarray:
        """0 for a good lane, -1 for one that is not computed yet, else the index of its reason in `reasons`."""
        return self._flat["status"]

    @property
    def ok(self) -> np.ndarray:
        """Whether a lane is good."""
        return self.status == 0

    @cached_property
    def values(self) -> PyTree:
        """What the measure returned."""
        arrays = self.arrays
        if self.rebuild is not None:
            return self.rebuild(list(arrays.values()))
        return (
            arrays["value"]
            if list(arrays) == ["value"]
            else {_strip_prefix(name): array for name, array in arrays.items()}
        )

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """The values by name, `value` or `value.<where in the result>`."""
        return {name: array for name, array in self._flat.items() if name != "status"}

    def reason(self, index: int | tuple[int, ...]) -> str:
        """What went wrong in a lane; "ok" if nothing did."""
        code = int(self.status[index])
        return MISSING_REASON if code < 0 else self.reasons[code]

    @property
    def failures(self) -> dict[str, int]:
        """Numbers of failed lanes, by reason."""
        codes, counts = np.unique(self.status[~self.ok], return_counts=True)
        return {
            MISSING_REASON if code < 0 else self.reasons[code]: int(n) for code, n in zip(codes, counts, strict=True)
        }

    def number(self, of: str | None = None) -> np.ndarray:
        """One number of each lane, chosen by its name where there are several."""
        numbers = {
            _strip_prefix(n): a
            for n, a in self.arrays.items()
            if a.ndim == len(self.shape) and not _strip_prefix(n).endswith("ok")
        }
        if of is None and len(numbers) == 1:
            return next(iter(numbers.values()))
        if of not in numbers:
            raise ValueError(
                f"of: got {of!r}, expected the name of one number of each lane: {', '.join(numbers) or 'there is none'}."
            )
        return numbers[of]

    def best(self, of: str | None = None, *, largest: bool = False) -> Best:
        """The good lane with the least, or the largest, number `of` the values; ValueError where no lane is good."""
        score = self.number(of)
        if not self.ok.any():
            raise ValueError(f"best: no lane is good: {self.failures}.")
        worst = -np.inf if largest else np.inf
        place = (np.argmax if largest else np.argmin)(np.where(self.ok, score, worst))
        index = np.unravel_index(place, self.shape)
        values = jax.tree.map(lambda array: array[index], self.values)
        return Best(self.lanes.points(int(place)), values, tuple(map(int, index)), float(score[index]))

    def plot(
        self, of: str | None = None, *, labels: dict[str, str] | None = None, ax: "Axes | Figure | None" = None
    ) -> "Axes | Figure":
        """Draw the number `of` the values: a line over one axis, a map with contours over two, panels over three.

        `labels` are words for axes and numbers, with their units. Failed lanes are marked. Returns the axes, or the
        figure of panels.
        """
        from physjax.study.sweeps.chart import draw_sweep

        return draw_sweep(self, of, labels=labels, ax=ax)

    def to_numpy(self) -> dict[str, np.ndarray]:
        """Everything by name: `axis.<name>`, `value...`, `status`, and `reasons`."""
        return self.lanes.arrays | self.arrays | {"status": self.status, "reasons": np.array(self.reasons)}

    def to_xarray(self) -> "Dataset":
        """An `xarray.Dataset` with named dimensions and coordinates. Needs xarray."""
        try:
            import xarray
        except ImportError as error:
            raise ImportError("to_xarray needs xarray: pip install 'physjax[sweep]'.") from error
        zipped = self.lanes.design == "zip"
        dims = ("lane",) if zipped else tuple(axis.name for axis in self.lanes.axes)
        # a variable must not have the name of a dimension unless it is its coordinate
        data = {(_strip_prefix(n) if _strip_prefix(n) not in self.axes else n): a for n, a in self.arrays.items()} | {
            "status": self.status
        }
        variables = {n: (dims + tuple(f"{n}_{i}" for i in range(a.ndim - len(dims))), a) for n, a in data.items()}
        coordinates = {axis.name: (dims[0] if zipped else axis.name, axis.coordinate) for axis in self.lanes.axes}
        return xarray.Dataset(variables, coordinates, {"reasons": list(self.reasons)})

    def save(self, path: str | os.PathLike) -> None:
        """Write what `to_numpy` gives as one compressed `.npz`, readable by `numpy.load`; the file is whole or absent."""
        with write_atomically(path, "wb") as file:
            arrays = {**self.to_numpy(), "design": np.array(self.lanes.design), "format": np.array(SWEEP_FORMAT)}
            np.savez_compressed(file, **arrays)  # pyright: ignore[reportArgumentType]  # NumPy's stubs take every keyword for allow_pickle


def load(path: str | os.PathLike) -> Sweep:
    """A sweep from a file that `Sweep.save` wrote, or from the folder of a sweep, finished or not.

    Raises FileNotFoundError, or ValueError for what is neither, or damaged, or written in a newer format.
    """
    path = Path(path)
    if path.is_dir():
        folder = chunks.found(path)
        lanes = _read_lanes(read_arrays(path / "axes.npz", _EXPECTED_SOURCE), folder.manifest["design"])
        if {axis.name: axis.digest for axis in lanes.axes} != folder.manifest["axes"]:
            raise ValueError(f"load: {path / 'axes.npz'} does not hold the axes of this sweep. Use another folder.")
        return Sweep(lanes, tuple(folder.manifest["reasons"]), folder.gather)
    arrays = read_arrays(path, _EXPECTED_SOURCE)
    demand_known_format("load", path, arrays.get("format", SWEEP_FORMAT), SWEEP_FORMAT)
    missing = {"status", "reasons", "design"} - set(arrays)
    if missing:
        raise ValueError(f"load: {path} is not a saved sweep: it lacks {', '.join(sorted(missing))}.")
    lanes = _read_lanes(arrays, str(arrays["design"]))
    flat = {name: a for name, a in arrays.items() if name.partition(".")[0] == "value" or name == "status"}
    _demand_sweep(path, arrays, lanes, flat)
    flat = {name: a.reshape(lanes.count, *a.shape[len(lanes.shape) :]) for name, a in flat.items()}
    return Sweep(lanes, tuple(map(str, arrays["reasons"])), lambda: flat)


def _demand_sweep(path: Path, arrays: dict[str, np.ndarray], lanes: Lanes, flat: dict[str, np.ndarray]) -> None:
    """Raise a ValueError that names the file and the array which no sweep could have written."""

    def demand(name: str, good: ArrayLike, expected: str) -> None:
        if not np.all(good):
            shown = (
                f"{arrays[name].dtype} of shape {arrays[name].shape}" if arrays[name].size > 4 else f"{arrays[name]}"
            )
            raise ValueError(
                f"load: {path}: {name}: got {shown}, expected {expected}. The file is not as it was saved: save the sweep again."
            )

    demand("design", lanes.design in DESIGNS, " or ".join(DESIGNS))
    named = [name for name in arrays if name.startswith("axis.")]
    if not named or len(flat) < 2:
        raise ValueError(f"load: {path} is not a saved sweep: it lacks {'values' if named else 'axes'}.")
    for name in named:
        demand(
            name, arrays[name].dtype.kind in "biufV" and arrays[name].ndim and len(arrays[name]), "at least one number"
        )
        axis = next(axis for axis in lanes.axes if name in axis.arrays)
        length = lanes.axes[0].length if lanes.design == "zip" else axis.length
        demand(name, len(arrays[name]) == length, f"{length} values, as the other arrays of its axis have")
    for name in flat:
        shape = lanes.shape
        demand(name, arrays[name].shape[: len(shape)] == shape, f"a shape that begins with that of the axes, {shape}")
    reasons, status = arrays["reasons"], arrays["status"]
    demand("reasons", reasons.ndim == 1 and reasons.dtype.kind == "U" and len(reasons), "words")
    demand("status", status.dtype.kind == "i" and status.shape == lanes.shape, f"whole numbers of shape {lanes.shape}")
    demand("status", (status >= -1) & (status < len(reasons)), f"-1 to {len(reasons) - 1}, the places of the reasons")


def value_names(values: PyTree) -> list[str]:
    """The names of a measure's numbers in files."""
    paths = [leaf_name(path) for path, _ in jax.tree_util.tree_leaves_with_path(values)]
    return [f"value.{path}" if path else "value" for path in paths]


def _read_lanes(arrays: dict[str, np.ndarray], design: str) -> Lanes:
    """The axes of a file: records come back as dicts by name."""
    axes: dict[str, PyTree] = {}
    for name, array in arrays.items():
        kind, _, rest = name.partition(".")
        axis, _, part = rest.partition(".")
        if kind == "axis":
            axes[axis] = {**axes.get(axis, {}), part: array} if part else array
    return Lanes(tuple(Axis(name, values) for name, values in axes.items()), design)


def _strip_prefix(name: str) -> str:
    return name.removeprefix("value.")
