"""Kinematic nodes: lanes whose motion is prescribed, such as the hand that shakes a flag or the limb that drags a body."""

import inspect
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, PyTree

from physjax.backend import block_fusion
from physjax.checks import concrete_or_none, unchecked_quantity
from physjax.particles import Particles, demand_particles
from physjax.parts import as_module
from physjax.tracebacks import Module
from physjax.vectors import add_trailing_axes, components, stack_components


class Pins(Module):
    """Prescribed motion: `Scene(..., pinned=Pins(nodes, path))` moves the lanes of the mask `nodes` along `path(t)`.

    `path(t) -> positions` [m] of all lanes, `(*lanes, dim)` or broadcastable to it; only the rows of `nodes` count. It is a
    function of the time alone: what starts somewhere is moved from there, `lambda t: start.position + velocity * t`.
    Forces see the nodes on the path at the time of each evaluation, with the velocity of the path (its derivative), so
    that a method keeps its order where the path is smooth; after each step the nodes are on the path exactly. `t` [s] is a
    scalar, or shaped to broadcast with the lanes where a run has many step sizes. Numbers of a path that is an
    `equinox.Module` can be swept and differentiated; a plain function recompiles for each new one. Kinematic nodes
    must start on the path: `state = pins.prescribe(0.0, state)`. Raises ValueError or TypeError otherwise.

    Example:
        >>> hand = Pins(sheet.nodes["left"], path=lambda t: sheet.state.position + jnp.array([0.0, 2.0, 0.0]) * t)
        >>> prescribed = hand.prescribe(0.5, sheet.state)
        >>> print(prescribed.position[0], prescribed.velocity[0])
        [0. 1. 0.] [0. 2. 0.]
    """

    path: Callable
    nodes: Bool[Array, "*lanes"] = unchecked_quantity("prescribed nodes", per="memory")

    def __init__(self, nodes: ArrayLike, path: Callable):
        nodes = as_mask("Pins", nodes)
        if nodes.dtype != bool:
            raise ValueError(f"Pins: got nodes of dtype {nodes.dtype}, expected booleans, one for each lane.")
        if not callable(path) or isinstance(path, type):
            raise TypeError(
                f"Pins: got the path {path!r}, expected a function t -> positions. To hold lanes where they are, give "
                "the mask alone: pinned=nodes."
            )
        _demand_time_alone(path)
        self.nodes = nodes
        self.path = as_module(path)

    def prescribe(self, t: ArrayLike, state: Particles) -> Particles:
        """The state with the kinematic nodes on the path at the time t [s], with its velocity."""
        position, velocity = self._motion(t, state)
        position, velocity = (
            self._replace_prescribed(position, state.position),
            self._replace_prescribed(velocity, state.velocity),
        )
        # materialised: XLA on CPU would evaluate the path again for every neighbour that reads a node
        return state._replace(**block_fusion({"position": position, "velocity": velocity}))

    lead = prescribe
    """The name of the first edition."""

    def prescribe_acceleration(
        self, t: ArrayLike, state: Particles, acceleration: Float[Array, "*lanes dim"]
    ) -> Float[Array, "*lanes dim"]:
        """The accelerations [m/s²], at kinematic nodes the second derivative of the path."""
        t = self._clock(t, state)
        _, path_acceleration = jax.jvp(lambda t: self._motion(t, state)[1], (t,), (jnp.ones_like(t),))
        return self._replace_prescribed(path_acceleration, acceleration)

    def prepare(self, state: PyTree) -> "Pins":
        """The pins as part of a scene that starts in this state, their numbers in its dtype; the checks are here."""
        demand_particles("Pins", state, "bodies are held by a mask, or by a point of theirs, mass=inertia.about(point)")
        if self.nodes.shape != state.lanes:
            raise ValueError(
                f"Pins: got nodes of shape {self.nodes.shape}, expected booleans of the lanes' shape {state.lanes}."
            )
        cast = lambda leaf: leaf.astype(state.dtype) if eqx.is_inexact_array(leaf) else leaf  # noqa: E731
        pins = jax.tree.map(cast, self)
        _demand_start(pins, state)
        return pins

    def _clock(self, t: ArrayLike, state: Particles) -> Array:
        """The time in the state's dtype, with axes for the lanes of each scene where scenes have times of their own."""
        return add_trailing_axes(jnp.asarray(t, state.dtype), len(state.lanes))

    def _motion(self, t: ArrayLike, state: Particles) -> tuple[Array, Array]:
        """Position [m] and velocity [m/s] of the path, for all lanes."""
        t, shape = self._clock(t, state), state.position.shape

        def positions(t):
            value = jnp.asarray(self.path(t))
            if not jnp.issubdtype(value.dtype, jnp.number) or not _is_broadcastable(value.shape, shape):
                raise ValueError(
                    f"Pins: the path returns {value.dtype} of shape {value.shape} for a time of shape {t.shape}, expected "
                    f"positions [m] of the shape {shape} or broadcastable to it: (*lanes, dim), as the state has."
                )
            return value.astype(state.dtype)

        position, velocity = jax.jvp(positions, (t,), (jnp.ones_like(t),))
        return jnp.broadcast_to(position, shape), jnp.broadcast_to(velocity, shape)

    def _replace_prescribed(self, prescribed: Array, free: Array) -> Array:
        # by components: a choice between whole vectors takes half as long again
        pairs = zip(components(prescribed), components(free), strict=True)
        return stack_components([jnp.where(self.nodes, a, b) for a, b in pairs])


