"""Attributes that were renamed are still there under their old names."""

import numpy as np
import pytest

from physjax.study.ablation import Ablation, Effect
from physjax.study.energy.budget import Account, Ledger

ONE = np.ones(2)
EFFECT = Effect("drag", ONE, np.array([0.5, 3.0]), 1e-6 * ONE, 1.0, 0.0, 0.0, 10.0, 80.0, np.array(["none", "needed"]))
ABLATION = Ablation(EFFECT, (EFFECT,), ONE, "rk4", 0.1, ())
ACCOUNT = Account("J", {"kinetic": np.array([0.0, 1.0]), "drag": np.array([0.0, -0.75])}, ONE)
LEDGER = Ledger(ONE, "rk4", ACCOUNT, ACCOUNT, None, 8, 1e-12)


@pytest.mark.parametrize(
    ("holder", "old", "new", "value"),
    [
        (ABLATION, "matters", "threshold", ONE),
        (ACCOUNT, "closing", "closure_error", 0.25),
        (LEDGER, "unsettled", "substep_error", 1e-12),
    ],
)
def test_an_old_name_is_an_alias(holder, old, new, value):
    np.testing.assert_array_equal(getattr(holder, old), value)
    np.testing.assert_array_equal(getattr(holder, new), value)


def test_the_old_name_of_the_worst_entry_takes_an_effect():
    assert ABLATION.telling(EFFECT) == ABLATION.worst_entry(EFFECT) == (3.0, 1e-6, 1.0)
