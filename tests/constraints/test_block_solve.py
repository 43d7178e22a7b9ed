"""Systems of joints are solved as dense ones are, in levels whose number grows with the logarithm of a chain."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax.constraints.block_solve import Blocks, solve_blocks
from physjax.constraints.elimination import plan_elimination

MECHANISMS = {
    "one": [(-1, 0)],
    "two": [(-1, 0), (0, 1)],
    "tree": [((i - 1) // 2, i) for i in range(1, 40)],
    "ring": [(i, (i + 1) % 12) for i in range(12)],
    "loops": [(i, i + 1) for i in range(10)] + [(0, 5), (3, 9)],
}


def build(pairs, rows, worlds=2):
    """Blocks of a random J' Jᵀ, in which each joint has numbers for its two bodies alone, and the dense matrices."""
    random, count = np.random.default_rng(0), len(pairs)
    bodies = max(map(max, pairs)) + 1
    joined = np.zeros((count, bodies), bool)
    for joint, pair in enumerate(pairs):
        joined[joint, [body for body in pair if body >= 0]] = True
    joined = np.kron(joined, np.ones((rows, 3)))
    first = random.normal(size=(worlds, count * rows, bodies * 3)) * joined
    second = first + 0.1 * random.normal(size=first.shape) * joined
    dense = second @ np.swapaxes(first, 1, 2)
    block = lambda i, j: np.moveaxis(dense[:, i * rows : (i + 1) * rows, j * rows : (j + 1) * rows], 0, -1)  # noqa: E731

    def stack(found):
        blocks = [block(i, j) for i, j in found]
        return jnp.asarray(np.stack(blocks, axis=2) if blocks else np.zeros((rows, rows, 0, worlds)))

    edges = [(int(i), int(j)) for i, j in plan_elimination(tuple(pairs)).edges]
    blocks = Blocks(*map(stack, ([(i, i) for i in range(count)], [(j, i) for i, j in edges], edges)))
    return dense, blocks


@pytest.mark.parametrize(("name", "rows"), [("one", 1), ("two", 2), ("tree", 1), ("ring", 2), ("loops", 1)])
def test_the_solution_is_that_of_the_dense_matrix(name, rows):
    pairs = MECHANISMS[name]
    dense, blocks = build(pairs, rows)
    right = np.random.default_rng(1).normal(size=(rows, len(pairs), 2))
    flat = np.moveaxis(right, (0, 1, 2), (2, 1, 0)).reshape(2, -1, 1)
    solve = jax.jit(lambda matrix, right: solve_blocks(plan_elimination(tuple(pairs)), matrix, right))
    for matrix, given in ((dense, blocks), (np.swapaxes(dense, 1, 2), blocks.transposed())):
        found = solve(given, right)
        exact = np.moveaxis(np.linalg.solve(matrix, flat).reshape(2, len(pairs), rows), (0, 1, 2), (2, 1, 0))
        np.testing.assert_allclose(found, exact, rtol=0, atol=1e-11 * np.abs(exact).max())


def test_a_row_that_follows_from_others_gets_nothing():
    one = jnp.ones((1, 1, 2, 1))
    twice = Blocks(one, one[:, :, :1], one[:, :, :1])
    found = solve_blocks(plan_elimination(((-1, 0), (-1, 0))), twice, jnp.full((1, 2, 1), 3.0))
    assert found.ravel().tolist() == [3.0, 0.0]


def test_the_levels_of_a_chain_grow_with_its_logarithm_and_no_joint_is_forgotten():
    for links in (2, 3, 31, 200):
        plan = plan_elimination(tuple((i - 1, i) for i in range(links)))
        assert len(plan.levels) <= np.log2(links) + 2
        eliminated = np.concatenate([level.joints for level in plan.levels])
        assert sorted(eliminated[eliminated < links]) == list(range(links))


def test_a_program_does_not_grow_with_a_chain():
    def count(links):
        pairs = tuple((i - 1, i) for i in range(links))
        _, blocks = build(pairs, 1, worlds=1)
        traced = jax.make_jaxpr(lambda m, b: solve_blocks(plan_elimination(pairs), m, b))(
            blocks, jnp.ones((1, links, 1))
        )
        return str(traced).count("=")

    assert count(120) <= 1.1 * count(20)
