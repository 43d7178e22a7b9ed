"""When the small motions of a gallery scene are fastest, and the map of every method around its limits."""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import PyTree

from physjax.scene import Scene
from physjax.stepping.methods import METHODS
from physjax.study import stability
from physjax.study.problem import Problem
from physjax.study.stability.limits import Limit
from physjax.study.stability.linearisation import linearise, prepare_linearisation

INSPECTED_FRAMES = 16
"""Moments of a run at which its small motions are linearised."""
MAP_STEPS = 48
"""Steps of a map, from a tenth of the shortest limit to three times the longest."""


def find_fastest_moment(problem: Problem) -> tuple[float, PyTree]:
    """Of a few moments of a run, the one [s] at which small motions are fastest, and the state then."""
    flight = problem.reference()

    def pick_state(frame: int) -> PyTree:
        return jax.tree.map(lambda leaf: leaf[frame], flight.state)

    def find_fastest_rate(frame: int) -> float:
        with jax.enable_x64(True):
            return float(linearise(*prepare_linearisation(problem.scene, pick_state(frame))).fastest_rate().max())

    frames = range(0, len(flight.time), max(1, len(flight.time) // INSPECTED_FRAMES))
    fastest = max(frames, key=find_fastest_rate)
    return float(flight.time[fastest]), pick_state(fastest)


def map_around_limits(scene: Scene, limits: Sequence[Limit]) -> stability.StabilityMap | None:
    """The map of all methods over the steps around their limits; None where none has a limit."""
    dts = [limit.dt for limit in limits if 0 < limit.dt < np.inf]
    if not dts:
        return None
    return stability.map(scene, list(METHODS.values()), np.geomspace(min(dts) / 10, 3 * max(dts), MAP_STEPS))
