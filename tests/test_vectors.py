"""The vector helpers equal NumPy at any number of lanes, and their derivatives are right, also where the formulas are not."""

from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax.vectors import (
    add_leading_axes,
    add_trailing_axes,
    axis_vector,
    broadcast_vector,
    components,
    conjugate_quaternion,
    cross,
    dot,
    join_components,
    multiply_by_vector,
    multiply_quaternions,
    norm,
    root_and_inverse,
    rotate_components,
    rotate_vector,
    rotate_vector_back,
    scale,
    spin,
    split_components,
    square_root,
    stack_components,
    turn_left,
    unit,
)

# large and odd sizes, because jax 0.10.2 returned wrong rows for some of them on CPU (jax issue 39103)
LANES = pytest.mark.parametrize("n", [1000, 16385, 32769, 50001])


@jax.jit
def everything(a, b, flat, number, vector, amount):
    """Every helper at once, so that a size costs one compilation."""
    p, q = ([number, *components(v)] for v in (a, b))
    return {
        "multiply_quaternions": stack_components(multiply_quaternions(p, q)),
        "multiply_by_vector": stack_components(multiply_by_vector(p, components(b))),
        "conjugate_quaternion": stack_components(conjugate_quaternion(p)),
        "rotate_components": stack_components(rotate_components(p, components(b))),
        "rotate_vector": rotate_vector(stack_components(p), b),
        "rotate_vector_back": rotate_vector_back(stack_components(p), b),
        "dot": dot(a, b),
        "dot in the plane": dot(flat, turn_left(flat) + flat),
        "components": components(a)[1],
        "stack_components": stack_components(components(a)),
        "split_components": split_components(a)[1],
        "join_components": join_components(split_components(a)),
        "square_root": square_root(dot(a, a)),
        "root_and_inverse": stack_components(list(root_and_inverse(dot(a, a)))),
        "norm": norm(a),
        "unit": unit(a),
        "cross": cross(a, b),
        "spin, one vector": spin(vector, b),
        "spin, a vector per lane": spin(a, b),
        "spin, a number per lane": spin(number, flat),
        "turn_left": turn_left(flat),
        "scale": scale(number, a),
        "scale by one number": scale(amount, a),
        "broadcast_vector": broadcast_vector(vector, a),
        "axis_vector": axis_vector(number, 2, a),
        "axis_vector, one number": axis_vector(amount, 1, flat),
    }


def expected(a, b, flat, number, vector, amount):
    """The same by NumPy in extended precision, each with the sum of the magnitudes that its rounding errors are shares of."""
    length, size = np.linalg.norm(a, axis=-1), np.linalg.norm
    left = np.stack([-flat[:, 1], flat[:, 0]], axis=-1)
    products = (size(a, axis=-1) * size(b, axis=-1))[:, None]
    axis = np.zeros_like(a)
    axis[:, 2] = number
    p, n = np.concatenate([number[:, None], a], axis=-1), number[:, None]
    scalar = number * number - np.sum(a * b, axis=-1)
    twist = np.concatenate([scalar[:, None], n * a + n * b + np.cross(a, b)], axis=-1)
    bent, twice = np.cross(a, b), 2 * np.cross(a, np.cross(a, b))
    far = ((1 + size(p, axis=-1)) ** 2 * size(b, axis=-1))[:, None]
    around = (size(p, axis=-1) * np.hypot(number, size(b, axis=-1)))[:, None]
    return {
        "multiply_quaternions": (twist, around),
        "multiply_by_vector": (np.concatenate([-np.sum(a * b, axis=-1, keepdims=True), n * b + bent], axis=-1), around),
        "conjugate_quaternion": (p * [1, -1, -1, -1], 0.0),
        "rotate_components": (b + 2 * n * bent + twice, far),
        "rotate_vector": (b + 2 * n * bent + twice, far),
        "rotate_vector_back": (b - 2 * n * bent + twice, far),
        "dot": (np.sum(a * b, axis=-1), products[:, 0]),
        "components": (a[:, 1], 0.0),
        "stack_components": (a, 0.0),
        "split_components": (a[:, 1:2], 0.0),
        "join_components": (a, 0.0),
        "dot in the plane": (np.sum(flat * flat, axis=-1), 2 * np.sum(flat * flat, axis=-1)),
        "square_root": (length, length),
        "root_and_inverse": (np.stack([length, 1 / length], axis=-1), np.stack([length, 1 / length], axis=-1)),
        "norm": (length, length),
        "unit": (a / length[:, None], 1.0),
        "cross": (np.cross(a, b), products),
        "spin, one vector": (np.cross(vector[None], b), size(vector) * size(b, axis=-1)[:, None]),
        "spin, a vector per lane": (np.cross(a, b), products),
        "spin, a number per lane": (number[:, None] * left, np.abs(number[:, None] * left)),
        "turn_left": (left, 0.0),
        "scale": (number[:, None] * a, np.abs(number[:, None] * a)),
        "scale by one number": (amount * a, np.abs(amount * a)),
        "broadcast_vector": (np.broadcast_to(vector, a.shape), 0.0),
        "axis_vector": (axis, 0.0),
        "axis_vector, one number": (np.broadcast_to([0.0, amount], flat.shape), 0.0),
    }


