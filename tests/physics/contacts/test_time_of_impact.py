"""Time of impact: energy, heights, times, orders, derivatives, resting, and nothing ever passes."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, contacts, forces, methods, simulate
from physjax.parts import as_module
from physjax.stepping.simulate import sample_states

SECOND_ORDER = (methods.verlet, methods.midpoint, methods.rk4)
G = 9.8
FLOOR = {"point": (0.0, 0.0), "normal": (0.0, 1.0)}


def dropped(height, velocity=(0.0, 0.0), loads=(), mass=1.0, **surface):
    height = jnp.asarray(height, float)
    position = jnp.stack([jnp.zeros_like(height), height], axis=-1)
    velocity = jnp.broadcast_to(jnp.asarray(velocity, float), position.shape)
    floor = contacts.Plane(**FLOOR, **surface)
    return Scene(Particles(position, velocity), mass, forces=(forces.Gravity(G), *loads), contacts=(floor,))


def last(scene, method, dt, steps):
    return simulate(scene, method, dt=dt, steps=steps, save_every=steps).final_scene


# bounces


@pytest.mark.parametrize("method", SECOND_ORDER)
def test_ten_thousand_bounces_keep_their_energy(method):
    scene = dropped(np.linspace(0.01, 0.012, 4), restitution=1.0)
    # a fall from 1 cm takes 45 ms: 10 000 bounces in 910 s
    end = last(scene, method, dt=0.02, steps=46_000).state
    energy = G * end.position[:, 1] + 0.5 * end.velocity[:, 1] ** 2
    np.testing.assert_allclose(energy, G * scene.state.position[:, 1], rtol=1e-10)


@pytest.mark.parametrize("method", SECOND_ORDER)
@pytest.mark.parametrize("restitution", [0.3, 0.5, 0.8, 0.95])
def test_the_rebound_height(method, restitution):
    h = 1.3
    fall = np.sqrt(2 * h / G)
    apex = fall * (1 + restitution)
    end = last(dropped(h, restitution=restitution), method, dt=apex / 57, steps=57).state
    assert float(end.position[1]) == pytest.approx(restitution**2 * h, rel=1e-9)
    assert abs(float(end.velocity[1])) < 1e-9


@pytest.mark.parametrize("restitution", [0.0, 0.3, 0.5, 0.8, 0.95])
def test_the_time_of_coming_to_rest(restitution):
    h = np.array([0.2, 1.0])
    rest = np.sqrt(2 * h / G) * (1 + restitution) / (1 - restitution)
    floor = last(dropped(h, restitution=restitution), methods.verlet, dt=1e-2, steps=3000).contacts[0]
    np.testing.assert_allclose(floor.touching_since, rest, rtol=1e-6)


def test_at_rest_it_lies_still_for_a_million_steps():
    end = last(dropped(0.01, (0.0, 0.0), restitution=0.5), methods.rk4, dt=1e-3, steps=1_000_000)
    np.testing.assert_array_equal(end.state.position, 0.0)
    np.testing.assert_array_equal(end.state.velocity, 0.0)


def test_two_bounces_within_one_step():
    h, restitution = 1.0, 0.8
    fall = np.sqrt(2 * h / G)
    # the first bounce after one fall, the second after a flight of twice 0.8 falls
    end = last(dropped(h, restitution=restitution), methods.rk4, dt=3.0 * fall, steps=1).state
    t, speed = (3.0 - 2.6) * fall, restitution**2 * G * fall
    assert float(end.position[1]) == pytest.approx(speed * t - 0.5 * G * t**2, abs=1e-12)
    assert float(end.velocity[1]) == pytest.approx(speed - G * t, abs=1e-12)


def test_at_the_bound_of_impacts_a_lane_waits_and_keeps_its_energy():
    walls = (contacts.Plane((0.0, 0.0), (1.0, 0.0)), contacts.Plane((1e-3, 0.0), (-1.0, 0.0)))
    scene = Scene(Particles(jnp.asarray([5e-4, 0.0]), jnp.asarray([10.0, 0.5])), contacts=walls)
    flight = simulate(scene, methods.verlet, dt=0.1, steps=50)
    assert np.all((flight.position[:, 0] >= -1e-15) & (flight.position[:, 0] <= 1e-3 + 1e-15))
    np.testing.assert_allclose(jnp.sum(flight.velocity**2, axis=-1), 100.25, rtol=1e-12)


# order


def end_after_a_bounce(method, steps, response):
    drag = forces.QuadraticDrag(area=0.02, coefficient=0.5)
    scene = dropped(np.linspace(0.7, 1.3, 48), (2.0, 0.0), (drag,), 0.05, restitution=0.7, response=response)
    states = sample_states(scene, as_module(method), jnp.asarray(0.75 / steps), jnp.asarray(steps), 1)  # compiles once
    return np.asarray(states.position[-1])


@cache
def truth_after_a_bounce():
    return end_after_a_bounce(methods.rk4, 3000, contacts.impact)


def errors_after_a_bounce(method, response, counts):
    truth = truth_after_a_bounce()
    return [np.sqrt(np.mean((end_after_a_bounce(method, int(n), response) - truth) ** 2)) for n in counts]


@pytest.mark.parametrize(("method", "least"), [(methods.rk4, 3.5), (methods.verlet, 1.8), (methods.midpoint, 1.8)])
def test_the_order_survives_a_bounce(method, least):
    counts = np.array([16, 32, 64, 128]) if method is methods.rk4 else np.array([64, 128, 256, 512])
    errors = errors_after_a_bounce(method, contacts.impact, counts)
    assert -np.polyfit(np.log(counts), np.log(errors), 1)[0] >= least


@pytest.mark.parametrize("method", [methods.rk4, methods.verlet, methods.midpoint])
def test_the_lectures_response_is_of_first_order(method):
    counts = np.array([64, 128, 256, 512, 1024])
    errors = errors_after_a_bounce(method, contacts.project, counts)
    assert -np.polyfit(np.log(counts), np.log(errors), 1)[0] == pytest.approx(1, abs=0.2)


# derivatives


def bounced(numbers):
    """Positions of a throw from a height at a speed and angle after 0.72, 1.44 and 2.16 s: behind one, two, three bounces."""
    height, speed, angle, restitution = numbers
    velocity = jnp.stack([speed * jnp.cos(angle), speed * jnp.sin(angle)], axis=-1)
    scene = dropped(height, velocity, restitution=restitution)
    return simulate(scene, methods.rk4, dt=0.02, steps=108, save_every=36).position[1:]


@pytest.mark.slow
def test_derivatives_through_one_two_and_three_bounces():
    rng = np.random.default_rng(1)
    lanes = 1000
    numbers = [rng.uniform(0.8, 1.2, lanes), rng.uniform(0.5, 1.5, lanes), rng.uniform(-0.6, 0.3, lanes)]
    numbers = jnp.asarray([*numbers, rng.uniform(0.75, 0.85, lanes)])
    run = jax.jit(lambda numbers: bounced(numbers).sum(axis=-1))  # (frames, lanes)
    h = 1e-6
    pushes = jnp.broadcast_to(jnp.eye(4)[:, :, None], (4, 4, lanes))
    forward = jax.vmap(lambda push: jax.jvp(run, (numbers,), (push,))[1])(pushes)
    central = jnp.stack([(run(numbers + h * push) - run(numbers - h * push)) / (2 * h) for push in pushes])
    size = np.abs(central).max(axis=-1, keepdims=True)
    assert np.abs((forward - central) / (np.abs(central) + size)).max() < 1e-6
    backward = jax.vmap(jax.grad(lambda numbers, weights: jnp.sum(weights @ run(numbers))), in_axes=(None, 0))(
        numbers, jnp.eye(3)
    )
    np.testing.assert_allclose(backward, forward.transpose(1, 0, 2), rtol=1e-9, atol=1e-11 * size.max())


def test_a_number_that_a_plain_force_closes_over_can_be_differentiated_through_a_bounce():
    def height(k):
        drag = forces.independent(lambda t, state, mass: -k * state.velocity)
        floor = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.7)
        ball = Particles(jnp.array([0.0, 1.0]), jnp.array([1.0, 0.0]))
        scene = Scene(ball, forces=(forces.Gravity(), drag), contacts=(floor,))
        return simulate(scene, methods.rk4, dt=0.05, steps=16, save_every=16).position[-1, 1]

    difference = (height(0.1 + 1e-5) - height(0.1 - 1e-5)) / 2e-5
    assert jax.jacfwd(height)(0.1) == pytest.approx(float(difference), rel=1e-7)


@pytest.mark.slow
def test_the_moment_of_rest_can_be_differentiated():
    def rest(numbers):
        h, restitution = numbers
        return last(dropped(h, restitution=restitution), methods.verlet, dt=0.01, steps=400).contacts[0].touching_since

    h, k = 0.4, 0.6
    fall = np.sqrt(2 * h / G)
    slope = jax.jacfwd(rest)(jnp.asarray([h, k]))
    np.testing.assert_allclose(slope, [fall / (2 * h) * (1 + k) / (1 - k), fall * 2 / (1 - k) ** 2], rtol=1e-9)


# lasting contact


def on_slope(angle, velocity=0.0, lanes=(), **surface):
    along = np.array([np.cos(angle), np.sin(angle)])
    position = jnp.broadcast_to(jnp.asarray(3.0 * along), (*lanes, 2))
    start = jnp.broadcast_to(jnp.asarray(velocity * along), (*lanes, 2))
    slope = contacts.Plane((0.0, 0.0), (-along[1], along[0]), **surface)
    return Scene(Particles(position, start), forces=(forces.Gravity(G),), contacts=(slope,)), along


def test_below_the_friction_angle_a_block_does_not_creep():
    scene, _ = on_slope(0.4, coulomb=contacts.Coulomb(0.5, 0.4))
    end = last(scene, methods.rk4, dt=1e-2, steps=100_000).state
    assert np.abs(end.position - scene.state.position).max() < 1e-12
    np.testing.assert_array_equal(end.velocity, 0.0)


@pytest.mark.parametrize("method", [methods.semi_implicit_euler, *SECOND_ORDER])
def test_above_the_friction_angle_it_slides(method):
    angle, kinetic = 0.6, 0.4
    scene, along = on_slope(angle, coulomb=contacts.Coulomb(0.5, kinetic))
    end = last(scene, method, dt=1e-3, steps=1000).state
    expected = -G * (np.sin(angle) - kinetic * np.cos(angle))
    np.testing.assert_allclose(end.velocity, expected * along, rtol=1e-6)


@pytest.mark.parametrize(
    ("method", "dt"),
    [
        *((method, 0.0137) for method in (methods.semi_implicit_euler, *SECOND_ORDER)),
        (methods.rk4, 1e-3),
        (methods.rk4, 0.3),
    ],
)
def test_a_sled_stops_where_it_must_and_stays(method, dt):
    speed, kinetic = 5.0, 0.3
    sled, _ = on_slope(0.0, speed, coulomb=contacts.Coulomb(0.35, kinetic))
    flight = simulate(sled, method, dt=dt, steps=int(4 / dt))
    stop = speed**2 / (2 * kinetic * G)
    tolerance = 1e-6 if method is not methods.semi_implicit_euler else kinetic * G * dt * speed
    assert float(flight.position[-1, 0]) - 3.0 == pytest.approx(stop, abs=tolerance)
    stopped = np.asarray(flight.time) > speed / (kinetic * G) + dt
    np.testing.assert_array_equal(flight.velocity[stopped], 0.0)
    np.testing.assert_array_equal(flight.position[stopped], flight.position[-1:].repeat(stopped.sum(), axis=0))


def test_uphill_a_sled_stops_and_comes_back_only_where_friction_lets_it():
    angle = np.array([0.2, 0.5])
    kinetic, static, speed = 0.25, 0.3, 4.0
    ends = []
    for a in angle:
        sled, along = on_slope(a, speed, coulomb=contacts.Coulomb(static, kinetic))
        end = last(sled, methods.rk4, dt=1e-2, steps=200).state
        up = G * (np.sin(a) + kinetic * np.cos(a))
        down = G * (np.sin(a) - kinetic * np.cos(a))
        top, left = speed**2 / (2 * up), 2.0 - speed / up
        ends.append((np.dot(end.position, along) - 3.0, top if np.tan(a) < static else top - 0.5 * down * left**2))
    np.testing.assert_allclose([e[0] for e in ends], [e[1] for e in ends], rtol=1e-9)


def test_frictionless_sliding_off_a_ball():
    """A mass leaves a frictionless ball where cos θ = 2/3."""
    start = 0.05
    ball = contacts.Sphere((0.0, 0.0), 1.0, restitution=0.2)
    position = jnp.asarray([np.sin(start), np.cos(start)])
    scene = Scene(Particles(position, jnp.zeros(2)), forces=(forces.Gravity(G),), contacts=(ball,))
    flight = simulate(scene, methods.rk4, dt=1e-3, steps=1500)
    distance = np.linalg.norm(flight.position, axis=-1)
    left = int(np.argmax(distance > 1 + 1e-7))
    cosine = float(flight.position[left, 1] / distance[left])
    assert cosine == pytest.approx(2 / 3 * np.cos(start), abs=0.01)
    assert np.abs(distance[:left] - 1).max() < 1e-7
    energy = G * flight.position[:, 1] + 0.5 * np.sum(np.square(flight.velocity), axis=-1)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-6)


def test_a_marble_swings_in_its_bowl():
    """Frictionless sliding in a bowl is a pendulum of the bowl's radius."""
    bowl = contacts.Sphere((0.0, 0.0), 1.0, inside=True)
    amplitude = 0.01
    position = jnp.asarray([np.sin(amplitude), -np.cos(amplitude)])
    marble = Scene(Particles(position, jnp.zeros(2)), forces=(forces.Gravity(G),), contacts=(bowl,))
    period = 2 * np.pi / np.sqrt(G) * (1 + amplitude**2 / 16)
    end = last(marble, methods.rk4, dt=period / 400, steps=400).state
    np.testing.assert_allclose(end.position, position, atol=1e-9)


