"""Whether small deviations grow, measured by running the scene: the test of every prediction."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from physjax.checks import positive_integer, real_quantity
from physjax.scene import Particles, Scene, as_module
from physjax.stepping.reference import in_dtype
from physjax.study.small_motion import small_motion
from physjax.vectors import scale

SMALL = 1e-8
"""A deviation, in parts of the scene's size: far from both rounding and curvature."""
GREAT = 1e4
"""What has grown by this has left the state it began at; it may well stop growing there."""
BATCH = 16
"""Steps tried at once; three rounds of them find a limit among five decades within 0.3 %."""


def measure_limit(
    scene: Scene, method: Callable, *, steps: int = 4000, between: tuple[float, float] | None = None
) -> np.ndarray:
    """The largest dt [s] at which a run of `steps` steps does not make a small deviation grow: by batched bisection.

    Shaped like `scene.status_shape`. Slow growth needs many `steps` to be seen: a method that is never stable shows the
    dt up to which nobody notices. Looks `between` two steps [s], by default five decades around the fastest rate of the
    scene; 0 or infinity where the limit is outside.
    """
    with jax.enable_x64(True):
        scene = in_dtype(scene, jnp.float64)
        bottom, top = _range(scene) if between is None else _checked_range(between, scene)
        low, high = bottom, top
        for _ in range(3):
            tried = np.geomspace(low, high, BATCH)
            bad = grows(scene, method, tried, steps=steps)
            first = np.where(bad.any(axis=0), bad.argmax(axis=0), BATCH)
            pick = lambda i: np.take_along_axis(tried, np.clip(i, 0, BATCH - 1)[None], axis=0)[0]  # noqa: E731, B023
            low, high = pick(first - 1), pick(first)
        return np.where(high <= bottom, 0.0, np.where(low >= top, np.inf, low))


def grows(scene: Scene, method: Callable, dt: Any, *, steps: int = 4000) -> np.ndarray:
    """Whether a small deviation grows in a run with steps of dt [s], for each scene (lane, where they are independent).

    Two runs, one begun a hair beside the other, are compared: unstable is a dt at which they are half as far again from
    each other in the second half as they ever were in the first, or have parted for good. `dt` has `scene.status_shape`
    or is a number; leading axes are further trials.
    """
    begin, early, late = _deviations(scene, method, dt, steps)
    # what comes to rest elsewhere has left as well
    return ~((late <= 1.5 * early) & (np.maximum(early, late) <= GREAT * begin))


def measure_growth(scene: Scene, method: Callable, dt: Any, *, steps: int = 2000) -> np.ndarray:
    """By how much a small deviation grows in a step of dt [s], on average over half a run; infinite if it blew up."""
    _, early, late = _deviations(scene, method, dt, steps)
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(late), (late / early) ** (2 / steps), np.inf)


def _range(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    pace = _pace(scene)
    return 1e-3 / pace, 1e2 / pace


def _pace(scene: Scene) -> np.ndarray:
    """The fastest rate of each scene [1/s]; 1 where nothing swings or decays."""
    fastest = np.abs(small_motion(scene, scene.state).rates()).max(axis=-1)
    return np.where(fastest > 0, fastest, 1.0)


def _checked_range(between: Any, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    low, high = (float(real_quantity("between [s]", number, above=0.0)) for number in between)
    if low >= high:
        raise ValueError(f"between [s]: got {low:g} and {high:g}, expected the smaller step first.")
    return np.full(scene.status_shape, low), np.full(scene.status_shape, high)


def _deviations(scene: Scene, method: Callable, dt: Any, steps: int) -> tuple[np.ndarray, ...]:
    """The largest deviation of a velocity at the beginning, in the first and in the second half of a run."""
    steps = positive_integer("steps", steps, at_least=64)
    with jax.enable_x64(True):
        scene = in_dtype(scene, jnp.float64)
        dt = np.asarray(real_quantity("dt [s]", dt, above=0.0), float)
        status = scene.status_shape
        leading = dt.shape[: dt.ndim - len(status)] if dt.ndim > len(status) else ()
        trials = np.broadcast_to(dt, (*leading, *status)).reshape((-1, *status))
        found = _run_pairs(scene, as_module(method), jnp.asarray(_pace(scene)), jnp.asarray(trials), steps)
        return tuple(np.asarray(a).reshape((*leading, *status)) for a in found)


@eqx.filter_jit
def _run_pairs(scene: Scene, method: Any, pace: Array, dts: Array, steps: int) -> tuple[Array, Array, Array]:
    x, v = scene.state
    size = SMALL * jnp.maximum(jnp.max(jnp.abs(x - jnp.mean(x))), 1e-3)
    keys = jax.random.split(jax.random.key(0))
    free = 1.0 if scene.held is None else 1 - jnp.asarray(scene.held)[..., None].astype(x.dtype)
    push, speed = (free * size * jax.random.normal(key, x.shape, x.dtype) for key in keys)
    # pushed in both, in the proportion of the fastest mode: slower ones have then begun to move as well
    beside = scene.having(state=Particles(x + push, v + scale(pace, speed)))
    pair = (scene, beside)
    arrays, still = eqx.partition(pair, eqx.is_array)
    inner = (-2, -1) if scene.couples else -1

    def run(dt):
        def step(i, carry):
            arrays, worst = carry
            pair = tuple(s.step(method, i.astype(x.dtype) * dt, dt) for s in eqx.combine(arrays, still))
            apart = jnp.max(jnp.abs(pair[1].state.velocity - pair[0].state.velocity), axis=inner)
            apart = jnp.where(jnp.isfinite(apart), apart, jnp.inf)
            spans = (i < 4, i < steps // 2, i >= steps // 2)
            worst = tuple(jnp.where(now, jnp.maximum(w, apart), w) for now, w in zip(spans, worst, strict=True))
            return eqx.filter(pair, eqx.is_array), worst

        zero = jnp.zeros(scene.status_shape, x.dtype)
        return lax.fori_loop(0, steps, step, (arrays, (zero, zero, zero)))[1]

    return jax.vmap(run)(dts)
