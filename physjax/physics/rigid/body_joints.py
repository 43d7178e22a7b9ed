"""What all exact joints between bodies have in common: two points that they join, and how these are read."""

from collections.abc import Sequence
from typing import Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from physjax.checks import as_real_quantity, demand_direction
from physjax.constraints.constraint import Constraint, PushedRows, check_joint_pairs, demand_closed, remember_breaks
from physjax.constraints.coordinates import Places
from physjax.constraints.elimination import Pairs
from physjax.loops import Time
from physjax.physics.rigid.inertia import Inertia
from physjax.physics.rigid.joint_coordinates import (
    BodyCoordinates,
    PlanarCoordinates,
    SpatialCoordinates,
    choose_coordinates,
)
from physjax.physics.rigid.planar.bodies import PlanarBodies
from physjax.physics.rigid.spatial import Load, RigidBodies, Wrench

Ends = tuple[list[Array], list[Array]]
"""The points of the first and of the second bodies in the world, in components `(joints, worlds)`."""
TURNS = np.array([[[(i - j) * (j - k) * (k - i) / 2 for k in range(3)] for i in range(3)] for j in range(3)])[
    ..., None, None
]
"""The component i of e_j × e_k."""


class BodyJoints(Constraint, Load):
    """Joints between a point of each of two bodies, in their frames; of the world, index -1, the point is its place."""

    points: eqx.AbstractVar[Array]  # pyright: ignore[reportGeneralTypeIssues]  # all of them are set by constructors

    @property
    def reader(self) -> BodyCoordinates:
        """How bodies are read, in the plane or in space as the points are given."""
        return PlanarCoordinates() if self.points.shape[-1] == 2 else SpatialCoordinates()

    def wrench(self, t: Time, bodies: PyTree, inertia: PyTree) -> Wrench:
        """No load of its own: the scene's motion is kept on the joints."""
        return Wrench()

    def coordinates(self, state: PyTree) -> BodyCoordinates:
        """Those of bodies in the plane or in space."""
        return choose_coordinates(type(self).__name__, state)

    def world_places(self, dtype: np.dtype) -> Places:
        """The world as one body, at the origin."""
        return self.reader.world_place(dtype)

    def extent(self) -> Array:
        """The largest coordinate of a point [m]."""
        return jnp.max(jnp.abs(self.points))

    def place_ends(self, first: Places, second: Places) -> Ends:
        """Both points in the world."""
        points = jnp.moveaxis(self.points, 0, 2)[..., None]
        return self.reader.place_points(first, points[0]), self.reader.place_points(second, points[1])

    def turn_ends(self, first: Places, second: Places, directions: Array | None = None) -> tuple[Array, Array]:
        """In space the ways from the centres of both bodies to the points [m], `(3, 2, joints, worlds)`, and directions in the
        world frame, `(3, 2, directions, joints, worlds)`, given in those of the bodies.

        All of them in one turn, for a small program.
        """
        vectors = jnp.transpose(self.points)[:, :, None, :, None]
        if directions is not None:
            vectors = jnp.concatenate([vectors, directions], axis=2)
        turned = SpatialCoordinates().turn_each(jnp.stack([first, second], axis=1)[:, :, None], vectors)
        return turned[:, :, 0], turned[:, :, 1:]

    def prepare(self, state: PyTree, mass: PyTree) -> Self:
        """The joints as part of a scene, closed at its start; a ValueError where they cannot be."""
        name, dim = type(self).__name__, self.coordinates(state).dim
        if self.points.shape[-1] != dim:
            raise ValueError(
                f"{name}: got points of shape {self.points.shape}, expected {(len(self.pairs), 2, dim)} for such bodies."
            )
        if isinstance(mass, Inertia) and mass.arm is not None:
            raise ValueError(
                f"{name}: got bodies on a pivot, expected free ones. Join a point of theirs to the world, -1."
            )
        joints = remember_breaks(self, state)
        demand_closed(joints, state, lambda joint: f"the joint {joint} of {self.pairs[joint]}")
        return joints


