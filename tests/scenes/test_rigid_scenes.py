"""What turns keeps its truths under our own steps as well."""

import jax
import numpy as np
import pytest

from physjax import methods, simulate
from physjax.scenes import SCENES
from physjax.study import stability
from physjax.study.accuracy import Budget, work_precision


@pytest.mark.parametrize("name", ["free_top", "heavy_top", "t_handle", "physical_pendulum"])
def test_closed_forms_are_met_by_rk4_at_a_converged_step(name):
    problem = SCENES[name]()
    each = 32
    steps = each * problem.frames
    flight = simulate(problem.scene, methods.rk4, dt=problem.duration / steps, steps=steps, save_every=each)
    flight = jax.tree.map(np.asarray, flight)
    for truth in problem.truths:
        assert (np.abs(truth.measure(flight) - truth.expected) <= 1e-6 * np.abs(truth.expected).max() + 1e-6).all()


def test_charts_count_the_orientation_among_the_errors():
    few = Budget(seconds=0.002, repeats=1, refinement=2.0)
    study = work_precision(
        SCENES["free_top"](), [methods.rk4, methods.euler], [1.5e-3, 3e-3, 6e-3], rivals=(), budget=few
    )
    assert study.observed_order("rk4") == pytest.approx(4, abs=0.3)
    assert study.observed_order("euler") == pytest.approx(1, abs=0.15)  # a path without forces is exact: turning is not


def test_modes_of_what_turns_in_space_cannot_be_asked_for_yet():
    scene = SCENES["free_top"]().scene
    assert "set by the spin of a body" in str(stability.limit(scene, methods.rk4))
    with pytest.raises(TypeError, match="RigidBodies, expected Particles"):
        stability.explain(scene, methods.rk4, 0.1)
