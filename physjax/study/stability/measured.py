"""Whether small deviations from a state grow, measured by running the scene: the test of every prediction.

A scene that is not at rest moves on meanwhile, and its deviations grow and shrink with where it goes. So that a limit
belongs to one state, only the deviation is run, under the forces that it adds to those of that state. The part of it that
grows whatever the method is removed after every step.
"""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.checks import as_positive_integer, as_real_quantity
from physjax.compiling import announce_compiling
from physjax.particles import Particles
from physjax.parts import Force
from physjax.scene import Scene
from physjax.study.stability.limits import check_method
from physjax.study.stability.linearisation import (
    SmallMotion,
    follows_rates,
    linearise,
    prepare_linearisation,
    sqrt_mass,
)
from physjax.study.stability.planar import State, count_substeps
from physjax.vectors import scale

DEVIATION_SIZE_SHARE = 1e-10
"""A deviation, relative to the scene's size (or its way in the time of its fastest motion): far from rounding and curvature."""
SMALLEST_SIZE = 1e-3
"""Size of a scene that has none, one node at rest [m]."""
ESCAPE_FACTOR = 1e4
"""A deviation that has grown by this has left the state it began at; it may well stop growing there."""
GROWTH_RATIO = 1.5
"""A deviation grows if it is this much larger in the second half of a run than in the first: beats stay below."""
RATE_RANGE = 1e-3, 1e2
"""Steps searched for a limit, times the fastest rate: five decades about every known method's."""
TRIAL_ROUNDS = 3
"""Rounds of trials, each within the gap that the last left."""
EARLY_STEPS = 4
"""Steps at the beginning of a run in which the size of a deviation is taken."""
TRIAL_STEPS = 16
"""Steps tried at once; three rounds of them narrow five decades down to 0.3 %."""


@announce_compiling("measure_limit")
def measure_limit(
    scene: Scene,
    method: Callable,
    at: State | None = None,
    *,
    steps: int = 4000,
    between: tuple[float, float] | None = None,
) -> np.ndarray:
    """The largest dt [s] at which `steps` steps do not make a small deviation from a state grow: by batched bisection.

    About the scene's state, if none is given, and shaped like `scene.status_shape`. Slow growth needs many `steps` to
    be seen: a method that is never stable shows the dt up to which its growth goes unnoticed. Motions that grow by
    themselves (`grows_by_itself`) are left out. The search is `between` two steps [s], by default five decades around the
    fastest rate of the scene; 0 or infinity where the limit is outside.

    Example:
        >>> round(float(stability.measure_limit(swing, methods.verlet, steps=400)), 2)
        1.0
    """
    with jax.enable_x64(True):
        substeps = count_substeps(scene)
        scene, state = prepare_linearisation(scene, at)
        bottom, top = _choose_range(scene, state) if between is None else _check_range(between, scene, substeps)
        low, high = bottom, top
        for _ in range(TRIAL_ROUNDS):
            tried = np.geomspace(low, high, TRIAL_STEPS)
            bad = grows(scene, method, tried, state, steps=steps)
            first = np.where(bad.any(axis=0), bad.argmax(axis=0), TRIAL_STEPS)
            pick = lambda i: np.take_along_axis(tried, np.clip(i, 0, TRIAL_STEPS - 1)[None], axis=0)[0]  # noqa: E731, B023
            low, high = pick(first - 1), pick(first)
        return substeps * np.where(high <= bottom, 0.0, np.where(low >= top, np.inf, low))


def grows(scene: Scene, method: Callable, dt: ArrayLike, at: State | None = None, *, steps: int = 4000) -> np.ndarray:
    """Whether a small deviation grows in a run with steps of dt [s], for each scene (lane, where they are independent).

    A dt is unstable if the deviation is half as large again in the second half of the run as it ever was in the first, or
    has left for good. `dt` has `scene.status_shape` or is a number; leading axes are further trials.

    Example:
        >>> [bool(stability.grows(swing, methods.verlet, dt, steps=200)) for dt in (0.8, 1.25)]
        [False, True]
    """
    begin, early, late = _measure_deviations(scene, method, dt, at, steps)
    # a deviation that comes to rest elsewhere has left as well; written so that NaN grows
    return ~((late <= GROWTH_RATIO * early) & (np.maximum(early, late) <= ESCAPE_FACTOR * begin))


def measure_growth(
    scene: Scene, method: Callable, dt: ArrayLike, at: State | None = None, *, steps: int = 2000
) -> np.ndarray:
    """The factor by which a small deviation grows in a step of dt [s], on average over half a run; infinite if it blew up.

    Example:
        >>> round(float(stability.measure_growth(swing, methods.euler, 0.5, steps=100)), 2)
        1.41
    """
    _, early, late = _measure_deviations(scene, method, dt, at, steps)
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(late), (late / early) ** (2 * count_substeps(scene) / steps), np.inf)


def _choose_range(scene: Scene, state: Particles) -> tuple[np.ndarray, np.ndarray]:
    fastest_rate = _find_fastest_rate(linearise(scene, state))
    return RATE_RANGE[0] / fastest_rate, RATE_RANGE[1] / fastest_rate


def _find_fastest_rate(motion: SmallMotion) -> np.ndarray:
    """The fastest rate of each scene [1/s]; 1 where nothing swings or decays."""
    fastest = motion.fastest_rate()
    return np.where(fastest > 0, fastest, 1.0)


