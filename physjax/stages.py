"""The stages of a step that follow the motion: contacts that project, nodes on their path, joints, memories that advance."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import PyTree

from physjax.loops import Time, to_float_time
from physjax.parts import adopt_force


class Stage(NamedTuple):
    """A named part of a step; `part` counts the contact or the force that it is about."""

    name: str
    run: Callable[[PyTree], PyTree]
    part: int | None = None


def resolve_contact(index: int, scene: PyTree, t: Time) -> PyTree:
    """The scene with what a contact that projects makes of it."""
    state = scene.contacts[index].resolve(to_float_time(t), scene.state, scene.mass)
    return scene.replace(state=state)


def prescribe(scene: PyTree, start: PyTree, t: Time) -> PyTree:
    """Kinematic nodes where their path is at the time t, held ones where they were at the start of the step."""
    if scene.prescribed_motion is not None:
        return scene.replace(state=scene.prescribed_motion.prescribe(to_float_time(t), scene.state))
    held = jnp.asarray(scene.held)
    # an angle in the plane is a number for each lane, without an axis of components
    like = lambda leaf: held if leaf.ndim == held.ndim else held[..., None]  # noqa: E731
    keep = lambda now, before: jnp.where(like(now), before, now)  # noqa: E731
    return scene.replace(state=jax.tree.map(keep, scene.state, start))


def close_joints(scene: PyTree) -> PyTree:
    """The scene with its joints closed and none opening."""
    return scene.replace(state=scene.constraints[0].close(scene, scene.state))


def advance_force(index: int, scene: PyTree, t: ArrayLike, dt: ArrayLike) -> PyTree:
    """The scene after a force with memory has seen the step."""
    force, state = scene.forces[index], scene.state
    seen, _ = state.view_for_force(force, scene.mass)
    force, after = force.advance_within(scene, t, dt, seen)
    forces = (*scene.forces[:index], adopt_force(force), *scene.forces[index + 1 :])
    # a force that sees no state of this kind, such as one at the centres of bodies, cannot change it
    return scene.replace(state=after if seen is state else state, forces=forces)


__all__ = ["Stage", "advance_force", "close_joints", "prescribe", "resolve_contact"]
