"""Energies of a run at its frames."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from physjax.scene import Scene
from physjax.study.energy.quantities import kinetic, potential, total
from physjax.trajectory import Trajectory

ENERGIES = {"energy": total, "kinetic": kinetic, "potential": potential}
"""Energies [J] by name."""


def measure_total(run: Trajectory) -> Array:
    """Kinetic and potential energy [J] at the frames."""
    return measure_energy(run, "energy")


def measure_energy(run: Trajectory, name: str) -> Array:
    """The energy of that name [J] at the frames, `(frames, *status)`; ValueError where the run does not know its scene."""
    if run.scene is None:
        raise ValueError(f"{name}: this trajectory does not know its scene. Load it with scene= and method=.")
    changing = run.scene.changing()
    arrays, still = eqx.partition(run.film, changing)
    return _evaluate(arrays, still, jnp.asarray(run.time), name)


@eqx.filter_jit
def _evaluate(arrays: PyTree, still: PyTree, times: Array, name: str) -> Array:
    def evaluate(t: Array, arrays: PyTree) -> Array:
        scene: Scene = eqx.combine(arrays, still)
        return ENERGIES[name](scene, t, scene.state)

    return jax.vmap(evaluate)(times, arrays)
