"""What a scene holds exactly: a part that says which bodies it joins, and by how much they are off."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import ClassVar, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, PyTree

from physjax.checks import (
    OptionalNumbers,
    as_positive_integer,
    as_real_quantity,
    concrete_or_none,
    quantity,
    unchecked_quantity,
)
from physjax.constraints.coordinates import Coordinates, Places
from physjax.constraints.elimination import Pairs
from physjax.constraints.ranges import Bounds, Rows
from physjax.loops import Time
from physjax.parts import Force
from physjax.vectors import add_leading_axes

C = TypeVar("C", bound="Constraint")
PushedRows = Float[Array, "freedoms rows joints worlds"]
"""How rows change with moves of one end of each joint."""
ORDERS = (2, 4)
"""Orders of the step that holds joints."""


class Constraint(Force):
    """Joints between bodies, held exactly: no force of their own, but the scene's motion is kept on them.

    A subclass has `pairs`, indices into the last lane axis, where -1 is the first place in the world, -2 the second and so
    on; `rows`, how many numbers of a joint must be zero; and `measure`, which says what they are. With `breaks_at` [N], for
    all or one each, a joint that carries more force at the end of a step is gone from then on; which are `unbroken`,
    `(*scenes, joints)`, is what it remembers.
    """

    couples: ClassVar[bool] = True
    pairs: eqx.AbstractVar[Pairs]
    order: int = eqx.field(static=True, default=2, kw_only=True)
    substeps: int | None = eqx.field(static=True, default=1, kw_only=True)
    breaks_at: OptionalNumbers = quantity("breaks_at", "N", per="joint", above=0, default=None, kw_only=True)
    unbroken: Bool[Array, "..."] | None = unchecked_quantity("unbroken", per="joint", default=None, kw_only=True)

    def set_options(self, order: int, substeps: int | None, breaks_at: ArrayLike | Sequence | None) -> None:
        """Check what all kinds of joints are given, for their constructors; nothing has broken yet."""
        self.order = _demand_order(type(self).__name__, order)
        self.substeps = None if substeps is None else as_positive_integer("substeps", substeps)
        if substeps is None and order != 2:
            raise ValueError(
                f"{type(self).__name__}: got substeps=None and order={order}, expected order 2 for such steps."
            )
        self.breaks_at = None if breaks_at is None else as_real_quantity("breaks_at [N]", breaks_at, above=0.0)
        self.unbroken = None

    @property
    @abstractmethod
    def rows(self) -> int:
        """How many numbers of each joint must be zero, or within bounds."""

    @abstractmethod
    def measure(self, first: Places, second: Places) -> Float[Array, "rows joints worlds"]:
        """By how much each joint is off [m], or [rad], given the places of its two ends, `(numbers, joints, worlds)`.

        Of rows with bounds, which come last, it is what they bound.
        """

    def differentiate(self, reader: Coordinates, first: Places, second: Places) -> tuple[Rows, PushedRows, PushedRows]:
        """What `measure` returns, and how that changes with moves of the first ends and of the second."""
        still = jnp.zeros((reader.freedoms, *first.shape[1:]), first.dtype)
        count = reader.freedoms
        # both ends at once: `measure` is traced, and compiled, once
        units = np.eye(2 * count).reshape(2 * count, 2, count, *[1] * (still.ndim - 1))
        units = jnp.broadcast_to(units.astype(first.dtype), (2 * count, 2, *still.shape))
        change = lambda moves: self.measure(reader.displace(first, moves[0]), reader.displace(second, moves[1]))  # noqa: E731
        x, push = jax.linearize(change, jnp.stack([still, still]))
        rows = jax.vmap(push)(units)
        return x, rows[:count], rows[count:]

    @property
    def bounded(self) -> bool:
        """Whether some rows are not held at zero, but between limits, or driven."""
        return False

    def find_bounds(self, like: Rows) -> Bounds:
        """What the rows are held to, shaped like these."""
        return Bounds.hold(like)

    def unwrap(self, x: Rows, near: Rows) -> Rows:
        """The rows, with angles that are known up to turns as near to others as they can be."""
        return x

    @abstractmethod
    def coordinates(self, state: PyTree) -> Coordinates:
        """How the bodies are read; a TypeError for a state of another kind."""

    @abstractmethod
    def world_places(self, dtype: np.dtype) -> Places:
        """The places in the world that are joined, `(numbers, places)`."""

    @abstractmethod
    def extent(self) -> Array:
        """The size of a joint [m], relative to which it is closed."""

    def find_lengths(self, dtype: np.dtype, worlds: int) -> Float[Array, "joints worlds"]:
        """The length over which each joint holds, across which it swings [m]."""
        return jnp.full((len(self.pairs), worlds), self.extent(), dtype)

    @property
    def response(self) -> Callable | None:
        """How the scene's motion is kept on the joints."""
        from physjax.constraints.rattle import hold_joints

        return hold_joints

    def constrain_rate(self, scene: PyTree, t: Time, state: PyTree, rate: PyTree) -> PyTree:
        """The rate of a state with the forces of all joints of the scene, which keep their ends together."""
        from physjax.constraints.reactions import constrain_rate

        return constrain_rate(scene, t, state, rate)

    @property
    def force_rows(self) -> int:
        """How many of the rows are in metres, so that what they exert is a force: the first ones."""
        return self.rows

    @property
    def remembers(self) -> bool:
        """Whether joints can break."""
        return self.breaks_at is not None

    def advance(
        self, t: ArrayLike, dt: ArrayLike, state: PyTree, exerted: Array | None = None
    ) -> tuple["Constraint", PyTree]:
        """The joints without those that exert more than `breaks_at`, given what they exert, `(*scenes, joints, rows)`."""
        if self.breaks_at is None or self.unbroken is None:
            return self, state
        if exerted is None:
            exerted = jnp.zeros((*self.unbroken.shape, self.rows), state.dtype)
        force = exerted[..., : self.force_rows]
        # squares, whose derivative exists where nothing pulls
        limit = add_leading_axes(self.breaks_at, self.unbroken.ndim)
        unbroken = self.unbroken & (jnp.sum(force * force, axis=-1) <= limit * limit)
        return eqx.tree_at(lambda part: part.unbroken, self, unbroken), state

    def advance_within(self, scene: PyTree, t: ArrayLike, dt: ArrayLike, state: PyTree) -> tuple["Constraint", PyTree]:
        """The same, with the forces of all joints of the scene at the end of the step."""
        from physjax.constraints.reactions import find_forces

        exerted = find_forces(scene, t + dt, scene.state)
        place = [part is self for part in scene.constraints].index(True)
        return self.advance(t, dt, state, exerted[place])

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
        ends = np.where(pairs < 0, np.int32(bodies - 1) - pairs, pairs).T.ravel()
        first, second = jnp.split(jnp.take(places, ends, axis=1, mode="clip"), 2, axis=1)
        return first, second


