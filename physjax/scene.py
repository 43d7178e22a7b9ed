"""The nouns: what a scene is made of, and what a force is.

Arrays are shaped `(*lanes, dim)`, the component last. Lanes are independent (ten thousand balls) or coupled (bodies
that attract each other, a cloth's nodes); a force says which. In a coupled scene the last lane axis counts nodes and
earlier axes count scenes. A per-lane number is a scalar or has the shape of the lanes. SI units, y up.
"""

from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from physjax.checks import demand_legal, real_array, real_quantity
from physjax.lanes import WHOLE, kept_apart
from physjax.vectors import scale


class Particles(NamedTuple):
    """Point masses: position [m] and velocity [m/s], both `(*lanes, dim)`.

    The record knows how Newton's law moves it, so that the methods need no physics: `rate` is its time derivative,
    `kick` changes the velocity and leaves the position, `drift` moves the position with the velocity it has.
    """

    position: Float[Array, "*lanes dim"]
    velocity: Float[Array, "*lanes dim"]

    @property
    def lanes(self) -> tuple[int, ...]:
        """Shape of the lanes: `()` for a single particle."""
        return self.position.shape[:-1]

    @property
    def dtype(self) -> np.dtype:
        """Floating-point type, which every number of the scene follows."""
        return self.position.dtype

    def rate(self, acceleration: Float[Array, "*lanes dim"]) -> "Particles":
        """Time derivative: position changes with the velocity, velocity with the acceleration."""
        return Particles(self.velocity, acceleration)

    def kick(self, rate: "Particles", dt: ArrayLike) -> "Particles":
        """v += a dt, the position untouched."""
        return Particles(self.position, self.velocity + scale(dt, rate.velocity))

    def drift(self, dt: ArrayLike) -> "Particles":
        """x += v dt, the velocity untouched."""
        return Particles(self.position + scale(dt, self.velocity), self.velocity)

    def held(self, free: Float[Array, "*lanes"]) -> "Particles":
        """The state with the velocity of held lanes (free = 0) set to zero."""
        return Particles(self.position, scale(free, self.velocity))

    def checked(self) -> "Particles":
        """The state as floating-point arrays of one shape and dtype; ValueError or TypeError in plain words otherwise."""
        state = Particles(real_array("position", self.position), real_array("velocity", self.velocity))
        x, v = state
        if x.ndim == 0 or x.shape != v.shape:
            raise ValueError(
                f"Particles: got position {x.shape} and velocity {v.shape}, expected the same shape (*lanes, dim): "
                "component last, e.g. (2,) for one ball in the plane, (10000, 3) for ten thousand in space."
            )
        if 0 in x.shape:
            raise ValueError(f"Particles: got the empty shape {x.shape}, expected at least one lane and one component.")
        if x.dtype != v.dtype:
            raise TypeError(
                f"Particles: got position {x.dtype} and velocity {v.dtype}, expected one dtype. Cast one of them."
            )
        for name, array in (("position [m]", x), ("velocity [m/s]", v)):
            real_quantity(name, array)
        return Particles(x.astype(x.dtype), v.astype(v.dtype))  # astype makes weakly typed arrays strong


class Force(eqx.Module):
    """A load on each lane: any callable `(t, state, mass) -> newtons`, shaped like the velocity; the base of our own.

    `couples` says whether a lane's force depends on other lanes. `t` [s] is a scalar or per lane. A conservative force
    also gives its `potential(t, state, mass)` [J], shaped like the lanes (a shared energy is halved between its two
    lanes). A force that remembers has `advance(t, dt, state) -> (force, state)`, called once after every accepted step.
    One that jumps in time has `during(t, dt, state) -> force`, its mean over a step, and lists its `discontinuities()`.
    `near(t, state, mass) -> force` is its tangent for implicit steps; one that is `definite` always pushes back.
    """

    couples: ClassVar[bool] = False

    @abstractmethod
    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """Force on each lane [N]."""


