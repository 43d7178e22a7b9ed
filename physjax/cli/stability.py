"""`physjax stability`: the largest stable step of a scene under every method, predicted and measured."""

import sys
from typing import Any

from tqdm import tqdm


def add_command(commands: Any) -> None:
    """Enter the command and its options among those of `physjax`."""
    command = commands.add_parser("stability", help="which step is stable in a scene: predicted and measured limits")
    command.add_argument("scene", metavar="SCENE", help="a name from `physjax scenes`, failures included")
    command.add_argument("--out", default="stability", metavar="DIR", help="where the map goes (default: stability)")
    command.add_argument("--steps", type=int, default=4000, help="steps of a measuring run (default: 4000)")
    command.set_defaults(run=lambda options: _run_stability(options.scene, options.out, options.steps))


def _run_stability(name: str, out: str, steps: int) -> None:
    """Print predicted and measured limits of every method in a scene; write the map as PNG."""
    import jax
    import matplotlib
    import numpy as np

    from physjax.checks import as_positive_integer, demand_known
    from physjax.files import ensure_writable_folder, write_atomically
    from physjax.parts import callable_name
    from physjax.scenes import FAILURES, SCENES
    from physjax.stepping.methods import METHODS
    from physjax.study import stability
    from physjax.study.stability.survey import find_fastest_moment, map_around_limits
    from physjax.text import describe_machine, format_seconds, format_table

    name, steps = demand_known("scene", name, SCENES | FAILURES), as_positive_integer("steps", steps, at_least=64)
    folder = ensure_writable_folder(out)
    matplotlib.use("Agg")
    with jax.enable_x64(True):
        problem = (SCENES | FAILURES)[name]()
    scene = problem.scene
    time, at = find_fastest_moment(problem) if name in SCENES else (0.0, scene.state)
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
                *_format_limits(predicted.dt, measured),
                str(predicted).partition(", ")[2] or "any step is stable",
            ]
        )
    print(f"\n{format_table(['method', 'predicted', 'measured', 'what sets it'], rows, align='<>><')}\n")
    print(f"About the state at t = {time:.4g} s, where the scene is fastest.")
    if unstable:
        print("There its own motion takes neighbours apart, whatever the method: nothing to be measured.")
    chart = map_around_limits(scene, limits)
    if chart is not None:
        with write_atomically(folder / f"{name}.png", "wb") as file:
            chart.plot().savefig(file, dpi=110)
        print(f"Map: {folder / f'{name}.png'}")
    else:
        print("No method has a limit here, so there is no map to draw.")
    if name in FAILURES:
        reported = stability.explain(scene, problem.method, problem.dt, steps=problem.steps)
        print(f"{callable_name(problem.method)} with dt = {format_seconds(problem.dt)}: {reported}")
    print(f"Measured on {describe_machine()}.")


def _format_limits(predicted: float, measured: float | None) -> list[str]:
    from physjax.text import format_seconds

    if not predicted or predicted == float("inf"):
        return ["none" if predicted else "never stable", "-"]
    return [format_seconds(predicted), "-" if measured is None else format_seconds(measured)]
