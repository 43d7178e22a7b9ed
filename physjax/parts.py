"""The parts of a scene: what a force and a contact are, and what becomes of them when a scene is built."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from physjax.checks import demand_start_outside
from physjax.particles import Particles, demand_particles
from physjax.vectors import scale


class Function(eqx.Module):
    """A plain function as part of a scene. It counts as coupling its lanes unless it is said to be independent."""

    function: Callable = eqx.field(static=True)
    couples: bool = eqx.field(static=True, default=True)

    def __call__(self, *arguments: Any) -> Any:
        """Call the function."""
        return self.function(*arguments)


def as_module(function: Callable) -> eqx.Module:
    """A plain function wrapped so that it can travel in a pytree; modules are returned as they are."""
    return function if isinstance(function, eqx.Module) else Function(function)


def find_plain_functions(part: Any) -> list[Function]:
    """The plain functions in a part of a scene or a method, however deep: what they close over nobody can see."""
    is_plain = lambda node: isinstance(node, Function)  # noqa: E731
    return [node for node in jax.tree.leaves(part, is_leaf=is_plain) if is_plain(node)]


class Force(eqx.Module):
    """A load on each lane: any callable `(t, state, mass) -> newtons`, shaped like the velocity; the base of our own.

    `couples` says whether a lane's force depends on other lanes. `t` [s] is a scalar or per lane. A conservative force
    also gives its `potential(t, state, mass)` [J], shaped like the lanes (a shared energy is halved between its two
    lanes). A force that remembers has `advance(t, dt, state) -> (force, state)`, called once after every accepted step.
    One that jumps in time has `averaged_over_step(t, dt, state) -> force`, its mean over a step, and lists its `discontinuities()`.
    `near(t, state, mass) -> force` is its tangent for implicit steps; one that is `dissipative_symmetric` always pushes back.
    Its numbers are fields made with `quantity`; one that depends on g or on which axis is up asks the scene: `under`.

    Example:
        >>> class Engine(Force):
        ...     def __call__(self, t, state, mass):
        ...         return 2.0 * state.velocity
        >>> print(loads(Scene(ball, forces=(Engine(),)), 0.0))
        [6. 8.]
    """

    couples: ClassVar[bool] = False

    @abstractmethod
    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """Force on each lane [N]."""

    @property
    def weight(self) -> tuple[Any, int] | None:
        """g [m/s²] (None: not along an axis) and the axis that is up, of a force that is the weight; None of any other."""
        return None

    def under(self, weight: tuple[Any, int]) -> "Force":
        """The force in a scene with this weight: one that needs g and up takes them over, or refuses what it cannot."""
        return self


class Field(Force):
    """A force proportional to mass, given as an acceleration [m/s²], so that a falling body never looks its mass up.

    Example:
        >>> class Tide(Field):
        ...     def acceleration(self, t, state, mass):
        ...         return 0.5 * state.position
        >>> print(Tide()(0.0, ball, shot.mass))
        [ 0. 10.]
    """

    @abstractmethod
    def acceleration(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """Acceleration of each lane [m/s²]."""

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """Force on each lane [N]: mass times the acceleration."""
        return scale(mass, self.acceleration(t, state, mass))


class Contact(eqx.Module):
    """Something that lanes may not pass. `respond(t, state)` answers every touch, once a step, at its end.

    A `response(motion, scene, t, dt) -> scene` other than `project` decides otherwise when touches are answered;
    `memory` names the arrays that it changes.

    Example:
        >>> floor = contacts.Plane(point=(0.0, 0.0), normal=(0.0, 1.0))
        >>> isinstance(floor, Contact), float(floor.signed_distance(0.0, ball.position))
        (True, 10.0)
    """

    couples: ClassVar[bool] = False
    response: ClassVar[Callable | None] = None
    memory: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def signed_distance(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes"]:
        """Signed distance to the surface [m], > 0 on the legal side."""

    @abstractmethod
    def respond(self, t: ArrayLike, state: Particles) -> Particles:
        """The state after a touch; lanes that touch nothing stay as they are."""

    def outline(self, t: float, low: np.ndarray, high: np.ndarray) -> Sequence[np.ndarray] | None:
        """Polygons `(corners, 3)` [m] that show the surface in a box in space; None: they follow from the signed distance."""
        return None

    def forget_lanes(self, lanes: Bool[Array, "*lanes"]) -> "Contact":
        """The contact with what it remembers of some lanes forgotten, because others will be in their place."""
        return self

    def resolve(self, t: ArrayLike, state: Any, mass: Any) -> Any:
        """What `project` takes: `respond`, unless an answer needs the masses."""
        return self.respond(t, state)

    def clearance(self, t: ArrayLike, state: Any) -> Float[Array, "*lanes"]:
        """How far each lane is from touching [m]."""
        return self.signed_distance(t, state.position)

    def demand_fit(self, state: Any, mass: Any) -> None:
        """Raise a TypeError for what cannot touch it, and a ValueError for lanes that start on the wrong side."""
        demand_particles("contacts", state, "rigid bodies touch with rigid.Touch(hull, plane)")
        demand_start_outside(self, state)

    def prepare(self, state: Any, couples: bool) -> "Contact":
        """The contact as part of a scene whose lanes are coupled or not; one that remembers begins its memory here."""
        return self


def build_memory_mask(part: Any) -> Any:
    """A part of a scene with True in place of each array that its `memory` names, False elsewhere."""
    mask = jax.tree.map(lambda _: False, part)
    where = lambda part: [getattr(part, name) for name in part.memory]  # noqa: E731
    return eqx.tree_at(where, mask, [True] * len(part.memory)) if getattr(part, "memory", ()) else mask


def unify_gravity(forces: list, dim: int) -> tuple:
    """The forces, agreed about g and which axis of `dim` is up: those of `Gravity`, of several the sum."""
    weights = [force.weight for force in forces if isinstance(force, Force) and force.weight is not None]
    for _, up in weights:
        if up >= dim:
            raise ValueError(
                f"up: got axis {up}, but places here have {dim} components. Give an axis from 0 to {dim - 1}."
            )
    if not weights:
        return tuple(forces)
    if len(axes := {up for _, up in weights}) > 1:
        raise ValueError(f"forces: got Gravity along the axes {sorted(axes)}, expected one axis that is up for all.")
    known = [g for g, _ in weights if g is not None]
    weight = (sum(known[1:], known[0]) if len(known) == len(weights) else None, weights[0][1])
    return tuple(force.under(weight) if isinstance(force, Force) else force for force in forces)


def as_tuple(kind: str, parts: Any) -> tuple:
    """The parts as a tuple; a single one given without it is an easy slip and gets an error that says so."""
    if callable(parts) or not hasattr(parts, "__iter__"):
        raise TypeError(f"{kind}s: got {type(parts).__name__}, expected a tuple of {kind}s. Write {kind}s=({kind},).")
    return tuple(parts)


def prepare_force(force: Any, dtype: np.dtype) -> eqx.Module:
    """A force as a pytree of arrays in the scene's dtype; a TypeError for what is none."""
    expected = "a force: a callable (t, state, mass) -> newtons"
    return _prepare_part("force", force, callable(force) and not isinstance(force, type), expected, dtype)


