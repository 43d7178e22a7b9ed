"""Ten years of the solar system: what a metre costs, by our methods for orbits and by REBOUND's IAS15.

    python benchmarks/orbits.py [--quick] [--out DIR]

Sun, planets and Pluto from JPL's DE421 positions at J2000, by Newton's gravitation alone, float64, one scene on one core. (a) The
largest error of a position after ten years against an integration in 34 digits, and the time of the run, from long steps to short
ones, for IAS15 (H. Rein and D. S. Spiegel 2015) from loose tolerances to its own; (b) whether the two come to the same places.
The rounding of positions of 4.5e12 m is a millimetre a step. All run on one core if the process may use one (taskset -c 0).
"""

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import harness
import jax
import numpy as np
from harness import Bar, print_progress

from physjax import methods, simulate
from physjax.files import write_atomically
from physjax.scene import Scene
from physjax.scenes import SCENES
from physjax.scenes.orbits import DAY, read_newtonian_places

DAYS = 3652.5
GOAL = 1.0
"""The error that is asked for [m]."""
RIVAL = "REBOUND IAS15"
COLOURS = {
    "leapfrog": "#CC79A7",
    "blanes_moan4": "#E69F00",
    "kahan_li8": "#56B4E9",
    "dprkn6": "#0072B2",
    "dopri8": "#009E73",
    RIVAL: "#000000",
}


class Settings(NamedTuple):
    """Steps [days] of each method, tolerances of IAS15, and how often each run is timed."""

    steps: dict[str, tuple[float, ...]]
    tolerances: tuple[float, ...]
    repeats: int


FULL = Settings(
    {
        "leapfrog": (1.0, 0.25, 0.05, 0.0125),
        "blanes_moan4": (4.0, 2.0, 1.0, 0.5, 0.25),
        "kahan_li8": (8.0, 4.0, 2.0, 1.1),
        "dprkn6": (4.0, 2.0, 1.0, 0.5, 0.25, 0.2),
        "dopri8": (4.0, 2.0, 1.0, 0.65),
    },
    (1e-3, 1e-5, 1e-7, 1e-9),
    5,
)
QUICK = Settings({"leapfrog": (4.0, 2.0), "dprkn6": (4.0, 0.25)}, (1e-9,), 1)


def run_ours(scene: Scene, method: Callable, steps: int) -> np.ndarray:
    """Positions after ten years [m]."""
    flight = simulate(scene, method, dt=DAYS * DAY / steps, steps=steps, save_every=steps)
    return np.asarray(flight.final_scene.state.position)


def run_rebound(scene: Scene, tolerance: float) -> np.ndarray:
    """The same by IAS15."""
    rebound = harness.import_optional("rebound")
    simulation = rebound.Simulation()
    simulation.G, simulation.integrator, simulation.dt = 1.0, "ias15", DAY
    simulation.integrator.epsilon = tolerance
    gm = np.asarray(scene.forces[0].gm)
    for m, x, v in zip(gm, np.asarray(scene.state.position), np.asarray(scene.state.velocity), strict=True):
        simulation.add(m=m, x=x[0], y=x[1], z=x[2], vx=v[0], vy=v[1], vz=v[2])
    simulation.integrate(DAYS * DAY)
    return np.array([[p.x, p.y, p.z] for p in simulation.particles])


def list_runs(scene: Scene, size: Settings) -> Iterator[tuple[str, str, Callable[[], np.ndarray]]]:
    """Each run: its method, its step or its tolerance, and how to make it."""
    for name, steps in size.steps.items():
        for days in steps:
            yield name, f"{days:g} d", partial(run_ours, scene, getattr(methods, name), round(DAYS / days))
    for tolerance in size.tolerances:
        yield RIVAL, f"{tolerance:g}", partial(run_rebound, scene, tolerance)


