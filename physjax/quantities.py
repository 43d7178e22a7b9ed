"""What every number of a scene's parts is: declared where the part is defined, and held against the lanes here.

`quantity` (checks.py) says of a field what it is and what there is one of it for. Here the declarations are found, however
deep a part is nested, and decide everything: whether a number fits the lanes, which arrays have an entry for each lane
(and are cut with them), and which lanes a traced number beyond its bounds invalidates. Nothing is guessed from a shape:
what a part does not declare is shared by all lanes.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, PyTree

from physjax.checks import ENTRY_AXIS_COUNT, Quantity, starts_outside

PER_LANE = ("lane", "table", "point")
"""What there may be one of for each lane, given by the user."""

MAX_COMPONENTS = 16
"""Components of a record beyond which it is a table, as the unknowns of a grid are, and no vector to be split."""


@runtime_checkable
class Related(Protocol):
    """A module whose numbers must also fit each other."""

    def relations(self) -> Iterable[Array]:
        """Booleans that must hold, each one for all lanes or one per lane."""
        ...


@runtime_checkable
class Advising(Protocol):
    """A module that knows what was probably meant where the shape of a number does not fit."""

    def hint_for_misfit(self, shape: tuple[int, ...]) -> str:
        """A sentence to end the error with; empty if there is nothing to say."""
        ...


class Number(NamedTuple):
    """An array of a part: the module that holds it, its field, what it is declared to be (None: nothing), its value."""

    owner: object
    field: str
    quantity: Quantity | None
    value: PyTree

    def has_lanes(self, lanes: tuple[int, ...], dim: int) -> bool:
        """Whether it has an entry (a number, a vector, a table) for each lane."""
        if self.quantity is None:
            # a record of ours is shaped like the lanes; a module that declares nothing shares what it holds
            return self.owner is None and np.shape(self.value)[: len(lanes)] == lanes
        own = ENTRY_AXIS_COUNT[self.quantity.per] + len(self.quantity.axes(dim))
        entries = self.quantity.per in (*PER_LANE, "spring", "joint", "memory")
        return entries and np.ndim(self.value) > own and np.shape(self.value)[: len(lanes)] == lanes

    def is_vector(self, lanes: tuple[int, ...], dim: int) -> bool:
        """Whether its last axis counts the components of a vector: of a record it comes after those of the lanes."""
        shape = np.shape(self.value)
        if self.quantity is None:
            fits = len(shape) == len(lanes) + 1 and shape[:-1] == lanes
            return self.owner is None and fits and shape[-1] <= MAX_COMPONENTS
        own = self.quantity.axes(dim)
        return len(own) == 1 and shape[-1:] == own


def build_vector_mask(tree: PyTree, lanes: tuple[int, ...], dim: int) -> PyTree:
    """The tree with True in place of each array whose last axis counts the components of a vector, False elsewhere."""
    found, structure = collect_numbers(tree)
    return structure.unflatten([number.is_vector(lanes, dim) for number in found])


def collect_numbers(tree: PyTree) -> tuple[list[Number], PyTree]:
    """Every leaf of a tree of parts with its declaration, the innermost on the way to it; and the tree's structure."""
    leaves, structure = jax.tree_util.tree_flatten_with_path(tree)
    return [_find_declaration(tree, path, leaf) for path, leaf in leaves], structure


def build_lane_mask(tree: PyTree, lanes: tuple[int, ...], dim: int) -> PyTree:
    """The tree with True in place of each array that has an entry for each of these lanes, False elsewhere."""
    found, structure = collect_numbers(tree)
    return structure.unflatten([number.has_lanes(lanes, dim) for number in found])


def may_hide_lanes(tree: PyTree, lanes: tuple[int, ...], dim: int) -> bool:
    """Whether a part holds an array that is not declared and has an axis as long as one of the lanes'.

    Nobody can know whether that is a table or a number per lane, so such lanes must stay together. So must those with a
    number per lane that lacks some of the lanes' axes.
    """
    return any(_may_hide(number, lanes, dim) for number in collect_numbers(tree)[0])


def select_lanes(tree: PyTree, lanes: tuple[int, ...], dim: int, cut: Callable) -> PyTree:
    """The tree with `cut(array)` for every array that has an entry for each of these lanes."""
    mask = build_lane_mask(tree, lanes, dim)
    return jax.tree.map(lambda leaf, has_lanes: cut(leaf) if has_lanes else leaf, tree, mask)


def demand_fitting_numbers(part: PyTree, lanes: tuple[int, ...], dim: int) -> None:
    """Raise a ValueError for a number of a part that is neither one for all lanes nor one for each."""
    for number in collect_numbers(part)[0]:
        quantity, shape = number.quantity, np.shape(number.value)
        if quantity is None or quantity.per not in PER_LANE:
            continue
        own = quantity.axes(dim)
        table = ENTRY_AXIS_COUNT[quantity.per]
        front = shape[: len(shape) - len(own) - table]
        fits = len(shape) >= len(own) + table and shape[len(shape) - len(own) :] == own and front in ((), lanes)
        if not fits:
            raise ValueError(_format_misfit(number, quantity, lanes, dim))


