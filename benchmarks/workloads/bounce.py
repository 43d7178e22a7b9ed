"""Balls that bounce on a floor with restitution 0.8: the gradient goes through times of impact, against the closed form."""

from collections.abc import Iterator
from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from harness import COLOURS, import_optional
from jax import lax
from measures import Peer, Run, Size, Workload, weigh

from physjax import Particles, Scene, contacts, forces, methods, simulate
from workloads.tapes import build_taichi_run, build_warp_run, import_taichi, import_warp

OURS, JAX, OTHER = COLOURS
G, RESTITUTION, DT, MOST_BOUNCES = 9.8, 0.8, 0.01, 10
MJX_SUBSTEPS, MJX_STIFFNESS = 10, 2e5
F = np.float32


def sample_balls(lanes: int) -> tuple[np.ndarray, np.ndarray]:
    """Places 1 to 2 m above the floor, and velocities."""
    rng = np.random.default_rng(4)
    return rng.uniform((-1, 1, -1), (1, 2, 1), (lanes, 3)).astype(F), rng.uniform(-1, 1, (lanes, 3)).astype(F)


def start(size: Size) -> np.ndarray:
    """Velocities."""
    return sample_balls(size.lanes)[1]


def follow_truth(size: Size, velocity: np.ndarray) -> np.ndarray:
    """Parabola after parabola, in closed form."""
    x, v = sample_balls(size.lanes)[0].astype(float), velocity.astype(float)
    left = np.full(size.lanes, size.steps * DT)
    for _ in range(40):
        fall = (v[:, 1] + np.sqrt(v[:, 1] ** 2 + 2 * G * np.maximum(x[:, 1], 0.0))) / G
        span = np.minimum(fall, left)[:, None]
        hits = (fall < left)[:, None] * np.array([False, True, False])
        x = x + span * v - span**2 / 2 * np.array([0.0, G, 0.0])
        v = v - span * np.array([0.0, G, 0.0])
        x, v, left = np.where(hits, 0.0, x), np.where(hits, -RESTITUTION * v, v), left - span[:, 0]
    return x


def with_physjax(size: Size) -> Run:
    """A plane whose impacts are timed within the step."""
    place, velocity = map(jnp.asarray, sample_balls(size.lanes))
    floor = contacts.Plane((0, 0, 0), (0, 1, 0), restitution=RESTITUTION, response=contacts.impact)
    scene = Scene(Particles(place, velocity), forces=(forces.Gravity(G),), contacts=(floor,))

    def run(scene):
        return simulate(
            scene, methods.verlet, dt=DT, steps=size.steps, save_every=size.steps
        ).final_scene.state.position

    loss = lambda v: weigh(run(scene.replace(state=Particles(place, v))))  # noqa: E731
    return Run(partial(run, scene), partial(jax.jit(jax.grad(loss)), velocity))


def with_diffrax(size: Size) -> Run:
    """Flight after flight, each ended by an event whose time Newton's method finds."""
    place, velocity = map(jnp.asarray, sample_balls(size.lanes))
    end, bounce = size.steps * DT, jnp.array([1.0, -RESTITUTION, 1.0])
    term = diffrax.ODETerm(lambda t, y, args: (y[1], jnp.array([0.0, -G, 0.0], y[1].dtype)))
    event = diffrax.Event(lambda t, y, args, **_: y[0][1], optimistix.Newton(1e-5, 1e-5), direction=False)
    control = diffrax.PIDController(rtol=1e-5, atol=1e-5, dtmax=0.25)

    def solve(x, v):
        def fly(carry, _):
            t, *y = carry
            found = diffrax.diffeqsolve(
                term, diffrax.Tsit5(), t, end, 0.05, tuple(y), stepsize_controller=control, event=event, max_steps=64
            )
            t, (x, v) = found.ts[-1], jax.tree.map(lambda leaf: leaf[-1], found.ys)
            return (t, x, jnp.where(t < end, bounce * v, v)), None

        return lax.scan(fly, (jnp.zeros((), x.dtype), x, v), None, length=MOST_BOUNCES)[0][1]

    many = jax.vmap(solve)
    gradient = jax.jit(jax.grad(lambda v: weigh(many(place, v))))
    return Run(partial(jax.jit(many), place, velocity), partial(gradient, velocity))


