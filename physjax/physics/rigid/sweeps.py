"""Sweeps over the contact points of a body: point after point, the impulses at the others given, until none changes.

Arrays are `(points, 3, lanes)`, numbers `(points, 1, lanes)` and 3×3 matrices `(points, 3, 3, lanes)` by columns, as
`impulses` says. A linear sweep is what the implicit function theorem asks for, with each point's part in it as a matrix.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from physjax.backend import any_lane
from physjax.loops import bounded_while_loop
from physjax.vectors import norm

MAX_SWEEPS = 256
"""Most sweeps over all points: a single point needs two, a box on its face about twenty, near sliding a hundred."""
SWEEP_ROUNDING = 256
"""Units of rounding of the impulses below which a sweep changes nothing."""


class PointRows(NamedTuple):
    """What the sweeps need of each point's own mobility K = W_kk; vectors are `(points, 3, lanes)`, numbers `(points, 1, lanes)`.

    `share` is 1/(n·Kn) of `active` points, else 0. With friction also `inverse` K⁻¹, `across`, which is K⁻¹ for impulses
    across the normal alone, `normal_response` Kn, and `slip_mobility`, one over the largest eigenvalue of K across the normal.
    """

    arm: Array
    normal: Array
    before: Array
    share: Array
    active: Array
    inverse: Array | None = None
    across: Array | None = None
    normal_response: Array | None = None
    slip_mobility: Array | None = None
    friction: tuple[Array, Array] | None = None


class Body(NamedTuple):
    """1/m `(1, lanes)`, and R I⁻¹ Rᵀ `(3, 3, lanes)`."""

    inverse_mass: Array
    inverse_inertia: Array


def repeat_sweeps(rows: PointRows, body: Body, start: Array, wanted: Array) -> Array:
    """Impulses `(points, 3, lanes)` that a sweep leaves unchanged, where `wanted` `(1, 1, lanes)`; else `start`."""

    # the velocity of the body is carried along, so that a point's turn costs no sum over the other points
    def pass_(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        before, moved_before, going = carry
        after, moved_after = _sweep_points(rows, body, before, moved_before)
        # a lane that has settled waits for the others without a change: its result does not depend on theirs
        after = jnp.where(going, after, before)
        return after, jnp.where(going[0], moved_after, moved_before), _find_changed_lanes(before, after)

    return _repeat_until_settled(pass_, (start, sum_velocities(rows, body, start), wanted))[0]


def _sweep_points(rows: PointRows, body: Body, j: Array, moved: Array) -> tuple[Array, Array]:
    """The impulses after one sweep over the points, and the velocity and ω `(6, lanes)` that they give to the body."""
    # one after the other: points that took their turns at once would overshoot where they share a load
    moved, after = lax.scan(partial(_update_point, body), moved, (rows, j))
    return after, moved


def _find_changed_lanes(before: Array, after: Array) -> Array:
    """Which lanes `(1, 1, lanes)` a sweep changes by more than rounding."""
    change, size = (jnp.sum(jnp.abs(part), axis=(0, 1), keepdims=True) for part in (after - before, after))
    return change > SWEEP_ROUNDING * float(jnp.finfo(after.dtype).eps) * size


def _repeat_until_settled(pass_: Callable[[tuple], tuple], start: tuple) -> tuple:
    """Sweeps until no lane changes any more; which lanes do is the last part of the carry."""
    return bounded_while_loop(lambda carry: any_lane(carry[-1]), pass_, start, most=MAX_SWEEPS)


def _update_point(body: Body, moved: Array, point: tuple[PointRows, Array]) -> tuple[Array, Array]:
    """A sweep's turn of one point, the impulses at the others given: it sticks if it can, else it is pushed and slips.

    Sticking is the impulse that stops the point, if it is within the cone of μ_s. Slipping takes a step against the
    velocity across the normal, at most as long as the stiffest direction allows, and cuts it to the disc of μ_k.
    """
    row, old = point
    # vectors are (1, 3, lanes) here and numbers (1, lanes): the compiler then keeps what several components share
    row, old = _add_point_axis(row), old[None]
    new = update_points(row, old, row.before + find_point_velocities(row.arm, moved))
    return moved + _find_change(body, row.arm, new - old), new[0]


def update_points(rows: PointRows, old: Array, v: Array) -> Array:
    """The impulses at points with velocities v after their turn; vectors are `(points, 3, lanes)`, numbers `(points, lanes)`."""
    normal = rows.normal
    pushed = _dot_one(normal, old)
    push = jnp.maximum(pushed - _dot_one(normal, v) * rows.share, 0.0)
    new = push[:, None] * normal
    if rows.friction is not None:
        assert rows.inverse is not None
        assert rows.normal_response is not None
        assert rows.slip_mobility is not None
        static, kinetic = rows.friction
        stick = old - multiply_columns(rows.inverse, v)
        # the slip after this turn's normal impulse, which moves the point across the normal as well
        v = v + (push - pushed)[:, None] * rows.normal_response
        slip = _project_across(normal, old - rows.slip_mobility[:, None] * v)
        size, most = _norm_one(slip), kinetic * push
        slip = jnp.where(size > most, most / jnp.where(size > 0, size, 1.0), 1.0)[:, None] * slip
        held = _dot_one(normal, stick)
        sticks = (held >= 0) & (_norm_one(_project_across(normal, stick)) <= static * held)
        new = jnp.where(rows.active[:, None], jnp.where(sticks[:, None], stick, new + slip), 0.0)
    return new


def _add_point_axis(row: PointRows) -> PointRows:
    """A single point with an axis of points; its numbers `(1, lanes)` have one already."""
    return jax.tree.map(lambda part: part if part.ndim == 2 and part.shape[0] == 1 else part[None], row)


def squeeze_numbers(rows: PointRows) -> PointRows:
    """All points with their numbers as `(points, lanes)`."""
    return jax.tree.map(lambda part: part[:, 0] if part.ndim == 3 and part.shape[1] == 1 else part, rows)


class LinearSweep(NamedTuple):
    """A linear sweep z_k ← P_k z_k + Q_k v_k + b_k, with v the velocities that impulses R z give to the points.

    The matrices are `(points, 3, 3, lanes)`, by columns.
    """

    own: Array
    velocity: Array
    impulse: Array

    @property
    def transposed(self) -> "LinearSweep":
        """The sweep of the transposed problem: what impulses give to velocities is symmetric."""
        turn = lambda matrix: jnp.swapaxes(matrix, 1, 2)  # noqa: E731
        return LinearSweep(turn(self.own), turn(self.impulse), turn(self.velocity))


def repeat_linear_sweeps(sweep: LinearSweep, body: Body, arm: Array, right: Array) -> Array:
    """The x that a linear sweep with these b leaves unchanged."""

    def pass_(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        before, moved, going = carry
        moved, after = lax.scan(partial(_take_linear_turn, body), moved, (sweep, arm, right, before))
        after = jnp.where(going, after, before)
        return after, moved, _find_changed_lanes(before, after)

    moved, going = jnp.zeros_like(join_momenta(arm, right)[0]), jnp.any(right != 0, axis=(0, 1), keepdims=True)
    return _repeat_until_settled(pass_, (jnp.zeros_like(right), moved, going))[0]


def _take_linear_turn(body: Body, moved: Array, point: tuple[LinearSweep, Array, Array, Array]) -> tuple[Array, Array]:
    """A linear sweep's turn of one point; `moved` `(6, lanes)` are the velocity and ω that the impulses give to the body."""
    sweep, *vectors = jax.tree.map(lambda part: part[None], point)
    arm, right, old = vectors
    v = find_point_velocities(arm, moved)
    new = multiply_columns(sweep.own, old) + multiply_columns(sweep.velocity, v) + right
    return moved + _find_change(body, arm, multiply_columns(sweep.impulse, new - old)), new[0]


