"""Shots from what moves: Galileo's shift, the roots of the closed form, derivatives, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from physjax import Particles, Scene, aim_at, contacts, forces, methods, simulate

G, SPEED = 9.8, 30.0
DRIFT = np.array([12.0, -5.0])
TARGET = np.array([40.0, -6.0])


def gun(*more, lanes=(), **parts):
    start = jnp.zeros((*lanes, 2))
    return Scene(Particles(start, start), 0.145, (forces.Gravity(G), *more), **parts)


def solve_flight_times(target, drift):
    """The first and the last root T > 0 of |target - ½aT² - uT|² = (speed T)²."""
    parts = [np.poly1d([-a / 2, -u, d]) for a, u, d in zip((0.0, -G), drift, target, strict=True)]
    roots = (parts[0] * parts[0] + parts[1] * parts[1] - np.poly1d([SPEED**2, 0, 0])).roots
    times = np.sort(roots[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)].real)
    return (times[0], times[-1]) if len(times) else (np.nan, np.nan)


def test_every_target_in_reach_is_hit_at_the_roots_of_the_closed_form():
    random = np.random.default_rng(0)
    target = np.stack([random.uniform(-60, 60, 500), random.uniform(-20, 15, 500)], axis=-1)
    drift = random.uniform(-15, 15, (500, 2))
    aimed = aim_at(gun(), target, speed=SPEED, launcher_velocity=drift)
    truth = np.array([solve_flight_times(*pair) for pair in zip(target, drift, strict=True)])
    reached = np.isfinite(truth[:, 0])
    assert 400 < reached.sum() < 500
    for shot, time in ((aimed.low, truth[:, 0]), (aimed.high, truth[:, 1])):
        np.testing.assert_array_equal(shot.ok, reached)
        np.testing.assert_allclose(shot.time[reached], time[reached], rtol=1e-9)
        fired = np.asarray(shot.velocity) - drift
        np.testing.assert_allclose(np.linalg.norm(fired, axis=-1)[reached], SPEED, rtol=1e-12)
        np.testing.assert_allclose(shot.angle, np.arctan2(fired[:, 1], fired[:, 0]), atol=1e-12)


def test_a_moving_launcher_is_one_at_rest_whose_target_and_air_move_the_other_way():
    drag = {"area": 4.3e-3, "coefficient": 0.35}
    aimed = aim_at(gun(forces.QuadraticDrag(**drag)), TARGET, speed=SPEED, launcher_velocity=DRIFT)
    there = gun(forces.QuadraticDrag(**drag, wind=-DRIFT))
    for name in ("low", "high"):
        shot = getattr(aimed, name)
        assert shot.ok
        still = getattr(aim_at(there, TARGET - DRIFT * shot.time, speed=SPEED), name)
        np.testing.assert_allclose(shot.velocity, still.velocity + DRIFT, atol=1e-8)
        np.testing.assert_allclose(shot.time, still.time, rtol=1e-9)
        np.testing.assert_allclose(shot.angle, still.angle, atol=1e-9)


def test_what_it_returns_is_simulated_as_it_is(precision):
    aimed = aim_at(gun(), TARGET, speed=SPEED, launcher_velocity=DRIFT)
    shot = aimed.low
    np.testing.assert_array_equal(aimed.scene(shot).state.velocity, shot.velocity)
    end = simulate(aimed.scene(shot), methods.rk4, dt=shot.time / 100, steps=100).position[-1]
    for place in (end, aimed.flight(shot).position[-1]):
        np.testing.assert_allclose(place, TARGET, atol=2e3 * precision.eps * 40)


def test_the_least_speed_is_that_of_the_closed_form():
    aimed = aim_at(gun(), TARGET, launcher_velocity=DRIFT)
    needed = lambda time: np.linalg.norm(TARGET / time + [0.0, G * time / 2] - DRIFT)  # noqa: E731
    truth = minimize_scalar(needed, bounds=(0.3, 10.0), method="bounded", options={"xatol": 1e-12})
    assert aimed.low.ok
    np.testing.assert_allclose(aimed.low.speed, truth.fun, rtol=1e-9)


def test_derivatives_by_the_velocity_of_the_launcher_are_central_differences():
    time = lambda drift: aim_at(gun(), TARGET, speed=SPEED, launcher_velocity=drift).low.time  # noqa: E731
    truth = [
        (solve_flight_times(TARGET, DRIFT + h)[0] - solve_flight_times(TARGET, DRIFT - h)[0]) / 2e-4
        for h in 1e-4 * np.eye(2)
    ]
    np.testing.assert_allclose(jax.grad(time)(jnp.asarray(DRIFT)), truth, rtol=1e-6)


def test_lanes_and_vmap_are_as_each_alone():
    drifts = jnp.asarray([-DRIFT, DRIFT])
    aim = lambda drift: aim_at(gun(), TARGET, speed=SPEED, launcher_velocity=drift, steps=20).low.velocity  # noqa: E731
    targets = np.broadcast_to(TARGET, (2, 2))
    lanes = aim_at(gun(), targets, speed=SPEED, launcher_velocity=drifts, steps=20).low.velocity
    np.testing.assert_allclose(jax.vmap(aim)(drifts), lanes, atol=1e-9)
    np.testing.assert_allclose(aim(drifts[1]), lanes[1], atol=1e-9)


@pytest.mark.slow
def test_by_a_bounce_it_hits_too():
    floor = contacts.Plane((0.0, -2.0), (0.0, 1.0), restitution=0.8)
    aimed = aim_at(gun(contacts=(floor,)), (40.0, 3.0), speed=SPEED, bounces=1, launcher_velocity=(-10.0, 4.0))
    assert aimed.low.ok
    np.testing.assert_allclose(np.linalg.norm(aimed.low.velocity - np.array([-10.0, 4.0])), SPEED, rtol=1e-9)
    path = aimed.flight(aimed.low).velocity[:, 1]
    assert np.sum(np.diff(path) > 0) == 1  # up only at the bounce


@pytest.mark.parametrize("velocity", [(1.0, 2.0, 3.0), 5.0, np.ones((4, 2)), (np.nan, 0.0)])
def test_a_velocity_of_the_launcher_that_does_not_fit_is_refused(velocity):
    with pytest.raises(ValueError, match=r"launcher_velocity \[m/s\]: got"):
        aim_at(gun(), TARGET, speed=SPEED, launcher_velocity=velocity)
