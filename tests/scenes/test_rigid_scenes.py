"""What turns keeps its truths under our own steps as well."""

import jax
import numpy as np
import pytest

from physjax import methods, simulate
from physjax.scenes import SCENES


@pytest.mark.parametrize("name", ["free_top", "heavy_top", "t_handle", "physical_pendulum"])
def test_closed_forms_are_met_by_rk4_at_a_converged_step(name):
    problem = SCENES[name]()
    each = 32
    steps = each * problem.frames
    flight = simulate(problem.scene, methods.rk4, dt=problem.duration / steps, steps=steps, save_every=each)
    flight = jax.tree.map(np.asarray, flight)
    for truth in problem.truths:
        assert (np.abs(truth.measure(flight) - truth.expected) <= 1e-6 * np.abs(truth.expected).max() + 1e-6).all()
