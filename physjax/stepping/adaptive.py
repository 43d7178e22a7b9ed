"""Steps that choose their own length: `adaptive(method, ...)` subdivides the dt it is given and lands on its end."""

from collections.abc import Callable
from functools import partial, reduce
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, PyTree

from physjax.backend import any_lane
from physjax.checks import as_positive_integer, as_real_quantity, concrete_or_none
from physjax.loops import Time, moment_at, to_float_time
from physjax.particles import demand_particles
from physjax.parts import Force, as_module
from physjax.scene import Scene, project
from physjax.stepping.registry import read_promises
from physjax.stepping.system import S, System, average_over_step, leaf_dtype, read_traits
from physjax.vectors import add_trailing_axes, norm

SAFETY_FACTOR, LECTURE_SAFETY_FACTOR = 0.8, 0.9
"""The next step relative to the one that would just keep the tolerance: ours rejects fewer steps than the lecture's."""
SMALLEST_STEP_FACTOR, LARGEST_STEP_FACTOR = 0.2, 5.0
"""Bounds of the next step relative to the last: one estimate of the error is not trusted further."""
NEGLIGIBLE_ERROR = 1e-10
"""An error, in units of the tolerance, that counts as none."""
SHORTEST_STEP_SHARE = 1e-6
"""The shortest step where none is given, relative to the dt that is subdivided."""


class Steps(NamedTuple):
    """What one subdivided dt took: steps accepted and rejected, the shortest accepted [s], and whether it reached the end.

    Shaped like the scene's status: for each lane where lanes are independent, for each scene where they are coupled.
    """

    state: PyTree
    accepted: Int[Array, "..."]
    rejected: Int[Array, "..."]
    shortest: Float[Array, "..."]
    ok: Bool[Array, "..."]


