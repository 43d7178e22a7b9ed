"""Small systems solved lane by lane, against LAPACK."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax.linear import build_cofactors, eliminate, solve_columns


def random_system(size, seed=0, lanes=(50,)):
    rng = np.random.default_rng(seed)
    matrix, x = rng.normal(size=(*lanes, size, size)), rng.normal(size=(*lanes, size))
    return matrix, x, np.einsum("...ij,...j->...i", matrix, x)


def as_columns(matrix):
    return [[jnp.asarray(matrix[..., i, j]) for i in range(matrix.shape[-1])] for j in range(matrix.shape[-1])]


def as_components(vector):
    return [jnp.asarray(vector[..., i]) for i in range(vector.shape[-1])]


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5])
def test_a_system_is_solved_in_every_lane(size):
    with jax.enable_x64(True):
        matrix, x, b = random_system(size)
        found = np.stack(solve_columns(as_columns(matrix), as_components(b)), axis=-1)
    condition = np.linalg.cond(matrix)[:, None]
    assert (np.abs(found - x) < 1e-13 * condition * np.abs(x).max()).all()


@pytest.mark.parametrize("size", [2, 4])
def test_a_zero_on_the_diagonal_is_no_obstacle(size):
    matrix = np.roll(np.eye(size), 1, axis=0)
    found = solve_columns(as_columns(matrix), as_components(np.arange(1.0, size + 1)))
    np.testing.assert_allclose(found, np.linalg.solve(matrix, np.arange(1.0, size + 1)))


@pytest.mark.parametrize("size", [1, 2, 3, 4])
def test_a_singular_matrix_gives_what_is_not_finite(size):
    found = solve_columns(as_columns(np.zeros((size, size))), as_components(np.ones(size)))
    assert not np.isfinite(found).any()


def test_a_solve_is_transposed_and_differentiated():
    with jax.enable_x64(True):
        matrix, _, b = random_system(4, lanes=())
        columns = as_columns(matrix)
        inverse = jax.jacrev(lambda b: jnp.stack(solve_columns(columns, [*b])))(jnp.asarray(b))
        np.testing.assert_allclose(inverse, np.linalg.inv(matrix), rtol=1e-10)


@pytest.mark.parametrize("size", [1, 2, 3])
def test_cofactors_times_the_columns_are_the_determinant(size):
    matrix, _, _ = random_system(size, lanes=())
    product = np.asarray(build_cofactors(as_columns(matrix))) @ matrix
    np.testing.assert_allclose(product, np.linalg.det(matrix) * np.eye(size), atol=1e-5)


def test_unknowns_that_may_not_be_used_are_zero_and_their_equations_left_out():
    with jax.enable_x64(True):
        matrix, _, b = random_system(3)
        matrix = matrix @ np.swapaxes(matrix, -1, -2)
        rows = [[jnp.asarray(matrix[..., i, j]) for j in range(3)] for i in range(3)]
        found = np.stack(eliminate(rows, as_components(b), lambda i, pivot: (pivot > 0) & (i != 1)), axis=-1)
    kept = [0, 2]
    alone = np.linalg.solve(matrix[:, kept][:, :, kept], b[:, kept, None])[..., 0]
    assert (found[:, 1] == 0).all()
    np.testing.assert_allclose(found[:, kept], alone, rtol=1e-8)
