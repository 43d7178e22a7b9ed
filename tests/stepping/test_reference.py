"""The bridge to diffrax against closed forms, and our physics under diffrax's solvers."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, forces, methods, ode_term, reference, simulate
from physjax.stepping.reference import discontinuities

TIMES = np.array([0.0, 0.3, 1.0, 2.5])


def oscillators(dtype=float):
    """Three oscillators from soft to stiff, with their closed form."""
    omega, x, v = np.array([0.5, 2.0, 30.0]), np.array([1.0, -2.0, 0.5]), np.array([0.0, 1.0, 3.0])
    mass = np.array([1.0, 0.5, 2.0])
    state = Particles(jnp.asarray(x[:, None], dtype), jnp.asarray(v[:, None], dtype))
    spring = forces.Anchor(point=jnp.zeros(1), stiffness=mass * omega**2)

    def truth(t):
        phase = omega * t[:, None]
        position = x * np.cos(phase) + v / omega * np.sin(phase)
        return position, v * np.cos(phase) - omega * x * np.sin(phase)

    return Scene(state, mass=mass, forces=(spring,)), truth


def test_oscillators_follow_their_closed_form():
    scene, truth = oscillators()
    found = reference(scene, TIMES)
    position, velocity = truth(TIMES)
    np.testing.assert_allclose(found.position[..., 0], position, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.velocity[..., 0], velocity, rtol=0, atol=3e-8)  # 30 times as steep
    np.testing.assert_array_equal(found.time, TIMES)
    assert found.ok.all()
    assert found.ok.shape == (3,)


def test_a_projectile_and_a_fall_with_drag_follow_their_closed_forms():
    v, area, coefficient, mass = np.array([[3.0, 9.0], [0.0, 0.0]]), np.array([0.0, 0.02]), 0.5, 0.1
    parts = (forces.Gravity(), forces.QuadraticDrag(area=area, coefficient=coefficient))
    found = reference(Scene(Particles(jnp.zeros((2, 2)), jnp.asarray(v)), mass=mass, forces=parts), TIMES)
    t = TIMES[:, None]
    thrown = v[0] * t - np.array([0.0, 4.9]) * t**2
    np.testing.assert_allclose(found.position[:, 0], thrown, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.velocity[:, 0], v[0] - np.array([0.0, 9.8]) * t, rtol=0, atol=1e-9)
    terminal = np.sqrt(2 * mass * 9.8 / (1.225 * coefficient * area[1]))
    fall = -terminal * np.tanh(9.8 * TIMES / terminal)
    np.testing.assert_allclose(found.velocity[:, 1, 1], fall, rtol=0, atol=1e-9)


def test_float32_programs_get_a_float64_reference():
    with jax.enable_x64(False):
        scene, truth = oscillators(np.float32)
        assert scene.state.dtype == np.float32
        found = reference(scene, TIMES)
        for array in (found.time, found.position, found.velocity):
            assert isinstance(array, np.ndarray)
            assert array.dtype == np.float64
        assert not jax.config.jax_enable_x64
    # its numbers are those of the float32 scene, taken exactly
    exact = truth(TIMES)[0]
    np.testing.assert_allclose(found.position[..., 0], exact, rtol=0, atol=1e-4)
    twin = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf, float)), scene)
    np.testing.assert_array_equal(found.position, reference(twin, TIMES).position)


def test_a_millisecond_kick_in_a_long_flight_is_not_stepped_over():
    kick = forces.Kick(impulse=jnp.asarray([0.6, 0.0]), at=2.4567, duration=1e-3)
    scene = Scene(Particles(jnp.zeros(2), jnp.ones(2)), mass=0.3, forces=(kick,))
    found = reference(scene, [2.0, 5.0])
    np.testing.assert_allclose(found.velocity, [[1.0, 1.0], [3.0, 1.0]], rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.position[-1], [5.0 + 2.0 * (5.0 - 2.4567 - 0.5e-3), 5.0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(discontinuities(scene), [2.4567, 2.4577], rtol=1e-15)
    assert discontinuities(Scene(scene.state)).shape == (0,)


def test_any_diffrax_solver_is_accepted():
    scene, truth = oscillators()
    theirs, ours = (reference(scene, [1.0], rtol=1e-9, atol=1e-9, solver=s) for s in (diffrax.Tsit5(), None))
    for found in (theirs, ours):
        np.testing.assert_allclose(found.position[..., 0], truth(np.array([1.0]))[0], rtol=0, atol=1e-7)
        assert found.ok.all()
    assert not np.array_equal(theirs.position, ours.position)


def test_only_the_start_may_be_asked_for():
    scene, _ = oscillators()
    np.testing.assert_array_equal(reference(scene, [0.0]).position[0], scene.state.position)


def test_a_reference_knows_its_scene_and_no_method():
    scene, _ = oscillators()
    found = reference(scene, TIMES)
    assert found.method is None
    assert found.steps == 3
    np.testing.assert_array_equal(found.first_bad_step, [-1, -1, -1])


def test_a_solve_that_fails_says_so(monkeypatch):
    monkeypatch.setattr("physjax.stepping.reference.MAX_STEPS", 1000)

    def blow_up(t, state, mass):
        return state.position**3 * 1e3

    scene = Scene(Particles(jnp.ones((2, 1)), jnp.ones((2, 1))), forces=(forces.independent(blow_up),))
    found = reference(scene, [0.001, 10.0], rtol=1e-6, atol=1e-6)
    assert not found.ok.any()
    assert np.isfinite(found.position[0]).all()
    assert not np.isfinite(found.position[1]).any()


# our physics under diffrax


def test_a_scene_is_an_ode_term_for_diffrax_and_differentiable():
    def end(stiffness):
        spring = forces.Anchor(point=jnp.zeros(1), stiffness=stiffness)
        scene = Scene(Particles(jnp.ones(1), jnp.zeros(1)), forces=(spring,))
        solution = diffrax.diffeqsolve(
            ode_term(scene),
            diffrax.Tsit5(),
            t0=0.0,
            t1=2.0,
            dt0=0.01,
            y0=scene.state,
        )
        return solution.ys.position[-1, 0]

    k = 9.0  # x = cos(√k t)
    value, slope = jax.value_and_grad(end)(jnp.asarray(k))
    np.testing.assert_allclose(value, np.cos(6.0), rtol=0, atol=1e-10)
    np.testing.assert_allclose(slope, -np.sin(6.0) / 3.0, rtol=0, atol=1e-10)


def test_no_number_of_the_scene_compiles_the_reference_anew():
    traces = []

    @forces.independent
    def watched(t, state, mass):
        traces.append(t)
        return jnp.zeros_like(state.velocity)

    def run(g, speed, rtol):
        scene = Scene(Particles(jnp.zeros(2), jnp.full(2, speed)), mass=g, forces=(forces.Gravity(g), watched))
        return reference(scene, [0.5, 1.0], rtol=rtol)

    run(9.8, 3.0, 1e-10)
    count = len(traces)
    run(1.6, -2.0, 1e-8)
    assert len(traces) == count > 0


# bad input


@pytest.mark.parametrize(
    "times", [[], [[0.0, 1.0]], 1.0, [-1.0, 1.0], [0.0, 1.0, 1.0], [1.0, 0.5], [0.0, np.nan], [np.inf]]
)
def test_times_ascend_from_zero(unannotated, times):
    with pytest.raises(ValueError, match="times must be a list of ascending finite numbers >= 0"):
        reference(oscillators()[0], times)


@pytest.mark.parametrize("name", ["rtol", "atol"])
@pytest.mark.parametrize("value", [0.0, -1e-6, np.nan, np.inf])
def test_tolerances_are_above_zero(unannotated, name, value):
    with pytest.raises(ValueError, match=f"{name}: got .*, expected (numbers > 0|finite numbers)"):
        reference(oscillators()[0], TIMES, **{name: value})


def test_a_scene_is_needed(unannotated):
    with pytest.raises(TypeError, match="got a Particles, expected a Scene"):
        reference(oscillators()[0].state, TIMES)


def test_parts_that_remember_are_refused():
    class Remembers(eqx.Module):
        def __call__(self, t, state, mass):
            return state.velocity

        def advance(self, t, dt, state):
            return self, state

    scene = Scene(Particles(jnp.zeros(2), jnp.zeros(2)), forces=(Remembers(),))
    assert simulate(scene, methods.euler, dt=0.1, steps=1).ok.all()
    with pytest.raises(ValueError, match="parts with memory"):
        reference(scene, TIMES)
