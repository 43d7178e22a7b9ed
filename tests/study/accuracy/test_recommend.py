"""The advisor keeps its promises, says how it knows, and says what stops it."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, accuracy, contacts, forces, methods, simulate
from physjax.scenes import SCENES
from physjax.study.accuracy import error_measures, recommend
from physjax.study.accuracy.bounds import NEARBY_SHARE, bound_error, list_nearby
from physjax.study.accuracy.compiled_run import compile_run
from physjax.study.accuracy.reference_solution import ReferenceSolution, nudge_start, solve_reference
from physjax.study.accuracy.search import SearchTask, Trial
from physjax.study.problem import Problem

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from random_scenes import random_scene

ERRORS = (1e-2, 1e-4, 1e-6)
FEW = (methods.rk4, methods.verlet)


def spring(stiffness=9.0, x=1.0):
    return Scene(Particles(jnp.asarray([x, 0.0]), jnp.zeros(2)), forces=(forces.Anchor((0.0, 0.0), stiffness),))


@pytest.fixture(scope="module")
def swings():
    return recommend(spring(), error=ERRORS, horizon=10.0, progress=False)


def test_promises_are_kept_by_the_closed_form(swings):
    for advice in swings:
        flight = advice.simulate()
        x = np.cos(3 * np.asarray(flight.time, float))
        assert flight.position.dtype == advice.best.dtype
        assert np.abs(np.asarray(flight.position[:, 0], float) - x).max() / 2 <= advice.error


def test_runners_up_are_slower_and_keep_the_error_too(swings):
    for advice in swings:
        times = [advice.best.seconds, *(c.seconds for c in advice.runners_up)]
        assert times == sorted(times)
        assert all(choice.error <= advice.error for choice in advice.runners_up)
        assert "float32" not in {c.dtype for c in (advice.best, *advice.runners_up) if advice.error < 1e-6}


def test_the_answer_prints_as_a_table_with_reason_and_evidence(swings):
    text = str(swings[1])
    assert "run time per s" in text
    assert f"{swings[1].best.name} at" in text
    assert "diffrax Dopri8" in text
    assert swings[1].richardson == pytest.approx(swings[1].best.error, rel=0.5)


def test_a_state_too_large_for_diffrax_is_measured_by_our_own_fine_steps_as_right(monkeypatch):
    problem = Problem(spring(), 4.0, frames=8)
    by_diffrax = solve_reference(problem)
    monkeypatch.setattr(
        "physjax.study.accuracy.reference_solution.MAX_DIFFRAX_NUMBERS", 3
    )  # a ball in the plane has four numbers
    own = solve_reference(problem, wanted=1e-7)
    assert own.source.startswith("own rk4")
    assert own.truth_error().max() < 2e-9
    assert error_measures.path.error(own.scene, own.times, own.states, by_diffrax.states) < 2e-9


@pytest.mark.slow
def test_a_random_scene_keeps_its_promise_against_another_reference():
    """Diffrax in the search, our own rk4 with fine steps here."""
    scene, horizon = random_scene(2)
    other = solve_reference(Problem(scene, horizon), wanted=1e-7, own=methods.rk4)
    assert other.truth_error().max() < 1e-8
    for advice in recommend(scene, error=ERRORS, horizon=horizon, methods=FEW, progress=False):
        assert (
            error_measures.path.error(other.scene, other.times, advice.simulate().state, other.states) <= advice.error
        )


def test_random_scenes_are_the_same_for_the_same_seed():
    for seed in range(8):
        (one, span), (other, again) = random_scene(seed), random_scene(seed)
        assert span == again
        assert all(bool(jnp.all(a == b)) for a, b in zip(*map(jax.tree.leaves, (one, other)), strict=True))


def ball(response):
    floor = contacts.Plane((0.0,), (1.0,), restitution=0.8, response=response)
    return Scene(Particles(jnp.ones(1), jnp.zeros(1)), forces=(forces.Gravity(up=0),), contacts=(floor,))


@pytest.mark.slow
def test_through_contacts_the_truth_is_our_own_and_the_answer_says_so():
    advice = recommend(ball(contacts.impact), error=1e-6, horizon=1.0, methods=[methods.rk4], progress=False)
    assert advice.ok
    assert "own rk4" in advice.evidence
    assert "Richardson" in advice.evidence


@pytest.mark.slow
def test_contacts_resolved_late_stop_a_small_error():
    advice = recommend(
        ball(contacts.project), error=1e-9, horizon=1.0, methods=[methods.verlet], seconds=3, progress=False
    )
    assert not advice.ok
    assert "contacts resolved at the end of a step" in advice.reason
    with pytest.raises(ValueError, match="nothing keeps an error"):
        advice.simulate()


@pytest.mark.slow
def test_chaos_is_named_with_its_horizon():
    """Three bodies at rest on a triangle of sides 3, 4 and 5 (Burrau's problem), softened: they scatter each other."""
    place = jnp.asarray([[1.0, 3.0], [-2.0, -1.0], [1.0, -1.0]])
    attraction = forces.Gravitation(G=1.0, softening=0.02)
    scene = Scene(Particles(place, jnp.zeros_like(place)), mass=jnp.asarray([3.0, 4.0, 5.0]), forces=(attraction,))
    advice = recommend(scene, error=1e-6, horizon=70.0, methods=[methods.rk4], progress=False)
    assert not advice.ok
    assert "Chaos: beyond" in advice.reason


def test_float32_is_named_where_it_stops():
    few = {"horizon": 10.0, "methods": [methods.rk4], "progress": False}
    advice = recommend(spring(), error=1e-10, dtypes=(np.float32,), **few)
    assert not advice.ok
    assert "float32" in advice.reason
    assert recommend(spring(), error=1e-10, **few).best.dtype == "float64"


@pytest.mark.slow
def test_a_gradient_must_keep_the_error_as_well():
    advice = recommend(spring(), error=1e-5, horizon=10.0, methods=FEW, gradient=True, progress=False)
    assert "gradient" in advice.norm
    with jax.enable_x64(True):
        problem = Problem(spring(), 10.0)
        push = Particles(jnp.zeros(2), jnp.asarray([1.0, 0.0]))
        _, slopes = compile_run(problem, advice.best.method, push=push)(advice.best.steps_per_frame)
    true = np.sin(3 * problem.times) / 3
    assert np.abs(np.asarray(slopes.position[:, 0]) - true).max() <= 1e-5 * np.abs(true).max()


def test_an_error_can_be_that_of_a_users_outcome():
    def crossing(times, states):
        return states.position[-1, 0]

    advice = recommend(spring(), error=1e-6, horizon=10.0, norm=crossing, methods=FEW, progress=False)
    assert advice.norm == "crossing"
    assert abs(float(advice.simulate().position[-1, 0]) / np.cos(30.0) - 1) <= 1e-6


def test_errors_can_be_given_in_metres():
    few = {"horizon": 10.0, "methods": [methods.verlet], "progress": False, "dtypes": (np.float64,)}
    relative = recommend(spring(x=100.0), error=1e-4, **few)  # of an extent of 200 m
    absolute = recommend(spring(x=100.0), error=0.02, scale=1.0, **few)
    assert relative.best.dt == pytest.approx(absolute.best.dt, rel=0.2)


def test_methods_without_time_are_reported():
    advice = recommend(spring(), error=1e-4, horizon=10.0, methods=FEW, seconds=1e-3, progress=False)
    assert advice.untried
    assert f"Not tried for lack of time: {', '.join(advice.untried)}." in str(advice)


def test_the_error_of_each_norm_is_what_it_says():
    """A state with a known offset, measured five ways."""
    floor = contacts.Plane((0.0,), (1.0,))
    scene = Scene(Particles(jnp.ones(1), jnp.zeros(1)), mass=2.0, forces=(forces.Gravity(up=0),), contacts=(floor,))
    times = np.asarray([0.0, 0.1, 0.2])
    truth = Particles(1 - 4.9 * times[:, None] ** 2, -9.8 * times[:, None])
    extent = 4.9 * 0.2**2
    shifted = Particles(truth.position + np.asarray([[0.0], [0.02], [0.01]]), truth.velocity)
    faster = Particles(truth.position, truth.velocity * 1.1)
    sunk = Particles(truth.position - np.asarray([[0.0], [0.0], [1.0]]), truth.velocity)  # to -0.196 m
    error = lambda norm, states: norm.error(scene, times, states, truth)  # noqa: E731
    assert error(accuracy.path, shifted) == pytest.approx(0.02 / extent)
    assert error(accuracy.final, shifted) == pytest.approx(0.01 / extent)
    assert error(accuracy.momentum, faster) == pytest.approx(0.1)
    assert error(accuracy.energy, faster) == pytest.approx(1.1**2 - 1)
    assert error(accuracy.penetration, sunk) == pytest.approx(1.0)
    assert error(accuracy.outcome(lambda t, s: s.velocity[-1, 0]), faster) == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scene": 3}, "expected a Scene"),
        ({"error": 0.0}, "error"),
        ({"error": [[1e-2]]}, "expected a number or a list"),
        ({"horizon": -1.0}, "horizon"),
        ({"norm": 3}, "norm: got 3"),
        ({"dtype": np.float32}, "unknown recommend: option .dtype.. Did you mean dtypes"),
        ({"norm": accuracy.penetration}, "no contacts"),
    ],
)
@pytest.mark.usefixtures("unannotated")
def test_bad_input_is_refused_in_plain_words(arguments, message):
    given = {"scene": spring(), "error": 1e-2, "horizon": 1.0, "progress": False} | arguments
    with pytest.raises((TypeError, ValueError), match=message):
        recommend(given.pop("scene"), **given)


