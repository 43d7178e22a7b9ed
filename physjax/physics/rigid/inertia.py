"""Mass, principal moments and axes of the usual solids, of point masses, of closed meshes, and of their composites.

Closed forms may be traced, swept and differentiated. A full tensor is diagonalised once, on the host in double precision.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float
from numpy.linalg import eigh

from physjax.checks import Numbers, as_real_quantity, concrete_or_none, demand_all, unchecked_quantity
from physjax.meshes import check_mesh
from physjax.physics.rigid.inertia_tensors import (
    demand_closed,
    find_quaternion,
    read_on_host,
    shift_inertia,
    turn_tensor,
)
from physjax.physics.rigid.planar_inertia import (
    PlanarInertia,
    PlanarSolid,
    planar_capsule,
    planar_disc,
    planar_plate,
    planar_polygon,
    planar_segment,
)
from physjax.tracebacks import Module
from physjax.vectors import components, dot, scale

FLAT_VOLUME_SHARE = 1e-12
"""Share of the tetrahedra's volumes below which their sum is rounding, and a mesh encloses nothing."""


class Inertia(Module):
    """Mass [kg] and principal moments of inertia about the center of mass [kg m²]: the `mass=` of a scene of rigid bodies.

    `mass` is a scalar or per lane, `principal` `(3,)` or `(*lanes, 3)`, `axes` a quaternion from the principal axes to
    the body frame, None where they are the same. A line has no moment about itself and cannot spin about it. `about` puts
    a body on a fixed pivot. Raises a ValueError for moments that no body can have.

    Example:
        >>> Scene(body, mass=Inertia(mass=12.0, principal=(13.0, 10.0, 5.0))).mass.principal.tolist()
        [13.0, 10.0, 5.0]
    """

    mass: Numbers = unchecked_quantity("mass", "kg", above=0)
    principal: Float[Array, "*lanes 3"] = unchecked_quantity("principal moments", "kg m²", kind="vector", at_least=0)
    axes: Float[Array, "*lanes 4"] | None = unchecked_quantity("axes", kind="rotation")
    arm: Float[Array, "*lanes 3"] | None = unchecked_quantity("arm of the pivot", "m", kind="vector")
    pivot: Float[Array, "*lanes 3"] | None = unchecked_quantity("pivot", "m", kind="place")

    def __init__(self, mass: ArrayLike, principal: ArrayLike | Sequence, axes: ArrayLike | Sequence | None = None):
        self.mass = as_real_quantity("mass [kg]", mass, above=0.0)
        self.principal = _check_moments(principal)
        self.axes = None if axes is None else check_quaternion("axes", axes)
        self.arm = self.pivot = None

    @property
    def inverse(self) -> Float[Array, "*lanes 3"]:
        """1/I about each principal axis [1/(kg m²)]; zero where there is no moment."""
        # a moment that is not there counts as infinite: the inverse is zero, and so are all derivatives
        return 1 / jnp.where(self.principal > 0, self.principal, jnp.inf)

    @property
    def tensor(self) -> np.ndarray:
        """The full tensor in the body frame [kg m²], `(*lanes, 3, 3)`, about the center of mass or the pivot."""
        (principal,) = read_on_host("tensor", self.principal)
        tensor = principal[..., None] * np.eye(3)
        if self.axes is None:
            return tensor
        (axes,) = read_on_host("axes", self.axes)
        return turn_tensor(axes, tensor)

    def about(self, point: ArrayLike | Sequence) -> "Inertia":
        """The same body on a fixed pivot: a `point` [m] of it, in its frame, from its center of mass.

        The moments are then those about the pivot, by the parallel-axis theorem. The pivot is where that point is when a
        scene starts, and stays there. A point on a principal axis with Python zeros elsewhere, (0, 0, l), may be traced;
        any other is computed on the host.
        """
        if self.arm is not None:
            raise ValueError("about: got an inertia with a pivot, expected one about the center of mass.")
        parts = _split_components("pivot [m]", point)
        away = [i for i, part in enumerate(parts) if concrete_or_none(part) is None or np.any(concrete_or_none(part))]
        point = jnp.stack(jnp.broadcast_arrays(*parts), axis=-1)
        if self.axes is None and len(away) <= 1:
            square = self.mass * dot(point, point)
            more = [jnp.zeros_like(square) if [i] == away else square for i in range(3)]
            body = Inertia(self.mass, sum(jnp.broadcast_arrays(self.principal, jnp.stack(more, axis=-1))))
        else:
            body = of_tensor(self.mass, self.tensor + shift_inertia(*read_on_host("pivot", self.mass, point)))
        return eqx.tree_at(lambda body: body.arm, body, -point, is_leaf=lambda leaf: leaf is None)

    def validate(self, lanes: tuple[int, ...], dtype: np.dtype) -> "Inertia":
        """The inertia of bodies in lanes of this shape, its numbers in this dtype; a ValueError where they do not fit."""
        parts = {"mass": self.mass, "principal": self.principal, "axes": self.axes, "arm": self.arm}
        for (name, array), width in zip(parts.items(), ((), (3,), (4,), (3,)), strict=True):
            if array is not None and array.shape not in (width, (*lanes, *width)):
                raise ValueError(f"Inertia: got {name} of shape {array.shape}, expected {width} or {(*lanes, *width)}.")
        numbers = [None if array is None else array.astype(dtype) for array in parts.values()]
        return eqx.tree_at(
            lambda i: (i.mass, i.principal, i.axes, i.arm), self, numbers, is_leaf=lambda leaf: leaf is None
        )

    def place_pivot(self, pivot: Float[Array, "*lanes 3"]) -> "Inertia":
        """The inertia with its pivot at a place in the world [m]."""
        return eqx.tree_at(lambda i: i.pivot, self, pivot, is_leaf=lambda leaf: leaf is None)


