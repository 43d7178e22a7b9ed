"""physjax as a Tesseract has it, the form in which Mosaic compares solvers: `apply` and `vector_jacobian_product`.

A flight with drag: velocities at the start and the drag's area in, places at the end out. Inputs and outputs are dicts of
arrays, and the names of the endpoints and of their arguments are those of a `tesseract_api.py`; a container only adds the
schemas..
"""

from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from physjax import Particles, Scene, forces, methods, simulate

STEPS, DT = 100, 0.01
DIFFERENTIABLE_INPUTS, OUTPUTS = ("velocity", "area"), ("position",)


@jax.jit
def solve(velocity: Array, area: Array) -> dict[str, Array]:
    """Places [m] of balls of 145 g after a second."""
    flight = Scene(
        Particles(jnp.zeros_like(velocity), velocity), 0.145, (forces.Gravity(), forces.QuadraticDrag(area, 0.35))
    )
    return {"position": simulate(flight, methods.rk4, dt=DT, steps=STEPS, save_every=STEPS).position[-1]}


def apply(inputs: Mapping[str, ArrayLike]) -> dict[str, np.ndarray]:
    """The places at the end."""
    return {name: np.asarray(found) for name, found in solve(**_check_inputs(inputs)).items()}


def vector_jacobian_product(
    inputs: Mapping[str, ArrayLike],
    vjp_inputs: Sequence[str],
    vjp_outputs: Sequence[str],
    cotangent_vector: Mapping[str, ArrayLike],
) -> dict[str, np.ndarray]:
    """The cotangents of the inputs that are asked for, given those of outputs."""
    given = _check_inputs(inputs)
    for name, known in [*((n, DIFFERENTIABLE_INPUTS) for n in vjp_inputs), *((n, OUTPUTS) for n in vjp_outputs)]:
        if name not in known:
            raise ValueError(f"vector_jacobian_product: got {name!r}, expected one of {known}.")
    fixed = {name: value for name, value in given.items() if name not in vjp_inputs}
    asked = {name: given[name] for name in vjp_inputs}
    found = _pull_back(asked, fixed, {name: jnp.asarray(cotangent_vector[name]) for name in vjp_outputs})
    return {name: np.asarray(value) for name, value in found.items()}


@jax.jit
def _pull_back(asked: dict[str, Array], fixed: dict[str, Array], cotangents: dict[str, Array]) -> dict[str, Array]:
    _, pull = jax.vjp(lambda asked: {name: solve(**asked, **fixed)[name] for name in cotangents}, asked)
    return pull(cotangents)[0]


def _check_inputs(inputs: Mapping[str, ArrayLike]) -> dict[str, Array]:
    if set(inputs) != set(DIFFERENTIABLE_INPUTS):
        raise ValueError(f"apply: got inputs {sorted(inputs)}, expected {sorted(DIFFERENTIABLE_INPUTS)}.")
    return {name: jnp.asarray(value, float) for name, value in inputs.items()}
