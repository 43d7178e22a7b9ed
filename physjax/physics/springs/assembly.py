"""Nodes, their masses and their springs in one record, as which every rope, sheet and bridge is returned."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.checks import NestedArrayLike, as_real_quantity
from physjax.particles import Particles
from physjax.physics.springs.springs import Springs
from physjax.physics.springs.wind import Cells, Triangles, Wind
from physjax.summaries import Row, format_number, format_part, write_summary, write_table


class NodeSets(dict[str, np.ndarray]):
    """Masks of nodes by the names of their sets; a wrong name is answered by those that there are."""

    def __missing__(self, name: str) -> np.ndarray:
        raise KeyError(f"nodes: got {name!r}, expected the name of a set: {', '.join(self)}.")


def _flatten_sets(sets: NodeSets) -> tuple[list[tuple[Any, np.ndarray]], tuple[str, ...]]:
    """As JAX flattens a dictionary: by its sorted names."""
    names = tuple(sorted(sets))
    return [(jax.tree_util.DictKey(name), sets[name]) for name in names], names


jax.tree_util.register_pytree_with_keys(
    NodeSets, _flatten_sets, lambda names, masks: NodeSets(zip(names, masks, strict=True))
)


class Lattice(NamedTuple):
    """Nodes at rest, the mass of each [kg], the springs between them, named sets of nodes, and faces to draw.

    `nodes` are boolean masks by name, `faces` `(faces, 3)` triangles of nodes. `shape` is (rows, columns) or the like of a
    regular lattice, None for a mesh.

    Example:
        >>> sheet.shape, np.flatnonzero(sheet.nodes["left"]).tolist()
        ((3, 3), [0, 3, 6])
    """

    state: Particles
    mass: Array
    springs: Springs
    nodes: dict[str, np.ndarray]
    faces: np.ndarray
    shape: tuple[int, ...] | None

    def __repr__(self) -> str:
        """Its size, mass and springs, and the names of its sets of nodes."""
        return write_summary(*self._describe())

    def _repr_html_(self) -> str:
        return write_table(*self._describe())

    def _describe(self) -> tuple[str, list[Row]]:
        nodes, dim = self.state.position.shape[-2:]
        shape = "" if self.shape is None else f" ({'×'.join(map(str, self.shape))})"
        rows = [
            ("mass", f"{format_number(np.sum(np.asarray(self.mass)))} kg"),
            ("springs", f"{len(self.springs.pairs)}, {format_part(self.springs)}"),
            ("faces", str(len(self.faces))),
            ("sets of nodes", ", ".join(f"{name} {int(np.sum(mask))}" for name, mask in self.nodes.items())),
        ]
        return f"Lattice: {nodes} nodes{shape} in {dim}-D", rows

    def wind(
        self,
        velocity: NestedArrayLike,
        density: ArrayLike = 1.225,
        normal: ArrayLike = 1.2,
        tangential: ArrayLike | None = 0.05,
    ) -> Wind:
        """The aerodynamic force on the faces in air that moves with a `velocity` [m/s]; see `Wind`."""
        if len(self.faces) == 0 or self.state.position.shape[-1] != 3:
            raise ValueError(
                "wind: this lattice has no faces in space to blow on; for points there is forces.QuadraticDrag."
            )
        if self.shape is not None and len(self.shape) == 2:
            surface = Cells(*self.shape)
        else:
            surface = Triangles(self.faces, self.state.lanes[-1])
        return Wind(surface, velocity, density, normal, tangential)


SpringKind = tuple[np.ndarray, NestedArrayLike | None]
"""Pairs of nodes, and the stiffness of the springs between them [N/m]; None: there are none."""
NO_FACES = np.zeros((0, 3), int)
"""The faces of what has none: a rope, a truss."""


def build_lattice(
    x: np.ndarray,
    kinds: Sequence[SpringKind],
    damping: NestedArrayLike | None,
    breaks_at: NestedArrayLike | None,
    mass: NestedArrayLike,
    share: np.ndarray,
    sets: dict[str, np.ndarray],
    faces: np.ndarray = NO_FACES,
    shape: tuple[int, ...] | None = None,
    stretch: ArrayLike = 1.0,
    yields_at: NestedArrayLike | None = None,
    volumes: Sequence[np.ndarray] | None = None,
) -> Lattice:
    """The lattice with nodes at x [m], and `mass` [kg] distributed to them in proportion to `share`.

    Springs are as long as their ends are apart, times `stretch`. Where each stands for one of `volumes`, kind by kind,
    stiffness and damping are those of the material: times V/l² they are a spring's.
    """
    chosen = [i for i, (pairs, stiffness) in enumerate(kinds) if stiffness is not None and len(pairs)]
    present = [(pairs, stiffness) for pairs, stiffness in (kinds[i] for i in chosen) if stiffness is not None]
    if not present:
        raise ValueError("lattice: got no stiffness, expected at least that of the structural springs.")
    pairs = np.concatenate([pairs for pairs, _ in present])
    lengths = vector_lengths(x[pairs[:, 0]] - x[pairs[:, 1]])
    rest = lengths * stretch
    stiffness = _join_stiffness(present)
    if volumes is not None:
        # of what is longer than its ends are apart there is more, in the same cross-section
        shares = jnp.asarray(np.concatenate([volumes[i] for i in chosen]) / lengths**2 / stretch, stiffness.dtype)
        stiffness = stiffness * shares if stiffness.ndim < 2 else stiffness * shares[(None,) * (stiffness.ndim - 1)]
        damping = None if damping is None else as_real_quantity("damping", damping, at_least=0) * shares
    state = Particles(jnp.asarray(x, jnp.result_type(float)), jnp.zeros(x.shape, jnp.result_type(float)))
    total = as_real_quantity("mass [kg]", mass, above=0)
    springs = Springs(pairs, stiffness, rest, damping, breaks_at, nodes=len(x), yields_at=yields_at)
    node_mass = total * jnp.asarray(share / share.sum(), total.dtype)
    return Lattice(state, node_mass, springs, NodeSets(sets), faces, shape)


def _join_stiffness(kinds: list[tuple[np.ndarray, NestedArrayLike]]) -> Array:
    """The stiffness of each spring [N/m]; a number as given where there is one kind, which keeps it a scalar."""
    numbers = [as_real_quantity("stiffness [N/m]", stiffness, at_least=0) for _, stiffness in kinds]
    if len(kinds) == 1:
        return numbers[0]
    for number in numbers:
        if number.ndim and number.shape[-1] != 1:
            raise ValueError(
                f"stiffness [N/m]: got shape {number.shape}, expected a number, or (*scenes, 1) for a sweep."
            )
    scenes = jnp.broadcast_shapes(*(number.shape[:-1] for number in numbers))
    parts = [jnp.broadcast_to(n, (*scenes, len(pairs))) for n, (pairs, _) in zip(numbers, kinds, strict=True)]
    return jnp.concatenate(parts, axis=-1)


def vector_lengths(v: np.ndarray) -> np.ndarray:
    """Lengths of vectors, component last."""
    return np.sqrt(np.sum(v * v, axis=-1))
