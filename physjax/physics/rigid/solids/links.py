"""What joints do to contacts: an impulse on one body moves all bodies that are joined to it.

Joints leave of a change u of velocities the part P u, with P = 1 - M⁻¹Jᵀ(J M⁻¹ Jᵀ)⁻¹J. Contacts are solved with bodies that
move so. Solved for free bodies, and the joints closed after them, a contact takes what the mass of the body that it touches
needs: a car of 100 kg on wheels of 1 kg would sink into the road.

A limit that is met, and a drive that is at its aim, hold like joints. Which do is known once the step of the joints is taken,
with what contacts are expected to exert: a servo that their load overpowers gives way, and so does a limit from which they
pull. In an impact, which takes no time, drives exert nothing, and what a limit does is left to the step after it.
"""

from functools import cache, partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from physjax.constraints.elimination import Pairs
from physjax.constraints.mechanism import Jacobian, Mechanism, find_constraints, hold_rows
from physjax.constraints.reactions import TOUCHING
from physjax.physics.rigid.solids.mechanics import Sides, Velocity
from physjax.physics.rigid.solids.pairs import Groups, part_contacts
from physjax.scene import Scene

T = TypeVar("T")
Response = Float[Array, "freedoms joined freedoms joined worlds"]
"""What joints add to velocities (first) where a contact alone changes one by 1 (second)."""


class Turns(NamedTuple):
    """In which turns contacts are solved where bodies are joined: no contact of a turn moves a body of another one.

    `groups` are these turns. `places` says which place each of theirs was in the groups before, `(turns, width)`, `back` the
    other way round. `joined` are the bodies in joints, and `columns` which of these the first and the second bodies of
    contacts are. In all of them one beyond the last is none.
    """

    groups: Groups
    places: np.ndarray
    back: np.ndarray
    joined: np.ndarray
    columns: tuple[np.ndarray, np.ndarray]

    def arrange(self, tree: T) -> T:
        """Numbers of contacts in groups `(groups, ..., size, worlds)` in turns; zero where there is none."""
        return jax.tree.map(lambda leaf: _take_places(leaf, self.places), tree)

    def restore(self, tree: T) -> T:
        """Numbers of contacts in turns in groups again."""
        return jax.tree.map(lambda leaf: _take_places(leaf, self.back), tree)


class Links(NamedTuple):
    """The turns of contacts, and how joints react to them in some worlds; `at_impacts` otherwise than else, None: as else."""

    turns: Turns
    response: Response
    at_impacts: Response | None = None

    def take_impacts(self) -> "Links":
        """How joints react to impacts."""
        return self if self.at_impacts is None else Links(self.turns, self.at_impacts)

    def add_reactions(self, velocity: Velocity) -> Velocity:
        """Velocities of bodies `(..., bodies, worlds)` that impulses alone have changed, with what joints add."""
        joined = self.turns.joined
        change = flatten(velocity)[:, joined]
        return self.add(velocity, jnp.sum(self.response * change[None, None], axis=(2, 3)))

    def find_reaction(self, columns: Sides, changes: tuple[Velocity, Velocity]) -> Array:
        """What joints add to the velocities of the joined bodies where contacts of a turn change both of theirs."""
        total = jnp.zeros((), self.response.dtype)
        for column, change in zip(columns, changes, strict=True):
            picked = jnp.take(self.response, column, axis=3, mode="fill", fill_value=0)
            total = total + jnp.sum(picked * flatten(change)[None, None], axis=(2, 3))
        return total

    def add(self, velocity: Velocity, change: Array) -> Velocity:
        """Velocities of all rows, with changes of those of the joined bodies."""
        parts, begun = [], 0
        for part in velocity:
            size = 1 if part.ndim == 2 else len(part)
            own = change[begun : begun + size]
            parts.append(part.at[..., self.turns.joined, :].add(own[0] if part.ndim == 2 else own, unique_indices=True))
            begun += size
        return tuple(parts)

    def spread(self, changes: tuple[Velocity, Velocity]) -> tuple[Velocity, Velocity]:
        """What is left of changes of both bodies of every contact `(turns, ..., width, worlds)`, all else at rest."""
        flat = [jax.vmap(flatten)(change) for change in changes]
        both = []
        for column, change in zip(self.turns.columns, changes, strict=True):
            total = jax.vmap(flatten)(change)
            for other, of_other in zip(self.turns.columns, flat, strict=True):
                block = self._take_blocks(column, other)
                total = total + jnp.sum(block * of_other[:, None], axis=2)
            both.append(_unflatten(total, change))
        return both[0], both[1]

    def _take_blocks(self, rows: np.ndarray, columns: np.ndarray) -> Array:
        """What joints add to these bodies of contacts where those change by 1, `(turns, freedoms, freedoms, width, worlds)`."""
        padded = jnp.pad(self.response, ((0, 0), (0, 1), (0, 0), (0, 1), (0, 0)))
        size, worlds = len(self.turns.joined) + 1, padded.shape[-1]
        flat = jnp.transpose(padded, (0, 2, 1, 3, 4)).reshape(len(padded), len(padded), size * size, worlds)
        return jnp.moveaxis(flat[:, :, rows * size + columns], 2, 0)


def plan_turns(scene: Scene, groups: Groups) -> Turns | None:
    """The turns in which the contacts of a scene are solved; None without contacts or exact joints."""
    pairs = tuple(pair for part in find_constraints(scene) for pair in part.pairs)
    if not pairs or not groups.is_contact.any():
        return None
    return _plan_turns(pairs, *_freeze(groups))


