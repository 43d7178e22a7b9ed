"""`physjax chart`: speed against accuracy for scenes of the gallery, as pictures, CSV and one page."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

if TYPE_CHECKING:
    from physjax.study.accuracy.result import WorkPrecision
    from physjax.study.report_page import Section

BOUNCING_SCENE = "bouncing_ball"
"""The scene that shows how contacts lower the order of a method."""
GUIDE = (
    "Every method runs each scene with finer and finer steps. A cell of the table names the fastest run whose error stays below "
    "the share of the path at the head of its column: the method, its step, and how long one run takes.",
    "Which run to take? Choose the error that you can accept (a hundredth is rarely seen in a game, 1e-4 is below a pixel) and "
    "take what stands in that column. If several methods are about as fast, take the simplest.",
    "In the charts of error against run time lower left is better. The band is the Pareto front: no run is both faster and more "
    "accurate than one on it. Where errors are drawn against the step, the slope of a line is the order of its method; it is "
    "unseen where fewer than three runs lie between those that are too coarse and those that rounding has bent.",
)
"""How the page of charts is read."""
DEFAULT_SCENES = ("fall_with_drag", "oscillator", "kepler", BOUNCING_SCENE)
"""What is charted by default: free flight with drag, stiff and soft springs, a close approach, and contacts."""


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its options to those of `physjax`."""
    command = commands.add_parser("chart", help="chart speed against accuracy for the scenes of the gallery")
    command.add_argument(
        "scenes",
        nargs="*",
        metavar="SCENE",
        help=f"names from `physjax scenes`; by default {', '.join(DEFAULT_SCENES)}",
    )
    command.add_argument("--all", action="store_true", help="all smooth scenes, and a ball that bounces")
    command.add_argument(
        "--out", default="chart", metavar="DIR", help="where pictures, CSV and the page go (default: chart)"
    )
    command.add_argument("--quick", action="store_true", help="coarser and faster")
    command.add_argument(
        "--report",
        action="store_true",
        help="a page for each scene instead: accuracy, stability and energy, with coarse charts",
    )
    command.set_defaults(run=_run_chart)


def _run_chart(options: argparse.Namespace) -> int:
    """Study scenes one by one: PNG, CSV, one HTML page and a printed table; or a report on each scene instead."""
    import matplotlib

    from physjax.files import ensure_writable_folder
    from physjax.text import describe_machine

    names = _choose_scenes(options.scenes, options.all)
    folder = ensure_writable_folder(options.out)
    matplotlib.use("Agg")
    if options.report:
        _write_reports(names, folder)
        return 0
    results, summary = [], ""
    for number, name in enumerate(names, 1):
        try:
            results.append(_study_scene(name, folder, options.quick, f"{number}/{len(names)} {name}"))
        except KeyboardInterrupt:
            done = (
                f"{len(results)} of {len(names)} scenes are done: {folder / 'index.html'}"
                if results
                else "none is done"
            )
            print(f"\nphysjax chart: stopped by Ctrl-C; {done}", file=sys.stderr)
            return 130
        summary = _summarise([result for result, _ in results])
        # so far, so that it can be read while the others are studied
        _write_page(folder, summary, [section for _, section in results])
        print(f"Chart: {folder / f'{name}.png'}", flush=True)
    print(f"\nThe fastest run whose error stays below a fraction of the path:\n\n{summary}\n")
    print(f"Measured on {describe_machine()}.\nCharts: {folder / 'index.html'}")
    return 0


def _choose_scenes(names: list[str], everything: bool) -> list[str]:
    """The scenes that were named, or those of the default; with `everything` those without contacts or memory, and a ball.

    All of them come in the order of reading, the easiest first.

    The others are charted when they are named; all of them together would take an hour.
    """
    from physjax.checks import demand_known
    from physjax.scenes import SCENES
    from physjax.scenes.catalogue import list_scene

    if everything and names:
        raise ValueError(f"--all: got {names[0]} as well, expected no names with it.")
    if everything:
        smooth = [name for name in SCENES if name == BOUNCING_SCENE or list_scene(name).smooth]
        return sorted(smooth, key=_rate_difficulty)
    return [demand_known("scene", name, SCENES) for name in dict.fromkeys(names)] or list(DEFAULT_SCENES)


