"""What a contact does to a velocity: restitution along the normal, friction across it."""

from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.checks import Numbers, concrete_or_none, demand_all, quantity
from physjax.particles import Particles
from physjax.tracebacks import Module
from physjax.vectors import dot, scale

MIN_SLIP_SPEED_SQUARED = 1e-30
"""Slip speed² [m²/s²] below which nothing slips; it keeps the derivative of the square root finite at zero."""


class Coulomb(Module):
    """Dry friction: a contact sticks up to μ_s times the normal impulse or force; beyond, it slips against μ_k times it.

    Example:
        >>> dry = contacts.Coulomb(static=0.6, kinetic=0.5)
        >>> road = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.0, coulomb=dry)
        >>> skid = Particles(jnp.array([0.0, -0.1]), jnp.array([3.0, -4.0]))
        >>> print(road.respond(0.0, skid).velocity)
        [1. 0.]
    """

    static: Numbers = quantity("static friction μ_s", "1", at_least=0)
    kinetic: Numbers = quantity("kinetic friction μ_k", "1", at_least=0)

    def __check_init__(self):
        static, kinetic = concrete_or_none(self.static), concrete_or_none(self.kinetic)
        if static is not None and kinetic is not None:
            demand_all(
                "kinetic friction μ_k [1]", self.kinetic, kinetic <= static, f"at most the static μ_s = {static}"
            )

    def relations(self) -> tuple[Array, ...]:
        """Conditions on its numbers, checked also where they are traced."""
        return (self.kinetic <= self.static,)


@runtime_checkable
class DryFriction(Protocol):
    """Coefficients of static and of kinetic friction."""

    @property
    def static(self) -> Any:
        """μ_s."""
        ...

    @property
    def kinetic(self) -> Any:
        """μ_k."""
        ...


@runtime_checkable
class Material(Protocol):
    """What a contact needs to know of a surface besides its geometry."""

    @property
    def restitution(self) -> Any:
        """K_r."""
        ...

    @property
    def friction(self) -> Any:
        """The lecture's K_f."""
        ...

    @property
    def coulomb(self) -> DryFriction | None:
        """Coulomb's friction."""
        ...


def apply_restitution(
    surface: Material,
    state: Particles,
    contact: tuple[Array, Array, Array],
    inward: Float[Array, "*lanes"],
    rests: Array | None = None,
) -> Particles:
    """v' = (1 - K_f) v_t - K_r v_n relative to the surface, and the position moved back onto it.

    `contact` is signed distance (<= 0), normal and relative velocity; `inward` (<= 0) is the normal velocity of lanes in
    contact, 0 of all others. Lanes that come to rest (`rests`) do not bounce, nor keep tangential velocity if K_f > 0.
    """
    depth, normal, relative = contact
    restitution = surface.restitution if rests is None else jnp.where(rests, 0.0, surface.restitution)
    push = (1 + restitution) * inward
    loss = _tangential_loss(surface, relative, inward, -push, rests)
    x, v = state
    # per-lane coefficients instead of a choice between vectors, which would cost several times the step
    if loss is not None:
        v = v - scale(loss, relative)
        push = push - loss * inward
    return Particles(x - scale(depth, normal), v - scale(push, normal))


def _tangential_loss(
    surface: Material, relative: Array, inward: Array, impulse: Array, rests: ArrayLike | None
) -> Array | None:
    """The share of the tangential velocity that a contact takes from each lane; None for a frictionless surface.

    `impulse` is the normal one, per unit of mass.
    """
    if surface.friction is not None:
        loss = surface.friction if rests is None else jnp.where(rests & (surface.friction > 0), 1.0, surface.friction)
        return jnp.where(inward < 0, loss, 0.0)
    if surface.coulomb is None:
        return None
    # by Pythagoras, without the tangential vector: another vector would cost several times the step
    speed = jnp.sqrt(jnp.maximum(dot(relative, relative) - inward * inward, MIN_SLIP_SPEED_SQUARED))
    slipping = speed > surface.coulomb.static * impulse
    share = surface.coulomb.kinetic * impulse / jnp.where(slipping, speed, 1.0)
    return jnp.where(inward < 0, jnp.where(slipping, share, 1.0), 0.0)
