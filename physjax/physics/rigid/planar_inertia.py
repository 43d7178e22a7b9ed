"""Mass and moment of inertia of bodies in the plane, in closed forms: disc, plate, segment, capsule, polygon."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.checks import NestedArrayLike, Numbers, as_real_quantity, quantity
from physjax.physics.rigid.polygon_corners import demand_convex_corners
from physjax.tracebacks import Module


class PlanarInertia(Module):
    """Mass [kg] and moment of inertia about the center of mass [kg m²] of bodies in the plane, one for all or per lane.

    Example:
        >>> wheel = inertia.planar_disc(2.0, radius=3.0)
        >>> float(wheel.mass), float(wheel.moment)
        (2.0, 9.0)
    """

    mass: Numbers = quantity("mass", "kg", above=0)
    moment: Numbers = quantity("moment of inertia", "kg m²", above=0)

    def validate(self, lanes: tuple[int, ...], dtype: np.dtype) -> "PlanarInertia":
        """The inertia of bodies in lanes of this shape, its numbers in this dtype; a ValueError where they do not fit."""
        for name, number in (("mass", self.mass), ("moment", self.moment)):
            if number.shape not in ((), lanes):
                raise ValueError(
                    f"PlanarInertia: got {name} of shape {number.shape}, expected () or the lanes {lanes}."
                )
        return PlanarInertia(self.mass.astype(dtype), self.moment.astype(dtype))


class PlanarSolid(NamedTuple):
    """An inertia, and its center of mass [m] in the coordinates in which the body was given.

    Example:
        >>> tile = inertia.planar_polygon(1.0, [[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])
        >>> tile.center.tolist()
        [1.0, 1.0]
    """

    inertia: PlanarInertia
    center: Array


def planar_disc(mass: ArrayLike, radius: ArrayLike) -> PlanarInertia:
    """A disc: I = m r²/2.

    Example:
        >>> float(inertia.planar_disc(4.0, radius=0.5).moment)
        0.5
    """
    return _build_inertia(mass, as_real_quantity("radius [m]", radius, above=0.0) ** 2 / 2)


def planar_plate(mass: ArrayLike, size: NestedArrayLike) -> PlanarInertia:
    """A rectangle with sides a, b [m]: I = m (a² + b²)/12.

    Example:
        >>> float(inertia.planar_plate(12.0, (1.0, 2.0)).moment)
        5.0
    """
    size = as_real_quantity("size [m]", size, above=0.0)
    if size.shape[-1:] != (2,):
        raise ValueError(f"size [m]: got the shape {size.shape}, expected two sides, (2,) or (*lanes, 2).")
    return _build_inertia(mass, (size[..., 0] ** 2 + size[..., 1] ** 2) / 12)


def planar_segment(mass: ArrayLike, length: ArrayLike) -> PlanarInertia:
    """A thin straight rod: I = m l²/12.

    Example:
        >>> float(inertia.planar_segment(3.0, length=2.0).moment)
        1.0
    """
    return _build_inertia(mass, as_real_quantity("length [m]", length, above=0.0) ** 2 / 12)


def planar_capsule(mass: ArrayLike, radius: ArrayLike, length: ArrayLike) -> PlanarInertia:
    """A rectangle of a `length` [m] between two half discs, of uniform density.

    With their areas 2rl and πr² as shares of the mass: I = m/(2l + πr) [2l (l² + 4r²)/12 + πr (r²/2 + l²/4 + 4rl/3π)].

    Example:
        >>> round(float(inertia.planar_capsule(1.0, radius=1.0, length=1e-9).moment), 6)
        0.5
    """
    r, l = as_real_quantity("radius [m]", radius, above=0.0), as_real_quantity("length [m]", length, above=0.0)  # noqa: E741
    plate, ends = 2 * l, np.pi * r
    # half a disc has its center of mass 4r/3π from the straight side
    moment = plate * (l**2 + 4 * r**2) / 12 + ends * (r**2 / 2 + l**2 / 4) + 4 / 3 * r**2 * l
    return _build_inertia(mass, moment / (plate + ends))


def planar_polygon(mass: ArrayLike, corners: NestedArrayLike) -> PlanarSolid:
    """A convex polygon of uniform density with these corners [m], `(corners, 2)` anticlockwise, by the shoelace moments.

    Example:
        >>> square = inertia.planar_polygon(6.0, [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        >>> round(float(square.inertia.moment), 6)
        1.0
    """
    corners = as_real_quantity("corners [m]", corners)
    demand_convex_corners(corners)
    middle = jnp.mean(corners, axis=0)  # far from the origin the sums would cancel
    a = corners - middle[None]
    b = jnp.roll(a, -1, axis=0)
    area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    center = jnp.sum(area[:, None] * (a + b), axis=0) / (3 * jnp.sum(area))
    about = jnp.sum(area * jnp.sum(a * a + a * b + b * b, axis=-1)) / (6 * jnp.sum(area))
    return PlanarSolid(_build_inertia(mass, about - jnp.sum(center**2)), middle + center)


def _build_inertia(mass: ArrayLike, per_kilogram: Array) -> PlanarInertia:
    mass = as_real_quantity("mass [kg]", mass, above=0.0)
    return PlanarInertia(mass, mass * per_kilogram)


__all__ = [
    "PlanarInertia",
    "PlanarSolid",
    "planar_capsule",
    "planar_disc",
    "planar_plate",
    "planar_polygon",
    "planar_segment",
]
