"""Joints between rigid bodies: stiff damped springs between points that should coincide."""

from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from physjax.checks import Numbers, as_real_quantity, quantity, unchecked_quantity
from physjax.loops import Time
from physjax.physics.rigid.inertia import Inertia
from physjax.physics.rigid.spatial import Load, RigidBodies, Wrench, angular_velocity
from physjax.vectors import broadcast_vector, cross, dot, norm, rotate_vector, scale


class Joints(Load):
    """Ball joints: F = k d + c ḋ at a point of each of two bodies, d [m] from the first point to the second.

    `pairs` `(joints, 2)` are indices into the last lane axis, `points` `(joints, 2, 3)` the places [m] in the frames of
    the two bodies, from their centers of mass. Stiffness k [N/m] and damping c [kg/s] are shared or per joint. A hinge is
    two ball joints on its axis: see `hinge`. The points separate by about load/k, which `error` reports; a step must
    resolve √(m/k) of the lightest body.

    Example:
        >>> arm = rigid.Joints([(0, 1)], [[[0.5, 0.0, 0.0], [-0.5, 0.0, 0.0]]], stiffness=1e3)
        >>> print(arm.error(rigid.bodies(brick, [[0.0, 0.0, 0.0], [1.25, 0.0, 0.0]])))
        [0.25]
    """

    couples: ClassVar[bool] = True
    pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)
    points: Float[Array, "joints 2 3"] = unchecked_quantity("points of the joints", "m", kind="place", per=None)
    stiffness: Numbers = quantity("stiffness k", "N/m", per="joint", above=0)
    damping: Numbers = quantity("damping c", "kg/s", per="joint", at_least=0)

    def __init__(
        self,
        pairs: ArrayLike | Sequence,
        points: ArrayLike | Sequence,
        stiffness: ArrayLike | Sequence,
        damping: ArrayLike | Sequence = 0.0,
    ):
        pairs = np.asarray(pairs)
        self.points = as_real_quantity("points of the joints [m]", points)
        whole = pairs.dtype.kind in "iu" and pairs.ndim == 2 and pairs.shape[1:] == (2,) and pairs.size
        if not whole or (pairs < 0).any() or (pairs[:, 0] == pairs[:, 1]).any():
            raise ValueError(f"Joints: got pairs {pairs.tolist()}, expected (joints, 2) indices of different bodies.")
        if self.points.shape != (len(pairs), 2, 3):
            raise ValueError(
                f"Joints: got points {self.points.shape}, expected {(len(pairs), 2, 3)}: one on each body."
            )
        self.pairs = tuple((int(i), int(j)) for i, j in pairs)
        self.stiffness = as_real_quantity("stiffness k [N/m]", stiffness, above=0.0)
        self.damping = as_real_quantity("damping c [kg/s]", damping, at_least=0.0)

    def __call__(self, t: Time, state: PyTree, mass: PyTree) -> Wrench:
        """The wrench; a TypeError for a state that is not of bodies in space."""
        if not isinstance(state, RigidBodies):
            raise TypeError(f"Joints: got a state of type {type(state).__name__}, expected RigidBodies.")
        return self.wrench(t, state, mass)

    def wrench(self, t: Time, bodies: RigidBodies, inertia: Inertia) -> Wrench:
        """Forces and torques on all bodies, with equal and opposite forces at each joint."""
        straight, omega = scale(1 / inertia.mass, bodies.momentum), angular_velocity(bodies, inertia)
        arm, place, straight, omega = self._locate_ends(bodies, straight, omega)
        apart, closing = self._subtract_ends(place), self._subtract_ends(straight + cross(omega, arm))
        pull = self.stiffness * apart + self.damping * closing
        force = jnp.concatenate([pull, -pull], axis=-2)
        total = self._sum_by_body(jnp.concatenate([force, cross(arm, force)], axis=-1), bodies)
        return Wrench(total[..., :3], total[..., 3:])

    def potential(self, t: ArrayLike, state: RigidBodies, mass: Inertia) -> Float[Array, "*lanes"]:
        """½k d² [J], halved between the two bodies."""
        apart = self._subtract_ends(self._locate_ends(state)[1])
        half = 0.25 * self.stiffness * dot(apart, apart)
        shares = jnp.concatenate([half, half], axis=-1)[..., None]
        return self._sum_by_body(shares, state)[..., 0]

    def error(self, bodies: RigidBodies) -> Float[Array, "*scenes joints"]:
        """How far the two points of each joint are apart [m]."""
        return norm(self._subtract_ends(self._locate_ends(bodies)[1]))

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
