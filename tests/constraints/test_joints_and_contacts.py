"""Joints stay closed while what they join hits walls and lies on floors, whatever resolves the contacts."""

import jax
import jax.numpy as jnp
import numpy as np

from physjax import Particles, Scene, contacts, energy, forces, inertia, methods, rigid, simulate, springs


def drop_chain(response=None):
    """A chain of eight links that falls askew on a floor."""
    along = 0.2 * np.array([np.cos(0.5), np.sin(0.5)])
    x = jnp.asarray([0.0, 0.3] + np.arange(9)[:, None] * along)
    rods = springs.Rods([(i, i + 1) for i in range(8)])
    floor = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.0, friction=0.5, response=contacts.project)
    return Scene(
        Particles(x, jnp.zeros_like(x)), forces=(forces.Gravity(), forces.StokesDrag(1.0), rods), contacts=(floor,)
    )


def test_a_chain_comes_to_lie_on_a_floor_with_its_links_as_long_as_before():
    film = simulate(drop_chain(), methods.verlet, dt=2e-3, steps=2000, save_every=20)
    links = np.linalg.norm(np.diff(film.position, axis=1), axis=-1)
    np.testing.assert_allclose(links, 0.2, atol=1e-9)
    assert film.position[..., 1].min() > -1e-3
    np.testing.assert_allclose(film.position[-1, :, 1], 0.0, atol=1e-3)
    assert np.abs(film.velocity[-1]).max() < 1e-2


def test_a_double_pendulum_of_boxes_hits_a_wall_and_holds():
    box = inertia.planar_plate(1.0, (0.2, 1.0))
    points = [[[0.0, 0.0], [0.0, 0.5]], [[0.0, -0.5], [0.0, 0.5]]]
    joints = rigid.Joints([(-1, 0), (0, 1)], points)
    along = np.array([np.sin(1.0), -np.cos(1.0)])
    start = rigid.planar_bodies(box, [0.5 * along, 1.5 * along], angle=np.array([1.0, 1.0]))
    wall = contacts.Plane((-0.4, 0.0), (1.0, 0.0))
    solids = rigid.Solids(rigid.PlanarShape.box((0.2, 0.96)), (wall,), 0.5, pairs=np.zeros((0, 2), int))
    scene = Scene(start, box, (forces.Gravity(), joints), (solids,))
    film = simulate(scene, methods.verlet, dt=1 / 240, steps=360, save_every=4)
    assert jax.vmap(joints.error)(film.state).max() < 1e-6
    lowest = film.position[:, 1, 0] - 0.5 * np.abs(np.sin(film.state.angle[:, 1]))
    assert lowest.min() < -0.3  # it comes to the wall
    assert lowest.min() > -0.53  # and not through it
    stored = np.asarray(jax.vmap(lambda t, s: energy.total(scene, t, s))(film.time, film.state))
    assert stored.max() < stored[0] + 0.01 * 9.8


ROUGH = contacts.Coulomb(0.4, 0.3)


