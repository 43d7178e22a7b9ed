"""`physjax aim`: which launch hits a target."""

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from physjax.scene import Scene
    from physjax.study.inverse.aim import Aimed


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its options to those of `physjax`."""
    command = commands.add_parser("aim", help="which angle hits a target: both arcs, with drag and wind")
    command.add_argument("--target", type=float, nargs="+", required=True, metavar="M", help="x y, or x y z [m]")
    command.add_argument("--speed", type=float, help="launch speed [m/s]; the least that hits if left out")
    command.add_argument(
        "--start", type=float, nargs="+", metavar="M", help="where it is launched from [m] (default: the origin)"
    )
    command.add_argument(
        "--drag", type=float, metavar="CDA", help="drag coefficient times area [m²], in air of 1.225 kg/m³"
    )
    command.add_argument("--mass", type=float, default=1.0, help="mass [kg] (default: 1)")
    command.add_argument(
        "--wind", type=float, nargs="+", metavar="V", help="velocity of the air [m/s]; acts through --drag"
    )
    command.add_argument("--gravity", type=float, default=9.8, help="g [m/s²] (default: 9.8)")
    command.add_argument("--up", choices="xyz", default="y", help="the axis that is up (default: y)")
    command.add_argument("--out", default="aim", metavar="DIR", help="where the picture goes (default: aim)")
    command.set_defaults(run=_run_aim)


def _run_aim(options: argparse.Namespace) -> None:
    """Print both arcs to a target with their angle, flight time and apex; write their picture as PNG."""
    import jax
    import matplotlib

    from physjax.files import ensure_writable_folder, write_atomically
    from physjax.study.inverse.aim import aim_at

    with jax.enable_x64(True):
        scene = _build_throw(options)
        folder = ensure_writable_folder(options.out)
        aimed = aim_at(scene, options.target, speed=options.speed)
        print(_format_arcs(aimed, any_speed=options.speed is None))
        if not aimed.ok:
            print(describe_reach(scene, options, float(aimed.low.miss)))
        matplotlib.use("Agg")
        with write_atomically(folder / "aim.png", "wb") as file:
            aimed.plot().figure.savefig(file, dpi=125)  # pyright: ignore[reportAttributeAccessIssue]  # ours are in a figure, not in a subfigure
    print(f"Picture: {folder / 'aim.png'}")


def describe_reach(scene: "Scene", options: argparse.Namespace, miss: float) -> str:
    """How near a shot comes that does not hit, and the least speed that does."""
    from physjax.study.inverse.aim import aim_at

    if options.speed is None:
        return f"The target is out of reach at any speed that was tried: the nearest miss is {miss:.3g} m away."
    least = aim_at(scene, options.target).low
    needs = f"it needs at least {float(least.speed):.4g} m/s" if least.ok else "no speed that was tried hits it"
    return f"The target is out of reach: {options.speed:g} m/s comes within {miss:.3g} m of it; {needs}."


def _format_arcs(aimed: "Aimed", any_speed: bool) -> str:
    """A table with a line for each arc; where any speed will do, only that of the least speed."""
    import numpy as np

    from physjax.text import format_table

    arcs = {"least speed": aimed.low} if any_speed else {"low": aimed.low, "high": aimed.high}
    angles = ["angle [°]"] if aimed.low.azimuth is None else ["angle [°]", "azimuth [°]"]
    rows = [
        [
            name,
            "hit" if shot.ok else "out of reach",
            *(f"{np.degrees(angle):.4f}" for angle in (shot.angle, shot.azimuth) if angle is not None),
            *(f"{float(number):.4f}" for number in (shot.speed, shot.time, shot.apex)),
            f"{float(shot.miss):.2g}",
        ]
        for name, shot in arcs.items()
    ]
    headers = ["arc", "", *angles, "speed [m/s]", "time [s]", "apex [m]", "miss [m]"]
    return format_table(headers, rows, align="<<" + ">" * (len(headers) - 2))


def _build_throw(options: argparse.Namespace) -> "Scene":
    """A point mass at rest at the start, under gravity and, if asked for, drag."""
    import jax.numpy as jnp

    from physjax.particles import Particles
    from physjax.parts import Force
    from physjax.physics import forces
    from physjax.scene import Scene

    dim = len(options.target)
    start = jnp.array(options.start or [0.0] * dim)
    for name, given in (("start", start), ("wind", options.wind)):
        if given is not None and len(given) != dim:
            raise ValueError(f"--{name}: got {len(given)} numbers, expected {dim}, one for each of --target.")
    if options.wind is not None and options.drag is None:
        raise ValueError("--wind: got a wind without --drag, expected both: the air acts through the drag.")
    if options.up == "z" and dim == 2:
        raise ValueError("--up: got z with a target in the plane, expected x or y, or a third number for --target.")
    loads: list[Force] = [forces.Gravity(options.gravity, up="xyz".index(options.up))]
    if options.drag is not None:
        loads.append(forces.QuadraticDrag(area=options.drag, coefficient=1.0, wind=options.wind))
    return Scene(Particles(start, jnp.zeros(dim)), mass=options.mass, forces=tuple(loads))
