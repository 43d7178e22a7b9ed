"""The program of one lane run on numbers, with loops and branches that end for a whole block."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal

from physjax.components.loop_rules import read_scan_layout
from physjax.kernels.numbers import (
    Numbers,
    UnsupportedError,
    all_known,
    any_of_block,
    flatten_to_vectors,
    from_known,
    from_list,
    is_known,
    list_entries,
    select,
)
from physjax.kernels.rules import RULES, apply_known
from physjax.programs import count_operations, describe_value

MAX_UNROLLED_TURNS = 16
"""A loop of at most this many turns is written out: the stages of a method, whose coefficients are then known."""
CALLS = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "eval_jaxpr": "call_jaxpr",
    "core_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "custom_vmap_call": "call",
    "checkpoint": "jaxpr",
    "remat2": "jaxpr",
}
"""Calls, which are written out, and where their program is kept."""


class LaneInterpreter:
    """Runs the program of one lane for a block of them."""

    def __init__(self, block: int) -> None:
        self.block = block

    def run(self, jaxpr: Jaxpr, constants: Sequence[Numbers], ins: Sequence[Numbers]) -> list[Numbers]:
        """The results of a program, its operations one after the other."""
        known = dict(zip(jaxpr.constvars, constants, strict=True))
        known |= dict(zip(jaxpr.invars, ins, strict=True))

        def read(atom: Any) -> Numbers:
            return (
                from_known(np.asarray(atom.val, describe_value(atom).dtype))
                if isinstance(atom, Literal)
                else known[atom]
            )

        for eqn in jaxpr.eqns:
            known |= zip(eqn.outvars, self._apply(eqn, [read(atom) for atom in eqn.invars]), strict=True)
        return [read(atom) for atom in jaxpr.outvars]

    def _run_closed(self, program: ClosedJaxpr | Jaxpr, ins: Sequence[Numbers]) -> list[Numbers]:
        if isinstance(program, ClosedJaxpr):
            return self.run(program.jaxpr, [*map(_demand_known, program.consts)], ins)
        return self.run(program, (), ins)

    def _apply(self, eqn: JaxprEqn, ins: list[Numbers]) -> list[Numbers]:
        name = eqn.primitive.name
        if name in CALLS:
            return self._run_closed(eqn.params[CALLS[name]], ins)
        if name == "call_hi_primitive":  # from jax 0.11 on, such as a root with a rule for its derivative
            lowered = jax.make_jaxpr(partial(eqn.primitive.to_lojax, **eqn.params))  # pyright: ignore[reportOptionalCall, reportArgumentType]
            return self._run_closed(lowered(*map(describe_value, eqn.invars)), ins)
        if name == "cond":
            return self._branch(eqn, ins)
        if name == "while":
            return self._loop(eqn, ins)
        if name == "scan":
            return self._scan(eqn, ins)
        if all_known(ins):
            return apply_known(eqn, ins)
        if name not in RULES:
            raise UnsupportedError(name)
        return RULES[name](eqn, ins)

    def _branch(self, eqn: JaxprEqn, ins: list[Numbers]) -> list[Numbers]:
        """Of two branches the shorter is computed, and the longer only if a lane of the block takes it."""
        (index, *operands), branches = ins, eqn.params["branches"]
        number = index[()]
        if is_known(number):
            return self._run_closed(branches[int(np.clip(number, 0, len(branches) - 1))], operands)
        if len(branches) > 2:
            raise UnsupportedError(f"a choice among {len(branches)} branches")
        taken = number if number.dtype == bool else number > 0
        long = max((0, 1), key=lambda i: count_operations(branches[i]))
        at_long = taken if long else ~taken
        short = self._run_closed(branches[1 - long], operands)
        kinds, shapes = _describe_results(eqn)
        otherwise = flatten_to_vectors(short, kinds, self.block)
        found = lax.cond(
            any_of_block(at_long),
            lambda: flatten_to_vectors(self._run_closed(branches[long], operands), kinds, self.block),
            lambda: otherwise,
        )
        return _unflatten([select(at_long, a, b) for a, b in zip(found, otherwise, strict=True)], shapes)

    def _loop(self, eqn: JaxprEqn, ins: list[Numbers]) -> list[Numbers]:
        """A loop ends when all lanes of the block are done; those that were done before stay as they were."""
        params, (kinds, shapes) = eqn.params, _describe_results(eqn)
        first, second = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
        asked, constants = ins[:first], ins[first:second]
        start = flatten_to_vectors(ins[second:], kinds, self.block)

        def goes(now: Sequence[Any]) -> Any:
            going = self._run_closed(params["cond_jaxpr"], [*asked, *_unflatten(now, shapes)])
            return flatten_to_vectors(going, [np.dtype(bool)], self.block)[0]

        def turn(state: tuple) -> tuple:
            going, now = state
            after = self._run_closed(params["body_jaxpr"], [*constants, *_unflatten(now, shapes)])
            after = flatten_to_vectors(after, kinds, self.block)
            chosen = [select(going, a, b) for a, b in zip(after, now, strict=True)]
            return going & goes(chosen), chosen

        _, end = lax.while_loop(lambda state: any_of_block(state[0]), turn, (goes(start), start))
        return _unflatten(end, shapes)

    def _scan(self, eqn: JaxprEqn, ins: list[Numbers]) -> list[Numbers]:
        """A few turns are written out; many are a loop, which may carry but not gather."""
        params = eqn.params
        constant_count, carry_count = read_scan_layout(params)
        constants, along = ins[:constant_count], ins[constant_count + carry_count :]
        carry, length = ins[constant_count : constant_count + carry_count], params["length"]
        if length <= MAX_UNROLLED_TURNS:
            kept, order = {}, range(length)
            for i in reversed(order) if params["reverse"] else order:
                found = self._run_closed(
                    params["jaxpr"], [*constants, *carry, *(list_entries(numbers)[i] for numbers in along)]
                )
                carry, kept[i] = found[:carry_count], found[carry_count:]
            return [*carry, *(np.stack(entries) for entries in zip(*map(kept.get, order), strict=True))]
        if along or len(eqn.outvars) > carry_count:
            raise UnsupportedError(f"a loop of {length} turns along arrays")
        kinds, shapes = _describe_results(eqn)

        def turn(_: Any, now: list) -> list:
            after = self._run_closed(params["jaxpr"], [*constants, *_unflatten(now, shapes)])
            return flatten_to_vectors(after, kinds, self.block)

        end = lax.fori_loop(0, length, turn, flatten_to_vectors(carry, kinds, self.block))
        return _unflatten(end, shapes)


def _describe_results(eqn: JaxprEqn) -> tuple[list[Any], list[tuple[int, ...]]]:
    """Types and shapes of what comes out."""
    described = [*map(describe_value, eqn.outvars)]
    return [d.dtype for d in described], [d.shape for d in described]


def _unflatten(numbers: Sequence[Any], shapes: Sequence[tuple[int, ...]]) -> list[Numbers]:
    ends = np.cumsum([0, *(int(np.prod(shape)) for shape in shapes)])
    return [from_list(numbers[first:last], shape) for first, last, shape in zip(ends, ends[1:], shapes, strict=False)]


def _demand_known(constant: Any) -> Numbers:
    if isinstance(constant, Tracer):
        raise UnsupportedError("an array that is closed over and traced")
    return from_known(constant)
