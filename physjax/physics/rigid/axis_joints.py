"""Exact joints with an axis: hinges, which turn about it, and sliders, which move along it; both may have limits and a motor."""

from collections.abc import Sequence
from typing import cast

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from physjax.checks import OptionalNumbers, quantity, unchecked_quantity
from physjax.constraints.constraint import PushedRows
from physjax.constraints.coordinates import Coordinates, Places
from physjax.constraints.elimination import Pairs
from physjax.constraints.ranges import Rows
from physjax.physics.rigid.body_joints import (
    BodyJoints,
    as_axes,
    check_axis,
    check_joints,
    differentiate_rows,
    subtract_arms,
    subtract_points,
)
from physjax.physics.rigid.joint_coordinates import SpatialCoordinates, cross_rows, dot_components, normalise
from physjax.physics.rigid.joint_drives import DrivenJoints, Limits
from physjax.physics.rigid.turns import measure_turn, remember_turns


class Hinges(DrivenJoints):
    """A point of each of two bodies stays at that of the other, and they turn about an axis alone.

    In space `axis` is a direction in the frames of both bodies, `(3,)` or `(joints, 3)`, or one in each, `(joints, 2, 3)`; of
    the world, index -1, it is a direction in space. In the plane there is none. Of `limits`, the least and the greatest angle
    [rad] by which the second body is turned relative to the first, either may be None; in space they are from -π to π. What
    comes to a limit stops there and does not rebound. A `motor` turns the second body at that speed [rad/s] relative to the
    first, a `servo` towards that angle [rad], from which it is away by e^(-t/`response_time`) of the start, either with at
    most `torque` [N m]. All are one number or one for each joint, swept over scenes `(*scenes, joints)`. For the rest see
    `Joints`.

    Example:
        >>> wheel = inertia.planar_disc(2.0, 0.5)
        >>> axle = rigid.Hinges([(-1, 0)], [[[0.0, 0.0], [0.0, 0.0]]], motor=6.0, torque=0.5)
        >>> turned = Scene(rigid.planar_bodies(wheel, [[0.0, 0.0]]), wheel, (axle,))
        >>> for seconds in (1.0, 4.0):
        ...     state = simulate(turned, methods.verlet, dt=0.01, duration=seconds).final_scene.state
        ...     print(round(float(state.angular_momentum[0] / wheel.moment), 3))
        2.0
        6.0
    """

    pairs: Pairs = eqx.field(static=True)
    points: Float[Array, "joints 2 dim"] = unchecked_quantity("points of the joints", "m", kind="place", per=None)
    axis: Float[Array, "joints 2 3"] | None = unchecked_quantity("axis", "1", kind="vector", per=None)
    torque: OptionalNumbers = quantity("torque", "N m", per="joint", at_least=0, default=None)

    def __init__(
        self,
        pairs: ArrayLike | Sequence,
        points: ArrayLike | Sequence,
        axis: ArrayLike | Sequence | None = None,
        *,
        limits: Limits | None = None,
        motor: ArrayLike | Sequence | None = None,
        servo: ArrayLike | Sequence | None = None,
        response_time: ArrayLike | Sequence | None = None,
        torque: ArrayLike | Sequence | None = None,
        order: int = 2,
        substeps: int | None = 1,
        breaks_at: ArrayLike | Sequence | None = None,
    ):
        self.pairs, self.points = check_joints("Hinges", pairs, points)
        dim = self.points.shape[-1]
        if (axis is None) != (dim == 2):
            raise ValueError(
                f"Hinges: got points with {dim} components and axis={axis}, expected an axis in space and none in the plane."
            )
        self.axis = None if axis is None else as_axes("Hinges", axis, len(self.pairs))
        self.set_options(order, substeps, breaks_at)
        self.torque = self.set_drive("rad", limits, motor, servo, response_time, ("torque", "N m", torque))

    @property
    def cap(self) -> Array | None:
        """The most that a motor exerts [N m]."""
        return self.torque

    @property
    def held_rows(self) -> int:
        """The directions, and in space two angles."""
        return 2 if self.axis is None else 5

    @property
    def force_rows(self) -> int:
        """The directions."""
        return self.points.shape[-1]

    def measure(self, first: Places, second: Places) -> Float[Array, "rows joints worlds"]:
        """From the first point to the second [m], in space the cosines of one axis across the other, and the angle [rad]."""
        if self.axis is None:
            rows = subtract_points(self.place_ends(first, second))
            return jnp.stack([*rows, self._measure_angle(first, second)] if self.bounded else rows)
        axes = self._find_axes()
        return self._stack_rows(first, second, axes, *self.turn_ends(first, second, self._choose_directions(axes)))

    def differentiate(self, reader: Coordinates, first: Places, second: Places) -> tuple[Rows, PushedRows, PushedRows]:
        """The rows and their change with moves of either end, in space in closed form; of the angle, as the axes are closed."""
        if self.axis is None:
            return super().differentiate(reader, first, second)
        axes = self._find_axes()
        arms, pairs = self.turn_ends(first, second, self._choose_directions(axes))
        across = cross_rows(pairs[:, 0], pairs[:, 1])
        if self.bounded:
            across = jnp.concatenate([across, -pairs[:, 0, :1]], axis=1)
        return self._stack_rows(first, second, axes, arms, pairs), *differentiate_rows(arms, across)

    def _find_axes(self) -> Array:
        """The directions of the axes in the frames of both bodies, `(3, 2, joints, 1)`."""
        return normalise(jnp.transpose(jnp.asarray(self.axis))[..., None])

    def _choose_directions(self, axes: Array) -> Array:
        """Pairs that are across each other, `(3, 2, 2, joints, 1)`: the first body's axis, twice, and normals of the second's."""
        axis, normals = axes[:, 0], SpatialCoordinates().find_normals(axes[:, 1])
        return jnp.stack([jnp.stack([axis, axis], axis=1), jnp.stack(normals, axis=1)], axis=1)

    def _stack_rows(self, first: Places, second: Places, axes: Array, arms: Array, pairs: Array) -> Rows:
        """The rows in space, given what is turned with the bodies."""
        rows = [subtract_arms(first, second, arms), jnp.sum(pairs[:, 0] * pairs[:, 1], axis=0)]
        if self.bounded:
            rows.append(SpatialCoordinates().measure_twist(first, second, axes)[None])
        return jnp.concatenate(rows)

    def angle(self, state: PyTree) -> Float[Array, "*scenes joints"]:
        """By how much the second body of each joint is turned relative to the first [rad], in space from -π to π."""
        ends = self.find_ends(self.coordinates(state).read_places(state))
        return self._measure_angle(*ends).T.reshape(*state.lanes[:-1], len(self.pairs))

    def _measure_angle(self, first: Places, second: Places) -> Float[Array, "joints worlds"]:
        if self.axis is None:
            return self.reader.compare(first, second)[0]
        return SpatialCoordinates().measure_twist(first, second, self._find_axes())

    def unwrap(self, x: Rows, near: Rows) -> Rows:
        """In space the angle is known up to turns."""
        if self.axis is None or not self.bounded:
            return x
        turns = jnp.round((x[-1:] - near[-1:]) / (2 * jnp.pi))
        return jnp.concatenate([x[:-1], x[-1:] - 2 * jnp.pi * turns])


