"""What adaptive steps gain, and what they cost methods whose bounded energy depends on equal ones.

    python benchmarks/adaptive.py [--quick] [--out DIR]

Two bodies on ellipses, float64. (a) Eccentricity 0.9, two orbits: error at the end against evaluations of the force,
for Runge-Kutta with equal steps and methods under error control, by doubled steps or by the errors that they know; (b)
rejected steps; (c) eccentricity 0.6, many orbits: the energy under leapfrog, verlet and Runge-Kutta, with equal steps
and, for the same number of evaluations, with error control. Counts, not seconds, so the machine does not matter.
"""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import harness
import jax
import numpy as np
from harness import Bar, print_progress

from physjax import energy, methods, simulate
from physjax.files import write_atomically
from physjax.scenes import SCENES
from physjax.study.accuracy.method_facts import count_evaluations_per_try
from physjax.study.problem import Problem

ERROR_GOAL = 1e-6
COLOURS = {"rk4": "#009E73", "verlet": "#0072B2", "leapfrog": "#CC79A7", "tsit5": "#E69F00"}
COLOURS |= {"dopri8": "#56B4E9", "dprkn6": "#D55E00"}
SYMPLECTIC = ("leapfrog", "verlet")
FRAMES_PER_ORBIT = 20
"""Times per orbit at which the energy is recorded."""
STEPS_PER_ATTEMPT = 3
"""An attempt is a step taken whole and in two halves."""


class Settings(NamedTuple):
    """Sizes of the studies."""

    tolerances: tuple[float, ...]
    counts: tuple[int, ...]
    orbits: int
    per_orbit: int


FULL = Settings(tuple(10.0**-i for i in range(3, 12)), tuple(500 * 2**i for i in range(8)), 200, 1600)
QUICK = Settings((1e-4, 1e-6, 1e-10), (500, 8000, 32_000), 10, 800)


def measure_error(problem: Problem, method: Callable, steps: int) -> float:
    """Error of position after the whole duration [m]."""
    run = simulate(problem.scene, method, dt=problem.duration / steps, steps=steps, save_every=steps)
    exact = problem.exact(np.array([problem.duration])).position[0]
    return float(np.abs(np.asarray(run.position[-1]) - exact).max())


def measure_adaptive(problem: Problem, method: Callable, tolerance: float, frames: int = 4) -> dict:
    """Error, evaluations and rejections of a run under error control."""
    chooser = methods.adaptive(method, tolerance, tolerance)
    counted = methods.count_steps(problem.scene, chooser, dt=problem.duration / frames, steps=frames)
    tries, rejected = int((counted.accepted + counted.rejected).sum()), int(counted.rejected.sum())
    exact = problem.exact(np.array([problem.duration])).position[0]
    # and two for the length of the first step
    evaluations = count_evaluations_per_try(chooser, problem.scene) * tries + 2
    error = float(np.abs(np.asarray(counted.state.position[-1]) - exact).max())
    row = {"method": f"adaptive {method.__name__}", "tolerance": tolerance, "error": error, "evaluations": evaluations}
    return row | {"tries": tries, "rejected": rejected}


def measure_work_and_error(size: Settings) -> list[dict]:
    """Error against evaluations on the orbit of eccentricity 0.9."""
    problem, rows = SCENES["kepler"](), []
    for steps in size.counts:
        evaluations = steps * methods.rk4.promises.evaluations
        rows.append({"method": "rk4", "error": measure_error(problem, methods.rk4, steps), "evaluations": evaluations})
    for method in (methods.rk4, methods.verlet, methods.tsit5, methods.dopri8, methods.dprkn6):
        # second order needs very many steps for the finest tolerances
        rows += [
            measure_adaptive(problem, method, t) for t in size.tolerances if method is not methods.verlet or t >= 1e-8
        ]
    return rows


def interpolate_evaluations(rows: list[dict], name: str) -> float:
    """Evaluations at which a method's error falls to the goal, on a straight line between logarithms."""
    points = sorted((r["evaluations"], r["error"]) for r in rows if r["method"] == name)
    for (n0, e0), (n1, e1) in pairwise(points):
        if e1 <= ERROR_GOAL < e0:
            return float(n0 * (n1 / n0) ** (np.log(e0 / ERROR_GOAL) / np.log(e0 / e1)))
    return float("nan")


def compare_energies(size: Settings) -> dict[str, dict[str, np.ndarray]]:
    """Relative change of the energy over many orbits, equal steps and steps under error control."""
    problem = SCENES["kepler"](eccentricity=0.6, orbits=size.orbits)
    start = float(energy.total(problem.scene, 0.0, problem.scene.state))
    found = {}
    for method in (methods.leapfrog, methods.verlet, methods.rk4):
        chooser, spent = match_cost(problem, method, size)
        frames = size.orbits * FRAMES_PER_ORBIT
        each = max(1, round(spent / method.promises.evaluations / frames))
        steps = each * frames
        change = lambda t, state: energy.total(problem.scene, t, state) / start - 1  # noqa: E731
        equal = simulate(
            problem.scene, method, dt=problem.duration / steps, steps=steps, save_every=each, record=change
        )
        follows = simulate(problem.scene, chooser, dt=problem.duration / frames, steps=frames, record=change)
        found[method.__name__] = {"equal": np.asarray(equal.recorded)[1:], "adaptive": np.asarray(follows.recorded)[1:]}
        print_progress(f"  {method.__name__}: {steps} equal steps, {spent} evaluations under error control")
    return found


