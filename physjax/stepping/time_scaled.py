"""Steps that follow the pace of the motion: leapfrog in another time, in which steps are equal (K. F. Sundman 1912).

Where a planet is near the sun everything is fast, and a step that is short enough there is wasted elsewhere. Steps chosen
from errors lose the bounded energy of a symplectic method; steps of dt/ds = g keep it, if the way to choose them is the same
there and back. The time is then a coordinate of the motion, and no step ends at a given time: the method goes its own way
beyond the end of each dt, and what is read there is a step back from it that is not carried on.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.loops import Time, differentiable_while_loop, is_library_part, to_float_time
from physjax.particles import callable_name, demand_particles
from physjax.parts import Function, as_module
from physjax.scene import Scene
from physjax.stepping.dependence import find_dependent, find_kicked, name_forces_of_velocity
from physjax.stepping.registry import Promises, read_promises
from physjax.stepping.system import S, System, average_over_step, leaf_dtype, read_traits
from physjax.tracebacks import Module, shorten_tracebacks

SHORTEST_STEP_SHARE = 1e-9
"""The shortest step, relative to dt: a pace that asks for shorter ones would never arrive."""
SMALLEST_ENERGY_SHARE = 1e-4
"""A scene whose energy is a smaller share of its potential energy is about to escape, and its orbit has no size."""
LANDING_TURNS = 1
"""How often the step back to the end of dt is corrected: its time is then right to dt⁴, and no error of it is carried on."""
MOST_STEPS = 4096
"""Steps in one dt of which derivatives are known."""


class ScaledMotion(NamedTuple):
    """The way that a method goes: a state, how far [s] it is beyond the start of the next dt, and what its pace follows."""

    state: Any
    ahead: Array
    numbers: Any


class TimeScaled(Module):
    """A method whose steps follow the pace of the motion, made by `time_scaled`. It remembers its way from dt to dt.

    Called as a plain method it forgets it, and starts over at each dt.
    """

    method: Function
    pace: Callable | None
    promises: Promises = eqx.field(static=True)

    @property
    def __name__(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]  # of the instance, as a function has
        pace = "" if self.pace is None else f", {callable_name(self.pace)}"
        return f"time_scaled({callable_name(self.method)}{pace})"

    def start(self, system: System, t: Time, state: Any, dt: ArrayLike) -> ScaledMotion:
        """The memory at the start of a run, before the first step dt [s] from the time t [s]."""
        nowhere = jnp.zeros(read_traits(system).status_shape, leaf_dtype(state))
        if self.pace is None:
            _demand_conserved_energy(system)
        return ScaledMotion(state, nowhere, self._rule.begin(system, t, state))

    def advance(
        self, system: System, t: Time, state: Any, dt: ArrayLike, memory: ScaledMotion
    ) -> tuple[Any, ScaledMotion]:
        """The state at t + dt [s], and the memory for the next step; the way goes on from the memory, not from `state`."""
        rule, kind = self._rule, memory.ahead.dtype
        dt = jnp.broadcast_to(jnp.asarray(dt, kind), memory.ahead.shape)
        shortest = max(SHORTEST_STEP_SHARE, 16 * float(jnp.finfo(kind).eps))

        def turn(walk: _Walk) -> _Walk:
            going = walk.left > 0
            now = t + (dt - walk.left)
            end, elapsed, numbers = rule.leap(system, now, walk.state, walk.numbers, jnp.where(going, dt, 0.0))
            end = system.normalised(end) if isinstance(system, Scene) else end
            stuck = going & ~(elapsed > shortest * dt)  # negated, so that a step of NaN ends the lane as well
            return _Walk(end, jnp.where(stuck, jnp.nan, walk.left - elapsed), numbers)

        start = _Walk(memory.state, dt - memory.ahead, memory.numbers)
        walk = differentiable_while_loop(lambda walk: walk.left > 0, turn, start, most=MOST_STEPS)
        end = rule.step_back(system, t + dt, walk.state, walk.numbers, -walk.left)
        return end, ScaledMotion(walk.state, -walk.left, walk.numbers)

    def __call__(self, system: System, t: Time, state: S, dt: ArrayLike) -> S:
        """The state after a step dt [s] from the time t [s], on a way of its own."""
        return self.advance(system, t, state, dt, self.start(system, t, state, dt))[0]

    @property
    def _rule(self) -> "_Rule":
        return _Logarithmic() if self.pace is None else _Paced(self.method, self.pace)


class _Walk(NamedTuple):
    """A way with the time that is left until the end of dt [s]; negative beyond it."""

    state: Any
    left: Array
    numbers: Any


class _Rule(Protocol):
    """How the steps of a way are chosen, by numbers that go along with it."""

    def begin(self, system: Any, t: Time, state: Any) -> Any:
        """The numbers at the start."""
        ...

    def leap(self, system: Any, t: Time, state: S, numbers: Any, dt: Array) -> tuple[S, Array, Any]:
        """A step of the pace dt [s]: where it ends, the time that it took [s], and the numbers there."""
        ...

    def step_back(self, system: Any, t: Time, state: S, numbers: Any, ahead: Array) -> S:
        """The state at the time t, from one that is ahead of it [s]."""
        ...


class _Paced(NamedTuple):
    """Steps of dt g(state), with a density of steps ρ = 1/g that is integrated and not looked up: d ln ρ = -g' dt.

    Each step goes by the density at its middle: it is the same there and back (E. Hairer and G. Söderlind 2005). The
    numbers are ln ρ and g' [1/s] where the state is.
    """

    method: Callable
    pace: Callable

    def begin(self, system: System, t: Time, state: Any) -> tuple[Array, Array]:
        pace, change = self._measure(system, t, state)
        return -jnp.log(pace), change

    def leap(self, system: System, t: Time, state: S, numbers: Any, dt: Array) -> tuple[S, Array, Any]:
        density, change = numbers
        middle = density - dt / 2 * change
        elapsed = dt * jnp.exp(-middle)
        # the mean over no time is 0/0: NaN, which would come back in a derivative although it is not selected
        seen = average_over_step(system, t, jnp.where(elapsed > 0, elapsed, 1.0))
        end = self.method(seen, t, state, elapsed)
        _, change = self._measure(system, t + elapsed, end)
        return end, elapsed, (middle - dt / 2 * change, change)

    def step_back(self, system: System, t: Time, state: S, numbers: Any, ahead: Array) -> S:
        """The state at the time t, from one that is ahead of it [s]."""
        seen = average_over_step(system, t, jnp.where(ahead > 0, ahead, 1.0))
        return self.method(seen, t + ahead, state, -ahead)

    def _measure(self, system: System, t: Time, state: Any) -> tuple[Array, Array]:
        """The pace [1] and how it changes [1/s], for each lane or scene."""
        return jax.jvp(lambda y: self._read_pace(system, y), (state,), (system.rate(t, state),))

    def _read_pace(self, system: System, state: Any) -> Array:
        shape, pace = read_traits(system).status_shape, jnp.asarray(self.pace(state))
        if pace.shape not in ((), shape):
            raise ValueError(
                f"time_scaled: got a pace of shape {pace.shape}, expected () or {shape}, a number > 0 for each scene where "
                "lanes are coupled, for each lane where not."
            )
        return jnp.broadcast_to(pace.astype(leaf_dtype(state)), shape)


class _Logarithmic(NamedTuple):
    """Leapfrog of the Hamiltonian ln(T + B) - ln U, with the kinetic energy T, U = -V and B = U - T of the start.

    It drifts for ds/(T + B) and kicks for ds/U, which are the same where the energy is kept: the orbit of two bodies is then
    exact, and only the time along it has an error (S. Mikkola and K. Tanikawa 1999, M. Preto and S. Tremaine 1999). The
    numbers are B and ds/dt [J], which is the mean of U in time by the virial theorem: 2|B|.
    """

    def begin(self, system: Any, t: Time, state: Any) -> tuple[Array, Array]:
        depth = _sum_depth(system, t, state)
        binding = depth - _sum_kinetic(system, state)
        return binding, jnp.maximum(2 * jnp.abs(binding), SMALLEST_ENERGY_SHARE * depth)

    def leap(self, system: Any, t: Time, state: S, numbers: Any, dt: Array) -> tuple[S, Array, Any]:
        binding, mean = numbers
        end, elapsed, _ = self._leap(system, t, state, binding, mean * dt)
        return end, elapsed, numbers

    def step_back(self, system: Any, t: Time, state: S, numbers: Any, ahead: Array) -> S:
        """The state at the time t, from one that is ahead of it [s]: on the orbit, the time to a higher order."""
        binding, _ = numbers
        way = -ahead * (_sum_kinetic(system, state) + binding)
        for _ in range(LANDING_TURNS):
            _, elapsed, inverse_pace = self._leap(system, t, state, binding, way)
            way = way - (ahead + elapsed) * inverse_pace
        return self._leap(system, t, state, binding, way)[0]

    def _leap(self, system: Any, t: Time, state: S, binding: Array, way: Array) -> tuple[S, Array, Array]:
        """Drift, kick and drift for a way [J s]: where it ends, the time that it takes [s], and ds/dt there [J]."""
        first = way / 2 / (_sum_kinetic(system, state) + binding)
        half = system.drift(state, first)
        kicked = system.kick(half, system.rate(t, half), way / _sum_depth(system, t, half))
        inverse_pace = _sum_kinetic(system, kicked) + binding
        second = way / 2 / inverse_pace
        return system.drift(kicked, second), first + second, inverse_pace


@shorten_tracebacks
def time_scaled(method: Callable, pace: Callable | None = None) -> TimeScaled:
    """A symplectic method whose steps are short where the motion is fast, with its energy bounded as with equal steps.

    Of order 2 in dt. `pace(state)` is how long a step is relative to dt, any positive function of the state: one number for
    each scene where lanes are coupled, for each lane where not, such as r^(3/2) of a planet at a distance r, in units in
    which it is about 1. The method is `methods.leapfrog` or `methods.verlet`. Without a pace it is that of the logarithmic
    Hamiltonian, 2|E|/U, for particles whose forces all have a potential energy below zero that does not depend on time,
    as gravitation: U is that energy with its sign changed, E the total energy, and dt the mean step (of a bound orbit, by
    the virial theorem). The orbit of two bodies is then exact, only the time along it is not. For this take
    `methods.leapfrog`. Where U is not > 0, or a pace is not, or asks for a step below a billionth of dt, a lane ends as NaN.

    No step of it ends with dt: frames are a step back from the way it goes, which costs a step more for each dt (without a
    pace two). `simulate` carries its way from dt to dt; called by hand, or where contacts end steps
    early, it starts over at each dt, and does not keep the energy as well. Reverse mode knows the derivatives of 4096 steps
    in one dt. Raises ValueError or TypeError for other methods and, while tracing, for forces without a potential.

    Example:
        >>> scaled = methods.time_scaled(methods.leapfrog, pace=lambda state: 1.0 + state.position[0] ** 2)
        >>> end = scaled(swing, 0.0, swing.state, 0.01)
        >>> round(float(end.position[0]), 3), round(float(np.cos(2.0 * 0.01)), 3)
        (1.0, 1.0)
    """
    if not callable(method):
        raise TypeError(f"time_scaled: got the method {method!r}, expected methods.leapfrog or methods.verlet.")
    name = callable_name(method)
    if not is_library_part(method) or name not in ("leapfrog", "verlet"):
        raise ValueError(f"time_scaled: got the method {name}, expected methods.leapfrog or methods.verlet.")
    if pace is not None and not callable(pace):
        raise TypeError(f"time_scaled: got the pace {pace!r}, expected a function state -> number > 0, or None.")
    if pace is None and name != "leapfrog":
        raise ValueError(
            f"time_scaled: got {name} without a pace, expected methods.leapfrog: of the logarithmic Hamiltonian only drift, "
            "kick and drift keeps the orbit of two bodies. Give the method or a pace."
        )
    if pace is None:
        promised = Promises(order=2, evaluations=2 + LANDING_TURNS, stability_limit=2.0, order_with_drag=0)
        return TimeScaled(Function(method), None, promised)
    promised = read_promises(method) or Promises(order=2, evaluations=2, stability_limit=2.0, order_with_drag=1)
    return TimeScaled(Function(method), as_module(pace), promised._replace(evaluations=2 * promised.evaluations))


def _demand_conserved_energy(scene: Any) -> None:
    """Raise a TypeError or a ValueError unless a scene keeps the sum of its kinetic and potential energy."""
    if not isinstance(scene, Scene):
        raise TypeError(
            f"time_scaled: got a {type(scene).__name__}, expected a Scene, which knows its energy. Give pace=, a function of "
            "the state."
        )
    demand_particles(
        "time_scaled", scene.state, "bodies have no energy that a drift keeps. Give pace=, or use another method"
    )
    without = [callable_name(f) for f in scene.forces if not f.has_potential]
    where = "" if scene.forces else "no forces"
    where = f"forces without a potential energy ({', '.join(without)})" if without else where
    where = "kinematic nodes, which do work" if scene.prescribed_motion is not None else where
    zero = jnp.zeros((), scene.state.dtype)
    if not where:
        seeing = name_forces_of_velocity(scene, zero, scene.state, find_kicked(scene, scene.state))
        energies = lambda t: (scene.rate(t, scene.state), _sum_depth(scene, t, scene.state))  # noqa: E731
        where = f"forces that look at the velocity ({seeing})" if seeing else where
        where = "forces that change with time" if any(find_dependent(energies, zero, marked=[True])) else where
    if where:
        raise ValueError(
            f"time_scaled: got {where}, expected forces that all have a potential energy and keep the total, such as "
            "gravitation. Give pace=, a function of the state, or use another method."
        )


def _sum_kinetic(scene: Scene, state: Any) -> Array:
    """T [J], for each lane or scene."""
    return _sum_coupled(scene, state.kinetic_energy(scene.mass))


def _sum_depth(scene: Scene, t: Time, state: Any) -> Array:
    """U = -V, the depth of the potential [J], for each lane or scene."""
    terms = [f.potential(to_float_time(t), *state.view_for_force(f, scene.mass)) for f in scene.forces]
    return -_sum_coupled(scene, sum(terms[1:], terms[0]))


def _sum_coupled(scene: Scene, per_lane: Array) -> Array:
    return jnp.sum(per_lane, axis=-1) if scene.couples else per_lane
