"""What each part of a model is worth: leave it out, and see what that does to the outcome and what it saves."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import PyTree

from physjax.checks import as_real_quantity
from physjax.compiling import announce_compiling
from physjax.particles import callable_name
from physjax.scene import Scene
from physjax.stepping.simulate import simulate
from physjax.study.ablation.variants import Variant, list_pair_variants, list_variants
from physjax.study.stability.limits import check_method
from physjax.text import format_seconds, format_table
from physjax.timing import time_in_turn
from physjax.tracebacks import shorten_tracebacks
from physjax.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NEEDED, NEGLIGIBLE, COSTLY, NONE = "needed", "negligible", "costs more than it gives", "none"
UNRESOLVED = "shorter dt"
"""Without the part the run is too inaccurate to tell, though the whole is not: damping that kept a method stable, say."""
SAMPLE_SECONDS, MIN_SAMPLES, MAX_SAMPLES = 0.01, 3, 15
"""A timing is the least of runs that together last this long [s]; the least and the greatest number of each."""
COSTLY_TIME_SHARE = 0.1
"""Share of the run's time from which on a part of the model costs something."""

Outcome = Callable[[Trajectory], ArrayLike]
"""What a run is judged by: a number or an array of numbers."""


class Effect(NamedTuple):
    """A run with something left out, next to the whole one. Arrays are shaped like the outcome.

    `change` is |outcome - outcome of the whole|, `numerical` the error of the two, `seconds` the least time of a run,
    `saved` [s] how much less that is (0 where it is within the timer's `spread`), `flops` and `bytes` what the compiler
    counts in a step. `verdicts` holds one for each entry of the outcome, `verdict` the gravest.
    """

    name: str
    outcome: np.ndarray
    change: np.ndarray
    numerical: np.ndarray
    seconds: float
    saved: float
    spread: float
    flops: float
    bytes: float
    verdicts: np.ndarray

    @property
    def verdict(self) -> str:
        """Needed where any entry of the outcome needs it; none where no entry shows a change beyond its numerical error."""
        found = set(self.verdicts.ravel().tolist())
        return next(verdict for verdict in (NEEDED, UNRESOLVED, COSTLY, NEGLIGIBLE, NONE) if verdict in found)


class Ablation(NamedTuple):
    """What each part of a scene is worth for an outcome. Printed, it is a table; `notes` say what could not be left out.

    Printed are the change of the outcome, its numerical error, the share of the run time saved and the flops of a step.

    `whole` is the run with everything; `threshold` the change that counts, shaped like the outcome.
    """

    whole: Effect
    effects: tuple[Effect, ...]
    threshold: np.ndarray
    method: str
    dt: float
    notes: tuple[str, ...]

    @property
    def matters(self) -> np.ndarray:
        """The old name of `threshold`."""
        return self.threshold

    @property
    def telling(self) -> Callable[[Effect], tuple[float, float, float]]:
        """The old name of `worst_entry`."""
        return self.worst_entry

    def __getitem__(self, name: str) -> Effect:
        """The effect of leaving out the part of this name."""
        return next(effect for effect in self.effects if effect.name == name)

    def __str__(self) -> str:
        headers = ["without", "changes by", "error", "saves", "flops", "verdict"]
        rows = [self._format_row(self.whole._replace(name="(nothing)"))] + [self._format_row(e) for e in self.effects]
        rows[0][-1] = ""
        counts = " to ".join(dict.fromkeys(f"{float(edge(self.threshold)):.3g}" for edge in (np.min, np.max)))
        run = f"{self.method}, dt = {format_seconds(self.dt)}; what counts is a change of the outcome by more than {counts}"
        return "\n".join([run, format_table(headers, rows, align="<>>>><"), *self.notes])

    def worst_entry(self, effect: Effect) -> tuple[float, float, float]:
        """Change, numerical error and what counts, for the entry that most exceeds what counts or can be resolved."""
        bar = np.maximum(self.threshold, effect.numerical)
        exceeds = np.where(np.isnan(effect.change), np.inf, effect.change) / np.where(bar > 0, bar, 1.0)
        entry = np.unravel_index(np.argmax(exceeds), exceeds.shape)
        change, numerical, threshold = (float(a[entry]) for a in (effect.change, effect.numerical, self.threshold))
        return change, numerical, threshold

    def _format_row(self, effect: Effect) -> list[str]:
        change, numerical, _ = self.worst_entry(effect)
        numbers = [f"{change:.3g}", f"{numerical:.3g}", self._format_saving(effect), f"{effect.flops:.4g}"]
        return [effect.name, *numbers, effect.verdict]

    def _format_saving(self, effect: Effect) -> str:
        if math.isnan(effect.seconds):
            return "not timed"
        if effect.saved == 0:
            return "none"
        return f"{100 * effect.saved / self.whole.seconds:.0f} %"

    def plot(self, figure: "Figure | None" = None) -> "Figure":
        """Draw the changes next to the numerical errors, and the time saved; returns the matplotlib figure."""
        from physjax.study.ablation.chart import draw_ablation

        return draw_ablation(self, figure)


