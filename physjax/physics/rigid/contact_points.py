"""What of a rigid body can touch: points with a radius around each. Boxes, balls, capsules, and sets of points on planes.

    floor = contacts.Plane((0, 0, 0), (0, 1, 0), restitution=0.3, coulomb=contacts.Coulomb(0.6, 0.5))
    brick, hull = inertia.box(2.0, size), rigid.ContactPoints.box(size)
    Scene(rigid.bodies(brick, (0, 2, 0)), brick, (forces.Gravity(),), contacts=(rigid.SurfaceContact(hull, floor),))

A box touches a plane with its corners, a ball with its centre at a radius, a capsule, or a cylinder that lies, with the
two ends of its axis. Bodies pass through each other: there are no stacks, and no mesh against mesh.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.checks import as_real_quantity, demand_start_outside, unchecked_quantity
from physjax.particles import Particles
from physjax.parts import Contact
from physjax.physics.contacts.path_search import find_path_dip
from physjax.physics.contacts.surface import Surface
from physjax.physics.rigid.impulses import Points
from physjax.physics.rigid.inertia import Inertia
from physjax.physics.rigid.response import ContactPointState, collide
from physjax.physics.rigid.spatial import RigidBodies, angular_velocity, to_world_frame
from physjax.vectors import cross, scale


class ContactPoints(eqx.Module):
    """Points of a body [m], in its frame from its centre of mass, each with a `radius` [m] around it.

    `points` are `(points, 3)`, or `(*lanes, points, 3)` where bodies differ; `radius` is a scalar or per lane.

    Example:
        >>> rigid.ContactPoints.box((1.0, 2.0, 3.0)).points.shape
        (8, 3)
    """

    points: Float[Array, "*lanes points 3"] = unchecked_quantity("points of the hull", "m", kind="place", per="point")
    radius: Float[Array, "..."] = unchecked_quantity("radius of the hull", "m", at_least=0)

    def __init__(self, points: Any, radius: Any = 0.0):
        self.points = as_real_quantity("points of the hull [m]", points)
        self.radius = as_real_quantity("radius of the hull [m]", radius, at_least=0.0)
        if self.points.ndim < 2 or self.points.shape[-1] != 3 or not self.points.size:
            raise ValueError(
                f"ContactPoints: got points of shape {self.points.shape}, expected (points, 3), or (*lanes, points, 3): at least "
                "one. A ball is ContactPoints.sphere(radius)."
            )

    @classmethod
    def box(cls, size: ArrayLike) -> "ContactPoints":
        """The eight corners of a box with edges a, b, c [m], `(3,)` or `(*lanes, 3)`."""
        size = as_real_quantity("size [m]", size, above=0.0)
        corners = [scale(0.5, size * jnp.broadcast_to(jnp.asarray(c, size.dtype), size.shape)) for c in _CORNERS]
        return cls(jnp.stack(corners, axis=-2))

    @classmethod
    def sphere(cls, radius: ArrayLike) -> "ContactPoints":
        """A ball: its centre, and a radius [m]."""
        return cls(jnp.zeros((1, 3)), as_real_quantity("radius [m]", radius, above=0.0))

    @classmethod
    def capsule(cls, radius: ArrayLike, length: float, *, axis: int = 2) -> "ContactPoints":
        """The ends of an axis of a `length` [m], and a radius [m] around it; on its side, a cylinder too touches so."""
        if axis not in (0, 1, 2):
            raise ValueError(f"axis: got {axis!r}, expected 0, 1 or 2: the axis of the body's frame that it is along.")
        end = as_real_quantity("length [m]", length, above=0.0) / 2
        along = jnp.stack([end if i == axis else jnp.zeros_like(end) for i in range(3)], axis=-1)
        return cls(jnp.stack([-along, along], axis=-2), as_real_quantity("radius [m]", radius, above=0.0))

    def arms(self, bodies: RigidBodies) -> Float[Array, "points *lanes 3"]:
        """From each body's centre of mass to its points [m], in the world's frame, the points first."""
        return jax.vmap(lambda point: to_world_frame(bodies, point))(jnp.moveaxis(self.points, -2, 0))


_CORNERS = tuple(product((-1.0, 1.0), repeat=3))


class SurfaceContact(Contact):
    """A hull that may not pass a surface, which may move: K_r and Coulomb's friction are the surface's.

    The moment of an impact is found inside the step, and the impulses at all points that touch then obey Poisson's rule
    with Coulomb's friction at μ_k; no impact can add energy. Points that stay are held, roll or slide there, second
    order in dt. A body that is slower than a millionth of what a step's load gives, and whose reactions balance that
    load, keeps its place to the last bit. Where forces couple the bodies, impacts are answered at the end of the step.
    Points are followed through the step: no plate is too thin for them, no ball too small, as long as the method follows
    how the body turns.

    Only points touch: the edge of a box passes through a ball that is a surface, and through a kerb. Bodies do not
    hang on a pivot.

    Example:
        >>> touch = rigid.SurfaceContact(rigid.ContactPoints.sphere(0.5), contacts.Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
        >>> float(touch.signed_distance(0.0, jnp.array([0.0, 2.0, 0.0])))
        1.5
    """

    hull: ContactPoints
    surface: Surface

    @property
    def response(self) -> Callable:
        """How touches are answered."""
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
                "SurfaceContact: got a surface with friction= or response=, expected coulomb=Coulomb(static, kinetic) or nothing: "
                "the others are for particles."
            )

    def point_state(self, t: ArrayLike, bodies: RigidBodies, inertia: Inertia) -> ContactPointState:
        """The points of the hull as the surface feels them; what touches is a radius below each."""
        arm = self.hull.arms(bodies)
        time = jnp.broadcast_to(t, arm.shape[:-1])
        where = bodies.position[None] + arm
        normal = self.surface.normal_at(time, where)
        omega = jnp.broadcast_to(angular_velocity(bodies, inertia), arm.shape)
        straight = scale(1 / inertia.mass, bodies.momentum)[None]
        center = Particles(where, straight + cross(omega, arm))
        low = arm - scale(self._radius(arm), normal)
        wide = lambda number: jnp.broadcast_to(number, time.shape)  # noqa: E731
        dry = self.surface.coulomb
        friction = None if dry is None else (wide(dry.static), wide(dry.kinetic))
        points = Points(low, normal, self.surface.relative(straight + cross(omega, low)), friction)
        turning = None
        if self.surface.curved:
            along = self.surface.relative(center.velocity)
            turning = self.surface.normal_rate(time, where, along), self._radius(arm)
        return ContactPointState(
            points, center, self.signed_distance(time, where), wide(self.surface.restitution), turning
        )

    def walls(self) -> tuple["SurfaceContact", ...]:
        """A touch of the hull with each of the surfaces that its surface is made of."""
        walls = self.surface.walls()
        return (self,) if len(walls) == 1 else tuple(replace(self, surface=wall) for wall in walls)

    def facing(self, t: ArrayLike, state: RigidBodies) -> "SurfaceContact":
        """The touch with the surface as a body in its place sees it: a plate has the face that its centre of mass is before."""
        face = self.surface.facing(t, state.position)
        return self if face is self.surface else replace(self, surface=face)

    def signed_distance(self, t: ArrayLike, position: Float[Array, "*lanes 3"]) -> Float[Array, "*lanes"]:
        """Signed distance of the ball around a point at this place to the surface [m]."""
        return self.surface.signed_distance(t, position) - self._radius(position)

    def normal_at(self, t: ArrayLike, position: Float[Array, "*lanes 3"]) -> Float[Array, "*lanes 3"]:
        """Unit vector away from the surface."""
        return self.surface.normal_at(t, position)

    def relative(self, velocity: Float[Array, "*lanes 3"]) -> Float[Array, "*lanes 3"]:
        """Velocities as seen from the surface [m/s]."""
        return self.surface.relative(velocity)

    @property
    def narrow(self) -> bool:
        """Whether a fast point may pass through the surface and out again within a step: a ball, not a wall or a plate."""
        return self.surface.curved and not getattr(self.surface, "inside", False)

    def deepest(self, t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles, dip: tuple[Array, Array]) -> tuple:
        """Where in a leg a point comes lowest, as a share of it, and its gap there, as the surface finds it."""
        if self.surface.curved and type(self.surface).deepest is Surface.deepest:
            return find_path_dip(self, t, dt, start, end, dip)  # a radius around each point
        radius = self._radius(start.position)
        share, depth = self.surface.deepest(t, dt, start, end, (dip[0], dip[1] + radius))
        return share, depth - radius

    def clearance(self, t: ArrayLike, state: RigidBodies) -> Float[Array, "*lanes"]:
        """Signed distance of each body's lowest point to the surface [m]."""
        where, face = state.position[None] + self.hull.arms(state), self.facing(t, state)
        return jnp.min(face.signed_distance(jnp.broadcast_to(t, where.shape[:-1]), where), axis=0)

    def respond(self, t: ArrayLike, state: RigidBodies) -> RigidBodies:
        """The bodies that are on the wrong side moved out of it, their velocities as they were."""
        depth = jnp.minimum(self.clearance(t, state), 0.0)
        return state._replace(position=state.position - scale(depth, self.surface.normal_at(t, state.position)))

    def demand_fit(self, state: Any, mass: Any) -> None:
        """Raise a TypeError for a state that is not of rigid bodies, a ValueError for bodies on the wrong side or a pivot."""
        if not isinstance(state, RigidBodies):
            raise TypeError(
                f"SurfaceContact: got a state of type {type(state).__name__}, expected RigidBodies; particles touch the surface "
                "itself: contacts=(surface,)."
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
