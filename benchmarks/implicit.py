"""Implicit methods on a stiff cloth: what a frame costs, what accuracy a second buys, and what is left of a swing.

    python benchmarks/implicit.py [--quick] [--out DIR]

The cloth of T. Liu et al., "Fast simulation of mass-spring systems" (2013): 81 × 81 nodes, 1 m square, 1 kg, k = 1000 N/m
structural and shear, 100 bend, two corners pinned, 60 frames a second, float32. (a) the first 90 frames one by one by
implicit Euler at a relative residual of 1e-3; (b) the linear system of a frame by our conjugate gradients and by lineax's,
to the same 2-norm, and its full equation by our Newton method and by optimistix's, in float64: in float32 the rounding
of the forces is larger than that; (c) error after a quarter of a second against time, for implicit Euler at 1/60 s and
shorter, and explicit methods from their largest stable step down; (d) the same cloth hung by its upper edge, at rest but
for an angle of 0.3 rad, in float64: the energy of the swing after each period, and the time of a step, by implicit Euler,
the implicit midpoint rule and TR-BDF2, linearised once and converged, at multiples of verlet's stable step.
All run on one core if the process may use one (taskset -c 0).
"""

import math
import statistics
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import harness
import jax
import jax.numpy as jnp
import numpy as np
from harness import Bar, Missing, print_progress
from jax.typing import DTypeLike

from physjax import Particles, Scene, forces, lattices, methods, simulate
from physjax.files import write_atomically
from physjax.stepping.implicit import ImplicitEuler
from physjax.stepping.krylov import conjugate_gradients
from physjax.stepping.reference import cast_floats
from physjax.study.energy.quantities import total
from physjax.timing import time_call, time_repeatedly

DT, RESIDUAL_TOLERANCE = 1 / 60, 1e-3
GAME_METHOD = ImplicitEuler(tolerance=RESIDUAL_TOLERANCE)
SWING_ANGLE, GROWN, SWING_TOLERANCE = 0.3, 1.1, 1e-4
"""The cloth is let go at this angle [rad]; a run has failed when its swing has grown to so many times its energy."""
CHAIN_MODE = 2.404825557695773 / 2
"""ω√(L/g) of the slowest swing of a hanging sheet, half of the first zero of the Bessel function J₀."""
SWINGERS = {
    name: kind(tolerance=SWING_TOLERANCE, newton=newton)
    for name, kind, newton in (
        ("implicit Euler", methods.ImplicitEuler, 0),
        ("implicit midpoint", methods.ImplicitMidpoint, 0),
        ("implicit midpoint, converged", methods.ImplicitMidpoint, 20),
        ("TR-BDF2", methods.TrBdf2, 0),
        ("TR-BDF2, converged", methods.TrBdf2, 20),
    )
}
LIU_FRAME_MS = {"their fast solver": 50.0, "Newton": 13_000.0}
"""What Liu et al. report for a frame [ms], on their machine."""
COLOURS = {"implicit_euler": "#0072B2", "semi_implicit_euler": "#E69F00", "rk4": "#009E73"}


class Settings(NamedTuple):
    """Sizes of the runs."""

    side: int
    frames: int
    horizon: int
    refinements: int
    repeats: int
    swing_steps: int
    swing_multiples: tuple[float, ...]


FULL = Settings(81, 90, 15, 5, 5, 1000, (5.0, 20.0, 100.0))
QUICK = Settings(17, 6, 3, 2, 1, 120, (20.0, 100.0))


def build_cloth(side: int, dtype: DTypeLike = np.float32) -> Scene:
    """The cloth, with its weight."""
    sheet = lattices.cloth(1.0, 1.0, side, side, mass=1.0, structural=1000.0, shear=1000.0, bend=100.0)
    state = Particles(*(jnp.asarray(leaf, dtype) for leaf in sheet.state))
    pinned = sheet.nodes["top"] & sheet.nodes["corners"]
    return Scene(state, mass=sheet.mass, forces=(forces.Gravity(), sheet.springs), pinned=pinned)


