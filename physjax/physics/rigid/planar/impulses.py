"""The impulses of a contact in the plane.

A contact has one normal and one or two points, and so three directions: the tangent, in which the friction at both points
acts along one line, and the normal at each point.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.backend import materialise
from physjax.physics.rigid.planar.manifolds import Vector
from physjax.physics.rigid.solids.mechanics import (
    ALTERNATIONS,
    SOFT,
    Demand,
    Impulses,
    Points,
    Sides,
    Speeds,
    Spread,
    Velocity,
)

MIN_DETERMINANT_SHARE = 1e-3
"""Share of the product of its diagonal below which the matrix of two points has none: they are as good as one."""

COUPLED = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""The directions of each number in `Contacts.coupling`."""
Both = tuple[Array, Array]
"""The same number at both points of each contact."""
Directions = tuple[Array, Array, Array]
"""A number of contacts along the tangent and along the normal at both points, each `(contacts, worlds)`."""


class Contacts(NamedTuple):
    """All contacts of a step as the solver sees them; every array is `(contacts, worlds)`, or in groups with these in front.

    `normal` points from a to b; the tangent is the normal turned left. `torque` is what unit impulses along the three
    directions turn a and b by [m]; `carried` the speed of b's surface along the tangent and the normal [m/s], or where it
    may turn the normal at both points; `coupling` by how much a unit impulse along one direction changes the speed along
    another [1/kg]: tangent with itself and both normals, first normal with itself and the second, second with itself.
    `mass` and `moment` are the inverse ones of both bodies [1/kg, 1/(kg m²)], `friction` is μ, and `is_point` says which
    of the two are points.
    """

    normal: Vector
    torque: tuple[Directions, Directions]
    carried: tuple[Array, ...]
    coupling: tuple[Array, ...]
    mass: Sides
    moment: Sides
    friction: Array
    is_point: Both


def build_contacts(
    t: ArrayLike,
    normal: Vector,
    arm: tuple[Vector, Vector],
    carried: Vector,
    bodies: tuple[Sides, Sides],
    friction: Array,
    is_point: Array,
) -> Contacts:
    """Contacts from normals, arms to both points `(2, ...)`, the velocity of b's surface [m/s], and 1/m and 1/I."""
    nx, ny = normal
    # of two points the line of friction goes through the middle
    middle = lambda c: jnp.where(is_point[1], (c[0] + c[1]) / 2, c[0])  # noqa: E731
    turn = lambda ax, ay: (middle(ax) * nx + middle(ay) * ny, *(ax * ny[None] - ay * nx[None]))  # noqa: E731
    ta, tb = torque = materialise(t, lambda: (turn(*arm[0]), turn(*arm[1])))
    along, across = carried[0] * nx + carried[1] * ny, carried[1] * nx - carried[0] * ny
    mass, (ia, ib) = bodies
    parallel = lambda i, j: 0.0 if (i == 0) != (j == 0) else mass[0] + mass[1]  # noqa: E731
    coupling = tuple(parallel(i, j) + ia * ta[i] * ta[j] + ib * tb[i] * tb[j] for i, j in COUPLED)
    points = (is_point[0], is_point[1])
    return Contacts(normal, torque, (across, along), coupling, mass, (ia, ib), friction, points)


def link(contacts: Contacts, spread: Spread) -> Contacts:
    """Contacts of bodies whose velocities impulses change as `spread` says, all of them in groups."""
    still = contacts._replace(carried=tuple(map(jnp.zeros_like, contacts.carried)))
    none = jnp.zeros_like(contacts.coupling[0])

    def respond(impulse: Array) -> Speeds:
        return find_speeds(spread(find_changes(contacts, tuple(none + part for part in impulse))), still)

    found = jax.vmap(respond)(jnp.eye(3, dtype=none.dtype))
    return contacts._replace(coupling=tuple(found[i][j] for i, j in COUPLED))


