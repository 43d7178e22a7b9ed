"""Aimed shots drawn: arcs that end on their targets, and misses that say so."""

import jax.numpy as jnp
import numpy as np

from physjax import Particles, Scene, aim_at, contacts, forces


def test_both_arcs_end_on_the_target_and_a_miss_says_so():
    wall = contacts.Plane(point=(0.0, -2.0), normal=(0.0, 1.0), response=contacts.project)
    ball = Scene(Particles(jnp.zeros(2), jnp.zeros(2)), forces=(forces.Gravity(),), contacts=(wall,))
    ax = aim_at(ball, (40.0, 3.0), speed=25.0).plot()
    low, high = ax.lines[:2]
    for line in (low, high):
        np.testing.assert_allclose(line.get_xydata()[-1], [40.0, 3.0], atol=1e-9)
        assert line.get_linestyle() == "-"
    assert low.get_ydata().max() < high.get_ydata().max()
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    assert left < 0 < 40 < right
    assert bottom < -2
    assert top > high.get_ydata().max()
    assert "low arc: 24.37°, 25 m/s, 1.76 s" in [line.get_label() for line in ax.lines]
    missed = aim_at(ball, (80.0, 3.0), speed=25.0).plot()
    assert missed.lines[0].get_linestyle() == "--"
    assert "misses by" in missed.lines[0].get_label()
    assert missed.get_xlim()[1] > 80


def test_many_targets_in_space():
    ball = Scene(Particles(jnp.zeros(3), jnp.zeros(3)), forces=(forces.Gravity(),))
    targets = jnp.stack([jnp.linspace(5.0, 20.0, 6), jnp.zeros(6), jnp.linspace(-5.0, 5.0, 6)], axis=-1)
    ax = aim_at(ball, targets, speed=20.0).plot(every=2)
    assert len(ax.lines) == 2 * 3 + 2
    assert ax.get_zlabel() == "z [m]"
