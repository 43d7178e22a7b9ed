"""What a run returns: frames over time, a status per lane, and enough memory of the run to step again inside it."""

import os
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, PyTree

from physjax.checks import concrete_or_none
from physjax.crossing import BodyCrossing, Crossing, find_crossing
from physjax.files import RUN_FORMAT, demand_saved_run, read_arrays, write_atomically
from physjax.lazy import call_late
from physjax.loops import moment_at
from physjax.memories import replace_memories, select_stateful_parts
from physjax.moments import build_dataset, build_frame_table, pick_frame, step_to_time
from physjax.particles import Particles, callable_name, view_centers
from physjax.parts import Function
from physjax.run_files import restore_run
from physjax.scene import Scene


class Trajectory(eqx.Module):
    """Frames of a run. `.time` [s] is `(frames,)`; `.state` has a leading axis of frames, frame 0 the start.

    `.ok` says whether the state stayed finite, per lane (per scene where lanes are coupled); `.first_bad_step` where it
    did not. `.parts` are the forces, contacts and emitter that remember, with the arrays they changed at every frame.
    `.recorded` replaces `.state` when `simulate` was given a `record`. `.final_scene` is the scene at the end of
    the run, from which it can be resumed.

    Example:
        >>> flight
        <Trajectory: verlet, 21 frames from t = 0 to 2 s, position (21, 2) float32, ok>
    """

    time: Float[Array | np.ndarray, "frames *lanes"]
    state: PyTree
    parts: tuple
    recorded: PyTree
    ok: Bool[Array | np.ndarray, "..."]
    scene: Scene | None
    final_scene: Scene | None
    stepper: Callable | None
    dt: Float[Array | np.ndarray, "..."] | None
    first_step: Int[Array | np.ndarray, ""]
    save_every: int = eqx.field(static=True)
    steps: int = eqx.field(static=True)

    @property
    def position(self) -> Float[Array | np.ndarray, "frames *lanes dim"]:
        """Positions [m] at the frames.

        Example:
            >>> print(flight.position[10])
            [3.  9.1]
        """
        return self._demand_states().position

    @property
    def velocity(self) -> Float[Array | np.ndarray, "frames *lanes dim"]:
        """Velocities [m/s] at the frames; of rigid bodies those of their centres of mass.

        Example:
            >>> print(flight.velocity[10])
            [ 3.  -5.8]
        """
        states = self._demand_states()
        if isinstance(states, Particles):
            return states.velocity
        return view_centers(states, self._demand_scene("velocity").mass).velocity

    @property
    def method(self) -> Callable | None:
        """The method that made the run; None when it came from a reference solver.

        Example:
            >>> flight.method is methods.verlet
            True
        """
        return self.stepper.function if isinstance(self.stepper, Function) else self.stepper

    @property
    @jax.transfer_guard("allow")
    def final_step(self) -> Int[Array | np.ndarray, ""]:
        """The count of steps at the end, to resume from.

        Example:
            >>> rest = simulate(flight.final_scene, methods.verlet, dt=0.1, steps=20, first_step=flight.final_step)
            >>> int(rest.final_step)
            40
        """
        return self.first_step + self.steps

    @property
    @jax.transfer_guard("allow")
    def first_bad_step(self) -> Int[Array, "..."]:
        """The first step after which a lane was no longer finite, -1 where `.ok`.

        Watching every step would slow every run, so a run that failed is stepped once more, with a watch, when this is
        read.

        Example:
            >>> int(flight.first_bad_step)
            -1
        """
        ok = concrete_or_none(self.ok)
        if ok is not None and ok.all():
            return jnp.full(ok.shape, -1, jnp.int32)
        self._demand_scene("first_bad_step")
        watch = partial(_find_first_bad_step, steps=self.steps)
        for _ in range(self.first_step.ndim):  # runs that came out of vmap
            watch = jax.vmap(watch)
        return watch(self.scene, self.stepper, self.dt, self.first_step)

    @property
    def film(self) -> Scene:
        """The scene with frames along a leading axis in each array that changed: its state, and what parts remember.

        Example:
            >>> flight.film.state.position.shape
            (21, 2)
        """
        return replace_memories(self._demand_scene("film"), self._demand_states(), self.parts)

    def __repr__(self) -> str:
        """One line: what was run, for how long, and whether it held."""
        method = self.method
        how = "" if method is None else f"{callable_name(method)}, "
        if concrete_or_none(self.time) is None or np.ndim(self.first_step):
            return f"<Trajectory: {how}{self.steps} steps, traced or out of vmap>"
        time, ok = np.asarray(self.time), np.asarray(self.ok)
        shape = "recorded" if self.state is None else f"position {self.position.shape} {self.position.dtype}"
        held = "ok" if ok.all() else f"{ok.size - ok.sum()} of {ok.size} blew up"
        return f"<Trajectory: {how}{len(time)} frames from t = {time.min():g} to {time.max():g} s, {shape}, {held}>"

    def __len__(self) -> int:
        """The number of frames, the start included.

        Example:
            >>> len(flight)
            21
        """
        return self.time.shape[np.ndim(self.first_step)]

    def __bool__(self) -> bool:
        """True: a run is something, however few frames it has."""
        return True

    def __getitem__(self, frame: int) -> PyTree:
        """The state at a frame, counted from 0 or, if negative, from the end.

        Example:
            >>> print(flight[-1].position)
            [ 6.  -1.6]
        """
        return pick_frame(self._demand_states(), frame, len(self), np.ndim(self.first_step))

    def at(self, t: ArrayLike) -> PyTree:
        """The state at a time [s] of the run, or at several: stepped to it from the frame before, the last step shortened.

        As accurate as the run itself, however few frames were saved. With derivatives, also by the time. Raises ValueError
        for times outside of the run, and for a run that does not know its scene and method or has a dt for each lane.

        Example:
            >>> print(flight.at(1.0).position, flight.at(0.25).position)
            [3.  9.1] [ 0.75  10.694]
        """
        self._demand_scene("at")
        return step_to_time(self, t)

    def energy(self) -> Float[Array | np.ndarray, "..."]:
        """Kinetic and potential energy [J] at the frames, per lane or summed over coupled ones.

        Example:
            >>> print(flight.energy()[:3])
            [221. 221. 221.]
        """
        return call_late("physjax.study.energy.over_time:measure_total", self)

    def plot(self, looks: PyTree = None) -> Any:
        """Draw the run: the paths of particles, else its last frame. Returns the figure; `looks` as in `animate.view`.

        Example:
            >>> flight.plot().axes[0].get_xlabel()
            'x [m]'
        """
        return call_late("physjax.show.auto_plot:plot_run", self, looks)

    def to_xarray(self) -> Any:
        """The frames as an `xarray.Dataset`: dimensions time, lanes and component, with units. Needs xarray.

        Example:
            >>> dict(flight.to_xarray().position.sizes)
            {'time': 21, 'component': 2}
        """
        return build_dataset(self)

    def to_pandas(self) -> Any:
        """The frames as a `pandas.DataFrame`: a row for each frame and lane, a column for each component. Needs pandas.

        Example:
            >>> list(flight.to_pandas().columns)
            ['time', 'position_x', 'position_y', 'velocity_x', 'velocity_y']
        """
        return build_frame_table(self)

    def crossing(
        self, surface: PyTree, *, direction: int | None = None, nth: int | Sequence[int] = 1
    ) -> Crossing | BodyCrossing:
        """Time, position and velocity of the first crossing of a surface, for each lane; `ok` False where there is none.

        `nth=2` is the second crossing, of those in the `direction` if there is one; `nth=range(1, 4)` are the first three,
        along an axis in front.

        `surface` is a height [m] along the scene's `up`, a number or one per lane; anything with a `gap(t, position)`, such as
        `contacts.Plane`; or a function `(t, position) -> signed distance` [m], one for each lane, with t a scalar or per
        lane. `direction` -1 looks for what goes from positive gaps to negative (downward), +1 for the opposite. The step
        is found by stepping again between the frames, the moment in it along the method's own path: the error falls with
        the method's order, however few frames were saved, and derivatives, forward and reverse, move the moment as well.

        What starts on the surface does not cross it there; what bounces off a contact does not cross it. A crossing and
        its return within one step are not seen, nor are those between two frames whose positions and velocities, by the
        cubic through them, do not tell of it. Coupled nodes have their own moments each, at the cost of a few steps of
        the whole scene for every node. Raises ValueError where the run does not know its scene and method.

        Of rigid bodies, heights and surfaces are crossed by their centers of mass, and a function is one of `(t, bodies)`,
        of anything in their state: a number for each body, or, where bodies are coupled, one for all, such as an angle
        between two. The result holds the time and the state. Where `rigid.Solids` or others bounce within the very step of
        the crossing, the error is of first order in dt.

        Example:
            >>> landing = flight.crossing(0.0, direction=-1)
            >>> round(float(landing.time), 3), round((4.0 + (4.0**2 + 2 * 9.8 * 10.0) ** 0.5) / 9.8, 3)
            (1.894, 1.894)
            >>> bool(flight.crossing(0.0, nth=2).ok)
            False
        """
        self._demand_scene("crossing")
        return find_crossing(self, surface, direction, nth)

    def save(self, path: str | os.PathLike) -> None:
        """Write the run as one compressed `.npz`, readable by `numpy.load`; the file is whole or absent.

        Holds time, ok, first_bad_step, dt, steps, save_every, the name of the method, and the arrays of state, parts
        and recorded, named after their fields. The scene itself is code and stays with you.

        Example:
            >>> flight.save("flight.npz")
            >>> np.load("flight.npz")["time"].shape
            (21,)
        """
        arrays = {name: getattr(self, name) for name in ("time", "ok", "first_step", "save_every", "steps")}
        arrays |= {"method": callable_name(self.method), "format": RUN_FORMAT}
        if self.dt is not None:
            arrays["dt"] = self.dt
        if self.scene is not None and self.stepper is not None:
            arrays["first_bad_step"] = self.first_bad_step
        for group, tree in self._collect_saved_trees().items():
            for keys, leaf in jax.tree_util.tree_leaves_with_path(tree):
                arrays[group + jax.tree_util.keystr(keys)] = leaf
        with write_atomically(path, "wb") as file:
            np.savez_compressed(file, allow_pickle=False, **{name: np.asarray(array) for name, array in arrays.items()})

    @classmethod
    @jax.transfer_guard("allow")
    def load(
        cls, path: str | os.PathLike, *, scene: Scene | None = None, method: Callable | None = None
    ) -> "Trajectory":
        """Read a saved run. Give the scene and the method it was made with to step again inside it or to resume it.

        Without them frames and status are there all the same, of particles; bodies want their scene. What was recorded
        comes back as an array, or, if it was more than one, as a dict by path. A run in float32 takes the given scene's
        numbers in float32, also where 64-bit types are on, and so goes on as it would have. Raises FileNotFoundError, or
        ValueError for a file that is not a saved run, has an array that no run could have written, or belongs to another
        scene, method or precision.

        Example:
            >>> flight.save("flight.npz")
            >>> again = Trajectory.load("flight.npz", scene=shot, method=methods.verlet)
            >>> bool((again.position == flight.position).all())
            True
        """
        arrays = read_arrays(path, "a run written by Trajectory.save")
        demand_saved_run(path, arrays)
        return restore_run(cls, arrays, scene, method)

    def _collect_saved_trees(self) -> dict[str, PyTree]:
        """The pytrees that go into a file, by the name they have there."""
        groups = {"state": self.state, "parts": self.parts, "recorded": self.recorded}
        if self.final_scene is not None:
            groups |= {"final_state": self.final_scene.state, "final_parts": select_stateful_parts(self.final_scene)}
        return groups

    def _demand_scene(self, what: str) -> Scene:
        """The scene, if it is known with its method, so that it can be stepped."""
        if self.scene is None or self.stepper is None:
            raise ValueError(
                f"{what}: this trajectory does not know its scene and method. Load it with scene= and method=."
            )
        return self.scene

    def _demand_states(self) -> PyTree:
        if self.state is None:
            raise AttributeError(
                "this trajectory holds .recorded only: simulate was given record=, which replaces the state."
            )
        return self.state


@partial(jax.jit, static_argnames="steps")
def _find_first_bad_step(scene, method, dt, first_step, steps):
    def body(carry):
        i, scene, found = carry
        scene = scene.step(method, moment_at(first_step + i, dt, scene.state.dtype), dt)
        fresh = (found < 0) & ~scene.finite(scene.state)
        return i + 1, scene, jnp.where(fresh, first_step + i + 1, found)

    def going(carry):
        i, _, found = carry
        return (i < steps) & jnp.any(found < 0)

    bad = jnp.full(scene.status_shape, -1, jnp.int32)
    return lax.while_loop(going, body, (jnp.zeros((), jnp.int32), scene, bad))[2]
