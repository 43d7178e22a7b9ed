"""The order that errors show: from runs made up with known errors, and of scenes that lower it or bend its line."""

import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, methods, springs
from physjax.scenes import SCENES
from physjax.study.accuracy import Budget, work_precision
from physjax.study.accuracy.method_facts import promised_order
from physjax.study.accuracy.observed_order import fit_order, fit_scattered_order

STEPS = 0.2 * 1.5 ** -np.arange(24.0)


def keep(dt, error):
    """Those that a study calls resolved."""
    chosen = error < 0.05
    return dt[chosen], error[chosen]


@pytest.mark.parametrize("ratio", [1.5, 2.0])
@pytest.mark.parametrize("order", [1, 2, 4, 5, 8])
def test_runs_bent_by_rounding_do_not_lower_the_order(order, ratio):
    scatter = 1 + 0.5 * np.sin(7 * np.arange(40.0))
    dt = 0.2 * ratio ** -np.arange(40.0)
    error = dt**order + 1e-11 * scatter * dt**-0.5
    dt, error = keep(dt[dt > 1e-6], error[dt > 1e-6])
    turn = int(np.argmin(error))
    for last in range(turn, min(turn + 6, len(dt))):  # however far into rounding a study went
        assert fit_order(dt[: last + 1], error[: last + 1]) == pytest.approx(order, rel=0.15), last


def test_one_run_within_rounding_is_left_out():
    """As kahan_li8 runs on kepler: its errors fall by 8.5 and end at 3e-12, above any estimate of rounding."""
    dt = STEPS[:8]
    error = np.maximum(3.0 * dt**8, [0, 0, 0, 0, 0, 0, 3.0 * dt[5] ** 8 * 0.8, 3.0 * dt[5] ** 8 * 0.9])
    assert fit_order(dt, error) == pytest.approx(8, abs=1e-6)
    assert np.polyfit(np.log(dt), np.log(error), 1)[0] < 7


def test_the_error_of_the_truth_is_no_order():
    dt, error = keep(STEPS, STEPS**4 + 1e-8)
    assert fit_order(dt, error) == pytest.approx(4, abs=0.15)


def test_coarse_runs_that_still_bend_are_left_out():
    dt, error = keep(STEPS, STEPS**2 / (1 + (10 * STEPS) ** 2) ** 0.8)
    assert fit_order(dt, error) == pytest.approx(2, abs=0.05)


def made_of(slopes):
    """Steps that halve, and errors that fall from one to the next with these slopes."""
    return 0.1 / 2.0 ** np.arange(len(slopes) + 1), 0.01 * 2.0 ** -np.cumsum([0, *slopes])


def test_of_a_line_the_finest_runs_count_where_they_are_as_straight():
    assert fit_order(*made_of([2.5, 2.0, 2.0])) == pytest.approx(2, abs=1e-9)
    assert 1.8 < fit_order(*made_of([2.0, 2.0, 1.6])) < 2


def test_a_steep_line_may_be_rough_but_not_bend_away():
    assert fit_order(*made_of([7.5, 10.0])) == pytest.approx(8.75)
    assert np.isnan(fit_order(*made_of([6.8, 3.0])))
    assert np.isnan(fit_order(*made_of([7.5, 10.0, 0.1, 0.0]))), "its finest run is as small as rounding"


@pytest.mark.parametrize(("order", "lower"), [(4, 1), (4, 2), (2, 1), (8, 2)])
def test_a_real_loss_of_order_over_a_decade_is_shown(order, lower):
    crossing = STEPS[6]
    dt, error = keep(STEPS, STEPS**order + crossing ** (order - lower) * STEPS**lower)
    over_a_decade = dt > crossing / 20
    assert fit_order(dt[over_a_decade], error[over_a_decade]) == pytest.approx(lower, abs=0.2)


def test_a_loss_that_scatters_is_shown():
    """A kink falls somewhere in its step: the error of rk4 is of first order there, times what the place says."""
    crossing = STEPS[6]
    for seed in range(20):
        place = np.random.default_rng(seed).uniform(0.6, 1.6, len(STEPS))
        dt, error = keep(STEPS, STEPS**4 + crossing**3 * STEPS * place)
        over_a_decade = dt > crossing / 30
        assert 0.5 < fit_order(dt[over_a_decade], error[over_a_decade]) < 2, seed


def test_an_order_takes_three_runs():
    assert np.isnan(fit_order([], []))
    assert np.isnan(fit_order([0.2, 0.1], [1e-3, 1e-4]))
    steep = [1e-2, 1e-6, 1.1e-11, 0.9e-11, 1.2e-11, 1.1e-11]
    assert np.isnan(fit_order(0.2 / 2.0 ** np.arange(6), steep)), "two runs above rounding"
    assert np.isnan(fit_scattered_order([0.2, 0.1], [1e-2, 1e-4]))
    assert np.isnan(fit_scattered_order([0.4, 0.2, 0.1], [1e-2, 9e-3, 8e-3])), "falls by less than it scatters"


def test_kepler_shows_the_orders_of_methods_that_reach_rounding():
    dts = 12.6 / 32 / 1.5 ** np.arange(6, 22)
    few = Budget(seconds=0.1, repeats=1, refinement=1.5)
    study = work_precision(SCENES["kepler"](), [methods.blanes_moan4], dts, rivals=(), budget=few)
    errors = np.array([run.path_error for run in study.of("blanes_moan4")])
    assert errors[-1] > 0.5 * errors[-2], "the finest runs are rounding"
    assert study.observed_order("blanes_moan4") == pytest.approx(4, abs=0.2)


@pytest.mark.parametrize(("order", "promised"), [(2, [2, 2, 1]), (4, [4, 2, 1])])
def test_a_method_promises_no_more_than_the_step_of_joints(order, promised):
    rod = springs.Rods([[0, 1]], 1.0, order=order)
    pendulum = Scene(Particles(jnp.array([[0.0, 0.0], [1.0, 0.0]]), jnp.zeros((2, 2))), forces=(rod,))
    given = [promised_order(method, False, pendulum) for method in (methods.rk4, methods.verlet, methods.euler)]
    assert given == promised


def test_joints_lower_high_orders_to_that_of_their_step_and_the_promise_says_so():
    few = Budget(seconds=0.02, repeats=1, refinement=2.0)
    dts = 0.01 / 2.0 ** np.arange(4)
    study = work_precision(SCENES["double_pendulum"](), [methods.rk4, methods.euler], dts, rivals=(), budget=few)
    assert study.promised == {"rk4": 2, "euler": 1}
    assert study.observed_order("rk4") == pytest.approx(2, abs=0.1)
