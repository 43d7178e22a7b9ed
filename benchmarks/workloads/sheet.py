"""NVIDIA's cloth case with its gradient: springs with damping on a grid, two corners pinned, semi-implicit Euler, float32."""

import importlib.util
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from harness import COLOURS
from measures import Peer, Run, Size, Workload, weigh

from physjax import Scene
from workloads.tapes import build_taichi_run, build_warp_run, import_taichi, import_warp

OURS, _, OTHER = COLOURS
F, FINE = np.float32, 16


def _load_study():
    """The study of this cloth, which has the case."""
    spec = importlib.util.spec_from_file_location("cloth_study", Path(__file__).parents[1] / "cloth.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


study = _load_study()
K, DAMPING, MASS, G, DT = study.K, study.DAMPING, study.MASS, study.G, study.DT


def build_scene(size: Size) -> Scene:
    """The cloth of so many nodes, moving a little."""
    scene = study.build_grid(round(size.lanes**0.5))
    return scene.replace(state=scene.state._replace(velocity=jnp.asarray(start(size))))


def start(size: Size) -> np.ndarray:
    """Velocities, of pinned corners 0."""
    free = 1 - np.asarray(study.build_grid(round(size.lanes**0.5)).pinned).astype(F)
    return np.random.default_rng(5).normal(scale=0.1, size=(size.lanes, 3)).astype(F) * free[:, None]


def step_numpy(given, x: np.ndarray, v: np.ndarray, dt: float, count: int) -> np.ndarray:
    """Steps in NumPy, in the type of x; held nodes do not move."""
    kind, (i, j) = x.dtype.type, given.pairs.T
    rest, free = given.rest.astype(kind), given.free.astype(kind)[:, None]
    weight = np.array([0, -G, 0], kind)
    for _ in range(count):
        d, w = x[j] - x[i], v[j] - v[i]
        length = np.sqrt((d * d).sum(-1))
        d /= length[:, None]
        d *= (kind(K) * (length - rest) + kind(DAMPING) * (d * w).sum(-1))[:, None]
        pull = [np.bincount(i, f, len(x)) - np.bincount(j, f, len(x)) for f in d.T]
        v = v + kind(dt) * free * (np.stack(pull, axis=-1).astype(kind) / kind(MASS) + weight)
        x = x + kind(dt) * v
    return x


def follow_truth(size: Size, velocity: np.ndarray) -> np.ndarray:
    """The same step in float64, sixteen for one."""
    given = study.build_case(study.build_grid(round(size.lanes**0.5)))
    return step_numpy(given, given.x.astype(float), velocity.astype(float), DT / FINE, size.steps * FINE)


def with_physjax(size: Size) -> Run:
    """The public `simulate`."""
    scene = build_scene(size)
    loss = lambda v: weigh(study.simulate_final(scene.replace(state=scene.state._replace(velocity=v)), size.steps))  # noqa: E731
    run = partial(study.simulate_final, scene, size.steps)
    return Run(run, partial(jax.jit(jax.grad(loss)), scene.state.velocity))


def with_numpy(size: Size) -> Run:
    """Forces on springs, summed at their ends by bincount."""
    given = study.build_case(build_scene(size))
    return Run(partial(step_numpy, given, given.x, start(size), DT, size.steps))


def with_warp(size: Size) -> Run:
    """A thread for each spring, which adds to both ends, then one for each node."""
    wp = import_warp()
    vectors, numbers = wp.array(dtype=wp.vec3), wp.array(dtype=float)

    @wp.kernel
    def pull(x: vectors, v: vectors, pairs: wp.array(dtype=int), rest: numbers, k: float, c: float, f: vectors):
        s = wp.tid()
        i = pairs[2 * s]
        j = pairs[2 * s + 1]
        d = x[j] - x[i]
        length = wp.length(d)
        along = d * (1.0 / length)
        force = along * (k * (length - rest[s]) + c * wp.dot(along, v[j] - v[i]))
        wp.atomic_add(f, i, force)
        wp.atomic_sub(f, j, force)

    @wp.kernel
    def move(x: vectors, v: vectors, f: vectors, inverse: numbers, dt: float, g: float, y: vectors, w: vectors):
        n = wp.tid()
        a = f[n] * inverse[n]
        if inverse[n] > 0.0:
            a = a - wp.vec3(0.0, g, 0.0)
        u = v[n] + a * dt
        w[n] = u
        y[n] = x[n] + u * dt

    given, on = study.build_case(build_scene(size)), {"device": "cpu"}
    pairs = wp.array(given.pairs.ravel(), dtype=int, **on)
    rest, inverse = (wp.array(a.astype(F), dtype=float, **on) for a in (given.rest, given.free / MASS))

    def launch(x, v, y, w):
        f = wp.zeros(len(given.x), dtype=wp.vec3, requires_grad=x.requires_grad, **on)
        wp.launch(pull, dim=len(given.pairs), inputs=[x, v, pairs, rest, K, DAMPING], outputs=[f], **on)
        wp.launch(move, dim=len(given.x), inputs=[x, v, f, inverse, DT, G], outputs=[y, w], **on)

    return build_warp_run(given.x, start(size), size.steps, launch)


def with_taichi(size: Size) -> Run:
    """The kernels of Warp, over fields of frames."""
    import_taichi()
    given = study.build_case(build_scene(size))
    nodes, count = len(given.x), len(given.pairs)

    def build_step(ti, x, v):
        frames = x.shape[0]
        f = ti.Vector.field(3, ti.f32, (frames, nodes), needs_grad=frames > 2)
        pairs, rest, inverse = ti.field(ti.i32, (count, 2)), ti.field(ti.f32, count), ti.field(ti.f32, nodes)
        pairs.from_numpy(given.pairs.astype(np.int32))
        rest.from_numpy(given.rest.astype(F))
        inverse.from_numpy((given.free / MASS).astype(F))

        @ti.kernel
        def clear(b: int):
            for n in range(nodes):
                f[b, n] = ti.Vector([0.0, 0.0, 0.0])

        @ti.kernel
        def pull(a: int, b: int):
            for s in range(count):
                i, j = pairs[s, 0], pairs[s, 1]
                d = x[a, j] - x[a, i]
                length = d.norm()
                along = d / length
                force = along * (K * (length - rest[s]) + DAMPING * along.dot(v[a, j] - v[a, i]))
                f[b, i] += force
                f[b, j] -= force

        @ti.kernel
        def move(a: int, b: int):
            for n in range(nodes):
                w = inverse[n]
                u = v[a, n] + DT * (f[b, n] * w - ti.select(w > 0.0, 1.0, 0.0) * ti.Vector([0.0, G, 0.0]))
                v[b, n] = u
                x[b, n] = x[a, n] + DT * u

        def step(a, b):
            clear(b)
            pull(a, b)
            move(a, b)

        return step

    return build_taichi_run(given.x, start(size), size, build_step)


def list_peers() -> Iterator[Peer]:
    """All that can do it."""
    yield Peer("physjax", OURS, "lattices.cloth, semi-implicit Euler; jax.grad of simulate", with_physjax)
    yield Peer("NumPy", OTHER, "semi-implicit Euler, springs in arrays, bincount", with_numpy)
    yield Peer("Warp", OTHER, "semi-implicit Euler, atomic adds, two launches a step on a tape", with_warp)
    yield Peer("Taichi", OTHER, "semi-implicit Euler, atomic adds; ti.ad.Tape", with_taichi)


WORK = Workload(
    name="sheet",
    about="NVIDIA's cloth case: springs with damping, two corners pinned, 960 steps a second of semi-implicit Euler, float32; "
    "gradient by the velocities of all nodes.",
    exact="the same step in float64, sixteen for one",
    unit="m",
    scale=1.0,
    start=start,
    truth=follow_truth,
    peers=list_peers,
    checked=Size(256, 160),
    horizons=(40, 160, 480),
    costs=(Size(1024, 160), Size(16_384, 160)),
)
