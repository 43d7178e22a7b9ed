"""Crowds of particles in contact: restitution and momentum of a hit, energy of a gas, and a heap at rest in a box."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, contacts, forces, methods, simulate
from physjax.physics.forces import soft_spheres


def collide(speed, restitution):
    """The velocities along x after a hit of 1 kg at a speed with 3 kg that come at 1 m/s."""
    velocity = jnp.array([[1.0, 0.0], [0.0, 0.0]]) * speed + jnp.array([[0.0, 0.0], [-1.0, 0.0]])
    state = Particles(jnp.array([[0.0, 0.0], [1.02, 0.0]]), velocity)
    crowd = forces.SoftSpheres(radius=np.array([0.6, 0.4]), stiffness=1e4, restitution=restitution)
    run = simulate(Scene(state, np.array([1.0, 3.0]), (crowd,)), methods.rk4, dt=1e-4, steps=500, save_every=500)
    return run.velocity[-1, :, 0]


def test_a_hit_has_its_restitution_and_keeps_momentum():
    restitution = jnp.array([0.9, 0.5, 0.1])
    after = jax.vmap(lambda k: collide(2.0, k))(restitution)
    np.testing.assert_allclose(after[:, 1] - after[:, 0], 3.0 * restitution, atol=2e-2)
    np.testing.assert_allclose(after[:, 0] + 3.0 * after[:, 1], -1.0, atol=1e-12)


def test_an_elastic_hit_has_its_derivative():
    after, slope = jax.jvp(lambda v: collide(v, None), (2.0,), (1.0,))
    np.testing.assert_allclose(after, [-2.5, 0.5], atol=1e-5)
    np.testing.assert_allclose(slope, [-0.5, 0.5], atol=2e-3)


@pytest.fixture
def crowd():
    random = np.random.default_rng(5)
    x, v = random.uniform(0, 4, (2, 40, 3)), random.normal(size=(2, 40, 3))
    return Particles(jnp.asarray(x), jnp.asarray(v)), random.uniform(0.3, 0.6, 40), random.uniform(1, 2, 40)


def sum_by_hand(state, radius, mass, stiffness, restitution):
    x, v = np.asarray(state.position), np.asarray(state.velocity)
    way, speed = x[:, None] - x[:, :, None], v[:, :, None] - v[:, None]
    distance = np.linalg.norm(way, axis=-1) + 1e9 * np.eye(x.shape[1])
    normal = way / distance[..., None]
    depth, heavy = radius[:, None] + radius - distance, mass[:, None] * mass / (mass[:, None] + mass)
    ratio = -np.log(restitution) / np.hypot(np.pi, np.log(restitution))
    push = stiffness * depth + 2 * ratio * np.sqrt(stiffness * heavy) * np.sum(normal * speed, axis=-1)
    return -np.sum(np.where(depth > 0, push, 0.0)[..., None] * normal, axis=2)


def test_forces_of_a_crowd_are_those_of_its_pairs_alone_in_tiles_and_in_a_batch(crowd, monkeypatch):
    state, radius, mass = crowd
    force = forces.SoftSpheres(radius, 50.0, 0.4)
    right = sum_by_hand(state, radius, mass, 50.0, 0.4)
    push = lambda state: force(0.0, state, jnp.asarray(mass))  # noqa: E731
    np.testing.assert_allclose(push(state), right, atol=1e-10)
    np.testing.assert_allclose(jax.vmap(push)(state), right, atol=1e-10)
    np.testing.assert_allclose(push(jax.tree.map(lambda part: part[0], state)), right[0], atol=1e-10)
    monkeypatch.setattr(soft_spheres, "choose_tile_sources", lambda bodies: 16)
    np.testing.assert_allclose(push(state), right, atol=1e-10)
    elastic = forces.SoftSpheres(radius, 50.0)
    energy = lambda x: jnp.sum(elastic.potential(0.0, Particles(x, state.velocity), jnp.asarray(mass)))  # noqa: E731
    np.testing.assert_allclose(-jax.grad(energy)(state.position), elastic(0.0, state, jnp.asarray(mass)), atol=1e-10)


def test_a_gas_of_discs_keeps_its_energy_in_a_room():
    side = np.arange(8) + 0.5
    x = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    v = np.random.default_rng(2).normal(size=x.shape)
    room = contacts.Room((0.3, 0.3), (7.7, 7.7), restitution=1.0)
    scene = Scene(Particles(jnp.asarray(x), jnp.asarray(v)), 1.0, (forces.SoftSpheres(0.3, 2e4),), (room,))
    run = simulate(scene, methods.verlet, dt=5e-4, steps=1000, save_every=500)
    energy = 0.5 * np.sum(np.asarray(run.velocity) ** 2, axis=(-2, -1))
    energy = energy + np.sum(jax.vmap(lambda s: scene.forces[0].potential(0.0, s, jnp.ones(64)))(run.state), axis=-1)
    np.testing.assert_allclose(energy, energy[0], rtol=5e-3)
    # they have met: the velocities are others
    assert np.abs(np.abs(run.velocity[-1]) - np.abs(v)).max() > 0.5


def test_two_hundred_discs_come_to_rest_in_a_box():
    r, k, g, width = 0.1, 2e4, 9.8, 4.0
    x = np.stack(np.meshgrid(0.13 + 0.25 * np.arange(16), 0.2 + 0.25 * np.arange(13)), axis=-1).reshape(-1, 2)[:200]
    x = jnp.asarray(x + np.random.default_rng(1).uniform(-0.02, 0.02, x.shape), jnp.float32)
    box = contacts.Room((r, r), (width - r, 10.0), restitution=0.0)
    crowd = forces.SoftSpheres(r, k, 0.3)
    scene = Scene(Particles(x, jnp.zeros_like(x)), 1.0, (forces.Gravity(g), crowd), (box,))
    run = simulate(scene, methods.semi_implicit_euler, dt=1e-3, steps=3000, save_every=3000)
    assert run.ok.all()
    place, velocity = np.asarray(run.position[-1], float), np.asarray(run.velocity[-1], float)
    assert (place >= r - 1e-5).all()
    assert (place[:, 0] <= width - r + 1e-5).all()
    # without friction one or the other still slides off the top, but the crowd has come to rest
    assert np.mean(np.sum(velocity**2, axis=-1)) < 0.01 * 2 * g * r
    # packed no closer than hexagons, and about as close as discs fall
    filled = 200 * np.pi * r**2 / (width * 2 * place[:, 1].mean())
    assert 0.78 < filled < 0.907
    # the deepest overlap is some times that under the mean weight on a disc at the bottom
    apart = np.linalg.norm(place[:, None] - place[None], axis=-1) + 10 * np.eye(200)
    assert 0 < 2 * r - apart.min() < 4 * (200 * g * 2 * r / width) / k