def with_mjx(size: Size) -> Run:
    """A sphere on a plane: a contact stiff enough for these steps, damped so that it gives back 0.8; ten sub-steps."""
    mujoco, mjx = import_optional("mujoco"), import_optional("mujoco.mjx", "mujoco-mjx")
    rest = -np.log(RESTITUTION)
    damping = 2 * rest / np.hypot(np.pi, rest) * np.sqrt(MJX_STIFFNESS)
    radius = 0.1
    model = mjx.put_model(
        mujoco.MjModel.from_xml_string(
            f'<mujoco><option timestep="{DT / MJX_SUBSTEPS}" gravity="0 -{G} 0" iterations="1" ls_iterations="4"/>'
            '<worldbody><geom type="plane" size="50 50 1" euler="-90 0 0" condim="1"/><body>'
            '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/><joint type="slide" axis="0 0 1"/>'
            f'<geom type="sphere" size="{radius}" mass="1" condim="1" solref="-{MJX_STIFFNESS} -{damping}"'
            ' solimp="0.99 0.99 0.001 0.5 2" priority="1"/></body></worldbody></mujoco>'
        )
    )
    data, lift = mjx.make_data(model), jnp.array([0.0, radius, 0.0], F)
    place, velocity = map(jnp.asarray, sample_balls(size.lanes))

    def solve(x, v):
        begun = data.replace(qpos=x + lift, qvel=v)
        steps = size.steps * MJX_SUBSTEPS
        return lax.scan(lambda d, _: (mjx.step(model, d), None), begun, None, length=steps)[0].qpos - lift

    many = jax.vmap(solve)
    gradient = jax.jit(jax.grad(lambda v: weigh(many(place, v))))
    return Run(partial(jax.jit(many), place, velocity), partial(gradient, velocity))


def with_warp(size: Size) -> Run:
    """A kernel a step that goes to the time of impact and on from there."""
    wp = import_warp()

    @wp.kernel
    def move(
        x: wp.array(dtype=wp.vec3),
        v: wp.array(dtype=wp.vec3),
        y: wp.array(dtype=wp.vec3),
        w: wp.array(dtype=wp.vec3),
        h: float,
        g: float,
        keep: float,
    ):
        i = wp.tid()
        down = wp.vec3(0.0, -g, 0.0)
        p = x[i]
        u = v[i]
        q = p + h * u + 0.5 * h * h * down
        end = u + h * down
        if q[1] < 0.0 and end[1] < 0.0:
            s = (u[1] + wp.sqrt(u[1] * u[1] + 2.0 * g * wp.max(p[1], 0.0))) / g
            hit = u + s * down
            off = wp.vec3(hit[0], -keep * hit[1], hit[2])
            rest = h - s
            q = p + s * u + 0.5 * s * s * down + rest * off + 0.5 * rest * rest * down
            end = off + rest * down
        y[i] = q
        w[i] = end

    def launch(x, v, y, w):
        wp.launch(move, dim=size.lanes, inputs=[x, v], outputs=[y, w, DT, G, RESTITUTION], device="cpu")

    return build_warp_run(*sample_balls(size.lanes), size.steps, launch)


def with_taichi(size: Size) -> Run:
    """The same step, a kernel over fields of frames."""
    import_taichi()

    def build_step(ti, x, v):
        @ti.kernel
        def step(a: int, b: int):
            for i in range(size.lanes):
                down = ti.Vector([0.0, -G, 0.0])
                p, u = x[a, i], v[a, i]
                q, end = p + DT * u + 0.5 * DT * DT * down, u + DT * down
                if q[1] < 0.0 and end[1] < 0.0:
                    s = (u[1] + ti.sqrt(u[1] * u[1] + 2.0 * G * ti.max(p[1], 0.0))) / G
                    hit = u + s * down
                    off = ti.Vector([hit[0], -RESTITUTION * hit[1], hit[2]])
                    rest = DT - s
                    q = p + s * u + 0.5 * s * s * down + rest * off + 0.5 * rest * rest * down
                    end = off + rest * down
                x[b, i] = q
                v[b, i] = end

        return step

    return build_taichi_run(*sample_balls(size.lanes), size, build_step)


def list_peers() -> Iterator[Peer]:
    """All that can do it."""
    yield Peer("physjax", OURS, "a Plane with timed impacts, verlet; jax.grad of simulate", with_physjax)
    yield Peer("diffrax", JAX, "a scan of solves that end in an Event, Tsit5 at 1e-5", with_diffrax, 4096 * 200)
    yield Peer(
        "MJX",
        JAX,
        "a soft contact with its own stiffness and damping, sub-steps of 1 ms",
        with_mjx,
        64 * 200,
        "its gradient takes minutes to compile",
    )
    yield Peer("Warp", OTHER, "the time of impact written out in a kernel for this case", with_warp)
    yield Peer("Taichi", OTHER, "the time of impact written out in a kernel for this case", with_taichi)


WORK = Workload(
    name="bounce",
    about="Balls that fall from 1 to 2 m onto a floor with restitution 0.8, float32, steps of 10 ms; gradient by all "
    "initial velocities, through times of impact.",
    exact="parabola after parabola in closed form, float64",
    unit="m",
    scale=1.0,
    start=start,
    truth=follow_truth,
    peers=list_peers,
    checked=Size(64, 200),
    horizons=(100, 200, 300),
    costs=(Size(4096, 200), Size(32_768, 200)),
)
