"""Exact joints without an axis other than ball joints: welds, rods and ropes."""

from collections.abc import Sequence
from typing import Self, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from physjax.checks import (
    OptionalNumbers,
    as_real_quantity,
    quantity,
    unchecked_quantity,
)
from physjax.constraints.coordinates import Places
from physjax.constraints.elimination import Pairs
from physjax.constraints.ranges import Bounds, Rows, spread_bounds
from physjax.physics.rigid.body_joints import (
    BodyJoints,
    check_joints,
    subtract_points,
)
from physjax.physics.rigid.joint_coordinates import dot_components
from physjax.physics.rigid.turns import measure_turn, remember_turns


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
        substeps: int | None = 1,
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
        return jnp.stack([*apart, *measure_turn(self, self.turns, first, second)])

    def prepare(self, state: PyTree, mass: PyTree) -> "Welds":
        """The joints as part of a scene, with the turn of their bodies at its start."""
        return cast("Welds", BodyJoints.prepare(remember_turns(self, state), state, mass))


class BodyDistances(BodyJoints):
    """Joints that each hold a point of one body at a distance of `length` [m] from one of another."""

    length: OptionalNumbers = quantity("length", "m", per="joint", above=0, default=None, kw_only=True)

    @property
    def rows(self) -> int:
        """One distance."""
        return 1

    def measure(self, first: Places, second: Places) -> Float[Array, "1 joints worlds"]:
        """(d² - L²)/2L [m], which is d - L to first order."""
        assert self.length is not None
        apart = subtract_points(self.place_ends(first, second))
        square = dot_components(apart, apart)
        length = spread_bounds(self.length, square.shape)
        return ((square - length * length) / (2 * length))[None]

    def prepare(self, state: PyTree, mass: PyTree) -> Self:
        """The joints with their lengths, as part of a scene."""
        joints = self
        if self.length is None:
            what = f"distance between the points of {type(self).__name__.lower()} [m]"
            length = as_real_quantity(what, _measure_distances(self, state), above=0.0)
            joints = eqx.tree_at(lambda joints: joints.length, self, length, is_leaf=lambda leaf: leaf is None)
        return cast("Self", BodyJoints.prepare(joints, state, mass))


class Rods(BodyDistances):
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

    def __init__(
        self,
        pairs: ArrayLike | Sequence,
        points: ArrayLike | Sequence,
        length: ArrayLike | Sequence | None = None,
        *,
        order: int = 2,
        substeps: int | None = 1,
        breaks_at: ArrayLike | Sequence | None = None,
    ):
        self.pairs, self.points = check_joints("Rods", pairs, points)
        self.length = None if length is None else as_real_quantity("length [m]", length, above=0.0)
        self.set_options(order, substeps, breaks_at)


class Ropes(BodyDistances):
    """Points of two bodies are no farther apart than `length` [m]: `springs.Ropes` between points of bodies.

    `length` is one for all or one each; None: as far apart as the points start. For the rest see `Joints`.

    Example:
        >>> plate = inertia.planar_plate(1.0, (0.2, 0.2))
        >>> tied = rigid.planar_bodies(plate, [[0.0, -0.1]], velocity=[[0.0, -1.0]])
        >>> ropes = rigid.Ropes([(-1, 0)], [[[0.0, 0.0], [0.0, 0.1]]], length=0.5)
        >>> end = simulate(Scene(tied, plate, (ropes,)), methods.verlet, dt=0.01, duration=1.0).final_scene.state
        >>> print(end.position[0].round(6), end.momentum[0].round(6))
        [ 0.  -0.6] [0. 0.]
    """

    pairs: Pairs = eqx.field(static=True)
    points: Float[Array, "joints 2 dim"] = unchecked_quantity("points of the joints", "m", kind="place", per=None)

    def __init__(
        self,
        pairs: ArrayLike | Sequence,
        points: ArrayLike | Sequence,
        length: ArrayLike | Sequence | None = None,
        *,
        substeps: int | None = 1,
        breaks_at: ArrayLike | Sequence | None = None,
    ):
        self.pairs, self.points = check_joints("Ropes", pairs, points)
        self.length = None if length is None else as_real_quantity("length [m]", length, above=0.0)
        self.set_options(2, substeps, breaks_at)

    @property
    def bounded(self) -> bool:
        """Ropes hold on one side."""
        return True

    def find_bounds(self, like: Rows) -> Bounds:
        """No longer than they are."""
        return Bounds.hold(like)._replace(low=jnp.full_like(like, -jnp.inf))


@jax.jit
def _measure_distances(joints: BodyDistances, state: PyTree) -> Array:
    """How far the points of each are apart [m], `(*scenes, rods)`."""
    apart = subtract_points(joints.place_ends(*joints.find_ends(joints.coordinates(state).read_places(state))))
    return jnp.sqrt(dot_components(apart, apart)).T.reshape(*state.lanes[:-1], len(joints.pairs))


__all__ = ["BodyDistances", "Rods", "Ropes", "Welds"]
