"""What is read from a run: a frame, the state at any time between frames, and its frames as tables with names."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, PyTree

from physjax.checks import concrete_or_none
from physjax.loops import moment_at

UNITS = {"position": "m", "velocity": "m/s", "momentum": "kg m/s", "angular_momentum": "kg m²/s", "angle": "rad"}
"""Units of the fields of states."""
AXES = "xyz"
"""Names of components."""


def pick_frame(states: PyTree, frame: int, count: int, batch: int) -> PyTree:
    """The state at a frame; IndexError beyond the run, TypeError for what is no number of a frame."""
    if isinstance(frame, bool) or not isinstance(frame, int | np.integer):
        raise TypeError(
            f"flight[{frame!r}]: expected the number of a frame, e.g. flight[-1]; for arrays flight.position."
        )
    if not -count <= frame < count:
        raise IndexError(
            f"flight[{frame}]: got frame {frame}, expected {-count} to {count - 1}: the run has {count} frames."
        )
    return jax.tree.map(lambda leaf: leaf[(slice(None),) * batch + (int(frame) % count,)], states)


def step_to_time(run: Any, t: ArrayLike) -> PyTree:
    """The state at the times `t` [s] of a run, stepped to them from the frames before."""
    times, dt = run.time, run.dt
    if np.ndim(dt) or np.ndim(run.first_step):
        raise ValueError("at: got a run with a step for each lane or out of vmap, expected one run with one dt.")
    known = concrete_or_none(t), concrete_or_none(times)
    if known[0] is not None and known[1] is not None:
        low, high = float(known[1][0]), float(known[1][-1])
        slack = 1e-6 * (high - low)
        if not np.all((known[0] >= low - slack) & (known[0] <= high + slack)):
            raise ValueError(f"at: got t = {known[0]} s, expected times of the run, from {low:g} to {high:g} s.")
    t = jnp.asarray(t, times.dtype)
    arrays, still = eqx.partition(run.film, run.scene.changing())
    step = partial(_step_to_moment, run.stepper, arrays, still, jnp.asarray(times), jnp.asarray(dt), run.save_every)
    flat = lax.map(lambda moment: step(run.first_step, moment), t.reshape(-1))
    return jax.tree.map(lambda leaf: leaf.reshape(*t.shape, *leaf.shape[1:]), flat)


@partial(jax.jit, static_argnames="save_every")
def _step_to_moment(
    method: Any,
    arrays: PyTree,
    still: PyTree,
    times: Array,
    dt: Array,
    save_every: int,
    first_step: ArrayLike,
    t: Array,
) -> PyTree:
    """Whole steps from the frame before a moment, and a step that is as short as what is left."""
    frame = jnp.clip(jnp.searchsorted(times, lax.stop_gradient(t), side="right") - 1, 0, len(times) - 1)
    begun = jax.tree.map(lambda leaf: leaf[frame], arrays)
    first = jnp.asarray(first_step, jnp.int32) + frame.astype(jnp.int32) * save_every
    count = jnp.clip(jnp.floor(lax.stop_gradient((t - times[frame]) / dt)), 0, save_every).astype(jnp.int32)

    def step(i: Array, carried: PyTree) -> PyTree:
        scene = eqx.combine(carried, still)
        moved = scene.step(method, moment_at(first + i, dt, scene.state.dtype), dt)
        changed = jax.tree.map(
            lambda old, new: None if old is None else new, carried, moved, is_leaf=lambda x: x is None
        )
        return jax.tree.map(lambda a, b: jnp.where(i < count, a, b), changed, carried)

    # a loop of known length, so that it can be differentiated
    carried, _ = lax.scan(lambda c, i: (step(i, c), None), begun, jnp.arange(save_every, dtype=jnp.int32))
    scene = eqx.combine(carried, still)
    moment = moment_at(first + count, dt, scene.state.dtype)
    rest = t - (times[frame] + count.astype(dt.dtype) * dt)
    moved = scene.step(method, moment, jnp.where(rest > 0, rest, dt))
    return jax.tree.map(lambda a, b: jnp.where(rest > 0, a, b), moved.state, scene.state)


def build_dataset(run: Any) -> Any:
    """The frames as an xarray.Dataset."""
    try:
        import xarray
    except ImportError as error:
        raise ImportError("to_xarray needs xarray: pip install 'physjax[sweep]'.") from error
    time, fields = _read_fields(run)
    lanes = np.shape(run.position)[1:-1]
    names = [f"lane_{i}" if len(lanes) > 1 else "lane" for i in range(len(lanes))]
    variables = {}
    for name, array in fields.items():
        extra = array.ndim - 1 - len(lanes)
        kind = "component" if array.shape[-1] == np.shape(run.position)[-1] else f"{name}_component"
        variables[name] = (["time", *names, *([kind] if extra else [])], array, {"units": UNITS.get(name, "")})
    dim = np.shape(run.position)[-1]
    coordinates = {"time": ("time", time, {"units": "s"}), "component": list(AXES[:dim])}
    return xarray.Dataset(variables, coordinates)


def build_frame_table(run: Any) -> Any:
    """The frames as a pandas.DataFrame."""
    try:
        import pandas
    except ImportError as error:
        raise ImportError("to_pandas needs pandas: pip install pandas.") from error
    time, fields = _read_fields(run)
    lanes = np.shape(run.position)[1:-1]
    indices = np.indices((len(time), *lanes)).reshape(1 + len(lanes), -1)
    columns = {"time": time[indices[0]]}
    columns |= {f"lane_{i}" if len(lanes) > 1 else "lane": index for i, index in enumerate(indices[1:])}
    for name, array in fields.items():
        if array.ndim == 1 + len(lanes):
            columns[name] = array.ravel()
            continue
        ends = AXES if array.shape[-1] <= len(AXES) else "wxyz"
        columns |= {f"{name}_{ends[i]}": array[..., i].ravel() for i in range(array.shape[-1])}
    return pandas.DataFrame(columns)


def _read_fields(run: Any) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Times and the fields of the states by name; ValueError for a run out of vmap or with a time for each lane."""
    if np.ndim(run.time) != 1:
        raise ValueError(f"got times {np.shape(run.time)}, expected one run with one time for all lanes.")
    position = run.position  # which says so where there are no states
    states = run.state
    return np.asarray(run.time), {"position": np.asarray(position)} | {
        name: np.asarray(getattr(states, name)) for name in states._fields
    }


__all__ = ["build_dataset", "build_frame_table", "pick_frame", "step_to_time"]
