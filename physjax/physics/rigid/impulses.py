"""Impulses at the contact points of a body: normal ones that only push, friction within Coulomb's cone.

    v_k⁺ = b_k + Σ_l W_kl j_l,   W_kl = 1/m - [r_k] I⁻¹ [r_l],   λ_k >= 0 ⊥ n_k·v_k⁺ >= 0,   |j_t| <= μ λ

for the points k of a body, r from its center of mass, b the velocities before (M. Anitescu and F. Potra 1997). Projected
Gauss-Seidel, one point after the other, all lanes at once. Arrays of points are `(points, *lanes, ...)`.

Inside, the component comes second, `(points, 3, *lanes)`: the lanes are then the long last axis that a processor reads
in one go, and a sweep over a few points of many bodies has no short inner loops.
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
from physjax.particles import sum_terms
from physjax.physics.rigid.inertia import Inertia
from physjax.physics.rigid.spatial import RigidBodies, apply_inverse_inertia
from physjax.vectors import cross, dot, norm

MAX_SWEEPS = 256
"""Most sweeps over all points: a single point needs two, a box on its face about twenty, near sliding a hundred."""
SWEEP_ROUNDING = 256
"""Units of rounding of the impulses below which a sweep changes nothing."""
MIN_STIFFNESS_SQUARED = 1e-30
"""Smallest value under a square root that vanishes where a point is equally stiff across the normal [1/kg²]."""


class Points(NamedTuple):
    """Contact points: arms r [m], normals, velocities before [m/s], and μ_s, μ_k (None: no friction anywhere)."""

    arm: Float[Array, "points *lanes 3"]
    normal: Float[Array, "points *lanes 3"]
    velocity: Float[Array, "points *lanes 3"]
    friction: tuple[Float[Array, "points *lanes"], Float[Array, "points *lanes"]] | None


class _PointRows(NamedTuple):
    """What the sweeps need of each point's own mobility K = W_kk; vectors are `(points, 3, *lanes)`.

    `share` is 1/(n·Kn) of active points, else 0. With friction also `inverse` K⁻¹, `normal_response` Kn,
    `push_direction` K⁻¹n/(n·K⁻¹n), and `slip_mobility`, one over the largest eigenvalue of K across the normal. With
    `push` the normal impulses are given [N s], and only friction is solved for.
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
    where points differ, by the mean weighted with their impulses), and friction is solved again with these normal ones.

    No impact adds energy, whatever the shape, the friction and the number of points: impulses j scaled by s change it
    by s b·j + s² j·Wj/2, which is not positive for s <= -2 b·j/(j·Wj), and s is cut to that. Where the inelastic problem
    is solved, b·j <= -j·Wj, so that 1 + K_r <= 2 is never cut. From there friction only lowers the energy, within discs
    that are fixed. (Newton's rule, for velocities, would add energy at a corner that slips.)
    """
    if restitution is not None and points.friction is not None:
        # in an impact sticking is limited by μ_k as well: discs that shrink from μ_s to μ_k could add energy
        points = points._replace(friction=(points.friction[1],) * 2)
    body = _build_body(bodies, inertia)
    rows = _build_rows(points, active, body)
    # compression: the impulses that just stop the points from going in
    j = _solve_fixed_point(rows, body, jnp.zeros_like(rows.before))
    response = _point_velocity(rows, _sum_body_changes(rows, body, j)[None])
    work, square = (jnp.sum(part * j, axis=(0, 1)) for part in (rows.before, response))
    # expansion: the same impulses again, times K_r, as far as the energy allows
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
    """Inverse mass and inertia in the layout of the sweeps: the tensor's columns are what it makes of the three axes."""
    axes = jnp.eye(3, dtype=bodies.dtype).reshape(3, *(1,) * len(bodies.lanes), 3)
    axes = jnp.broadcast_to(axes, (3, *bodies.position.shape))
    inverse_inertia = _move_component_second(jax.vmap(lambda axis: apply_inverse_inertia(bodies, inertia, axis))(axes))
    return _Body(jnp.broadcast_to(1 / inertia.mass, (1, 1, *bodies.lanes)), inverse_inertia[None])


def _move_component_second(vectors: Array) -> Array:
    """Vectors with their component in the second axis instead of the last."""
    return jnp.moveaxis(vectors, -1, 1)


def _build_rows(points: Points, active: Array, body: _Body) -> _PointRows:
    """Each point's own mobility, and with friction its inverse: by cofactors, since K >= 1/m is never singular."""
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
    # the largest eigenvalue of K across the normal, from its trace and its determinant there, |K| n·K⁻¹n
    half = (columns[:, 0, 0] + columns[:, 1, 1] + columns[:, 2, 2] - stiffness) / 2
    stiffest = half + jnp.sqrt(jnp.maximum(half * half - volume * ease, MIN_STIFFNESS_SQUARED))
    return rows._replace(
        inverse=inverse,
        normal_response=normal_response,
        push_direction=leaning / ease[:, None],
        slip_mobility=1 / stiffest,
        friction=points.friction,
    )


def _solve_fixed_point(rows: _PointRows, body: _Body, start: Array) -> Array:
    """Impulses `(points, 3, *lanes)` that a sweep over the points leaves unchanged.

    Their derivatives are those of a fixed point, by the implicit function theorem: a linear problem that is solved by
    sweeps as well, so that nothing is differentiated through the sweeps themselves.
    """

    def residual(j: Array) -> Array:
        return _sweep_points(rows, body, j)[0] - j

    def repeat_sweeps(_, j: Array) -> Array:
        # the velocity of the body is carried along, so that a point's turn costs no sum over the other points
        moved = _sum_body_changes(rows, body, j)

        def pass_(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            after, moved = _sweep_points(rows, body, carry[0], carry[1])
            return after, moved, _find_changed_lanes(carry[0], after)

        return _repeat_until_settled(pass_, (j, moved, jnp.any(rows.share > 0, axis=0)))[0]

    def solve_linear(change: Callable[[Array], Array], right: Array) -> Array:
        def pass_(carry: tuple[Array, Array]) -> tuple[Array, Array]:
            after = carry[0] + change(carry[0]) - right
            return after, _find_changed_lanes(carry[0], after)

        return _repeat_until_settled(pass_, (jnp.zeros_like(right), jnp.any(right != 0, axis=(0, 1))))[0]

    solve = partial(lax.custom_linear_solve, solve=solve_linear, transpose_solve=solve_linear)
    return lax.custom_root(residual, start, repeat_sweeps, solve)


def _sweep_points(rows: _PointRows, body: _Body, j: Array, moved: Array | None = None) -> tuple[Array, Array]:
    """The impulses after one sweep over the points, and the velocity and ω `(6, *lanes)` that they give to the body."""
    moved = _sum_body_changes(rows, body, j) if moved is None else moved
    # one after the other: points that took their turns at once would overshoot where they share a load
    moved, after = lax.scan(partial(_update_point, body), moved, (rows, j))
    return after, moved


def _find_changed_lanes(before: Array, after: Array) -> Array:
    """Which lanes a sweep changes by more than rounding."""
    change, size = (jnp.sum(jnp.abs(part), axis=(0, 1)) for part in (after - before, after))
    return change > SWEEP_ROUNDING * float(jnp.finfo(after.dtype).eps) * size


def _repeat_until_settled(pass_: Callable[[tuple], tuple], start: tuple) -> tuple:
    """Sweeps until no lane changes any more; which lanes do is the last part of the carry."""
    return bounded_while_loop(lambda carry: any_lane(carry[-1]), pass_, start, most=MAX_SWEEPS)


def _update_point(body: _Body, moved: Array, point: tuple[_PointRows, Array]) -> tuple[Array, Array]:
    """A sweep's turn of one point, the impulses at the others given: it sticks if it can, else it is pushed and slips.

    Sticking is the impulse that stops the point, if it is within the cone of μ_s. Slipping takes a step against the
    velocity across the normal, at most as long as the stiffest direction allows, and cuts it to the disc of μ_k.
    """
    row, old = jax.tree.map(lambda part: part[None], point)
    v, pushed = row.before + _point_velocity(row, moved[None]), _dot(row.normal, old)
    push = jnp.maximum(pushed - _dot(row.normal, v) * row.share, 0.0) if row.push is None else row.push
    new = push[:, None] * row.normal
    if row.friction is not None:
        static, kinetic = row.friction
        stick = old - _multiply(row.inverse, v)
        if row.push is not None:
            # the normal impulse is given: the sticking impulse of that size, which leaves a normal velocity
            stick, static = stick + (push - _dot(row.normal, stick))[:, None] * row.push_direction, kinetic
        # the slip after this turn's normal impulse, which moves the point across the normal as well
        v = v + (push - pushed)[:, None] * row.normal_response
        slip = _project_across(row.normal, old - row.slip_mobility[:, None] * v)
        size, most = _norm(slip), kinetic * push
        slip = jnp.where(size > most, most / jnp.where(size > 0, size, 1.0), 1.0)[:, None] * slip
        held = _dot(row.normal, stick)
        sticks = (held >= 0) & (_norm(_project_across(row.normal, stick)) <= static * held)
        new = jnp.where((row.share > 0)[:, None], jnp.where(sticks[:, None], stick, new + slip), 0.0)
    return moved + _compute_body_changes(row, body, new - old)[0], new[0]


def _sum_body_changes(rows: _PointRows, body: _Body, j: Array) -> Array:
    """The velocity and ω `(6, *lanes)` that all impulses together give to their body."""
    return jnp.sum(_compute_body_changes(rows, body, j), axis=0)


def _compute_body_changes(rows: _PointRows, body: _Body, j: Array) -> Array:
    """The velocity and ω `(points, 6, *lanes)` that each impulse gives to its body."""
    return jnp.concatenate([body.inverse_mass * j, _multiply(body.inverse_inertia, _cross(rows.arm, j))], axis=1)


def _point_velocity(rows: _PointRows, moved: Array) -> Array:
    """The velocity of the points of a body with this velocity and ω `(1, 6, *lanes)`."""
    return moved[:, :3] + _cross(jnp.broadcast_to(moved[:, 3:], rows.arm.shape), rows.arm)


def _apply_point_mobility(body: _Body, arm: Array, vector: Array) -> Array:
    """Kx: the velocity that an impulse x at a point gives to that point."""
    return body.inverse_mass * vector + _cross(_multiply(body.inverse_inertia, _cross(arm, vector)), arm)


def _multiply(columns: Array, vector: Array) -> Array:
    """A symmetric matrix `(points, 3, 3, *lanes)` times vectors."""
    return sum_terms([columns[:, i] * vector[:, i : i + 1] for i in range(3)])


def _dot(a: Array, b: Array) -> Array:
    """Scalar products of vectors with the component in the second axis."""
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def _cross(a: Array, b: Array) -> Array:
    """Vector products of vectors with the component in the second axis."""
    return jnp.stack([a[:, i - 2] * b[:, i - 1] - a[:, i - 1] * b[:, i - 2] for i in range(3)], axis=1)


def _project_across(normal: Array, vector: Array) -> Array:
    return vector - _dot(normal, vector)[:, None] * normal


def _norm(vector: Array) -> Array:
    return norm(jnp.moveaxis(vector, 1, -1))
