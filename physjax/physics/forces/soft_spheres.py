"""Contact between particles: discs in the plane and balls in space that push each other apart, and do not rotate.

All pairs are measured, in tiles of one part of the others at a time: memory stays linear in the number of particles, work
is quadratic, which suits crowds of up to some thousand.
"""

from collections.abc import Callable
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.backend import choose_tile_sources
from physjax.checks import Numbers, OptionalNumbers, quantity
from physjax.particles import Particles
from physjax.parts import Force
from physjax.vectors import root_and_inverse, stack_components

Column = tuple[list[Array], list[Array], Array, Array, Array]
"""Places [m] and velocities [m/s] by components, radii [m], masses [kg] and numbers of particles, `(*scenes, particles)` each."""

Term = Callable[[Column, Column], list[Array]]
"""What others contribute to particles, of which the arrays are `(*scenes, particles, 1)` and `(*scenes, 1, others)`."""


class SoftSpheres(Force):
    """Contact of all particles in the last lane axis with each other: a spring and a damper wherever two of them overlap.

    Discs in the plane, balls in space, each with a `radius` [m], without friction and rotation. Two that overlap by d > 0
    push each other apart with k d + c d', where k is the `stiffness` [N/m] and c gives the `restitution` K_r of a hit of
    both alone: c = 2 ζ √(k μ), ζ = -ln K_r / √(π² + ln² K_r), with the reduced mass μ = m₁m₂/(m₁ + m₂). Without it
    nothing is lost, and the energy k d²/2 is in the audit. Momentum is conserved to rounding.

    A hit lasts π/ω, ω² = (1 - ζ²) k/μ, and needs some ten steps; a stiffness of 100 m g/r keeps what rests on one another
    apart to a hundredth of the radius, and v √(μ/k) is how far a hit at v presses. `stability.limit` knows the longest step
    of particles that touch. Walls are `contacts` one radius further in. What leaves a contact is held back a little at its
    end, which K_r needs to be exact. The force has a kink where a contact begins, and methods are of second order there. With a
    restitution it jumps where a contact begins and ends: they are of first order, and derivatives miss what the jumps add.

    Source: P. Cundall and O. Strack, "A discrete numerical model for granular assemblies" (1979).

    Example:
        >>> pair = Particles(jnp.array([[0.0, 0.0], [0.9, 0.0]]), jnp.zeros((2, 2)))
        >>> crowd = forces.SoftSpheres(radius=0.5, stiffness=100.0)
        >>> print(loads(Scene(pair, forces=(crowd,)), 0.0).round(3) + 0.0)
        [[-10.   0.]
         [ 10.   0.]]
    """

    couples: ClassVar[bool] = True
    radius: Numbers = quantity("radius", "m", above=0)
    stiffness: Numbers = quantity("stiffness k", "N/m", per=None, above=0)
    restitution: OptionalNumbers = quantity("restitution K_r", "1", per=None, above=0, at_most=1, default=None)

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*scenes nodes dim"]:
        """The sum of what all others push each particle with [N]."""
        return stack_components(self._sum_over_others(state, mass, self._push))

    def potential(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*scenes nodes"]:
        """¼ Σ k d² [J]: each pair's energy is halved between its two particles."""
        return self._sum_over_others(state, mass, self._store)[0]

    def _push(self, here: Column, there: Column) -> list[Array]:
        (_, v, _, mass, _), (_, speeds, _, heavy, _) = here, there
        normal, depth = _measure_overlap(here, there)
        push = self.stiffness * depth
        if self.restitution is not None:
            approach = sum(n * (a - b) for n, a, b in zip(normal, v, speeds, strict=True))
            log = jnp.log(self.restitution)
            damping_ratio = -log / jnp.sqrt(jnp.pi**2 + log * log)
            damping = 2 * damping_ratio * jnp.sqrt(self.stiffness * mass * heavy / (mass + heavy))
            push = push + jnp.where(depth > 0, damping * approach, 0.0)
        return [-push * n for n in normal]

    def _store(self, here: Column, there: Column) -> list[Array]:
        depth = _measure_overlap(here, there)[1]
        return [0.25 * self.stiffness * depth * depth]

    def _sum_over_others(self, state: Particles, mass: Array, term: Term) -> list[Array]:
        """The sum of a term over all others for each particle, folded over tiles of these."""
        if not state.lanes:
            raise ValueError(
                "SoftSpheres: got a state without lanes, expected positions (*scenes, particles, dim) of two or more."
            )
        split = lambda vectors: [vectors[..., i] for i in range(vectors.shape[-1])]  # noqa: E731
        numbers = (jnp.broadcast_to(number, state.lanes) for number in (self.radius, mass))
        which = jnp.broadcast_to(jnp.arange(state.lanes[-1], dtype=jnp.int32), state.lanes)
        crowd = split(state.position), split(state.velocity), *numbers, which
        here = jax.tree.map(lambda part: part[..., :, None], crowd)
        add = lambda there: [  # noqa: E731
            jnp.sum(part, axis=-1) for part in term(here, jax.tree.map(lambda part: part[..., None, :], there))
        ]
        count, most = state.lanes[-1], choose_tile_sources(state.lanes[-1])
        if count <= most:
            return add(crowd)
        tiles = -(-count // most)

        def cut(part: Array, filling: float = 0) -> Array:
            wide = [(0, 0)] * (part.ndim - 1) + [(0, tiles * most - count)]
            filled = jnp.pad(part, wide, constant_values=filling)
            return jnp.moveaxis(filled.reshape(*part.shape[:-1], tiles, most), -2, 0)

        # what fills the last tile reaches nobody: its radius is minus infinity
        x, v, radius, weight, _ = crowd
        parts = [*map(cut, x)], [*map(cut, v)], cut(radius, -jnp.inf), cut(weight, 1.0), cut(which)
        none = jax.tree.map(lambda kind: jnp.zeros(kind.shape, kind.dtype), jax.eval_shape(add, crowd))
        # recomputing a tile in reverse mode keeps its memory linear too
        fold = jax.checkpoint(
            lambda total, tile: ([a + b for a, b in zip(total, add(tile), strict=True)], None), prevent_cse=False
        )
        return lax.scan(fold, none, parts)[0]


def _measure_overlap(here: Column, there: Column) -> tuple[list[Array], Array]:
    """Unit vectors to others, and how deep they overlap [m]: zero where they do not, as of one with itself.

    Particles are compared by number: x - x need not be zero, since a compiler may round each x in its own way.
    """
    (x, _, radius, _, own), (others, _, reach, _, number) = here, there
    ways = [b - a for a, b in zip(x, others, strict=True)]
    distance, inverse = root_and_inverse(sum(way * way for way in ways[1:]) + ways[0] * ways[0])
    depth = radius + reach - distance
    touches = (depth > 0) & (own != number)
    return [way * inverse for way in ways], jnp.where(touches, depth, 0.0)


__all__ = ["SoftSpheres"]


def __dir__() -> list[str]:
    return __all__
