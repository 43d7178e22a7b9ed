"""The engine of a live view, which needs no widget: settings in, a film and its figures out, nothing compiled twice."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from physjax.checks import as_positive_integer, as_real_quantity, demand_known
from physjax.live.listing import write_code
from physjax.live.pictures import Box, Pictures
from physjax.live.runs import Overtaken, Run, count_steps, run_steps
from physjax.live.sliders import EXAMPLE, Settings, Slider, demand_parameters, read_slider, takes_whole_number
from physjax.live.sources import Builder, Built, Source
from physjax.live.strip import (
    Figure,
    describe_cost,
    describe_energy,
    describe_error,
    describe_limit,
    describe_status,
    find_limit,
)
from physjax.particles import callable_name
from physjax.show.page_data import Json
from physjax.stepping.methods import METHODS, SPECIAL_METHODS
from physjax.study.accuracy.method_facts import method_title
from physjax.study.problem import Problem
from physjax.study.stability.limits import Limit

FIRST_METHODS = ("rk4", "verlet", "semi_implicit_euler", "euler")
"""Methods that are offered where none are named: one of order four, the games' two, and the one that fails."""
FRAMES = 96
"""Moments of a film: three seconds of pictures."""
START_STEPS, STEP_RANGE = 500, (40.0, 25.0)
"""Steps of the first run where no dt is named, and by how much they may be longer or shorter."""
SHORTENING, MAX_SHORTENINGS = 4.0, 6
"""A first step with which the run does not stay finite is shortened by this factor, at most so many times."""
SLOW_RUN_SECONDS, GAME_STEP_SECONDS = 0.06, 1 / 60
"""A first run that takes longer than the first [s] has steps of the second, or one for each frame: pictures follow the slider."""
MAX_KEPT_LIMITS = 512
"""Stable steps of so many settings are kept."""


class Answer(NamedTuple):
    """A setting with its scene, its run, and the film of it."""

    settings: Settings
    built: Built
    source: Source
    run: Run
    film: Json


