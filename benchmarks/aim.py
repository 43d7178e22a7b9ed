"""Which angle hits: ten thousand targets in wind, by `aim_at`, by `solve` lane by lane, and by diffrax with optimistix.

    python benchmarks/aim.py [--quick] [--out DIR]

A baseball at 40 m/s under gravity, quadratic drag and wind, in float64; every target is where a shot in this wind passes
on its way down, so that all are in reach. `aim_at` finds both arcs, start values included. `solve`, which is
optimistix, is vmapped over angle and flight time together, for the low arc of the first thousand. The competitor works in the
usual way: diffrax (Tsit5, adaptive) flies until an event, when the ball falls through the target's height; optimistix's
Newton looks for the angle alone that makes the range right, for the low arc. Both are given the vacuum's angle and time
to start from. What each has found is checked through diffrax at a tolerance of 1e-11; the misses are in the table.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import diffrax
import harness
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from harness import Bar, print_progress

from physjax import Particles, Scene, aim_at, forces, methods, ode_term, projectile, simulate, solve

SPEED, MASS, STEPS = 40.0, 0.145, 200
OURS, OTHER, PLAIN = harness.COLOURS  # families by colour only
HIT_DISTANCE = 1e-6
"""A target missed by no more than this is hit [m]."""


class Settings(NamedTuple):
    """Sizes of the runs."""

    targets: int
    few: int
    repeats: int


FULL, QUICK = Settings(10_000, 1000, 3), Settings(200, 200, 1)


class Problem(NamedTuple):
    """Targets [m], a wind at each [m/s]."""

    target: jax.Array
    wind: jax.Array


def build_scene(wind: jax.Array, velocity: jax.Array) -> Scene:
    """A baseball that leaves the origin."""
    drag = forces.QuadraticDrag(area=4.3e-3, coefficient=0.35, wind=wind)
    return Scene(Particles(jnp.zeros_like(velocity), velocity), mass=MASS, forces=(forces.Gravity(), drag))


def direction(angle: jax.Array) -> jax.Array:
    """Unit vectors."""
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)


def build_problem(count: int) -> Problem:
    """Targets on the way down of shots at random angles, each with its own wind."""
    rng = np.random.default_rng(0)
    wind = jnp.asarray(rng.normal(scale=3.0, size=(count, 2)) * (1.0, 0.3))
    angle = jnp.asarray(rng.uniform(0.15, 1.3, count))
    time = rng.uniform(1.15, 1.8, count) * SPEED * jnp.sin(angle) / 9.8
    start = build_scene(wind, SPEED * direction(angle))
    flight = simulate(start, methods.rk4, dt=time / STEPS, steps=STEPS, save_every=STEPS)
    return Problem(flight.position[-1], wind)


@jax.jit
def run_aim_at(given: Problem) -> tuple:
    """Angles and times of both arcs, and whether they hit."""
    aimed = aim_at(build_scene(given.wind, jnp.zeros_like(given.wind)), given.target, speed=SPEED, steps=STEPS)
    return (aimed.low.angle, aimed.high.angle), (aimed.low.time, aimed.high.time), aimed.low.ok & aimed.high.ok


def guess(target: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The low arc of the vacuum, or, where drag or wind make up for what is out of its reach, an eighth of a turn."""
    low, _, ok = projectile.angles_for_target(target[..., 0], target[..., 1], SPEED)
    angle = jnp.where(ok, low, jnp.pi / 4)
    return angle, target[..., 0] / (SPEED * jnp.cos(angle))


@jax.jit
@jax.vmap
def run_solve(given: Problem) -> tuple:
    """Angle and flight time together, by `solve`."""

    def miss(unknown):
        angle, time = unknown
        flight = simulate(
            build_scene(given.wind, SPEED * direction(angle)),
            methods.rk4,
            dt=time / STEPS,
            steps=STEPS,
            save_every=STEPS,
        )
        return flight.position[-1] - given.target

    found = solve(miss, guess(given.target))
    return *found.value, found.ok


@jax.jit
@jax.vmap
def run_event_search(given: Problem) -> tuple:
    """The angle alone: diffrax flies to the event, optimistix makes the range right."""

    def falls_through(t, y, args, **_):
        return y.position[1] - given.target[1]

    def landing(angle):
        start = build_scene(given.wind, SPEED * direction(angle))
        return diffrax.diffeqsolve(
            ode_term(start),
            diffrax.Tsit5(),
            t0=0.0,
            t1=30.0,
            dt0=None,
            y0=start.state,
            stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-9),
            event=diffrax.Event(falls_through, optimistix.Newton(1e-10, 1e-10), direction=False),
            adjoint=diffrax.DirectAdjoint(),
            max_steps=256,
            throw=False,
        )

    def too_far(angle, _):
        return landing(angle).ys.position[-1, 0] - given.target[0]

    angle, _ = guess(given.target)
    found = optimistix.root_find(too_far, optimistix.Newton(1e-9, 1e-9), angle, max_steps=30, throw=False)
    return found.value, landing(found.value).ts[-1], found.result == optimistix.RESULTS.successful


