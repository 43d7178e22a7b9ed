"""Surfaces that turn within themselves: turntables and drums, for particles and bodies, against their equations of motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from physjax import Particles, Scene, contacts, forces, inertia, methods, rigid, simulate
from physjax.physics.contacts.resting import Reaction
from physjax.physics.contacts.surfaces import Surfaces

G, OMEGA = 9.8, 2.0
AXIS = np.array([0.0, OMEGA, 0.0])
RUN = {"rtol": 1e-12, "atol": 1e-12, "method": "DOP853"}


def turntable(friction, omega=AXIS):
    rough = contacts.Coulomb(friction, friction)
    return contacts.Plane((0.0,) * 3, (0.0, 1.0, 0.0), restitution=0.0, coulomb=rough, angular_velocity=omega)


def on_table(place, velocity, friction, omega=AXIS):
    start = Particles(jnp.asarray(place), jnp.asarray(velocity))
    return Scene(start, 1.0, (forces.Gravity(G),), (turntable(friction, omega),))


def end_of(scene, duration, steps):
    return simulate(scene, methods.rk4, dt=duration / steps, steps=steps, save_every=steps).position[-1]


def test_a_ball_that_rolls_on_a_turntable_goes_round_at_two_sevenths_of_its_rate():
    """S. Earnshaw 1844: dv/dt = 2/7 Ω × v, a circle wherever and however fast it starts."""
    radius, rate = 0.1, 2 * OMEGA / 7
    ball, hull = inertia.sphere(1.0, radius), rigid.ContactPoints.sphere(radius)
    place = np.array([[0.5, radius, 0.0], [-0.2, radius, 0.7]])
    velocity = np.array([[0.0, 0.0, 0.3], [0.4, 0.0, -0.1]])
    spin = np.cross([0.0, 1.0, 0.0], velocity - np.cross(AXIS, place)) / radius
    contact = rigid.SurfaceContact(hull, turntable(0.9))

    state = rigid.bodies(ball, place, velocity=velocity, angular_velocity=spin)
    dt = jnp.array([0.02, 0.01])  # a batch, in which each ball has a step of its own
    scene = Scene(state, ball, (forces.Gravity(G),), (contact,))
    found = simulate(scene, methods.rk4, dt=dt, steps=100, save_every=100).position[-1]
    turn = rate * 100 * np.asarray(dt)[:, None]
    across = np.cross([0.0, 1.0, 0.0], velocity)
    right = place + (np.sin(turn) * velocity + (1 - np.cos(turn)) * across) / rate
    assert (np.abs(found - right).max(axis=-1) < 0.4 * dt**2).all()


def test_what_sticks_to_a_turntable_turns_with_it_while_friction_suffices():
    """The border is Ω²r = μg, exactly: what is further out slides off."""
    border = 0.5 * G / OMEGA**2
    radius = jnp.array([0.5, 0.999 * border, 1.001 * border])
    place = np.asarray(radius)[:, None] * np.eye(3)[:1]
    ends = end_of(on_table(place, np.cross(AXIS, place), 0.5), 1.5, 150)
    right = np.asarray(radius)[:, None] * np.array([np.cos(3.0), 0.0, -np.sin(3.0)])
    np.testing.assert_allclose(ends[:2], right[:2], atol=1e-7)
    assert jnp.linalg.norm(ends[2]) > radius[2] + 1e-3


def slide_in_truth(numbers):
    """A block on a turntable that slips from the start to the end, by SciPy."""
    x, friction, omega = numbers

    def rate(_, s):
        slip = s[2:] - omega * np.array([s[1], -s[0]])
        return [*s[2:], *(-friction * G * slip / np.hypot(*slip))]

    s = solve_ivp(rate, (0.0, 0.4), [x, 0.2, 0.0, 0.0], **RUN).y[:, -1]
    return np.array([s[0], 0.0, s[1]])


def test_a_block_slips_on_a_turntable_as_its_equation_of_motion_says():
    numbers = np.array([[1.0, 0.1, 3.0], [0.6, 0.2, -5.0]])

    def slide(numbers):
        x, friction, omega = numbers
        place = jnp.stack([x, 0.0 * x, 0.0 * x + 0.2])
        return end_of(on_table(place, jnp.zeros(3), friction, omega * jnp.eye(3)[1]), 0.4, 20)

    right = np.array([slide_in_truth(one) for one in numbers])
    np.testing.assert_allclose(jax.vmap(slide)(jnp.asarray(numbers)), right, rtol=0, atol=1e-8)


def lift_by_drum(friction):
    """How far a drum has carried up what lay in it, in half a second."""
    rough = contacts.Coulomb(friction, friction)
    drum = contacts.Sphere((1.0, 2.0), 2.0, inside=True, restitution=0.0, coulomb=rough, angular_velocity=5.0)
    start = Particles(jnp.broadcast_to(jnp.array([1.0, 0.0]), (*friction.shape, 2)), jnp.zeros((*friction.shape, 2)))
    return end_of(Scene(start, 1.0, (forces.Gravity(G),), (drum,)), 0.5, 40)


def lift_in_truth(friction):
    """θ'' = -g/R sin θ + μ (g/R cos θ + θ'²) while the drum is faster, by SciPy."""
    rate = lambda _, s: [s[1], -G / 2 * np.sin(s[0]) + friction * (G / 2 * np.cos(s[0]) + s[1] ** 2)]  # noqa: E731
    angle = solve_ivp(rate, (0.0, 0.5), [0.0, 0.0], **RUN).y[0, -1]
    return np.array([1 + 2 * np.sin(angle), 2 - 2 * np.cos(angle)])


def test_a_drum_carries_up_what_lies_in_it():
    friction = jnp.array([0.3, 0.6])
    right = np.array([lift_in_truth(mu) for mu in friction])
    np.testing.assert_allclose(lift_by_drum(friction), right, rtol=0, atol=1e-7)


def test_the_friction_of_a_turntable_has_the_derivatives_of_its_formula():
    place, velocity = jnp.array([0.8, 0.0, -0.3]), jnp.array([0.2, 0.0, 0.5])

    def formula(rate):
        slip = velocity - jnp.cross(rate * jnp.eye(3)[1], place)
        return -0.4 * G * slip / jnp.sqrt(slip @ slip)

    @jax.jit
    def friction(rate):
        table = Surfaces.of([turntable(jnp.asarray(0.4), rate * jnp.eye(3)[1])])
        slip = velocity - table.velocity_at(0.0, place)[0]
        slides = Reaction(table, None, jnp.ones(1), jnp.zeros(()), slip[None], None)
        return slides(0.0, Particles(place, velocity), -G * jnp.eye(3)[1])

    rate = jnp.asarray(2.5)
    np.testing.assert_allclose(friction(rate), formula(rate), atol=1e-12)
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(derivative(friction))(rate), jax.jit(jax.jacfwd(formula))(rate), atol=1e-12)


def test_the_response_at_the_end_of_a_step_sees_the_surface_turn():
    """An impact whose friction grips takes over the velocity of the table below."""
    falling = Particles(jnp.array([0.5, -0.01, 0.0]), jnp.array([0.0, -3.0, 0.0]))
    after = turntable(0.9).respond(0.0, falling)
    np.testing.assert_allclose(after.velocity, np.cross(AXIS, [0.5, 0.0, 0.0]), atol=1e-12)


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: turntable(0.5, (1.0, 0.0, 0.0)), "across the normal"),
        (lambda: contacts.Plane((0.0, 0.0), (0.0, 1.0), angular_velocity=1.0), "cannot turn within itself"),
        (lambda: contacts.Room((0.0,) * 3, (1.0,) * 3, angular_velocity=AXIS), "Room: got angular_velocity="),
    ],
)
def test_what_cannot_turn_within_itself_is_refused(build, words):
    with pytest.raises(ValueError, match=words):
        build()
