"""Newton's gravitation between all pairs, in tiles of sources, so that memory stays linear in the number of bodies."""

from typing import ClassVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.backend import SOURCES_PER_TILE
from physjax.checks import quantity
from physjax.particles import Particles
from physjax.parts import Field


class Gravitation(Field):
    """Attraction between all lanes of the last axis: a_i = Σ_j G m_j (x_j - x_i)/d³, d² = |x_j - x_i|² + ε².

    `G` [m³/kg/s²] (the lecture's 6.673e-11 by argument) with the scene's masses, or `gm` [m³/s²] for each body, which
    astronomers know far better than either. `softening` ε [m] is Plummer's. Two bodies at the same point do not act on
    each other.

    Example:
        >>> pair = Particles(jnp.array([[0.0, 0.0], [2.0, 0.0]]), jnp.zeros((2, 2)))
        >>> print(loads(Scene(pair, mass=jnp.array([3.0, 4.0]), forces=(forces.Gravitation(G=1.0),)), 0.0))
        [[ 3.  0.]
         [-3.  0.]]
    """

    couples: ClassVar[bool] = True
    G: Float[Array, ""] = quantity("G", "m³/kg/s²", per=None, default=6.67430e-11)
    softening: Float[Array, ""] | None = quantity("softening", "m", per=None, at_least=0, default=None)
    gm: Float[Array, "..."] | None = quantity("gm", "m³/s²", at_least=0, default=None)

    def acceleration(
        self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]
    ) -> Float[Array, "*scenes nodes dim"]:
        """Σ_j G m_j (x_j - x_i)/d³ [m/s²]."""
        x, gm = state.position, self._gm(state, mass)
        targets = _split_components(x)

        def pull(total, sources, strength):
            offsets = [s[..., None, :] - x_i[..., :, None] for s, x_i in zip(sources, targets, strict=True)]
            near = self._inverse_distance(offsets)
            weight = strength[..., None, :] * near * near * near  # in this order float32 reaches Pluto in SI units
            return [a + jnp.sum(weight * d, axis=-1) for a, d in zip(total, offsets, strict=True)]

        return jnp.stack(_fold_tiles(pull, [jnp.zeros_like(c) for c in targets], targets, gm), axis=-1)

    def potential(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*scenes nodes"]:
        """-½ Σ_j m_i G m_j/d [J]: each pair's energy is halved between its two bodies."""
        x, gm = state.position, self._gm(state, mass)
        targets = _split_components(x)

        def add(total, sources, strength):
            offsets = [s[..., None, :] - x_i[..., :, None] for s, x_i in zip(sources, targets, strict=True)]
            return total + jnp.sum(strength[..., None, :] * self._inverse_distance(offsets), axis=-1)

        return -0.5 * mass * _fold_tiles(add, jnp.zeros_like(gm), targets, gm)

    def _gm(self, state: Particles, mass: Array) -> Array:
        """Strength of every body as a source [m³/s²]."""
        if not state.lanes:
            raise ValueError(
                "Gravitation: got a state without lanes, expected positions (*scenes, nodes, dim) of two or more bodies."
            )
        return jnp.broadcast_to(self.G * mass if self.gm is None else self.gm, state.lanes)

    def _inverse_distance(self, offsets: list[Array]) -> Array:
        """1/d, and zero for a body and itself (or another at the same point)."""
        square = sum(d * d for d in offsets[1:]) + offsets[0] * offsets[0]
        apart = square > 0
        square = jnp.where(apart, square, 1.0)
        if self.softening is not None:
            square = square + self.softening * self.softening
        return jnp.where(apart, 1.0 / jnp.sqrt(square), 0.0)  # rsqrt's derivative passes 1/d³, which underflows


def _split_components(x: Array) -> list[Array]:
    return [x[..., i] for i in range(x.shape[-1])]


def _fold_tiles(add, total, sources: list[Array], strength: Array):
    """Fold `add(total, sources, strength)` over tiles of the last axis; the last is filled up with sources of no strength."""
    count = strength.shape[-1]
    if count <= SOURCES_PER_TILE:
        return add(total, sources, strength)
    missing = -count % SOURCES_PER_TILE

    def tiles(a):
        filled = jnp.pad(a, [(0, 0)] * (a.ndim - 1) + [(0, missing)])
        return jnp.moveaxis(filled.reshape((*a.shape[:-1], -1, SOURCES_PER_TILE)), -2, 0)

    # recomputing a tile in reverse mode keeps its memory linear too
    body = jax.checkpoint(lambda total, tile: (add(total, *tile), None), prevent_cse=False)
    return lax.scan(body, total, ([tiles(c) for c in sources], tiles(strength)))[0]
