"""Nodes with their masses and springs put together: what every rope, sheet and bridge is returned as."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from physjax.checks import as_real_quantity
from physjax.particles import Particles
from physjax.physics.springs.springs import Springs
from physjax.physics.springs.wind import Cells, Triangles, Wind


class Lattice(NamedTuple):
    """Nodes at rest, the mass of each [kg], the springs between them, named sets of nodes, and faces for drawing.

    `nodes` are boolean masks by name; `faces` `(faces, 3)` are triangles of nodes. `shape` is that of a lattice, such
    as (rows, columns); None for a mesh.

    Example:
        >>> sheet.shape, np.flatnonzero(sheet.nodes["left"]).tolist()
        ((3, 3), [0, 3, 6])
    """

    state: Particles
    mass: Any
    springs: Springs
    nodes: dict[str, np.ndarray]
    faces: np.ndarray
    shape: tuple[int, ...] | None

    def wind(
        self,
        velocity: Any,
        density: ArrayLike = 1.225,
        normal: ArrayLike = 1.2,
        tangential: ArrayLike | None = 0.05,
    ) -> Wind:
        """The force of the air on the faces, moving with `velocity` [m/s]; see `Wind`."""
        if len(self.faces) == 0 or self.state.position.shape[-1] != 3:
            raise ValueError(
                "wind: this lattice has no faces in space to blow on; for points there is forces.QuadraticDrag."
            )
        cells = self.shape is not None and len(self.shape) == 2
        surface = Cells(*self.shape) if cells else Triangles(self.faces, self.state.lanes[-1])
        return Wind(surface, velocity, density, normal, tangential)


def build_lattice(x, kinds, damping, breaks_at, mass, share, sets, faces, shape, stretch=1.0) -> Lattice:
    """The lattice of nodes at x with those kinds of springs that have a stiffness."""
    present = [(pairs, stiffness) for pairs, stiffness in kinds if stiffness is not None and len(pairs)]
    if not present:
        raise ValueError("lattice: got no stiffness, expected at least that of the structural springs.")
    pairs = np.concatenate([pairs for pairs, _ in present])
    rest = vector_lengths(x[pairs[:, 0]] - x[pairs[:, 1]]) * stretch
    state = Particles(jnp.asarray(x, jnp.result_type(float)), jnp.zeros(x.shape, jnp.result_type(float)))
    mass = as_real_quantity("mass [kg]", mass, above=0)
    springs = Springs(pairs, _join_stiffness(present), rest, damping, breaks_at, nodes=len(x))
    share = jnp.asarray(share / share.sum(), mass.dtype)
    return Lattice(state, mass * share, springs, sets, faces, shape)


def _join_stiffness(kinds: list[tuple[np.ndarray, Any]]) -> Any:
    """The stiffness of each spring; a number alone where there is only one kind."""
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
    """Lengths of vectors, the component last."""
    return np.sqrt(np.sum(v * v, axis=-1))