def differentiate_rows(arms: Array, across: Array | None = None) -> tuple[PushedRows, PushedRows]:
    """How rows of joints in space change with moves of the first bodies and of the second: the way from the first point to the
    second in three rows, then angles, given by the vectors along which they change with turns of the first.

    A point r from the centre moves by d + ω × r. `arms` are r of both ends, `(3, 2, joints, worlds)`, and `across`
    `(3, angles, joints, worlds)`.
    """
    both = []
    for side, sign in enumerate((-1.0, 1.0)):
        # ω × r: the change of row i with the turn about j, for each component k of r
        turns = jnp.sum((sign * TURNS).astype(arms.dtype) * arms[None, None, :, side], axis=2)
        if across is not None:
            turns = jnp.concatenate([turns, -sign * across], axis=1)
        moves = (sign * np.eye(3, turns.shape[1]))[..., None, None].astype(arms.dtype)
        both.append(jnp.concatenate([jnp.broadcast_to(moves, turns.shape), turns]))
    return both[0], both[1]


def check_joints(
    name: str, pairs: ArrayLike | Sequence, points: ArrayLike | Sequence
) -> tuple[Pairs, Float[Array, "joints 2 dim"]]:
    """Pairs and points, if they fit."""
    found = as_real_quantity("points of the joints [m]", points)
    joined = check_joint_pairs(name, pairs, 1)
    if found.ndim != 3 or found.shape[:2] != (len(joined), 2) or found.shape[2] not in (2, 3):
        raise ValueError(
            f"{name}: got points {found.shape}, expected {(len(joined), 2, 3)}, or of bodies in the plane "
            f"{(len(joined), 2, 2)}: one on each body."
        )
    return joined, found


def check_axis(name: str, axis: ArrayLike | Sequence, shapes: Sequence[tuple[int, ...]]) -> Array:
    """Directions of one of these shapes; a ValueError for others, and for a vector that has none."""
    found = as_real_quantity("axis [1]", axis)
    if found.shape not in shapes:
        expected = " or ".join(str(shape) for shape in shapes)
        raise ValueError(f"{name}: got an axis of shape {found.shape}, expected {expected}.")
    demand_direction("axis", found)
    return found


def as_axes(name: str, axis: ArrayLike | Sequence, joints: int) -> Float[Array, "joints 2 3"]:
    """Directions in space for both bodies of each joint."""
    found = check_axis(name, axis, ((3,), (joints, 3), (joints, 2, 3)))
    return jnp.broadcast_to(found if found.ndim == 3 else found[..., None, :], (joints, 2, 3))


def put_joints_last(number: Array, components: int) -> Array:
    """A number or a vector for each joint, `(*scenes, joints)` or with components last, as `(components, joints, worlds)`."""
    own = number[..., None] if components == 1 else number
    return jnp.moveaxis(own.reshape(-1, *own.shape[-2:]), (0, 1, 2), (2, 1, 0))


def subtract_points(ends: Ends) -> list[Array]:
    """From the first point of each joint to its second [m], in components."""
    return [b - a for a, b in zip(*ends, strict=True)]


def subtract_arms(first: Places, second: Places, arms: Array) -> Array:
    """The same of joints in space `(3, joints, worlds)`, given the ways to the points from the centres."""
    return (second[:3] - first[:3]) + (arms[:, 1] - arms[:, 0])


def read_bodies(bodies: RigidBodies | PlanarBodies) -> Places:
    """Where bodies are, as joints read them."""
    if isinstance(bodies, PlanarBodies):
        return PlanarCoordinates().read_places(bodies)
    return SpatialCoordinates().read_places(bodies)


__all__ = [
    "BodyJoints",
    "Ends",
    "as_axes",
    "check_axis",
    "check_joints",
    "differentiate_rows",
    "put_joints_last",
    "read_bodies",
    "subtract_arms",
    "subtract_points",
]
