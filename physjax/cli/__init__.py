"""`physjax` on the command line, one module for each command."""

import argparse
import sys
from collections.abc import Sequence

from physjax.cli import aim, chart, scenes, stability, sweep

COMMANDS = (chart, scenes, stability, aim, sweep)
"""In the order in which `physjax --help` lists them."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns 0, 1 if a part of it failed, or 2 with one plain line on standard error for bad input."""
    parser = argparse.ArgumentParser(prog="physjax", description="Game physics in JAX.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for command in COMMANDS:
        command.add_command(commands)
    options = parser.parse_args(arguments)
    try:
        return options.run(options) or 0
    except (ValueError, OSError) as error:
        print(f"physjax: {error}", file=sys.stderr)
        return 2