def test_a_ball_comes_to_rest_in_a_wedge():
    sides = [contacts.Plane((0.0, 0.0), (s, 1.0), restitution=0.4, coulomb=contacts.Coulomb(0.3, 0.2)) for s in (1, -1)]
    ball = Scene(Particles(jnp.asarray([0.1, 1.0]), jnp.zeros(2)), forces=(forces.Gravity(G),), contacts=tuple(sides))
    flight = simulate(ball, methods.verlet, dt=1e-2, steps=2000)
    assert min(float(side.signed_distance(0.0, flight.position).min()) for side in sides) > -1e-12
    np.testing.assert_array_equal(flight.velocity[-100:], 0.0)
    assert np.ptp(np.asarray(flight.position[-1000:]), axis=0).max() < 1e-12
    rests = [float(side.touching_since) for side in flight.final_scene.contacts]
    assert 0.5 < min(rests) <= max(rests) < 1.5


@pytest.mark.slow
@pytest.mark.parametrize("opening", [30.0, 60.0, 90.0, 150.0])
def test_a_block_slides_down_a_groove(opening):
    """Two planes carry it, each with N = m g cosα/(2 sin(opening/2)), so that a = g (sinα - μ_k cosα/sin(opening/2))."""
    half, slope, kinetic = np.deg2rad(opening / 2), 0.7, 0.1
    along, up = np.array([0, -np.sin(slope), np.cos(slope)]), np.array([0, np.cos(slope), np.sin(slope)])
    normals = [s * np.cos(half) * np.array([1.0, 0, 0]) + np.sin(half) * up for s in (1, -1)]
    sides = [contacts.Plane((0.0, 0.0, 0.0), n, coulomb=contacts.Coulomb(0.2, kinetic)) for n in normals]
    # a third and a fourth surface far away: more than a lane can lean on in space
    far = [contacts.Sphere((0.0, 50.0, s * 50.0), 1.0) for s in (1, -1)]
    still = Particles(jnp.zeros(3), jnp.zeros(3))
    expected = G * (np.sin(slope) - kinetic * np.cos(slope) / np.sin(half))
    for surfaces in (sides, [far[0], sides[0], far[1], sides[1]]):
        block = Scene(still, forces=(forces.Gravity(G),), contacts=tuple(surfaces))
        end = last(block, methods.rk4, dt=0.01, steps=100).state
        np.testing.assert_allclose(end.velocity, expected * along, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(end.position, 0.5 * expected * along, rtol=1e-6, atol=1e-9)


def test_the_lectures_friction_leaves_nothing_of_a_slide():
    """Endless bounces each take their part of the tangential velocity: what comes to rest stands still."""
    end = last(dropped(0.5, (1.0, 0.0), restitution=0.4, friction=0.2), methods.rk4, dt=0.01, steps=300).state
    np.testing.assert_array_equal(end.velocity, 0.0)


def test_a_lift_carries_what_rests_on_it_and_lets_go_of_what_is_pulled_off():
    lift = contacts.Plane(**FLOOR, restitution=0.1, velocity=(0.0, 0.3))
    position = jnp.asarray([[0.0, 0.5], [1.0, 0.5]])
    up = forces.Kick(impulse=jnp.asarray([[0.0, 0.0], [0.0, 20.0]]), at=2.0, duration=1.0)
    scene = Scene(Particles(position, jnp.zeros_like(position)), forces=(forces.Gravity(G), up), contacts=(lift,))
    flight = simulate(scene, methods.rk4, dt=0.01, steps=300)
    t = np.asarray(flight.time)
    np.testing.assert_allclose(flight.position[100:, 0, 1], 0.3 * t[100:], atol=1e-12)
    np.testing.assert_allclose(flight.velocity[100:, 0, 1], 0.3, atol=1e-12)
    flown = t[200:] - 2.0
    np.testing.assert_allclose(flight.position[200:, 1, 1], 0.6 + 0.3 * flown + 0.5 * (20 - G) * flown**2, atol=1e-9)
    assert np.isinf(flight.final_scene.contacts[0].touching_since[1])


# nothing passes


@pytest.mark.slow
def test_ten_thousand_balls_stay_in_their_room(precision):
    rng = np.random.default_rng(0)
    x = jnp.asarray(rng.uniform(-1, 1, (10_000, 3)), precision.dtype)
    v = jnp.asarray(rng.uniform(-2, 2, (10_000, 3)), precision.dtype)
    room = contacts.Room(lower=(-1, -1, -1), upper=(1, 1, 1))
    dt = jnp.where(jnp.arange(10_000) % 2 == 0, jnp.asarray(0.05, x.dtype), jnp.asarray(0.5, x.dtype))
    end = last(Scene(Particles(x, v), contacts=(room,)), methods.verlet, dt=dt, steps=100).state
    assert float(jnp.abs(end.position).max()) <= 1 + 4 * precision.eps
    energy = jnp.sum(jnp.square(end.velocity.astype(float))) / jnp.sum(jnp.square(v.astype(float)))
    assert float(energy) == pytest.approx(1.0, abs=1e-2 if precision.dtype == np.float32 else 1e-8)


@pytest.mark.parametrize(
    "obstacle",
    [
        lambda: contacts.Sphere((0.0, 0.0, 0.0), 0.005),
        lambda: contacts.Slab((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), thickness=0.01),
        lambda: contacts.Plane((0.0, 0.0, 0.0), (-1.0, 0.0, 0.0)),
    ],
    ids=("sphere", "slab", "plane"),
)
def test_a_fast_particle_does_not_tunnel(obstacle, precision):
    offset = np.linspace(-0.004, 0.004, 101)
    x = jnp.asarray(np.stack([np.full(101, -8.3), offset, np.zeros(101)], axis=-1), precision.dtype)
    v = jnp.asarray(np.tile([1000.0, 0.0, 0.0], (101, 1)), precision.dtype)
    scene = Scene(Particles(x, v), contacts=(obstacle(),))
    end = last(scene, methods.verlet, dt=1 / 60, steps=1).state
    turned = np.abs(np.asarray(end.velocity) - np.asarray(v)).max(axis=-1)
    assert np.all(turned > 100), "every one of them must have been turned"
    assert float(scene.contacts[0].signed_distance(0.0, end.position).min()) > 0


def test_a_ball_between_two_pistons_is_heated():
    pistons = (
        contacts.Plane((-1.0, 0.0), (1.0, 0.0), velocity=(0.1, 0.0)),
        contacts.Plane((1.0, 0.0), (-1.0, 0.0), velocity=(-0.1, 0.0)),
    )
    scene = Scene(Particles(jnp.zeros(2), jnp.asarray([1.0, 0.0])), contacts=pistons)
    end = last(scene, methods.rk4, dt=0.05, steps=60).state
    # each bounce adds 0.2 m/s; first at 1/1.1 s
    t, x, v, side = 0.0, 0.0, 1.0, 1
    while True:
        signed_distance = (1 - 0.1 * t) - side * x
        hit = t + signed_distance / (abs(v) + 0.1)
        if hit > 3.0:
            break
        x, t, v, side = x + v * (hit - t), hit, -v - np.sign(v) * 0.2, -side
    np.testing.assert_allclose(end.velocity[0], v, rtol=1e-12)
    np.testing.assert_allclose(end.position[0], x + v * (3.0 - t), atol=1e-12)


# batches


@pytest.mark.slow
def test_alone_in_lanes_in_a_large_batch_and_under_vmap_agree():
    heights = jnp.linspace(0.2, 2.0, 3000)
    run = lambda h: last(dropped(h, (1.0, 0.0), restitution=0.8), methods.verlet, dt=0.01, steps=150).state.position  # noqa: E731
    lanes = run(heights)
    np.testing.assert_allclose(jax.vmap(run)(heights[::300]), lanes[::300], rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(run(heights[::300]), lanes[::300], rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(run(heights[600]), lanes[600], rtol=1e-10, atol=1e-12)


@pytest.mark.slow
def test_a_run_with_resting_lanes_is_resumed_and_loaded(tmp_path):
    scene = dropped(np.linspace(0.05, 1.0, 5), (1.0, 0.0), restitution=0.5, coulomb=contacts.Coulomb(0.4, 0.3))
    whole = simulate(scene, methods.rk4, dt=0.01, steps=200)
    half = simulate(scene, methods.rk4, dt=0.01, steps=100)
    rest = simulate(half.final_scene, methods.rk4, dt=0.01, steps=100, first_step=half.final_step)
    np.testing.assert_allclose(rest.position[-1], whole.position[-1], rtol=0, atol=1e-13)
    half.save(tmp_path / "half.npz")
    loaded = type(half).load(tmp_path / "half.npz", scene=scene, method=methods.rk4)
    again = simulate(loaded.final_scene, methods.rk4, dt=0.01, steps=100, first_step=loaded.final_step)
    np.testing.assert_array_equal(again.position, rest.position)


def test_a_bad_lane_harms_no_other():
    scene = dropped(np.array([1.0, 1.0]), restitution=0.8)
    wild = forces.independent(lambda t, state, mass: state.position * jnp.asarray([[0.0, 0.0], [0.0, jnp.inf]]))
    scene = Scene(scene.state, forces=(forces.Gravity(G), wild), contacts=scene.contacts)
    flight = simulate(scene, methods.verlet, dt=0.01, steps=100)
    alone = simulate(dropped(1.0, restitution=0.8), methods.verlet, dt=0.01, steps=100)
    np.testing.assert_array_equal(flight.ok, [True, False])
    np.testing.assert_allclose(flight.position[:, 0], alone.position, rtol=1e-12)


def test_coupled_lanes_cannot_have_their_own_impact_times():
    pair = Particles(jnp.asarray([[0.0, 1.0], [0.5, 1.0]]), jnp.zeros((2, 2)))
    floor = contacts.Plane(**FLOOR, response=contacts.impact)
    with pytest.raises(ValueError, match="couple"):
        Scene(pair, forces=(forces.Gravitation(G=0.1),), contacts=(floor,))