@pytest.mark.slow
def test_rigid_bodies_are_advised_as_well():
    problem = SCENES["free_top"]()
    advice = recommend(
        problem.scene,
        error=1e-4,
        horizon=problem.duration,
        frames=problem.frames,
        methods=[methods.rk4],
        dtypes=(np.float64,),
        progress=False,
    )
    flight = advice.simulate()
    assert error_measures.path.error(problem.scene, problem.times, flight.state, problem.exact(problem.times)) <= 1e-4


def test_lanes_of_every_size_are_each_resolved():
    speed = np.stack([10.0 ** np.arange(-6, 10, 3), np.zeros(6)], axis=-1)
    scene = Scene(Particles(jnp.zeros((6, 2)), jnp.asarray(speed)), forces=(forces.StokesDrag(0.5),))
    advice = recommend(scene, error=1e-5, horizon=2.0, methods=FEW, dtypes=[np.float64], progress=False)
    assert advice.ok, advice.reason
    assert advice.truth_error < 1e-11
    exact = speed[:, 0] / 0.5 * (1 - np.exp(-0.5 * 2.0))
    np.testing.assert_allclose(advice.simulate().position[-1, :, 0], exact, rtol=2e-5)


def test_a_period_that_divides_the_moments_is_no_chaos():
    # at each moment it is where it began
    problem = Problem(spring((2 * np.pi / 0.5) ** 2), 32.0)
    with jax.enable_x64(True):
        truth = solve_reference(problem)
    assert truth.truth_error().max() < 1e-11
    assert truth.horizon(1e-6, 1e-15) == np.inf
    assert truth.reach.max() == pytest.approx(2.0, rel=0.02)


