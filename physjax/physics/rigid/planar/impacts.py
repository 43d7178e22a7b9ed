"""Impacts: the velocities after all contacts that approach have bounced, those that arrive together together.

In each round, over the contacts that approach fast enough to close their gap in the sub-step: v_n' >= -K_r v_n, impulses
>= 0, and either is zero; friction takes at most μ times the normal impulse. What would rebound too slowly to be told from
rest keeps the speed that closes its gap. Rounds are repeated until none approaches so fast.

All touching points at once would send a cradle off as (-0.6, 0.4, 0.4, 0.4, 0.4): with the right energy and momentum, and
wrong.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from physjax.loops import differentiable_while_loop
from physjax.physics.rigid.planar.impulses import (
    Contacts,
    Demand,
    Impulses,
    Points,
    Velocity,
    measure_speeds,
    sweep_contacts,
)
from physjax.physics.rigid.planar.pairs import Groups

MAX_ROUNDS = 64
"""Most rounds of a sub-step: an impact goes through a row of this many bodies."""
MAX_SWEEPS = 256
"""Most sweeps over the contacts of a round: what is left of a hit on a high pile is for the next sub-steps."""
REACH = 1 + 1e-4
"""Factor of the way in a sub-step within which a contact is reached: what just closes its gap bounces, and does not stop."""
ROUNDING = 64
"""Speeds relative to the fastest, in units of rounding, that are none."""
CONVERGED = 16
"""Changes of speed in a sweep relative to the fastest, in units of rounding, that are none."""


class Bouncing(NamedTuple):
    """What decides of contacts in groups whether they bounce: their K_r, and two speeds of approach [m/s].

    A point bounces that is faster than `slow` of its world, and than its `reach`: what closes its gap in the sub-step.
    """

    restitution: Array
    slow: Array
    reach: tuple[Array, Array]


class _Round(NamedTuple):
    """What has been reached so far: velocities, how fast both points of each contact open, and which must bounce."""

    velocity: Velocity
    speeds: Points
    active: Points
    number: Array


class _Sweep(NamedTuple):
    velocity: Velocity
    impulses: Impulses
    change: Array


def resolve_impacts(
    velocity: Velocity, speeds: Points, groups: Groups, contacts: Contacts, bouncing: Bouncing
) -> Velocity:
    """Velocities of all rows after the impacts; `speeds` are those of both points of each contact before [m/s]."""
    slow = bouncing.slow[None, None]

    def begin_round(velocity: Velocity, speeds: Points, number: Array) -> _Round:
        rounding = _round_speed(velocity, ROUNDING)[None, None]
        cases = zip(contacts.is_point, speeds, bouncing.reach, strict=True)
        first, second = (there & (-v > slow + rounding) & (-v * REACH > reach) for there, v, reach in cases)
        return _Round(velocity, speeds, (first, second), number)

    def bounce(this: _Round) -> _Round:
        rebounds = [-bouncing.restitution * v for v in this.speeds]
        # what has closed its gap already closes it no further
        first, second = (
            jnp.where(back > slow, back, -jnp.maximum(reach, 0.0))
            for back, reach in zip(rebounds, bouncing.reach, strict=True)
        )
        demand = Demand.hard((first, second), this.active)
        velocity = _solve_round(this.velocity, groups, contacts, demand)
        _, *opening = measure_speeds(velocity, groups, contacts)
        return begin_round(velocity, (opening[0], opening[1]), this.number + 1)

    def is_going(this: _Round) -> Array:
        return jnp.any(this.active[0] | this.active[1], axis=(0, 1)) & (this.number < MAX_ROUNDS)

    start = begin_round(velocity, speeds, jnp.zeros(velocity[0].shape[-1:], jnp.int32))
    return differentiable_while_loop(is_going, bounce, start, most=MAX_ROUNDS).velocity


def _solve_round(velocity: Velocity, groups: Groups, contacts: Contacts, demand: Demand) -> Velocity:
    """Velocities after the contacts that are active separate with the speeds asked for; the others are not there."""
    tolerance = _round_speed(velocity, CONVERGED)
    # an impulse changes the speed of a contact by at least that much
    lightness = contacts.mass[0] + contacts.mass[1]

    def sweep(carry: _Sweep) -> _Sweep:
        velocity, impulses = sweep_contacts(carry.velocity, groups, contacts, demand, carry.impulses)
        moved = [jnp.abs(new - old) for new, old in zip(impulses, carry.impulses, strict=True)]
        most = jnp.maximum(jnp.maximum(moved[0], moved[1]), moved[2])
        return _Sweep(velocity, impulses, jnp.max(lightness * most, axis=(0, 1)))

    none = jnp.zeros_like(demand.speed[0])
    start = _Sweep(velocity, (none, none, none), jnp.full(none.shape[-1:], jnp.inf, none.dtype))
    return differentiable_while_loop(lambda carry: carry.change > tolerance, sweep, start, most=MAX_SWEEPS).velocity


def _round_speed(velocity: Velocity, units: int) -> Array:
    """`units` of rounding of the fastest body of each world [m/s]."""
    x, y, _ = velocity
    return units * float(jnp.finfo(x.dtype).eps) * jnp.max(jnp.maximum(jnp.abs(x), jnp.abs(y)), axis=0)


__all__ = ["ROUNDING", "Bouncing", "resolve_impacts"]
