"""Point masses, the state of most scenes; and so what a scene asks of any record of moving things.

A record has `lanes` and `dtype`; is `validate` with its mass when a scene is built; tells what a `evaluate_load` does to it and
their `total`, how it is `generalised_force` and its `rate` for that; kicks, drifts, and is `held`. A record whose arrays must
agree with each other (a quaternion is of length 1) is also `settled` after every step. A scene calls these and knows
nothing else of what moves in it.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.checks import as_real_array, as_real_quantity
from physjax.loops import Time, time_for_part
from physjax.vectors import dot, scale


class Particles(NamedTuple):
    """Point masses: position [m] and velocity [m/s], both `(*lanes, dim)`.

    The record knows how Newton's law moves it, so that the methods need no physics: `rate` is its time derivative,
    `kick` changes the velocity and leaves the position, `drift` moves the position with the velocity it has.

    Example:
        >>> balls = Particles(position=jnp.zeros((10_000, 3)), velocity=jnp.ones((10_000, 3)))
        >>> balls.lanes
        (10000,)
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

    @property
    def place(self) -> Float[Array | np.ndarray, "*lanes dim"]:
        """What the errors of a path are measured by: the position [m]."""
        return self.position

    def view_for_force(self, force: Any, mass: Float[Array, "..."]) -> tuple["Particles", Float[Array, "..."]]:
        """The state and the mass that a force sees."""
        return self, mass

    def evaluate_load(self, force: Any, t: Time, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """What a force does to each lane [N], shaped like the velocity; seen once, while tracing."""
        return check_load_shape(force, force(time_for_part(force, t), self, mass), self.velocity)

    def sum_loads(self, terms: Any) -> Float[Array, "*lanes dim"]:
        """The sum of loads [N]."""
        return sum_terms(terms) if terms else jnp.zeros_like(self.velocity)

    def generalised_force(self, scene: Any, t: Time) -> Float[Array, "*lanes dim"]:
        """Acceleration [m/s²]."""
        return scene.acceleration(t, self)

    def rate(self, acceleration: Float[Array, "*lanes dim"], mass: Any = None) -> "Particles":
        """Time derivative: position changes with the velocity, velocity with the acceleration."""
        return Particles(self.velocity, acceleration)

    def kick(self, rate: "Particles", dt: ArrayLike) -> "Particles":
        """v += a dt, the position untouched."""
        return Particles(self.position, self.velocity + scale(dt, rate.velocity))

    def drift(self, dt: ArrayLike, mass: Any = None) -> "Particles":
        """x += v dt, the velocity untouched."""
        return Particles(self.position + scale(dt, self.velocity), self.velocity)

    def hold_lanes(self, free: Float[Array, "*lanes"]) -> "Particles":
        """The state with the velocity of held lanes (free = 0) set to zero."""
        return Particles(self.position, scale(free, self.velocity))

    def kinetic_energy(self, mass: Float[Array, "..."]) -> Float[Array, "*lanes"]:
        """½mv² [J]."""
        return 0.5 * mass * dot(self.velocity, self.velocity)

    def linear_momentum(self, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """mv [kg m/s]."""
        return scale(mass, self.velocity)

    def validate(self, mass: Any) -> tuple["Particles", Float[Array, "..."]]:
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
        mass = as_real_quantity("mass [kg]", mass, above=0.0).astype(state.dtype)
        if mass.shape not in ((), state.lanes):
            raise ValueError(f"mass [kg]: got shape {mass.shape}, expected () or the lanes' shape {state.lanes}.")
        return state, mass


def demand_particles(what: str, state: Any, why: str) -> None:
    """Raise a TypeError for a state of another kind, where something is done with particles only."""
    if not isinstance(state, Particles):
        raise TypeError(f"{what}: got a state of type {type(state).__name__}, expected Particles: {why}.")


def sum_terms(terms: Any) -> Array:
    """The sum of arrays, in order."""
    total, *others = terms
    for term in others:
        total = total + term
    return total


def check_load_shape(force: Any, value: Any, expected: Array) -> Array:
    """The value of a force, if it is shaped as expected, like the velocity; a TypeError in plain words otherwise."""
    shape, dtype = getattr(value, "shape", ()), getattr(value, "dtype", type(value))
    if shape == expected.shape and dtype == expected.dtype:
        return value
    name = getattr(getattr(force, "function", force), "__name__", type(force).__name__)
    raise TypeError(
        f"force {name}: got an array of shape {shape} and dtype {dtype}, expected {expected.shape} and {expected.dtype} "
        "like the velocity. Build it from state and mass, and keep other numbers Python floats or fields of a module."
    )


def append_axes(number: Array, like: Array) -> Array:
    """A number of each scene or lane, with the axes of an array of the state."""
    return number.reshape(number.shape + (1,) * (like.ndim - number.ndim))