def find_valid_lanes(part: PyTree, lanes: tuple[int, ...], dim: int) -> list[Bool[Array, "..."]]:
    """For each traced number of a part, which lanes have it within its bounds, shaped () or like the lanes.

    A module may add relations between its numbers: `relations()` gives booleans, one for all lanes or one per lane.
    """
    if not any(map(_is_traced, jax.tree.leaves(part))):
        return []
    good = []
    for number in collect_numbers(part)[0]:
        if number.quantity is not None and number.quantity.per != "memory" and _is_traced(number.value):
            per_lane = number.quantity.per in PER_LANE and number.has_lanes(lanes, dim)
            good.append(_all_entries_good(number.quantity.within_bounds(number.value), lanes if per_lane else ()))
    for module in _iterate_modules(part):
        relations = module.relations() if isinstance(module, Related) else ()
        good += [
            _all_entries_good(r, lanes if r.shape[: len(lanes)] == lanes else ()) for r in relations if _is_traced(r)
        ]
    return good


def _all_entries_good(good: Array, lanes: tuple[int, ...]) -> Array:
    """Whether all entries of each lane are good."""
    return jnp.all(good, axis=tuple(range(len(lanes), good.ndim)))


def _is_traced(value: PyTree) -> bool:
    return isinstance(value, Tracer)


def mark_invalid_lanes(state: PyTree, mass: PyTree, parts: Iterable[PyTree], contacts: Iterable[PyTree]) -> PyTree:
    """The state with NaN in the lanes that a traced number beyond its bounds spoils, or that start on the wrong side.

    A traced value cannot raise; so it is seen in the status of its lane, before the first step.
    """
    lanes, dim = state.lanes, state.position.shape[-1]
    good = [flag for part in (mass, *parts) for flag in find_valid_lanes(part, lanes, dim)]
    if _is_traced(mass):
        good.append(MASS.within_bounds(mass))
    good += [flag for contact in contacts if _is_traced(flag := starts_outside(contact, state))]
    if not good:
        return state
    every = good[0]
    for flag in good[1:]:
        every = every & flag

    def spoil(leaf):
        axes = lanes if every.ndim else ()
        keep = every.reshape(axes + (1,) * (leaf.ndim - len(axes)))
        return jnp.where(keep, leaf, jnp.asarray(jnp.nan, leaf.dtype))

    return jax.tree.map(spoil, state)


MASS = Quantity("mass", "kg", above=0.0)
"""What the mass of particles is."""


def _iterate_modules(part: PyTree) -> Iterator[eqx.Module]:
    """The modules that a part is made of, itself included."""
    if isinstance(part, eqx.Module):
        yield part
    for child in jax.tree.leaves(part, is_leaf=lambda node: node is not part):
        if child is not part and isinstance(child, eqx.Module | tuple | list | dict):
            yield from _iterate_modules(child)


def _find_declaration(tree: PyTree, path: tuple, leaf: PyTree) -> Number:
    """A leaf with the innermost declaration on the path to it; modules that a scene is built of own what they hold."""
    node, owner, field, quantity = tree, None, "", None
    for key in path:
        name = str(key.name) if isinstance(key, jax.tree_util.GetAttrKey) else ""
        about = type(node).__dataclass_fields__.get(name) if isinstance(node, eqx.Module) else None
        if about is not None and "record" in about.metadata:
            owner, quantity = None, None
        elif about is not None:
            owner, field = node, name
            quantity = about.metadata.get("quantity", quantity)
        node = _get_child(node, key)
    return Number(owner, field, quantity, leaf)


def _get_child(node: PyTree, key: PyTree) -> PyTree:
    """What a key of a path leads to; None within containers of another kind, in which nothing declares anything."""
    if isinstance(key, jax.tree_util.GetAttrKey):
        return getattr(node, key.name, None)
    if isinstance(node, tuple | list | dict):
        return node[key.idx if isinstance(key, jax.tree_util.SequenceKey) else key.key]
    return None


def _may_hide(number: Number, lanes: tuple[int, ...], dim: int) -> bool:
    shape = np.shape(number.value)
    if number.owner is None or not shape or number.has_lanes(lanes, dim):
        return False
    if number.quantity is None:
        return bool({*lanes, int(np.prod(lanes))} & set(shape))
    return number.quantity.per in ("lane", "memory") and len(shape) > len(number.quantity.axes(dim))


def _format_misfit(number: Number, quantity: Quantity, lanes: tuple[int, ...], dim: int) -> str:
    shape = np.shape(number.value)
    own = quantity.axes(dim)
    if ENTRY_AXIS_COUNT[quantity.per]:
        own = ("n", *own)
    text = lambda axes: "(" + ", ".join(map(str, axes)) + ("," if len(axes) == 1 else "") + ")"  # noqa: E731
    each = f" or {text((*lanes, *own))}, one for each lane" if lanes else ""
    what = {"number": "a number", "axial": "a number" if dim < 3 else "a vector", "rotation": "a quaternion"}
    expected = f"{what.get(quantity.kind, 'a vector')} of shape {text(own)} for all lanes{each}"
    advice = f" {number.owner.hint_for_misfit(shape)}" if isinstance(number.owner, Advising) else ""
    return (
        f"{type(number.owner).__name__}: {quantity.name} [{quantity.unit}] has the shape {shape}, expected {expected}."
        f"{advice or _suggest_fix(shape, lanes, own)}"
    )


def _suggest_fix(shape: tuple[int, ...], lanes: tuple[int, ...], own: tuple) -> str:
    if lanes and shape and len(shape) < len(lanes) and not own:
        return " Say which axis is meant: number[:, None] or number[None, :], broadcast to the lanes' shape."
    if not lanes and shape:
        return " The state is one particle or body without lanes; several are positions of shape (n, dim)."
    return ""
