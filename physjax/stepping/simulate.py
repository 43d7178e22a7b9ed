"""The loop: repeat a scene's step, keep frames, count time.

The number of steps is part of the program's shape (a scan, which can be differentiated); dt and every physical number
are data, so that changing them recompiles nothing. Reverse mode keeps the state at the frames and recomputes between
them in nested scans: memory O(frames + √save_every).
"""

import functools
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, PyTree

from physjax.backend import hide_constant, runs_as_kernel, split_compilation
from physjax.checks import as_positive_integer, as_real_argument, as_real_quantity, concrete_or_none
from physjax.closures import warn_of_recompilation
from physjax.compiling import announce_compiling
from physjax.loops import LAST_STEP, moment_at, time_at
from physjax.memory import demand_memory_for_frames
from physjax.parts import as_module, find_plain_functions, is_untransformed
from physjax.scene import Scene
from physjax.stepping.frames import Moving, choose_steps
from physjax.stepping.pairs import Remembering
from physjax.stepping.sampling import Sampling, sample_frames
from physjax.tracebacks import shorten_tracebacks
from physjax.trajectory import Trajectory, select_stateful_parts
from physjax.xla_options import jit_untransformed


@shorten_tracebacks
@jax.transfer_guard("allow")  # what a call is given goes to the device on purpose
@announce_compiling("the run")
def simulate(
    scene: Scene,
    method: Callable,
    *,
    dt: ArrayLike,
    steps: int | None = None,
    duration: float | None = None,
    save_every: int = 1,
    record: Callable | None = None,
    first_step: ArrayLike = 0,
) -> Trajectory:
    """Step a scene and keep every `save_every`-th state: compute ten, draw one.

    Give `steps`, or a `duration` [s] that is a multiple of `dt` [s]. `dt` is a scalar or shaped like
    `scene.status_shape`. Frame 0 is the start. `record=f(t, state)` keeps only that instead of the whole state; name
    the function once, a new one recompiles. `first_step` continues the count of time: `simulate(flight.final_scene,
    ..., first_step=flight.final_step)` resumes a run, up to step 2³¹ - 1. Under jit, vmap, jvp and grad as well. Raises
    ValueError or TypeError for bad numbers, MemoryError for frames that cannot fit; a run that blows up does not raise, it
    returns with `.ok` False and `.first_bad_step`.

    JAX keeps the compiled program of every scene that differs in more than numbers, some megabytes each; where there
    are thousands in one process, `jax.clear_caches()` frees them.

    Example:
        >>> run = simulate(shot, methods.verlet, dt=0.1, duration=2.0, save_every=10)
        >>> print(run.time, run.position[:, 1])
        [0. 1. 2.] [10.   9.1 -1.6]
    """
    if not isinstance(scene, Scene):
        raise TypeError(f"simulate: got a {type(scene).__name__}, expected a Scene.")
    if not callable(method):
        shown = repr(method) if isinstance(method, str) else f"of type {type(method).__name__}"
        raise TypeError(
            f"simulate: got the method {shown}, expected a function (system, t, state, dt) -> state, e.g. methods.rk4."
        )
    if record is not None and not callable(record):
        raise TypeError(f"record: got {record!r}, expected a function (t, state) -> what to keep.")
    if not jnp.issubdtype(jnp.result_type(first_step), jnp.integer):
        raise TypeError(f"first_step: got {first_step!r}, expected an integer, e.g. flight.final_step.")
    steps = _check_steps(steps, duration, dt)
    dt = _check_dt(dt, scene)
    save_every = as_positive_integer("save_every", save_every)
    if steps % save_every:
        raise ValueError(f"save_every: got {save_every}, expected a divisor of the {steps} steps. Change either.")
    method = as_module(method)
    warn_of_recompilation("simulate", (*(plain.function for plain in find_plain_functions((scene, method))), record))
    first_step, dt = _check_first_step(first_step, steps, dt)
    if record is None:
        demand_memory_for_frames(scene.state, steps, save_every)
    given = scene, method, dt, first_step
    if record is None and is_untransformed(given):
        # an array of a method may be of all lanes, of which a kernel's step is one
        in_kernel = runs_as_kernel(jax.tree.leaves(given)) and all(np.ndim(a) == 0 for a in jax.tree.leaves(method))
        small = scene.compile_bound or any(contact.many_small_kernels for contact in scene.contacts)
        run = _get_standalone_run(small, in_kernel)
    else:
        run = _run_inside
    return run(scene, method, dt, first_step, steps // save_every, save_every, record)


def _run_steps(
    scene: Scene,
    method: Callable,
    dt: ArrayLike,
    first_step: ArrayLike,
    frames: int,
    save_every: int,
    record: Callable | None,
    *,
    in_kernel: bool = False,
    inside: bool = False,
) -> Trajectory:
    """The compiled run. Only the arrays that a step changes are carried; the others stay constants of the loop.

    `inside`: part of another program, such as a user's jit, whose compiler may know dt.
    """
    dt, first_step = jnp.asarray(dt), jnp.asarray(first_step)  # of the host, where nothing is compiled
    arrays, still = eqx.partition(scene, scene.changing())
    clock = partial(time_at, dt=dt, dtype=scene.state.dtype)
    if record is None and isinstance(method, Sampling) and scene.only_moves and not in_kernel:
        states = sample_frames(scene, method, dt, first_step, frames, save_every)
        kept = eqx.filter(scene.replace(state=states), scene.changing())
        last = jax.tree.map(lambda leaf: leaf[-1], kept)
    else:
        # what rotates stores its turns at the time step
        hidden = inside and scene.state.rotates
        options = dict(in_kernel=in_kernel, hidden=hidden)
        last, kept = _step_through(scene, method, dt, first_step, frames, save_every, record, **options)
    first_kept = arrays if record is None else record(clock(first_step), scene.state)
    kept = jax.tree.map(lambda a, b: jnp.concatenate([jnp.asarray(a)[None], b]), first_kept, kept)
    film = None if record is not None else eqx.combine(kept, still)
    final_scene = eqx.combine(last, still)
    return Trajectory(
        time=jax.vmap(clock)(first_step + save_every * jnp.arange(frames + 1, dtype=jnp.int32)),
        state=None if film is None else film.state,
        parts=() if film is None else select_stateful_parts(film),
        recorded=None if record is None else kept,
        ok=scene.finite(final_scene.state),
        scene=scene,
        final_scene=final_scene,
        stepper=method,
        dt=dt,
        first_step=first_step,
        save_every=save_every,
        steps=frames * save_every,
    )


def _step_through(
    scene: Scene,
    method: Callable,
    dt: Array,
    first_step: Array,
    frames: int,
    save_every: int,
    record: Callable | None,
    *,
    in_kernel: bool,
    hidden: bool,
) -> tuple[PyTree, PyTree]:
    """What steps change of a scene, at the end and at every frame behind the first; or what is recorded there."""
    changing = scene.changing()
    arrays, still = eqx.partition(scene, changing)
    moving = Moving(arrays, start_memory(scene, method, first_step, dt))

    def step(i: Array, moving: Moving, still: PyTree, dt: Array) -> Moving:
        dt = hide_constant(dt, i) if hidden else dt
        scene, memory = take_step(eqx.combine(moving.arrays, still), method, i, dt, moving.memory)
        return Moving(eqx.filter(scene, changing), memory)

    way = choose_steps(scene, step, moving, still, dt, frame_steps=save_every, cut=record is None, in_kernel=in_kernel)

    def frame(carried: PyTree, index: Array) -> tuple[PyTree, PyTree]:
        first = first_step + index * save_every
        carried = way.advance(carried, first, save_every)
        if record is None:
            return carried, way.keep(carried)
        end = time_at(first + save_every, dt, scene.state.dtype)
        return carried, record(end, eqx.combine(way.join(carried).arrays, still).state)

    last, kept = lax.scan(frame, way.start(moving), jnp.arange(frames, dtype=jnp.int32))
    return way.join(last).arrays, way.join(kept, leading=1).arrays if record is None else kept


RUN_STRUCTURE = ("frames", "save_every", "record")
"""What of a run is structure and not numbers."""
_run_inside = jax.jit(partial(_run_steps, inside=True), static_argnames=RUN_STRUCTURE)


@functools.cache
def _get_standalone_run(many_small_kernels: bool, in_kernel: bool) -> Callable[..., Trajectory]:
    """The compiled run where no transformation is around it; made at the first run, since it asks for the device."""
    run = partial(_run_steps, in_kernel=in_kernel)
    return jit_untransformed(run, many_small_kernels=many_small_kernels, static_argnames=RUN_STRUCTURE)


def start_memory(scene: Scene, method: Callable, first_step: Array, dt: ArrayLike) -> PyTree:
    """The memory of a method that goes its own way, where nothing interferes with it; None where there is none."""
    if not isinstance(method, Remembering) or not scene.only_moves:
        return None
    return method.start(scene, moment_at(first_step, dt, scene.state.dtype), scene.state, dt)


def take_step(scene: Scene, method: Callable, i: Array, dt: ArrayLike, memory: PyTree) -> tuple[Scene, PyTree]:
    """Step number i of a loop, and the memory after it."""
    if scene.compiles_in_pieces:
        scene = scene.replace(state=split_compilation(scene.state, i))
    t = moment_at(i, dt, scene.state.dtype)
    if memory is None:
        return scene.step(method, t, dt), None
    assert isinstance(method, Remembering)
    state, memory = method.advance(scene, t, scene.state, dt, memory)
    return scene.replace(state=state), memory


@partial(jax.jit, static_argnames=("frames",))
def sample_states(scene: Scene, method: Callable, dt: ArrayLike, steps_per_frame: ArrayLike, frames: int) -> Any:
    """States at `frames` + 1 equally spaced times, with a number of steps between them that is data, not shape.

    One compilation serves every step size, as studies of the step need. A loop of a traced length has no reverse mode.
    `steps_per_frame` is an integer. Returns the state stacked along a leading axis, frame 0 the start.
    """
    dt, begun = jnp.asarray(dt), jnp.zeros((), jnp.int32)
    if isinstance(method, Sampling) and scene.only_moves:
        states = sample_frames(scene, method, dt, begun, frames, steps_per_frame)
        return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), scene.state, states)
    changing = scene.changing()
    arrays, still = eqx.partition(scene, changing)
    moving = Moving(arrays, start_memory(scene, method, begun, dt))

    def step(i: ArrayLike, moving: Moving) -> Moving:
        i = jnp.asarray(i, jnp.int32)  # a plain number where jit is disabled
        scene, memory = take_step(eqx.combine(moving.arrays, still), method, i, dt, moving.memory)
        return Moving(eqx.filter(scene, changing), memory)

    def frame(moving: Moving, index: Array) -> tuple[Moving, PyTree]:
        moving = lax.fori_loop(index * steps_per_frame, (index + 1) * steps_per_frame, step, moving)
        return moving, eqx.combine(moving.arrays, still).state

    _, states = lax.scan(frame, moving, jnp.arange(frames, dtype=jnp.int32))
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), scene.state, states)


