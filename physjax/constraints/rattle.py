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
from physjax.constraints.coordinates import Places
from physjax.constraints.impulses import ClosingStep, close_joints
from physjax.constraints.mechanism import Jacobian, Mechanism, Rows, find_constraints
from physjax.constraints.reactions import stop_opening
from physjax.loops import Time, to_float_time
from physjax.scene import Scene

CLOSED_SHARE = 1e-12
"""Relative to its size, how far a closed joint may be open."""
CLOSED_ROUNDINGS = 16
"""The same in roundings of the number type, where that is more: float32 has no 12 digits."""
MAX_CORRECTIONS = 8
"""Newton's steps towards closed joints between two steps of the method; three are taken where joints turn by 0.1 rad."""
SUZUKI_SHARE = 1 / (4 - 4 ** (1 / 3))
"""The share of a step [1] for which the errors of order 3 of five steps cancel."""
SUZUKI_4 = (SUZUKI_SHARE, SUZUKI_SHARE, 1 - 4 * SUZUKI_SHARE, SUZUKI_SHARE, SUZUKI_SHARE)
"""Shares of a step [1]: as many steps of a symmetric method of order 2 make one of order 4."""


def hold_joints(motion: Callable, scene: Scene, t: Time, dt: ArrayLike) -> Scene:
    """The scene after a step of dt [s] at the end of which all joints are closed and stay so."""
    if scene.emitter is not None:
        raise ValueError(
            "joints: got a scene with an emitter, expected bodies that live from the start: births open joints."
        )
    parts = find_constraints(scene)
    dt = jnp.asarray(dt, scene.state.dtype)
    substeps = max(part.substeps for part in parts)
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
    """What a step begins with: the mechanism, its Jacobian and M⁻¹Jᵀ at the start, and the length of the step of each world."""

    mechanism: Mechanism
    jacobian: Jacobian
    moved: Jacobian
    h: Float[Array, " worlds"]
    tolerance: Float[Array, " worlds"]


def _take_step(motion: Callable, scene: Scene, t: Time, dt: Array) -> Scene:
    """A step of order 2."""
    free = scene.replace(
        forces=tuple(force for force in scene.forces if not isinstance(force, Constraint) or force.response is None)
    )
    start = _begin(scene, dt)
    mechanism, mass = start.mechanism, scene.mass
    read = mechanism.coordinates.read_places
    push = lambda λ: _push(start, scene, λ)  # noqa: E731

    def take(λ: Rows) -> tuple[Rows, PyTree]:
        end = motion(free.replace(state=push(λ)), t, dt).state
        if scene.prescribed_motion is not None:
            end = scene.prescribed_motion.prescribe(to_float_time(t + dt), end)
        return mechanism.measure(read(end)), end

    drift = lambda λ: read(push(λ).drift(dt, mass))  # noqa: E731
    step = ClosingStep(take, partial(_correct, start, drift), partial(_invert, start), start.tolerance)
    none = jnp.zeros((mechanism.rows, len(mechanism.pairs), len(start.h)), start.h.dtype)
    _, gap, end = close_joints(step, none)
    good = jnp.all(jnp.max(jnp.abs(gap), axis=(0, 1)) <= start.tolerance * float(jnp.finfo(gap.dtype).eps) ** -0.25)
    end = jax.tree.map(lambda leaf: leaf * jnp.where(good, 1.0, jnp.nan).astype(leaf.dtype), end)
    return scene.replace(state=stop_opening(mechanism, scene, end))


def _begin(scene: Scene, dt: Array) -> _Start:
    mechanism = Mechanism.of(scene)
    state, worlds = scene.state, mechanism.free.shape[-1]
    places = mechanism.coordinates.read_places(state)
    jacobian = mechanism.differentiate(places)
    mobility = mechanism.coordinates.read_mobility(state, scene.mass)
    moved = mechanism.move_by_impulses(mobility, jacobian)
    share = max(CLOSED_SHARE, CLOSED_ROUNDINGS * float(jnp.finfo(state.dtype).eps))
    size = jnp.max(jnp.abs(places[: mechanism.coordinates.dim]), axis=(0, 1))
    size = jnp.maximum(size, jnp.max(mechanism.coordinates.measure_bodies(mobility), axis=0))
    for part in mechanism.parts:
        size = jnp.maximum(size, part.extent())
    return _Start(mechanism, jacobian, moved, jnp.broadcast_to(dt.reshape(-1), worlds), lax.stop_gradient(share * size))


def _push(start: _Start, scene: Scene, λ: Rows) -> PyTree:
    """The state at the start with impulses along the joints."""
    mechanism = start.mechanism
    return mechanism.coordinates.push(scene.state, scene.mass, mechanism.sum_at_bodies(start.jacobian, λ))


def _correct(start: _Start, drift: Callable[[Rows], Places], λ: Rows, end: PyTree) -> Rows:
    """Better impulses, by Newton's method: other impulses lead to where a drift with them leads from there.

    That is exact where forces do not see the velocity and a step evaluates them at its start, or half way.
    """
    mechanism, coordinates = start.mechanism, start.mechanism.coordinates
    there, before = coordinates.read_places(end), drift(λ)
    predict = lambda λ: coordinates.carry_on(there, before, drift(λ))  # noqa: E731
    worst = lambda gap: jnp.max(jnp.abs(gap), axis=(0, 1))  # noqa: E731

    def turn(carry: tuple) -> tuple:
        λ, places, gap, count = carry
        change = (
            mechanism.solve(mechanism.build_matrix(mechanism.differentiate(places), start.moved), gap)
            / start.h[None, None]
        )
        # worlds whose joints are closed keep their impulses
        λ = jnp.where((worst(gap) > start.tolerance)[None, None], λ - change, λ)
        places = predict(λ)
        return λ, places, mechanism.measure(places), count + 1

    def goes_on(carry: tuple) -> Array:
        _, _, gap, count = carry
        return jnp.any(worst(gap) > start.tolerance) & (count < MAX_CORRECTIONS)

    return lax.while_loop(goes_on, turn, (λ, there, mechanism.measure(there), jnp.zeros((), jnp.int32)))[0]


def _invert(start: _Start, λ: Rows, end: PyTree, gap: Rows, transposed: bool) -> Rows:
    """The change of impulses that closes small gaps at the end of a step, or the transposed of that."""
    mechanism = start.mechanism
    there = mechanism.differentiate(mechanism.coordinates.read_places(end))
    matrix = mechanism.build_matrix(there, start.moved)
    return mechanism.solve(matrix.transposed() if transposed else matrix, gap) / start.h[None, None]


__all__ = ["hold_joints"]