def weld_in_the_plane(place, velocity, angle, spin, restitution):
    """A plate of 1 kg with one of 5 kg welded to it inside, and one body of the same mass, moment and outline."""
    parts, apart = (inertia.planar_plate(1.0, (0.6, 0.4)), inertia.planar_plate(5.0, (0.2, 0.2))), 0.2
    off = 5 * apart / 6
    moment = sum(float(part.moment) for part in parts) + 5 / 6 * apart**2
    along = np.array([np.cos(angle), np.sin(angle)])
    x = place + np.outer([-off, apart - off], along)
    v = velocity + spin * np.outer([-off, apart - off], [-along[1], along[0]])
    floor = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=restitution, coulomb=ROUGH)
    corners = np.array([[-0.3, -0.2], [0.3, -0.2], [0.3, 0.2], [-0.3, 0.2]])
    touch = lambda *shapes: rigid.Solids(shapes, (floor,), restitution, coulomb=ROUGH, pairs=np.zeros((0, 2), int))  # noqa: E731
    one = rigid.PlanarInertia(jnp.asarray(6.0), jnp.asarray(moment))
    start = rigid.planar_bodies(one, [place], angle=[angle], velocity=[velocity], angular_velocity=[spin])
    whole = Scene(start, one, (forces.Gravity(),), (touch(rigid.PlanarShape.polygon(corners - [off, 0.0])),))
    two = rigid.PlanarInertia(jnp.asarray([1.0, 5.0]), jnp.asarray([float(part.moment) for part in parts]))
    start = rigid.planar_bodies(two, x, angle=[angle] * 2, velocity=v, angular_velocity=[spin] * 2)
    weld = rigid.Welds([(0, 1)], [[[apart, 0.0], [0.0, 0.0]]])
    plates = touch(rigid.PlanarShape.box((0.6, 0.4)), rigid.PlanarShape.box((0.2, 0.2)))
    return whole, Scene(start, two, (forces.Gravity(), weld), (plates,))


def weld_in_space(place, velocity, spin, restitution):
    """A box of 1 kg with one of 5 kg welded to it inside, and one body of the same mass, moments and hull."""
    parts, apart = (inertia.box(1.0, (0.6, 0.4, 0.3)), inertia.box(5.0, (0.2, 0.2, 0.2))), 0.2
    off = 5 * apart / 6
    tensor = sum(np.diag(np.asarray(part.principal)) for part in parts) + 5 / 6 * apart**2 * np.diag([0.0, 1.0, 1.0])
    arms = np.array([[-off, 0.0, 0.0], [apart - off, 0.0, 0.0]])
    floor = contacts.Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), restitution=restitution, coulomb=ROUGH)
    corners = np.stack(np.meshgrid([-0.3, 0.3], [-0.2, 0.2], [-0.15, 0.15]), -1).reshape(-1, 3)
    touch = lambda *shapes: rigid.Solids(shapes, (floor,), restitution, coulomb=ROUGH, pairs=np.zeros((0, 2), int))  # noqa: E731
    one = inertia.of_tensor(6.0, tensor)
    start = rigid.bodies(one, [place], velocity=[velocity], angular_velocity=[spin])
    whole = Scene(start, one, (forces.Gravity(up=2),), (touch(rigid.Shape.hull(corners - [off, 0.0, 0.0])),))
    two = inertia.Inertia(np.array([1.0, 5.0]), np.stack([part.principal for part in parts]))
    start = rigid.bodies(two, place + arms, velocity=velocity + np.cross(spin, arms), angular_velocity=[spin] * 2)
    weld = rigid.Welds([(0, 1)], [[[apart, 0.0, 0.0], [0.0, 0.0, 0.0]]])
    boxes = touch(rigid.Shape.box((0.6, 0.4, 0.3)), rigid.Shape.box((0.2, 0.2, 0.2)))
    return whole, Scene(start, two, (forces.Gravity(up=2), weld), (boxes,))


