"""What a traced program holds, its calls, loops and branches looked into."""

from collections.abc import Iterator

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var

LOOPS = ("while", "scan", "cond")
"""Operations that ask which way to go on."""


def iterate_operations(program: ClosedJaxpr | Jaxpr) -> Iterator[JaxprEqn]:
    """Every operation, those within others as well."""
    jaxpr = program.jaxpr if isinstance(program, ClosedJaxpr) else program
    for eqn in jaxpr.eqns:
        yield eqn
        if eqn.primitive.name == "pallas_call":  # one operation, whatever a kernel does
            continue
        for inner in jax.tree.leaves([*eqn.params.values()]):
            if isinstance(inner, ClosedJaxpr | Jaxpr):
                yield from iterate_operations(inner)


def count_operations(program: ClosedJaxpr | Jaxpr) -> int:
    """How many operations a program holds."""
    return sum(1 for _ in iterate_operations(program))


def holds_loops(program: ClosedJaxpr | Jaxpr) -> bool:
    """Whether a program loops or branches."""
    return any(eqn.primitive.name in LOOPS for eqn in iterate_operations(program))


def describe_value(atom: Var | Literal) -> jax.ShapeDtypeStruct:
    """Shape and type of an operand or a result, which is an array."""
    kind = atom.aval
    return jax.ShapeDtypeStruct(kind.shape, kind.dtype)  # pyright: ignore[reportAttributeAccessIssue]  # of an array
