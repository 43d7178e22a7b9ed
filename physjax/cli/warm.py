"""`physjax warm`: compile scenes into a folder from which later sessions read, for a classroom."""

import argparse
import sys

from tqdm import tqdm

from physjax.cli.chart import DEFAULT_SCENES


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its options to those of `physjax`; main reads the folder, and keeps what is compiled in it."""
    command = commands.add_parser(
        "warm", help="compile scenes into a folder (default: compiled), from which later sessions read: for a classroom"
    )
    command.add_argument(
        "scenes",
        nargs="*",
        metavar="SCENE",
        help=f"names from `physjax scenes`; by default {', '.join(DEFAULT_SCENES)}",
    )
    command.set_defaults(run=lambda options: _run_warm(options.scenes, options.cache), cache="compiled")


def _run_warm(names: list[str], folder: str) -> None:
    """Compile what the reference, the film and the chart of each scene need."""
    from physjax.checks import demand_known
    from physjax.scenes import SCENES
    from physjax.scenes.catalogue import build_scene
    from physjax.study import accuracy

    names = [demand_known("scene", name, SCENES) for name in dict.fromkeys(names)] or list(DEFAULT_SCENES)
    once = accuracy.Budget(seconds=0.0, repeats=0)  # each method at its coarsest step: compiled is compiled
    with tqdm(names, desc="compiling", unit="scene", file=sys.stderr) as bar:
        for name in bar:
            bar.set_postfix_str(name)
            problem = build_scene(name)
            problem.reference()
            problem.filmed()
            accuracy.work_precision(problem, budget=once, name=name)
    print(f"Compiled: {', '.join(names)}.")
    print(f'Read by `physjax chart --cache {folder}`, and in Python after `physjax.cache("{folder}")`.')
