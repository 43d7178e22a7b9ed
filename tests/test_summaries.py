"""Results say what they are in a few lines with numbers and units, as text and as a table of HTML."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import (
    Particles,
    Scene,
    contacts,
    forces,
    lattices,
    methods,
    simulate,
    stability,
    sweep,
)
from physjax.crossing import Crossing
from physjax.parts import as_module
from physjax.study.accuracy.result import Run, WorkPrecision
from physjax.study.inverse.aim import Aimed, Shot
from physjax.study.inverse.shooting import AimProblem
from physjax.study.inverse.solve import Minimum, Solution
from physjax.summaries import format_array, format_tree, write_table

BALL = Particles(jnp.array([0.0, 10.0]), jnp.array([3.0, 4.0]))
SHEET = lattices.cloth(1.0, 1.0, 3, 3, mass=0.9, structural=100.0)
SWING = Scene(
    Particles(jnp.array([1.0]), jnp.array([0.0])), mass=1.0, forces=(forces.Anchor(point=(0.0,), stiffness=4.0),)
)


def test_a_scene_names_its_parts_with_numbers_and_units():
    def push(t, state, mass):
        return 0 * state.velocity

    floor = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.5)
    text = repr(
        Scene(BALL, mass=2.0, forces=(forces.Gravity(), forces.QuadraticDrag(0.1, 0.4), push), contacts=(floor,))
    )
    assert len(text.splitlines()) == 8
    for words in (
        "<Scene: 1 particle in 2-D, float64",
        "(0, 10) m",
        "2 kg",
        "Gravity(g=9.8 m/s²",
        "area=0.1 m²",
        "density=1.225 kg/m³",
        "push(t, state, mass)",
        "restitution=0.5",
    ):
        assert words in text
    flag = Scene(SHEET.state, SHEET.mass, (forces.Gravity(), SHEET.springs), pinned=SHEET.nodes["left"])
    assert "9 coupled particles in 3-D" in repr(flag)
    assert "held      3 of 9" in repr(flag)


def test_of_what_is_traced_the_type_is_said():
    seen = []
    jax.make_jaxpr(lambda x: seen.append(repr(Scene(Particles(x, BALL.velocity)))))(jnp.zeros(2))
    assert "traced float64[2] m" in seen[0]


def test_a_part_alone_says_its_numbers():
    assert repr(forces.Gravity(3.7)).startswith("Gravity(g=3.7 m/s²")
    assert "restitution=0.25" in repr(contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.25))


def results():
    """Built by hand where they take long to compute."""
    still = Scene(Particles(jnp.zeros(2), jnp.zeros(2)), mass=0.145, forces=(forces.Gravity(),))
    hit, number = jnp.asarray(True), jnp.asarray
    shot = Shot(number(0.3571), None, number(30.0), number(1.4), jnp.ones(2), number(5.6), jnp.zeros(2), hit)
    aimed = Aimed(shot, shot, AimProblem(still, jnp.array([40.0, 5.0]), as_module(methods.rk4), 200))
    runs = [
        Run("verlet", dt, None, 32, 64, 1e-4, 1e-4, 0.1, error, error, ()) for dt, error in ((0.1, 1e-2), (0.05, 2e-3))
    ]
    chart = WorkPrecision(
        "swing", tuple(runs), {"verlet": 2.0}, "exact", 0.0, 2.0, (), "float64", (np.ones(2), np.ones(2))
    )
    limit = stability.Limit("verlet", 1.0, np.ones(()), "stiffness", "Anchor", None, (), -2j)
    return {
        "scene": (SWING, ["1 m", "stiffness=4 N/m"]),
        "lattice": (SHEET, ["9 nodes (3×3)", "0.9 kg", "left 3"]),
        "aimed": (aimed, ["(40, 5) m", "30 m/s", "low arc", "high arc", "misses by"]),
        "shot": (aimed.low, ["0.3571 rad", "True"]),
        "limit": (limit, ["verlet: 1 s", "stiffness of Anchor"]),
        "sweep": (sweep(lambda k: k**2, {"k": jnp.linspace(0, 1, 5)}, progress=False), ["0 to 1, 5", "5 ok"]),
        "work-precision": (chart, ["2 runs over 2 s", "verlet", "error 0.002 of the path, in 100 µs"]),
        "solution": (Solution(number(1.414), number(1e-9), hit, number(5)), ["1.414", "1e-9"]),
        "minimum": (Minimum({"a": number(1.0)}, number(0.0), hit, number(5)), ["['a'] 1", "cost"]),
        "crossing": (Crossing(number(1.4977), number([4.5, 5.0]), jnp.ones(2), hit), ["1.498 s", "5) m"]),
    }


def test_every_result_is_a_few_lines_with_what_matters():
    for name, (result, words) in results().items():
        text = repr(result)
        assert len(text.splitlines()) <= 10, name
        assert all(word in text for word in words), (name, text)
        if hasattr(result, "_repr_html_"):
            assert result._repr_html_().startswith("<table>"), name


def test_many_numbers_are_a_range_and_what_is_not_finite_is_counted():
    assert format_array(np.array([1.0, np.nan, 3.0, 4.0, 5.0]), "m") == "1 to 5 (1 not finite) m, 5"
    assert format_array(np.float32(1e-7)) == "1e-7"
    assert format_array(np.ones(9, bool)) == "9 of 9"
    assert format_tree({"a": jnp.ones(2), "b": 3.0}) == "['a'] (1, 1), ['b'] 3"


def test_names_stay_text_in_tables():
    assert "<b>" not in write_table("<b>", [("<b>", "<b>")])


# what is read from a run


@pytest.fixture(scope="module")
def fall():
    scene = Scene(BALL, forces=(forces.Gravity(), forces.QuadraticDrag(0.1, 0.4)))
    return [simulate(scene, methods.rk4, dt=0.1, steps=30, save_every=every) for every in (1, 10)]


def test_a_run_has_a_length_and_frames(fall, unannotated):
    run, coarse = fall
    assert (len(run), len(coarse)) == (31, 4)
    np.testing.assert_array_equal(coarse[-1].position, run.position[30])
    assert len(list(coarse)) == 4
    with pytest.raises(IndexError, match="expected -4 to 3"):
        coarse[4]
    with pytest.raises(TypeError, match=r"flight\[-1\]"):
        coarse[1.0]


def test_the_state_at_any_time_is_that_of_the_run_however_few_frames_there_are(fall):
    run, coarse = fall
    np.testing.assert_allclose(coarse.at(run.time).position, run.position, rtol=1e-9, atol=1e-9)
    between = coarse.at(0.537)
    fine = simulate(run.scene, methods.rk4, dt=0.537 / 64, steps=64)
    np.testing.assert_allclose(between.position, fine.position[-1], rtol=1e-6)
    speed = jax.grad(lambda t: coarse.at(t).position[0])(0.537)
    np.testing.assert_allclose(speed, between.velocity[0], rtol=1e-4)
    with pytest.raises(ValueError, match="from 0 to 3 s"):
        coarse.at(3.5)


def test_energies_tables_and_pictures_of_a_run(fall):
    run = fall[1]
    energy = run.energy()
    np.testing.assert_allclose(energy[0], 0.5 * 25 + 9.8 * 10)
    assert (np.diff(energy) < 0).all()
    data = run.to_xarray()
    assert dict(data.position.sizes) == {"time": 4, "component": 2}
    assert data.velocity.attrs["units"] == "m/s"
    table = run.to_pandas()
    np.testing.assert_allclose(table["position_y"], run.position[:, 1])
    assert run.plot().axes[0].get_xlabel() == "x [m]"
