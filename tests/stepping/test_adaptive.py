"""Steps that choose their own length: their errors, their counts, where they land, and how they give up."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, forces, methods, simulate
from physjax.scenes import SCENES

RK4 = methods.adaptive(methods.rk4, 1e-8, 1e-8)


def thrown():
    return Scene(Particles(jnp.zeros(2), jnp.asarray([3.0, 10.0])), forces=(forces.Gravity(),))


def final_error(problem, method, steps):
    exact = problem.exact(np.array([problem.duration])).position[0]
    run = simulate(problem.scene, method, dt=problem.duration / steps, steps=steps, save_every=steps)
    return np.abs(np.asarray(run.position[-1]) - exact).max()


def test_kepler_takes_a_third_of_the_evaluations_of_fixed_steps():
    problem, frames = SCENES["kepler"](), 4
    fixed = 20_000
    assert final_error(problem, methods.rk4, fixed) > 1e-6
    method = methods.adaptive(methods.rk4, 3e-10, 3e-10)
    assert final_error(problem, method, frames) < 1e-6
    counts = methods.count_steps(problem.scene, method, dt=problem.duration / frames, steps=frames)
    tries = int(jnp.sum(counts.accepted + counts.rejected))
    assert int(jnp.sum(counts.rejected)) <= 0.05 * tries
    assert 3 * (3 * 4 * tries + 2 * frames) <= 4 * fixed


@pytest.mark.parametrize("name", ["kepler", "oscillator"])
@pytest.mark.parametrize("method", [methods.euler, methods.verlet, methods.rk4], ids=lambda m: m.__name__)
def test_the_local_error_of_accepted_steps_stays_within_twice_the_tolerance(name, method):
    problem, frames, tolerance = SCENES[name](), 100, 1e-6
    scene, dt = problem.scene, problem.duration / 8000
    chooser = methods.adaptive(method, tolerance, tolerance)
    counts = methods.count_steps(scene, chooser, dt=dt, steps=frames)
    states = jax.tree.map(lambda start, ends: jnp.concatenate([start[None], ends]), scene.state, counts.state)

    def fine(state):
        step = lambda i, s: methods.rk4(scene, 0.0, s, dt / 64)  # noqa: E731
        return jax.lax.fori_loop(0, 64, step, state)

    truth = jax.jit(jax.vmap(fine))(jax.tree.map(lambda leaf: leaf[:-1], states))
    accepted = np.asarray(counts.accepted, float)
    taken = accepted.reshape(accepted.shape + (1,) * (states.position.ndim - accepted.ndim))
    for got, right in zip(*(map(np.asarray, s) for s in (states, truth)), strict=True):
        assert np.all(np.abs(got[1:] - right) <= 2 * taken * tolerance * (1 + np.abs(right)))


def test_it_lands_on_the_end_and_lanes_have_steps_of_their_own():
    scene = SCENES["oscillator"]().scene
    report = RK4.report(scene, 0.0, scene.state, 1.0)
    assert report.accepted.shape == (4,)
    assert np.all(np.diff(report.accepted) > 0)
    assert bool(report.ok.all())
    omega = np.sqrt([1.0, 10.0, 100.0, 1000.0])
    np.testing.assert_allclose(report.state.position[:, 0], np.cos(omega), atol=1e-5)


def test_the_lectures_error_does_not_see_where_a_throw_goes():
    sound = methods.adaptive(methods.euler, 1e-3, 1e-3)
    blind = methods.adaptive(methods.euler, 1e-3, 1e-3, error="velocity")
    exact = np.array([6.0, 20.0 - 0.5 * 9.8 * 4.0])
    ends = [simulate(thrown(), method, dt=2.0, steps=1).position[-1] for method in (blind, sound)]
    assert np.abs(ends[0] - exact).max() > 4.0
    assert np.abs(ends[1] - exact).max() < 0.25
    told = methods.count_steps(thrown(), blind, dt=2.0, steps=1)
    assert int(told.rejected[0]) == 0


def test_a_floor_ends_the_lane_that_needs_less_and_no_other():
    scene = SCENES["oscillator"]().scene
    method = methods.adaptive(methods.euler, 1e-5, 1e-5, dt_min=1.5e-3)
    flight = simulate(scene, method, dt=0.1, steps=3)
    np.testing.assert_array_equal(flight.ok, [True, True, False, False])
    np.testing.assert_array_equal(flight.first_bad_step, [-1, -1, 1, 1])


def test_a_force_that_is_not_a_number_ends_in_a_status():
    scene = Scene(
        Particles(jnp.zeros(1), jnp.ones(1)), forces=(forces.independent(lambda t, s, m: s.velocity * jnp.nan),)
    )
    assert not bool(simulate(scene, RK4, dt=0.1, steps=2).ok)


def test_a_bounded_number_of_tries_can_be_differentiated():
    bounded = methods.adaptive(methods.rk4, 1e-9, 1e-9, tries=40)

    def end(stiffness):
        spring = forces.Anchor(point=jnp.zeros(1), stiffness=stiffness)
        scene = Scene(Particles(jnp.ones(1), jnp.zeros(1)), forces=(spring,))
        return simulate(scene, bounded, dt=0.5, steps=4).position[-1, 0]

    assert end(2.0) == pytest.approx(np.cos(2 * np.sqrt(2.0)), abs=1e-7)
    assert jax.grad(end)(2.0) == pytest.approx(-np.sin(2 * np.sqrt(2.0)) / np.sqrt(2.0), abs=1e-6)
    few = methods.adaptive(methods.rk4, 1e-9, 1e-9, tries=2)
    assert not bool(simulate(SCENES["kepler"]().scene, few, dt=1.0, steps=1).ok)


def test_it_works_in_both_precisions(precision):
    scene = Scene(Particles(jnp.ones(1, precision.dtype), jnp.zeros(1, precision.dtype)), forces=(
        forces.Anchor(point=jnp.zeros(1, precision.dtype), stiffness=1.0),
    ))  # fmt: skip
    flight = simulate(scene, methods.adaptive(methods.rk4, 1e-5, 1e-5), dt=0.5, steps=8)
    assert flight.position.dtype == precision.dtype
    np.testing.assert_allclose(flight.position[:, 0], np.cos(flight.time), atol=1e-4)


def test_bad_input_is_refused(unannotated):
    with pytest.raises(ValueError, match="atol"):
        methods.adaptive(methods.rk4, atol=0.0)
    with pytest.raises(ValueError, match="rtol"):
        methods.adaptive(methods.rk4, rtol=-1.0)
    with pytest.raises(ValueError, match="more than dt_max"):
        methods.adaptive(methods.rk4, dt_min=1.0, dt_max=0.1)
    with pytest.raises(TypeError, match=r"such as methods\.rk4"):
        methods.adaptive("rk4")
    with pytest.raises(ValueError, match="Give order="):
        methods.adaptive(lambda system, t, state, dt: state)
    with pytest.raises(ValueError, match="lecture"):
        methods.adaptive(methods.rk4, error="speed")
    with pytest.raises(TypeError, match=r"expected methods\.adaptive"):
        methods.count_steps(thrown(), methods.rk4, dt=1.0, steps=1)
