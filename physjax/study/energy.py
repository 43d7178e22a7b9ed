"""Energy, momentum and angular momentum of a scene: what its physics keeps, and so what a method must not lose."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.scene import Particles, Scene
from physjax.vectors import cross, dot, norm, scale


class Conserved(NamedTuple):
    """A quantity that the physics keeps constant, `value(scene, t, state)`, and the `size` that its errors are measured by.

    Both are per lane, or per scene where lanes are coupled; the value may have components behind that.
    """

    name: str
    value: Callable[[Scene, ArrayLike, Particles], Array]
    size: Callable[[Scene, ArrayLike, Particles], Array]


def kinetic(scene: Scene, t: ArrayLike, state: Particles) -> Float[Array, "..."]:
    """½mv² [J], per lane or summed over coupled ones."""
    return _total(scene, 0.5 * scene.mass * dot(state.velocity, state.velocity))


def potential(scene: Scene, t: ArrayLike, state: Particles) -> Float[Array, "..."]:
    """Potential energy of all forces that have one [J], per lane or summed over coupled ones."""
    terms = [f.potential(t, state, scene.mass) for f in scene.forces if hasattr(f, "potential")]
    return _total(scene, sum(terms, jnp.zeros_like(state.position[..., 0])))


def total(scene: Scene, t: ArrayLike, state: Particles) -> Float[Array, "..."]:
    """Kinetic and potential energy [J], per lane or summed over coupled ones."""
    return kinetic(scene, t, state) + potential(scene, t, state)


def momentum(scene: Scene, t: ArrayLike, state: Particles) -> Float[Array, "..."]:
    """Σmv [kg m/s], per lane or summed over coupled ones; the component last."""
    p = scale(scene.mass, state.velocity)
    return jnp.sum(p, axis=-2) if scene.couples else p


def angular_momentum(scene: Scene, t: ArrayLike, state: Particles) -> Float[Array, "..."]:
    """Σ r × mv about the origin [kg m²/s]; a number in the plane, a vector in space."""
    r, p = state.position, scale(scene.mass, state.velocity)
    if r.shape[-1] == 2:
        return _total(scene, r[..., 0] * p[..., 1] - r[..., 1] * p[..., 0])
    spin = cross(r, p)
    return jnp.sum(spin, axis=-2) if scene.couples else spin


def _total(scene: Scene, per_lane: Array) -> Array:
    return jnp.sum(per_lane, axis=-1) if scene.couples else per_lane


ENERGY = Conserved("energy", total, kinetic)
"""Total energy, its errors measured by the kinetic energy."""
MOMENTUM = Conserved("momentum", momentum, lambda scene, t, s: _total(scene, scene.mass * norm(s.velocity)))
"""Total momentum, its errors measured by Σm|v|."""
ANGULAR_MOMENTUM = Conserved(
    "angular momentum",
    angular_momentum,
    lambda scene, t, s: _total(scene, scene.mass * norm(s.position) * norm(s.velocity)),
)
"""Angular momentum about the origin, its errors measured by Σm|r||v|."""
