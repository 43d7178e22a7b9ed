"""Rods and ropes between particles: distances that are kept exactly, or not exceeded, of which pendulums and chains are made."""

from collections.abc import Sequence
from typing import Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from physjax.checks import OptionalNumbers, as_real_quantity, quantity, unchecked_quantity
from physjax.constraints.constraint import (
    Constraint,
    check_joint_pairs,
    demand_closed,
    remember_breaks,
)
from physjax.constraints.coordinates import Places, PointCoordinates
from physjax.constraints.elimination import Pairs
from physjax.constraints.ranges import Bounds, Rows, spread_bounds
from physjax.loops import Time
from physjax.particles import Particles, demand_particles
from physjax.vectors import norm


class Distances(Constraint):
    """Joints that each hold two particles at a distance of `length` [m]."""

    pairs: Pairs = eqx.field(static=True, kw_only=True)
    length: OptionalNumbers = quantity("length", "m", per="joint", above=0, default=None, kw_only=True)
    anchors: Float[Array, "anchors dim"] | None = unchecked_quantity(
        "anchors", "m", kind="place", per=None, default=None, kw_only=True
    )

    def set_distances(
        self,
        pairs: ArrayLike | Sequence,
        length: ArrayLike | Sequence | None,
        anchors: ArrayLike | Sequence | None,
    ) -> None:
        """Check and set what is joined, for constructors."""
        name = type(self).__name__
        self.anchors = None if anchors is None else as_real_quantity("anchors [m]", anchors)
        if self.anchors is not None and self.anchors.ndim != 2:
            raise ValueError(f"{name}: got anchors of shape {self.anchors.shape}, expected (anchors, dim).")
        self.pairs = check_joint_pairs(name, pairs, 0 if self.anchors is None else len(self.anchors))
        lengths = None if length is None else as_real_quantity("length [m]", length, above=0.0)
        if lengths is not None and lengths.ndim and lengths.shape[-1] not in (1, len(self.pairs)):
            raise ValueError(f"{name}: got lengths {lengths.shape}, expected () or ({len(self.pairs)},), one for each.")
        self.length = lengths

    def __call__(self, t: Time, state: Particles, mass: Array) -> Float[Array, "*lanes dim"]:
        """No force of its own: the scene's motion is kept on the distances."""
        return jnp.zeros_like(state.velocity)

    @property
    def rows(self) -> int:
        """One distance."""
        return 1

    def measure(self, first: Places, second: Places) -> Float[Array, "1 joints worlds"]:
        """(d² - L²)/2L [m], which is d - L to first order, and of second degree in the positions."""
        apart = second - first
        square = apart[0] * apart[0]
        for part in apart[1:]:
            square = square + part * part
        assert self.length is not None
        length = spread_bounds(self.length, square.shape)
        return ((square - length * length) / (2 * length))[None]

    def coordinates(self, state: PyTree) -> PointCoordinates:
        """The positions."""
        name = type(self).__name__
        demand_particles(name, state, f"between points of bodies they are rigid.{name}")
        return PointCoordinates(state.position.shape[-1])

    def world_places(self, dtype: np.dtype) -> Places:
        """The anchors."""
        assert self.anchors is not None
        return self.anchors.T

    def extent(self) -> Array:
        """The largest length or coordinate of an anchor [m]."""
        assert self.length is not None
        longest = jnp.max(self.length)
        return longest if self.anchors is None else jnp.maximum(longest, jnp.max(jnp.abs(self.anchors)))

    def find_lengths(self, dtype: np.dtype, worlds: int) -> Float[Array, "joints worlds"]:
        """Their lengths."""
        assert self.length is not None
        return spread_bounds(self.length, (len(self.pairs), worlds)).astype(dtype)

    def prepare(self, state: PyTree, mass: PyTree) -> Self:
        """The joints with their lengths, as part of a scene; a ValueError for what they cannot join."""
        reader, name = self.coordinates(state), type(self).__name__
        if self.anchors is not None and self.anchors.shape[1] != reader.freedoms:
            raise ValueError(
                f"{name}: got anchors of shape {self.anchors.shape}, expected (anchors, {reader.freedoms}) like the positions."
            )
        joints = self
        if self.length is None:
            length = self._measure_lengths(state)
            joints = eqx.tree_at(lambda joints: joints.length, self, length, is_leaf=lambda leaf: leaf is None)
        joints = remember_breaks(joints, state)
        demand_closed(joints, state, lambda joint: f"{name.lower()[:-1]} {joint} between {self.pairs[joint]}")
        return joints

    def _measure_lengths(self, state: Particles) -> Array:
        """As far as the ends are apart, `(*scenes, rods)`."""
        if not state.lanes or np.max(self.pairs) >= state.lanes[-1]:
            return jnp.ones((), state.dtype)  # the check of the pairs reports it
        return as_real_quantity(
            f"distance between the ends of {type(self).__name__.lower()} [m]",
            _measure_distances(self, state),
            above=0.0,
        )


