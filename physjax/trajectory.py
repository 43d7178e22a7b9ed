"""What a run returns: frames over time, a status per lane, and enough memory of the run to step again inside it."""

import os
from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from physjax.checks import concrete_or_none
from physjax.crossing import BodyCrossing, Crossing, find_first_crossing
from physjax.files import RUN_FORMAT, demand_saved_run, read_arrays, write_atomically
from physjax.loops import moment_at
from physjax.particles import Particles, callable_name, view_centers
from physjax.parts import Contact, Function, as_module, build_memory_mask, has_memory
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
        return _replace_memories(self._demand_scene("film"), self._demand_states(), self.parts)

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

    def crossing(self, surface: PyTree, *, direction: int | None = None) -> Crossing | BodyCrossing:
        """Time, position and velocity of the first crossing of a surface, for each lane; `ok` False where there is none.

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
        """
        self._demand_scene("crossing")
        return find_first_crossing(self, surface, direction)

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
        return _restore_run(cls, arrays, scene, method)

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


def select_stateful_parts(scene: Scene) -> tuple:
    """The parts of the scene with memory: forces that advance, contacts that remember since when lanes touch them, an emitter."""
    return tuple(part for part in (*scene.forces, *scene.contacts, scene.emitter) if has_memory(part))


def _replace_memories(scene: Scene, state: PyTree, parts: tuple) -> Scene:
    """The scene with another state, and with other memories in those of its parts that have some."""
    remaining = iter(parts)
    renewed = lambda old: tuple(next(remaining) if has_memory(part) else part for part in old)  # noqa: E731
    forces, contacts, (emitter,) = renewed(scene.forces), renewed(scene.contacts), renewed((scene.emitter,))
    return scene.replace(state=state, forces=forces, contacts=contacts, emitter=emitter)


def _restore_run(cls: type, saved: dict[str, np.ndarray], scene: Scene | None, method: Callable | None) -> Trajectory:
    """A trajectory from the arrays of a file: NumPy for a reference, which has no step, as it was before."""
    arrays: dict[str, Array | np.ndarray] = dict(saved)
    ours, made_by = "dt" in arrays, str(arrays.pop("method"))
    if ours and method is not None and made_by not in (callable_name(method), "NoneType"):
        raise ValueError(
            f"load: the run was made with the method {made_by}, got {callable_name(method)}. Give the method it was made "
            "with; to go on with another one, simulate(run.final_scene, ...)."
        )
    if scene is not None and ours:
        scene = _cast_to_run(scene, saved)
    # a run of float64 without 64-bit types stays in NumPy, where nothing is rounded
    exact = lambda array: ours and jax.dtypes.canonicalize_dtype(array.dtype) == array.dtype  # noqa: E731
    floats = [array for array in arrays.values() if array.dtype.kind == "f"]
    if all(map(exact, floats)):
        arrays = {name: jnp.asarray(array) if ours else array for name, array in arrays.items()}
    recorded = {name.removeprefix("recorded"): array for name, array in arrays.items() if name.startswith("recorded")}
    final_scene, parts = (None, ()) if scene is None or not ours else _restore_end(scene, arrays, not recorded)
    state = None
    if not recorded:
        state = _fill_tree("state", Particles(jnp.zeros(0), jnp.zeros(0)) if scene is None else scene.state, arrays)
    return cls(
        time=arrays["time"],
        state=state,
        parts=parts,
        recorded=recorded.get("", recorded) if recorded else None,
        ok=arrays["ok"],
        scene=scene,
        final_scene=final_scene,
        stepper=None if method is None else as_module(method),
        dt=arrays.get("dt"),
        first_step=arrays["first_step"],
        save_every=int(arrays["save_every"]),
        steps=int(arrays["steps"]),
    )


