"""Newtonian gravitation between all pairs, in tiles of sources: memory stays linear in the number of bodies."""

from collections.abc import Callable
from typing import ClassVar, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.backend import SOURCES_PER_TILE
from physjax.checks import Numbers, OptionalNumbers, quantity
from physjax.particles import Particles
from physjax.parts import Field

Total = TypeVar("Total")


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
        x, gm = state.position, self._gm(state, mass)
        targets = _split_components(x)

        def pull(total: list[Array], sources: list[Array], strength: Array) -> list[Array]:
            offsets = [s[..., None, :] - x_i[..., :, None] for s, x_i in zip(sources, targets, strict=True)]
            near = self._inverse_distance(offsets)
            weight = strength[..., None, :] * near * near * near  # in this order float32 reaches Pluto in SI units
            return [a + jnp.sum(weight * d, axis=-1) for a, d in zip(total, offsets, strict=True)]

        return jnp.stack(_fold_tiles(pull, [jnp.zeros_like(c) for c in targets], targets, gm), axis=-1)

    def potential(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*scenes nodes"]:
        """-½ Σ_j m_i G m_j/d [J]: each pair's energy is halved between its two bodies."""
        x, gm = state.position, self._gm(state, mass)
        targets = _split_components(x)

        def add(total: Array, sources: list[Array], strength: Array) -> Array:
            offsets = [s[..., None, :] - x_i[..., :, None] for s, x_i in zip(sources, targets, strict=True)]
            return total + jnp.sum(strength[..., None, :] * self._inverse_distance(offsets), axis=-1)

        return -0.5 * mass * _fold_tiles(add, jnp.zeros_like(gm), targets, gm)

    def _gm(self, state: Particles, mass: Array) -> Array:
        """GM of every body as a source [m³/s²]."""
        if not state.lanes:
            raise ValueError(
                "Gravitation: got a state without lanes, expected positions (*scenes, nodes, dim) of two or more bodies."
            )
        return jnp.broadcast_to(self.G * mass if self.gm is None else self.gm, state.lanes)

    def _inverse_distance(self, offsets: list[Array]) -> Array:
        """1/d, and zero between a body and itself (or another at the same point)."""
        square = sum(d * d for d in offsets[1:]) + offsets[0] * offsets[0]
        apart = square > 0
        square = jnp.where(apart, square, 1.0)
        if self.softening is not None:
            square = square + self.softening * self.softening
        # not rsqrt: its derivative contains d³, which leaves the range of float32 in SI units
        return jnp.where(apart, 1.0 / jnp.sqrt(square), 0.0)


def _split_components(x: Array) -> list[Array]:
    """The components of positions, one array each: `(*scenes, nodes)` [m]."""
    return [x[..., i] for i in range(x.shape[-1])]


def _fold_tiles(
    add: Callable[[Total, list[Array], Array], Total], total: Total, sources: list[Array], strength: Array
) -> Total:
    """Fold `add(total, sources, strength)` over tiles of sources; the last tile is padded with sources of zero strength."""
    count = strength.shape[-1]
    if count <= SOURCES_PER_TILE:
        return add(total, sources, strength)
    missing = -count % SOURCES_PER_TILE

    def tiles(a: Array) -> Array:
        filled = jnp.pad(a, [(0, 0)] * (a.ndim - 1) + [(0, missing)])
        return jnp.moveaxis(filled.reshape((*a.shape[:-1], -1, SOURCES_PER_TILE)), -2, 0)

    # recomputing a tile in reverse mode keeps its memory linear too
    body = jax.checkpoint(lambda total, tile: (add(total, *tile), None), prevent_cse=False)
    return lax.scan(body, total, ([tiles(c) for c in sources], tiles(strength)))[0]


__all__ = ["Gravitation"]


def __dir__() -> list[str]:
    return __all__
