"""The first crossing of a height, or of zero by any number of their state, of rigid bodies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Scene, contacts, forces, inertia, methods, rigid, simulate

PLATE, SPIN = inertia.planar_plate(2.0, (1.0, 1.0)), 3.0


def touch_nothing(t, bodies, inertia):
    """A force that ties the bodies of a scene together and does nothing."""
    return rigid.Wrench(0.0 * bodies.momentum)


def measure_angle(t, bodies):
    """How far each body has turned beyond 1 rad."""
    return bodies.angle - 1.0


def measure_twist(t, bodies):
    """How far two bodies have turned against each other beyond 2 rad."""
    return bodies.angle[..., 0] - bodies.angle[..., 1] - 2.0


def throw_plates(spin=SPIN, parts=()):
    """Two plates in free fall from 2 m and 4 m, which turn against each other."""
    spin = jnp.asarray(spin)
    spins, place = jnp.stack([spin, -spin]), [[0.0, 2.0], [3.0, 4.0]]
    state = rigid.planar_bodies(PLATE, place, velocity=(2.0, 0.0), angular_velocity=spins)
    return simulate(
        Scene(state, PLATE, (forces.Gravity(9.8), *parts)), methods.verlet, dt=0.02, steps=50, save_every=10
    )


def test_bodies_in_the_plane_cross_heights_and_angles():
    run = throw_plates()
    found = run.crossing(1.0, direction=-1)
    fall = np.sqrt(2 * np.array([1.0, 3.0]) / 9.8)
    np.testing.assert_allclose(found.time, fall, rtol=1e-12)
    np.testing.assert_allclose(found.position, [[2 * fall[0], 1.0], [3.0 + 2 * fall[1], 1.0]], rtol=1e-12)
    np.testing.assert_allclose(found.velocity, np.stack([[2.0, 2.0], -9.8 * fall], axis=-1), rtol=1e-12)
    np.testing.assert_allclose(found.state.angle, SPIN * fall * [1.0, -1.0], rtol=1e-12)
    turned = run.crossing(measure_angle)
    np.testing.assert_array_equal(turned.ok, [True, False])
    np.testing.assert_allclose(turned.time, [1 / SPIN, np.nan], rtol=1e-12)


def test_a_number_of_a_whole_scene_is_crossed_by_all_of_its_bodies_and_has_gradients():
    tie = (rigid.on_bodies(touch_nothing, couples=True),)

    def find(spin):
        found = throw_plates(spin, tie).crossing(measure_twist)
        return found.time, found

    (time, found), slope = jax.value_and_grad(find, has_aux=True)(SPIN)
    assert found.ok.shape == ()
    assert found.state.angle.shape == (2,)
    np.testing.assert_allclose(time, 1 / SPIN, rtol=1e-12)
    np.testing.assert_allclose(slope, -1 / SPIN**2, rtol=1e-9)


def test_a_function_of_another_shape_is_refused():
    with pytest.raises(ValueError, match=r"the function \(t, bodies\) has the shape \(2, 2\)"):
        throw_plates().crossing(lambda t, bodies: bodies.position)


def test_solids_cross_on_their_way_up_again():
    floor = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=1.0)
    solids = rigid.Solids(rigid.PlanarShape.disc(0.5), surfaces=(floor,), pairs=(), substeps=1)
    disc = inertia.planar_disc(2.0, 0.5)
    ball = Scene(rigid.planar_bodies(disc, [[0.0, 2.0]]), disc, (forces.Gravity(9.8),), contacts=(solids,))
    run = simulate(ball, methods.verlet, dt=0.01, steps=80, save_every=2)
    time, height, speed = run.time, run.position[:, 0, 1], run.velocity[:, 0, 1]
    before = int(np.flatnonzero((height[:-1] < 1.0) & (height[1:] >= 1.0))[0])
    np.testing.assert_allclose(speed[before] - speed[before + 1], 0.196, rtol=1e-9)  # it flies freely there
    rise = (speed[before] - np.sqrt(speed[before] ** 2 - 2 * 9.8 * (1.0 - height[before]))) / 9.8
    np.testing.assert_allclose(run.crossing(1.0, direction=1).time, time[before] + rise, rtol=1e-9)


def test_a_body_in_space_crosses_by_its_own_state():
    ball = inertia.sphere(2.0, 0.5)
    run = simulate(Scene(rigid.bodies(ball, angular_velocity=(0.0, 0.0, 1.0)), ball), methods.verlet, dt=0.02, steps=50)
    found = run.crossing(lambda t, body: body.orientation[..., 3] - np.sin(0.3))  # turned by 0.6 rad
    np.testing.assert_allclose(found.time, 0.6, atol=1e-4)
