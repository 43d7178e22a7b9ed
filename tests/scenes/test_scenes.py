"""Every scene of the gallery keeps its own truth, and real data is met."""

import jax
import numpy as np
import pytest

from physjax import methods, simulate
from physjax.scenes import SCENES, title
from physjax.scenes.orbits import read_newtonian_places
from physjax.scenes.registry import read_table

SLOW = (
    "car",
    "ragdoll",
    "heavy_rope",
    "chain_bridge",
    "crane",
    "hung_ragdoll",
    "thrown_ragdoll",
    "motor_car",
    "triple_pendulum",
    "tumbling_box",
    "rolling",
    "bowling",
    "smoke",
    "sparks",
    "stiff_flag",
    "stiff_jelly",
)
PILES = ("box_on_slope", "stack_of_ten", "stack_of_sizes", "pyramid", "card_house")
IN_SPACE = ("stack_in_space", "pyramid_in_space", "cradle_in_space", "marbles")
SOLIDS = (*PILES, *IN_SPACE, "wrecking_ball", "newtons_cradle", "billiard_break", "dominoes", "marble_run", "see_saw")
"""What compiles for many seconds."""


@pytest.fixture(params=[pytest.param(n, marks=pytest.mark.slow) if n in (*SLOW, *SOLIDS) else n for n in SCENES])
def problem(request):
    return SCENES[request.param]()


def test_every_truth_holds(problem):
    verdicts = problem.verify()
    assert verdicts, "a scene without a truth proves nothing"
    for truth, measured, holds in verdicts:
        assert holds, f"{truth.statement}: measured {measured}, expected {truth.expected}"


def test_the_closed_form_solves_the_equations_of_motion(problem):
    if problem.exact is None:
        pytest.skip("no closed form")
    flight = problem.reference()
    exact = problem.exact(problem.times)
    for name, tolerance in zip(exact._fields, (1e-9, 1e-8, 1e-8, 1e-8), strict=False):
        found, true = getattr(flight.state, name), getattr(exact, name)
        np.testing.assert_allclose(found, true, atol=tolerance * np.abs(true).max(), rtol=0, err_msg=name)


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_is_described_and_follows_the_float_type_of_the_moment(name):
    assert 20 < len(title(name)) < 120
    with jax.enable_x64(False):
        assert SCENES[name]().scene.state.dtype == np.float32


def errors_in_km(method, dt_days, days):
    problem = SCENES["solar_system"]()
    steps = round(days / dt_days)
    end = simulate(problem.scene, method, dt=days * 86400.0 / steps, steps=steps, save_every=steps).final_scene.state
    ephemeris = read_table("solar_system_de421.csv")
    then = ephemeris["julian_date_tdb"] == ephemeris["julian_date_tdb"].min() + days
    position = np.stack([ephemeris[c][then] for c in ("x_m", "y_m", "z_m")], axis=-1)
    off = np.linalg.norm(np.asarray(end.position) - position, axis=-1) / 1e3
    return dict(zip(ephemeris["body"][then], off, strict=True)), problem.scene, end


def test_rk4_lands_where_newtons_law_leaves_the_planets_after_ten_years():
    off, scene, end = errors_in_km(methods.rk4, 0.1, 3652.5)
    expected = {"mercury": 1823, "venus": 901, "earthmoon": 561, "mars": 341, "jupiter": 72.2, "saturn": 15.5}
    expected |= {"uranus": 0.38, "neptune": 0.155, "pluto": 0.24}
    for planet, km in expected.items():
        assert off[planet] == pytest.approx(km, rel=0.05), planet
    momentum = lambda state: np.sum(np.asarray(scene.mass)[:, None] * np.asarray(state.velocity), axis=0)  # noqa: E731
    size = np.sum(np.asarray(scene.mass) * np.linalg.norm(np.asarray(scene.state.velocity), axis=-1))
    assert np.abs(momentum(end) - momentum(scene.state)).max() < 1e-12 * size


def test_dprkn6_takes_ten_years_of_the_planets_to_a_metre():
    scene, steps = SCENES["solar_system"]().scene, 18_000
    end = simulate(scene, methods.dprkn6, dt=3652.5 * 86400.0 / steps, steps=steps, save_every=steps).final_scene.state
    assert np.linalg.norm(end.position - read_newtonian_places(3652.5), axis=-1).max() < 1.0


def test_thirty_days_of_the_inner_planets():
    off, _, _ = errors_in_km(methods.rk4, 0.05, 30)
    for planet, km in {"mercury": 9.2, "earthmoon": 1.5, "mars": 0.2}.items():
        assert off[planet] == pytest.approx(km, abs=0.05), planet
