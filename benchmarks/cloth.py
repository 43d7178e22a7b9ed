"""NVIDIA's cloth case: how fast physjax steps springs, next to Warp, Taichi and NumPy doing the same work in the same run.

    python benchmarks/cloth.py [--quick] [--out DIR]

(a) a grid of N × N nodes, 0.1 m apart and 0.1 kg each, k = 1000 N/m and 10 kg/s along structural, shear and bend springs
alike, two corners pinned, g = 9.81 m/s², semi-implicit Euler, 960 steps a second, float32, for N = 32, 64, 128; its mean
position after a second must be the known one; (b) the same springs on a triangle mesh, a geodesic sphere of 16 002 nodes;
(c) a thousand cloths of 16 × 16 in one vmap; (d) the memory of a step of a million nodes. All contenders must agree with
a float64 run before any is timed. What is not installed is left out and named. All run on one core if the process may
use one (taskset -c 0). Needs the extra `bench`.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import equinox as eqx
import harness
import jax
import jax.numpy as jnp
import numpy as np
from harness import Bar, Missing, print_progress

from physjax import Particles, Scene, forces, lattices, methods, simulate

K, DAMPING, MASS, G, DT, SPACING = 1000.0, 10.0, 0.1, 9.81, 1 / 960, 0.1
OURS, _, OTHER = harness.COLOURS
F = np.float32
EXPECTED_MEANS = {64: (3.1500, -4.0086, 2.6403), 128: (6.3500, -4.6847, 6.2180)}
"""Mean positions [m] after a second, by N."""
EXPECTED_LOWEST = -4.9101
"""The lowest node after a second [m]: one that has not felt the corners yet, in free fall."""


class Settings(NamedTuple):
    """Sizes of the runs."""

    grids: tuple[int, ...]
    frequency: int
    cloths: int
    many: int
    steps: int
    repeats: int


FULL = Settings((32, 64, 128), 40, 1000, 1000, 160, 7)
QUICK = Settings((16, 32), 8, 20, 100, 8, 1)


class Case(NamedTuple):
    """Springs for everyone: positions `(n, 3)`, pairs `(s, 2)`, rest lengths, and 1 for nodes that are free."""

    x: np.ndarray
    pairs: np.ndarray
    rest: np.ndarray
    free: np.ndarray


class Contender(NamedTuple):
    """Who runs: a name, its family, and a call that returns the final positions `(n, 3)`."""

    name: str
    family: str
    run: Callable[[], object]


def build_scene(lattice: lattices.Lattice, pinned: np.ndarray) -> Scene:
    """A lattice with the case's masses, in float32, under gravity."""
    state = Particles(*(jnp.asarray(a, F) for a in lattice.state))
    return Scene(state, mass=MASS, forces=(forces.Gravity(g=G), lattice.springs), pinned=pinned)


def build_grid(count: int) -> Scene:
    """NVIDIA's cloth of count × count nodes."""
    side, stiff = SPACING * (count - 1), {"structural": K, "shear": K, "bend": K, "damping": DAMPING}
    sheet = lattices.cloth(side, side, count, count, mass=MASS * count**2, down=(0, 0, 1), **stiff)
    return build_scene(sheet, sheet.nodes["top"] & sheet.nodes["corners"])


def build_sphere(frequency: int) -> Scene:
    """The same springs on a geodesic sphere of 10 frequency² + 2 nodes, two of them pinned."""
    x, faces = build_geodesic(frequency)
    ball = lattices.from_mesh(2 * x, faces, mass=MASS * len(x), structural=K, bend=K, damping=DAMPING)
    return build_scene(ball, np.arange(len(x)) < 2)


