"""The equation of an implicit stage: the force at its end moves the state, by u = h·K rate(t, drift(base + u, h)).

K is what a kick takes from a rate, u what a kick changes: for particles Δv. Every method that is implicit in one stage at a
time solves this equation, with a step h and a `base` of its own: what is known of the end before the implicit force acts.
"""

from collections.abc import Callable
from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import PyTree

from physjax.loops import Time
from physjax.stepping.dependence import find_kicked, pick_leaves
from physjax.stepping.krylov import Vector
from physjax.stepping.system import System, has_no_lanes, leaf_dtype, linearise_at, read_traits
from physjax.vectors import scale


class Stage(NamedTuple):
    """A stage to be solved: the system, the time of its force [s], the base that it starts from, and its step h [s].

    `near` is the state at which forces are linearised, `way` the change from there to drift(base, h), None where there is
    none. `free` is where the stage ends without its force, by which residuals are measured. `kicked_leaves` says which
    leaves of a state a kick changes.
    """

    system: System
    time: Time
    base: PyTree
    h: jax.Array
    near: PyTree
    way: PyTree | None
    free: PyTree
    kicked_leaves: list[bool]

    @property
    def is_independent(self) -> bool:
        """Whether each lane is a system of its own."""
        return not read_traits(self.system).couples or has_no_lanes(self.base)

    def linearise(self) -> "Linearised":
        """The equation linearised at `near`."""
        system = linearise_at(self.system, self.time, self.near)
        rate, push = jax.linearize(lambda y: system.rate(self.time, y), self.near)
        _, move = jax.linearize(lambda u: self.system.drift(self.add_change(u), self.h), self.zero_change())
        there = rate if self.way is None else jax.tree.map(jnp.add, rate, push(self.way))
        return Linearised(self, self.kick(there), push, move, read_traits(system).dissipative_symmetric)

    def residual(self, u: Vector) -> Vector:
        """What is left of the equation: u - h·K rate(t, drift(base + u, h))."""
        return subtract(u, self.kick(self.system.rate(self.time, self.end_state(u))))

    def free_kick(self) -> Vector:
        """What the force of the stage would do where it ends without it: the size that residuals are relative to."""
        return self.kick(self.system.rate(self.time, self.free))

    def kick(self, rate: PyTree) -> Vector:
        """h·rate, of the leaves that a kick changes."""
        return take_kick(self.system, self.base, rate, self.h, self.kicked_leaves)

    def zero_change(self) -> Vector:
        """No change."""
        return [jnp.zeros_like(leaf) for leaf in pick_leaves(self.base, self.kicked_leaves)]

    def mask_held(self, u: Vector) -> Vector:
        """u with zero for held lanes, which do not move: the matrix is then symmetric in them as well."""
        held = read_traits(self.system).held
        return u if held is None else [scale(1 - held.astype(leaf.dtype), leaf) for leaf in u]

    def add_change(self, u: Vector) -> PyTree:
        """The base with u added to what a kick changes."""
        return add_change(self.base, u, self.kicked_leaves)

    def end_state(self, u: Vector) -> PyTree:
        """The state at the end of the stage."""
        return self.system.drift(self.add_change(u), self.h)

    def inner(self, a: Vector, b: Vector) -> jax.Array:
        """Σ m a·b for each system."""
        return self._sum([scale(self._mass(), p) for p in a], b)

    def inner_of_dual(self, a: Vector, b: Vector) -> jax.Array:
        """Σ a·b/m for each system."""
        return self._sum([scale(1 / self._mass(), p) for p in a], b)

    def _mass(self) -> jax.Array:
        """The mass of each lane; one for bodies, whose momenta are not velocities, and for a system without masses."""
        mass = read_traits(self.system).mass
        return jnp.asarray(mass) if isinstance(mass, jax.Array | np.ndarray) else jnp.ones((), self.h.dtype)

    def _sum(self, a: Vector, b: Vector) -> jax.Array:
        kept = len(read_traits(self.system).status_shape)
        return reduce(jnp.add, [_sum_trailing_axes(p * q, kept) for p, q in zip(a, b, strict=True)])


class Linearised(NamedTuple):
    """The equation of a stage linearised at a state: (1 - h K J) u = b, J the derivative of the rate.

    `push` applies J to a change of the state, `move` gives the change of the end that belongs to u.
    """

    stage: Stage
    b: Vector
    push: Callable[[PyTree], PyTree]
    move: Callable[[Vector], PyTree]
    dissipative_symmetric: bool

    def matvec(self, u: Vector) -> Vector:
        """(1 - h K J) u."""
        return subtract(u, self.stage.kick(self.push(self.move(self.stage.mask_held(u)))))


def build_stage(system: System, time: Time, base: PyTree, h: ArrayLike) -> Stage:
    """A stage that is linearised where it ends without its force, drift(base, h)."""
    h = jnp.asarray(h, leaf_dtype(base))
    free = system.drift(base, h)
    return Stage(system, time, base, h, free, None, free, find_kicked(system, base))


def take_kick(system: System, state: PyTree, rate: PyTree, h: ArrayLike, kicked_leaves: list[bool]) -> Vector:
    """h·rate, of the leaves that a kick changes."""
    return pick_leaves(system.kick(jax.tree.map(jnp.zeros_like, state), rate, h), kicked_leaves)


def add_change(state: PyTree, u: Vector, kicked_leaves: list[bool]) -> PyTree:
    """The state with u added to what a kick changes."""
    leaves, tree = jax.tree.flatten(state)
    more = iter(u)
    return jax.tree.unflatten(
        tree, [leaf + next(more) if place else leaf for leaf, place in zip(leaves, kicked_leaves, strict=True)]
    )


def subtract(a: Vector, b: Vector) -> Vector:
    """a - b."""
    return [p - q for p, q in zip(a, b, strict=True)]


def _sum_trailing_axes(a: jax.Array, kept: int) -> jax.Array:
    """The sum over all axes but the first `kept`."""
    return jnp.sum(a, axis=tuple(range(kept, a.ndim)))
