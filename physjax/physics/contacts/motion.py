"""How a surface is driven: as a rigid body, along a path and about an axis, both functions of time."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.checks import OptionalNumbers, demand_direction, quantity
from physjax.parts import as_module
from physjax.tracebacks import Module, explain_tracer_error
from physjax.vectors import broadcast_vector, dot, scale, spin, unit

__all__ = ["Motion"]


class Motion(Module):
    """The motion of a surface as a function of time: x(t) = P + R(θ(t)) (X - P) + s(t) of each of its points X.

    `displacement(t)` is s [m], a vector; `angle(t)` is θ [rad], about the `pivot` P [m], the origin unless given: in the
    plane anticlockwise, in space about an `axis`. A surface is given where it stands where both are zero. Its velocity
    and acceleration are their derivatives, so both must be smooth, and steps short enough to follow them. They are
    called with t [s] as a scalar or with an axis of length 1 in place of the components, `(*lanes, 1)`: write
    `jnp.array([0.0, 0.1]) * jnp.sin(9.0 * t)`. Numbers of a function that is an `equinox.Module` can be swept and
    differentiated; a plain function recompiles for each new one. Raises TypeError or ValueError otherwise.

    Example:
        >>> shaken = contacts.Motion(displacement=lambda t: jnp.array([0.0, 2.0]) * t**2)
        >>> table = contacts.Plane((0.0, 0.0), (0.0, 1.0), motion=shaken)
        >>> print(table.signed_distance(0.5, ball.position), table.velocity_at(0.5, ball.position))
        9.5 [0. 2.]
        >>> door = contacts.Plane((0.0, 0.0), (0.0, 1.0), motion=contacts.Motion(angle=lambda t: jnp.pi / 2 * t))
        >>> print(jnp.round(door.normal_at(1.0, ball.position), 6) + 0.0)
        [-1.  0.]
    """

    displacement: Callable | None
    angle: Callable | None
    pivot: OptionalNumbers = quantity("pivot", "m", kind="place", default=None)
    axis: OptionalNumbers = quantity("axis", "1", kind="vector", default=None)

    def __init__(
        self,
        displacement: Callable | None = None,
        angle: Callable | None = None,
        pivot: ArrayLike | None = None,
        axis: ArrayLike | None = None,
    ):
        for name, function in (("displacement", displacement), ("angle", angle)):
            if function is not None and (not callable(function) or isinstance(function, type)):
                raise TypeError(f"Motion: got {name}={function!r}, expected a function of the time t.")
        if displacement is None and angle is None:
            raise ValueError(
                "Motion: got neither displacement= nor angle=, expected at least one function of the time t."
            )
        self.displacement = None if displacement is None else as_module(displacement)
        self.angle = None if angle is None else as_module(angle)
        self.pivot, self.axis = pivot, axis  # pyright: ignore[reportAttributeAccessIssue]  # converted by `quantity`

    def __check_init__(self):
        if self.angle is None and (self.pivot is not None or self.axis is not None):
            raise ValueError(
                "Motion: got pivot= or axis= without angle=, expected the function that says how far it turns."
            )
        if self.axis is not None:
            demand_direction("axis of the motion", self.axis)

    def relations(self) -> tuple[Array, ...]:
        """Conditions on its numbers, checked also where they are traced."""
        return () if self.axis is None else (dot(self.axis, self.axis) > 0,)

    def demand_fit(self, name: str, dim: int) -> None:
        """Raise a ValueError unless the functions give what a surface in so many dimensions needs."""
        if self.angle is not None and (self.axis is None) == (dim == 3):
            wanted = "axis=, the direction that it turns about" if dim == 3 else "no axis= in the plane"
            raise ValueError(f"{name}: got a motion with angle= and axis {self.axis}, expected {wanted}.")
        lanes = 2, 1  # a time for each lane, which shows functions that take a number alone
        for what, function, width in (("displacement", self.displacement, dim), ("angle", self.angle, 1)):
            if function is None:
                continue
            for t in ((), lanes):
                example = "jnp.array([0.0, 0.1]) * jnp.sin(9.0 * t)" if width > 1 else "0.3 * jnp.sin(9.0 * t)"
                wanted = f"{width} components, such as {example}" if width > 1 else f"an angle, such as {example}"
                try:
                    with jax.numpy_rank_promotion("allow"):
                        found = jax.eval_shape(function, jax.ShapeDtypeStruct(t, jnp.result_type(float))).shape
                except (TypeError, ValueError) as error:
                    words = explain_tracer_error(error)
                    reason = str(error) if words is None else f"It {words}"
                    raise ValueError(
                        f"{name}: got a motion whose {what} cannot be called with a time of shape {t}, "
                        f"expected {wanted}. {reason}"
                    ) from error
                if found[-1:] not in ((), (1,), (width,)) or (not found and width > 1):
                    raise ValueError(
                        f"{name}: got a motion whose {what} has the shape {found} for a time of shape {t}, expected {wanted}."
                    )

    def place(self, t: ArrayLike, rest: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """Where points of the surface are at a time, given where they are at rest [m]."""
        pivot = self._pivot(rest)
        turned = rest if self.angle is None else pivot + self.turn(t, rest - pivot)
        return turned if self.displacement is None else turned + self._displacement(t, rest)

    def rest_place(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """Where the points that are at positions at a time are at rest [m]: the inverse of `place`."""
        moved = position if self.displacement is None else position - self._displacement(t, position)
        if self.angle is None:
            return moved
        pivot = self._pivot(position)
        return pivot + self._turn_by(-self._angle(t, position), moved - pivot)

    def turn(self, t: ArrayLike, direction: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """A direction of the surface at a time, given that at rest."""
        return direction if self.angle is None else self._turn_by(self._angle(t, direction), direction)

    def velocity_at(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes dim"]:
        """The velocity of the points that are at positions at a time [m/s]."""
        rest, time = self.rest_place(t, position), jnp.asarray(t, position.dtype)
        return jax.jvp(lambda time: self.place(time, rest), (time,), (jnp.ones_like(time),))[1]

    def spin_at(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes turns"] | None:
        """How fast it turns at a time [rad/s], for each position: one number in the plane, three in space; else None."""
        if self.angle is None:
            return None
        time = jnp.asarray(t, position.dtype)
        rate = jax.jvp(lambda time: self._angle(time, position), (time,), (jnp.ones_like(time),))[1]
        if self.axis is None:
            return jnp.broadcast_to(rate[..., None], (*position.shape[:-1], 1))
        return scale(rate, broadcast_vector(unit(self.axis), position))

    def _pivot(self, like: Array) -> Array:
        return jnp.zeros_like(like) if self.pivot is None else broadcast_vector(self.pivot, like)

    def _displacement(self, t: ArrayLike, like: Array) -> Array:
        assert self.displacement is not None
        return jnp.broadcast_to(_ask(self.displacement, t, like), like.shape)

    def _angle(self, t: ArrayLike, like: Array) -> Array:
        assert self.angle is not None
        angle = _ask(self.angle, t, like)
        return angle[..., 0] if angle.ndim else angle

    def _turn_by(self, angle: Array, vector: Array) -> Array:
        cosine, sine = jnp.cos(angle), jnp.sin(angle)
        if self.axis is None:
            return scale(cosine, vector) + scale(sine, spin(jnp.ones((), vector.dtype), vector))
        axis = broadcast_vector(unit(self.axis), vector)
        # O. Rodrigues 1840
        along = scale((1 - cosine) * dot(axis, vector), axis)
        return scale(cosine, vector) + scale(sine, spin(axis, vector)) + along


def _ask(function: Callable, t: ArrayLike, like: Array) -> Array:
    """What a function of time returns, in a dtype; where lanes have times of their own, with these for components."""
    t = jnp.asarray(t, like.dtype)
    with jax.numpy_rank_promotion("allow"):  # a function that is written for one time is called with many
        return jnp.asarray(function(t[..., None] if t.ndim else t), like.dtype)
