"""Rockets, which lose mass while they burn."""

from collections.abc import Iterable
from dataclasses import replace
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from physjax.checks import Numbers, OptionalNumbers, concrete_or_none, quantity, unchecked_quantity
from physjax.loops import Time, cast_remainder, float32_remainder, time_for_part
from physjax.particles import Particles, demand_particles
from physjax.parts import Force, adopt_force, as_tuple
from physjax.physics.forces.step_shares import acting_share, align_moment, is_acting
from physjax.vectors import broadcast_vector, norm, scale, unit


def _adopt_forces(forces: Iterable) -> tuple[Force, ...]:
    return tuple(adopt_force(force) for force in as_tuple("force", forces))


class Rocket(Force):
    """A rocket that burns for a `duration` [s] from the time `at` [s] on: a = (F + Σ forces)/m(t), m(t) = m₀ - q (t - at).

    `thrust` F [N] acts along a `direction`, or without one along the velocity, and takes a `flow` q [kg/s] of propellant:
    its exhaust leaves at F/q [m/s] (Tsiolkovsky). The mass of the scene is m₀, that at launch. All that acts on the rocket
    and is not proportional to its mass (drag, wind, a control) stands in `forces`, where it meets m(t). So do springs and
    contact between rockets (`SoftSpheres`), which then conserve the momentum of the masses that are left; contacts with
    surfaces do not depend on mass. `Gravity` and other fields stand beside the rocket. What a scene says of forces, momenta
    and energies is that of m₀ at the same velocity and acceleration. Lanes that are no rockets have a thrust and a flow of 0.
    Methods keep their order where the burn begins and ends with steps; elsewhere a step knows what share of it burns, to
    second order.

    Raises ValueError for a rocket that burns all of its mass, that is at rest without a direction, and for forces beside it
    that would not see m(t); TypeError for forces that it cannot hold: those with a memory, and fields.

    Example:
        >>> drag = forces.QuadraticDrag(area=0.2, coefficient=1.0, density=2.0)
        >>> rocket = forces.Rocket(12.0, flow=0.5, duration=2.0, direction=(0.0, 1.0), forces=(drag,))
        >>> flight = simulate(Scene(ball, 2.0, (forces.Gravity(), rocket)), methods.rk4, dt=0.01, steps=200)
        >>> print(flight.velocity[-1].round(3))
        [1.563 0.298]
    """

    sees_moments: ClassVar[bool] = True
    thrust: Numbers = quantity("thrust", "N", at_least=0)
    flow: Numbers = quantity("flow of propellant", "kg/s", at_least=0)
    duration: Numbers = quantity("duration of the burn", "s", above=0)
    direction: OptionalNumbers = quantity("direction of the thrust", "1", kind="vector", default=None)
    forces: tuple[Force, ...] = eqx.field(converter=_adopt_forces, default=())
    at: Numbers = quantity("start of the burn", "s", default=0.0)
    at_rest: Numbers = unchecked_quantity(
        "rest of the start", "s", per="memory", default=None, repr=False, kw_only=True
    )

    def __post_init__(self):
        self.at_rest = float32_remainder(self.at, self.at_rest)

    def __check_init__(self):
        for force in self.forces:
            if force.remembers or force.is_field or force.response is not None:
                raise TypeError(
                    f"Rocket: got {type(force).__name__} among its forces, expected such as drag: what is proportional to mass "
                    "stands beside the rocket in the scene, and what remembers or holds exactly has no place in it."
                )

    # a class attribute of other forces, a property of this one: both are read the same way
    @property
    def couples(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether one of the forces on it ties lanes together."""
        return any(force.couples for force in self.forces)

    def __call__(self, t: Time, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """m₀ times the acceleration [N]."""
        return self.push(t, state, mass, jnp.where(is_acting(self, t, state), 1.0, 0.0).astype(state.dtype))

    def push(
        self, t: Time, state: Particles, mass: Float[Array, "..."], share: Float[Array, "..."]
    ) -> Float[Array, "*lanes dim"]:
        """m₀ times the acceleration [N], with a share of the thrust."""
        left = self._measure_mass(t, state, mass)
        along = state.velocity if self.direction is None else broadcast_vector(self.direction, state.velocity)
        total = scale(share * self.thrust, unit(along))
        for force in self.forces:
            total = total + force(time_for_part(force, t), state, left)
        return scale(mass / left, total)

    def _measure_mass(self, t: Time, state: Particles, mass: Float[Array, "..."]) -> Array:
        """m(t) [kg]; NaN where nothing would be left, which the status of the lane reports."""
        since = -align_moment(t, 1.0, state)[0].time_until(self.at, cast_remainder(self.at, self.at_rest))
        # not `clip`, which halves the derivative at its bounds
        burns = jnp.where(since < 0, 0.0, jnp.where(since < self.duration, since, self.duration))
        left = mass - self.flow * burns
        return jnp.where(left > 0, left, jnp.nan)

    def averaged_over_step(self, t: Time, dt: ArrayLike, state: Particles) -> Force:
        """The rocket with the share of the thrust that acts in the step from t to t + dt [s]."""
        seen = [f.averaged_over_step(time_for_part(f, t), dt, state) if f.jumps else f for f in self.forces]
        return _RocketStep(eqx.tree_at(lambda r: r.forces, self, tuple(seen)), acting_share(self, t, dt, state))

    def discontinuities(self) -> tuple[Float[Array, "..."], ...]:
        """Start and end of the burn [s], and the times at which the forces on it jump."""
        return self.at, self.at + self.duration, *(t for force in self.forces for t in force.discontinuities())

    def under(self, weight: tuple[ArrayLike | None, int]) -> "Rocket":
        """The rocket with the scene's g and up for the forces on it."""
        return replace(self, forces=tuple(force.under(weight) for force in self.forces))

    def prepare(self, state: PyTree, mass: PyTree) -> "Rocket":
        """The rocket as part of a scene; what its mass and its start must be is checked here."""
        demand_particles("Rocket", state, "bodies have an inertia, which would burn as well")
        speed, kept, burnt = map(concrete_or_none, (norm(state.velocity), mass, self.flow * self.duration))
        if self.direction is None and speed is not None and np.any(speed == 0):
            raise ValueError(
                "Rocket: got a lane at rest and no direction, expected direction= or a velocity to follow."
            )
        if kept is not None and burnt is not None and np.any(burnt >= kept):
            raise ValueError(
                f"Rocket: got {np.max(burnt)} kg of propellant (flow times duration) and a mass of {np.min(kept)} kg at launch, "
                "expected less. Burn for a shorter duration."
            )
        return replace(self, forces=tuple(force.prepare(state, mass) for force in self.forces))

    def demand_company(self, forces: tuple[Force, ...]) -> None:
        """Raise a ValueError for forces of the scene that do not see how the mass falls."""
        for force in forces:
            if force is not self and not force.is_field:
                raise ValueError(
                    f"Rocket: got {type(force).__name__} beside it, which would act on the mass at launch; expected only forces "
                    "that are proportional to mass, such as Gravity. Give the others as Rocket(..., forces=(...,))."
                )


class _RocketStep(Force):
    """A rocket in a step of which it burns for a share only."""

    sees_moments: ClassVar[bool] = True
    rocket: Rocket
    share: Numbers = unchecked_quantity("share of the step", per="memory")

    @property
    def couples(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.rocket.couples

    def __call__(self, t: Time, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        return self.rocket.push(t, state, mass, self.share)


__all__ = ["Rocket"]


def __dir__() -> list[str]:
    return __all__