def build_geodesic(frequency: int) -> tuple[np.ndarray, np.ndarray]:
    """An icosahedron whose faces are cut into frequency² triangles, blown up to a sphere of radius 1."""
    p = (1 + 5**0.5) / 2
    corners = np.array([[0, a, b * p] for a in (-1, 1) for b in (-1, 1)])
    corners = np.concatenate([np.roll(corners, turn, axis=1) for turn in range(3)])
    near = np.abs(((corners[:, None] - corners) ** 2).sum(-1) - 4) < 1e-9
    sides = [
        (a, b, c) for a in range(12) for b in range(a) for c in range(b) if near[a, b] and near[b, c] and near[a, c]
    ]
    points, faces = [], []
    for side in sides:
        a, b, c = corners[list(side)]
        if np.cross(b - a, c - a) @ a < 0:
            b, c = c, b
        number = {}
        for i in range(frequency + 1):
            for j in range(frequency + 1 - i):
                number[i, j] = len(points)
                points.append((a * (frequency - i - j) + b * i + c * j) / frequency)
        for i, j in number:
            if i + j < frequency:
                faces.append((number[i, j], number[i + 1, j], number[i, j + 1]))
            if i + j < frequency - 1:
                faces.append((number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]))
    x, same = np.unique(np.round(points, 9), axis=0, return_inverse=True)
    return x / np.sqrt((x * x).sum(-1, keepdims=True)), same.ravel()[np.array(faces)]


def build_case(scene: Scene) -> Case:
    """What a scene is made of, for those who do not know scenes."""
    springs = scene.forces[1]
    pinned = np.asarray(scene.pinned)
    return Case(np.asarray(scene.state.position), springs.pairs, np.asarray(springs.rest_length), 1 - pinned.astype(F))


def simulate_final(scene: Scene, steps: int) -> jax.Array:
    """Final positions through the public `simulate`."""
    run = simulate(scene, methods.semi_implicit_euler, dt=DT, steps=steps, save_every=steps)
    return run.final_scene.state.position


def with_physjax(scene: Scene, steps: int) -> Iterator[Contender]:
    """The layout that was chosen."""
    yield Contender(f"physjax, {scene.forces[1].layout}", OURS, partial(simulate_final, scene, steps))


def run_numpy(given: Case, steps: int, kind: type[np.floating] = F) -> np.ndarray:
    """The same step in NumPy: forces on springs, summed at their ends by bincount."""
    x, rest, free = (a.astype(kind) for a in (given.x, given.rest, given.free))
    (i, j), v = given.pairs.T, np.zeros_like(x)
    dt, weight = kind(DT), np.array([0, -G, 0], kind)
    for _ in range(steps):
        d, w = x[j] - x[i], v[j] - v[i]
        length = np.sqrt((d * d).sum(-1))
        d /= length[:, None]
        d *= (kind(K) * (length - rest) + kind(DAMPING) * (d * w).sum(-1))[:, None]
        pull = [np.bincount(i, f, len(x)) - np.bincount(j, f, len(x)) for f in d.T]
        v += dt * free[:, None] * (np.stack(pull, axis=-1).astype(kind) / kind(MASS) + weight)
        x += dt * v
    return x


def with_numpy(scene: Scene, steps: int) -> Iterator[Contender]:
    """NumPy, spring by spring in arrays."""
    yield Contender("NumPy", OTHER, partial(run_numpy, build_case(scene), steps))


def with_warp(scene: Scene, steps: int) -> Iterator[Contender]:
    """Warp on the CPU: a thread for each spring, which adds to both ends, then a thread for each node."""
    wp = harness.import_optional("warp", "warp-lang")
    wp.config.quiet, wp.config.log_level = True, 30
    vectors, numbers = wp.array(dtype=wp.vec3), wp.array(dtype=float)

    @wp.kernel
    def pull(x: vectors, v: vectors, pairs: wp.array(dtype=int), rest: numbers, k: numbers, c: numbers, f: vectors):
        s = wp.tid()
        i = pairs[2 * s]
        j = pairs[2 * s + 1]
        d = x[j] - x[i]
        length = wp.length(d)
        along = d * (1.0 / length)
        force = along * (k[s] * (length - rest[s]) + c[s] * wp.dot(along, v[j] - v[i]))
        wp.atomic_add(f, i, force)
        wp.atomic_sub(f, j, force)

    @wp.kernel
    def move(x: vectors, v: vectors, f: vectors, inverse_mass: numbers, dt: float, g: float):
        n = wp.tid()
        w = inverse_mass[n]
        a = f[n] * w
        if w > 0.0:
            a = a - wp.vec3(0.0, g, 0.0)
        u = v[n] + a * dt
        x[n] = x[n] + u * dt
        v[n] = u
        f[n] = wp.vec3()

    given = build_case(scene)
    nodes, springs = len(given.x), len(given.pairs)
    on = {"device": "cpu"}
    pairs = wp.array(given.pairs.ravel(), dtype=int, **on)
    rest, k, c, inverse = (
        wp.array(a.astype(F), dtype=float, **on)
        for a in (given.rest, np.full(springs, K), np.full(springs, DAMPING), given.free / MASS)
    )

    def run():
        x = wp.array(given.x, dtype=wp.vec3, **on)
        v, f = (wp.zeros(nodes, dtype=wp.vec3, **on) for _ in range(2))
        for _ in range(steps):
            wp.launch(pull, dim=springs, inputs=[x, v, pairs, rest, k, c, f], **on)
            wp.launch(move, dim=nodes, inputs=[x, v, f, inverse, DT, G], **on)
        return x.numpy()

    yield Contender(f"Warp {wp.config.version}", OTHER, run)


