"""Stacks of ten boxes in the plane: speed by the number of worlds, and how still they stand by the number of sub-steps.

    python benchmarks/stacks.py [--quick] [--out DIR]

1024 stacks in float32 on one core, steps of 1/60 s, neighbours as pairs, each box offset by up to 2 % of its width: how
many boxes take a step in a second, compile time apart. Then stacks in float64 for a minute: how far they sink, how far a box
moves sideways after the first second, and how fast any still is at the end.
"""

import argparse
import json
import time
from pathlib import Path

import jax
import numpy as np

from physjax import Scene, contacts, forces, inertia, methods, rigid, simulate

BOXES, DT = 10, 1 / 60
FRICTION = contacts.Coulomb(0.5, 0.5)


def build_stacks(worlds: int, substeps: int, dtype: type, seed: int = 0) -> Scene:
    """Stacks of boxes of 1 m and 1 kg that begin at rest."""
    x = np.random.default_rng(seed).uniform(-0.02, 0.02, (worlds, BOXES))
    crate, floor = (
        inertia.planar_plate(1.0, (1.0, 1.0)),
        contacts.Plane((0, 0), (0, 1), restitution=0, coulomb=FRICTION),
    )
    place = np.stack([x, np.broadcast_to(np.arange(BOXES) + 0.5, x.shape)], axis=-1).astype(dtype)
    pairs = [(i, i + 1) for i in range(BOXES - 1)]
    solids = rigid.Solids(rigid.PlanarShape.box((1, 1)), (floor,), coulomb=FRICTION, pairs=pairs, substeps=substeps)
    return Scene(rigid.planar_bodies(crate, place), crate, (forces.Gravity(),), contacts=(solids,))


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
    """How far eight stacks sink and shift [mm], and the fastest box at the end [m/s]."""
    with jax.enable_x64(True):
        steps = 60 * seconds
        state = simulate(build_stacks(8, substeps, float), methods.verlet, dt=DT, steps=steps, save_every=10).state
    x, y = np.moveaxis(np.asarray(state.position), -1, 0)
    return {
        "sink_mm": 1e3 * float(np.abs(y[-1] - np.arange(BOXES) - 0.5).max()),
        "shift_mm": 1e3 * float(np.abs(x[6:] - x[6]).max()),
        "speed_m_per_s": float(np.abs(state.momentum[-1]).max()),
    }


def main() -> None:
    """Measure, print, and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few worlds and a short run")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args()
    worlds, steps, seconds = (64, 20, 2) if options.quick else (1024, 120, 60)
    found: dict[str, dict] = {"jax": {"version": jax.__version__}}
    for substeps in (4, 8):
        name = f"{worlds} worlds, {substeps} sub-steps"
        found[name] = measure_speed(worlds, substeps, steps, repeats=7)
        print(
            f"{name}: {found[name]['best'] / 1e6:.2f} M box-steps/s, first frame {found[name]['first_frame_s']:.1f} s",
            flush=True,
        )
        found[f"rest, {substeps} sub-steps"] = rest = measure_rest(substeps, seconds)
        print("  " + ", ".join(f"{key} {value:.3g}" for key, value in rest.items()), flush=True)
    if not options.quick:
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / f"stacks-cpu-jax{jax.__version__}.json").write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
