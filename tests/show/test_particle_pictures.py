"""Particles are dots of those alive, as large, as coloured and as opaque as their age has it."""

import numpy as np
import pytest

from physjax import Particles, Scene, animate, emitters, forces, methods, plot, simulate
from physjax.show import lights


def spray(glows=False):
    look = emitters.Look(size=(1.0, 2.0), colour=((1.0, 0.5, 0.0), (0.0, 0.5, 1.0)), opacity=(1.0, 0.2), glows=glows)
    jet = emitters.Emitter(
        60,
        emitters.Point((0.0, 0.0)),
        key=0,
        rate=50.0,
        life=1.0,
        speed=4.0,
        size=0.1,
        cone=0.4,
        direction=(0, 1),
        look=look,
    )
    return simulate(Scene(jet.unborn(), 0.01, (forces.Gravity(),), emitter=jet), methods.rk4, dt=0.02, steps=60)


def test_dots_are_those_alive_and_age():
    film = spray()
    figure = plot.particles(film, frames=(10, 60))
    for ax, frame in zip(figure.axes, (10, 60), strict=True):
        emitter, now = film.film.emitter, np.asarray(film.time)
        alive, age = np.asarray(emitter.alive(now))[frame], np.asarray(emitter.age(now))[frame]
        (dots,) = ax.collections
        np.testing.assert_allclose(dots.get_offsets(), np.asarray(film.position[frame])[alive])
        np.testing.assert_allclose(dots.get_facecolors()[:, 0], 1 - age[alive], atol=1e-12)
        np.testing.assert_allclose(dots.get_facecolors()[:, 3], 1 - 0.8 * age[alive], atol=1e-12)
        wide = np.sqrt(dots.get_sizes())
        points = 72 / figure.dpi * np.ptp(ax.transData.transform([(0, 0), (1, 0)])[:, 0])  # a metre
        np.testing.assert_allclose(wide, points * 0.1 * (1 + age[alive]), rtol=1e-9)
    assert len(animate.particles(film, fps=10).frames) == 13


def test_the_light_of_what_glows_adds_up():
    paper, wide = np.asarray([[30.5, 20.5], [30.5, 20.5], [70.5, 20.5]]), np.full(3, 16.0)
    seen = lights.render_glow(paper, wide, np.asarray([[0.2, 0.1, 0.0]] * 3), (41, 101))
    light = seen[..., :3] * seen[..., 3:]
    np.testing.assert_allclose(light[20, [30, 70]], [[0.4, 0.2, 0.0], [0.2, 0.1, 0.0]], atol=1e-6)
    # a bell curve that at half the radius has fallen to e^-1/2
    np.testing.assert_allclose(light[20, 74, 0], 0.2 * np.exp(-0.5), atol=1e-6)
    (ax,) = plot.particles(spray(glows=True), frames=(60,)).axes
    (image,) = [each for each in ax.artists if hasattr(each, "get_array")]
    assert image.get_array()[..., 3].max() > 0.5


def test_a_density_counts_all_that_are_alive():
    film = spray()
    panel, bar = plot.particles(film, frames=(60,), density=True).axes
    (image,) = [each for each in panel.artists if hasattr(each, "get_array")]
    assert image.get_array().sum() == np.asarray(film.film.emitter.alive(film.time))[60].sum()
    assert "particles in a cell" in bar.get_xlabel()


def test_a_run_without_an_emitter_is_refused():
    ball = Scene(Particles(np.zeros((2, 2)), np.ones((2, 2))))
    with pytest.raises(ValueError, match="without an emitter"):
        plot.particles(simulate(ball, methods.rk4, dt=0.1, steps=2))
