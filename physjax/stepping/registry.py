"""The registry of methods, and what a method promises. Charts, tests and tables iterate it; nobody lists methods twice."""

from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

from physjax.stepping.pairs import Pair

METHODS: dict[str, Callable] = {}
"""Every method for scenes of any kind by name, in the order of their definition."""
SPECIAL_METHODS: dict[str, Callable] = {}
"""Every method that is made for forces of one kind: of place and time alone (with others it is of order 1, or refuses them),
or magnetic ones (with forces of place alone it is leapfrog at a higher price)."""


def find_method(name: str) -> Callable:
    """The method of that name; KeyError where there is none.

    Example:
        >>> methods.find_method("rk4") is methods.rk4
        True
    """
    return list_all_methods()[name]


def list_all_methods() -> dict[str, Callable]:
    """Every method by name, the special ones last.

    Example:
        >>> {"rk4", "dprkn6"} <= set(methods.list_all_methods())
        True
    """
    return METHODS | SPECIAL_METHODS


class Promises(NamedTuple):
    """What a method promises, each measured by the tests.

    `order`: the global error falls as dt^order. `evaluations`: force evaluations a step. `stability_limit`: the largest
    stable ω·dt on the undamped oscillator, whose growth stays below 2e-4 a step; 0 where it grows at any step.
    `order_with_drag`: the order once forces depend on velocity, where it differs. `relative_step`: how many times as long
    its steps are at equal errors as those of others of its order, for one that is made for long steps. `looped`: whether
    its stages are a loop, so that the program of a step holds one evaluation.

    Example:
        >>> methods.verlet.promises
        Promises(order=2, evaluations=2, stability_limit=2.0, order_with_drag=2, relative_step=1.0, looped=False)
    """

    order: int
    evaluations: int
    stability_limit: float
    order_with_drag: int
    relative_step: float = 1.0
    looped: bool = False


def promises(
    *,
    order: int,
    evaluations: int,
    stability_limit: float,
    order_with_drag: int | None = None,
    relative_step: float = 1.0,
    looped: bool = False,
    pair: Pair | None = None,
    special: bool = False,
) -> Callable[[Callable], Callable]:
    """Attach promises to a method (`method.promises`) and enter it in `METHODS`, or in `SPECIAL_METHODS`.

    `pair` is what `methods.adaptive` knows the errors of its steps by (`method.pair`).

    Example:
        >>> enter = methods.promises(order=1, evaluations=1, stability_limit=0.0)
        >>> enter(methods.euler) is methods.METHODS["euler"]
        True
    """

    def attach(method: Callable) -> Callable:
        with_drag = order if order_with_drag is None else order_with_drag
        promised = Promises(order, evaluations, stability_limit, with_drag, relative_step, looped)
        method.promises = promised  # pyright: ignore[reportFunctionMemberAccess]  # a function may carry attributes
        if pair is not None:
            method.pair = pair  # pyright: ignore[reportFunctionMemberAccess]
        (SPECIAL_METHODS if special else METHODS)[method.__name__] = method
        return method

    return attach


@runtime_checkable
class Promising(Protocol):
    """A method that says what it promises, as all of the library's do but those that subdivide a step."""

    promises: Promises


def read_promises(method: Callable) -> Promises | None:
    """What a method promises; None for one that promises nothing."""
    return method.promises if isinstance(method, Promising) else None
