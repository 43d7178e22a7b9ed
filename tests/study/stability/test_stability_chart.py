"""Pictures of stability, and the command that draws them."""

import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, forces, methods, stability
from physjax.cli import main
from physjax.stepping.methods import METHODS


def spring(stiffness):
    return Scene(Particles(jnp.ones(1), jnp.zeros(1)), forces=(forces.Anchor(point=jnp.zeros(1), stiffness=stiffness),))


def test_the_map_turns_from_stable_to_diverged_where_it_was_predicted():
    stiffness = np.array([1.0, 4.0, 16.0])
    dts = np.geomspace(0.05, 8.0, 30)
    result = stability.map(spring, [methods.verlet, methods.euler], dts, ("stiffness [N/m]", stiffness), duration=200.0)
    assert result.verdict.shape == (2, 3, 30)
    np.testing.assert_allclose(result.predicted, [2 / np.sqrt(stiffness), [0, 0, 0]], rtol=1e-5)
    for row in range(3):
        first = result.dts[0, row][result.verdict[0, row] == 2].min()
        assert first == pytest.approx(result.predicted[0, row], rel=0.25)
        assert (result.verdict[0, row][result.dts[0, row] > first] == 2).all()
    assert (result.verdict[1][:, 10:] == 2).all()
    figure = result.plot()
    panels = [ax for ax in figure.axes if ax.get_visible()]
    assert [ax.get_title() for ax in panels] == ["verlet", "euler"]
    assert panels[0].get_ylabel() == "stiffness [N/m]"
    assert panels[0].get_xlabel() == "dt [s]"


def test_the_region_is_drawn_with_its_axes():
    ax = stability.region(methods.rk4, points=(61, 71)).plot()
    assert ax.get_xlabel() == "Re λ dt (damping)"
    assert "rk4" in ax.get_title()


def test_the_map_says_of_a_method_without_a_limit_what_the_limit_says():
    limits = np.array([[0.0], [np.inf], [5.0]])
    dts = np.broadcast_to([0.1, 0.2], (3, 1, 2))
    names = ("euler", "implicit_euler", "rk4")
    drawn = stability.StabilityMap(
        names, "", np.zeros(1), dts, np.ones((3, 1, 2), int), np.ones((3, 1, 2)), limits, 1.0
    )
    texts = [text.get_text() for text in drawn.plot().axes[0].texts]
    assert texts == ["never stable", "any step is stable", "limit beyond this edge"]


def test_a_map_needs_a_function_for_a_parameter():
    with pytest.raises(TypeError, match="Give a Scene, or a function"):
        stability.map(spring(1.0), [methods.rk4], [0.1], ("stiffness", [1.0]))


def test_the_command_prints_limits_and_draws_the_map(tmp_path, capsys, monkeypatch):
    for name in set(METHODS) - {"euler", "verlet"}:
        monkeypatch.delitem(METHODS, name)
    assert main(["stability", "oscillator", "--steps", "400", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "never stable" in printed
    assert "63.2 ms" in printed
    assert "stiffness of Anchor" in printed
    assert (tmp_path / "oscillator.png").stat().st_size > 10_000
    assert main(["stability", "oscilator", "--out", str(tmp_path)]) == 2