class Solid(NamedTuple):
    """An inertia, and its center of mass [m] in the coordinates in which the body was given.

    Example:
        >>> pair = inertia.points([1.0, 3.0], [[0.0, 0.0, 0.0], [4.0, 0.0, 0.0]])
        >>> isinstance(pair, inertia.Solid), pair.center.tolist()
        (True, [3.0, 0.0, 0.0])
    """

    inertia: Inertia
    center: np.ndarray


# closed forms


def box(mass: ArrayLike, size: ArrayLike | Sequence) -> Inertia:
    """A box with edges a, b, c [m] along the axes: I = m/12 (b² + c², c² + a², a² + b²).

    Example:
        >>> inertia.box(12.0, (1.0, 2.0, 3.0)).principal.tolist()
        [13.0, 10.0, 5.0]
    """
    size = as_real_quantity("size [m]", size, above=0.0)
    if size.shape[-1:] != (3,):
        raise ValueError(f"size [m]: got the shape {size.shape}, expected three edges, (3,) or (*lanes, 3).")
    a, b, c = jnp.moveaxis(size**2, -1, 0)
    return _build_inertia(mass, 1 / 12, b + c, c + a, a + b)


def sphere(mass: ArrayLike, radius: ArrayLike, *, hollow: bool = False) -> Inertia:
    """A ball: I = 2/5 m r²; a thin shell: 2/3 m r².

    Example:
        >>> inertia.sphere(5.0, radius=2.0).principal.tolist()
        [8.0, 8.0, 8.0]
    """
    square = as_real_quantity("radius [m]", radius, above=0.0) ** 2
    return _build_inertia(mass, 2 / 3 if hollow else 2 / 5, square, square, square)