class Field(Force):
    """A force proportional to mass, given as an acceleration [m/s²], so that a falling body never looks its mass up."""

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
    """

    response: ClassVar[Callable | None] = None
    memory: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def gap(self, t: ArrayLike, position: Float[Array, "*lanes dim"]) -> Float[Array, "*lanes"]:
        """Signed distance to the surface [m], > 0 on the legal side."""

    @abstractmethod
    def respond(self, t: ArrayLike, state: Particles) -> Particles:
        """The state after a touch; lanes that touch nothing stay as they are."""

    def changes(self) -> "Contact":
        """The contact with True in place of each array that a step changes, False elsewhere."""
        mask = jax.tree.map(lambda _: False, self)
        where = lambda contact: [getattr(contact, name) for name in self.memory]  # noqa: E731
        return eqx.tree_at(where, mask, [True] * len(self.memory)) if self.memory else mask

    def prepared(self, state: Particles, couples: bool) -> "Contact":
        """The contact as part of a scene whose lanes are coupled or not; one that remembers begins its memory here."""
        return self


def project(motion: Callable, scene: "Scene", t: ArrayLike, dt: ArrayLike) -> "Scene":
    """The lecture's response: step as if nothing were there, then put back and turn around what went in.

    Cheap and robust, first order in dt: a bounce happens at the end of the step, not when the surface was met, and a
    lane that crosses a thin obstacle within one step is not seen.
    """
    scene = motion(scene, t, dt)
    state = scene.state
    for contact in scene.contacts:
        if (contact.response or project) is project:
            state = contact.respond(t + dt, state)
    return scene.having(state=state)


class Function(eqx.Module):
    """A plain function as part of a scene. It counts as coupling its lanes unless it is said to be independent."""

    function: Callable = eqx.field(static=True)
    couples: bool = eqx.field(static=True, default=True)

    def __call__(self, *arguments: Any) -> Any:
        """Call the function."""
        return self.function(*arguments)


class Scene(eqx.Module):
    """Everything a run needs but the method: state, mass [kg], forces, contacts, and which lanes are held or led.

    `mass` is a scalar or per lane. `forces` are library forces or any callable `(t, state, mass) -> newtons`. `pinned`
    is a boolean mask over the lanes that are held, or `Pins(nodes, path)`, which leads them. Every number becomes an
    array of the state's dtype: changing it compiles nothing, and it can be swept and differentiated. Raises ValueError
    or TypeError for shapes that do not match, numbers that are not finite, and masses <= 0.
    """

    state: Particles
    mass: Float[Array, "..."]
    forces: tuple
    contacts: tuple
    pinned: Bool[Array, "*lanes"] | eqx.Module | None
    reaction: Callable | None = eqx.field(init=False)

    def __init__(
        self,
        state: Any,
        mass: Any = 1.0,
        forces: Any = (),
        contacts: Any = (),
        pinned: Any = None,
    ):
        if not hasattr(state, "checked"):
            raise TypeError(
                f"Scene: got a state of type {type(state).__name__}, expected Particles(position, velocity)."
            )
        state = state.checked()
        lanes, dtype = state.lanes, state.dtype
        mass = real_quantity("mass [kg]", mass, above=0.0).astype(dtype)
        if mass.shape not in ((), lanes):
            raise ValueError(f"mass [kg]: got shape {mass.shape}, expected () or the lanes' shape {lanes}.")
        if hasattr(pinned, "lead"):
            pinned = pinned.prepared(state)
            state = pinned.lead(0.0, state)
        elif pinned is not None:
            pinned = jnp.asarray(pinned)
            if pinned.dtype != bool or pinned.shape != lanes:
                raise ValueError(
                    f"pinned: got {pinned.dtype} of shape {pinned.shape}, expected booleans of the lanes' shape {lanes}."
                )
            state = state.held(1 - pinned.astype(dtype))
        self.state = state
        self.mass = mass
        self.forces = tuple(_part("force", force, dtype) for force in _listed("force", forces))
        contacts = [_part("contact", contact, dtype) for contact in _listed("contact", contacts)]
        for contact in contacts:
            demand_legal(contact, state)
        self.contacts = tuple(contact.prepared(state, self.couples) for contact in contacts)
        self.pinned = pinned
        self.reaction = None

    @property
    def couples(self) -> bool:
        """Whether any force ties lanes together; a force that does not say counts as coupling."""
        return any(getattr(force, "couples", True) for force in self.forces)

    @property
    def held(self) -> Bool[Array, "*lanes"] | None:
        """Mask of the lanes that no force moves, held where they are or led along a path; None where there are none."""
        return self.pinned if self.led is None else self.led.nodes

    @property
    def led(self) -> Any:
        """The `Pins` that lead lanes along a path; None without."""
        return self.pinned if hasattr(self.pinned, "lead") else None

    @property
    def in_pieces(self) -> bool:
        """Whether a step is compiled in pieces: where more than a few nodes look at each other."""
        return self.couples and self.state.lanes[-1:] > (WHOLE,)

    @property
    def status_shape(self) -> tuple[int, ...]:
        """Shape of what is decided once a scene when lanes are coupled, once a lane when not: status and step size."""
        return self.state.lanes[:-1] if self.couples else self.state.lanes

    def acceleration(self, t: ArrayLike, state: Particles) -> Float[Array, "*lanes dim"]:
        """Newton's second law, a = ΣF/m [m/s²]; held lanes do not accelerate, led ones as their path does."""
        if self.led is not None:
            state = self.led.lead(t, state)
        free = None if self.held is None else 1 - self.held.astype(state.dtype)
        fields = [_shaped(f, f.acceleration(t, state, self.mass), state) for f in self.forces if isinstance(f, Field)]
        newtons = [_shaped(f, f(t, state, self.mass), state) for f in self.forces if not isinstance(f, Field)]
        total = []
        if fields:
            total.append(_sum(fields) if free is None else scale(free, _sum(fields)))
        if newtons:
            total.append(scale((1.0 if free is None else free) / self.mass, _sum(newtons)))
        acceleration = _sum(total) if total else jnp.zeros_like(state.velocity)
        if self.led is not None:
            acceleration = self.led.drive(t, state, acceleration)
        return acceleration if self.reaction is None else self.reaction(t, state, acceleration)

    def rate(self, t: ArrayLike, state: Particles) -> Particles:
        """Time derivative of the whole state: the right-hand side of the equations of motion."""
        if not self.in_pieces:
            return state.rate(self.acceleration(t, state))
        # apart, or a method's stage would be computed anew in every neighbour that looks at it
        return state.rate(kept_apart(t, lambda: self.acceleration(t, state)))

    def kick(self, state: Particles, rate: Particles, dt: ArrayLike) -> Particles:
        """Velocities changed by the accelerations in `rate` for a time dt."""
        return state.kick(rate, dt)

    def drift(self, state: Particles, dt: ArrayLike) -> Particles:
        """Positions moved by the velocities in `state` for a time dt."""
        return state.drift(dt)

    def during(self, t: ArrayLike, dt: ArrayLike) -> "Scene":
        """The scene as one step sees it: forces that jump in time replaced by their mean over the step."""
        forces = tuple(f.during(t, dt, self.state) if hasattr(f, "during") else f for f in self.forces)
        return eqx.tree_at(lambda scene: scene.forces, self, forces)

    @property
    def definite(self) -> bool:
        """Whether every force pushes back, symmetrically: an implicit step may then use conjugate gradients."""
        return all(getattr(force, "definite", False) for force in self.forces)

    def near(self, t: ArrayLike, state: Particles) -> "Scene":
        """The scene as an implicit step sees it: forces that have a tangent at this state replaced by it."""
        state = state if self.led is None else self.led.lead(t, state)
        return self.having(forces=tuple(f.near(t, state, self.mass) if hasattr(f, "near") else f for f in self.forces))

    def step(self, method: Callable, t: ArrayLike, dt: ArrayLike) -> "Scene":
        """The scene a moment later: a step of the method, touches answered, then each part that remembers advances."""
        motion = partial(_free_motion, method)
        responses = dict.fromkeys(contact.response or project for contact in self.contacts)
        # what is answered at the end of the step comes last
        for response in sorted(responses, key=lambda response: response is project):
            motion = partial(response, motion)
        after = motion(self, t, dt)
        state = after.state
        if self.led is not None:
            state = self.led.lead(t + dt, state)
        elif self.contacts and self.pinned is not None:
            held = self.pinned[..., None]
            state = jax.tree.map(lambda now, before: jnp.where(held, before, now), state, self.state)
        return after.having(state=state).advanced(t, dt)

    def advanced(self, t: ArrayLike, dt: ArrayLike) -> "Scene":
        """The scene after each force that remembers has advanced by a step from t to t + dt."""
        forces, state = list(self.forces), self.state
        for i, force in enumerate(forces):
            if hasattr(force, "advance"):
                forces[i], state = force.advance(t, dt, state)
        return self.having(state=state, forces=tuple(forces))

    def having(self, **parts: Any) -> "Scene":
        """The scene with some of its parts replaced, unchecked."""
        names = list(parts)
        where = lambda scene: [getattr(scene, name) for name in names]  # noqa: E731
        return eqx.tree_at(where, self, list(parts.values()), is_leaf=lambda leaf: leaf is None)

    def finite(self, state: Particles) -> Bool[Array, "..."]:
        """Whether the state is finite, per lane, or per scene where lanes are coupled."""
        status = [jnp.all(jnp.isfinite(leaf), axis=-1) for leaf in jax.tree.leaves(state)]
        good = jnp.all(jnp.stack(status), axis=0)
        return jnp.all(good, axis=-1) if self.couples and good.ndim else good


