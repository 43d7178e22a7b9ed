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
