"""Impacts: the velocities after all contacts that approach have bounced, those that arrive together together.

In each round, over the contacts that approach fast enough to close their gap in the sub-step: v_n' >= -K_r v_n, impulses
>= 0, and either is zero; friction takes at most μ times the normal impulse. What would rebound too slowly to be told from
rest keeps the speed that closes its gap. Rounds are repeated until none approaches so fast.

All touching points at once would send a cradle off as (-0.6, 0.4, 0.4, 0.4, 0.4): with the right energy and momentum, and
wrong.
"""

from functools import partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from physjax.compaction import choose_group_worlds
from physjax.loops import differentiable_while_loop
from physjax.physics.rigid.solids.links import Links, Response
from physjax.physics.rigid.solids.mechanics import (
    Demand,
    Impulses,
    Mechanics,
    Points,
    Velocity,
    by_world,
    find_largest,
    map_components,
)
from physjax.physics.rigid.solids.pairs import Groups
from physjax.physics.rigid.solids.sweeps import measure_openings, sweep_contacts

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
    reach: Points


class _Scene(NamedTuple):
    contacts: Any
    bouncing: Bouncing
    response: Response | None

    def find_links(self, all_worlds: Links | None) -> Links | None:
        """How joints react in these worlds."""
        return None if all_worlds is None or self.response is None else all_worlds._replace(response=self.response)


class _Round(NamedTuple):
    """How far the round of each world is: what its sweeps have brought about, and what they are asked for.

    `speeds` are those with which the points have to part, and `active` says which; `round` and `sweep` are their numbers.
    `total` are the impulses of all rounds.
    """

    velocity: Velocity
    impulses: Impulses
    total: Impulses
    speeds: Points
    active: Points
    round: Array
    sweep: Array


def resolve_impacts(
    mechanics: Mechanics,
    bodies: tuple[Velocity, Impulses],
    openings: Points,
    groups: Groups,
    contacts: Any,
    bouncing: Bouncing,
    links: Links | None,
) -> tuple[Velocity, Impulses]:
    """Velocities of all rows after the impacts, and their impulses.

    `openings` are the speeds of separation of all points before [m/s].
    Of `bodies` the impulses only tell what those of contacts look like: there are none before.

    One loop over sweeps, in which each world begins its next round when its sweeps have converged. Of many worlds only
    those are swept that still bounce, some at a time: most have come to an end when the last has hundreds to go.
    """
    (velocity, held), scene = bodies, _Scene(contacts, bouncing, None if links is None else links.response)
    worlds = velocity[0].shape[-1]
    zero = jnp.zeros(worlds, jnp.int32)
    still = jax.tree.map(jnp.zeros_like, held)
    start = _Round(velocity, still, still, *_find_demand(mechanics, scene, velocity, openings), zero, zero)
    some = choose_group_worlds(worlds)
    if some is None:
        sweep = partial(_sweep, mechanics, groups, links, scene)
        end = differentiable_while_loop(_is_going, sweep, start, most=MAX_SWEEPS_WITH_DERIVATIVES, lanes_last=True)
        return end.velocity, end.total

    def sweep_some(all_worlds: _Round) -> _Round:
        index = jnp.argsort(~_is_going(all_worlds), stable=True)[:some]
        pick = lambda leaf: leaf if leaf.shape[-1] == 1 else leaf[..., index]  # noqa: E731
        few, scene_of_few = jax.tree.map(pick, (all_worlds, scene))
        begun = few, jnp.zeros(some, jnp.int32)
        going = lambda turn: _is_going(turn[0]) & (turn[1] < SWEEPS_AT_A_TIME)  # noqa: E731
        sweep = lambda turn: (_sweep(mechanics, groups, links, scene_of_few, turn[0]), turn[1] + 1)  # noqa: E731
        few, _ = differentiable_while_loop(going, sweep, begun, most=SWEEPS_AT_A_TIME, lanes_last=True)
        write = lambda leaf, new: leaf.at[..., index].set(new, unique_indices=True)  # noqa: E731
        return jax.tree.map(write, all_worlds, few)

    most = MAX_SWEEPS_WITH_DERIVATIVES // SWEEPS_AT_A_TIME * -(-worlds // some)
    end = differentiable_while_loop(_is_going, sweep_some, start, most=most, lanes_last=True)
    return end.velocity, end.total


def _is_going(this: _Round) -> Array:
    acts = reduce(jnp.logical_or, this.active)
    return jnp.any(acts, axis=tuple(range(acts.ndim - 1))) & (this.round < MAX_ROUNDS)


def _find_demand(mechanics: Mechanics, scene: _Scene, velocity: Velocity, openings: Points) -> tuple[Points, Points]:
    """What the next round asks for: the speeds after it, and of which points; of none in worlds that have what is asked."""
    contacts, bouncing, _ = scene
    restitution, found = jax.vmap(mechanics.spread)(bouncing.restitution), []
    rounding = _round_speed(mechanics, velocity, ROUNDING)
    fast = bouncing.slow + rounding
    for there, v, reach in zip(contacts.is_point, openings, bouncing.reach, strict=True):
        back = -restitution * v
        # what has closed its gap already closes it no further
        after = jnp.where(back > by_world(bouncing.slow, v), back, -jnp.maximum(reach, 0.0))
        acts = there & (-v > by_world(fast, v)) & (-v * REACH > reach)
        found.append((after, acts, acts & (after > v + by_world(rounding, v))))
    lacks = find_largest([lacking for _, _, lacking in found])
    return tuple(speed for speed, _, _ in found), tuple(acts & by_world(lacks, acts) for _, acts, _ in found)


def _sweep(mechanics: Mechanics, groups: Groups, links: Links | None, scene: _Scene, this: _Round) -> _Round:
    """One sweep further; a world whose sweeps have converged is at the beginning of its next round."""
    contacts, demand = scene.contacts, Demand.hard(this.speeds, this.active)
    links = scene.find_links(links)
    velocity, impulses = sweep_contacts(mechanics, this.velocity, groups, contacts, demand, this.impulses, links)
    moved = jax.vmap(mechanics.measure_size)(map_components(jnp.subtract, impulses, this.impulses), contacts)
    # an impulse changes the speed of a contact by at least that much
    change = find_largest([(contacts.mass[0] + contacts.mass[1]) * moved])
    ends = (change <= _round_speed(mechanics, velocity, CONVERGED)) | (this.sweep >= MAX_SWEEPS)
    following = _find_demand(mechanics, scene, velocity, measure_openings(mechanics, velocity, groups, contacts))
    begin = lambda new, old: jnp.where(by_world(ends, old), new, old)  # noqa: E731
    speeds, active = jax.tree.map(begin, following, (this.speeds, this.active))
    total = map_components(lambda before, now, then: before + now - then, this.total, impulses, this.impulses)
    impulses = map_components(lambda part: begin(0.0, part), impulses)
    rounds, sweeps = this.round + ends.astype(jnp.int32), jnp.where(ends, 0, this.sweep + 1)
    return _Round(velocity, impulses, total, speeds, active, rounds, sweeps)


def _round_speed(mechanics: Mechanics, velocity: Velocity, units: int) -> Array:
    """`units` of rounding of the fastest body of each world [m/s]."""
    straight = [jnp.abs(part) for part in velocity[: mechanics.straight]]
    return units * float(jnp.finfo(straight[0].dtype).eps) * find_largest(straight)


__all__ = ["ROUNDING", "Bouncing", "resolve_impacts"]
