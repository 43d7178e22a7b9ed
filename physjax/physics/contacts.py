"""Surfaces that particles may not pass: each shape is a signed distance, and the answer to a touch is written once for all.

`gap` [m] is positive on the legal side, zero on the surface, negative on the wrong side; `outward` points to the legal side.
Shapes may move with a constant `velocity` [m/s] from where they are at t = 0 (a piston, a bat).
"""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.checks import concrete, demand, quantity
from physjax.scene import Contact, Particles
from physjax.vectors import dot, norm, over, scale, unit


class Coulomb(eqx.Module):
    """Dry friction: a touch holds up to μ_s times the normal impulse; beyond, it slips and is braked by μ_k times it."""

    static: Float[Array, "..."] = quantity("static friction μ_s", "1", at_least=0)
    kinetic: Float[Array, "..."] = quantity("kinetic friction μ_k", "1", at_least=0)

    def __check_init__(self):
        static, kinetic = concrete(self.static), concrete(self.kinetic)
        if static is not None and kinetic is not None:
            demand("kinetic friction μ_k [1]", self.kinetic, kinetic <= static, f"at most the static μ_s = {static}")


class Surface(Contact):
    """What every shape has: restitution K_r, at most one kind of friction, and a velocity if it moves.

    `restitution` is 1 for a perfect bounce, 0 for none. `friction` is the lecture's K_f, the fraction of the tangential
    velocity that a bounce takes; `coulomb` clamps the tangential impulse by the normal one instead. (K_r = 0 sticks
    only with K_f = 1 as well, and gravity acts again in the next step: the lecture's "stick to wall" is for a moment.)
    """

    restitution: Float[Array, "..."] = quantity("restitution K_r", "1", at_least=0, default=1.0, kw_only=True)
    friction: Float[Array, "..."] | None = quantity("friction K_f", "1", at_least=0, default=None, kw_only=True)
    coulomb: Coulomb | None = eqx.field(default=None, kw_only=True)
    velocity: Float[Array, "..."] | None = quantity("surface velocity", "m/s", default=None, kw_only=True)

    def __check_init__(self):
        for name, value in (("restitution K_r [1]", self.restitution), ("friction K_f [1]", self.friction)):
            if value is not None and concrete(value) is not None:
                demand(name, value, concrete(value) <= 1, "numbers from 0 to 1")
        if self.friction is not None and self.coulomb is not None:
            raise ValueError("contact: got friction= (the lecture's K_f) and coulomb=, expected at most one of them.")

    @abstractmethod
    def gap(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes"]:
        """Signed distance to the surface [m], > 0 on the legal side."""

    @abstractmethod
    def outward(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """Unit vector towards the legal side."""

    def respond(self, t: ArrayLike, state: Particles) -> Particles:
        """The state after a touch: `project`."""
        return project(self, t, state)

    def _still(self, t: ArrayLike, position: Array) -> Array:
        """Positions as the surface sees them, which thinks that it stands where it was at t = 0."""
        return position if self.velocity is None else position - scale(t, over(self.velocity, position))


class Plane(Surface):
    """A floor, a wall, a slope: legal is (X - P)·N > 0. The normal N is made a unit vector."""

    point: Float[Array, "..."] = quantity("point of the plane", "m")
    normal: Float[Array, "..."] = quantity("normal of the plane", "1")

    def __check_init__(self):
        _demand_direction("normal of the plane", self.normal)

    def gap(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes"]:
        """(X - P)·N [m]."""
        return dot(self._still(t, position) - over(self.point, position), self.outward(t, position))

    def outward(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """N, of length 1."""
        return over(unit(self.normal), position)


class Slab(Surface):
    """A plate of finite thickness [m] with two legal sides, about the plane through a point."""

    point: Float[Array, "..."] = quantity("point in the middle of the slab", "m")
    normal: Float[Array, "..."] = quantity("normal of the slab", "1")
    thickness: Float[Array, "..."] = quantity("thickness", "m", above=0)

    def __check_init__(self):
        _demand_direction("normal of the slab", self.normal)

    def gap(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes"]:
        """Distance to the nearer face [m]."""
        return jnp.abs(self._height(t, position)) - self.thickness / 2

    def outward(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """The normal of the nearer face."""
        side = jnp.where(self._height(t, position) < 0, -1.0, 1.0)
        return scale(side, over(unit(self.normal), position))

    def _height(self, t, position):
        return dot(self._still(t, position) - over(self.point, position), over(unit(self.normal), position))


class Sphere(Surface):
    """A ball in the way, or with `inside=True` a bowl that keeps what it holds."""

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

    def _offset(self, t, position):
        return self._still(t, position) - over(self.center, position)


class Room(Surface):
    """A closed box between two corners; every particle stays in it, in a corner too."""

    lower: Float[Array, "..."] = quantity("lower corner", "m")
    upper: Float[Array, "..."] = quantity("upper corner", "m")

    def __check_init__(self):
        lower, upper = concrete(self.lower), concrete(self.upper)
        if lower is not None and upper is not None:
            demand("upper corner [m]", self.upper, upper > lower, f"above the lower corner {lower} in every component")

    def walls(self) -> tuple[Plane, ...]:
        """The six planes (four in the plane), normals inward."""
        dim = self.lower.shape[-1]
        about = {name: getattr(self, name) for name in ("restitution", "friction", "coulomb", "velocity")}
        axes = jnp.eye(dim, dtype=self.lower.dtype)
        return tuple(
            Plane(corner, sign * axes[i], **about)
            for corner, sign in ((self.lower, 1.0), (self.upper, -1.0))
            for i in range(dim)
        )

    def gap(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes"]:
        """Distance to the nearest wall [m]; outside, to the farthest one that was passed."""
        gaps = [wall.gap(t, position) for wall in self.walls()]
        return jnp.min(jnp.stack(gaps), axis=0)

    def outward(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """The normal of the nearest wall."""
        nearest = jnp.argmin(jnp.stack([wall.gap(t, position) for wall in self.walls()]), axis=0)
        normals = [wall.outward(t, position) for wall in self.walls()]
        return sum(scale((nearest == i).astype(position.dtype), n) for i, n in enumerate(normals))

    def respond(self, t: ArrayLike, state: Particles) -> Particles:
        """`project`, wall by wall: in a corner two or three of them answer."""
        for wall in self.walls():
            state = project(wall, t, state)
        return state


def project(surface: Surface, t: ArrayLike, state: Particles) -> Particles:
    """The lecture's answer to a touch: back to the surface, and v' = (1 - K_f) v_t - K_r v_n for a lane that was going in.

    Cheap and robust, first order in dt: the bounce happens at the end of the step, not when the surface was met, and a
    lane that crosses a thin obstacle within one step is not seen. Velocities are relative to a moving surface.
    """
    x, v = state
    gap, normal = surface.gap(t, x), surface.outward(t, x)
    relative = v if surface.velocity is None else v - over(surface.velocity, v)
    inward = jnp.where(gap < 0, jnp.minimum(dot(relative, normal), 0.0), 0.0)
    push = (1 + surface.restitution) * inward
    loss = _tangential_loss(surface, relative, normal, inward)
    # per-lane coefficients instead of a choice between vectors, which would cost several times the step
    if loss is not None:
        v = v - scale(loss, relative)
        push = push - loss * inward
    return Particles(x - scale(jnp.minimum(gap, 0.0), normal), v - scale(push, normal))


def _tangential_loss(surface: Surface, relative: Array, normal: Array, inward: Array) -> Array | None:
    """The fraction of the tangential velocity that a touch takes, per lane; None for a frictionless surface."""
    if surface.friction is not None:
        return jnp.where(inward < 0, surface.friction, 0.0)
    if surface.coulomb is None:
        return None
    # by Pythagoras, without the tangential vector; the floor keeps the slope of the root finite
    speed = jnp.sqrt(jnp.maximum(dot(relative, relative) - inward * inward, 1e-30))
    impulse = -(1 + surface.restitution) * inward  # per unit of mass
    slipping = speed > surface.coulomb.static * impulse
    share = surface.coulomb.kinetic * impulse / jnp.where(slipping, speed, 1.0)
    return jnp.where(inward < 0, jnp.where(slipping, share, 1.0), 0.0)


def _demand_direction(name: str, vector: Array) -> None:
    values = concrete(vector)
    if values is not None:
        demand(f"{name} [1]", vector, (values**2).sum(axis=-1, keepdims=True) > 0, "a vector that is not zero")
