"""The whole report on a scene, part by part: picture, cost of accuracy, stability, ledger, ablation, recommendation."""

from collections.abc import Callable, Iterator
from typing import NamedTuple, TypedDict

import jax
import numpy as np

from physjax.particles import Particles
from physjax.physics.contacts.time_of_impact import impact
from physjax.scene import Scene, project
from physjax.show import auto_plot
from physjax.show.style import AS_GIVEN
from physjax.stepping.methods import METHODS, find_method, list_all_methods
from physjax.stepping.simulate import simulate
from physjax.study import accuracy, energy, stability
from physjax.study.accuracy.recommendation import Recommendation
from physjax.study.accuracy.result import TABLE_ERRORS, Run, WorkPrecision
from physjax.study.energy.audit import RESPONSE_OBSERVERS
from physjax.study.problem import Problem
from physjax.study.report_page import Picture, Section, Table, encode_figure
from physjax.study.stability.survey import find_fastest_moment, map_around_limits
from physjax.text import format_seconds

TARGET_ERROR = 1e-4
"""Error, relative to the extent of the path, of the run whose energy is audited and whose parts are left out."""
ABLATION_TIMING_SECONDS = 3.0
"""Time for the timings of the ablation [s]."""

Block = str | Picture | Table


class Stepping(TypedDict):
    """Options of `simulate`."""

    method: Callable
    dt: float
    duration: float
    save_every: int


class SceneStudy(NamedTuple):
    """A scene, its name, what it is in one sentence, and its work-precision study, which the parts draw upon."""

    name: str
    sentence: str
    problem: Problem
    precision: WorkPrecision

    @property
    def run(self) -> Run | None:
        """The cheapest run of our methods that is accurate enough, or the most accurate; None if none stayed on the path.

        Only of methods that are stable on an undamped oscillator as well: the ablation leaves the damping out.
        """
        stable = {name for name, method in list_all_methods().items() if method.promises.stability_limit > 0}
        ours = [
            run
            for run in self.precision.runs
            if run.scheme in stable and run.treatment == AS_GIVEN and not run.adaptive and run.status == "ok"
        ]
        accurate = [run for run in ours if run.path_error <= TARGET_ERROR]
        if accurate:
            return min(accurate, key=lambda run: run.seconds)
        return min(ours, key=lambda run: run.path_error, default=None)

    @property
    def stepping(self) -> Stepping:
        """That run as options of `simulate`."""
        run, problem = self._demand_run(), self.problem
        steps, method, every = run.steps, find_method(run.scheme), run.steps // problem.frames
        return {"method": method, "dt": problem.duration / steps, "duration": problem.duration, "save_every": every}

    @property
    def stepping_text(self) -> str:
        """That run in words."""
        run = self._demand_run()
        step = format_seconds(self.problem.duration / run.steps)
        return f"Stepped by {run.method} with dt = {step}, whose error is {run.path_error:.1e} of the path."

    def _demand_run(self) -> Run:
        if self.run is None:
            raise ValueError(NO_RUN)
        return self.run


def build_sections(
    problem: Problem,
    name: str,
    sentence: str,
    *,
    budget: accuracy.Budget = accuracy.QUICK,
    progress: Callable[[str], None] = lambda what: None,
) -> Iterator[Section]:
    """The `PARTS` of a scene's page, in the order of reading; a part that a scene cannot have says why in one sentence.

    `sentence` says what the scene is. `progress(what)` is called before each part.
    """
    progress("reference and runs")
    precision = accuracy.work_precision(problem, budget=budget, name=name)
    studied = SceneStudy(name, sentence, problem, precision)
    for heading, part in PARTS.items():
        progress(heading)
        with jax.enable_x64(True):
            section = Section(heading, *part(studied))
        yield section


def _show_scene(studied: SceneStudy) -> Iterator[Block]:
    yield studied.sentence
    run, looks = studied.problem.filmed(), studied.problem.looks
    yield encode_figure(auto_plot.plot_run(run, looks), f"Picture: {studied.sentence}")
    yield Picture(auto_plot.animate_run(run, looks).gif(), f"Film: {studied.sentence}", kind="gif")


