"""How fast physjax is, next to diffrax, NumPy, C, numba and Warp doing the same work in the same run.

    python benchmarks/throughput.py [--quick] [--out DIR]

(a) 65 536 projectiles in space under gravity and quadratic drag, float32, classical Runge-Kutta, 200 steps;
(b) the same with a million lanes; (c) the mutual attraction of 4096 bodies, and its memory; (d) what a new scene costs
to compile, and that a changed number does not recompile; (e) what the import costs. All contenders of (a) must agree with
a float64 run to float32 rounding before any is timed. What is not installed is left out and named. Runs on whatever
device JAX has; C, NumPy and numba stay on the CPU and are labelled so. Needs the extra `bench` for numba and Warp.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import harness
import jax
import jax.numpy as jnp
import numpy as np
from harness import Bar, Missing, print_progress
from jax import lax
from rivals import (
    AREA,
    DRAG,
    DT,
    JAX,
    MASS,
    OURS,
    SOFTENING_LENGTH,
    Contender,
    F,
    build_throws,
    run_numpy_rk4,
    sample_shots,
    simulate_final,
    with_c,
    with_diffrax,
    with_numba,
    with_numpy,
    with_physjax,
    with_warp,
)

from physjax import Particles, Scene, forces, methods, simulate
from physjax.stepping.methods import METHODS


class Settings(NamedTuple):
    """Sizes of the runs."""

    lanes: int
    many: int
    steps: int
    bodies: int
    sizes: tuple[int, ...]
    repeats: int


FULL = Settings(65_536, 1_000_000, 200, 4096, (1024, 2048, 4096, 8192), 7)
QUICK = Settings(4096, 20_000, 20, 512, (128, 256, 512), 1)


def race_projectiles(size: Settings) -> tuple[list[dict], dict[str, str]]:
    """(a) and (b): rates in million particle-steps a second, and who is missing and why."""
    contenders, missing = [], {}
    for source in (with_physjax, with_diffrax, with_numpy, with_c, with_numba, with_warp):
        try:
            contenders += source(size.lanes, size.steps)
        except Missing as reason:
            missing[source.__name__.removeprefix("with_")] = str(reason)
    crowd = Contender(
        f"physjax rk4, {size.many:,} lanes",
        OURS,
        partial(simulate_final, build_throws(size.many), methods.rk4, size.steps),
    )
    truth = run_numpy_rk4(*(array.T.astype(float) for array in sample_shots(size.lanes)), size.steps)
    contenders = {who.name: who for who in (*contenders, crowd)}

    def check(name, found):
        if name == crowd.name:
            return
        found = np.asarray(found.numpy() if hasattr(found, "numpy") else found, float)
        allowed = (100 * np.finfo(F).eps if contenders[name].rk4 else 0.02) * abs(truth).max()
        if not abs(found - truth).max() <= allowed:
            raise SystemExit(f"{name} is off by {abs(found - truth).max():.3g} m, more than {allowed:.3g} m.")

    timings, failed = harness.time_side_by_side(
        {name: who.run for name, who in contenders.items()}, size.repeats, check
    )
    if any(contenders[name].family == OURS for name in failed):
        raise SystemExit(f"physjax failed: {failed}")
    rows = []
    for name, timing in timings.items():
        work = (size.many if name == crowd.name else size.lanes) * size.steps / 1e6
        rows.append(harness.make_row(name, contenders[name].family, work, timing))
    return rows, missing | failed


def compute_accelerations(scene: Scene) -> jax.Array:
    """The accelerations of a scene [m/s²]."""
    return scene.acceleration(0.0, scene.state)


def build_bodies(count: int) -> Scene:
    """Bodies of about unit mass in a ball of about unit size that attract each other, softened."""
    random = np.random.default_rng(3)
    x = jnp.asarray(random.normal(size=(count, 3)), F)
    attraction = forces.Gravitation(G=1.0, softening=SOFTENING_LENGTH)
    return Scene(
        Particles(x, jnp.zeros_like(x)), mass=jnp.asarray(random.uniform(0.5, 1.5, count), F), forces=(attraction,)
    )


def sum_dense(inverse_cube: Callable, x: jax.Array, mass: jax.Array) -> jax.Array:
    """The broadcast form: all differences x[None] - x[:, None] at once, `(n, n, 3)`."""
    d = x[None] - x[:, None]
    return jnp.sum((mass[None] * inverse_cube(jnp.sum(d * d, axis=-1) + SOFTENING_LENGTH**2))[..., None] * d, axis=1)


def race_gravitation(size: Settings) -> tuple[list[dict], dict[str, dict[int, int]]]:
    """(c): billion pairs a second, and temporary memory in bytes by the number of bodies."""
    scene, tiled = build_bodies(size.bodies), jax.jit(compute_accelerations)
    forms = {
        "dense broadcast, (r²)^(-3/2)": jax.jit(partial(sum_dense, lambda r2: r2**-1.5)),
        "dense broadcast, rsqrt": jax.jit(partial(sum_dense, lambda r2: lax.rsqrt(r2) * lax.rsqrt(r2) * lax.rsqrt(r2))),
    }
    runs = {"physjax Gravitation": partial(tiled, scene)}
    runs |= {name: partial(form, scene.state.position, scene.mass) for name, form in forms.items()}
    x, mass = (np.asarray(array, float) for array in (scene.state.position, scene.mass))
    truth = np.stack([(mass / (((x - here) ** 2).sum(-1) + SOFTENING_LENGTH**2) ** 1.5) @ (x - here) for here in x])

    def check(name, found):
        np.testing.assert_allclose(found, truth, rtol=0, atol=1e-5 * abs(truth).max(), err_msg=name)

    timings, _ = harness.time_side_by_side(runs, size.repeats, check)
    work = size.bodies**2 / 1e9
    rows = [
        harness.make_row(name, OURS if "physjax" in name else JAX, work, timing) for name, timing in timings.items()
    ]
    leap = jax.jit(lambda s: simulate(s, methods.leapfrog, dt=1e-3, steps=8, save_every=8).final_scene.state)
    memory = {"force": {}, "simulate": {}, "dense": {}}
    for count in size.sizes:
        scene = build_bodies(count)
        memory["force"][count] = harness.measure_temporary_bytes(tiled, scene)
        memory["simulate"][count] = harness.measure_temporary_bytes(leap, scene)
        memory["dense"][count] = harness.measure_temporary_bytes(
            forms["dense broadcast, (r²)^(-3/2)"], scene.state.position, scene.mass
        )
    return rows, memory


def time_compilation() -> list[dict]:
    """(d): the first run of a new scene under every method, and what compiles when only numbers change."""
    rows = []
    for name, method in METHODS.items():
        first, xla, recompiled = [], [], 0
        for lanes in (5, 6, 7):

            def run(dt=DT, speed=1.0, mass=MASS, wind=1.0, lanes=lanes, method=method):
                x, v = sample_shots(lanes)
                drag = forces.QuadraticDrag(area=AREA, coefficient=DRAG, wind=jnp.asarray([wind, 0, 0], F))
                scene = Scene(Particles(jnp.asarray(x), jnp.asarray(F(speed) * v)), mass, (forces.Gravity(), drag))
                return lambda: simulate(scene, method, dt=dt, steps=100, save_every=10).position

            with harness.record_compilations() as seen:
                first.append(harness.time_call(lambda run=run: run()()))
            xla.append(sum(seen))
            with harness.record_compilations() as seen:
                for changed in ({"dt": 0.5 * DT}, {"speed": 2.0}, {"mass": 3.0}, {"wind": -4.0}):
                    jax.block_until_ready(run(**changed)())
            recompiled += len(seen)
        rows.append({"method": name, "least": min(first), "most": max(first), "xla": min(xla), "anew": recompiled})
    return rows


def build_bars(rows: list[dict], pairs: list[dict], memory: dict, compiled: list[dict], imports: dict) -> list[Bar]:
    """The wanted rates against the measured ones; rates are those of the best turn."""
    flights, attraction = ({row["name"]: row["rate"] for row in table} for table in (rows, pairs))
    ours, crowd = flights["physjax rk4"], next(rate for name, rate in flights.items() if name.endswith("lanes"))
    vmapped, arrays, broadcast = (
        max(rate for name, rate in rates.items() if name.startswith(start))
        for rates, start in ((flights, "diffrax vmap"), (flights, "NumPy"), (attraction, "dense"))
    )
    per_body = [amount / count for count, amount in memory["force"].items()]
    return [
        Bar("rk4 against the fastest vmapped diffrax [times]", ours / vmapped, ">=", 15),
        Bar("rk4 against the fastest NumPy [times]", ours / arrays, ">=", 4),
        Bar("rk4 against itself with many lanes [times]", ours / crowd, "<=", 1.5),
        Bar(
            "gravitation against the fastest dense form [times]", attraction["physjax Gravitation"] / broadcast, ">=", 5
        ),
        Bar("memory per body, most bodies against fewest [times]", per_body[-1] / per_body[0], "<=", 1.25),
        Bar("first run of a new scene, slowest method [s]", max(row["least"] for row in compiled), "<=", 1.0),
        Bar("compilations after changed numbers", sum(row["anew"] for row in compiled), "<=", 0),
        Bar("import of physjax beyond that of jax [s]", imports["physjax"] - imports["jax"], "<=", 0.3),
    ]


def main() -> None:
    """Run all studies, print their tables, write the record and the chart."""
    quick, folder = harness.parse_options(__doc__)
    size, about = QUICK if quick else FULL, harness.describe_machine()
    print_progress(harness.format_caption(about))
    print_progress("imports, compile times")
    imports, compiled = harness.time_imports(("jax", "physjax"), size.repeats), time_compilation()
    print_progress("gravitation")
    pairs, memory = race_gravitation(size)
    print_progress("projectiles")
    rows, missing = race_projectiles(size)
    judged = build_bars(rows, pairs, memory, compiled, imports)

    print(harness.format_caption(about))
    harness.print_rates(
        f"{size.lanes:,} projectiles, {size.steps} steps", "million particle-steps/s", rows, "physjax rk4"
    )
    harness.print_rates(f"{size.bodies} bodies", "billion pairs/s", pairs, "physjax Gravitation")
    by_count = [[f"{n} bodies", *(memory[kind][n] / 2**20 for kind in memory)] for n in size.sizes]
    harness.print_table("Temporary memory [MiB]", ["", *memory], by_count)
    harness.print_table("First run of a new scene [s]", list(compiled[0]), [list(row.values()) for row in compiled])
    harness.print_table("Import, least of the repeats [s]", list(imports), [[f"{s:.3f}" for s in imports.values()]])
    harness.print_bars(judged, quick)
    for name, reason in missing.items():
        print(f"left out: {name}, {reason}")

    record = {"benchmark": "throughput", "quick": quick, "machine": about, "settings": size._asdict()}
    record |= {"projectiles": rows, "left_out": missing, "gravitation": pairs, "temporary_bytes": memory}
    record |= {
        "compile": compiled,
        "import_seconds": imports,
        "bars": [bar._asdict() | {"met": bar.met} for bar in judged],
    }
    written, drawn = (harness.result_path(folder, "throughput", quick, ending) for ending in ("json", "png"))
    harness.write_json(written, record)
    flights = f"{size.lanes:,} projectiles, quadratic drag, 3-D, float32, {size.steps} steps"
    panels = [
        (flights, "million particle-steps per second (logarithmic)", rows),
        (f"Gravitation of {size.bodies} bodies, float32", "billion pairs per second (logarithmic)", pairs),
    ]
    harness.draw_bar_chart(drawn, panels, harness.format_caption(about))
    print(f"\nwritten: {written} and {drawn.name}")


if __name__ == "__main__":
    main()
