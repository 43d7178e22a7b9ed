"""How a state moves through one step: a method is `(system, t, state, dt) -> state`, with its promises above it.

A `system` (every `Scene` is one) offers `rate(t, state)`, the whole right-hand side, and the split form `kick(state,
rate, dt)` and `drift(state, dt)`. Methods know no physics: any force works under any of them. `t` and `dt` are scalars
or have the shape of the lanes.

`adaptive(method, atol, rtol)` lets any method choose its own steps, lane by lane; `time_scaled(leapfrog)` makes steps
short where bodies are close and keeps the energy bounded. How large a step of yours may be, and what sets that limit,
is for `stability.limit` to say before the run. `METHODS` and `SPECIAL_METHODS` are what charts, tests, tables and the
command line go through: a method of your own is in all of them once `@methods.promises(order=2, evaluations=2,
stability_limit=0.0)` stands above it.

Example:
    >>> def trapezoid(system, t, state, dt):
    ...     along = lambda slope, dt: jax.tree.map(lambda y, k: y + dt * k, state, slope)
    ...     here = system.rate(t, state)
    ...     there = system.rate(t + dt, along(here, dt))
    ...     return along(jax.tree.map(lambda a, b: (a + b) / 2, here, there), dt)
    >>> end = simulate(swing, trapezoid, dt=0.01, steps=100).position[-1, 0]
    >>> round(float(end), 3), round(float(np.cos(2.0)), 3)
    (-0.416, -0.416)
"""

import math

from jax.typing import ArrayLike

from physjax.loops import Time
from physjax.name_hints import hint_at_names
from physjax.stepping.adaptive import adaptive, count_steps
from physjax.stepping.boris import take_boris_step
from physjax.stepping.compositions import BLANES_MOAN_4, KAHAN_LI_8, compose_leapfrogs, take_split_step
from physjax.stepping.implicit import ImplicitEuler, ImplicitMidpoint, TrBdf2
from physjax.stepping.nystrom import DPRKN6, NystromPair, take_nystrom_step
from physjax.stepping.registry import METHODS, SPECIAL_METHODS, Promises, find_method, list_all_methods, promises
from physjax.stepping.system import S, System
from physjax.stepping.tableaus import DOPRI8, EULER, HEUN, MIDPOINT, RK4, TSIT5, TableauPair, take_step
from physjax.stepping.time_scaled import time_scaled


@promises(order=1, evaluations=1, stability_limit=0.0)
def euler(system: System, t: Time, state: S, dt: ArrayLike) -> S:
    """Explicit Euler: follow the slope at the start. One force a step; gains energy at any step without damping.

    The lecture's EulerStep and its listing `position += velocity*dt; velocity += acceleration*dt`.

    Example:
        >>> fall = methods.euler(shot, 0.0, ball, 1.0)
        >>> print(fall.position, fall.velocity)
        [ 3. 14.] [ 3.  -5.8]
    """
    return take_step(EULER, system, t, state, dt)


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
    return take_step(MIDPOINT, system, t, state, dt)


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
    return take_step(RK4, system, t, state, dt)


@promises(order=2, evaluations=2, stability_limit=0.0)
def heun(system: System, t: Time, state: S, dt: ArrayLike) -> S:
    """Heun's method, the explicit trapezoid: the mean of the slopes at both ends. An oscillation grows as under midpoint.

    Example:
        >>> fall = methods.heun(shot, 0.0, ball, 1.0)
        >>> print(fall.position, fall.velocity)
        [3.  9.1] [ 3.  -5.8]
    """
    return take_step(HEUN, system, t, state, dt)


@promises(order=5, evaluations=6, stability_limit=1.0554808, relative_step=1.7, pair=TableauPair(TSIT5))
def tsit5(system: System, t: Time, state: S, dt: ArrayLike) -> S:
    """Tsitouras' Runge-Kutta method of order 5, for smooth forces of any kind; equals `diffrax.Tsit5` step for step.

    An undamped oscillation loses energy up to ω·dt = 0.478, and gains less than 2e-4 of it a step up to the limit.

    Example:
        >>> end = methods.tsit5(swing, 0.0, swing.state, 0.1)
        >>> bool(abs(end.position[0] - np.cos(2.0 * 0.1)) < 1e-6)
        True
    """
    return take_step(TSIT5, system, t, state, dt)


@promises(order=8, evaluations=13, stability_limit=3.719823, pair=TableauPair(DOPRI8))
def dopri8(system: System, t: Time, state: S, dt: ArrayLike) -> S:
    """Prince and Dormand's Runge-Kutta method of order 8, for errors below 1e-8, in float64; equals `diffrax.Dopri8`.

    Not the 8(5,3) of the same authors. An undamped oscillation gains less than 1e-6 of itself a step up to ω·dt = 3.70.

    Example:
        >>> end = methods.dopri8(swing, 0.0, swing.state, 0.25)
        >>> bool(abs(end.position[0] - np.cos(2.0 * 0.25)) < 1e-6)
        True
    """
    return take_step(DOPRI8, system, t, state, dt)