def with_taichi(scene: Scene, steps: int) -> Iterator[Contender]:
    """Taichi on one thread, the kernels of Warp."""
    ti = harness.import_optional("taichi")
    ti.init(arch=ti.cpu, cpu_max_num_threads=1, log_level=ti.WARN, offline_cache=False)
    given = build_case(scene)
    nodes, springs = len(given.x), len(given.pairs)
    x, v, f = (ti.Vector.field(3, ti.f32, nodes) for _ in range(3))
    inverse, pairs = ti.field(ti.f32, nodes), ti.field(ti.i32, (springs, 2))
    rest, k, c = (ti.field(ti.f32, springs) for _ in range(3))

    @ti.kernel
    def pull():
        for s in range(springs):
            i, j = pairs[s, 0], pairs[s, 1]
            d = x[j] - x[i]
            length = d.norm()
            along = d / length
            force = along * (k[s] * (length - rest[s]) + c[s] * along.dot(v[j] - v[i]))
            f[i] += force
            f[j] -= force

    @ti.kernel
    def move():
        for n in range(nodes):
            w = inverse[n]
            a = f[n] * w
            if w > 0:
                a[1] -= G
            v[n] += a * DT
            x[n] += v[n] * DT
            f[n] = ti.Vector([0.0, 0.0, 0.0])

    pairs.from_numpy(given.pairs)
    rest.from_numpy(given.rest.astype(F))
    inverse.from_numpy((given.free / MASS).astype(F))
    k.fill(K)
    c.fill(DAMPING)

    def run():
        x.from_numpy(given.x)
        v.fill(0.0)
        f.fill(0.0)
        for _ in range(steps):
            pull()
            move()
        return x.to_numpy()

    yield Contender(f"Taichi {'.'.join(map(str, ti.__version__))}", OTHER, run)


def race(scene: Scene, size: Settings) -> tuple[list[dict], dict[str, str]]:
    """Rates in million node-steps a second, and who is missing and why."""
    contenders, missing = [], {}
    for source in (with_physjax, with_warp, with_taichi, with_numpy):
        try:
            contenders += source(scene, size.steps)
        except Missing as reason:
            missing[source.__name__.removeprefix("with_")] = str(reason)
    contenders = {who.name: who for who in contenders}
    given = build_case(scene)
    truth = run_numpy(given, size.steps, np.float64)

    def check(name, found):
        error = np.abs(np.asarray(found, float) - truth).max()
        if not error <= 1e-4:
            raise SystemExit(f"{name} is off by {error:.3g} m after {size.steps} steps.")

    timings, failed = harness.time_side_by_side({n: who.run for n, who in contenders.items()}, size.repeats, check)
    if any(contenders[name].family == OURS for name in failed):
        raise SystemExit(f"physjax failed: {failed}")
    work = len(given.x) * size.steps / 1e6
    return [harness.make_row(n, contenders[n].family, work, t) for n, t in timings.items()], missing | failed


def measure_second(count: int) -> dict[str, object]:
    """Where a cloth is after a second, and how far from where it must be."""
    x = np.asarray(simulate_final(build_grid(count), 960), float)
    error = float(np.abs(x.mean(axis=0) - EXPECTED_MEANS[count]).max())
    return {"mean": x.mean(axis=0).tolist(), "error": error, "lowest": float(x[:, 1].min())}


