"""What a sweep varies: named axes, crossed to a grid, zipped or sampled; and which values belong to which lane."""

import hashlib
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import PyTree

from physjax.checks import as_positive_integer, as_real_quantity, demand_known

__all__ = ["Axis", "Lanes", "latin_hypercube", "sobol"]

DESIGNS = ("grid", "zip")

KeyPath = tuple[Any, ...]
"""The keys that lead to a leaf of a pytree, as JAX gives them."""


class Axis(NamedTuple):
    """A name, and values stacked along the leading axis of every array in a pytree."""

    name: str
    values: PyTree

    @property
    def length(self) -> int:
        """The number of values."""
        return len(jax.tree.leaves(self.values)[0])

    @property
    def coordinate(self) -> np.ndarray:
        """The numbers of the axis, `(length,)`; their places 0, 1, 2, ... where a value is not one number."""
        leaves = jax.tree.leaves(self.values)
        return leaves[0] if len(leaves) == 1 and leaves[0].ndim == 1 else np.arange(self.length)

    def at(self, index: int | np.integer | np.ndarray) -> PyTree:
        """The value, or the values, at an index."""
        return jax.tree.map(lambda leaf: leaf[index], self.values)

    @property
    def digest(self) -> str:
        """A hash of names, dtypes, shapes and bytes, the same for a record and for the dict that comes back from a file."""
        found = hashlib.sha256()
        for name, array in sorted(self.arrays.items()):
            found.update(f"{name} {array.dtype} {array.shape}".encode())
            found.update(np.ascontiguousarray(array).tobytes())
        return found.hexdigest()

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays by name, `axis.<name>` and where in the record."""
        leaves = jax.tree_util.tree_leaves_with_path(self.values)
        return {".".join(filter(None, ("axis", self.name, leaf_name(path)))): leaf for path, leaf in leaves}


def leaf_name(path: KeyPath) -> str:
    """The path of a leaf as a name with dots."""
    return jax.tree_util.keystr(path, simple=True, separator=".")


class Lanes(NamedTuple):
    """All points of a design in order: the last axis of a grid varies fastest. Made chunk by chunk, never as a whole."""

    axes: tuple[Axis, ...]
    design: str

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the results: the axes' lengths, or for zipped axes the one that they have in common."""
        lengths = tuple(axis.length for axis in self.axes)
        return lengths[:1] if self.design == "zip" else lengths

    @property
    def count(self) -> int:
        """The number of points."""
        return math.prod(self.shape)

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays of all axes by name."""
        return {name: array for axis in self.axes for name, array in axis.arrays.items()}

    def indices(self, lanes: int | np.ndarray) -> tuple[int | np.integer | np.ndarray, ...]:
        """The index on each axis of lanes given by their number."""
        return (lanes,) * len(self.axes) if self.design == "zip" else np.unravel_index(lanes, self.shape)

    def points(self, lanes: int | np.ndarray) -> dict[str, PyTree]:
        """The values of lanes given by their number, by axis."""
        return {axis.name: axis.at(i) for axis, i in zip(self.axes, self.indices(lanes), strict=True)}


def build_lanes(axes: Mapping[str, PyTree], design: str) -> Lanes:
    """The axes as arrays of the dtypes that JAX will compute in; ValueError or TypeError in plain words for bad ones."""
    demand_known("design", design, DESIGNS)
    if not isinstance(axes, Mapping) or not axes:
        raise TypeError(f"axes: got {axes!r}, expected names and arrays, e.g. dict(speed=jnp.linspace(10, 50, 100)).")
    lanes = Lanes(tuple(_build_axis(name, values) for name, values in axes.items()), design)
    lengths = {axis.name: axis.length for axis in lanes.axes}
    if design == "zip" and len(set(lengths.values())) > 1:
        raise ValueError(
            f"axes: got lengths {lengths}, expected equal ones: zipped axes have one value each for every lane."
        )
    return lanes


def _build_axis(name: str, values: PyTree) -> Axis:
    if not isinstance(name, str) or not name.isidentifier():
        raise TypeError(f"axes: got the name {name!r}, expected the name of an argument of the measure.")
    if isinstance(values, Sequence) and not hasattr(values, "_fields") and len(values):
        values = _stack_records(name, list(values))
    values = jax.tree.map(lambda leaf: _check_array(name, leaf), values)
    leaves = jax.tree.leaves(values)
    if not leaves or any(not leaf.ndim or not leaf.size for leaf in leaves):
        shapes = [leaf.shape for leaf in leaves]
        raise ValueError(
            f"axis {name}: got arrays of shape {shapes}, expected at least one value. Give it some, or leave it out."
        )
    lengths = {len(leaf) for leaf in leaves}
    if len(lengths) > 1:
        raise ValueError(
            f"axis {name}: got arrays of lengths {sorted(lengths)}, expected one length, a value for each lane."
        )
    return Axis(name, values)


def _check_array(name: str, leaf: ArrayLike) -> np.ndarray:
    array = np.asarray(leaf)
    if array.dtype.kind not in "biuf" and not jnp.issubdtype(array.dtype, jnp.floating):
        raise TypeError(f"axis {name}: got dtype {array.dtype}, expected real numbers, or records of them.")
    return array.astype(jax.dtypes.canonicalize_dtype(array.dtype))


def _stack_records(name: str, values: list[PyTree]) -> PyTree:
    """Records of the same shape, scenes for example, as one with a leading axis; others are refused with the reason."""
    # what is not a number stands in the structure, where it must be the same in all
    parts = [
        eqx.partition(value, lambda leaf: eqx.is_array(leaf) or isinstance(leaf, bool | int | float | np.generic))
        for value in values
    ]
    trees = [jax.tree.structure(static) for _, static in parts]
    first, rest = parts[0]
    for place, ((numbers, static), tree) in enumerate(zip(parts, trees, strict=True)):
        if (
            tree != trees[0]
            or jax.tree.structure(numbers) != jax.tree.structure(first)
            or not eqx.tree_equal(static, rest)
        ):
            raise ValueError(
                f"axis {name}: the values 0 and {place} differ in more than numbers: in their parts, in how many nodes or "
                "springs they have, or in a function. A sweep is one compiled program for all lanes: expected records that "
                "differ in numbers only. Sweep scenes of each shape on their own."
            )
        for (path, one), other in zip(
            jax.tree_util.tree_leaves_with_path(first), jax.tree.leaves(numbers), strict=True
        ):
            if np.shape(one) != np.shape(other):
                raise ValueError(
                    f"axis {name}: the values 0 and {place} have different shapes, {np.shape(one)} and {np.shape(other)} at "
                    f"{jax.tree_util.keystr(path) or 'the number itself'}. A sweep is one compiled program for all lanes: "
                    "expected equal shapes. Sweep scenes of each shape on their own."
                )
    stacked = jax.tree.map(
        lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *(numbers for numbers, _ in parts)
    )
    return eqx.combine(stacked, rest)


def latin_hypercube(ranges: Mapping[str, tuple[float, float]], count: int, *, seed: int = 0) -> dict[str, np.ndarray]:
    """Axes to be zipped: `count` points, one in each of `count` equal slices of every range (low, high). Needs scipy.

    M. D. McKay, R. J. Beckman, W. J. Conover, Technometrics 21 (1979) 239.
    """
    return _sample_points(False, ranges, count, seed)


def sobol(ranges: Mapping[str, tuple[float, float]], count: int, *, seed: int = 0) -> dict[str, np.ndarray]:
    """Axes to be zipped: `count` points, a power of two, of a scrambled Sobol sequence over ranges (low, high). Needs scipy.

    I. M. Sobol, USSR Comput. Math. Math. Phys. 7 (1967) 86; scrambled after A. Owen (1998).
    """
    if as_positive_integer("count", count).bit_count() != 1:
        raise ValueError(
            f"count: got {count}, expected a power of two, e.g. {1 << count.bit_length()}: only such designs are balanced."
        )
    return _sample_points(True, ranges, count, seed)


def _sample_points(
    balanced: bool, ranges: Mapping[str, tuple[float, float]], count: int, seed: int
) -> dict[str, np.ndarray]:
    try:
        from scipy.stats import qmc
    except ImportError as error:
        raise ImportError("sampled designs need scipy: pip install 'physjax[sweep]'.") from error
    as_positive_integer("count", count)
    ends = {name: np.asarray(as_real_quantity(f"range of {name}", ends), float) for name, ends in ranges.items()}
    for name, end in ends.items():
        if end.shape != (2,) or not end[0] < end[1]:
            raise ValueError(f"range of {name}: got {end.tolist()}, expected (low, high) with low < high.")
    sampler = qmc.Sobol if balanced else qmc.LatinHypercube
    points = sampler(len(ends), rng=np.random.default_rng(seed)).random(count)
    return {name: low + (high - low) * points[:, i] for i, (name, (low, high)) in enumerate(ends.items())}
