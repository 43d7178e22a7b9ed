"""The aerodynamic force of the wind on the faces of a sheet."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.backend import materialise
from physjax.checks import Numbers, OptionalNumbers, quantity
from physjax.particles import Particles, sum_terms
from physjax.parts import Force
from physjax.physics.springs.neighbours import rank_in_group, take
from physjax.vectors import broadcast_vector, cross, dot, norm, scale, unit


class Cells:
    """The cells of a sheet of rows × columns nodes, by shifted slices; each of the four corners gets a quarter of a force.

    Around the sheet there are cells without force, so that every node has four.
    """

    def __init__(self, rows: int, columns: int):
        self.rows, self.columns = rows, columns

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Cells) and (self.rows, self.columns) == (other.rows, other.columns)

    def __hash__(self) -> int:
        return hash((self.rows, self.columns))

    @property
    def nodes(self) -> int:
        """The number of nodes."""
        return self.rows * self.columns

    def faces(self, x: Array, v: Array) -> tuple[Array, Array]:
        """Area vector [m²] and velocity [m/s] of each cell."""
        a, b, c, d = self._take_corners(x)
        p, q, r, s = self._take_corners(v)
        return 0.5 * cross(d - a, b - c), 0.25 * (p + q + r + s)

    def sum_at_nodes(self, newtons: Array) -> Array:
        """The forces of the cells [N] distributed to their corners, `(*scenes, nodes, 3)`."""
        wide = jnp.pad(newtons, [(0, 0)] * (newtons.ndim - 3) + [(1, 1), (1, 1), (0, 0)])
        total = 0.25 * sum_terms(self._slice_shifted(wide, self.rows, self.columns))
        return total.reshape((*newtons.shape[:-3], self.nodes, newtons.shape[-1]))

    def _take_corners(self, a: Array) -> list[Array]:
        """The vectors at the four corners of each cell: upper left, upper right, lower left, lower right."""
        sheet = a.reshape((*a.shape[:-2], self.rows, self.columns, a.shape[-1]))
        return self._slice_shifted(sheet, self.rows - 1, self.columns - 1)

    def _slice_shifted(self, a: Array, rows: int, columns: int) -> list[Array]:
        """The four windows of a size in a sheet, shifted by one row and one column."""
        return [a[..., i : i + rows, j : j + columns, :] for i in (0, 1) for j in (0, 1)]


class Triangles:
    """The triangles of a mesh, by gathering; each corner gets a third of a force. Compared by content."""

    def __init__(self, faces: np.ndarray, nodes: int):
        self.corners, self.nodes = faces.astype(np.int32), nodes
        place = rank_in_group(self.corners.ravel(), nodes)
        self.node_faces = np.full((int(place.max()) + 1, nodes), len(faces), np.int32)
        self.node_faces[place, self.corners.ravel()] = np.repeat(np.arange(len(faces)), 3)
        self._hash = hash((nodes, self.corners.tobytes()))

    def __eq__(self, other: object) -> bool:
        return self is other or (
            isinstance(other, Triangles) and self.nodes == other.nodes and np.array_equal(self.corners, other.corners)
        )

    def __hash__(self) -> int:
        return self._hash

    def faces(self, x: Array, v: Array) -> tuple[Array, Array]:
        """Area vector [m²] and velocity [m/s] of each triangle."""
        a, b, c = (take(x, self.corners[:, i]) for i in range(3))
        p, q, r = (take(v, self.corners[:, i]) for i in range(3))
        return 0.5 * cross(b - a, c - a), (p + q + r) / 3

    def sum_at_nodes(self, newtons: Array) -> Array:
        """The forces of the triangles [N] distributed to their corners, `(*scenes, nodes, 3)`."""
        # gathered by node instead of scattered by face: row `len(faces)` is the zero for nodes with fewer faces
        shares = jnp.concatenate([newtons / 3, jnp.zeros_like(newtons[..., :1, :])], axis=-2)
        return sum_terms([take(shares, faces) for faces in self.node_faces])


class Wind(Force):
    """Wind on a sheet: F = ½ρA (C_n |u·n| (u·n) n + C_t |u| u_t) on each face of area A, distributed to its corners.

    u is the velocity of the air relative to the face, n the normal of the face and u_t the tangential part of u.
    `velocity` [m/s] of the air is `(3,)`; `density` ρ [kg/m³], coefficients `normal` C_n and `tangential` C_t [1]. With
    C_t = None there is no tangential term. A flat plate normal to the wind has C_n = 1.1 to 1.3.
    """

    couples: ClassVar[bool] = True
    surface: Cells | Triangles = eqx.field(static=True)
    velocity: Numbers = quantity("wind", "m/s", kind="vector", per=None)
    density: Numbers = quantity("density of the air", "kg/m³", per=None, at_least=0, default=1.225)
    normal: Numbers = quantity("normal coefficient C_n", "1", per=None, at_least=0, default=1.2)
    tangential: OptionalNumbers = quantity("tangential coefficient C_t", "1", per=None, at_least=0, default=None)

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*scenes nodes 3"]:
        """The force of the air on each node [N]."""
        if state.position.shape[-2:] != (self.surface.nodes, 3):
            raise ValueError(
                f"Wind: got positions of shape {state.position.shape}, expected (*scenes, {self.surface.nodes}, 3): the "
                "nodes of the sheet that it was made for."
            )
        # every node reads several faces: not materialised, the force of a face would be computed for each of its corners
        return self.surface.sum_at_nodes(materialise(t, lambda: self._compute_face_forces(state)))

    def _compute_face_forces(self, state: Particles) -> Array:
        """The force on each face [N]."""
        area, velocity = self.surface.faces(*state)
        air = broadcast_vector(self.velocity, velocity) - velocity
        normal = unit(area)
        through = dot(air, normal)
        push = scale(self.normal * jnp.abs(through) * through, normal)
        if self.tangential is not None:
            push = push + scale(self.tangential * norm(air), air - scale(through, normal))
        return scale(0.5 * self.density * norm(area), push)
