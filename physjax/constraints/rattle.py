"""A step that keeps joints closed, whatever the method: RATTLE.

Impulses Jᵀλ along the joints at the start of the step lead to closed joints at its end; impulses Jᵀμ there leave no speed at
which they open (H. C. Andersen, "Rattle", J. Comput. Phys. 52 (1983) 24). λ is half of what the joints transfer in a step.
Of order 2 under every method of order 2 or more, and symmetric under a symmetric one, so that the energy does not drift;
five such steps make one of order 4 (M. Suzuki, Phys. Lett. A 146 (1990) 319).
"""

from collections.abc import Callable
from functools import partial
from itertools import accumulate
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from physjax.constraints.constraint import Constraint
from physjax.constraints.coordinates import Moves, Places
from physjax.constraints.impulses import ClosingStep, close_joints
from physjax.constraints.mechanism import Jacobian, Mechanism, find_constraints, hold_rows
from physjax.constraints.ranges import Range, Rows, Steps, are_held, change_steps
from physjax.constraints.reactions import TOUCHING, stop_opening
from physjax.constraints.swings import resolve_swings
from physjax.loops import Time, to_float_time
from physjax.scene import Scene

MAX_CORRECTIONS = 8
"""Newton's steps towards closed joints between two steps of the method; three are taken where joints turn by 0.1 rad."""
MAX_BOUNDED_CORRECTIONS = 32
"""The same where limits or motors choose anew in each whether they hold."""
SUZUKI_SHARE = 1 / (4 - 4 ** (1 / 3))
"""The share of a step [1] for which the errors of order 3 of five steps cancel."""
SUZUKI_4 = (SUZUKI_SHARE, SUZUKI_SHARE, 1 - 4 * SUZUKI_SHARE, SUZUKI_SHARE, SUZUKI_SHARE)
"""Shares of a step [1]: as many steps of a symmetric method of order 2 make one of order 4."""


def hold_joints(motion: Callable, scene: Scene, t: Time, dt: ArrayLike) -> Scene:
    """The scene after a step of dt [s] at the end of which all joints are closed and stay so."""
    parts = find_constraints(scene)
    dt = jnp.asarray(dt, scene.state.dtype)
    if any(part.substeps is None for part in parts):
        return resolve_swings(partial(_take_step, motion), scene, t, dt)
    substeps = max(part.substeps or 1 for part in parts)
    shares = SUZUKI_4 if max(part.order for part in parts) == 4 else (1.0,)
    shares = tuple(share / substeps for share in shares) * substeps
    if len(shares) == 1:
        return _take_step(motion, scene, t, dt)
    begun = accumulate(shares[:-1], initial=0.0)

    def follow(state: PyTree, stage: Array) -> tuple[PyTree, None]:
        return _take_step(motion, scene.replace(state=state), t + stage[0] * dt, stage[1] * dt).state, None

    stages = jnp.asarray([*zip(begun, shares, strict=True)], dt.dtype)
    return scene.replace(state=lax.scan(follow, scene.state, stages)[0])


class _Start(NamedTuple):
    """What a step begins with: the mechanism, its Jacobian and M⁻¹Jᵀ at the start, and the length of the step of each world.

    `pushed` are the impulses of contacts on the bodies `(freedoms, bodies, worlds)` in half of the step, as far as they are
    expected. `x` are the numbers of its rows, `allowed` what they may be at the end; None where all are held at zero.
    """

    mechanism: Mechanism
    jacobian: Jacobian
    moved: Jacobian
    mobility: Array
    h: Float[Array, " worlds"]
    tolerance: Float[Array, " worlds"]
    pushed: Moves | None
    x: Rows
    allowed: Range | None

    def measure_gap(self, x: Rows, λ: Rows) -> Rows:
        """By how much the rows are off, given their impulses."""
        return x if self.allowed is None else self.allowed.measure_gap(x, λ)


def _take_step(motion: Callable, scene: Scene, t: Time, dt: Array) -> Scene:
    """A step of order 2."""
    free = scene.replace(
        forces=tuple(force for force in scene.forces if not isinstance(force, Constraint) or force.response is None)
    )
    start = _begin(scene, dt)
    mechanism, mass = start.mechanism, scene.mass
    read = mechanism.coordinates.read_places
    push = lambda λ: _push(start, scene, λ)  # noqa: E731

    def take(λ: Rows) -> tuple[Rows, tuple[PyTree, Rows]]:
        end = motion(free.replace(state=push(λ)), t, dt).state
        if scene.prescribed_motion is not None:
            end = scene.prescribed_motion.prescribe(to_float_time(t + dt), end)
        x = mechanism.measure(read(end), start.x)
        return start.measure_gap(x, λ), (end, x)

    drift = lambda λ: read(push(λ).drift(dt, mass))  # noqa: E731
    step = ClosingStep(take, partial(_correct, start, drift), partial(_invert, start), start.tolerance)
    none = jnp.zeros((mechanism.rows, len(mechanism.pairs), len(start.h)), start.h.dtype)
    _, gap, (end, _) = close_joints(step, none)
    good = jnp.max(jnp.abs(gap), axis=(0, 1)) <= start.tolerance * float(jnp.finfo(gap.dtype).eps) ** -0.25
    end = _keep_worlds(end, good)
    if start.pushed is not None:
        end = mechanism.coordinates.push(end, mass, start.pushed)
    return scene.replace(state=stop_opening(mechanism, scene, end, TOUCHING * start.tolerance, start.h))


