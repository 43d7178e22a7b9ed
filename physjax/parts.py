"""The parts of a scene: what a force and a contact can do, and how they are prepared when a scene is built."""

from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from types import new_class
from typing import Any, ClassVar

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer
from jax.extend.core import get_opaque_trace_state
from jax.tree_util import Partial
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, PyTree

from physjax.checks import demand_start_outside
from physjax.loops import Time
from physjax.old_names import CONTACT_OLD_NAMES, FORCE_OLD_NAMES, serve_old_names
from physjax.particles import Particles, demand_particles
from physjax.summaries import represent_part
from physjax.tracebacks import Module
from physjax.vectors import scale


class Function(Module):
    """A plain function as part of a scene. It counts as coupling lanes unless `forces.independent` says otherwise."""

    function: Callable = eqx.field(static=True)
    couples: bool = eqx.field(static=True, default=True)

    def __call__(self, *arguments: PyTree) -> PyTree:
        """Call the function."""
        return self.function(*arguments)


def as_module(function: Callable) -> PyTree:
    """A plain function wrapped so that it can travel in a pytree; modules are returned as they are."""
    return function if isinstance(function, eqx.Module) else Function(function)


def find_plain_functions(part: PyTree) -> list[Function]:
    """The plain functions in a part of a scene or a method, however deep. What they close over cannot be seen."""
    is_plain = lambda node: isinstance(node, Function)  # noqa: E731
    return [node for node in jax.tree.leaves(part, is_leaf=is_plain) if is_plain(node)]


def holds_user_code(part: PyTree) -> bool:
    """Whether anything in a part of a scene, a method or a motion is not the library's own, and may close over a number."""
    if isinstance(part, Function):
        return not _is_library_definition(part.function)
    what = part.func if isinstance(part, Partial) else type(part)
    if isinstance(part, Partial | eqx.Module) and not _is_library_definition(what):
        return True
    children = jax.tree.leaves(part, is_leaf=lambda node: node is not part)
    return any(holds_user_code(child) for child in children if child is not part)


with jax.ensure_compile_time_eval():
    _EAGER = get_opaque_trace_state()
    """What JAX calls the state of tracing where no transformation is around."""


def is_untransformed(run: PyTree) -> bool:
    """Whether a run is compiled by itself: no transformation is around it, so that nothing in it is traced.

    What a function of the user closes over is not traced either, since there is nothing that would trace it.
    """
    return get_opaque_trace_state() == _EAGER and not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(run))


def _is_library_definition(thing: Any) -> bool:
    """Whether a function or class is the library's own, which closes over nothing."""
    return str(getattr(thing, "__module__", "")).startswith("physjax.") and "<locals>" not in thing.__qualname__


