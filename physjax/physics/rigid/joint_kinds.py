"""Exact joints between bodies other than ball joints: welds, hinges, sliders and rods."""

from collections.abc import Sequence
from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from physjax.checks import (
    OptionalNumbers,
    as_real_quantity,
    demand_direction,
    quantity,
    unchecked_quantity,
)
from physjax.constraints.coordinates import Places
from physjax.constraints.elimination import Pairs
from physjax.physics.rigid.body_joints import (
    BodyJoints,
    check_joints,
    dot_components,
    measure_turns,
    put_joints_last,
    subtract_points,
)


class Welds(BodyJoints):
    """A point of each of two bodies stays at that of the other, and they do not turn relative to how they start.

    For `pairs`, `points`, `order`, `substeps` and `breaks_at` see `Joints`.

    Example:
        >>> plate = inertia.planar_plate(1.0, (1.0, 0.2))
        >>> beam = rigid.planar_bodies(plate, [[0.5, 0.0], [1.5, 0.0]])
        >>> welds = rigid.Welds([(-1, 0), (0, 1)], [[[0.0, 0.0], [-0.5, 0.0]], [[0.5, 0.0], [-0.5, 0.0]]])
        >>> print(constraint_forces(Scene(beam, plate, (forces.Gravity(), welds)))[0][0, 1:].round(3))
        [-19.6 -19.6]
    """

    pairs: Pairs = eqx.field(static=True)
    points: Float[Array, "joints 2 dim"] = unchecked_quantity("points of the joints", "m", kind="place", per=None)
    turns: Float[Array, "..."] | None = unchecked_quantity("turn at the start", "rad", per="joint", default=None)

    def __init__(
        self,
        pairs: ArrayLike | Sequence,
        points: ArrayLike | Sequence,
        *,
        order: int = 2,
        substeps: int = 1,
        breaks_at: ArrayLike | Sequence | None = None,
    ):
        self.pairs, self.points = check_joints("Welds", pairs, points)
        self.set_options(order, substeps, breaks_at)
        self.turns = None

    @property
    def rows(self) -> int:
        """Directions and angles: 3 in the plane, 6 in space."""
        return 3 if self.points.shape[-1] == 2 else 6

    @property
    def force_rows(self) -> int:
        """The directions."""
        return self.points.shape[-1]

    def measure(self, first: Places, second: Places) -> Float[Array, "rows joints worlds"]:
        """From the first point to the second [m], and by how much the bodies have turned [rad]."""
        apart = subtract_points(self.place_ends(first, second))
        return jnp.stack([*apart, *_measure_turn(self, self.turns, first, second)])

    def prepare(self, state: PyTree, mass: PyTree) -> "Welds":
        """The joints as part of a scene, with the turn of their bodies at its start."""
        return _remember_turns(self, state, mass)


class Hinges(BodyJoints):
    """A point of each of two bodies in space stays at that of the other, and they turn about an axis alone.

    `axis` is a direction in the frames of both bodies, `(3,)` or `(joints, 3)`, or one in each, `(joints, 2, 3)`; of the world,
    index -1, it is a direction in space. In the plane `Joints` are hinges. For the rest see `Joints`.

    Example:
        >>> hinges = rigid.Hinges([(-1, 0)], [[[0.0, 0.0, 0.0], [-0.25, 0.0, 0.0]]], axis=(0.0, 1.0, 0.0))
        >>> door = Scene(rigid.bodies(brick, [[0.25, 0.0, 0.0]]), brick, (forces.Gravity(), hinges))
        >>> round(float(constraint_forces(door)[0][0, 1]), 6) == round(float(-9.8 * brick.mass), 6)
        True
    """

    pairs: Pairs = eqx.field(static=True)
    points: Float[Array, "joints 2 3"] = unchecked_quantity("points of the joints", "m", kind="place", per=None)
    axis: Float[Array, "joints 2 3"] = unchecked_quantity("axis", "1", kind="vector", per=None)

    def __init__(
        self,
        pairs: ArrayLike | Sequence,
        points: ArrayLike | Sequence,
        axis: ArrayLike | Sequence,
        *,
        order: int = 2,
        substeps: int = 1,
        breaks_at: ArrayLike | Sequence | None = None,
    ):
        self.pairs, self.points = check_joints("Hinges", pairs, points)
        if self.points.shape[-1] == 2:
            raise ValueError(
                "Hinges: got points in the plane, expected (joints, 2, 3); in the plane Joints are hinges."
            )
        axis = _check_axis("Hinges", axis, len(self.pairs), 3)
        self.axis = jnp.broadcast_to(axis if axis.ndim == 3 else axis[:, None], self.points.shape)
        self.set_options(order, substeps, breaks_at)

    @property
    def rows(self) -> int:
        """Three directions and two angles."""
        return 5

    @property
    def force_rows(self) -> int:
        """The directions."""
        return 3

    def measure(self, first: Places, second: Places) -> Float[Array, "5 joints worlds"]:
        """From the first point to the second [m], and the cosines of the first axis across the second."""
        reader, axes = self.reader, jnp.moveaxis(self.axis, 0, 2)[..., None]
        axis = reader.turn(first, axes[0] / jnp.sqrt(jnp.sum(axes[0] ** 2, axis=0, keepdims=True)))
        across = [dot_components(axis, reader.turn(second, normal)) for normal in reader.find_normals(axes[1])]
        return jnp.stack([*subtract_points(self.place_ends(first, second)), *across])


