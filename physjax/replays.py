"""Derivatives by a replay: a search finds moments and choices without derivatives, a replay with these known carries them.

A search that branches lane by lane until all have arrived has no reverse mode, and needs none: where it led is a smooth
function of everything once its choices are fixed. It is a path of legs, each of which ends at the zero of a guard. Where
each leg began and how long it took is logged, so that the derivative of a leg is computed without flying those before it.
"""

from collections.abc import Callable
from functools import partial, wraps
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.custom_derivatives import SymbolicZero
from jax.tree_util import Partial
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, PyTree

from physjax.backend import any_lane
from physjax.loops import open_closure
from physjax.vectors import scale


def trace_once(response: Callable) -> Callable:
    """A response traced once for all callers that step the same scene: a search with derivatives does so in many places."""
    program = jax.jit(response)

    @wraps(response)
    def respond(motion: Callable, scene: PyTree, t: PyTree, dt: ArrayLike) -> PyTree:
        return program(motion if isinstance(motion, Partial) else Partial(motion), scene, t, dt)

    return respond


class Replay(NamedTuple):
    """A path flown again, leg by leg; all functions are differentiable, and `*arguments` are those of the search.

    - `begin(*arguments) -> start` of the first leg.
    - `prepare(choices, start, *arguments) -> prepared`: what moves through the leg.
    - `fly(choices, prepared, duration, *arguments) -> (end, guard)`: the state after a time, per-lane vectors, and the
      number per lane that is zero when the leg ends.
    - `respond(choices, prepared, duration, end, *arguments) -> start` of the next leg; of lanes without this leg, as it was.
    - `finish(record, start) -> result`, linear: what is asked for of where the last leg led.
    """

    begin: Callable[..., PyTree]
    prepare: Callable[..., PyTree]
    fly: Callable[..., tuple[PyTree, Array]]
    respond: Callable[..., PyTree]
    finish: Callable[..., PyTree]


class Record(NamedTuple):
    """A path as it was found: of every leg, along the first axis, its start, duration and choices, and which lanes have it."""

    starts: PyTree
    durations: Array
    choices: PyTree
    active: Bool[Array, "legs *lanes"]


def differentiate_by_replay(
    find: Callable[..., PyTree], log: Callable[..., tuple[PyTree, Record]], replay: Replay, *arguments: PyTree
) -> PyTree:
    """`find(*arguments)`, whose derivatives are those of a replay, forward and reverse, of any order.

    Only where something is differentiated does `log(*arguments)` run instead, which returns what `find` does and a record.
    What the functions close over must not be differentiated: see `hoist_closures`.
    """
    leaves, structure = jax.tree.flatten(arguments)
    run = jax.custom_jvp(lambda *leaves: find(*structure.unflatten(leaves)))
    # compiled as calls, so that they are traced once: loops around ask for the rule once for each of their fixed points
    logged_run = jax.custom_jvp(jax.jit(lambda *leaves: log(*structure.unflatten(leaves))))

    @partial(jax.jit, static_argnums=(0, 1))
    def push(moving: tuple[int, ...], whole: bool, record: Record, leaves: tuple, changes: tuple) -> PyTree:
        def join(some: tuple) -> tuple:
            moved = dict(zip(moving, some, strict=True))
            # what does not move stays a constant of the replay
            return structure.unflatten([moved.get(i, leaf) for i, leaf in enumerate(leaves)])

        some = tuple(leaves[i] for i in moving)
        return _push_path(replay, record, (join, some, changes), whole)

    def make_rule(whole: bool) -> Callable[[tuple, tuple], tuple]:
        def rule(primals: tuple, tangents: tuple) -> tuple:
            # of the record too derivatives are known, so that the rule itself has some
            result, record = logged_run(*primals)
            moving = tuple(i for i, tangent in enumerate(tangents) if not isinstance(tangent, SymbolicZero))
            change = push(moving, whole, record, primals, tuple(tangents[i] for i in moving))
            return ((result, record), (change[0], _complete(change[1], record))) if whole else (result, change)

        return rule

    run.defjvp(make_rule(False), symbolic_zeros=True)
    logged_run.defjvp(make_rule(True), symbolic_zeros=True)
    return run(*leaves)


