"""Particles that are born and die, compared with the same scene without births, NumPy and Warp.

    python benchmarks/particles.py [--quick] [--out DIR]

100 000 particles in space, float32, semi-implicit Euler, 100 steps: gravity, quadratic drag in a wind, a plane with
restitution whose contacts are resolved at the end of the step or, by `impact`, within it, and 20 000 births a second (200
a step) from a point into a cone. NumPy and Warp overwrite the next 200 slots at the end of every step. The contenders take
turns on one core; bars are judged by the best turn of each. Also the memory of a process that runs a million.
"""

import resource
from collections.abc import Callable, Iterator
from typing import NamedTuple

import harness
import jax
import jax.numpy as jnp
import numpy as np
from harness import Bar, Missing, print_progress

from physjax import Scene, contacts, emitters, forces, methods, simulate

DT, MASS, AREA, DRAG, WIND, G = 0.01, 1e-3, 1e-4, 0.5, (1.0, 0.0, 0.0), 9.8
SPEED, CONE, RESTITUTION, FRICTION, LIFE_SECONDS = 8.0, 0.4, 0.5, 0.1, 4.9
K = 0.5 * 1.225 * DRAG * AREA / MASS
OURS, OTHER = "physjax", "without JAX"


class Settings(NamedTuple):
    """Sizes of the runs."""

    lanes: int
    many: int
    steps: int
    repeats: int


FULL = Settings(100_000, 1_000_000, 100, 7)
QUICK = Settings(2_000, 5_000, 20, 1)


def build_run(
    lanes: int,
    emits: bool,
    method: Callable = methods.semi_implicit_euler,
    response: Callable = contacts.project,
    warm: int = 600,
) -> Callable:
    """A run from the steady state on; without births from the same places and speeds."""
    up = (0.0, 1.0, 0.0)
    source = emitters.Point((0.0, 1.0, 0.0))
    options = {"life": LIFE_SECONDS, "speed": SPEED, "direction": up, "cone": CONE, "speed_spread": 0.2}
    jet = emitters.Emitter(lanes, source, key=0, rate=lanes / 5, **options)
    floor = contacts.Plane((0.0, 0.0, 0.0), up, restitution=RESTITUTION, friction=FRICTION, response=response)
    parts = (MASS, (forces.Gravity(G), forces.QuadraticDrag(AREA, DRAG, wind=WIND)), (floor,))
    scene = simulate(
        Scene(jet.unborn(np.float32), *parts, emitter=jet), method, dt=DT, steps=warm, save_every=warm
    ).final_scene
    start = scene if emits else Scene(scene.state, *parts)

    def run(steps):
        return simulate(start, method, dt=DT, steps=steps, save_every=steps, first_step=warm).position[-1]

    return run


def with_numpy(lanes: int, steps: int) -> Callable:
    """NumPy, components in rows."""
    rng = np.random.default_rng(0)
    x0, v0 = np.zeros((3, lanes), np.float32), rng.normal(0, 3, (3, lanes)).astype(np.float32)
    x0[1], wind, births = 1.0, np.asarray(WIND, np.float32)[:, None], lanes // 500

    def run():
        x, v = x0.copy(), v0.copy()
        for step in range(steps):
            air = v - wind
            v += np.float32(DT) * (np.float32(-K) * np.sqrt((air * air).sum(axis=0)) * air)
            v[1] -= np.float32(DT * G)
            x += np.float32(DT) * v
            low = x[1] < 0
            x[1, low] = 0
            inward = low & (v[1] < 0)
            v[0, inward] *= np.float32(1 - FRICTION)
            v[2, inward] *= np.float32(1 - FRICTION)
            v[1, inward] *= np.float32(-RESTITUTION)
            born = slice(step * births % lanes, step * births % lanes + births)
            x[:, born], v[:, born] = x0[:, born], rng.normal(0, 3, (3, births))
        return x

    return run


