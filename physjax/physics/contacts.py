"""Surfaces that particles may not pass: each shape is a signed distance, and the answer to a touch is written once for all.

`gap` [m] is positive on the legal side, zero on the surface, negative on the wrong side; `outward` points to the legal side.
Shapes may move with a constant `velocity` [m/s] from where they are at t = 0 (a piston, a bat).
"""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from physjax.checks import concrete, demand, demand_direction, quantity
from physjax.physics.edges import Corners, Nearest, nearest_on_segment, respond_segment, touching_corners
from physjax.physics.impact import impact
from physjax.physics.rebound import Coulomb, rebound
from physjax.scene import Contact, Particles, project
from physjax.vectors import dot, norm, over, scale, unit


class Surface(Contact):
    """What every shape has: restitution K_r, at most one kind of friction, and a velocity if it moves.

    `restitution` is 1 for a perfect bounce, 0 for none. `friction` is the lecture's K_f, the fraction of the tangential
    velocity that a bounce takes; `coulomb` clamps the tangential impulse by the normal one instead. (K_r = 0 sticks
    only with K_f = 1 as well, and gravity acts again in the next step: the lecture's "stick to wall" is for a moment.)

    Example:
        >>> floor = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.5, friction=0.25)
        >>> print(floor.respond(0.0, Particles(jnp.array([0.0, -0.1]), jnp.array([4.0, -4.0]))).velocity)
        [3. 2.]
    """

    restitution: Float[Array, "..."] = quantity("restitution K_r", "1", at_least=0, default=1.0, kw_only=True)
    friction: Float[Array, "..."] | None = quantity("friction K_f", "1", at_least=0, default=None, kw_only=True)
    coulomb: Coulomb | None = eqx.field(default=None, kw_only=True)
    velocity: Float[Array, "..."] | None = quantity("surface velocity", "m/s", default=None, kw_only=True)
    response: Callable | None = eqx.field(static=True, default=None, kw_only=True)
    touching_since: Float[Array, "..."] | None = eqx.field(default=None, kw_only=True)

    def __check_init__(self):
        for name, value in (("restitution K_r [1]", self.restitution), ("friction K_f [1]", self.friction)):
            if value is not None and concrete(value) is not None:
                demand(name, value, concrete(value) <= 1, "numbers from 0 to 1")
        if self.friction is not None and self.coulomb is not None:
            raise ValueError("contact: got friction= (the lecture's K_f) and coulomb=, expected at most one of them.")
        if self.response is not None and not callable(self.response):
            raise TypeError(f"response: got {self.response!r}, expected contacts.impact, contacts.project or None.")

    @property
    def memory(self) -> tuple[str, ...]:
        """Names of the arrays that a step changes: when each lane began to touch, where impacts are timed."""
        return ("touching_since",) if self.response is impact else ()

    @abstractmethod
    def gap(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes"]:
        """Signed distance to the surface [m], > 0 on the legal side."""

    @abstractmethod
    def outward(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """Unit vector towards the legal side."""

    def respond(self, t: ArrayLike, state: Particles) -> Particles:
        """The state after a touch: back on the surface, v' = (1 - K_f) v_t - K_r v_n for a lane that was going in.

        Velocities are relative to a moving surface.
        """
        gap, normal, relative = (
            self.gap(t, state.position),
            self.outward(t, state.position),
            self.relative(state.velocity),
        )
        inward = jnp.where(gap < 0, jnp.minimum(dot(relative, normal), 0.0), 0.0)
        return rebound(self, state, (jnp.minimum(gap, 0.0), normal, relative), inward)

    def relative(self, velocity: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """Velocities as seen from the surface [m/s]."""
        return velocity if self.velocity is None else velocity - over(self.velocity, velocity)

    def bend(self, t: ArrayLike, position: Array, relative: Array) -> Array:
        """What the surface's curvature adds to the second time derivative of the gap [m/s²]: nothing where it is flat."""
        return jnp.zeros_like(relative[..., 0])

    def deepest(self, t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles, dip: tuple[Array, Array]) -> tuple:
        """Where in a step the path comes lowest, as a share of it, and its gap there; `dip` is what the gap's cubic says."""
        return dip

    def may_meet(
        self, touching: list[Array], t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles
    ) -> Bool[Array, "*lanes"]:
        """Whether a lane may meet the surface within a step, or, if it slides there already (`touching`), may stop."""
        before, after = self.relative(start.velocity), self.relative(end.velocity)
        meets = self.facing(t, start.position).may_dip(t, dt, start, end)
        if self.coulomb is None:
            return meets & ~touching[0]
        return jnp.where(touching[0], (dot(before, after) <= 0) & (dot(before, before) > 0), meets)

    def may_dip(self, t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles) -> Bool[Array, "*lanes"]:
        """Whether the gap may fall below zero within a step: a cubic stays above the lowest of its four control points."""
        d0, d1 = self.gap(t, start.position), self.gap(t + dt, end.position)
        r0 = dt * dot(self.relative(start.velocity), self.outward(t, start.position))
        r1 = dt * dot(self.relative(end.velocity), self.outward(t + dt, end.position))
        return jnp.minimum(jnp.minimum(d0 + r0 / 3, d1 - r1 / 3), d1) < 0

    def nearest_shares(self, t: ArrayLike, start: Array, end: Array) -> tuple[Array, ...]:
        """Shares of a segment where it may come nearest other than at its ends: none where the surface is flat."""
        return ()

    def facing(self, t: ArrayLike, position: Array) -> "Surface":
        """The surface as a lane at this position sees it."""
        return self

    def walls(self) -> tuple["Surface", ...]:
        """The surfaces it is made of: itself."""
        return (self,)

    def prepared(self, state: Particles, couples: bool) -> "Surface":
        """The surface as part of a scene: which response it has, and, for `impact`, which lanes touch it from the start."""
        response = self.response or (project if couples else impact)
        if response is not impact:
            return replace(self, response=response)
        if couples:
            raise ValueError(
                f"{type(self).__name__}: got response=impact in a scene with forces that couple its lanes, expected "
                "independent lanes: use response=contacts.project, or wrap a plain function in forces.independent."
            )
        return replace(self, response=impact).remembering([_touching(wall, state) for wall in self.walls()])

    def remembering(self, since: list[Array]) -> "Surface":
        """The surface with another memory of when each lane began to touch it, wall by wall."""
        return eqx.tree_at(lambda surface: surface.touching_since, self, since[0], is_leaf=lambda leaf: leaf is None)

    def forgetting(self, lanes: Bool[Array, "*lanes"]) -> "Surface":
        """The surface with some lanes as if they had never touched it."""
        if not self.memory:
            return self
        return self.remembering([jnp.where(lanes, jnp.inf, wall.touching_since) for wall in self.walls()])

    def _still(self, t: ArrayLike, position: Array) -> Array:
        """Positions as the surface sees them, which thinks that it stands where it was at t = 0."""
        return position if self.velocity is None else position - scale(t, over(self.velocity, position))

    def _height(self, t: ArrayLike, position: Array, normal: Array) -> Array:
        """How far positions are above the plane through the surface's point [m].

        Only the velocity along the normal moves a plane: a belt, which moves along itself, is where it was at any time.
        """
        height = dot(position - over(self.point, position), normal)
        if self.velocity is None:
            return height
        velocity, normal = jnp.broadcast_arrays(self.velocity, unit(self.normal))
        along = dot(velocity, normal)
        # what rounding of velocity and normal may be is the zero that it means
        rounding = 4 * float(jnp.finfo(along.dtype).eps) * dot(jnp.abs(velocity), jnp.abs(normal))
        along = along - lax.stop_gradient(jnp.where(jnp.abs(along) <= rounding, along, 0.0))
        return height - t * along


ABOUT = ("restitution", "friction", "coulomb", "velocity")
"""What a part of a surface takes over from the whole."""


_TINY = 1e-30


class Plane(Surface):
    """A floor, a wall, a slope: legal is (X - P)·N > 0. The normal N is made a unit vector.

    Example:
        >>> slope = contacts.Plane(point=(0.0, 5.0), normal=(3.0, 4.0))
        >>> round(float(slope.gap(0.0, ball.position)), 3)
        4.0
    """

    point: Float[Array, "..."] = quantity("point of the plane", "m")
    normal: Float[Array, "..."] = quantity("normal of the plane", "1")

    def __check_init__(self):
        demand_direction("normal of the plane", self.normal)

    def gap(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes"]:
        """(X - P)·N [m]."""
        return self._height(t, position, self.outward(t, position))

    def outward(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """N, of length 1."""
        return over(unit(self.normal), position)


class Slab(Surface):
    """A plate of finite thickness [m] with two legal sides, about the plane through a point.

    With `inside=True` it is a corridor of that width: legal is what lies between its faces.

    Example:
        >>> float(contacts.Slab((0.0, 0.0), (0.0, 1.0), thickness=2.0).gap(0.0, ball.position))
        9.0
    """

    point: Float[Array, "..."] = quantity("point in the middle of the slab", "m")
    normal: Float[Array, "..."] = quantity("normal of the slab", "1")
    thickness: Float[Array, "..."] = quantity("thickness", "m", above=0)
    inside: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        demand_direction("normal of the slab", self.normal)

    def gap(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes"]:
        """Distance to the nearer face [m]."""
        height = jnp.abs(self._above(t, position))
        return self.thickness / 2 - height if self.inside else height - self.thickness / 2

    def outward(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """The normal of the nearer face."""
        side = jnp.where((self._above(t, position) < 0) != self.inside, -1.0, 1.0)
        return scale(side, over(unit(self.normal), position))

    def facing(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Surface:
        """The face on the side where a lane is, as a plane: a fast lane cannot mistake it for the other."""
        if self.inside:
            return self  # whichever face it passes, it has left
        about = {name: getattr(self, name) for name in ABOUT}
        normal = self.outward(t, position)
        return Plane(over(self.point, position) + scale(self.thickness / 2, normal), normal, **about)

    def nearest_shares(self, t: ArrayLike, start: Array, end: Array) -> tuple[Array, ...]:
        """Where a segment crosses the middle of the slab."""
        h0, h1 = self._above(t, start), self._above(t, end)
        crosses = h0 * h1 < 0
        return () if self.inside else (jnp.where(crosses, h0 / jnp.where(crosses, h0 - h1, 1.0), 0.0),)

    def _above(self, t, position):
        return self._height(t, position, over(unit(self.normal), position))


class Sphere(Surface):
    """A ball in the way, or with `inside=True` a bowl that keeps what it holds.

    Example:
        >>> float(contacts.Sphere(center=(0.0, 0.0), radius=4.0).gap(0.0, ball.position))
        6.0
    """

    center: Float[Array, "..."] = quantity("center", "m")
    radius: Float[Array, "..."] = quantity("radius", "m", above=0)
    inside: bool = eqx.field(static=True, default=False)

    def gap(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes"]:
        """Distance to the sphere [m]."""
        distance = norm(self._offset(t, position))
        return self.radius - distance if self.inside else distance - self.radius

    def outward(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """Away from the center, or towards it where the inside is legal; zero in the center itself."""
        direction = unit(self._offset(t, position))
        return -direction if self.inside else direction

    def bend(self, t: ArrayLike, position: Array, relative: Array) -> Array:
        """|v_t|²/r: along the surface a path bends away from the ball, or into the bowl."""
        normal_speed = dot(relative, self.outward(t, position))
        across = (dot(relative, relative) - normal_speed**2) / self.radius
        return -across if self.inside else across

    def may_dip(self, t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles) -> Bool[Array, "*lanes"]:
        """Whether the path may enter the ball: its chord comes closer than the radius and the path's own bow together."""
        dips = super().may_dip(t, dt, start, end)
        if self.inside:
            return dips
        p, chord = self._offset(t, start.position), self._offset(t + dt, end.position)
        chord = chord - p
        bow = norm(scale(dt, self.relative(start.velocity)) - chord) + norm(
            scale(dt, self.relative(end.velocity)) - chord
        )
        s = jnp.clip(-dot(p, chord) / jnp.maximum(dot(chord, chord), _TINY), 0.0, 1.0)
        nearest = p + scale(s, chord)
        # a lane that leaves the surface is nearest at its start
        return dips | ((norm(nearest) < self.radius + bow / 4) & (s > 0))

    def deepest(self, t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles, dip: tuple[Array, Array]) -> tuple:
        """The closest approach to the center: of the chord, then one Newton step on the cubic path between its ends."""
        if self.inside:
            return dip
        p, q = self._offset(t, start.position), self._offset(t + dt, end.position)
        u, w = scale(dt, self.relative(start.velocity)), scale(dt, self.relative(end.velocity))
        chord = q - p
        b, a = 3.0 * chord - 2.0 * u - w, u + w - 2.0 * chord
        length = dot(chord, chord)
        s = jnp.clip(-dot(p, chord) / jnp.maximum(length, _TINY), 0.0, 1.0)
        at = p + scale(s, u + scale(s, b + scale(s, a)))
        slope, turn = u + scale(s, 2.0 * b + scale(3.0 * s, a)), 2.0 * b + scale(6.0 * s, a)
        steep = dot(slope, slope) + dot(at, turn)
        s = jnp.clip(s - jnp.where(steep > 0, dot(at, slope) / jnp.where(steep > 0, steep, 1.0), 0.0), 0.0, 1.0)
        at = p + scale(s, u + scale(s, b + scale(s, a)))
        return s, norm(at) - self.radius

    def nearest_shares(self, t: ArrayLike, start: Array, end: Array) -> tuple[Array, ...]:
        """The foot of the perpendicular from the center."""
        p, along = self._offset(t, start), end - start
        return (jnp.clip(-dot(p, along) / jnp.maximum(dot(along, along), _TINY), 0.0, 1.0),)

    def _offset(self, t, position):
        return self._still(t, position) - over(self.center, position)


class Room(Surface):
    """A closed box between two corners; every particle stays in it, in a corner too.

    A lane that turns around within one step, after it has come from the other half of the room, is seen to touch only if
    it ends outside: take steps in which no lane flies up from the floor, touches the ceiling and comes back.

    Example:
        >>> float(contacts.Room((-4.0, 0.0), (7.0, 12.0)).gap(0.0, ball.position))
        2.0
    """

    lower: Float[Array, "..."] = quantity("lower corner", "m")
    upper: Float[Array, "..."] = quantity("upper corner", "m")

    def __check_init__(self):
        lower, upper = concrete(self.lower), concrete(self.upper)
        if lower is not None and upper is not None:
            demand("upper corner [m]", self.upper, upper > lower, f"above the lower corner {lower} in every component")

    def walls(self) -> tuple[Slab, ...]:
        """A corridor along each axis, between two opposite walls."""
        about = {name: getattr(self, name) for name in ABOUT}
        middle, width = (self.lower + self.upper) / 2, self.upper - self.lower
        axes = jnp.eye(self.lower.shape[-1], dtype=self.lower.dtype)
        pairs = [Slab(middle, axis, width[..., i], inside=True, **about) for i, axis in enumerate(axes)]
        if self.touching_since is None:
            return tuple(pairs)
        return tuple(pair.remembering([self.touching_since[..., i]]) for i, pair in enumerate(pairs))

    def remembering(self, since: list[Array]) -> "Room":
        """The room with another memory of when each lane began to touch a wall, the wall's axis last."""
        return super().remembering([jnp.stack(since, axis=-1)])

    def gap(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes"]:
        """Distance to the nearest wall [m]; outside, to the farthest one that was passed."""
        gaps = [wall.gap(t, position) for wall in self.walls()]
        return jnp.min(jnp.stack(gaps), axis=0)

    def outward(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """The normal of the nearest wall."""
        nearest = jnp.argmin(jnp.stack([wall.gap(t, position) for wall in self.walls()]), axis=0)
        normals = [wall.outward(t, position) for wall in self.walls()]
        return sum(scale((nearest == i).astype(position.dtype), n) for i, n in enumerate(normals))

    def may_meet(
        self, touching: list[Array], t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles
    ) -> Bool[Array, "*lanes"]:
        """Whether a lane may meet a wall within a step, or stop on one it slides along."""
        flags = [w.may_meet([touch], t, dt, start, end) for w, touch in zip(self.walls(), touching, strict=True)]
        return jnp.any(jnp.stack(flags), axis=0)

    def respond(self, t: ArrayLike, state: Particles) -> Particles:
        """Wall by wall: in a corner two or three of them answer."""
        for wall in self.walls():
            state = wall.respond(t, state)
        return state


@jax.jit  # one compilation instead of one for each operation
def _touching(wall: Surface, state: Particles) -> Array:
    """When each lane began to touch a surface: at t = 0 where it starts on it and does not leave, else never (infinite)."""
    (x, v), rounding = state, 8 * float(jnp.finfo(state.dtype).eps)
    relative = wall.relative(v)
    normal_speed = dot(relative, wall.outward(0.0, x))
    on = jnp.abs(wall.gap(0.0, x)) <= rounding * norm(x)
    along = normal_speed * normal_speed <= rounding**2 * dot(v, v)
    return lax.stop_gradient(jnp.where(on & along, 0.0, jnp.inf).astype(state.dtype))


__all__ = [
    "Corners",
    "Coulomb",
    "Nearest",
    "Plane",
    "Room",
    "Slab",
    "Sphere",
    "Surface",
    "impact",
    "nearest_on_segment",
    "project",
    "respond_segment",
    "touching_corners",
]
