"""Derivatives by a replay: of a search in a loop without a reverse mode, to second order, in both modes."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from physjax.replays import Record, Replay, differentiate_by_replay, hoist_closures


def search(number, function):
    """The x >= 0 with function(x) = number, by bisection in a loop that ends when it has found it."""

    def halve(bracket):
        low, high = bracket
        middle = (low + high) / 2
        above = function(middle) > number
        return jnp.where(above, low, middle), jnp.where(above, middle, high)

    return lax.while_loop(lambda bracket: bracket[1] - bracket[0] > 1e-13, halve, (jnp.zeros(()), jnp.full((), 8.0)))[0]


def root_of(function, solve, *probe):
    """A root as the duration of one leg, which ends where the function has reached the number."""

    def log(number):
        x = search(number, function)
        return x, Record(jnp.zeros(1), x[None], (), jnp.ones(1, bool))

    replay = Replay(
        begin=jnp.zeros_like,
        prepare=lambda choices, start, number: number,
        fly=lambda choices, number, duration, _: ((), number - function(duration)),
        respond=lambda choices, prepared, duration, end, _: duration,
        finish=lambda record, last: last,
    )
    return lambda number: solve(*probe, lambda number: search(number, function), log, replay, number)


def test_a_search_has_the_derivatives_of_its_replay():
    cube_root = root_of(lambda x: x**3, differentiate_by_replay)
    a = jnp.asarray(5.0)
    assert float(cube_root(a)) == float(search(a, lambda x: x**3))
    first, second = a ** (-2 / 3) / 3, -2 / 9 * a ** (-5 / 3)
    for derivative in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(derivative(cube_root)(a), first, rtol=1e-10)
        np.testing.assert_allclose(jax.grad(derivative(cube_root))(a), second, rtol=1e-10)
    numbers = jnp.asarray([1.0, 5.0, 20.0])
    np.testing.assert_allclose(jax.vmap(jax.grad(cube_root))(numbers), numbers ** (-2 / 3) / 3, rtol=1e-10)


def test_numbers_that_a_function_closes_over_can_be_differentiated():
    def scaled_root(scale):
        function = lambda x: scale * x**3  # noqa: E731
        return root_of(function, hoist_closures, function)(jnp.asarray(5.0))

    found = jax.jit(jax.value_and_grad(scaled_root))(jnp.asarray(2.0))
    np.testing.assert_allclose(found, [2.5 ** (1 / 3), -(2.5 ** (1 / 3)) / 6], rtol=1e-10)