def time_frames(scene: Scene, frames: int) -> tuple[list[float], list[int], list[float], Scene]:
    """Seconds, matrix products and relative residual of each frame, each called separately; the scene half way through."""
    step = partial(simulate, method=GAME_METHOD, dt=DT, steps=1)
    jax.block_until_ready(step(scene).state)
    seconds, products, residuals, middle = [], [], [], scene
    for i in range(frames):
        flight, taken = time_call(partial(step, scene, first_step=i))
        after = flight.final_scene
        seconds.append(taken)
        report = GAME_METHOD.report(scene, DT)
        products.append(int(report.products))
        residuals.append(float(report.residual))
        scene = after
        if i == frames // 6:
            middle = scene
    return seconds, products, residuals, middle


def build_system(scene: Scene) -> tuple[Callable, jax.Array]:
    """The matrix of a linearised step, as a function, and its right-hand side; nodes are equally heavy."""
    linearised = scene.linearised_at(DT, scene.state)
    x, v = scene.state
    a, push = jax.linearize(lambda x, v: linearised.acceleration(DT, Particles(x, v)), x, v)
    return lambda u: u - DT * push(DT * u, u), DT * (a + push(DT * v, jnp.zeros_like(v)))


def build_linear_contenders(scene: Scene) -> dict[str, Callable]:
    """The linear system of a step to the same residual, by ours, by lineax's and by a round of optimistix's Newton method."""
    lx, optx = harness.import_optional("lineax"), harness.import_optional("optimistix")
    two_norm = lambda r: jnp.sqrt(jnp.sum(r * r))  # noqa: E731
    inner = lambda a, b: jnp.sum(a[0] * b[0])  # noqa: E731

    def build_run(solve):
        """The solution with its residual, found by the program that knows the matrix: rounding makes another one of it."""

        @jax.jit
        def run(scene):
            matvec, b = build_system(scene)
            u = solve(matvec, b)
            r = b - matvec(u)
            return u, jnp.sqrt(jnp.sum(r * r) / jnp.sum(b * b))

        return partial(run, scene)

    def ours(matvec, b):
        return conjugate_gradients(lambda u: [matvec(u[0])], [b], inner, RESIDUAL_TOLERANCE, 1000)[0][0]

    def lineax(matvec, b):
        size = two_norm(b)
        operator = lx.FunctionLinearOperator(
            matvec, jax.ShapeDtypeStruct(b.shape, b.dtype), lx.positive_semidefinite_tag
        )
        # its relative tolerance is meant entry by entry: an absolute one, and a right-hand side of norm 1
        solver = lx.CG(rtol=0.0, atol=RESIDUAL_TOLERANCE, norm=two_norm, max_steps=1000)
        return size * lx.linear_solve(operator, b / size, solver, throw=False).value

    def optimistix(matvec, b):
        size = two_norm(b)
        solver = lx.CG(rtol=0.0, atol=RESIDUAL_TOLERANCE, norm=two_norm, max_steps=1000)
        newton = optx.Newton(rtol=1.0, atol=1.0, norm=two_norm, linear_solver=solver)
        tags = frozenset({lx.positive_semidefinite_tag})
        residual = lambda u, _: matvec(u) - b / size  # noqa: E731
        found = optx.root_find(residual, newton, jnp.zeros_like(b), max_steps=1, throw=False, tags=tags)
        return size * found.value

    return {
        "physjax, conjugate gradients": build_run(ours),
        "lineax, CG": build_run(lineax),
        "optimistix, a Newton step with CG": build_run(optimistix),
    }


