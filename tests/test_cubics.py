"""The cubic through the ends of a step, against the cubics it must be."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax.cubics import Cubic


def through(polynomial):
    slope = polynomial.deriv()
    return Cubic.through(*(jnp.asarray(f(s)) for f in (polynomial, slope) for s in (0.0, 1.0)))


@pytest.mark.parametrize("coefficients", [(1.0, -2.0, 0.5, 3.0), (0.0, 0.0, 0.0, 1.0), (2.0, 0.0, -1.0, 0.0)])
def test_a_cubic_is_found_again_from_its_ends(coefficients):
    polynomial = np.polynomial.Polynomial(coefficients)
    s = np.linspace(-0.5, 1.5, 9)
    with jax.enable_x64(True):
        cubic = through(polynomial)
        np.testing.assert_allclose([*cubic], coefficients, atol=1e-14)
        np.testing.assert_allclose(jax.vmap(cubic.at)(s), polynomial(s), atol=1e-14)
        np.testing.assert_allclose(jax.vmap(cubic.slope)(s), polynomial.deriv()(s), atol=1e-13)
        np.testing.assert_allclose(jax.vmap(cubic.curvature)(s), polynomial.deriv(2)(s), atol=1e-13)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("places", [(0.2, 0.7), (-0.4, 0.4), (0.1, 5.0)])
def test_minimum_and_maximum_are_told_apart(places, sign):
    slope = sign * np.polynomial.Polynomial.fromroots(places)
    with jax.enable_x64(True):
        lowest, highest = through(slope.integ()).extrema()
    expected = places[::-1] if sign > 0 else places
    np.testing.assert_allclose((lowest, highest), expected, rtol=1e-12)


def test_a_parabola_that_bends_up_has_only_a_minimum():
    lowest, highest = through(np.polynomial.Polynomial([1.0, -1.0, 2.0])).extrema()
    assert float(lowest) == 0.25
    assert not np.isfinite(highest)


def test_a_line_has_neither():
    assert not np.isfinite(through(np.polynomial.Polynomial([1.0, -1.0])).extrema()).any()


def test_vectors_run_along_the_cubic_of_each_component():
    rng = np.random.default_rng(0)
    ends, s = rng.normal(size=(4, 5, 3)), rng.uniform(size=5)
    with jax.enable_x64(True):
        whole = Cubic.through(*map(jnp.asarray, ends)).at(jnp.asarray(s))
        parts = [Cubic.through(*(jnp.asarray(end[:, i]) for end in ends)).at(jnp.asarray(s)) for i in range(3)]
    np.testing.assert_allclose(whole, np.stack(parts, axis=-1), rtol=1e-14)