@promises(
    order=4, evaluations=7, stability_limit=3.1634, order_with_drag=1, relative_step=5.0, looped=True, special=True
)
def blanes_moan4(system: System, t: Time, state: S, dt: ArrayLike) -> S:
    """Blanes and Moan's symplectic splitting of order 4: energy bounded.

    Seven kicks with drifts between, for forces of position alone. Forces that depend on velocity see the old one, and the
    order falls to 1; where bodies rotate in space, whose drift is of second order, it falls to 2. From the limit to 3.169 an
    oscillation grows by up to 0.0024 a step.

    Example:
        >>> end = methods.blanes_moan4(swing, 0.0, swing.state, 0.25)
        >>> bool(abs(end.position[0] - np.cos(2.0 * 0.25)) < 1e-6)
        True
    """
    return take_split_step(BLANES_MOAN_4, system, t, state, dt)


@promises(order=8, evaluations=17, stability_limit=3.0964, order_with_drag=1, looped=True, special=True)
def kahan_li8(system: System, t: Time, state: S, dt: ArrayLike) -> S:
    """Kahan and Li's composition of 17 leapfrogs: symplectic, order 8, energy bounded.

    Forces that depend on velocity see the old one, and the order falls to 1.

    Example:
        >>> end = methods.kahan_li8(swing, 0.0, swing.state, 0.5)
        >>> bool(abs(end.position[0] - np.cos(2.0 * 0.5)) < 2e-6)
        True
    """
    return compose_leapfrogs(KAHAN_LI_8, system, t, state, dt)


@promises(order=6, evaluations=6, stability_limit=1.6292, order_with_drag=0, pair=NystromPair(DPRKN6), special=True)
def dprkn6(system: System, t: Time, state: S, dt: ArrayLike) -> S:
    """Dormand and Prince's Runge-Kutta-Nyström method of order 6, for smooth forces of place and time alone.

    A ValueError while tracing where a force looks at the velocity, or bodies rotate in space. An undamped oscillation gains
    less than 2e-4 of itself a step up to the limit, and less than 1e-8 up to ω·dt = 0.46.

    Example:
        >>> end = methods.dprkn6(swing, 0.0, swing.state, 0.25)
        >>> bool(abs(end.position[0] - np.cos(2.0 * 0.25)) < 1e-7)
        True
    """
    return take_nystrom_step(DPRKN6, system, t, state, dt)


@promises(order=2, evaluations=1, stability_limit=2.0, special=True)
def boris(system: System, t: Time, state: S, dt: ArrayLike) -> S:
    """Boris' method, for charges in magnetic fields: leapfrog whose kick sees the mean of the old and the new velocity.

    Of a force that is linear in the velocity, and of position otherwise, this is solved exactly, lane by lane: in a magnetic
    field alone |v| is kept to rounding at any step, which no other explicit method does. Other forces are linearised
    there. Second order with forces of any kind, but first with dampers between lanes, which see the old velocity in part.

    Example:
        >>> field = (forces.Lorentz(charge=1.0, magnetic=1.0),)
        >>> circle = Scene(Particles(jnp.zeros(2), jnp.array([3.0, 4.0])), forces=field)
        >>> end = methods.boris(circle, 0.0, circle.state, 1.5)
        >>> round(float(jnp.hypot(*end.velocity)), 5)
        5.0
    """
    return take_boris_step(system, t, state, dt)


implicit_euler = ImplicitEuler()
"""Implicit Euler, linearised once a step: stable at any step, damps; `ImplicitEuler(newton=20)` converges the full step."""
implicit_midpoint = ImplicitMidpoint()
"""The implicit midpoint rule: order 2, keeps what oscillates; `ImplicitMidpoint(newton=20)` where springs turn far in a step."""
tr_bdf2 = TrBdf2()
"""TR-BDF2: order 2, damps what is stiff, knows its error; `TrBdf2(newton=20)` where springs turn far in a step."""
METHODS.update({method.__name__: method for method in (implicit_euler, implicit_midpoint, tr_bdf2)})

__all__ = [
    "METHODS",
    "SPECIAL_METHODS",
    "ImplicitEuler",
    "ImplicitMidpoint",
    "Promises",
    "TrBdf2",
    "adaptive",
    "blanes_moan4",
    "boris",
    "count_steps",
    "dopri8",
    "dprkn6",
    "euler",
    "find_method",
    "heun",
    "implicit_euler",
    "implicit_midpoint",
    "kahan_li8",
    "leapfrog",
    "list_all_methods",
    "midpoint",
    "promises",
    "rk4",
    "semi_implicit_euler",
    "time_scaled",
    "tr_bdf2",
    "tsit5",
    "verlet",
]


def __dir__() -> list[str]:
    return __all__


hint_at_names(__name__)