def test_the_table_of_expected_values_misses_no_helper():
    import physjax.vectors as module

    ours = {name: f for name, f in vars(module).items() if getattr(f, "__module__", "") == module.__name__}
    # old names of a function are the function
    public = {name for name, f in ours.items() if not isinstance(f, TypeVar) and f.__name__ == name}
    named = {word.strip(",") for name in expected(*some(2, np.float64)) for word in name.split()[:1]}
    assert {name for name in public if not name.startswith("_")} == named | {"add_trailing_axes", "add_leading_axes"}


def test_axes_of_length_one_are_added_behind_and_before_and_a_scalar_stays_one():
    number = jnp.arange(3.0)
    np.testing.assert_array_equal(add_trailing_axes(number, 3), np.arange(3.0)[:, None, None])
    np.testing.assert_array_equal(add_leading_axes(number, 2), np.arange(3.0)[None, :])
    assert add_trailing_axes(jnp.asarray(2.0), 3).shape == add_leading_axes(jnp.asarray(2.0), 3).shape == ()


def some(n, dtype, seed=0):
    """Arguments for all helpers, lanes of magnitudes from 1e-6 to 1e6, and no zero vector."""
    rng = np.random.default_rng(seed)

    def numbers(*shape):
        lanes = shape[:1] + (1,) * (len(shape) - 1)
        return np.asarray(rng.normal(size=shape) * 10.0 ** rng.uniform(-6, 6, size=lanes), dtype)

    return numbers(n, 3), numbers(n, 3), numbers(n, 2), numbers(n), numbers(3), numbers()


def check_against_numpy(found, arguments):
    """Each component is within four roundings of the exact one."""
    eps = np.finfo(arguments[0].dtype).eps
    wanted = expected(*(a.astype(np.longdouble) for a in arguments))
    assert found.keys() == wanted.keys()
    for name, (value, magnitude) in wanted.items():
        assert found[name].dtype == arguments[0].dtype, name
        assert found[name].shape == value.shape, name
        assert np.all(np.abs(np.asarray(found[name], np.longdouble) - value) <= 4 * eps * magnitude), name


@LANES
def test_every_helper_equals_numpy(n, precision):
    arguments = some(n, precision.dtype)
    check_against_numpy(everything(*map(jnp.asarray, arguments)), arguments)


def test_under_vmap_too(precision):
    arguments = some(1000, precision.dtype)
    lane_by_lane = jax.vmap(everything, in_axes=(0, 0, 0, 0, None, None))
    check_against_numpy(lane_by_lane(*map(jnp.asarray, arguments)), arguments)


def test_a_number_per_scene_scales_all_its_lanes():
    array = jnp.arange(12.0).reshape(2, 3, 2)
    np.testing.assert_array_equal(scale(jnp.asarray([2.0, -1.0]), array), array * np.array([2.0, -1.0])[:, None, None])


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_directions_have_length_one_however_short_or_long_the_vector(dim):
    v = jnp.outer(10.0 ** jnp.linspace(-150, 150, 61), jnp.arange(1.0, dim + 1))
    np.testing.assert_allclose(norm(unit(v)), 1.0, rtol=4e-16, atol=0)


def test_directions_stay_small_where_squares_underflow(precision):
    least = np.log10(float(jnp.finfo(precision.dtype).smallest_subnormal))
    v = jnp.outer(10.0 ** jnp.linspace(least, least / 4, 200), jnp.ones(3)).astype(precision.dtype)
    direction = jax.jit(unit)(v)
    assert jnp.all(jnp.abs(direction) < 1 + 4 * precision.eps)


