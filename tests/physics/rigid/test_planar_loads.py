"""Loads on bodies in the plane, and the motion of their points, are those of the same bodies in space."""

import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, energy, forces, inertia, loads, methods, rigid, simulate

FLAT = rigid.PlanarInertia(2.0, 0.6)
BRICK = inertia.box(2.0, (1.2, 1.5, 1.0))
"""A brick whose moment about z is 2 (1.2² + 1.5²)/12."""
PLATE = rigid.PlanarInertia(2.0, 2.0 * (1.2**2 + 1.5**2) / 12)
PLACE, ANGLE = np.array([[0.3, 0.5], [-1.0, 2.0]]), np.array([0.4, -2.0])
VELOCITY, TURN = np.array([[1.0, -0.5], [0.2, 0.7]]), np.array([3.0, -1.5])
ALONG = np.array([0.2, -0.7])


def lift(vectors):
    """Vectors of the plane in space."""
    return np.pad(np.asarray(vectors, float), [(0, 0)] * (np.ndim(vectors) - 1) + [(0, 1)])


def axial(numbers):
    """Numbers of the plane as vectors along z."""
    return np.asarray(numbers, float)[..., None] * np.array([0.0, 0.0, 1.0])


FLAT_BODIES = rigid.planar_bodies(PLATE, PLACE, ANGLE, VELOCITY, TURN)
HALF = ANGLE / 2
QUATERNION = np.stack([np.cos(HALF), 0 * HALF, 0 * HALF, np.sin(HALF)], axis=-1)
SOLID_BODIES = rigid.bodies(BRICK, lift(PLACE), QUATERNION, lift(VELOCITY), axial(TURN))
SPRING = {"stiffness": 30.0, "damping": 2.0}


@pytest.mark.parametrize(
    ("flat", "solid"),
    [
        (rigid.Torque(0.7), rigid.Torque(axial(0.7))),
        (rigid.Torque([0.7, -0.2], frame="body"), rigid.Torque(axial([0.7, -0.2]), frame="body")),
        (rigid.RotationalDrag(0.3), rigid.RotationalDrag(0.3)),
        (rigid.Thrust((1.0, 0.4)), rigid.Thrust((1.0, 0.4, 0.0))),
        (rigid.Thrust((1.0, 0.4), ALONG), rigid.Thrust((1.0, 0.4, 0.0), lift(ALONG))),
        (
            rigid.AtPoint(ALONG, forces.Anchor((1.0, 1.0), **SPRING)),
            rigid.AtPoint(lift(ALONG), forces.Anchor((1.0, 1.0, 0.0), **SPRING)),
        ),
        (rigid.AtPoint(ALONG, forces.StokesDrag(0.5)), rigid.AtPoint(lift(ALONG), forces.StokesDrag(0.5))),
    ],
)
def test_a_load_is_that_of_the_same_bodies_in_space(flat, solid):
    force, torque = loads(Scene(FLAT_BODIES, PLATE, (flat,)), 0.0)
    expected_force, expected_torque = loads(Scene(SOLID_BODIES, BRICK, (solid,)), 0.0)
    np.testing.assert_allclose(lift(force), expected_force, atol=1e-14)
    np.testing.assert_allclose(axial(torque), expected_torque, atol=1e-14)
    if flat.has_potential:
        one, other = Scene(FLAT_BODIES, PLATE, (flat,)), Scene(SOLID_BODIES, BRICK, (solid,))
        np.testing.assert_allclose(energy.total(one, 0.0, one.state), energy.total(other, 0.0, other.state))


def test_points_move_as_those_of_the_same_bodies_in_space():
    place = rigid.point(FLAT_BODIES, ALONG), rigid.point(SOLID_BODIES, lift(ALONG))
    velocity = rigid.point_velocity(FLAT_BODIES, PLATE, ALONG), rigid.point_velocity(SOLID_BODIES, BRICK, lift(ALONG))
    flat = Scene(FLAT_BODIES, PLATE, (forces.Gravity(), rigid.Torque(2.0)))
    solid = Scene(SOLID_BODIES, BRICK, (forces.Gravity(), rigid.Torque(axial(2.0))))
    change = rigid.point_acceleration(flat, 0.0, ALONG), rigid.point_acceleration(solid, 0.0, lift(ALONG))
    for mine, theirs in (place, velocity, change):
        np.testing.assert_allclose(lift(mine), theirs, atol=1e-13)
    np.testing.assert_allclose(rigid.angular_velocity(FLAT_BODIES, PLATE), TURN)
    np.testing.assert_allclose(rigid.angular_acceleration(FLAT_BODIES, PLATE, 3.0 * TURN), 3.0 * TURN / PLATE.moment)


def test_a_function_of_bodies_is_a_load_in_the_plane():
    spin_up = rigid.on_bodies(
        lambda t, bodies, inertia: rigid.Wrench(force=-bodies.momentum, torque=0.5 * bodies.angular_momentum)
    )
    force, torque = loads(Scene(FLAT_BODIES, PLATE, (spin_up,)), 0.0)
    np.testing.assert_allclose(force, -FLAT_BODIES.momentum)
    np.testing.assert_allclose(torque, FLAT_BODIES.angular_momentum / 2)


def test_an_engine_beside_the_centre_turns_the_body_at_a_constant_rate_of_change():
    jet = rigid.Thrust((0.0, 3.0), (0.5, 0.0))
    run = simulate(Scene(rigid.planar_bodies(FLAT), FLAT, (jet,)), methods.rk4, dt=0.05, steps=20)
    assert float(run.state.angle[-1]) == pytest.approx(0.5 * (1.5 / 0.6), rel=1e-12)


def test_a_load_is_refused_on_particles_and_in_the_wrong_number_of_dimensions():
    ball = Particles(jnp.zeros(2), jnp.zeros(2))
    with pytest.raises(TypeError, match="expected RigidBodies or PlanarBodies"):
        loads(Scene(ball, 1.0, (rigid.Torque(1.0),)), 0.0)
    with pytest.raises(ValueError, match="torque"):
        Scene(FLAT_BODIES, PLATE, (rigid.Torque((0.0, 0.0, 1.0)),))


def test_joints_are_for_bodies_in_space():
    joint = rigid.Joints([(0, 1)], [[[0.5, 0.0, 0.0], [-0.5, 0.0, 0.0]]], stiffness=1e3)
    with pytest.raises(TypeError, match="Joints: got a state of type PlanarBodies, expected RigidBodies"):
        loads(Scene(FLAT_BODIES, PLATE, (joint,)), 0.0)


@pytest.mark.parametrize("coupled", [False, True])
def test_the_angular_momentum_has_the_bodies_own(coupled):
    pull = (rigid.on_bodies(lambda t, bodies, inertia: rigid.Wrench(bodies.momentum), couples=True),) * coupled
    one, other = Scene(FLAT_BODIES, PLATE, pull), Scene(SOLID_BODIES, BRICK, pull)
    found, expected = (energy.angular_momentum(scene, 0.0, scene.state) for scene in (one, other))
    np.testing.assert_allclose(found, expected[..., 2])
    size = energy.ANGULAR_MOMENTUM.size
    np.testing.assert_allclose(size(one, 0.0, one.state), size(other, 0.0, other.state))
