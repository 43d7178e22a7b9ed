"""The impulses at all contacts: group after group, each contact of a group at the same time.

A contact asks for a speed of separation along its normal, softly or not, with impulses that only push; friction stops
the slip, with at most μ times those. What a sweep asks for is its `Demand`: the places after a sub-step, the
velocities at its end, and the speeds after an impact are found by the same sweep.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from physjax.backend import any_lane, block_fusion
from physjax.physics.rigid.solids.links import Links
from physjax.physics.rigid.solids.mechanics import (
    Demand,
    Impulses,
    Mechanics,
    Points,
    Sides,
    Speeds,
    Velocity,
    map_components,
)
from physjax.physics.rigid.solids.pairs import Groups


def sweep_contacts(
    mechanics: Mechanics,
    velocity: Velocity,
    groups: Groups,
    contacts: Any,
    demand: Demand,
    impulses: Impulses,
    links: Links | None,
) -> tuple[Velocity, Impulses]:
    """Velocities of all rows and impulses of all groups after each contact was solved once, group after group.

    The velocities are those that the impulses given have brought about. With `links` the groups are their turns.
    """

    def solve(velocity: Velocity, group: tuple) -> tuple[Velocity, Impulses]:
        (a, b), columns, contacts, demand, impulses = block_fusion(group)
        ends = _pick_rows(velocity, a), _pick_rows(velocity, b)
        speeds = mechanics.find_speeds(ends, contacts)

        def act() -> tuple[Velocity, Impulses]:
            new = mechanics.solve_contact(speeds, contacts, demand, impulses)
            change = mechanics.find_changes(contacts, map_components(jnp.subtract, new, impulses))
            after = velocity
            for rows, end, more in zip((a, b), ends, change, strict=True):
                write = lambda part, e, m, rows=rows: part.at[..., rows, :].set(e + m, unique_indices=True)  # noqa: E731
                after = map_components(write, after, end, more)
            return after if links is None else links.add(after, links.find_reaction(columns, change)), new

        if links is None:
            return act()
        # turns of joined bodies are many, and few of their contacts touch
        return lax.cond(
            any_lane(_asks(mechanics, speeds, contacts, demand, impulses)), act, lambda: (velocity, impulses)
        )

    rows = jnp.asarray(groups.a), jnp.asarray(groups.b)
    columns = None if links is None else tuple(map(jnp.asarray, links.turns.columns))
    return lax.scan(solve, velocity, (rows, columns, contacts, demand, impulses))


def _asks(mechanics: Mechanics, speeds: Speeds, contacts: Any, demand: Demand, impulses: Impulses) -> Array:
    """Which contacts press, or have to."""
    openings = mechanics.find_openings(speeds, contacts)
    cases = zip(contacts.is_point, demand.active, openings, demand.speed, strict=True)
    asks = [jnp.any(there & active & (v < asked)) for there, active, v, asked in cases]
    return jnp.any(jnp.stack([*asks, *(jnp.any(part != 0) for part in impulses)]))


def _pick_rows(velocity: Velocity, rows: Array) -> Velocity:
    return map_components(lambda part: part[..., rows, :], velocity)


def measure_openings(mechanics: Mechanics, velocity: Velocity, groups: Groups, contacts: Any) -> Points:
    """How fast second bodies move away from first ones at every point [m/s]."""
    return jax.vmap(mechanics.find_openings)(measure_several(mechanics, (velocity,), groups, contacts)[0], contacts)


def measure_several(
    mechanics: Mechanics, velocities: tuple[Velocity, ...], groups: Groups, contacts: Any
) -> tuple[Speeds, ...]:
    """How second bodies move relative to first ones along the directions of every contact, at several velocities."""

    def measure(group: tuple) -> tuple[Speeds, ...]:
        (a, b), contacts = group
        return tuple(mechanics.find_speeds((_pick_rows(each, a), _pick_rows(each, b)), contacts) for each in velocities)

    return lax.map(measure, ((jnp.asarray(groups.a), jnp.asarray(groups.b)), contacts))


def sum_impulses(
    mechanics: Mechanics, contacts: Any, impulses: Impulses, incidence: Sides, links: Links | None
) -> Velocity:
    """What impulses in groups change in the velocities of all bodies; `incidence` says which contacts each is a and b of."""
    (on_a, on_b), (of_a, of_b) = incidence, jax.vmap(mechanics.find_changes)(contacts, impulses)

    def gather(matrix: Array, part: Array) -> Array:
        flat = jnp.moveaxis(part, 0, -3)
        flat = flat.reshape(*flat.shape[:-3], -1, flat.shape[-1])
        return jnp.moveaxis(jnp.dot(matrix, flat, precision=lax.Precision.HIGHEST), 0, -2)

    total = map_components(lambda a, b: gather(on_a, a) + gather(on_b, b), of_a, of_b)
    return total if links is None else links.add_reactions(total)


__all__ = ["measure_openings", "measure_several", "sum_impulses", "sweep_contacts"]
