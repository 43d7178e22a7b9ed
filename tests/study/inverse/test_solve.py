"""Roots, least squares and minima: against closed forms, between bounds, with derivatives, and as a status in a batch."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, forces, methods, minimise, projectile, simulate, solve


def landing(angle, time, speed=30.0):
    """Where a shot is after a time, simulated."""
    velocity = speed * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    scene = Scene(Particles(jnp.zeros(2), velocity), forces=(forces.Gravity(),))
    return simulate(scene, methods.midpoint, dt=time / 4, steps=4, save_every=4).position[-1]


def hit(target):
    """The angle and the time that hit a target."""
    return solve(lambda unknown: landing(*unknown) - target, (jnp.asarray(0.5), jnp.asarray(2.0)))


@pytest.fixture(scope="module")
def compiled_hit():
    return jax.jit(hit)


def test_a_root_of_a_simulation_is_the_closed_form(compiled_hit):
    target = jnp.array([40.0, 3.0])
    found = compiled_hit(target)
    truth = projectile.angles_for_target(40.0, 3.0, 30.0)
    assert found.ok
    assert found.value[0] == pytest.approx(float(truth.low), abs=1e-13)
    assert found.value[1] == pytest.approx(40.0 / (30.0 * math.cos(truth.low)), abs=1e-12)
    assert np.abs(found.residual).max() < 1e-12
    assert 0 < found.steps < 20


def test_derivatives_of_a_root_forward_reverse_and_in_a_compiled_batch(compiled_hit):
    """d(angle)/d(target), which is closed over, against the derivative of the closed form."""
    targets = jnp.array([[40.0, 3.0], [55.0, -8.0]])
    truth = jax.vmap(jax.grad(lambda target: projectile.angles_for_target(*target, 30.0).low))(targets)
    angle = lambda target: hit(target).value[0]  # noqa: E731
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(jax.vmap(derivative(angle)))(targets), truth, rtol=1e-11)


def test_second_derivatives_of_a_root():
    curvature = jax.grad(jax.grad(lambda a: solve(lambda x: x**3 - a, 1.0).value))(jnp.asarray(2.0))
    assert curvature == pytest.approx(-2 / 9 * 2.0 ** (-5 / 3), rel=1e-12)


def test_a_guess_that_is_the_root_has_its_derivative():
    assert jax.grad(lambda a: solve(lambda x: x**3 - a, 1.0).value)(jnp.asarray(1.0)) == pytest.approx(1 / 3, rel=1e-12)


def test_lanes_of_a_batch_fail_alone(compiled_hit):
    targets = jnp.array([[40.0, 0.0], [400.0, 0.0], [jnp.nan, 0.0], [60.0, 5.0]])
    found = jax.vmap(compiled_hit)(targets)
    np.testing.assert_array_equal(found.ok, [True, False, False, True])
    truth = projectile.angles_for_target(targets[::3, 0], targets[::3, 1], 30.0)
    np.testing.assert_allclose(found.value[0][::3], truth.low, atol=1e-12)


def test_where_newton_alone_runs_away():
    """atan(x) = 0 from x = 3: Newton's steps grow without end; damped ones do not."""
    found = solve(jnp.arctan, 3.0)
    assert found.ok
    assert abs(found.value) < 1e-15


def test_no_root_is_not_ok():
    assert not solve(lambda x: x * x + 1, 3.0).ok
    assert not solve(lambda x: x - 5.0, 1.0, lower=0.0, upper=2.0).ok


def test_a_root_between_bounds_is_the_one_found():
    """cos(x) = 0 has many; each pair of bounds has its own, approached from anywhere between them."""
    for guess in (6.4, 7.9, 9.3):
        found = solve(jnp.cos, guess, lower=2 * math.pi, upper=3 * math.pi)
        assert found.ok
        assert found.value == pytest.approx(2.5 * math.pi, abs=1e-14)


