"""How cost grows: throughput by lanes from 10 to 10⁶, a gradient by steps from 10² to 10⁵, compiling by scene."""

import time
from functools import partial
from typing import Any

import harness
import jax
import measures
from harness import print_progress
from measures import Peer, Size

from physjax import methods, simulate
from physjax.scenes import SCENES
from workloads import projectile

PHYSJAX = Peer("physjax", "physjax", "", projectile.with_physjax)
DIFFRAX = Peer("diffrax", "other JAX code", "", projectile.with_diffrax, 10**5 * 200)
LANES, STEPS = tuple(10**n for n in range(1, 7)), tuple(10**n for n in range(2, 6))
COMPILED = (
    "fall_with_drag", "bouncing_ball", "kepler", "flag", "tumbling_box", "newtons_cradle", "pyramid", "stack_in_space",
    "ragdoll", "car",
)  # fmt: skip


def measure_lanes(quick: bool, peers: list[Peer]) -> list[dict[str, Any]]:
    """Steps a second of projectiles, 200 steps, by lanes."""
    rows = []
    for lanes in LANES[: 4 if quick else None]:
        size = Size(lanes, 200)
        able = [peer for peer in peers if size.lanes * size.steps <= peer.largest]
        calls = {peer.name: peer.build(size).forward for peer in able}
        timings, _ = harness.time_side_by_side(calls, 3)
        for peer in able:
            timing = measures.describe_timing(timings[peer.name])
            rows.append(measures.make_row("lanes", peer, size, rate=lanes * 200 / timings[peer.name].least, **timing))
        print_progress(f"  {lanes:,} lanes: {rows[-len(able)]['rate'] / 1e6:.3g} M steps/s")
    return rows


def measure_gradient_steps(quick: bool, peers: list[Peer]) -> list[dict[str, Any]]:
    """Time and temporary memory of the gradient of 64 projectiles, by steps."""
    rows = []
    for steps in STEPS[: 2 if quick else None]:
        size = Size(64, steps)
        calls = {peer.name: peer.build(size).gradient for peer in peers}
        timings, _ = harness.time_side_by_side(calls, 3)
        for peer in peers:
            function, *arguments = calls[peer.name].func, *calls[peer.name].args
            memory = harness.measure_temporary_bytes(function, *arguments)
            timing = measures.describe_timing(timings[peer.name])
            rows.append(measures.make_row("steps", peer, size, temporary_bytes=memory, **timing))
            print_progress(f"  {peer.name}, {steps:,} steps: {timing['least_s']:.3g} s, {memory / 2**20:.3g} MiB")
    return rows


def measure_compiling(quick: bool) -> list[dict[str, Any]]:
    """The first run of a scene of the gallery, rk4 or what bodies that touch allow, and the compiler's share of it."""
    rows = []
    for name in COMPILED[: 4 if quick else None]:
        scene = SCENES[name]().scene
        method = methods.verlet if name in ("newtons_cradle", "pyramid", "stack_in_space") else methods.rk4
        run = partial(simulate, scene, method, dt=1e-3, steps=8)
        with harness.record_compilations() as compiling:
            begun = time.perf_counter()
            jax.block_until_ready(run().state)
            first = time.perf_counter() - begun
        rows.append(measures.make_row("compile", PHYSJAX, scene=name, first_call_s=first, compile_s=sum(compiling)))
        print_progress(f"  {name}: first run {first:.3g} s, XLA {sum(compiling):.3g} s")
    return rows


def measure(quick: bool, peers: bool) -> list[dict[str, Any]]:
    """All three."""
    both = [PHYSJAX, *([DIFFRAX] if peers else [])]
    print_progress("  throughput by lanes")
    rows = measure_lanes(quick, both)
    print_progress("  gradient by steps")
    rows += measure_gradient_steps(quick, both)
    print_progress("  compiling by scene")
    return rows + measure_compiling(quick)
