"""`physjax` on the command line, one module for each command."""

import argparse
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version

from physjax.cli import aim, chart, explore, scenes, stability, sweep, warm
from physjax.compiling import cache

COMMANDS = (chart, explore, scenes, stability, aim, sweep, warm)
"""In the order in which `physjax --help` lists them."""
EXAMPLES = """\
physjax explore projectile            change a throw while you watch it
physjax scenes                        list the scenes of the gallery
physjax chart kepler                  chart speed against accuracy on an orbit
physjax aim --speed 30 --target 40 5  find the angle that hits
physjax stability flag                find the largest stable steps

physjax COMMAND --help says more of each; all commands: physjax --help"""
"""What `physjax` alone shows."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns 0, 1 if a part of it failed, or 2 with one plain line on standard error for bad input.

    Without a command it shows examples. 130 is for Ctrl-C; a pipe that closes ends it quietly.
    """
    parser = argparse.ArgumentParser(
        prog="physjax",
        description="Game physics in JAX.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"physjax {version('physjax')}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    for command in COMMANDS:
        command.add_command(commands)
    for command in commands.choices.values():
        command.add_argument(
            "--cache", metavar="DIR", help="keep compiled programs in a folder, and read them from there"
        )
    options = parser.parse_args(arguments)
    if options.command is None:
        print(EXAMPLES)
        return 0
    try:
        with _keep_programs(options.cache):
            status = options.run(options) or 0
            sys.stdout.flush()
            return status
    except KeyboardInterrupt:
        print(f"physjax {options.command}: stopped by Ctrl-C", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # whoever read the output has enough of it; what is left in the buffer must not fail at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
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