def prepare_contact(contact: Any, dtype: np.dtype) -> eqx.Module:
    """A contact as a pytree of arrays in the scene's dtype; a TypeError for what is none."""
    expected = "a contact, e.g. contacts.Plane(point=(0, 0), normal=(0, 1))"
    return _prepare_part("contact", contact, isinstance(contact, Contact), expected, dtype)


def _prepare_part(kind: str, part: Any, good: bool, expected: str, dtype: np.dtype) -> eqx.Module:
    """A force or contact as a pytree of arrays whose floating-point numbers have the scene's dtype; a TypeError otherwise."""
    if not good:
        raise TypeError(f"{kind}s: got {type(part).__name__} {part!r}, expected {expected}.")
    part = part if isinstance(part, eqx.Module) else Function(part)
    for path, leaf in jax.tree_util.tree_leaves_with_path(part):
        _demand_array(part, path, leaf)
    cast = lambda leaf: leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf  # noqa: E731
    return jax.tree.map(cast, part)


def _demand_array(part: Any, path: tuple, leaf: Any) -> None:
    """Raise a TypeError for a leaf that a compiled program cannot take: only arrays and floats change from run to run."""
    if isinstance(leaf, jax.Array | np.ndarray | np.generic | float):
        return
    field = jax.tree_util.keystr(path).lstrip(".")
    kind, name = type(leaf).__name__, type(part).__name__
    if isinstance(leaf, bool | int | str):
        number = f", or a float if it is a number: {float(leaf)}" if type(leaf) is int else ""
        raise TypeError(
            f"{name}: the field {field} holds the {kind} {leaf!r}, expected an array or a float, which can change from run "
            f"to run. A {kind} decides what is compiled; say so: {field.split('.')[0].split('[')[0]}: {kind} = "
            f"eqx.field(static=True){number}."
        )
    raise TypeError(
        f"{name}: the field {field} holds a {kind}, expected an array or a float. What is no number is a part of the "
        "program: declare it with eqx.field(static=True)."
    )


def force_name(force: Any) -> str:
    """What a force is called in sentences: its class, or the name of the function that it is."""
    return getattr(getattr(force, "function", force), "__name__", type(force).__name__)
