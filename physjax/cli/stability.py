"""`physjax stability`: the largest stable step of a scene under every method, predicted and measured."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, cast

from tqdm import tqdm

if TYPE_CHECKING:
    from physjax.particles import Particles
    from physjax.scene import Scene
    from physjax.scenes.failures import Failure
    from physjax.study.stability import Limit


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its options to those of `physjax`."""
    command = commands.add_parser("stability", help="which step is stable in a scene: predicted and measured limits")
    command.add_argument("scene", metavar="SCENE", help="a name from `physjax scenes`, failures included")
    command.add_argument("--out", default="stability", metavar="DIR", help="where the map goes (default: stability)")
    command.add_argument("--steps", type=int, default=4000, help="steps of a measuring run (default: 4000)")
    command.set_defaults(run=lambda options: _run_stability(options.scene, options.out, options.steps))


def _run_stability(name: str, out: str, steps: int) -> None:
    """Print predicted and measured limits of every method in a scene; write the map as PNG."""
    import jax
    import matplotlib

    from physjax.checks import as_positive_integer, demand_known
    from physjax.files import ensure_writable_folder
    from physjax.particles import callable_name
    from physjax.scenes import FAILURES, SCENES
    from physjax.study import stability
    from physjax.study.problem import Problem
    from physjax.study.stability.survey import find_fastest_moment
    from physjax.text import describe_machine, format_seconds

    name, steps = demand_known("scene", name, SCENES | FAILURES), as_positive_integer("steps", steps, at_least=64)
    folder = ensure_writable_folder(out)
    matplotlib.use("Agg")
    with jax.enable_x64(True):
        problem = (SCENES | FAILURES)[name]()
    scene = problem.scene
    time, at = find_fastest_moment(problem) if isinstance(problem, Problem) else (0.0, scene.state)
    unstable = bool(stability.grows_by_itself(scene, at).any())
    limits = _print_limits(name, scene, at, None if unstable else steps)
    print(f"Linearised about the state at t = {time:.4g} s, where the scene is fastest.")
    if unstable:
        print(
            "There neighbouring motions diverge by the physics itself, whatever the method: no limit can be measured."
        )
    _write_map(scene, limits, folder / f"{name}.png")
    if name in FAILURES:
        failure = cast("Failure", problem)
        reported = stability.explain(scene, failure.method, failure.dt, steps=failure.steps)
        print(f"{callable_name(failure.method)} with dt = {format_seconds(failure.dt)}: {reported}")
    print(f"Measured on {describe_machine()}.")


def _print_limits(name: str, scene: "Scene", at: "Particles", steps: int | None) -> "list[Limit]":
    """Print a table of the limits of every method about a state, measured in runs of `steps` (None: predicted only)."""
    import numpy as np

    from physjax.stepping.methods import METHODS
    from physjax.study import stability
    from physjax.text import format_table

    rows, limits = [], []
    for method in tqdm(METHODS.values(), desc=name, unit="method", file=sys.stderr):
        predicted = stability.limit(scene, method, at)
        measured = None
        # a method that is stable at any step, or at none, has no limit to be found by runs
        if steps is not None and np.isfinite(predicted.dt) and predicted.dt > 0:
            measured = float(stability.measure_limit(scene, method, at, steps=steps).min())
        limits.append(predicted)
        reason = str(predicted).partition(", ")[2] or "any step is stable"
        rows.append([predicted.method, *_format_limits(predicted.dt, measured), reason])
    print(f"\n{format_table(['method', 'predicted', 'measured', 'what sets it'], rows, align='<>><')}\n")
    return limits


def _write_map(scene: "Scene", limits: "list[Limit]", path: Path) -> None:
    """Write the map of stable steps around the limits as PNG, if any method has a limit."""
    from physjax.files import write_atomically
    from physjax.study.stability.survey import map_around_limits

    chart = map_around_limits(scene, limits)
    if chart is None:
        print("No method has a limit here, so there is no map to draw.")
        return
    with write_atomically(path, "wb") as file:
        chart.plot().savefig(file, dpi=110)
    print(f"Map: {path}")


def _format_limits(predicted: float, measured: float | None) -> list[str]:
    from physjax.text import format_seconds

    if not predicted or predicted == float("inf"):
        return ["none" if predicted else "never stable", "-"]
    return [format_seconds(predicted), "-" if measured is None else format_seconds(measured)]