@pytest.mark.slow
def test_dry_friction_is_walked_through_and_never_called_chaos():
    friction = forces.independent(lambda t, s, m: -2.0 * jnp.sign(s.velocity))
    scene = Scene(Particles(jnp.zeros((2, 1)), jnp.asarray([[3.0], [5.0]])), forces=(friction,))
    few = {"horizon": 4.0, "methods": FEW, "dtypes": [np.float64], "progress": False}
    good, bad = recommend(scene, error=(1e-3, 1e-9), **few)
    assert good.ok, good.reason
    np.testing.assert_allclose(good.simulate().position[-1, :, 0], [2.25, 6.25], rtol=2e-3)
    assert "known only to" in bad.reason
    assert "worst in lane" in bad.reason


@pytest.mark.slow
def test_a_deviation_that_a_larger_nudge_leaves_as_small_is_no_growth():
    with jax.enable_x64(True):
        truth = solve_reference(Problem(spring(), 4.0, frames=8))
    noise = jax.tree.map(lambda leaf: leaf * (1 + np.linspace(0.0, 1.0, 9)[:, None] ** 9), truth.states)
    jumpy = truth._replace(nudged=noise, more_nudged=lambda: noise)
    assert jumpy.growth().max() > 1e8
    assert jumpy.horizon(1e-6, 1e-15) == np.inf
    far = jax.tree.map(lambda a, b: a + 10 * (b - a), truth.states, noise)
    assert jumpy._replace(more_nudged=lambda: far).horizon(1e-6, 1e-15) < 4.0