def build_newton_contenders(scene: Scene) -> dict[str, Callable]:
    """The full equation of a step, u = dt a(x + dt (v + u), v + u), to the same residual, by ours and by optimistix."""
    lx, optx = harness.import_optional("lineax"), harness.import_optional("optimistix")
    two_norm = lambda r: jnp.sqrt(jnp.sum(r * r))  # noqa: E731
    converged = ImplicitEuler(tolerance=RESIDUAL_TOLERANCE, newton=20)

    def residual(u, scene):
        x, v = scene.state
        return u - DT * scene.acceleration(DT, Particles(x + DT * (v + u), v + u))

    def measured(solve):
        @jax.jit
        def run(scene):
            u = solve(scene)
            return u, two_norm(residual(u, scene)) / two_norm(residual(jnp.zeros_like(u), scene))

        return partial(run, scene)

    def ours(scene):
        return converged(scene, 0.0, scene.state, jnp.asarray(DT, scene.state.dtype)).velocity - scene.state.velocity

    def theirs(rounds):
        def solve(scene):
            start = jnp.zeros_like(scene.state.velocity)
            size = two_norm(residual(start, scene))
            # three digits of the first residual in each linear system, as ours; stopped by the number of rounds alone
            linear = lx.BiCGStab(rtol=0.0, atol=RESIDUAL_TOLERANCE, norm=two_norm, max_steps=1000)
            newton = optx.Newton(rtol=1e-12, atol=1e-12, norm=two_norm, linear_solver=linear)
            scaled = lambda u, scene: residual(u, scene) / size  # noqa: E731
            return optx.root_find(scaled, newton, start, scene, max_steps=rounds, throw=False).value

        return measured(solve)

    # as few rounds as reach the residual, or its best
    tries = {rounds: theirs(rounds) for rounds in range(1, 9)}
    found = {rounds: float(run()[1]) for rounds, run in tries.items()}
    reached = [rounds for rounds, r in found.items() if r <= RESIDUAL_TOLERANCE] or [
        min(found, key=lambda rounds: found[rounds])
    ]
    print_progress(f"  optimistix reaches {found[reached[0]]:.1e} in {reached[0]} rounds")
    return {"physjax, ImplicitEuler(newton=20)": measured(ours), "optimistix, Newton": tries[reached[0]]}


def race(contenders: dict[str, Callable], goal: float, repeats: int) -> list[dict]:
    """Milliseconds and residual of each contender; one that failed says why."""
    rows, found = [], {}
    timings, failed = harness.time_side_by_side(
        contenders, repeats, lambda name, run: found.update({name: float(run[1])})
    )
    for name, timing in timings.items():
        row = {"name": name, "ms": 1e3 * timing.least, "median_ms": 1e3 * timing.median, "residual": found[name]}
        rows.append(row | {"converged": found[name] <= 1.5 * goal, "first_call_s": timing.first})
    return rows + [{"name": name, "failed": why} for name, why in failed.items()]


def find_largest_frequency(scene: Scene) -> float:
    """ω of the fastest oscillation at rest [rad/s], by 300 rounds of the power method."""
    x, v = scene.state

    @jax.jit
    def power(start):
        _, push = jax.linearize(lambda x: scene.acceleration(0.0, Particles(x, v)), x)

        def turn(_, carry):
            y, _ = carry
            z = -push(y)
            size = jnp.sqrt(jnp.sum(z * z))
            return z / size, size

        return jax.lax.fori_loop(0, 300, turn, (start / jnp.sqrt(jnp.sum(start * start)), jnp.zeros((), x.dtype)))[1]

    start = np.random.default_rng(0).normal(size=x.shape) * ~np.asarray(scene.pinned)[:, None]
    return math.sqrt(float(power(jnp.asarray(start, x.dtype))))


def compute_truth(size: Settings, omega: float) -> np.ndarray:
    """Positions at the horizon by rk4 in float64 at a quarter of its largest stable step."""
    with jax.enable_x64(True):
        scene = build_cloth(size.side, np.float64)
        steps = size.horizon * math.ceil(DT * omega / 0.7)
        return np.asarray(simulate_final(scene, methods.rk4, steps, size))


