"""A loop of unknown length has derivatives of any order, forward and reverse, lane by lane."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax.loops import differentiable_while_loop

TURNS = np.array([3, 10], np.int32)


def repeat(rate, start, most=64):
    def turn(carry):
        x, count = carry
        return jnp.where(count < TURNS, x + rate * jnp.sin(x), x), count + 1

    going = lambda carry: carry[1] < TURNS  # noqa: E731
    return differentiable_while_loop(going, turn, (start, jnp.zeros(2, jnp.int32)), most=most)[0]


def expected(rate, start):
    for count in range(TURNS.max()):
        start = jnp.where(count < TURNS, start + rate * jnp.sin(start), start)
    return start


START = np.array([1.0, 2.0])


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev, jax.hessian])
@pytest.mark.parametrize("argument", [0, 1])
def test_its_derivatives_are_those_of_the_turns_written_out(derivative, argument):
    rate, start = jnp.asarray(0.1), jnp.asarray(START)
    found, right = (derivative(function, argument)(rate, start) for function in (repeat, expected))
    np.testing.assert_allclose(found, right, rtol=1e-13)


def test_lanes_that_need_more_turns_have_no_derivative_but_their_value():
    rate, start = jnp.asarray(0.1), jnp.asarray(START)
    few = lambda start: repeat(rate, start, most=4)  # noqa: E731
    np.testing.assert_array_equal(few(start), repeat(rate, start))
    np.testing.assert_array_equal(np.isnan(jax.jvp(few, (start,), (start,))[1]), [False, True])
    np.testing.assert_array_equal(np.isnan(jax.grad(lambda start: jnp.sum(few(start)))(start)), [False, True])


def test_it_can_be_batched_inside_and_outside_of_a_derivative():
    start = jnp.asarray(START)
    total = lambda rate: jnp.sum(repeat(rate, start))  # noqa: E731
    rates = jnp.asarray([0.1, 0.2])
    each = [float(jax.grad(total)(rate)) for rate in rates]
    np.testing.assert_allclose(jax.vmap(jax.grad(total))(rates), each, rtol=1e-13)
    np.testing.assert_allclose(jax.grad(lambda rates: jnp.sum(jax.vmap(total)(rates)))(rates), each, rtol=1e-13)
