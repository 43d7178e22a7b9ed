"""Impulses at the contact points of a body: normal ones that only push, friction within Coulomb's cone.

    v_k⁺ = b_k + Σ_l W_kl j_l,   W_kl = 1/m - [r_k] I⁻¹ [r_l],   λ_k >= 0 ⊥ n_k·v_k⁺ >= 0,   |j_t| <= μ λ

for the points k of a body, r from its center of mass, b the velocities before (M. Anitescu and F. Potra 1997). Projected
Gauss-Seidel, one point after the other, all lanes at once. Arrays of points are `(points, *lanes, ...)`.

Inside, the lanes are one axis, which is the last, `(points, 3, lanes)`: the long one that a processor reads in one go, so
that a sweep over a few points of many bodies has no short inner loops. Numbers have a component axis of length 1, and a
3×3 matrix is `(..., 3, 3, lanes)`: the same few operations for one vector, for all points, and for the columns of a matrix.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from physjax.physics.rigid.mobility import Mobility
from physjax.physics.rigid.spatial import RigidBodies
from physjax.physics.rigid.sweeps import (
    Body,
    LinearSweep,
    PointRows,
    cross,
    dot,
    find_point_velocities,
    find_velocities,
    multiply,
    multiply_columns,
    repeat_linear_sweeps,
    repeat_sweeps,
    squeeze_numbers,
    sum_impulses,
    sum_velocities,
    update_points,
)
from physjax.vectors import add_leading_axes

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
    j = _find_impulses(rows, body, bounce, collides).end
    unflatten = lambda part: jnp.moveaxis(part.reshape(len(part), *bodies.lanes), 0, -1)  # noqa: E731
    given = sum_impulses(rows, j)
    push, turn, faster, spun = map(unflatten, (given[:3], given[3:], *find_velocities(body, given)))
    after = bodies._replace(momentum=bodies.momentum + push, angular_momentum=bodies.angular_momentum + turn)
    return Impact(after, dot(rows.normal, j).reshape(active.shape), (faster, spun))


class _Phases(NamedTuple):
    """The phases of a collision, along the first axis: the impulses that each began with and solved for; and the last ones."""

    starts: Array
    solved: Array
    end: Array


class _Phase(NamedTuple):
    """A phase of a collision: its points, the lanes that it solves for, and those whose normal impulses are known."""

    rows: PointRows
    wanted: Array
    known: Array | None

    @classmethod
    def of(cls, rows: PointRows, struck: Array | None, expands: Array | bool) -> "_Phase":
        active = jnp.any(rows.active, axis=0, keepdims=True)
        if struck is None or rows.friction is None:
            return cls(rows, active, None)
        known = struck & expands
        return cls(_keep_normal_impulses(rows, known), active & (known[None] | ~jnp.asarray(expands)), known)


@jax.custom_jvp
def _find_impulses(rows: PointRows, body: Body, restitution: Array | None, struck: Array | None) -> _Phases:
    """The impulses `(points, 3, lanes)`: those that just stop the points, and of bodies that are struck those of both phases.

    Compression is the inelastic problem. Expansion gives the same impulses again, times K_r as far as the energy allows,
    and then solves for friction with the normal impulses given.
    """

    # one loop over both phases: the sweeps then stand in the program once
    def pass_phase(start: Array, expands: Array | bool) -> tuple[Array, tuple[Array, Array]]:
        phase = _Phase.of(rows, struck, expands)
        solved = repeat_sweeps(phase.rows, body, start, phase.wanted)
        return _end_phase(rows, body, restitution, solved, expands), (start, solved)

    zero = jnp.zeros_like(rows.before)
    if struck is None or rows.friction is None:
        end, (start, solved) = pass_phase(zero, False)
        return _Phases(start[None], solved[None], end)
    end, phases = lax.scan(pass_phase, zero, jnp.array([False, True]))
    return _Phases(*phases, end)


@_find_impulses.defjvp
def _push_impulses(primals: tuple, tangents: tuple) -> tuple[_Phases, _Phases]:
    """What changes impulses: the implicit function theorem for each phase, one after the other."""
    rows, body, restitution, struck = primals
    phases = _find_impulses(*primals)

    @jax.checkpoint  # what reverse mode needs of a phase is sooner computed again than stored for each
    def push_phase(changes: tuple, change: Array, phase: tuple[Array, Array, Array | bool]) -> tuple[Array, Array]:
        (start, solved, expands), (d_rows, d_body, d_restitution) = phase, changes
        turn = lambda rows, body, start: _turn_points(_Phase.of(rows, struck, expands), body, start, solved)  # noqa: E731
        right = jax.jvp(turn, (rows, body, start), (d_rows, d_body, change))[1]
        moved = _solve_linear(_Phase.of(rows, struck, expands), body, start, solved, right)
        end = lambda rows, body, restitution, j: _end_phase(rows, body, restitution, j, expands)  # noqa: E731
        return jax.jvp(end, (rows, body, restitution, solved), (d_rows, d_body, d_restitution, moved))[1], moved

    def go_on(change: Array, phase: tuple) -> tuple[Array, tuple[Array, Array]]:
        after, moved = push_phase(tangents[:3], change, phase)
        return after, (change, moved)

    zero = jnp.zeros_like(rows.before)
    if len(phases.solved) == 1:
        end, (start, solved) = go_on(zero, (phases.starts[0], phases.solved[0], False))
        return phases, _Phases(start[None], solved[None], end)
    end, changes = lax.scan(go_on, zero, (phases.starts, phases.solved, jnp.array([False, True])))
    return phases, _Phases(*changes, end)


def _end_phase(rows: PointRows, body: Body, restitution: Array | None, j: Array, expands: Array | bool) -> Array:
    """The impulses after a phase; at the end of compression as far as they may go on, by Poisson's rule and the energy."""
    work, given = jnp.sum(rows.before * j, axis=(0, 1), keepdims=True), sum_impulses(rows, j)
    square = jnp.sum(given * jnp.concatenate(find_velocities(body, given)), axis=0)[None, None]
    wanted = jnp.ones_like(work)
    if restitution is not None:
        push = dot(rows.normal, j)
        total = jnp.sum(push, axis=0, keepdims=True)
        wanted = 1 + jnp.sum(restitution * push, axis=0, keepdims=True) / jnp.where(total > 0, total, 1.0)
    most = jnp.where(square > 0, -2.0 * work / jnp.where(square > 0, square, 1.0), 0.0)
    return jnp.where(expands, j, jnp.minimum(wanted, most) * j)


