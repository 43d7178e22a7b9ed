"""How surfaces that turn, or are driven by functions of time, move where bodies touch them.

What sticks to such a surface must end a sub-step where the surface has gone: so the velocity for the places after it is
that of the surface halfway, at the place that the point in contact has reached by then, and the velocity for the end is
that at the end. Both are second order: a box on a turntable neither spirals out nor lags behind.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.physics.contacts.surface import Surface
from physjax.physics.rigid.solids.world import World


class SurfaceMotion(NamedTuple):
    """Velocities of second surfaces at the middles of contacts [m/s] and about them [rad/s].

    Each component is `(groups, size, worlds)`: one of `spin` in the plane, three in space.
    """

    velocity: tuple[Array, ...]
    spin: tuple[Array, ...]


def follow_surfaces(
    world: World, t: ArrayLike, middle: tuple[Array, ...]
) -> tuple[SurfaceMotion, SurfaceMotion] | None:
    """How surfaces move in the mean of a sub-step, and at its end; None where all of them stand or move uniformly.

    `middle` [m] has a component for each direction, `(groups, size, worlds)`, at the start of the sub-step.
    """
    if not any(slot.surface.accelerates for slot in world.slots):
        return None
    # times as numbers, or with the axes of places
    h, t = (part if part.ndim == 0 else part.reshape(1, 1, -1) for part in (world.substep, jnp.asarray(t, world.dtype)))
    x = jnp.stack(middle, axis=-1)
    after = lambda share, v: x + (share * h)[..., None] * v if h.ndim else x + share * h * v  # noqa: E731
    halfway = _find_motion(world, t + h / 2, after(0.5, _find_motion(world, t, x)[0]))
    end = _find_motion(world, t + h, after(1.0, halfway[0]))
    split = lambda vectors: tuple(vectors[..., i] for i in range(vectors.shape[-1]))  # noqa: E731
    mean, end = (SurfaceMotion(split(velocity), split(spin)) for velocity, spin in (halfway, end))
    return mean, end


def _find_motion(world: World, t: Array, place: Array) -> tuple[Array, Array]:
    """Velocities and angular velocities of all surfaces where they are touched, `(groups, size, worlds, dim)`."""
    slots, pairs = world.slots, world.groups.of_pairs
    each = (len(place) - pairs) // len(slots)
    apart = [place[:pairs], *(place[pairs + k * each : pairs + (k + 1) * each] for k in range(len(slots)))]
    spins = 3 if place.shape[-1] == 3 else 1
    none = jnp.zeros_like(apart[0]), jnp.zeros((*apart[0].shape[:-1], spins), place.dtype)
    found = [none, *(_move_surface(slot.surface, t, x, spins) for slot, x in zip(slots, apart[1:], strict=True))]
    velocity, spin = (jnp.concatenate(parts) for parts in zip(*found, strict=True))
    return velocity, spin


def _move_surface(surface: Surface, t: Array, place: Array, spins: int) -> tuple[Array, Array]:
    velocity, spin = surface.velocity_at(t, place), surface.spin_at(t, place)
    still = jnp.zeros((*place.shape[:-1], spins), place.dtype)
    return jnp.zeros_like(place) if velocity is None else velocity, still if spin is None else spin


__all__ = ["SurfaceMotion", "follow_surfaces"]