@shorten_tracebacks
@announce_compiling("ablate")
def ablate(
    scene: Scene,
    outcome: Outcome,
    *,
    method: Callable[..., Any],
    dt: float,
    duration: float,
    save_every: int = 1,
    error: float = 1e-3,
    scale: ArrayLike | None = None,
    pairs: bool = False,
    lanes: Mapping[str, int] | None = None,
    others: Mapping[str, Scene] | None = None,
    seconds: float = 10.0,
    progress: Callable[[str], None] = lambda what: None,
) -> Ablation:
    """What each force, contact, law and dimension of a scene is worth for an `outcome(flight)`, a number or an array.

    Each is left out in turn: forces, contacts; options (wind, damping, friction, softening, and what a user's own part
    declares with the default None); drag is replaced by a simpler law, a quadratic one by Stokes' in air, a sphere's by
    the quadratic with C_d = 0.44 and by Stokes'; springs of each stiffness;
    timed impacts by the lecture's; the third dimension, where the motion stays in a plane; with `pairs` every two
    forces or contacts; of `lanes`, such as {"Neptune": 8}, each body (its states are then NaN); and every scene in
    `others`, such as a cloth with half the rows: a lattice does not remember how it was built, so build it again.

    A part is needed if that changes the outcome by more than `error` times `scale`, the outcome's own size unless given,
    negligible if less; it costs more than it gives if it is negligible and takes a tenth of the time or more; and a change
    below the numerical error, estimated by runs with shorter steps, is none, or "shorter dt" where the whole would have
    been accurate enough to tell. Times are the least of several, all runs
    in turn, within some `seconds` [s]; a difference within the timer's spread is none; with 0 nothing is timed.
    Compiles each variant twice. Raises ValueError or TypeError for bad input.

    Example:
        >>> height = lambda flight: flight.position[-1, 1]
        >>> result = accuracy.ablate(shot, height, method=methods.verlet, dt=0.1, duration=2.0, seconds=0.1)
        >>> round(float(result["Gravity"].change), 3), result["Gravity"].verdict
        (19.6, 'needed')
    """
    _check_outcome(outcome)
    check_method(method)
    # used as given: a Python 0.01 divides 5 s, the float32 next to it does not
    as_real_quantity("dt [s]", dt, above=0.0)
    error = float(as_real_quantity("error", error, at_least=0.0))
    seconds = float(as_real_quantity("seconds [s]", seconds, at_least=0.0))
    measure = partial(_measure_outcome, outcome, method, dt, duration, save_every)
    progress("everything")
    run, value, uncertain = measure(Variant("everything", scene))
    found, notes = list_variants(scene, run, lanes or {})
    found += list_pair_variants(scene) if pairs else []
    found += [Variant(name, other) for name, other in (others or {}).items()]
    measured = [(value, uncertain)]
    for variant in found:
        progress(f"without {variant.name}")
        measured.append(measure(variant)[1:])
    everything = [Variant("everything", scene), *found]
    progress("times")
    runs = [partial(_run_scene, one.scene, method, dt, run.steps, save_every) for one in everything]
    times, costs = _time_runs(runs, seconds), [_count_step_cost(one.scene, method, dt) for one in everything]
    threshold = np.broadcast_to(error * np.abs(value if scale is None else np.asarray(scale, float)), value.shape)
    compare = partial(_compare_with_whole, whole=measured[0], clock=times[0], threshold=threshold)
    effects = list(map(compare, [one.name for one in everything], measured, times, costs))
    return Ablation(effects[0], tuple(effects[1:]), threshold, callable_name(method), float(dt), tuple(notes))


