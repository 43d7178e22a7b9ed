"""Shots at what moves: the roots of the closed form, with linear drag too, derivatives, bounces and pictures."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from scipy.optimize import brentq

from physjax import Particles, Scene, aim_at, contacts, forces

G, SPEED = 9.8, 30.0


def gun(dim, *more, **parts):
    return Scene(Particles(jnp.zeros(dim), jnp.zeros(dim)), 1.0, (forces.Gravity(G), *more), **parts)


def solve_flight_times(target, moves):
    """The first and the last root T > 0 of |target + uT - ½aT²|² = (speed T)²."""
    parts = [np.poly1d([-a / 2, u, d]) for a, u, d in zip((0.0, -G), moves, target, strict=True)]
    roots = (parts[0] * parts[0] + parts[1] * parts[1] - np.poly1d([SPEED**2, 0, 0])).roots
    times = np.sort(roots[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)].real)
    return (times[0], times[-1]) if len(times) else (np.nan, np.nan)


def test_every_target_in_reach_is_met_at_the_roots_of_the_closed_form():
    random = np.random.default_rng(1)
    target = np.stack([random.uniform(-60, 60, 300), random.uniform(-20, 15, 300)], axis=-1)
    moves = random.uniform(-15, 15, (300, 2))
    aimed = aim_at(gun(2), target, speed=SPEED, target_velocity=moves)
    truth = np.array([solve_flight_times(*pair) for pair in zip(target, moves, strict=True)])
    reached = np.isfinite(truth[:, 0])
    assert 200 < reached.sum() < 300
    for shot, time in ((aimed.low, truth[:, 0]), (aimed.high, truth[:, 1])):
        np.testing.assert_array_equal(shot.ok, reached)
        np.testing.assert_allclose(shot.time[reached], time[reached], rtol=1e-9)
        met = target + moves * np.asarray(shot.time)[:, None]
        np.testing.assert_allclose(aimed.meeting_place(shot), met, rtol=1e-12)
    np.testing.assert_array_equal(aimed.target, target)


def test_in_linear_drag_a_walker_is_met_as_the_closed_form_says():
    c, start, moves = 0.4, np.array([20.0, 0.0, 10.0]), np.array([1.5, 0.0, -3.0])

    def find_launch(time, moves):
        place = (start + moves * time) * c / (1 - np.exp(-c * time))
        return place + np.array([0.0, G * time / (1 - np.exp(-c * time)) - G / c, 0.0])

    def find_time(moves):
        return brentq(lambda time: np.linalg.norm(find_launch(time, moves)) - SPEED, 0.3, 1.8, xtol=1e-14)

    def aim(moves):
        shot = aim_at(gun(3, forces.StokesDrag(c)), start, speed=SPEED, target_velocity=moves).low
        return shot.time, shot

    (_, shot), slope = jax.value_and_grad(aim, has_aux=True)(jnp.asarray(moves))
    time = find_time(moves)
    assert shot.ok
    np.testing.assert_allclose(shot.time, time, rtol=1e-8)
    np.testing.assert_allclose(shot.velocity, find_launch(time, moves), rtol=1e-7)
    np.testing.assert_allclose(shot.angle, np.arcsin(find_launch(time, moves)[1] / SPEED), rtol=1e-7)
    right = [(find_time(moves + h) - find_time(moves - h)) / 2e-4 for h in 1e-4 * np.eye(3)]
    np.testing.assert_allclose(slope, right, rtol=1e-6)


def test_many_at_once_and_under_vmap_are_the_same():
    moves = jnp.array([[12.0, -5.0], [-3.0, 4.0]])
    aim = lambda moves: aim_at(gun(2), (40.0, -6.0), speed=SPEED, target_velocity=moves, steps=20).low.velocity  # noqa: E731
    lanes = aim_at(gun(2), [(40.0, -6.0)] * 2, speed=SPEED, target_velocity=moves, steps=20).low.velocity
    np.testing.assert_allclose(jax.vmap(aim)(moves), lanes, atol=1e-9)


@pytest.mark.slow
def test_by_a_bounce_it_meets_a_target_too():
    floor = contacts.Plane((0.0, -2.0), (0.0, 1.0), restitution=0.8)
    aimed = aim_at(gun(2, contacts=(floor,)), (30.0, 3.0), speed=SPEED, bounces=1, target_velocity=(4.0, 1.0))
    assert aimed.low.ok
    end = aimed.flight(aimed.low).position[-1]
    np.testing.assert_allclose(end, [30.0 + 4.0 * aimed.low.time, 3.0 + aimed.low.time], atol=1e-6)


def test_a_velocity_of_the_target_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"target_velocity \[m/s\]: got shape \(3,\)"):
        aim_at(gun(2), (40.0, -6.0), speed=SPEED, target_velocity=(1.0, 2.0, 3.0))


class Swing(eqx.Module):
    """A target that swings and climbs."""

    width: Array

    def __call__(self, t):
        return jnp.stack([40.0 + self.width * jnp.sin(2.0 * t), -6.0 + 0.5 * t**2])


@pytest.mark.parametrize("launcher", [None, (3.0, 1.0)])
def test_a_target_on_a_path_is_met_where_it_is_then_and_the_answer_has_gradients(launcher):
    def aim(width):
        return aim_at(gun(2), Swing(width), speed=SPEED, launcher_velocity=launcher, steps=20)

    width, h = jnp.asarray(4.0), 1e-4
    aimed = aim(width)
    np.testing.assert_allclose(aimed.flight(aimed.low).position[-1], Swing(width)(aimed.low.time), rtol=0, atol=1e-9)
    angle = lambda width: aim(width).low.angle  # noqa: E731
    difference = (angle(width + h) - angle(width - h)) / (2 * h)
    np.testing.assert_allclose(jax.grad(angle)(width), difference, rtol=1e-6)
    np.testing.assert_allclose(jax.jvp(angle, (width,), (1.0,))[1], difference, rtol=1e-6)


def test_a_path_to_more_than_one_place_is_refused():
    with pytest.raises(ValueError, match="target: got a path to places of shape"):
        aim_at(gun(2), lambda t: jnp.zeros((3, 2)) + t, speed=SPEED)
