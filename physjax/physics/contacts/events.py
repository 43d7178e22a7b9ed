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
from physjax.physics.contacts.contact_mode import ContactMode
from physjax.physics.contacts.face import ContactFace, Face
from physjax.vectors import dot


class Event(NamedTuple):
    """Which lanes have an event within a leg, bracketed between two shares of it, and the guard's values there.

    `above` and `below` are the values of the first guard that falls, at `first` and `last`. `watched` says which guards
    may end the leg; the others are ignored.
    """

    hit: Bool[Array, "*lanes"]
    first: Array
    last: Array
    above: Array
    below: Array
    watched: tuple[Array, ...]


def find_next_event(
    walls: tuple[ContactFace, ...], start: ContactMode, end: Particles, t: ArrayLike, dt: ArrayLike
) -> Event:
    """The first event on the path from start to end, bracketed by the cubic through its ends.

    Only a bracket is needed here: the event's time is then a root on the method's own path. Every lane pays for this
    test in every step, so it takes few operations.
    """
    walls, start, end = lax.stop_gradient((walls, start, end))
    dips = []
    for face, pressed in zip(collect_faces(walls, t, start.state), start.pressed, strict=True):
        dip = find_dip(face, t, dt, start.state, end)
        # the reaction keeps a lane that presses on a surface on it: rounding there is no impact
        dips.append(dip._replace(last=jnp.where(pressed > 0, jnp.inf, dip.last)))
    for wall, slip in zip(walls, start.slip, strict=True):
        if slip is not None:
            before, after = (dot(wall.relative(state.velocity), slip) for state in (start.state, end))
            last = jnp.where((before > 0) & (after <= 0), 1.0, jnp.inf)
            dips.append(Dip(jnp.zeros_like(last), last, before, after))
    last = jnp.min(jnp.stack([dip.last for dip in dips]), axis=0)
    first = jnp.min(jnp.stack([jnp.where(dip.last <= 1, dip.first, jnp.inf) for dip in dips]), axis=0)
    above, below = jnp.zeros_like(last), jnp.zeros_like(last)
    # by a choice for each guard: an index that differs from lane to lane would be a gather
    for dip in dips:
        above = jnp.where(dip.last == last, dip.above, above)
        below = jnp.where(dip.last == last, dip.below, below)
    return Event(last <= 1, first, last, above, below, tuple(dip.last <= 1 for dip in dips))


class Dip(NamedTuple):
    """Where a signed distance falls below zero within a leg: after the share `first`, before `last` (∞: nowhere).

    `above` and `below` [m] are its values there.
    """

    first: Array
    last: Array
    above: Array
    below: Array


def find_dip(face: Face, t: ArrayLike, dt: ArrayLike, start: Particles, end: Particles) -> Dip:
    """The first dip of the signed distance by the cubic d(s) = d₀ + r s + b s² + a s³ through the ends of the leg."""
    d0, d1 = face.signed_distance(t, start.position), face.signed_distance(t + dt, end.position)
    r0 = dt * dot(face.relative(start.velocity), face.normal_at(t, start.position))
    r1 = dt * dot(face.relative(end.velocity), face.normal_at(t + dt, end.position))
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
    below = jnp.where(last == 1.0, d1, depth)
    return Dip(first, last, jnp.where(first > 0, cubic.at(first), d0), below)


def evaluate_guards(
    faces: list[ContactFace],
    walls: tuple[ContactFace, ...],
    start: ContactMode,
    event: Event,
    t: ArrayLike,
    state: Particles,
) -> list[Array]:
    """The guards of a leg at a time t [s]; those that are not watched are infinite.

    The faces are those of the beginning of the leg: a moving slab may since have passed the place where a lane was, and
    would then show it the other face.
    """
    values = [face.signed_distance(t, state.position) for face in faces]
    for wall, slip in zip(walls, start.slip, strict=True):
        if slip is not None:
            values.append(dot(wall.relative(state.velocity), slip))
    return [jnp.where(watched, value, jnp.inf) for watched, value in zip(event.watched, values, strict=True)]


def collect_faces(walls: tuple[ContactFace, ...], t: ArrayLike, state: Particles) -> list[ContactFace]:
    """The surfaces as each lane meets them from where it is: of a slab, the nearer face."""
    return [wall.facing(t, state.position) for wall in walls]