def test_least_squares_of_a_path_find_gravity_and_its_derivative():
    """y = -½gt² seen at ten times: g is the weighted mean, linear in what was seen."""
    t = jnp.linspace(0.1, 1.0, 10)
    seen = -4.9 * t**2 + 1e-2 * jnp.cos(7 * t)

    def gravity(seen):
        return solve(lambda g: -0.5 * g * t**2 - seen, 5.0)

    found = jax.jit(gravity)(seen)
    weight = -2 * t**2 / (t**2 @ t**2)
    assert found.ok
    assert found.value == pytest.approx(float(weight @ seen), rel=1e-9)
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(lambda seen: gravity(seen).value)(seen), weight, rtol=1e-9)


def rosenbrock(value, a=1.0):
    return (a - value["x"]) ** 2 + 100.0 * (value["y"] - value["x"] ** 2) ** 2


def test_a_minimum_and_its_derivative():
    """Rosenbrock's valley has its minimum at (a, a²)."""
    least = lambda a: minimise(lambda v: rosenbrock(v, a), {"x": -1.2, "y": 1.0}, rtol=1e-9, atol=1e-9)  # noqa: E731
    found = jax.jit(least)(jnp.asarray(1.3))
    assert found.ok
    assert found.value["x"] == pytest.approx(1.3, abs=1e-7)
    assert found.value["y"] == pytest.approx(1.69, abs=1e-7)
    assert found.cost < 1e-14
    for derivative in (jax.jacfwd, jax.jacrev):
        slopes = jax.jit(derivative(lambda a: least(a).value))(jnp.asarray(1.3))
        assert slopes["x"] == pytest.approx(1.0, abs=1e-5)
        assert slopes["y"] == pytest.approx(2.6, abs=1e-5)


@pytest.mark.parametrize(("bounds", "end"), [({"upper": 0.7}, 0.7), ({"lower": -1.0, "upper": 0.7}, 0.7)])
def test_a_minimum_on_a_bound_is_reached_and_moves_with_it(bounds, end):
    """(x - 2)² is least at the upper bound: the cost cannot move it, the bound moves it one to one."""

    def least(centre, upper):
        return minimise(lambda x: (x - centre) ** 2, 0.1, **(bounds | {"upper": upper})).value

    assert least(2.0, end) == pytest.approx(end, abs=1e-9)
    by_centre, by_bound = jax.jacfwd(least, argnums=(0, 1))(jnp.asarray(2.0), jnp.asarray(end))
    assert by_centre == pytest.approx(0.0, abs=1e-6)
    assert by_bound == pytest.approx(1.0, abs=1e-6)


def test_a_lower_bound_alone():
    found = minimise(lambda x: (x + 3.0) ** 2, 100.0, lower=5.0)
    assert found.ok
    assert found.value == pytest.approx(5.0, abs=1e-6)
    assert minimise(lambda x: (x - 30.0) ** 2, 100.0, lower=5.0).value == pytest.approx(30.0, abs=1e-6)


def test_float32_stays_float32(precision):
    found = solve(lambda x: x * x - 2, jnp.asarray(1.0, precision.dtype))
    assert found.ok
    assert found.value.dtype == precision.dtype
    assert found.value == pytest.approx(math.sqrt(2), rel=4 * precision.eps)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"residual": lambda x: x[0] + x[1], "guess": jnp.ones(2)}, "1 equations for 2 unknowns"),
        ({"guess": jnp.nan}, "finite"),
        ({"guess": 3.0, "upper": 3.0}, "strictly between"),
        ({"guess": {"a": 1.0}, "lower": {"b": 0.0}}, "same structure"),
        ({"guess": jnp.ones(2), "lower": jnp.zeros(3)}, "shapes"),
        ({"guess": 1.0, "rtol": 0.0}, "> 0"),
        ({"guess": 1.0, "max_steps": 0}, "at least 1"),
        ({"guess": ()}, "empty"),
    ],
)
def test_bad_input_is_told_before_the_search(arguments, words):
    with pytest.raises(ValueError, match=words):
        solve(**{"residual": lambda x: x, **arguments})


def test_a_cost_must_be_one_number():
    with pytest.raises(ValueError, match="expected one number"):
        minimise(lambda x: x, jnp.ones(3))
