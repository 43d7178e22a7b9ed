"""Bodies in the plane: their inertia against sums over points, their free motion, and what is refused."""

import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Scene, forces, inertia, methods, rigid, simulate


def sample_moment(inside, half, mass=3.0, count=1201):
    """m ∫ r² over a shape by midpoints of a grid, about the origin."""
    ticks = (np.arange(count) + 0.5) / count * 2 * half - half
    x, y = np.meshgrid(ticks, ticks)
    there = inside(x, y)
    return mass * ((x**2 + y**2) * there).sum() / there.sum()


def test_moments_are_those_of_their_areas():
    capsule = lambda x, y: np.hypot(np.maximum(np.abs(x) - 0.6, 0), y) < 0.3  # noqa: E731
    assert inertia.planar_disc(3.0, 0.8).moment == pytest.approx(
        sample_moment(lambda x, y: np.hypot(x, y) < 0.8, 1), rel=1e-3
    )
    assert inertia.planar_capsule(3.0, 0.3, 1.2).moment == pytest.approx(sample_moment(capsule, 1), rel=1e-3)
    assert inertia.planar_plate(3.0, (1.0, 0.5)).moment == pytest.approx(3 * 1.25 / 12)
    assert inertia.planar_segment(3.0, 2.0).moment == pytest.approx(1.0)
    # three corners far from the origin: a triangle's moment is m/36 times the sum of its sides' squares
    corners = np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0]])
    triangle = inertia.planar_polygon(2.0, corners + 100.0)
    assert triangle.inertia.moment == pytest.approx(2 / 36 * (9 + 16 + 25))
    np.testing.assert_allclose(triangle.center, corners.mean(axis=0) + 100, rtol=1e-12)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_a_free_body_flies_as_its_center_and_turns_steadily(dtype):
    stick = inertia.planar_segment(2.0, 1.0)
    thrown = rigid.planar_bodies(stick, np.zeros((3, 2), dtype), velocity=(3.0, 4.0), angular_velocity=[1.0, -2.0, 0.0])
    run = simulate(Scene(thrown, stick, (forces.Gravity(),)), methods.verlet, dt=0.05, steps=20)
    assert run.state.position.dtype == dtype
    tolerance = 1e-12 if dtype == np.float64 else 1e-5
    np.testing.assert_allclose(run.state.position[-1], np.tile([3.0, 4.0 - 9.8 / 2], (3, 1)), rtol=tolerance)
    np.testing.assert_allclose(run.state.angle[-1], [1.0, -2.0, 0.0], rtol=tolerance)
    energy = run.state.kinetic_energy(stick) + 2.0 * 9.8 * run.state.position[..., 1]
    np.testing.assert_allclose(energy, np.broadcast_to(energy[0], energy.shape), rtol=10 * tolerance)


def test_wrong_bodies_are_refused_in_plain_words():
    plate = inertia.planar_plate(1.0, (1.0, 1.0))
    with pytest.raises(TypeError, match="PlanarInertia"):
        Scene(rigid.planar_bodies(plate), 1.0)
    with pytest.raises(ValueError, match="expected \\(2,\\)"):
        Scene(rigid.PlanarBodies(jnp.zeros((2,)), jnp.zeros(()), jnp.zeros((3,)), jnp.zeros(())), plate)
    with pytest.raises(ValueError, match="convex polygon, anticlockwise"):
        rigid.PlanarShape.polygon([[0.0, 0.0], [0.0, 1.0], [1.0, 1.0], [1.0, 0.0]])
    with pytest.raises(ValueError, match="3 to 12"):
        inertia.planar_polygon(1.0, [[0.0, 0.0], [1.0, 0.0]])
