"""Steps in a scaled time: an orbit of e = 0.9 keeps its energy, whatever the frames, and costs a fraction of equal steps."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Pins, Scene, contacts, energy, forces, inertia, methods, rigid, simulate
from physjax.scenes import SCENES
from physjax.stepping.pairs import Remembering
from physjax.stepping.time_scaled import MOST_STEPS
from physjax.vectors import norm

PERIOD = 2 * np.pi


def root_of_cube(state):
    """r^(3/2) of two bodies: the time of an orbit that is as far."""
    return norm(state.position[1] - state.position[0]) ** 1.5


LOGARITHMIC = methods.time_scaled(methods.leapfrog)
PACED = methods.time_scaled(methods.leapfrog, pace=root_of_cube)
EACH = pytest.mark.parametrize(
    "method",
    [LOGARITHMIC, PACED, methods.time_scaled(methods.verlet, pace=root_of_cube)],
    ids=["logarithmic", "leapfrog", "verlet"],
)


@partial(jax.jit, static_argnames=("frames", "every"))
def run(scene, method, dt, frames, every=1):
    """States at the ends of every so many dt, and the memories there."""

    def step(kept, i):
        return method.advance(scene, i * dt, kept[0], dt, kept[1]), None

    def frame(kept, index):
        kept, _ = jax.lax.scan(step, kept, index * every + jnp.arange(every, dtype=scene.state.dtype))
        return kept, kept

    start = scene.state, method.start(scene, 0.0, scene.state, dt)
    return jax.lax.scan(frame, start, jnp.arange(frames, dtype=scene.state.dtype))[1]


def energy_error(scene, states):
    now = jax.vmap(lambda state: energy.total(scene, 0.0, state))(states)
    return np.abs(now / energy.total(scene, 0.0, scene.state) - 1)


def path_errors(problem, states, dt, every=1):
    times = every * dt * np.arange(1, len(states.position) + 1)
    return np.linalg.norm(states.position - problem.exact(times).position, axis=-1).max(axis=-1)


@EACH
def test_the_path_is_of_second_order(method):
    problem, errors = SCENES["kepler"](eccentricity=0.6), []
    assert isinstance(method, Remembering)
    for n in (200, 400, 800):
        states, _ = run(problem.scene, method, PERIOD / n, 8, n // 4)
        errors.append(path_errors(problem, states, PERIOD / n, n // 4).max())
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), method.promises.order, atol=0.15)


def test_the_logarithmic_hamiltonian_keeps_the_orbit_of_two_bodies_and_its_phase_is_known():
    problem, n, periods = SCENES["kepler"](eccentricity=0.9), 100, 10
    states, memories = run(problem.scene, LOGARITHMIC, PERIOD / n, n * periods)
    assert energy_error(problem.scene, states).max() < 1e-12
    # every frame is on the ellipse, whose other focus is at the distance 2 from the sum of both
    apart = np.asarray(states.position[:, 1] - states.position[:, 0])
    focus = np.array([-2 * 0.9, 0.0])
    np.testing.assert_allclose(np.hypot(*apart.T) + np.hypot(*(apart - focus).T), 2.0, rtol=0, atol=1e-11)
    # 21/n² of a radian a period, computed independently
    speed = 0.5 * np.sqrt(1.9 / 0.1)
    errors = path_errors(problem, states, PERIOD / n)
    assert errors[-1] == pytest.approx(20.67 / n**2 * periods * speed, rel=0.05)
    # no more than a step ahead, of at most 1 + e times dt; as many steps as dt in a whole period
    assert 0 <= np.min(memories.ahead) <= np.max(memories.ahead) < 1.9 * PERIOD / n


def test_over_1000_periods_the_energy_is_bounded():
    problem = SCENES["kepler"](eccentricity=0.9)
    for method, n, bound in ((LOGARITHMIC, 100, 2e-12), (PACED, 1500, 1e-4)):
        states, _ = run(problem.scene, method, PERIOD / n, 10_000, n // 10)
        errors = energy_error(problem.scene, states)
        assert errors.max() < bound
        if method is PACED:  # the last hundred periods are no worse than the first
            assert errors[-1000:].max() < 1.05 * errors[:1000].max()


def count_work(method, n):
    """Evaluations a period: those of its steps, of which there are n times the mean of 1/g, and those of n steps back."""
    anomaly = np.linspace(0, 2 * np.pi, 4000, endpoint=False)
    r = 1 - 0.9 * np.cos(anomaly)
    mean = 1.0 if method is LOGARITHMIC else np.mean(r / r**1.5)
    return n * (mean + method.promises.evaluations - 1)


def test_the_same_energy_error_costs_verlet_five_times_the_work():
    problem, n, steps = SCENES["kepler"](eccentricity=0.9), 1500, 30_000
    scaled, _ = run(problem.scene, PACED, PERIOD / n, 2 * n)
    equal = simulate(problem.scene, methods.verlet, dt=PERIOD / steps, steps=2 * steps, save_every=10).state
    assert energy_error(problem.scene, scaled).max() < 1e-4 < energy_error(problem.scene, equal).max()
    assert 5 * count_work(PACED, n) < steps * methods.verlet.promises.evaluations


def test_the_same_path_error_costs_verlet_and_leapfrog_more_than_twice_the_work():
    problem, n, periods = SCENES["kepler"](eccentricity=0.9), 400, 4
    scaled, _ = run(problem.scene, LOGARITHMIC, PERIOD / n, n * periods)
    for method in (methods.verlet, methods.leapfrog):
        steps = round(2 * count_work(LOGARITHMIC, n) / method.promises.evaluations / n) * n
        equal = simulate(problem.scene, method, dt=PERIOD / steps, steps=periods * steps, save_every=steps // n).state
        equal = jax.tree.map(lambda leaf: leaf[1:], equal)
        errors = [path_errors(problem, states, PERIOD / n).max() for states in (scaled, equal)]
        assert errors[0] < errors[1] / 4


def test_the_way_is_the_same_there_and_back():
    scene = SCENES["figure_eight"]().scene
    pace = lambda state: norm(state.position[1] - state.position[0])  # noqa: E731
    for method in (LOGARITHMIC, methods.time_scaled(methods.leapfrog, pace=pace)):
        rule = method._rule
        state, numbers = scene.state, rule.begin(scene, 0.0, scene.state)
        leap = jax.jit(lambda state, numbers, rule=rule: rule.leap(scene, 0.0, state, numbers, jnp.asarray(0.02)))
        for _ in range(10):
            state, _, numbers = leap(state, numbers)
        back = state._replace(velocity=-state.velocity)
        numbers = numbers if method is LOGARITHMIC else (numbers[0], -numbers[1])
        for _ in range(10):
            back, _, numbers = leap(back, numbers)
        np.testing.assert_allclose(back.position, scene.state.position, rtol=0, atol=1e-13)
        np.testing.assert_allclose(-back.velocity, scene.state.velocity, rtol=0, atol=1e-13)


def swings(dtype=float):
    """Three oscillations of their own, of which a step is short where they are fast."""
    x = jnp.asarray([[1.0, 0.0], [0.5, 0.2], [0.0, 2.0]], dtype)
    spring = forces.Anchor(point=jnp.zeros(2), stiffness=np.array([1.0, 9.0, 4.0]))
    return Scene(Particles(x, jnp.zeros_like(x)), forces=(spring,))


def lane_pace(state):
    """One number for each lane."""
    return 1.0 / (1.0 + norm(state.velocity))


def test_lanes_have_steps_and_clocks_of_their_own(precision):
    scene, method = swings(precision.dtype), methods.time_scaled(methods.verlet, pace=lane_pace)
    dt = jnp.asarray([0.01, 0.01, 0.005], precision.dtype)
    states, memories = run(scene, method, dt, 40, 5)
    time = 5 * np.outer(np.arange(1, 41), dt)
    exact = np.asarray(scene.state.position) * np.cos(time * np.array([1.0, 3.0, 2.0]))[..., None]
    np.testing.assert_allclose(states.position, exact, rtol=0, atol=1e-3)
    assert states.position.dtype == precision.dtype
    assert memories.ahead.shape == (40, 3)
    for lane in range(3):
        alone = Scene(
            Particles(scene.state.position[lane], scene.state.velocity[lane]),
            forces=(forces.Anchor(point=jnp.zeros(2), stiffness=[1.0, 9.0, 4.0][lane]),),
        )
        found, _ = run(alone, method, dt[lane], 40, 5)
        np.testing.assert_allclose(found.position, states.position[:, lane], rtol=0, atol=64 * precision.eps)


@pytest.mark.parametrize(
    "method", [LOGARITHMIC, methods.time_scaled(methods.leapfrog, pace=lambda s: norm(s.position[..., 0, :]))]
)
def test_scenes_side_by_side_go_ways_of_their_own(method, precision):
    x, v = map(np.asarray, SCENES["kepler"](eccentricity=0.5).scene.state)
    slower = np.array([1.0, 0.8, 0.6])[:, None, None]
    states = Particles(jnp.asarray(x + 0 * slower, precision.dtype), jnp.asarray(v * slower, precision.dtype))
    pull = forces.Gravitation(G=1.0)
    together, memories = run(Scene(states, mass=0.5, forces=(pull,)), method, 0.02, 3, 20)
    assert memories.ahead.shape == (3, 3)
    for i in range(3):
        alone, _ = run(Scene(Particles(*(leaf[i] for leaf in states)), mass=0.5, forces=(pull,)), method, 0.02, 3, 20)
        np.testing.assert_allclose(together.position[:, i], alone.position, rtol=0, atol=2000 * precision.eps)


def test_a_pace_of_one_is_the_method_itself():
    scene, method = swings(), methods.time_scaled(methods.leapfrog, pace=lambda state: 1.0)
    states, _ = run(scene, method, 0.01, 20)
    same = simulate(scene, methods.leapfrog, dt=0.01, steps=20).state
    np.testing.assert_allclose(states.position, same.position[1:], rtol=0, atol=1e-14)


def test_called_by_hand_it_begins_anew_and_is_of_second_order():
    problem, errors = SCENES["kepler"](eccentricity=0.6), []
    for method in (LOGARITHMIC, PACED):
        for n in (400, 800):
            flight = simulate(problem.scene, method, dt=PERIOD / n, steps=n, save_every=n // 4)
            errors.append(np.abs(flight.position - problem.exact(np.asarray(flight.time)).position).max())
    np.testing.assert_allclose(np.log2([errors[0] / errors[1], errors[2] / errors[3]]), 2, atol=0.15)


def test_the_whole_impulse_of_a_kick_arrives():
    kick = forces.Kick((2.0, 0.0), at=0.333, duration=0.05)
    scene = Scene(Particles(jnp.zeros(2), jnp.asarray([0.0, 1.0])), forces=(kick,))
    states, _ = run(scene, methods.time_scaled(methods.leapfrog, pace=lambda s: 1.5 + jnp.sin(s.position[1])), 0.1, 10)
    np.testing.assert_allclose(states.velocity[-1], [2.0, 1.0], rtol=1e-13)


@pytest.mark.parametrize("method", [LOGARITHMIC, PACED], ids=["logarithmic", "paced"])
def test_derivatives_forward_and_reverse_are_those_of_differences(method):
    @jax.jit
    def end(numbers):
        speed, dt = numbers
        velocity = jnp.asarray([[0.0, -0.5], [0.0, 0.5]]) * speed
        scene = Scene(
            Particles(jnp.asarray([[-0.2, 0.0], [0.2, 0.0]]), velocity), mass=0.5, forces=(forces.Gravitation(G=1.0),)
        )
        states, _ = run(scene, method, dt, 4, 3)
        return states.position[-1, 0, 1]

    at = jnp.asarray([1.9, 0.05])
    steps = 1e-6 * jnp.eye(2)
    expected = [(end(at + h) - end(at - h)) / 2e-6 for h in steps]
    np.testing.assert_allclose(jax.jit(jax.jacfwd(end))(at), expected, rtol=1e-6)
    np.testing.assert_allclose(jax.jit(jax.grad(end))(at), expected, rtol=1e-6)


def test_a_lane_whose_pace_is_no_length_of_a_step_is_lost_alone():
    scene = swings()
    for bad in (-1.0, 0.0, 1e-12, jnp.nan):
        pace = lambda state, bad=bad: jnp.asarray([1.0, bad, 1.0])  # noqa: E731
        states, _ = run(scene, methods.time_scaled(methods.leapfrog, pace=pace), 0.01, 2)
        np.testing.assert_array_equal(np.isfinite(states.position[-1]).all(axis=-1), [True, False, True])
    assert MOST_STEPS > 1000


def test_energies_of_the_wrong_sign_are_no_pace():
    high = Scene(Particles(jnp.asarray([0.0, 10.0]), jnp.zeros(2)), forces=(forces.Gravity(),))
    states, _ = run(high, LOGARITHMIC, 0.1, 1)
    assert np.isnan(states.position).any()


def bound(*more, pinned=None):
    state = Particles(jnp.asarray([[-0.5, 0.0], [0.5, 0.0]]), jnp.zeros((2, 2)))
    return Scene(state, forces=(forces.Gravitation(G=1.0), *more), pinned=pinned)


def turning():
    brick = inertia.box(2.0, (1.0, 2.0, 3.0))
    return Scene(rigid.bodies(brick, jnp.zeros(3)), brick, (forces.Gravity(),))


def led():
    start = bound().state.position
    return bound(pinned=Pins(jnp.asarray([True, False]), path=lambda t: start + jnp.sin(t) ** 2))


class Fading(forces.Gravitation):
    """Attraction that grows weaker."""

    def acceleration(self, t, state, mass):
        return jnp.exp(-t) * super().acceleration(t, state, mass)

    def potential(self, t, state, mass):
        return jnp.exp(-t) * super().potential(t, state, mass)


@pytest.mark.parametrize(
    ("scene", "words"),
    [
        (lambda: bound(forces.StokesDrag(0.1)), r"without a potential energy \(StokesDrag\)"),
        (lambda: Scene(bound().state), "no forces"),
        (lambda: Scene(bound().state, forces=(Fading(G=1.0),)), "change with time"),
        (lambda: bound(forces.Anchor(point=jnp.zeros(2), stiffness=1.0, damping=0.1)), r"the velocity \(Anchor\)"),
        (led, "kinematic"),
        (turning, "RigidBodies"),
    ],
)
def test_a_scene_without_the_energy_is_refused(scene, words):
    scene = scene()
    with pytest.raises((TypeError, ValueError), match=words):
        LOGARITHMIC.start(scene, 0.0, scene.state, 0.1)
    with pytest.raises((TypeError, ValueError), match=words):
        simulate(scene, LOGARITHMIC, dt=0.1, steps=1)


def test_a_name_says_what_the_pace_follows():
    assert LOGARITHMIC.__name__ == "time_scaled(leapfrog)"
    assert PACED.__name__ == "time_scaled(leapfrog, root_of_cube)"


def test_other_methods_and_paces_are_refused():
    with pytest.raises(ValueError, match="got the method rk4"):
        methods.time_scaled(methods.rk4)
    with pytest.raises(ValueError, match="without a pace"):
        methods.time_scaled(methods.verlet)
    scene = swings()
    with pytest.raises(ValueError, match=r"got a pace of shape \(3, 2\)"):
        methods.time_scaled(methods.leapfrog, pace=lambda s: s.position).start(scene, 0.0, scene.state, 0.1)


def test_a_ball_that_bounces_is_stepped_without_memory():
    floor = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=1.0, response=contacts.impact)
    drop = Scene(Particles(jnp.asarray([0.0, 1.0]), jnp.zeros(2)), forces=(forces.Gravity(),), contacts=(floor,))
    method = methods.time_scaled(methods.leapfrog, pace=lambda state: 1.0 / (1.0 + norm(state.velocity)))
    flight = simulate(drop, method, dt=0.01, steps=200)
    assert flight.ok
    np.testing.assert_allclose(energy.total(drop, 0.0, flight.final_scene.state), 9.8, rtol=2e-3)


def test_a_run_carries_the_way_from_dt_to_dt():
    problem = SCENES["kepler"]()
    dt, frames = problem.duration / 512, 64
    flown = simulate(problem.scene, LOGARITHMIC, dt=dt, steps=8 * frames, save_every=8)
    kept, _ = run(problem.scene, LOGARITHMIC, dt, frames, every=8)
    np.testing.assert_allclose(flown.position[1:], kept.position, rtol=1e-9, atol=1e-9)
    assert energy_error(problem.scene, flown.state).max() < 1e-12
