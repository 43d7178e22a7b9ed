"""Order conditions of the tableaus and of the compositions, to rounding."""

import itertools
import math

import numpy as np
import pytest

from physjax.stepping.compositions import BLANES_MOAN_4, KAHAN_LI_8
from physjax.stepping.tableaus import DOPRI8, EULER, HEUN, MIDPOINT, RK4, TSIT5

TABLEAUS = {"euler": EULER, "midpoint": MIDPOINT, "heun": HEUN, "rk4": RK4, "tsit5": TSIT5, "dopri8": DOPRI8}
EACH = pytest.mark.parametrize("tableau", TABLEAUS.values(), ids=TABLEAUS)


def rooted_trees(order):
    """All rooted trees of this order, each the sorted tuple of the trees that hang on its root."""
    if order == 1:
        return {()}
    parts = (p for n in range(1, order) for p in itertools.combinations_with_replacement(range(1, order), n))
    hung = (itertools.product(*map(rooted_trees, p)) for p in parts if sum(p) == order - 1)
    return {tuple(sorted(trees)) for trees in itertools.chain.from_iterable(hung)}


def size(tree):
    return 1 + sum(map(size, tree))


def density(tree):
    return size(tree) * math.prod(map(density, tree))


def matrix(tableau):
    count = len(tableau.weights)
    return np.array([[*row, *[0.0] * (count - len(row))] for row in tableau.rows])


def stage_weights(tree, a):
    return math.prod((a @ stage_weights(branch, a) for branch in tree), start=np.ones(len(a)))


def defects(weights, a, order):
    return [
        weights @ stage_weights(tree, a) - 1 / density(tree) for n in range(1, order + 1) for tree in rooted_trees(n)
    ]


def test_there_are_as_many_rooted_trees_as_cayley_counted():
    assert [len(rooted_trees(n)) for n in range(1, 9)] == [1, 1, 2, 4, 9, 20, 48, 115]


@EACH
def test_weights_satisfy_every_order_condition_and_no_higher_one(tableau):
    a, weights = matrix(tableau), np.array(tableau.weights)
    np.testing.assert_allclose(a.sum(axis=1), tableau.nodes, rtol=0, atol=2e-14)
    # the fractions of dopri8 were printed with 18 digits and have large ones among them
    assert np.abs(defects(weights, a, tableau.order)).max() < 2e-14
    assert np.abs(defects(weights, a, tableau.order + 1)).max() > 1e-9


@pytest.mark.parametrize("tableau", [TSIT5, DOPRI8], ids=["tsit5", "dopri8"])
def test_the_lower_order_of_a_pair_is_one_below(tableau):
    a, lower = matrix(tableau), np.subtract(tableau.weights, tableau.errors)
    assert np.abs(defects(lower, a, tableau.order - 1)).max() < 2e-14
    assert np.abs(defects(lower, a, tableau.order)).max() > 1e-9
    assert tableau.first_same_as_last
    np.testing.assert_allclose(tableau.rows[-1], tableau.weights[:-1], rtol=0, atol=1e-15)


def test_compositions_end_where_the_step_ends_and_are_symmetric():
    for shares in (KAHAN_LI_8, BLANES_MOAN_4.kicks):
        assert sum(shares) == pytest.approx(1, abs=1e-15)
        assert shares == shares[::-1]
    assert sum(BLANES_MOAN_4.drifts) == pytest.approx(1, abs=1e-15)
    for power in (3, 5, 7):
        # of a symmetric composition the sums of odd powers vanish up to its order
        assert abs(sum(share**power for share in KAHAN_LI_8)) < 1e-13
