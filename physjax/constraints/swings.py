"""Steps as short as the fastest link of a chain needs: how it swings under its tension, and how fast it turns already.

A link of length L between masses m under a tension T swings across at up to ω² = 2 T (1/m + 1/m)/L, whatever the load at
the end of its chain. Where a chain goes slack and is pulled straight again its light links turn faster still.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, PyTree

from physjax.constraints.mechanism import Mechanism
from physjax.constraints.reactions import find_forces
from physjax.loops import Time, differentiable_while_loop, to_float_time

SWING_PER_STEP = 0.25
"""How far a link may be in its swing after a step [rad], and how far it may turn."""
SHORTEST_SHARE = 2.0**-16
"""Of a step [1]: what fails in shorter ones has failed."""
MAX_STEPS = 4096
"""Of a step for derivatives."""


def resolve_swings(take: Callable, scene: PyTree, t: Time, dt: Array) -> PyTree:
    """The scene after as many steps `take(scene, t, h)` in a time dt [s] as resolve how links swing and turn.

    One that leaves joints open, with numbers that are not finite, is taken again in quarters.
    """
    finite = lambda tree: jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)]))  # noqa: E731

    def turn(carry: tuple[PyTree, Array, Array]) -> tuple[PyTree, Array, Array]:
        state, done, shorter = carry
        now = scene.replace(state=state)
        at = t + done * dt
        share = lax.stop_gradient(jnp.minimum(shorter / _count_steps(now, to_float_time(at), dt), 1 - done))
        tried = take(now, at, share * dt).state
        good = finite(tried) | ~finite(state) | (shorter <= SHORTEST_SHARE)
        state = jax.tree.map(lambda new, old: jnp.where(good, new, old), tried, state)
        done = jnp.where(good, jnp.where(share >= 1 - done, 1.0, done + share), done)
        return state, done, jnp.where(good, jnp.minimum(2 * shorter, 1.0), shorter / 4).astype(dt.dtype)

    one = jnp.ones((), dt.dtype)
    begun = scene.state, jnp.zeros_like(one), one
    state, *_ = differentiable_while_loop(lambda carry: carry[1] < 1, turn, begun, most=MAX_STEPS)
    return scene.replace(state=state)


def _count_steps(scene: PyTree, t: Array, dt: Array) -> Array:
    """How many steps as long as the next should be there are in a time dt."""
    mechanism = Mechanism.of(scene)
    coordinates, state = mechanism.coordinates, scene.state
    jacobian, _ = mechanism.differentiate(coordinates.read_places(state))
    moved = mechanism.move_by_impulses(coordinates.read_mobility(state, scene.mass), jacobian)
    forces = [jnp.moveaxis(f.reshape(-1, *f.shape[-2:]), (0, 1, 2), (2, 1, 0)) for f in find_forces(scene, t, state)]
    λ = mechanism.join_rows(forces)
    pull = jnp.sum(moved * jnp.concatenate([λ, λ], axis=-2)[None], axis=1)
    pulls = jnp.split(jnp.sqrt(jnp.sum(pull[: coordinates.dim] ** 2, axis=0)), 2, axis=-2)
    length = jnp.concatenate([part.find_lengths(λ.dtype, λ.shape[-1]) for part in mechanism.parts])
    rates = coordinates.read_rates(state, scene.mass)[: coordinates.dim]
    first, second = mechanism.take_ends(rates)
    turning = jnp.sqrt(jnp.sum((second - first) ** 2, axis=0)) / length
    swing = jnp.maximum(jnp.sqrt(2 * (pulls[0] + pulls[1]) / length), turning)
    return jnp.maximum(1.0, jnp.max(swing * dt.reshape(-1)[None]) / SWING_PER_STEP)


__all__ = ["resolve_swings"]