class Sliders(BodyJoints):
    """Two bodies move along an axis of the first alone, and do not turn relative to how they start: prismatic joints.

    `axis` is a direction in the frame of the first body, `(dim,)` or `(joints, dim)`; the second point stays on the line
    through the first. For the rest see `Joints`.

    Example:
        >>> plate = inertia.planar_plate(1.0, (0.2, 0.2))
        >>> rail = rigid.Sliders([(-1, 0)], [[[0.0, 0.0], [0.0, 0.0]]], axis=(1.0, 1.0))
        >>> start = Scene(rigid.planar_bodies(plate, [[0.0, 0.0]]), plate, (forces.Gravity(), rail))
        >>> round(float(abs(constraint_forces(start)[0][0, 0])), 4), round(9.8 * 0.5**0.5, 4)
        (6.9296, 6.9296)
    """

    pairs: Pairs = eqx.field(static=True)
    points: Float[Array, "joints 2 dim"] = unchecked_quantity("points of the joints", "m", kind="place", per=None)
    axis: Float[Array, "joints dim"] = unchecked_quantity("axis", "1", kind="vector", per=None)
    turns: Float[Array, "..."] | None = unchecked_quantity("turn at the start", "rad", per="joint", default=None)

    def __init__(
        self,
        pairs: ArrayLike | Sequence,
        points: ArrayLike | Sequence,
        axis: ArrayLike | Sequence,
        *,
        order: int = 2,
        substeps: int = 1,
        breaks_at: ArrayLike | Sequence | None = None,
    ):
        self.pairs, self.points = check_joints("Sliders", pairs, points)
        dim = self.points.shape[-1]
        self.axis = jnp.broadcast_to(_check_axis("Sliders", axis, len(self.pairs), dim), (len(self.pairs), dim))
        self.set_options(order, substeps, breaks_at)
        self.turns = None

    @property
    def rows(self) -> int:
        """All but one of the ways to move: 2 in the plane, 5 in space."""
        return 2 if self.points.shape[-1] == 2 else 5

    @property
    def force_rows(self) -> int:
        """The directions across the axis."""
        return self.points.shape[-1] - 1

    def measure(self, first: Places, second: Places) -> Float[Array, "rows joints worlds"]:
        """From the first point to the second across the axis [m], and by how much the bodies have turned [rad]."""
        apart, reader = subtract_points(self.place_ends(first, second)), self.reader
        normals = reader.find_normals(self.axis.T[..., None])
        across = [dot_components(apart, reader.turn(first, normal)) for normal in normals]
        return jnp.stack([*across, *_measure_turn(self, self.turns, first, second)])

    def prepare(self, state: PyTree, mass: PyTree) -> "Sliders":
        """The joints as part of a scene, with the turn of their bodies at its start."""
        return _remember_turns(self, state, mass)


