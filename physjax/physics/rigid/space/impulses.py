"""The impulses of a contact in space: four points that press, and friction where they press in the mean.

Each contact has a frame: two tangents and the normal, about the middle of its points. In it the second body moves
relative to the first by a twist: a velocity of the origin and an angular velocity. Friction is one force in the plane
through the center of pressure and one torque about the normal, within (|f|/μN)² + (τ/μΣNᵢrᵢ)² <= 1, rᵢ from there: the
ellipsoid by which S. Goyal (1991) and R. Howe and M. Cutkosky (1996) describe a patch that slides and spins. Of one
point it is Coulomb's cone.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.backend import any_lane, block_fusion, materialise
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
from physjax.physics.rigid.space.components import (
    Vector,
    multiply,
    multiply_back,
    multiply_rows,
    square_root,
    sum_parts,
)
from physjax.physics.rigid.space.manifolds import POINTS, Manifold, find_tangents

MAX_EXCHANGES = 20
"""Most times in which points that pull let go, and such that would approach press, before the rest is for the next sweep."""
FULL_EXCHANGES = 3
"""Of these, how many exchange all such points at once; after that only the first of them, which cannot go round."""
ROUNDING = 64
"""Speeds relative to those asked for, in units of rounding, that are none."""
LEAST_SHARE = 1e-6
"""Share of the force that would stop a slip below which a smaller one has the same direction."""
SLIDE_TURNS = 3
"""Newton's turns for the direction in which a patch slides and spins: the error is squared in each."""


class Mobility(NamedTuple):
    """What unit forces and torques along the axes of a frame change in the twist there, each `(3, 3, ...)`.

    Velocities by forces [1/kg], angular velocities by forces [1/(kg m)] and by torques [1/(kg m²)]; rows are the twist's.
    Velocities by torques are the second turned over.
    """

    straight: Array
    mixed: Array
    spin: Array


class Bodies(NamedTuple):
    """Both bodies of contacts: centers of mass `(3, ...)` [m], 1/m [1/kg] and R I⁻¹ Rᵀ `(3, 3, ...)` [1/(kg m²)]."""

    center: Sides
    mass: Sides
    turning: Sides


class Contacts(NamedTuple):
    """All contacts of a step as the solver sees them; every array is `(..., size, worlds)`, or in groups with these in front.

    `axes` are two tangents and the normal, from a to b, as rows of `(3, 3, ...)`; `swings` how angular velocities of both
    bodies move the origin along these [m]; `places` where the points are along both tangents [m], `(4, ...)`. `carried` is
    the velocity of b's surface [m/s] in the frame, `(3, ...)`, and where it may turn its angular one [rad/s]. `mass` [1/kg]
    and `turning` [1/(kg m²)] are the inverse ones of both bodies, `friction` is μ, and `is_point` says of the points,
    `(4, ...)`, whether they are there.
    """

    axes: Array
    swings: Sides
    places: Sides
    carried: tuple[Array, ...]
    mobility: Mobility
    mass: Sides
    turning: Sides
    friction: Array
    is_point: Points


def build_contacts(
    t: ArrayLike, found: Manifold, bodies: Bodies, carried: tuple[Array, ...], friction: Array
) -> Contacts:
    """The contacts of manifolds, given the velocity of b's surface [m/s] and μ."""
    axes = materialise(t, lambda: find_tangents(found.normal))
    origin = [(part[0] + part[1] + part[2] + part[3]) / POINTS for part in found.points]
    middle = materialise(t, lambda: jnp.stack(origin))

    def find_arms() -> tuple[Array, Array, Array, Array]:
        ways = [part - start[None] for part, start in zip(found.points, middle, strict=True)]
        x, y = (sum_parts([axes[k, i][None] * way for i, way in enumerate(ways)]) for k in (0, 1))
        return x, y, middle - bodies.center[0], middle - bodies.center[1]

    x, y, *arms = materialise(t, find_arms)
    swings = materialise(t, lambda: (_cross_rows(arms[0], axes), _cross_rows(arms[1], axes)))
    mobility = materialise(t, lambda: _find_mobility(axes, swings, bodies))
    speed = jnp.stack([axes[k, 0] * carried[0] + axes[k, 1] * carried[1] + axes[k, 2] * carried[2] for k in range(3)])
    is_point = jnp.broadcast_to(found.is_point, (POINTS, *found.is_point.shape))
    return Contacts(axes, swings, (x, y), (speed,), mobility, bodies.mass, bodies.turning, friction, (is_point,))


