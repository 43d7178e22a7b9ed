"""What contact costs: no contact, the lecture's response, and the time of impact, doing the same steps in the same run.

    python benchmarks/contact.py [--quick] [--out DIR]

65 536 balls of 50 g in space under gravity and quadratic drag, float32, 200 steps of 10 ms over a floor, from heights up
to 2 m: (a) in flight, with restitution 1 and 0.8, where about one lane in a hundred bounces in a step; (b) four seconds
later with restitution 0.5, when all lie on the floor or slide on it; with and without Coulomb friction. Before anything
is timed, no ball may have passed the floor.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import harness
import jax
import jax.numpy as jnp
import numpy as np
from harness import Bar, print_progress
from jax.typing import ArrayLike

from physjax import Particles, Scene, contacts, forces, methods, simulate

OURS, LECTURE, BARE = harness.COLOURS  # families by colour only: all of this is physjax
DT = 0.01
REST_STEPS = 400
"""Steps after which balls of restitution 0.5 lie or slide."""


class Settings(NamedTuple):
    """Sizes of the runs."""

    lanes: int
    steps: int
    repeats: int


FULL, QUICK = Settings(65_536, 200, 7), Settings(2048, 20, 1)


class Case(NamedTuple):
    """What is on the floor: restitution, friction, and how many steps it has run before the clock starts."""

    restitution: float
    coulomb: bool = False
    before: int = 0


CASES = {
    "restitution 1": Case(1.0),
    "restitution 0.8": Case(0.8),
    "restitution 0.8, Coulomb": Case(0.8, coulomb=True),
    "at rest": Case(0.5, before=REST_STEPS),
    "at rest, Coulomb": Case(0.5, coulomb=True, before=REST_STEPS),
}


def build_balls(size: Settings, case: Case, response: Callable | None) -> Scene:
    """The balls, over a floor unless `response` is None."""
    rng = np.random.default_rng(0)
    position, velocity = rng.uniform((-1, 0.2, -1), (1, 2, 1), (size.lanes, 3)), rng.normal(size=(size.lanes, 3))
    rough = contacts.Coulomb(0.3, 0.2) if case.coulomb else None
    floor = contacts.Plane((0, 0, 0), (0, 1, 0), restitution=case.restitution, coulomb=rough, response=response)
    return Scene(
        Particles(jnp.asarray(position, np.float32), jnp.asarray(velocity, np.float32)),
        mass=0.05,
        forces=(forces.Gravity(), forces.QuadraticDrag(3.4e-3, 0.5)),
        contacts=() if response is None else (floor,),
    )


def run(scene: Scene, method: Callable, size: Settings, first: ArrayLike) -> jax.Array:
    """The final positions; frames are kept twice, as in a long run."""
    half = size.steps // 2
    flight = simulate(scene, method, dt=DT, steps=size.steps, save_every=half, first_step=first)
    return flight.final_scene.state.position


RESPONSES = {"no contact": None, "project": contacts.project, "impact": contacts.impact}


def build_contenders(method: Callable, case: Case, size: Settings) -> dict[str, Callable]:
    """Three runs of a case: without contact, with either response; the case's history is the same for both."""
    runs = {}
    for name, response in RESPONSES.items():
        scene, first = build_balls(size, case, response), 0
        if case.before and response is not None:
            earlier = simulate(scene, method, dt=DT, steps=case.before, save_every=case.before)
            scene, first = earlier.final_scene, earlier.final_step
        runs[name] = partial(run, scene, method, size, first)
    return runs


def main() -> None:
    """Run all cases, print their tables, write the record and the chart."""
    quick, folder = harness.parse_options(__doc__)
    size, about = QUICK if quick else FULL, harness.describe_machine()
    print_progress(harness.format_caption(about))
    newest = tuple(int(part) for part in jax.__version__.split(".")[:2]) >= (0, 11)
    studies, ratios, bars, panels = [], [], [], []
    work = size.lanes * size.steps / 1e6
    for method in (methods.rk4, methods.semi_implicit_euler):
        for title, case in CASES.items():
            if method is methods.semi_implicit_euler and (case.coulomb or case.before):
                continue
            print_progress(f"{method.__name__}, {title}")
            timings, failed = harness.time_side_by_side(
                build_contenders(method, case, size), size.repeats, check=_check_floor
            )
            if failed:
                raise SystemExit(f"{title}: {failed}")
            bare, lecture, timed = (timings[name].least for name in RESPONSES)
            ratios.append(
                [
                    f"{method.__name__}, {title}",
                    *(work / seconds for seconds in (bare, lecture, timed)),
                    lecture / bare,
                    timed / lecture,
                    timings["impact"].first,
                    timings["impact"].compiling,
                ]
            )
            families = dict(zip(RESPONSES, (BARE, LECTURE, OURS), strict=True))
            rows = [harness.make_row(name, families[name], work, timing) for name, timing in timings.items()]
            studies.append({"method": method.__name__, "case": title, "runs": rows})
            if method is methods.rk4:
                panels.append((f"rk4, {title}", "million particle-steps per second (logarithmic)", rows))
            if title in ("restitution 1", "restitution 0.8"):
                name, most = f"{method.__name__}, {title}: ", 1.6 if method is methods.rk4 else 2.6
                bars.append(Bar(f"{name}project / no contact", lecture / bare, "<=", most))
                bars.append(Bar(f"{name}impact / project", timed / lecture, "<=", 4.0 if newest else 6.0))

    print(harness.format_caption(about))
    head = [
        "",
        *(f"{name} [M/s]" for name in RESPONSES),
        "project / none",
        "impact / project",
        "first run [s]",
        "XLA [s]",
    ]
    harness.print_table(f"{size.lanes:,} balls, {size.steps} steps: million particle-steps a second", head, ratios)
    harness.print_bars(bars, quick)
    record = {"benchmark": "contact", "quick": quick, "machine": about, "settings": size._asdict(), "studies": studies}
    record["bars"] = [bar._asdict() | {"met": bar.met} for bar in bars]
    written, drawn = (harness.result_path(folder, "contact", quick, ending) for ending in ("json", "png"))
    harness.write_json(written, record)
    names = dict(zip((BARE, LECTURE, OURS), RESPONSES, strict=True))
    harness.draw_bar_chart(drawn, panels, harness.format_caption(about), names)
    print(f"\nwritten: {written} and {drawn.name}")


def _check_floor(name: str, position: jax.Array) -> None:
    """What has contact must not have passed the floor; without, it must have, or nothing was tried."""
    lowest = float(position[:, 1].min())
    if (lowest < -1e-6) != (name == "no contact"):
        raise SystemExit(f"{name}: the lowest ball is at {lowest:.3g} m")


if __name__ == "__main__":
    main()