class Adaptive(eqx.Module):
    """A method that takes each of its steps whole and in two halves, and calls the difference its error.

    Made by `adaptive`; `report` also returns the steps it took. Steps end where a force of the system jumps, and each
    sees the mean over itself of what jumps within it: the system is asked for that mean before every step.
    """

    method: Callable
    atol: Float[Array, ""]
    rtol: Float[Array, ""]
    dt_min: Float[Array, ""] | None
    dt_max: Float[Array, ""] | None
    order: int = eqx.field(static=True)
    error: str = eqx.field(static=True)
    tries: int | None = eqx.field(static=True)

    def __call__(self, system: System, t: Time, state: S, dt: ArrayLike) -> S:
        """The state a dt later; NaN where steps became shorter than `dt_min`, or more than `tries` were needed."""
        return self.report(system, t, state, dt).state

    def check_scene(self, scene: Scene) -> Scene:
        """The scene as it is; a ValueError where a contact or a force acts once a dt, whatever the steps in it."""
        late = [f"{type(f).__name__}, a force that remembers" for f in scene.forces if f.remembers]
        late += [
            f"{type(contact).__name__} with response=contacts.project"
            for contact in scene.contacts
            if (contact.response or project) is project
        ]
        if late:
            raise ValueError(
                f"adaptive: got {late[0]}, which acts once a dt and not in the steps that a tolerance chooses; expected "
                "contacts timed by contacts.impact, and forces without memory. Use equal steps, such as methods.rk4 with a "
                "small dt."
            )
        return scene

    def report(self, system: System, t: Time, state: PyTree, dt: Time) -> Steps:
        """The state a dt later, with the counts of accepted and rejected steps."""
        shape, kind = read_traits(system).status_shape, leaf_dtype(state)
        dt = jnp.broadcast_to(jnp.asarray(dt, kind), shape)
        floor = SHORTEST_STEP_SHARE * dt if self.dt_min is None else jnp.minimum(self.dt_min.astype(kind), dt)
        # a step below rounding would leave the time where it is
        floor = jnp.maximum(floor, 16 * jnp.finfo(kind).eps * dt)
        ceiling = dt if self.dt_max is None else jnp.minimum(self.dt_max.astype(kind), dt)
        h = jnp.clip(self._choose_first_step(system, t, state, dt), floor, ceiling)
        none = jnp.zeros(shape, jnp.int32)
        start = _Progress(
            state=state, elapsed=jnp.zeros(shape, kind), h=lax.stop_gradient(h), accepted=none, rejected=none, shortest=dt,
            failed=jnp.zeros(shape, bool), last=jnp.full(shape, jnp.inf, kind), error=jnp.ones(shape, kind),
        )  # fmt: skip
        attempt = partial(
            self._attempt_step,
            system,
            t,
            dt,
            partial(_find_next_stop, _find_jumps(system, t, shape), dt),
            floor,
            ceiling,
        )
        if self.tries is None:
            end = lax.while_loop(lambda walk: any_lane(walk.going(dt)), attempt, start)
        else:
            end, _ = lax.scan(lambda walk, _: (attempt(walk), None), start, None, length=self.tries)
        # a dt or a tolerance that is traced cannot raise; one that is not > 0 has no end and no error
        bounds = (dt, *(b for b in (self.atol, self.rtol, self.dt_min, self.dt_max) if b is not None))
        legal = [jnp.all(b > 0) if b.ndim == 0 else b > 0 for b in bounds if isinstance(b, Tracer)]
        ok = reduce(jnp.logical_and, legal, ~end.failed & ~end.going(dt))
        # a product, not `where`: the derivatives of a failed lane must be NaN as well, and `where` would make them zero
        state = jax.tree.map(
            lambda leaf: leaf * add_trailing_axes(jnp.where(ok, 1.0, jnp.nan).astype(leaf.dtype), leaf.ndim), end.state
        )
        return Steps(state, end.accepted, end.rejected, end.shortest, ok)

    def _attempt_step(
        self, system: System, t: Time, dt: Array, next_stop: Callable, floor: Array, ceiling: Array, walk: "_Progress"
    ) -> "_Progress":
        """One step whole and in halves, kept if both agree, and the next length from how well they do."""
        stop = next_stop(walk.elapsed)
        going, left = walk.going(dt), stop - walk.elapsed
        # two equal steps to the end rather than a long and a tiny one
        last = walk.h >= left
        h = jnp.where(last, left, jnp.where(2 * walk.h > left, left / 2, walk.h))
        h = jnp.where(going, h, 0.0)
        begun = t + walk.elapsed
        whole = self._take_step(system, begun, walk.state, h)
        middle = self._take_step(system, begun, walk.state, h / 2)
        halves = self._take_step(system, begun + h / 2, middle, h / 2)
        error = lax.stop_gradient(self._measure_error(walk.state, whole, halves, h.shape))
        good = going & (error <= 1.0)
        bad = going & ~good
        factor = self._choose_factor(walk, h, error, good)
        # cut short by the end, a step says little about how long the next may be
        longer = jnp.where(good, jnp.maximum(h * factor, jnp.where(last, walk.h, 0.0)), h * factor)
        return _Progress(
            state=jax.tree.map(lambda a, b: jnp.where(add_trailing_axes(good, a.ndim), a, b), halves, walk.state),
            elapsed=jnp.where(good, jnp.where(last, stop, walk.elapsed + h), walk.elapsed),
            h=jnp.where(going, jnp.clip(longer, floor, ceiling), walk.h),
            accepted=walk.accepted + good.astype(jnp.int32),
            rejected=walk.rejected + bad.astype(jnp.int32),
            shortest=jnp.where(good, jnp.minimum(walk.shortest, h), walk.shortest),
            failed=walk.failed | (bad & ~(h > floor)),  # negated, so that a step of NaN fails as well
            last=jnp.where(good, h, walk.last),
            error=jnp.where(good, error, walk.error),
        )

    def _take_step(self, system: System, t: Time, state: S, h: Array) -> S:
        """One step of the method, with what jumps in time replaced by its mean over the step."""
        # the mean over no time is 0/0: NaN, which would come back in a derivative although it is not selected
        return self.method(average_over_step(system, t, jnp.where(h > 0, h, 1.0)), t, state, h)

    def _choose_factor(self, walk: "_Progress", h: Array, error: Array, good: Array) -> Array:
        """By how much longer the next step may be: as this error allows, or less where errors have been growing.

        The trend, from the accepted step before, is K. Gustafsson's (1994; Hairer and Wanner, section IV.8): without it
        a fifth of all tries is rejected where a body falls towards another, as each step is harder than the last.
        """
        if self.error == "velocity":
            factor = LECTURE_SAFETY_FACTOR * jnp.maximum(error, NEGLIGIBLE_ERROR) ** -0.5
        else:
            power = 1 / (self.order + 1)
            now, before = jnp.maximum(error, NEGLIGIBLE_ERROR), jnp.maximum(walk.error, NEGLIGIBLE_ERROR)
            factor = SAFETY_FACTOR * now**-power
            # no step before: its length is infinite, and nothing is known
            trend = jnp.where(jnp.isfinite(walk.last), h / walk.last * (before / now) ** power, 1.0)
            factor = jnp.where(good, factor * jnp.minimum(trend, 1.0), factor)
        return jnp.where(
            jnp.isfinite(error), jnp.clip(factor, SMALLEST_STEP_FACTOR, LARGEST_STEP_FACTOR), SMALLEST_STEP_FACTOR
        )

    def _measure_error(self, start: PyTree, whole: PyTree, halves: PyTree, shape: tuple[int, ...]) -> Array:
        """The largest difference in units of the tolerance; or, as in the lecture, |v₁ - v₂| alone over atol."""
        if self.error == "velocity":
            demand_particles("error='velocity'", halves, "bodies have momenta. Leave it out")
            worst = norm(halves.velocity - whole.velocity)
            return _max_over_shared_step(worst, shape) / self.atol.astype(worst.dtype)
        return _scaled_norm(jax.tree.map(lambda a, b: a - b, halves, whole), self._tolerance(start, halves), shape)

    def _tolerance(self, start: S, end: S) -> S:
        size = jax.tree.map(lambda a, b: jnp.maximum(jnp.abs(a), jnp.abs(b)), start, end)
        return jax.tree.map(lambda s: self.atol.astype(s.dtype) + self.rtol.astype(s.dtype) * s, size)

    def _choose_first_step(self, system: System, t: Time, state: PyTree, dt: Array) -> Array:
        """A first length from how fast the state and its rate change (Hairer, Nørsett, Wanner, section II.4)."""
        shape, tolerance = dt.shape, self._tolerance(state, state)
        slope = system.rate(t, state)
        size, speed = _scaled_norm(state, tolerance, shape), _scaled_norm(slope, tolerance, shape)
        small = 0.01 * jnp.where(speed > 0, size / jnp.where(speed > 0, speed, 1.0), 1e30)
        small = jnp.clip(small, SHORTEST_STEP_SHARE * dt, dt)
        ahead = jax.tree.map(lambda y, k: y + add_trailing_axes(small, y.ndim) * k, state, slope)
        turn = jax.tree.map(lambda a, b: a - b, system.rate(t + small, ahead), slope)
        second_derivative = jnp.maximum(_scaled_norm(turn, tolerance, shape) / small, 1e-30)
        # half of y'' dt² is what a step of first order misses
        return jnp.minimum(100 * small, (0.01 / jnp.maximum(second_derivative, speed)) ** (1 / (self.order + 1)))