class StateAfter(NamedTuple):
    """The state at the end, the steps taken and their length [s], and whether the state is finite, as in a `Trajectory`."""

    state: Any
    steps: Int[Array, ""]
    dt: Float[Array, ""]
    ok: Bool[Array, "..."]


@shorten_tracebacks
@jax.transfer_guard("allow")  # what a call is given goes to the device on purpose
@announce_compiling("the run")
def state_after(scene: Scene, method: Callable, *, duration: ArrayLike, dt: ArrayLike) -> StateAfter:
    """The state after a `duration` [s] in equal steps of about `dt` [s]: the nearest count that fits, at least one.

    The count is data, not shape, so that one program serves every dt, also under jit and vmap: this is how dt is swept.
    Both are one number for the scene. Forward derivatives only.

    Example:
        >>> end = state_after(shot, methods.euler, duration=1.0, dt=0.3)
        >>> int(end.steps), round(float(end.dt), 4)
        (3, 0.3333)
    """
    duration = _invalidate_nonpositive(as_real_quantity("duration [s]", duration, above=0.0).astype(scene.state.dtype))
    dt = _invalidate_nonpositive(as_real_quantity("dt [s]", dt, above=0.0).astype(scene.state.dtype))
    if duration.shape or dt.shape:
        raise ValueError(f"state_after: got shapes {duration.shape} and {dt.shape}, expected one duration and one dt.")
    steps = jnp.maximum(1, jnp.round(duration / dt)).astype(jnp.int32)
    dt = duration / steps.astype(dt.dtype)
    method = as_module(method)
    warn_of_recompilation("state_after", [plain.function for plain in find_plain_functions((scene, method))])
    states = sample_states(scene, method, dt, steps, 1)
    end = jax.tree.map(lambda leaf: leaf[-1], states)
    return StateAfter(end, steps, dt, scene.finite(end))


