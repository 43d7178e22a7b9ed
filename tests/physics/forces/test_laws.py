"""Each force against its closed form; then, for all of them, what every force must be."""

import math
from importlib import resources

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, forces, loads, methods, simulate
from physjax.stepping.methods import METHODS

G = 9.8


def ball(position, velocity=None, dtype=float):
    position = jnp.asarray(position, dtype)
    return Particles(position, jnp.zeros_like(position) if velocity is None else jnp.asarray(velocity, dtype))


def some_state(lanes=4, dim=2, seed=0):
    x, v = np.random.default_rng(seed).normal(size=(2, lanes, dim))
    return ball(x, v)


def push(force, state, mass=1.0, t=0.0):
    """The force alone, as NumPy."""
    return np.asarray(force(t, state, jnp.asarray(mass)))


def fly(force, state, mass=1.0, *, dt=0.01, steps=200, method=methods.rk4):
    return simulate(Scene(state, mass, force), method, dt=dt, steps=steps)


# Gravity, Constant, a plain function


def test_weight_pulls_down_the_chosen_axis():
    state = some_state(2, 3)
    weight = push(forces.Gravity(g=np.array([9.8, 1.6]), up=2), state, np.array([2.0, 3.0]))
    np.testing.assert_allclose(weight, [[0, 0, -19.6], [0, 0, -4.8]], rtol=1e-15)
    with pytest.raises(ValueError, match=r"up: got axis 1, .* Give an axis from 0 to 0"):
        loads(Scene(ball([0.0]), forces=(forces.Gravity(),)), 0.0)


def test_a_constant_force_makes_a_parabola():
    flight = fly((forces.Constant([3.0, -2.0]),), ball([1.0, 0.0], [0.0, 5.0]), 2.0, dt=0.125, steps=16)
    t = np.asarray(flight.time)[:, None]
    exact = np.array([1.0, 0.0]) + np.array([0.0, 5.0]) * t + 0.25 * np.array([3.0, -2.0]) * t**2
    np.testing.assert_allclose(flight.position, exact, rtol=0, atol=2e-14)


@pytest.mark.parametrize("wrap", [lambda f: f, forces.independent], ids=["bare", "independent"])
def test_a_plain_function_is_a_force(wrap):
    flight = fly((wrap(lambda t, state, mass: -4.0 * state.position),), ball([1.0, 0.0]), dt=0.005, steps=400)
    np.testing.assert_allclose(flight.position[:, 0], np.cos(2 * np.asarray(flight.time)), rtol=0, atol=1e-9)


def test_a_function_is_independent_only_when_said_to_be():
    def pull(t, state, mass):
        return -state.position

    assert forces.independent(pull).couples is False
    assert Scene(some_state(), forces=(pull,)).couples is True
    assert Scene(some_state(), forces=(forces.independent(pull),)).status_shape == (4,)


# Kick


# in steps: from the first one on, one step, several, many; then between the steps, and within one
WINDOWS = np.array([[0.0, 10.0], [97.0, 1.0], [50.0, 7.0], [5.0, 90.0], [7.3, 12.9], [20.2, 0.3], [40.0, 20.0]])
IMPULSES = np.array([[1.0, 2.0], [-3.0, 0.1], [0.0, 5.0], [1e3, -1e-3], [4.0, 4.0], [-1.0, 7.0], [0.0, 0.0]])


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_a_kick_gives_its_whole_impulse_under_every_method(method, precision):
    (start, length), mass = WINDOWS.T, np.array([1.0, 2.0, 3.0, 0.5, 1.0, 2.0, 1.0])
    state = ball(np.zeros((7, 2)), np.tile([[0.0, 4.0]], (7, 1)), precision.dtype)
    gain = IMPULSES / mass[:, None]
    # a rounding for each step of the kick and, where it begins or ends within one, the resolution of time there
    within = start % 1 != 0
    share = (4 + length + 8 * within * start / length)[:, None]
    for dt in (0.1, 0.01, 0.3, 0.125, 1e-3, 1 / 3):
        kick = forces.Kick(IMPULSES, at=start * dt, duration=length * dt)
        velocity = simulate(Scene(state, mass, (kick,)), method, dt=dt, steps=100).velocity
        error = np.asarray(velocity[-1], float) - [0.0, 4.0] - gain
        assert np.all(np.abs(error) <= precision.eps * share * (np.abs(gain) + 4.0 * (gain != 0))), dt
    np.testing.assert_array_equal(velocity[:, -1], np.tile([0.0, 4.0], (101, 1)), "no impulse, no change")


