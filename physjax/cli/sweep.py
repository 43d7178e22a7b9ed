"""`physjax sweep`: an outcome of a scene over a grid of the numbers that it is built from."""

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its options to those of `physjax`."""
    command = commands.add_parser(
        "sweep", help="an outcome of a scene over a grid of the numbers that it is built from"
    )
    command.add_argument("scene", metavar="SCENE", help="a name from `physjax scenes`")
    command.add_argument(
        "--over",
        nargs="+",
        required=True,
        metavar="NAME=LOW:HIGH:COUNT",
        help="arguments of the scene, e.g. speed=10:50:40",
    )
    command.add_argument("--outcome", required=True, metavar="NAME", help="height, distance, speed or energy")
    command.add_argument("--method", default="rk4", metavar="NAME", help="a method of stepping (default: rk4)")
    command.add_argument("--steps", type=int, default=1024, help="steps of each run (default: 1024)")
    command.add_argument(
        "--out",
        metavar="DIR",
        help="where chunks, sweep.npz and the picture go (default: sweep/, and there a folder named after what is swept)",
    )
    command.set_defaults(run=_run_sweep)


def _run_sweep(options: argparse.Namespace) -> None:
    """Print the best points and the failures; write the results, so that a sweep can be resumed, and their picture."""
    import jax
    import matplotlib
    from matplotlib.figure import Figure

    from physjax.checks import demand_known
    from physjax.files import ensure_writable_folder, write_atomically
    from physjax.scenes import SCENES
    from physjax.stepping.methods import find_method, list_all_methods
    from physjax.study.sweeps.observables import OBSERVABLES, sweep_scene

    build = SCENES[demand_known("scene", options.scene, SCENES)]
    outcome = demand_known("outcome", options.outcome, OBSERVABLES)
    method = find_method(demand_known("method", options.method, list_all_methods()))
    axes = dict(_parse_range(text) for text in options.over)
    folder = ensure_writable_folder(options.out or f"sweep/{options.scene}-{outcome}-over-{'-'.join(axes)}")
    matplotlib.use("Agg")
    with jax.enable_x64(True):
        found = sweep_scene(build, axes, outcome, method=method, steps=options.steps, out=folder / "chunks")
        words = (OBSERVABLES[outcome].__doc__ or "").strip().rstrip(".")
        if found.ok.any():
            for name, largest in (("least", False), ("most", True)):
                best = found.best(outcome, largest=largest)
                where = ", ".join(f"{axis} = {float(best.point[axis]):.6g}" for axis in axes)
                print(f"{name}: {best.score:.6g} at {where}")
        for reason, count in found.failures.items():
            print(f"{count} of {found.status.size} lanes failed: {reason}")
        found.save(folder / "sweep.npz")
        drawn = found.plot(outcome, labels={outcome: words})
        with write_atomically(folder / "sweep.png", "wb") as file:
            figure = drawn if isinstance(drawn, Figure) else drawn.figure
            figure.savefig(file, dpi=125)  # pyright: ignore[reportAttributeAccessIssue]  # ours are in a figure, not in a subfigure
    print(f"{words}: {folder / 'sweep.npz'}, {folder / 'sweep.png'}")


def _parse_range(text: str) -> "tuple[str, np.ndarray]":
    """An axis from NAME=LOW:HIGH:COUNT."""
    import numpy as np

    name, _, numbers = text.partition("=")
    try:
        low, high, count = numbers.split(":")
        return name, np.linspace(float(low), float(high), int(count))
    except ValueError as error:
        raise ValueError(f"--over: got {text!r}, expected NAME=LOW:HIGH:COUNT, e.g. speed=10:50:40.") from error
