"""What holds programs of its own: loops, branches, calls and custom derivatives, each rebuilt around a split program.

A loop carries a vector by its components where it gets one, or where a turn makes one. Custom derivatives keep their
rule, which is split as well: it is a function of the same vectors. Where nothing in the operands is split, nothing is
rebuilt.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn

from physjax.components.array_rules import Results
from physjax.components.values import Value, describe_whole, restore_value, store_value

INLINED_EQUATIONS = 12
"""A call of at most this many operations is written out: as a call it would take as many to pass components."""


class SplitProgram(NamedTuple):
    """A program whose vectors are passed by components: `call` maps stored operands to stored results.

    `makes_vector`: for each result whether it is a vector when nobody asks for another form.
    """

    call: Callable[..., list[Any]]
    makes_vector: tuple[bool, ...]


@runtime_checkable
class Interpreter(Protocol):
    """What the rules ask of the interpreter."""

    def run(self, jaxpr: Jaxpr, constants: Sequence[Any], ins: Sequence[Value]) -> list[Value]:
        """The results of a program, its equations one after the other."""
        ...

    def split(
        self, jaxpr: Jaxpr, constants: Sequence[Any], stored: Sequence[Any], wanted: Sequence[bool | None]
    ) -> SplitProgram:
        """A program split for operands stored like these, its results split (True), whole (False) or as they are."""
        ...


def apply_call(run: Interpreter, eqn: JaxprEqn, ins: list[Value]) -> Results:
    """A compiled function within the program stays one, so that it is lowered once for all its calls."""
    inner = eqn.params["jaxpr"]
    shardings = (*eqn.params["in_shardings"], *eqn.params["out_shardings"])
    if any(type(sharding).__name__ != "UnspecifiedValue" for sharding in shardings):
        return None
    if len(inner.jaxpr.eqns) <= INLINED_EQUATIONS and not all(value.is_plain for value in ins):
        return run.run(inner.jaxpr, inner.consts, ins)
    if not any(value.is_vector for value in ins):
        return None
    stored = [store_value(value) for value in ins]
    program = run.split(inner.jaxpr, inner.consts, stored, (None,) * len(eqn.outvars))
    return _restore(jax.jit(program.call)(*stored))


def apply_remat(run: Interpreter, eqn: JaxprEqn, ins: list[Value]) -> Results:
    """What reverse mode computes again stays that."""
    params = eqn.params
    if params["differentiated"] or not any(value.is_vector for value in ins):
        return None
    stored = [store_value(value) for value in ins]
    program = run.split(params["jaxpr"], (), stored, (None,) * len(eqn.outvars))
    return _restore(jax.checkpoint(program.call, prevent_cse=params["prevent_cse"], policy=params["policy"])(*stored))


def apply_cond(run: Interpreter, eqn: JaxprEqn, ins: list[Value]) -> Results:
    """Branches: a result is split where one of them makes a vector."""
    (index, *operands), branches = ins, eqn.params["branches"]
    if not any(value.is_vector for value in operands):
        return None
    stored = [store_value(value) for value in operands]

    def split(wanted: Sequence[bool | None]) -> list[SplitProgram]:
        return [run.split(branch.jaxpr, branch.consts, stored, wanted) for branch in branches]

    programs = split((None,) * len(eqn.outvars))
    vector = tuple(any(made) for made in zip(*(program.makes_vector for program in programs), strict=True))
    if any(program.makes_vector != vector for program in programs):
        programs = split(vector)
    if len(programs) == 2:
        return _restore(lax.cond(index.whole(), programs[1].call, programs[0].call, *stored))
    return _restore(lax.switch(index.whole(), [program.call for program in programs], *stored))


def _split_turn(
    run: Interpreter, body: ClosedJaxpr, constants: list, carry: list[Value], entries: list, kept: int
) -> tuple[SplitProgram, tuple[bool, ...]]:
    """A turn of a loop, and which arrays it carries by components: those that come in so, and those that a turn makes so."""
    vector = tuple(value.is_vector for value in carry)
    while True:
        stored = [*constants, *_store_carry(carry, vector), *entries]
        program = run.split(body.jaxpr, body.consts, stored, (*vector, *(None,) * kept))
        wanted = tuple(a or b for a, b in zip(vector, program.makes_vector[: len(carry)], strict=True))
        if wanted == vector:
            return program, vector
        vector = wanted


def _store_carry(carry: list[Value], vector: tuple[bool, ...]) -> list[Any]:
    return [store_value(value, split) for value, split in zip(carry, vector, strict=True)]


def apply_loop(run: Interpreter, eqn: JaxprEqn, ins: list[Value]) -> Results:
    """A scan: vectors that it goes along are split over all of its length."""
    if not any(value.is_vector for value in ins):
        return None
    params = eqn.params
    constant_count, carry_count = read_scan_layout(params)
    end = constant_count + carry_count
    constants = [store_value(value) for value in ins[:constant_count]]
    carry = ins[constant_count:end]
    along = [store_value(value, value.is_vector and len(value.shape) > 1) for value in ins[end:]]
    entries = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), along)
    program, vector = _split_turn(run, params["jaxpr"], constants, carry, entries, len(eqn.outvars) - carry_count)

    def turn(now: list, entry: list) -> tuple[list, list]:
        after = program.call(*constants, *now, *entry)
        return after[:carry_count], after[carry_count:]

    start = _store_carry(carry, vector)
    last, kept = lax.scan(turn, start, along, params["length"], params["reverse"], params["unroll"])
    return _restore([*last, *kept])


def read_scan_layout(params: dict[str, Any]) -> tuple[int, int]:
    """How many operands of a scan are constants and how many are carried, from the parameters of its equation."""
    if "num_carry" in params:
        return params["num_consts"], params["num_carry"]
    constants, carry, _ = params["ft_in"].unpack()  # from jax 0.11 on
    return len(constants), len(carry)


def apply_while(run: Interpreter, eqn: JaxprEqn, ins: list[Value]) -> Results:
    """A loop with an end that it finds."""
    if not any(value.is_vector for value in ins):
        return None
    params = eqn.params
    condition, body = params["cond_jaxpr"], params["body_jaxpr"]
    first, second = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
    asked, constants = ([store_value(value) for value in some] for some in (ins[:first], ins[first:second]))
    program, vector = _split_turn(run, body, constants, ins[second:], [], 0)
    start = _store_carry(ins[second:], vector)
    going = run.split(condition.jaxpr, condition.consts, [*asked, *start], (False,))
    turn = lambda now: program.call(*constants, *now)  # noqa: E731
    return _restore(lax.while_loop(lambda now: going.call(*asked, *now)[0], turn, start))


def apply_custom_jvp(run: Interpreter, eqn: JaxprEqn, ins: list[Value]) -> Results:
    """A function with a rule for its derivative: the function split, with the same rule, split."""
    if not any(value.is_vector for value in ins):
        return None
    body, stored = eqn.params["call_jaxpr"], [store_value(value) for value in ins]
    program = run.split(body.jaxpr, body.consts, stored, (None,) * len(eqn.outvars))
    operands, structure = jax.tree.flatten(stored)
    function = jax.custom_jvp(lambda *leaves: program.call(*structure.unflatten(leaves)))
    whole = lambda *arrays: eqn.primitive.bind(*arrays, **eqn.primitive.get_bind_params(eqn.params))  # noqa: E731

    def rule(primals: tuple, tangents: tuple) -> tuple[list, list]:
        along = jax.tree.unflatten(structure, primals), jax.tree.unflatten(structure, tangents)
        return _push_forward(run, whole, *along, program.makes_vector)

    function.defjvp(rule, symbolic_zeros=True)
    return _restore(function(*operands))


def _push_forward(
    run: Interpreter, whole: Callable, primals: list, tangents: list, makes_vector: tuple[bool, ...]
) -> tuple[list, list]:
    """Values and changes of a function of whole arrays along what moves, by its own rule, computed on components.

    What does not move stays a constant of the rule.
    """
    moving = [i for i, tangent in enumerate(tangents) if not all(map(_is_zero, _flatten_tangent(tangent)))]
    pushes = [jax.tree.map(_make_zero, tangents[i], is_leaf=_is_zero) for i in moving]

    def push(arrays: list, pushes: list) -> tuple[list, list]:
        def along(*some: Any) -> list:
            moved = dict(zip(moving, some, strict=True))
            return whole(*(moved.get(i, array) for i, array in enumerate(arrays)))

        values, changes = jax.jvp(along, [arrays[i] for i in moving], pushes)
        return values, [change for change in changes if change.dtype != jax.dtypes.float0]

    rule = jax.make_jaxpr(push)(*([describe_whole(array) for array in group] for group in (primals, pushes)))
    moves = [jnp.issubdtype(kind.dtype, jnp.inexact) for kind in rule.out_avals[: len(makes_vector)]]
    wanted = (*makes_vector, *(vector for vector, moved in zip(makes_vector, moves, strict=True) if moved))
    found = run.split(rule.jaxpr, rule.consts, [*primals, *pushes], wanted).call(*primals, *pushes)
    values, changes = found[: len(moves)], iter(found[len(moves) :])
    return values, [next(changes) if moved else _still(value) for value, moved in zip(values, moves, strict=True)]


def _is_zero(leaf: Any) -> bool:
    return isinstance(leaf, SymbolicZero)


def _flatten_tangent(tangent: Any) -> list:
    return jax.tree.leaves(tangent, is_leaf=_is_zero)


def _make_zero(tangent: Any) -> Any:
    return jnp.zeros(tangent.shape, tangent.dtype) if _is_zero(tangent) else tangent


def _still(value: Any) -> Any:
    """The change of what cannot be differentiated."""
    return jax.tree.map(lambda leaf: np.zeros(leaf.shape, jax.dtypes.float0), value)


def _restore(stored: Sequence[Any]) -> list[Value]:
    return [restore_value(array) for array in stored]


LOOP_RULES: dict[str, Callable[[Interpreter, JaxprEqn, list[Value]], Results]] = {
    "jit": apply_call,
    "pjit": apply_call,
    "checkpoint": apply_remat,
    "remat2": apply_remat,
    "cond": apply_cond,
    "scan": apply_loop,
    "while": apply_while,
    "custom_jvp_call": apply_custom_jvp,
}
"""The rule for each primitive by its name."""