def _push_path(replay: Replay, record: Record, inputs: tuple[Callable, tuple, tuple], whole: bool) -> PyTree:
    """The derivative of a result by a change of some arguments; `whole`, also those of starts and durations of its legs."""
    join, some, changes = inputs
    _, first = jax.jvp(lambda some: replay.begin(*join(some)), (some,), (changes,))

    def go_on(change: PyTree, leg: Record) -> tuple[PyTree, PyTree]:
        # reverse mode computes each leg again: storing what it needs of one costs more than the work
        fly = jax.checkpoint(lambda leg, change, some, changes: _push_leg(replay, leg, change, (join, some, changes)))
        after, later = lax.cond(
            any_lane(leg.active),
            lambda: fly(leg, change, some, changes),
            lambda: (change, jnp.zeros_like(leg.durations)),
        )
        return after, (change, later) if whole else None

    last, legs = lax.scan(go_on, first, record)
    result = replay.finish(record, last)
    return (result, legs) if whole else result


def _push_leg(
    replay: Replay, leg: Record, change: PyTree, inputs: tuple[Callable, tuple, tuple]
) -> tuple[PyTree, Array]:
    """The change of what follows a leg, and of its duration [s], by those of its start and of some arguments."""
    join, some, changes = inputs
    choices, duration = leg.choices, leg.durations
    prepare = lambda start, some: replay.prepare(choices, start, *join(some))  # noqa: E731
    prepared, moved = jax.jvp(prepare, (leg.starts, some), (change, changes))
    fly = lambda prepared, some: replay.fly(choices, prepared, duration, *join(some))  # noqa: E731
    (end, _), (shift, rise) = jax.jvp(fly, (prepared, some), (moved, changes))
    fly_for = lambda duration: replay.fly(choices, prepared, duration, *join(some))  # noqa: E731
    _, (rate, slope) = jax.jvp(fly_for, (duration,), (jnp.ones_like(duration),))
    # the guard stays zero (implicit function theorem)
    later = jnp.where(slope < 0, -rise / jnp.where(slope < 0, slope, 1.0), 0.0)
    shift = jax.tree.map(lambda moved, rate: moved + scale(later, rate), shift, rate)
    respond = lambda prepared, duration, end, some: replay.respond(choices, prepared, duration, end, *join(some))  # noqa: E731
    return jax.jvp(respond, (prepared, duration, end, some), (moved, later, shift, changes))[1], later


def _complete(legs: tuple[PyTree, Array], record: Record) -> Record:
    """The derivative of a record from that of its starts and durations: choices have none."""
    none = lambda leaf: (  # noqa: E731
        jnp.zeros_like(leaf) if jnp.issubdtype(leaf.dtype, jnp.inexact) else np.zeros(leaf.shape, jax.dtypes.float0)
    )
    return Record(*legs, *jax.tree.map(none, record[2:]))


def hoist_closures(
    probe: Callable[..., PyTree],
    find: Callable[..., PyTree],
    log: Callable[..., tuple[PyTree, Record]],
    replay: Replay,
    *arguments: PyTree,
) -> PyTree:
    """`differentiate_by_replay`, also by numbers that a user's function in the arguments closes over.

    `probe(*arguments)` calls all such functions, and is cheap. Only where it meets a number that is being traced are the
    functions traced as a whole, and what they close over becomes an argument of theirs.
    """
    if not any(isinstance(number, Tracer) for number in jax.make_jaxpr(probe)(*arguments).consts):
        return differentiate_by_replay(find, log, replay, *arguments)
    record = jax.eval_shape(log, *arguments)[1]
    leg = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), record)
    choices, duration = leg.choices, leg.durations
    prepared = jax.eval_shape(replay.prepare, choices, leg.starts, *arguments)
    end, _ = jax.eval_shape(replay.fly, choices, prepared, duration, *arguments)
    numbers: list[list] = []

    def hoist(function: Callable, *first: PyTree) -> Callable:
        opened, closed_over = open_closure(function, *first, *arguments)
        place, count = len(numbers), len(first)
        numbers.append(closed_over)
        return lambda *given: opened(given[count][place], *given[:count], *given[count + 1 :])

    find, log = hoist(find), hoist(log)
    flown = replay._replace(
        begin=lambda numbers, *arguments: replay.begin(*arguments),
        prepare=hoist(replay.prepare, choices, leg.starts),
        fly=hoist(replay.fly, choices, prepared, duration),
        respond=hoist(replay.respond, choices, prepared, duration, end),
    )
    return differentiate_by_replay(find, log, flown, numbers, *arguments)
