"""Sources of particles: each is a shape that is sampled uniformly by three uniform numbers from 0 to 1.

A source is called with numbers `(*lanes, 3)` and returns the position [m] and the outward normal there, both `(*lanes,
dim)`. Its parameters can be swept and differentiated: the positions move with them.

Births have the same bits in every program: products are rounded (`force_rounding`) before they are added, since compilers
fuse the two to one operation in some programs and not in others.
"""

import math
from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from physjax.checks import Numbers, concrete_or_none, demand_all, demand_direction, quantity
from physjax.loops import force_rounding
from physjax.tracebacks import Module
from physjax.vectors import broadcast_vector, components, scale, stack_components, turn_left


class Source(Module):
    """A shape that particles are born from.

    Example:
        >>> isinstance(emitters.Point((0.0, 0.0)), emitters.Source)
        True
    """

    @property
    @abstractmethod
    def dim(self) -> int:
        """Components of a place: 2 in the plane, 3 in space."""

    @abstractmethod
    def __call__(self, u: Float[Array, "*lanes 3"]) -> tuple[Float[Array, "*lanes dim"], Float[Array, "*lanes dim"]]:
        """Place [m] and outward direction for uniform numbers."""


class Point(Source):
    """A point, with isotropic directions.

    Example:
        >>> place, outward = emitters.Point((1.0, 2.0))(jnp.array([0.1, 0.2, 0.3]))
        >>> print(place)
        [1. 2.]
    """

    at: Numbers = quantity("place of the source", "m", kind="place", per=None)

    @property
    def dim(self) -> int:
        """Components of the point."""
        return self.at.shape[-1]

    def __call__(self, u: Float[Array, "*lanes 3"]) -> tuple[Float[Array, "*lanes dim"], Float[Array, "*lanes dim"]]:
        """The point itself, and an isotropic direction."""
        outward = isotropic_direction(u, self.dim)
        return broadcast_vector(self.at, outward), outward


class Disc(Source):
    """A disc of a radius [m] with the given `normal`, sampled uniformly; in the plane a line as long as its diameter.

    Example:
        >>> disc = emitters.Disc((0.0, 0.0, 0.0), normal=(0.0, 0.0, 2.0), radius=2.0)
        >>> place, outward = disc(jnp.array([0.25, 0.0, 0.0]))
        >>> print(jnp.hypot(place[0], place[1]), outward)
        1.0 [0. 0. 1.]
    """

    center: Numbers = quantity("center of the disc", "m", kind="place", per=None)
    normal: Numbers = quantity("normal of the disc", "1", kind="vector", per=None)
    radius: Numbers = quantity("radius of the disc", "m", per=None, at_least=0)

    def __check_init__(self):
        demand_direction("normal of the disc", self.normal)

    @property
    def dim(self) -> int:
        """Components of the center."""
        return self.center.shape[-1]

    def __call__(self, u: Float[Array, "*lanes 3"]) -> tuple[Float[Array, "*lanes dim"], Float[Array, "*lanes dim"]]:
        """r = R √u₀ at the angle 2πu₁, and the normal."""
        normal = broadcast_vector(unit_direction(self.normal), u[..., : self.dim])
        if self.dim == 2:
            across = scale(2.0 * u[..., 0] - 1.0, turn_left(normal))
        else:
            across = scale(jnp.sqrt(u[..., 0]), unit_vector_around(normal, 2 * math.pi * u[..., 1]))
        return broadcast_vector(self.center, normal) + force_rounding(self.radius * force_rounding(across)), normal


