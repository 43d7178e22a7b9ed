"""Point masses, the state of most scenes, and what a scene asks of any record of moving things."""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from physjax.checks import Vectors, as_real_array, as_real_quantity, concrete_or_none, demand_all
from physjax.loops import Time, time_for_part, to_float_time
from physjax.vectors import dot, scale


class StateRecord(Protocol):
    """What a scene asks of a record of moving things; it knows nothing else of what moves in it.

    `validate` checks it against its mass when a scene is built. `view_for_force` is what a force sees of it,
    `evaluate_load` what a force does to it, `generalised_force` the sum of that, `rate` its time derivative; `kick` and
    `drift` are the two halves of a step. `normalised` restores what a step does not keep, such as quaternions of length 1.
    """

    @property
    def lanes(self) -> tuple[int, ...]:
        """Shape of the lanes."""
        ...

    @property
    def dtype(self) -> np.dtype:
        """Floating-point type, which every number of the scene follows."""
        ...

    @property
    def place(self) -> PyTree:
        """What the errors of a path are measured by."""
        ...

    @property
    def rotates(self) -> bool:
        """Whether it has an orientation."""
        ...

    def validate(self, mass: PyTree) -> tuple[PyTree, PyTree]:
        """State and mass as arrays that fit; ValueError or TypeError otherwise."""
        ...

    def view_for_force(self, force: Callable, mass: PyTree) -> tuple[PyTree, PyTree]:
        """The state and the mass that a force sees."""
        ...

    def evaluate_load(self, force: Callable, t: Time, mass: PyTree) -> PyTree:
        """What a force does to each lane."""
        ...

    def sum_loads(self, terms: PyTree) -> PyTree:
        """The sum of loads."""
        ...

    def generalised_force(self, scene: PyTree, t: Time) -> PyTree:
        """All that changes the velocities in a scene at the time t [s]."""
        ...

    def rate(self, loads: PyTree, mass: PyTree) -> PyTree:
        """Time derivative under these loads."""
        ...

    def kick(self, rate: PyTree, dt: ArrayLike) -> PyTree:
        """Velocities changed by `rate` for a time dt [s]."""
        ...

    def drift(self, dt: ArrayLike, mass: PyTree) -> PyTree:
        """Places moved by the velocities for a time dt [s]."""
        ...

    def normalised(self, mass: PyTree) -> PyTree:
        """The state as it must be after a step."""
        ...

    def hold_lanes(self, free: Array) -> PyTree:
        """The state with held lanes (free = 0) at rest."""
        ...


MASS_ADVICE = (
    "numbers > 0: hold what nothing shall move with Scene(pinned=mask); test particles that attract nothing have a mass, and "
    "gm=0 in forces.Gravitation(gm=...)"
)
"""What a mass of zero is meant to say, and how to say it."""