def cylinder(mass: ArrayLike, radius: ArrayLike, length: ArrayLike, *, axis: int = 2) -> Inertia:
    """A cylinder along an axis of its frame (2: z): I = m r²/2 about it, m (3r² + l²)/12 across.

    Example:
        >>> inertia.cylinder(12.0, radius=1.0, length=3.0).principal.tolist()
        [12.0, 12.0, 6.0]
    """
    radius, length = (
        as_real_quantity("radius [m]", radius, above=0.0),
        as_real_quantity("length [m]", length, above=0.0),
    )
    return _build_axial(mass, axis, radius**2 / 2, (3 * radius**2 + length**2) / 12)


def rod(mass: ArrayLike, length: ArrayLike, *, axis: int = 2) -> Inertia:
    """A thin rod along an axis of its frame: I = m l²/12 across, none about itself.

    Example:
        >>> inertia.rod(3.0, length=2.0).principal.tolist()
        [1.0, 1.0, 0.0]
    """
    length = as_real_quantity("length [m]", length, above=0.0)
    return _build_axial(mass, axis, 0.0 * length, length**2 / 12)


def capsule(mass: ArrayLike, radius: ArrayLike, length: ArrayLike, *, axis: int = 2) -> Inertia:
    """A cylinder of a `length` [m] between two hemispheres, of uniform density.

    With their shares of the mass, s = 4r/(3l + 4r) and 1 - s: I = (1 - s) m r²/2 + s m 2r²/5 about the axis, (1 - s)
    m (3r² + l²)/12 + s m (2r²/5 + l²/4 + 3lr/8) across.

    Example:
        >>> print(inertia.capsule(7.0, radius=1.0, length=1.0).principal)
        [5.1 5.1 3.1]
    """
    r, l = as_real_quantity("radius [m]", radius, above=0.0), as_real_quantity("length [m]", length, above=0.0)  # noqa: E741
    s = 4 * r / (3 * l + 4 * r)
    about = (1 - s) * r**2 / 2 + s * 2 * r**2 / 5
    across = (1 - s) * (3 * r**2 + l**2) / 12 + s * (2 * r**2 / 5 + l**2 / 4 + 3 * l * r / 8)
    return _build_axial(mass, axis, about, across)


# from a full tensor


def of_tensor(mass: ArrayLike, tensor: ArrayLike | Sequence) -> Inertia:
    """The inertia of a full symmetric tensor in the body frame [kg m²], `(3, 3)` or per lane; diagonalised on the host.

    Example:
        >>> print(inertia.of_tensor(1.0, [[2.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 3.0]]).principal)
        [1. 3. 3.]
    """
    (tensor,) = read_on_host("tensor", tensor)
    if tensor.shape[-2:] != (3, 3):
        raise ValueError(f"tensor [kg m²]: got shape {tensor.shape}, expected (3, 3) or (*lanes, 3, 3).")
    size = np.abs(tensor).max(axis=(-2, -1), keepdims=True)
    rounding = 64 * np.finfo(float).eps * size
    if not np.isfinite(tensor).all() or (np.abs(tensor - np.swapaxes(tensor, -2, -1)) > rounding).any():
        raise ValueError(
            f"tensor [kg m²]: got {tensor.tolist()}, expected finite numbers, symmetric about the diagonal."
        )
    if (np.abs(tensor * (1 - np.eye(3))) <= rounding).all():
        return Inertia(mass, np.diagonal(tensor, axis1=-2, axis2=-1))
    principal, columns = eigh(tensor)
    # eigenvectors come with any sign; a quaternion needs a right-handed frame
    right_handed = np.sign(np.sum(columns[..., 0] * np.cross(columns[..., 1], columns[..., 2]), axis=-1))
    principal = np.where(np.abs(principal) <= rounding[..., 0], 0.0, principal)
    return Inertia(mass, principal, find_quaternion(columns * right_handed[..., None, None]))


