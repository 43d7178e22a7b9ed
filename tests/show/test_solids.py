"""Bodies are drawn with their shapes, where they are and as they stand."""

import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, animate, inertia, methods, plot, rigid, simulate
from physjax.show import solids
from physjax.show.bodies import check_shapes
from physjax.show.surfaces import find_back_faces

BRICK = inertia.box(1.0, (1.0, 2.0, 3.0))
STILL = rigid.bodies(BRICK, position=[[0.0, 0, 0], [5, 0, 0]], orientation=[[1.0, 0, 0, 0], [1, 0, 0, 1]])
FILM = simulate(Scene(STILL, BRICK), methods.verlet, dt=0.1, steps=2)


def volume(shape):
    a, b, c = shape.vertices[shape.faces].transpose(1, 0, 2)
    return np.sum(a * np.cross(b, c)) / 6


@pytest.mark.parametrize(
    ("shape", "exact", "share"),
    [
        (solids.box((1.0, 2.0, 3.0)), 6.0, 1e-14),
        (solids.cylinder(0.5, 2.0, axis=0), np.pi / 2, 0.02),
        (solids.sphere(0.5), np.pi / 6, 0.04),
        (solids.capsule(0.5, 2.0, axis=1), np.pi / 2 + np.pi / 6, 0.03),
    ],
)
def test_a_shape_encloses_its_volume_with_faces_that_look_outward(shape, exact, share):
    assert volume(shape) == pytest.approx(exact, rel=share)
    a, b, c = shape.vertices[shape.faces].transpose(1, 0, 2)
    assert (np.sum(np.cross(b - a, c - a) * (a + b + c), axis=1) > 0).all()


def test_shapes_lie_along_their_axis_and_are_joined():
    long = solids.capsule(0.1, 1.0, axis=1)
    np.testing.assert_allclose(np.ptp(long.vertices, axis=0), [0.2, 1.2, 0.2], rtol=1e-12)
    pair = long.joined(solids.box((1, 1, 1)).at((3, 0, 0)))
    assert volume(pair) == pytest.approx(volume(long) + 1.0)


def test_every_body_is_drawn_where_it_is_and_as_it_stands():
    seen, faces = solids.place_shapes(*check_shapes("plot.bodies", FILM, solids.box((1.0, 2.0, 3.0))))
    assert (seen.position.shape, faces.max()) == ((3, 16, 3), 15)
    np.testing.assert_allclose(np.ptp(seen.position[0, :8], axis=0), [1, 2, 3], rtol=1e-6)
    np.testing.assert_allclose(np.ptp(seen.position[0, 8:], axis=0), [2, 1, 3], rtol=1e-6)  # a quarter turn about z
    np.testing.assert_allclose(seen.position[0, 8:].mean(axis=0), [5, 0, 0], atol=1e-6)


def test_pictures_and_films_are_drawn(tmp_path):
    shapes = [solids.box((1.0, 2.0, 3.0)), solids.sphere(1.0)]
    figure = plot.bodies(FILM, shapes, frames=(0, 2))
    assert [ax.get_title() for ax in figure.axes] == ["t = 0.000 s", "t = 0.200 s"]
    figure.canvas.draw()
    inside = np.asarray(figure.canvas.buffer_rgba())
    assert (inside[..., 2].astype(int) - inside[..., 0] > 40).mean() > 0.01  # blue
    film = animate.bodies(FILM, shapes, fps=10)
    assert film.save(tmp_path / "boxes.gif", progress=False).stat().st_size > 1000


def test_the_far_side_of_a_body_is_drawn_before_its_near_one():
    (ax,) = plot.bodies(FILM, [solids.box((1.0, 2.0, 3.0)), solids.sphere(1.0)], frames=-1).axes
    layers = {c.get_zorder(): c for c in ax.collections if c.get_zorder() in (1, 4)}
    far, near = (len(layers[order].get_facecolor()) for order in (1, 4))
    assert far + near == 12 + len(solids.sphere(1.0).faces)
    assert min(far, near) > 0.3 * (far + near)
    top = np.array([[[0.0, 1, 0], [0, 1, 1], [1, 1, 0]]])  # seen from above
    assert find_back_faces(np.concatenate([top, top[:, ::-1]]), ax).tolist() == [False, True]


@pytest.mark.usefixtures("unannotated")
def test_what_does_not_fit_is_refused_in_plain_words():
    ball = simulate(Scene(Particles(jnp.zeros(3), jnp.ones(3))), methods.verlet, dt=0.1, steps=1)
    with pytest.raises(TypeError, match="expected RigidBodies"):
        plot.bodies(ball, solids.sphere(1.0))
    with pytest.raises(ValueError, match="got 1 shapes, expected a Shape for all 2"):
        plot.bodies(FILM, [solids.sphere(1.0)])
    with pytest.raises(ValueError, match="size"):
        solids.box((1, -1, 1))
