"""What is up in a scene is up in its pictures, films, pages and files."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, animate, contacts, forces, methods, simulate
from physjax.show import export, obstacles, plot
from physjax.show.auto_plot import plot_run
from physjax.show.solids import rotate_vectors


def thrown(up):
    """A ball thrown over another one on a floor, the axes exchanged in their cycle."""
    turned = lambda *vector: np.roll(vector, up - 1)  # noqa: E731
    floor = contacts.Plane((0.0, 0.0, 0.0), turned(0.0, 1.0, 0.0), response=contacts.project)
    stone = contacts.Sphere(turned(1.5, 0.3, 0.2), 0.3, response=contacts.project)
    ball = Particles(jnp.asarray(turned(0.0, 1.0, 0.0)), jnp.asarray(turned(3.0, 4.0, 1.0)))
    scene = Scene(ball, forces=(forces.Gravity(up=up),), contacts=(floor, stone))
    return simulate(scene, methods.verlet, dt=0.05, steps=20)


def pixels(run):
    """The last picture of a film, without the names and numbers of the axes."""
    figure = animate.paths(run).still(-1)
    figure.set_dpi(40)
    ax = figure.axes[0]
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.set_ticklabels([])
        axis.label.set_text("")
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].astype(int)


def test_a_film_of_another_up_is_the_same_but_for_the_names_of_the_axes():
    """Floor, light, shading and view turn along."""
    usual, turned = pixels(thrown(1)), pixels(thrown(2))
    assert usual.shape == turned.shape
    assert (np.abs(usual - turned).max(axis=-1) > 24).mean() < 0.01


@pytest.mark.parametrize("up", [0, 1, 2])
def test_axes_in_space_stand_on_the_ground(up):
    run = thrown(up)
    for ax in (plot.paths(run), plot_run(run).axes[0], animate.paths(run).still(0).axes[0]):
        assert ax._vertical_axis == up
    assert animate.view(run)._content["up"] == up
    lamp = obstacles.orient_up(obstacles.LIGHT_DIRECTION, up)
    assert lamp.argmax() == up


@pytest.mark.parametrize("up", [0, 1, 2])
def test_gltf_is_y_up_whatever_the_scene_is(up, tmp_path):
    data = export.gltf(thrown(up), tmp_path / "run.glb", progress=False).read_bytes()
    content = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    (root,) = (content["nodes"][i] for i in content["scenes"][0]["nodes"])
    if up == 1:
        assert "rotation" not in root
        return
    x, y, z, w = root["rotation"]
    assert root["children"] == [0]
    np.testing.assert_allclose(rotate_vectors(np.array([w, x, y, z]), np.eye(3)[up]), [0.0, 1.0, 0.0], atol=1e-15)