def test_a_kick_that_meets_the_steps_keeps_the_order_of_the_method():
    kick, pull = forces.Kick(np.array([0.8]), at=0.0, duration=0.4), forces.Anchor(np.zeros(1), 9.0)
    t, force = 1.2, 0.8 / 0.4
    exact = force / 9.0 * (np.cos(3 * (t - 0.4)) - np.cos(3 * t))
    errors = [fly((kick, pull), ball([0.0]), dt=t / n, steps=n).position[-1, 0] - exact for n in (30, 60, 120)]
    np.testing.assert_allclose([errors[0] / errors[1], errors[1] / errors[2]], 16, rtol=0.1)


def test_a_kick_lasts_from_its_start_to_just_before_its_end():
    kick = forces.Kick(np.array([6.0, 0.0]), at=0.25, duration=0.5)
    before = np.nextafter([0.25, 0.75], 0.0)
    seen = [push(kick, ball([0.0, 0.0]), t=t)[0] for t in (0.0, before[0], 0.25, 0.5, before[1], 0.75, 9.0)]
    np.testing.assert_array_equal(seen, [0, 0, 12, 12, 12, 0, 0])
    assert kick.discontinuities() == (0.25, 0.75)


def test_a_kick_knows_the_time_of_each_scene():
    kick = forces.Kick(np.array([6.0, 0.0]), at=np.array([[0.0, 1.0, 2.0]] * 2), duration=0.5)
    state, t = ball(np.zeros((2, 3, 2))), jnp.asarray([0.25, 2.25])
    np.testing.assert_array_equal(push(kick, state, t=t)[..., 0], [[12, 0, 0], [0, 0, 12]])
    mean = kick.averaged_over_step(t, jnp.asarray([1.0, 0.125]), state)
    np.testing.assert_array_equal(push(mean, state)[..., 0], [[3, 3, 0], [0, 0, 12]])


# Drag


def test_creeping_drag_is_an_exponential_approach():
    b, mass, wind, start = 0.7, 1.4, np.array([2.0, 0.0]), np.array([-3.0, 8.0])
    flight = fly((forces.Gravity(), forces.StokesDrag(b, wind)), ball([0.0, 0.0], start), mass)
    terminal = wind - [0.0, mass * G / b]
    exact = terminal + (start - terminal) * np.exp(-b / mass * np.asarray(flight.time))[:, None]
    np.testing.assert_allclose(flight.velocity, exact, rtol=0, atol=1e-10)


def test_creeping_drag_of_a_sphere():
    radius = np.array([1e-6, 2e-3])
    drag = forces.StokesDrag.of_sphere(radius, viscosity=1e-3, wind=np.array([1.0, 0.0]))
    np.testing.assert_allclose(drag.coefficient, 6 * np.pi * 1e-3 * radius, rtol=1e-15)
    np.testing.assert_allclose(push(drag, ball(np.zeros((2, 2))))[:, 0], 6 * np.pi * 1e-3 * radius, rtol=1e-15)


def test_a_fall_with_quadratic_drag_is_a_hyperbolic_tangent():
    mass, area, coefficient, density = 0.5, 0.02, 0.47, 1.2
    terminal = math.sqrt(2 * mass * G / (density * coefficient * area))
    flight = fly((forces.Gravity(), forces.QuadraticDrag(area, coefficient, density)), ball([0.0, 0.0]), mass)
    t = np.asarray(flight.time)
    np.testing.assert_allclose(flight.velocity[:, 1], -terminal * np.tanh(G * t / terminal), rtol=0, atol=1e-10)
    fallen = terminal**2 / G * np.log(np.cosh(G * t / terminal))
    np.testing.assert_allclose(flight.position[:, 1], -fallen, rtol=0, atol=1e-10)


AIRBORNE = {
    "stokes": lambda wind: forces.StokesDrag(0.3, wind),
    "quadratic": lambda wind: forces.QuadraticDrag(0.1, 0.4, wind=wind),
    "sphere": lambda wind: forces.SphereDrag(0.1, wind=wind),
    "magnus": lambda wind: forces.Magnus(0.1, 0.4, axis=np.array([0.3, -1.0, 0.5]), wind=wind),
}


@pytest.mark.parametrize("build", AIRBORNE.values(), ids=AIRBORNE)
@pytest.mark.parametrize(
    "wind", [np.array([3.0, -1.0, 0.5]), np.arange(1.0, 13.0).reshape(4, 3)], ids=["one", "per lane"]
)
def test_a_wind_is_a_velocity_of_the_air(build, wind):
    state = some_state(dim=3)
    seen_from_the_air = Particles(state.position, state.velocity - jnp.broadcast_to(wind, (4, 3)))
    np.testing.assert_array_equal(push(build(wind), state), push(build(None), seen_from_the_air))
    assert np.all(push(build(wind), state) != push(build(None), state))