def points(masses: ArrayLike | Sequence, positions: ArrayLike | Sequence) -> Solid:
    """Point masses [kg] `(n,)` held together at positions [m] `(n, 3)`: I = Σ m (|r|² 1 - r rᵀ).

    Example:
        >>> cross = [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, -2.0, 0.0]]
        >>> print(np.sort(inertia.points(np.ones(4), cross).inertia.principal))
        [ 2.  8. 10.]
    """
    masses, positions = read_on_host("points", as_real_quantity("masses [kg]", masses, above=0.0), positions)
    if positions.ndim != 2 or positions.shape != (masses.size, 3) or masses.ndim != 1:
        raise ValueError(
            f"points: got masses {masses.shape} and positions {positions.shape}, expected (n,) and (n, 3)."
        )
    center = np.sum(masses[:, None] * positions, axis=0) / masses.sum()
    return Solid(of_tensor(masses.sum(), shift_inertia(masses, positions - center).sum(axis=0)), center)


def mesh(
    vertices: ArrayLike | Sequence,
    faces: ArrayLike | Sequence,
    *,
    mass: float | None = None,
    density: float | None = None,
) -> Solid:
    """A solid inside a closed surface of triangles, by the divergence theorem; give its mass [kg] or density [kg/m³].

    Exact for the polyhedron: a sum over the tetrahedra between each face and a point. `meshes.read_mesh` reads vertices
    [m] and faces from a file. Raises a ValueError for a mesh that is open, or whose faces are not oriented alike.

    Example:
        >>> corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        >>> solid = inertia.mesh(corners, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], density=6.0)
        >>> round(float(solid.inertia.mass), 3), solid.center.round(3).tolist()
        (1.0, [0.25, 0.25, 0.25])
    """
    if (mass is None) == (density is None):
        raise ValueError("mesh: expected either mass= [kg] or density= [kg/m³].")
    vertices, faces = check_mesh(vertices, faces)
    demand_closed(faces)
    # the point is in the middle of the vertices: far from the origin the sum would cancel
    middle = vertices.mean(axis=0)
    a, b, c = (vertices[faces[:, i]] - middle for i in range(3))
    volume = np.sum(a * np.cross(b, c), axis=-1) / 6
    whole = volume.sum()
    if abs(whole) <= FLAT_VOLUME_SHARE * np.abs(volume).sum():
        raise ValueError(f"mesh: encloses a volume of {whole:g} m³, expected a body.")
    edges = np.stack([a, b, c, a + b + c])
    center = np.sum(volume[:, None] * edges[3], axis=0) / (4 * whole)
    second = np.sum(volume[:, None, None] / 20 * np.sum(edges[..., :, None] * edges[..., None, :], axis=0), axis=0)
    mass = abs(whole) * density if mass is None else mass
    (heavy,) = read_on_host("mass", as_real_quantity("mass [kg]", mass, above=0.0))
    second = heavy * (second / whole - center[:, None] * center)
    return Solid(of_tensor(heavy, np.trace(second) * np.eye(3) - second), middle + center)


def composite(parts: Iterable[tuple]) -> Solid:
    """Bodies joined rigidly: `(inertia, position)` or `(inertia, position, orientation)` each, by the parallel-axis theorem.

    Positions [m] of the centers of mass and orientations (quaternions) are in the frame of the whole.

    Example:
        >>> pair = inertia.composite([(inertia.sphere(5.0, 1.0), (0.0, 0.0, z)) for z in (-2.0, 2.0)])
        >>> print(pair.inertia.principal)
        [44. 44.  4.]
    """
    parts = list(parts)
    bodies, places = [part[0] for part in parts], [part[1] for part in parts]
    if not parts or any(not isinstance(body, Inertia) or body.arm is not None for body in bodies):
        raise ValueError("composite: expected (inertia, position) or (inertia, position, orientation) for each part.")
    masses, positions = read_on_host("composite", [float(body.mass) for body in bodies], places)
    center = np.sum(masses[:, None] * positions, axis=0) / masses.sum()
    whole = shift_inertia(masses, positions - center).sum(axis=0)
    for body, _, *orientation in parts:
        (q,) = read_on_host("orientation", check_quaternion("orientation", *(orientation or [(1.0, 0.0, 0.0, 0.0)])))
        whole = whole + turn_tensor(q, body.tensor)
    return Solid(of_tensor(masses.sum(), whole), center)