class Engine:
    """Runs a scene with whatever settings are asked for. Changed numbers, another dt or duration recompile nothing.

    `build(**numbers)` returns a `Scene` or a `Problem`. `ranges` are `(low, high)` or `(low, high, start)` for what is set;
    single numbers are handed to `build` as they are. `name` is that of a scene of the gallery. Everything is in float64.
    """

    def __init__(
        self,
        build: Callable,
        ranges: Mapping[str, Any],
        *,
        units: Mapping[str, str] | None = None,
        name: str | None = None,
        duration: float | None = None,
        methods: Sequence[Callable | str] | None = None,
        dt: Any = None,
        frames: int = FRAMES,
    ):
        demand_parameters(build, ranges)
        self.frames = as_positive_integer("frames", frames, at_least=2)
        if duration is not None:
            duration = float(as_real_quantity("duration [s]", duration, above=0.0))
        fixed = {key: _read_number(key, value) for key, value in ranges.items() if not isinstance(value, Sequence)}
        self.sliders = [
            read_slider(key, value, unit=(units or {}).get(key, ""), whole=takes_whole_number(build, key))
            for key, value in ranges.items()
            if key not in fixed
        ]
        self.name, self.build, self.fixed = name, build, fixed
        start = {slider.name: slider.start for slider in self.sliders}
        with jax.enable_x64(True):
            self._builder = Builder(build, duration, fixed | start)
            first = self._builder(fixed | start)
        self.methods = _read_methods(methods)
        self.step_slider = _choose_step_slider(dt, first.duration)
        self._searches_start = dt is None
        self.start = Settings(start, next(iter(self.methods)), self.step_slider.start)
        self._pictures, self._compiled = Pictures(), dict[tuple, float]()
        self._last_built: tuple[tuple, Built, Source] | None = None
        self._limits: dict[tuple, Limit | None] = {}

    @property
    def recompiles(self) -> bool:
        """Whether each setting is another program, because `build` makes functions of its own and asks for its numbers."""
        return self._builder.recompiles

    def read_settings(self, asked: Mapping[str, Any]) -> Settings:
        """Settings from what a page sends, within their ranges; ValueError for what is none."""
        numbers = asked.get("numbers", {})
        clipped = {slider.name: slider.clip(numbers.get(slider.name, slider.start)) for slider in self.sliders}
        method = demand_known("method", str(asked.get("method", self.start.method)), self.methods)
        return Settings(clipped, method, self.step_slider.clip(asked.get("dt", self.start.dt)))

    def find_start(self) -> Answer:
        """The first answer; where dt was left open, with a step that keeps the run finite, and is long in slow scenes."""
        answer = self.answer(self.start)
        is_slow = answer.run.step_seconds * answer.run.steps > SLOW_RUN_SECONDS
        dt = min(GAME_STEP_SECONDS, answer.built.duration / self.frames)
        if self._searches_start and is_slow and dt > answer.run.dt:
            longer = self.answer(answer.settings._replace(dt=dt))
            answer = answer if longer.run.failed.any() else longer
        for _ in range(MAX_SHORTENINGS if self._searches_start else 0):
            shorter = answer.settings.dt / SHORTENING
            if not answer.run.failed.any() or shorter < self.step_slider.low:
                break
            answer = self.answer(answer.settings._replace(dt=float(f"{shorter:.2g}")))
        self.start = answer.settings
        return answer

    def will_compile(self, settings: Settings) -> bool:
        """Whether the run of these settings needs a program that there is not yet."""
        with jax.enable_x64(True):
            return self._key(settings, self._build_source(settings)[1]) not in self._compiled

    def answer(
        self, settings: Settings, ghost_box: Box | None = None, overtaken: Callable[[], bool] = lambda: False
    ) -> Answer:
        """The run of the settings and its film; raises Overtaken as soon as a newer one is asked for."""
        with jax.enable_x64(True):
            (built, source), method = self._build_source(settings), self.methods[settings.method]
            key = self._key(settings, source)
            steps = count_steps(built.duration, settings.dt)
            cost = self._compiled.get(key)
            run = run_steps(built, source, method, steps, self.frames, overtaken, step_seconds=cost)
            if cost is None:  # once more, for its time without compiling
                run = run_steps(built, source, method, steps, self.frames, overtaken)
            self._compiled[key] = run.step_seconds
            look = None if built.problem is None else built.problem.looks
            return Answer(settings, built, source, run, self._pictures.draw(run, look, ghost_box))

    def measure(self, answer: Answer, overtaken: Callable[[], bool] = lambda: False) -> list[Figure]:
        """The strip: error, energy, stable step if it is known, cost and status; raises Overtaken."""
        run, method = answer.run, self.methods[answer.settings.method]
        with jax.enable_x64(True):
            error = self._measure_error(answer, method, overtaken)
            known = self._limit_key(answer) in self._limits
            found = self._limits.get(self._limit_key(answer))
            step = describe_limit(found, run.dt, method) if known else Figure("stable step", "…", "being computed")
            return [
                error,
                describe_energy(run, answer.built, answer.source),
                step,
                describe_cost(run),
                describe_status(run, found),
            ]

    def find_limit(self, answer: Answer) -> None:
        """Compute the longest stable step of the settings, for the next strip: some milliseconds, of many nodes seconds."""
        key = self._limit_key(answer)
        if key in self._limits:
            return
        with jax.enable_x64(True):
            found = find_limit(answer.built, answer.source, self.methods[answer.settings.method], answer.run)
        if len(self._limits) >= MAX_KEPT_LIMITS:
            self._limits.clear()
        self._limits[key] = found

    def knows_limit(self, answer: Answer) -> bool:
        """Whether the longest stable step of the settings has been computed."""
        return self._limit_key(answer) in self._limits

    def write_code(self, settings: Settings) -> str:
        """The program of the settings."""
        with jax.enable_x64(True):
            built, _ = self._build_source(settings)
        steps = count_steps(built.duration, settings.dt)
        return write_code(
            self.build, self.name, self.fixed | settings.numbers, self.methods[settings.method], steps, built
        )

    def _build_source(self, settings: Settings) -> tuple[Built, Source]:
        """The scene of the settings; that of the last numbers is kept, since dt and the method do not change it."""
        numbers = self.fixed | settings.numbers
        key = tuple(numbers.items())
        kept = self._last_built
        if kept is None or kept[0] != key:
            built = self._builder(numbers)
            kept = self._last_built = key, built, self._builder.source(built, numbers)
        return kept[1], kept[2]

    def _measure_error(self, answer: Answer, method: Callable, overtaken: Callable[[], bool]) -> Figure:
        run, built = answer.run, answer.built
        problem = built.problem
        if isinstance(problem, Problem) and problem.exact is not None:
            return describe_error(run, problem.exact(np.asarray(run.flight.time)), "against the closed form")
        half = run_steps(
            built, answer.source, method, run.steps, self.frames, overtaken, refined=2, step_seconds=run.step_seconds
        )
        return describe_error(run, half.flight.state, "against half the step")

    def _key(self, settings: Settings, source: Source) -> tuple:
        arrays = eqx.filter(source, eqx.is_array)
        shapes = tuple((leaf.shape, str(leaf.dtype)) for leaf in jax.tree.leaves(arrays))
        return settings.method, jax.tree.structure(arrays), shapes

    def _limit_key(self, answer: Answer) -> tuple:
        return answer.settings.method, tuple(answer.settings.numbers.items())


