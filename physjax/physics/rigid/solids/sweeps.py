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

from physjax.backend import block_fusion
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
    mechanics: Mechanics, velocity: Velocity, groups: Groups, contacts: Any, demand: Demand, impulses: Impulses
) -> tuple[Velocity, Impulses]:
    """Velocities of all rows and impulses of all groups after each contact was solved once, group after group.

    The velocities are those that the impulses given have brought about.
    """

    def solve(velocity: Velocity, group: tuple) -> tuple[Velocity, Impulses]:
        (a, b), contacts, demand, impulses = block_fusion(group)
        ends = _pick_rows(velocity, a), _pick_rows(velocity, b)
        new = mechanics.solve_contact(mechanics.find_speeds(ends, contacts), contacts, demand, impulses)
        change = mechanics.find_changes(contacts, map_components(jnp.subtract, new, impulses))
        for rows, end, more in zip((a, b), ends, change, strict=True):
            write = lambda part, e, m, rows=rows: part.at[..., rows, :].set(e + m, unique_indices=True)  # noqa: E731
            velocity = map_components(write, velocity, end, more)
        return velocity, new

    rows = jnp.asarray(groups.a), jnp.asarray(groups.b)
    return lax.scan(solve, velocity, (rows, contacts, demand, impulses))


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


def sum_impulses(mechanics: Mechanics, contacts: Any, impulses: Impulses, incidence: Sides) -> Velocity:
    """What impulses in groups change in the velocities of all bodies; `incidence` says which contacts each is a and b of."""
    (on_a, on_b), (of_a, of_b) = incidence, jax.vmap(mechanics.find_changes)(contacts, impulses)

    def gather(matrix: Array, part: Array) -> Array:
        flat = jnp.moveaxis(part, 0, -3)
        flat = flat.reshape(*flat.shape[:-3], -1, flat.shape[-1])
        return jnp.moveaxis(jnp.dot(matrix, flat, precision=lax.Precision.HIGHEST), 0, -2)

    return map_components(lambda a, b: gather(on_a, a) + gather(on_b, b), of_a, of_b)


__all__ = ["measure_openings", "measure_several", "sum_impulses", "sweep_contacts"]
