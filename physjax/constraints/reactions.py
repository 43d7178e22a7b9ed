"""The forces of joints at a moment, and the impulses that leave no speed at which joints open."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, PyTree

from physjax.constraints.constraint import Constraint
from physjax.constraints.coordinates import Places, put_worlds_last
from physjax.constraints.mechanism import Jacobian, Mechanism, hold_rows
from physjax.constraints.ranges import Range, Rows, Steps, are_held, change_steps
from physjax.loops import Time, open_closure, to_float_time

PROJECTION_STEPS = 5
"""Newton's steps of a projection: joints that are open by a tenth of their size close to rounding."""
MAX_CHOICES = 32
"""How often it is chosen anew which limits hold."""
TOUCHING = 16
"""Relative to how far closed joints may be open, how near a limit is reached."""


def stop_opening(
    mechanism: Mechanism, scene: PyTree, state: PyTree, near: Array | None = None, h: Array | None = None
) -> PyTree:
    """The state with impulses along the joints after which none opens, J q̇ = 0: for what moves otherwise as it did.

    Motors exert half of what they can in a time `h` [s], nothing without one; limits count as reached as `near` as that.
    """
    coordinates, mass = mechanism.coordinates, scene.mass
    places, rates = coordinates.read_places(state), coordinates.read_rates(state, mass)
    mobility = coordinates.read_mobility(state, mass)
    jacobian, x = mechanism.differentiate(places)
    opening = mechanism.measure_rates(jacobian, rates)
    bounds = mechanism.find_bounds(x)
    if bounds is None:
        λ = _solve_impulses(mechanism, mobility, jacobian, -opening)
    else:
        if near is None:
            near = TOUCHING * mechanism.measure_tolerance(places, mobility)
        none = jnp.zeros_like(opening[0, 0])
        λ = _solve_bounded(mechanism, mobility, jacobian, opening, bounds.speeds(x, none if h is None else h, near))
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
        jacobian, x = mechanism.differentiate(places)
        bounds = mechanism.find_bounds(x)
        if bounds is not None:
            # limits that are passed are closed like joints, and others are left alone
            within = jnp.clip(x, bounds.low, bounds.high)
            jacobian = hold_rows(jacobian, (x != within) | (bounds.low == bounds.high))
            x = x - within
        λ = _solve_impulses(mechanism, coordinates.read_mobility(state, mass), jacobian, -x)
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
    gap shrinks. With what `rigid.Solids` exerted on the bodies in the mean of the last step; without it in another `state`.

    Example:
        >>> hung = Scene(Particles(jnp.array([[0.0, -1.0]]), jnp.zeros((1, 2))), 2.0,
        ...     (forces.Gravity(), springs.Rods([(-1, 0)], anchors=[(0.0, 0.0)])))
        >>> print(constraint_forces(hung)[0].ravel())
        [19.6]
    """
    if state is None:
        return find_forces(scene, t, scene.state)
    free = tuple(contact for contact in scene.contacts if contact.find_loads() is None)
    return find_forces(scene.replace(contacts=free), t, state)


@jax.jit
def find_forces(scene: PyTree, t: ArrayLike, state: PyTree) -> tuple[Array, ...]:
    """What `constraint_forces` returns, compiled."""
    mechanism, state = _at_moment(scene, t, state)
    rate = _rate_without_joints(scene, t, state)
    for loads in (contact.find_loads() for contact in scene.contacts):
        if loads is not None:
            rate = mechanism.coordinates.push(rate, scene.mass, put_worlds_last(loads, state.lanes))
    _, λ = _find_multipliers(mechanism, scene, state, rate)
    found, begun = [], 0
    for part in mechanism.parts:
        own = -λ[: part.rows, begun : begun + len(part.pairs)]
        found.append(jnp.moveaxis(own, (0, 1, 2), (2, 1, 0)).reshape(*state.lanes[:-1], len(part.pairs), part.rows))
        begun += len(part.pairs)
    return tuple(found)


def split_rate(scene: PyTree, t: ArrayLike, state: PyTree) -> tuple[PyTree, tuple[PyTree, ...]]:
    """The rate of a state, and what of it each part that holds joints brings: to held bodies too, which are held against it."""
    if not scene.constraints:
        return scene.rate(t, state), ()
    mechanism, state = _at_moment(scene, t, state)
    rate = _rate_without_joints(scene, t, state)
    jacobian, λ = _find_multipliers(mechanism, scene, state, rate)
    all_move, none = mechanism._replace(free=jnp.ones_like(mechanism.free)), jax.tree.map(jnp.zeros_like, state)
    counts = [len(part.pairs) for part in mechanism.parts]
    own = [np.repeat(np.arange(len(counts)) == i, counts)[None, :, None] for i in range(len(counts))]
    push = lambda rate, joined, λ: mechanism.coordinates.push(rate, scene.mass, joined.sum_at_bodies(jacobian, λ))  # noqa: E731
    return push(rate, mechanism, λ), tuple(push(none, all_move, jnp.where(mask, λ, 0.0)) for mask in own)


def find_stops(scene: PyTree, before: PyTree, after: PyTree) -> tuple[Array | None, ...]:
    """For each part that holds joints, in which worlds a limit was reached between two states; None without limits."""
    mechanism = Mechanism.of(scene)

    def reach(state: PyTree) -> list[Array | None]:
        places = mechanism.coordinates.read_places(state)
        near = TOUCHING * mechanism.measure_tolerance(places, mechanism.coordinates.read_mobility(state, scene.mass))
        return [_reach_limits(part, places, near) if part.bounded else None for part in mechanism.parts]

    both = zip(reach(before), reach(after), strict=True)
    came = [None if then is None or now is None else jnp.any(now & ~then, axis=(0, 1)) for then, now in both]
    return tuple(None if flag is None else flag.reshape(before.lanes[:-1]) for flag in came)


def _reach_limits(part: Constraint, places: Places, near: Array) -> Array:
    """Which rows of a part are at a limit."""
    x = part.measure(*part.find_ends(places))
    bounds = part.find_bounds(x)
    return (bounds.low < bounds.high) & ((x <= bounds.low + near[None, None]) | (x >= bounds.high - near[None, None]))


def _rate_without_joints(scene: PyTree, t: Time, state: PyTree) -> PyTree:
    free = scene.replace(forces=tuple(f for f in scene.forces if not isinstance(f, Constraint) or f.response is None))
    return free.rate(t, state)


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

    speed, change = jax.jvp(opening, (state,), (rate,))
    places, mobility = coordinates.read_places(state), coordinates.read_mobility(state, mass)
    jacobian, x = mechanism.differentiate(places)
    bounds = mechanism.find_bounds(x)
    if bounds is None:
        return jacobian, _solve_impulses(mechanism, mobility, jacobian, -change)
    near = TOUCHING * mechanism.measure_tolerance(places, mobility)
    fastest = jnp.max(jnp.abs(coordinates.read_rates(state, mass)), axis=(0, 1))
    # what rests moves by rounding: no farther in a second than what counts as touching
    slow = lax.stop_gradient(jnp.maximum(float(jnp.finfo(x.dtype).eps) ** 0.5 * fastest, near))
    allowed = bounds.accelerations(x, speed, near, slow)
    return jacobian, _solve_bounded(mechanism, mobility, jacobian, change, allowed)


def _solve_bounded(mechanism: Mechanism, mobility: Array, jacobian: Jacobian, right: Rows, allowed: Range) -> Rows:
    """The λ with which x = right + J M⁻¹ Jᵀ λ is within what is allowed: first which limits hold, then their impulses."""
    moved = mechanism.move_by_impulses(mobility, jacobian)
    allowed = allowed._replace(scale=lax.stop_gradient(mechanism.measure_mobilities(jacobian, moved)))

    def respond(λ: Rows) -> Rows:
        return right + mechanism.measure_rates(jacobian, mechanism.change_rates(mobility, jacobian, λ))

    def solve(steps: Steps) -> Rows:
        driven, held = allowed.find_impulse(steps), are_held(steps)
        left = jnp.where(held, allowed.find_target(steps) - respond(driven), 0.0)
        return driven + _solve_impulses(mechanism, mobility, hold_rows(jacobian, held), left)

    def find() -> tuple[Rows, Steps]:
        def turn(carry: tuple) -> tuple:
            found, _, _, count = carry
            λ = solve(found)
            return change_steps(found, allowed.find_steps(respond(λ), λ), allowed.cap, count), found, λ, count + 1

        none = jnp.zeros_like(right)
        steps = allowed.find_steps(right, none)
        goes_on = lambda carry: jnp.any(carry[0] != carry[1]) & (carry[3] < MAX_CHOICES)  # noqa: E731
        _, steps, λ, _ = lax.while_loop(goes_on, turn, (steps, steps + 1, none, jnp.zeros((), jnp.int32)))
        return λ, steps

    # the last turn is the answer: it is not computed again where nothing is differentiated
    (run, known), (again, numbers) = open_closure(find), open_closure(solve, jnp.zeros(right.shape, jnp.int32))

    @jax.custom_jvp
    def answer(known: list, numbers: list) -> Rows:
        return run(known)[0]

    @answer.defjvp
    def push(given: tuple, changes: tuple) -> tuple:
        λ, steps = run(given[0])
        return λ, jax.jvp(lambda numbers: again(numbers, steps), (given[1],), (changes[1],))[1]

    return answer(known, numbers)


def _solve_impulses(mechanism: Mechanism, mobility: Array, jacobian: Jacobian, right: Rows) -> Rows:
    """The λ with J M⁻¹ Jᵀ λ = right, differentiable through what the matrix does alone."""

    def apply(λ: Rows) -> Rows:
        return mechanism.measure_rates(jacobian, mechanism.change_rates(mobility, jacobian, λ))

    def solve(apply: Callable, right: Rows) -> Rows:
        moved = mechanism.move_by_impulses(mobility, jacobian)
        return mechanism.solve(mechanism.build_matrix(jacobian, moved), right)

    return lax.custom_linear_solve(apply, right, solve, symmetric=True)


__all__ = ["constrain_rate", "constraint_forces", "find_forces", "project_joints", "stop_opening"]