def with_warp(lanes: int, steps: int) -> Iterator[tuple[str, Callable]]:
    """Warp, a launch a step; the random numbers of a birth from its slot and step."""
    wp = harness.import_optional("warp", "warp-lang")
    wp.config.quiet = True
    device, births = "cpu", lanes // 500

    @wp.kernel
    def move(x: wp.array(dtype=wp.vec3), v: wp.array(dtype=wp.vec3), first: int, count: int, step: int, k: float):
        i = wp.tid()
        p = x[i]
        q = v[i]
        air = q - wp.vec3(1.0, 0.0, 0.0)
        q = q + 0.01 * (-k * wp.length(air) * air - wp.vec3(0.0, 9.8, 0.0))
        p = p + 0.01 * q
        if p[1] < 0.0:
            p = wp.vec3(p[0], 0.0, p[2])
            if q[1] < 0.0:
                q = wp.vec3(0.9 * q[0], -0.5 * q[1], 0.9 * q[2])
        if i >= first and i < first + count:
            state = wp.rand_init(step, i)
            p = wp.vec3(0.0, 1.0, 0.0)
            q = 3.0 * wp.vec3(wp.randn(state), wp.randn(state), wp.randn(state))
        x[i] = p
        v[i] = q

    start = np.zeros((lanes, 3), np.float32)

    def run():
        x, v = (wp.array(start, dtype=wp.vec3, device=device) for _ in range(2))
        for step in range(steps):
            wp.launch(move, lanes, inputs=[x, v, step * births % lanes, births, step, K], device=device)
        wp.synchronize_device(device)
        return x.numpy()

    yield f"Warp {wp.config.version}, one core", run


def main() -> None:
    """Run all, print the table and the bars, write the record."""
    quick, folder = harness.parse_options(__doc__)
    size, about = QUICK if quick else FULL, harness.describe_machine()
    print_progress(harness.format_caption(about))
    print_progress("a million")
    jax.block_until_ready(build_run(size.many, True, warm=10)(10))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10

    runs, missing, ours = {}, {}, {}
    for method, response in (
        (methods.semi_implicit_euler, contacts.project),
        (methods.rk4, contacts.project),
        (methods.semi_implicit_euler, contacts.impact),
    ):
        about_it = f"{method.__name__}, {response.__name__}"
        ours[about_it] = [f"physjax {about_it}, {what}" for what in ("births and deaths", "neither")]
        for name, emits in zip(ours[about_it], (True, False), strict=True):
            run = build_run(size.lanes, emits, method, response)
            runs[name] = lambda run=run: run(size.steps)
    runs["NumPy, semi-implicit"] = with_numpy(size.lanes, size.steps)
    try:
        runs |= dict(with_warp(size.lanes, size.steps))
    except Missing as reason:
        missing["warp"] = str(reason)

    def check(name, found):
        if not jnp.all(jnp.isfinite(jnp.asarray(found))):
            raise SystemExit(f"{name} is not finite")

    timings, failed = harness.time_side_by_side(runs, size.repeats, check)
    work = size.lanes * size.steps / 1e6
    rows = [harness.make_row(name, OURS if "physjax" in name else OTHER, work, t) for name, t in timings.items()]
    rate = {name: work / timing.least for name, timing in timings.items()}
    bars = [Bar("memory of a process with a million [MiB]", memory, "<=", 1024)]
    for about_it, (born, plain) in ours.items():
        bars.append(Bar(f"{about_it}: births and deaths / neither", rate[born] / rate[plain], ">=", 0.25))
        if "semi" in about_it:
            bars.append(Bar(f"{about_it}: with births, million particle-steps/s", rate[born], ">=", 40.0))

    print(harness.format_caption(about))
    title, unit = f"{size.lanes:,} particles, {size.steps} steps", "million particle-steps/s"
    harness.print_rates(title, unit, rows, next(iter(ours.values()))[0])
    harness.print_bars(bars, quick)
    record = {
        "benchmark": "particles",
        "how": " ".join(__doc__.split("\n\n")[2].split()),
        "quick": quick,
        "machine": about,
        "settings": size._asdict(),
        "rates": rows,
    }
    record |= {"left_out": missing | failed, "bars": [bar._asdict() | {"met": bar.met} for bar in bars]}
    written, drawn = (harness.result_path(folder, "particles", quick, ending) for ending in ("json", "png"))
    harness.write_json(written, record)
    harness.draw_bar_chart(drawn, [(title, f"{unit} (logarithmic)", rows)], harness.format_caption(about))
    print(f"\nwritten: {written}, {drawn}")


if __name__ == "__main__":
    main()