class Rods(BodyJoints):
    """A point of one body stays at a distance from one of another: `springs.Rods` between points of bodies.

    `length` [m] is one for all or one each; None: as far apart as the points start. For the rest see `Joints`.

    Example:
        >>> plate = inertia.planar_plate(1.0, (0.2, 0.2))
        >>> hung = rigid.planar_bodies(plate, [[0.0, -1.1]])
        >>> rods = rigid.Rods([(-1, 0)], [[[0.0, 0.0], [0.0, 0.1]]])
        >>> print(constraint_forces(Scene(hung, plate, (forces.Gravity(), rods)))[0].ravel())
        [9.8]
    """

    pairs: Pairs = eqx.field(static=True)
    points: Float[Array, "joints 2 dim"] = unchecked_quantity("points of the joints", "m", kind="place", per=None)
    length: OptionalNumbers = quantity("length", "m", per="joint", above=0, default=None)

    def __init__(
        self,
        pairs: ArrayLike | Sequence,
        points: ArrayLike | Sequence,
        length: ArrayLike | Sequence | None = None,
        *,
        order: int = 2,
        substeps: int = 1,
        breaks_at: ArrayLike | Sequence | None = None,
    ):
        self.pairs, self.points = check_joints("Rods", pairs, points)
        self.length = None if length is None else as_real_quantity("length [m]", length, above=0.0)
        self.set_options(order, substeps, breaks_at)

    @property
    def rows(self) -> int:
        """A rod keeps one distance."""
        return 1

    def measure(self, first: Places, second: Places) -> Float[Array, "1 joints worlds"]:
        """(d² - L²)/2L [m], which is d - L to first order."""
        assert self.length is not None
        apart = subtract_points(self.place_ends(first, second))
        length = put_joints_last(jnp.broadcast_to(self.length, (*self.length.shape[:-1], len(self.pairs))), 1)[0]
        return ((dot_components(apart, apart) - length * length) / (2 * length))[None]

    def prepare(self, state: PyTree, mass: PyTree) -> "Rods":
        """The rods with their lengths, as part of a scene."""
        rods = self
        if self.length is None:
            length = as_real_quantity(
                "distance between the points of rods [m]", _measure_distances(self, state), above=0.0
            )
            rods = eqx.tree_at(lambda rods: rods.length, self, length, is_leaf=lambda leaf: leaf is None)
        return cast("Rods", BodyJoints.prepare(rods, state, mass))


@jax.jit
def _measure_distances(rods: Rods, state: PyTree) -> Array:
    """How far the points of rods are apart [m], `(*scenes, rods)`."""
    apart = subtract_points(rods.place_ends(*rods.find_ends(rods.coordinates(state).read_places(state))))
    return jnp.sqrt(dot_components(apart, apart)).T.reshape(*state.lanes[:-1], len(rods.pairs))


def _measure_turn(part: Welds | Sliders, turns: Array | None, first: Places, second: Places) -> list[Array]:
    """By how much the bodies have turned relative to each other [rad], in rows."""
    assert turns is not None
    reader = part.reader
    turn = reader.compare(first, second)
    return reader.measure_turn(turn, put_joints_last(turns, len(turn)))


def _remember_turns(part: PyTree, state: PyTree, mass: PyTree) -> PyTree:
    """The joints with the turn of their bodies, which they keep if they have one."""
    if part.turns is None and part.points.shape[-1] == part.coordinates(state).dim:
        turns = measure_turns(part, state)
        part = eqx.tree_at(lambda part: part.turns, part, turns, is_leaf=lambda leaf: leaf is None)
    return BodyJoints.prepare(part, state, mass)


def _check_axis(name: str, axis: ArrayLike | Sequence, joints: int, dim: int) -> Array:
    """Directions, `(1, dim)`, `(joints, dim)` or `(joints, 2, dim)`."""
    found = as_real_quantity("axis [1]", axis)
    if found.shape not in ((dim,), (joints, dim), (joints, 2, dim)) or (found.ndim == 3 and name != "Hinges"):
        raise ValueError(f"{name}: got an axis of shape {found.shape}, expected {(dim,)} or {(joints, dim)}.")
    demand_direction("axis", found)
    return found[None] if found.ndim == 1 else found


__all__ = ["Hinges", "Rods", "Sliders", "Welds"]