def find_point_velocities(arm: Array, moved: Array) -> Array:
    """The velocities `(points, 3, lanes)` of points of a body that has this velocity and ω `(6, lanes)`."""
    return moved[None, :3] + _cross_one(moved[None, 3:], arm)


def _find_change(body: Body, arm: Array, impulse: Array) -> Array:
    """The velocity and ω `(6, lanes)` that an impulse at a single point gives to the body."""
    turned = multiply_columns(body.inverse_inertia[None], _cross_one(arm, impulse))
    return jnp.concatenate([(body.inverse_mass * impulse[0])[None], turned], axis=1)[0]


def sum_impulses(rows: PointRows, j: Array) -> Array:
    """The momentum and angular momentum `(6, lanes)` that all impulses together give to their body."""
    return jnp.sum(join_momenta(rows.arm, j), axis=0)


def sum_velocities(rows: PointRows, body: Body, j: Array) -> Array:
    """The velocity and ω `(6, lanes)` that all impulses together give to their body."""
    return jnp.concatenate(find_velocities(body, sum_impulses(rows, j)))


def join_momenta(arm: Array, j: Array) -> Array:
    """The momentum and angular momentum `(..., 6, lanes)` that an impulse at the end of an arm gives to its body."""
    return jnp.concatenate([j, cross(arm, j)], axis=-2)


def find_velocities(body: Body, given: Array) -> tuple[Array, Array]:
    """The velocity and ω, each `(3, lanes)`, of a body that is given these momenta `(6, lanes)`."""
    return body.inverse_mass * given[:3], multiply(body.inverse_inertia, given[3:])


def _dot_one(a: Array, b: Array) -> Array:
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def _cross_one(a: Array, b: Array) -> Array:
    return jnp.stack([a[:, i - 2] * b[:, i - 1] - a[:, i - 1] * b[:, i - 2] for i in range(3)], axis=1)


def multiply_columns(columns: Array, vector: Array) -> Array:
    """Matrices `(points, 3, 3, lanes)` by columns times vectors `(points, 3, lanes)`."""
    return columns[:, 0] * vector[:, 0:1] + columns[:, 1] * vector[:, 1:2] + columns[:, 2] * vector[:, 2:3]


def _norm_one(vector: Array) -> Array:
    return norm(jnp.moveaxis(vector, 1, -1))


def _project_across(normal: Array, vector: Array) -> Array:
    return vector - _dot_one(normal, vector)[:, None] * normal


def multiply(matrix: Array, vector: Array) -> Array:
    """Symmetric matrices `(..., 3, 3, lanes)` times vectors `(..., 3, lanes)`."""
    return _sum_components(matrix * vector[..., None, :, :])[..., 0, :]


def dot(a: Array, b: Array) -> Array:
    """Scalar products `(..., 1, lanes)`."""
    return _sum_components(a * b)


def _sum_components(vector: Array) -> Array:
    """The sum over the component, which stays as an axis of length 1; written out, since a reduction is slow on a CPU."""
    return vector[..., :1, :] + vector[..., 1:2, :] + vector[..., 2:, :]


def cross(a: Array, b: Array) -> Array:
    """Vector products."""
    (ax, ay, az), (bx, by, bz) = ([vector[..., i : i + 1, :] for i in range(3)] for vector in (a, b))
    return jnp.concatenate([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-2)
