"""The appearance of particles over their life: size, colour and opacity as curves, evaluated for drawing."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from physjax.checks import Numbers, concrete_or_none, demand_all, quantity
from physjax.tracebacks import Module


class Appearance(NamedTuple):
    """Which particles are alive, their size [m], colour (red, green, blue from 0 to 1) and opacity (0 to 1; 0 when dead).

    Example:
        >>> seen = jet.final_scene.emitter.appearance(0.9)
        >>> isinstance(seen, emitters.Appearance), int(seen.alive.sum())
        (True, 4)
    """

    alive: Bool[Array, "*lanes"]
    size: Float[Array, "*lanes"]
    colour: Float[Array, "*lanes 3"]
    opacity: Float[Array, "*lanes"]


class Look(Module):
    """Curves over life: values at equally spaced ages from birth to death, linear between them.

    `size` `(knots,)` multiplies the size at birth, `colour` is `(knots, 3)`, `opacity` `(knots,)`. With `glows` the light of
    particles adds up, as in a fire, instead of one particle covering another. Raises ValueError for other shapes or
    numbers.

    Example:
        >>> emitters.Look(opacity=(1.0, 0.0)).opacity.tolist()
        [1.0, 0.0]
    """

    size: Numbers = quantity("size over life", "1", per=None, at_least=0, default=(1.0, 1.0))
    colour: Numbers = quantity("colour over life", "1", per=None, at_least=0, default=((0.2, 0.4, 0.7),) * 2)
    opacity: Numbers = quantity("opacity over life", "1", per=None, at_least=0, default=(1.0, 1.0))
    glows: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        for name, curve, axes in (("size", self.size, 1), ("colour", self.colour, 2), ("opacity", self.opacity, 1)):
            if curve.ndim != axes or (axes == 2 and curve.shape[-1] != 3) or not curve.shape[0]:
                raise ValueError(
                    f"{name} over life: got the shape {curve.shape}, expected {'(knots, 3)' if axes == 2 else '(knots,)'}."
                )
            if name != "size" and (values := concrete_or_none(curve)) is not None:
                demand_all(f"{name} over life [1]", curve, values <= 1, "numbers from 0 to 1")

    def appearance_of(
        self, alive: Bool[Array, "*lanes"], size: Float[Array, "*lanes"], share: Float[Array, "*lanes"]
    ) -> Appearance:
        """The appearance of particles of a size at birth [m], after a share of their lives [1]."""
        colour = jnp.stack([_interpolate(self.colour[:, i], share) for i in range(3)], axis=-1)
        opacity = jnp.where(alive, _interpolate(self.opacity, share), 0.0)
        return Appearance(alive, size * _interpolate(self.size, share), colour, opacity)


def _interpolate(curve: Array, share: Array) -> Array:
    """The value of a curve over life at a share of it, linear between its knots."""
    knots = jnp.linspace(0.0, 1.0, curve.shape[0], dtype=share.dtype)
    return jnp.interp(share, knots, curve.astype(share.dtype))
