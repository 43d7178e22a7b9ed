"""Newtonian gravitation between all pairs, in blocks: memory stays linear in the number of bodies.

On a CPU the sums are folded over tiles of sources. A GPU has a kernel that goes over all sources at once (`pair_kernel`),
and any other device one reduction for each block of targets; the derivatives of both are those of the fold.
"""

from collections.abc import Callable
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.backend import choose_block_targets, choose_pair_kernel, choose_tile_sources
from physjax.checks import Numbers, OptionalNumbers, quantity
from physjax.particles import Particles
from physjax.parts import Field

Term = Callable[[list[Array], Array, Array | None], list[Array]]
"""What pairs contribute to their targets, from their offsets [m], the strength GM of their sources and the softening [m]."""


class Gravitation(Field):
    """Gravitation between all bodies of the last lane axis: a_i = Σ_j G m_j (x_j - x_i)/d³, d² = |x_j - x_i|² + ε².

    With `G` [m³/kg/s²] sources have the scene's masses; `gm` [m³/s²] gives their GM instead, which astronomers know to more
    digits than either factor. ε is Plummer's `softening` [m]. Bodies at the same point do not attract each other.

    Example:
        >>> pair = Particles(jnp.array([[0.0, 0.0], [2.0, 0.0]]), jnp.zeros((2, 2)))
        >>> print(loads(Scene(pair, mass=jnp.array([3.0, 4.0]), forces=(forces.Gravitation(G=1.0),)), 0.0))
        [[ 3.  0.]
         [-3.  0.]]
    """

    couples: ClassVar[bool] = True
    G: Numbers = quantity("G", "m³/kg/s²", per=None, default=6.67430e-11)
    softening: OptionalNumbers = quantity("softening", "m", per=None, at_least=0, default=None)
    gm: OptionalNumbers = quantity("gm", "m³/s²", at_least=0, default=None)

    def acceleration(
        self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]
    ) -> Float[Array, "*scenes nodes dim"]:
        """Σ_j G m_j (x_j - x_i)/d³ [m/s²]."""
        return jnp.stack(_sum_over_sources(_pull, state.position, self._gm(state, mass), self.softening), axis=-1)

    def potential(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*scenes nodes"]:
        """-½ Σ_j m_i G m_j/d [J]: each pair's energy is halved between its two bodies."""
        (total,) = _sum_over_sources(_weigh, state.position, self._gm(state, mass), self.softening)
        return -0.5 * mass * total

    def _gm(self, state: Particles, mass: Array) -> Array:
        """GM of every body as a source [m³/s²]."""
        if not state.lanes:
            raise ValueError(
                "Gravitation: got a state without lanes, expected positions (*scenes, nodes, dim) of two or more bodies."
            )
        return jnp.broadcast_to(self.G * mass if self.gm is None else self.gm, state.lanes)


def _pull(offsets: list[Array], strength: Array, softening: Array | None) -> list[Array]:
    """G m_j (x_j - x_i)/d³ by components [m/s²]."""
    near = _inverse_distance(offsets, softening)
    weight = strength * near * near * near  # in this order float32 reaches Pluto in SI units
    return [weight * d for d in offsets]


def _weigh(offsets: list[Array], strength: Array, softening: Array | None) -> list[Array]:
    """G m_j/d [m²/s²]."""
    return [strength * _inverse_distance(offsets, softening)]


def _inverse_distance(offsets: list[Array], softening: Array | None) -> Array:
    """1/d, and zero between a body and itself (or another at the same point)."""
    square = sum(d * d for d in offsets[1:]) + offsets[0] * offsets[0]
    apart = square > 0
    square = jnp.where(apart, square, 1.0)
    if softening is not None:
        square = square + softening * softening
    # not rsqrt: its derivative contains d³, which leaves the range of float32 in SI units
    return jnp.where(apart, 1.0 / jnp.sqrt(square), 0.0)


def _sum_over_sources(term: Term, x: Array, strength: Array, softening: Array | None) -> list[Array]:
    """The sum of a term over all sources for every body, `(*scenes, nodes)` each."""
    bodies = [x[..., i] for i in range(x.shape[-1])]
    if choose_block_targets(strength.shape[-1]) is None:
        return _fold_tiles(term, bodies, strength, softening)
    return _sum_at_once(term, bodies, strength, softening)


def _sum_pairs(
    term: Term, targets: list[Array], sources: list[Array], strength: Array, softening: Array | None
) -> list[Array]:
    """The sum of a term over some sources for some targets."""
    offsets = [s[..., None, :] - x[..., :, None] for s, x in zip(sources, targets, strict=True)]
    return [jnp.sum(part, axis=-1) for part in term(offsets, strength[..., None, :], softening)]


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _sum_at_once(term: Term, bodies: list[Array], strength: Array, softening: Array | None) -> list[Array]:
    """The sum over all sources at once, by a kernel or for one block of targets after the other.

    In a gradient a pair has something for its source as well as for its target, which no single reduction adds up:
    derivatives are of the sum by tiles, whose pairs are stored.
    """
    count, lanes = strength.shape[-1], strength.shape[:-1]
    kernel = choose_pair_kernel(count)
    if kernel is not None:
        from physjax.physics.forces.pair_kernel import sum_pairs_in_kernel  # Pallas takes a while to import

        by_scene = lambda bodies, strength: sum_pairs_in_kernel(term, bodies, strength, softening, kernel)  # noqa: E731
        for _ in lanes:
            by_scene = jax.vmap(by_scene)
        return by_scene(bodies, strength)
    blocks = -(-count // (choose_block_targets(count) or count))
    if blocks == 1:
        return _sum_pairs(term, bodies, bodies, strength, softening)
    found = lax.map(lambda some: _sum_pairs(term, some, bodies, strength, softening), [_cut(x, blocks) for x in bodies])
    return [jnp.moveaxis(a, 0, -2).reshape((*lanes, -1))[..., :count] for a in found]


@partial(_sum_at_once.defjvp, symbolic_zeros=True)
def _push_sum(term: Term, primals: tuple, tangents: tuple) -> tuple[list[Array], list[Array]]:
    numbers, structure = jax.tree.flatten(primals)
    pushes = structure.flatten_up_to(tangents)
    moving = [i for i, push in enumerate(pushes) if not isinstance(push, SymbolicZero)]

    def fold(*moved: Array) -> list[Array]:
        now = dict(zip(moving, moved, strict=True))
        return _fold_tiles(term, *structure.unflatten(now.get(i, number) for i, number in enumerate(numbers)))

    return jax.jvp(fold, [numbers[i] for i in moving], [pushes[i] for i in moving])


def _fold_tiles(term: Term, bodies: list[Array], strength: Array, softening: Array | None) -> list[Array]:
    """The sum folded over tiles of sources; the last tile is padded with sources of zero strength."""
    count = strength.shape[-1]
    most = choose_tile_sources(count)

    def add(total: list[Array], sources: list[Array], strength: Array) -> list[Array]:
        found = _sum_pairs(term, bodies, sources, strength, softening)
        return [a + b for a, b in zip(total, found, strict=True)]

    kinds = jax.eval_shape(partial(_sum_pairs, term), bodies, bodies, strength, softening)
    total = [jnp.zeros(kind.shape, kind.dtype) for kind in kinds]
    if count <= most:
        return add(total, bodies, strength)
    tiles = lambda a: _cut(a, -(-count // most), most)  # noqa: E731
    # recomputing a tile in reverse mode keeps its memory linear too
    body = jax.checkpoint(lambda total, tile: (add(total, *tile), None), prevent_cse=False)
    return lax.scan(body, total, ([tiles(c) for c in bodies], tiles(strength)))[0]


def _cut(a: Array, blocks: int, size: int | None = None) -> Array:
    """The last axis cut into blocks of a size, or of equal sizes, along a new first axis; filled up with zeros."""
    count = a.shape[-1]
    size = -(-count // blocks) if size is None else size
    filled = jnp.pad(a, [(0, 0)] * (a.ndim - 1) + [(0, blocks * size - count)])
    return jnp.moveaxis(filled.reshape((*a.shape[:-1], blocks, size)), -2, 0)


__all__ = ["Gravitation"]


def __dir__() -> list[str]:
    return __all__
