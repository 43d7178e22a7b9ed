"""`physjax scenes`: the gallery, listed or drawn."""

import argparse
import sys

from tqdm import tqdm


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its options to those of `physjax`."""
    command = commands.add_parser("scenes", help="list the scenes of the gallery, or draw them")
    command.add_argument("--only", nargs="+", default=[], metavar="SCENE", help="these scenes; all by default")
    command.add_argument(
        "--render", metavar="DIR", help="write a picture and a short film of each, and a page with all of them"
    )
    command.set_defaults(run=lambda options: _run_scenes(options.only, options.render))


def _run_scenes(names: list[str], out: str | None) -> int:
    """Print every scene, and every run that must fail; or draw the scenes. Returns 1 if one could not be drawn."""
    from physjax.checks import demand_known
    from physjax.scenes import FAILURES, SCENES, title
    from physjax.scenes.catalogue import list_scene
    from physjax.text import format_table

    chosen = [demand_known("scene", name, SCENES) for name in dict.fromkeys(names)] or list(SCENES)
    if out is not None:
        return _render_scenes(chosen, out)
    for name in chosen:
        print(list_scene(name), end="\n\n", flush=True)
    if not names:
        print(format_table(["failure", "what it is"], [[name, title(name)] for name in FAILURES], align="<<"))
    return 0


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
