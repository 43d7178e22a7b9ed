"""Balls that hit each other: what they exchange, what is kept, the spin that friction gives, bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, contacts, energy, forces, inertia, methods, rigid, simulate

BALL = inertia.sphere(0.2, 0.03)


def billiards(place, velocity, omega=(0.0, 0.0, 0.0), acting=(), more=(), **balls):
    start = rigid.bodies(BALL, place, velocity=velocity, angular_velocity=omega)
    return Scene(start, BALL, acting, (rigid.Balls(0.03, **balls), *more))


def test_a_row_of_balls_hands_the_push_to_the_last():
    row = np.zeros((5, 3))
    row[:, 0] = [-0.3, 0.0, 0.06, 0.12, 0.18]
    velocity = np.zeros((5, 3))
    velocity[0, 0] = 1.0
    end = simulate(billiards(row, velocity), methods.rk4, dt=1e-3, steps=400, save_every=400)
    np.testing.assert_allclose(end.velocity[-1, :, 0], [0, 0, 0, 0, 1], atol=1e-12)


def test_a_break_keeps_momentum_and_with_smooth_balls_energy():
    rng = np.random.default_rng(0)
    place = np.stack(np.meshgrid(np.arange(3) * 0.07, np.arange(3) * 0.07, [0.0]), axis=-1).reshape(-1, 3)
    velocity, omega = rng.normal(size=(2, 9, 3))
    for options, keeps in (({}, True), (dict(restitution=0.8, coulomb=contacts.Coulomb(0.3, 0.3)), False)):
        scene = billiards(place, velocity - 10 * (place - place.mean(axis=0)), 20 * omega, **options)
        film = simulate(scene, methods.verlet, dt=1e-3, steps=100, save_every=1)
        e = jax.vmap(lambda t, s, scene=scene: energy.total(scene, t, s))(film.time, film.state)
        assert np.diff(e).max() <= 1e-13 * e[0]
        assert (e[-1] > 0.999999999 * e[0]) == keeps
        p = np.sum(film.state.momentum, axis=1)
        np.testing.assert_allclose(p, np.broadcast_to(p[0], p.shape), rtol=0, atol=1e-13)


def test_friction_between_balls_stops_the_slip_it_can():
    place, velocity = np.array([[0.0, 0, 0], [0.0601, 0, 0]]), np.array([[1.0, 0.01, 0], [0, 0, 0]])
    scene = billiards(place, velocity, coulomb=contacts.Coulomb(0.5, 0.5))
    end = simulate(scene, methods.rk4, dt=1e-3, steps=1).final_scene.state
    line = np.asarray(end.position[1] - end.position[0])
    normal, omega = line / np.linalg.norm(line), np.asarray(rigid.angular_velocity(end, BALL))
    slip = np.asarray(end.momentum[1] - end.momentum[0]) / 0.2 - np.cross(omega.sum(axis=0), 0.03 * normal)
    np.testing.assert_allclose(slip - normal * np.sum(slip * normal), 0, atol=1e-6)
    assert abs(float(end.momentum[1, 1])) > 1e-4


def test_balls_hit_each_other_and_the_floor():
    floor = contacts.Plane((0, 0, 0), (0, 1, 0), restitution=0.5)
    place = np.array([[0.0, 0.2, 0], [0.001, 0.3, 0], [0.0, 0.4, 0.001]])
    more = (rigid.SurfaceContact(rigid.ContactPoints.sphere(0.03), floor),)
    pile = billiards(place, (0.0, 0, 0), acting=(forces.Gravity(),), more=more, restitution=0.5)
    film = simulate(pile, methods.rk4, dt=2e-3, steps=1000, save_every=50)
    assert film.ok.all()
    assert film.position[-1, :, 1].min() > 0.03 - 1e-6
    assert np.asarray(pile.contacts[0].signed_distance(0.0, film.position[-1])).min() > -1e-6


@pytest.mark.usefixtures("unannotated")
@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: rigid.Balls(-1.0), "numbers > 0"),
        (lambda: rigid.Balls(1.0, 1.5), "numbers from 0 to 1"),
        (lambda: billiards(np.zeros((2, 3)), (0, 0, 0)), "on the wrong side"),
        (lambda: billiards(np.zeros((1, 3)), (0, 0, 0)), "2 to 64 balls"),
        (lambda: Scene(Particles(jnp.zeros((2, 3)), jnp.zeros((2, 3))), contacts=(rigid.Balls(0.1),)), "expected RigidBodies"),
        (
            lambda: Scene(
                rigid.bodies(inertia.box(1.0, (1, 2, 3)), np.eye(3)), inertia.box(1.0, (1, 2, 3)), (), (rigid.Balls(0.1),)
            ),
            "inertia.sphere",
        ),
    ],
)  # fmt: skip
def test_bad_input_is_refused_in_plain_words(build, words):
    with pytest.raises((ValueError, TypeError), match=words):
        build()
