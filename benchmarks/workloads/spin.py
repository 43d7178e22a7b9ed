"""Free boxes that tumble: orientations after two seconds and their gradient by the spin at the start, float32."""

from collections.abc import Iterator
from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from harness import COLOURS, import_optional
from jax import lax
from measures import Peer, Run, Size, Workload, weigh
from scipy.integrate import solve_ivp

from physjax import Scene, inertia, methods, rigid, simulate

OURS, JAX, OTHER = COLOURS
DT = 0.01
F = np.float32


def sample_boxes(lanes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sides [m], orientations, and angular velocities in the frame of the box [rad/s]."""
    rng = np.random.default_rng(0)
    q = rng.normal(size=(lanes, 4))
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    return tuple(a.astype(F) for a in (rng.uniform(0.5, 2.0, (lanes, 3)), q, 2 * rng.normal(size=(lanes, 3))))


def find_moments(sides):
    """Principal moments of boxes of 1 kg."""
    square = sides * sides
    return (square.sum(-1, keepdims=True) - square) / 12


def start(size: Size) -> np.ndarray:
    """Angular velocities."""
    return sample_boxes(size.lanes)[2]


def find_rates(xp, moments, q, w):
    """Euler's equations and q' = q·(0, w)/2, lane by lane, for NumPy and JAX alike."""
    a, b, c, d = (q[..., i] for i in range(4))
    x, y, z = (w[..., i] for i in range(3))
    i, j, k = (moments[..., n] for n in range(3))
    turn = (-b * x - c * y - d * z, a * x + c * z - d * y, a * y - b * z + d * x, a * z + b * y - c * x)
    spin = ((j - k) / i * y * z, (k - i) / j * z * x, (i - j) / k * x * y)
    return xp.stack(turn, axis=-1) / 2, xp.stack(spin, axis=-1)


def point(xp, q):
    """Where the x axis of a body points, of a quaternion of any length."""
    a, b, c, d = (q[..., i] for i in range(4))
    length = a * a + b * b + c * c + d * d
    axis = (a * a + b * b - c * c - d * d, 2 * (b * c + a * d), 2 * (b * d - a * c))
    return xp.stack([part / length for part in axis], axis=-1)


def follow_truth(size: Size, spin: np.ndarray) -> np.ndarray:
    """SciPy's DOP853 of Euler's equations in float64, at 1e-12."""
    sides, q, _ = (a.astype(float) for a in sample_boxes(size.lanes))
    moments, count = find_moments(sides), 4 * size.lanes

    def rate(t, y):
        return np.concatenate(
            [r.ravel() for r in find_rates(np, moments, y[:count].reshape(-1, 4), y[count:].reshape(-1, 3))]
        )

    begun = np.concatenate([q.ravel(), spin.ravel()])
    found = solve_ivp(rate, (0, size.steps * DT), begun, "DOP853", rtol=1e-11, atol=1e-11)
    return point(np, found.y[:count, -1].reshape(-1, 4))


def with_physjax(size: Size) -> Run:
    """rigid.bodies, rk4."""
    sides, q, spin = map(jnp.asarray, sample_boxes(size.lanes))
    body, zeros = inertia.box(1.0, sides), jnp.zeros((size.lanes, 3))
    scene = Scene(rigid.bodies(body, zeros, q, angular_velocity=spin, frame="body"), body)

    def run(scene):
        last = simulate(scene, methods.rk4, dt=DT, steps=size.steps, save_every=size.steps).final_scene.state
        return point(jnp, last.orientation)

    begin = lambda spin: rigid.bodies(body, zeros, q, angular_velocity=spin, frame="body")  # noqa: E731
    loss = lambda spin: weigh(run(scene.replace(state=begin(spin))))  # noqa: E731
    return Run(partial(run, scene), partial(jax.jit(jax.grad(loss)), spin))


def with_diffrax(size: Size) -> Run:
    """Euler's equations written out, Tsit5, equal steps, under vmap."""
    sides, q, spin = map(jnp.asarray, sample_boxes(size.lanes))

    def solve(moments, q, spin):
        term = diffrax.ODETerm(lambda t, y, args: find_rates(jnp, moments, *y))
        end = diffrax.diffeqsolve(term, diffrax.Tsit5(), 0.0, size.steps * DT, DT, (q, spin), max_steps=size.steps + 4)
        return point(jnp, end.ys[0][-1])

    many = partial(jax.vmap(solve), find_moments(sides), q)
    return Run(partial(jax.jit(many), spin), partial(jax.jit(jax.grad(lambda w: weigh(many(w)))), spin))


def with_mjx(size: Size) -> Run:
    """A free joint each, RK4, contacts and constraints off, a scan of mjx.step under vmap."""
    mujoco, mjx = import_optional("mujoco"), import_optional("mujoco.mjx", "mujoco-mjx")
    model = mjx.put_model(
        mujoco.MjModel.from_xml_string(
            f'<mujoco><option timestep="{DT}" integrator="RK4" gravity="0 0 0"><flag contact="disable" constraint="disable"/>'
            '</option><worldbody><body><freejoint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody>'
            "</mujoco>"
        )
    )
    data = mjx.make_data(model)
    sides, q, spin = map(jnp.asarray, sample_boxes(size.lanes))

    def solve(moments, q, spin):
        body = model.replace(body_inertia=model.body_inertia.at[1].set(moments))
        begun = data.replace(qpos=data.qpos.at[:3].set(0).at[3:7].set(q), qvel=jnp.concatenate([jnp.zeros(3, F), spin]))
        last = lax.scan(lambda d, _: (mjx.step(body, d), None), begun, None, length=size.steps)[0]
        return point(jnp, last.qpos[3:7])

    # its gradient takes XLA on a CPU more than two minutes to compile (measured: 120 s and on, two cores)
    return Run(partial(jax.jit(partial(jax.vmap(solve), find_moments(sides), q)), spin))


def with_numpy(size: Size) -> Run:
    """Euler's equations, rk4, arrays (lanes, n)."""
    sides, q, spin = sample_boxes(size.lanes)
    moments, h = find_moments(sides), F(DT)
    rate = partial(find_rates, np, moments)

    def run():
        y = [q, spin]
        ahead = lambda y, h, k: [a + h * b for a, b in zip(y, k, strict=True)]  # noqa: E731
        for _ in range(size.steps):
            k1 = rate(*y)
            k2 = rate(*ahead(y, h / F(2), k1))
            k3 = rate(*ahead(y, h / F(2), k2))
            k4 = rate(*ahead(y, h, k3))
            y = [a + h / F(6) * (p + F(2) * (r + s) + t) for a, p, r, s, t in zip(y, k1, k2, k3, k4, strict=True)]
        return point(np, y[0])

    return Run(run)


def list_peers() -> Iterator[Peer]:
    """All that can do it."""
    yield Peer("physjax", OURS, "rigid.bodies, rk4; jax.grad of simulate", with_physjax)
    yield Peer("diffrax", JAX, "Euler's equations written out, Tsit5, equal steps, the default adjoint", with_diffrax)
    yield Peer(
        "MJX", JAX, "a free joint each, RK4, no contacts; its gradient takes minutes to compile", with_mjx, 1024 * 200
    )
    yield Peer("NumPy", OTHER, "Euler's equations written out, rk4", with_numpy)


WORK = Workload(
    name="spin",
    about="Free boxes of 1 kg that tumble in space, float32, steps of 10 ms: where the x axis of each points; gradient by all "
    "initial spins.",
    exact="SciPy's DOP853 of Euler's equations at 1e-11, float64",
    unit="1",
    scale=1.0,
    start=start,
    truth=follow_truth,
    peers=list_peers,
    checked=Size(64, 200),
    horizons=(200, 800, 2000),
    costs=(Size(1024, 200), Size(16_384, 200)),
)
