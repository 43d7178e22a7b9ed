"""Sweeps drawn: axes and numbers with their words, failed lanes marked, a shape for each number of axes."""

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib import pyplot as plt

from physjax import sweep

LABELS = {"x": "x [m]", "y": "y [s]", "z": "z [kg]", "value": "height [m]"}
X, Y, Z = np.linspace(0, 1, 12), np.linspace(1, 3, 9), np.linspace(0, 2, 4)


def height(**point):
    total = sum(point.values())
    return jnp.where(total > 3.6, jnp.nan, jnp.sin(3 * total))


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


def drawn(axes, **options):
    return sweep(height, axes, progress=False, **options).plot(labels=LABELS)


def test_one_axis_is_a_line_with_crosses_where_it_failed():
    ax = drawn({"y": Y * 1.3})
    line, crosses = ax.get_lines()
    np.testing.assert_allclose(line.get_xdata(), Y * 1.3)
    np.testing.assert_allclose(line.get_ydata()[:5], np.sin(3 * 1.3 * Y[:5]))
    assert set(crosses.get_xdata()) == set(1.3 * Y[1.3 * Y > 3.6])
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("y [s]", "height [m]")
    assert ax.get_legend().get_texts()[0].get_text() == "failed (1 of 9)"


def test_two_axes_are_a_map_whose_failed_cells_are_left_out():
    ax = drawn({"x": X, "y": Y})
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("y [s]", "x [m]")
    cells = ax.collections[0].get_array().reshape(X.size, Y.size)
    total = X[:, None] + Y
    np.testing.assert_array_equal(cells.mask, total > 3.6)
    np.testing.assert_allclose(cells[~cells.mask], np.sin(3 * total[total <= 3.6]))
    assert ax.get_title() == f"grey: failed ({(total > 3.6).sum()} of {total.size})"
    assert ax.figure.axes[1].get_ylabel() == "height [m]"


def test_three_axes_are_panels_on_one_scale():
    figure = drawn({"z": Z, "x": X, "y": Y})
    panels = [ax for ax in figure.axes if ax.get_title()]
    assert [ax.get_title() for ax in panels] == [f"z [kg]: {z:.4g}" for z in Z]
    assert len({ax.collections[0].get_clim() for ax in panels}) == 1
    with pytest.raises(ValueError, match="got 4 crossed axes, expected at most three"):
        drawn({"w": Z, "z": Z, "x": X, "y": Y})


def test_zipped_axes_are_points():
    ax = drawn({"x": X, "y": np.linspace(1, 3, 12)}, design="zip")
    good = X + np.linspace(1, 3, 12) <= 3.6
    assert len(ax.collections[0].get_offsets()) == good.sum()
    assert len(ax.collections[1].get_offsets()) == (~good).sum()
