"""Rigid bodies on surfaces: contact points that may not pass a plane, a slab, a ball, a room or a user's shape.

    floor = contacts.Plane((0, 0, 0), (0, 1, 0), restitution=0.3, coulomb=contacts.Coulomb(0.6, 0.5))
    brick, hull = inertia.box(2.0, size), rigid.ContactPoints.box(size)
    Scene(rigid.bodies(brick, (0, 2, 0)), brick, (forces.Gravity(),), contacts=(rigid.SurfaceContact(hull, floor),))

Bodies pass through each other: `rigid.Solids` keeps them apart.
"""

from collections.abc import Callable
from dataclasses import replace

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.checks import demand_start_outside
from physjax.loops import is_library_part
from physjax.particles import Particles
from physjax.physics.contacts.face import LowestPoint
from physjax.physics.contacts.path_search import find_path_dip
from physjax.physics.contacts.surface import Surface
from physjax.physics.rigid.contact_points import ContactPoints
from physjax.physics.rigid.impulses import Points
from physjax.physics.rigid.inertia import Inertia
from physjax.physics.rigid.point_contacts import ContactPointState, PointContact
from physjax.physics.rigid.response import collide
from physjax.physics.rigid.spatial import RigidBodies
from physjax.scene import Scene
from physjax.vectors import cross, scale