class Force(Module):
    """A load on each lane: any callable `(t, state, mass) -> newtons`, shaped like the velocity; the base of our own.

    `t` [s] is a scalar or one per lane. `couples` says whether a lane's force depends on other lanes. Numbers are fields
    made with `quantity`. Everything below `__call__` is an ability that a force may have, with the default of a force
    that lacks it: a conservative force gives its `potential`, one that jumps in time its mean (`averaged_over_step`) and its
    `discontinuities`, one with memory how it `advance`s, one that depends on g or on which axis is up asks the scene
    (`under`).

    Example:
        >>> class Engine(Force):
        ...     def __call__(self, t, state, mass):
        ...         return 2.0 * state.velocity
        >>> print(loads(Scene(ball, forces=(Engine(),)), 0.0))
        [6. 8.]
    """

    __repr__ = represent_part
    couples: ClassVar[bool] = False
    is_field: ClassVar[bool] = False
    """Whether it is proportional to mass and gives an `acceleration`, as a `Field` does."""
    dissipative_symmetric: ClassVar[bool] = False
    """Whether its Jacobian is symmetric and takes energy, as that of springs: implicit steps then use conjugate gradients."""
    lane_by_lane: ClassVar[bool] = False
    """Whether the functions in it are called for one lane at a time, so that they close over no array of all lanes."""
    sees_moments: ClassVar[bool] = False
    """Whether it takes the time as a `Moment`, which keeps what one float32 cannot hold."""

    def __init_subclass__(cls, **options: object):
        super().__init_subclass__(**options)
        serve_old_names(cls, FORCE_OLD_NAMES)

    @abstractmethod
    def __call__(self, t: ArrayLike, state: PyTree, mass: PyTree) -> PyTree:
        """Force on each lane [N], shaped like the velocity; of a load on rigid bodies the wrench."""

    def potential(self, t: ArrayLike, state: PyTree, mass: PyTree) -> Array | None:
        """Potential energy [J], shaped like the lanes (a shared energy is halved between its two lanes); None without one."""
        return None

    @property
    def has_potential(self) -> bool:
        """Whether the force is conservative, with its `potential`."""
        return type(self).potential is not Force.potential

    def averaged_over_step(self, t: Time, dt: ArrayLike, state: PyTree) -> "Force":
        """The force as a step from t to t + dt [s] sees it: one that jumps in time gives its mean."""
        return self

    @property
    def jumps(self) -> bool:
        """Whether the force jumps in time, and a step must see its mean (`averaged_over_step`)."""
        return type(self).averaged_over_step is not Force.averaged_over_step

    def discontinuities(self) -> tuple[Array, ...]:
        """Times [s] at which the force jumps."""
        return ()

    def linearised_at(self, t: Time, state: PyTree, mass: PyTree) -> "Force":
        """The force that an implicit step differentiates at this state in place of this one."""
        return self

    @property
    def has_linearisation(self) -> bool:
        """Whether an implicit step differentiates another force than this one (`linearised_at`)."""
        return type(self).linearised_at is not Force.linearised_at

    def advance(self, t: ArrayLike, dt: ArrayLike, state: PyTree) -> tuple["Force", PyTree]:
        """The force and the state after a step from t to t + dt [s] was taken, for one with memory: springs that break."""
        return self, state

    def advance_within(self, scene: PyTree, t: ArrayLike, dt: ArrayLike, state: PyTree) -> tuple["Force", PyTree]:
        """What `advance` returns, for a force whose memory depends on the rest of the scene: joints that break."""
        return self.advance(t, dt, state)

    @property
    def remembers(self) -> bool:
        """Whether the force has memory, which `advance` changes after every step."""
        return type(self).advance is not Force.advance

    @property
    def response(self) -> Callable | None:
        """How a scene's motion is kept on what the force holds exactly, as by a contact's response; None: it only pushes."""

    def constrain_rate(self, scene: PyTree, t: Time, state: PyTree, rate: PyTree) -> PyTree:
        """The rate of a state with the forces of all that the scene holds exactly."""
        return rate

    def close(self, scene: PyTree, state: PyTree) -> PyTree:
        """The state, which something else has changed, back on all that the scene holds exactly."""
        return state

    def prepare(self, state: PyTree, mass: PyTree) -> "Force":
        """The force as part of a scene that starts in this state; what it joins is checked here."""
        return self

    def demand_company(self, forces: tuple["Force", ...]) -> None:
        """Raise a ValueError for other forces of the scene, with which this one would not be right."""

    @property
    def up_axis(self) -> int | None:
        """The axis that points up, of a force that has one in a field `up`."""
        axis = getattr(self, "up", None)
        return axis if isinstance(axis, int) else None

    @property
    def weight(self) -> tuple[ArrayLike | None, int] | None:
        """g [m/s²] (None: not along an axis) and the axis that is up, of a force that is the weight; None of any other."""
        return None

    def under(self, weight: tuple[ArrayLike | None, int]) -> "Force":
        """The force in a scene with this weight: one that needs g and up takes them over, or refuses what it cannot."""
        return self


serve_old_names(Force, FORCE_OLD_NAMES)


