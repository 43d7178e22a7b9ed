"""A million shots: `sweep` against the bare `simulate`, a Python loop over SciPy, and diffrax under vmap.

    python benchmarks/sweep.py [--quick] [--out DIR]

A ball with quadratic drag, 1000 speeds by 1000 angles, 400 steps of rk4 in float32, where it is after 4 s. The bare run is
one scene of a million lanes; the sweep measures one ball, in memory and into a folder. The competitors are given the largest
tolerance at which their worst error, on a thousand of the shots, is no more than that of the sweep: SciPy's `solve_ivp`
(RK45, float64) flies these thousand one by one, from which a million is extrapolated, and diffrax (Tsit5, adaptive,
float32) a hundred thousand in one `vmap`. What two CPU devices
on two cores gain over one on one core, and the memory that batches take of a budget of 128 MiB, with a hundred frames a
lane, are measured in processes of their own, which choose their cores by themselves.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import harness
import jax
import jax.numpy as jnp
import numpy as np
from harness import Bar, print_progress
from scipy.integrate import solve_ivp

from physjax import Particles, Scene, forces, methods, ode_term, reference, simulate, sweep

STEPS, DT = 400, 0.01
AREA, DRAG, DENSITY, MASS, G = 4.3e-3, 0.35, 1.225, 0.145, 9.8
BUDGET_BYTES = 128 << 20
"""Memory that the measured sweep may take [bytes]."""
TOLERANCES = (1e-3, 3e-4, 1e-4, 3e-5, 1e-5, 3e-6, 1e-6, 3e-7, 1e-7)
OURS, OTHER, PLAIN = harness.COLOURS
FAMILIES = {OURS: "physjax", OTHER: "diffrax", PLAIN: "SciPy"}
PLANNED_LANES = 10**8
"""Lanes that are planned on paper."""


class Settings(NamedTuple):
    """Sizes of the runs."""

    points: int
    rival_points: int
    few: int
    repeats: int


FULL, QUICK = Settings(1000, 316, 1000, 5), Settings(100, 30, 20, 1)


def build_axes(points: int) -> dict[str, np.ndarray]:
    """Speeds [m/s] and angles [rad]."""
    return {
        "speed": np.linspace(10, 50, points, dtype=np.float32),
        "angle": np.linspace(0.1, 1.4, points, dtype=np.float32),
    }


def build_shot(speed: jax.Array, angle: jax.Array) -> Scene:
    """Balls thrown from the origin."""
    launch = speed[..., None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    drag = forces.QuadraticDrag(area=AREA, coefficient=DRAG, density=DENSITY)
    return Scene(Particles(jnp.zeros_like(launch), launch), mass=MASS, forces=(forces.Gravity(G), drag))


def fly_to_end(speed: jax.Array, angle: jax.Array) -> jax.Array:
    """Where a ball is after the flight [m]."""
    flight = simulate(build_shot(speed, angle), methods.rk4, dt=DT, steps=STEPS, save_every=STEPS)
    return flight.final_scene.state.position


def find_apex(speed: jax.Array, angle: jax.Array) -> jax.Array:
    """The greatest height [m] of a hundred frames, which all lanes at once could not keep."""
    flight = simulate(build_shot(speed, angle), methods.rk4, dt=DT, steps=STEPS, save_every=STEPS // 100)
    return jnp.max(flight.position[:, 1])


def run_sweep(points: int, **options: Any) -> np.ndarray:
    """The places by `sweep`."""
    return sweep(fly_to_end, build_axes(points), progress=False, **options).values.reshape(-1, 2)


def sweep_into_folder(points: int) -> np.ndarray:
    """The same into a folder, and read from there."""
    with tempfile.TemporaryDirectory() as folder:
        return run_sweep(points, out=folder)


def run_diffrax(speed: jax.Array, angle: jax.Array, tolerance: jax.Array) -> jax.Array:
    """The places by diffrax."""

    @jax.vmap
    def one(speed, angle):
        scene = build_shot(speed, angle)
        end = diffrax.diffeqsolve(
            ode_term(scene),
            diffrax.Tsit5(),
            t0=0.0,
            t1=STEPS * DT,
            dt0=None,
            y0=scene.state,
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
            max_steps=4096,
            throw=False,
        )
        return end.ys.position[-1]

    return one(speed, angle)


def run_scipy(speed: np.ndarray, angle: np.ndarray, tolerance: float) -> np.ndarray:
    """The places by a loop over `solve_ivp`."""

    def rate(t, y):
        pull = -0.5 * DENSITY * DRAG * AREA / MASS * np.sqrt(y[2] * y[2] + y[3] * y[3])
        return y[2], y[3], pull * y[2], pull * y[3] - G

    starts = [(0.0, 0.0, s * np.cos(a), s * np.sin(a)) for s, a in zip(speed, angle, strict=True)]
    return np.array([solve_ivp(rate, (0, STEPS * DT), y, rtol=tolerance, atol=tolerance).y[:2, -1] for y in starts])


def worst_error(found: np.ndarray, truth: np.ndarray) -> float:
    """The largest distance from the reference solution [m]."""
    return float(np.sqrt(((np.asarray(found, float) - truth) ** 2).sum(-1)).max())


def match_tolerance(fly: Callable[[float], np.ndarray], truth: np.ndarray, allowed: float) -> tuple[float, float]:
    """The largest tolerance whose worst error is allowed, or else the one of the least error; and that error [m]."""
    tried = [(tolerance, worst_error(fly(tolerance), truth)) for tolerance in TOLERANCES]
    return next((one for one in tried if one[1] <= allowed), min(tried, key=lambda one: one[1]))


def run_alone(task: str, *, points: int, devices: int, repeats: int) -> list[float]:
    """The numbers of a `--task` in a process of its own."""
    given = {"points": points, "devices": devices, "repeats": repeats}
    command = [sys.executable, __file__, "--task", task, json.dumps(given)]
    run = subprocess.run(command, check=True, capture_output=True, text=True)
    return [float(number) for number in run.stdout.split()]


def time_devices(points: int, repeats: int) -> tuple[float, ...]:
    """The least times of a sweep on one device on one core, and on two devices on two cores, taken in turn [s]."""
    mine = sorted(os.sched_getaffinity(0))
    cores = [*mine, *(core for core in range(os.cpu_count() or 1) if core not in mine)]
    taken = {1: [], 2: []}
    for _ in range(1 + repeats):  # the first pays for the compilations
        for count, times in taken.items():
            for thread in os.listdir("/proc/self/task"):
                os.sched_setaffinity(int(thread), cores[:count])
            times.append(harness.time_call(partial(run_sweep, points, devices=jax.local_devices()[:count])))
    return tuple(min(times[1:]) for times in taken.values())


def measure_memory(points: int, repeats: int) -> tuple[float]:
    """Memory that a sweep into a folder takes at its highest, its compilation included [bytes]."""
    with tempfile.TemporaryDirectory() as folder:
        sweep(fly_to_end, build_axes(10), progress=False, out=Path(folder) / "first")  # what any sweep loads
        Path("/proc/self/clear_refs").write_text("5")  # forget the highest so far
        before = _read_status("VmRSS")
        sweep(find_apex, build_axes(points), progress=False, memory=BUDGET_BYTES, out=Path(folder) / "measured")
        return (_read_status("VmHWM") - before,)


def _read_status(field: str) -> float:
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(field))
    return 1024 * float(line.split()[1])


def count_changed_lanes(points: int) -> int:
    """Good lanes of a sweep with 1 % of NaN whose bits differ from those of the clean sweep."""
    grid = np.stack([a.ravel() for a in np.meshgrid(*build_axes(points).values(), indexing="ij")])
    lanes = grid.shape[1]
    bad = np.random.default_rng(0).choice(lanes, lanes // 100, replace=False)
    dirty = grid.copy()
    dirty[0, bad] = np.nan
    clean, other = (sweep(fly_to_end, {"speed": s, "angle": a}, design="zip", progress=False) for s, a in (grid, dirty))
    if np.count_nonzero(~other.ok) != bad.size:
        raise SystemExit(f"{np.count_nonzero(~other.ok)} lanes are said to be bad, expected {bad.size}.")
    return int(np.any(clean.values != other.values, axis=-1)[other.ok].sum())


def main() -> None:
    """Run all contenders, print their tables, write the record and the chart."""
    quick, folder = harness.parse_options(__doc__)
    size, about = QUICK if quick else FULL, harness.describe_machine()
    print_progress(harness.format_caption(about))
    lanes, rivals = size.points**2, size.rival_points**2
    speed, angle = (a.ravel() for a in np.meshgrid(*build_axes(size.points).values(), indexing="ij"))
    some = np.linspace(0, lanes - 1, size.few).astype(int)
    fleet = jnp.asarray(speed), jnp.asarray(angle)
    part = jnp.asarray(speed[:: lanes // rivals][:rivals]), jnp.asarray(angle[:: lanes // rivals][:rivals])
    with jax.enable_x64(True):
        truth = reference(
            build_shot(jnp.asarray(speed[some], float), jnp.asarray(angle[some], float)), [0.0, STEPS * DT]
        )
    truth = np.asarray(truth.position[-1])
    with harness.record_compilations() as seen:
        ours = worst_error(run_sweep(size.points)[some], truth)
    compiled = len(seen)
    fly = jax.jit(run_diffrax)
    tolerance = {
        OTHER: match_tolerance(partial(fly, *(a[some] for a in fleet)), truth, ours),
        PLAIN: match_tolerance(partial(run_scipy, speed[some], angle[some]), truth, ours),
    }
    runs = {
        "simulate, one scene of all lanes": partial(fly_to_end, *fleet),
        "sweep": partial(run_sweep, size.points),
        "sweep into a folder": partial(sweep_into_folder, size.points),
        f"diffrax Tsit5, vmapped, {rivals:,} lanes": partial(fly, *part, tolerance[OTHER][0]),
        f"SciPy solve_ivp, a loop, {size.few} lanes": partial(run_scipy, speed[some], angle[some], tolerance[PLAIN][0]),
    }
    timings, failed = harness.time_side_by_side(runs, size.repeats)
    if failed:
        raise SystemExit(f"{failed}")
    counts, families = (lanes, lanes, lanes, rivals, size.few), (OURS, OURS, OURS, OTHER, PLAIN)
    rows = [
        harness.make_row(name, family, count, timing)
        for count, family, (name, timing) in zip(counts, families, timings.items(), strict=True)
    ]
    bare, rate, kept = (row["rate"] for row in rows[:3])
    print_progress("memory, two devices")
    (taken,) = run_alone("memory", points=size.points, devices=1, repeats=1)
    one, two = run_alone("seconds", points=size.points, devices=2, repeats=4 * size.repeats)
    bars = [
        Bar("sweep: share of the rate of the bare run", rate / bare, ">=", 0.7),
        Bar("sweep into a folder: share of the rate of the bare run", kept / bare, ">=", 0.7),
        Bar("sweep: compilations", compiled, "<=", 1),
        Bar("memory taken, in parts of the budget", taken / BUDGET_BYTES, "<=", 1.0),
        Bar("two devices on two cores: times faster than one on one", one / two, ">=", 1.6),
        Bar("lanes changed by 1 % of NaN lanes", count_changed_lanes(size.points), "<=", 0),
        Bar("sweep: times faster than diffrax at equal error", rate / rows[3]["rate"], ">=", 1.0),
        Bar("sweep: times faster than SciPy at equal error", rate / rows[4]["rate"], ">=", 1.0),
    ]
    accuracy = [
        ["sweep", "-", ours],
        ["diffrax", *(f"{number:.2g}" for number in tolerance[OTHER])],
        ["SciPy", *(f"{number:.2g}" for number in tolerance[PLAIN])],
    ]
    batch = 1 << 17
    paper = {
        "chunks": -(-PLANNED_LANES // batch),
        "disk_bytes": PLANNED_LANES * 10,
        "hours_on_one_core": PLANNED_LANES / kept / 3600,
        "solve_ivp_days": PLANNED_LANES / rows[4]["rate"] / 86400,
    }
    print(harness.format_caption(about))
    harness.print_rates(f"{lanes:,} shots of {STEPS} steps", "lanes a second", rows, "sweep")
    harness.print_table("Equal error", ["", "tolerance", "worst error [m]"], accuracy)
    harness.print_table(f"{PLANNED_LANES:,} lanes on paper", list(paper), [[f"{n:.4g}" for n in paper.values()]])
    harness.print_bars(bars, quick)
    record = {"benchmark": "sweep", "quick": quick, "machine": about, "settings": size._asdict(), "runs": rows}
    record["accuracy"] = accuracy
    record |= {
        "one_device_s": one,
        "two_devices_s": two,
        "memory_bytes": taken,
        "budget_bytes": BUDGET_BYTES,
        "paper": paper,
    }
    record["bars"] = [bar._asdict() | {"met": bar.met} for bar in bars]
    written, drawn = (harness.result_path(folder, "sweep", quick, ending) for ending in ("json", "png"))
    harness.write_json(written, record)
    title = f"{lanes:,} shots with quadratic drag, {STEPS} steps of rk4, float32; rivals at equal error"
    harness.draw_bar_chart(
        drawn, [(title, "lanes per second (logarithmic)", rows)], harness.format_caption(about), FAMILIES
    )
    print(f"\nwritten: {written} and {drawn.name}")


if __name__ == "__main__":
    if "--task" in sys.argv:
        given = json.loads(sys.argv[3])
        jax.config.update("jax_num_cpu_devices", given.pop("devices"))
        print(*{"seconds": time_devices, "memory": measure_memory}[sys.argv[2]](**given))
    else:
        main()
