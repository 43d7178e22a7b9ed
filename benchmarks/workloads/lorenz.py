"""The ensemble of GPUODEBenchmarks: Lorenz' equations, ρ from 0 to 21 across lanes, float32, 1000 equal steps or errors of 1e-8.

The equations, the solver (Tsit5), its tolerances and the way in which diffrax is asked are that suite's own
(github.com/utkarsh530/GPUODEBenchmarks, GPU_ODE_JAX/bench_diffrax.py). Also the gradient by ρ, which that suite has not.
"""

from functools import partial
from typing import Any

import diffrax
import harness
import jax
import jax.numpy as jnp
import measures
import numpy as np
from harness import COLOURS, print_progress
from measures import Peer, Run, Size
from scipy.integrate import solve_ivp

from physjax import methods, ode_scene, simulate

OURS, JAX, _ = COLOURS
TOLERANCE, STEPS, DT, CHECKED = 1e-8, 1000, 1e-3, 64
LANES, QUICK_LANES = (8, 1024, 32_768, 131_072), (8, 1024)


def find_rate(t, y, rho):
    """Lorenz' equations."""
    return jnp.stack([10.0 * (y[1] - y[0]), rho * y[0] - y[1] - y[0] * y[2], y[0] * y[1] - (8 / 3) * y[2]])


def follow_truth(lanes: int) -> np.ndarray:
    """SciPy's DOP853 in float64, at 1e-12."""

    def solve(rho):
        rate = lambda t, y: (10 * (y[1] - y[0]), rho * y[0] - y[1] - y[0] * y[2], y[0] * y[1] - 8 / 3 * y[2])  # noqa: E731
        return solve_ivp(rate, (0, 1), (1.0, 0.0, 0.0), "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]

    return np.array([solve(rho) for rho in np.linspace(0.0, 21.0, lanes)])


def with_physjax(adaptive: bool, method: Any, size: Size) -> Run:
    """`ode_scene`, the parameter of each lane in `parameters`."""
    method, steps = (methods.adaptive(method, TOLERANCE, TOLERANCE), 1) if adaptive else (method, STEPS)
    y0 = jnp.zeros((size.lanes, 3)).at[:, 0].set(1.0)
    rho = jnp.linspace(0.0, 21.0, size.lanes)
    scene = ode_scene(find_rate, y0, rho)

    def run(scene):
        return simulate(scene, method, dt=1.0 / steps, steps=steps, save_every=steps).final_scene.state.y

    gradient = jax.jit(jax.grad(lambda rho: measures.weigh(run(ode_scene(find_rate, y0, rho)))))
    return Run(partial(run, scene), partial(gradient, rho))


def with_diffrax(adaptive: bool, size: Size) -> Run:
    """vmap of diffeqsolve, as that suite writes it."""
    control = diffrax.PIDController(rtol=TOLERANCE, atol=TOLERANCE) if adaptive else diffrax.ConstantStepSize()

    def solve(rho):
        term, y0 = diffrax.ODETerm(lambda t, y, args: find_rate(t, y, rho)), jnp.array([1.0, 0.0, 0.0])
        return diffrax.diffeqsolve(
            term, diffrax.Tsit5(), 0.0, 1.0, DT, y0, stepsize_controller=control, max_steps=4096, throw=False
        ).ys[-1]

    many, rho = jax.vmap(solve), jnp.linspace(0.0, 21.0, size.lanes)
    return Run(partial(jax.jit(many), rho), partial(jax.jit(jax.grad(lambda rho: measures.weigh(many(rho)))), rho))


def list_peers(adaptive: bool) -> list[Peer]:
    """Ours, and diffrax."""
    kind = f"errors of {TOLERANCE:g}" if adaptive else f"{STEPS} equal steps"
    ours = [("physjax", "tsit5", methods.tsit5)] + [("physjax rk4", "rk4", methods.rk4)] * (not adaptive)
    found = [Peer(n, OURS, f"ode_scene, {name}, {kind}", partial(with_physjax, adaptive, m)) for n, name, m in ours]
    return [*found, Peer("diffrax", JAX, f"vmap of diffeqsolve, Tsit5, {kind}", partial(with_diffrax, adaptive))]


def measure(quick: bool, peers: bool) -> list[dict[str, Any]]:
    """Errors and costs of both parts, by lanes."""
    rows, truth = [], follow_truth(CHECKED)
    repeats = 3 if quick else 5
    for part in ("fixed", "adaptive"):
        print_progress(f"  {part}")
        able = [peer for peer in list_peers(part == "adaptive") if peers or "physjax" in peer.name]
        for peer in able:
            found = measures.as_numbers(peer.build(Size(CHECKED, STEPS)).forward())
            error = float(np.abs(found - truth).max())
            size = Size(CHECKED, STEPS)
            rows.append(measures.make_row("runs", peer, size, ok=True, differentiates=True, how=peer.how, part=part))
            row = measures.make_row("forward", peer, size, error=error, relative=error / 20, unit="1", part=part)
            rows.append(row)
            print_progress(f"  {peer.name}: off by {error:.2g}")
        for lanes in QUICK_LANES if quick else LANES:
            size = Size(lanes, STEPS)
            rows += _measure_cost(able, size, part, "forward", repeats)
            if lanes <= 1024:
                rows += _measure_cost(able, size, part, "gradient", repeats)
    return rows


def _measure_cost(able: list[Peer], size: Size, part: str, of: str, repeats: int) -> list[dict[str, Any]]:
    print_progress(f"  {of}, {size.lanes:,} lanes")
    by_name = {peer.name: peer for peer in able}
    timings, failed = harness.time_side_by_side({p.name: getattr(p.build(size), of) for p in able}, repeats)
    rows = [
        measures.make_row("cost", by_name[n], size, of=of, part=part, **measures.describe_timing(t))
        for n, t in timings.items()
    ]
    return rows + [
        measures.make_row("cost", by_name[n], size, of=of, part=part, failed=why) for n, why in failed.items()
    ]