class Particles(NamedTuple):
    """Point masses: position [m] and velocity [m/s], both `(*lanes, dim)`.

    The record knows how Newton's law moves it, so that the methods need no physics: `rate` is its time derivative,
    `kick` changes the velocity and leaves the position, `drift` moves the position with the velocity it has.

    Example:
        >>> balls = Particles(position=jnp.zeros((10_000, 3)), velocity=jnp.ones((10_000, 3)))
        >>> balls.lanes
        (10000,)
    """

    # NumPy arrays and lists may be given as well: `validate` converts them, and an exact path has NumPy arrays
    position: Vectors
    velocity: Vectors

    @property
    def lanes(self) -> tuple[int, ...]:
        """Shape of the lanes: `()` for a single particle."""
        return self.position.shape[:-1]

    @property
    def dtype(self) -> np.dtype:
        """Floating-point type, which every number of the scene follows."""
        return self.position.dtype

    @property
    def place(self) -> Float[Array | np.ndarray, "*lanes dim"]:
        """What the errors of a path are measured by: the position [m]."""
        return self.position

    def view_for_force(self, force: Callable, mass: Float[Array, "..."]) -> tuple["Particles", Float[Array, "..."]]:
        """The state and the mass that a force sees."""
        return self, mass

    def evaluate_load(self, force: Callable, t: Time, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """What a force does to each lane [N], shaped like the velocity; seen once, while tracing."""
        return check_load_shape(force, force(time_for_part(force, t), self, mass), self.velocity)

    def evaluate_field(self, field: Callable, t: Time, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """The acceleration that a field gives to each lane [m/s²]."""
        return check_load_shape(field, field.acceleration(time_for_part(field, t), self, mass), self.velocity)

    def sum_loads(self, terms: Sequence[Array]) -> Float[Array, "*lanes dim"]:
        """The sum of loads [N]."""
        return sum_terms(terms) if terms else jnp.zeros_like(self.velocity)

    def generalised_force(self, scene: PyTree, t: Time) -> Float[Array, "*lanes dim"]:
        """Newton's second law, a = ΣF/m [m/s²]: fields first, so that a falling body never looks its mass up.

        Held lanes do not accelerate, kinematic ones as their path does; what rests on a surface is held by its reaction.
        """
        motion, state = scene.prescribed_motion, self
        if motion is not None:
            state = motion.prescribe(to_float_time(t), state)
        free = None if scene.held is None else 1 - scene.held.astype(state.dtype)
        fields = [state.evaluate_field(f, t, scene.mass) for f in scene.forces if f.is_field]
        newtons = [state.evaluate_load(f, t, scene.mass) for f in scene.forces if not f.is_field]
        total = []
        if fields:
            total.append(sum_terms(fields) if free is None else scale(free, sum_terms(fields)))
        if newtons:
            total.append(scale((1.0 if free is None else free) / scene.mass, sum_terms(newtons)))
        acceleration = sum_terms(total) if total else jnp.zeros_like(state.velocity)
        if motion is not None:
            acceleration = motion.prescribe_acceleration(to_float_time(t), state, acceleration)
        return acceleration if scene.reaction is None else scene.reaction(to_float_time(t), state, acceleration)

    def rate(self, acceleration: Float[Array, "*lanes dim"], mass: PyTree = None) -> "Particles":
        """Time derivative: position changes with the velocity, velocity with the acceleration."""
        return Particles(self.velocity, acceleration)

    def kick(self, rate: "Particles", dt: ArrayLike) -> "Particles":
        """v += a dt, the position untouched."""
        return Particles(self.position, self.velocity + scale(dt, rate.velocity))

    def drift(self, dt: ArrayLike, mass: PyTree = None) -> "Particles":
        """x += v dt, the velocity untouched."""
        return Particles(self.position + scale(dt, self.velocity), self.velocity)

    @property
    def rotates(self) -> bool:
        """Points do not rotate."""
        return False

    def normalised(self, mass: PyTree = None) -> "Particles":
        """The state itself: its arrays need not agree with each other."""
        return self

    def hold_lanes(self, free: Float[Array, "*lanes"]) -> "Particles":
        """The state with the velocity of held lanes (free = 0) set to zero."""
        return Particles(self.position, scale(free, self.velocity))

    def kinetic_energy(self, mass: Float[Array, "..."]) -> Float[Array, "*lanes"]:
        """½mv² [J]."""
        return 0.5 * mass * dot(self.velocity, self.velocity)

    def linear_momentum(self, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """mv [kg m/s]."""
        return scale(mass, self.velocity)

    def validate(self, mass: PyTree) -> tuple["Particles", Float[Array, "..."]]:
        """State and mass as floating-point arrays of one dtype that fit; ValueError or TypeError in plain words otherwise."""
        state = Particles(as_real_array("position", self.position), as_real_array("velocity", self.velocity))
        x, v = state
        if x.ndim == 0 or x.shape != v.shape:
            raise ValueError(
                f"Particles: got position {x.shape} and velocity {v.shape}, expected the same shape (*lanes, dim): "
                "component last, e.g. (2,) for one ball in the plane, (10000, 3) for ten thousand in space."
            )
        if x.ndim == 2 and x.shape[0] in (2, 3) and x.shape[1] > 4:
            raise ValueError(
                f"Particles: got the shape {x.shape}, which is {x.shape[0]} particles of {x.shape[1]} components, expected "
                f"(*lanes, dim), the component last. For {x.shape[1]} particles transpose both arrays: position.T, velocity.T."
            )
        if 0 in x.shape:
            raise ValueError(f"Particles: got the empty shape {x.shape}, expected at least one lane and one component.")
        if x.dtype != v.dtype:
            raise TypeError(
                f"Particles: got position {x.dtype} and velocity {v.dtype}, expected one dtype. Cast one of them."
            )
        for name, array in (("position [m]", x), ("velocity [m/s]", v)):
            as_real_quantity(name, array)
        state = Particles(x.astype(x.dtype), v.astype(v.dtype))  # astype makes weakly typed arrays strong
        mass = as_real_quantity("mass [kg]", mass).astype(state.dtype)
        if (values := concrete_or_none(mass)) is not None:
            demand_all("mass [kg]", mass, values > 0, MASS_ADVICE)
        if mass.shape not in ((), state.lanes):
            raise ValueError(f"mass [kg]: got shape {mass.shape}, expected () or the lanes' shape {state.lanes}.")
        return state, mass


def callable_name(part: object) -> str:
    """What a force or a method is called in sentences: its class, or the name of the function that it is."""
    return getattr(getattr(part, "function", part), "__name__", type(part).__name__)


def demand_state_record(state: object) -> None:
    """Raise a TypeError for a state that is no record of moving things."""
    if not hasattr(type(state), "validate"):
        raise TypeError(
            f"Scene: got a state of type {type(state).__name__}, expected Particles(position, velocity), "
            "or RigidBodies(position, orientation, momentum, angular_momentum)."
        )


def demand_particles(what: str, state: object, why: str) -> None:
    """Raise a TypeError for a state of another kind, where something is done with particles only."""
    if not isinstance(state, Particles):
        raise TypeError(f"{what}: got a state of type {type(state).__name__}, expected Particles: {why}.")


def view_centers(state: PyTree, mass: PyTree) -> Particles:
    """Particles themselves, and those at the centers of mass of bodies."""
    # a force that is no load sees bodies as particles
    return state if isinstance(state, Particles) else state.view_for_force(None, mass)[0]


def sum_terms(terms: Sequence[Array]) -> Array:
    """The sum of arrays, in order."""
    total, *others = terms
    for term in others:
        total = total + term
    return total


def check_load_shape(force: Callable, value: object, expected: Array) -> Array:
    """The value of a force, if it is shaped as expected, like the velocity; a TypeError in plain words otherwise."""
    shape = value.shape if isinstance(value, jax.Array | np.ndarray) else ()
    dtype = value.dtype if isinstance(value, jax.Array | np.ndarray) else type(value)
    if isinstance(value, jax.Array) and shape == expected.shape and dtype == expected.dtype:
        return value
    name = callable_name(force)
    raise TypeError(
        f"force {name}: got an array of shape {shape} and dtype {dtype}, expected {expected.shape} and {expected.dtype} "
        "like the velocity. Build it from state and mass, and keep other numbers Python floats or fields of a module."
    )