def _keep_normal_impulses(rows: PointRows, known: Array) -> PointRows:
    """The points with nothing that changes the normal impulses of the lanes in which these are known."""
    assert rows.inverse is not None
    assert rows.across is not None
    inverse = jnp.where(known[None, None], rows.across, rows.inverse)
    return rows._replace(share=jnp.where(known[None], 0.0, rows.share), inverse=inverse)


def _build_body(mobility: Mobility) -> Body:
    """The mobility in the layout of the sweeps."""
    return Body(mobility.inverse_mass.reshape(1, -1), _flatten_vectors(jnp.stack(mobility.columns)))


def _flatten_vectors(vectors: Array) -> Array:
    """Vectors `(points, *lanes, 3)` as `(points, 3, lanes)`."""
    return jnp.moveaxis(vectors, -1, 1).reshape(len(vectors), 3, -1)


def _flatten_numbers(numbers: Array) -> Array:
    """Numbers `(points, *lanes)` as `(points, 1, lanes)`."""
    return numbers.reshape(len(numbers), 1, -1)


def _build_rows(points: Points, active: Array, body: Body) -> PointRows:
    """Each point's own mobility, and with friction its inverse: by cofactors, since K >= 1/m is never singular."""
    arm, normal, before = map(_flatten_vectors, points[:3])
    active = _flatten_numbers(active)
    if points.friction is None:
        stiffness = dot(normal, _apply_point_mobility(body, arm, normal))
        return PointRows(arm, normal, before, jnp.where(active, 1 / stiffness, 0.0), active)
    arms = jnp.broadcast_to(arm[:, None], (len(arm), 3, *arm.shape[1:]))
    axes = jnp.broadcast_to(jnp.eye(3, dtype=arm.dtype)[None, :, :, None], arms.shape)
    mobility = _apply_point_mobility(body, arms, axes)
    normal_response = multiply(mobility, normal)
    stiffness = dot(normal, normal_response)
    # of a symmetric matrix with columns a, b, c the cofactors are b × c, c × a, a × b
    cofactors = cross(_shift_columns(mobility, 1), _shift_columns(mobility, 2))
    volume = dot(mobility[:, 0], cofactors[:, 0])
    inverse = cofactors / volume[:, None]
    leaning = multiply(inverse, normal)
    ease = dot(normal, leaning)
    # the largest eigenvalue of K across the normal, from its trace and its determinant there, |K| n·K⁻¹n
    trace = mobility[:, 0, :1] + mobility[:, 1, 1:2] + mobility[:, 2, 2:]
    half = (trace - stiffness) / 2
    stiffest = half + jnp.sqrt(jnp.maximum(half * half - volume * ease, MIN_STIFFNESS_SQUARED))
    return PointRows(
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


def _turn_points(phase: _Phase, body: Body, start: Array, j: Array, v: Array | None = None) -> Array:
    """What all points make at once of impulses j that the sweeps leave unchanged, at velocities v: the same, but for derivatives.

    In lanes whose normal impulses are known these are those of `start`.
    """
    rows, kept = phase.rows, j
    if phase.known is not None:
        kept = j + jnp.where(phase.known[None], dot(rows.normal, start - j), 0.0) * rows.normal
    if v is None:
        v = rows.before + find_point_velocities(rows.arm, sum_velocities(rows, body, kept))
    return jnp.where(phase.wanted, update_points(squeeze_numbers(rows), kept, v), start)


def _solve_linear(phase: _Phase, body: Body, start: Array, j: Array, right: Array) -> Array:
    """The x with x = P x + Q v(R x) + right: how impulses j change if what `_turn_points` makes of them does so by `right`.

    Solved by sweeps like those for the impulses themselves; where several impulses do the same to the body, any will do.
    """
    rows = phase.rows
    v = rows.before + find_point_velocities(rows.arm, sum_velocities(rows, body, j))
    turn = lambda j, v: _turn_points(phase, body, start, j, v)  # noqa: E731
    axes = jnp.broadcast_to(jnp.eye(3, dtype=j.dtype).reshape(3, 1, 3, 1), (3, *j.shape))
    none = jnp.zeros_like(axes)
    along = lambda *axis: jax.jvp(turn, (j, v), axis)[1]  # noqa: E731
    columns = jax.vmap(along)(jnp.concatenate([axes, none]), jnp.concatenate([none, axes]))
    own, velocity, impulse = (jnp.moveaxis(part, 0, 1) for part in (columns[:3], columns[3:], axes))
    if phase.known is not None:
        normal = jnp.where(phase.known[None], rows.normal, 0.0)
        impulse = impulse - normal[:, :, None] * normal[:, None]
    sweep = LinearSweep(own, velocity, impulse)

    def leave(x: Array) -> Array:
        gives = find_point_velocities(rows.arm, sum_velocities(rows, body, multiply_columns(impulse, x)))
        return x - multiply_columns(own, x) - multiply_columns(velocity, gives)

    return lax.custom_linear_solve(
        leave,
        right,
        solve=lambda _, right: repeat_linear_sweeps(sweep, body, rows.arm, right),
        transpose_solve=lambda _, right: repeat_linear_sweeps(sweep.transposed, body, rows.arm, right),
    )


def _apply_point_mobility(body: Body, arm: Array, vector: Array) -> Array:
    """Kx: the velocity that an impulse x at a point gives to that point."""
    inverse_mass, inverse_inertia = (add_leading_axes(part, vector.ndim + i) for i, part in enumerate(body))
    return inverse_mass * vector + cross(multiply(inverse_inertia, cross(arm, vector)), arm)


def _shift_columns(matrix: Array, by: int) -> Array:
    """Matrices `(points, 3, 3, lanes)` with column i + by in place of column i."""
    return jnp.concatenate([matrix[:, by:], matrix[:, :by]], axis=1)
