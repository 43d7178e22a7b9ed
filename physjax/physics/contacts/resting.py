"""Reaction forces of resting contact: each surface pushes a lane that presses on it, and friction brakes its slide.

`contact_mode` decides at the start of a step which lanes press on which surfaces and whether they stick; the `Reaction`
then joins the forces for that step, so that a method sees resting contact as one more acceleration.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from physjax.linear import eliminate
from physjax.particles import Particles, sum_terms
from physjax.physics.contacts.face import ContactFace
from physjax.vectors import components, norm, stack_components, turn_left

NEGLIGIBLE_SPEED = 1e-15
"""A speed [m/s] of nothing: a slide in space that is slower has the direction that was decided."""
PARALLEL_SIN_SQUARED = 1e-5
"""Two surfaces whose normals differ by less (sin² of the angle) are one: the second carries nothing."""

SurfaceTerms = tuple[list[Array], ArrayLike, list[Array]]
"""Of a surface: normal, curvature acceleration [m/s²], and the direction of normal force and friction together."""


class Reaction(eqx.Module):
    """Normal forces N >= 0 of the surfaces that a lane presses on, and friction μ_k N against its slip.

    `pressed` and `slip` are per surface: which lanes it carries (1 or 0), and the direction in which they slip at the
    start of the step. Friction keeps that direction through the step, beyond the moment at which a slide stops: the path
    stays smooth, and the stop is found as a root on it. Lanes that stick (`still`) do not accelerate at all.

    No lane presses on more surfaces than space has dimensions. Where there are more surfaces, `places` says which of
    them takes each lane's first place, its second and so on, so that the normal forces are a system of that size.
    """

    surfaces: tuple[ContactFace, ...]
    pressed: tuple[Float[Array, "*lanes"], ...]
    slip: tuple[Float[Array, "*lanes dim"] | None, ...]
    still: Float[Array, "*lanes"]
    places: tuple[tuple[Float[Array, "*lanes"], ...], ...] | None
    any_contact: Bool[Array, ""]

    def __call__(self, t: ArrayLike, state: Particles, acceleration: Array) -> Array:
        """The acceleration [m/s²] of each lane with its reactions added."""
        return lax.cond(self.any_contact, lambda: self._add_reactions(t, state, acceleration), lambda: acceleration)

    def _add_reactions(self, t: ArrayLike, state: Particles, acceleration: Array) -> Array:
        surface_terms = [self._compute_surface_terms(i, t, state) for i in range(len(self.surfaces))]
        # component by component: small vectors along the last axis would be reductions
        total = components(acceleration)
        if self.places is None:
            presses = list(self.pressed)
        else:
            presses = [sum_terms(place) for place in self.places]
            surface_terms = [_select_place(place, surface_terms) for place in self.places]
        # N_j along each reaction so that no lane accelerates into a surface that it presses on: n·a + v·∇n·v = 0
        wanted = [
            -dot_components(total, normal) - curvature_acceleration
            for normal, curvature_acceleration, _ in surface_terms
        ]
        weights = [[dot_components(normal, along) for _, _, along in surface_terms] for normal, _, _ in surface_terms]
        for force, (_, _, along) in zip(_solve_normal_forces(weights, wanted, presses), surface_terms, strict=True):
            total = add_scaled(total, force, along)
        # a product and not a choice: `where` between vectors costs several times the step
        free = 1 - self.still
        return stack_components([free * part for part in total])

    def _compute_surface_terms(self, i: int, t: ArrayLike, state: Particles) -> SurfaceTerms:
        """Normal, curvature acceleration, and the direction of the reaction: the normal and friction against the slip."""
        surface, slip = self.surfaces[i], self.slip[i]
        normal_at, relative = surface.normal_at(t, state.position), surface.relative(state.velocity)
        curvature_acceleration = surface.curvature_acceleration(t, state.position, relative)
        normal = components(normal_at)
        if slip is None or surface.coulomb is None:
            return normal, curvature_acceleration, normal
        along, length = _find_slip_direction(components(slip), normal_at, relative)
        return normal, curvature_acceleration, add_scaled(normal, -surface.coulomb.kinetic / length, along)


def _find_slip_direction(slip: list[Array], normal_at: Array, relative: Array) -> tuple[list[Array], ArrayLike]:
    """A vector along which a lane slips, and its length, in the direction that `slip` had at the start of the step.

    In the plane that is the surface's tangent with the sign decided then: the speed, which passes through zero where a
    slide turns back, is no divisor. In space it is the tangential velocity; one that is negligible takes the direction of
    `slip` instead.
    """
    if len(slip) == 2:
        tangent = components(turn_left(normal_at))
        sign = jnp.sign(dot_components(tangent, slip))
        return [sign * part for part in tangent], 1.0
    normal, across = components(normal_at), components(relative)
    across = add_scaled(across, -dot_components(across, normal), normal)
    forwards = jnp.where(dot_components(across, slip) < 0, -1.0, 1.0)
    # where nothing moves yet, a negligible velocity along the decided direction stands in
    across = [forwards * part + NEGLIGIBLE_SPEED * direction for part, direction in zip(across, slip, strict=True)]
    # which has no derivatives: a choice between equals, which the compiler drops where nothing is differentiated
    moving = norm(stack_components(across)) > 2 * NEGLIGIBLE_SPEED
    across = [jnp.where(moving, part, lax.stop_gradient(part)) for part in across]
    speed = norm(stack_components(across))
    return across, jnp.where(speed > 0, speed, 1.0)


def _select_place(place: tuple[Array, ...], surface_terms: list[SurfaceTerms]) -> SurfaceTerms:
    """The terms of the surface that takes a place, lane by lane: a sum, of which all shares but one are zero."""
    pick = lambda *values: sum_terms([share * value for share, value in zip(place, values, strict=True)])  # noqa: E731
    return jax.tree.map(pick, *surface_terms)


def _solve_normal_forces(weights: list[list[Array]], wanted: list[Array], presses: list[Array]) -> list[Array]:
    """The N >= 0 with Σ_j W_ij N_j = w_i of the surfaces that press; one that would have to pull lets go."""
    forces = _eliminate_pressed(weights, wanted, presses)
    if len(forces) > 1:
        forces = _eliminate_pressed(
            weights, wanted, [jnp.where(force > 0, p, 0.0) for p, force in zip(presses, forces, strict=True)]
        )
    return [jnp.maximum(force, 0.0) for force in forces]


def _eliminate_pressed(weights: list[list[Array]], wanted: list[Array], presses: list[Array]) -> list[Array]:
    """Gaussian elimination, lane by lane, over those that press."""
    return eliminate(weights, wanted, lambda i, pivot: (presses[i] > 0) & (pivot > PARALLEL_SIN_SQUARED))


def dot_components(a: list[Array], b: list[Array]) -> Array:
    """Scalar product of vectors given as lists of components."""
    return sum_terms([x * y for x, y in zip(a, b, strict=True)])


def add_scaled(a: list[Array], factor: ArrayLike, b: list[Array]) -> list[Array]:
    """a + factor b, component by component."""
    return [x + factor * y for x, y in zip(a, b, strict=True)]