def _restore_end(scene: Scene, arrays: dict[str, Array | np.ndarray], filmed: bool) -> tuple[Scene, tuple]:
    """The scene at the end of the run, and the parts with memory over its frames, where these were `filmed`."""
    final_state = _fill_tree("final_state", scene.state, arrays)
    if final_state.position.shape != scene.state.position.shape:
        raise ValueError(
            f"load: the run has the shape {final_state.position.shape}, the given scene {scene.state.position.shape}. "
            "Give the scene the run was made with."
        )
    stateful = select_stateful_parts(scene)
    final_parts = _fill_tree("final_parts", stateful, arrays, shaped=True)
    _demand_same_contacts(stateful, final_parts)
    parts = ()
    if filmed:
        parts = _fill_tree("parts", stateful, arrays, shaped=True)
        _demand_same_contacts(stateful, parts)
    return _replace_memories(scene, final_state, final_parts), parts


def _cast_to_run(scene: Scene, arrays: dict[str, np.ndarray]) -> Scene:
    """The scene with its numbers in the run's precision, as they were when it was made; ValueError where they are coarser."""
    run, here = arrays.get("final_state.position", arrays["time"]).dtype, scene.state.dtype
    if run == here:
        return scene
    if jnp.finfo(run).bits > jnp.finfo(here).bits:
        raise ValueError(
            f"load: the run is in {run}, the given scene in {here}, too coarse to go on from there. Build the scene in "
            f'{run}: jax.config.update("jax_enable_x64", True) first.'
        )
    return jax.tree.map(lambda leaf: leaf.astype(run) if eqx.is_inexact_array(leaf) else leaf, scene)


def _demand_same_contacts(given: tuple, found: tuple) -> None:
    """Raise a ValueError naming a number of a contact, which never changes, that is another one in the file."""
    still = [
        jax.tree.map(lambda changing: not changing, build_memory_mask(part))
        for part in given
        if isinstance(part, Contact)
    ]
    pick = lambda parts: [part for part in parts if isinstance(part, Contact)]  # noqa: E731
    here, there = eqx.filter(pick(given), still), eqx.filter(pick(found), still)
    for (keys, ours), theirs in zip(jax.tree_util.tree_leaves_with_path(here), jax.tree.leaves(there), strict=True):
        if concrete_or_none(ours) is not None and not np.array_equal(ours, theirs):
            name = jax.tree_util.keystr(keys, simple=True, separator=".").partition(".")[2]
            raise ValueError(
                f"load: the run was made with a contact whose {name} was {np.asarray(theirs)}, in the given scene it is "
                f"{np.asarray(ours)}. Give the scene the run was made with; to go on with another one, begin from its last frame."
            )


def _fill_tree(group: str, like: PyTree, arrays: dict[str, Array | np.ndarray], shaped: bool = False) -> PyTree:
    """The pytree `like` with its leaves replaced by that group of arrays, `shaped` as they are, of parts also with frames."""
    leaves, tree = jax.tree_util.tree_flatten_with_path(like)
    names = [group + jax.tree_util.keystr(keys) for keys, _ in leaves]
    # what rounding leaves out of a moment was nothing in files from before it was kept
    rests = [name for name in names if name.endswith("_rest") and name.removesuffix("_rest") in arrays]
    arrays = {name: np.zeros_like(arrays[name.removesuffix("_rest")]) for name in rests} | arrays
    missing = [name for name in names if name not in arrays]
    if missing:
        raise ValueError(
            f"load: the file lacks {missing[0]!r}, which the scene has. Give the scene the run was made with."
        )
    over_time = lambda shape: (*arrays["time"].shape[: axis + 1], *shape[axis:])  # noqa: E731
    axis = arrays["first_step"].ndim
    for name, (_, leaf) in zip(names, leaves, strict=True):
        shapes = (jnp.shape(leaf), over_time(jnp.shape(leaf)) if group == "parts" else jnp.shape(leaf))
        if shaped and (arrays[name].shape not in shapes or arrays[name].dtype != jnp.result_type(leaf)):
            raise ValueError(
                f"load: {name}: the file has {arrays[name].dtype} of shape {arrays[name].shape}, the given scene "
                f"{jnp.result_type(leaf)} of shape {jnp.shape(leaf)}. Give the scene the run was made with."
            )
    return jax.tree.unflatten(tree, [arrays[name] for name in names])