@jax.jit
@jax.vmap
def measure_miss(given: Problem, angle: jax.Array, time: jax.Array) -> jax.Array:
    """By how much a shot misses [m], through diffrax at a tolerance of 1e-11, whoever found it."""
    start = build_scene(given.wind, SPEED * direction(angle))
    end = diffrax.diffeqsolve(
        ode_term(start),
        diffrax.Dopri8(),
        t0=0.0,
        t1=time,
        dt0=None,
        y0=start.state,
        stepsize_controller=diffrax.PIDController(rtol=1e-11, atol=1e-11),
        max_steps=4096,
        throw=False,
    )
    miss = end.ys.position[-1] - given.target
    return jnp.sqrt(miss[0] ** 2 + miss[1] ** 2)


FAMILIES = {OURS: "aim_at", OTHER: "optimistix over diffrax", PLAIN: "optimistix over simulate"}
CONTENDERS = {
    "aim_at, both arcs": run_aim_at,
    "solve on angle and time, vmapped": run_solve,
    "diffrax event + optimistix on the angle": run_event_search,
}


def judge_hits(name: str, given: Problem, found: tuple) -> list[str | float]:
    """Name, share that hit, worst and median miss of those reported as hits [m]."""
    angles, times, ok = found
    arcs = zip(angles, times, strict=True) if name.startswith("aim_at") else [(angles, times)]
    miss = np.max([np.asarray(measure_miss(given, angle, time)) for angle, time in arcs], axis=0)
    good = np.asarray(ok) & (miss <= HIT_DISTANCE)
    said = miss[np.asarray(ok)]
    return [name, float(good.mean()), float(np.asarray(ok).mean()), float(np.median(said)), float(said.max())]


def main() -> None:
    """Run all contenders, print their tables, write the record and the chart."""
    quick, folder = harness.parse_options(__doc__)
    size, about = QUICK if quick else FULL, harness.describe_machine()
    print_progress(harness.format_caption(about))
    given, accuracy = build_problem(size.targets), []
    few = jax.tree.map(lambda leaf: leaf[: size.few], given)
    problems = {name: few if run is run_solve else given for name, run in CONTENDERS.items()}
    runs: dict[str, Callable] = {name: partial(run, problems[name]) for name, run in CONTENDERS.items()}
    timings, failed = harness.time_side_by_side(
        runs, size.repeats, check=lambda name, found: accuracy.append(judge_hits(name, problems[name], found))
    )
    if failed:
        raise SystemExit(f"{failed}")
    rows = [
        harness.make_row(name, family, len(problems[name].target), timing)
        for family, (name, timing) in zip((OURS, PLAIN, OTHER), timings.items(), strict=True)
    ]
    ours, _, rival = (timings[name].least for name in CONTENDERS)
    hits = {name: share for name, share, *_ in accuracy}
    bars = [
        Bar("aim_at: seconds for all targets, both arcs", ours, "<=", 1.0),
        Bar("aim_at: share of targets hit by both arcs", hits["aim_at, both arcs"], ">=", 1.0),
        Bar("aim_at: times faster than the event", rival / ours, ">=", 10.0),
    ]
    print(harness.format_caption(about))
    harness.print_rates(f"{size.targets:,} targets", "targets a second", rows, "aim_at, both arcs")
    head = ["", f"hit to {HIT_DISTANCE:g} m", "said to hit", "median miss [m]", "worst miss [m]"]
    harness.print_table("Solutions checked through diffrax; misses of those reported as hits", head, accuracy)
    harness.print_bars(bars, quick)
    record = {"benchmark": "aim", "quick": quick, "machine": about, "settings": size._asdict(), "runs": rows}
    record["accuracy"] = [dict(zip(("name", *head[1:]), line, strict=True)) for line in accuracy]
    record["bars"] = [bar._asdict() | {"met": bar.met} for bar in bars]
    written, drawn = (harness.result_path(folder, "aim", quick, ending) for ending in ("json", "png"))
    harness.write_json(written, record)
    title = f"{size.targets:,} targets, drag and wind, float64"
    harness.draw_bar_chart(
        drawn, [(title, "targets per second (logarithmic)", rows)], harness.format_caption(about), FAMILIES
    )
    print(f"\nwritten: {written} and {drawn.name}")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