def find_speeds(ends: tuple[Velocity, Velocity], contacts: Contacts) -> Directions:
    """How fast b moves away from a along each direction [m/s]."""
    ((ax, ay, aw), (bx, by, bw)), (nx, ny), (across, *along) = ends, contacts.normal, contacts.carried
    dx, dy = bx - ax, by - ay
    turning = [b * bw - a * aw for a, b in zip(*contacts.torque, strict=True)]
    straight = [nx * dx + ny * dy + part for part in along]
    return nx * dy - ny * dx + across + turning[0], straight[0] + turning[1], straight[-1] + turning[2]


def find_changes(contacts: Contacts, impulses: Impulses) -> tuple[Velocity, Velocity]:
    """What impulses on b, and the opposite ones on a, change in the velocities of both."""
    (nx, ny), across, along = contacts.normal, impulses[0], impulses[1] + impulses[2]
    px, py = nx * along - ny * across, ny * along + nx * across
    sa, sb = (sum(arm * impulse for arm, impulse in zip(torque, impulses, strict=True)) for torque in contacts.torque)
    (ma, mb), (ia, ib) = contacts.mass, contacts.moment
    return (-ma * px, -ma * py, -ia * sa), (mb * px, mb * py, ib * sb)


def solve_contact(speed: Speeds, contacts: Contacts, demand: Demand, impulses: Impulses) -> Impulses:
    """The impulses of each contact: friction, then both normals together, in turns."""
    own, first, second, *matrix = contacts.coupling
    there = [is_point & active for is_point, active in zip(contacts.is_point, demand.active, strict=True)]
    # what all impulses have to bring about: the speeds asked for, less those there would be without any
    rows = (own, first, second), (first, matrix[0], matrix[1]), (second, matrix[1], matrix[2])
    wanted = jnp.zeros_like(own), *demand.speed
    effect = [sum(k * impulse for k, impulse in zip(row, impulses, strict=True)) for row in rows]
    slip, *targets = (asked - v + part for asked, v, part in zip(wanted, speed, effect, strict=True))

    def grip(press: Both) -> Array:
        most = contacts.friction * (press[0] + press[1])
        held = (slip - first * press[0] - second * press[1]) / jnp.where(own > 0, own, jnp.inf)
        return jnp.where(there[0] | there[1], jnp.clip(held, -most, most), 0.0)

    def alternate(press: Both, _: None) -> tuple[Both, None]:
        friction = grip(press)
        left = targets[0] - first * friction, targets[1] - second * friction
        return _press_both(matrix, left, demand.yields, there), None

    press, _ = lax.scan(alternate, (impulses[1], impulses[2]), length=ALTERNATIONS)
    return grip(press), *press


def _press_both(matrix: list[Array], wanted: Both, yields: Points, there: list[Array]) -> Both:
    """The normal impulses x >= 0 of two points with K x >= wanted, where either is met: solved exactly, as a box rocks.

    K holds the changes of speed by unit impulses; softness makes its diagonal larger.
    """
    aa, ab, bb = matrix
    aa, bb = (jnp.where(own > 0, own, 1.0) for own in (aa, bb))
    soft_a, soft_b = (jnp.where(yields[k], SOFT.yielding * own, own) for k, own in enumerate((aa, bb)))
    wanted_a, wanted_b = (jnp.where(there[k], wanted[k], -1.0) for k in range(2))
    determinant = soft_a * soft_b - ab * ab
    regular = determinant > MIN_DETERMINANT_SHARE * soft_a * soft_b
    inverse = 1 / jnp.where(regular, determinant, jnp.inf)
    both_a, both_b = inverse * (soft_b * wanted_a - ab * wanted_b), inverse * (soft_a * wanted_b - ab * wanted_a)
    both = regular & (both_a >= 0) & (both_b >= 0)
    only_a, only_b = jnp.maximum(wanted_a / soft_a, 0.0), jnp.maximum(wanted_b / soft_b, 0.0)
    a_alone = ab * only_a >= wanted_b
    return (
        jnp.where(both, both_a, jnp.where(a_alone, only_a, 0.0)),
        jnp.where(both, both_b, jnp.where(a_alone, 0.0, only_b)),
    )


__all__ = ["Contacts", "build_contacts", "find_changes", "find_speeds", "link", "solve_contact"]