def race_copies(size: Settings) -> list[dict]:
    """(c): many small cloths in one vmap, next to one cloth of about as many nodes."""
    small, side = build_grid(16), round((256 * size.cloths) ** 0.5)
    states = jax.tree.map(lambda a: jnp.tile(a, (size.cloths, 1, 1)), small.state)

    def alone(state):
        return simulate_final(eqx.tree_at(lambda scene: scene.state, small, state), size.steps)

    many, large = f"{size.cloths} cloths of 16 x 16, vmap", f"one cloth of {side} x {side}"
    runs = {
        many: partial(jax.jit(jax.vmap(alone)), states),
        large: partial(simulate_final, build_grid(side), size.steps),
    }
    timings, failed = harness.time_side_by_side(runs, size.repeats)
    if failed:
        raise SystemExit(f"physjax failed: {failed}")
    nodes = {many: 256 * size.cloths, large: side**2}
    return [harness.make_row(name, OURS, nodes[name] * size.steps / 1e6, timing) for name, timing in timings.items()]


def measure_step_bytes(count: int) -> int:
    """Memory of a compiled step of count × count nodes, with what goes in and what comes out [bytes]."""
    scene = build_grid(count)
    step = jax.jit(lambda scene: scene.step(methods.semi_implicit_euler, 0.0, DT).state)
    held = step.lower(scene).compile().memory_analysis()
    constants = scene.forces[1].topology.present.size
    return held.temp_size_in_bytes + held.argument_size_in_bytes + held.output_size_in_bytes + constants


def main() -> None:
    """Run all studies, print their tables, write the record and the chart."""
    quick, folder = harness.parse_options(__doc__)
    size, about = QUICK if quick else FULL, harness.describe_machine()
    print_progress(harness.format_caption(about))
    scenes = {f"cloth {n} x {n}": build_grid(n) for n in size.grids}
    scenes[f"mesh, {10 * size.frequency**2 + 2:,} nodes"] = build_sphere(size.frequency)
    tables, missing = {}, {}
    for name, scene in scenes.items():
        print_progress(name)
        tables[name], reasons = race(scene, size)
        missing |= reasons
    print_progress("a thousand cloths, a second, memory")
    tables["many cloths"] = race_copies(size)
    ends = {} if quick else {n: measure_second(n) for n in EXPECTED_MEANS}
    memory = measure_step_bytes(size.many)

    bars = []
    for name, rows in tables.items():
        ours, *others = rows
        rivals = [row["rate"] for row in others if row["name"].startswith(("Warp", "Taichi"))]
        wanted = 1.0 if name.startswith("mesh") else 2.0 if name == "cloth 32 x 32" else 2.5
        if rivals:
            bars.append(
                Bar(f"{name} against the faster of Warp and Taichi [times]", ours["rate"] / max(rivals), ">=", wanted)
            )
    small, large = (row["rate"] for row in tables["many cloths"])
    bars.append(Bar("many cloths against one large one [times]", small / large, ">=", 0.5))
    bars += [
        Bar(f"{n} x {n} after a second, mean position off by [m]", end["error"], "<=", 1e-3) for n, end in ends.items()
    ]
    bars += [
        Bar(f"{n} x {n}, lowest node off by [m]", abs(end["lowest"] - EXPECTED_LOWEST), "<=", 1e-3)
        for n, end in ends.items()
    ]
    bars.append(Bar(f"a step of {size.many**2:,} nodes [GB]", memory / 1e9, "<=", 1.0))

    print(harness.format_caption(about))
    for name, rows in tables.items():
        harness.print_rates(name, "million node-steps/s", rows, rows[0]["name"])
    harness.print_bars(bars, quick)
    for name, reason in missing.items():
        print(f"left out: {name}, {reason}")
    record = {"benchmark": "cloth", "quick": quick, "machine": about, "settings": size._asdict(), "rates": tables}
    record |= {"left_out": missing, "after_a_second": ends, "step_bytes": memory}
    record["bars"] = [bar._asdict() | {"met": bar.met} for bar in bars]
    written, drawn = (harness.result_path(folder, "cloth", quick, ending) for ending in ("json", "png"))
    harness.write_json(written, record)
    unit = "million node-steps per second (logarithmic)"
    panels = [(f"{name}, springs with damping, float32", unit, rows) for name, rows in tables.items()]
    harness.draw_bar_chart(drawn, panels, harness.format_caption(about))
    print(f"\nwritten: {written} and {drawn.name}")


if __name__ == "__main__":
    main()
