"""Solids on surfaces that turn or are driven: what sticks goes where the surface goes, at its velocity."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Scene, contacts, forces, inertia, methods, rigid, simulate

ROUGH = contacts.Coulomb(0.7, 0.6)
UP, SIZE = (0.0, 1.0), (0.2, 0.1)
STEPS, DT = 40, 1 / 60
ALONG, TILT = (0.03, 0.05), 0.2


class Swing(eqx.Module):
    """A sin(ω t): an angle, or how far along a direction."""

    amplitude: jax.Array
    rate: float
    direction: tuple[float, ...] | None = None

    def __call__(self, t):
        swing = self.amplitude * jnp.sin(self.rate * t)
        return swing if self.direction is None else swing * jnp.array(self.direction, jnp.asarray(t).dtype)


def take_end(scene, steps):
    run = simulate(scene, methods.verlet, dt=DT, steps=steps, save_every=steps)
    return jax.tree.map(lambda part: part[-1], run.state)


def run_pile(surface, place, velocity=(0.0, 0.0), omega=0.0, steps=STEPS):
    crate = inertia.planar_plate(1.0, SIZE)
    solids = rigid.Solids(rigid.PlanarShape.box(SIZE), (surface,), coulomb=ROUGH)
    pile = rigid.planar_bodies(crate, place, velocity=velocity, angular_velocity=omega)
    scene = Scene(pile, crate, (forces.Gravity(),), contacts=(solids,))
    return take_end(scene, steps)


def shake(amplitude, rest):
    """The state of a pile after a while on a table that is shaken, tilted and lifted, given where it stands on it."""
    moves = contacts.Motion(Swing(amplitude, 8.0, ALONG), Swing(amplitude * TILT, 3.0))
    floor = contacts.Plane((0.0, 0.0), UP, restitution=0.5, coulomb=ROUGH, motion=moves)
    # all start with the table, which passes through its place at rest
    omega = 3.0 * TILT * amplitude
    along = np.broadcast_to(8.0 * np.array(ALONG), rest.shape)
    velocity = amplitude * along + omega * np.stack([-rest[..., 1], rest[..., 0]], axis=-1)
    return run_pile(floor, rest, velocity, omega * jnp.ones(rest.shape[:-1]))


def follow_table(amplitude, rest, t):
    angle = amplitude * TILT * np.sin(3.0 * t)
    c, s = np.cos(angle), np.sin(angle)
    return rest @ np.array([[c, s], [-s, c]]) + amplitude * np.sin(8.0 * t) * np.array(ALONG)


def test_piles_go_along_with_a_table_that_is_shaken_tilted_and_lifted():
    rest = np.array([[[0.1, 0.05], [0.1, 0.15]], [[-0.4, 0.05], [-0.4, 0.15]]])
    t, h = STEPS * DT, 1e-5
    state = shake(1.0, rest)
    np.testing.assert_allclose(state.position, follow_table(1.0, rest, t), atol=2e-4)
    speed = (follow_table(1.0, rest, t + h) - follow_table(1.0, rest, t - h)) / (2 * h)
    np.testing.assert_allclose(state.momentum, speed, atol=2e-3)
    np.testing.assert_allclose(state.angle, TILT * np.sin(3.0 * t), atol=2e-4)


def test_where_a_shaken_table_takes_a_box_has_its_derivative():
    rest, h = np.array([[0.1, 0.05]]), 1e-5
    one = jnp.ones(())
    _, slope = jax.jit(lambda a: jax.jvp(lambda a: shake(a, rest).position, (a,), (one,)))(one)
    right = (follow_table(1 + h, rest, STEPS * DT) - follow_table(1 - h, rest, STEPS * DT)) / (2 * h)
    np.testing.assert_allclose(slope, right, atol=5e-4)


def test_a_box_rides_on_a_drum_however_fast_it_turns():
    def ride(rate):
        drum = contacts.Sphere((0.0, -1.0), 1.0, restitution=0.0, coulomb=ROUGH, angular_velocity=rate)
        velocity = jnp.stack([-rate, jnp.zeros_like(rate)])[None]
        return run_pile(drum, [[0.0, 0.05]], velocity, rate[None], steps=60).position[0]

    rates = np.array([0.3, -0.2])
    way = np.asarray(jax.vmap(ride)(jnp.asarray(rates))) - [0.0, -1.0]
    np.testing.assert_allclose(np.hypot(*way.T), 1.05, atol=2e-3)
    np.testing.assert_allclose(np.arctan2(-way[:, 0], way[:, 1]), rates, atol=2e-3)


def test_a_brick_goes_round_with_a_turntable():
    size, rate = (0.2, 0.1, 0.2), 1.5
    table = contacts.Plane(
        np.zeros(3), (0.0, 1.0, 0.0), restitution=0.0, coulomb=ROUGH, angular_velocity=(0.0, rate, 0.0)
    )
    brick = inertia.box(1.0, size)
    bricks = rigid.bodies(brick, [[1.0, 0.05, 0.0]], velocity=[[0.0, 0.0, -rate]], angular_velocity=[[0.0, rate, 0.0]])
    solids = rigid.Solids(rigid.Shape.box(size), (table,))
    state = take_end(Scene(bricks, brick, (forces.Gravity(),), contacts=(solids,)), STEPS)
    angle = rate * STEPS * DT
    np.testing.assert_allclose(state.position[0], [np.cos(angle), 0.05, -np.sin(angle)], atol=5e-5)
    np.testing.assert_allclose(rigid.angular_velocity(state, brick)[0], [0.0, rate, 0.0], atol=2e-4)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_surface_led_in_a_circle_turns_as_one_with_an_angular_velocity(dim):
    place, axis = jnp.linspace(-1.0, 1.0, 4 * dim).reshape(4, dim), (0.0, 0.0, 2.0)
    rate = -1.5 if dim == 2 else (0.0, 0.0, -1.5)
    turns = contacts.Sphere(np.zeros(dim), 1.0, angular_velocity=rate)
    moves = contacts.Motion(angle=lambda t: -1.5 * t, axis=None if dim == 2 else axis)
    led = contacts.Sphere(np.zeros(dim), 1.0, motion=moves)
    for ask in ("spin_at", "velocity_at"):
        np.testing.assert_allclose(getattr(led, ask)(0.3, place), getattr(turns, ask)(0.3, place), atol=1e-12)
