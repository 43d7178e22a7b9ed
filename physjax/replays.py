"""Derivatives by a replay: a search finds moments and choices without derivatives, a replay with these known carries them.

A search that branches lane by lane until all have arrived has no reverse mode, and needs none: where it led is a smooth
function of everything once its choices are fixed.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.core import Tracer
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jaxtyping import Array, PyTree


def differentiate_by_replay(
    find: Callable[..., PyTree], log: Callable[..., tuple], replay: Callable[..., PyTree], *arguments: PyTree
) -> PyTree:
    """`find(*arguments)`, whose derivatives are those of a replay, forward and reverse, as far as the replay has them.

    Only where something is differentiated does `log(*arguments)` run instead, which returns what `find` does and a record
    of what was chosen, and then `replay(record, *arguments)`, which returns the result again; where it is a NaN, so are the
    derivatives. What the three close over must not be differentiated: see `hoist_closures`.
    """
    leaves, structure = jax.tree.flatten(arguments)
    run = jax.custom_jvp(lambda *leaves: find(*structure.unflatten(leaves)))
    # compiled as calls, so that they are traced once: loops around ask for the rule once for each of their fixed points
    log_leaves = jax.jit(lambda *leaves: log(*structure.unflatten(leaves)))
    replay_leaves = jax.jit(lambda record, *leaves: replay(record, *structure.unflatten(leaves)))

    def rule(primals: tuple, tangents: tuple) -> tuple:
        result, record = log_leaves(*lax.stop_gradient(list(primals)))
        # what does not move stays a constant of the replay
        moving = [i for i, tangent in enumerate(tangents) if not isinstance(tangent, SymbolicZero)]

        def again(*some: Any) -> PyTree:
            moved = dict(zip(moving, some, strict=True))
            return replay_leaves(record, *(moved.get(i, leaf) for i, leaf in enumerate(primals)))

        some, pushes = tuple(primals[i] for i in moving), tuple(tangents[i] for i in moving)
        value, change = jax.jvp(again, some, pushes)
        return jax.tree.map(_adopt_derivatives, result, value), change

    run.defjvp(rule, symbolic_zeros=True)
    return run(*leaves)


def _adopt_derivatives(found: Array, flown: Array) -> Array:
    """The search's own number, to the last bit, with the derivatives of the replay."""
    change = flown - lax.stop_gradient(flown)
    return found + jnp.where(jnp.isfinite(change), change, 0.0)


def hoist_closures(
    probe: Callable[..., PyTree],
    find: Callable[..., PyTree],
    log: Callable[..., tuple],
    replay: Callable[..., PyTree],
    *arguments: PyTree,
) -> PyTree:
    """`differentiate_by_replay`, also by numbers that a user's function in the arguments closes over.

    `probe(*arguments)` calls all such functions, and is cheap. Only where it meets a number that is being traced are the
    three functions traced as a whole, and what they close over becomes an argument of theirs.
    """
    if not any(isinstance(number, Tracer) for number in jax.make_jaxpr(probe)(*arguments).consts):
        return differentiate_by_replay(find, log, replay, *arguments)
    record = jax.eval_shape(log, *arguments)[1]
    (find, found), (log, logged) = (_open_closure(function, *arguments) for function in (find, log))
    replay, flown = _open_closure(replay, record, *arguments)
    return differentiate_by_replay(
        lambda found, logged, flown, *arguments: find(found, *arguments),
        lambda found, logged, flown, *arguments: log(logged, *arguments),
        lambda record, found, logged, flown, *arguments: replay(flown, record, *arguments),
        found, logged, flown, *arguments,
    )  # fmt: skip


def _open_closure(function: Callable, *examples: PyTree) -> tuple[Callable, list]:
    """The function with what it closes over as its first argument, and that."""
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*examples)
    structure = jax.tree.structure(shape)

    def opened(numbers: list, *arguments: PyTree) -> PyTree:
        program = jaxpr_as_fun(ClosedJaxpr(closed.jaxpr, numbers))
        return structure.unflatten(program(*jax.tree.leaves(arguments)))

    return opened, list(closed.consts)