def _read_methods(given: Sequence[Callable | str] | None) -> dict[str, Callable]:
    """Methods by the name that they are shown with."""
    known = METHODS | SPECIAL_METHODS
    if given is None:
        return {name: METHODS[name] for name in FIRST_METHODS}
    if isinstance(given, str) or callable(given) or not given:
        raise TypeError(f"methods: got {given!r}, expected a list, e.g. methods=[methods.rk4, methods.verlet].")
    found: dict[str, Callable] = {}
    for method in given:
        if isinstance(method, str):
            found[method] = known[demand_known("method", method, known)]
        elif callable(method):
            title = method_title(method)
            name = title if title not in found else f"{callable_name(method)} {len(found) + 1}"
            found[name] = method
        else:
            raise TypeError(f"methods: got {method!r}, expected methods such as methods.rk4, or their names.")
    return found


def _choose_step_slider(given: Any, duration: float) -> Slider:
    """The slider of dt [s], around a share of the duration where it is left open."""
    if given is None:
        start = float(f"{duration / START_STEPS:.1g}")
        return Slider("dt", start / STEP_RANGE[1] / SHORTENING**2, start * STEP_RANGE[0], start, "s", logarithmic=True)
    if not isinstance(given, Sequence):
        start = float(as_real_quantity("dt [s]", given, above=0.0))
        return Slider("dt", start / STEP_RANGE[0], start * STEP_RANGE[1], start, "s", logarithmic=True)
    slider = read_slider("dt", given, unit="s")
    if slider.low <= 0:
        raise ValueError(f"dt [s]: got {given!r}, expected steps longer than 0, e.g. dt=(1e-3, 1e-1).")
    middle = float(f"{np.sqrt(slider.low * slider.high):.2g}")
    return slider._replace(logarithmic=True, start=slider.start if len(given) == 3 else middle)


def _read_number(name: str, value: object) -> float:
    """A number that stays; TypeError for what is neither a number nor a range."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise TypeError(f"{name}: got {value!r}, expected a range, {EXAMPLE}; or one number, which stays.")
    return int(value) if isinstance(value, int | np.integer) else float(value)


__all__ = ["Answer", "Engine", "Overtaken"]
