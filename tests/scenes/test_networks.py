"""What the scenes made of springs promise beyond their own truths: under our methods, stiff, unloaded, and in charts."""

import numpy as np
import pytest

from physjax import methods, simulate
from physjax.scenes import SCENES
from physjax.stepping.methods import METHODS
from physjax.study.accuracy import Budget, work_precision


def test_all_fifty_modes_of_the_chain_have_their_frequency_under_rk4():
    problem = SCENES["oscillator_chain"]()
    steps = 24 * problem.frames
    flight = simulate(problem.scene, methods.rk4, dt=problem.duration / steps, steps=steps, save_every=24)
    (truth,) = problem.truths
    frequencies = truth.measure(flight)
    assert frequencies.shape == (50,)
    np.testing.assert_allclose(frequencies, truth.expected, rtol=0, atol=1e-6)


def test_a_stiff_rope_comes_to_rest_in_a_catenary():
    length, span = 1.3, 1.0
    problem = SCENES["hanging_rope"](stiffness=1e6, length=length, span=span)
    steps = 20_000
    flight = simulate(problem.scene, methods.rk4, dt=problem.duration / steps, steps=steps, save_every=steps)
    a = 0.5
    for _ in range(60):  # Newton's method on length = 2a sinh(span/2a)
        off = 2 * a * np.sinh(span / (2 * a)) - length
        a -= off / (2 * np.sinh(span / (2 * a)) - span / a * np.cosh(span / (2 * a)))
    along = np.linspace(-length / 2, length / 2, flight.position.shape[1])
    curve = np.stack([a * np.arcsinh(along / a), np.hypot(a, along) - np.hypot(a, length / 2)], axis=-1)
    assert np.abs(flight.velocity[-1]).max() < 1e-6
    np.testing.assert_allclose(flight.position[-1], curve, rtol=0, atol=1e-3 * length)


@pytest.mark.slow
def test_a_cloth_sags_as_far_under_methods_of_every_order():
    scene = SCENES["hanging_cloth"]().scene  # near its limit of 1.8 ms, explicit Euler finds another fold
    ends = [
        simulate(scene, METHODS[name], dt=1e-3, steps=4500, save_every=4500).final_scene.state.position
        for name in ("euler", "semi_implicit_euler", "verlet", "rk4", "dopri8")
    ]
    assert np.ptp(np.stack(ends), axis=0).max() < 1e-6
    assert np.linalg.norm(ends[0] - scene.state.position, axis=-1).max() > 0.3


def test_a_bridge_without_a_load_holds():
    scene = SCENES["breaking_bridge"](rate=1e-9).scene
    flight = simulate(scene, methods.rk4, dt=1e-3, steps=4000, save_every=4000)
    assert np.asarray(flight.parts[0].unbroken).all()
    np.testing.assert_allclose(flight.position[-1], scene.state.position, rtol=0, atol=1e-9)


def test_what_remembers_is_no_ordinary_differential_equation_and_its_chart_says_so():
    bridge = SCENES["breaking_bridge"]()
    assert not bridge.is_ode
    assert SCENES["flag"]().is_ode
    few = Budget(seconds=0.002, repeats=1, refinement=2.0)
    study = work_precision(bridge, [methods.rk4], budget=few)
    assert study.truth.startswith("own rk4")
    assert (study.promised["rk4"], study.scattered, study.methods) == (1.0, True, ("rk4",))
    with pytest.raises(ValueError, match=r"forces that remember, .* Give rivals=\(\)"):
        work_precision(bridge, [methods.rk4], rivals=(None,))


def test_a_truth_that_is_itself_wrong_calls_no_run_exact():
    study = work_precision(
        SCENES["oscillator"](stiffness=(1.0,)), [methods.rk4], [1e-3, 5e-4], rivals=(), budget=Budget(0.01, 1, 2.0)
    )
    assert np.isinf(study.observed_order("rk4"))
    assert np.isnan(study._replace(floor=1e-3).observed_order("rk4"))
