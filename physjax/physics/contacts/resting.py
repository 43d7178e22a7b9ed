"""Reaction forces of resting contact: each surface pushes a lane that presses on it, and friction brakes its slide.

`contact_mode` decides at the start of a leg which lanes press on which surfaces and whether they stick; the `Reaction`
then joins the forces for that leg, so that a method sees resting contact as one more acceleration.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from physjax.particles import Particles
from physjax.physics.contacts.surfaces import Surfaces, average_surfaces, mask_surfaces, relative_to
from physjax.vectors import dot, norm, scale, turn_left

NEGLIGIBLE_SPEED = 1e-15
"""A speed [m/s] of nothing: a slide in space that is slower has the direction that was decided."""
PARALLEL_SIN_SQUARED = 1e-5
"""Two surfaces whose normals differ by less (sin² of the angle) are one: the second carries nothing."""


class Reaction(eqx.Module):
    """Normal forces N >= 0 of the surfaces that a lane presses on, and friction μ_k N against its slip.

    No lane presses on more surfaces than space has dimensions: `places` says which surface takes each lane's first
    place, its second and so on (None: every surface has a place of its own), `pressed` which places are taken (1 or 0),
    and `slip` the direction in which the lane slips there at the start of the leg. Friction keeps that direction through
    the leg, beyond the moment at which a slide stops: the path stays smooth, and the stop is found as a root on it.
    Lanes that stick (`still`) do not accelerate, but with a surface that turns. Without `any_contact` the reactions are
    always computed: for a single surface and few lanes that is less work than to ask.
    """

    surfaces: Surfaces
    places: Bool[Array, "places surfaces *lanes"] | None
    pressed: Float[Array, "places *lanes"]
    still: Float[Array, "*lanes"]
    slip: Float[Array, "places *lanes dim"] | None
    any_contact: Bool[Array, ""] | None

    def __call__(self, t: ArrayLike, state: Particles, acceleration: Array) -> Array:
        """The acceleration [m/s²] of each lane with its reactions added."""
        if self.any_contact is None:
            return self._add_reactions(t, state, acceleration)
        return lax.cond(self.any_contact, lambda: self._add_reactions(t, state, acceleration), lambda: acceleration)

    def _add_reactions(self, t: ArrayLike, state: Particles, acceleration: Array) -> Array:
        normal = self._take_places(self.surfaces.normal_at(t, state.position))
        turn = self.surfaces.distance_acceleration(t, state)
        along = normal if self.slip is None else self._lean(t, normal, state, self.slip)
        # N_j along each reaction so that no lane accelerates into a surface that it presses on: n·a + v·∇n·v = 0
        wanted = -dot(jnp.broadcast_to(acceleration, normal.shape), normal)
        if turn is not None:
            wanted = wanted - self._take_places(turn)
        force = _solve_normal_forces(normal, along, wanted, self.pressed)
        acceleration = acceleration + (
            scale(force[0], along[0]) if len(force) == 1 else jnp.sum(scale(force, along), 0)
        )
        carried = self.surfaces.acceleration_at(t, state.position)
        # a product and not a choice: `where` between vectors costs several times the step
        if carried is None:
            return scale(1 - self.still, acceleration)
        leads = jnp.broadcast_to(mask_surfaces(self.surfaces.accelerates, carried[..., 0]), carried.shape[:-1])
        pressed = self.pressed * self._take_places(leads.astype(acceleration.dtype))
        # what sticks is let go within a step where its surface falls away from it
        pulled = jnp.all(force <= 0, axis=0) & jnp.any(pressed * wanted < 0, axis=0)
        still = jnp.where(pulled, 0.0, self.still)
        return scale(1 - still, acceleration) + scale(still, average_surfaces(pressed, self._take_places(carried)))

    def _take_places(self, values: Array) -> Array:
        """Of each place the value of the surface that takes it: a sum, of which all shares but one are zero."""
        if self.places is None:
            return values
        mask = self.places if self.places.ndim == values.ndim + 1 else self.places[..., None]
        return jnp.sum(jnp.where(mask, values[None], 0.0), axis=1)

    def _lean(self, t: ArrayLike, normal: Array, state: Particles, slip: Array) -> Array:
        """The direction of normal force and friction together: the normal, and μ_k against the slip."""
        kinetic = self.surfaces.kinetic_friction(state.lanes)
        assert kinetic is not None, "a slip is only decided where a surface is rough"
        relative = relative_to(self.carry(t, state), state.velocity, len(slip))
        across, length = _find_slip_direction(slip, normal, relative)
        return normal - scale(self._take_places(kinetic) / length, across)

    def measure_slides(self, t: ArrayLike, state: Particles) -> Array | None:
        """The speed of each slide in the direction in which it began [m/s], zero where it stops; None without friction."""
        if self.slip is None:
            return None
        return dot(relative_to(self.carry(t, state), state.velocity, len(self.slip)), self.slip)

    def carry(self, t: ArrayLike, state: Particles) -> Array | None:
        """The velocities of the surfaces that take the places [m/s]; None where no surface moves."""
        carried = self.surfaces.velocity_at(t, state.position)
        return None if carried is None else self._take_places(carried)


def _find_slip_direction(slip: Array, normal: Array, relative: Array) -> tuple[Array, ArrayLike]:
    """A vector along which a lane slips, and its length, in the direction that `slip` had at the start of the leg.

    In the plane that is the surface's tangent with the sign decided then: the speed, which passes through zero where a
    slide turns back, is no divisor. In space it is the tangential velocity; one that is negligible takes the direction of
    `slip` instead.
    """
    if slip.shape[-1] == 2:
        tangent = turn_left(normal)
        return scale(jnp.sign(dot(tangent, slip)), tangent), 1.0
    across = relative - scale(dot(relative, normal), normal)
    forwards = jnp.where(dot(across, slip) < 0, -1.0, 1.0)
    # where nothing moves yet, a negligible velocity along the decided direction stands in
    across = scale(forwards, across) + NEGLIGIBLE_SPEED * slip
    # which has no derivatives: a choice between equals, which the compiler drops where nothing is differentiated
    across = jnp.where((norm(across) > 2 * NEGLIGIBLE_SPEED)[..., None], across, lax.stop_gradient(across))
    speed = norm(across)
    return across, jnp.where(speed > 0, speed, 1.0)


def _solve_normal_forces(normal: Array, along: Array, wanted: Array, pressed: Array) -> Array:
    """The N >= 0 with Σ_j n_i·along_j N_j = w_i of the places that press; one that would have to pull lets go.

    Arrays are `(places, *lanes)`. Gaussian elimination, lane by lane, over the places that press, and again over those
    that the first time has left pushing.
    """
    size = len(wanted)
    if size == 1:  # friction is across the normal: n·along = 1
        return jnp.maximum(pressed * wanted, 0.0)
    pairs = (size, *normal.shape)
    rows = dot(jnp.broadcast_to(normal[:, None], pairs), jnp.broadcast_to(along[None], pairs))

    def eliminate(force: Array, _) -> tuple[Array, None]:
        return _eliminate_pressed(rows, wanted, force > 0), None

    force, _ = lax.scan(eliminate, pressed, length=2)
    return jnp.maximum(force, 0.0)


def _eliminate_pressed(rows: Array, wanted: Array, presses: Array) -> Array:
    """The x with Σ_j rows_ij x_j = wanted_i over the places that press (Gauss and Jordan), zero at the others."""
    size, lanes = len(wanted), wanted.shape[1:]
    units = jnp.asarray(np.eye(size, size + 1).reshape(size, size + 1, *(1,) * len(lanes)), wanted.dtype)

    def clear_column(carry: tuple[Array, Array], unit: Array) -> tuple[tuple[Array, Array], None]:
        system, free = carry
        # a product with a row of the unit matrix picks a row or a column: an index that is traced takes more operations
        row, column, own = jnp.sum(unit[:size, None] * system, 0), jnp.sum(unit[None] * system, 1), unit[:size]
        pivot = jnp.sum(own * column, 0)
        takes = (jnp.sum(own * free, 0) > 0) & (pivot > PARALLEL_SIN_SQUARED)
        inverse = jnp.where(takes, 1.0 / pivot, 0.0)[None]
        # its own row is divided by the pivot, from the others its share is taken
        system = system - ((column - own) * inverse)[:, None] * row[None]
        return (system, free * (1 - own * (inverse == 0).astype(own.dtype))), None

    start = jnp.concatenate([rows, wanted[:, None]], axis=1), presses.astype(wanted.dtype)
    (system, free), _ = lax.scan(clear_column, start, units)
    return free * system[:, -1]
