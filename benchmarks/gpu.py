"""What a GPU makes of every kind of scene, next to kernels by hand; in minutes, without a network and without a build.

    python -m benchmarks gpu [--quick] [--out DIR] [--minutes M]

Flights, attraction, cloth, contacts, adaptive steps, aiming, single small scenes, and a gradient, in float32 unless said.
Each row is checked against float64, a closed form or a law before it is timed. CUDA C through CuPy, and Warp, are limits
where they are installed. After `--minutes` no further row begins, and what is left out is named. Where there is no card
it runs on the CPU all the same, which shows that all rows work.
"""

import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import aim
import cloth
import contact
import cuda
import harness
import jax
import jax.numpy as jnp
import numpy as np
import rivals
import throughput
from harness import Missing, print_progress

from physjax import contacts, methods, scenes, simulate

OURS, _, OTHER = harness.COLOURS
F = np.float32
CHECKED = 2048
"""Lanes, bodies or nodes of a large run that are compared with float64."""


class Settings(NamedTuple):
    """Sizes of the runs."""

    flights: tuple[int, ...]
    bodies: tuple[int, ...]
    grids: tuple[int, ...]
    cloths: int
    balls: tuple[int, ...]
    adaptive: int
    targets: int
    gradient: int
    steps: int
    repeats: int


FULL = Settings(
    (65_536, 1_000_000, 10_000_000), (4096, 16_384, 65_536), (32, 128, 512, 1024), 1000, (65_536, 1_000_000),
    65_536, 10_000, 1_000_000, 200, 3,
)  # fmt: skip
QUICK = Settings((4096,), (512,), (16,), 8, (2048,), 256, 100, 2048, 16, 1)


class Row(NamedTuple):
    """A piece of work: what it is, its unit, how much of it a call does, who does it, and what a result must be."""

    title: str
    unit: str
    work: float
    runs: dict[str, Callable[[], Any]]
    check: Callable[[str, Any], None]


def demand_close(name: str, found: Any, wanted: np.ndarray, allowed: float) -> None:
    """Stop where a result is off by more than is allowed."""
    off = float(np.abs(np.asarray(found, float) - wanted).max())
    if not off <= allowed:
        raise SystemExit(f"{name} is off by {off:.3g}, more than {allowed:.3g}.")


def add_limit(runs: dict[str, Callable], name: str, build: Callable[[], Callable]) -> None:
    """Add a kernel by hand, where it can be had; else say why not."""
    try:
        runs[name] = build()
    except Missing as reason:
        print_progress(f"  left out: {name}, {reason}")


def fly(size: Settings) -> Iterator[Row]:
    """Projectiles with quadratic drag by rk4."""
    for lanes in size.flights:
        scene = rivals.build_throws(lanes)
        runs = {"physjax": partial(rivals.simulate_final, scene, methods.rk4, size.steps)}
        add_limit(runs, "CUDA C, one kernel", partial(cuda.with_flight, lanes, size.steps))
        add_limit(runs, "Warp, one kernel", lambda lanes=lanes: next(rivals.with_warp(lanes, size.steps)).run)
        few = [a[:CHECKED].T.astype(float) for a in rivals.sample_shots(lanes)]
        truth = rivals.run_numpy_rk4(*few, size.steps)

        def check(name: str, found: Any, truth: np.ndarray = truth) -> None:
            some = np.asarray((found.numpy() if hasattr(found, "numpy") else _fetch(found))[:CHECKED])
            demand_close(name, some, truth, 100 * np.finfo(F).eps * abs(truth).max())

        work = lanes * size.steps / 1e9
        yield Row(f"{lanes:,} projectiles, rk4 with drag", "G particle-steps/s", work, runs, check)


def attract(size: Settings) -> Iterator[Row]:
    """The mutual attraction of bodies, once."""
    for count in size.bodies:
        scene = throughput.build_bodies(count)
        x, mass = (np.asarray(a, float) for a in (scene.state.position, scene.mass))
        truth = _sum_attraction(x, mass, x[:256])
        runs = {"physjax": partial(jax.jit(throughput.compute_accelerations), scene)}
        add_limit(runs, "CUDA C, tiles", partial(cuda.with_attraction, x, mass))

        def check(name: str, found: Any, truth: np.ndarray = truth) -> None:
            demand_close(name, _fetch(found)[:256], truth, 1e-5 * abs(truth).max())

        yield Row(f"{count:,} bodies that attract each other", "G pairs/s", count**2 / 1e9, runs, check)


