"""Event detection: the guards of a leg, and where along it they fall below zero.

A guard is a number that is positive until something happens: the signed distance to a surface, or the speed of a slide
along the direction in which it began, which is zero where it stops. A leg is the part of a step up to the next event.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool

from physjax.cubics import Cubic
from physjax.particles import Particles
from physjax.physics.contacts.face import Face
from physjax.physics.contacts.resting import Reaction
from physjax.physics.contacts.surfaces import Surfaces
from physjax.stacks import map_stacks
from physjax.vectors import dot

NEWTON_STEPS = 3
"""Steps towards the zero of a cubic: from the secant of its ends they reach it to single precision or better."""


class Event(NamedTuple):
    """Which lanes have an event within a leg, bracketed between two shares of it, and the guard's values there.

    `above` and `below` are the values of the first guard that falls, at `first` and `last`; `guess` is where its cubic
    is zero and `slope` its derivative there. `watched` says which guards may end the leg; the others are ignored.
    """

    hit: Bool[Array, "*lanes"]
    first: Array
    last: Array
    above: Array
    below: Array
    guess: Array
    slope: Array
    watched: Bool[Array, "guards *lanes"]


class Dip(NamedTuple):
    """Where a signed distance falls below zero within a leg: after the share `first`, before `last` (∞: nowhere).

    `above` and `below` [m] are its values there, `guess` is where the cubic through the leg's ends is zero.
    """

    first: Array
    last: Array
    above: Array
    below: Array
    guess: Array
    slope: Array


def find_next_event(
    faces: Surfaces, reaction: Reaction, pressed: Array, start: Particles, end: Particles, t: ArrayLike, dt: ArrayLike
) -> Event:
    """The first event on the path from start to end, bracketed by the cubic through its ends.

    Only a bracket is needed here: the event's time is then a root on the method's own path.
    """
    dip = map_stacks(lambda face: find_dip(face, t, dt, start, end), faces.stacks)
    # the reaction keeps a lane that presses on a surface on it: rounding there is no impact
    dip = dip._replace(last=jnp.where(pressed, jnp.inf, dip.last))
    before, after = reaction.measure_slides(t, start), reaction.measure_slides(t + dt, end)
    if before is not None and after is not None:
        stop = _find_stop(before, after)
        dip = Dip(*(jnp.concatenate([a, b]) for a, b in zip(dip, stop, strict=True)))
    watched, last = dip.last <= 1, jnp.min(dip.last, axis=0)
    first = jnp.min(jnp.where(watched, dip.first, jnp.inf), axis=0)
    soonest = watched & (dip.last == last[None])
    above, below, guess, slope = (jnp.min(jnp.where(soonest, part, jnp.inf), axis=0) for part in dip[2:])
    return Event(last <= 1, first, last, above, below, guess, slope, watched)


def _find_stop(before: Array, after: Array) -> Dip:
    """Where slides with these speeds along their first direction, at both ends of a leg, come to a stop."""
    stops = (before > 0) & (after <= 0)
    fall = jnp.where(stops, before - after, 1.0)
    return Dip(jnp.zeros_like(before), jnp.where(stops, 1.0, jnp.inf), before, after, before / fall, -fall)


def find_dip(face: Face, t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles) -> Dip:
    """The first dip of the signed distance by the cubic d(s) = d₀ + r s + b s² + a s³ through the ends of the leg."""
    d0, d1 = face.signed_distance(t, start.position), face.signed_distance(t + dt, end.position)
    r0 = dt * dot(face.relative(t, *start), face.normal_at(t, start.position))
    r1 = dt * dot(face.relative(t + dt, *end), face.normal_at(t + dt, end.position))
    cubic = Cubic.through(d0, d1, r0, r1)  # pyright: ignore[reportArgumentType]  # a number times an array is an array
    # infinite or NaN where the cubic has no minimum, and then not taken
    lowest, highest = cubic.extrema()
    lowest, depth = face.deepest(t, dt, start, end, (lowest, cubic.at(lowest)))
    last = jnp.where(d1 < 0, 1.0, jnp.inf)
    last = jnp.where((lowest > 0) & (lowest < 1) & (depth < 0), lowest, last)
    last = jnp.where((d0 < 0) & (r0 < 0), 0.0, last)
    # a lane that just bounced is at zero now as well; behind a part of its way up only the next touch is left
    bounced = (d0 <= float(jnp.finfo(d0.dtype).eps) ** 0.5 * r0) & (r0 > 0) & (highest > 0) & (highest < last)
    first = jnp.where(bounced, 0.1 * highest, 0.0)
    above = jnp.where(first > 0, cubic.at(first), d0)
    below = jnp.where(last == 1.0, d1, depth)
    return Dip(first, last, above, below, *_find_zero(cubic, first, last, above, below))


def _find_zero(cubic: Cubic, first: Array, last: Array, above: Array, below: Array) -> tuple[Array, Array]:
    """Where a cubic that falls from `above` to `below` between two shares is zero, and its slope there."""
    fall = above - below
    start = first + (last - first) * (above / jnp.where(fall > 0, fall, 1.0))

    def improve(_, s: Array) -> Array:
        slope = cubic.slope(s)
        return jnp.clip(s - cubic.at(s) / jnp.where(slope < 0, slope, -jnp.inf), first, last)

    s = lax.fori_loop(0, NEWTON_STEPS, improve, start)
    return s, cubic.slope(s)