def _check_first_step(
    first_step: ArrayLike, steps: int, dt: Array | np.ndarray
) -> tuple[ArrayLike, Array | np.ndarray]:
    """The first step in 32 bits; the last must fit as well, or time would run backwards: a traced one makes dt NaN."""
    number = concrete_or_none(first_step)
    if number is not None and number.size and number.max() > LAST_STEP - steps:
        raise ValueError(
            f"first_step: got {number.max()} and {steps} steps, expected at most {LAST_STEP} together: steps are counted in "
            "32 bits. Take longer steps, or begin a new count: first_step=0, with what follows the clock moved by as much."
        )
    if number is not None:
        return number.astype(np.int32), dt
    return jnp.asarray(first_step, jnp.int32), jnp.where(jnp.asarray(first_step) <= LAST_STEP - steps, dt, jnp.nan)


def _check_dt(dt: ArrayLike, scene: Scene) -> Array | np.ndarray:
    """The step [s] in the scene's type; on the host where it was given there, from where the compiled run takes it."""
    dt = as_real_argument("dt [s]", dt, scene.state.dtype, above=0.0)
    if isinstance(dt, Tracer):
        dt = _invalidate_nonpositive(dt)
    if dt.shape not in ((), scene.status_shape):
        raise ValueError(
            f"dt [s]: got shape {dt.shape}, expected () or {scene.status_shape}: one step size per "
            f"{'scene, since lanes are coupled' if scene.couples else 'lane'}."
        )
    return dt


