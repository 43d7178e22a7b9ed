"""Bodies that attract each other, softened: coupled, chaotic in the end, float32, leapfrog and what is like it."""

from collections.abc import Iterator
from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from harness import COLOURS, import_optional
from measures import Peer, Run, Size, Workload, weigh
from scipy.integrate import solve_ivp

from physjax import Particles, Scene, forces, methods, simulate
from workloads.tapes import build_taichi_run, build_warp_run, import_taichi, import_warp

OURS, JAX, OTHER = COLOURS
DT, SOFTENING, DIFFRAX_STRIDE = 0.01, 0.2, 4
F = np.float32


def sample_bodies(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Places in a ball of about unit size, and slow velocities; masses are 1/count and G is 1."""
    rng = np.random.default_rng(3)
    return rng.normal(size=(count, 3)).astype(F), rng.normal(scale=0.3, size=(count, 3)).astype(F)


def start(size: Size) -> np.ndarray:
    """Velocities."""
    return sample_bodies(size.lanes)[1]


def sum_attraction(x: np.ndarray) -> np.ndarray:
    """Accelerations of all bodies, all pairs at once."""
    d = x[None] - x[:, None]
    inverse = ((d * d).sum(-1) + x.dtype.type(SOFTENING**2)) ** x.dtype.type(-1.5)
    return (d * inverse[..., None]).sum(1) / x.dtype.type(len(x))


def follow_truth(size: Size, velocity: np.ndarray) -> np.ndarray:
    """SciPy's DOP853 in float64, at 1e-12."""
    x = sample_bodies(size.lanes)[0].astype(float)

    def rate(t, y):
        x, v = y.reshape(2, *velocity.shape)
        return np.concatenate([v, sum_attraction(x)]).ravel()

    begun = np.concatenate([x, velocity]).ravel()
    found = solve_ivp(rate, (0, size.steps * DT), begun, "DOP853", rtol=1e-12, atol=1e-12)
    return found.y[: x.size, -1].reshape(x.shape)


def with_physjax(size: Size) -> Run:
    """Gravitation and leapfrog."""
    place, velocity = map(jnp.asarray, sample_bodies(size.lanes))
    attraction = forces.Gravitation(G=1.0, softening=SOFTENING)
    scene = Scene(Particles(place, velocity), mass=1 / size.lanes, forces=(attraction,))

    def run(scene):
        last = simulate(scene, methods.leapfrog, dt=DT, steps=size.steps, save_every=size.steps)
        return last.final_scene.state.position

    loss = lambda v: weigh(run(scene.replace(state=Particles(place, v))))  # noqa: E731
    return Run(partial(run, scene), partial(jax.jit(jax.grad(loss)), velocity))


def with_diffrax(size: Size) -> Run:
    """Tsit5 with a quarter of the steps, which has as many evaluations and a half, and the default adjoint."""
    place, velocity = map(jnp.asarray, sample_bodies(size.lanes))

    def rate(t, y, args):
        x, v = y
        d = x[None] - x[:, None]
        inverse = (jnp.sum(d * d, axis=-1) + SOFTENING**2) ** -1.5
        return v, jnp.sum(d * inverse[..., None], axis=1) / size.lanes

    def run(v):
        step, end = DIFFRAX_STRIDE * DT, size.steps * DT
        term, most = diffrax.ODETerm(rate), size.steps // DIFFRAX_STRIDE + 4
        return diffrax.diffeqsolve(term, diffrax.Tsit5(), 0.0, end, step, (place, v), max_steps=most).ys[0][-1]

    return Run(partial(jax.jit(run), velocity), partial(jax.jit(jax.grad(lambda v: weigh(run(v)))), velocity))


def with_numpy(size: Size) -> Run:
    """All pairs at once."""

    def run():
        x, v = sample_bodies(size.lanes)
        for _ in range(size.steps):
            x = x + F(DT / 2) * v
            v = v + F(DT) * sum_attraction(x)
            x = x + F(DT / 2) * v
        return x

    return Run(run)


def with_numba(size: Size) -> Run:
    """Two loops, the outer over all cores."""
    numba = import_optional("numba")
    inverse_count, soft, half = F(1 / size.lanes), F(SOFTENING**2), F(DT / 2)

    @numba.njit(parallel=True, fastmath=True)
    def kick(x, v, dt):
        for i in numba.prange(len(x)):
            a, b, c = F(0), F(0), F(0)
            for j in range(len(x)):
                p, q, r = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
                s = F(1) / np.sqrt(p * p + q * q + r * r + soft)
                s = s * s * s
                a, b, c = a + s * p, b + s * q, c + s * r
            v[i, 0] += dt * a
            v[i, 1] += dt * b
            v[i, 2] += dt * c

    def run():
        x, v = (a.copy() for a in sample_bodies(size.lanes))
        for _ in range(size.steps):
            x += half * v
            kick(x, v, F(DT) * inverse_count)
            x += half * v
        return x

    return Run(run)


def with_rebound(size: Size) -> Run:
    """REBOUND's leapfrog, C in float64."""
    rebound = import_optional("rebound")

    def run():
        simulation = rebound.Simulation()
        simulation.G, simulation.integrator, simulation.dt = 1.0, "leapfrog", DT
        simulation.softening = SOFTENING
        for x, v in zip(*(a.astype(float) for a in sample_bodies(size.lanes)), strict=True):
            simulation.add(m=1 / size.lanes, x=x[0], y=x[1], z=x[2], vx=v[0], vy=v[1], vz=v[2])
        simulation.integrate(size.steps * DT)
        return np.array([[p.x, p.y, p.z] for p in simulation.particles])

    return Run(run)


def with_warp(size: Size) -> Run:
    """A thread a body, which loops over all others."""
    wp = import_warp()

    @wp.kernel
    def drift(x: wp.array(dtype=wp.vec3), v: wp.array(dtype=wp.vec3), h: float, y: wp.array(dtype=wp.vec3)):
        i = wp.tid()
        y[i] = x[i] + h * v[i]

    @wp.kernel
    def kick(
        x: wp.array(dtype=wp.vec3),
        v: wp.array(dtype=wp.vec3),
        h: float,
        soft: float,
        count: int,
        w: wp.array(dtype=wp.vec3),
    ):
        i = wp.tid()
        p = x[i]
        a = wp.vec3()
        for j in range(count):
            d = x[j] - p
            s = 1.0 / wp.sqrt(wp.dot(d, d) + soft)
            a += (s * s * s) * d
        w[i] = v[i] + h * a

    def launch(x, v, y, w):
        n, on = size.lanes, {"device": "cpu"}
        half = wp.zeros(n, dtype=wp.vec3, requires_grad=x.requires_grad, **on)
        wp.launch(drift, dim=n, inputs=[x, v, DT / 2], outputs=[half], **on)
        wp.launch(kick, dim=n, inputs=[half, v, DT / n, SOFTENING**2, n], outputs=[w], **on)
        wp.launch(drift, dim=n, inputs=[half, w, DT / 2], outputs=[y], **on)

    return build_warp_run(*sample_bodies(size.lanes), size.steps, launch)


def with_taichi(size: Size) -> Run:
    """A kernel a step over all pairs, which add to a field of accelerations."""
    import_taichi()
    n = size.lanes

    def build_step(ti, x, v):
        frames = x.shape[0]
        half, a = (ti.Vector.field(3, ti.f32, (frames, n), needs_grad=frames > 2) for _ in range(2))

        @ti.kernel
        def drift(s: int, e: int):
            for i in range(n):
                half[e, i] = x[s, i] + 0.5 * DT * v[s, i]
                a[e, i] = ti.Vector([0.0, 0.0, 0.0])

        @ti.kernel
        def attract(e: int):
            for i, j in ti.ndrange(n, n):
                d = half[e, j] - half[e, i]
                a[e, i] += d * (d.dot(d) + SOFTENING**2) ** -1.5 / n

        @ti.kernel
        def move(s: int, e: int):
            for i in range(n):
                v[e, i] = v[s, i] + DT * a[e, i]
                x[e, i] = half[e, i] + 0.5 * DT * (v[s, i] + DT * a[e, i])

        def step(s, e):
            drift(s, e)
            attract(e)
            move(s, e)

        return step

    return build_taichi_run(*sample_bodies(n), size, build_step)


def list_peers() -> Iterator[Peer]:
    """All that can do it."""
    yield Peer("physjax", OURS, "forces.Gravitation, leapfrog; jax.grad of simulate", with_physjax)
    yield Peer(
        "diffrax", JAX, "Tsit5 with steps four times as long, all pairs at once, the default adjoint", with_diffrax
    )
    yield Peer("NumPy", OTHER, "leapfrog, all pairs at once", with_numpy, 1024 * 20)
    yield Peer("numba", OTHER, "leapfrog, two loops, all cores", with_numba)
    yield Peer("REBOUND", OTHER, "its leapfrog in C, float64", with_rebound)
    yield Peer(
        "Warp", OTHER, "leapfrog, a thread a body that loops over all others; a launch a stage on a tape", with_warp
    )
    yield Peer("Taichi", OTHER, "leapfrog, pairs add to a field; ti.ad.Tape", with_taichi)


WORK = Workload(
    name="bodies",
    about="Bodies of mass 1/n that attract each other, softened by 0.2, float32, steps of 0.01; gradient by all initial "
    "velocities. Chaos ends every horizon.",
    exact="SciPy's DOP853 at 1e-12, float64",
    unit="m",
    scale=1.0,
    start=start,
    truth=follow_truth,
    peers=list_peers,
    checked=Size(64, 200),
    horizons=(200, 800, 1600),
    costs=(Size(256, 200), Size(1024, 20)),
)
