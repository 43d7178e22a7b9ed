"""What every contact surface has: restitution, friction, a velocity, and all that follows from its signed distance."""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import KW_ONLY, replace
from typing import ClassVar, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from physjax.checks import Numbers, OptionalNumbers, quantity, unchecked_quantity
from physjax.old_names import serve_old_names
from physjax.particles import Particles
from physjax.parts import Contact
from physjax.physics.contacts.face import LowestPoint
from physjax.physics.contacts.motion import Motion
from physjax.physics.contacts.path_search import bound_path_length, find_path_dip
from physjax.physics.contacts.restitution import Coulomb, apply_restitution
from physjax.physics.contacts.time_of_impact import impact
from physjax.scene import Scene, project
from physjax.vectors import broadcast_vector, dot, norm, scale, spin, unit

S = TypeVar("S", bound="Surface")

OLD_NAMES = {"outward": "normal_at", "bend": "curvature_acceleration"}
"""Methods of a surface that subclasses override, by their names in the first edition; `Contact` has its own."""

CONTACT_START_ROUNDING = 8
"""Lanes this many units of rounding off the surface, or off a tangential velocity, begin in contact."""


class Surface(Contact):
    """A surface that particles may not pass: restitution K_r, at most one kind of friction, and a velocity if it moves.

    `restitution` is 1 for an elastic bounce, 0 for a perfectly inelastic one. `friction` is the lecture's K_f, the share
    of the tangential velocity that a bounce takes; `coulomb` limits the tangential impulse by the normal one instead.
    (K_r = 0 sticks only with K_f = 1 as well, and gravity acts again in the next step: the lecture's "stick to wall"
    lasts for a moment.)

    What turns within itself has an `angular_velocity` Ω [rad/s], a vector in space and a number in the plane (> 0:
    anticlockwise): friction then sees velocity + Ω×r, with r from the axis. The axis goes through the point of a plane or
    slab, along its normal (a turntable), and through the center of a sphere (a drum, a ball that spins); that of a shape
    of your own, which must be round about it, goes through `axis_point`. What is driven along a path or about an axis, as
    functions of time, has a `motion` instead.

    A shape of your own is a subclass with a `signed_distance(t, position)` and nothing else: its normal and curvature
    follow by differentiation. It measures from `self.rest_place(t, position)` if it is to move. Override `normal_at` and
    `curvature_acceleration` where closed forms are known. The distance must be right to first order at the surface,
    where its gradient has length 1, and must nowhere be greater than the true one, or the search for impacts may step
    over something thin.

    Example:
        >>> floor = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.5, friction=0.25)
        >>> print(floor.respond(0.0, Particles(jnp.array([0.0, -0.1]), jnp.array([4.0, -4.0]))).velocity)
        [3. 2.]
    """

    curved: ClassVar[bool] = True
    _: KW_ONLY  # type checkers do not see the kw_only of `quantity`
    restitution: Numbers = quantity("restitution K_r", "1", at_least=0, at_most=1, default=1.0, kw_only=True)
    friction: OptionalNumbers = quantity("friction K_f", "1", at_least=0, at_most=1, default=None, kw_only=True)
    coulomb: Coulomb | None = eqx.field(default=None, kw_only=True)
    velocity: OptionalNumbers = quantity("surface velocity", "m/s", kind="vector", default=None, kw_only=True)
    angular_velocity: OptionalNumbers = quantity(
        "angular velocity of the surface", "rad/s", kind="axial", default=None, kw_only=True
    )
    motion: Motion | None = eqx.field(default=None, kw_only=True)
    # a field or a property where other contacts have a class attribute: all are read the same way
    response: Callable[..., Scene] | None = eqx.field(  # pyright: ignore[reportIncompatibleVariableOverride]
        static=True, default=None, kw_only=True
    )
    touching_since: OptionalNumbers = unchecked_quantity(
        "begin of contact", "s", per="memory", default=None, kw_only=True
    )

    def __init_subclass__(cls, **options: object):
        super().__init_subclass__(**options)
        serve_old_names(cls, OLD_NAMES)

    def __check_init__(self):
        if self.friction is not None and self.coulomb is not None:
            raise ValueError("contact: got friction= (the lecture's K_f) and coulomb=, expected at most one of them.")
        if self.coulomb is not None and not isinstance(self.coulomb, Coulomb):
            raise TypeError(
                f"coulomb: got {self.coulomb!r}, expected contacts.Coulomb(static=0.5, kinetic=0.4): a contact sticks up to the "
                "one and slips against the other."
            )
        if self.motion is not None and not isinstance(self.motion, Motion):
            raise TypeError(
                f"motion: got {self.motion!r}, expected contacts.Motion(displacement=lambda t: ...), or velocity= where the "
                "surface moves uniformly."
            )
        if self.motion is not None and (self.velocity is not None or self.angular_velocity is not None):
            raise ValueError(
                f"{type(self).__name__}: got motion= and velocity= or angular_velocity=, expected one of them: a motion has "
                "its own velocity."
            )
        if self.response is not None and not callable(self.response):
            raise TypeError(f"response: got {self.response!r}, expected contacts.impact, contacts.project or None.")

    @property
    def memory(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Names of the arrays that a step changes: since when each lane is in contact, where impacts are timed."""
        return ("touching_since",) if self.response is impact else ()

    # geometry

    @abstractmethod
    def signed_distance(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes"]:
        """Signed distance to the surface [m], > 0 on the legal side."""

    def normal_at(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """Unit vector towards the legal side: the gradient of the signed distance, unless a shape has a closed form."""
        # the sum has each lane's own gradient, because no lane's distance depends on another lane
        return unit(jax.grad(lambda x: jnp.sum(self.signed_distance(t, x)))(position))

    def rest_place(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """Positions in the frame in which the surface stands where it was given [m]."""
        if self.motion is not None:
            return self.motion.rest_place(t, position)
        return position if self.velocity is None else position - scale(t, broadcast_vector(self.velocity, position))

    @property
    def moves(self) -> bool:
        """Whether it moves, or turns within itself."""
        return not (self.velocity is None and self.angular_velocity is None and self.motion is None)

    @property
    def accelerates(self) -> bool:
        """Whether what sticks to it is accelerated: it turns, or has a motion."""
        return not (self.angular_velocity is None and self.motion is None)

    def relative(
        self, t: ArrayLike, position: Float[Array, "*lanes dim"], velocity: Float[Array, "*lanes dim"]
    ) -> Float[Array, "*lanes dim"]:
        """Velocities relative to the surface, less what turns it within itself, which does not change the distance [m/s]."""
        if self.motion is not None:
            return velocity - self.motion.velocity_at(t, position)
        return velocity if self.velocity is None else velocity - broadcast_vector(self.velocity, velocity)

    def axis_point(self, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """A point on the axis about which the surface turns [m], at t = 0, one for each of these positions: the origin."""
        return jnp.zeros_like(position)

    def velocity_at(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"] | None:
        """The velocity of the surface itself at positions on it, v + Ω×r [m/s]; None where it does not move."""
        if self.motion is not None:
            return self.motion.velocity_at(t, position)
        turning = None if self.angular_velocity is None else spin(self.angular_velocity, self._arm(t, position))
        if self.velocity is None:
            return turning
        velocity = broadcast_vector(self.velocity, position)
        return velocity if turning is None else velocity + turning

    def spin_at(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes turns"] | None:
        """How fast it turns at each position [rad/s]: one number in the plane, three in space; None where it does not."""
        if self.motion is not None:
            return self.motion.spin_at(t, position)
        if self.angular_velocity is None:
            return None
        spin_rate = jnp.atleast_1d(self.angular_velocity)
        return jnp.broadcast_to(spin_rate, (*position.shape[:-1], spin_rate.shape[-1]))

    def acceleration_at(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"] | None:
        """The acceleration of what sticks to the surface there, Ω×(Ω×r) or the motion's [m/s²]; None where it has none."""
        if self.motion is not None:
            return self.velocity_rate(t, position, self.motion.velocity_at(t, position))
        if self.angular_velocity is None:
            return None
        return spin(self.angular_velocity, spin(self.angular_velocity, self._arm(t, position)))

    def velocity_rate(
        self, t: ArrayLike, position: Float[Array, "*lanes dim"], velocity: Float[Array, "*lanes dim"]
    ) -> Float[Array, "*lanes dim"] | None:
        """How fast `velocity_at` changes at a place that moves with a velocity, Ω×ẋ [m/s²]; None where it does not."""
        if self.motion is not None:
            return _differentiate_along(self.motion.velocity_at, t, position, velocity)
        if self.angular_velocity is None:
            return None
        return spin(self.angular_velocity, self.relative(t, position, velocity))

    def slip(self, t: ArrayLike, state: Particles) -> Float[Array, "*lanes dim"]:
        """Velocities relative to the surface where each lane is, turning included [m/s]: what friction sees."""
        carried = self.velocity_at(t, state.position)
        return state.velocity if carried is None else state.velocity - carried

    def curvature_acceleration(self, t: ArrayLike, position: Array, relative: Array) -> Array:
        """What the curvature adds to the second time derivative of the signed distance: v·∇n·v [m/s²], zero if flat."""
        if not self.curved:
            return jnp.zeros_like(relative[..., 0])
        return dot(relative, self.normal_rate(t, position, relative))

    def distance_acceleration(self, t: ArrayLike, state: Particles) -> Array:
        """The second time derivative of the signed distance of lanes that are not accelerated [m/s²].

        That is due to curvature, and to the motion of the surface.
        """
        x, v = state
        if self.motion is None:
            return self.curvature_acceleration(t, x, self.relative(t, x, v))
        return _differentiate_along(lambda t, x: dot(self.normal_at(t, x), self.relative(t, x, v)), t, x, v)

    def normal_rate(self, t: ArrayLike, position: Array, relative: Array) -> Array:
        """How fast the normal turns under a lane that moves over the surface, v·∇n [1/s], by differentiation."""
        if self.motion is not None:
            velocity = relative + self.motion.velocity_at(t, position)
            return _differentiate_along(self.normal_at, t, position, velocity)
        return jax.jvp(lambda x: self.normal_at(t, x), (position,), (relative,))[1]

    def facing(self, t: ArrayLike, position: Array) -> "Surface":
        """The surface as a lane at this position meets it."""
        return self

    def walls(self) -> tuple["Surface", ...]:
        """The surfaces that it consists of: itself."""
        return (self,)

    @property
    def narrow(self) -> bool:
        """Whether a fast point may pass through it and out again within a step: a curved obstacle, not a wall or plate."""
        return self.curved

    # responses

    def respond(self, t: ArrayLike, state: Particles) -> Particles:
        """The state after a contact at the end of a step: v' = (1 - K_f) v_t - K_r v_n for a lane that was going in.

        Velocities are relative to the surface; what went through it is moved back onto it.
        """
        signed_distance, normal, relative = (
            self.signed_distance(t, state.position),
            self.normal_at(t, state.position),
            self.slip(t, state),
        )
        inward = jnp.where(signed_distance < 0, jnp.minimum(dot(relative, normal), 0.0), 0.0)
        return apply_restitution(self, state, (jnp.minimum(signed_distance, 0.0), normal, relative), inward)

    # where a path meets the surface within a step

    def deepest(self, t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles, dip: LowestPoint) -> LowestPoint:
        """Where in a step the path comes lowest, as a share of it, and the signed distance there.

        `dip` is that of a cubic in time, which is enough over flat ground. Over a curved surface the path is searched,
        advancing by what the signed distance shows to be free.
        """
        return find_path_dip(self, t, dt, start, end, dip) if self.curved else dip

    def may_meet(
        self, touching: Array, t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles
    ) -> Bool[Array, "*lanes"]:
        """Whether a lane may meet the surface within a step, or, where it slides already (`touching`), may stop."""
        before, after = self.slip(t, start), self.slip(t + dt, end)
        meets = self.facing(t, start.position).may_dip(t, dt, start, end)
        if self.coulomb is None:
            return meets & ~touching
        return jnp.where(touching, (dot(before, after) <= 0) & (dot(before, before) > 0), meets)

    def may_dip(self, t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles) -> Bool[Array, "*lanes"]:
        """Whether the signed distance may fall below zero within a step; over a curve, whether the path can reach it."""
        dips = self.may_dip_as_cubic(t, dt, start, end)
        if not self.curved:
            return dips
        # a path shorter than both distances together cannot get to the surface and away again
        free = self.signed_distance(t, start.position) + self.signed_distance(t + dt, end.position)
        return dips | (free < bound_path_length(self, t, dt, start, end))

    def may_dip_as_cubic(self, t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles) -> Bool[Array, "*lanes"]:
        """The same of a distance that is a cubic in time, which stays above the lowest of its four Bézier points."""
        d0, d1 = self.signed_distance(t, start.position), self.signed_distance(t + dt, end.position)
        r0 = dt * dot(self.relative(t, *start), self.normal_at(t, start.position))
        r1 = dt * dot(self.relative(t + dt, *end), self.normal_at(t + dt, end.position))
        # the first point, d0, is left out: a lane that has just bounced is at zero and would always count
        return jnp.minimum(jnp.minimum(d0 + r0 / 3, d1 - r1 / 3), d1) < 0

    def nearest_shares(self, t: ArrayLike, start: Array, end: Array) -> tuple[Array, ...]:
        """Shares of a segment where it may come nearest other than at its ends: none where the surface is flat."""
        return ()

    # as part of a scene

    def prepare(self, state: Particles, couples: bool) -> "Surface":
        """The surface as part of a scene: with its response, and, for `impact`, which lanes begin in contact."""
        if self.motion is not None:
            self.motion.demand_fit(type(self).__name__, state.position.shape[-1])
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

    def remember_since(self: S, since: list[Array]) -> S:
        """The surface with new times [s] since when each lane is in contact with it, wall by wall."""
        return eqx.tree_at(lambda surface: surface.touching_since, self, since[0], is_leaf=lambda leaf: leaf is None)

    def forget_lanes(self: S, lanes: Bool[Array, "*lanes"]) -> S:
        """The surface with some lanes as if they had never been in contact with it."""
        if not self.memory:
            return self
        since = [wall.touching_since for wall in self.walls()]
        return self.remember_since([jnp.where(lanes, jnp.inf, start) for start in since if start is not None])

    def _arm(self, t: ArrayLike, position: Array) -> Array:
        """From the axis to positions [m]."""
        return self.rest_place(t, position) - self.axis_point(position)


serve_old_names(Surface, OLD_NAMES)


def _differentiate_along(function: Callable, t: ArrayLike, position: Array, velocity: Array) -> Array:
    """How fast a function of time and place changes at places that move with a velocity."""
    time = jnp.asarray(t, position.dtype)
    return jax.jvp(function, (time, position), (jnp.ones_like(time), velocity))[1]


@jax.jit  # one compilation instead of one for each operation
def _find_contact_start(wall: Surface, state: Particles) -> Array:
    """Since when each lane is in contact: from t = 0 if it begins on the surface and does not leave, else never (∞)."""
    (x, v), rounding = state, CONTACT_START_ROUNDING * float(jnp.finfo(state.dtype).eps)
    relative = wall.relative(0.0, x, v)
    normal_speed = dot(relative, wall.normal_at(0.0, x))
    on = jnp.abs(wall.signed_distance(0.0, x)) <= rounding * norm(x)
    along = normal_speed * normal_speed <= rounding**2 * dot(v, v)
    return lax.stop_gradient(jnp.where(on & along, 0.0, jnp.inf).astype(state.dtype))
