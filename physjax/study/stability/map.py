"""Runs over many steps and scenes at once, judged stable, inaccurate or diverged, beside what was predicted."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from physjax.checks import as_real_quantity
from physjax.particles import callable_name
from physjax.parts import as_module
from physjax.scene import Scene
from physjax.stepping import methods as ours
from physjax.stepping.reference import cast_floats
from physjax.stepping.simulate import sample_states
from physjax.study.stability.limits import check_method, limit

JUDGED_FRAMES = 4
"""Moments at which a run is compared with the truth; every dt is rounded so that they are whole steps."""
INACCURATE_ERROR, DIVERGED_ERROR = 0.05, 10.0
"""Errors, in parts of the way that the scene goes, beyond which a run is called so."""
VERDICTS = ("stable", "inaccurate", "diverged")


class StabilityMap(NamedTuple):
    """Verdicts `(methods, values, steps)`, an index into `VERDICTS`, with the `dts` [s] of each run and its error.

    `predicted` `(methods, values)` are the limits [s]. `parameter` names what `values` change; "" for a single scene.

    Example:
        >>> chart = stability.map(swing, [methods.verlet], dts=[0.01, 1.25])
        >>> isinstance(chart, stability.StabilityMap), chart.verdict.shape
        (True, (1, 1, 2))
    """

    methods: tuple[str, ...]
    parameter: str
    values: np.ndarray
    dts: np.ndarray
    verdict: np.ndarray
    error: np.ndarray
    predicted: np.ndarray
    duration: float

    def plot(self, figure: Any = None) -> Any:
        """Draw the verdicts over dt with the predicted limits on top; returns the figure."""
        from physjax.study.stability.chart import draw_stability_map

        return draw_stability_map(self, figure)


def map(
    scene: Scene | Callable[[float], Scene],
    methods: Sequence[Callable],
    dts: Any,
    parameter: tuple[str, Any] | None = None,
    *,
    duration: float | None = None,
) -> StabilityMap:
    """Run a scene under every method and dt [s], call each run stable, inaccurate or diverged, and predict the boundary.

    With a `parameter` (name, values), `scene` is a function of such a value. Judged by the positions after `duration`
    [s] and on the way (forty of the longest steps, if not given): inaccurate is an error of more than 5 % of the way
    gone, diverged one of more than ten times that way. Each dt is rounded to divide a quarter of the duration.

    Example:
        >>> stability.map(swing, [methods.verlet], dts=[0.01, 1.25]).verdict.tolist()
        [[[0, 2]]]
    """
    for method in methods:
        check_method(method)
    dts = np.sort(np.asarray(as_real_quantity("dts [s]", dts, above=0.0), float).ravel())
    name, values = ("", [0.0]) if parameter is None else parameter
    values = np.asarray(as_real_quantity(f"values of {name}", values), float).ravel()
    if callable(scene) == (parameter is None):
        raise TypeError(
            "map: got a scene and a parameter that do not fit. Give a Scene, or a function and (name, values)."
        )
    duration = float(
        10 * JUDGED_FRAMES * dts[-1] if duration is None else as_real_quantity("duration [s]", duration, above=0.0)
    )
    with jax.enable_x64(True):
        scenes = [cast_floats(scene(value) if parameter else scene, jnp.float64) for value in values]
        predicted = np.array([[limit(s, method).dt for s in scenes] for method in methods])
        counts = np.maximum(1, np.round(duration / JUDGED_FRAMES / dts)).astype(int)
        truths = [_sample_positions(s, ours.rk4, duration, _count_reference_steps(s, counts, duration)) for s in scenes]
        error = np.array(
            [
                [
                    [_measure_error(_sample_positions(s, m, duration, count), truth) for count in counts]
                    for s, truth in zip(scenes, truths, strict=True)
                ]
                for m in methods
            ]
        )
    verdict = np.where(error <= INACCURATE_ERROR, 0, np.where(error <= DIVERGED_ERROR, 1, 2))
    actual = np.broadcast_to(duration / JUDGED_FRAMES / counts, error.shape)
    names = tuple(callable_name(method) for method in methods)
    return StabilityMap(names, name, values, actual, verdict, error, predicted, duration)


def _count_reference_steps(scene: Scene, counts: np.ndarray, duration: float) -> int:
    """Steps of rk4 in a frame for the truth: finer than any run, and a tenth of what is stable."""
    stable = limit(scene, ours.rk4).dt
    return int(max(2 * counts.max(), np.ceil(10 * duration / JUDGED_FRAMES / stable) if 0 < stable < np.inf else 0))


def _sample_positions(scene: Scene, method: Callable, duration: float, count: int) -> np.ndarray:
    dt = jnp.asarray(duration / JUDGED_FRAMES / count)
    return np.asarray(
        sample_states(scene, as_module(method), dt, jnp.asarray(count, jnp.int32), JUDGED_FRAMES).position
    )


def _measure_error(positions: np.ndarray, truth: np.ndarray) -> float:
    """The largest error in parts of the way gone (of the scene's size, if it rests); infinite for a run that blew up."""
    way = np.abs(truth - truth[0]).max()
    size = way if way > 1e-6 * np.abs(truth).max() else max(np.ptp(truth), 1e-300)
    error = np.abs(positions - truth).max() / size
    return float(error) if np.isfinite(error) else float("inf")