def find_links(turns: Turns, scene: Scene, moved: Any, h: Array) -> Links:
    """How the joints of a scene react to changes of velocities, given the state a time h [s] later if nothing touches."""
    mechanism = Mechanism.of(scene)
    coordinates = mechanism.coordinates
    places = coordinates.read_places(scene.state)
    jacobian, x = mechanism.differentiate(places)
    mobility = coordinates.read_mobility(scene.state, scene.mass)
    respond = partial(_find_response, turns.joined, mechanism, mobility)
    bounds = mechanism.find_bounds(x)
    if bounds is None:
        return Links(turns, respond(jacobian))
    near = TOUCHING * mechanism.measure_tolerance(places, mobility)
    later = mechanism.measure(coordinates.read_places(moved), x)
    holds = jnp.stack([bounds.find_held(x, later, h, near), bounds.low == bounds.high])
    response, at_impacts = jax.vmap(lambda held: respond(hold_rows(jacobian, held)))(holds)
    return Links(turns, response, at_impacts)


def _find_response(joined: np.ndarray, mechanism: Mechanism, mobility: Array, jacobian: Jacobian) -> Response:
    """What joints add where a contact alone changes velocities by 1, so that no row of the Jacobian changes."""
    matrix = mechanism.build_matrix(jacobian, mechanism.move_by_impulses(mobility, jacobian))
    freedoms, bodies = mechanism.coordinates.freedoms, len(mechanism.free)
    one = np.eye(freedoms * bodies).reshape(freedoms, bodies, freedoms, bodies)[:, joined]

    def respond(change: Array) -> Array:
        change = jnp.broadcast_to(change[..., None], (freedoms, *mechanism.free.shape)).astype(jacobian.dtype)
        λ = mechanism.solve(matrix, -mechanism.measure_rates(jacobian, change))
        return mechanism.change_rates(mobility, jacobian, λ)[:, joined]

    found = jax.vmap(jax.vmap(respond))(jnp.asarray(one, jacobian.dtype))
    return jnp.moveaxis(found, (0, 1), (2, 3))


@cache
def _plan_turns(pairs: Pairs, contact: tuple, a: tuple, b: tuple, bodies: int) -> Turns:
    """The same, of what can be looked up."""
    joined = np.array(sorted({body for pair in pairs for body in pair if body >= 0}))
    mechanism = _name_mechanisms(pairs, bodies)
    flat = [np.array(table).ravel() for table in (contact, a, b)]
    there = np.flatnonzero(flat[1] < bodies)
    moves = [tuple({mechanism[row] for row in (p, q) if row < bodies}) for p, q in zip(*flat[1:], strict=True)]
    turns = part_contacts([moves[place] for place in there], len(contact[0]))
    width, none = max(map(len, turns)), flat[0].size
    index = np.full((len(turns), width), none)
    for turn, members in enumerate(turns):
        index[turn, : len(members)] = there[members]
    still = bodies + 2 * np.arange(width) + 0 * index
    number, first, second = (np.append(part, 0)[index] for part in flat)
    empty = index == none
    first, second = np.where(empty, still, first), np.where(empty | (second >= bodies), still + 1, second)
    number = np.where(empty, flat[0].max() + 1, number)
    groups = Groups(number, first, second, bodies + 2 * width, 0)
    back = np.full(none + 1, index.size)
    back[index.ravel()] = np.arange(index.size)
    places = np.full(groups.rows, len(joined))
    places[joined] = np.arange(len(joined))
    return Turns(groups, index, back[:none].reshape(len(contact), -1), joined, (places[first], places[second]))


def _freeze(groups: Groups) -> tuple[Any, ...]:
    """The tables of groups as tuples, and the number of bodies."""
    tables = (tuple(map(tuple, table.tolist())) for table in (groups.contact, groups.a, groups.b))
    return (*tables, groups.rows - 2 * groups.size)


def _name_mechanisms(pairs: Pairs, bodies: int) -> list[int]:
    """For each body the first of all that it is joined to, over several joints; its own number where it is free."""
    names = list(range(bodies))
    for a, b in pairs:
        if a >= 0 and b >= 0:
            kept, lost = sorted((names[a], names[b]))
            names = [kept if name == lost else name for name in names]
    return names


def _take_places(leaf: Array, index: np.ndarray) -> Array:
    """Numbers in other places, `(groups, ..., size, worlds)`; zero for those beyond the last."""
    flat = jnp.moveaxis(leaf, -2, 1).reshape(-1, *leaf.shape[1:-2], leaf.shape[-1])
    padded = jnp.pad(flat, [(0, 1)] + [(0, 0)] * (flat.ndim - 1))
    return jnp.moveaxis(padded[index], 1, -2)


def flatten(velocity: Velocity) -> Array:
    """Velocities as one array `(freedoms, bodies, worlds)`."""
    return jnp.concatenate([part.reshape(-1, *part.shape[-2:]) for part in velocity])


def _unflatten(rates: Array, like: Velocity) -> Velocity:
    """Arrays `(turns, freedoms, width, worlds)` in parts like other ones."""
    parts, begun = [], 0
    for part in like:
        size = 1 if part.ndim == 3 else part.shape[1]
        own = rates[:, begun : begun + size]
        parts.append(own.reshape(part.shape[0], *part.shape[1:-2], *own.shape[-2:]))
        begun += size
    return tuple(parts)


__all__ = ["Links", "Response", "Turns", "find_links", "flatten", "plan_turns"]
