"""The surfaces of a scene that are resolved at the time of impact, together: evaluated once for all of a kind.

Arrays of all surfaces are `(surfaces, *lanes)` and `(surfaces, *lanes, dim)`, kind after kind. What no surface has, such
as friction or a velocity, is None and absent from the program.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.particles import Particles
from physjax.physics.contacts.face import ContactFace
from physjax.stacks import Stack, map_stacks, stack_alike, unstack
from physjax.tracebacks import Module
from physjax.vectors import scale


class Touch(NamedTuple):
    """What a state is to every surface: signed distance [m], normal, and the surface's own velocity [m/s] (None: none moves)."""

    distance: Array
    normal: Array
    carried: Array | None


class Surfaces(Module):
    """All surfaces of a scene that are resolved at the time of impact, by kind."""

    stacks: tuple[Stack, ...]

    @classmethod
    def of(cls, surfaces: Sequence[ContactFace]) -> "Surfaces":
        """The surfaces by kind."""
        return cls(stack_alike(surfaces))

    def __len__(self) -> int:
        return sum(stack.size for stack in self.stacks)

    @property
    def bends(self) -> bool:
        """Whether the distance to any of them has a second derivative of its own: it is curved, or has a motion."""
        return any(stack.part.curved or stack.part.motion is not None for stack in self.stacks)

    @property
    def moves(self) -> np.ndarray:
        """Which of them move, or turn within themselves."""
        return self._mark(lambda part: part.moves)

    @property
    def accelerates(self) -> np.ndarray:
        """Which of them accelerate what sticks to them."""
        return self._mark(lambda part: part.accelerates)

    @property
    def rough(self) -> np.ndarray:
        """Which of them have Coulomb's friction."""
        return self._mark(lambda part: part.coulomb is not None)

    @property
    def touching_since(self) -> Array:
        """Since when [s] each lane is in contact with each; infinite where it is not."""
        return map_stacks(lambda part: part.touching_since, self.stacks)

    def in_scene_order(self, values: Array) -> list[Array]:
        """Values of every surface, listed in the order in which the scene has the surfaces."""
        places = [place for stack in self.stacks for place in stack.places]
        each = unstack(values)
        return [each[places.index(place)] for place in range(len(places))]

    def facing(self, t: ArrayLike, position: Array) -> "Surfaces":
        """The surfaces as each lane meets them from where it is: of a slab, the nearer face."""
        return Surfaces(tuple(stack.replace(lambda part: part.facing(t, position)) for stack in self.stacks))

    def signed_distance(self, t: ArrayLike, position: Array) -> Array:
        """Signed distances [m]."""
        return map_stacks(lambda part: part.signed_distance(t, position), self.stacks)

    def normal_at(self, t: ArrayLike, position: Array) -> Array:
        """Unit vectors towards the legal side."""
        return map_stacks(lambda part: part.normal_at(t, position), self.stacks)

    def velocity_at(self, t: ArrayLike, position: Array) -> Array | None:
        """The velocities of the surfaces where lanes are [m/s]; None where none moves."""
        if not self.moves.any():
            return None
        return map_stacks(lambda part: _or_zero(part.velocity_at(t, position), position), self.stacks)

    def acceleration_at(self, t: ArrayLike, position: Array) -> Array | None:
        """The accelerations of what sticks to them [m/s²]; None where none has any."""
        if not self.accelerates.any():
            return None
        return map_stacks(lambda part: _or_zero(part.acceleration_at(t, position), position), self.stacks)

    def measure(self, t: ArrayLike, state: Particles) -> Touch:
        """Where the state is relative to every surface."""
        x = state.position
        return Touch(self.signed_distance(t, x), self.normal_at(t, x), self.velocity_at(t, x))

    def distance_acceleration(self, t: ArrayLike, state: Particles) -> Array | None:
        """The second time derivatives of the signed distances of lanes that are not accelerated [m/s²]; None if all are zero."""
        if not self.bends:
            return None
        return map_stacks(lambda part: part.distance_acceleration(t, state), self.stacks)

    def may_meet(self, since: Array, t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles) -> Array:
        """Whether a lane may meet any of them within a step, or stop where it slides: cheap, true of every lane that does."""
        meets, first = jnp.zeros(start.lanes, bool), 0
        for stack in self.stacks:
            touching = jnp.isfinite(since[first : (first := first + stack.size)])
            ask = lambda part, touching: part.may_meet(touching, t, dt, start, end)  # noqa: E731
            meets = meets | jnp.any(stack.map(ask, touching), axis=0)
        return meets

    def restitution(self, lanes: tuple[int, ...]) -> Array:
        """K_r of every surface, `(surfaces, *lanes)`."""
        return map_stacks(lambda part: jnp.broadcast_to(part.restitution, lanes), self.stacks)

    def friction(self, lanes: tuple[int, ...]) -> Array | None:
        """The lecture's K_f of every surface; zero where others have it, None where none has."""
        return self._pick_friction(lanes, lambda part: part.friction)

    def static_friction(self, lanes: tuple[int, ...]) -> Array | None:
        """Coulomb's μ_s of every surface; zero where others have it, None where none has."""
        return self._pick_friction(lanes, lambda part: part.coulomb and part.coulomb.static)

    def kinetic_friction(self, lanes: tuple[int, ...]) -> Array | None:
        """Coulomb's μ_k of every surface; zero where others have it, None where none has."""
        return self._pick_friction(lanes, lambda part: part.coulomb and part.coulomb.kinetic)

    def _pick_friction(self, lanes: tuple[int, ...], get: Callable[[Any], Array | None]) -> Array | None:
        if all(get(stack.part) is None for stack in self.stacks):
            return None
        absent = lambda part: jnp.zeros_like(part.restitution)  # noqa: E731

        def own(part: Any) -> Array:
            number = get(part)
            return jnp.broadcast_to(absent(part) if number is None else number, lanes)

        return map_stacks(own, self.stacks)

    def _mark(self, says: Callable[[Any], bool]) -> np.ndarray:
        return np.concatenate([np.full(stack.size, says(stack.part)) for stack in self.stacks])


def _or_zero(vectors: Array | None, like: Array) -> Array:
    return jnp.zeros_like(like) if vectors is None else vectors


def mask_surfaces(marks: np.ndarray, like: Array) -> Array:
    """Marks of the surfaces shaped to broadcast with `(surfaces, *lanes)` arrays."""
    return jnp.asarray(marks.reshape(-1, *(1,) * (like.ndim - 1)))


def relative_to(carried: Array | None, velocity: Array, count: int) -> Array:
    """Velocities relative to every surface [m/s], of which the velocities are given."""
    return jnp.broadcast_to(velocity, (count, *velocity.shape)) if carried is None else velocity[None] - carried


def average_surfaces(weight: Array, vectors: Array) -> Array:
    """The mean over the surfaces of a vector of each, where their weights are 1; zero where all are 0."""
    share = weight / jnp.maximum(jnp.sum(weight, axis=0, keepdims=True), 1)
    return jnp.sum(scale(share, vectors), axis=0)


def select_surface(chosen: Array, values: Array) -> Array:
    """The value of the surface that is chosen, lane by lane: the sum of what is not masked, so that nothing is gathered."""
    if len(values) == 1:
        return values[0]
    mask = chosen if chosen.ndim == values.ndim else chosen[..., None]
    return jnp.sum(jnp.where(mask, values, 0.0), axis=0)
