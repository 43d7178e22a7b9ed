"""Pictures over time and phase portraits show the numbers of the run, of one or of several."""

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib import pyplot as plt

from physjax import Particles, Scene, forces, methods, plot, simulate

SWING = Scene(
    Particles(jnp.array([[1.0], [2.0]]), jnp.zeros((2, 1))), forces=(forces.Anchor(point=(0.0,), stiffness=4.0),)
)
RUNS = [simulate(SWING, method, dt=0.1, steps=20) for method in (methods.verlet, methods.euler)]
SHOT = simulate(
    Scene(Particles(jnp.zeros(2), jnp.array([3.0, 4.0])), forces=(forces.Gravity(),)), methods.verlet, dt=0.1, steps=10
)


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


def test_each_quantity_has_a_panel_with_its_unit_and_each_lane_a_line():
    figure = plot.over_time(RUNS[0], "energy", "position", lambda t, state: 2.0 * state.position[..., 0])
    assert [ax.get_ylabel() for ax in figure.axes] == ["energy [J]", "position [m]", "<lambda>"]
    assert figure.axes[-1].get_xlabel() == "time [s]"
    for ax, values in zip(
        figure.axes, (RUNS[0].energy(), RUNS[0].position[..., 0], 2 * RUNS[0].position[..., 0]), strict=True
    ):
        assert len(ax.lines) == 2
        for lane, line in enumerate(ax.lines):
            np.testing.assert_allclose(line.get_xdata(), RUNS[0].time)
            np.testing.assert_allclose(line.get_ydata(), values[:, lane])


def test_components_have_names_and_height_is_along_up():
    figure = plot.over_time(SHOT, "position", "height", "speed")
    assert [text.get_text() for text in figure.axes[0].get_legend().get_texts()] == ["x", "y"]
    np.testing.assert_allclose(figure.axes[1].lines[0].get_ydata(), SHOT.position[:, 1])
    np.testing.assert_allclose(figure.axes[2].lines[0].get_ydata()[0], 5.0)


def test_several_runs_are_in_one_picture_under_their_names():
    def legend(figure):
        return [text.get_text() for text in figure.axes[0].get_legend().get_texts()]

    assert legend(plot.over_time(RUNS, "energy")) == ["verlet", "euler"]
    assert legend(plot.over_time({"good": RUNS[0], "bad": RUNS[1]}, "energy")) == ["good", "bad"]
    assert legend(plot.over_time(RUNS, "energy", labels=["a", "b"])) == ["a", "b"]
    finer = simulate(SWING, methods.verlet, dt=0.05, steps=40)
    assert legend(plot.over_time([RUNS[0], finer], "energy")) == ["verlet, dt = 0.1 s", "verlet, dt = 0.05 s"]


def test_a_phase_portrait_is_velocity_over_position():
    ax = plot.phase(RUNS)
    np.testing.assert_allclose(ax.lines[0].get_xdata(), RUNS[0].position[:, 0, 0])
    np.testing.assert_allclose(ax.lines[0].get_ydata(), RUNS[0].velocity[:, 0, 0])
    assert plot.phase(SHOT, component=1).get_xlabel() == "position y [m]"


@pytest.mark.parametrize(
    ("draw", "error", "words"),
    [
        (lambda: plot.over_time(SHOT, "colour"), ValueError, "expected one of position, velocity, speed"),
        (lambda: plot.over_time(3), TypeError, "got int, expected runs"),
        (lambda: plot.over_time([]), TypeError, "got nothing"),
        (lambda: plot.over_time(RUNS, labels=["a"]), ValueError, "one for each of the 2 runs"),
        (lambda: plot.phase(SHOT, component=2), ValueError, "expected 0 to 1"),
    ],
)
def test_what_does_not_fit_is_refused_in_plain_words(unannotated, draw, error, words):
    with pytest.raises(error, match=words):
        draw()