def swing_cloth(size: Settings) -> Iterator[Row]:
    """NVIDIA's cloth by semi-implicit Euler, and many small ones."""
    for count in size.grids:
        scene = cloth.build_grid(count)
        steps = size.steps if count < 1000 else size.steps // 4
        truth = cloth.run_numpy(cloth.build_case(scene), 4, float)

        def check(name: str, _: Any, scene: Any = scene, truth: np.ndarray = truth) -> None:
            demand_close(name, cloth.simulate_final(scene, 4), truth, 1e-4)

        runs = {"physjax": partial(cloth.simulate_final, scene, steps)}
        yield Row(f"a cloth of {count}² nodes", "G node-steps/s", count**2 * steps / 1e9, runs, check)
    scene = cloth.build_grid(16)
    shifts = jnp.linspace(0.0, 1.0, size.cloths, dtype=F)

    @jax.jit
    @jax.vmap
    def swing(shift: jax.Array) -> jax.Array:
        moved = scene.state._replace(position=scene.state.position + shift)
        return cloth.simulate_final(scene.replace(state=moved), size.steps)

    alone = np.asarray(cloth.simulate_final(scene, size.steps))

    def check_first(name: str, found: Any) -> None:
        demand_close(name, found[0], alone, 1e-4)

    work = size.cloths * 256 * size.steps / 1e9
    runs = {"physjax": partial(swing, shifts)}
    yield Row(f"{size.cloths:,} cloths of 16² nodes", "G node-steps/s", work, runs, check_first)


def bounce(size: Settings) -> Iterator[Row]:
    """Balls on a floor, with the lecture's response and with the time of impact."""
    for lanes in size.balls:
        settings = contact.Settings(lanes, size.steps, size.repeats)
        for name, response in (
            ("at the end of the step", contacts.project),
            ("at the time of impact", contacts.impact),
        ):
            scene = contact.build_balls(settings, contact.CASES["restitution 0.8"], response)
            runs = {"physjax": partial(contact.run, scene, methods.rk4, settings, 0)}

            def check(name: str, found: Any) -> None:
                if not (lowest := float(found[:, 1].min())) >= -1e-5:
                    raise SystemExit(f"{name}: the lowest ball is at {lowest:.3g} m.")

            yield Row(f"{lanes:,} balls, bounces {name}", "M particle-steps/s", lanes * size.steps / 1e6, runs, check)


def adapt(size: Settings) -> Iterator[Row]:
    """Flights with error control, every lane with its own steps."""
    scene, intervals = rivals.build_throws(size.adaptive), 20
    careful = methods.adaptive(methods.rk4, atol=1e-4, rtol=1e-4)
    length = size.steps * rivals.DT / intervals
    few = [a[:CHECKED].T.astype(float) for a in rivals.sample_shots(size.adaptive)]
    truth = rivals.run_numpy_rk4(*few, size.steps)

    def run() -> jax.Array:
        return simulate(scene, careful, dt=length, steps=intervals, save_every=intervals).position[-1]

    def check(name: str, found: Any) -> None:
        demand_close(name, found[:CHECKED], truth, 0.01)

    title = f"{size.adaptive:,} projectiles, adaptive rk4, {intervals} intervals"
    yield Row(title, "runs/s", 1.0, {"physjax": run}, check)


def aim_at_targets(size: Settings) -> Iterator[Row]:
    """Both arcs to many targets with drag and wind, in float64."""
    with jax.enable_x64(True):
        given = aim.build_problem(size.targets)

    def run() -> tuple:
        with jax.enable_x64(True):
            return aim.run_aim_at(given)

    def check(name: str, found: Any) -> None:
        if float(jnp.mean(found[2])) < 0.98:
            raise SystemExit(f"{name} hit {float(jnp.mean(found[2])):.1%} of the targets.")

    yield Row(f"{size.targets:,} targets aimed at, float64", "k targets/s", size.targets / 1e3, {"physjax": run}, check)


def step_small_scenes(size: Settings) -> Iterator[Row]:
    """Single small scenes, whose step is all overhead."""
    for name in ("projectile", "kepler", "bouncing_ball", "car"):
        scene = scenes.SCENES[name]().scene
        steps = 10 * size.steps
        run = partial(simulate, scene, methods.rk4, dt=1e-4, steps=steps, save_every=steps)

        def check(name: str, found: Any) -> None:
            if not bool(jnp.all(found.ok)):
                raise SystemExit(f"{name} blew up.")

        yield Row(f"the scene {name} alone", "k steps/s", size.steps / 100, {"physjax": run}, check)


