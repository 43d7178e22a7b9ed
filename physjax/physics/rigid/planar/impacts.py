"""Impacts: the velocities after all contacts that approach have bounced, those that arrive together together.

In each round, over the contacts that approach fast enough to close their gap in the sub-step: v_n' >= -K_r v_n, impulses
>= 0, and either is zero; friction takes at most μ times the normal impulse. What would rebound too slowly to be told from
rest keeps the speed that closes its gap. Rounds are repeated until none approaches so fast.

All touching points at once would send a cradle off as (-0.6, 0.4, 0.4, 0.4, 0.4): with the right energy and momentum, and
wrong.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from physjax.compaction import choose_group_worlds
from physjax.loops import differentiable_while_loop
from physjax.physics.rigid.planar.impulses import (
    Contacts,
    Demand,
    Impulses,
    Points,
    Velocity,
    map_components,
    measure_speeds,
    sweep_contacts,
)
from physjax.physics.rigid.planar.pairs import Groups

MAX_ROUNDS = 64
"""Most rounds of a sub-step: an impact goes through a row of this many bodies."""
MAX_SWEEPS = 256
"""Most sweeps over the contacts of a round: what is left of a hit on a high pile is for the next sub-steps."""
MAX_SWEEPS_WITH_DERIVATIVES = 1024
"""Most sweeps of all rounds of a sub-step of which there are derivatives."""
SWEEPS_AT_A_TIME = 32
"""Sweeps of the worlds that are picked, before others take the places of those that have come to an end."""
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


class _Scene(NamedTuple):
    contacts: Contacts
    bouncing: Bouncing


class _Round(NamedTuple):
    """How far the round of each world is: what its sweeps have brought about, and what they are asked for.

    `speeds` are those with which the points have to part, and `active` says which; `round` and `sweep` are their numbers.
    """

    velocity: Velocity
    impulses: Impulses
    speeds: Points
    active: Points
    round: Array
    sweep: Array


def resolve_impacts(
    velocity: Velocity, speeds: Points, groups: Groups, contacts: Contacts, bouncing: Bouncing
) -> Velocity:
    """Velocities of all rows after the impacts; `speeds` are those of both points of each contact before [m/s].

    One loop over sweeps, in which each world begins its next round when its sweeps have converged. Of many worlds only
    those are swept that still bounce, some at a time: most have come to an end when the last has hundreds to go.
    """
    scene, none = _Scene(contacts, bouncing), jnp.zeros_like(speeds[0])
    worlds = velocity[0].shape[-1]
    zero = jnp.zeros(worlds, jnp.int32)
    start = _Round(velocity, (none, none, none), *_find_demand(scene, velocity, speeds), zero, zero)
    some = choose_group_worlds(worlds)
    if some is None:
        sweep = partial(_sweep, groups, scene)
        return differentiable_while_loop(
            _is_going, sweep, start, most=MAX_SWEEPS_WITH_DERIVATIVES, lanes_last=True
        ).velocity

    def sweep_some(all_worlds: _Round) -> _Round:
        index = jnp.argsort(~_is_going(all_worlds), stable=True)[:some]
        pick = lambda leaf: leaf if leaf.shape[-1] == 1 else leaf[..., index]  # noqa: E731
        few, scene_of_few = jax.tree.map(pick, (all_worlds, scene))
        begun = few, jnp.zeros(some, jnp.int32)
        going = lambda turn: _is_going(turn[0]) & (turn[1] < SWEEPS_AT_A_TIME)  # noqa: E731
        sweep = lambda turn: (_sweep(groups, scene_of_few, turn[0]), turn[1] + 1)  # noqa: E731
        few, _ = differentiable_while_loop(going, sweep, begun, most=SWEEPS_AT_A_TIME, lanes_last=True)
        write = lambda leaf, new: leaf.at[..., index].set(new, unique_indices=True)  # noqa: E731
        return jax.tree.map(write, all_worlds, few)

    most = MAX_SWEEPS_WITH_DERIVATIVES // SWEEPS_AT_A_TIME * -(-worlds // some)
    return differentiable_while_loop(_is_going, sweep_some, start, most=most, lanes_last=True).velocity


def _is_going(this: _Round) -> Array:
    return jnp.any(this.active[0] | this.active[1], axis=(0, 1)) & (this.round < MAX_ROUNDS)


def _find_demand(scene: _Scene, velocity: Velocity, speeds: Points) -> tuple[Points, Points]:
    """What the next round asks for: the speeds after it, and of which points."""
    (contacts, bouncing), rounding = scene, _round_speed(velocity, ROUNDING)[None, None]
    slow, found = bouncing.slow[None, None], []
    for there, v, reach in zip(contacts.is_point, speeds, bouncing.reach, strict=True):
        back = -bouncing.restitution * v
        # what has closed its gap already closes it no further
        after = jnp.where(back > slow, back, -jnp.maximum(reach, 0.0))
        found.append((after, there & (-v > slow + rounding) & (-v * REACH > reach)))
    (first, first_acts), (second, second_acts) = found
    return (first, second), (first_acts, second_acts)


def _sweep(groups: Groups, scene: _Scene, this: _Round) -> _Round:
    """One sweep further; a world whose sweeps have converged is at the beginning of its next round."""
    contacts, demand = scene.contacts, Demand.hard(this.speeds, this.active)
    velocity, impulses = sweep_contacts(this.velocity, groups, contacts, demand, this.impulses)
    moved = map_components(lambda new, old: jnp.abs(new - old), impulses, this.impulses)
    # an impulse changes the speed of a contact by at least that much
    lightness = contacts.mass[0] + contacts.mass[1]
    change = jnp.max(lightness * jnp.maximum(jnp.maximum(*moved[:2]), moved[2]), axis=(0, 1))
    ends = (change <= _round_speed(velocity, CONVERGED)) | (this.sweep >= MAX_SWEEPS)
    _, *opening = measure_speeds(velocity, groups, contacts)
    following = _find_demand(scene, velocity, (opening[0], opening[1]))
    begin = lambda new, old: jnp.where(ends[None, None], new, old)  # noqa: E731
    speeds, active = jax.tree.map(begin, following, (this.speeds, this.active))
    impulses = map_components(lambda part: begin(0.0, part), impulses)
    rounds, sweeps = this.round + ends.astype(jnp.int32), jnp.where(ends, 0, this.sweep + 1)
    return _Round(velocity, impulses, speeds, active, rounds, sweeps)


def _round_speed(velocity: Velocity, units: int) -> Array:
    """`units` of rounding of the fastest body of each world [m/s]."""
    x, y, _ = velocity
    return units * float(jnp.finfo(x.dtype).eps) * jnp.max(jnp.maximum(jnp.abs(x), jnp.abs(y)), axis=0)


__all__ = ["ROUNDING", "Bouncing", "resolve_impacts"]