class Rods(Distances):
    """Massless rods: each keeps two particles at a distance of `length` [m], exactly, in tension and in compression.

    `pairs` `(rods, 2)` are indices into the last lane axis. The index -1 is the first of the `anchors` `(anchors, dim)`, fixed
    places [m], -2 the second and so on; particles that are pinned are as good. Lengths are one for all or `(rods,)`, swept over
    scenes `(*scenes, rods)`; None: as far apart as the ends start. A rod adds no stiffness, so that no step is too long for it:
    after each the ends are at their distance and do not approach, to 1e-12 of the scene's size (in float32 2e-6). Steps are of
    order 2 under every method of order 2 or more; with `order=4` each is five of them, under a symmetric method such as verlet
    of order 4. What moves along a rod at the start is stopped by the first step. `constraint_forces` gives the tensions.

    A link swings across its tension T at up to 2√(T/mL), which a step must resolve, whatever hangs on it: each step is
    `substeps` steps, and with `substeps=None` as many as it takes, by tension and speed, also where a heavy load whips a rope.

    With `breaks_at` [N], one for all or one each, a rod that carries more at the end of a step is gone from then on, in
    tension and in compression; a run records which are `unbroken`.

    Example:
        >>> bob = Particles(jnp.array([[1.0, 0.0]]), jnp.zeros((1, 2)))
        >>> pendulum = Scene(bob, forces=(forces.Gravity(), springs.Rods([(-1, 0)], anchors=[(0.0, 0.0)])))
        >>> end = simulate(pendulum, methods.verlet, dt=0.01, duration=1.0).final_scene.state
        >>> round(float(jnp.hypot(*end.position[0])), 5)
        1.0
    """

    def __init__(
        self,
        pairs: ArrayLike | Sequence,
        length: ArrayLike | Sequence | None = None,
        anchors: ArrayLike | Sequence | None = None,
        *,
        order: int = 2,
        substeps: int | None = 1,
        breaks_at: ArrayLike | Sequence | None = None,
    ):
        self.set_distances(pairs, length, anchors)
        self.set_options(order, substeps, breaks_at)


class Ropes(Distances):
    """Ropes without mass: the ends of each are no farther apart than its `length` [m], and it does not push.

    A rope that becomes taut stops its ends from separating, without a rebound, by an impulse along it; while it is slack they
    move as if it were not there. `pairs`, `length`, `anchors`, `substeps` and `breaks_at` are those of `Rods`; steps are of
    order 2 while no rope becomes taut or slack, and in steps in which one does of order 1.

    Example:
        >>> ball = Particles(jnp.array([[0.0, 0.0]]), jnp.zeros((1, 2)))
        >>> tied = Scene(ball, forces=(forces.Gravity(), springs.Ropes([(-1, 0)], 0.5, anchors=[(0.0, 0.0)])))
        >>> run = simulate(tied, methods.verlet, dt=0.01, duration=1.0)
        >>> print(run.position[[20, 100], 0, 1].round(3))
        [-0.196 -0.5  ]
    """

    def __init__(
        self,
        pairs: ArrayLike | Sequence,
        length: ArrayLike | Sequence | None = None,
        anchors: ArrayLike | Sequence | None = None,
        *,
        substeps: int | None = 1,
        breaks_at: ArrayLike | Sequence | None = None,
    ):
        self.set_distances(pairs, length, anchors)
        self.set_options(2, substeps, breaks_at)

    @property
    def bounded(self) -> bool:
        """Ropes hold on one side."""
        return True

    def find_bounds(self, like: Rows) -> Bounds:
        """No longer than they are."""
        return Bounds.hold(like)._replace(low=jnp.full_like(like, -jnp.inf))


@jax.jit
def _measure_distances(rods: Distances, state: Particles) -> Array:
    """How far the ends of each are apart, `(*scenes, rods)`."""
    first, second = rods.find_ends(rods.coordinates(state).read_places(state))
    length = norm(jnp.moveaxis(second - first, (0, 1, 2), (2, 1, 0)))
    return length.reshape(*state.lanes[:-1], len(rods.pairs))


__all__ = ["Distances", "Rods", "Ropes"]