def check_joint_pairs(name: str, pairs: ArrayLike | Sequence, places: int | None) -> Pairs:
    """Pairs of different bodies as tuples; below 0 are places in the world, `places` of them (None: any number)."""
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


def _demand_order(name: str, order: int) -> int:
    """The order of the step, if it is one that there is."""
    if order not in ORDERS:
        raise ValueError(f"{name}: got order={order!r}, expected one of {ORDERS}.")
    return order


def remember_breaks(part: C, state: PyTree) -> C:
    """The joints as part of a scene, none of them broken unless they are already; a ValueError for limits that do not fit."""
    if part.breaks_at is None:
        return part
    shape = (*state.lanes[:-1], len(part.pairs))
    limits = part.breaks_at.shape
    if len(limits) > len(shape) or any(n not in (1, m) for n, m in zip(limits[::-1], shape[::-1], strict=False)):
        raise ValueError(
            f"{type(part).__name__}: got breaks_at of shape {limits}, expected () or one for each joint, {shape[-1:]}; swept "
            f"over scenes (*scenes, {shape[-1]})."
        )
    if part.unbroken is not None and part.unbroken.shape == shape:
        return part
    whole = jnp.ones(shape, bool)
    return eqx.tree_at(lambda part: part.unbroken, part, whole, is_leaf=lambda leaf: leaf is None)


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
    gap = part.measure(*part.find_ends(part.coordinates(state).read_places(state)))
    bounds = part.find_bounds(jnp.zeros_like(gap))
    gap = gap - jnp.clip(gap, bounds.low, bounds.high)
    return gap if part.unbroken is None else gap * spread_unbroken(part, gap.shape[-1], gap.dtype)[None], part.extent()


def spread_unbroken(part: Constraint, worlds: int, dtype: np.dtype) -> Float[Array, "joints worlds"]:
    """Which joints are unbroken (1) or not (0) in each world."""
    joints = len(part.pairs)
    if part.unbroken is None:
        return jnp.ones((joints, worlds), dtype)
    return jnp.broadcast_to(part.unbroken.reshape(-1, joints).T, (joints, worlds)).astype(dtype)


__all__ = [
    "Constraint",
    "PushedRows",
    "check_joint_pairs",
    "demand_closed",
    "remember_breaks",
    "spread_unbroken",
]
