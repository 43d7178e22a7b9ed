"""What stepping asks of physics: a system, which every `Scene` is, and what a method is.

Only `rate`, `kick` and `drift` are needed. A scene also says which lanes share a step, which are held, how heavy they
are, and where its forces jump; a system that says nothing of that is one coupled system of unit mass.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, PyTree

from physjax.loops import Time

S = TypeVar("S")
"""A state, any tree of floating-point arrays; its rate is a tree of the same structure."""


@runtime_checkable
class System(Protocol):
    """What a method sees. `kick` and `drift` split a step: the first changes velocities, the second positions."""

    def rate(self, t: Time, state: Any) -> Any:
        """Time derivative of the whole state: the right-hand side of the equations of motion."""
        ...

    def kick(self, state: Any, rate: Any, dt: ArrayLike) -> Any:
        """The state with its velocities changed by what the rate says for a time dt [s]."""
        ...

    def drift(self, state: Any, dt: ArrayLike) -> Any:
        """The state with its positions moved by its velocities for a time dt [s]."""
        ...


@runtime_checkable
class Method(Protocol):
    """How a state moves through one step; t [s] and dt [s] are scalars or one per lane."""

    def __call__(self, system: Any, t: Time, state: Any, dt: ArrayLike) -> Any:
        """The state at t + dt."""
        ...


class SystemTraits(NamedTuple):
    """What a system may say of itself; the defaults are those of one that only moves.

    `couples`: whether lanes depend on each other. `status_shape`: for what there is one step size: a lane, or a scene
    where lanes are coupled. `held`: lanes that no force moves. `mass` [kg] weights the residual of an implicit step.
    `compile_bound`: whether a small program is worth more than a fast one: stages are then a loop. `normalised(state)`
    is what a step leaves, as it must be. `averaged_over_step(t, dt)` and `linearised_at(t, state)` give the system to be
    stepped, and differentiated, instead.
    """

    couples: bool = True
    status_shape: tuple[int, ...] = ()
    held: Bool[Array, "*lanes"] | None = None
    mass: PyTree = 1.0
    forces: tuple = ()
    dissipative_symmetric: bool = False
    compile_bound: bool = False
    averaged_over_step: Callable | None = None
    normalised: Callable | None = None
    linearised_at: Callable | None = None


def read_traits(system: System) -> SystemTraits:
    """What a system says of itself: the one place that looks for what it need not have."""
    return SystemTraits(**{name: getattr(system, name) for name in SystemTraits._fields if hasattr(system, name)})


def average_over_step(system: System, t: Time, dt: ArrayLike) -> System:
    """The system with what jumps in time replaced by its mean over the step from t to t + dt [s]."""
    average = read_traits(system).averaged_over_step
    return system if average is None else average(t, dt)


def linearise_at(system: System, t: Time, state: PyTree) -> System:
    """The system that an implicit step differentiates at a state."""
    linearise = read_traits(system).linearised_at
    return system if linearise is None else linearise(t, state)


def push_drift(system: System, state: S, elapsed: ArrayLike, change: ArrayLike) -> S:
    """How far a state that has drifted for some time [s] drifts on in a change of time [s], to first order."""
    times = tuple(jnp.asarray(time, leaf_dtype(state)) for time in (elapsed, change))
    at, further = jnp.broadcast_arrays(*times)
    return jax.jvp(lambda h: system.drift(state, h), (at,), (further,))[1]


@runtime_checkable
class _LaneRecord(Protocol):
    @property
    def lanes(self) -> tuple[int, ...]: ...


def has_no_lanes(state: PyTree) -> bool:
    """Whether a state is that of one body alone; a state that has no `lanes` may be anything."""
    return isinstance(state, _LaneRecord) and state.lanes == ()


def count_lane_axes(state: PyTree) -> int:
    """How many axes of lanes the arrays of a state have in front: none where it does not say."""
    return len(state.lanes) if isinstance(state, _LaneRecord) else 0


def leaf_dtype(state: PyTree) -> jax.numpy.dtype:
    """The floating-point type of a state."""
    return jax.tree.leaves(state)[0].dtype
