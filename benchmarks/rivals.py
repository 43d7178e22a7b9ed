"""The contenders of `throughput.py`: physjax, diffrax, NumPy, C, numba and Warp, each in the way that is fast for it.

Each `with_...(lanes, steps)` yields contenders that do the same work: gravity and quadratic drag in space, float32, classical
Runge-Kutta. It raises `Missing` where a tool is not installed.
"""

import ctypes
from collections.abc import Callable, Iterator
from functools import partial
from typing import ClassVar, NamedTuple

import diffrax
import harness
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from physjax import Particles, Scene, forces, methods, ode_term, simulate

G, MASS, AREA, DRAG, AIR_DENSITY, DT = (
    9.8,
    0.145,
    4.3e-3,
    0.35,
    1.225,
    1 / 128,
)  # a baseball; the step is exact in binary
K = 0.5 * AIR_DENSITY * DRAG * AREA / MASS
OURS, JAX, OTHER = harness.COLOURS
SOFTENING_LENGTH = 0.05
HOST_LABEL = "" if jax.default_backend() == "cpu" else " (CPU)"  # marks what stays on the CPU when JAX does not
F = np.float32


class Contender(NamedTuple):
    """A contender: a name, its family, a call that returns the final positions `(lanes, 3)`, and whether it is rk4."""

    name: str
    family: str
    run: Callable[[], object]
    rk4: bool = True


def sample_shots(lanes: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities of throws in all directions at 10 to 50 m/s, `(lanes, 3)` in float32."""
    steep, around, speed = np.random.default_rng(2).uniform([[0.1], [0], [10]], [[1.4], [2 * np.pi], [50]], (3, lanes))
    aim = np.stack([np.cos(steep) * np.cos(around), np.sin(steep), np.cos(steep) * np.sin(around)], axis=-1)
    return np.zeros((lanes, 3), F), (speed[:, None] * aim).astype(F)


def build_throws(lanes: int) -> Scene:
    """The throws as a scene with gravity and drag."""
    drag = forces.QuadraticDrag(area=AREA, coefficient=DRAG, density=AIR_DENSITY)
    return Scene(Particles(*map(jnp.asarray, sample_shots(lanes))), mass=MASS, forces=(forces.Gravity(g=G), drag))


def simulate_final(scene: Scene, method: Callable, steps: int) -> jax.Array:
    """Final positions through the public `simulate`."""
    return simulate(scene, method, dt=DT, steps=steps, save_every=steps).final_scene.state.position


def with_physjax(lanes: int, steps: int) -> Iterator[Contender]:
    """Three methods; and rk4 inside a jit of the user's, where XLA fills half of an AVX-512 register."""
    scene = build_throws(lanes)
    for method in (methods.rk4, methods.verlet, methods.semi_implicit_euler):
        cheaper = "" if method is methods.rk4 else f", forces a step: {method.promises.evaluations}"
        yield Contender(
            f"physjax {method.__name__}{cheaper}", OURS, partial(simulate_final, scene, method, steps), not cheaper
        )
    inner = jax.jit(lambda scene: simulate_final(scene, methods.rk4, steps))
    yield Contender("physjax rk4, inside a user's jit", OURS, partial(inner, scene))


class ClassicalRK4(diffrax.AbstractERK):
    """The classical tableau as a diffrax solver, which diffrax does not ship."""

    tableau: ClassVar[diffrax.ButcherTableau] = diffrax.ButcherTableau(
        a_lower=(np.array([0.5]), np.array([0.0, 0.5]), np.array([0.0, 0.0, 1.0])),
        b_sol=np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6]),
        b_error=np.zeros(4),
        c=np.array([0.5, 0.5, 1.0]),
    )
    interpolation_cls: ClassVar[Callable] = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

    def order(self, terms):
        return 4


def with_diffrax(lanes: int, steps: int) -> Iterator[Contender]:
    """Fixed steps in diffrax, first in the ways that were fastest with vmap: ForwardMode and plain loops, or one scan.

    Then as most would write it, with the default adjoint and jnp.linalg.norm; and without vmap, one array for all lanes.
    """

    def by_components(t, y, args):
        v = y.velocity
        pull = -K * jnp.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
        return Particles(v, jnp.stack([pull * v[0], pull * v[1] - G, pull * v[2]]))

    def by_norm(t, y, args):
        v = y.velocity
        return Particles(v, -K * jnp.linalg.norm(v) * v - jnp.array([0.0, G, 0.0], v.dtype))

    def solve(term, solver, adjoint, y0):
        saved, count = diffrax.SaveAt(t1=True), {"max_steps": steps, "throw": False}
        found = diffrax.diffeqsolve(term, solver, 0.0, steps * DT, DT, y0, saveat=saved, adjoint=adjoint, **count)
        return found.ys.position[-1]

    def scan(term, solver, y0):
        def body(carry, i):
            y, memory = carry
            y, _, _, memory, _ = solver.step(term, i * F(DT), (i + 1) * F(DT), y, None, memory, made_jump=False)
            return (y, memory), None

        start = y0, solver.init(term, 0.0, DT, y0, None)
        return lax.scan(body, start, jnp.arange(steps, dtype=F))[0][0].position

    scene, plain = build_throws(lanes), ClassicalRK4(scan_kind="lax")
    forward, default = diffrax.ForwardMode(), diffrax.RecursiveCheckpointAdjoint()
    quick, usual = diffrax.ODETerm(by_components), diffrax.ODETerm(by_norm)
    ways = {
        "diffrax vmap, ForwardMode": jax.vmap(partial(solve, quick, plain, forward)),
        "diffrax vmap, solver.step in a scan": jax.vmap(partial(scan, quick, plain)),
        "diffrax vmap, default adjoint, norm": jax.vmap(partial(solve, usual, ClassicalRK4(), default)),
        "diffrax with physjax's ode_term, one array": partial(solve, ode_term(scene), plain, forward),
    }
    for name, way in ways.items():
        yield Contender(name, JAX, partial(jax.jit(way), scene.state))