class Field(Force):
    """A force proportional to mass, given as an acceleration [m/s²], so that a falling body never looks its mass up.

    Example:
        >>> class Tide(Field):
        ...     def acceleration(self, t, state, mass):
        ...         return 0.5 * state.position
        >>> print(Tide()(0.0, ball, shot.mass))
        [ 0. 10.]
    """

    is_field: ClassVar[bool] = True

    @abstractmethod
    def acceleration(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """Acceleration of each lane [m/s²]."""

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """Force on each lane [N]: mass times the acceleration."""
        return scale(mass, self.acceleration(t, state, mass))


class Contact(Module):
    """Something that lanes may not pass. `respond(t, state)` resolves every contact at the end of a step.

    A `response(motion, scene, t, dt) -> scene` other than `project` decides when contacts are resolved instead;
    `memory` names the arrays that it changes. With `many_small_kernels` it is compiled for these, however many lanes there are.

    Example:
        >>> floor = contacts.Plane(point=(0.0, 0.0), normal=(0.0, 1.0))
        >>> isinstance(floor, Contact), float(floor.signed_distance(0.0, ball.position))
        (True, 10.0)
    """

    couples: ClassVar[bool] = False
    response: ClassVar[Callable | None] = None
    many_small_kernels: ClassVar[bool] = False
    __repr__ = represent_part
    memory: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls, **options: object):
        super().__init_subclass__(**options)
        serve_old_names(cls, CONTACT_OLD_NAMES)

    @abstractmethod
    def signed_distance(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes"]:
        """Signed distance to the surface [m], > 0 on the legal side."""

    @abstractmethod
    def respond(self, t: ArrayLike, state: PyTree) -> PyTree:
        """The state after contact; lanes that are not in contact stay as they are."""

    def outline(self, t: float, low: np.ndarray, high: np.ndarray) -> Sequence[np.ndarray] | None:
        """Polygons `(corners, 3)` [m] that show the surface in a box in space; None: they follow from the signed distance."""
        return None

    def find_loads(self) -> Array | None:
        """What it exerted on the bodies in the mean of the last step, `(*lanes, freedoms)` [N, N m], where it knows."""
        return None

    def find_pushes(self) -> Array | None:
        """What it is expected to exert on joined bodies in this step, `(freedoms, bodies, worlds)` [N, N m]."""
        return None

    def forget_lanes(self, lanes: Bool[Array, "*lanes"]) -> "Contact":
        """The contact with the memory of some lanes cleared, because other particles take their place."""
        return self

    def resolve(self, t: ArrayLike, state: PyTree, mass: PyTree) -> PyTree:
        """What `project` calls: `respond`, unless the response needs the masses."""
        return self.respond(t, state)

    def clearance(self, t: ArrayLike, state: PyTree) -> Float[Array, "*lanes"]:
        """How far each lane is from contact [m]."""
        return self.signed_distance(t, state.position)

    def demand_fit(self, state: PyTree, mass: PyTree) -> None:
        """Raise a TypeError for a state of another kind, and a ValueError for lanes that start on the wrong side."""
        hint = "rigid bodies need rigid.Solids(shapes, (plane,)), or in space rigid.SurfaceContact(hull, plane)"
        demand_particles("contacts", state, hint)
        demand_start_outside(self, state)

    def prepare(self, state: PyTree, couples: bool) -> "Contact":
        """The contact as part of a scene whose lanes are coupled or not; one that remembers begins its memory here."""
        return self


serve_old_names(Contact, CONTACT_OLD_NAMES)


class ParticleSource(Module):
    """What lets the lanes of a scene be born and die within a step; `memory` names the arrays that this changes."""

    memory: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def prepare(self, scene: PyTree) -> "ParticleSource":
        """The source as part of this scene; the checks are here."""

    @abstractmethod
    def live(self, motion: Callable, scene: PyTree, t: Time, dt: ArrayLike) -> PyTree:
        """The scene after a step, in which each lane moves from its birth, or the start, to its death, or the end."""


@cache
def _adopt_class(cls: type) -> type:
    """The class of a user's force that is not derived from `Force`, with the defaults of `Force` for what it lacks."""
    own = {} if hasattr(cls, "couples") else {"couples": True}  # one that does not say may depend on any lane
    names = {"__module__": cls.__module__, "__qualname__": cls.__qualname__, "__doc__": cls.__doc__}
    # with its own way to begin: a dataclass would make one in which a default of `Force` may stand before a field without one
    body = own | names | {"__init__": cls.__init__}
    return new_class(cls.__name__, (cls, Force), exec_body=lambda namespace: namespace.update(body))


def adopt_force(part: Callable) -> Force:
    """Any callable as a `Force`: a plain function, or a user's module with some of its abilities."""
    module = as_module(part)
    if isinstance(module, Force):
        return module
    adopted = object.__new__(_adopt_class(type(module)))
    vars(adopted).update(vars(module))
    return adopted


def unify_gravity(forces: list, dim: int) -> tuple:
    """The forces with one g and one axis of `dim` that is up: those of `Gravity`, with several of them the sum."""
    weights = [force.weight for force in forces if force.weight is not None]
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
    return tuple(force.under(weight) for force in forces)


def as_tuple(kind: str, parts: object) -> tuple:
    """The parts as a tuple; a single one given without it is an easy slip and gets an error that says so."""
    if callable(parts) or not isinstance(parts, Iterable):
        raise TypeError(f"{kind}s: got {type(parts).__name__}, expected a tuple of {kind}s. Write {kind}s=({kind},).")
    return tuple(parts)


def prepare_force(force: Callable, dtype: np.dtype) -> Force:
    """A force as a pytree of arrays in the scene's dtype; a TypeError for what is none."""
    expected = "a force: a callable (t, state, mass) -> newtons"
    return _prepare_part("force", force, callable(force) and not isinstance(force, type), expected, dtype)


def prepare_contact(contact: object, dtype: np.dtype) -> Contact:
    """A contact as a pytree of arrays in the scene's dtype; a TypeError for what is none."""
    expected = "a contact, e.g. contacts.Plane(point=(0, 0), normal=(0, 1))"
    return _prepare_part("contact", contact, isinstance(contact, Contact), expected, dtype)


def _prepare_part(kind: str, part: PyTree, good: bool, expected: str, dtype: np.dtype) -> PyTree:
    """A force or contact as a pytree of arrays whose floating-point numbers have the scene's dtype; a TypeError otherwise."""
    if not good:
        got = f"the class {part.__name__}" if isinstance(part, type) else f"{type(part).__name__} {part!r}"
        raise TypeError(f"{kind}s: got {got}, expected {expected}.{' Call it.' * isinstance(part, type)}")
    part = adopt_force(part) if kind == "force" else part
    for path, leaf in jax.tree_util.tree_leaves_with_path(part):
        _demand_array(part, path, leaf)
    cast = lambda leaf: leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf  # noqa: E731
    return jax.tree.map(cast, part)


def _demand_array(part: object, path: tuple, leaf: object) -> None:
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
