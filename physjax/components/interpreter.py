"""A program computed by components: its equations one after the other, each by its rule, whole where there is none."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, jaxpr_as_fun
from jaxtyping import PyTree

from physjax.components.array_rules import ARRAY_RULES
from physjax.components.loop_rules import LOOP_RULES, SplitProgram
from physjax.components.values import (
    Value,
    describe_array,
    describe_whole,
    from_array,
    is_stored,
    restore_value,
    store_result,
)


class SplittingInterpreter:
    """Runs programs on values; what a loop or a call holds is split once for each way in which operands come."""

    def __init__(self) -> None:
        self._split: dict[tuple, tuple[Jaxpr, SplitProgram]] = {}

    def run(self, jaxpr: Jaxpr, constants: Sequence[Any], ins: Sequence[Value]) -> list[Value]:
        """The results of a program, its equations one after the other."""
        known = dict(zip(jaxpr.constvars, map(from_array, constants), strict=True))
        known |= dict(zip(jaxpr.invars, ins, strict=True))

        def read(atom: Any) -> Value:
            return from_array(atom.val) if isinstance(atom, Literal) else known[atom]

        for eqn in jaxpr.eqns:
            known |= zip(eqn.outvars, self._apply(eqn, [read(atom) for atom in eqn.invars]), strict=True)
        return [read(atom) for atom in jaxpr.outvars]

    def _apply(self, eqn: JaxprEqn, ins: list[Value]) -> list[Value]:
        name, found = eqn.primitive.name, None
        if name in ARRAY_RULES:
            found = ARRAY_RULES[name](eqn, ins)
        elif name in LOOP_RULES:
            found = LOOP_RULES[name](self, eqn, ins)
        if found is not None:
            return found
        params = eqn.primitive.get_bind_params(eqn.params)
        whole = eqn.primitive.bind(*(value.whole() for value in ins), **params)
        return [from_array(array) for array in (whole if eqn.primitive.multiple_results else [whole])]

    def split(
        self, jaxpr: Jaxpr, constants: Sequence[Any], stored: Sequence[Any], wanted: Sequence[bool | None]
    ) -> SplitProgram:
        """A program split for operands that are stored like these, with its results split (True), whole (False) or as they are.

        It is traced here, and once for all that ask for the same.
        """
        leaves, structure = jax.tree.flatten(list(stored))
        key = (id(jaxpr), structure, tuple(wanted))
        if key not in self._split:  # which keeps the program, so that its identity stays its own
            self._split[key] = jaxpr, self._trace(jaxpr, constants, leaves, structure, wanted)
        return self._split[key][1]

    def _trace(
        self, jaxpr: Jaxpr, constants: Sequence[Any], leaves: list, structure: Any, wanted: Sequence[bool | None]
    ) -> SplitProgram:
        made: list[bool] = []
        results: list[Any] = []

        def flat(*leaves: Any) -> list:
            found = self.run(jaxpr, constants, [restore_value(a) for a in structure.unflatten(leaves)])
            made[:] = [value.is_vector for value in found]
            out, after = jax.tree.flatten([store_result(v, split) for v, split in zip(found, wanted, strict=True)])
            results[:] = [after]
            return out

        program = jaxpr_as_fun(jax.make_jaxpr(flat)(*map(describe_array, leaves)))
        (after,) = results
        return SplitProgram(lambda *stored: after.unflatten(program(*jax.tree.leaves(stored))), tuple(made))


class SplitFunction(NamedTuple):
    """A function of split trees, and the program of the one of whole arrays that it came from."""

    program: ClosedJaxpr
    call: Callable[..., PyTree]

    def __call__(self, *trees: PyTree) -> PyTree:
        """Its result."""
        return self.call(*trees)


def compute_by_components(function: Callable[..., PyTree], *examples: PyTree, like: PyTree = None) -> SplitFunction:
    """A function of trees of arrays as one of trees whose vectors are split, as in the examples; its result is split `like` that.

    Without `like`, the arrays of the result are whole.

    The function is traced once, here, with whole arrays; what it closes over is a constant.
    """
    described = jax.tree.map(describe_whole, examples, is_leaf=is_stored)
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*described)
    structure = jax.tree.structure(shape)
    asked = shape if like is None else like
    wanted = [is_stored(leaf) for leaf in jax.tree.leaves(asked, is_leaf=is_stored)]
    interpreter = SplittingInterpreter()

    def by_components(*trees: PyTree) -> PyTree:
        ins = [restore_value(leaf) for leaf in jax.tree.leaves(trees, is_leaf=is_stored)]
        found = interpreter.run(closed.jaxpr, closed.consts, ins)
        return structure.unflatten([store_result(v, split) for v, split in zip(found, wanted, strict=True)])

    return SplitFunction(closed, by_components)
