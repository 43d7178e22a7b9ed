"""A sweep as a process: run by the tests that kill it, give it two devices, or run it twice at once."""

import jax
import jax.numpy as jnp
import numpy as np

from physjax import Particles, Scene, forces, methods, simulate
from physjax.study.sweeps.sweep import sweep

AXES = {"speed": np.linspace(5.0, 40.0, 120), "angle": np.linspace(0.2, 1.3, 30)}


def thrown(speed, angle):
    launch = speed * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    air = forces.QuadraticDrag(area=4.3e-3, coefficient=0.35)
    ball = Scene(Particles(jnp.zeros(2), launch), mass=0.145, forces=(forces.Gravity(), air))
    end = simulate(ball, methods.semi_implicit_euler, dt=0.02, steps=50, save_every=50).position[-1]
    return jnp.where(speed > 39.0, jnp.nan, end)


def run(outs, *, devices=1, address=None, process=0, **options):
    """Sweep into each folder, or into memory where it is None, and write the results into the file named by it."""
    jax.config.update("jax_num_cpu_devices", devices)
    jax.config.update("jax_enable_x64", True)
    if address is not None:
        jax.distributed.initialize(address, num_processes=2, process_id=process)
    for kept, out in outs.items():
        found = sweep(thrown, AXES, progress=False, out=out, **options)
        np.savez(kept, value=found.values, status=found.status)
