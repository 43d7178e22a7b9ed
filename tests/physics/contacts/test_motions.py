"""Surfaces led as functions of time: in the frame of a led surface the laws are those of one at rest, with inertial forces."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from physjax import Particles, Scene, contacts, forces, inertia, methods, rigid, simulate

G, LANES, W = 9.8, 40, 1.7
UP = (0.0, 1.0)
DRY = contacts.Coulomb(0.5, 0.4)
SHAPES = {
    "plane": lambda **has: contacts.Plane((0.0, -1.0), (0.2, 1.0), restitution=0.6, coulomb=DRY, **has),
    "slab": lambda **has: contacts.Slab((0.0, -1.5), (0.2, 1.0), 0.2, restitution=0.6, coulomb=DRY, **has),
    "ball": lambda **has: contacts.Sphere((0.0, -2.0), 0.8, restitution=0.6, **has),
    "room": lambda **has: contacts.Room((-1.0, -1.0), (1.0, 1.0), restitution=0.6, coulomb=DRY, **has),
}


class Fall(eqx.Module):
    """s = ½ a t²."""

    a: jax.Array

    def __call__(self, t):
        return 0.5 * self.a * t**2


class Turn(eqx.Module):
    """θ = ω t."""

    rate: jax.Array

    def __call__(self, t):
        return self.rate * t


class Shake(eqx.Module):
    """s = A sin(ω t)."""

    amplitude: jax.Array
    rate: jax.Array

    def __call__(self, t):
        return self.amplitude * jnp.sin(self.rate * t)


def drawn(seed=3):
    random = np.random.default_rng(seed)
    return random.uniform(-0.8, 0.8, (LANES, 2)), 2 * random.normal(size=(LANES, 2))


def end_of(place, velocity, force, surface, steps=100):
    scene = Scene(Particles(jnp.asarray(place), jnp.asarray(velocity)), 1.0, (force,), (surface,))
    run = simulate(scene, methods.rk4, dt=1 / steps, steps=steps, save_every=steps)
    assert run.ok.all()
    return np.asarray(run.position[-1])


def rotate(angle, place):
    c, s = np.cos(angle), np.sin(angle)
    return place @ np.array([[c, s], [-s, c]])


@pytest.mark.parametrize("name", SHAPES)
def test_what_falls_with_its_surface_sees_less_gravity(name):
    (place, velocity), a = drawn(), np.array([1.5, -3.0])
    build = SHAPES[name]
    led = end_of(place, velocity, forces.Gravity(G), build(motion=contacts.Motion(Fall(jnp.asarray(a)))))
    still = end_of(place, velocity, forces.Gravity(vector=np.array([0.0, -G]) - a), build())
    np.testing.assert_allclose(led - a / 2, still, atol=1e-12)


@pytest.mark.parametrize("name", ["ball", "room"])
def test_in_a_surface_that_turns_are_the_forces_of_its_frame(name):
    place, velocity = drawn()
    if name == "ball":
        place = 0.5 * place - [0.0, 0.5]
    carried = W * place @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    errors = []
    for steps in (50, 100):
        led = SHAPES[name](motion=contacts.Motion(angle=Turn(jnp.asarray(W))))
        seen = rotate(-W, end_of(place, velocity + carried, forces.Gravity(0.0), led, steps))
        still = end_of(place, velocity, forces.RotatingFrame(jnp.asarray(W)), SHAPES[name](), steps)
        errors.append(np.abs(seen - still).max())
    assert errors[1] < 1e-7
    assert np.log2(errors[0] / errors[1]) > 3.5  # order 4, through bounces and slides


def test_a_table_shaken_harder_than_g_throws_what_lies_on_it():
    amplitude, rate = 0.1, np.array([5.0, 15.0])
    motion = contacts.Motion(Shake(jnp.array([0.0, amplitude]), jnp.asarray(rate)[:, None]))
    start = Particles(jnp.zeros((2, 2)), jnp.stack([jnp.zeros(2), amplitude * jnp.asarray(rate)], axis=-1))
    table = contacts.Plane((0.0, 0.0), UP, restitution=0.0, motion=motion)
    run = simulate(Scene(start, 1.0, (forces.Gravity(G),), (table,)), methods.rk4, dt=0.002, steps=150)
    t, y = np.asarray(run.time), np.asarray(run.position[..., 1])
    np.testing.assert_allclose(y[:, 0], amplitude * np.sin(5 * t), atol=1e-9)
    # it leaves where the table falls as fast as it: A ω² sin ωt = g
    leaves = np.arcsin(G / (amplitude * rate[1] ** 2)) / rate[1]
    height, speed = amplitude * np.sin(rate[1] * leaves), amplitude * rate[1] * np.cos(rate[1] * leaves)
    since = np.maximum(t - leaves, 0.0)
    free = np.where(t < leaves, amplitude * np.sin(rate[1] * t), height + speed * since - G * since**2 / 2)
    np.testing.assert_allclose(y[:, 1], free, atol=3e-6)


def test_a_block_on_a_table_shaken_sideways_sticks_or_slips():
    """It rides along while A ω² < μ_s g; else it slips, as its equation of motion says."""
    amplitude, rate, friction = 0.2, 4.0, np.array([0.4, 0.2])
    motion = contacts.Motion(Shake(jnp.array([amplitude, 0.0]), jnp.asarray(rate)))
    dry = contacts.Coulomb(*map(jnp.asarray, (friction, friction)))
    table = contacts.Plane((0.0, 0.0), UP, restitution=0.0, coulomb=dry, motion=motion)
    start = Particles(jnp.zeros((2, 2)), jnp.array([[amplitude * rate, 0.0]] * 2))
    run = simulate(Scene(start, 1.0, (forces.Gravity(G),), (table,)), methods.rk4, dt=0.005, steps=300)
    t, x = np.asarray(run.time), np.asarray(run.position[..., 0])
    np.testing.assert_allclose(x[:, 0], amplitude * np.sin(rate * t), atol=1e-9)
    # sticks at first, slips from A ω² sin ωt = μg on, and sticks no more in this time
    slips = np.arcsin(friction[1] * G / (amplitude * rate**2)) / rate

    def slip(t, s):
        return [s[1], -friction[1] * G * np.sign(s[1] - amplitude * rate * np.cos(rate * t) or 1.0)]

    meets = lambda t, s: s[1] - amplitude * rate * np.cos(rate * t) if t > slips + 0.05 else 1.0  # noqa: E731
    meets.terminal = True
    begun = [amplitude * np.sin(rate * slips), amplitude * rate * np.cos(rate * slips)]
    truth = solve_ivp(slip, (slips, 1.5), begun, rtol=1e-11, atol=1e-12, events=meets, dense_output=True)
    during = (t > slips) & (t < truth.t[-1])
    assert during.sum() > 60
    np.testing.assert_allclose(x[during, 1], truth.sol(t[during])[0], atol=2e-4)


def test_what_sticks_to_a_drum_goes_up_with_it_until_it_is_too_steep():
    drum = contacts.Sphere(
        (0.0, 0.0), 1.0, inside=True, restitution=0.0, coulomb=contacts.Coulomb(0.5, 0.4), angular_velocity=0.5
    )
    start = Particles(jnp.array([0.0, -1.0]), jnp.array([0.5, 0.0]))
    run = simulate(Scene(start, 1.0, (forces.Gravity(G),), (drum,)), methods.rk4, dt=0.01, steps=80)
    angle = np.asarray(run.time) * 0.5
    np.testing.assert_allclose(run.position, np.stack([np.sin(angle), -np.cos(angle)], axis=-1), atol=1e-8)


def test_a_bead_on_a_line_that_swings_has_order_4_in_the_plane_and_in_space():
    angle = lambda t: 0.3 * jnp.sin(3 * t)  # noqa: E731
    θ, dθ = (lambda t: 0.3 * np.sin(3 * t)), (lambda t: 0.9 * np.cos(3 * t))
    rate = lambda t, s: [s[1], s[0] * dθ(t) ** 2 - G * np.sin(θ(t))]  # noqa: E731
    r = solve_ivp(rate, (0, 1), [0.5, 0.0], rtol=1e-12, atol=1e-12).y[0, -1]
    right = r * np.array([np.cos(θ(1.0)), np.sin(θ(1.0))])
    line = contacts.Plane((0.0, 0.0), UP, restitution=0.0, motion=contacts.Motion(angle=angle))
    errors = [np.abs(end_of([0.5, 0.0], [0.0, 0.45], forces.Gravity(G), line, n) - right).max() for n in (50, 100)]
    assert errors[1] < 1e-9
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4.0, abs=0.15)
    board = contacts.Plane(
        (0.3, 0.0, 2.0),
        (0.0, 1.0, 0.0),
        restitution=0.0,
        motion=contacts.Motion(angle=angle, pivot=(0.0, 0.0, 5.0), axis=(0.0, 0.0, 2.0)),
    )
    end = end_of([0.5, 0.0, 1.0], [0.0, 0.45, 0.0], forces.Gravity(G), board, 100)
    np.testing.assert_allclose(end, [*right, 1.0], atol=1e-9)


def test_derivatives_of_a_bounce_by_the_numbers_of_a_motion():
    def end(numbers):
        floor = contacts.Plane(
            (0.0, 0.0), UP, restitution=0.8, motion=contacts.Motion(Shake(numbers[0] * jnp.array(UP), numbers[1]))
        )
        start = Particles(jnp.array([0.0, 1.0]), jnp.array([1.0, 0.0]))
        scene = Scene(start, 1.0, (forces.Gravity(G),), (floor,))
        return simulate(scene, methods.rk4, dt=0.02, steps=35, save_every=35).position[-1]

    numbers, h = jnp.array([0.1, 5.0]), 1e-5
    backward = jax.jit(jax.jacrev(end))(numbers)
    run = jax.jit(jax.vmap(end))
    shifts = h * np.eye(2)
    differences = (run(numbers[None] + shifts) - run(numbers[None] - shifts)).T / (2 * h)
    np.testing.assert_allclose(backward, differences, atol=1e-8)


def test_boxes_come_to_rest_on_a_floor_that_accelerates():
    random, a, lanes, duration = np.random.default_rng(1), np.array([1.5, 2.0, -0.5]), 6, 1.2
    size = np.array([0.4, 0.3, 0.5])
    body, hull = inertia.box(1.0, size), rigid.ContactPoints.box(size)
    place = np.broadcast_to([0.0, 0.6, 0.0], (lanes, 3))
    state = rigid.bodies(
        body,
        place,
        random.normal(size=(lanes, 4)),
        velocity=random.normal(size=(lanes, 3)),
        angular_velocity=2 * random.normal(size=(lanes, 3)),
    )

    def film(gravity, motion):
        floor = contacts.Plane((0.0,) * 3, (0.0, 1.0, 0.0), restitution=0.4, coulomb=DRY, motion=motion)
        scene = Scene(state, body, (gravity,), (rigid.SurfaceContact(hull, floor),))
        run = simulate(scene, methods.rk4, dt=duration / 120, steps=120)
        assert run.ok.all()
        return run

    led = film(forces.Gravity(G), contacts.Motion(Fall(jnp.asarray(a))))
    still = film(forces.Gravity(vector=np.array([0.0, -G, 0.0]) - a), None)
    moved = np.asarray(led.position) - 0.5 * a * np.asarray(led.time)[:, None, None] ** 2
    # the same to rounding until the first lies down, and then as far as steps of this length tell
    np.testing.assert_allclose(moved[:36], still.position[:36], atol=1e-9)
    np.testing.assert_allclose(moved, still.position, atol=3e-3)


@pytest.mark.usefixtures("unannotated")
@pytest.mark.parametrize(
    ("build", "error", "message"),
    [
        (lambda: contacts.Motion(), ValueError, "neither displacement= nor angle="),
        (lambda: contacts.Motion(displacement=2.0), TypeError, "expected a function of the time"),
        (lambda: contacts.Motion(displacement=lambda t: t, pivot=(0.0, 0.0)), ValueError, "without angle="),
        (lambda: contacts.Plane((0.0, 0.0), UP, motion=lambda t: t), TypeError, r"contacts\.Motion"),
        (
            lambda: contacts.Plane((0.0, 0.0), UP, motion=contacts.Motion(angle=jnp.sin), velocity=(0.0, 1.0)),
            ValueError,
            "expected one of them",
        ),
    ],
)
def test_motions_that_make_no_sense_are_refused(build, error, message):
    with pytest.raises(error, match=message):
        build()


@pytest.mark.usefixtures("unannotated")
@pytest.mark.parametrize(
    ("motion", "message"),
    [
        (contacts.Motion(displacement=lambda t: jnp.array([0.0, jnp.sin(t)])), "time of shape"),
        (contacts.Motion(displacement=lambda t: t), "2 components"),
        (contacts.Motion(angle=lambda t: jnp.ones(2) * t), "an angle"),
        (contacts.Motion(angle=jnp.sin, axis=(0.0, 1.0)), "no axis= in the plane"),
    ],
)
def test_motions_that_do_not_fit_are_refused(motion, message):
    floor = contacts.Plane((0.0, 0.0), UP, motion=motion)
    with pytest.raises(ValueError, match=message):
        Scene(Particles(jnp.ones(2), jnp.zeros(2)), 1.0, (forces.Gravity(G),), (floor,))
