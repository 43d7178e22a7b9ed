"""Bodies in contact: impacts add no energy, resting bodies do not move, friction sticks and slips, derivatives, bad input."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, RigidBodies, Scene, contacts, energy, forces, inertia, methods, rigid, simulate
from physjax.physics.rigid.impulses import Points, apply_contact_impulses
from physjax.physics.rigid.mobility import Mobility

SIZE = (0.4, 0.2, 0.3)
BOX, CORNERS = inertia.box(2.0, SIZE), rigid.ContactPoints.box(SIZE)
UP = (0.0, 1.0, 0.0)
TILT = (0.9, 0.3, 0.2, 0.1)


def floor(restitution=0.0, friction=None, **options):
    coulomb = None if friction is None else contacts.Coulomb(friction, friction)
    return contacts.Plane((0.0, 0.0, 0.0), UP, restitution=restitution, coulomb=coulomb, **options)


def dropped(surface, height=0.4, **start):
    state = rigid.bodies(BOX, (0.0, height, 0.0), TILT, **start)
    return Scene(state, BOX, (forces.Gravity(),), (rigid.SurfaceContact(CORNERS, surface),))


def compute_energy(scene, film):
    return np.asarray(jax.vmap(lambda t, s: energy.total(scene, t, s))(film.time, film.state))


# impacts


def test_no_impulses_at_any_points_add_energy():
    rng = np.random.default_rng(0)
    n, k = 1000, 4
    normal = rng.normal(size=(k, n, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    body = inertia.box(jnp.asarray(rng.uniform(0.1, 5, n)), jnp.asarray(rng.uniform(0.02, 1, (n, 3))))
    state = rigid.bodies(body, jnp.zeros((n, 3)), *(jnp.asarray(rng.normal(size=(n, m))) for m in (4, 3, 3)))
    arm = jnp.asarray(rng.normal(size=(k, n, 3)))
    omega = np.asarray(rigid.angular_velocity(state, body))
    velocity = np.asarray(state.momentum / body.mass[:, None]) + np.cross(omega, arm)
    mu = jnp.asarray(rng.uniform(0, 2, (k, n)))
    points = Points(arm, jnp.asarray(normal), jnp.asarray(velocity), (1.3 * mu, mu))
    active = jnp.asarray(rng.random((k, n)) < 0.7)
    after, push, _ = jax.jit(apply_contact_impulses)(
        points, active, state, Mobility.of(state, body), jnp.asarray(rng.uniform(0, 1, (k, n)))
    )
    change = after.kinetic_energy(body) / state.kinetic_energy(body) - 1
    assert change.max() <= 1e-12
    assert change.min() < -0.9  # much is lost
    assert (push >= 0).all()
    assert (push[~active] == 0).all()
    assert (jnp.max(push, axis=0) > 0).mean() > 0.5


@pytest.mark.slow
def test_hundreds_of_random_drops_never_gain_energy():
    rng = np.random.default_rng(1)
    n = 100
    size = rng.uniform(0.1, 0.6, (n, 3))
    body = inertia.box(jnp.ones(n), jnp.asarray(size))
    place = np.zeros((n, 3))
    place[:, 1] = np.linalg.norm(size, axis=-1) / 2 + 0.01
    start = rigid.bodies(body, place, *(k * rng.normal(size=(n, m)) for k, m in ((1, 4), (2, 3), (5, 3))))
    bounce, rough = rng.uniform(0, 1, n), rng.uniform(0, 1.5, n)

    def gain(lanes, dt, each):
        pick = lambda tree: jax.tree.map(lambda leaf: leaf[lanes], tree)  # noqa: E731
        ground = floor(jnp.asarray(bounce[lanes]), jnp.asarray(rough[lanes]))
        contact = rigid.SurfaceContact(rigid.ContactPoints.box(size[lanes]), ground)
        scene = Scene(pick(start), pick(body), (forces.Gravity(),), (contact,))
        film = simulate(scene, methods.rk4, dt=dt, steps=80 * each, save_every=each)
        assert film.ok.all()
        signed_distance = jax.vmap(lambda state: contact.clearance(0.0, state))(film.state)
        assert signed_distance.min() > -1e-5
        e = compute_energy(scene, film)
        assert (e[-1] / e[0]).mean() < 0.8
        return (e / e[0]).max(axis=0) - 1

    coarse = gain(np.arange(n), 5e-3, 1)
    assert coarse.max() <= 1e-6  # what rk4 makes of the free turns at this step, and so of order 4
    worst = np.argsort(coarse)[-25:]
    assert gain(worst, 2.5e-3, 2).max() <= coarse.max() / 2**3.7


@pytest.mark.slow
def test_a_smooth_box_keeps_its_energy_over_a_hundred_impacts():
    scene = dropped(floor(1.0), height=0.25, angular_velocity=(1.0, 2.0, 3.0))
    film = simulate(scene, methods.rk4, dt=1e-3, steps=16_000)
    impacts = np.sum(np.diff(film.state.momentum[:, 1]) > 0)  # gravity alone only takes from it
    assert impacts >= 100
    e = compute_energy(scene, film)
    assert np.abs(e / e[0] - 1).max() < 1e-6


@pytest.mark.slow
def test_a_box_dropped_tilted_comes_to_rest_on_a_face_and_then_does_not_move():
    scene = dropped(floor(0.0, 0.5))
    film = simulate(scene, methods.rk4, dt=1e-3, steps=36_000, save_every=4000)
    rest, turns = np.asarray(film.position)[1:], np.asarray(film.state.orientation)[1:]
    assert np.abs(float(rest[0, 1]) - np.asarray(SIZE) / 2).min() < 1e-6
    assert np.abs(rest - rest[0]).max() <= 1e-9
    assert np.abs(turns - turns[0]).max() <= 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.99, 1.2])
def test_friction_holds_a_box_on_a_slope_up_to_its_angle_and_not_beyond(share):
    mu = 0.3
    angle = math.atan(mu) * share
    up = np.array([math.sin(angle), math.cos(angle), 0.0])
    turn = (math.cos(angle / 2), 0.0, 0.0, -math.sin(angle / 2))
    slope = contacts.Plane((0.0, 0.0, 0.0), up, coulomb=contacts.Coulomb(mu, mu))
    start = rigid.bodies(BOX, SIZE[1] / 2 * up, turn)
    scene = Scene(start, BOX, (forces.Gravity(),), (rigid.SurfaceContact(CORNERS, slope),))
    film = simulate(scene, methods.verlet, dt=2e-3, steps=500, save_every=500)
    way = np.linalg.norm(film.position[-1] - film.position[0])
    pull = max(9.8 * (math.sin(angle) - mu * math.cos(angle)), 0.0)
    assert way == pytest.approx(pull / 2, rel=1e-6, abs=1e-12)


@pytest.mark.slow
def test_a_belt_takes_a_ball_along():
    ball = inertia.sphere(1.0, 0.1)
    belt = floor(0.0, 0.5, velocity=(2.0, 0.0, 0.0))
    scene = Scene(
        rigid.bodies(ball, (0, 0.1, 0)),
        ball,
        (forces.Gravity(),),
        (rigid.SurfaceContact(rigid.ContactPoints.sphere(0.1), belt),),
    )
    end = simulate(scene, methods.rk4, dt=0.01, steps=100, save_every=100).final_scene.state
    np.testing.assert_allclose(end.momentum, [2 * 2 / 7, 0, 0], atol=1e-9)
    np.testing.assert_allclose(rigid.angular_velocity(end, ball), [0, 0, (2 - 4 / 7) / 0.1], atol=1e-8)


# derivatives


@pytest.mark.slow
def test_gradients_through_an_impact_agree_with_differences():
    @jax.jit
    def outcome(numbers):
        surface = floor(numbers[0], numbers[1])
        spin, fall = numbers[2:5], jnp.stack([0.5, -1.0, 0.2]) * numbers[5]
        scene = dropped(surface, velocity=fall, angular_velocity=spin)
        film = simulate(scene, methods.rk4, dt=0.01, steps=16, save_every=16)
        x, q, p, spin = film.final_scene.state
        return x[0] + 2 * x[1] - p[2] + 10 * spin[0] + q[3]

    at, h = jnp.asarray([0.5, 0.3, 1.0, 2.0, 3.0, 1.0]), 1e-6
    differences = [(outcome(at + h * e) - outcome(at - h * e)) / (2 * h) for e in jnp.eye(6)]
    assert abs(differences[0]) > 1e-2  # there is an impact
    for derivative in (jax.jacfwd, jax.grad):
        np.testing.assert_allclose(jax.jit(derivative(outcome))(at), differences, rtol=1e-5, atol=1e-7)


# bad input


@pytest.mark.usefixtures("unannotated")
@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: rigid.ContactPoints(jnp.zeros(3)), "A ball is ContactPoints.sphere"),
        (lambda: rigid.ContactPoints.sphere(0.0), "numbers > 0"),
        (lambda: rigid.ContactPoints.capsule(0.1, 1.0, axis=3), "expected 0, 1 or 2"),
        (lambda: rigid.SurfaceContact(floor(), CORNERS), "expected a ContactPoints"),
        (lambda: rigid.SurfaceContact(CORNERS, 0.0), "expected a Surface"),
        (lambda: rigid.SurfaceContact(CORNERS, contacts.Plane((0, 0, 0), UP, friction=0.1)), "coulomb="),
        (lambda: dropped(floor(), height=0.1), "on the wrong side"),
        (
            lambda: Scene(
                Particles(jnp.zeros(3), jnp.zeros(3)), contacts=(rigid.SurfaceContact(CORNERS, floor()),)
            ),
            "expected RigidBodies",
        ),
        (lambda: Scene(dropped(floor()).state, BOX, contacts=(floor(),)), "rigid.SurfaceContact"),
        (
            lambda: Scene(
                RigidBodies(*dropped(floor()).state),
                BOX,
                contacts=(rigid.SurfaceContact(rigid.ContactPoints(jnp.zeros((4, 2, 3))), floor()),),
            ),
            r"expected a vector of shape \(n, 3\) for all lanes",
        ),
        (
            lambda: Scene(
                dropped(floor()).state, BOX.about((0.0, 0.1, 0.0)), contacts=(rigid.SurfaceContact(CORNERS, floor()),)
            ),
            "pivot",
        ),
    ],
)  # fmt: skip
def test_bad_input_is_refused_in_plain_words(build, words):
    with pytest.raises((ValueError, TypeError), match=words):
        build()
