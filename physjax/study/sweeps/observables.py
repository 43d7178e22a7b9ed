"""Named outcomes of a run, one number each, and sweeps of the numbers that a scene is built from."""

import inspect
import itertools
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from physjax.checks import as_positive_integer, demand_known
from physjax.scene import Scene
from physjax.stepping.simulate import simulate
from physjax.study.energy.quantities import total
from physjax.study.problem import Problem
from physjax.study.sweeps.batching import Run
from physjax.study.sweeps.design import Axis, build_lanes
from physjax.study.sweeps.result import Sweep
from physjax.study.sweeps.sweep import sweep
from physjax.trajectory import Trajectory
from physjax.vectors import norm

OBSERVED_FRAMES = 32
"""Frames of a run that an outcome is computed from."""


def height(flight: Trajectory) -> Float[Array, ""]:
    """Greatest height of anything on the way [m]."""
    return jnp.max(flight.position[..., _demand_scene(flight.scene).up])


def distance(flight: Trajectory) -> Float[Array, ""]:
    """Distance from start to end of what went furthest [m]."""
    return jnp.max(norm(flight.position[-1] - flight.position[0]))


def speed(flight: Trajectory) -> Float[Array, ""]:
    """Speed at the end of what is fastest [m/s]."""
    return jnp.max(norm(flight.velocity[-1]))


def energy(flight: Trajectory) -> Float[Array, ""]:
    """Kinetic and potential energy of all at the end [J]."""
    end = _demand_scene(flight.final_scene)
    return jnp.sum(total(end, flight.time[-1], end.state))


def _demand_scene(scene: Scene | None) -> Scene:
    if scene is None:
        raise ValueError(
            "this outcome needs the scene of its run, expected a run from simulate, or one loaded with scene=."
        )
    return scene


OBSERVABLES = {outcome.__name__: outcome for outcome in (height, distance, speed, energy)}
"""Outcomes by name: functions of a `Trajectory`; their docstrings say what they are, and in which unit."""


class _SweptProblem(NamedTuple):
    """What differs between the lanes of a sweep over a scene's numbers."""

    scene: Scene
    duration: float


def sweep_scene(
    build: Callable[..., Problem],
    axes: Mapping[str, PyTree],
    outcome: str,
    *,
    method: Callable,
    steps: int,
    **options: Any,
) -> Sweep:
    """An outcome of a gallery scene at every point of a grid of the numbers that it is built from.

    Each lane runs for its own scene's duration, in `steps` equal steps, rounded up to a multiple of 32. Every scene is
    built before the first one runs. `options` go to `sweep`. Raises ValueError for names that are not known, and where a
    number changes the shape of the scene.
    """
    outcome = demand_known("outcome", outcome, OBSERVABLES)
    grid = build_lanes(axes, "grid")
    parameters = inspect.signature(build).parameters
    for name in axes:
        demand_known(f"number of {build.__name__}", name, parameters)
    values = [
        axis.coordinate if parameters[axis.name].annotation is not int else _check_counts(axis) for axis in grid.axes
    ]
    built = [build(**dict(zip(axes, point, strict=True))) for point in itertools.product(*(v.tolist() for v in values))]
    flat = {axis.name: axis.at(i) for axis, i in zip(grid.axes, grid.indices(np.arange(grid.count)), strict=True)}
    save_every = -(-as_positive_integer("steps", steps) // OBSERVED_FRAMES)

    def measure(scene, **_):
        dt = scene.duration / (save_every * OBSERVED_FRAMES)
        flight = simulate(scene.scene, method, dt=dt, steps=save_every * OBSERVED_FRAMES, save_every=save_every)
        return {outcome: OBSERVABLES[outcome](flight), "run": Run(None, None, None, flight.ok)}

    problems = [_SweptProblem(problem.scene, problem.duration) for problem in built]
    found = sweep(measure, flat | {"scene": problems}, design="zip", **options)
    return replace(found, lanes=grid)


def _check_counts(axis: Axis) -> np.ndarray:
    """The values of an axis that counts something."""
    counts = np.round(axis.coordinate).astype(int)
    if np.any(counts != axis.coordinate):
        raise ValueError(
            f"axis {axis.name}: got {axis.coordinate.tolist()}, expected whole numbers: it counts something."
        )
    return counts
