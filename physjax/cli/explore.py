"""`physjax explore`: a scene of the gallery with sliders, in the browser."""

import argparse


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its options to those of `physjax`."""
    command = commands.add_parser("explore", help="change a scene while you watch it, in the browser")
    command.add_argument("scene", metavar="SCENE", nargs="?", default="projectile", help="a name from `physjax scenes`")
    command.add_argument("--port", type=int, default=0, help="of the page on this machine (default: any that is free)")
    command.add_argument("--no-browser", action="store_true", help="only say where the page is")
    command.set_defaults(run=lambda options: _run_explore(options.scene, options.port, not options.no_browser))


def _run_explore(name: str, port: int, browser: bool) -> None:
    """Serve the page of a scene until Ctrl-C."""
    from physjax.checks import demand_known
    from physjax.live import explore
    from physjax.scenes import SCENES

    name = demand_known("scene", name, SCENES)
    if not 0 <= port < 2**16:
        raise ValueError(f"port: got {port}, expected a number from 0 (any that is free) to 65535.")
    print(f"{name}: compiling the first run", flush=True)
    explore(name).serve(port, browser=browser)