class Box(Source):
    """The volume of a box between two corners [m], sampled uniformly, with isotropic directions.

    Example:
        >>> place, outward = emitters.Box((0.0, 0.0), (2.0, 4.0))(jnp.array([0.5, 0.25, 0.0]))
        >>> print(place)
        [1. 1.]
    """

    lower: Numbers = quantity("lower corner", "m", kind="place", per=None)
    upper: Numbers = quantity("upper corner", "m", kind="place", per=None)

    def __check_init__(self):
        lower, upper = concrete_or_none(self.lower), concrete_or_none(self.upper)
        if lower is not None and upper is not None:
            demand_all("upper corner [m]", self.upper, upper >= lower, f"at least the lower corner {lower}")

    @property
    def dim(self) -> int:
        """Components of a corner."""
        return self.lower.shape[-1]

    def __call__(self, u: Float[Array, "*lanes 3"]) -> tuple[Float[Array, "*lanes dim"], Float[Array, "*lanes dim"]]:
        """lower + u (upper - lower), and an isotropic direction."""
        share = u[..., : self.dim]
        # the position has used these numbers; their lower digits are uniform as well, and independent of it
        again = jnp.mod(4096.0 * u, 1.0)
        return broadcast_vector(self.lower, share) + force_rounding(
            broadcast_vector(self.upper - self.lower, share) * share
        ), isotropic_direction(again, self.dim)


class Sphere(Source):
    """A ball of a radius [m] (in the plane a disc), sampled uniformly; with `shell=True` its surface alone.

    Example:
        >>> place, outward = emitters.Sphere((0.0, 0.0, 0.0), radius=2.0, shell=True)(jnp.array([0.1, 0.2, 0.3]))
        >>> print(place / outward)
        [2. 2. 2.]
    """

    center: Numbers = quantity("center", "m", kind="place", per=None)
    radius: Numbers = quantity("radius", "m", per=None, at_least=0)
    shell: bool = eqx.field(static=True, default=False)

    @property
    def dim(self) -> int:
        """Components of the center."""
        return self.center.shape[-1]

    def __call__(self, u: Float[Array, "*lanes 3"]) -> tuple[Float[Array, "*lanes dim"], Float[Array, "*lanes dim"]]:
        """R ∛u₂ (in the plane R √u₂) along an isotropic direction, which is also the outward one."""
        outward = isotropic_direction(u, self.dim)
        share = jnp.ones_like(u[..., 2]) if self.shell else u[..., 2] ** (1 / self.dim)
        return broadcast_vector(self.center, outward) + force_rounding(
            self.radius * force_rounding(scale(share, outward))
        ), outward


class Mesh(Source):
    """The surface of a triangle mesh, sampled uniformly: `vertices` `(n, 3)` [m], `faces` `(m, 3)`, outward by their winding.

    Raises ValueError for other shapes and for indices that are out of range.

    Example:
        >>> triangle = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        >>> place, outward = emitters.Mesh(triangle, np.array([[0, 1, 2]]))(jnp.array([0.5, 0.25, 0.5]))
        >>> print(place, outward)
        [0.5  0.25 0.  ] [0. 0. 1.]
    """

    vertices: Float[Array, "1 n 3"]
    faces: Int[Array, "1 m 3"]

    def __init__(self, vertices: Array | np.ndarray, faces: Array | np.ndarray):
        vertices, faces = jnp.asarray(vertices), np.asarray(faces)
        if vertices.ndim != 2 or vertices.shape[-1] != 3 or faces.ndim != 2 or faces.shape[-1] != 3 or not faces.size:
            raise ValueError(
                f"Mesh: got vertices {vertices.shape} and faces {faces.shape}, expected (n, 3) and (m, 3) triangles."
            )
        if faces.min() < 0 or faces.max() >= vertices.shape[0]:
            raise ValueError(
                f"Mesh: got faces that name vertices {faces.min()} to {faces.max()}, expected 0 to {vertices.shape[0] - 1}."
            )
        # an axis in front, so that no list of faces is mistaken for one of lanes
        self.vertices, self.faces = vertices[None], jnp.asarray(faces, jnp.int32)[None]

    @property
    def dim(self) -> int:
        """Always 3."""
        return 3

    def __call__(self, u: Float[Array, "*lanes 3"]) -> tuple[Float[Array, "*lanes dim"], Float[Array, "*lanes dim"]]:
        """A face by its share of the area, then a + (1 - √u₁)(b - a) + √u₁u₂(c - a) in it; and the face's normal."""
        corner = [jnp.take(self.vertices[0], self.faces[0, :, i], axis=0) for i in range(3)]
        normal = _cross(corner[1] - corner[0], corner[2] - corner[0])
        upto = jnp.cumsum(_length(normal))
        face = jnp.searchsorted(upto, u[..., 0] * upto[-1], side="right")
        face = jnp.minimum(face, self.faces.shape[1] - 1).astype(jnp.int32)
        a, b, c, outward = (jnp.take(each, face, axis=0) for each in (*corner, unit_direction(normal)))
        root = jnp.sqrt(u[..., 1])
        return a + force_rounding(scale(1 - root, b - a)) + force_rounding(scale(root * u[..., 2], c - a)), outward


