"""Exact joints between bodies: pendulums of textbooks in the plane and in space, forces of statics, bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from physjax import Scene, constraint_forces, forces, inertia, methods, rigid, simulate, stability, state_after

G, ROD = 9.8, inertia.planar_segment(2.0, 1.0)
BOX = inertia.box(1.0, (0.05, 0.4, 0.05))


def hang_rods(count=1, angle=1.0, **options):
    """Rods of 1 m in the plane, one after the other, that hang from the origin."""
    along = np.array([np.sin(angle), -np.cos(angle)])
    x = jnp.asarray((np.arange(count) + 0.5)[:, None] * along)
    points = [[[0.0, 0.0], [0.0, 0.5]], *[[[0.0, -0.5], [0.0, 0.5]]] * (count - 1)]
    joints = rigid.Joints([(i - 1, i) for i in range(count)], points, **options)
    return Scene(rigid.planar_bodies(ROD, x, angle=np.full(count, angle)), ROD, (forces.Gravity(G), joints))


def swing(angle, factor, duration):
    """The angle of a pendulum with θ̈ = -factor sin θ from rest."""
    rate = lambda t, y: [y[1], -factor * np.sin(y[0])]  # noqa: E731
    return solve_ivp(rate, (0, duration), [angle, 0.0], method="DOP853", rtol=1e-12, atol=1e-12).y[0, -1]


@pytest.mark.parametrize(("order", "within", "ratio"), [(2, 2e-4, 4.0), (4, 2e-9, 16.0)])
def test_a_physical_pendulum_in_the_plane(order, within, ratio):
    exact = swing(1.0, G * 0.5 / (1 / 3), 2.0)
    scene = hang_rods(order=order)
    found = [state_after(scene, methods.verlet, duration=2.0, dt=dt).state.angle[0] - exact for dt in (1e-2, 5e-3)]
    assert abs(found[1]) < within
    assert found[0] / found[1] == pytest.approx(ratio, rel=0.02)


def test_a_chain_in_the_plane_stays_closed_and_its_joints_carry_its_weight():
    scene = hang_rods(3, angle=0.0)
    carried = np.asarray(constraint_forces(scene)[0])
    np.testing.assert_allclose(carried[:, 0], 0.0, atol=1e-10)
    np.testing.assert_allclose(carried[:, 1], -2.0 * G * np.arange(3, 0, -1), rtol=1e-10)
    scene = hang_rods(3, angle=1.0)
    film = simulate(scene, methods.verlet, dt=1 / 240, steps=240, save_every=10)
    assert bool(film.ok)
    assert jax.vmap(scene.forces[1].error)(film.state).max() < 1e-11


def test_a_conical_pendulum_in_space_turns_as_a_whole():
    # about the pivot, the torque of the weight turns the angular momentum: m g l = (I₁ + m l² - I₃) Ω² cos θ
    angle, across, along = 0.8, (0.05**2 + 0.4**2) / 12 + 0.04, 2 * 0.05**2 / 12
    speed = np.sqrt(G * 0.2 / ((across - along) * np.cos(angle)))
    place = 0.2 * np.array([[np.sin(angle), -np.cos(angle), 0.0]])
    spin = np.array([[0.0, speed, 0.0]])
    turned = [[np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)]]
    joints = rigid.Joints([(-1, 0)], [[[0.0, 0.0, 0.0], [0.0, 0.2, 0.0]]])
    start = rigid.bodies(BOX, place, orientation=turned, velocity=np.cross(spin, place), angular_velocity=spin)
    scene, turn = Scene(start, BOX, (forces.Gravity(G), joints)), 2 * np.pi / speed
    ends = [state_after(scene, methods.verlet, duration=turn, dt=turn / n).state for n in (400, 800)]
    off = [np.abs(end.position - place).max() for end in ends]
    assert off[0] < 1e-3
    assert off[0] / off[1] == pytest.approx(4.0, rel=0.05)
    assert joints.error(ends[0]).max() < 1e-11


def test_two_ball_joints_are_a_hinge_though_they_hold_a_distance_twice():
    pairs, points = rigid.hinge((-1, 0), [[0.0, 0.0, 0.0], [0.0, 0.2, 0.0]], (0.0, 0.0, 1.0), 0.1)
    place = 0.2 * np.array([[np.sin(1.0), -np.cos(1.0), 0.0]])
    start = rigid.bodies(BOX, place, orientation=[[np.cos(0.5), 0.0, 0.0, np.sin(0.5)]])
    scene = Scene(start, BOX, (forces.Gravity(G), rigid.Joints(pairs, points)))
    rate = jax.jit(lambda scene: scene.rate(0.0, scene.state))(scene)
    turning = -G * 0.2 / ((0.05**2 + 0.4**2) / 12 + 0.04) * np.sin(1.0)
    np.testing.assert_allclose(rate.momentum[0], np.cross([0.0, 0.0, turning], place[0]), atol=1e-12)


def test_held_bodies_hold_what_is_joined_to_them():
    x = np.array([[0.0, 0.5], [0.0, -0.5]])
    joints = rigid.Joints([(0, 1)], [[[0.0, -0.5], [0.0, 0.5]]])
    start = rigid.planar_bodies(
        ROD, x, angular_velocity=np.array([0.0, 1.0]), velocity=np.array([[0.0, 0.0], [0.5, 0.0]])
    )
    scene = Scene(start, ROD, (forces.Gravity(G), joints), pinned=np.array([True, False]))
    film = simulate(scene, methods.verlet, dt=0.01, steps=50)
    assert (film.position[:, :1] == x[None, :1]).all()
    assert jax.vmap(joints.error)(film.state).max() < 1e-11


def test_the_limit_of_a_hung_rod_is_set_by_its_swing():
    limit = stability.limit(hang_rods(angle=0.0), methods.verlet)
    assert limit.dt == pytest.approx(2 / np.sqrt(G * 0.5 / (1 / 3)), rel=1e-6)
    assert (limit.cause, limit.force) == ("stiffness", "Joints")


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([[[0.0, 0.0], [0.0, 0.6]]], "the joint 0 of .-1, 0. is 0.1 off at the start"),
        ([[[0.0, 0.0, 0.0], [0.0, 0.5, 0.0]]], r"expected \(1, 2, 2\) for such bodies"),
    ],
)
def test_joints_that_do_not_fit_are_refused(points, message):
    start = rigid.planar_bodies(ROD, jnp.array([[0.0, -0.5]]))
    with pytest.raises(ValueError, match=message):
        Scene(start, ROD, (rigid.Joints([(-1, 0)], points),))


def test_springs_do_not_reach_to_the_world_and_pivots_are_not_joined():
    with pytest.raises(ValueError, match="springs to the world are AtPoint"):
        rigid.Joints([(-1, 0)], [[[0.0, 0.0, 0.0], [0.0, 0.2, 0.0]]], stiffness=1.0)
    on_pivot = BOX.about((0.0, 0.2, 0.0))
    joints = rigid.Joints([(-1, 0)], [[[0.0, 0.2, 0.0], [0.0, 0.2, 0.0]]])
    with pytest.raises(ValueError, match="bodies on a pivot"):
        Scene(rigid.bodies(BOX, np.zeros((1, 3))), on_pivot, (joints,))