def _rate_difficulty(name: str) -> tuple[bool, bool, int]:
    """What makes a scene harder to read: contacts, a truth that is no closed form, and many lanes."""
    from physjax.scenes.catalogue import list_scene

    entry = list_scene(name)
    return not entry.smooth, not entry.truth.startswith("closed form"), int(entry.size.split()[0])


def _write_page(folder: Path, summary: str, sections: "list[Section]") -> None:
    """The page with all charts, pictures inside."""
    from physjax.files import write_atomically
    from physjax.study.report_page import build_page

    with write_atomically(folder / "index.html") as file:
        file.write(build_page("physjax: speed against accuracy", summary, sections, guide=GUIDE))


def _write_reports(names: list[str], folder: Path) -> None:
    """Write a page on each scene, with its sections as progress."""
    import jax

    from physjax.files import write_atomically
    from physjax.scenes import SCENES, title
    from physjax.study.report_page import build_page
    from physjax.study.scene_report import PARTS, build_sections

    for name in names:
        with jax.enable_x64(True):
            problem = SCENES[name]()
        with tqdm(total=len(PARTS), desc=f"{name:<16}", unit="part", file=sys.stderr) as bar:
            reported = []
            for section in build_sections(problem, name, title(name), progress=bar.set_postfix_str):
                reported.append(section)
                bar.update()
        with write_atomically(folder / f"{name}.html") as file:
            file.write(build_page(name.replace("_", " "), "", reported))
        print(f"Report: {folder / f'{name}.html'}", flush=True)


def _study_scene(name: str, folder: Path, quick: bool, label: str) -> "tuple[WorkPrecision, Section]":
    """The work-precision study of a scene and its section of the page; PNG and CSV are written."""
    import jax

    from physjax.files import write_atomically
    from physjax.scenes import SCENES, title
    from physjax.study import accuracy
    from physjax.study.report_page import Section, Table, encode_figure

    with jax.enable_x64(True):
        problem = SCENES[name]()
        count = len(accuracy.list_compared_methods(problem.scene))
    rivals = accuracy.default_rivals() if problem.is_ode else ()
    with tqdm(total=1 + count + len(rivals), desc=f"{label:<20}", unit="method", file=sys.stderr) as bar:

        def progress(what: str) -> None:
            bar.set_postfix_str(what)
            bar.update()

        budget = accuracy.QUICK if quick else accuracy.THOROUGH
        result = accuracy.work_precision(problem, rivals=rivals, budget=budget, name=name, progress=progress)
        bar.set_postfix_str("done")
    picture = encode_figure(result.plot(), f"charts of {name}")
    with write_atomically(folder / f"{name}.png", "wb") as file:
        file.write(picture.data)
    result.to_csv(folder / f"{name}.csv")
    return result, Section(name, title(name), picture, Table(result.table()))


def _summarise(results: "list[WorkPrecision]") -> str:
    """A table with a line for each scene: the fastest method, its step and its time, for each error."""
    from physjax.study.accuracy.result import TABLE_ERRORS
    from physjax.text import format_table

    headers = ["scene", *(f"error {error:.0e}" for error in TABLE_ERRORS), "truth"]
    rows = [[r.name, *(_format_fastest(r, error) for error in TABLE_ERRORS), r.truth] for r in results]
    return format_table(headers, rows, align="<" * len(headers))


def _format_fastest(result: "WorkPrecision", error: float) -> str:
    from physjax.text import format_seconds

    run = result.fastest(error)
    if run is None:
        return "none within the budget"
    how = f"dt {format_seconds(run.dt)}" if run.dt is not None else f"tol {run.tolerance:.0e}"
    return f"{run.method}, {how}: {format_seconds(run.seconds)}"
