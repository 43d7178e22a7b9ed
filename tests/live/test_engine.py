"""The engine of a live view: what it answers is the run that was asked for, and nothing is compiled twice."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, explore, forces, methods, simulate, springs
from physjax.live import engine as engine_module
from physjax.live.engine import Engine
from physjax.live.pictures import snap
from physjax.live.runs import Overtaken
from physjax.show.stage import Stage


def throw(speed, angle, g=9.8):
    launch = speed * jnp.array([jnp.cos(angle), jnp.sin(angle)])
    return Scene(Particles(jnp.zeros(2), launch), forces=(forces.Gravity(g),))


def swing(stiffness):
    """A spring whose force closes over the slider's number, as a user's own functions do."""

    def pull(t, state, mass):
        return -stiffness * state.position

    return Scene(Particles(jnp.array([1.0]), jnp.array([0.0])), mass=1.0, forces=(pull,))


class Counted:
    """A method that counts how often it is traced."""

    def __init__(self, method):
        self.method, self.traces = method, 0

    def __call__(self, system, t, state, dt):
        self.traces += 1
        return self.method(system, t, state, dt)


def build_engine(build=throw, method=methods.verlet, **options):
    ranges = {"speed": (10, 50), "angle": (0.1, 1.4, 0.8)} if build is throw else {"stiffness": (1.0, 16.0, 4.0)}
    return Engine(build, ranges, methods=[method], **({"duration": 3.0} | options))


def numbers(**given):
    return {"numbers": given}


def test_the_film_is_the_run_that_simulate_makes():
    engine = build_engine(frames=50)
    answer = engine.answer(engine.read_settings(numbers(speed=20.0, angle=0.5) | {"dt": 0.01}))
    flight = simulate(throw(20.0, 0.5), methods.verlet, dt=0.01, duration=3.0, save_every=6)
    np.testing.assert_allclose(answer.run.flight.position, flight.position, rtol=1e-12)
    np.testing.assert_allclose(answer.run.flight.time, flight.time, rtol=1e-12)
    part, (low, high) = answer.film["part"], np.array(answer.film["reach"])
    places = (low + high) / 2 + part["places"].reshape(51, 2) / 32767 * (high - low) / 2
    np.testing.assert_allclose(places, flight.position, atol=(high - low).max() / 60_000)


@pytest.mark.parametrize("build", [throw, swing])
def test_a_changed_number_step_or_duration_of_the_run_recompiles_nothing(build):
    method = Counted(methods.verlet)
    engine = build_engine(build, method, frames=8)
    first, *others = engine.sliders[0].low, engine.sliders[0].high, 7.0
    name = engine.sliders[0].name
    engine.measure(engine.answer(engine.read_settings(numbers(**{name: first}))))
    traced = method.traces
    ends = []
    for value in others:
        for dt in (0.003, 0.05):
            answer = engine.answer(engine.read_settings(numbers(**{name: value}) | {"dt": dt}))
            engine.measure(answer)
            ends.append(float(answer.run.flight.position[-1, 0]))
    assert method.traces == traced > 0
    assert not engine.recompiles
    assert len(set(np.round(ends, 6))) >= 2  # and the runs differ


def test_a_force_that_closes_over_a_number_follows_the_slider():
    engine = build_engine(swing, methods.rk4, duration=1.0)
    for stiffness in (1.0, 9.0):
        answer = engine.answer(engine.read_settings(numbers(stiffness=stiffness) | {"dt": 1e-3}))
        np.testing.assert_allclose(answer.run.flight.position[-1, 0], np.cos(np.sqrt(stiffness)), rtol=1e-9)


def test_a_build_that_asks_for_its_numbers_recompiles_and_says_so():
    def build(stiffness):
        pull = (
            (lambda t, state, mass: -state.position) if stiffness > 2 else (lambda t, state, mass: 0 * state.position)
        )
        return Scene(Particles(jnp.array([1.0]), jnp.array([0.0])), forces=(pull,))

    engine = Engine(build, {"stiffness": (1.0, 5.0, 4.0)}, methods=[methods.rk4], duration=1.0)
    assert engine.recompiles
    still, moving = (engine.answer(engine.read_settings(numbers(stiffness=k) | {"dt": 0.01})) for k in (1.0, 4.0))
    assert np.ptp(still.run.flight.position) == 0
    np.testing.assert_allclose(moving.run.flight.position[-1, 0], np.cos(1.0), rtol=1e-8)


def test_steps_longer_than_a_frame_are_seen_as_they_are():
    engine = build_engine(frames=60, dt=(0.01, 1.0))
    answer = engine.answer(engine.read_settings({"dt": 0.5}))
    assert answer.run.steps == 6
    assert len(np.unique(answer.run.flight.time)) == 7


def figures(engine, answer):
    return {figure.name: figure for figure in engine.measure(answer)}


def test_the_error_is_that_against_half_the_step_and_falls_with_the_order():
    engine = build_engine(swing, methods.verlet, frames=20)
    found = []
    for dt in (0.05, 0.025):
        answer = engine.answer(engine.read_settings(numbers(stiffness=4.0) | {"dt": dt}))
        assert "half the step" in figures(engine, answer)["error"].note
        found.append(answer.run)
    exact = [np.abs(run.flight.position[:, 0] - np.cos(2 * run.flight.time)).max() / 2 for run in found]
    shown = figures(engine, engine.answer(engine.read_settings(numbers(stiffness=4.0) | {"dt": 0.05})))["error"].value
    # half the step has a quarter of the error
    assert float(shown.removesuffix(" %")) / 100 == pytest.approx(0.75 * exact[0], rel=0.1)
    assert exact[0] / exact[1] == pytest.approx(4, rel=0.05)


def test_the_strip_names_the_stable_step_its_cause_and_what_failed():
    engine = build_engine(swing, methods.verlet, duration=2000.0, dt=(0.1, 2.0))
    answer = engine.answer(engine.read_settings(numbers(stiffness=4.0) | {"dt": 1.5}))
    assert figures(engine, answer)["stable step"].value == "…"
    engine.find_limit(answer)
    found = figures(engine, answer)
    assert found["stable step"].value == "1 s"
    assert found["stable step"].grade == "bad"
    assert "stiffness of pull" in found["stable step"].note
    assert found["status"].value == "failed"
    assert "longer than 1 s" in found["status"].note
    assert found["energy change"].value == found["error"].value == "not finite"
    sound = engine.answer(engine.read_settings(numbers(stiffness=4.0) | {"dt": 0.5}))
    assert figures(engine, sound)["status"].value == "ok"


def stretch(length):
    """Two weights on a spring."""
    pull = springs.Springs([(0, 1)], stiffness=4.0, rest_length=1.0)
    return Scene(Particles(length * jnp.array([[0.0], [1.0]]), jnp.zeros((2, 1))), forces=(pull,))


def sway(amplitude):
    """Two weights ten metres apart, one of which hardly moves."""
    places, pull = jnp.array([[0.0], [10.0]]), forces.Anchor(jnp.array([[0.0], [10.0]]), 4.0)
    return Scene(Particles(places + amplitude * jnp.array([[1.0], [1e-9]]), jnp.zeros((2, 1))), forces=(pull,))


def test_the_error_of_what_rests_is_no_share_of_its_path():
    engine = Engine(sway, {"amplitude": (1e-3, 2.0, 1e-3)}, methods=[methods.euler], duration=2.0, dt=(0.01, 0.1))
    small, large = (figures(engine, engine.answer(engine.read_settings(numbers(amplitude=a)))) for a in (1e-3, 2.0))
    assert small["error"].note == "of 0.1 m, since little moves, against half the step"
    assert small["error"].value != large["error"].value
    assert large["error"].note == "of the path, against half the step"


def test_nodes_of_a_coupled_scene_share_their_path():
    engine = Engine(stretch, {"length": (1.0, 2.0)}, methods=[methods.euler], duration=2.0, dt=(0.01, 0.1))
    note = figures(engine, engine.find_start())["error"].note
    assert note == "of the path, against half the step"


def test_slow_scenes_start_with_steps_of_a_game_and_one_for_each_frame(monkeypatch):
    monkeypatch.setattr(engine_module, "SLOW_RUN_SECONDS", 0.0)
    for duration, dt in ((4.0, 1 / 60), (0.4, 0.4 / 96)):
        engine = Engine(swing, {"stiffness": (1.0, 9.0)}, methods=[methods.verlet], duration=duration)
        assert engine.find_start().settings.dt == engine.start.dt == pytest.approx(dt)
    engine = Engine(swing, {"stiffness": (1.0, 9.0)}, methods=[methods.verlet], duration=4.0, dt=1e-3)
    assert engine.find_start().settings.dt == 1e-3, "a step that was asked for stays"
    engine = Engine(swing, {"stiffness": (1e4, 9e5)}, methods=[methods.verlet], duration=4.0)
    assert engine.find_start().settings.dt < 1 / 60, "the longer one blows up"


def test_a_gallery_scene_has_its_closed_form_its_units_and_runs_from_its_own_code():
    explorer = explore("projectile", methods=[methods.rk4, methods.euler])
    engine = explorer.engine
    assert [(s.name, s.unit) for s in engine.sliders] == [("speed", "m/s"), ("angle", "rad"), ("g", "m/s²")]
    found = figures(engine, explorer.first)
    assert found["error"].note == "of the path, against the closed form"
    assert found["energy drift"].value == "none"
    settings = engine.read_settings(numbers(speed=20.0) | {"method": "euler"})
    scope = {}
    exec(engine.write_code(settings).replace("flight.plot()", ""), scope)
    np.testing.assert_allclose(scope["flight"].position[-1], engine.answer(settings).run.flight.position[-1], rtol=1e-5)
    assert "methods.euler" in explorer.engine.write_code(settings)


def test_the_first_step_is_shortened_until_the_run_stays_finite():
    engine = Engine(swing, {"stiffness": (1e4, 1e8, 4e6)}, methods=[methods.verlet], duration=60.0)
    assert engine.start.dt == 0.1
    answer = engine.find_start()
    assert not answer.run.failed.any()
    assert answer.settings.dt == engine.start.dt < 1e-3


def test_a_run_that_is_overtaken_ends_between_two_of_its_blocks():
    engine = build_engine()
    asked = []

    def overtaken():
        asked.append(1)
        return len(asked) > 3

    with pytest.raises(Overtaken):
        engine.answer(engine.start, None, overtaken)
    assert len(asked) == 4


def test_the_box_holds_the_ghost_and_does_not_tremble():
    engine = build_engine()
    settings = engine.read_settings(numbers(speed=20.0))
    small = engine.answer(settings).film
    large = engine.answer(engine.read_settings(numbers(speed=50.0))).film
    with_ghost = engine.answer(settings, (large["low"], large["high"])).film
    assert (np.array(with_ghost["high"]) >= np.array(large["high"])).all()
    near = engine.answer(engine.read_settings(numbers(speed=20.02))).film
    assert (near["low"], near["high"]) == (small["low"], small["high"])
    box = snap(Stage(np.array([-0.3, 0.1]), np.array([9.7, 3.2])))
    assert (box.low <= [-0.3, 0.1]).all()
    assert (box.high >= [9.7, 3.2]).all()


def test_particles_on_a_line_stand_side_by_side():
    film = explore("fall_with_drag", methods=["verlet"]).first.film
    assert film["names"] == ["", "x [m]"]
    assert len(film["low"]) == 2


@pytest.mark.parametrize(
    ("build", "ranges", "options", "error", "words"),
    [
        (throw, {"speed": (10, 50)}, {}, ValueError, "needs a range for 'angle'"),
        (throw, {"speed": (50, 10), "angle": 1.0}, {}, ValueError, "the lower first"),
        (throw, {"speed": (10, 50, 60), "angle": 1.0}, {}, ValueError, "the start 60"),
        (throw, {"speed": "fast", "angle": 1.0}, {}, TypeError, "expected a range"),
        (throw, {"speed": None, "angle": 1.0}, {}, TypeError, "expected a range"),
        (throw, {"velocity": (1, 2), "speed": 1.0, "angle": 1.0}, {}, ValueError, "takes no 'velocity'"),
        (throw, {"speed": (10, 50), "angle": 1.0}, {"duration": None}, ValueError, "Give duration="),
        (throw, {"speed": (10, 50), "angle": 1.0}, {"methods": ["rk5"]}, ValueError, "rk5"),
        (throw, {"speed": (10, 50), "angle": 1.0}, {"methods": methods.rk4}, TypeError, "expected a list"),
        (throw, {"speed": (10, 50), "angle": 1.0}, {"dt": (-1.0, 1.0)}, ValueError, "longer than 0"),
        (lambda frames: throw(1.0, 1.0), {"frames": (1, 2)}, {}, ValueError, "argument of explore itself"),
        (lambda speed: 3.0, {"speed": (1, 2)}, {}, TypeError, "expected a Scene or a Problem"),
    ],
)
def test_what_does_not_fit_is_refused_in_plain_words(build, ranges, options, error, words):
    with pytest.raises(error, match=words):
        Engine(build, ranges, **({"duration": 3.0} | options))


def test_settings_from_a_page_stay_in_their_ranges():
    engine = build_engine()
    assert engine.read_settings(numbers(speed=1e9)).numbers["speed"] == 50
    with pytest.raises(ValueError, match="speed: got 'x'"):
        engine.read_settings(numbers(speed="x"))
    with pytest.raises(ValueError, match="method"):
        engine.read_settings({"method": "no such"})


def test_numbers_are_in_float64_whatever_the_session_uses():
    with jax.enable_x64(False):
        answer = build_engine(frames=8).find_start()
    assert answer.run.flight.position.dtype == np.float64
