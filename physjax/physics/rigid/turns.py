"""How bodies that are joined are turned relative to each other, which welds and sliders keep and hinges count."""

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from physjax.constraints.coordinates import Places
from physjax.physics.rigid.body_joints import BodyJoints, put_joints_last

J = TypeVar("J", bound=BodyJoints)


@jax.jit
def measure_turns(part: BodyJoints, state: PyTree) -> Array:
    """How the second body of each joint is turned relative to the first: `(*scenes, joints)`, in space quaternions."""
    reader = part.coordinates(state)
    turns = reader.compare(*part.find_ends(reader.read_places(state)))
    turns = jnp.moveaxis(turns, (0, 1, 2), (2, 1, 0)).reshape(*state.lanes[:-1], len(part.pairs), len(turns))
    return turns[..., 0] if turns.shape[-1] == 1 else turns


def measure_turn(part: BodyJoints, turns: Array | None, first: Places, second: Places) -> list[Array]:
    """By how much the bodies have turned relative to each other since they were turned so [rad], in rows."""
    assert turns is not None
    reader = part.reader
    turn = reader.compare(first, second)
    return reader.measure_turn(turn, put_joints_last(turns, len(turn)))


def remember_turns(part: J, state: PyTree) -> J:
    """The joints with the turn of their bodies in a field `turns`, which they keep if they have one."""
    known = lambda part: part.turns  # noqa: E731
    if known(part) is not None or part.points.shape[-1] != part.coordinates(state).dim:
        return part
    return eqx.tree_at(known, part, measure_turns(part, state), is_leaf=lambda leaf: leaf is None)


__all__ = ["measure_turn", "measure_turns", "remember_turns"]
