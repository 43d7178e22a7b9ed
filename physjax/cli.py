"""`physjax` on the command line."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

BOUNCES = "bouncing_ball"
"""The scene that shows what a contact does to the order of a method."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns 0, 1 if a part of it failed, or 2 with one plain line on standard error for bad input."""
    parser = argparse.ArgumentParser(prog="physjax", description="Game physics in JAX.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    chart = commands.add_parser("chart", help="chart speed against accuracy for the scenes of the gallery")
    chart.add_argument(
        "scenes",
        nargs="*",
        metavar="SCENE",
        help="names from `physjax scenes`; by default all smooth ones and a ball that bounces",
    )
    chart.add_argument(
        "--out", default="chart", metavar="DIR", help="where pictures, CSV and the page go (default: chart)"
    )
    chart.add_argument("--quick", action="store_true", help="coarser and faster")
    chart.add_argument(
        "--report", action="store_true", help="a page for each scene instead: all there is to say of it, charts coarse"
    )
    chart.set_defaults(run=lambda options: _chart(options.scenes, options.out, options.quick, options.report))

    scenes = commands.add_parser("scenes", help="list the scenes of the gallery, or draw them")
    scenes.add_argument("--only", nargs="+", default=[], metavar="SCENE", help="these scenes; all by default")
    scenes.add_argument(
        "--render", metavar="DIR", help="write a picture and a short film of each, and a page with all of them"
    )
    scenes.set_defaults(run=lambda options: _scenes(options.only, options.render))

    stability = commands.add_parser("stability", help="which step is stable in a scene: predicted and measured limits")
    stability.add_argument("scene", metavar="SCENE", help="a name from `physjax scenes`, failures included")
    stability.add_argument("--out", default="stability", metavar="DIR", help="where the map goes (default: stability)")
    stability.add_argument("--steps", type=int, default=4000, help="steps of a measuring run (default: 4000)")
    stability.set_defaults(run=lambda options: _stability(options.scene, options.out, options.steps))

    aim = commands.add_parser("aim", help="which angle hits a target: both arcs, with drag and wind")
    aim.add_argument("--target", type=float, nargs="+", required=True, metavar="M", help="x y, or x y z [m]")
    aim.add_argument("--speed", type=float, help="launch speed [m/s]; the least that hits if left out")
    aim.add_argument(
        "--start", type=float, nargs="+", metavar="M", help="where it is fired from [m] (default: the origin)"
    )
    aim.add_argument(
        "--drag", type=float, metavar="CDA", help="drag coefficient times area [m²], in air of 1.225 kg/m³"
    )
    aim.add_argument("--mass", type=float, default=1.0, help="mass [kg] (default: 1)")
    aim.add_argument(
        "--wind", type=float, nargs="+", metavar="V", help="velocity of the air [m/s]; acts through --drag"
    )
    aim.add_argument("--gravity", type=float, default=9.8, help="g [m/s²] (default: 9.8)")
    aim.add_argument("--up", choices="xyz", default="y", help="the axis that is up (default: y)")
    aim.add_argument("--out", default="aim", metavar="DIR", help="where the picture goes (default: aim)")
    aim.set_defaults(run=_aim)

    sweep = commands.add_parser("sweep", help="an outcome of a scene over a grid of the numbers that it is built from")
    sweep.add_argument("scene", metavar="SCENE", help="a name from `physjax scenes`")
    sweep.add_argument(
        "--over",
        nargs="+",
        required=True,
        metavar="NAME=LOW:HIGH:COUNT",
        help="arguments of the scene, e.g. speed=10:50:40",
    )
    sweep.add_argument("--outcome", required=True, metavar="NAME", help="height, distance, speed or energy")
    sweep.add_argument("--method", default="rk4", metavar="NAME", help="a method of stepping (default: rk4)")
    sweep.add_argument("--steps", type=int, default=1024, help="steps of each run (default: 1024)")
    sweep.add_argument(
        "--out", default="sweep", metavar="DIR", help="where chunks, sweep.npz and the picture go (default: sweep)"
    )
    sweep.set_defaults(run=_sweep)

    options = parser.parse_args(arguments)
    try:
        return options.run(options) or 0
    except (ValueError, OSError) as error:
        print(f"physjax: {error}", file=sys.stderr)
        return 2


def _scenes(names: list[str], out: str | None) -> int:
    """Print every scene, and every run that must fail; or draw the scenes. Returns 1 if one of them could not be drawn."""
    from physjax.checks import known
    from physjax.scenes import FAILURES, SCENES, title
    from physjax.scenes.catalogue import entry
    from physjax.text import table

    chosen = [known("scene", name, SCENES) for name in dict.fromkeys(names)] or list(SCENES)
    if out is not None:
        return _rendered(chosen, out)
    for name in chosen:
        print(entry(name)[0], end="\n\n", flush=True)
    if not names:
        print(table(["failure", "what it is"], [[name, title(name)] for name in FAILURES], align="<<"))
    return 0


def _rendered(names: list[str], out: str) -> int:
    """Draw scenes with progress, and tell at the end which could not be drawn, and why."""
    import matplotlib

    from physjax.files import writable_folder
    from physjax.scenes.catalogue import render

    folder = writable_folder(out)
    matplotlib.use("Agg")
    failed = {}
    with tqdm(total=len(names), desc="drawing", unit="scene", file=sys.stderr) as bar:
        for name, error in render(names, folder):
            bar.set_postfix_str(name)
            bar.update()
            if error is not None:
                failed[name] = error
    print(f"Gallery: {folder / 'index.html'}")
    for name, error in failed.items():
        print(f"physjax: {name} could not be drawn: {type(error).__name__}: {error}", file=sys.stderr)
    return 1 if failed else 0


def _chart(names: list[str], out: str, quick: bool, whole: bool) -> None:
    """Study the scenes one by one; write PNG, CSV and one HTML page, print one table; or a page on the whole of each."""
    import matplotlib

    from physjax.checks import known
    from physjax.files import replacing, writable_folder
    from physjax.scenes import SCENES
    from physjax.study import report_page

    names = [known("scene", name, SCENES) for name in dict.fromkeys(names)] or _smooth()
    folder = writable_folder(out)
    matplotlib.use("Agg")
    if whole:
        return _reported(names, folder)
    results = [_study(name, folder, quick) for name in names]
    summary = _summary([result for result, _ in results])
    with replacing(folder / "index.html") as file:
        file.write(report_page.page("physjax: speed against accuracy", summary, [section for _, section in results]))
    print(f"\nThe fastest run whose error stays below a fraction of the path:\n\n{summary}\n")
    print(f"Measured on {report_page.machine()}.\nCharts: {folder / 'index.html'}")


def _smooth() -> list[str]:
    """What is charted unless told otherwise: motions without contacts or memory, and `BOUNCES` for what a contact does.

    The others are charted when they are named; all of them together would take an hour.
    """
    from physjax.scenes import SCENES

    return [name for name, build in SCENES.items() if name == BOUNCES or build().is_ode]


def _reported(names: list[str], folder: Path) -> None:
    """Write a page on each scene, with its parts as progress."""
    import jax

    from physjax.files import replacing
    from physjax.scenes import SCENES, title
    from physjax.study.report_page import page
    from physjax.study.scene_report import PARTS, sections

    for name in names:
        with jax.enable_x64(True):
            problem = SCENES[name]()
        with tqdm(total=len(PARTS), desc=f"{name:<16}", unit="part", file=sys.stderr) as bar:
            told = []
            for section in sections(problem, name, title(name), progress=bar.set_postfix_str):
                told.append(section)
                bar.update()
        with replacing(folder / f"{name}.html") as file:
            file.write(page(name.replace("_", " "), "", told))
        print(f"Report: {folder / f'{name}.html'}", flush=True)


def _stability(name: str, out: str, steps: int) -> None:
    """Print predicted and measured limits of every method in a scene; write the map as PNG."""
    import jax
    import matplotlib
    import numpy as np

    from physjax.checks import known, positive_integer
    from physjax.files import replacing, writable_folder
    from physjax.scenes import FAILURES, SCENES
    from physjax.stepping.methods import METHODS
    from physjax.stepping.registry import method_name
    from physjax.study import stability
    from physjax.study.stability.survey import fastest_moment, map_around
    from physjax.text import machine, seconds_text, table

    name, steps = known("scene", name, SCENES | FAILURES), positive_integer("steps", steps, at_least=64)
    folder = writable_folder(out)
    matplotlib.use("Agg")
    with jax.enable_x64(True):
        problem = (SCENES | FAILURES)[name]()
    scene = problem.scene
    time, at = fastest_moment(problem) if name in SCENES else (0.0, scene.state)
    unstable = bool(stability.grows_by_itself(scene, at).any())
    rows, limits = [], []
    for method in tqdm(METHODS.values(), desc=name, unit="method", file=sys.stderr):
        predicted = stability.limit(scene, method, at)
        finite = np.isfinite(predicted.dt) and predicted.dt > 0
        measured = (
            float(stability.measure_limit(scene, method, at, steps=steps).min()) if finite and not unstable else None
        )
        limits.append(predicted)
        rows.append(
            [
                predicted.method,
                *_limit_texts(predicted.dt, measured),
                str(predicted).partition(", ")[2] or "any step is stable",
            ]
        )
    print(f"\n{table(['method', 'predicted', 'measured', 'what sets it'], rows, align='<>><')}\n")
    print(f"About the state at t = {time:.4g} s, where the scene is fastest.")
    if unstable:
        print("There its own motion takes neighbours apart, whatever the method: nothing to be measured.")
    chart = map_around(scene, limits)
    if chart is not None:
        with replacing(folder / f"{name}.png", "wb") as file:
            chart.plot().savefig(file, dpi=110)
        print(f"Map: {folder / f'{name}.png'}")
    else:
        print("No method has a limit here, so there is no map to draw.")
    if name in FAILURES:
        told = stability.explain(scene, problem.method, problem.dt, steps=problem.steps)
        print(f"{method_name(problem.method)} with dt = {seconds_text(problem.dt)}: {told}")
    print(f"Measured on {machine()}.")


def _limit_texts(predicted: float, measured: float | None) -> list[str]:
    from physjax.text import seconds_text

    if not predicted or predicted == float("inf"):
        return ["none" if predicted else "never stable", "-"]
    return [seconds_text(predicted), "-" if measured is None else seconds_text(measured)]


def _aim(options: argparse.Namespace) -> None:
    """Print both arcs to a target with their angle, flight time and apex; write their picture as PNG."""
    import jax
    import matplotlib
    import numpy as np

    from physjax.files import replacing, writable_folder
    from physjax.study.inverse.aim import aim_at
    from physjax.text import table

    with jax.enable_x64(True):
        scene = _thrown(options)
        folder = writable_folder(options.out)
        aimed = aim_at(scene, options.target, speed=options.speed)
        arcs = {"low": aimed.low, "high": aimed.high} if options.speed is not None else {"least speed": aimed.low}
        angles = ["angle [°]"] if aimed.low.azimuth is None else ["angle [°]", "azimuth [°]"]
        rows = [
            [
                name,
                "hit" if shot.ok else "out of reach",
                *(f"{np.degrees(angle):.4f}" for angle in (shot.angle, shot.azimuth) if angle is not None),
                *(f"{float(number):.4f}" for number in (shot.speed, shot.time, shot.apex)),
                f"{float(shot.miss):.2g}",
            ]
            for name, shot in arcs.items()
        ]
        headers = ["arc", "", *angles, "speed [m/s]", "time [s]", "apex [m]", "miss [m]"]
        print(table(headers, rows, align="<<" + ">" * (len(headers) - 2)))
        if not aimed.ok:
            print("The target is out of reach: these are the nearest misses.")
        matplotlib.use("Agg")
        with replacing(folder / "aim.png", "wb") as file:
            aimed.plot().figure.savefig(file, dpi=125)
    print(f"Picture: {folder / 'aim.png'}")


def _thrown(options: argparse.Namespace):
    """The scene of `physjax aim`."""
    from physjax.particles import Particles
    from physjax.physics import forces
    from physjax.scene import Scene

    dim = len(options.target)
    start = options.start or [0.0] * dim
    for name, given in (("start", start), ("wind", options.wind)):
        if given is not None and len(given) != dim:
            raise ValueError(f"--{name}: got {len(given)} numbers, expected {dim}, as many as --target has.")
    if options.wind is not None and options.drag is None:
        raise ValueError("--wind: got a wind without --drag, expected both: the air acts through the drag.")
    if options.up == "z" and dim == 2:
        raise ValueError("--up: got z with a target in the plane, expected x or y, or a third number for --target.")
    loads = [forces.Gravity(options.gravity, up="xyz".index(options.up))]
    if options.drag is not None:
        loads.append(forces.QuadraticDrag(area=options.drag, coefficient=1.0, wind=options.wind))
    return Scene(Particles(start, [0.0] * dim), mass=options.mass, forces=tuple(loads))


def _sweep(options: argparse.Namespace) -> None:
    """Print the best points and what failed; write the results, resumably, and their picture."""
    import jax
    import matplotlib

    from physjax.checks import known
    from physjax.files import replacing, writable_folder
    from physjax.scenes import SCENES
    from physjax.stepping.methods import METHODS
    from physjax.study.sweeps.observables import OUTCOMES, swept_scene

    build, outcome = SCENES[known("scene", options.scene, SCENES)], known("outcome", options.outcome, OUTCOMES)
    method = METHODS[known("method", options.method, METHODS)]
    axes = dict(_range(text) for text in options.over)
    folder = writable_folder(options.out)
    matplotlib.use("Agg")
    with jax.enable_x64(True):
        found = swept_scene(build, axes, outcome, method=method, steps=options.steps, out=folder / "chunks")
        words = OUTCOMES[outcome].__doc__.strip().rstrip(".")
        if found.ok.any():
            for name, largest in (("least", False), ("most", True)):
                best = found.best(outcome, largest=largest)
                where = ", ".join(f"{axis} = {float(best.point[axis]):.6g}" for axis in axes)
                print(f"{name}: {best.score:.6g} at {where}")
        for reason, count in found.failures.items():
            print(f"{count} of {found.status.size} lanes failed: {reason}")
        found.save(folder / "sweep.npz")
        drawn = found.plot(outcome, labels={outcome: words})
        with replacing(folder / "sweep.png", "wb") as file:
            (drawn if hasattr(drawn, "savefig") else drawn.figure).savefig(file, dpi=125)
    print(f"{words}: {folder / 'sweep.npz'}, {folder / 'sweep.png'}")


def _range(text: str) -> tuple[str, Any]:
    """An axis from NAME=LOW:HIGH:COUNT."""
    import numpy as np

    name, _, numbers = text.partition("=")
    try:
        low, high, count = numbers.split(":")
        return name, np.linspace(float(low), float(high), int(count))
    except ValueError as error:
        raise ValueError(f"--over: got {text!r}, expected NAME=LOW:HIGH:COUNT, e.g. speed=10:50:40.") from error


def _study(name: str, folder: Path, quick: bool):
    """One scene: its work-precision study, with PNG and CSV written; the result and its section of the page."""
    import jax

    from physjax.files import replacing
    from physjax.scenes import SCENES, title
    from physjax.stepping.methods import METHODS
    from physjax.study import accuracy
    from physjax.study.report_page import Section, Table, drawn

    with jax.enable_x64(True):
        problem = SCENES[name]()
    rivals = accuracy.default_rivals() if problem.is_ode else ()
    with tqdm(total=1 + len(METHODS) + len(rivals), desc=f"{name:<16}", unit="method", file=sys.stderr) as bar:

        def progress(what: str) -> None:
            bar.set_postfix_str(what)
            bar.update()

        budget = accuracy.QUICK if quick else accuracy.THOROUGH
        result = accuracy.work_precision(problem, rivals=rivals, budget=budget, name=name, progress=progress)
        bar.set_postfix_str("done")
    picture = drawn(result.plot(), f"charts of {name}")
    with replacing(folder / f"{name}.png", "wb") as file:
        file.write(picture.data)
    result.to_csv(folder / f"{name}.csv")
    return result, Section(name, title(name), picture, Table(result.table()))


def _summary(results: list) -> str:
    """A line for each scene: the fastest method, its step and time, for each of the errors."""
    from physjax.study.accuracy.result import ERRORS
    from physjax.text import table

    headers = ["scene", *(f"error {error:.0e}" for error in ERRORS), "truth"]
    rows = [[r.name, *(_fastest(r, error) for error in ERRORS), r.truth] for r in results]
    return table(headers, rows, align="<" * len(headers))


def _fastest(result, error: float) -> str:
    from physjax.text import seconds_text

    run = result.fastest(error)
    if run is None:
        return "none within the budget"
    how = f"dt {seconds_text(run.dt)}" if run.dt is not None else f"tol {run.tolerance:.0e}"
    return f"{run.method}, {how}: {seconds_text(run.seconds)}"
