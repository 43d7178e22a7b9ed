"""`physjax` on the command line, one module for each command."""

import argparse
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from physjax.cli import aim, chart, explore, scenes, stability, sweep, warm
from physjax.compiling import cache

COMMANDS = (chart, explore, scenes, stability, aim, sweep, warm)
"""In the order in which `physjax --help` lists them."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns 0, 1 if a part of it failed, or 2 with one plain line on standard error for bad input."""
    parser = argparse.ArgumentParser(prog="physjax", description="Game physics in JAX.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for command in COMMANDS:
        command.add_command(commands)
    for command in commands.choices.values():
        command.add_argument(
            "--cache", metavar="DIR", help="keep compiled programs in a folder, and read them from there"
        )
    options = parser.parse_args(arguments)
    try:
        with _keep_programs(options.cache):
            return options.run(options) or 0
    except (ValueError, OSError) as error:
        print(f"physjax: {error}", file=sys.stderr)
        return 2


@contextmanager
def _keep_programs(folder: str | None) -> Iterator[None]:
    """Keep what a command compiles in a folder; None: not."""
    if folder is None:
        yield
        return
    cache(folder)
    try:
        yield
    finally:
        cache(None)