def _cross_rows(arm: Array, rows: Array) -> Array:
    """The cross products of a vector `(3, ...)` with each row of a matrix."""
    x, y, z = arm[0][None], arm[1][None], arm[2][None]
    p, q, r = rows[:, 0], rows[:, 1], rows[:, 2]
    return jnp.stack([y * r - z * q, z * p - x * r, x * q - y * p], axis=1)


def _find_mobility(axes: Array, swings: Sides, bodies: Bodies) -> Mobility:
    """What unit forces and torques along the axes change in the twist of b relative to a."""
    a, b = (
        Mobility(
            multiply_rows(multiply_rows(swing, turning), swing),
            multiply_rows(multiply_rows(axes, turning), swing),
            multiply_rows(multiply_rows(axes, turning), axes),
        )
        for turning, swing in zip(bodies.turning, swings, strict=True)
    )
    total = (bodies.mass[0] + bodies.mass[1])[None, None]
    diagonal = jnp.eye(3, dtype=total.dtype).reshape(3, 3, *(1,) * (total.ndim - 2))
    return Mobility(a.straight + b.straight + diagonal * total, a.mixed + b.mixed, a.spin + b.spin)


def find_speeds(ends: tuple[Velocity, Velocity], contacts: Contacts) -> Speeds:
    """The twist of b relative to a in the frame, `(3, ...)`: velocity of the origin [m/s] and angular velocity [rad/s]."""
    ((va, wa), (vb, wb)), (swing_a, swing_b) = ends, contacts.swings
    straight = multiply(contacts.axes, vb - va) + multiply(swing_b, wb) - multiply(swing_a, wa)
    spin, (carried, *turning) = multiply(contacts.axes, wb - wa), contacts.carried
    return straight + carried, spin + turning[0] if turning else spin


def find_openings(speeds: Speeds, contacts: Contacts) -> Array:
    """How fast b moves away from a at each point [m/s], `(4, ...)`."""
    (velocity, spin), (x, y) = speeds, contacts.places
    return velocity[2:] + spin[:1] * y - spin[1:2] * x


def find_slip(speeds: Speeds, contacts: Contacts) -> Array:
    """How fast the point that slides fastest does so [m/s]."""
    (velocity, spin), (x, y) = speeds, contacts.places
    along, across = velocity[:1] - spin[2:] * y, velocity[1:2] + spin[2:] * x
    return square_root(jnp.max(along * along + across * across, axis=0))


def find_wrench(contacts: Contacts, impulses: Impulses) -> tuple[list[Array], list[Array]]:
    """The force and the torque about the origin of impulses, in the frame [N s, N m s], by their three numbers."""
    (x, y), (fx, fy, spin, press) = contacts.places, impulses
    return block_fusion(([fx, fy, sum_parts(press)], [sum_parts(press * y), -sum_parts(press * x), spin]))


def link(contacts: Contacts, spread: Spread) -> Contacts:
    """Contacts of bodies whose velocities impulses change as `spread` says, all of them in groups."""
    still = contacts._replace(carried=tuple(map(jnp.zeros_like, contacts.carried)))
    none = jnp.zeros_like(contacts.axes[:, 0, 0])

    def respond(wrench: Array) -> Speeds:
        parts = [none + part for part in wrench]
        return jax.vmap(find_speeds)(spread(jax.vmap(apply_wrench)(contacts, parts[:3], parts[3:])), still)

    # the columns, each of `(groups, 3, ...)`: of the velocity of the origin, and of the angular velocity
    velocity, spin = (jnp.moveaxis(part, 0, 2) for part in jax.vmap(respond)(jnp.eye(6, dtype=none.dtype)))
    return contacts._replace(mobility=Mobility(velocity[:, :, :3], spin[:, :, :3], spin[:, :, 3:]))