def simulate_final(scene: Scene, method: Callable, steps: int, size: Settings) -> jax.Array:
    """Positions at the horizon after `steps` steps."""
    run = simulate(scene, method, dt=size.horizon * DT / steps, steps=steps, save_every=steps)
    return run.final_scene.state.position


def measure_work_and_error(scene: Scene, size: Settings, omega: float) -> list[dict]:
    """Error after the horizon and time of a frame, for each method from its longest useful step down."""
    exact = compute_truth(size, omega)
    coarsest = {
        "implicit_euler": 1,
        "semi_implicit_euler": math.ceil(DT * omega / 1.9),
        "rk4": math.ceil(DT * omega / 2.7),
    }
    rows = []
    for name, fewest in coarsest.items():
        method = GAME_METHOD if name == "implicit_euler" else getattr(methods, name)
        for n in [fewest * 2**i for i in range(size.refinements if name == "implicit_euler" else 3)]:
            run = partial(simulate_final, scene, method, n * size.horizon, size)
            found, timing = time_repeatedly(run, size.repeats, longest=math.inf)
            error = float(np.sqrt(np.mean((np.asarray(found, float) - exact) ** 2)))
            ms = 1e3 * timing.least / size.horizon
            rows.append({"method": name, "steps_a_frame": n, "error": error, "ms": ms})
            print_progress(f"  {name}, {n} steps a frame: {ms:.2f} ms a frame, error {error:.2e} m")
    return rows


def build_swing(side: int) -> tuple[Scene, Scene]:
    """The cloth hung by its upper edge, at rest, and the same turned about the edge; as stiff as 81 × 81 nodes."""
    stiff = {"structural": 1000.0, "shear": 1000.0, "bend": 100.0}
    sheet = lattices.cloth(1.0, 1.0, side, side, mass=1.0, **{name: k * (81 / side) ** 2 for name, k in stiff.items()})
    mass = jnp.asarray(sheet.mass)
    hanging = Scene(sheet.state, mass, (forces.Gravity(), sheet.springs), pinned=sheet.nodes["top"])
    damped = hanging.replace(forces=(*hanging.forces, forces.StokesDrag(20.0 * mass)))
    x = simulate(damped, ImplicitEuler(tolerance=1e-6), dt=0.05, steps=80, save_every=80).position[-1]
    c, s = math.cos(SWING_ANGLE), math.sin(SWING_ANGLE)
    turned = jnp.stack([x[:, 0], c * x[:, 1], -s * x[:, 1]], axis=-1)
    return tuple(hanging.replace(state=Particles(y, jnp.zeros_like(y))) for y in (x, turned))


def measure_swings(size: Settings) -> list[dict]:
    """The energy of the swing after each period and the median time of a step, by each method at each multiple."""
    with jax.enable_x64(True):
        rest, swinging = build_swing(size.side)
        energy = jax.jit(lambda scene: total(scene, 0.0, scene.state))
        low, start = float(energy(rest)), float(energy(swinging))
        limit = 2 / find_largest_frequency(rest)
        rows = []
        for times in size.swing_multiples:
            for name, method in SWINGERS.items():
                shares, seconds = follow_swing(swinging, method, times * limit, size.swing_steps, energy)
                shares = (np.asarray(shares) - low) / (start - low)
                period = 2 * math.pi / (CHAIN_MODE * math.sqrt(9.8)) / (times * limit)
                at = [round(i * period) for i in range(1, 1 + int(len(shares) / period))]
                kept = [float(shares[i - 1]) for i in at]
                failed = bool(len(shares) < size.swing_steps or np.max(shares) > GROWN)
                row = {"method": name, "multiple": times, "ms": 1e3 * statistics.median(seconds), "failed": failed}
                rows.append(row | {"steps": len(shares), "kept": kept, "shares": shares.tolist()})
                after = f"{kept[0]:.4f} after a period" if kept else f"{shares[-1]:.4f} at the end"
                print_progress(f"  {name} at {times:g}: {row['ms']:.1f} ms, {'failed' if failed else after}")
    return rows


