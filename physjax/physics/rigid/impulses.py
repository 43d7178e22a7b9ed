"""Impulses at the points where a body touches: normal ones that only push, friction within Coulomb's cone.

    v_k⁺ = b_k + Σ_l W_kl j_l,   W_kl = 1/m - [r_k] I⁻¹ [r_l],   λ_k >= 0 ⊥ n_k·v_k⁺ >= 0,   |j_t| <= μ λ

for the points k of a body, r from its centre of mass, b the velocities before (M. Anitescu and F. Potra 1997). Projected
Gauss-Seidel, one point after the other, all lanes at once. Arrays of points are `(points, *lanes, ...)`.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from physjax.backend import any_lane, bounded_while_loop
from physjax.linear import build_cofactors
from physjax.physics.rigid.inertia import Inertia
from physjax.physics.rigid.spatial import RigidBodies, apply_inverse_inertia
from physjax.vectors import cross, dot, norm

MAX_SWEEPS = 256
"""The most passes over all points. A point alone needs two, a box on its face about twenty, at the
edge of what friction can hold a hundred."""


class Points(NamedTuple):
    """Where bodies touch: arms r [m], normals, velocities before [m/s], μ_s and μ_k (None: no friction anywhere)."""

    arm: Float[Array, "points *lanes 3"]
    normal: Float[Array, "points *lanes 3"]
    velocity: Float[Array, "points *lanes 3"]
    friction: tuple[Float[Array, "points *lanes"], Float[Array, "points *lanes"]] | None


class _PointRows(NamedTuple):
    """Each point's own answer K = W_kk: what the sweeps need of it. Vectors are `(points, 3, *lanes)`, without friction None.

    `share` is 1/(n·Kn) of points that take part, else 0; `back` K⁻¹, `normal_response` Kn, `push_direction` K⁻¹n/(n·K⁻¹n), `slip_mobility` one over
    the stiffest way across the normal. With `push` the normal impulses are given, and only friction is looked for.
    """

    arm: Array
    normal: Array
    before: Array
    share: Array
    inverse: Array | None = None
    normal_response: Array | None = None
    push_direction: Array | None = None
    slip_mobility: Array | None = None
    friction: tuple[Array, Array] | None = None
    push: Array | None = None


def apply_contact_impulses(
    points: Points,
    active: Bool[Array, "points *lanes"],
    bodies: RigidBodies,
    inertia: Inertia,
    restitution: Float[Array, "points *lanes"] | None = None,
) -> tuple[RigidBodies, Float[Array, "points *lanes"]]:
    """The bodies after the impulses at their active points, and the normal impulse at each [N s].

    Without `restitution` the impact is perfectly inelastic. Else its impulses are multiplied by 1 + K_r (Poisson's rule;
    where points differ, by the mean of those that push), then friction takes what it can with these normal ones.

    No impact adds energy, whatever the shape, the friction and the number of points: impulses j scaled by s change it
    by s b·j + s² j·Wj/2, which is not positive for s <= -2 b·j/(j·Wj), and beyond that s is cut. Where the inelastic
    problem is solved, b·j <= -j·Wj, and 1 + K_r <= 2 is never cut. From there friction only goes down in energy, within
    discs that are fixed. (Newton's rule, for velocities, would add energy at a corner that slips.)
    """
    if restitution is not None and points.friction is not None:
        # in an impact what sticks must do so by μ_k too: discs that shrink afterwards could give energy
        points = points._replace(friction=(points.friction[1],) * 2)
    body = _build_body(bodies, inertia)
    rows = _build_rows(points, active, body)
    j = _solve_fixed_point(rows, body, jnp.zeros_like(rows.before))
    response = _point_velocity(rows, _sum_body_changes(rows, body, j)[None])
    work, square = (jnp.sum(part * j, axis=(0, 1)) for part in (rows.before, response))
    wanted = jnp.ones_like(work)
    if restitution is not None:
        push = _dot(rows.normal, j)
        total = jnp.sum(push, axis=0)
        wanted = 1 + jnp.sum(restitution * push, axis=0) / jnp.where(total > 0, total, 1.0)
    share = jnp.minimum(wanted, jnp.where(square > 0, -2.0 * work / jnp.where(square > 0, square, 1.0), 0.0))
    j = share[None, None] * j
    if restitution is not None and points.friction is not None:
        j = _solve_fixed_point(rows._replace(push=_dot(rows.normal, j)), body, j)
    push = jnp.moveaxis(j, 1, -1)
    given = jnp.sum(push, axis=0), jnp.sum(cross(points.arm, push), axis=0)
    momenta = bodies.momentum + given[0], bodies.angular_momentum + given[1]
    return RigidBodies(bodies.position, bodies.orientation, *momenta), dot(push, points.normal)


class _Body(NamedTuple):
    """1/m `(1, 1, *lanes)`, and R I⁻¹ Rᵀ `(1, 3, 3, *lanes)`."""

    inverse_mass: Array
    inverse_inertia: Array


def _build_body(bodies: RigidBodies, inertia: Inertia) -> _Body:
    axes = jnp.eye(3, dtype=bodies.dtype).reshape(3, *(1,) * len(bodies.lanes), 3)
    axes = jnp.broadcast_to(axes, (3, *bodies.position.shape))
    inverse_inertia = _move_component_second(jax.vmap(lambda axis: apply_inverse_inertia(bodies, inertia, axis))(axes))
    return _Body(jnp.broadcast_to(1 / inertia.mass, (1, 1, *bodies.lanes)), inverse_inertia[None])


def _move_component_second(vectors: Array) -> Array:
    """Vectors with their component in the second axis instead of the last."""
    return jnp.moveaxis(vectors, -1, 1)


def _build_rows(points: Points, active: Array, body: _Body) -> _PointRows:
    arm, normal, before = (_move_component_second(vector) for vector in points[:3])
    normal_response = _apply_point_mobility(body, arm, normal)
    stiffness = _dot(normal, normal_response)
    rows = _PointRows(arm, normal, before, jnp.where(active, 1 / stiffness, 0.0))
    if points.friction is None:
        return rows
    axes = jnp.eye(3, dtype=arm.dtype).reshape(3, 1, 3, *(1,) * (arm.ndim - 2))
    columns = jnp.stack([_apply_point_mobility(body, arm, jnp.broadcast_to(axis, arm.shape)) for axis in axes], axis=1)
    cofactors = build_cofactors([[columns[:, i, j] for j in range(3)] for i in range(3)])
    minors = jnp.stack([jnp.stack(row, axis=1) for row in cofactors], axis=1)
    volume = _dot(columns[:, 0], minors[:, 0])
    inverse = minors / volume[:, None, None]
    leaning = _multiply(inverse, normal)
    ease = _dot(normal, leaning)
    # of K across the normal: its trace, and its determinant, |K| n·K⁻¹n
    half = (columns[:, 0, 0] + columns[:, 1, 1] + columns[:, 2, 2] - stiffness) / 2
    stiffest = half + jnp.sqrt(jnp.maximum(half * half - volume * ease, 1e-30))
    return rows._replace(
        inverse=inverse,
        normal_response=normal_response,
        push_direction=leaning / ease[:, None],
        slip_mobility=1 / stiffest,
        friction=points.friction,
    )


def _solve_fixed_point(rows: _PointRows, body: _Body, start: Array) -> Array:
    """Impulses `(points, 3, *lanes)` that a sweep over the points leaves as they are.

    They move with the rows as a fixed point does: a linear problem, swept alike, so that no derivative follows the sweeps.
    """

    def left(j):
        return _sweep_points(rows, body, j)[0] - j

    def swept(_, j):
        moved = _sum_body_changes(rows, body, j)

        def pass_(carry):
            after, moved = _sweep_points(rows, body, carry[0], carry[1])
            return after, moved, _find_changed_lanes(carry[0], after)

        return _repeat_until_settled(pass_, (j, moved, jnp.any(rows.share > 0, axis=0)))[0]

    def solve_linear(change, right):
        def pass_(carry):
            after = carry[0] + change(carry[0]) - right
            return after, _find_changed_lanes(carry[0], after)

        return _repeat_until_settled(pass_, (jnp.zeros_like(right), jnp.any(right != 0, axis=(0, 1))))[0]

    solve = partial(lax.custom_linear_solve, solve=solve_linear, transpose_solve=solve_linear)
    return lax.custom_root(left, start, swept, solve)


def _sweep_points(rows: _PointRows, body: _Body, j: Array, moved: Array | None = None) -> tuple[Array, Array]:
    """The impulses after every point had its turn, and the velocity and ω `(6, *lanes)` that they give."""
    moved = _sum_body_changes(rows, body, j) if moved is None else moved
    moved, after = lax.scan(partial(_update_point, body), moved, (rows, j))
    return after, moved


def _find_changed_lanes(before: Array, after: Array) -> Array:
    """Which lanes a pass changes by more than rounding."""
    change, size = (jnp.sum(jnp.abs(part), axis=(0, 1)) for part in (after - before, after))
    return change > 256 * float(jnp.finfo(after.dtype).eps) * size


def _repeat_until_settled(pass_: Callable, start: tuple) -> tuple:
    """Passes until the last part of what they carry, the lanes that they change, is empty."""
    return bounded_while_loop(lambda carry: any_lane(carry[-1]), pass_, start, most=MAX_SWEEPS)


def _update_point(body: _Body, moved: Array, point: tuple[_PointRows, Array]) -> tuple[Array, Array]:
    """One point's turn, given what the others do: it sticks if it can, else it is pushed and slips."""
    row, old = jax.tree.map(lambda part: part[None], point)
    v, pushed = row.before + _point_velocity(row, moved[None]), _dot(row.normal, old)
    push = jnp.maximum(pushed - _dot(row.normal, v) * row.share, 0.0) if row.push is None else row.push
    new = push[:, None] * row.normal
    if row.friction is not None:
        static, kinetic = row.friction
        stick = old - _multiply(row.inverse, v)
        if row.push is not None:
            stick, static = stick + (push - _dot(row.normal, stick))[:, None] * row.push_direction, kinetic
        v = v + (push - pushed)[:, None] * row.normal_response
        slip = _project_across(row.normal, old - row.slip_mobility[:, None] * v)
        size, most = _norm(slip), kinetic * push
        slip = jnp.where(size > most, most / jnp.where(size > 0, size, 1.0), 1.0)[:, None] * slip
        held = _dot(row.normal, stick)
        sticks = (held >= 0) & (_norm(_project_across(row.normal, stick)) <= static * held)
        new = jnp.where((row.share > 0)[:, None], jnp.where(sticks[:, None], stick, new + slip), 0.0)
    return moved + _compute_body_changes(row, body, new - old)[0], new[0]


def _sum_body_changes(rows: _PointRows, body: _Body, j: Array) -> Array:
    """The velocity and ω `(6, *lanes)` that all the impulses give to their body."""
    return jnp.sum(_compute_body_changes(rows, body, j), axis=0)


def _compute_body_changes(rows: _PointRows, body: _Body, j: Array) -> Array:
    """The velocity and ω `(points, 6, *lanes)` that each impulse gives."""
    return jnp.concatenate([body.inverse_mass * j, _multiply(body.inverse_inertia, _cross(rows.arm, j))], axis=1)


def _point_velocity(rows: _PointRows, moved: Array) -> Array:
    """What velocity and ω `(1, 6, *lanes)` give to the points."""
    return moved[:, :3] + _cross(jnp.broadcast_to(moved[:, 3:], rows.arm.shape), rows.arm)


def _apply_point_mobility(body: _Body, arm: Array, vector: Array) -> Array:
    """Kx: the velocity that an impulse x at a point gives to it."""
    return body.inverse_mass * vector + _cross(_multiply(body.inverse_inertia, _cross(arm, vector)), arm)


def _multiply(columns: Array, vector: Array) -> Array:
    """A symmetric matrix `(points, 3, 3, *lanes)` times vectors."""
    return sum(columns[:, i] * vector[:, i : i + 1] for i in range(3))


def _dot(a: Array, b: Array) -> Array:
    """Scalar products of vectors with the component second."""
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def _cross(a: Array, b: Array) -> Array:
    return jnp.stack([a[:, i - 2] * b[:, i - 1] - a[:, i - 1] * b[:, i - 2] for i in range(3)], axis=1)


def _project_across(normal: Array, vector: Array) -> Array:
    return vector - _dot(normal, vector)[:, None] * normal


def _norm(vector: Array) -> Array:
    return norm(jnp.moveaxis(vector, 1, -1))