def find_changes(contacts: Contacts, impulses: Impulses) -> tuple[Velocity, Velocity]:
    """What impulses on b, and the opposite ones on a, change in the velocities of both."""
    return apply_wrench(contacts, *find_wrench(contacts, impulses))


def apply_wrench(contacts: Contacts, force: list[Array], torque: list[Array]) -> tuple[Velocity, Velocity]:
    """What a force and a torque about the origin of b, and the opposite ones on a, change in the velocities of both."""
    straight, twist = multiply_back(contacts.axes, force), multiply_back(contacts.axes, torque)
    spins = [
        multiply(turning, multiply_back(swing, force) + twist)
        for turning, swing in zip(contacts.turning, contacts.swings, strict=True)
    ]
    a, b = contacts.mass
    return (-a[None] * straight, -spins[0]), (b[None] * straight, spins[1])


def share_push(contacts: Contacts, push: Array, torque: Array) -> Array:
    """The impulses of four points, as even as can be, of a normal one [N s] and torques about both tangents [N m s]."""
    xs, ys = contacts.places
    # about the middle of all points the sums of x and y are zero
    xx, xy, yy = sum_parts(xs * xs), sum_parts(xs * ys), sum_parts(ys * ys)
    small = float(jnp.finfo(push.dtype).eps) ** 0.5 * (xx + yy)
    xx, yy = xx + small, yy + small
    area = xx * yy - xy * xy
    inverse = 1 / jnp.where(area > 0, area, jnp.inf)
    p, q = inverse * (xx * torque[0] + xy * torque[1]), inverse * (xy * torque[0] + yy * torque[1])
    return push[None] / POINTS + ys * p[None] - xs * q[None]


def solve_contact(speeds: Speeds, contacts: Contacts, demand: Demand, impulses: Impulses) -> Impulses:
    """The impulses of each contact: all points that press together, then friction, in turns."""
    mobility, before = contacts.mobility, impulses[-1]
    velocity, spin = _find_twist(mobility, *find_wrench(contacts, impulses))
    # the twist there would be without any impulse
    free, matrix = block_fusion(((speeds[0] - velocity, speeds[1] - spin), _couple_points(contacts)))
    there, none = contacts.is_point[0] & demand.active[0], jnp.zeros_like(impulses[0])

    def alternate(now: Impulses, _: Any) -> tuple[Impulses, None]:
        fx, fy, turn, *_ = now
        velocity, spin = _find_twist(mobility, [fx, fy, none], [none, none, turn])
        opening = find_openings((free[0] + velocity, free[1] + spin), contacts)
        press = _press_points(matrix, demand.speed[0] - opening, demand.yields[0], there, before)
        return (*_grip(contacts, free, press), press), None

    now, _ = lax.scan(alternate, impulses, length=ALTERNATIONS)
    return now


def _find_twist(mobility: Mobility, force: list[Array], torque: list[Array]) -> tuple[Array, Array]:
    """What a force and a torque change in the twist, `(3, ...)`."""
    velocity = multiply(mobility.straight, force) + multiply_back(mobility.mixed, torque)
    return velocity, multiply(mobility.mixed, force) + multiply(mobility.spin, torque)


def _couple_points(contacts: Contacts) -> Array:
    """How much a unit impulse at one point opens another [1/kg], `(4, 4, ...)`."""
    (x, y), (straight, mixed, spin) = contacts.places, contacts.mobility
    x1, x2, y1, y2 = x[:, None], x[None], y[:, None], y[None]
    one = lambda number: number[None, None]  # noqa: E731
    # along the normal a point moves by v_z + ω_x y - ω_y x
    outer = one(straight[2, 2]) + one(mixed[0, 2]) * (y1 + y2) - one(mixed[1, 2]) * (x1 + x2)
    turned = one(spin[0, 0]) * y1 * y2 - one(spin[0, 1]) * (y1 * x2 + x1 * y2) + one(spin[1, 1]) * x1 * x2
    return outer + turned


class _System(NamedTuple):
    """What unit impulses at one point open another [1/kg], with a softer diagonal, and the speeds asked for [m/s]."""

    matrix: Array
    diagonal: Array
    asked: Array


