"""Which arrays of a scene's parts a step changes: their memory."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from physjax.parts import Force, adopt_force


def build_memory_mask(part: PyTree) -> PyTree:
    """A contact or an emitter with True in place of each array that its `memory` names, False elsewhere."""
    mask = jax.tree.map(lambda _: False, part)
    if part is None or not part.memory:
        return mask
    if all(getattr(part, name) is None for name in part.memory):
        name = type(part).__name__
        raise ValueError(f"{name}: got one that no scene has prepared; give it to Scene(...), not to replace().")
    return eqx.tree_at(lambda part: [getattr(part, name) for name in part.memory], mask, [True] * len(part.memory))


def has_memory(part: PyTree) -> bool:
    """Whether a step changes arrays of this part of a scene, as well as the state."""
    return part is not None and (part.remembers if isinstance(part, Force) else bool(part.memory))


def build_advance_mask(force: Force, state: PyTree, mass: PyTree) -> PyTree:
    """A force with True in place of each array that its `advance` replaces: found by tracing it and comparing identities."""
    if not force.remembers:
        return jax.tree.map(lambda _: False, force)
    masks = []

    def trace(force, state):
        zero = jnp.zeros((), state.dtype)
        after, _ = force.advance(zero, zero, state)
        masks.append(jax.tree.map(lambda before, now: before is not now, force, adopt_force(after)))

    jax.eval_shape(trace, force, state)
    return masks[0]


__all__ = ["build_advance_mask", "build_memory_mask", "has_memory"]
