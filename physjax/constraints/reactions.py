"""The forces of joints at a moment, and the impulses that leave no speed at which joints open."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, PyTree

from physjax.constraints.constraint import Constraint
from physjax.constraints.mechanism import Jacobian, Mechanism, Rows
from physjax.loops import Time, to_float_time

PROJECTION_STEPS = 5
"""Newton's steps of a projection: joints that are open by a tenth of their size close to rounding."""


def stop_opening(mechanism: Mechanism, scene: PyTree, state: PyTree) -> PyTree:
    """The state with impulses along the joints after which none opens, J q̇ = 0: for what moves otherwise as it did."""
    coordinates, mass = mechanism.coordinates, scene.mass
    jacobian = mechanism.differentiate(coordinates.read_places(state))
    opening = mechanism.measure_rates(jacobian, coordinates.read_rates(state, mass))
    λ = _solve_impulses(mechanism, mass, state, jacobian, -opening)
    return coordinates.push(state, mass, mechanism.sum_at_bodies(jacobian, λ))


def project_joints(scene: PyTree, state: PyTree) -> PyTree:
    """The state with its joints closed and none opening, changed as little as the masses allow: for what else moves bodies.

    Newton's steps, each a displacement M⁻¹Jᵀλ, then the impulses that stop the joints: a contact solver calls this after
    it has pushed bodies apart.
    """
    mechanism, mass = Mechanism.of(scene), scene.mass
    coordinates, whole = mechanism.coordinates, jnp.ones((), state.dtype)

    def close(state: PyTree, _: None) -> tuple[PyTree, None]:
        places = coordinates.read_places(state)
        jacobian = mechanism.differentiate(places)
        λ = _solve_impulses(mechanism, mass, state, jacobian, -mechanism.measure(places))
        # bodies that rest, pushed and left alone for a second
        still = state.hold_lanes(jnp.zeros(state.lanes, state.dtype))
        moved = coordinates.push(still, mass, mechanism.sum_at_bodies(jacobian, λ)).drift(whole, mass)
        return coordinates.put_places(state, moved), None

    closed, _ = lax.scan(close, state, None, length=PROJECTION_STEPS)
    return stop_opening(mechanism, scene, closed)


def constrain_rate(scene: PyTree, t: Time, state: PyTree, rate: PyTree) -> PyTree:
    """The rate of a state with the forces of the joints: those under which the speeds at which joints open stay zero."""
    mechanism, state = _at_moment(scene, t, state)
    jacobian, λ = _find_multipliers(mechanism, scene, state, rate)
    return mechanism.coordinates.push(rate, scene.mass, mechanism.sum_at_bodies(jacobian, λ))


def constraint_forces(scene: PyTree, t: ArrayLike = 0.0, state: PyTree = None) -> tuple[Array, ...]:
    """What each part of a scene that holds joints exerts now, in the order of its forces, `(*worlds, joints, rows)`.

    Of a rod the force along it [N], positive where it pulls; of a ball joint the force on its first body; generally λ of
    Jᵀλ, in newtons for rows in metres and in N m for rows in radians, such that it acts on the first body as the row's
    gap shrinks.

    Example:
        >>> hung = Scene(Particles(jnp.array([[0.0, -1.0]]), jnp.zeros((1, 2))), 2.0,
        ...     (forces.Gravity(), springs.Rods([(-1, 0)], anchors=[(0.0, 0.0)])))
        >>> print(constraint_forces(hung)[0].ravel())
        [19.6]
    """
    return find_forces(scene, t, scene.state if state is None else state)


@jax.jit
def find_forces(scene: PyTree, t: ArrayLike, state: PyTree) -> tuple[Array, ...]:
    """What `constraint_forces` returns, compiled."""
    mechanism, state = _at_moment(scene, t, state)
    free = scene.replace(forces=tuple(f for f in scene.forces if not isinstance(f, Constraint) or f.response is None))
    _, λ = _find_multipliers(mechanism, scene, state, free.rate(t, state))
    found, begun = [], 0
    for part in mechanism.parts:
        own = -λ[: part.rows, begun : begun + len(part.pairs)]
        found.append(jnp.moveaxis(own, (0, 1, 2), (2, 1, 0)).reshape(*state.lanes[:-1], len(part.pairs), part.rows))
        begun += len(part.pairs)
    return tuple(found)


def _at_moment(scene: PyTree, t: Time, state: PyTree) -> tuple[Mechanism, PyTree]:
    """The mechanism, and the state with kinematic nodes on their path."""
    mechanism = Mechanism.of(scene)
    if scene.prescribed_motion is not None:
        state = scene.prescribed_motion.prescribe(to_float_time(t), state)
    return mechanism, state


def _find_multipliers(mechanism: Mechanism, scene: PyTree, state: PyTree, rate: PyTree) -> tuple[Jacobian, Rows]:
    """The Jacobian and the forces along it, under which the speeds at which joints open do not change."""
    coordinates, mass = mechanism.coordinates, scene.mass

    def opening(state: PyTree) -> Rows:
        places, rates = coordinates.read_places(state), coordinates.read_rates(state, mass)
        still = jnp.zeros_like(rates)
        return jax.jvp(lambda moves: mechanism.measure(coordinates.displace(places, moves)), (still,), (rates,))[1]

    _, change = jax.jvp(opening, (state,), (rate,))
    jacobian = mechanism.differentiate(coordinates.read_places(state))
    return jacobian, _solve_impulses(mechanism, mass, state, jacobian, -change)


def _solve_impulses(mechanism: Mechanism, mass: PyTree, state: PyTree, jacobian: Jacobian, right: Rows) -> Rows:
    """The λ with J M⁻¹ Jᵀ λ = right, differentiable through what the matrix does alone."""
    coordinates = mechanism.coordinates
    mobility = coordinates.read_mobility(state, mass)

    def apply(λ: Rows) -> Rows:
        rates = coordinates.apply_mobility(mobility, mechanism.sum_at_bodies(jacobian, λ))
        return mechanism.measure_rates(jacobian, rates)

    def solve(apply: Callable, right: Rows) -> Rows:
        moved = mechanism.move_by_impulses(mobility, jacobian)
        return mechanism.solve(mechanism.build_matrix(jacobian, moved), right)

    return lax.custom_linear_solve(apply, right, solve, symmetric=True)


__all__ = ["constrain_rate", "constraint_forces", "find_forces", "project_joints", "stop_opening"]
