"""Kernels in CUDA C, through CuPy, as limits of what a card can do: a flight in registers, and attraction in tiles."""

from collections.abc import Callable

import harness
import jax
import numpy as np
from rivals import DT, SOFTENING_LENGTH, F, G, K, sample_shots

THREADS = 256
"""Threads of a block; of the tiles as well."""

SOURCE = r"""
extern "C" __global__ void fly(float *s, int n, int steps, float dt, float g, float k) {
  const int i = blockDim.x * blockIdx.x + threadIdx.x;
  if (i >= n) return;
  float x = s[i], y = s[n+i], z = s[2*n+i], u = s[3*n+i], v = s[4*n+i], w = s[5*n+i];
  const float half = 0.5f * dt, sixth = dt / 6.0f;
#define PULL(U, V, W, A, B, C) const float d##A = -k * sqrtf(U*U + V*V + W*W), A = d##A*U, B = d##A*V - g, C = d##A*W;
#define MEAN(p, q, r, t) (sixth * (p + 2*(q + r) + t))
  for (int j = 0; j < steps; j++) {
    PULL(u, v, w, a1, b1, c1)
    const float u2 = u + half*a1, v2 = v + half*b1, w2 = w + half*c1;
    PULL(u2, v2, w2, a2, b2, c2)
    const float u3 = u + half*a2, v3 = v + half*b2, w3 = w + half*c2;
    PULL(u3, v3, w3, a3, b3, c3)
    const float u4 = u + dt*a3, v4 = v + dt*b3, w4 = w + dt*c3;
    PULL(u4, v4, w4, a4, b4, c4)
    x += MEAN(u, u2, u3, u4); y += MEAN(v, v2, v3, v4); z += MEAN(w, w2, w3, w4);
    u += MEAN(a1, a2, a3, a4); v += MEAN(b1, b2, b3, b4); w += MEAN(c1, c2, c3, c4);
  }
  s[i] = x; s[n+i] = y; s[2*n+i] = z; s[3*n+i] = u; s[4*n+i] = v; s[5*n+i] = w;
}
extern "C" __global__ void attract(const float4 *body, float4 *out, int n, float softening) {
  __shared__ float4 tile[256];
  const int i = blockDim.x * blockIdx.x + threadIdx.x;
  const float4 me = body[min(i, n - 1)];
  float ax = 0, ay = 0, az = 0;
  for (int first = 0; first < n; first += 256) {
    const int j = first + threadIdx.x;
    tile[threadIdx.x] = j < n ? body[j] : make_float4(0, 0, 0, 0);
    __syncthreads();
#pragma unroll 16
    for (int k = 0; k < 256; k++) {
      const float4 other = tile[k];
      const float dx = other.x - me.x, dy = other.y - me.y, dz = other.z - me.z;
      const float inverse = rsqrtf(dx*dx + dy*dy + dz*dz + softening*softening);
      const float pull = other.w * inverse * inverse * inverse;
      ax += pull*dx; ay += pull*dy; az += pull*dz;
    }
    __syncthreads();
  }
  if (i < n) out[i] = make_float4(ax, ay, az, 0);
}
"""


def load() -> tuple:
    """CuPy and the compiled kernels; `Missing` without it or without a card."""
    if jax.default_backend() != "gpu":
        raise harness.Missing("there is no GPU")
    cupy = harness.import_optional("cupy", "cupy-cuda13x")
    module = cupy.RawModule(code=SOURCE, options=("--use_fast_math",))
    return cupy, module.get_function("fly"), module.get_function("attract")


def with_flight(lanes: int, steps: int) -> Callable[[], np.ndarray]:
    """The projectiles of `rivals.build_throws`, all steps in one kernel; the call returns the final positions."""
    cupy, fly, _ = load()
    start = cupy.asarray(np.concatenate([array.T for array in sample_shots(lanes)]))

    def run() -> np.ndarray:
        state = start.copy()
        blocks = (lanes + THREADS - 1) // THREADS
        fly((blocks,), (THREADS,), (state, np.int32(lanes), np.int32(steps), F(DT), F(G), F(K)))
        cupy.cuda.Device().synchronize()
        return state[:3].T

    return run


def with_attraction(x: np.ndarray, mass: np.ndarray) -> Callable[[], np.ndarray]:
    """The accelerations of bodies at x, `(n, 3)`, that attract each other with softening, in tiles of shared memory."""
    cupy, _, attract = load()
    bodies = cupy.asarray(np.concatenate([x, mass[:, None]], axis=1).astype(F))
    out = cupy.zeros_like(bodies)

    def run() -> np.ndarray:
        blocks = (len(x) + THREADS - 1) // THREADS
        attract((blocks,), (THREADS,), (bodies, out, np.int32(len(x)), F(SOFTENING_LENGTH)))
        cupy.cuda.Device().synchronize()
        return out[:, :3]

    return run
