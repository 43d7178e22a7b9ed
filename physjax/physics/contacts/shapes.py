"""The shapes of contact surfaces: plane, slab, sphere and room, each given by its signed distance.

`signed_distance` [m] is positive on the legal side, zero on the surface and negative on the wrong side; `normal_at`
points to the legal side. Shapes may move with a constant `velocity` [m/s] from where they are at t = 0 (a piston, a
bat), turn within themselves with an `angular_velocity` [rad/s] (a turntable, a drum), or have a `motion` that is any
function of time (a shaken table, a lift, a paddle that swings). The contact response is the
same for all of them and stands in `surface`.
"""

from dataclasses import replace
from typing import ClassVar, TypeVar

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from physjax.checks import Numbers, concrete_or_none, demand_all, demand_direction, quantity
from physjax.cubics import Cubic
from physjax.particles import Particles, sum_terms
from physjax.physics.contacts.face import LowestPoint
from physjax.physics.contacts.surface import Surface
from physjax.vectors import broadcast_vector, cross, dot, norm, scale, unit

__all__ = ["Plane", "Room", "Slab", "Sphere"]


F = TypeVar("F", "Plane", "Slab")
R = TypeVar("R", bound="Room")

SMALLEST_LENGTH_SQUARED = 1e-30
"""Length² [m²] of a segment below which it is a point: it stands in for a zero that would be divided by."""
AXIS_ROUNDING = 64
"""Units of rounding by which the axis of a flat surface that turns may be off its normal [rad]."""
VELOCITY_ROUNDING = 4
"""Units of rounding below which a plane's velocity along its own normal is the zero that it is meant to be."""


