"""Bodies in the plane that touch: speed by the number of worlds, and what each number of sub-steps keeps of its promises.

    python -m benchmarks stacks [--quick] [--out DIR]

1024 stacks of ten boxes in float32 on one core, steps of 1/60 s, neighbours as pairs, each box offset by up to 2 % of its
width: how many boxes take a step in a second, compile time apart. Then, in float64 and for 1 to 32 sub-steps: how far balls
are off after bounces, against the closed form; how far a stack sinks, how far a box of it moves sideways after the first
second, and how fast any is after a minute; and in drops, how deep bodies sink into the floor and how much energy they gain.
"""

import time
from pathlib import Path
from typing import Any

import harness
import jax
import matplotlib.pyplot as plt
import numpy as np
from harness import print_progress

from physjax import Scene, contacts, forces, inertia, methods, rigid, simulate

BOXES, DT, G = 10, 1 / 60, 9.8
ROUGH = contacts.Coulomb(0.5, 0.5)
SUBSTEPS = (1, 2, 4, 8, 16, 32)


def build_floor(restitution: float) -> contacts.Plane:
    """Level ground, as rough as all bodies are."""
    return contacts.Plane((0, 0), (0, 1), restitution=restitution, coulomb=ROUGH)


def build_stacks(worlds: int, substeps: int, dtype: type, seed: int = 0) -> Scene:
    """Stacks of boxes of 1 m and 1 kg that begin at rest."""
    x = np.random.default_rng(seed).uniform(-0.02, 0.02, (worlds, BOXES))
    crate = inertia.planar_plate(1.0, (1.0, 1.0))
    place = np.stack([x, np.broadcast_to(np.arange(BOXES) + 0.5, x.shape)], axis=-1).astype(dtype)
    pairs = [(i, i + 1) for i in range(BOXES - 1)]
    solids = rigid.Solids(
        rigid.PlanarShape.box((1, 1)), (build_floor(0.0),), coulomb=ROUGH, pairs=pairs, substeps=substeps
    )
    return Scene(rigid.planar_bodies(crate, place), crate, (forces.Gravity(G),), contacts=(solids,))


def measure_speed(worlds: int, substeps: int, steps: int, repeats: int) -> dict[str, float]:
    """Steps of boxes per second, the best and the median run, and the time to the first frame [s]."""
    scene = build_stacks(worlds, substeps, np.float32)
    run = lambda count: simulate(scene, methods.verlet, dt=DT, steps=count, save_every=count).state.position  # noqa: E731
    begin = time.perf_counter()
    jax.block_until_ready(run(1))
    first, times = time.perf_counter() - begin, []
    jax.block_until_ready(run(steps))
    for _ in range(repeats):
        begin = time.perf_counter()
        jax.block_until_ready(run(steps))
        times.append(time.perf_counter() - begin)
    work = worlds * BOXES * steps
    return {"best": work / min(times), "median": work / float(np.median(times)), "first_frame_s": first}


def measure_rest(substeps: int, seconds: int) -> dict[str, float]:
    """How far eight stacks sink and shift [m], and the fastest box at the end [m/s]."""
    steps = 60 * seconds
    state = simulate(build_stacks(8, substeps, float), methods.verlet, dt=DT, steps=steps, save_every=10).state
    x, y = np.moveaxis(np.asarray(state.position), -1, 0)
    return {
        "sink": float(np.abs(y[-1] - np.arange(BOXES) - 0.5).max()),
        "shift": float(np.abs(x[6:] - x[6]).max()),
        "speed": float(np.abs(state.momentum[-1]).max()),
    }


def measure_bounces(substeps: int, balls: int, seed: int = 0) -> float:
    """How far balls with K_r = 0.8 are from where they should be after 1.5 s [m], the mean over heights of 0.5 to 1 m."""
    height, keeps, end = np.random.default_rng(seed).uniform(0.5, 1.0, balls), 0.8, 1.5
    ball, radius = inertia.planar_disc(1.0, 0.1), 0.1
    place = np.stack([0 * height, height + radius], axis=-1)[:, None]
    solids = rigid.Solids(rigid.PlanarShape.disc(radius), (build_floor(keeps),), substeps=substeps)
    scene = Scene(rigid.planar_bodies(ball, place), ball, (forces.Gravity(G),), contacts=(solids,))
    found = simulate(scene, methods.verlet, dt=DT, steps=round(end / DT)).state.position[-1, :, 0, 1] - radius
    fall, left = np.sqrt(2 * height / G), np.full(balls, end)
    rise, left = np.sqrt(2 * G * height), left - fall
    y = np.zeros(balls)
    for _ in range(8):
        rise = keeps * rise
        flying = (left > 0) & (left <= 2 * rise / G)
        y = np.where(flying, rise * left - G * left**2 / 2, y)
        left = left - 2 * rise / G
    return float(np.abs(found - y).mean())


