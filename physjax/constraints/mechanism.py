"""All joints of a scene as one system: by how much they are off, their Jacobian, and what impulses on them do."""

from functools import cache
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PyTree

from physjax.constraints.block_solve import Blocks, solve_blocks
from physjax.constraints.constraint import Constraint, spread_unbroken
from physjax.constraints.coordinates import Coordinates, Moves, Places, put_worlds_last
from physjax.constraints.elimination import Elimination, Pairs, plan_elimination
from physjax.constraints.ranges import Bounds, Rows

CLOSED_SHARE = 1e-12
"""Relative to its size, how far a closed joint may be open."""
CLOSED_ROUNDINGS = 16
"""The same in roundings of the number type, where that is more: float32 has no 12 digits."""
Jacobian = Float[Array, "freedoms rows ends worlds"]
"""How the rows of each joint change with moves of its two ends: first ends of all joints, then second ends."""


class Mechanism(NamedTuple):
    """The joints of a scene, how its bodies are read, which of them move (1) or not (0), and which bodies joints join.

    `whole` says which joints are unbroken (1) or not (0), None: all of them. The rows of those that broke are zero.
    """

    parts: tuple[Constraint, ...]
    coordinates: Coordinates
    free: Float[Array, "bodies worlds"]
    pairs: Pairs
    whole: Float[Array, "joints worlds"] | None

    @classmethod
    def of(cls, scene: PyTree) -> "Mechanism":
        """The mechanism of a scene."""
        parts = find_constraints(scene)
        lanes, dtype = scene.state.lanes, scene.state.dtype
        free = jnp.ones((), dtype) if scene.held is None else 1 - jnp.asarray(scene.held).astype(dtype)
        pairs = tuple(pair for part in parts for pair in part.pairs)
        free, whole = put_worlds_last(free, lanes), None
        if any(part.unbroken is not None for part in parts):
            worlds = free.shape[-1]
            whole = jnp.concatenate([spread_unbroken(part, worlds, dtype) for part in parts])
        return cls(parts, parts[0].coordinates(scene.state), free, pairs, whole)

    @property
    def plan(self) -> Elimination:
        """The order of elimination."""
        return plan_elimination(self.pairs)

    @property
    def rows(self) -> int:
        """The most rows that a joint has."""
        return max(part.rows for part in self.parts)

    def measure(self, places: Places, near: Rows | None = None) -> Rows:
        """The numbers of each joint, of which those that must be zero say how far it is off; angles in the turn of `near`."""
        return self._finish([part.measure(*part.find_ends(places)) for part in self.parts], near)

    def _finish(self, found: list[Array], near: Rows | None) -> Rows:
        """The rows of all parts together; zero of what broke."""
        x = self._join(found, 0)
        if near is not None and any(part.bounded for part in self.parts):
            cuts = np.cumsum([len(part.pairs) for part in self.parts])[:-1]
            split = zip(self.parts, *(jnp.split(a, cuts, axis=-2) for a in (x, near)), strict=True)
            x = jnp.concatenate([part.unwrap(own, start) for part, own, start in split], axis=-2)
        return x if self.whole is None else x * self.whole[None]

    def measure_tolerance(self, places: Places, mobility: Array) -> Float[Array, " worlds"]:
        """How far joints of bodies in these places may be open [m] to count as closed."""
        size = jnp.max(jnp.abs(places[: self.coordinates.dim]), axis=(0, 1))
        size = jnp.maximum(size, jnp.max(self.coordinates.measure_bodies(mobility), axis=0))
        for part in self.parts:
            size = jnp.maximum(size, part.extent())
        share = max(CLOSED_SHARE, CLOSED_ROUNDINGS * float(jnp.finfo(places.dtype).eps))
        return lax.stop_gradient(share * size)

    def find_bounds(self, like: Rows) -> Bounds | None:
        """What rows are held to; None where all of them are held at zero."""
        if not any(part.bounded for part in self.parts):
            return None
        worlds = like.shape[-1]
        found = [part.find_bounds(jnp.zeros((part.rows, len(part.pairs), worlds), like.dtype)) for part in self.parts]
        bounds = Bounds(*(self._join(list(each), 0) for each in zip(*found, strict=True)))
        if self.whole is None:
            return bounds
        return Bounds(*(jnp.where(self.whole[None] > 0, each, 0.0) for each in bounds))

    def differentiate(self, places: Places, near: Rows | None = None) -> tuple[Jacobian, Rows]:
        """The Jacobian of `measure`, and what that returns."""
        parts = [part.differentiate(self.coordinates, *part.find_ends(places)) for part in self.parts]
        found, firsts, seconds = map(list, zip(*parts, strict=True))
        ends = [self._join(end, 1) for end in (firsts, seconds)]
        if self.whole is not None:
            ends = [end * self.whole[None, None] for end in ends]
        return jnp.concatenate(ends, axis=-2), self._finish(found, near)

    def _join(self, arrays: list[Array], axis: int) -> Array:
        """Arrays of parts as one of all joints, with as many rows for each."""
        if len(arrays) == 1:
            return arrays[0]
        pad = lambda a: [(0, self.rows - n if i == axis else 0) for i, n in enumerate(a.shape)]  # noqa: E731
        return jnp.concatenate([jnp.pad(a, pad(a)) for a in arrays], axis=-2)

    def sum_at_bodies(self, jacobian: Jacobian, impulses: Rows) -> Moves:
        """What impulses of the joints do to the bodies that move: Jᵀλ, `(freedoms, bodies, worlds)`."""
        both = jnp.concatenate([impulses, impulses], axis=-2)
        ends = jnp.sum(jacobian * both[None], axis=1)
        padded = jnp.pad(ends, ((0, 0), (0, 1), (0, 0)))
        slots = _list_ends_of_bodies(self.pairs, len(self.free))
        return self.free[None] * jnp.sum(jnp.take(padded, slots, axis=1, mode="clip"), axis=1)

    def measure_rates(self, jacobian: Jacobian, rates: Moves) -> Rows:
        """How fast the joints open: J q̇."""
        ends = self._at_ends(rates)
        each = jnp.sum(jacobian * ends[:, None], axis=0)
        first, second = jnp.split(each, 2, axis=-2)
        return first + second

    def join_rows(self, found: list[Array]) -> Rows:
        """Numbers of the rows of each part as those of all."""
        return self._join(found, 0)

    def take_ends(self, table: Array) -> tuple[Array, Array]:
        """What the bodies at the first end of each joint have, and those at the second; zero for the world."""
        first, second = jnp.split(self._at_ends(table), 2, axis=-2)
        return first, second

    def change_rates(self, mobility: Array, jacobian: Jacobian, λ: Rows) -> Moves:
        """What impulses of the joints do to velocities: M⁻¹Jᵀλ."""
        return self.coordinates.apply_mobility(mobility, self.sum_at_bodies(jacobian, λ))

    def move_by_impulses(self, mobility: Array, jacobian: Jacobian) -> Jacobian:
        """M⁻¹Jᵀ: the velocities that a unit impulse of each row gives to both ends."""
        return self.coordinates.apply_mobility(self._at_ends(self.free[None] * mobility)[:, None], jacobian)

    def measure_mobilities(self, jacobian: Jacobian, moved: Jacobian) -> Rows:
        """By how much a unit impulse of each row changes its own rate: the diagonal of J M⁻¹ Jᵀ."""
        first, second = jnp.split(jnp.sum(jacobian * moved, axis=0), 2, axis=-2)
        return first + second

    def build_matrix(self, jacobian: Jacobian, moved: Jacobian) -> Blocks:
        """J M⁻¹ Jᵀ, from the Jacobian at one place and M⁻¹Jᵀ there or at another; one for rows that a joint lacks or lost."""
        plan, joints = self.plan, len(self.pairs)
        whole = jnp.sum(jacobian[:, :, None] * moved[:, None], axis=0)
        own = whole[..., :joints, :] + whole[..., joints:, :]
        lacks = np.concatenate(
            [np.repeat(np.arange(self.rows) >= p.rows, len(p.pairs)).reshape(self.rows, -1) for p in self.parts], axis=1
        )
        if lacks.any():
            own = own + (np.eye(self.rows)[..., None] * lacks).astype(own.dtype)[..., None]
        if self.whole is not None:
            own = (
                own
                + (np.eye(self.rows)[..., None] * ~lacks).astype(own.dtype)[..., None] * (1 - self.whole)[None, None]
            )
        pad = lambda a: jnp.pad(a, [(0, 0), (0, 0), (0, 1), (0, 0)])  # noqa: E731
        # the early and the late end of each edge, or the other way round, for all bodies that the joints of an edge share
        pick = lambda a, ends: jnp.take(pad(a), ends, axis=-2, mode="clip")  # noqa: E731
        left, right = pick(jacobian, plan.shared[:, ::-1]), pick(moved, plan.shared)
        both = jnp.sum(left[:, :, None] * right[:, None], axis=(0, 3))
        return Blocks(own, both[:, :, 0], both[:, :, 1])

    def solve(self, matrix: Blocks, right: Rows) -> Rows:
        """The impulses with matrix λ = right."""
        return solve_blocks(self.plan, matrix, right)

    def _at_ends(self, table: Array) -> Array:
        """What the bodies at both ends of each joint have; zero for the world."""
        pairs, bodies = np.asarray(self.pairs, np.int32), len(self.free)
        index = np.where(pairs < 0, np.int32(bodies), pairs).T.ravel()
        if (pairs < 0).any():
            table = jnp.pad(table, [(0, 0)] * (table.ndim - 2) + [(0, 1), (0, 0)])
        return jnp.take(table, index, axis=-2, mode="clip")


def find_constraints(scene: PyTree) -> tuple[Constraint, ...]:
    """What a scene holds exactly."""
    return tuple(force for force in scene.forces if force.response is not None)


def hold_rows(jacobian: Jacobian, held: Array) -> Jacobian:
    """The Jacobian with zeros for the rows `(rows, joints, worlds)` that are not held, whose impulse is then found to be zero."""
    return jacobian * jnp.concatenate([held, held], axis=-2).astype(jacobian.dtype)[None]


@cache
def _list_ends_of_bodies(pairs: Pairs, bodies: int) -> np.ndarray:
    """Which ends each body has, `(most, bodies)`; twice the number of joints is none."""
    ends = np.asarray(pairs, np.int32).T.ravel()
    slots = [np.flatnonzero(ends == body) for body in range(bodies)]
    table = np.full((max(map(len, slots)), bodies), len(ends), np.int32)
    for body, slot in enumerate(slots):
        table[: len(slot), body] = slot
    return table


__all__ = ["Jacobian", "Mechanism", "find_constraints", "hold_rows"]