def run_numpy_rk4(x: np.ndarray, v: np.ndarray, steps: int) -> np.ndarray:
    """The same formula in NumPy, in the dtype of the state; components first, `(3, lanes)`, or last, `(lanes, 3)`."""
    kind, first = v.dtype.type, len(v) == 3
    x, v, dt, k, two = x.copy(), v.copy(), kind(DT), kind(-K), kind(2)
    half, sixth = dt / two, dt / kind(6)
    weight = np.array([0, G, 0], kind).reshape((3, 1) if first else (1, 3))

    def acceleration(v):
        p, q, r = v if first else (v[:, 0], v[:, 1], v[:, 2])
        pull = k * np.sqrt(p * p + q * q + r * r)
        return v * (pull if first else pull[:, None]) - weight

    for _ in range(steps):
        k1 = acceleration(v)
        v2 = v + half * k1
        k2 = acceleration(v2)
        v3 = v + half * k2
        k3 = acceleration(v3)
        v4 = v + dt * k3
        x += sixth * (v + two * (v2 + v3) + v4)
        v += sixth * (k1 + two * (k2 + k3) + acceleration(v4))
    return x.T if first else x


def with_numpy(lanes: int, steps: int) -> Iterator[Contender]:
    """NumPy in both layouts; components first suit it better."""
    x, v = sample_shots(lanes)
    yield Contender(
        f"NumPy, arrays (3, lanes){HOST_LABEL}", OTHER, partial(run_numpy_rk4, x.T.copy(), v.T.copy(), steps)
    )
    yield Contender(f"NumPy, arrays (lanes, 3){HOST_LABEL}", OTHER, partial(run_numpy_rk4, x, v, steps))


C_SOURCE = r"""
#include <math.h>
#define BLOCK 64 /* lanes that take all their steps before the next ones begin */
#define PULL(u, v, w, a, b, c) { const float d = -k * sqrtf(u*u + v*v + w*w); a = d*u; b = d*v - g; c = d*w; }
#define MEAN(p, q, r, s) (sixth * (p + 2*(q + r) + s))
typedef float *restrict column;
static inline __attribute__((always_inline)) void
block(column x, column y, column z, column u, column v, column w, int lanes, long steps, float dt, float g, float k) {
  const float half = dt / 2, sixth = dt / 6;
  for (long s = 0; s < steps; s++)
    for (int i = 0; i < lanes; i++) {
      float a1, b1, c1, a2, b2, c2, a3, b3, c3, a4, b4, c4;
      const float u1 = u[i], v1 = v[i], w1 = w[i];
      PULL(u1, v1, w1, a1, b1, c1)
      const float u2 = u1 + half*a1, v2 = v1 + half*b1, w2 = w1 + half*c1;
      PULL(u2, v2, w2, a2, b2, c2)
      const float u3 = u1 + half*a2, v3 = v1 + half*b2, w3 = w1 + half*c2;
      PULL(u3, v3, w3, a3, b3, c3)
      const float u4 = u1 + dt*a3, v4 = v1 + dt*b3, w4 = w1 + dt*c3;
      PULL(u4, v4, w4, a4, b4, c4)
      x[i] += MEAN(u1, u2, u3, u4); y[i] += MEAN(v1, v2, v3, v4); z[i] += MEAN(w1, w2, w3, w4);
      u[i] = u1 + MEAN(a1, a2, a3, a4); v[i] = v1 + MEAN(b1, b2, b3, b4); w[i] = w1 + MEAN(c1, c2, c3, c4);
    }
}
void fly(column x, column y, column z, column u, column v, column w, long n, long steps, float dt, float g, float k) {
  long i = 0; /* the length of a whole block is known to the compiler */
  for (; i + BLOCK <= n; i += BLOCK) block(x+i, y+i, z+i, u+i, v+i, w+i, BLOCK, steps, dt, g, k);
  if (i < n) block(x+i, y+i, z+i, u+i, v+i, w+i, n - i, steps, dt, g, k);
}
"""