def _invalidate_nonpositive(duration: Array) -> Array:
    """A duration [s], NaN where it is traced and not > 0: then the run's status says so."""
    return jnp.where(duration > 0, duration, jnp.nan) if isinstance(duration, Tracer) else duration


def _check_steps(steps: int | None, duration: float | None, dt: ArrayLike) -> int:
    """The number of steps, given or counted from the duration; a duration that is no multiple of dt is an error."""
    if (steps is None) == (duration is None):
        given = "neither" if steps is None else "both"
        raise ValueError(f"simulate: got {given} of steps and duration, expected exactly one of them.")
    if steps is not None:
        return as_positive_integer("steps", steps)
    if isinstance(dt, Tracer) or isinstance(duration, Tracer):
        raise TypeError(
            "duration: dt or duration is being traced, so the number of steps is unknown. Give steps= instead."
        )
    with jax.ensure_compile_time_eval():  # a number stays a number inside jit
        as_real_quantity("dt [s]", dt, above=0.0)
        span = as_real_quantity("duration [s]", duration, above=0.0)
    if span.ndim:
        raise ValueError(f"duration [s]: got shape {span.shape}, expected one number.")
    # before rounding to the state's dtype: a Python 0.01 divides 5 s, the float32 next to it does not
    exact, span = np.asarray(dt), np.asarray(duration)
    counts = span.astype(float) / exact.astype(float)
    count = round(counts.flat[0])
    rounding = max(np.finfo(number.dtype).eps if number.dtype.kind == "f" else 0.0 for number in (exact, span))
    tolerance = 1e-6 + counts * rounding
    if count < 1 or np.any(np.abs(counts - count) > tolerance):
        raise ValueError(
            f"duration [s]: got {span:g} with dt {exact.flat[0]:g}, which is {counts.flat[0]:.7g} steps; "
            "expected a whole number of steps, the same in every lane. Change one of them or give steps=."
        )
    return count