def _check_range(between: tuple[float, float], scene: Scene, substeps: int) -> tuple[np.ndarray, np.ndarray]:
    low, high = (float(as_real_quantity("between [s]", number, above=0.0)) / substeps for number in between)
    if low >= high:
        raise ValueError(f"between [s]: got {between[0]:g} and {between[1]:g}, expected the smaller step first.")
    return np.full(scene.status_shape, low), np.full(scene.status_shape, high)


OwnGrowth = tuple[Array | np.ndarray, Array | np.ndarray | None]
"""The projector on motions that grow by themselves, and the basis it is written in (None: the lanes' components)."""


class _DeviationForce(Force):
    """The forces that a deviation from a state adds to those of a scene there."""

    scene: Scene
    state: Particles

    @property
    def couples(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]  as the scene's forces do
        return self.scene.couples

    def __call__(self, t: ArrayLike, state: Particles, mass: Array) -> Array:
        now = jnp.zeros((), state.dtype)
        deviated = jax.tree.map(jnp.add, self.state, state)
        return scale(mass, self.scene.acceleration(now, deviated) - self.scene.acceleration(now, self.state))


def _measure_deviations(
    scene: Scene, method: Callable, dt: ArrayLike, at: State | None, steps: int
) -> tuple[np.ndarray, ...]:
    """The largest velocity of a deviation at the beginning, in the first and in the second half of a run."""
    steps = as_positive_integer("steps", steps, at_least=64)
    with jax.enable_x64(True):
        dt = np.asarray(as_real_quantity("dt [s]", dt, above=0.0), float) / count_substeps(scene)
        scene, state = prepare_linearisation(scene, at)
        status = scene.status_shape
        leading = dt.shape[: dt.ndim - len(status)] if dt.ndim > len(status) else ()
        trials = np.broadcast_to(dt, (*leading, *status)).reshape((-1, *status))
        motion = linearise(scene, state)
        method = check_method(method)
        fastest_rate = jnp.asarray(_find_fastest_rate(motion))
        # without damping a method that kicks and drifts keeps the decaying partners of growing modes as well
        growth_projector = motion.growth_projector(partners=motion.undamped and not follows_rates(method))
        own = None if growth_projector is None else (growth_projector, motion.basis)
        found = _run_deviations(scene, state, method, fastest_rate, own, jnp.asarray(trials), steps)
        return tuple(np.asarray(a).reshape((*leading, *status)) for a in found)


@eqx.filter_jit
def _run_deviations(
    scene: Scene,
    state: Particles,
    method: Callable,
    fastest_rate: Float[Array, "..."],
    own: OwnGrowth | None,
    dts: Float[Array, "trials ..."],
    steps: int,
) -> tuple[Array, Array, Array]:
    """The largest velocity of a deviation early, in the first and in the second half of a run, for each trial."""
    x, v = state
    reach = jnp.maximum(jnp.max(jnp.abs(x - jnp.mean(x))), jnp.max(jnp.abs(v)) / jnp.max(fastest_rate))
    size = DEVIATION_SIZE_SHARE * jnp.maximum(reach, SMALLEST_SIZE)
    keys = jax.random.split(jax.random.key(0))
    push, speed = (size * jax.random.normal(key, x.shape, x.dtype) for key in keys)
    # positions and velocities in the proportion of the fastest mode: slower modes then move as well
    start = Particles(push, scale(fastest_rate, speed))
    if (held := scene.held) is not None:
        start = jax.tree.map(lambda leaf: scale(1 - held.astype(x.dtype), leaf), start)
    remove_growth = (lambda state: state) if own is None else partial(_remove_own_growth, own, scene)
    start = remove_growth(start)
    deviation = Scene(start, mass=scene.mass, forces=(_DeviationForce(scene, state),), pinned=scene.held)
    inner = (-2, -1) if scene.couples else -1

    def run(dt: Array) -> tuple[Array, Array, Array]:
        def step(i: Array, carry: tuple) -> tuple:
            state, worst = carry
            state = remove_growth(deviation.replace(state=state).step(method, i.astype(x.dtype) * dt, dt).state)
            speed = jnp.max(jnp.abs(state.velocity), axis=inner)
            speed = jnp.where(jnp.isfinite(speed), speed, jnp.inf)  # a maximum would pass over NaN
            spans = (i < EARLY_STEPS, i < steps // 2, i >= steps // 2)
            worst = tuple(jnp.where(now, jnp.maximum(w, speed), w) for now, w in zip(spans, worst, strict=True))
            return state, worst

        zero = jnp.zeros(scene.status_shape, x.dtype)
        return lax.fori_loop(0, steps, step, (deviation.state, (zero, zero, zero)))[1]

    return jax.vmap(run)(dts)


def _remove_own_growth(own: OwnGrowth, scene: Scene, state: Particles) -> Particles:
    """A deviation without its part of motions that grow by themselves."""
    growth_projector, basis = own
    weight = sqrt_mass(scene, state)
    blocks = growth_projector.shape[:-2]
    both = [(leaf * weight).reshape((*blocks, -1)) for leaf in state]
    # into the coordinates of the modes and back, where only the fastest are known
    reduced = both if basis is None else [jnp.einsum("...ij,...j->...i", basis, a) for a in both]
    grown = jnp.einsum("...ij,...j->...i", growth_projector, jnp.concatenate(reduced, axis=-1))
    parts = jnp.split(grown, 2, axis=-1)
    parts = parts if basis is None else [jnp.einsum("...ij,...i->...j", basis, a) for a in parts]
    return Particles(*(leaf - a.reshape(leaf.shape) / weight for leaf, a in zip(state, parts, strict=True)))
