"""Limits, motors and servos of joints carry what lies on the bodies, and yield to it where they have to."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Scene, contacts, forces, inertia, methods, rigid, simulate

ROUGH = contacts.Coulomb(0.8, 0.8)
SIZE = 0.2


def build_lever(mass, arm, dim=2, **drive):
    """A beam of 10 kg on an axle in its middle, with a box on it that far from the axle."""
    if dim == 2:
        parts = inertia.planar_plate(10.0, (4.0, 0.1)), inertia.planar_plate(mass, (SIZE, SIZE))
        bodies = rigid.PlanarInertia(
            *(jnp.stack([getattr(part, name) for part in parts]) for name in ("mass", "moment"))
        )
        start = rigid.planar_bodies(bodies, [[0.0, 0.0], [arm, 0.05 + SIZE / 2]])
        shapes, axis = [rigid.PlanarShape.box((4.0, 0.1)), rigid.PlanarShape.box((SIZE, SIZE))], None
    else:
        parts = inertia.box(10.0, (4.0, 0.1, 0.4)), inertia.box(mass, (SIZE, SIZE, SIZE))
        bodies = inertia.Inertia(
            *(jnp.stack([getattr(part, name) for part in parts]) for name in ("mass", "principal"))
        )
        start = rigid.bodies(bodies, [[0.0, 0.0, 0.0], [arm, 0.05 + SIZE / 2, 0.0]])
        shapes, axis = [rigid.Shape.box((4.0, 0.1, 0.4)), rigid.Shape.box((SIZE, SIZE, SIZE))], (0.0, 0.0, 1.0)
    axle = rigid.Hinges([(-1, 0)], np.zeros((1, 2, dim)), axis, **drive)
    return Scene(start, bodies, (forces.Gravity(9.8), axle), (rigid.Solids(shapes, (), coulomb=ROUGH),))


def run_lever(scene, steps=60):
    """The angle of the beam, and how far the box is above it at the start [m], step by step."""
    film = simulate(scene, methods.leapfrog, dt=1 / 60, steps=steps)
    angle = jax.vmap(scene.forces[1].angle)(film.state)[:, 0]
    return np.asarray(angle), film.position[:, 1, 1] - 0.05 - SIZE / 2


@pytest.mark.parametrize("dim", [2, 3])
def test_a_servo_carries_a_load_up_to_its_torque_and_no_more(dim):
    needed = 50.0 * 9.8 * 1.0
    servo = lambda share: build_lever(50.0, 1.0, dim, servo=0.0, response_time=0.05, torque=share * needed)  # noqa: E731
    holds, _ = run_lever(servo(1.01))
    np.testing.assert_allclose(holds, 0.0, atol=5e-5)
    np.testing.assert_allclose(holds[-1], 0.0, atol=1e-8)
    yields, _ = run_lever(servo(0.98))
    moment = 10 * (16 + 0.01) / 12 + 50 * (1 + 0.15**2 + SIZE**2 / 6)
    # the box is above the axle and leans out: θ'' = (lacking + tilt θ) / moment
    lacking, tilt = 0.02 * needed, 50.0 * 9.8 * 0.15
    np.testing.assert_allclose(yields[-1], -lacking / tilt * (np.cosh(np.sqrt(tilt / moment)) - 1), rtol=0.03)


def test_a_light_beam_on_its_limit_carries_a_load_500_times_as_heavy():
    angle, height = run_lever(build_lever(5000.0, 1.0, limits=(0.0, None)))
    assert np.abs(angle).max() < 1e-12
    np.testing.assert_allclose(height, 0.0, atol=2e-5)


def test_a_load_on_the_other_side_lifts_a_beam_from_its_limit_as_if_there_were_none():
    held, _ = run_lever(build_lever(50.0, -1.0, limits=(0.0, None)), 12)
    free, _ = run_lever(build_lever(50.0, -1.0), 12)
    # that it pulls is known after one of four sub-steps
    later = (np.arange(1, 13) - 0.25) / np.arange(1, 13)
    np.testing.assert_allclose(held[1:], free[1:] * later**2, rtol=2e-2)


def test_servos_hold_up_a_table_with_a_thousand_times_the_mass_of_its_legs():
    splay, mass = 0.3, jnp.asarray([500.0, 0.5, 0.5])
    across, along = np.sin(splay), np.cos(splay)
    hips, y = np.array([-0.7, 0.7]), along + 0.05 * across
    x = [[0.0, y], *([hip + side * 0.5 * across, y - 0.5 * along] for hip, side in zip(hips, (-1, 1), strict=True))]
    moment = jnp.asarray([500 * (4 + 0.01) / 12, *[0.5 * (1 + 0.01) / 12] * 2])
    bodies = rigid.PlanarInertia(mass, moment)
    angle = np.array([0.0, -splay, splay])
    points = [[[-0.7, 0.0], [0.0, 0.5]], [[0.7, 0.0], [0.0, 0.5]]]
    hinges = rigid.Hinges([(0, 1), (0, 2)], points, servo=angle[1:], response_time=0.02, torque=1e4)
    slippery = contacts.Coulomb(0.1, 0.1)
    floor = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.0, coulomb=slippery)
    shapes = [rigid.PlanarShape.box((2.0, 0.1)), *[rigid.PlanarShape.box((0.1, 1.0))] * 2]
    solids = rigid.Solids(shapes, (floor,), coulomb=slippery, pairs=np.zeros((0, 2), int))
    start = rigid.planar_bodies(bodies, x, angle=angle)
    film = simulate(
        Scene(start, bodies, (forces.Gravity(9.8), hinges), (solids,)), methods.leapfrog, dt=1 / 60, steps=60
    )
    np.testing.assert_allclose(film.position[:, 0, 1], y, atol=5e-5)
    np.testing.assert_allclose(film.state.angle[-1], angle, atol=1e-5)


def test_the_angle_of_a_servo_that_yields_can_be_differentiated_by_the_load():
    def turn(mass):
        scene = build_lever(mass, 1.0, servo=0.0, response_time=0.05, torque=450.0)
        return simulate(scene, methods.leapfrog, dt=1 / 60, steps=20).state.angle[-1, 0]

    mass, step = jnp.asarray(50.0), 1e-4
    slope = (turn(mass + step) - turn(mass - step)) / (2 * step)
    np.testing.assert_allclose(jax.jvp(turn, (mass,), (jnp.ones(()),))[1], slope, rtol=1e-4)


def test_levers_under_vmap_equal_each_alone():
    masses = jnp.asarray([10.0, 50.0, 60.0])

    def angles(mass):
        return simulate(
            build_lever(mass, 1.0, servo=0.0, response_time=0.05, torque=500.0), methods.leapfrog, dt=1 / 60, steps=10
        ).state.angle

    together = jax.vmap(angles)(masses)
    np.testing.assert_allclose(together[1], angles(masses[1]), atol=1e-12)