def test_a_slow_sphere_feels_stokes_law():
    r, rho, eta = 1e-3, 1.2, 1.8e-5
    reynolds = np.array([1e-18, 1e-9, 1e-6, 1e-3])
    speed = reynolds * eta / (2 * rho * r)
    drag = -push(forces.SphereDrag(r, rho, eta), ball(np.zeros((4, 1)), speed[:, None]))[:, 0]
    stokes = 6 * np.pi * eta * r * speed
    np.testing.assert_allclose(drag[0], stokes[0], rtol=1e-12)
    np.testing.assert_allclose(drag / stokes - 1, 0.15 * reynolds**0.681, rtol=1e-4, atol=1e-14)


def test_a_fast_sphere_has_the_drag_coefficient_of_brown_and_lawler():
    r, rho, eta, speed = 0.05, 1.2, 1.8e-5, np.array([0.1, 1.0, 10.0])
    reynolds = 2 * rho * r * speed / eta
    coefficient = 24 / reynolds * (1 + 0.15 * reynolds**0.681) + 0.407 / (1 + 8710 / reynolds)
    drag = push(forces.SphereDrag(r, rho, eta), ball(np.zeros((3, 2)), np.outer(speed, [0.6, -0.8])))
    exact = -0.5 * rho * coefficient * np.pi * r**2 * speed**2
    np.testing.assert_allclose(drag, np.outer(exact, [0.6, -0.8]), rtol=1e-14)


def terminal_speed(drag, weight):
    """The speed at which the drag bears the weight, by bisection, a lane for each drop."""
    low, high = np.zeros_like(weight), np.full_like(weight, 100.0)
    magnitude = jax.jit(lambda v: -drag(0.0, Particles(v, v), jnp.ones(()))[:, 0])
    for _ in range(60):
        middle = (low + high) / 2
        slow = np.asarray(magnitude(middle[:, None])) < weight
        low, high = np.where(slow, middle, low), np.where(slow, high, middle)
    return low


def test_raindrops_fall_as_fast_as_gunn_and_kinzer_measured():
    table = resources.files("physjax.scenes").joinpath("data/raindrop_terminal_velocity.csv")
    diameter, measured = np.loadtxt(table.open(), delimiter=",", skiprows=1, unpack=True)
    radius = diameter / 2000
    weight = (998.0 - 1.204) * 4 / 3 * np.pi * radius**3 * G
    error = terminal_speed(forces.SphereDrag(radius), weight) / measured - 1
    spheres = (diameter > 0.15) & (diameter < 2.25)
    assert spheres.sum() == 15
    assert np.all(np.abs(error[spheres]) < 0.05)
    assert 0.08 < error[np.isclose(diameter, 3.0)].item() < 0.12, "larger drops flatten"
    creeping = terminal_speed(forces.StokesDrag.of_sphere(radius), weight) / measured - 1
    np.testing.assert_allclose(creeping[:2], [0.11, 0.67], atol=0.01)


# Magnus


def test_lift_does_no_work_and_turns_with_the_spin():
    state = some_state(50, 3)
    axis = np.random.default_rng(3).normal(size=(50, 3))
    lift = push(forces.Magnus(0.2, 0.3, axis=axis, density=1.1), state)
    v = np.asarray(state.velocity)
    power, size = np.sum(lift * v, axis=-1), np.linalg.norm(lift, axis=-1) * np.linalg.norm(v, axis=-1)
    assert np.all(np.abs(power) <= 4e-16 * size)
    speed = np.linalg.norm(v, axis=-1, keepdims=True)
    exact = 0.5 * 1.1 * 0.2 * 0.3 * speed * np.cross(axis / np.linalg.norm(axis, axis=-1, keepdims=True), v)
    np.testing.assert_allclose(lift, exact, rtol=0, atol=1e-15)


@pytest.mark.parametrize("turn", [1, -1])
def test_in_the_plane_lift_alone_is_a_circle(turn):
    mass, speed = 0.4, 7.0
    radius = mass / (0.5 * 1.225 * 0.1 * 0.5)
    flight = fly((forces.Magnus(0.1, 0.5, axis=turn * 3.0),), ball([0.0, 0.0], [speed, 0.0]), mass)
    angle = turn * speed / radius * np.asarray(flight.time)
    circle = radius * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=-1) * [turn, turn]
    np.testing.assert_allclose(flight.position, circle, rtol=0, atol=1e-9)
    assert turn * flight.position[1, 1] > 0, "anticlockwise spin lifts a ball that flies to the right"