def measure(scene: Scene, size: Settings) -> tuple[list[dict], dict[str, np.ndarray]]:
    """Error and time of every run, and where the best of ours and of IAS15 end; what is not installed is left out."""
    exact, rows, ends = read_newtonian_places(DAYS), [], {}
    for name, fineness, run in list_runs(scene, size):
        timings, failed = harness.time_side_by_side({name: run}, size.repeats)
        if failed:
            print_progress(f"  {name}: {failed[name]}")
            continue
        end, side = run(), "IAS15" if name == RIVAL else "ours"
        error = measure_distance(end, exact)
        if error < measure_distance(ends.get(side, np.inf), exact):
            ends[side] = end
        rows.append({"method": name, "fineness": fineness, "error": error, "seconds": timings[name].least})
        print_progress(f"  {name} {fineness}: {error:.3g} m, {timings[name].least:.3g} s")
    return rows, ends


def measure_distance(places: np.ndarray | float, others: np.ndarray) -> float:
    """The largest distance between two places of a body [m]."""
    return float(np.linalg.norm(places - others, axis=-1).max())


def find_cheapest(rows: Iterable[dict], ours: bool) -> float:
    """Seconds of the cheapest run that is within the goal, of ours or of the others; NaN without one."""
    good = [r["seconds"] for r in rows if r["error"] <= GOAL and (r["method"] != RIVAL) is ours]
    return min(good, default=float("nan"))


def draw(path: Path, rows: list[dict], foot: str) -> None:
    """Error against time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.5, 5.0), layout="constrained")
    axis = figure.subplots()
    for name, colour in COLOURS.items():
        points = [(r["seconds"], r["error"]) for r in rows if r["method"] == name]
        if points:
            axis.loglog(*zip(*points, strict=True), "o-", color=colour, label=name)
    axis.axhline(GOAL, color="#999999", linewidth=0.8)
    axis.set(
        xlabel="time of a run [s]", ylabel="largest error of a position [m]", title="ten years of the solar system"
    )
    axis.legend(frameon=False)
    axis.grid(alpha=0.3)
    figure.supxlabel(foot, fontsize=8, x=0.01, ha="left")
    with write_atomically(path, "wb") as file:
        figure.savefig(file, format="png", dpi=150)


def main() -> None:
    """Run everything, print the table, write the record and the chart."""
    quick, folder = harness.parse_options(__doc__)
    size, about = QUICK if quick else FULL, harness.describe_machine()
    with jax.enable_x64(True):
        rows, ends = measure(SCENES["solar_system"]().scene, size)
    seconds = {"ours": find_cheapest(rows, ours=True), "IAS15": find_cheapest(rows, ours=False)}
    apart = measure_distance(ends["ours"], ends["IAS15"]) if len(ends) == 2 else float("nan")
    least = min(r["error"] for r in rows if r["method"] != RIVAL)
    bars = [Bar("least error of ours [m]", least, "<=", GOAL), Bar("ours and IAS15 apart [m]", apart, "<=", GOAL)]
    print(harness.format_caption(about))
    cells = [[r["method"], r["fineness"], r["error"], r["seconds"]] for r in rows]
    harness.print_table("ten years of the solar system", ["", "step, tolerance", "error [m]", "time [s]"], cells)
    harness.print_table("time to 1 m [s]", ["", "ours", "IAS15"], [["", seconds["ours"], seconds["IAS15"]]])
    harness.print_bars(bars, quick)
    record = {"benchmark": "orbits", "quick": quick, "machine": about, "settings": size._asdict(), "runs": rows}
    record["seconds_to_goal"] = seconds
    record["bars"] = [bar._asdict() | {"met": bar.met} for bar in bars]
    written, drawn = (harness.result_path(folder, "orbits", quick, ending) for ending in ("json", "png"))
    harness.write_json(written, record)
    draw(drawn, rows, harness.format_caption(about))
    print(f"\nwritten: {written} and {drawn.name}")


if __name__ == "__main__":
    main()