def _keep_worlds(state: PyTree, good: Array) -> PyTree:
    """The state with NaN in the worlds whose joints could not be closed."""
    worlds, factor = state.lanes[:-1], jnp.where(good, 1.0, jnp.nan)
    return jax.tree.map(
        lambda leaf: leaf * factor.reshape(*worlds, *[1] * (leaf.ndim - len(worlds))).astype(leaf.dtype), state
    )


def _begin(scene: Scene, dt: Array) -> _Start:
    mechanism = Mechanism.of(scene)
    state, worlds = scene.state, mechanism.free.shape[-1]
    places = mechanism.coordinates.read_places(state)
    jacobian, x = mechanism.differentiate(places)
    mobility = mechanism.coordinates.read_mobility(state, scene.mass)
    moved = mechanism.move_by_impulses(mobility, jacobian)
    h = jnp.broadcast_to(dt.reshape(-1), worlds)
    bounds, allowed = mechanism.find_bounds(x), None
    if bounds is not None:
        scale = lax.stop_gradient(h[None, None] * mechanism.measure_mobilities(jacobian, moved))
        allowed = bounds.after(x, h)._replace(scale=scale)
    pushes = [push for push in (contact.find_pushes() for contact in scene.contacts) if push is not None]
    pushed = 0.5 * h[None, None] * mechanism.free[None] * sum(pushes) if pushes else None
    tolerance = mechanism.measure_tolerance(places, mobility)
    return _Start(mechanism, jacobian, moved, mobility, h, tolerance, pushed, x, allowed)


def _push(start: _Start, scene: Scene, λ: Rows) -> PyTree:
    """The state at the start with impulses along the joints, and those of contacts."""
    mechanism = start.mechanism
    impulses = mechanism.sum_at_bodies(start.jacobian, λ)
    if start.pushed is not None:
        impulses = impulses + start.pushed
    return mechanism.coordinates.push(scene.state, scene.mass, impulses)


def _correct(start: _Start, drift: Callable[[Rows], Places], λ: Rows, taken: tuple[PyTree, Rows]) -> Rows:
    """Better impulses, by Newton's method: other impulses lead to where a drift with them leads from there.

    That is exact where forces do not see the velocity and a step evaluates them at its start, or half way.
    """
    mechanism, allowed = start.mechanism, start.allowed
    end, x = taken
    there, before = mechanism.coordinates.read_places(end), drift(λ)
    worst = lambda x, λ: jnp.max(jnp.abs(start.measure_gap(x, λ)), axis=(0, 1))  # noqa: E731

    def turn(carry: tuple) -> tuple:
        λ, places, x, steps, count = carry
        if allowed is not None:
            steps = change_steps(steps, allowed.find_steps(x, λ), allowed.cap, count)
        # worlds whose joints are closed keep their impulses
        λ = jnp.where((worst(x, λ) > start.tolerance)[None, None], _take_newton_step(start, λ, places, steps), λ)
        places = mechanism.coordinates.carry_on(there, before, drift(λ))
        return λ, places, mechanism.measure(places, start.x), steps, count + 1

    def goes_on(carry: tuple) -> Array:
        λ, _, x, _, count = carry
        return jnp.any(worst(x, λ) > start.tolerance) & (count < most)

    most = MAX_CORRECTIONS if allowed is None else MAX_BOUNDED_CORRECTIONS
    steps = None if allowed is None else allowed.find_steps(x, λ)
    return lax.while_loop(goes_on, turn, (λ, there, x, steps, jnp.zeros((), jnp.int32)))[0]


def _take_newton_step(start: _Start, λ: Rows, places: Places, steps: Steps | None) -> Rows:
    """The impulses after which joints are closed, as far as they move bodies in proportion."""
    mechanism, allowed, moved = start.mechanism, start.allowed, start.moved
    there, gap = mechanism.differentiate(places, start.x)
    if allowed is not None and steps is not None:
        held = are_held(steps)
        driven = jnp.where(held, λ, allowed.find_impulse(steps))
        # what driven rows change is known, and held ones answer it
        rates = mechanism.change_rates(start.mobility, start.jacobian, driven - λ)
        gap = gap + start.h[None, None] * mechanism.measure_rates(there, rates)
        gap = jnp.where(held, gap - allowed.find_target(steps), 0.0)
        there, moved, λ = hold_rows(there, held), hold_rows(moved, held), driven
    return λ - mechanism.solve(mechanism.build_matrix(there, moved), gap) / start.h[None, None]


def _invert(start: _Start, λ: Rows, taken: tuple[PyTree, Rows], gap: Rows, transposed: bool) -> Rows:
    """The change of impulses that closes small gaps at the end of a step, or the transposed of that."""
    mechanism, allowed = start.mechanism, start.allowed
    end, x = taken
    there, _ = mechanism.differentiate(mechanism.coordinates.read_places(end))
    moved, held = start.moved, None if allowed is None else are_held(allowed.find_steps(x, λ))
    if held is not None:
        there, moved = hold_rows(there, held), hold_rows(moved, held)
    matrix = mechanism.build_matrix(there, moved)
    found = mechanism.solve(matrix.transposed() if transposed else matrix, gap) / start.h[None, None]
    if allowed is None or held is None:
        return found
    # what rows that are not held do to others is left to the iteration that this serves
    return jnp.where(held, found, gap / jnp.where(allowed.scale > 0, allowed.scale, 1.0))


__all__ = ["hold_joints"]