# checks, and building from a kilogram's moments


def check_quaternion(name: str, value: ArrayLike | Sequence) -> Float[Array, "*lanes 4"]:
    """A quaternion (w, x, y, z) scaled to length 1; a ValueError for zero, which is no rotation.

    Example:
        >>> print(inertia.check_quaternion("orientation", (3.0, 0.0, 0.0, 4.0)))
        [0.6 0.  0.  0.8]
    """
    q = as_real_quantity(name, value)
    if q.shape[-1:] != (4,):
        raise ValueError(f"{name}: got shape {q.shape}, expected a quaternion (w, x, y, z), (4,) or (*lanes, 4).")
    if concrete_or_none(q) is not None:
        demand_all(
            name,
            q,
            np.any(concrete_or_none(q) != 0, axis=-1, keepdims=True) | np.zeros(q.shape, bool),
            "a quaternion not zero",
        )
    return scale(1 / jnp.sqrt(dot(q, q)), q)


def _split_components(name: str, vector: ArrayLike | Sequence) -> list[Array]:
    """The components of a vector one by one: in a tuple of three, each may be traced or not."""
    if isinstance(vector, list | tuple) and not isinstance(vector[0], list | tuple):
        parts = [as_real_quantity(name, part) for part in vector]
    else:
        parts = components(as_real_quantity(name, vector))
    if len(parts) != 3:
        raise ValueError(f"{name}: got {len(parts)} components, expected 3.")
    return parts


def _check_moments(value: ArrayLike | Sequence) -> Float[Array, "*lanes 3"]:
    """Principal moments that a body can have: none negative, none greater than the sum of the others."""
    principal = as_real_quantity("principal moments [kg m²]", value, at_least=0.0)
    if principal.shape[-1:] != (3,):
        raise ValueError(f"principal moments [kg m²]: got shape {principal.shape}, expected (3,) or (*lanes, 3).")
    values = concrete_or_none(principal)
    if values is not None:
        rounding = 1 + 64 * np.finfo(values.dtype).eps
        good = (2 * values.max(axis=-1) <= rounding * values.sum(axis=-1)) & (values.max(axis=-1) > 0)
        if not good.all():
            raise ValueError(
                f"principal moments [kg m²]: got {values[~good].reshape(-1, 3)[0].tolist()}, expected none greater than "
                "the sum of the other two (the triangle inequality), and not all zero: no body has such moments."
            )
    return principal


def _build_inertia(mass: ArrayLike, factor: float, *moments: Array) -> Inertia:
    """The inertia with `factor` times the mass [kg] times these moments per kilogram [m²]."""
    mass = as_real_quantity("mass [kg]", mass, above=0.0)
    return Inertia(
        mass,
        scale(factor * mass, jnp.stack(moments, axis=-1))
        if mass.ndim == 0
        else jnp.stack([factor * mass * m for m in moments], axis=-1),
    )


def _build_axial(mass: ArrayLike, axis: int, about: Array, across: Array) -> Inertia:
    """The inertia with these moments per kilogram [m²] about an axis of the body frame and across it."""
    if axis not in (0, 1, 2):
        raise ValueError(
            f"axis: got {axis!r}, expected 0, 1 or 2: the axis of the body's frame that the shape is along."
        )
    return _build_inertia(mass, 1.0, *(about if i == axis else across for i in range(3)))


__all__ = [
    "Inertia",
    "PlanarInertia",
    "PlanarSolid",
    "Solid",
    "box",
    "capsule",
    "composite",
    "cylinder",
    "mesh",
    "of_tensor",
    "planar_capsule",
    "planar_disc",
    "planar_plate",
    "planar_polygon",
    "planar_segment",
    "points",
    "rod",
    "sphere",
]


def __dir__() -> list[str]:
    return __all__
