"""What is predicted of a method before it is compiled: from its promises and from the runs of others."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, forces, methods
from physjax.study.accuracy import error_measures
from physjax.study.accuracy.compiled_run import compile_run
from physjax.study.accuracy.exploring import Candidate, explore_methods
from physjax.study.accuracy.forecast import Costs, Pace, estimate_pace, predict_seconds
from physjax.study.accuracy.method_facts import depends_on_velocity
from physjax.study.accuracy.reference_solution import solve_reference
from physjax.study.accuracy.search import Exploration, SearchTask, Trial
from physjax.study.problem import Problem
from physjax.text import progress_bar

COSTS = Costs(frame=16.0, entry=3.0, step=0.0, evaluation=1.0)


class Run:
    """What a forecast asks of a compiled run."""

    adaptive = False

    def __init__(self, method):
        self.method, self.error_power = method, float(method.promises.order)

    def dt(self, fineness):
        return 1 / fineness


def explored(method, *trials):
    return Exploration(Run(method), tuple(Trial(*trial) for trial in trials))


def swing():
    return Scene(Particles(jnp.asarray([1.0, 0.0]), jnp.zeros(2)), forces=(forces.Anchor((0.0, 0.0), 9.0),))


def test_higher_orders_win_where_errors_are_small():
    pace = Pace(((4.0, 0.1),), 0.1, 0.0, COSTS)
    few = {"verlet": methods.verlet, "rk4": methods.rk4, "dopri8": methods.dopri8}

    def find_fastest(error):
        return min(few, key=lambda name: predict_seconds(pace, few[name], few[name].promises.order, error))

    assert [find_fastest(error) for error in (1e-1, 1e-5, 1e-12)] == ["verlet", "rk4", "dopri8"]


def test_steps_that_are_too_long_for_one_method_are_for_others():
    # unstable with 8 steps between two moments, stable with 16
    failed = explored(methods.verlet, (8.0, np.inf, 1e-3), (16.0, 1e-4, 1e-3), (32.0, 2.5e-5, 2e-3))
    pace = estimate_pace(swing(), None, [failed])
    assert pace.stiffness == pytest.approx(2.0 * 16)
    stable = predict_seconds(pace, methods.rk4, 4.0, 1e-2)
    assert (
        stable >= pace.costs.frame + pace.stiffness / methods.rk4.promises.stability_limit * 4 * pace.costs.evaluation
    )


def test_what_runs_cost_is_read_off_runs_with_few_and_with_many_steps():
    found = explored(methods.rk4, (1.0, 1e-2, 2e-4 + 1e-5), (64.0, 1e-9, 2e-4 + 64e-5))
    pace = estimate_pace(swing(), None, [found])
    assert 4 * pace.costs.evaluation == pytest.approx(1e-5)
    assert pace.costs.frame + 4 * pace.costs.entry == pytest.approx(2e-4)
    assert predict_seconds(pace, methods.rk4, 4.0, 1e-2) == pytest.approx(2.1e-4, rel=0.01)


@pytest.mark.parametrize("method", [methods.blanes_moan4, methods.tsit5, methods.verlet, methods.dprkn6])
def test_methods_need_the_steps_that_their_promises_predict(method):
    """On a swing, from one run of rk4, within a factor of three."""
    with jax.enable_x64(True):
        problem = Problem(swing(), 10.0)
        times = problem.times
        exact = np.stack([np.cos(3 * times), np.zeros_like(times)], axis=-1)

        def measure(one, count):
            off = np.asarray(compile_run(problem, one)(count).position) - exact
            return np.linalg.norm(off, axis=-1).max() / 2

        known = measure(methods.rk4, 8.0)
        difficulty, count = 8.0 * known**0.25, 4.0
        error = measure(method, count)
    predicted = difficulty * error ** (-1 / method.promises.order) / method.promises.relative_step
    assert count / 3 < predicted < 3 * count


@pytest.mark.parametrize("speed", [0.5, 3.0, 50.0])
def test_dry_friction_is_seen_to_depend_on_velocity_however_fast_a_body_is(speed):
    friction = forces.independent(lambda t, s, m: -2.0 * jnp.sign(s.velocity))
    assert depends_on_velocity(Scene(Particles(jnp.zeros(1), jnp.full(1, speed)), forces=(friction,)))
    assert not depends_on_velocity(Scene(Particles(jnp.zeros(1), jnp.full(1, speed)), forces=(forces.Gravity(up=0),)))


@pytest.mark.slow
def test_what_cannot_win_is_not_compiled(monkeypatch):
    compiled = []

    def note(problem, method, *more, **options):
        compiled.append(method.__name__)
        return compile_run(problem, method, *more, **options)

    monkeypatch.setattr("physjax.study.accuracy.exploring.compile_run", note)
    few = [Candidate(m, float(m.promises.order)) for m in (methods.rk4, methods.euler, methods.midpoint, methods.heun)]
    with jax.enable_x64(True):
        problem = Problem(swing(), 10.0)
        task = SearchTask(problem, solve_reference(problem), error_measures.path, None, None, np.inf)
        with progress_bar(progress=False, desc="", unit="", leave=False) as bar:
            found, untried = explore_methods(task, few, [1e-6], None, bar, everything=False)
    assert compiled == ["rk4"]
    assert [entry.compiled_run.name for entry in found] == ["rk4"]
    assert not untried
