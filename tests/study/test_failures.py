"""It must fail here, and here is the figure: each failure happens, and is explained by its right cause."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, forces, methods, simulate, stability
from physjax.scenes import FAILURES, title
from physjax.scenes.failures import OMEGA
from physjax.study.energy.quantities import total

SLOW = {"stiff_cloth", "implicit_midpoint_on_a_swinging_rope", "tr_bdf2_linearised_once"}


@functools.cache
def explain(name):
    """A failure and its explanation."""
    run = FAILURES[name]()
    return run, stability.explain(run.scene, run.method, run.dt, steps=run.steps)


# the cloth that is damped has a test of its own
NAMES = [name for name in FAILURES if name != "damped_cloth"]


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in NAMES])
def test_the_right_cause_is_named(name):
    run, found = explain(name)
    assert (found.cause, found.force) == (run.cause, run.force)
    assert len(found.cures) == 2
    if run.limit is not None:
        assert found.limit == pytest.approx(run.limit, rel=1e-3)
        assert found.limit < run.dt
    if found.cause in ("stiffness", "damping") and found.limit > 0:
        assert "times the cost" in found.cures[0]
        cured = simulate(run.scene, run.method, dt=0.9 * found.limit, steps=2000, save_every=2000)
        assert cured.ok.all()
    assert 20 < len(title(name)) < 120


@pytest.mark.parametrize(
    ("name", "settings", "growth"),
    [
        ("euler_on_a_spring", {}, np.sqrt(1 + 0.15)),
        ("euler_on_a_spring", {"dt": 1e-3}, np.sqrt(1 + 15e-6)),
        ("midpoint_on_a_spring", {}, np.sqrt(1 + 0.15**2 / 4)),
        ("euler_on_a_damped_spring", {}, np.sqrt(1 - 0.7e-3 + 15 * 49e-6)),
        # z + 1/z = (ω dt)² - 2 at ω dt = 2.02
        ("semi_implicit_beyond_two", {}, 1.01**2 * 2 - 1 + np.sqrt((1.01**2 * 2 - 1) ** 2 - 1)),
        ("rk4_beyond_two_root_two", {}, np.sqrt(1 - (1.01**2 * 8) ** 3 / 72 + (1.01**2 * 8) ** 4 / 576)),
    ],
)
def test_what_grows_does_so_as_predicted(name, settings, growth):
    run = FAILURES[name](**settings)
    assert stability.explain(run.scene, run.method, run.dt).growth - 1 == pytest.approx(growth - 1, rel=1e-6)
    measured = stability.measure_growth(run.scene, run.method, run.dt, steps=200_000 if growth < 1.001 else 2000)
    assert measured - 1 == pytest.approx(growth - 1, rel=0.02)


def test_rk4_loses_energy_below_its_limit():
    dt, steps = 2.5 / OMEGA, 100
    flight = simulate(FAILURES["rk4_beyond_two_root_two"]().scene, methods.rk4, dt=dt, steps=steps)
    energy = 0.5 * flight.velocity[:, 0] ** 2 + 7.5 * flight.position[:, 0] ** 2
    kept = (1 - 2.5**6 / 72 + 2.5**8 / 576) ** steps
    np.testing.assert_allclose(energy[-1] / energy[0], kept, rtol=1e-6)


def test_a_cloth_is_explained_with_its_spring_and_its_node():
    run, found = explain("damped_cloth")
    assert found.limit == pytest.approx(float(stability.measure_limit(run.scene, run.method)), rel=0.02)
    assert found.first_bad_step > 0
    assert f"{found.cause} of Springs (the spring between nodes" in str(found)
    assert f"Not finite after step {found.first_bad_step}, node {found.node[0]} first" in str(found)


def test_drag_turns_a_fast_body_around_within_a_step():
    assert FAILURES["fast_drag"]().run().velocity[1, 0] < 0


def test_a_close_approach_is_cured_by_short_steps_there():
    assert "adaptive" in explain("close_approach")[1].cures[1]


def test_a_ball_in_float32_stands_still_far_from_the_origin():
    flight = FAILURES["far_from_the_origin"]().run()
    assert flight.position[-1, 0] == flight.position[0, 0]  # a metre on, in truth


def test_a_throw_ends_elsewhere_when_the_error_is_blind():
    run = FAILURES["blind_throw"]()
    end = run.run().position[-1]
    exact = jnp.asarray([6.0, 20.0 - 0.5 * 9.8 * 4.0])
    assert float(jnp.linalg.norm(end - exact)) == pytest.approx(4.5, abs=0.6)


def measure_swing(run, **numbers):
    """The energy of a rope that swings, above that of the same rope at rest, as a share of what it starts with."""
    scene, x = run.scene, np.asarray(run.scene.state.position)
    hanging = np.stack([0 * x[:, 0], -np.hypot(*x.T)], axis=-1)
    energy = lambda x, v: float(np.sum(total(scene, 0.0, Particles(jnp.asarray(x), jnp.asarray(v)))))  # noqa: E731
    rest, start = energy(hanging, 0 * x), energy(x, 0 * x)
    film = run.run(save_every=run.steps // 10)
    return np.array([energy(*state) - rest for state in zip(*film.state, strict=True)]) / (start - rest)


@pytest.mark.slow
def test_a_rope_that_swings_breaks_up_under_long_implicit_steps_and_not_under_shorter_ones():
    midpoint = FAILURES["implicit_midpoint_on_a_swinging_rope"]
    assert measure_swing(midpoint()).max() > 1e3
    np.testing.assert_allclose(measure_swing(midpoint(beyond=20.0)), 1.0, rtol=0, atol=1e-3)


@pytest.mark.slow
def test_a_rope_gains_energy_where_tr_bdf2_is_linearised_once_and_not_where_it_is_solved():
    linearised = FAILURES["tr_bdf2_linearised_once"]
    assert measure_swing(linearised()).max() > 1e3
    kept = measure_swing(linearised(newton=20))
    assert np.all(np.diff(kept) < 0)
    assert kept[-1] > 0.99  # after 1200 steps, 15 periods


def test_a_sound_run_is_not_accused():
    found = stability.explain(FAILURES["euler_on_a_spring"]().scene, methods.rk4, 0.01)
    assert found.cause == "nothing"
    assert "Nothing was found wrong" in str(found)
    with pytest.raises(ValueError, match="its method and dt"):
        stability.explain(FAILURES["euler_on_a_spring"]().scene)


def test_one_failed_lane_of_many_is_explained_by_itself():
    stiffness = np.array([1.0, 9.0, 4.0e4])
    lanes = Particles(jnp.ones((3, 3)), jnp.zeros((3, 3)))
    springs = forces.Anchor((0.0, 0.0, 0.0), stiffness)  # as many lanes as components: the point is one for all
    wind = forces.StokesDrag(1e-6, wind=(1.0, 0.0, 0.0))
    flight = simulate(Scene(lanes, 1.0, (springs, wind)), methods.verlet, dt=0.02, steps=600, save_every=50)
    assert flight.ok.tolist() == [True, True, False]
    failed = int(np.argmin(flight.ok))
    found = stability.explain(flight, lane=failed)
    assert (found.cause, found.force) == ("stiffness", "Anchor")
    assert found.first_bad_step == flight.first_bad_step[failed]
    assert found.limit == pytest.approx(2 / np.sqrt(stiffness[failed]), rel=1e-3)
    assert stability.explain(flight.scene, methods.verlet, 0.02, steps=600, lane=failed).cause == "stiffness"
    assert stability.explain(flight, lane=0).cause == "nothing"
    with pytest.raises(IndexError, match="whose shape is"):
        stability.explain(flight, lane=3)
