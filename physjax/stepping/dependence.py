"""What depends on what in a traced program: whether a force looks at the velocity is read from it, not guessed."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal
from jaxtyping import Array, PyTree

from physjax.backend import BARRIER
from physjax.components.loop_rules import read_scan_layout
from physjax.loops import Time
from physjax.particles import callable_name
from physjax.scene import Scene
from physjax.stepping.system import System


def find_dependent(function: Callable, *arguments: PyTree, marked: Sequence[bool]) -> list[bool]:
    """For each array that a function returns, whether it depends on any of those `marked` among its arguments' arrays.

    Traced, never run: it depends where an operation reads it, whatever the numbers, so that a drag of zero counts as well.
    An operation that is not known to do less mixes all that it reads.
    """
    return _follow(jax.make_jaxpr(function)(*arguments).jaxpr, marked)


def find_kicked(system: System, state: Any) -> list[bool]:
    """For each array of a state, whether a kick changes it: those are the velocities."""
    count = len(jax.tree.leaves(state))
    return find_dependent(system.kick, state, state, 1.0, marked=[False] * 2 * count + [True])


def pick_leaves(tree: Any, marked: Sequence[bool]) -> list[Array]:
    """The arrays of a tree that are marked."""
    return [leaf for leaf, mark in zip(jax.tree.leaves(tree), marked, strict=True) if mark]


def name_forces_of_velocity(system: System, t: Time, state: Any, kicked: Sequence[bool]) -> str:
    """The forces of a system that look at the velocity, the arrays that are `kicked`; empty where none does."""
    looks = lambda function: any(find_dependent(function, state, marked=kicked))  # noqa: E731
    if not looks(lambda y: pick_leaves(system.rate(t, y), kicked)):
        return ""
    seeing = []
    if isinstance(system, Scene):
        forces, mass = system.forces, system.mass
        seeing = [f for f in forces if looks(lambda y, f=f: y.evaluate_load(f, t, mass))]
    return ", ".join(map(callable_name, seeing)) or "what holds it to a surface"


def _follow(jaxpr: Jaxpr, marked: Sequence[bool]) -> list[bool]:
    """Which results of a program depend on what is marked."""
    known = {var for var, mark in zip(jaxpr.invars, marked, strict=True) if mark}
    reads = lambda atom: not isinstance(atom, Literal) and atom in known  # noqa: E731
    for eqn in jaxpr.eqns:
        ins = [reads(atom) for atom in eqn.invars]
        if any(ins):
            known.update(var for var, mark in zip(eqn.outvars, _follow_operation(eqn, ins), strict=True) if mark)
    return [reads(atom) for atom in jaxpr.outvars]


def _follow_operation(eqn: JaxprEqn, ins: list[bool]) -> list[bool]:
    """Which results of an operation depend on what is marked."""
    name, params, every = eqn.primitive.name, eqn.params, [True] * len(eqn.outvars)
    if name == BARRIER:
        return ins
    if name == "cond":
        chosen = [_follow(branch.jaxpr, ins[1:]) for branch in params["branches"]]
        return every if ins[0] else [any(marks) for marks in zip(*chosen, strict=True)]
    if name == "scan":
        constants, carried = read_scan_layout(params)
        return _follow_turns(
            params["jaxpr"].jaxpr, ins[:constants], ins[constants : constants + carried], ins[constants + carried :]
        )
    if name == "while":
        asked, constants = params["cond_nconsts"], params["body_nconsts"]
        given, start = ins[asked : asked + constants], ins[asked + constants :]
        carried = _follow_turns(params["body_jaxpr"].jaxpr, given, start, [])
        (stops,) = _follow(params["cond_jaxpr"].jaxpr, [*ins[:asked], *carried])
        return every if stops else carried
    bodies = [_open(body) for body in params.values() if isinstance(body, ClosedJaxpr | Jaxpr)]
    calls = [body for body in bodies if (len(body.invars), len(body.outvars)) == (len(ins), len(every))]
    return _follow(calls[0], ins) if len(bodies) == 1 == len(calls) else every


def _follow_turns(turn: Jaxpr, constants: list[bool], carried: list[bool], entries: list[bool]) -> list[bool]:
    """The same of a loop: what one turn marks the next one finds marked."""
    while True:
        after = _follow(turn, [*constants, *carried, *entries])
        grown = [a or b for a, b in zip(carried, after, strict=False)]
        if grown == carried:
            return [*carried, *after[len(carried) :]]
        carried = grown


def _open(body: ClosedJaxpr | Jaxpr) -> Jaxpr:
    return body.jaxpr if isinstance(body, ClosedJaxpr) else body
