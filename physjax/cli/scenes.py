"""`physjax scenes`: the gallery, listed or drawn."""

import argparse
import sys

from tqdm import tqdm


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its options to those of `physjax`."""
    command = commands.add_parser("scenes", help="list the scenes of the gallery, or draw them")
    command.add_argument(
        "names", nargs="*", metavar="SCENE", help="these scenes, with the numbers that they are built from"
    )
    command.add_argument("--only", nargs="+", default=[], metavar="SCENE", help="the same, without their numbers")
    command.add_argument(
        "--render", metavar="DIR", help="write a picture and a short film of each, and a page with all of them"
    )
    command.set_defaults(run=lambda options: _run_scenes(options.names, options.only, options.render))


def _run_scenes(detailed: list[str], only: list[str], out: str | None) -> int:
    """Print every scene, and every run that must fail; or draw the scenes. Returns 1 if one could not be drawn."""
    from physjax.checks import demand_known
    from physjax.scenes import FAILURES, SCENES, title
    from physjax.scenes.catalogue import list_scene, wrap_line

    names = list(dict.fromkeys([*detailed, *only]))
    chosen = [demand_known("scene", name, SCENES) for name in names] or list(SCENES)
    if out is not None:
        return _render_scenes(chosen, out)
    for name in chosen:
        print(list_scene(name), end="\n\n", flush=True)
        if name in detailed:
            print(_format_numbers(name), end="\n\n")
    if not names:
        print("Runs that must fail:", end="\n\n")
        for name in FAILURES:
            print(f"{name}\n{wrap_line(title(name), 4)}", end="\n\n")
    return 0


def _format_numbers(name: str) -> str:
    """A table of the numbers that a scene is built from, and how to give them."""
    from physjax.scenes import SCENES
    from physjax.scenes.parameters import read_parameters
    from physjax.summaries import format_number
    from physjax.text import format_table

    parameters = read_parameters(SCENES[name])
    if not parameters:
        return "    has no numbers to set"
    rows = []
    for p in parameters:
        ends = "" if p.low is None or p.high is None else f"{format_number(p.low)} to {format_number(p.high)}"
        rows.append([p.name, str(p.default), p.unit, ends])
    table = format_table(["number", "default", "unit", "worth a look"], rows, align="<><<")
    first = parameters[0]
    given = f'scenes.SCENES["{name}"]({first.name}={first.default})'
    return "\n".join(
        f"    {line}".rstrip() for line in [*table.splitlines(), "", f"physjax explore {name}; in Python {given}"]
    )


def _render_scenes(names: list[str], out: str) -> int:
    """Draw scenes with progress, and report at the end which could not be drawn, and why."""
    import matplotlib

    from physjax.files import ensure_writable_folder
    from physjax.scenes.catalogue import render

    folder = ensure_writable_folder(out)
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
