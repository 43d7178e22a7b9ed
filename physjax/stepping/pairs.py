"""What a method may offer besides its step: the error of each step, and a memory that lives from step to step.

A pair knows the error of a step from the slopes that it computes anyway, and the path within it. A method with a memory
goes its own way and is read at the ends of dt: simulate carries the memory, and nobody else sees it.
"""

from typing import Any, NamedTuple, Protocol, runtime_checkable

from jax.typing import ArrayLike
from jaxtyping import PyTree

from physjax.loops import Time


class Attempt(NamedTuple):
    """A step that knows its error.

    - `end`: the state at its end; `error`: what that may be wrong by, a tree like the state.
    - `slope`: the rate at the end, with which the next step may begin; None where the method does not compute it.
    - `stages`: what the interpolant needs of the step, arrays shaped like those of the state.
    """

    end: Any
    error: Any
    slope: Any
    stages: PyTree


@runtime_checkable
class Pair(Protocol):
    """Two methods of neighbouring orders on the same slopes. Each replaces what jumps in time by its mean over a step.

    `error_order`: an error falls as dt^(error_order + 1). `dense_order`: a state within the step is right to
    dt^(dense_order + 1), as long as that is no worse than the step itself; 0 where there is no interpolant. Where
    `keeps_slope` the rate at the start of a step is known from the one before.
    """

    @property
    def error_order(self) -> int:
        """See above."""
        ...

    @property
    def dense_order(self) -> int:
        """See above."""
        ...

    @property
    def keeps_slope(self) -> bool:
        """See above."""
        ...

    def attempt(self, system: Any, t: Time, state: Any, dt: ArrayLike, slope: Any) -> Attempt:
        """A step dt [s] from the time t [s]; `slope` is the rate there, None where it is to be computed."""
        ...

    def interpolate(self, system: Any, t: Time, state: Any, dt: ArrayLike, attempt: Attempt, share: ArrayLike) -> Any:
        """The state at a share [1] of a step attempted from `state` at the time t [s], one number for each lane or scene."""
        ...


@runtime_checkable
class Remembering(Protocol):
    """A method that goes its own way and remembers where it is, in trees of arrays that start with the lanes' axes."""

    def __call__(self, system: Any, t: Time, state: Any, dt: ArrayLike) -> Any:
        """A step by itself, without a memory."""
        ...

    def start(self, system: Any, t: Time, state: Any, dt: ArrayLike) -> Any:
        """The memory at the start of a run, before the first step dt [s] from the time t [s]."""
        ...

    def advance(self, system: Any, t: Time, state: Any, dt: ArrayLike, memory: Any) -> tuple[Any, Any]:
        """The state at t + dt [s], and the memory for the next step."""
        ...


def read_pair(method: Any) -> Pair | None:
    """The pair of a method, None where it knows no error of a step."""
    return getattr(getattr(method, "function", method), "pair", None)