# Buoyancy


def test_a_neutrally_buoyant_ball_stays_or_drifts_on():
    volume = np.array([1e-3, 0.2])
    water = forces.Buoyancy(density=1000.0, volume=volume)
    start = ball([[0.0, -1.0], [0.0, -1.0]], [[0.0, 0.0], [0.5, 0.25]])
    flight = fly((forces.Gravity(), water), start, 1000.0 * volume, dt=0.0625, steps=64)
    np.testing.assert_allclose(flight.velocity[-1], start.velocity, rtol=0, atol=1e-13)
    np.testing.assert_allclose(flight.position[-1], [[0, -1], [2, 0]], rtol=0, atol=1e-13)


def test_the_displaced_volume_is_that_of_the_cap_below_the_surface():
    r, surface = 0.5, 1.0
    y = surface + r * np.array([1.5, 1.0, 0.5, 0.0, -0.5, -1.0, -9.0])
    h = np.clip(surface - y + r, 0, 2 * r)
    volume = np.pi * h**2 * (3 * r - h) / 3
    ball_in = ball(np.stack([0 * y, y], axis=-1))
    water = forces.Buoyancy(density=1000.0, radius=r, surface=surface)
    np.testing.assert_allclose(water.displaced_volume(ball_in), volume, rtol=1e-15)
    np.testing.assert_allclose(volume[[0, 1, 3, 5, 6]], 4 / 3 * np.pi * r**3 * np.array([0, 0, 0.5, 1, 1]), rtol=1e-15)
    np.testing.assert_allclose(push(water, ball_in), np.outer(1000 * G * volume, [0, 1]), rtol=1e-14)


def test_a_floating_ball_settles_where_the_displaced_fluid_weighs_as_much():
    r, density = 0.1, np.array([100.0, 500.0, 900.0])
    mass = density * 4 / 3 * np.pi * r**3
    water = forces.Buoyancy(density=1000.0, radius=r, surface=0.0)
    start = ball([[0.0, 0.5], [0.0, -0.3], [0.0, -2.0]])
    flight = fly((forces.Gravity(), water, forces.StokesDrag(mass * 8)), start, mass, dt=0.02, steps=1500)
    h = r - np.asarray(flight.position[-1, :, 1])
    np.testing.assert_allclose(1000 * np.pi * h**2 * (3 * r - h) / 3, mass, rtol=1e-10)
    np.testing.assert_allclose(flight.velocity[-1], 0, atol=1e-10)


# RotatingFrame


def orientation(omega, rate, time, steps=400):
    """R(t), from the turning axes to the inertial ones: R' = R [ω(t)]×, with ω in the turning axes."""

    def slope(frame, t):
        return np.cross(frame, omega + rate * t)

    frame, h = np.eye(3), time / steps
    for t in h * np.arange(steps):
        k1 = slope(frame, t)
        k2 = slope(frame + h / 2 * k1, t + h / 2)
        k3 = slope(frame + h / 2 * k2, t + h / 2)
        frame = frame + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(frame + h * k3, t + h))
    return frame


@pytest.mark.parametrize("rate", [None, [0.0, 0.0, -0.4], [0.3, 0.8, -0.4]], ids=["constant", "changing", "tumbling"])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_free_body_is_a_straight_line_seen_from_the_inertial_frame(dim, rate):
    if dim == 2:
        omega, rate = np.array([0.0, 0.0, 1.3]), None if rate is None else np.array([0.0, 0.0, rate[2]])
        frame = forces.RotatingFrame(1.3, None if rate is None else rate[2])
    else:
        omega = np.array([0.2, -0.5, 1.3])
        frame = forces.RotatingFrame(omega, None if rate is None else np.array(rate))
    x, v = np.array([[1.0, 2.0, 0.5], [0.4, -0.3, 0.8]]) * (np.arange(3) < dim)
    flight = fly((frame,), ball(x[:dim], (v - np.cross(omega, x))[:dim]), dt=0.01, steps=200)
    seen = orientation(omega, np.zeros(3) if rate is None else np.array(rate), 2.0)[:dim, :dim]
    np.testing.assert_allclose(seen @ flight.position[-1], (x + 2.0 * v)[:dim], rtol=0, atol=1e-8)