class Sliders(DrivenJoints):
    """Two bodies move along an axis of the first alone, and do not turn relative to how they start: prismatic joints.

    `axis` is a direction in the frame of the first body, `(dim,)` or `(joints, dim)`; the second point stays on the line
    through the first. `limits` are the least and the greatest travel [m] of the second point from the first along the axis,
    of which either may be None; a `motor` drives it at that speed [m/s], a `servo` to that travel [m], with at most
    `force` [N]: see `Hinges`. For the rest see `Joints`.

    Example:
        >>> plate = inertia.planar_plate(1.0, (0.2, 0.2))
        >>> rail = rigid.Sliders([(-1, 0)], [[[0.0, 0.0], [0.0, 0.0]]], axis=(1.0, 1.0), limits=(-0.1, None))
        >>> start = Scene(rigid.planar_bodies(plate, [[0.0, 0.0]]), plate, (forces.Gravity(), rail))
        >>> end = simulate(start, methods.verlet, dt=0.01, duration=1.0).final_scene.state
        >>> print(end.position[0].round(3))
        [-0.071 -0.071]
    """

    pairs: Pairs = eqx.field(static=True)
    points: Float[Array, "joints 2 dim"] = unchecked_quantity("points of the joints", "m", kind="place", per=None)
    axis: Float[Array, "joints dim"] = unchecked_quantity("axis", "1", kind="vector", per=None)
    turns: Float[Array, "..."] | None = unchecked_quantity("turn at the start", "rad", per="joint", default=None)
    force: OptionalNumbers = quantity("force", "N", per="joint", at_least=0, default=None)

    def __init__(
        self,
        pairs: ArrayLike | Sequence,
        points: ArrayLike | Sequence,
        axis: ArrayLike | Sequence,
        *,
        limits: Limits | None = None,
        motor: ArrayLike | Sequence | None = None,
        servo: ArrayLike | Sequence | None = None,
        response_time: ArrayLike | Sequence | None = None,
        force: ArrayLike | Sequence | None = None,
        order: int = 2,
        substeps: int | None = 1,
        breaks_at: ArrayLike | Sequence | None = None,
    ):
        self.pairs, self.points = check_joints("Sliders", pairs, points)
        dim = self.points.shape[-1]
        self.axis = jnp.broadcast_to(
            check_axis("Sliders", axis, ((dim,), (len(self.pairs), dim))), (len(self.pairs), dim)
        )
        self.set_options(order, substeps, breaks_at)
        self.force = self.set_drive("m", limits, motor, servo, response_time, ("force", "N", force))
        self.turns = None

    @property
    def cap(self) -> Array | None:
        """The most that a motor exerts [N]."""
        return self.force

    @property
    def held_rows(self) -> int:
        """All but one of the ways to move: 2 in the plane, 5 in space."""
        return 2 if self.points.shape[-1] == 2 else 5

    @property
    def force_rows(self) -> int:
        """The directions across the axis."""
        return self.points.shape[-1] - 1

    def measure(self, first: Places, second: Places) -> Float[Array, "rows joints worlds"]:
        """From the first point to the second across the axis [m], how far the bodies have turned [rad], and the travel [m]."""
        apart, reader = subtract_points(self.place_ends(first, second)), self.reader
        axis = normalise(self.axis.T[..., None])
        rows = [dot_components(apart, reader.turn(first, normal)) for normal in reader.find_normals(axis)]
        rows += measure_turn(self, self.turns, first, second)
        return jnp.stack([*rows, self._measure_travel(first, apart)] if self.bounded else rows)

    def travel(self, state: PyTree) -> Float[Array, "*scenes joints"]:
        """How far the second point of each joint is from the first along the axis [m]."""
        first, second = self.find_ends(self.coordinates(state).read_places(state))
        travel = self._measure_travel(first, subtract_points(self.place_ends(first, second)))
        return travel.T.reshape(*state.lanes[:-1], len(self.pairs))

    def _measure_travel(self, first: Places, apart: list[Array]) -> Float[Array, "joints worlds"]:
        return dot_components(apart, self.reader.turn(first, normalise(self.axis.T[..., None])))

    def prepare(self, state: PyTree, mass: PyTree) -> "Sliders":
        """The joints as part of a scene, with the turn of their bodies at its start."""
        return cast("Sliders", BodyJoints.prepare(remember_turns(self, state), state, mass))


__all__ = ["Hinges", "Sliders"]
