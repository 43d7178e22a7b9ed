"""Impulses at the contact points of a body: normal ones that only push, friction within Coulomb's cone.

    v_k⁺ = b_k + Σ_l W_kl j_l,   W_kl = 1/m - [r_k] I⁻¹ [r_l],   λ_k >= 0 ⊥ n_k·v_k⁺ >= 0,   |j_t| <= μ λ

for the points k of a body, r from its center of mass, b the velocities before (M. Anitescu and F. Potra 1997). Projected
Gauss-Seidel, one point after the other, all lanes at once. Arrays of points are `(points, *lanes, ...)`.

Inside, the lanes are one axis, which is the last, `(points, 3, lanes)`: the long one that a processor reads in one go, so
that a sweep over a few points of many bodies has no short inner loops. Numbers have a component axis of length 1, and a
3×3 matrix is `(..., 3, 3, lanes)`: the same few operations for one vector, for all points, and for the columns of a matrix.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from physjax.backend import any_lane, bounded_while_loop
from physjax.physics.rigid.mobility import Mobility
from physjax.physics.rigid.spatial import RigidBodies
from physjax.vectors import add_leading_axes, norm

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


class Impact(NamedTuple):
    """What impulses made of bodies: their state, the normal impulse at each point [N s], and how much v and ω changed."""

    bodies: RigidBodies
    push: Float[Array, "points *lanes"]
    change: tuple[Float[Array, "*lanes 3"], Float[Array, "*lanes 3"]]


class _PointRows(NamedTuple):
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


def apply_contact_impulses(
    points: Points,
    active: Bool[Array, "points *lanes"],
    bodies: RigidBodies,
    mobility: Mobility,
    restitution: Float[Array, "points *lanes"] | None = None,
    struck: Bool[Array, "*lanes"] | None = None,
) -> Impact:
    """The bodies after the impulses at their active points.

    Bodies that are `struck` (all, with a `restitution`) collide: their impulses are multiplied by 1 + K_r (Poisson's
    rule; where points differ, by the mean weighted with their impulses), and friction is solved again with these normal
    ones. The others are only kept from going in.

    No impact adds energy, whatever the shape, the friction and the number of points: impulses j scaled by s change it
    by s b·j + s² j·Wj/2, which is not positive for s <= -2 b·j/(j·Wj), and s is cut to that. Where the inelastic problem
    is solved, b·j <= -j·Wj, so that 1 + K_r <= 2 is never cut. From there friction only lowers the energy, within discs
    that are fixed. (Newton's rule, for velocities, would add energy at a corner that slips.)
    """
    if restitution is not None and struck is None:
        struck = jnp.ones(bodies.lanes, bool)
    if struck is not None and points.friction is not None:
        # in an impact sticking is limited by μ_k as well: discs that shrink from μ_s to μ_k could add energy
        static, kinetic = points.friction
        points = points._replace(friction=(jnp.where(struck[None], kinetic, static), kinetic))
    body = _build_body(mobility)
    rows = _build_rows(points, active, body)
    bounce = None if restitution is None else _flatten_numbers(restitution)
    collides = None if struck is None else struck.reshape(1, -1)
    j = _solve_impulses(rows, body, bounce, collides)
    unflatten = lambda part: jnp.moveaxis(part.reshape(len(part), *bodies.lanes), 0, -1)  # noqa: E731
    given = _sum_impulses(rows, j)
    push, turn, faster, spun = map(unflatten, (given[:3], given[3:], *_find_velocities(body, given)))
    after = bodies._replace(momentum=bodies.momentum + push, angular_momentum=bodies.angular_momentum + turn)
    return Impact(after, _dot(rows.normal, j).reshape(active.shape), (faster, spun))


def _solve_impulses(rows: _PointRows, body: "_Body", restitution: Array | None, struck: Array | None) -> Array:
    """The impulses `(points, 3, lanes)`: those that just stop the points, and of bodies that are struck those of both phases.

    Compression is the inelastic problem. Expansion gives the same impulses again, times K_r as far as the energy allows,
    and then solves for friction with the normal impulses given.
    """
    active = jnp.any(rows.active, axis=0, keepdims=True)

    def scale_impulses(j: Array) -> Array:
        work, given = jnp.sum(rows.before * j, axis=(0, 1), keepdims=True), _sum_impulses(rows, j)
        square = jnp.sum(given * jnp.concatenate(_find_velocities(body, given)), axis=0)[None, None]
        wanted = jnp.ones_like(work)
        if restitution is not None:
            push = _dot(rows.normal, j)
            total = jnp.sum(push, axis=0, keepdims=True)
            wanted = 1 + jnp.sum(restitution * push, axis=0, keepdims=True) / jnp.where(total > 0, total, 1.0)
        return jnp.minimum(wanted, jnp.where(square > 0, -2.0 * work / jnp.where(square > 0, square, 1.0), 0.0)) * j

    zero = jnp.zeros_like(rows.before)
    if struck is None or rows.friction is None:
        return scale_impulses(_solve_fixed_point(rows, body, zero, active))

    # one loop over both phases: the sweeps, and all that their derivatives take, then stand in the program once
    def pass_phase(j: Array, expands: Array) -> tuple[Array, None]:
        known = struck & expands
        solved = _solve_fixed_point(
            _keep_normal_impulses(rows, known), body, j, active & (known[None] | ~expands), known
        )
        return jnp.where(expands, solved, scale_impulses(solved)), None

    return lax.scan(pass_phase, zero, jnp.array([False, True]))[0]


def _keep_normal_impulses(rows: _PointRows, known: Array) -> _PointRows:
    """The points with nothing that changes the normal impulses of the lanes in which these are known."""
    assert rows.inverse is not None
    assert rows.across is not None
    inverse = jnp.where(known[None, None], rows.across, rows.inverse)
    return rows._replace(share=jnp.where(known[None], 0.0, rows.share), inverse=inverse)


class _Body(NamedTuple):
    """1/m `(1, lanes)`, and R I⁻¹ Rᵀ `(3, 3, lanes)`."""

    inverse_mass: Array
    inverse_inertia: Array


def _build_body(mobility: Mobility) -> _Body:
    """The mobility in the layout of the sweeps."""
    return _Body(mobility.inverse_mass.reshape(1, -1), _flatten_vectors(jnp.stack(mobility.columns)))


def _flatten_vectors(vectors: Array) -> Array:
    """Vectors `(points, *lanes, 3)` as `(points, 3, lanes)`."""
    return jnp.moveaxis(vectors, -1, 1).reshape(len(vectors), 3, -1)


def _flatten_numbers(numbers: Array) -> Array:
    """Numbers `(points, *lanes)` as `(points, 1, lanes)`."""
    return numbers.reshape(len(numbers), 1, -1)


def _build_rows(points: Points, active: Array, body: _Body) -> _PointRows:
    """Each point's own mobility, and with friction its inverse: by cofactors, since K >= 1/m is never singular."""
    arm, normal, before = map(_flatten_vectors, points[:3])
    active = _flatten_numbers(active)
    if points.friction is None:
        stiffness = _dot(normal, _apply_point_mobility(body, arm, normal))
        return _PointRows(arm, normal, before, jnp.where(active, 1 / stiffness, 0.0), active)
    arms = jnp.broadcast_to(arm[:, None], (len(arm), 3, *arm.shape[1:]))
    axes = jnp.broadcast_to(jnp.eye(3, dtype=arm.dtype)[None, :, :, None], arms.shape)
    mobility = _apply_point_mobility(body, arms, axes)
    normal_response = _multiply(mobility, normal)
    stiffness = _dot(normal, normal_response)
    # of a symmetric matrix with columns a, b, c the cofactors are b × c, c × a, a × b
    cofactors = _cross(_shift_columns(mobility, 1), _shift_columns(mobility, 2))
    volume = _dot(mobility[:, 0], cofactors[:, 0])
    inverse = cofactors / volume[:, None]
    leaning = _multiply(inverse, normal)
    ease = _dot(normal, leaning)
    # the largest eigenvalue of K across the normal, from its trace and its determinant there, |K| n·K⁻¹n
    trace = mobility[:, 0, :1] + mobility[:, 1, 1:2] + mobility[:, 2, 2:]
    half = (trace - stiffness) / 2
    stiffest = half + jnp.sqrt(jnp.maximum(half * half - volume * ease, MIN_STIFFNESS_SQUARED))
    return _PointRows(
        arm,
        normal,
        before,
        share=jnp.where(active, 1 / stiffness, 0.0),
        active=active,
        inverse=inverse,
        # K⁻¹ - K⁻¹n (K⁻¹n)ᵀ/(n·K⁻¹n): it leaves the normal impulse as it is
        across=inverse - leaning[:, None] * (leaning / ease)[:, :, None],
        normal_response=normal_response,
        slip_mobility=1 / stiffest,
        friction=(_flatten_numbers(points.friction[0]), _flatten_numbers(points.friction[1])),
    )


def _solve_fixed_point(rows: _PointRows, body: _Body, start: Array, wanted: Array, known: Array | None = None) -> Array:
    """Impulses `(points, 3, lanes)` that a sweep over the points leaves unchanged, where `wanted` `(1, 1, lanes)`; else `start`.

    Their derivatives are those of a fixed point, by the implicit function theorem: a linear problem that is solved by
    sweeps as well, so that nothing is differentiated through the sweeps themselves. In the lanes that are `known` the
    normal impulses are those of `start`.
    """

    def residual(j: Array) -> Array:
        kept = j
        if known is not None:
            # no change in value, since sweeps keep them: the derivatives are then those of impulses that are known
            kept = j + jnp.where(known[None], _dot(rows.normal, start - j), 0.0) * rows.normal
        swept = _sweep_points(rows, body, kept, _sum_velocities(rows, body, kept))[0]
        return jnp.where(wanted, swept, start) - j

    def repeat_sweeps(_, j: Array) -> Array:
        # the velocity of the body is carried along, so that a point's turn costs no sum over the other points
        def pass_(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            before, moved_before, going = carry
            after, moved_after = _sweep_points(rows, body, before, moved_before)
            # a lane that has settled waits for the others without a change: its result does not depend on theirs
            after = jnp.where(going, after, before)
            return after, jnp.where(going[0], moved_after, moved_before), _find_changed_lanes(before, after)

        return _repeat_until_settled(pass_, (j, _sum_velocities(rows, body, j), wanted))[0]

    def solve_linear(change: Callable[[Array], Array], right: Array) -> Array:
        def pass_(carry: tuple[Array, Array]) -> tuple[Array, Array]:
            before, going = carry
            after = jnp.where(going, before + change(before) - right, before)
            return after, _find_changed_lanes(before, after)

        return _repeat_until_settled(pass_, (jnp.zeros_like(right), jnp.any(right != 0, axis=(0, 1), keepdims=True)))[0]

    solve = partial(lax.custom_linear_solve, solve=solve_linear, transpose_solve=solve_linear)
    return lax.custom_root(residual, start, repeat_sweeps, solve)


def _sweep_points(rows: _PointRows, body: _Body, j: Array, moved: Array) -> tuple[Array, Array]:
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


def _update_point(body: _Body, moved: Array, point: tuple[_PointRows, Array]) -> tuple[Array, Array]:
    """A sweep's turn of one point, the impulses at the others given: it sticks if it can, else it is pushed and slips.

    Sticking is the impulse that stops the point, if it is within the cone of μ_s. Slipping takes a step against the
    velocity across the normal, at most as long as the stiffest direction allows, and cuts it to the disc of μ_k.
    """
    row, old = point
    # vectors are (1, 3, lanes) here and numbers (1, lanes): the compiler then keeps what several components share
    arm, normal, before, old = (vector[None] for vector in (row.arm, row.normal, row.before, old))
    v = before + moved[None, :3] + _cross_one(moved[None, 3:], arm)
    pushed = _dot_one(normal, old)
    push = jnp.maximum(pushed - _dot_one(normal, v) * row.share, 0.0)
    new = push[:, None] * normal
    if row.friction is not None:
        assert row.inverse is not None
        assert row.normal_response is not None
        assert row.slip_mobility is not None
        static, kinetic = row.friction
        stick = old - _multiply_one(row.inverse[None], v)
        # the slip after this turn's normal impulse, which moves the point across the normal as well
        v = v + (push - pushed)[:, None] * row.normal_response[None]
        slip = _project_across(normal, old - row.slip_mobility[:, None] * v)
        size, most = _norm_one(slip), kinetic * push
        slip = jnp.where(size > most, most / jnp.where(size > 0, size, 1.0), 1.0)[:, None] * slip
        held = _dot_one(normal, stick)
        sticks = (held >= 0) & (_norm_one(_project_across(normal, stick)) <= static * held)
        new = jnp.where(row.active[:, None], jnp.where(sticks[:, None], stick, new + slip), 0.0)
    change = new - old
    turned = _multiply_one(body.inverse_inertia[None], _cross_one(arm, change))
    return moved + jnp.concatenate([(body.inverse_mass * change[0])[None], turned], axis=1)[0], new[0]


def _dot_one(a: Array, b: Array) -> Array:
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def _cross_one(a: Array, b: Array) -> Array:
    return jnp.stack([a[:, i - 2] * b[:, i - 1] - a[:, i - 1] * b[:, i - 2] for i in range(3)], axis=1)


def _multiply_one(columns: Array, vector: Array) -> Array:
    return columns[:, 0] * vector[:, 0:1] + columns[:, 1] * vector[:, 1:2] + columns[:, 2] * vector[:, 2:3]


def _norm_one(vector: Array) -> Array:
    return norm(jnp.moveaxis(vector, 1, -1))


def _project_across(normal: Array, vector: Array) -> Array:
    return vector - _dot_one(normal, vector)[:, None] * normal


def _sum_impulses(rows: _PointRows, j: Array) -> Array:
    """The momentum and angular momentum `(6, lanes)` that all impulses together give to their body."""
    return jnp.sum(_join_momenta(rows.arm, j), axis=0)


def _sum_velocities(rows: _PointRows, body: _Body, j: Array) -> Array:
    """The velocity and ω `(6, lanes)` that all impulses together give to their body."""
    return jnp.concatenate(_find_velocities(body, _sum_impulses(rows, j)))


def _join_momenta(arm: Array, j: Array) -> Array:
    """The momentum and angular momentum `(..., 6, lanes)` that an impulse at the end of an arm gives to its body."""
    return jnp.concatenate([j, _cross(arm, j)], axis=-2)


def _find_velocities(body: _Body, given: Array) -> tuple[Array, Array]:
    """The velocity and ω, each `(3, lanes)`, of a body that is given these momenta `(6, lanes)`."""
    return body.inverse_mass * given[:3], _multiply(body.inverse_inertia, given[3:])


def _apply_point_mobility(body: _Body, arm: Array, vector: Array) -> Array:
    """Kx: the velocity that an impulse x at a point gives to that point."""
    inverse_mass, inverse_inertia = (add_leading_axes(part, vector.ndim + i) for i, part in enumerate(body))
    return inverse_mass * vector + _cross(_multiply(inverse_inertia, _cross(arm, vector)), arm)


def _shift_columns(matrix: Array, by: int) -> Array:
    """Matrices `(points, 3, 3, lanes)` with column i + by in place of column i."""
    return jnp.concatenate([matrix[:, by:], matrix[:, :by]], axis=1)


def _multiply(matrix: Array, vector: Array) -> Array:
    """Symmetric matrices `(..., 3, 3, lanes)` times vectors `(..., 3, lanes)`."""
    return _sum_components(matrix * vector[..., None, :, :])[..., 0, :]


def _dot(a: Array, b: Array) -> Array:
    """Scalar products `(..., 1, lanes)`."""
    return _sum_components(a * b)


def _sum_components(vector: Array) -> Array:
    """The sum over the component, which stays as an axis of length 1; written out, since a reduction is slow on a CPU."""
    return vector[..., :1, :] + vector[..., 1:2, :] + vector[..., 2:, :]


def _cross(a: Array, b: Array) -> Array:
    """Vector products."""
    (ax, ay, az), (bx, by, bz) = ([vector[..., i : i + 1, :] for i in range(3)] for vector in (a, b))
    return jnp.concatenate([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-2)