def _press_points(matrix: Array, wanted: Array, yields: Array, there: Array, before: Array) -> Array:
    """The normal impulses x >= 0 of four points with K x >= wanted, where either is met.

    Four points in a plane move in three ways: what they share among each other in the fourth stays as it was before, by a
    diagonal that is larger by the root of rounding.
    """
    small = float(jnp.finfo(wanted.dtype).eps) ** 0.5
    own = jnp.stack([matrix[k, k] for k in range(POINTS)])
    own = jnp.where(own > 0, own, 1.0)
    diagonal = jnp.where(yields, SOFT.yielding * own, own) + small * own
    system = _System(matrix, diagonal, wanted + small * own * before)
    pressed = _find_pressed(lax.stop_gradient(system), there)
    return jnp.maximum(jnp.stack(block_fusion(_solve_pressed(system, pressed))), 0.0)


def _find_pressed(system: _System, there: Array) -> Array:
    """Which points press: by exchange of those that pull, and of those that would approach (K. Murty 1974)."""
    units = ROUNDING * float(jnp.finfo(system.asked.dtype).eps)
    floor = units * sum_parts(abs(system.asked))

    def exchange(turn: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        number, pressed, _ = turn
        x = jnp.stack(block_fusion(_solve_pressed(system, pressed)))
        # of points that do not press the diagonal is of no matter
        opening = sum_parts(jnp.swapaxes(system.matrix, 0, 1) * x[:, None]) - system.asked
        wrong = there & jnp.where(pressed, x < 0, opening < -floor[None])
        earlier = jnp.cumsum(wrong, axis=0, dtype=jnp.int32) - wrong.astype(jnp.int32)
        flips = wrong & ((earlier == 0) | (number < FULL_EXCHANGES))
        return number + 1, pressed ^ flips, jnp.any(wrong)

    begun = jnp.zeros((), jnp.int32), there, jnp.ones((), bool)
    return lax.while_loop(lambda turn: turn[2] & (turn[0] < MAX_EXCHANGES), exchange, begun)[1]


def _solve_pressed(system: _System, pressed: Array) -> list[Array]:
    """The impulses of the points that press, with none of the others: by elimination."""
    lower = [[jnp.where(pressed[i] & pressed[j], system.matrix[i, j], 0.0) for j in range(i)] for i in range(POINTS)]
    pivots = [jnp.where(pressed[k], system.diagonal[k], 1.0) for k in range(POINTS)]
    x = [jnp.where(pressed[k], system.asked[k], 0.0) for k in range(POINTS)]
    for k in range(POINTS):
        column = [row[k] if len(row) > k else pivots[k] for row in lower]
        for i in range(k + 1, POINTS):
            lower[i][k] = share = column[i] / pivots[k]
            pivots[i] = pivots[i] - share * column[i]
            for j in range(k + 1, i):
                lower[i][j] = lower[i][j] - share * column[j]
            x[i] = x[i] - share * x[k]
    x = [part / pivot for part, pivot in zip(x, pivots, strict=True)]
    for k in reversed(range(POINTS)):
        for i in range(k + 1, POINTS):
            x[k] = x[k] - lower[i][k] * x[i]
    return x


def _grip(contacts: Contacts, free: Speeds, press: Array) -> tuple[Array, Array, Array]:
    """What stops the slip, or as much of it as friction can: two forces, and the torque about the origin."""
    total, (x, y) = jnp.maximum(sum_parts(press), 0.0), contacts.places
    inverse = 1 / jnp.where(total > 0, total, jnp.inf)
    cx, cy = inverse * sum_parts(press * x), inverse * sum_parts(press * y)
    radius = inverse * sum_parts(press * square_root((x - cx[None]) ** 2 + (y - cy[None]) ** 2))
    total, cx, cy, radius = block_fusion((total, cx, cy, radius))
    none = jnp.zeros_like(total)
    velocity, spin = _find_twist(contacts.mobility, [none, none, total], [total * cy, -total * cx, none])
    vx, vy, wz = free[0][0] + velocity[0], free[0][1] + velocity[1], free[1][2] + spin[2]
    # a force at the center turns about the origin
    slip = [vx - wz * cy, vy + wz * cx, radius * wz]
    matrix = _find_patch(contacts.mobility, (cx, cy, radius))
    fx, fy, twist = _slide(matrix, slip, contacts.friction * total)
    return fx, fy, radius * twist + cx * fy - cy * fx


def _find_patch(mobility: Mobility, patch: Vector) -> list[list[Array]]:
    """What forces at the center of a patch and the torque over its radius change in how it slides."""
    (cx, cy, radius), one, none = patch, jnp.ones_like(patch[0]), jnp.zeros_like(patch[0])
    a, b, d = mobility.straight[0, 0], mobility.straight[0, 1], mobility.straight[1, 1]
    c, e, f = mobility.mixed[2, 0], mobility.mixed[2, 1], mobility.spin[2, 2]
    own = [[a, b, c], [b, d, e], [c, e, f]]
    ways = [(one, none, -cy), (none, one, cx), (none, none, radius)]
    moved = [[sum_parts([k * part for k, part in zip(row, way, strict=True)]) for row in own] for way in ways]
    matrix = [[sum_parts([p * q for p, q in zip(way, other, strict=True)]) for other in moved] for way in ways]
    # a single point resists no spin, and its radius may be one of rounding
    matrix[2][2] = matrix[2][2] + float(jnp.finfo(radius.dtype).eps) ** 0.5 * matrix[0][0]
    return matrix


def _slide(matrix: list[list[Array]], speeds: list[Array], most: Array) -> list[Array]:
    """The force f within |f| <= most that stops a slip, or is opposite to what of it is left: (G + α) f = -v, α >= 0.

    The root α is found as that of the size of a step in optimisation (J. Moré and D. Sorensen 1983).
    """
    own = matrix[0][0] + matrix[1][1] + matrix[2][2]
    matrix = [
        [jnp.where(own > 0, k, 1.0 if i == j else 0.0) for j, k in enumerate(row)] for i, row in enumerate(matrix)
    ]
    whole = _solve_three(matrix, jnp.zeros_like(most), speeds)
    # of less than that only the direction is left to find
    bound = jnp.maximum(most, LEAST_SHARE * _measure(whole))
    divisor = jnp.where(bound > 0, bound, 1.0)

    def turn(now: tuple[Array, list[Array]], _: None) -> tuple[tuple[Array, list[Array]], None]:
        more, force = now
        square = sum_parts([part * part for part in force])
        size = square_root(square)
        bent = sum_parts([part * other for part, other in zip(force, _solve_three(matrix, more, force), strict=True)])
        step = jnp.where(bent != 0, square / jnp.where(bent != 0, bent, 1.0), 0.0) * (size - bound) / divisor
        more = jnp.where(size > bound, more + step, more)
        return (more, _solve_three(matrix, more, speeds)), None

    slides = (_measure(whole) > bound) & (most > 0)
    begun = jnp.zeros_like(most), whole
    # at rest nothing slides, and what stops it is found already
    find = lambda: lax.scan(turn, begun, length=SLIDE_TURNS)[0][1]  # noqa: E731
    force = lax.cond(any_lane(slides), find, lambda: whole)
    size = _measure(force)
    share = jnp.where(size > most, most / jnp.where(size > 0, size, 1.0), jnp.where(most > 0, 1.0, 0.0))
    return block_fusion([-share * part for part in force])


def _measure(force: list[Array]) -> Array:
    return square_root(sum_parts([part * part for part in force]))


def _solve_three(matrix: list[list[Array]], more: Array, right: list[Array]) -> list[Array]:
    """The solution of a symmetric system of three with `more` on its diagonal, by elimination."""
    (a, b, c), (_, d, e), (_, _, f) = matrix
    x, y, z = right
    a, d, f = a + more, d + more, f + more
    p, q = b / a, c / a
    d, e, f = d - p * b, e - p * c, f - q * c
    y, z = y - p * x, z - q * x
    r = e / d
    f, z = f - r * e, z - r * y
    z = z / f
    y = (y - e * z) / d
    return [(x - b * y - c * z) / a, y, z]


__all__ = [
    "Bodies",
    "Contacts",
    "build_contacts",
    "find_changes",
    "find_openings",
    "find_slip",
    "find_speeds",
    "find_wrench",
    "link",
    "share_push",
    "solve_contact",
]