def _check_outcome(outcome: Outcome) -> None:
    if not callable(outcome):
        raise TypeError(f"outcome: got {outcome!r}, expected a function of the run, e.g. lambda f: f.position[-1, 0].")


def _compare_with_whole(
    name: str,
    measured: tuple[np.ndarray, np.ndarray],
    timed: tuple[float, float],
    cost: tuple[float, float],
    *,
    whole: tuple[np.ndarray, np.ndarray],
    clock: tuple[float, float],
    threshold: np.ndarray,
) -> Effect:
    """What leaving out did: outcome and its error, time and its spread, next to those of the whole."""
    (now, off), (value, uncertain) = measured, whole
    if now.shape != value.shape:
        raise ValueError(f"outcome: got the shape {now.shape} without {name}, expected {value.shape} as with it.")
    numerical, change = np.maximum(off, uncertain), np.abs(now - value)
    saved, spread = clock[0] - timed[0], max(timed[1], clock[1])
    saved = saved if abs(saved) > spread else 0.0
    verdicts = _judge_entries(change, uncertain, off, threshold, saved > COSTLY_TIME_SHARE * clock[0])
    return Effect(name, now, change, numerical, timed[0], saved, spread, *cost, verdicts)


def _judge_entries(
    change: np.ndarray, uncertain: np.ndarray, off: np.ndarray, threshold: np.ndarray, costs: bool
) -> np.ndarray:
    """A verdict for each entry, by the numerical errors of the whole and without; a change that is not finite is needed."""
    little = np.where(change <= threshold, COSTLY if costs else NEGLIGIBLE, NEEDED)
    cannot_tell = np.where((off > threshold) & (uncertain <= threshold) & (threshold > 0), UNRESOLVED, NONE)
    return np.where(change <= np.maximum(off, uncertain), cannot_tell, little)


def _run_scene(scene: Scene, method: Callable[..., Any], dt: float, steps: int, save_every: int) -> PyTree:
    run = simulate(scene, method, dt=dt, steps=steps, save_every=save_every)
    assert run.final_scene is not None
    return jax.block_until_ready(run.final_scene.state)


def _measure_outcome(
    outcome: Outcome, method: Callable[..., Any], dt: float, duration: float, save_every: int, variant: Variant
) -> tuple[Trajectory, np.ndarray, np.ndarray]:
    """The run, its outcome, and the outcome's numerical error by Richardson's comparison with shorter steps.

    Twice the difference to half the step is the error at first order, more than it at any other; below it is rounding.
    """
    scene = variant.scene
    run = simulate(scene, method, dt=dt, duration=duration, save_every=save_every)
    frames, runs = run.steps // save_every, [run]
    refinements = [2 * save_every]
    if scene.resolves_at_step_end:
        # a contact resolved at the end of a step may be met at the same moment by half the step: compare also with
        # a run whose steps end elsewhere
        refinements.append(2 * save_every + 1)
    for every in refinements:
        runs.append(simulate(scene, method, dt=dt * save_every / every, steps=frames * every, save_every=every))
    restored = [eqx.tree_at(lambda run: run.state, one, variant.restore_states(one.state)) for one in runs]
    value, *finer = (np.asarray(outcome(one), float) for one in restored)
    rounding = float(jnp.finfo(run.position.dtype).eps) * math.sqrt(run.steps) * np.abs(value)
    return run, value, 2 * np.max([np.abs(value - better) for better in finer], axis=0) + rounding


def _time_runs(runs: Sequence[Callable[[], object]], seconds: float) -> list[tuple[float, float]]:
    """The least time of each run [s] and its spread, from the least to the lower quartile; all take turns."""
    if seconds == 0:
        return [(math.nan, math.nan)] * len(runs)
    timings = time_in_turn(runs, slice_seconds=SAMPLE_SECONDS, seconds=seconds, rounds=(MIN_SAMPLES, MAX_SAMPLES))
    return [(timing.least, timing.spread) for timing in timings]


def _count_step_cost(scene: Scene, method: Callable[..., Any], dt: float) -> tuple[float, float]:
    """Floating-point operations and bytes of one compiled step, as the compiler counts them."""
    step = jax.jit(lambda scene, t, dt: scene.step(method, t, dt))
    numbers = (jnp.asarray(number, scene.state.dtype) for number in (0.0, dt))
    counted = step.lower(scene, *numbers).compile().cost_analysis() or {}
    return float(counted.get("flops", math.nan)), float(counted.get("bytes accessed", math.nan))
