"""How a state moves through one step: a method is `(system, t, state, dt) -> state`, with its promises above it.

A `system` (every `Scene` is one) offers `rate(t, state)`, the whole right-hand side, and the split form `kick(state,
rate, dt)` and `drift(state, dt)`. Methods know no physics: any force works under any of them. `t` and `dt` are scalars
or have the shape of the lanes.
"""

import math

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.loops import Time
from physjax.stepping.adaptive import adaptive, count_steps
from physjax.stepping.implicit import ImplicitEuler
from physjax.stepping.registry import METHODS, Promises, promises
from physjax.stepping.system import S, System, leaf_dtype, read_traits
from physjax.vectors import scale


@promises(order=1, evaluations=1, stability_limit=0.0)
def euler(system: System, t: Time, state: S, dt: ArrayLike) -> S:
    """Explicit Euler: follow the slope at the start. One force a step; gains energy at any step without damping.

    The lecture's EulerStep and its listing `position += velocity*dt; velocity += acceleration*dt`.

    Example:
        >>> fall = methods.euler(shot, 0.0, ball, 1.0)
        >>> print(fall.position, fall.velocity)
        [ 3. 14.] [ 3.  -5.8]
    """
    return _move_along(state, system.rate(t, state), dt)


@promises(order=1, evaluations=1, stability_limit=2.0)
def semi_implicit_euler(system: System, t: Time, state: S, dt: ArrayLike) -> S:
    """Kick, then drift with the new velocity: one force a step, energy bounded.

    The lecture's `Vel = Vel + Acc*dt; Pos = Pos + Vel*dt`, which it also calls Euler; a different method with different
    stability.

    Example:
        >>> fall = methods.semi_implicit_euler(shot, 0.0, ball, 1.0)
        >>> print(fall.position, fall.velocity)
        [3.  4.2] [ 3.  -5.8]
    """
    return system.drift(system.kick(state, system.rate(t, state), dt), dt)


@promises(order=2, evaluations=2, stability_limit=0.0)
def midpoint(system: System, t: Time, state: S, dt: ArrayLike) -> S:
    """Follow the slope found half a step ahead: second order; an oscillation grows by √(1 + (ωdt)⁴/4) a step.

    Example:
        >>> fall = methods.midpoint(shot, 0.0, ball, 1.0)
        >>> print(fall.position, fall.velocity)
        [3.  9.1] [ 3.  -5.8]
    """
    half = _move_along(state, system.rate(t, state), dt / 2)
    return _move_along(state, system.rate(t + dt / 2, half), dt)


@promises(order=2, evaluations=2, stability_limit=2.0)
def verlet(system: System, t: Time, state: S, dt: ArrayLike) -> S:
    """Velocity Verlet: half a kick, drift, half a kick with the force found there. Second order, energy bounded.

    Forces that depend on velocity see the predicted v + a·dt at the end of the step, which keeps the order at 2.

    Example:
        >>> fall = methods.verlet(shot, 0.0, ball, 1.0)
        >>> print(fall.position, fall.velocity)
        [3.  9.1] [ 3.  -5.8]
    """
    start = system.rate(t, state)
    arrived = system.drift(system.kick(state, start, dt / 2), dt)
    end = system.rate(t + dt, system.kick(arrived, start, dt / 2))
    return system.kick(arrived, end, dt / 2)


@promises(order=2, evaluations=1, stability_limit=2.0, order_with_drag=1)
def leapfrog(system: System, t: Time, state: S, dt: ArrayLike) -> S:
    """Drift half way, kick, drift on: second order for one force a step, the cheapest where forces depend on position alone.

    Forces that depend on velocity see the old one, and the order falls to 1.

    Example:
        >>> end = methods.leapfrog(swing, 0.0, swing.state, 0.5)
        >>> print(end.position, end.velocity)
        [0.5] [-2.]
    """
    half = system.drift(state, dt / 2)
    return system.drift(system.kick(half, system.rate(t + dt / 2, half), dt), dt / 2)


@promises(order=4, evaluations=4, stability_limit=2 * math.sqrt(2))
def rk4(system: System, t: Time, state: S, dt: ArrayLike) -> S:
    """The classical Runge-Kutta method: four slopes, weighted 1 2 2 1. Loses energy near its limit.

    The lecture's RK4Integration.

    Example:
        >>> end = methods.rk4(swing, 0.0, swing.state, 0.1)
        >>> round(float(end.position[0]), 4), round(float(np.cos(2.0 * 0.1)), 4)
        (0.9801, 0.9801)
    """
    if read_traits(system).compile_bound:
        return _loop_over_stages(system, t, state, dt, (0.0, 0.5, 0.5, 1.0), (1.0, 2.0, 2.0, 1.0))
    k1 = system.rate(t, state)
    k2 = system.rate(t + dt / 2, _move_along(state, k1, dt / 2))
    k3 = system.rate(t + dt / 2, _move_along(state, k2, dt / 2))
    k4 = system.rate(t + dt, _move_along(state, k3, dt))
    slope = jax.tree.map(lambda a, b, c, d: a + 2.0 * b + 2.0 * c + d, k1, k2, k3, k4)
    return _move_along(state, slope, dt / 6)


implicit_euler = ImplicitEuler()
"""Implicit Euler, linearised once a step: stable at any step, damps; `ImplicitEuler(newton=20)` converges the full step."""
METHODS[implicit_euler.__name__] = implicit_euler

__all__ = [
    "METHODS",
    "ImplicitEuler",
    "Promises",
    "adaptive",
    "count_steps",
    "euler",
    "implicit_euler",
    "leapfrog",
    "midpoint",
    "promises",
    "rk4",
    "semi_implicit_euler",
    "verlet",
]


def _move_along(state: S, slope: S, dt: ArrayLike) -> S:
    """The state moved along a slope: y + dt·k."""
    return jax.tree.map(lambda y, k: y + scale(dt, k), state, slope)


def _loop_over_stages(
    system: System, t: Time, state: S, dt: ArrayLike, shares: tuple[float, ...], weights: tuple[float, ...]
) -> S:
    """A step whose stages each follow the slope of the one before for a share of it: the forces stand in the program once."""

    def follow(carry: tuple[S, S], stage: Array) -> tuple[tuple[S, S], None]:
        slope, total = carry
        ahead = stage[0] * dt
        slope = system.rate(t + ahead, _move_along(state, slope, ahead))
        return (slope, jax.tree.map(lambda a, k: a + stage[1] * k, total, slope)), None

    none = jax.tree.map(jnp.zeros_like, state)
    stages = jnp.asarray(list(zip(shares, weights, strict=True)), leaf_dtype(state))
    (_, total), _ = lax.scan(follow, (none, none), stages)
    return _move_along(state, total, dt / sum(weights))


def __dir__() -> list[str]:
    return __all__