def _chart_precision(studied: SceneStudy) -> Iterator[Block]:
    precision = studied.precision
    yield (
        "Every method from coarse to fine steps. Errors are relative to the extent of the path, measured against: "
        f"{precision.truth}. The table has the shortest run time for each error."
    )
    yield encode_figure(
        precision.plot(), f"Charts of error against run time and step for each method in {studied.name}."
    )
    yield Table(precision.table())


def _chart_stability(studied: SceneStudy) -> Iterator[Block]:
    scene = studied.problem.scene
    if not isinstance(scene.state, Particles):
        yield "No map: the limits are those of small motions in a straight line, and rigid bodies turn."
        return
    if scene.emitter is not None:
        yield "No map: particles are born and die, so there is no one motion that could be stable."
        return
    time, at = find_fastest_moment(studied.problem)
    limits = [stability.limit(scene, method, at) for method in METHODS.values()]
    yield f"The longest stable step about t = {time:.3g} s, where the scene is fastest:"
    yield from map(str, limits)
    if stability.grows_by_itself(scene, at).any():
        yield "Small deviations grow there by the scene's own motion, whatever the method."
    timed = any(contact.response is impact for contact in scene.contacts)
    # timed contacts compile for minutes, and the limit is that of the motion between them
    free = Scene(scene.state, scene.mass, scene.forces, pinned=scene.pinned) if timed else scene
    chart = map_around_limits(free, limits)
    if chart is None:
        yield "No map: no method has a limit here."
        return
    yield (
        f"Runs from the start{', without their contacts' if timed else ''}, coloured by their error; the black line is the "
        "limit of stability predicted at their start. Beyond it a run diverges sooner or later. A method for which any "
        "step is stable has no line and does not diverge, and is inaccurate all the same where its steps are long."
    )
    yield encode_figure(
        chart.plot(), f"Map of the steps at which each method is accurate, inaccurate or diverged in {studied.name}."
    )


def _chart_ledger(studied: SceneStudy) -> Iterator[Block]:
    scene = studied.problem.scene
    if scene.emitter is not None:
        yield "No ledger: particles bring energy when they are born and take it when they die."
        return
    if any((contact.response or project) not in (*RESPONSE_OBSERVERS, project) for contact in scene.contacts):
        yield "No ledger: a contact has a response of its own, and how much energy that takes is not known."
        return
    if studied.run is None:
        yield NO_RUN
        return
    ledger = energy.ledger(simulate(scene, **studied.stepping))
    yield studied.stepping_text
    yield encode_figure(ledger.plot(), f"Chart of where the energy of {studied.name} went over time.")
    yield Table(str(ledger))


def _chart_ablation(studied: SceneStudy) -> Iterator[Block]:
    scene = studied.problem.scene
    if scene.emitter is not None:
        yield "No ablation: without one of its parts other particles would be born, and there would be no two ends to compare."
        return
    if not (scene.forces or scene.contacts):
        yield "No ablation: the scene has neither forces nor contacts that could be left out."
        return
    if studied.run is None:
        yield NO_RUN
        return
    extent = float(np.ptp(studied.precision.path[1], axis=0).max())
    found = accuracy.ablate(
        scene,
        lambda flight: flight.position[-1],
        scale=extent,
        seconds=ABLATION_TIMING_SECONDS,
        **studied.stepping,
    )
    yield (
        f"What each part is worth for where everything ends: what counts is a thousandth of the extent of the path, "
        f"{extent:.3g} m. {studied.stepping_text}"
    )
    yield encode_figure(found.plot(), f"Chart of how much each part of {studied.name} changes where it ends.")
    yield Table(str(found))


def _write_recommendation(studied: SceneStudy) -> Iterator[Block]:
    problem = studied.problem
    answers = accuracy.recommend(problem.scene, error=TABLE_ERRORS, horizon=problem.duration, progress=False)
    assert not isinstance(answers, Recommendation)  # several errors have several answers
    for answer in answers:
        yield f"For an error of {answer.error:g}: {answer.reason}"
    yield Table("\n\n".join(map(str, answers)))


NO_RUN = "Not available: no run with a fixed step stayed on the path."
PARTS = {
    "scene": _show_scene,
    "speed against accuracy": _chart_precision,
    "stability": _chart_stability,
    "energy ledger": _chart_ledger,
    "ablation": _chart_ablation,
    "recommendation": _write_recommendation,
}
"""The parts of a page by their headings, in the order of reading."""