def compare_with_one_body(scenes, dt, steps):
    """How far the center of mass of two welded bodies goes from that of one [m], frame by frame."""
    whole, welded = (simulate(scene, methods.leapfrog, dt=dt, steps=steps, save_every=steps // 10) for scene in scenes)
    light, heavy = welded.position[:, 0], welded.position[:, 1]
    return np.linalg.norm((light + 5 * heavy) / 6 - whole.position[:, 0], axis=-1)


def test_bodies_welded_together_slide_to_rest_as_one_body_in_the_plane():
    scenes = weld_in_the_plane(np.array([0.0, 0.2]), np.array([1.5, 0.0]), 0.0, 0.0, 0.0)
    assert compare_with_one_body(scenes, 1 / 120, 120).max() < 1e-9


def test_bodies_welded_together_bounce_and_tumble_as_one_body_in_the_plane():
    scenes = weld_in_the_plane(np.array([0.0, 0.6]), np.array([1.5, 0.0]), 0.4, 2.0, 0.5)
    coarse, fine = (compare_with_one_body(scenes, dt, round(0.8 / dt)).max() for dt in (1 / 200, 1 / 400))
    assert fine < 2e-6
    assert coarse / fine > 3  # the way between hits is of second order


def test_bodies_welded_together_bounce_and_tumble_as_one_body_in_space():
    scenes = weld_in_space(np.array([0.0, 0.0, 0.6]), np.array([1.5, 0.3, 0.0]), np.array([1.0, 2.0, -0.5]), 0.5)
    assert compare_with_one_body(scenes, 1 / 400, 240).max() < 2e-5


def build_car(chassis, torque=0.0):
    """A car of plates whose wheels weigh a kilogram each, on a road."""
    body, wheel = inertia.planar_plate(chassis, (2.4, 0.5)), inertia.planar_disc(1.0, 0.3)
    bodies = rigid.PlanarInertia(
        jnp.stack([body.mass, wheel.mass, wheel.mass]), jnp.stack([body.moment, wheel.moment, wheel.moment])
    )
    points = [[[-0.8, -0.25], [0.0, 0.0]], [[0.8, -0.25], [0.0, 0.0]]]
    axles = rigid.Hinges([(0, 1), (0, 2)], points, motor=-60.0, torque=torque)
    road = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.0, coulomb=contacts.Coulomb(0.9, 0.9))
    shapes = [rigid.PlanarShape.box((2.4, 0.5)), rigid.PlanarShape.disc(0.3), rigid.PlanarShape.disc(0.3)]
    solids = rigid.Solids(shapes, (road,), coulomb=road.coulomb, pairs=np.zeros((0, 2), int))
    start = rigid.planar_bodies(bodies, [[0.0, 0.55], [-0.8, 0.3], [0.8, 0.3]])
    return Scene(start, bodies, (forces.Gravity(), axles), (solids,))


def test_light_wheels_carry_and_drive_a_car_a_thousand_times_as_heavy():
    for mass in (1.0, 30.0, 1000.0):
        film = simulate(build_car(mass, 0.4 * mass), methods.leapfrog, dt=1 / 60, steps=30, save_every=3)
        assert np.abs(film.position[:, 1:, 1] - 0.3).max() < 1e-4
        # what the motors turn: the car, and its wheels
        pace = 0.4 * mass / 0.3 / (mass + 2 + 2 * 0.5)
        np.testing.assert_allclose(film.state.momentum[-1, 0, 0] / mass, pace, rtol=1e-3)


def test_the_pace_of_a_car_can_be_differentiated_by_the_torque_of_its_motors():
    def pace(torque):
        film = simulate(build_car(30.0, torque), methods.leapfrog, dt=1 / 60, steps=30)
        return film.state.momentum[-1, 0, 0] / 30.0

    _, slope = jax.jvp(pace, (jnp.asarray(1.0),), (jnp.asarray(1.0),))
    np.testing.assert_allclose(slope, (pace(1.01) - pace(0.99)) / 0.02, rtol=1e-4)
    np.testing.assert_allclose(slope, 2 / 0.3 / 33.0 * 0.5, rtol=1e-3)


def test_joints_hold_solids_that_nothing_can_touch():
    plate = inertia.planar_plate(1.0, (0.2, 0.2))
    pin = rigid.Joints([(-1, 0)], [[[0.0, 0.0], [0.0, 0.5]]])
    solids = rigid.Solids(rigid.PlanarShape.box((0.2, 0.2)), pairs=np.zeros((0, 2), int))
    start = rigid.planar_bodies(plate, [[0.0, -0.5]])
    film = simulate(Scene(start, plate, (forces.Gravity(), pin), (solids,)), methods.leapfrog, dt=1 / 60, steps=10)
    np.testing.assert_allclose(film.position[-1, 0], [0.0, -0.5], atol=1e-12)
