"""Baseballs with quadratic drag: independent lanes, smooth, float32, 200 steps of classical Runge-Kutta and what is like it."""

from collections.abc import Iterator
from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import rivals
from measures import Peer, Run, Size, Workload, weigh
from rivals import DT, JAX, OTHER, OURS, G, K

from physjax import Particles, methods
from workloads.tapes import build_taichi_run, build_warp_run, import_taichi, import_warp


def start(size: Size) -> np.ndarray:
    """Velocities."""
    return rivals.sample_shots(size.lanes)[1]


def follow_truth(size: Size, velocity: np.ndarray) -> np.ndarray:
    """The same formula in float64 with four times as many steps: its error is a 256th of that of the step itself."""
    x, v = np.zeros_like(velocity.T, float), velocity.T.astype(float)
    fine = 4
    for _ in range(size.steps * fine):
        x, v = take_rk4_step(x, v, DT / fine)
    return x.T


def take_rk4_step(x: np.ndarray, v: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """A step in NumPy, components first."""
    weight = np.array([[0.0], [G], [0.0]])
    pull = lambda v: -K * np.sqrt((v * v).sum(0)) * v - weight  # noqa: E731
    k1 = pull(v)
    k2 = pull(v2 := v + dt / 2 * k1)
    k3 = pull(v3 := v + dt / 2 * k2)
    k4 = pull(v4 := v + dt * k3)
    return x + dt / 6 * (v + 2 * (v2 + v3) + v4), v + dt / 6 * (k1 + 2 * (k2 + k3) + k4)


def with_physjax(size: Size) -> Run:
    """The public `simulate`, and `jax.grad` of it."""
    scene = rivals.build_throws(size.lanes)

    def loss(velocity):
        thrown = scene.replace(state=Particles(scene.state.position, velocity))
        return weigh(rivals.simulate_final(thrown, methods.rk4, size.steps))

    run = partial(rivals.simulate_final, scene, methods.rk4, size.steps)
    return Run(run, partial(jax.jit(jax.grad(loss)), scene.state.velocity))


def with_diffrax(size: Size) -> Run:
    """`diffeqsolve` under vmap: Tsit5, constant steps, the default adjoint."""

    def rate(t, y, args):
        _x, v = y
        speed = jnp.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
        return v, -K * speed * v - jnp.array([0.0, G, 0.0], v.dtype)

    def solve(velocity):
        y0, term = (jnp.zeros_like(velocity), velocity), diffrax.ODETerm(rate)
        end = diffrax.diffeqsolve(term, diffrax.Tsit5(), 0.0, size.steps * DT, DT, y0, max_steps=size.steps + 4)
        return end.ys[0][-1]

    velocity, many = jnp.asarray(start(size)), jax.vmap(solve)
    return Run(partial(jax.jit(many), velocity), partial(jax.jit(jax.grad(lambda v: weigh(many(v)))), velocity))


def with_numpy(size: Size) -> Run:
    """Arrays `(3, lanes)`."""
    x, v = rivals.sample_shots(size.lanes)
    return Run(partial(rivals.run_numpy_rk4, x.T.copy(), v.T.copy(), size.steps))


def with_numba(size: Size) -> Run:
    """Blocks of lanes through all steps."""
    return Run(next(rivals.with_numba(size.lanes, size.steps)).run)


def with_warp(size: Size) -> Run:
    """All steps in one kernel; for the gradient a launch a step on a tape."""
    wp = import_warp()
    whole = next(rivals.with_warp(size.lanes, size.steps)).run

    @wp.func
    def pull(v: wp.vec3, g: float, k: float):
        return -k * wp.length(v) * v - wp.vec3(0.0, g, 0.0)

    @wp.kernel
    def move(
        x: wp.array(dtype=wp.vec3),
        v: wp.array(dtype=wp.vec3),
        y: wp.array(dtype=wp.vec3),
        w: wp.array(dtype=wp.vec3),
        h: float,
        g: float,
        k: float,
    ):
        i = wp.tid()
        q = v[i]
        k1 = pull(q, g, k)
        q2 = q + 0.5 * h * k1
        k2 = pull(q2, g, k)
        q3 = q + 0.5 * h * k2
        k3 = pull(q3, g, k)
        q4 = q + h * k3
        y[i] = x[i] + h / 6.0 * (q + 2.0 * (q2 + q3) + q4)
        w[i] = q + h / 6.0 * (k1 + 2.0 * (k2 + k3) + pull(q4, g, k))

    def launch(x, v, y, w):
        wp.launch(move, dim=size.lanes, inputs=[x, v], outputs=[y, w, DT, G, K], device="cpu")

    return Run(whole, build_warp_run(*rivals.sample_shots(size.lanes), size.steps, launch).gradient)


def with_taichi(size: Size) -> Run:
    """A kernel a step over fields of frames."""
    import_taichi()

    def build_step(ti, x, v):
        @ti.func
        def pull(q):
            return -K * q.norm() * q - ti.Vector([0.0, G, 0.0])

        @ti.kernel
        def step(a: int, b: int):
            for i in range(size.lanes):
                q = v[a, i]
                k1 = pull(q)
                q2 = q + 0.5 * DT * k1
                k2 = pull(q2)
                q3 = q + 0.5 * DT * k2
                k3 = pull(q3)
                q4 = q + DT * k3
                x[b, i] = x[a, i] + DT / 6.0 * (q + 2.0 * (q2 + q3) + q4)
                v[b, i] = q + DT / 6.0 * (k1 + 2.0 * (k2 + k3) + pull(q4))

        return step

    return build_taichi_run(*rivals.sample_shots(size.lanes), size, build_step)


def list_peers() -> Iterator[Peer]:
    """All that can do it; MJX has no force like that."""
    yield Peer("physjax", OURS, "simulate, rk4; jax.grad of it", with_physjax)
    yield Peer("diffrax", JAX, "diffeqsolve under vmap: Tsit5, equal steps, the default adjoint", with_diffrax)
    yield Peer("NumPy", OTHER, "rk4, arrays (3, lanes)", with_numpy)
    yield Peer("numba", OTHER, "rk4, blocks of lanes through all steps, all cores", with_numba)
    yield Peer("Warp", OTHER, "rk4 in one kernel; the gradient by a launch a step on a tape", with_warp)
    yield Peer("Taichi", OTHER, "rk4, a kernel a step over fields of frames, ti.ad.Tape", with_taichi)


WORK = Workload(
    name="projectile",
    about="Baseballs under gravity and quadratic drag in space, float32, steps of 1/128 s; gradient by all initial velocities.",
    exact="classical Runge-Kutta in float64 with a quarter of the step",
    unit="m",
    scale=50.0,
    start=start,
    truth=follow_truth,
    peers=list_peers,
    checked=Size(64, 200),
    horizons=(50, 200, 800, 2000),
    costs=(Size(4096, 200), Size(65_536, 200)),
)
