"""How Warp and Taichi differentiate a loop, as their documentation shows: an array for each step, a launch a step, a tape."""

import functools
from collections.abc import Callable
from types import ModuleType

import harness
import numpy as np
from measures import Run, Size

F = np.float32


@functools.cache
def import_warp() -> ModuleType:
    """Warp, quiet; `Missing` where it is not installed."""
    wp = harness.import_optional("warp", "warp-lang")
    wp.config.quiet, wp.config.log_level = True, 30  # the older and the newer way to hear warnings only
    return wp


@functools.cache
def import_taichi() -> ModuleType:
    """Taichi on all cores; `Missing` where it is not installed."""
    ti = harness.import_optional("taichi")
    ti.init(arch=ti.cpu, log_level=ti.ERROR, offline_cache=False, default_fp=ti.f32)
    return ti


def build_warp_run(x0: np.ndarray, v0: np.ndarray, steps: int, launch: Callable, differentiable: bool = True) -> Run:
    """A run whose step is `launch(x, v, x_after, v_after)`; its gradient is by the velocities at the start."""
    wp = import_warp()
    vec, on = wp.vec3, {"device": "cpu"}

    @wp.kernel
    def weigh(x: wp.array(dtype=wp.vec3), loss: wp.array(dtype=float)):
        p = x[wp.tid()]
        wp.atomic_add(loss, 0, p[0] + 2.0 * p[1] + 3.0 * p[2])

    def forward():
        x, v = ([wp.array(a, dtype=vec, **on), wp.zeros(len(a), dtype=vec, **on)] for a in (x0, v0))
        for s in range(steps):
            a, b = s % 2, 1 - s % 2
            launch(x[a], v[a], x[b], v[b])
        return x[steps % 2].numpy()

    def gradient():
        option = {"dtype": vec, "requires_grad": True, **on}
        x, v = ([wp.array(a, **option), *(wp.zeros(len(a), **option) for _ in range(steps))] for a in (x0, v0))
        loss, tape = wp.zeros(1, dtype=float, requires_grad=True, **on), wp.Tape()
        with tape:
            for s in range(steps):
                launch(x[s], v[s], x[s + 1], v[s + 1])
            wp.launch(weigh, dim=len(x0), inputs=[x[steps]], outputs=[loss], **on)
        tape.backward(loss)
        return v[0].grad.numpy()

    return Run(forward, gradient if differentiable else None)


def build_taichi_run(x0: np.ndarray, v0: np.ndarray, size: Size, build_step: Callable) -> Run:
    """A run whose step is `build_step(ti, x, v)(a, b)`, from frame a to b of fields; its gradient as Warp's."""
    ti, steps, count = import_taichi(), size.steps, len(x0)

    def make(frames, differentiated):
        x, v = (ti.Vector.field(3, ti.f32, (frames, count), needs_grad=differentiated) for _ in range(2))
        return x, v, build_step(ti, x, v)

    @functools.cache
    def make_short():
        return *make(2, False), np.zeros((2, count, 3), F), np.zeros((2, count, 3), F)

    def forward():
        x, v, step, xs, vs = make_short()
        xs[0], vs[0] = x0, v0
        x.from_numpy(xs)
        v.from_numpy(vs)
        for s in range(steps):
            step(s % 2, 1 - s % 2)
        return x.to_numpy()[steps % 2]

    @functools.cache
    def make_long():
        x, v, step = make(steps + 1, True)
        loss = ti.field(ti.f32, (), needs_grad=True)

        @ti.kernel
        def weigh():
            for i in range(count):
                p = x[steps, i]
                loss[None] += p[0] + 2.0 * p[1] + 3.0 * p[2]

        xs, vs = (np.zeros((steps + 1, count, 3), F) for _ in range(2))
        xs[0], vs[0] = x0, v0
        x.from_numpy(xs)
        v.from_numpy(vs)
        return v, step, loss, weigh

    def gradient():
        v, step, loss, weigh = make_long()
        loss[None] = 0.0
        with ti.ad.Tape(loss):
            for s in range(steps):
                step(s, s + 1)
            weigh()
        return v.grad.to_numpy()[0]

    return Run(forward, gradient)
