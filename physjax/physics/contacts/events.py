"""What a step runs into first: the guards of a leg, and where they dip below zero."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool

from physjax.cubics import Cubic
from physjax.particles import Particles
from physjax.physics.contacts.resting import ContactMode
from physjax.vectors import dot


class Event(NamedTuple):
    """Which lanes meet something within a leg, and between which shares of it; how far above and below zero its guard is.

    A guard is a number that is positive until something happens: the gap to a surface, or the speed of a slide along
    the direction it had. `watched` says which guards may end the leg; the others are not looked at.
    """

    hit: Bool[Array, "*lanes"]
    first: Array
    last: Array
    above: Array
    below: Array
    watched: tuple[Array, ...]


def find_next_event(walls: tuple, start: ContactMode, end: Particles, t: ArrayLike, dt: ArrayLike) -> Event:
    """What the path from start to end meets, judged by the cubic through its ends; few operations, since every lane pays."""
    walls, start, end = lax.stop_gradient((walls, start, end))
    dips = []
    for face, pressed in zip(collect_faces(walls, t, start.state), start.pressed, strict=True):
        dip = find_dip(face, t, dt, start.state, end)
        dips.append(dip._replace(last=jnp.where(pressed > 0, jnp.inf, dip.last)))
    for wall, slip in zip(walls, start.slip, strict=True):
        if slip is not None:
            before, after = (dot(wall.relative(state.velocity), slip) for state in (start.state, end))
            last = jnp.where((before > 0) & (after <= 0), 1.0, jnp.inf)
            dips.append(Dip(jnp.zeros_like(last), last, before, after))
    last = jnp.min(jnp.stack([dip.last for dip in dips]), axis=0)
    first = jnp.min(jnp.stack([jnp.where(dip.last <= 1, dip.first, jnp.inf) for dip in dips]), axis=0)
    above, below = jnp.zeros_like(last), jnp.zeros_like(last)
    for dip in dips:
        above = jnp.where(dip.last == last, dip.above, above)
        below = jnp.where(dip.last == last, dip.below, below)
    return Event(last <= 1, first, last, above, below, tuple(dip.last <= 1 for dip in dips))


class Dip(NamedTuple):
    """Where a gap goes below zero within a leg: after the share `first`, before `last` (infinite: nowhere), and how deep."""

    first: Array
    last: Array
    above: Array
    below: Array


def find_dip(face: eqx.Module, t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles) -> Dip:
    """The first dip of the gap, as the cubic d(s) = d₀ + r s + b s² + a s³ through the ends of the leg has it."""
    d0, d1 = face.signed_distance(t, start.position), face.signed_distance(t + dt, end.position)
    r0 = dt * dot(face.relative(start.velocity), face.normal_at(t, start.position))
    r1 = dt * dot(face.relative(end.velocity), face.normal_at(t + dt, end.position))
    cubic = Cubic.through(d0, d1, r0, r1)
    # infinite or NaN where the cubic has no minimum, and then not taken
    lowest, highest = cubic.extrema()
    lowest, depth = face.deepest(t, dt, start, end, (lowest, cubic.at(lowest)))
    last = jnp.where(d1 < 0, 1.0, jnp.inf)
    last = jnp.where((lowest > 0) & (lowest < 1) & (depth < 0), lowest, last)
    last = jnp.where((d0 < 0) & (r0 < 0), 0.0, last)
    # a lane that just bounced is at zero now as well; behind a part of its way up only the next touch is left
    bounced = (d0 <= float(jnp.finfo(d0.dtype).eps) ** 0.5 * r0) & (r0 > 0) & (highest > 0) & (highest < last)
    first = jnp.where(bounced, 0.1 * highest, 0.0)
    below = jnp.where(last == 1.0, d1, depth)
    return Dip(first, last, jnp.where(first > 0, cubic.at(first), d0), below)


def evaluate_guards(
    faces: list, walls: tuple, start: ContactMode, event: Event, t: ArrayLike, state: Particles
) -> list[Array]:
    """The guards of a leg at a moment; those not watched are infinite. The faces are those seen when the leg begins.

    Later a slab that moves may have gone past the place where the lane began.
    """
    values = [face.signed_distance(t, state.position) for face in faces]
    for wall, slip in zip(walls, start.slip, strict=True):
        if slip is not None:
            values.append(dot(wall.relative(state.velocity), slip))
    return [jnp.where(seen, value, jnp.inf) for seen, value in zip(event.watched, values, strict=True)]


def collect_faces(walls: tuple, t: ArrayLike, state: Particles) -> list:
    """The surfaces as each lane sees them from where it is: of a slab, the nearer face."""
    return [wall.facing(t, state.position) for wall in walls]
