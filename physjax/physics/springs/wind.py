"""Air on the faces of a sheet: what makes a flag fly."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.backend import block_fusion, materialise
from physjax.checks import quantity
from physjax.particles import Particles
from physjax.parts import Force
from physjax.physics.springs.topology import rank_in_group, take
from physjax.vectors import broadcast_vector, cross, dot, norm, scale, unit


class Cells:
    """The cells of a sheet of rows × columns nodes, found by shifted slices; their four corners carry a quarter each.

    The sheet is thought to go on for one more row and column on every side, folded up to nothing, so that every node
    has four cells; those without area feel nothing.
    """

    def __init__(self, rows: int, columns: int):
        self.rows, self.columns = rows, columns

    def __eq__(self, other: Any) -> bool:
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
        """The cells' forces shared among their corners, `(*scenes, nodes, 3)`."""
        total = 0.25 * sum(self._slice_shifted(newtons, self.rows, self.columns))
        return total.reshape((*newtons.shape[:-3], self.nodes, newtons.shape[-1]))

    def _take_corners(self, a):
        sheet = a.reshape((*a.shape[:-2], self.rows, self.columns, a.shape[-1]))
        wide = jnp.pad(sheet, [(0, 0)] * (sheet.ndim - 3) + [(1, 1), (1, 1), (0, 0)], mode="edge")
        return self._slice_shifted(block_fusion(wide), self.rows + 1, self.columns + 1)

    def _slice_shifted(self, a, rows, columns):
        return [a[..., i : i + rows, j : j + columns, :] for i in (0, 1) for j in (0, 1)]


class Triangles:
    """The triangles of a mesh, found by gathering; their corners carry a third each. Compared by content."""

    def __init__(self, faces: np.ndarray, nodes: int):
        self.corners, self.nodes = faces.astype(np.int32), nodes
        place = rank_in_group(self.corners.ravel(), nodes)
        self.node_faces = np.full((int(place.max()) + 1, nodes), len(faces), np.int32)
        self.node_faces[place, self.corners.ravel()] = np.repeat(np.arange(len(faces)), 3)
        self._hash = hash((nodes, self.corners.tobytes()))

    def __eq__(self, other: Any) -> bool:
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
        """The triangles' forces shared among their corners, `(*scenes, nodes, 3)`."""
        shares = jnp.concatenate([newtons / 3, jnp.zeros_like(newtons[..., :1, :])], axis=-2)
        return sum(take(shares, faces) for faces in self.node_faces)


class Wind(Force):
    """Air on a sheet: F = ½ρA (C_n |u·n| (u·n) n + C_t |u| u_t) on each face of area A, shared among its corners.

    u is the air's velocity relative to the face, u·n its part along the face's normal, u_t what is left. `velocity`
    [m/s] is that of the air, `(3,)`; `density` ρ [kg/m³], `normal` C_n and `tangential` C_t [1]; C_t = None leaves the
    second part out. A flat plate across the wind has C_n = 1.1 to 1.3.
    """

    couples: ClassVar[bool] = True
    surface: Cells | Triangles = eqx.field(static=True)
    velocity: Float[Array, "..."] = quantity("wind", "m/s", kind="vector", per=None)
    density: Float[Array, "..."] = quantity("density of the air", "kg/m³", per=None, at_least=0, default=1.225)
    normal: Float[Array, "..."] = quantity("normal coefficient C_n", "1", per=None, at_least=0, default=1.2)
    tangential: Float[Array, "..."] | None = quantity(
        "tangential coefficient C_t", "1", per=None, at_least=0, default=None
    )

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*scenes nodes 3"]:
        """The wind's push on each node [N]."""
        if state.position.shape[-2:] != (self.surface.nodes, 3):
            raise ValueError(
                f"Wind: got positions of shape {state.position.shape}, expected (*scenes, {self.surface.nodes}, 3): the "
                "nodes of the sheet that it was made for."
            )
        # each node looks at several faces: apart, or their forces would be computed anew for every one of them
        return self.surface.sum_at_nodes(materialise(t, lambda: self._compute_face_forces(state)))

    def _compute_face_forces(self, state: Particles) -> Array:
        """The force on each face [N]."""
        area, velocity = self.surface.faces(*state)
        air = broadcast_vector(self.velocity, velocity) - velocity
        outward = unit(area)
        through = dot(air, outward)
        push = scale(self.normal * jnp.abs(through) * through, outward)
        if self.tangential is not None:
            push = push + scale(self.tangential * norm(air), air - scale(through, outward))
        return scale(0.5 * self.density * norm(area), push)