def run_columns(function: Callable, lanes: int, *numbers: float | np.floating) -> np.ndarray:
    """Run a kernel that changes six arrays in place: x, y, z and their velocities."""
    columns = [column.copy() for array in sample_shots(lanes) for column in array.T]
    function(*columns, *numbers)
    return np.stack(columns[:3], axis=-1)


def with_c(lanes: int, steps: int) -> Iterator[Contender]:
    """C by hand, one core."""
    library = harness.compile_c(C_SOURCE)
    library.fly.argtypes = [np.ctypeslib.ndpointer(F)] * 6 + [ctypes.c_long] * 2 + [ctypes.c_float] * 3
    library.fly.restype = None
    name = f"C, {'AVX-512, ' if harness.has_avx512() else ''}one core{HOST_LABEL}"
    yield Contender(name, OTHER, partial(run_columns, library.fly, lanes, lanes, steps, DT, G, K))


def with_numba(lanes: int, steps: int) -> Iterator[Contender]:
    """numba, the loops of the C, blocks of lanes over all cores."""
    numba = harness.import_optional("numba")
    fast = {"fastmath": True, "error_model": "numpy"}

    @numba.njit(inline="always", **fast)
    def pull(u, v, w, g, k):
        d = -k * np.sqrt(u * u + v * v + w * w)
        return d * u, d * v - g, d * w

    @numba.njit(inline="always", **fast)
    def mean(p, q, r, s):
        return (p + F(2) * (q + r) + s) / F(6)

    @numba.njit(parallel=True, **fast)
    def fly(x, y, z, u, v, w, steps, dt, g, k):
        half = dt / F(2)
        for block in numba.prange((x.size + 255) // 256):
            cut = slice(256 * block, min(256 * block + 256, x.size))
            X, Y, Z, U, V, W = x[cut], y[cut], z[cut], u[cut], v[cut], w[cut]
            for _ in range(steps):
                for i in range(X.size):
                    u1, v1, w1 = U[i], V[i], W[i]
                    a1, b1, c1 = pull(u1, v1, w1, g, k)
                    u2, v2, w2 = u1 + half * a1, v1 + half * b1, w1 + half * c1
                    a2, b2, c2 = pull(u2, v2, w2, g, k)
                    u3, v3, w3 = u1 + half * a2, v1 + half * b2, w1 + half * c2
                    a3, b3, c3 = pull(u3, v3, w3, g, k)
                    u4, v4, w4 = u1 + dt * a3, v1 + dt * b3, w1 + dt * c3
                    a4, b4, c4 = pull(u4, v4, w4, g, k)
                    X[i] += dt * mean(u1, u2, u3, u4)
                    Y[i] += dt * mean(v1, v2, v3, v4)
                    Z[i] += dt * mean(w1, w2, w3, w4)
                    U[i] = u1 + dt * mean(a1, a2, a3, a4)
                    V[i] = v1 + dt * mean(b1, b2, b3, b4)
                    W[i] = w1 + dt * mean(c1, c2, c3, c4)

    run = partial(run_columns, fly, lanes, steps, F(DT), F(G), F(K))
    yield Contender(f"numba, cores: {numba.get_num_threads()}{HOST_LABEL}", OTHER, run)


def with_warp(lanes: int, steps: int) -> Iterator[Contender]:
    """Warp, one thread a lane for all its steps in one launch; on the GPU where JAX is."""
    wp = harness.import_optional("warp", "warp-lang")
    wp.config.quiet, wp.config.log_level = True, 30  # the older and the newer way to hear warnings only
    gpu = jax.default_backend() == "gpu" and wp.is_cuda_available()
    device = "cuda:0" if gpu else "cpu"

    @wp.func
    def pull(v: wp.vec3, g: float, k: float):
        return -k * wp.length(v) * v - wp.vec3(0.0, g, 0.0)

    @wp.kernel
    def fly(
        x: wp.array(dtype=wp.vec3),
        v: wp.array(dtype=wp.vec3),
        y: wp.array(dtype=wp.vec3),
        n: int,
        dt: float,
        g: float,
        k: float,
    ):
        i = wp.tid()
        p = x[i]
        q = v[i]
        for _s in range(n):
            k1 = pull(q, g, k)
            q2 = q + 0.5 * dt * k1
            k2 = pull(q2, g, k)
            q3 = q + 0.5 * dt * k2
            k3 = pull(q3, g, k)
            q4 = q + dt * k3
            p = p + dt / 6.0 * (q + 2.0 * (q2 + q3) + q4)
            q = q + dt / 6.0 * (k1 + 2.0 * (k2 + k3) + pull(q4, g, k))
        y[i] = p

    start = [wp.array(array, dtype=wp.vec3, device=device) for array in sample_shots(lanes)]
    final = wp.zeros(lanes, dtype=wp.vec3, device=device)

    def run():
        wp.launch(fly, dim=lanes, inputs=[*start, final, steps, DT, G, K], device=device)
        wp.synchronize_device(device)
        return final

    yield Contender(f"Warp {wp.config.version}, {'GPU' if gpu else f'one core{HOST_LABEL}'}", OTHER, run)


# ---- the studies