@pytest.mark.parametrize("function", [norm, unit], ids=["norm", "unit"])
def test_value_and_derivatives_at_zero_are_zero_to_third_order(function, precision):
    first, first_reverse = jax.jacfwd(function), jax.jacrev(function)
    second, third = jax.jacfwd(first_reverse), jax.jacfwd(jax.jacfwd(first))
    every = jax.jit(lambda v: [f(v) for f in (function, first, first_reverse, second, third)])
    for value in every(jnp.zeros(3, precision.dtype)):
        assert value.dtype == precision.dtype
        np.testing.assert_array_equal(value, np.zeros_like(value))


def test_a_lane_at_zero_leaves_the_gradient_of_its_neighbours_alone():
    v = jnp.asarray([[0.0, 0.0], [3.0, -4.0]])
    gradient = jax.jit(jax.grad(lambda v: jnp.sum(norm(v))))(v)
    np.testing.assert_allclose(gradient, [[0, 0], [0.6, -0.8]], rtol=1e-15, atol=0)


@pytest.mark.parametrize("function", [norm, unit], ids=["norm", "unit"])
def test_derivatives_equal_finite_differences(function):
    v, h = np.array([0.3, -1.2, 0.7]), 1e-5
    ahead, behind = (np.asarray(function(jnp.asarray(v + step))) for step in (h * np.eye(3), -h * np.eye(3)))
    differences = (ahead - behind).T / (2 * h)
    for jacobian in jax.jit(lambda v: (jax.jacfwd(function)(v), jax.jacrev(function)(v)))(jnp.asarray(v)):
        np.testing.assert_allclose(jacobian, differences, rtol=0, atol=1e-10)


def test_the_second_derivative_of_the_norm_is_the_projector_over_the_length():
    v = np.array([0.3, -1.2, 0.7])
    length = np.linalg.norm(v)
    projector = (np.eye(3) - np.outer(v, v) / length**2) / length
    np.testing.assert_allclose(jax.jit(jax.hessian(norm))(jnp.asarray(v)), projector, rtol=0, atol=1e-15)


def test_second_derivatives_in_a_loop_are_zero_at_zero_in_any_nesting_of_the_modes():
    """A loop in reverse mode drops the rules for derivatives, so what they give must not be what makes them right."""

    def end(v):
        push = lambda v, _: (v - scale(norm(v), v) + 0.1 * unit(v) + square_root(dot(v, v)), None)  # noqa: E731
        return jax.lax.scan(push, v, None, length=3)[0][0]

    forward, backward = jax.jacfwd, jax.jacrev
    nestings = [
        (forward, forward),
        (forward, backward),
        (backward, backward),
        (backward, forward),
    ]
    for second in jax.jit(lambda v: [outer(inner(end))(v) for outer, inner in nestings])(jnp.zeros(2)):
        np.testing.assert_array_equal(second, np.zeros((2, 2)))


@pytest.mark.parametrize("shape", [(), (2,), (4, 1)])
def test_a_vector_of_another_length_is_not_spread_over_the_components(shape):
    with pytest.raises(ValueError, match=r"got a vector of shape .* expected \(3,\) for all lanes or \(4, 3\)"):
        broadcast_vector(jnp.ones(shape), jnp.zeros((4, 3)))


def test_an_axis_that_is_not_there_is_a_plain_error():
    with pytest.raises(ValueError, match=r"up: got axis 1, .* 1 components.*Give an axis from 0 to 0"):
        axis_vector(jnp.asarray(9.8), 1, jnp.zeros((4, 1)))


def test_quaternions_turn_as_matrices_do():
    quarter = jnp.asarray([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])  # about z
    np.testing.assert_allclose(rotate_vector(quarter, jnp.asarray([1.0, 0.0, 2.0])), [0.0, 1.0, 2.0], atol=1e-15)
    rng = np.random.default_rng(4)
    p, q = (unit(jnp.asarray(rng.normal(size=(9, 4)))) for _ in range(2))
    v = jnp.asarray(rng.normal(size=(9, 3)))
    both = stack_components(multiply_quaternions(components(p), components(q)))
    np.testing.assert_allclose(rotate_vector(both, v), rotate_vector(p, rotate_vector(q, v)), atol=1e-14)
    np.testing.assert_allclose(rotate_vector_back(p, rotate_vector(p, v)), v, atol=1e-14)
    np.testing.assert_allclose(norm(rotate_vector(p, v)), norm(v), rtol=1e-14)
