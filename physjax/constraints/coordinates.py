"""What joints ask of a state record: where bodies are and how they move, as arrays with the bodies and the worlds last."""

from typing import Protocol

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from physjax.particles import Particles
from physjax.vectors import scale

Moves = Float[Array, "freedoms *rest"]
"""Velocities of bodies, small moves of them or impulses on them, by their freedoms: of a point the components."""
Places = Float[Array, "numbers *rest"]
"""Where bodies are."""


class Coordinates(Protocol):
    """How bodies of one kind are read and moved; a world is a scene of a batch, all of which are solved side by side."""

    @property
    def dim(self) -> int:
        """How many of the numbers of a place are a position [m], the first ones."""
        ...

    @property
    def freedoms(self) -> int:
        """In how many ways a body moves."""
        ...

    def read_places(self, state: PyTree) -> Places:
        """Where the bodies are, `(numbers, bodies, worlds)`."""
        ...

    def read_rates(self, state: PyTree, mass: PyTree) -> Moves:
        """How they move, `(freedoms, bodies, worlds)`."""
        ...

    def displace(self, places: Places, moves: Moves) -> Places:
        """The places after small moves, to first order."""
        ...

    def carry_on(self, places: Places, before: Places, after: Places) -> Places:
        """The places, moved by what leads from one to the other of two more."""
        ...

    def read_mobility(self, state: PyTree, mass: PyTree) -> Array:
        """What turns impulses into velocities, `(numbers, bodies, worlds)`."""
        ...

    def measure_bodies(self, mobility: Array) -> Float[Array, "bodies worlds"]:
        """The size of each body [m], such as its radius of gyration; zero for a point."""
        ...

    def apply_mobility(self, mobility: Array, impulses: Moves) -> Moves:
        """The velocities that impulses `(freedoms, *rest)` give, where the mobility has as many axes."""
        ...

    def put_places(self, state: PyTree, other: PyTree) -> PyTree:
        """The state with the places of another."""
        ...

    def push(self, state: PyTree, mass: PyTree, impulses: Moves) -> PyTree:
        """The state, or a rate of states, with impulses `(freedoms, bodies, worlds)` added to the momenta."""
        ...


def put_worlds_last(number: Array, lanes: tuple[int, ...]) -> Array:
    """A number per lane, `()` or `(*worlds, bodies)` with or without components, as `(components, bodies, worlds)`."""
    own = number.shape[len(lanes) :] if number.ndim >= len(lanes) and number.shape[: len(lanes)] == lanes else ()
    spread = jnp.broadcast_to(number, (*lanes, *own)).reshape(-1, lanes[-1], *own)
    return jnp.moveaxis(spread, (0, 1), (-1, -2))


def put_worlds_first(moves: Moves, lanes: tuple[int, ...]) -> Float[Array, "*lanes freedoms"]:
    """The inverse of `put_worlds_last` for vectors."""
    return jnp.moveaxis(moves, (-1, -2), (0, 1)).reshape(*lanes, len(moves))


class PointCoordinates:
    """Point masses: their places and velocities."""

    def __init__(self, dim: int):
        self.dim = self.freedoms = dim

    def read_places(self, state: Particles) -> Places:
        """Positions [m]."""
        return put_worlds_last(state.position, state.lanes)

    def read_rates(self, state: Particles, mass: Array) -> Moves:
        """Velocities [m/s]."""
        return put_worlds_last(state.velocity, state.lanes)

    def displace(self, places: Places, moves: Moves) -> Places:
        """x + d."""
        return places + moves

    def carry_on(self, places: Places, before: Places, after: Places) -> Places:
        """The difference added."""
        return places + (after - before)

    def read_mobility(self, state: Particles, mass: Array) -> Array:
        """1/m [1/kg]."""
        return put_worlds_last(1 / mass, state.lanes)[None]

    def measure_bodies(self, mobility: Array) -> Array:
        """Points have no size."""
        return jnp.zeros_like(mobility[0])

    def apply_mobility(self, mobility: Array, impulses: Moves) -> Moves:
        """Δv = P/m."""
        return mobility * impulses

    def put_places(self, state: Particles, other: Particles) -> Particles:
        """The velocities of one, the positions of the other."""
        return state._replace(position=other.position)

    def push(self, state: Particles, mass: Array, impulses: Moves) -> Particles:
        """v += P/m."""
        return state._replace(velocity=state.velocity + scale(1 / mass, put_worlds_first(impulses, state.lanes)))


__all__ = ["Coordinates", "Moves", "Places", "PointCoordinates", "put_worlds_first", "put_worlds_last"]
