"""Where a scene of the gallery is fastest, and the map of what every method does with it around its limits."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from physjax.scene import Scene
from physjax.stepping.methods import METHODS
from physjax.study import stability
from physjax.study.problem import Problem
from physjax.study.stability.limits import Limit
from physjax.study.stability.linearisation import linearise, prepare_linearisation

INSPECTED_FRAMES = 16
"""Moments of a run at which its small motions are looked at."""
MAP_STEPS = 48
"""Steps of a map, from a tenth of the shortest limit to three times the longest."""


def find_fastest_moment(problem: Problem) -> tuple[float, Any]:
    """The moment [s] of a run, of a few, at which small motions are fastest, and the state then."""
    flight = problem.reference()

    def pace(i: int) -> float:
        with jax.enable_x64(True):
            return float(np.abs(linearise(*prepare_linearisation(problem.scene, state(i))).rates()).max())

    state = lambda i: jax.tree.map(lambda leaf: leaf[i], flight.state)  # noqa: E731
    fastest = max(range(0, len(flight.time), max(1, len(flight.time) // INSPECTED_FRAMES)), key=pace)
    return float(flight.time[fastest]), state(fastest)


def map_around_limits(scene: Scene, limits: Sequence[Limit]) -> stability.StabilityMap | None:
    """The map of all methods over the steps around their limits; None where none has a limit."""
    dts = [limit.dt for limit in limits if 0 < limit.dt < np.inf]
    if not dts:
        return None
    return stability.map(scene, list(METHODS.values()), np.geomspace(min(dts) / 10, 3 * max(dts), MAP_STEPS))
