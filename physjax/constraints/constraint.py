"""What a scene holds exactly: a part that says which bodies it joins, and by how much they are off."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from physjax.checks import concrete_or_none
from physjax.constraints.coordinates import Coordinates, Places
from physjax.constraints.elimination import Pairs
from physjax.loops import Time
from physjax.parts import Force

ORDERS = (2, 4)
"""Orders of the step that holds joints."""


class Constraint(Force):
    """Joints between bodies, held exactly: no force of their own, but the scene's motion is kept on them.

    A subclass has `pairs`, indices into the last lane axis, where -1 is the first place in the world, -2 the second and so
    on; `rows`, how many numbers of a joint must be zero; and `measure`, which says what they are.
    """

    couples: ClassVar[bool] = True
    pairs: eqx.AbstractVar[Pairs]
    order: eqx.AbstractVar[int]
    substeps: eqx.AbstractVar[int]

    @property
    @abstractmethod
    def rows(self) -> int:
        """How many numbers of each joint must be zero."""

    @abstractmethod
    def measure(self, first: Places, second: Places) -> Float[Array, "rows joints worlds"]:
        """By how much each joint is off [m], or [rad], given the places of its two ends, `(numbers, joints, worlds)`."""

    @abstractmethod
    def coordinates(self, state: PyTree) -> Coordinates:
        """How the bodies are read; a TypeError for a state of another kind."""

    @abstractmethod
    def world_places(self, dtype: np.dtype) -> Places:
        """The places in the world that are joined, `(numbers, places)`."""

    @abstractmethod
    def extent(self) -> Array:
        """The size of a joint [m], relative to which it is closed."""

    @property
    def response(self) -> Callable | None:
        """How the scene's motion is kept on the joints."""
        from physjax.constraints.rattle import hold_joints

        return hold_joints

    def constrain_rate(self, scene: PyTree, t: Time, state: PyTree, rate: PyTree) -> PyTree:
        """The rate of a state with the forces of all joints of the scene, which keep their ends together."""
        from physjax.constraints.reactions import constrain_rate

        return constrain_rate(scene, t, state, rate)

    def close(self, scene: PyTree, state: PyTree) -> PyTree:
        """The state with all joints of the scene closed and none opening, after contacts have moved bodies."""
        from physjax.constraints.reactions import project_joints

        return project_joints(scene, state)

    def find_ends(self, places: Places) -> tuple[Places, Places]:
        """The places of the first and the second end of each joint, given those of the bodies `(numbers, bodies, worlds)`."""
        bodies = places.shape[1]
        pairs = np.asarray(self.pairs, np.int32)
        if (pairs < 0).any():
            world = self.world_places(places.dtype)[..., None]
            places = jnp.concatenate([places, jnp.broadcast_to(world, (*world.shape[:2], places.shape[2]))], axis=1)
        first, second = np.where(pairs < 0, np.int32(bodies - 1) - pairs, pairs).T
        return tuple(jnp.take(places, end, axis=1, mode="clip") for end in (first, second))  # pyright: ignore[reportReturnType]


def check_joint_pairs(name: str, pairs: ArrayLike | Sequence, places: int | None) -> Pairs:
    """Pairs of different bodies as tuples; below 0 are places in the world, of which there are so many (None: any number)."""
    given = np.asarray(pairs)
    if given.dtype.kind not in "iu" or given.ndim != 2 or given.shape[1:] != (2,) or not given.size:
        raise ValueError(f"{name}: got pairs {given.tolist()}, expected (joints, 2) indices of different bodies.")
    if (given[:, 0] == given[:, 1]).any() or (given < 0).all(axis=1).any():
        raise ValueError(
            f"{name}: got pairs {given.tolist()}, expected two different bodies, or one and the world (-1)."
        )
    if places is not None and given.min() < -places:
        raise ValueError(
            f"{name}: got the index {given.min()}, expected at least {-places}: there are {places} places in the world, "
            "of which -1 is the first."
        )
    return tuple((int(i), int(j)) for i, j in given)


def demand_order(name: str, order: int) -> int:
    """The order of the step, if it is one that there is."""
    if order not in ORDERS:
        raise ValueError(f"{name}: got order={order!r}, expected one of {ORDERS}.")
    return order


def demand_closed(part: Constraint, state: PyTree, describe: Callable[[int], str]) -> None:
    """Raise a ValueError for a joint between bodies that are not there, or one that is not closed at the start."""
    bodies = state.lanes[-1] if state.lanes else 0
    name, most = type(part).__name__, max(max(pair) for pair in part.pairs)
    if not state.lanes or most >= bodies:
        raise ValueError(
            f"{name}: got pairs up to the index {most}, but the scene has {bodies or 'one body and no lane axis'}"
            f"{' bodies' if bodies else ''}. Joined bodies are the last lane axis: positions (*scenes, bodies, dim)."
        )
    # compiled: operation by operation it would take as long as the first frame
    gap, extent = map(concrete_or_none, _measure_start(part, state))
    place = concrete_or_none(state.position)
    if gap is None or extent is None or place is None:
        return
    size = max(float(extent), float(np.abs(place).max()))
    worst = np.abs(gap).max(axis=(0, 2))
    joint = int(np.argmax(worst))
    if not worst[joint] <= size * float(jnp.finfo(state.dtype).eps) ** 0.5:
        raise ValueError(
            f"{name}: {describe(joint)} is {worst[joint]:.3g} off at the start, expected a closed joint. Move its bodies."
        )


@jax.jit
def _measure_start(part: Constraint, state: PyTree) -> tuple[Array, Array]:
    return part.measure(*part.find_ends(part.coordinates(state).read_places(state))), part.extent()


__all__ = ["Constraint", "check_joint_pairs", "demand_closed", "demand_order"]