def judge_swings(rows: list[dict]) -> list[Bar]:
    """What is asked of the methods of second order, where a period was run."""
    found = {(row["method"], row["multiple"]): row for row in rows}
    bars = []
    for name, times in (("TR-BDF2, converged", 100.0), ("implicit midpoint, converged", 20.0)):
        kept = [1.0, *found[name, times]["kept"]]
        lost = [1 - after / before for before, after in pairwise(kept)]
        if lost:
            bars.append(Bar(f"{name} at {times:g}, most of a swing lost in a period", max(lost), "<=", 0.01))
        bars.append(Bar(f"{name} at {times:g}, failed", float(found[name, times]["failed"]), "<=", 0.0))
    for name, times in (("TR-BDF2", 100.0), ("implicit midpoint", 20.0)):
        ratio = found[name, times]["ms"] / found["implicit Euler", times]["ms"]
        bars.append(Bar(f"{name} at {times:g}, median step / implicit Euler's", ratio, "<=", 1.5))
    return bars


def follow_swing(
    scene: Scene, method: Callable, dt: float, steps: int, energy: Callable
) -> tuple[list[float], list[float]]:
    """Energy [J] after each step, called separately, and its time [s], until it has grown beyond what can be the swing."""
    step = partial(simulate, method=method, dt=dt, steps=1)
    jax.block_until_ready(step(scene).state)
    energies, seconds, first = [], [], float(energy(scene))
    for _ in range(steps):
        flight, taken = time_call(partial(step, scene))
        scene = flight.final_scene
        energies.append(float(energy(scene)))
        seconds.append(taken)
        if not energies[-1] < first + 10:  # joules, of a swing of 0.2
            break
    return energies, seconds


def draw_swings(axes, rows: list[dict]) -> None:
    """The energy of the swing against the number of steps, at the largest multiple."""
    largest = max(row["multiple"] for row in rows)
    for row in rows:
        if row["multiple"] == largest:
            axes.plot(np.clip(row["shares"], 0, 1.5), label=row["method"] + (" (failed)" if row["failed"] else ""))
    axes.set(xlabel="step", ylabel="energy of the swing [share]", ylim=(0, 1.3))
    axes.set_title(f"a swing of 0.3 rad at {largest:g} times verlet's step")
    axes.legend(frameon=False, fontsize=8)