def _free_motion(method: Callable, scene: Scene, t: ArrayLike, dt: ArrayLike) -> Scene:
    """A step of the method as if nothing were in the way."""
    return scene.having(state=method(scene.during(t, dt), t, scene.state, dt))


def loads(scene: Scene, t: ArrayLike, state: Particles | None = None, *, per_term: bool = False) -> Any:
    """Total force on each lane [N] (the lecture's ComputeTotalForce), at `scene.state` unless a state is given.

    Returns an array shaped like the velocity; with `per_term=True` a tuple of such arrays, one for each of
    `scene.forces`.
    """
    state = scene.state if state is None else state
    terms = tuple(_shaped(force, force(t, state, scene.mass), state) for force in scene.forces)
    if per_term:
        return terms
    return _sum(terms) if terms else jnp.zeros_like(state.velocity)


def as_module(function: Callable) -> eqx.Module:
    """A plain function wrapped so that it can travel in a pytree; modules are returned as they are."""
    return function if isinstance(function, eqx.Module) else Function(function)


def _listed(kind: str, parts: Any) -> tuple:
    """The parts as a tuple; a single one given without it is an easy slip and gets an error that says so."""
    if callable(parts) or not hasattr(parts, "__iter__"):
        raise TypeError(f"{kind}s: got {type(parts).__name__}, expected a tuple of {kind}s. Write {kind}s=({kind},).")
    return tuple(parts)


