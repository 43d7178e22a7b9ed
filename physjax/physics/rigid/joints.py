"""Ball joints between rigid bodies: exact, or stiff damped springs between points that should coincide."""

from collections.abc import Callable, Sequence
from typing import ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from physjax.checks import (
    Numbers,
    OptionalNumbers,
    as_real_quantity,
    quantity,
    unchecked_quantity,
)
from physjax.constraints.constraint import PushedRows
from physjax.constraints.coordinates import Coordinates, Places
from physjax.constraints.elimination import Pairs
from physjax.constraints.ranges import Bounds, Rows, spread_bounds
from physjax.loops import Time
from physjax.physics.rigid.body_joints import (
    BodyJoints,
    as_axes,
    check_joints,
    differentiate_rows,
    read_bodies,
    subtract_arms,
    subtract_points,
)
from physjax.physics.rigid.inertia import Inertia
from physjax.physics.rigid.joint_coordinates import cross_rows, normalise
from physjax.physics.rigid.planar.bodies import PlanarBodies
from physjax.physics.rigid.spatial import RigidBodies, Wrench, angular_velocity
from physjax.vectors import broadcast_vector, cross, dot, norm, rotate_vector, scale


class Joints(BodyJoints):
    """Ball joints, in the plane hinges: a point of each of two bodies stays at that of the other.

    `pairs` `(joints, 2)` are indices into the last lane axis, -1 for the world; `points` `(joints, 2, dim)` are places [m] in the
    frames of the two bodies, from their centers of mass. Without a stiffness joints are exact, as `springs.Rods` are, with
    the same `order`, `substeps` and `breaks_at`: they add no stiffness, open by no load, and `constraint_forces` gives their
    forces.

    With a `cone` [rad] joints in space turn only so far that the `axis` of the first body and that of the second, directions
    in the frames of both, `(3,)` or `(joints, 3)`, or one in each, `(joints, 2, 3)`, are no more than that angle apart.

    With a `stiffness` k [N/m] and a `damping` c [kg/s], shared or per joint, they are springs between bodies in space,
    F = k d + c ḋ, with d from the first point to the second: the points separate by about load/k, and a step must resolve
    √(m/k) of the lightest body. `error` reports how far. A hinge in space is `Hinges`, of springs two ball joints on its axis
    (`hinge`).

    Example:
        >>> plate = inertia.planar_plate(2.0, (1.0, 0.2))
        >>> shelf = rigid.planar_bodies(plate, [[0.5, 0.0]])
        >>> nail = rigid.Joints([(-1, 0)], [[[0.0, 0.0], [-0.5, 0.0]]])
        >>> end = simulate(Scene(shelf, plate, (forces.Gravity(), nail)), methods.verlet, dt=0.01, steps=10).final_scene.state
        >>> round(float(nail.error(end)[0]), 6)
        0.0
    """

    couples: ClassVar[bool] = True
    pairs: Pairs = eqx.field(static=True)
    points: Float[Array, "joints 2 dim"] = unchecked_quantity("points of the joints", "m", kind="place", per=None)
    stiffness: OptionalNumbers = quantity("stiffness k", "N/m", per="joint", above=0, default=None)
    damping: Numbers = quantity("damping c", "kg/s", per="joint", at_least=0, default=0.0)
    axis: Float[Array, "joints 2 3"] | None = unchecked_quantity("axis", "1", kind="vector", per=None, default=None)
    cone: OptionalNumbers = quantity("cone", "rad", per="joint", above=0, default=None)

    def __init__(
        self,
        pairs: ArrayLike | Sequence,
        points: ArrayLike | Sequence,
        stiffness: ArrayLike | Sequence | None = None,
        damping: ArrayLike | Sequence = 0.0,
        *,
        axis: ArrayLike | Sequence | None = None,
        cone: ArrayLike | Sequence | None = None,
        order: int = 2,
        substeps: int | None = 1,
        breaks_at: ArrayLike | Sequence | None = None,
    ):
        self.pairs, self.points = check_joints("Joints", pairs, points)
        self._set_cone(axis, cone)
        self.stiffness = None if stiffness is None else as_real_quantity("stiffness k [N/m]", stiffness, above=0.0)
        self.damping = as_real_quantity("damping c [kg/s]", damping, at_least=0.0)
        self.set_options(order, substeps, breaks_at)
        if cone is not None and (order != 2 or stiffness is not None):
            raise ValueError(
                f"Joints: got a cone, order={order} and stiffness={stiffness}, expected exact joints of order 2."
            )
        if self.stiffness is not None and breaks_at is not None:
            raise ValueError("Joints: got a stiffness and breaks_at, expected one of them: springs do not break.")
        if self.stiffness is not None and (np.asarray(self.pairs) < 0).any():
            raise ValueError(
                "Joints: got the world, -1, and a stiffness; springs to the world are AtPoint(point, Anchor(...))."
            )

    def _set_cone(self, axis: ArrayLike | Sequence | None, cone: ArrayLike | Sequence | None) -> None:
        """Check and set how far joints turn."""
        if (axis is None) != (cone is None) or (cone is not None and self.points.shape[-1] == 2):
            raise ValueError(
                f"Joints: got axis={axis} and cone={cone}, expected both, in space, or none. In the plane `Hinges` have limits."
            )
        self.cone = None if cone is None else as_real_quantity("cone [rad]", cone, above=0.0, at_most=np.pi)
        self.axis = None if axis is None else as_axes("Joints", axis, len(self.pairs))

    @property
    def response(self) -> Callable | None:
        """How motion is kept on exact joints; None of springs."""
        return super().response if self.stiffness is None else None

    @property
    def rows(self) -> int:
        """As many as there are directions, and one for a cone."""
        return self.points.shape[-1] + self.bounded

    @property
    def force_rows(self) -> int:
        """The directions."""
        return self.points.shape[-1]

    @property
    def bounded(self) -> bool:
        """Whether they have a cone."""
        return self.cone is not None

    def find_bounds(self, like: Rows) -> Bounds:
        """The cosine of the angle of a cone is the least."""
        bounds = Bounds.hold(like)
        if self.cone is None:
            return bounds
        least = spread_bounds(jnp.cos(self.cone), like.shape[1:]).astype(like.dtype)[None]
        extend = lambda last: jnp.concatenate([like[:-1], last])  # noqa: E731
        return bounds._replace(low=extend(least), high=extend(jnp.full_like(least, jnp.inf)))

    def measure(self, first: Places, second: Places) -> Float[Array, "rows joints worlds"]:
        """From the first point to the second [m], and the cosine of the angle between the axes."""
        if self.points.shape[-1] == 2:
            return jnp.stack(subtract_points(self.place_ends(first, second)))
        arms, axes = self.turn_ends(first, second, self._find_axes())
        return self._stack_rows(first, second, arms, axes)

    def differentiate(self, reader: Coordinates, first: Places, second: Places) -> tuple[Rows, PushedRows, PushedRows]:
        """The rows and their change with moves of either end, in space in closed form."""
        if self.points.shape[-1] == 2:
            return super().differentiate(reader, first, second)
        arms, axes = self.turn_ends(first, second, self._find_axes())
        across = None if self.axis is None else cross_rows(axes[:, 0], axes[:, 1])
        return self._stack_rows(first, second, arms, axes), *differentiate_rows(arms, across)

    def _find_axes(self) -> Array | None:
        """The directions of the axes of both bodies of each joint, `(3, 2, 1, joints, 1)`."""
        return None if self.axis is None else normalise(jnp.transpose(self.axis)[:, :, None, :, None])

    def _stack_rows(self, first: Places, second: Places, arms: Array, axes: Array) -> Rows:
        """The rows in space, given what is turned with the bodies."""
        apart = subtract_arms(first, second, arms)
        return apart if self.axis is None else jnp.concatenate([apart, jnp.sum(axes[:, 0] * axes[:, 1], axis=0)])

    def prepare(self, state: PyTree, mass: PyTree) -> Self:
        """The joints as part of a scene; exact ones are closed at its start."""
        return self if self.stiffness is not None else super().prepare(state, mass)

    def __call__(self, t: Time, state: PyTree, mass: PyTree) -> Wrench:
        """The wrench of springs; a TypeError for a state that is not of bodies in space."""
        if self.stiffness is None:
            return Wrench()
        if not isinstance(state, RigidBodies):
            raise TypeError(f"Joints: got a state of type {type(state).__name__}, expected RigidBodies for springs.")
        return self.wrench(t, state, mass)

    @property
    def has_potential(self) -> bool:
        """Whether they are springs."""
        return self.stiffness is not None

    def wrench(self, t: Time, bodies: RigidBodies, inertia: Inertia) -> Wrench:
        """Forces and torques on all bodies, with equal and opposite forces at each joint."""
        straight, omega = scale(1 / inertia.mass, bodies.momentum), angular_velocity(bodies, inertia)
        arm, place, straight, omega = self._locate_ends(bodies, straight, omega)
        apart, closing = self._subtract_ends(place), self._subtract_ends(straight + cross(omega, arm))
        stiffness = jnp.asarray(self.stiffness)  # of springs there is one
        pull = stiffness * apart + self.damping * closing
        force = jnp.concatenate([pull, -pull], axis=-2)
        total = self._sum_by_body(jnp.concatenate([force, cross(arm, force)], axis=-1), bodies)
        return Wrench(total[..., :3], total[..., 3:])

    def potential(self, t: ArrayLike, state: RigidBodies, mass: Inertia) -> Float[Array, "*lanes"]:
        """½k d² [J] of springs, halved between the two bodies."""
        apart = self._subtract_ends(self._locate_ends(state)[1])
        half = 0.25 * jnp.asarray(self.stiffness) * dot(apart, apart)
        shares = jnp.concatenate([half, half], axis=-1)[..., None]
        return self._sum_by_body(shares, state)[..., 0]

    def error(self, bodies: RigidBodies | PlanarBodies) -> Float[Array, "*scenes joints"]:
        """How far the two points of each joint are apart [m]."""
        apart = jnp.stack(subtract_points(self.place_ends(*self.find_ends(read_bodies(bodies)))))
        return norm(jnp.moveaxis(apart, (0, 1, 2), (2, 1, 0))).reshape(*bodies.lanes[:-1], len(self.pairs))

    def _locate_ends(self, bodies: RigidBodies, *more: Array) -> list[Array]:
        """Of the ends of joints, first ends then second ends: arm and place [m], and what `more` says of their bodies."""
        parts = (bodies.position, bodies.orientation, *more)
        # side by side, so that one gather takes all
        table = jnp.concatenate(parts, axis=-1)
        found = jnp.take(table, self._bodies_of_ends, axis=-2, mode="clip")
        cuts = np.cumsum([part.shape[-1] for part in parts])
        position, orientation, *others = jnp.split(found, cuts[:-1], axis=-1)
        points = jnp.swapaxes(self.points, 0, 1).reshape(-1, 3)
        arm = rotate_vector(orientation, broadcast_vector(points, position))
        return [arm, position + arm, *others]

    @property
    def _bodies_of_ends(self) -> np.ndarray:
        return np.asarray(self.pairs).T.ravel()

    def _subtract_ends(self, ends: Array) -> Array:
        """From the first end of each joint to its second."""
        return ends[..., len(self.pairs) :, :] - ends[..., : len(self.pairs), :]

    def _sum_by_body(self, ends: Array, bodies: RigidBodies) -> Array:
        """What acts on the ends of joints, first ends then second ends, summed body by body.

        Each body gathers its first end, its second and so on, because a scatter is slow on every device.
        """
        # which end of which joint each body has is known before compiling: the slots are constants of the program
        bodies_of, nodes = self._bodies_of_ends, bodies.lanes[-1]
        slots = [np.flatnonzero(bodies_of == node) for node in range(nodes)]
        index = np.full((max(map(len, slots)), nodes), len(bodies_of))
        for node, slot in enumerate(slots):
            index[: len(slot), node] = slot
        padded = jnp.concatenate([ends, jnp.zeros_like(ends[..., :1, :])], axis=-2)
        return jnp.sum(jnp.take(padded, index, axis=-2, mode="clip"), axis=-3)


def hinge(
    pair: tuple[int, int], points: ArrayLike | Sequence, axis: ArrayLike | Sequence, width: float
) -> tuple[list[tuple[int, int]], np.ndarray]:
    """Pairs and points of a hinge for `Joints`: two ball joints a `width` [m] apart on an axis that both bodies share.

    `points` `(2, 3)` is its middle in each body's frame, `axis` its direction in both frames, or `(2, 3)`, one in each.

    Example:
        >>> pairs, points = rigid.hinge((0, 1), [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], axis=(0.0, 0.0, 1.0), width=0.5)
        >>> pairs, points.shape
        ([(0, 1), (0, 1)], (2, 2, 3))
    """
    points, axis = np.broadcast_to(points, (2, 3)), np.broadcast_to(axis, (2, 3))
    size = np.sqrt(np.sum(axis * axis, axis=-1, keepdims=True))
    if not (size > 0).all() or width <= 0:
        raise ValueError(f"hinge: got axis {axis.tolist()} and width {width}, expected a direction and a width > 0.")
    half = width / 2 * axis / size
    return [pair, pair], np.stack([points - half, points + half])
