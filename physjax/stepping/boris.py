"""Boris' method: what a force makes of the velocity sees the mean of the old velocity and the new one.

J. P. Boris, "Relativistic plasma simulation", Proc. 4th Conf. on Numerical Simulation of Plasmas (1970) 3. For a force
that is linear in the velocity, v' = v + dt a((v + v')/2) is a linear equation for v', of each lane for itself; in a magnetic
field its solution is Boris' rotation (a Cayley transform), which keeps |v|. For other forces it is linearised, as
Rosenbrock's methods do, which keeps order 2.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.linear import solve_columns
from physjax.loops import Time
from physjax.stepping.dependence import find_dependent, find_kicked, pick_leaves
from physjax.stepping.system import S, System, count_lane_axes


def take_boris_step(system: System, t: Time, state: S, dt: ArrayLike) -> S:
    """Drift half way, kick with the rate at the mean of the velocities before and after, drift on."""
    half = system.drift(state, dt / 2)
    return system.drift(system.kick(half, _find_centred_rate(system, t + dt / 2, half, dt), dt), dt / 2)


def _find_centred_rate(system: System, t: Time, state: Any, dt: ArrayLike) -> Any:
    """The rate r = f(v + r dt/2), linearised about v; f(v) itself where no force looks at the velocity."""
    kicked = find_kicked(system, state)
    zero = jax.tree.map(jnp.zeros_like, state)  # a rate is a tree of the same structure
    rate, change = jax.linearize(lambda r: system.rate(t, system.kick(state, r, dt / 2)), zero)
    looks = find_dependent(lambda r: pick_leaves(change(r), kicked), zero, marked=kicked)
    if not any(looks):
        return rate
    axes = count_lane_axes(state)
    units = _build_units(zero, kicked, axes)
    # (1 - ∂f/∂v dt/2) r = f(v), a column for each component of the velocity
    columns = []
    for unit in units:
        own, seen = (_list_components(pick_leaves(tree, kicked), axes) for tree in (unit, change(unit)))
        columns.append([a - b for a, b in zip(own, seen, strict=True)])
    solved = solve_columns(columns, _list_components(pick_leaves(rate, kicked), axes))
    return _replace_components(rate, kicked, axes, solved)


def _build_units(zero: Any, kicked: Sequence[bool], axes: int) -> list[Any]:
    """For each component of the velocity a tree that is 1 there, in every lane, and zero elsewhere."""
    leaves, structure = jax.tree.flatten(zero)
    units = []
    for place, (leaf, mark) in enumerate(zip(leaves, kicked, strict=True)):
        if not mark:
            continue
        flat = leaf.reshape(*leaf.shape[:axes], -1)
        for i in range(flat.shape[-1]):
            one = jnp.broadcast_to(jnp.asarray(np.eye(flat.shape[-1])[i], leaf.dtype), flat.shape).reshape(leaf.shape)
            units.append(structure.unflatten([*leaves[:place], one, *leaves[place + 1 :]]))
    return units


def _list_components(leaves: Sequence[Array], axes: int) -> list[Array]:
    """The components of arrays, each shaped like the lanes."""
    flat = [leaf.reshape(*leaf.shape[:axes], -1) for leaf in leaves]
    return [leaf[..., i] for leaf in flat for i in range(leaf.shape[-1])]


def _replace_components(tree: Any, kicked: Sequence[bool], axes: int, components: Sequence[Array]) -> Any:
    """The tree with the arrays that are kicked made of these components."""
    leaves, structure = jax.tree.flatten(tree)
    rest = list(components)
    for place, (leaf, mark) in enumerate(zip(leaves, kicked, strict=True)):
        if mark:
            count = leaf.reshape(*leaf.shape[:axes], -1).shape[-1]
            own, rest = rest[:count], rest[count:]
            leaves[place] = jnp.stack(own, axis=-1).reshape(leaf.shape)
    return structure.unflatten(leaves)


__all__ = ["take_boris_step"]