def draw(path: Path, seconds: list[float], rows: list[dict], swings: list[dict], size: Settings, foot: str) -> None:
    """Frames by their time, error against time, and what is left of a swing."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(16, 4.6), layout="constrained")
    left, right, last = figure.subplots(1, 3)
    draw_swings(last, swings)
    ms = 1e3 * np.asarray(seconds)
    left.plot(
        np.arange(1, len(ms) + 1), ms, color=COLOURS["implicit_euler"], label="implicit_euler at 1/60 s, residual 1e-3"
    )
    left.axhline(np.median(ms), color="black", linewidth=0.8, linestyle="--", label=f"median {np.median(ms):.1f} ms")
    left.set(
        xlabel="frame", ylabel="time of a frame [ms]", ylim=(0, None), title=f"{size.side} × {size.side} cloth, float32"
    )
    left.legend(frameon=False)
    for name, colour in COLOURS.items():
        points = [(row["ms"], row["error"], row["steps_a_frame"]) for row in rows if row["method"] == name]
        points = [point for point in points if math.isfinite(point[1])]
        right.loglog(*zip(*[p[:2] for p in points], strict=True), "o-", color=colour, label=name)
        for x, y, n in points:
            right.annotate(f"{n}", (x, y), textcoords="offset points", xytext=(5, 5), fontsize=8, color=colour)
    right.set(xlabel="time of a frame [ms]", ylabel=f"rms error of position after {size.horizon * DT:.3g} s [m]")
    right.set_title("error against time; numbers: steps a frame")
    right.grid(alpha=0.3)
    right.legend(frameon=False)
    figure.supxlabel(foot, fontsize=8, x=0.01, ha="left")
    with write_atomically(path, "wb") as file:
        figure.savefig(file, format="png", dpi=150)


def main() -> None:
    """Run all studies, print their tables, write the record and the chart."""
    quick, folder = harness.parse_options(__doc__)
    size, about = QUICK if quick else FULL, harness.describe_machine()
    print_progress(harness.format_caption(about))
    scene = build_cloth(size.side)
    print_progress("frames")
    seconds, products, residuals, middle = time_frames(scene, size.frames)
    print_progress("linear system")
    races, missing = {}, {}
    try:
        races["linear system"] = race(build_linear_contenders(middle), RESIDUAL_TOLERANCE, size.repeats)
        with jax.enable_x64(True):
            races["full equation"] = race(
                build_newton_contenders(cast_floats(middle, jnp.float64)), RESIDUAL_TOLERANCE, size.repeats
            )
    except Missing as reason:
        missing["others"] = str(reason)
    print_progress("error against time")
    omega = find_largest_frequency(scene)
    rows = measure_work_and_error(scene, size, omega)

    print_progress("swings")
    swings = measure_swings(size)

    median = 1e3 * statistics.median(seconds)
    allowed = 75.0 if jax.__version_info__ < (0, 11) else 50.0
    bars = [
        Bar("median of the frames [ms]", median, "<=", allowed),
        Bar("largest relative residual of a frame", max(residuals), "<=", RESIDUAL_TOLERANCE),
    ]
    bars += judge_swings(swings)
    for name, entries in races.items():
        ours, *others = entries
        if not ours["converged"]:
            raise SystemExit(f"physjax did not converge: {ours}")
        good = [other for other in others if other.get("converged")]
        bars += [Bar(f"{name}, {other['name']} / ours [times]", other["ms"] / ours["ms"], ">=", 1.3) for other in good]

    print(harness.format_caption(about))
    print(
        f"frames: median {median:.1f} ms, {statistics.median(products)} products; Liu et al. report {LIU_FRAME_MS} ms"
    )
    for name, entries in races.items():
        cells = [[e["name"], e["ms"], e["median_ms"], e["residual"], e["first_call_s"]] for e in entries if "ms" in e]
        harness.print_table(name, ["", "best [ms]", "median [ms]", "residual", "first call [s]"], cells)
    cells = [[row["method"], row["steps_a_frame"], row["ms"], row["error"]] for row in rows]
    harness.print_table(
        f"error against time, ω = {omega:.0f} rad/s", ["", "steps a frame", "ms a frame", "error [m]"], cells
    )
    cells = [
        [
            r["method"],
            r["multiple"],
            r["ms"],
            r["steps"],
            "failed" if r["failed"] else "stable",
            str(np.round(r["kept"][:4], 4)),
        ]
        for r in swings
    ]
    harness.print_table("swings", ["", "times verlet's step", "ms a step", "steps", "", "kept after periods"], cells)
    harness.print_bars(bars, quick)
    for name, reason in missing.items():
        print(f"left out: {name}, {reason}")
    record = {
        "benchmark": "implicit",
        "quick": quick,
        "machine": about,
        "settings": size._asdict(),
        "reported_ms": LIU_FRAME_MS,
    }
    record |= {"seconds": seconds, "products": products, "residuals": residuals, "races": races, "left_out": missing}
    record |= {"largest_frequency": omega, "error_against_time": rows, "swings": swings}
    record["bars"] = [bar._asdict() | {"met": bar.met} for bar in bars]
    written, drawn = (harness.result_path(folder, "implicit", quick, ending) for ending in ("json", "png"))
    harness.write_json(written, record)
    draw(drawn, seconds, rows, swings, size, harness.format_caption(about))
    print(f"\nwritten: {written} and {drawn.name}")


if __name__ == "__main__":
    main()
