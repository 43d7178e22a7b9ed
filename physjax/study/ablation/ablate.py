"""What each part of a model is worth: leave it out, see what that does to the outcome, and what it saves."""

import math
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from physjax.checks import as_real_quantity
from physjax.particles import callable_name
from physjax.scene import Scene
from physjax.stepping.simulate import simulate
from physjax.study.ablation.variants import Variant, list_pair_variants, list_variants
from physjax.study.stability.limits import check_method
from physjax.text import format_seconds, format_table

NEEDED, NEGLIGIBLE, COSTLY, NONE = "needed", "negligible", "costs more than it gives", "none"
UNRESOLVED = "shorter dt"
"""What is left runs too inaccurately to tell, though the whole did not: damping that kept a method stable, say."""
SAMPLE_SECONDS, MIN_SAMPLES, MAX_SAMPLES = 0.01, 3, 15
"""A timing is the least of runs that last so long together [s]; at least and at most so many of each."""
COSTLY_TIME_SHARE = 0.1
"""Part of the run's time from which on a part of the model costs something."""


class Effect(NamedTuple):
    """A run with something left out, beside the whole one. Arrays are shaped like the outcome.

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
        """Needed where any entry of the outcome needs it; none where all do without and cannot tell."""
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

    def __getitem__(self, name: str) -> Effect:
        """The effect of leaving out what is called so."""
        return next(effect for effect in self.effects if effect.name == name)

    def __str__(self) -> str:
        headers = ["without", "changes by", "error", "saves", "flops", "verdict"]
        rows = [
            [
                e.name,
                *map(_format_number, self.worst_entry(e)[:2]),
                self._format_saving(e),
                _format_count(e.flops),
                e.verdict,
            ]
            for e in (self.whole._replace(name="(nothing)"), *self.effects)
        ]
        rows[0][-1] = ""
        counts = " to ".join(dict.fromkeys(f"{float(edge(self.threshold)):.3g}" for edge in (np.min, np.max)))
        run = f"{self.method}, dt = {format_seconds(self.dt)}; what counts is a change of the outcome by more than {counts}"
        return "\n".join([run, format_table(headers, rows, align="<>>>><"), *self.notes])

    def worst_entry(self, effect: Effect) -> tuple[float, float, float]:
        """Change, numerical error and what counts, for the entry that most exceeds what counts or can be told."""
        bar = np.maximum(self.threshold, effect.numerical)
        exceeds = np.where(np.isnan(effect.change), np.inf, effect.change) / np.where(bar > 0, bar, 1.0)
        entry = np.unravel_index(np.argmax(exceeds), exceeds.shape)
        return tuple(float(numbers[entry]) for numbers in (effect.change, effect.numerical, self.threshold))

    def _format_saving(self, effect: Effect) -> str:
        if math.isnan(effect.seconds):
            return "not timed"
        if effect.saved == 0:
            return "none"
        return f"{100 * effect.saved / self.whole.seconds:.0f} %"

    def plot(self, figure: Any = None) -> Any:
        """Draw the changes beside the numerical errors, and the time saved; returns the matplotlib figure."""
        from physjax.study.ablation.chart import draw_ablation

        return draw_ablation(self, figure)


def ablate(
    scene: Scene,
    outcome: Callable,
    *,
    method: Callable,
    dt: float,
    duration: float,
    save_every: int = 1,
    error: float = 1e-3,
    scale: Any = None,
    pairs: bool = False,
    lanes: Mapping[str, int] | None = None,
    others: Mapping[str, Scene] | None = None,
    seconds: float = 10.0,
    progress: Callable[[str], None] = lambda what: None,
) -> Ablation:
    """What each force, contact, law and dimension of a scene is worth for an `outcome(flight)`, a number or an array.

    Each is left out in turn: forces, contacts; options (wind, damping, friction, softening); drag by a simpler law, a
    quadratic by Stokes' in air, a sphere's by the quadratic with C_d = 0.44 and by Stokes'; springs of each stiffness;
    impacts that are timed by the lecture's; the third dimension, where the motion stays in a plane; with `pairs` every
    two forces or contacts; of `lanes`, such as {"Neptune": 8}, each body (its states are NaN then); and every scene in
    `others`, such as a cloth with half the rows: a lattice does not remember how it was built, so build it once more.

    A part is needed if that changes the outcome by more than `error` times `scale`, the outcome's own size unless given,
    negligible if less; it costs more than it gives if it is negligible and takes a tenth of the time or more; and a change
    below the numerical error, estimated by runs with shorter steps, is none, or "shorter dt" where the whole would have
    been accurate enough to tell. Times are the least of several, all runs
    in turn, within some `seconds` [s]; a difference within the timer's spread is none, 0 times nothing. Compiles each
    variant twice. Raises ValueError or TypeError for bad input.

    Example:
        >>> height = lambda flight: flight.position[-1, 1]
        >>> told = accuracy.ablate(shot, height, method=methods.verlet, dt=0.1, duration=2.0, seconds=0.1)
        >>> round(float(told["Gravity"].change), 3), told["Gravity"].verdict
        (19.6, 'needed')
    """
    if not callable(outcome):
        raise TypeError(f"outcome: got {outcome!r}, expected a function of the run, e.g. lambda f: f.position[-1, 0].")
    check_method(method)
    as_real_quantity(
        "dt [s]", dt, above=0.0
    )  # used as given: a Python 0.01 divides 5 s, the float32 next to it does not
    error, seconds = (
        float(as_real_quantity(name, value, at_least=0.0))
        for name, value in (("error", error), ("seconds [s]", seconds))
    )
    run = partial(_measure_outcome, outcome, method, dt, duration, save_every)
    progress("everything")
    flight, value, uncertain = run(Variant("everything", scene))
    found, notes = list_variants(scene, flight, lanes or {})
    found += list_pair_variants(scene) if pairs else []
    found += [Variant(name, other) for name, other in (others or {}).items()]
    measured = [(value, uncertain)]
    for variant in found:
        progress(f"without {variant.name}")
        measured.append(run(variant)[1:])
    scenes = [scene, *(variant.scene for variant in found)]
    progress("times")
    times = _time_runs([partial(_run_scene, s, method, dt, flight.steps, save_every) for s in scenes], seconds)
    threshold = np.broadcast_to(error * np.abs(value if scale is None else np.asarray(scale, float)), value.shape)
    names = ["everything", *(variant.name for variant in found)]
    costs = [_count_step_cost(one, method, dt) for one in scenes]
    effects = [
        _compare_with_whole(*each, whole=measured[0], clock=times[0], threshold=threshold)
        for each in zip(names, measured, times, costs, strict=True)
    ]
    return Ablation(effects[0], tuple(effects[1:]), threshold, callable_name(method), float(dt), tuple(notes))


def _compare_with_whole(
    name: str, measured: tuple, timed: tuple, cost: tuple, *, whole: tuple, clock: tuple, threshold: np.ndarray
) -> Effect:
    """What leaving out did: outcome and its error, time and its spread, beside those of the whole."""
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
    """A verdict for each entry, by the numerical errors of the whole and without; a change that is no number is needed."""
    little = np.where(change <= threshold, COSTLY if costs else NEGLIGIBLE, NEEDED)
    cannot_tell = np.where((off > threshold) & (uncertain <= threshold) & (threshold > 0), UNRESOLVED, NONE)
    return np.where(change <= np.maximum(off, uncertain), cannot_tell, little)


def _run_scene(scene: Scene, method: Callable, dt: float, steps: int, save_every: int) -> Any:
    flight = simulate(scene, method, dt=dt, steps=steps, save_every=save_every)
    return jax.block_until_ready(flight.final_scene.state)


def _measure_outcome(
    outcome: Callable, method: Callable, dt: float, duration: float, save_every: int, variant: Variant
) -> tuple[Any, np.ndarray, np.ndarray]:
    """The run, its outcome, and the outcome's numerical error by Richardson's comparison with shorter steps.

    Twice the difference to half the step is the error at first order, more than it at any other; below it is rounding.
    What is answered at the end of a step may happen to be answered at the same moment in half the step: there the run is
    also compared with one whose steps end elsewhere.
    """
    scene = variant.scene
    late = scene.resolves_at_step_end
    flight = simulate(scene, method, dt=dt, duration=duration, save_every=save_every)
    frames, runs = flight.steps // save_every, [flight]
    for every in (2 * save_every, *([2 * save_every + 1] if late else [])):
        runs.append(simulate(scene, method, dt=dt * save_every / every, steps=frames * every, save_every=every))
    seen = [eqx.tree_at(lambda run: run.state, one, variant.restore_states(one.state)) for one in runs]
    value, *finer = (np.asarray(outcome(one), float) for one in seen)
    rounding = float(jnp.finfo(flight.position.dtype).eps) * math.sqrt(flight.steps) * np.abs(value)
    return flight, value, 2 * np.max([np.abs(value - better) for better in finer], axis=0) + rounding


def _time_runs(runs: list[Callable], seconds: float) -> list[tuple[float, float]]:
    """The least time of each run [s] and its spread, from the least to the lower quartile; all take turns."""
    if seconds == 0:
        return [(math.nan, math.nan)] * len(runs)
    counts = []
    for run in runs:
        run()
        counts.append(max(1, math.ceil(SAMPLE_SECONDS / _time_run(run))))
    taken, begun = [[] for _ in runs], time.perf_counter()
    while len(taken[0]) < MIN_SAMPLES or (len(taken[0]) < MAX_SAMPLES and time.perf_counter() - begun < seconds):
        for run, count, times in zip(runs, counts, taken, strict=True):
            times.append(min(_time_run(run) for _ in range(count)))
    return [(min(times), float(np.quantile(times, 0.25)) - min(times)) for times in taken]


def _time_run(run: Callable) -> float:
    started = time.perf_counter()
    run()
    return time.perf_counter() - started


def _count_step_cost(scene: Scene, method: Callable, dt: float) -> tuple[float, float]:
    """Floating-point operations and bytes of one compiled step, as the compiler counts them."""
    step = jax.jit(lambda scene, t, dt: scene.step(method, t, dt))
    numbers = (jnp.asarray(number, scene.state.dtype) for number in (0.0, dt))
    counted = step.lower(scene, *numbers).compile().cost_analysis()
    return float(counted.get("flops", math.nan)), float(counted.get("bytes accessed", math.nan))


def _format_number(amount: float) -> str:
    return f"{amount:.3g}"


def _format_count(number: float) -> str:
    return f"{number:.4g}"