def isotropic_direction(u: Float[Array, "*lanes 3"], dim: int) -> Float[Array, "*lanes dim"]:
    """An isotropic direction: by Archimedes' hat-box theorem cos θ = 1 - 2u₁ is uniform on the sphere."""
    angle = 2 * math.pi * u[..., 0]
    if dim == 2:
        return stack_components([jnp.cos(angle), jnp.sin(angle)])
    height = 2.0 * u[..., 1]
    across = jnp.sqrt(height * (2.0 - height))
    return stack_components([across * jnp.cos(angle), across * jnp.sin(angle), 1.0 - height])


def direction_in_cone(
    axis: Float[Array, "*lanes dim"], cone: Float[Array, ""], u: Float[Array, "*lanes 2"]
) -> Float[Array, "*lanes dim"]:
    """A uniformly distributed direction within the half-angle `cone` [rad] about a unit axis, smooth in the angle, at 0 too.

    In space sin(θ/2) = √u₀ sin(cone/2); in the plane the angle is uniform from -cone to cone.
    """
    if axis.shape[-1] == 2:
        angle = cone * (2.0 * u[..., 0] - 1.0)
        return force_rounding(scale(jnp.cos(angle), axis)) + force_rounding(scale(jnp.sin(angle), turn_left(axis)))
    # a bound that never acts but depends on u: XLA folds a constant sine at compile time, with other bits
    edge = jnp.sin(jnp.minimum(cone / 2, 2.0 + u[..., 0]))
    half = force_rounding(u[..., 0] * force_rounding(edge * edge))
    sine = 2.0 * edge * jnp.sqrt(u[..., 0] * (1.0 - half))
    sideways = unit_vector_around(axis, 2 * math.pi * u[..., 1])
    return force_rounding(scale(1.0 - 2.0 * half, axis)) + force_rounding(scale(sine, sideways))


def unit_vector_around(axis: Float[Array, "*lanes 3"], angle: Float[Array, "*lanes"]) -> Float[Array, "*lanes 3"]:
    """The unit vector at an angle [rad] around a unit axis.

    The frame is the branchless one of T. Duff et al., "Building an orthonormal basis, revisited", J. Comput. Graph.
    Tech. 6 (2017) 1.
    """
    x, y, z = components(axis)
    sign = jnp.where(z < 0, -1.0, 1.0).astype(z.dtype)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = stack_components([1.0 + force_rounding(sign * x * x * a), sign * b, -sign * x])
    second = stack_components([b, sign + force_rounding(y * y * a), -y])
    return force_rounding(scale(jnp.cos(angle), first)) + force_rounding(scale(jnp.sin(angle), second))


def unit_direction(vector: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
    """v/|v| with the same bits in every program; NaN for the zero vector."""
    return vector / _length(vector)[..., None]


def _length(vector: Array) -> Array:
    """|v| with the same bits in every program."""
    return jnp.sqrt(sum(force_rounding(each * each) for each in components(vector)))


def _cross(a: Array, b: Array) -> Array:
    """a × b with the same bits in every program."""
    (x, y, z), (p, q, r) = components(a), components(b)
    parts = ((y * r, z * q), (z * p, x * r), (x * q, y * p))
    return stack_components([force_rounding(one) - force_rounding(other) for one, other in parts])
