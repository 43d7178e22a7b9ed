"""What every surface has: how it answers a touch, how it moves, and what follows from its signed distance alone."""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from physjax.checks import quantity, unchecked_quantity
from physjax.particles import Particles
from physjax.parts import Contact
from physjax.physics.contacts.path_search import bound_path_length, find_path_dip
from physjax.physics.contacts.restitution import Coulomb, apply_restitution
from physjax.physics.contacts.time_of_impact import impact
from physjax.scene import project
from physjax.vectors import broadcast_vector, dot, norm, scale, unit


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

    curved: ClassVar[bool] = True
    restitution: Float[Array, "..."] = quantity(
        "restitution K_r", "1", at_least=0, at_most=1, default=1.0, kw_only=True
    )
    friction: Float[Array, "..."] | None = quantity(
        "friction K_f", "1", at_least=0, at_most=1, default=None, kw_only=True
    )
    coulomb: Coulomb | None = eqx.field(default=None, kw_only=True)
    velocity: Float[Array, "..."] | None = quantity(
        "surface velocity", "m/s", kind="vector", default=None, kw_only=True
    )
    response: Callable | None = eqx.field(static=True, default=None, kw_only=True)
    touching_since: Float[Array, "..."] | None = unchecked_quantity(
        "begin of contact", "s", per="memory", default=None, kw_only=True
    )

    def __check_init__(self):
        if self.friction is not None and self.coulomb is not None:
            raise ValueError("contact: got friction= (the lecture's K_f) and coulomb=, expected at most one of them.")
        if self.response is not None and not callable(self.response):
            raise TypeError(f"response: got {self.response!r}, expected contacts.impact, contacts.project or None.")

    @property
    def memory(self) -> tuple[str, ...]:
        """Names of the arrays that a step changes: when each lane began to touch, where impacts are timed."""
        return ("touching_since",) if self.response is impact else ()

    @abstractmethod
    def signed_distance(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes"]:
        """Signed distance to the surface [m], > 0 on the legal side."""

    def normal_at(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """Unit vector towards the legal side: unless a shape says it, the direction in which its gap grows."""
        return unit(jax.grad(lambda x: jnp.sum(self.signed_distance(t, x)))(position))

    def respond(self, t: ArrayLike, state: Particles) -> Particles:
        """The state after a touch: back on the surface, v' = (1 - K_f) v_t - K_r v_n for a lane that was going in.

        Velocities are relative to a moving surface.
        """
        signed_distance, normal, relative = (
            self.signed_distance(t, state.position),
            self.normal_at(t, state.position),
            self.relative(state.velocity),
        )
        inward = jnp.where(signed_distance < 0, jnp.minimum(dot(relative, normal), 0.0), 0.0)
        return apply_restitution(self, state, (jnp.minimum(signed_distance, 0.0), normal, relative), inward)

    def relative(self, velocity: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """Velocities as seen from the surface [m/s]."""
        return velocity if self.velocity is None else velocity - broadcast_vector(self.velocity, velocity)

    def curvature_acceleration(self, t: ArrayLike, position: Array, relative: Array) -> Array:
        """What the surface's curvature adds to the second time derivative of the gap [m/s²]: nothing where it is flat."""
        if not self.curved:
            return jnp.zeros_like(relative[..., 0])
        return dot(relative, self.normal_rate(t, position, relative))

    def normal_rate(self, t: ArrayLike, position: Array, relative: Array) -> Array:
        """How fast the normal turns under a lane that moves over the surface [1/s], from `normal_at` by differentiation."""
        return jax.jvp(lambda x: self.normal_at(t, x), (position,), (relative,))[1]

    def deepest(self, t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles, dip: tuple[Array, Array]) -> tuple:
        """Where in a step the path comes lowest, as a share of it, and its gap there; `dip` is what the gap's cubic says.

        Where the surface is curved the path is followed, by the distance that it has to go at least.
        """
        return find_path_dip(self, t, dt, start, end, dip) if self.curved else dip

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
        """Whether the gap may fall below zero within a step; over a curved surface, whether the path reaches it at all."""
        dips = self.may_dip_as_cubic(t, dt, start, end)
        if not self.curved:
            return dips
        free = self.signed_distance(t, start.position) + self.signed_distance(t + dt, end.position)
        return dips | (free < bound_path_length(self, dt, start, end))

    def may_dip_as_cubic(self, t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles) -> Bool[Array, "*lanes"]:
        """The same of a gap that is a cubic in time, which stays above the lowest of its four control points."""
        d0, d1 = self.signed_distance(t, start.position), self.signed_distance(t + dt, end.position)
        r0 = dt * dot(self.relative(start.velocity), self.normal_at(t, start.position))
        r1 = dt * dot(self.relative(end.velocity), self.normal_at(t + dt, end.position))
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

    def prepare(self, state: Particles, couples: bool) -> "Surface":
        """The surface as part of a scene: which response it has, and, for `impact`, which lanes touch it from the start."""
        response = self.response or (project if couples else impact)
        if response is not impact:
            return replace(self, response=response)
        if couples:
            raise ValueError(
                f"{type(self).__name__}: got response=impact in a scene with forces that couple its lanes, expected "
                "independent lanes: use response=contacts.project, or wrap a plain function in forces.independent."
            )
        return replace(self, response=impact).remember_since(
            [_find_contact_start(wall, state) for wall in self.walls()]
        )

    def remember_since(self, since: list[Array]) -> "Surface":
        """The surface with another memory of when each lane began to touch it, wall by wall."""
        return eqx.tree_at(lambda surface: surface.touching_since, self, since[0], is_leaf=lambda leaf: leaf is None)

    def forget_lanes(self, lanes: Bool[Array, "*lanes"]) -> "Surface":
        """The surface with some lanes as if they had never touched it."""
        if not self.memory:
            return self
        return self.remember_since([jnp.where(lanes, jnp.inf, wall.touching_since) for wall in self.walls()])

    def _to_rest_frame(self, t: ArrayLike, position: Array) -> Array:
        """Positions as the surface sees them, which thinks that it stands where it was at t = 0."""
        return position if self.velocity is None else position - scale(t, broadcast_vector(self.velocity, position))

    def _height(self, t: ArrayLike, position: Array, normal: Array) -> Array:
        """How far positions are above the plane through the surface's point [m].

        Only the velocity along the normal moves a plane: a belt, which moves along itself, is where it was at any time.
        """
        height = dot(position - broadcast_vector(self.point, position), normal)
        if self.velocity is None:
            return height
        velocity, normal = jnp.broadcast_arrays(self.velocity, unit(self.normal))
        along = dot(velocity, normal)
        # what rounding of velocity and normal may be is the zero that it means
        rounding = 4 * float(jnp.finfo(along.dtype).eps) * dot(jnp.abs(velocity), jnp.abs(normal))
        along = along - lax.stop_gradient(jnp.where(jnp.abs(along) <= rounding, along, 0.0))
        return height - t * along


INHERITED_FIELDS = ("restitution", "friction", "coulomb", "velocity")
"""What a part of a surface takes over from the whole."""


@jax.jit  # one compilation instead of one for each operation
def _find_contact_start(wall: Surface, state: Particles) -> Array:
    """When each lane began to touch a surface: at t = 0 where it starts on it and does not leave, else never (infinite)."""
    (x, v), rounding = state, 8 * float(jnp.finfo(state.dtype).eps)
    relative = wall.relative(v)
    normal_speed = dot(relative, wall.normal_at(0.0, x))
    on = jnp.abs(wall.signed_distance(0.0, x)) <= rounding * norm(x)
    along = normal_speed * normal_speed <= rounding**2 * dot(v, v)
    return lax.stop_gradient(jnp.where(on & along, 0.0, jnp.inf).astype(state.dtype))