def test_the_conical_pendulum_stands_still_in_its_frame():
    theta, length, mass, k = 0.7, 2.0, 0.3, 50.0
    r = length * math.sin(theta)
    omega = math.sqrt(G * math.tan(theta) / r)
    tension = mass * G / math.cos(theta)
    string = forces.Anchor(np.array([0.0, 5.0, 0.0]), k, rest_length=length - tension / k)
    terms = (forces.Gravity(), forces.RotatingFrame(np.array([0.0, omega, 0.0])), string)
    bob = Scene(ball([r, 5.0 - length * math.cos(theta), 0.0]), mass, terms)
    weight, centrifugal, pull = map(np.asarray, loads(bob, 0.0, per_term=True))
    np.testing.assert_allclose(weight + centrifugal + pull, 0, atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(pull), tension, rtol=1e-14)
    np.testing.assert_allclose(-pull[0], mass * omega**2 * r, rtol=1e-14)


# Anchor


def test_a_spring_to_a_point_is_the_damped_oscillator():
    k, c, mass, point = 8.0, 0.6, 0.5, np.array([1.0, -2.0])
    flight = fly((forces.Anchor(point, k, damping=c),), ball([2.0, -2.0], [0.0, 3.0]), mass, dt=0.002, steps=1000)
    t, gamma = np.asarray(flight.time), c / (2 * mass)
    omega = math.sqrt(k / mass - gamma**2)
    swing = np.stack([np.cos(omega * t) + gamma / omega * np.sin(omega * t), 3 / omega * np.sin(omega * t)], axis=-1)
    np.testing.assert_allclose(flight.position, point + np.exp(-gamma * t)[:, None] * swing, rtol=0, atol=1e-10)


def test_a_spring_with_a_rest_length_swings_about_it():
    along, rest, amplitude = np.array([0.6, 0.8]), 2.0, 0.5
    flight = fly((forces.Anchor(np.zeros(2), 9.0, rest),), ball((rest + amplitude) * along), dt=0.005, steps=400)
    exact = np.outer(rest + amplitude * np.cos(3 * np.asarray(flight.time)), along)
    np.testing.assert_allclose(flight.position, exact, rtol=0, atol=1e-9)


def test_a_spring_is_damped_along_its_line_only():
    spring = forces.Anchor(np.zeros(2), 5.0, rest_length=2.0, damping=0.3)
    state = ball([[0.0, 2.0]] * 2, [[7.0, 0.0], [7.0, 4.0]])
    np.testing.assert_allclose(push(spring, state), [[0, 0], [0, -1.2]], rtol=1e-15)


# Bad numbers


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: forces.Gravity(g=np.nan), r"g \[m/s²\]: got nan, expected finite numbers"),
        (lambda: forces.StokesDrag([0.1, -0.1]), r"drag coefficient b \[kg/s\]: got -0\.1 at index 1 .* >= 0"),
        (lambda: forces.SphereDrag(radius=0.0), r"radius \[m\]: got 0\.0, expected numbers > 0"),
        (lambda: forces.Kick([1.0, 0.0], at=0.0, duration=0.0), r"duration of the kick \[s\]: got 0\.0, .* > 0"),
        (lambda: forces.Anchor([0.0, 0.0], stiffness=-1.0), r"stiffness \[N/m\]: got -1\.0, expected numbers >= 0"),
        (lambda: forces.Buoyancy(1000.0), r"expected volume= .* or radius= and surface= .* got none of them"),
        (lambda: forces.Buoyancy(1000.0, volume=1.0, radius=1.0), r"got \['volume', 'radius'\]"),
        (lambda: forces.Buoyancy(1000.0, radius=1.0), r"got \['radius'\]"),
    ],
)
def test_a_bad_number_is_answered_when_the_force_is_built(build, message, unannotated):
    with pytest.raises(ValueError, match=message):
        build()


@pytest.mark.parametrize(
    "force",
    [
        forces.Constant(5.0),
        forces.RotatingFrame(0.1),
        forces.Magnus(0.1, 0.4, axis=1.0),
        forces.StokesDrag(0.1, wind=[1.0, 0.0]),
        forces.Anchor([0.0, 0.0], stiffness=1.0),
        forces.Kick([1.0, 0.0], at=0.0, duration=1.0),
    ],
    ids=lambda force: type(force).__name__,
)
def test_a_number_or_a_short_vector_is_not_spread_over_space(force):
    with pytest.raises(
        ValueError, match=r"has the shape \(2?,?\), expected a vector of shape \(3,\) for all lanes or \(4, 3\)"
    ):
        simulate(Scene(some_state(dim=3), forces=(force,)), methods.rk4, dt=0.1, steps=1)
