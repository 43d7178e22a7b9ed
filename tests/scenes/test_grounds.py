"""The kerb and the hill of the gallery are surfaces: their distance grows along their normals, and they are drawn."""

import jax
import numpy as np
import pytest

from physjax.scenes.driving import Kerb
from physjax.scenes.snow import Hill
from physjax.show.outlines import build_outline
from physjax.show.stage import Stage

KERB = Kerb(13.0, 0.4)
HILL = Hill(0.4, 1.5, 20.0, 3.0)


def gradient_of_the_distance(surface, place):
    return jax.vmap(jax.grad(lambda x: surface.signed_distance(0.0, x)))(place)


@pytest.mark.parametrize(
    ("place", "normal", "distance"),
    [
        ((5.0, 0.1, 3.0), (0.0, 1.0, 0.0), 0.1),  # above the ground
        ((12.9, 0.3, 0.0), (-1.0, 0.0, 0.0), 0.1),  # before the face
        ((15.0, 0.7, 0.0), (0.0, 1.0, 0.0), 0.3),  # above the top
        ((12.7, 0.8, 0.0), (-0.6, 0.8, 0.0), 0.5),  # off the edge
        ((13.1, 0.2, 0.0), (-1.0, 0.0, 0.0), -0.1),  # inside, nearest to the face
        ((15.0, 0.3, 0.0), (0.0, 1.0, 0.0), -0.1),  # inside, nearest to the top
    ],
)
def test_a_kerb_is_as_far_as_the_nearest_of_its_parts(place, normal, distance):
    place = np.array([place])
    np.testing.assert_allclose(KERB.signed_distance(0.0, place), distance, atol=1e-12)
    np.testing.assert_allclose(KERB.normal_at(0.0, place)[0], normal, atol=1e-12)
    np.testing.assert_allclose(gradient_of_the_distance(KERB, place)[0], normal, atol=1e-12)


def test_on_a_hill_the_distance_grows_along_the_normal_and_curves_as_the_hill_does():
    x = np.linspace(10.0, 30.0, 101)
    place = np.stack([x, np.asarray(HILL.height(x)[0])], axis=-1)
    np.testing.assert_allclose(HILL.signed_distance(0.0, place), 0.0, atol=1e-12)
    np.testing.assert_allclose(gradient_of_the_distance(HILL, place), HILL.normal_at(0.0, place), atol=1e-12)
    slope = np.asarray(HILL.height(x)[1])
    velocity = np.stack([np.full_like(x, 7.0), 7.0 * slope], axis=-1)

    def distance(t, place, velocity):
        return HILL.signed_distance(t, place + t * velocity)

    curvature_acceleration = jax.vmap(jax.grad(jax.grad(distance)), in_axes=(None, 0, 0))(0.0, place, velocity)
    np.testing.assert_allclose(HILL.curvature_acceleration(0.0, place, velocity), curvature_acceleration, atol=1e-10)


def test_a_kerb_is_drawn_from_side_to_side_with_a_sharp_edge():
    stage = Stage(np.array([10.0, -1.0, -2.0]), np.array([16.0, 1.0, 2.0]))
    ground, face, top = build_outline(KERB, stage, 0.0).polygons
    np.testing.assert_allclose(face[:, 0], 13.0)
    np.testing.assert_allclose([np.ptp(ground[:, 2]), np.ptp(face[:, 1]), top[:, 1].min()], [4.0, 0.4, 0.4])
    before = stage._replace(high=np.array([12.0, 1.0, 2.0]))
    (ground,) = build_outline(KERB, before, 0.0).polygons
    assert np.ptp(ground[:, 1]) == 0.0