_EXPECTED = {
    "force": "a force: a callable (t, state, mass) -> newtons",
    "contact": "a contact, e.g. contacts.Plane(point=(0, 0), normal=(0, 1))",
}


def _part(kind: str, part: Any, dtype: np.dtype) -> eqx.Module:
    """A force or contact as a pytree whose floating-point numbers have the scene's dtype."""
    good = isinstance(part, Contact) if kind == "contact" else callable(part) and not isinstance(part, type)
    if not good:
        raise TypeError(f"{kind}s: got {type(part).__name__} {part!r}, expected {_EXPECTED[kind]}.")
    return jax.tree.map(
        lambda leaf: leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf,
        part if isinstance(part, eqx.Module) else Function(part),
    )


def _sum(terms: Any) -> Array:
    total, *others = terms
    for term in others:
        total = total + term
    return total


def _shaped(force: Any, value: Any, state: Particles) -> Array:
    """The force's value, if it is shaped like the velocity; seen once, while tracing."""
    expected = state.velocity
    shape, dtype = getattr(value, "shape", ()), getattr(value, "dtype", type(value))
    if shape == expected.shape and dtype == expected.dtype:
        return value
    name = getattr(getattr(force, "function", force), "__name__", type(force).__name__)
    raise TypeError(
        f"force {name}: got an array of shape {shape} and dtype {dtype}, expected {expected.shape} and {expected.dtype} "
        "like the velocity. Build it from state and mass, and keep other numbers Python floats or fields of a module."
    )