def differentiate(size: Settings) -> Iterator[Row]:
    """A gradient through all steps of a flight, against the flight itself."""
    scene = rivals.build_throws(size.gradient)

    def height(velocity: jax.Array) -> jax.Array:
        thrown = scene.replace(state=scene.state._replace(velocity=velocity))
        return jnp.sum(rivals.simulate_final(thrown, methods.rk4, size.steps)[:, 1])

    runs = {
        "forward": partial(jax.jit(height), scene.state.velocity),
        "value and gradient": partial(jax.jit(jax.value_and_grad(height)), scene.state.velocity),
    }
    step = 0.05

    def check(name: str, found: Any) -> None:
        if name == "forward":
            return
        few = [a[:1].T.astype(float) for a in rivals.sample_shots(size.gradient)]
        ahead, behind = (
            rivals.run_numpy_rk4(few[0], few[1] + sign * step * np.eye(3)[:, 1:2], size.steps)[0, 1] for sign in (1, -1)
        )
        demand_close(name, found[1][0, 1], (ahead - behind) / (2 * step), 1e-3)

    work = size.gradient * size.steps / 1e9
    yield Row(
        f"{size.gradient:,} projectiles, {size.steps} steps, differentiated", "G particle-steps/s", work, runs, check
    )


STUDIES = (fly, attract, swing_cloth, bounce, adapt, aim_at_targets, step_small_scenes, differentiate)


def main() -> None:
    """Run all rows within the time, print their table, write the record and the chart."""
    parser = harness.build_parser(__doc__)
    parser.add_argument("--minutes", type=float, default=8.0, metavar="M", help="begin no row later (%(default)s)")
    given = harness.parse_arguments(parser)
    size, about = QUICK if given.quick else FULL, harness.describe_machine()
    print_progress(harness.format_caption(about))
    began, found, late = time.monotonic(), [], []
    for study in STUDIES:
        if time.monotonic() - began > 60 * given.minutes:
            late.append(study.__name__)
            continue
        for row in study(size):
            print_progress(row.title)
            timings, failed = harness.time_side_by_side(row.runs, size.repeats, row.check)
            lines = [
                harness.make_row(name, OTHER if "kernel" in name or "tiles" in name else OURS, row.work, timing)
                for name, timing in timings.items()
            ]
            found.append({"title": row.title, "unit": row.unit, "rows": lines, "failed": failed})
    report(given.out, given.quick, about, size, found, late)


def report(
    folder: Path, quick: bool, about: dict[str, Any], size: Settings, found: list[dict], late: list[str]
) -> None:
    """Print what was found, write it, and draw it."""
    print(harness.format_caption(about))
    lines = [
        [f"{study['title']}: {row['name']}", row["rate"], row["median_rate"], study["unit"], row["first_call_s"]]
        for study in found
        for row in study["rows"]
    ]
    harness.print_table("Rates", ["", "best", "median", "", "first call [s]"], lines)
    for study in found:
        for name, reason in study["failed"].items():
            print(f"failed: {study['title']}, {name}: {reason}")
    if late:
        print(f"left out, no time: {', '.join(late)}")
    record = {"benchmark": "gpu", "quick": quick, "machine": about, "settings": size._asdict(), "studies": found}
    written, drawn = (harness.result_path(folder, "gpu", quick, ending) for ending in ("json", "png"))
    harness.write_json(written, record | {"left_out": late})
    panels = [(study["title"], f"{study['unit']} (logarithmic)", study["rows"]) for study in found if study["rows"]]
    harness.draw_bar_chart(drawn, panels, harness.format_caption(about), {OTHER: "kernels by hand"})
    print(f"\nwritten: {written} and {drawn.name}")


def _fetch(array: Any) -> np.ndarray:
    """An array of JAX, NumPy or CuPy on the host."""
    return array.get() if hasattr(array, "get") else np.asarray(array)


def _sum_attraction(x: np.ndarray, mass: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The accelerations at some places, in float64."""
    pull = lambda here: (mass / (((x - here) ** 2).sum(-1) + rivals.SOFTENING_LENGTH**2) ** 1.5) @ (x - here)  # noqa: E731
    return np.stack([pull(here) for here in at])


if __name__ == "__main__":
    main()