def as_mask(who: str, nodes: ArrayLike) -> Array:
    """A mask of lanes as an array; TypeError for the name of a set, and all else that is no array."""
    try:
        return jnp.asarray(nodes)
    except TypeError:
        raise TypeError(
            f"{who}: got {nodes!r}, expected a mask, booleans of the lanes' shape: of a lattice lattice.nodes['left']."
        ) from None


def _demand_time_alone(path: Callable) -> None:
    """Raise a TypeError unless a path can be called with one argument."""
    try:
        signature = inspect.signature(path)
    except ValueError:  # of some functions written in C nothing is known
        return
    try:
        signature.bind(0.0)
    except TypeError:
        raise TypeError(
            f"Pins: got a path that takes {signature}, expected a function of the time alone, t -> positions [m] of all "
            "lanes. Move nodes from where they start: path=lambda t: state.position + velocity * t."
        ) from None


def _is_broadcastable(shape: tuple[int, ...], whole: tuple[int, ...]) -> bool:
    """Whether an array of one shape can be broadcast to another."""
    pairs = zip(shape[::-1], whole[::-1], strict=False)
    return len(shape) <= len(whole) and all(n in (1, wanted) for n, wanted in pairs)


def _demand_start(pins: Pins, state: Particles) -> None:
    """Raise a ValueError unless the path is finite at t = 0 and the kinematic nodes start on it, to rounding."""
    position, velocity = pins._motion(0.0, state)
    nodes, x = concrete_or_none(pins.nodes), concrete_or_none(state.position)
    position, velocity = concrete_or_none(position), concrete_or_none(velocity)
    if nodes is None or position is None or velocity is None:
        return
    where = np.argwhere(nodes)
    for name, value in (("path(0) [m]", position), ("velocity of the path at t = 0 [m/s]", velocity)):
        bad = ~np.isfinite(value[nodes]).all(axis=-1)
        if bad.any():
            raise ValueError(
                f"Pins: {name} is {value[nodes][bad][0]} at lane {where[bad][0].tolist()}, expected finite numbers."
            )
    if x is None:
        return
    off = np.abs(x - position)[nodes].max(axis=-1, initial=0.0)
    far = off > 16 * float(jnp.finfo(state.dtype).eps) * max(np.abs(x).max(), np.abs(position[nodes]).max(initial=0.0))
    if far.any():
        raise ValueError(
            f"Pins: {far.sum()} of {far.size} nodes do not start on the path: lane {where[far][0].tolist()} is at "
            f"{x[nodes][far][0]}, path(0) is {position[nodes][far][0]} [m]. Start there: state = pins.prescribe(0.0, state)."
        )
