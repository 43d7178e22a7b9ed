"""How particles look over their life: size, colour and opacity as curves, data for drawing."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from physjax.checks import concrete_or_none, demand_all, quantity


class Appearance(NamedTuple):
    """Who is seen, how large [m], in which colour (red, green, blue from 0 to 1), and how opaque (0 to 1; 0 of the dead).

    Example:
        >>> seen = jet.final_scene.emitter.appearance(0.9)
        >>> isinstance(seen, emitters.Appearance), int(seen.alive.sum())
        (True, 4)
    """

    alive: Bool[Array, "*lanes"]
    size: Float[Array, "*lanes"]
    colour: Float[Array, "*lanes 3"]
    opacity: Float[Array, "*lanes"]


class Look(eqx.Module):
    """Curves over life: values at equal shares of it from birth to death, straight lines between them.

    `size` multiplies the size a particle was born with; `colour` is `(knots, 3)`. `glows` says that the light of
    particles adds up, as fire's does, instead of one covering another. Raises ValueError for other shapes or numbers.

    Example:
        >>> emitters.Look(opacity=(1.0, 0.0)).opacity.tolist()
        [1.0, 0.0]
    """

    size: Float[Array, "knots"] = quantity("size over life", "1", per=None, at_least=0, default=(1.0, 1.0))
    colour: Float[Array, "knots 3"] = quantity(
        "colour over life", "1", per=None, at_least=0, default=((0.2, 0.4, 0.7),) * 2
    )
    opacity: Float[Array, "knots"] = quantity("opacity over life", "1", per=None, at_least=0, default=(1.0, 1.0))
    glows: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        for name, curve, axes in (("size", self.size, 1), ("colour", self.colour, 2), ("opacity", self.opacity, 1)):
            if curve.ndim != axes or (axes == 2 and curve.shape[-1] != 3) or not curve.shape[0]:
                raise ValueError(
                    f"{name} over life: got the shape {curve.shape}, expected {'(knots, 3)' if axes == 2 else '(knots,)'}."
                )
            if name != "size" and concrete_or_none(curve) is not None:
                demand_all(f"{name} over life [1]", curve, concrete_or_none(curve) <= 1, "numbers from 0 to 1")

    def appearance_of(
        self, alive: Bool[Array, "*lanes"], size: Float[Array, "*lanes"], share: Float[Array, "*lanes"]
    ) -> Appearance:
        """The appearance of particles born with a size [m], after a share of their lives."""
        colour = jnp.stack([_interpolate(self.colour[:, i], share) for i in range(3)], axis=-1)
        opacity = jnp.where(alive, _interpolate(self.opacity, share), 0.0)
        return Appearance(alive, size * _interpolate(self.size, share), colour, opacity)


def _interpolate(curve: Array, share: Array) -> Array:
    knots = jnp.linspace(0.0, 1.0, curve.shape[0], dtype=share.dtype)
    return jnp.interp(share, knots, curve.astype(share.dtype))
