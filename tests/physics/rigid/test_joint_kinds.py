"""Welds, hinges, sliders and rods leave bodies the ways to move that their names say, and no other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from physjax import Scene, constraint_forces, forces, inertia, methods, rigid, simulate

G = 9.8
PLATE, BRICK = inertia.planar_plate(1.0, (1.0, 0.2)), inertia.box(1.0, (0.3, 0.1, 0.2))


def find_gaps(scene, film):
    """By how much the joints of a run are off, frame by frame."""
    part = scene.forces[-1]
    read = part.coordinates(scene.state).read_places
    return np.asarray(jax.vmap(lambda state: part.measure(*part.find_ends(read(state))))(film.state))


def test_welded_plates_fly_as_one():
    start = rigid.planar_bodies(
        PLATE, [[-0.5, 0.0], [0.5, 0.0]], velocity=[[1.0, -0.5], [1.0, 0.5]], angular_velocity=1.0
    )
    scene = Scene(start, PLATE, (forces.Gravity(G), rigid.Welds([(0, 1)], [[[0.5, 0.0], [-0.5, 0.0]]])))
    film = simulate(scene, methods.verlet, dt=0.01, steps=100, save_every=10)
    np.testing.assert_allclose(film.position.mean(axis=1)[-1], [1.0, -G / 2], atol=1e-12)
    np.testing.assert_allclose(film.state.angle[-1], [1.0, 1.0], atol=1e-4)
    assert np.abs(find_gaps(scene, film)).max() < 1e-11


def find_rate(scene):
    return jax.jit(lambda scene: scene.rate(0.0, scene.state))(scene)


def test_welded_bricks_turn_as_one():
    spin, push = np.array([1.0, 2.0, 3.0]), (0.5, -1.0, 2.0)
    whole = inertia.box(2.0, (0.6, 0.1, 0.2))
    x = np.array([[-0.15, 0.0, 0.0], [0.15, 0.0, 0.0]])
    start = rigid.bodies(BRICK, x, velocity=np.cross(spin, x), angular_velocity=spin)
    welds = rigid.Welds([(0, 1)], [[[0.15, 0.0, 0.0], [-0.15, 0.0, 0.0]]])
    scene = Scene(start, BRICK, (rigid.Torque(push), welds))
    alone = rigid.bodies(whole, np.zeros(3), angular_velocity=spin)
    expected = rigid.angular_acceleration(alone, whole, 2 * jnp.asarray(push))
    rate = find_rate(scene)
    found = rigid.angular_acceleration(start, BRICK, rate.angular_momentum)
    np.testing.assert_allclose(found, np.stack([expected, expected]), atol=1e-11)
    np.testing.assert_allclose(rate.momentum, np.cross(expected, x) + np.cross(spin, np.cross(spin, x)), atol=1e-11)


def test_a_hinged_brick_is_a_physical_pendulum():
    moment = (0.3**2 + 0.1**2) / 12 + 0.15**2
    place = 0.15 * np.array([[np.cos(1.0), np.sin(1.0), 0.0]])
    start = rigid.bodies(BRICK, place, orientation=[[np.cos(0.5), 0.0, 0.0, np.sin(0.5)]])
    hinges = rigid.Hinges([(-1, 0)], [[[0.0, 0.0, 0.0], [-0.15, 0.0, 0.0]]], axis=(0.0, 0.0, 2.0))
    scene = Scene(start, BRICK, (forces.Gravity(G), hinges))
    film = simulate(scene, methods.verlet, dt=2e-3, steps=250, save_every=50)
    rate = lambda t, y: [y[1], -G * 0.15 / moment * np.cos(y[0])]  # noqa: E731
    angle = solve_ivp(rate, (0, 0.5), [1.0, 0.0], method="DOP853", rtol=1e-11, atol=1e-11).y[0, -1]
    np.testing.assert_allclose(film.position[-1, 0], [0.15 * np.cos(angle), 0.15 * np.sin(angle), 0.0], atol=5e-5)
    assert np.abs(find_gaps(scene, film)).max() < 1e-11


def test_a_slider_falls_down_its_slope():
    axis = np.array([3.0, 4.0])
    sliders = rigid.Sliders([(-1, 0)], jnp.zeros((1, 2, 2)), axis)
    scene = Scene(rigid.planar_bodies(PLATE, [[0.0, 0.0]]), PLATE, (forces.Gravity(G), sliders))
    film = simulate(scene, methods.verlet, dt=0.01, steps=100, save_every=10)
    np.testing.assert_allclose(film.position[-1, 0], -G * 0.8 / 2 * axis / 5, atol=1e-10)
    assert np.abs(find_gaps(scene, film)).max() < 1e-11
    np.testing.assert_allclose(abs(constraint_forces(scene)[0][0, 0]), G * 0.6, rtol=1e-10)


def test_a_slider_in_space_leaves_the_acceleration_along_its_axis():
    sliders = rigid.Sliders([(-1, 0)], jnp.zeros((1, 2, 3)), (3.0, 4.0, 0.0))
    scene = Scene(rigid.bodies(BRICK, [[0.0, 0.0, 0.0]]), BRICK, (forces.Gravity(G), sliders))
    rate = find_rate(scene)
    np.testing.assert_allclose(rate.momentum[0], -G * 0.8 * np.array([0.6, 0.8, 0.0]), atol=1e-12)
    np.testing.assert_allclose(rate.angular_momentum[0], 0.0, atol=1e-12)


def test_rods_between_bodies_keep_their_length_and_different_joints_hold_together():
    start = rigid.planar_bodies(PLATE, [[0.5, 0.0], [1.7, 0.0]], angular_velocity=[0.0, 3.0])
    nail = rigid.Joints([(-1, 0)], [[[0.0, 0.0], [-0.5, 0.0]]])
    rods = rigid.Rods([(0, 1)], [[[0.5, 0.0], [-0.1, 0.0]]])
    scene = Scene(start, PLATE, (forces.Gravity(G), nail, rods))
    np.testing.assert_allclose(scene.forces[-1].length, [0.6])
    film = simulate(scene, methods.verlet, dt=0.005, steps=100, save_every=10)
    assert np.abs(find_gaps(scene, film)).max() < 1e-11
    assert jax.vmap(nail.error)(film.state).max() < 1e-11
    assert [force.shape for force in constraint_forces(scene)] == [(1, 2), (1, 1)]


@pytest.mark.usefixtures("unannotated")
@pytest.mark.parametrize(
    ("build", "message"),
    [
        (
            lambda: rigid.Hinges([(-1, 0)], [[[0.0, 0.0], [0.0, 0.0]]], (0.0, 1.0)),
            "an axis in space and none in the plane",
        ),
        (lambda: rigid.Hinges([(-1, 0)], jnp.zeros((1, 2, 3)), (0.0, 0.0, 0.0)), "a vector that is not zero"),
        (lambda: rigid.Sliders([(-1, 0)], jnp.zeros((1, 2, 3)), (1.0, 0.0)), r"axis of shape \(2,\)"),
        (lambda: rigid.Welds([(-2, 0)], jnp.zeros((1, 2, 3))), "there are 1 places in the world"),
        (lambda: rigid.Rods([(-1, 0)], jnp.zeros((1, 2, 3)), length=0.0), "numbers > 0"),
    ],
)
def test_bad_joints_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()
