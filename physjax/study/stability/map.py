"""Runs over many steps and scenes, classified as stable, inaccurate or diverged, next to the predicted limits."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from physjax.checks import as_real_quantity
from physjax.compiling import announce_compiling
from physjax.particles import callable_name
from physjax.parts import as_module
from physjax.scene import Scene
from physjax.stepping import methods as ours
from physjax.stepping.reference import cast_floats
from physjax.stepping.simulate import sample_states
from physjax.study.stability.limits import check_method, limit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

JUDGED_FRAMES = 4
"""Moments at which a run is compared with the truth; every dt is rounded so that they fall on whole steps."""
DEFAULT_STEPS_PER_FRAME = 10
"""Of the longest step, between two of these moments, where no duration is given."""
INACCURATE_ERROR, DIVERGED_ERROR = 0.05, 10.0
"""Errors, relative to the way that the scene goes, beyond which a run is called so."""
REST_SHARE = 1e-6
"""A way shorter than this share of the scene's coordinates is rest; errors are then relative to the scene's size."""
REFERENCE_STEPS_RATIO = 10
"""Steps of the truth for each that is just stable: the fastest motion is then followed, not only bounded."""
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

    def plot(self, figure: "Figure | None" = None) -> "Figure":
        """Draw the verdicts over dt with the predicted limits on top; returns the figure."""
        from physjax.study.stability.chart import draw_stability_map

        return draw_stability_map(self, figure)


@announce_compiling("the map")
def map(
    scene: Scene | Callable[[float], Scene],
    methods: Sequence[Callable],
    dts: ArrayLike | Sequence[float],
    parameter: tuple[str, ArrayLike | Sequence[float]] | None = None,
    *,
    duration: float | None = None,
) -> StabilityMap:
    """Run a scene under every method and dt [s], classify each run as stable, inaccurate or diverged, predict the boundary.

    With a `parameter` (name, values), `scene` is a function of one value. Positions after `duration` [s] (by default forty
    of the longest steps) and on the way decide: inaccurate is an error of more than 5 % of the distance travelled, diverged
    one of more than ten times that distance. Each dt is rounded to divide a quarter of the duration.

    Example:
        >>> stability.map(swing, [methods.verlet], dts=[0.01, 1.25]).verdict.tolist()
        [[[0, 2]]]
    """
    for method in methods:
        check_method(method)
    dts = np.sort(np.asarray(as_real_quantity("dts [s]", dts, above=0.0), float).ravel())
    name, values = ("", [0.0]) if parameter is None else parameter
    values = np.asarray(as_real_quantity(f"values of {name}", values), float).ravel()
    build = _as_builder(scene, parameter is not None)
    if build is None:
        raise TypeError(
            "map: got a scene and a parameter that do not fit. Give a Scene, or a function and (name, values)."
        )
    if duration is None:
        duration = DEFAULT_STEPS_PER_FRAME * JUDGED_FRAMES * dts[-1]
    duration = float(as_real_quantity("duration [s]", duration, above=0.0))
    with jax.enable_x64(True):
        scenes = [cast_floats(build(value), jnp.float64) for value in values]
        predicted = np.array([[limit(s, method).dt for s in scenes] for method in methods])
        counts = np.maximum(1, np.round(duration / JUDGED_FRAMES / dts)).astype(int)
        truths = [_sample_positions(s, ours.rk4, duration, _count_reference_steps(s, counts, duration)) for s in scenes]
        pairs = list(zip(scenes, truths, strict=True))
        measure = lambda s, m, truth, count: _measure_error(_sample_positions(s, m, duration, count), truth)  # noqa: E731
        error = np.array([[[measure(s, m, truth, n) for n in counts] for s, truth in pairs] for m in methods])
    verdict = np.where(error <= INACCURATE_ERROR, 0, np.where(error <= DIVERGED_ERROR, 1, 2))
    actual = np.broadcast_to(duration / JUDGED_FRAMES / counts, error.shape)
    names = tuple(callable_name(method) for method in methods)
    return StabilityMap(names, name, values, actual, verdict, error, predicted, duration)


def _as_builder(scene: Scene | Callable[[float], Scene], swept: bool) -> Callable[[float], Scene] | None:
    """The scene as a function of the parameter; None where it is a function without one, or the other way round."""
    if isinstance(scene, Scene):
        return None if swept else lambda value: scene
    return scene if swept else None


def _count_reference_steps(scene: Scene, counts: np.ndarray, duration: float) -> int:
    """Steps of rk4 in a frame for the truth: finer than any run, and a tenth of the largest stable step."""
    stable = limit(scene, ours.rk4).dt
    enough = np.ceil(REFERENCE_STEPS_RATIO * duration / JUDGED_FRAMES / stable) if 0 < stable < np.inf else 0
    return int(max(2 * counts.max(), enough))


def _sample_positions(scene: Scene, method: Callable, duration: float, count: int) -> np.ndarray:
    # dt and count are data: one compilation for each method and scene
    dt = jnp.asarray(duration / JUDGED_FRAMES / count)
    return np.asarray(
        sample_states(scene, as_module(method), dt, jnp.asarray(count, jnp.int32), JUDGED_FRAMES).position
    )


def _measure_error(positions: np.ndarray, truth: np.ndarray) -> float:
    """The largest error relative to the distance travelled (to the scene's size, if it rests); infinite if a run blew up."""
    way = np.abs(truth - truth[0]).max()
    size = way if way > REST_SHARE * np.abs(truth).max() else max(np.ptp(truth), 1e-300)
    error = np.abs(positions - truth).max() / size
    return float(error) if np.isfinite(error) else float("inf")
