"""Rods between particles: distances that are kept exactly, of which pendulums, chains and bridges are made."""

from collections.abc import Sequence

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
from physjax.loops import Time
from physjax.particles import Particles, demand_particles
from physjax.vectors import norm


class Rods(Constraint):
    """Massless rods: each keeps two particles at a distance of `length` [m], exactly, in tension and in compression.

    `pairs` `(rods, 2)` are indices into the last lane axis. The index -1 is the first of the `anchors` `(anchors, dim)`, fixed
    places [m], -2 the second and so on; particles that are pinned are as good. Lengths are one for all or `(rods,)`, swept over
    scenes `(*scenes, rods)`; None: as far apart as the ends start. A rod adds no stiffness, so that no step is too long for it:
    after each the ends are at their distance and do not approach, to 1e-12 of the scene's size (in float32 2e-6). Steps are of
    order 2 under every method of order 2 or more; with `order=4` each is five of them, under a symmetric method such as verlet
    of order 4. What moves along a rod at the start is stopped by the first step. `constraint_forces` gives the tensions.

    With `breaks_at` [N], one for all or one each, a rod that carries more at the end of a step is gone from then on, in
    tension and in compression; a run records which are `unbroken`.

    Example:
        >>> bob = Particles(jnp.array([[1.0, 0.0]]), jnp.zeros((1, 2)))
        >>> pendulum = Scene(bob, forces=(forces.Gravity(), springs.Rods([(-1, 0)], anchors=[(0.0, 0.0)])))
        >>> end = simulate(pendulum, methods.verlet, dt=0.01, duration=1.0).final_scene.state
        >>> round(float(jnp.hypot(*end.position[0])), 5)
        1.0
    """

    pairs: Pairs = eqx.field(static=True)
    length: OptionalNumbers = quantity("length", "m", per="joint", above=0, default=None)
    anchors: Float[Array, "anchors dim"] | None = unchecked_quantity(
        "anchors", "m", kind="place", per=None, default=None
    )

    def __init__(
        self,
        pairs: ArrayLike | Sequence,
        length: ArrayLike | Sequence | None = None,
        anchors: ArrayLike | Sequence | None = None,
        *,
        order: int = 2,
        substeps: int = 1,
        breaks_at: ArrayLike | Sequence | None = None,
    ):
        self.anchors = None if anchors is None else as_real_quantity("anchors [m]", anchors)
        if self.anchors is not None and self.anchors.ndim != 2:
            raise ValueError(f"Rods: got anchors of shape {self.anchors.shape}, expected (anchors, dim).")
        self.pairs = check_joint_pairs("Rods", pairs, 0 if self.anchors is None else len(self.anchors))
        lengths = None if length is None else as_real_quantity("length [m]", length, above=0.0)
        if lengths is not None and lengths.ndim and lengths.shape[-1] not in (1, len(self.pairs)):
            raise ValueError(f"Rods: got lengths {lengths.shape}, expected () or ({len(self.pairs)},), one for each.")
        self.length = lengths
        self.set_options(order, substeps, breaks_at)

    def __call__(self, t: Time, state: Particles, mass: Array) -> Float[Array, "*lanes dim"]:
        """No force of its own: the scene's motion is kept on the rods."""
        return jnp.zeros_like(state.velocity)

    @property
    def rows(self) -> int:
        """A rod keeps one distance."""
        return 1

    def measure(self, first: Places, second: Places) -> Float[Array, "1 rods worlds"]:
        """(d² - L²)/2L [m], which is d - L to first order, and of second degree in the positions."""
        apart = second - first
        square = apart[0] * apart[0]
        for part in apart[1:]:
            square = square + part * part
        length = self._length_by_world(square.shape)
        return ((square - length * length) / (2 * length))[None]

    def coordinates(self, state: PyTree) -> PointCoordinates:
        """The positions."""
        demand_particles("Rods", state, "a rod between points of bodies is rigid.Joints")
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

    def prepare(self, state: PyTree, mass: PyTree) -> "Rods":
        """The rods with their lengths, as part of a scene; a ValueError for what they cannot join."""
        reader = self.coordinates(state)
        if self.anchors is not None and self.anchors.shape[1] != reader.freedoms:
            raise ValueError(
                f"Rods: got anchors of shape {self.anchors.shape}, expected (anchors, {reader.freedoms}) like the positions."
            )
        rods = (
            self
            if self.length is not None
            else eqx.tree_at(
                lambda rods: rods.length, self, self._measure_lengths(state), is_leaf=lambda leaf: leaf is None
            )
        )
        rods = remember_breaks(rods, state)
        demand_closed(rods, state, lambda rod: f"rod {rod} between {self.pairs[rod]}")
        return rods

    def _measure_lengths(self, state: Particles) -> Array:
        """As far as the ends are apart, `(*scenes, rods)`."""
        if not state.lanes or np.max(self.pairs) >= state.lanes[-1]:
            return jnp.ones((), state.dtype)  # the check of the pairs reports it
        return as_real_quantity("distance between the ends of rods [m]", _measure_distances(self, state), above=0.0)

    def _length_by_world(self, shape: tuple[int, ...]) -> Array:
        """Lengths as `(rods, worlds)`."""
        assert self.length is not None
        rods, worlds = shape
        if self.length.ndim < 2:
            return jnp.broadcast_to(self.length.reshape(-1, 1), shape)
        return jnp.broadcast_to(self.length.reshape(-1, self.length.shape[-1]).T, (rods, worlds))


@jax.jit
def _measure_distances(rods: Rods, state: Particles) -> Array:
    """How far the ends of rods are apart, `(*scenes, rods)`."""
    first, second = rods.find_ends(rods.coordinates(state).read_places(state))
    length = norm(jnp.moveaxis(second - first, (0, 1, 2), (2, 1, 0)))
    return length.reshape(*state.lanes[:-1], len(rods.pairs))


__all__ = ["Rods"]