class _Progress(NamedTuple):
    """How far the steps have come; `last` and `error` are of the last step accepted."""

    state: PyTree
    elapsed: Array
    h: Array
    accepted: Array
    rejected: Array
    shortest: Array
    failed: Array
    last: Array
    error: Array

    def going(self, dt: Array) -> Array:
        """Which have not reached the end."""
        return (self.elapsed < dt) & ~self.failed


def adaptive(
    method: Callable,
    atol: ArrayLike = 1e-6,
    rtol: ArrayLike = 1e-6,
    *,
    dt_min: ArrayLike | None = None,
    dt_max: ArrayLike | None = None,
    order: int | None = None,
    error: str = "state",
    tries: int | None = None,
) -> Adaptive:
    """A method that subdivides its own dt so that no step's error exceeds the tolerance, by step doubling.

    Each step is taken whole and in two halves; E = max |y₁ - y₂| / (atol + rtol |y|) over position and velocity. E <= 1
    keeps the halves, otherwise the step is redone; the next is 0.8 E^(-1/(p+1)) times as long, p the method's order, at
    most 5 times, and less where the error has been growing. Every independent lane has steps of its own, and all land
    exactly on the end of dt: 3 times the evaluations of the method a try, and two to begin a dt with, so give it long
    ones. Steps end where a force jumps (`Kick`, `Control`, `Blast`); a force of your own that jumps and gives neither
    `averaged_over_step` nor `discontinuities` (see `Force`) can be stepped over. Forces with memory and contacts resolved
    by `contacts.project` act once a dt, which no tolerance can mend: a scene with them is refused with a ValueError.
    Timed contacts are counted per dt as well: a flight shorter than a quarter of dt is the last before rest, and after
    64 contacts in one dt (8 of a body) a lane waits for the next, so take a dt in which few bounces happen.

    `error="velocity"` is the lecture's E = |v₁ - v₂| / atol, the next step 0.9 E^(-1/2) times as long. It cannot see
    position: under gravity alone it is 0, and a throw of 2 s by Euler ends metres off. A step rejected at `dt_min` [s]
    (a millionth of dt, if not given) ends that lane as NaN: see `.ok` and `.first_bad_step` of a run. `tries` bounds
    the steps of one dt and makes the run differentiable in reverse; where more are needed, state and derivatives are NaN
    as well. Symplectic methods (semi-implicit Euler, verlet, leapfrog) lose their bounded energy: with steps that depend
    on the state it drifts.

    Example:
        >>> careful = methods.adaptive(methods.rk4, atol=1e-5, rtol=1e-5)
        >>> end = simulate(swing, careful, dt=1.0, steps=1).position[-1, 0]
        >>> round(float(end), 3), round(float(np.cos(2.0 * 1.0)), 3)
        (-0.416, -0.416)
    """
    if not callable(method):
        raise TypeError(f"adaptive: got the method {method!r}, expected one such as methods.rk4.")
    module = as_module(method)
    if error not in ("state", "velocity"):
        raise ValueError(f"error: got {error!r}, expected 'state' or 'velocity' (the lecture's).")
    if order is None:
        promises = read_promises(method)
        if promises is None:
            raise ValueError("adaptive: the method promises no order. Give order=.")
        order = promises.order
    atol, rtol = as_real_quantity("atol", atol, above=0.0), as_real_quantity("rtol", rtol, above=0.0)
    dt_min, dt_max = (
        None if h is None else as_real_quantity(name, h, above=0.0)
        for name, h in (("dt_min", dt_min), ("dt_max", dt_max))
    )
    known = [concrete_or_none(h) for h in (dt_min, dt_max) if h is not None]
    shortest, longest = known if len(known) == 2 else (None, None)
    if shortest is not None and longest is not None and shortest > longest:
        raise ValueError(f"dt_min: got {shortest:g} s, which is more than dt_max {longest:g} s. Exchange them.")
    return Adaptive(
        module,
        atol,
        rtol,
        dt_min,
        dt_max,
        as_positive_integer("order", order),
        error,
        None if tries is None else as_positive_integer("tries", tries),
    )