def measure_drops(substeps: int, worlds: int, seed: int = 0) -> dict[str, float]:
    """The deepest overlap [m], and by how much energy ever rises, relative to that at the start: a disc and four boxes."""
    rng, count = np.random.default_rng(seed), 5
    shapes = [rigid.PlanarShape.disc(0.5), *(rigid.PlanarShape.box((1.0, side)) for side in (1.0, 0.6, 0.8, 0.5))]
    body = inertia.planar_plate(1.0, (1.0, 0.8))
    x = np.stack(
        [
            rng.uniform(-0.5, 0.5, (worlds, count)),
            1 + 1.6 * np.arange(count) + rng.uniform(0, 0.2, (worlds, count)),
        ],
        axis=-1,
    )
    motion = rng.uniform(-3, 3, (worlds, count)), rng.uniform(-1, 1, (worlds, count, 2))
    solids = rigid.Solids(shapes, (build_floor(0.3),), restitution=0.3, coulomb=ROUGH, substeps=substeps)
    thrown = rigid.planar_bodies(body, x, *motion, rng.uniform(-3, 3, (worlds, count)))
    scene = Scene(thrown, body, (forces.Gravity(G),), contacts=(solids,))
    state = simulate(scene, methods.verlet, dt=DT, steps=150, save_every=2).state
    energy = np.sum(state.kinetic_energy(body) + G * state.position[..., 1], axis=-1)
    rise = np.max(energy - np.minimum.accumulate(energy, axis=0), axis=0) / energy[0]
    # the disc's overlap with the floor and the lowest corners of the boxes
    corners = (
        np.abs(np.sin(state.angle[..., 1:])) / 2
        + np.abs(np.cos(state.angle[..., 1:])) * np.array([1.0, 0.6, 0.8, 0.5]) / 2
    )
    low = np.minimum(state.position[..., 0, 1] - 0.5, (state.position[..., 1:, 1] - corners).min(axis=-1))
    return {"rise": float(rise.max()), "overlap": float(max(0.0, -low.min()))}


def measure_promises(substeps: int, quick: bool) -> dict[str, float]:
    """All that a number of sub-steps is asked to keep."""
    with jax.enable_x64(True):
        return {
            "bounce": measure_bounces(substeps, 64 if quick else 512),
            **measure_rest(substeps, 2 if quick else 60),
            **measure_drops(substeps, 16 if quick else 256),
        }


def draw_promises(path: Path, found: dict[int, dict[str, float]], caption: str) -> None:
    """Each promise against the number of sub-steps, with lines of first and second order."""
    panels = {
        "after bounces: mean error [m]": {"bounce": "balls, K_r = 0.8"},
        "a stack of ten: how far [m]": {"sink": "sinks", "shift": "moves sideways, from 1 s to 60 s"},
        "drops: energy that is gained, relative": {"rise": "most in any world"},
        "drops: deepest overlap with the floor [m]": {"overlap": "bodies of 1 m"},
    }
    figure, axes = plt.subplots(1, 4, figsize=(15, 4), layout="constrained")
    counts = np.array(list(found))
    for ax, (title, lines) in zip(axes, panels.items(), strict=True):
        for key, label in lines.items():
            ax.loglog(counts, [found[n][key] for n in counts], "o-", label=label)
        last = found[int(counts[-1])][next(iter(lines))]
        for order, style in ((1, ":"), (2, "--")):
            ax.loglog(counts, last * (counts[-1] / counts) ** order, style, color="0.6", label=f"order {order}")
        ax.set_title(title, fontsize=10)
        ax.set(xlabel="sub-steps of a step of 1/60 s")
        ax.set_xticks(counts, [str(n) for n in counts])
        ax.minorticks_off()
        ax.legend(fontsize=8)
    figure.suptitle(caption, fontsize=9)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def main() -> None:
    """Measure, print, write the record and the chart."""
    quick, folder = harness.parse_options(__doc__)
    about = harness.describe_machine()
    caption = harness.format_caption(about)
    print_progress(caption)
    worlds, steps = (64, 20) if quick else (1024, 120)
    speeds: dict[int, dict[str, float]] = {}
    for substeps in (4, 8):
        print_progress(f"{worlds} stacks, {substeps} sub-steps")
        speeds[substeps] = measure_speed(worlds, substeps, steps, repeats=3 if quick else 9)
    promises: dict[int, dict[str, float]] = {}
    for substeps in SUBSTEPS:
        print_progress(f"promises of {substeps} sub-steps")
        promises[substeps] = measure_promises(substeps, quick)
    rows = [[n, s["best"] / 1e6, s["median"] / 1e6, s["first_frame_s"]] for n, s in speeds.items()]
    head = ["sub-steps", "best [M/s]", "median [M/s]", "first frame [s]"]
    harness.print_table(f"{worlds} stacks of ten boxes, float32: box-steps a second", head, rows)
    names = list(promises[SUBSTEPS[0]])
    table = [[n, *(kept[name] for name in names)] for n, kept in promises.items()]
    harness.print_table("what sub-steps keep [m, m/s, relative]", ["sub-steps", *names], table)
    record: dict[str, Any] = {"benchmark": "stacks", "quick": quick, "machine": about, "worlds": worlds}
    record |= {"speeds": speeds, "promises": promises}
    written, drawn = (harness.result_path(folder, "stacks", quick, ending) for ending in ("json", "png"))
    harness.write_json(written, record)
    draw_promises(drawn, promises, caption)
    print(f"\nwritten: {written} and {drawn.name}")


if __name__ == "__main__":
    main()