def match_cost(problem: Problem, method: Callable, size: Settings) -> tuple[Callable, int]:
    """The method under error control with the tolerance at which it costs about as many evaluations as equal steps."""
    low, high = -12.0, -2.0
    goal, frames = size.orbits * size.per_orbit, size.orbits * FRAMES_PER_ORBIT
    for _ in range(10):
        middle = (low + high) / 2
        chooser = methods.adaptive(method, 10.0**middle, 10.0**middle)
        counted = methods.count_steps(problem.scene, chooser, dt=problem.duration / frames, steps=frames)
        spent = STEPS_PER_ATTEMPT * method.promises.evaluations * int((counted.accepted + counted.rejected).sum())
        low, high = (middle, high) if spent > goal or not counted.ok.all() else (low, middle)
    return chooser, spent


def drift(change: np.ndarray) -> float:
    """By how much the mean energy of the last tenth of a run differs from that of its first: 0 if it only oscillates."""
    parts = np.array_split(change, 10)
    return float(abs(parts[-1].mean() - parts[0].mean()))


def draw(path: Path, rows: list[dict], found: dict, size: Settings, foot: str) -> None:
    """Error against evaluations, and energy over orbits."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    looks = {"rk4": ("rk4", "o--"), "adaptive rk4": ("rk4", "s-"), "adaptive verlet": ("verlet", "s-")}
    looks |= {f"adaptive {name}": (name, "s-") for name in ("tsit5", "dopri8", "dprkn6")}
    for name, (colour, line) in looks.items():
        points = sorted((r["evaluations"], r["error"]) for r in rows if r["method"] == name)
        label = name if name.startswith("adaptive") else f"{name}, equal steps"
        left.loglog(*zip(*points, strict=True), line, color=COLOURS[colour], label=label)
    left.set(xlabel="evaluations of the force", ylabel="error at the end [m]", title="two orbits of eccentricity 0.9")
    left.legend(frameon=False)
    left.grid(alpha=0.3)
    for name, runs in found.items():
        for kind, line in (("equal", "--"), ("adaptive", "-")):
            worst = np.abs(runs[kind]).reshape(size.orbits, FRAMES_PER_ORBIT).max(axis=-1)
            label = f"{name}, {'equal steps' if kind == 'equal' else 'adaptive'}"
            right.loglog(np.arange(1, size.orbits + 1), worst, line, color=COLOURS[name], label=label)
    right.set(xlabel="orbit", ylabel="largest relative change of energy", title="eccentricity 0.6, at equal cost")
    right.legend(frameon=False, fontsize=8)
    right.grid(alpha=0.3)
    figure.supxlabel(foot, fontsize=8, x=0.01, ha="left")
    with write_atomically(path, "wb") as file:
        figure.savefig(file, format="png", dpi=150)


def main() -> None:
    """Run all studies, print their tables, write the record and the chart."""
    quick, folder = harness.parse_options(__doc__)
    size, about = QUICK if quick else FULL, harness.describe_machine()
    with jax.enable_x64(True):
        print_progress("error against evaluations")
        rows = measure_work_and_error(size)
        print_progress("energy over many orbits")
        found = compare_energies(size)
    drifts = {name: {kind: drift(change) for kind, change in runs.items()} for name, runs in found.items()}
    share = interpolate_evaluations(rows, "adaptive rk4") / interpolate_evaluations(rows, "rk4")
    pairs = interpolate_evaluations(rows, "adaptive dprkn6") / interpolate_evaluations(rows, "adaptive tsit5")
    drift_ratio = min(drifts[name]["adaptive"] / drifts[name]["equal"] for name in SYMPLECTIC)
    names = {row["method"] for row in rows if "tries" in row}
    count = lambda name, what: sum(row[what] for row in rows if row["method"] == name)  # noqa: E731
    rejected = max(count(name, "rejected") / count(name, "tries") for name in names)
    bars = [
        Bar("evaluations at an error of 1e-6, adaptive / equal steps of rk4", share, "<=", 1 / 3),
        Bar("evaluations at an error of 1e-6, the Nyström pair / tsit5", pairs, "<=", 1 / 2),
        Bar("largest share of rejected steps, of a method at all tolerances", rejected, "<=", 0.05),
        Bar("drift of energy of symplectic methods, adaptive / equal steps [times]", drift_ratio, ">=", 10.0),
    ]
    print(harness.format_caption(about))
    cells = [[r["method"], r.get("tolerance", "-"), r["error"], r["evaluations"], r.get("rejected", "-")] for r in rows]
    harness.print_table(
        "eccentricity 0.9, two orbits", ["", "tolerance", "error [m]", "evaluations", "rejected"], cells
    )
    cells = [[name, runs["equal"], runs["adaptive"]] for name, runs in drifts.items()]
    title = f"drift of the energy over {size.orbits} orbits, relative"
    harness.print_table(title, ["", "equal", "adaptive"], cells)
    harness.print_bars(bars, quick)
    record = {"benchmark": "adaptive", "quick": quick, "machine": about, "settings": size._asdict()}
    record |= {"work_and_error": rows, "drift_of_energy": drifts}
    record["bars"] = [bar._asdict() | {"met": bar.met} for bar in bars]
    written, drawn = (harness.result_path(folder, "adaptive", quick, ending) for ending in ("json", "png"))
    harness.write_json(written, record)
    draw(drawn, rows, found, size, harness.format_caption(about))
    print(f"\nwritten: {written} and {drawn.name}")


if __name__ == "__main__":
    main()