class SurfaceContact(PointContact):
    """A hull that may not pass a surface, which may move; K_r and Coulomb's friction are the surface's.

    The time of an impact is found within the step, and the impulses at all points that touch then obey Poisson's rule
    with Coulomb's friction at μ_k; no impact adds energy. Points that stay stick, roll or slide, second order in dt. A
    body slower than a millionth of the speed that a step's load gives, with reactions that balance that load, keeps its
    place to the last bit. Where forces couple the bodies, impacts are resolved at the end of the step. Points are
    followed through the step: no plate is too thin for them and no ball too small, as long as the method resolves how
    the body turns.

    Only points touch: the edge of a box passes through a ball that is a surface, and through a kerb. Bodies on a pivot
    are refused.

    Example:
        >>> touch = rigid.SurfaceContact(rigid.ContactPoints.sphere(0.5), contacts.Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
        >>> float(touch.signed_distance(0.0, jnp.array([0.0, 2.0, 0.0])))
        1.5
    """

    surface: Surface

    @property
    def response(self) -> Callable[..., Scene]:  # pyright: ignore[reportIncompatibleVariableOverride]  # as in `Surface`
        """How its contacts are resolved: `collide`."""
        return collide

    def __check_init__(self):
        for name, part, kind, example in (
            ("hull", self.hull, ContactPoints, "rigid.ContactPoints.box((1, 2, 3))"),
            ("surface", self.surface, Surface, "contacts.Plane((0, 0, 0), (0, 1, 0))"),
        ):
            if not isinstance(part, kind):
                raise TypeError(
                    f"SurfaceContact: got a {name} of type {type(part).__name__}, expected a {kind.__name__}: {example}."
                )
        if self.surface.friction is not None or self.surface.response is not None:
            raise ValueError(
                "SurfaceContact: got a surface with friction= or response=, expected coulomb=Coulomb(static, kinetic) or "
                "nothing: the others are for particles."
            )

    def point_state(self, t: ArrayLike, bodies: RigidBodies, velocities: tuple[Array, Array]) -> ContactPointState:
        """The points of the hull at the surface; what touches is a radius below each of them."""
        arm = self.hull.arms(bodies)
        time = jnp.broadcast_to(t, arm.shape[:-1])
        where = bodies.position[None] + arm
        normal = self.surface.normal_at(time, where)
        straight, omega = (jnp.broadcast_to(vector, arm.shape) for vector in velocities)
        center = Particles(where, straight + cross(omega, arm))
        # the point of the hull that is nearest to the surface: a radius below the center, along the normal
        low = arm - scale(self._radius(arm), normal)
        per_point = lambda number: jnp.broadcast_to(number, time.shape)  # noqa: E731
        dry = self.surface.coulomb
        friction = None if dry is None else (per_point(dry.static), per_point(dry.kinetic))
        touch = Particles(bodies.position[None] + low, straight + cross(omega, low))
        points = Points(low, normal, self.surface.slip(time, touch), friction)
        turning, moves = None, center.velocity
        if self.surface.curved or self.surface.motion is not None:
            along = self.surface.relative(time, where, center.velocity)
            turning = self.surface.normal_rate(time, where, along), self._radius(arm)
            moves = moves - scale(turning[1], turning[0])
        return ContactPointState(
            points,
            center,
            self.signed_distance(time, where),
            per_point(self.surface.restitution),
            turning,
            self.surface.velocity_rate(time, touch.position, moves),
        )

    def walls(self) -> tuple["SurfaceContact", ...]:
        """A contact of the hull with each of the surfaces that its surface consists of."""
        walls = self.surface.walls()
        return (self,) if len(walls) == 1 else tuple(replace(self, surface=wall) for wall in walls)

    def facing(self, t: ArrayLike, state: RigidBodies) -> "SurfaceContact":
        """The contact with the surface as a body meets it: of a plate, the face on the side of its center of mass."""
        face = self.surface.facing(t, state.position)
        return self if face is self.surface else replace(self, surface=face)

    def signed_distance(self, t: ArrayLike, position: Float[Array, "*lanes 3"]) -> Float[Array, "*lanes"]:
        """Signed distance to the surface of the ball around a point at this place [m]."""
        return self.surface.signed_distance(t, position) - self._radius(position)

    def normal_at(self, t: ArrayLike, position: Float[Array, "*lanes 3"]) -> Float[Array, "*lanes 3"]:
        """Unit vector away from the surface."""
        return self.surface.normal_at(t, position)

    def relative(
        self, t: ArrayLike, position: Float[Array, "*lanes 3"], velocity: Float[Array, "*lanes 3"]
    ) -> Float[Array, "*lanes 3"]:
        """Velocities relative to the surface [m/s]."""
        return self.surface.relative(t, position, velocity)

    @property
    def moves(self) -> bool:
        """Whether the surface may be elsewhere at another time: the library's own only where they are led."""
        led = self.surface.velocity is not None or self.surface.motion is not None
        return led or not is_library_part(type(self.surface))

    @property
    def narrow(self) -> bool:
        """Whether a fast point may pass through the surface and out again within a step."""
        return self.surface.narrow

    def deepest(self, t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles, dip: LowestPoint) -> LowestPoint:
        """Where in a leg a point comes lowest, as a share of it, and its distance there [m], as the surface finds it."""
        if self.surface.curved and type(self.surface).deepest is Surface.deepest:
            # the path is searched against this contact, which lies a radius above the surface
            return find_path_dip(self, t, dt, start, end, dip)
        radius = self._radius(start.position)
        share, depth = self.surface.deepest(t, dt, start, end, (dip[0], dip[1] + radius))
        return share, depth - radius

    def measure_points(self, t: ArrayLike, state: RigidBodies) -> Float[Array, "points *lanes"]:
        """Signed distance of each point of the hull to the surface [m]."""
        where = state.position[None] + self.hull.arms(state)
        return self.signed_distance(jnp.broadcast_to(t, where.shape[:-1]), where)

    def clearance(self, t: ArrayLike, state: RigidBodies) -> Float[Array, "*lanes"]:
        """Signed distance of each body's lowest point to the surface [m]."""
        return jnp.min(self.facing(t, state).measure_points(t, state), axis=0)

    def respond(self, t: ArrayLike, state: RigidBodies) -> RigidBodies:
        """The bodies on the wrong side moved out of the surface, their velocities unchanged."""
        depth = jnp.minimum(self.clearance(t, state), 0.0)
        return state._replace(position=state.position - scale(depth, self.surface.normal_at(t, state.position)))

    def demand_fit(self, state: object, mass: object) -> None:
        """Raise a TypeError unless the state is of rigid bodies, a ValueError for bodies on the wrong side or on a pivot."""
        if not isinstance(state, RigidBodies) or not isinstance(mass, Inertia):
            raise TypeError(
                f"SurfaceContact: got a state of type {type(state).__name__}, expected RigidBodies; for particles "
                "the surface itself is a contact: contacts=(surface,)."
            )
        if mass.arm is not None:
            raise ValueError(
                "SurfaceContact: got bodies on a pivot, expected free ones: a pivot leaves no place for an impulse."
            )
        lanes = state.lanes
        if self.hull.points.shape[:-2] not in ((), lanes) or self.hull.radius.shape not in ((), lanes):
            raise ValueError(
                f"ContactPoints: got points {self.hull.points.shape} and radius {self.hull.radius.shape} for bodies in lanes "
                f"{lanes}, expected (points, 3) and (), or with these lanes in front."
            )
        demand_start_outside(self, state)

    def _radius(self, like: Array) -> Array:
        return jnp.broadcast_to(self.hull.radius, like.shape[:-1])


Hull, Touch = ContactPoints, SurfaceContact
"""The names of the first edition."""