class Plane(Surface):
    """A plane, for a floor, a wall or a slope: (X - P)·N > 0 is legal. The normal N is scaled to length 1.

    Example:
        >>> slope = contacts.Plane(point=(0.0, 5.0), normal=(3.0, 4.0))
        >>> round(float(slope.signed_distance(0.0, ball.position)), 3)
        4.0
        >>> turntable = contacts.Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), angular_velocity=(0.0, 2.0, 0.0))
        >>> print(turntable.velocity_at(0.0, jnp.array([0.5, 0.0, 0.0])))
        [ 0.  0. -1.]
    """

    curved: ClassVar[bool] = False
    point: Numbers = quantity("point of the plane", "m", kind="place")
    normal: Numbers = quantity("normal of the plane", "1", kind="vector")
    scaled: bool = eqx.field(static=True, default=False, repr=False, kw_only=True)

    def __check_init__(self):
        demand_direction("normal of the plane", self.normal)
        _demand_axis_along_normal(self)

    def relations(self) -> tuple[Array, ...]:
        """Conditions on its numbers, checked also where they are traced."""
        return (dot(self.normal, self.normal) > 0, *_relate_axis(self))

    def axis_point(self, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """The point of the plane."""
        return broadcast_vector(self.point, position)

    def signed_distance(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes"]:
        """(X - P)·N [m]."""
        return _measure_height(self, t, position, self.normal_at(t, position))

    def normal_at(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """N, of length 1."""
        return _turn_normal(self, t, position)

    def facing(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Surface:
        """The plane with its normal scaled to length 1, once for all that is asked of it."""
        return _scale_normal(self)


class Slab(Surface):
    """A plate of finite thickness [m], legal on both sides, with its middle plane through a point.

    With `inside=True` it is a corridor of that width: the space between its faces is legal.

    Example:
        >>> float(contacts.Slab((0.0, 0.0), (0.0, 1.0), thickness=2.0).signed_distance(0.0, ball.position))
        9.0
    """

    curved: ClassVar[bool] = False
    point: Numbers = quantity("point in the middle of the slab", "m", kind="place")
    normal: Numbers = quantity("normal of the slab", "1", kind="vector")
    thickness: Numbers = quantity("thickness", "m", above=0)
    inside: bool = eqx.field(static=True, default=False)
    scaled: bool = eqx.field(static=True, default=False, repr=False, kw_only=True)

    def __check_init__(self):
        demand_direction("normal of the slab", self.normal)
        _demand_axis_along_normal(self)

    def relations(self) -> tuple[Array, ...]:
        """Conditions on its numbers, checked also where they are traced."""
        return (dot(self.normal, self.normal) > 0, *_relate_axis(self))

    def axis_point(self, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """The point in its middle."""
        return broadcast_vector(self.point, position)

    def signed_distance(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes"]:
        """Distance to the nearer face [m]."""
        height = jnp.abs(self._height_above_middle(t, position))
        return self.thickness / 2 - height if self.inside else height - self.thickness / 2

    def normal_at(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """The normal of the nearer face."""
        return scale(self._find_side(t, position), _turn_normal(self, t, position))

    def facing(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Surface:
        """The face on the lane's side, as a plane: a fast lane cannot mistake it for the other face."""
        if self.inside:
            return _scale_normal(self)  # a lane that passes either face has left the corridor
        normal = scale(self._find_side(t, position), broadcast_vector(_unit_normal(self), position))
        return Plane(
            point=broadcast_vector(self.point, position) + scale(self.thickness / 2, normal),
            normal=normal,
            restitution=self.restitution,
            friction=self.friction,
            coulomb=self.coulomb,
            velocity=self.velocity,
            angular_velocity=self.angular_velocity,
            motion=self.motion,
            scaled=True,
        )

    def nearest_shares(self, t: ArrayLike, start: Array, end: Array) -> tuple[Array, ...]:
        """Where a segment crosses the middle plane of the slab: between two points on either side it is deepest there."""
        h0, h1 = self._height_above_middle(t, start), self._height_above_middle(t, end)
        crosses = h0 * h1 < 0
        return () if self.inside else (jnp.where(crosses, h0 / jnp.where(crosses, h0 - h1, 1.0), 0.0),)

    def _height_above_middle(self, t: ArrayLike, position: Array) -> Array:
        return _measure_height(self, t, position, _turn_normal(self, t, position))

    def _find_side(self, t: ArrayLike, position: Array) -> Array:
        """Along the normal of the slab (1) or against it (-1) points that of the nearer face."""
        return jnp.where((self._height_above_middle(t, position) < 0) != self.inside, -1.0, 1.0)


def _unit_normal(surface: Plane | Slab) -> Array:
    return surface.normal if surface.scaled else unit(surface.normal)


def _turn_normal(surface: Plane | Slab, t: ArrayLike, like: Array) -> Array:
    """The normal at a time, where the surface may have turned."""
    normal = broadcast_vector(_unit_normal(surface), like)
    return normal if surface.motion is None else surface.motion.turn(t, normal)


def _scale_normal(surface: F) -> F:
    return replace(surface, normal=_unit_normal(surface), scaled=True)


def _relate_axis(surface: Plane | Slab) -> tuple[Array, ...]:
    """Whether a flat surface that turns does so about its own normal: else it would tilt."""
    omega = surface.angular_velocity
    if omega is None:
        return ()
    omega, normal = jnp.broadcast_arrays(omega, _unit_normal(surface))
    across = cross(omega, normal)
    rounding = AXIS_ROUNDING * float(jnp.finfo(omega.dtype).eps)
    return (dot(across, across) <= rounding**2 * dot(omega, omega),)


def _demand_axis_along_normal(surface: Plane | Slab) -> None:
    """Raise a ValueError for a flat surface that turns about another axis than its normal."""
    omega, name = surface.angular_velocity, type(surface).__name__
    if omega is None:
        return
    if surface.normal.shape[-1] != 3 or omega.shape[-1:] != (3,):
        raise ValueError(
            f"{name}: got angular_velocity of shape {omega.shape} and a normal of {surface.normal.shape[-1]} components, "
            "expected vectors in space: a line in the plane cannot turn within itself. A drum in the plane is a "
            "contacts.Sphere(inside=True)."
        )
    (along,) = map(concrete_or_none, _relate_axis(surface))
    if along is not None and not along.all():
        raise ValueError(
            f"{name}: got angular_velocity {omega} across the normal {surface.normal}, expected a multiple of it: a flat "
            "surface turns within itself, as a turntable does. What tilts is a shape of your own."
        )


def _measure_height(surface: Plane | Slab, t: ArrayLike, position: Array, normal: Array) -> Array:
    """How far positions are above the plane through the surface's point [m].

    Only the velocity along the normal moves a plane: a conveyor belt, which moves along itself, stays where it is.
    """
    point = broadcast_vector(surface.point, position)
    if surface.motion is not None:
        return dot(position - surface.motion.place(t, point), normal)
    height = dot(position - point, normal)
    if surface.velocity is None:
        return height
    velocity, normal = jnp.broadcast_arrays(surface.velocity, _unit_normal(surface))
    along = dot(velocity, normal)
    # a belt on a slope has rounding for its velocity along the normal; over hours it would sink through the floor
    rounding = VELOCITY_ROUNDING * float(jnp.finfo(along.dtype).eps) * dot(jnp.abs(velocity), jnp.abs(normal))
    # what is subtracted has no derivative, so that the velocity keeps its own
    along = along - lax.stop_gradient(jnp.where(jnp.abs(along) <= rounding, along, 0.0))
    return height - t * along


class Sphere(Surface):
    """A ball as an obstacle, or with `inside=True` a bowl that holds particles inside.

    Example:
        >>> float(contacts.Sphere(center=(0.0, 0.0), radius=4.0).signed_distance(0.0, ball.position))
        6.0
    """

    center: Numbers = quantity("center", "m", kind="place")
    radius: Numbers = quantity("radius", "m", above=0)
    inside: bool = eqx.field(static=True, default=False)

    def signed_distance(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes"]:
        """Distance to the sphere [m]."""
        distance = norm(self._offset(t, position))
        return self.radius - distance if self.inside else distance - self.radius

    def normal_at(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """Away from the center, or towards it where the inside is legal; zero at the center itself."""
        direction = unit(self._offset(t, position))
        return -direction if self.inside else direction

    def curvature_acceleration(self, t: ArrayLike, position: Array, relative: Array) -> Array:
        """|v_t|²/r with r the distance from the center [m/s²]; negative where the inside is legal."""
        offset = self._offset(t, position)
        distance = norm(offset)
        inverse = 1.0 / jnp.where(distance > 0, distance, 1.0)
        along = dot(relative, offset) * inverse
        across = (dot(relative, relative) - along * along) * inverse
        return -across if self.inside else across

    def axis_point(self, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """The center."""
        return broadcast_vector(self.center, position)

    @property
    def narrow(self) -> bool:
        """Whether a fast point may pass through it: a ball, not a bowl."""
        return not self.inside

    def may_dip(self, t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles) -> Bool[Array, "*lanes"]:
        """Whether the path may enter the ball: its chord comes closer to the center than the radius and its own sag."""
        dips = self.may_dip_as_cubic(t, dt, start, end)
        if self.inside:
            return dips
        p, chord = self._offset(t, start.position), self._offset(t + dt, end.position)
        chord = chord - p
        # a Hermite cubic is off its chord by at most a quarter of what its end velocities are off the chord's
        sag = norm(scale(dt, self.relative(t, *start)) - chord) + norm(scale(dt, self.relative(t + dt, *end)) - chord)
        s = jnp.clip(-dot(p, chord) / jnp.maximum(dot(chord, chord), SMALLEST_LENGTH_SQUARED), 0.0, 1.0)
        nearest = p + scale(s, chord)
        # a lane that leaves the surface is nearest at its start, which is no dip
        return dips | ((norm(nearest) < self.radius + sag / 4) & (s > 0))

    def deepest(self, t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles, dip: LowestPoint) -> LowestPoint:
        """The closest approach to the center: that of the chord, then one Newton step on the cubic path."""
        if self.inside:
            return dip
        p, q = self._offset(t, start.position), self._offset(t + dt, end.position)
        u, w = scale(dt, self.relative(t, *start)), scale(dt, self.relative(t + dt, *end))
        path, chord = Cubic.through(p, q, u, w), q - p
        length = dot(chord, chord)
        s = jnp.clip(-dot(p, chord) / jnp.maximum(length, SMALLEST_LENGTH_SQUARED), 0.0, 1.0)
        at, slope = path.at(s), path.slope(s)
        steep = dot(slope, slope) + dot(at, path.curvature(s))
        s = jnp.clip(s - jnp.where(steep > 0, dot(at, slope) / jnp.where(steep > 0, steep, 1.0), 0.0), 0.0, 1.0)
        return s, norm(path.at(s)) - self.radius

    def nearest_shares(self, t: ArrayLike, start: Array, end: Array) -> tuple[Array, ...]:
        """The foot of the perpendicular from the center."""
        p, along = self._offset(t, start), end - start
        return (jnp.clip(-dot(p, along) / jnp.maximum(dot(along, along), SMALLEST_LENGTH_SQUARED), 0.0, 1.0),)

    def relative(
        self, t: ArrayLike, position: Float[Array, "*lanes dim"], velocity: Float[Array, "*lanes dim"]
    ) -> Float[Array, "*lanes dim"]:
        """Velocities relative to the center [m/s]: how a ball turns does not change the distance."""
        if self.motion is None:
            return super().relative(t, position, velocity)
        return velocity - self.motion.velocity_at(t, self.motion.place(t, broadcast_vector(self.center, position)))

    def _offset(self, t: ArrayLike, position: Array) -> Array:
        """From the center to positions [m]."""
        center = broadcast_vector(self.center, position)
        if self.motion is not None:
            return position - self.motion.place(t, center)
        return self.rest_place(t, position) - center


class Room(Surface):
    """A closed box between two corners; every particle stays inside, in the corners too.

    A lane that crosses the middle of the room and turns around within one step is found in contact only if it ends
    outside: take steps in which no lane flies up from the floor, touches the ceiling and comes back.

    Example:
        >>> float(contacts.Room((-4.0, 0.0), (7.0, 12.0)).signed_distance(0.0, ball.position))
        2.0
    """

    curved: ClassVar[bool] = False
    lower: Numbers = quantity("lower corner", "m", kind="corner")
    upper: Numbers = quantity("upper corner", "m", kind="corner")

    def __check_init__(self):
        lower, upper = concrete_or_none(self.lower), concrete_or_none(self.upper)
        if lower is not None and upper is not None:
            demand_all(
                "upper corner [m]", self.upper, upper > lower, f"above the lower corner {lower} in every component"
            )
        if self.angular_velocity is not None:
            raise ValueError(
                "Room: got angular_velocity=, expected none: walls that turn would sweep through the corners."
            )

    def relations(self) -> tuple[Array, ...]:
        """Conditions on its numbers, checked also where they are traced."""
        return (self.upper > self.lower,)

    def walls(self) -> tuple[Slab, ...]:
        """A corridor along each axis, between two opposite walls."""
        middle, width = (self.lower + self.upper) / 2, self.upper - self.lower
        axes = jnp.eye(self.lower.shape[-1], dtype=self.lower.dtype)
        pairs = [self._build_wall_pair(middle, axis, width[..., i]) for i, axis in enumerate(axes)]
        if self.touching_since is None:
            return tuple(pairs)
        return tuple(pair.remember_since([self.touching_since[..., i]]) for i, pair in enumerate(pairs))

    def _build_wall_pair(self, middle: Array, axis: Array, width: Array) -> Slab:
        """The two walls across an axis, as a corridor."""
        return Slab(
            point=middle,
            normal=axis,
            thickness=width,
            inside=True,
            restitution=self.restitution,
            friction=self.friction,
            coulomb=self.coulomb,
            velocity=self.velocity,
            motion=self.motion,
        )

    def remember_since(self: R, since: list[Array]) -> R:
        """The room with new times [s] since when each lane is in contact with a wall, the wall's axis last."""
        return super().remember_since([jnp.stack(since, axis=-1)])

    def signed_distance(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes"]:
        """Distance to the nearest wall [m]; outside, to the farthest one that was passed."""
        distances = [wall.signed_distance(t, position) for wall in self.walls()]
        return jnp.min(jnp.stack(distances), axis=0)

    def normal_at(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """The normal of the nearest wall."""
        nearest = jnp.argmin(jnp.stack([wall.signed_distance(t, position) for wall in self.walls()]), axis=0)
        normals = [wall.normal_at(t, position) for wall in self.walls()]
        return sum_terms([scale((nearest == i).astype(position.dtype), n) for i, n in enumerate(normals)])

    def respond(self, t: ArrayLike, state: Particles) -> Particles:
        """Wall by wall: in a corner two or three of them respond."""
        for wall in self.walls():
            state = wall.respond(t, state)
        return state
