"""Fitted numbers come with standard errors that hold what they promise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, contacts, fit, forces, methods, simulate

TRUE_DRAG = 0.4


def throw(drag, velocity=(20.0, 15.0)):
    """Where a ball is, every tenth of a second."""
    v = jnp.asarray(velocity)
    air = forces.QuadraticDrag(area=4.3e-3, coefficient=drag)
    ball = Scene(Particles(jnp.zeros_like(v), v), mass=0.145, forces=(forces.Gravity(), air))
    return simulate(ball, methods.rk4, dt=0.05, steps=40, save_every=2).position


def watched(path, sigma, count=1, seed=1):
    """The path with noise, experiment by experiment."""
    return path[None] + sigma * jax.random.normal(jax.random.key(seed), (count, *path.shape))


@pytest.mark.parametrize("sigma", [None, 0.05], ids=["noise unknown", "noise known"])
def test_the_drag_coefficient_is_within_two_standard_errors_in_95_percent_of_experiments(sigma):
    experiments = watched(throw(TRUE_DRAG), 0.05, count=1000)
    found = jax.jit(jax.vmap(lambda seen: fit(throw, 0.7, seen, sigma=sigma)))(experiments)
    assert found.ok.all()
    assert 0.93 <= np.mean(np.abs(found.value - TRUE_DRAG) <= 2 * found.standard_error) <= 0.97
    assert np.std(found.value) == pytest.approx(float(np.mean(found.standard_error)), rel=0.07)
    assert abs(np.mean(found.value) - TRUE_DRAG) <= 4 * np.std(found.value) / np.sqrt(1000)
    assert found.residual.shape == experiments.shape


def test_several_numbers_come_back_with_names_and_their_covariance():
    seen = watched(throw(TRUE_DRAG), 0.05)[0]
    predict = lambda n: throw(n["drag"], n["velocity"])  # noqa: E731
    found = fit(predict, {"drag": 0.0, "velocity": jnp.asarray([10.0, 10.0])}, seen, sigma=0.05)
    assert found.ok
    truth = {"drag": TRUE_DRAG, "velocity": np.array([20.0, 15.0])}
    for name, value in truth.items():
        assert (np.abs(found.value[name] - value) < 3 * found.standard_error[name]).all()
    np.testing.assert_allclose(found.residual, seen - predict(found.value), atol=1e-12)
    jacobian = jax.jacfwd(lambda n: predict({"drag": n[0], "velocity": n[1:]}).ravel())(
        jnp.concatenate([found.value["drag"][None], found.value["velocity"]])
    )
    np.testing.assert_allclose(found.covariance, 0.05**2 * np.linalg.inv(jacobian.T @ jacobian), rtol=1e-7)
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance))[0], found.standard_error["drag"])
    np.testing.assert_allclose(jacobian.T @ found.residual.ravel(), 0.0, atol=1e-4)  # the best there is


@pytest.mark.slow
def test_restitution_of_a_bouncing_ball():
    start = Particles(jnp.asarray([1.0]), jnp.asarray([0.0]))

    def bounces(restitution):
        floor = contacts.Plane((0.0,), (1.0,), restitution=restitution)
        ball = Scene(start, forces=(forces.Gravity(up=0),), contacts=(floor,))
        return simulate(ball, methods.leapfrog, dt=0.02, steps=75, save_every=3).position

    experiments = watched(bounces(0.75), 0.01, count=40)
    found = jax.jit(jax.vmap(lambda seen: fit(bounces, 0.7, seen)))(experiments)
    assert found.ok.all()
    assert (np.abs(found.value - 0.75) <= 4 * found.standard_error).all()
    assert np.mean(np.abs(found.value - 0.75) <= 2 * found.standard_error) >= 0.85
    assert found.standard_error.max() < 2e-3


def test_stiffness_and_damping_of_a_spring_though_a_third_was_not_seen():
    def swing(numbers):
        spring = forces.Anchor(point=jnp.zeros(1), stiffness=numbers[0], damping=numbers[1])
        mass = Scene(Particles(jnp.ones(1), jnp.zeros(1)), mass=0.5, forces=(spring,))
        return simulate(mass, methods.rk4, dt=0.02, steps=150, save_every=3).position

    truth = np.array([20.0, 0.3])
    seen = watched(swing(jnp.asarray(truth)), 0.02, count=100)
    hidden = np.random.default_rng(0).random(seen.shape) < 1 / 3
    seen = jnp.where(hidden, jnp.nan, seen)
    found = jax.jit(jax.vmap(lambda seen: fit(swing, jnp.asarray([17.0, 0.0]), seen)))(seen)
    assert found.ok.all()
    np.testing.assert_array_equal(np.isnan(found.residual), hidden)
    assert (np.abs(found.value - truth[None]) <= 4.5 * found.standard_error).all()
    shares = np.mean(np.abs(found.value - truth[None]) <= 2 * found.standard_error, axis=0)
    assert (shares >= 0.88).all()


def line(numbers):
    return numbers[0] + numbers[1] * jnp.arange(5.0)


def test_a_straight_line_is_that_of_the_textbook():
    y = jnp.asarray([0.1, 0.9, 2.2, 2.8, 4.1])
    found = fit(line, jnp.asarray([0.0, 1.0]), y)
    truth, covariance = np.polyfit(np.arange(5.0), y, 1, cov="unscaled")
    variance = np.sum((y - np.polyval(truth, np.arange(5.0))) ** 2) / 3
    np.testing.assert_allclose(found.value, truth[::-1], rtol=1e-7)
    np.testing.assert_allclose(found.covariance, variance * covariance[::-1, ::-1], rtol=1e-7)


def test_sigma_weighs_each_observation():
    y, sigma = jnp.asarray([0.0, 1.0, 2.0, 30.0, 4.0]), jnp.asarray([1.0, 1.0, 1.0, 1e6, 1.0])
    np.testing.assert_allclose(fit(line, jnp.asarray([0.5, 2.0]), y, sigma=sigma).value, [0.0, 1.0], atol=1e-6)


def test_the_fit_moves_with_what_was_observed():
    y = jnp.asarray([0.1, 0.9, 2.2, 2.8, 4.1])
    slope = jax.jacrev(lambda y: fit(line, jnp.asarray([0.0, 1.0]), y).value[1])(y)
    np.testing.assert_allclose(slope, (np.arange(5.0) - 2) / 10, atol=1e-7)


def test_what_the_data_cannot_tell_is_said_and_harms_no_other():
    product = lambda n: n[0] * n[1] * jnp.arange(1.0, 5.0)  # noqa: E731
    found = fit(product, jnp.asarray([1.0, 2.0]), 3.0 * jnp.arange(1.0, 5.0))
    assert not found.ok
    assert np.isinf(found.standard_error).all()
    y = jnp.stack([line(jnp.asarray([1.0, 2.0])), jnp.full(5, jnp.inf), line(jnp.asarray([0.0, 1.0]))])
    many = jax.vmap(lambda y: fit(line, jnp.asarray([0.5, 0.5]), y, sigma=1.0))(y)
    np.testing.assert_array_equal(many.ok, [True, False, True])
    np.testing.assert_allclose(many.value[::2], [[1.0, 2.0], [0.0, 1.0]], atol=1e-6)
    few = jax.vmap(lambda y: fit(line, jnp.asarray([0.5, 0.5]), y))(y.at[0, :3].set(jnp.nan))
    assert not few.ok[0]  # two points leave nothing to estimate the noise from
    assert not fit(line, jnp.asarray([0.5, 0.5]), y[0], max_steps=1).ok


def test_bad_input_is_told_in_plain_words():
    with pytest.raises(TypeError, match=r"fit: got predict 3, expected a function"):
        fit(3, 1.0, jnp.zeros(2))
    with pytest.raises(ValueError, match=r"observed: got the shape \(4,\), expected \(5,\)"):
        fit(line, jnp.zeros(2), jnp.zeros(4))
    with pytest.raises(ValueError, match=r"sigma: got 0\.0, expected numbers > 0"):
        fit(line, jnp.zeros(2), jnp.zeros(5), sigma=0.0)
    with pytest.raises(ValueError, match=r"sigma: got the shape \(3,\), expected \(5,\)"):
        fit(line, jnp.zeros(2), jnp.zeros(5), sigma=jnp.ones(3))
    with pytest.raises(ValueError, match=r"got 2 numbers that are not NaN, expected at least 3"):
        fit(line, jnp.zeros(2), jnp.asarray([1.0, 2.0, *[jnp.nan] * 3]))
    with pytest.raises(ValueError, match="guess: got nan, expected finite numbers"):
        fit(lambda a: jnp.zeros(3) + a, jnp.nan, jnp.zeros(3))