def test_the_error_of_a_start_nearby_stays_below_the_bound(swings):
    """Of 40 other starts, nudged alike, nearly all: the bound is for 95 of 100."""
    advice = swings[1]
    assert advice.bound.starts == 19
    assert advice.confidence == pytest.approx(0.95)
    assert advice.best.error <= advice.error_bound < 1.5 * advice.best.error
    assert f"Bound: {advice.error_bound:.1e} with 95% confidence" in str(advice)
    random, omega = np.random.default_rng(5), 3.0
    run = compile_swing(advice.best)
    kept = []
    for speed in random.normal(size=(40, 2)) * NEARBY_SHARE * omega:
        flight = run(speed)
        exact = np.cos(omega * flight.time)[:, None] * [1.0, 0.0] + np.sin(omega * flight.time)[:, None] * speed / omega
        off = np.linalg.norm(np.asarray(flight.position) - exact, axis=-1).max() / 2
        kept.append(off <= advice.error_bound)
    assert np.mean(kept) >= 0.85


def compile_swing(best):
    """The recommended run of the swing from another start, which compiles once."""

    def run(speed):
        with jax.enable_x64(best.dtype == "float64"):
            state = Particles(jnp.asarray([1.0, 0.0]), jnp.asarray(speed))
            scene = Scene(state, forces=(forces.Anchor((0.0, 0.0), 9.0),))
            return simulate(scene, best.method, dt=best.dt, duration=10.0, save_every=best.steps_per_frame)

    return run


def test_fewer_starts_give_less_confidence_and_no_time_gives_none():
    with jax.enable_x64(True):
        problem = Problem(spring(), 4.0, frames=8)
        task = SearchTask(problem, solve_reference(problem), error_measures.path, None, None, np.inf)
        entry = compile_run(problem, methods.rk4)
        trial = Trial(8.0, task.error(entry(8.0)), 1e-3)
        few = bound_error(task, list_nearby(task, 3, 60.0), entry, trial, 0.0)
        none = bound_error(task, list_nearby(task, 3, 0.0), entry, trial, 0.0)
    assert (few.starts, few.confidence) == (3, 0.75)
    assert trial.error <= few.error < 2 * trial.error
    assert (none.starts, none.confidence) == (0, 0.0)
    assert np.isnan(none.error)


def test_starts_nearby_differ_from_each_other_and_held_lanes_stay():
    state = Particles(jnp.zeros((2, 2)), jnp.ones((2, 2)))
    scene = Scene(state, forces=(forces.Gravity(),), pinned=np.asarray([True, False]))
    states = jax.tree.map(lambda leaf: np.stack([leaf, 2 * leaf]), state)
    moved = [np.asarray(nudge_start(scene, states, 0.01, seed=seed).state.velocity) for seed in (1, 2)]
    assert (moved[0][1] != moved[1][1]).all()
    assert all(np.abs(v[1] - 1).max() < 0.01 * 2 * 4 and (v[0] == 0).all() for v in moved)


@pytest.mark.parametrize(
    ("grow", "chaotic"),
    [
        (lambda t: np.exp(9 * t), True),
        (lambda t: np.exp(4 * t), False),  # too slowly for the time
        (lambda t: 1e4 * t, False),
        (lambda t: 1e4 * t**2, False),
        (lambda t: 5e3 * t * np.cos(2 * np.pi * t) ** 20, False),  # large where an orbit is close
        (lambda t: np.where(t < 0.9, 1.0, 1e8), True),
    ],
)
def test_chaos_is_exponential_growth_over_the_run(grow, chaotic):
    times = np.linspace(0.0, 10.0, 33)
    scene, still = spring(), np.zeros((33, 2))
    line = still + [1.0, 0.0] * np.asarray(times)[:, None] / 10
    off = lambda share: Particles(line + share * grow(times / 10)[:, None] * [0.0, 1.0], still)  # noqa: E731
    truth = ReferenceSolution(
        scene, times, Particles(line, still), None, off(1e-10), None, "", np.ones(1), lambda: off(1e-9)
    )
    assert np.isfinite(truth.lyapunov_time()) == chaotic
