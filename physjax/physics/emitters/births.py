"""What is drawn for a birth: uniform numbers from a key, folded with the slot and the generation of the particle.

No random state is carried: birth number n has the same numbers whatever was born before it, in any batch, and after a
run was resumed.
"""

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt32

from physjax.loops import force_rounding

if TYPE_CHECKING:
    from physjax.checks import Numbers

    Key = Numbers  # a seed or a key is given, words are read
else:
    Key = UInt32[Array, "words"]

DRAWS_PER_BIRTH = 8
"""Uniform numbers per birth: three for the place, two for the direction, then speed, life and size."""


class Birth(NamedTuple):
    """What is fixed when a particle is born: the time [s], its life [s] and size [m], position [m] and velocity [m/s].

    Example:
        >>> first = fountain.births(slot=jnp.array([0]), generation=jnp.array([0]))
        >>> isinstance(first, emitters.Birth), first.velocity.tolist()
        (True, [[0.0, 5.0]])
    """

    time: Float[Array, "*births"]
    life: Float[Array, "*births"]
    size: Float[Array, "*births"]
    position: Float[Array, "*births dim"]
    velocity: Float[Array, "*births dim"]


def read_key(key: int | np.integer | Array) -> UInt32[Array, "words"]:
    """The words of a key of JAX's default generator, or of a seed: plain numbers, which can be swept and saved."""
    if isinstance(key, int | np.integer):
        key = jax.random.key(key)
    if not (isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)):
        raise TypeError(f"key: got {key!r}, expected a seed or jax.random.key(seed).")
    return jax.random.key_data(key)


def draw_uniforms(words: Array, slot: Array, generation: Array, dtype: np.dtype) -> Float[Array, "births draws"]:
    """Uniform numbers from 0 to 1 for the births of these slots in these generations, `(births, DRAWS_PER_BIRTH)`."""
    key = jax.random.wrap_key_data(words, impl="threefry2x32")

    def draw(slot: Array, generation: Array) -> Array:
        folded = jax.random.fold_in(jax.random.fold_in(key, slot), generation)
        return jax.random.uniform(folded, (DRAWS_PER_BIRTH,), dtype)

    return jax.vmap(draw)(slot, generation)


def apply_spread(mean: Array, spread: Array, u: Array) -> Array:
    """A number that is uniform within mean·(1 ± spread), for u uniform from 0 to 1."""
    return force_rounding(mean * (1.0 + force_rounding(spread * (2.0 * u - 1.0))))