def count_steps(scene: Scene, method: Adaptive, *, dt: ArrayLike, steps: int) -> Steps:
    """Accepted and rejected steps of a run, dt by dt along a leading axis, the states at its ends with them.

    Example:
        >>> counts = methods.count_steps(swing, methods.adaptive(methods.rk4, atol=1e-5, rtol=1e-5), dt=1.0, steps=1)
        >>> bool(counts.accepted[0] > 1)
        True
    """
    if not isinstance(method, Adaptive):
        raise TypeError(f"count_steps: got {type(method).__name__}, expected methods.adaptive(...).")
    return _count_steps(scene, method, as_real_quantity("dt [s]", dt, above=0.0), as_positive_integer("steps", steps))


@eqx.filter_jit
def _count_steps(scene: Scene, method: Adaptive, dt: Array, steps: int) -> Steps:
    dt = dt.astype(scene.state.dtype)
    arrays, still = eqx.partition(scene, eqx.is_array)

    def one(arrays: Scene, i: Array) -> tuple[Scene, Steps]:
        scene = eqx.combine(arrays, still)
        t = moment_at(i, dt, scene.state.dtype)
        reported = method.report(scene, t, scene.state, dt)
        after = scene.step(method, t, dt)
        return eqx.filter(after, eqx.is_array), reported._replace(state=after.state)

    return lax.scan(one, arrays, jnp.arange(steps, dtype=jnp.int32))[1]


def _find_jumps(system: System, t: Time, shape: tuple[int, ...]) -> list[Array]:
    """When forces of a system jump, after t [s]: `(*shape, k)` each."""
    found = []
    for force in read_traits(system).forces:
        for times in map(jnp.asarray, force.discontinuities() if isinstance(force, Force) else ()):
            own = shape and times.shape[: len(shape)] == shape
            times = times.reshape((*shape, -1)) if own else times.reshape((1,) * len(shape) + (-1,))
            found.append(times - jnp.broadcast_to(to_float_time(t), shape)[..., None])
    return found


def _find_next_stop(jumps: list[Array], dt: Array, elapsed: Array) -> Array:
    """The end of dt, or the first jump before it that has not been reached."""
    for times in jumps:
        ahead = jnp.where(times > elapsed[..., None], times, jnp.inf)
        dt = jnp.minimum(dt, jnp.min(ahead, axis=-1))
    return dt


def _scaled_norm(state: S, tolerance: S, shape: tuple[int, ...]) -> Array:
    """The largest component in units of its tolerance, for each scene or lane."""
    leaves = [jnp.abs(a / b) for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(tolerance), strict=True)]
    largest = reduce(jnp.maximum, [leaf[..., i] for leaf in leaves for i in range(leaf.shape[-1])])
    return _max_over_shared_step(largest, shape)


def _max_over_shared_step(number: Array, shape: tuple[int, ...]) -> Array:
    """The largest number of all lanes that share a step."""
    return jnp.max(number, axis=tuple(range(len(shape), number.ndim)))


__all__ = ["Adaptive", "Steps", "adaptive", "count_steps"]
