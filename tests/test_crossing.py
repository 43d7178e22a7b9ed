"""The first crossing of a surface: right to the order of the method, however few frames were saved, and differentiable."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, Trajectory, contacts, forces, methods, reference, simulate
from physjax.study.sweeps.observables import height
from physjax.vectors import axis_vector, scale

SPEEDS = np.array([[10.0, 12.0], [3.0, 14.0], [20.0, 8.0]])


def thrown(velocity, method=methods.rk4, dt=0.05, steps=60, save_every=10, drag=0.4, parts=(), **options):
    velocity = jnp.asarray(velocity)
    air = forces.QuadraticDrag(area=4.3e-3, coefficient=drag)
    balls = Scene(Particles(jnp.zeros_like(velocity), velocity), 0.145, (forces.Gravity(), air, *parts), **options)
    return simulate(balls, method, dt=dt, steps=steps, save_every=save_every)


# accuracy


def test_without_drag_a_throw_lands_where_the_closed_form_says():
    at = thrown(SPEEDS, drag=0.0).crossing(0.0)
    assert at.ok.all()
    np.testing.assert_allclose(at.time, 2 * SPEEDS[:, 1] / 9.8, rtol=1e-14)
    np.testing.assert_allclose(at.position[:, 0], at.time * SPEEDS[:, 0], rtol=1e-14)
    np.testing.assert_allclose(at.position[:, 1], 0.0, atol=1e-13)
    np.testing.assert_allclose(at.velocity, SPEEDS * [1, -1], rtol=1e-13)


def test_the_error_falls_with_the_order_of_the_method_though_every_tenth_step_was_saved():
    truth = thrown(SPEEDS, dt=0.05 / 16, steps=60 * 16).crossing(-2.0)
    for method, least in ((methods.rk4, 3.5), (methods.verlet, 1.85)):
        errors = []
        for finer in (1, 2):
            at = thrown(SPEEDS, method, dt=0.05 / finer, steps=60 * finer).crossing(-2.0)
            assert at.ok.all()
            errors.append([np.abs(a - b).max() for a, b in zip(at[:3], truth[:3], strict=True)])
        orders = np.log2(np.divide(*errors))
        assert (orders >= least).all(), orders


def test_the_crossing_lies_on_the_path_of_an_independent_solver():
    flight = thrown(SPEEDS)
    at = flight.crossing(contacts.Plane((5.0, 0.0), (-1.0, 0.5)))
    order = np.argsort(at.time)
    truth = reference(flight.scene, np.asarray(at.time)[order])
    for moment, lane in enumerate(order):
        np.testing.assert_allclose(at.position[lane], truth.position[moment, lane], atol=2e-8)
        np.testing.assert_allclose(at.velocity[lane], truth.velocity[moment, lane], atol=2e-8)


def test_frames_do_not_matter():
    every = [thrown(SPEEDS, save_every=n).crossing(2.0, direction=-1) for n in (1, 10, 60)]
    for other in every[1:]:
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), other, every[0])


# which crossing


def test_upward_downward_or_whichever_comes_first():
    flight = thrown([10.0, 12.0], drag=0.0)
    up, down, first = (flight.crossing(3.0, direction=way) for way in (1, -1, None))
    root = np.sqrt(12.0**2 - 2 * 9.8 * 3.0)
    np.testing.assert_allclose([up.time, down.time, first.time], (12 + root * np.array([-1, 1, -1])) / 9.8, rtol=1e-13)
    assert up.velocity[1] > 0 > down.velocity[1]


def test_later_crossings_are_counted_and_move_with_the_stiffness():
    """x = cos ωt is zero at (n - ½)π/ω, and goes up there every other time."""
    start = Particles(jnp.ones((2, 1)), jnp.zeros((2, 1)))

    def moments(stiffness, direction=None, nth=(1, 2, 3)):
        scene = Scene(start, 1.0, (forces.Anchor((0.0,), stiffness),))
        run = simulate(scene, methods.rk4, dt=0.01, steps=300, save_every=30)
        found = run.crossing(0.0, direction=direction, nth=nth)
        return found.time, found.ok

    stiffness = jnp.array([25.0, 4.0])
    rate = np.sqrt(stiffness)
    time, ok = moments(stiffness, nth=(1, 2, 3, 4, 5))
    right = (np.arange(5)[:, None] + 0.5) * np.pi / rate
    np.testing.assert_array_equal(ok, right < 3.0)
    np.testing.assert_allclose(time, np.where(right < 3.0, right, np.nan), atol=1e-7)
    up, _ = moments(stiffness, direction=1, nth=2)
    np.testing.assert_allclose(up[0], 3.5 * np.pi / rate[0], atol=1e-7)
    slope = jax.jacfwd(lambda k: moments(k, nth=2)[0])(stiffness)
    np.testing.assert_allclose(np.diag(slope), -right[1] / (2 * stiffness), rtol=1e-6)


def test_each_lane_may_have_its_own_height_and_those_that_miss_say_so():
    at = thrown(SPEEDS).crossing([1.0, 20.0, 2.0])
    np.testing.assert_array_equal(at.ok, [True, False, True])
    np.testing.assert_allclose(at.position[[0, 2], 1], [1.0, 2.0], rtol=1e-14)
    for told in at[:3]:
        assert np.isnan(np.asarray(told)[1]).all()


def test_what_starts_on_a_tilted_plane_does_not_cross_it_at_once():
    slope = contacts.Plane((0.0, 0.0), (-np.sin(0.3), np.cos(0.3)))
    angles = np.linspace(0.4, 1.5, 200)
    flight = thrown(15 * np.stack([np.cos(angles), np.sin(angles)], -1), drag=0.0, dt=0.06)
    at = flight.crossing(slope)
    assert at.ok.all()
    np.testing.assert_allclose(at.time, 2 * 15 * np.sin(angles - 0.3) / (9.8 * np.cos(0.3)), rtol=1e-12)


def test_a_visit_between_two_frames_is_seen():
    flight = thrown([2.0, 6.0], drag=0.0, dt=0.04)
    at = flight.crossing(1.8)
    assert (flight.position[:, 1] < 1.8).all()
    np.testing.assert_allclose(at.time, (6 - np.sqrt(36 - 2 * 9.8 * 1.8)) / 9.8, rtol=1e-12)


def test_a_surface_may_move_and_may_be_a_function():
    rising = lambda t, x: x[..., 1] - 1.0 - 2.0 * t  # noqa: E731
    plane = contacts.Plane((0.0, 1.0), (0.0, 1.0), velocity=(0.0, 2.0))
    flight = thrown(SPEEDS, drag=0.0)
    times = [flight.crossing(surface, direction=-1).time for surface in (rising, plane)]
    exact = (10 + np.sqrt(10.0**2 - 2 * 9.8)) / 9.8
    np.testing.assert_allclose([t[0] for t in times], exact, rtol=1e-13)
    np.testing.assert_allclose(times[0], times[1], rtol=1e-13)


def bounced(restitution):
    """The first fall below half a metre of a ball thrown at the floor, and of one that would have to pass it."""
    start = jnp.asarray([[0.0, 0.2]] * 2)
    floor = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=restitution)
    balls = Scene(Particles(start, jnp.asarray([[1.0, -5.0]] * 2)), forces=(forces.Gravity(),), contacts=(floor,))
    run = simulate(balls, methods.leapfrog, dt=0.02, steps=50, save_every=10)
    return run.crossing([0.5, -1e-9], direction=-1)


@pytest.mark.slow
def test_a_ball_is_followed_through_its_bounce():
    at, moved = jax.jit(lambda r: jax.jvp(bounced, (r,), (1.0,)))(0.8)
    down = np.sqrt(25 + 2 * 9.8 * 0.2)
    up = np.sqrt((0.8 * down) ** 2 - 9.8)
    np.testing.assert_array_equal(at.ok, [True, False])  # a bounce is no crossing
    np.testing.assert_allclose(at.time[0], (down - 5 + 0.8 * down + up) / 9.8, rtol=1e-12)
    np.testing.assert_allclose(moved.time[0], (down + 0.8 * down**2 / up) / 9.8, rtol=1e-10)


# derivatives


def derivatives(function, at, *modes, step=1e-5):
    """By central differences and by the modes, each compiled as a whole."""
    trials = at[None] + step * np.concatenate([np.eye(len(at)), -np.eye(len(at))])
    plus, minus = np.split(np.asarray(jax.jit(jax.vmap(function))(trials)), 2)
    return np.moveaxis((plus - minus) / (2 * step), 0, -1), *(jax.jit(mode(function))(at) for mode in modes)


def test_the_moment_moves_with_every_number():
    def landing(numbers):
        speed, drag, height, dt = numbers
        shot = thrown(speed * jnp.asarray([[0.6, 0.8]]), drag=drag, dt=0.05 * dt).crossing(height, direction=-1)
        return jnp.concatenate([shot.time, shot.position[0], shot.velocity[0]])

    at = jnp.asarray([15.0, 0.4, 1.0, 1.0])
    central, forward, reverse = derivatives(landing, at, jax.jacfwd, jax.jacrev)
    np.testing.assert_allclose(forward, central, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(reverse, forward, rtol=1e-12, atol=1e-14)


def test_without_drag_the_slope_is_that_of_the_closed_form():
    v = jnp.asarray([10.0, 12.0])
    slope = jax.jit(jax.grad(lambda v: thrown(v, drag=0.0).crossing(0.0).position[0]))(v)
    np.testing.assert_allclose(slope, 2 * v[::-1] / 9.8, rtol=1e-12)


def test_functions_may_close_over_what_is_differentiated():
    def landing(numbers):
        pull, level = numbers
        brake = forces.independent(lambda t, state, mass: -pull * state.velocity)
        return thrown([10.0, 12.0], parts=(brake,)).crossing(lambda t, x: x[..., 1] + level).time

    central, reverse = derivatives(landing, jnp.asarray([0.02, 0.5]), jax.grad)
    np.testing.assert_allclose(reverse, central, rtol=1e-7)


# lanes, scenes, parts


def test_batches_agree_with_lanes():
    lanes = thrown(SPEEDS).crossing(1.0, direction=-1)
    batch = jax.vmap(thrown)(jnp.asarray(SPEEDS)).crossing(1.0, direction=-1)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), batch, lanes)


def pendulums(offset):
    """Two bodies on springs that attract each other, in two scenes."""
    x = jnp.asarray([[[1.0, 0.5], [-1.0, 1.2]], [[1.1, 0.8], [-0.9, 1.0]]]) + offset
    parts = (forces.Anchor(point=jnp.zeros(2), stiffness=3.0), forces.Gravitation(G=0.02))
    return simulate(Scene(Particles(x, 0.0 * x), forces=parts), methods.rk4, dt=0.01, steps=200, save_every=50)


def test_coupled_nodes_have_moments_of_their_own():
    run = pendulums(0.0)
    at = run.crossing(0.2)
    assert at.time.shape == (2, 2)
    assert at.ok.all()
    assert len(set(at.time.ravel().tolist())) == 4
    for scene in range(2):
        alone = run.scene.replace(state=jax.tree.map(lambda leaf, s=scene: leaf[s], run.scene.state))
        order = np.argsort(at.time[scene])
        truth = reference(alone, np.asarray(at.time[scene])[order])
        for moment, node in enumerate(order):
            np.testing.assert_allclose(at.position[scene, node], truth.position[moment, node], atol=1e-8)
            np.testing.assert_allclose(at.velocity[scene, node], truth.velocity[moment, node], atol=1e-8)
    np.testing.assert_allclose(at.position[..., 1], 0.2, rtol=1e-14)


@pytest.mark.slow
def test_moments_of_coupled_nodes_are_differentiable():
    first = lambda offset: jnp.sum(pendulums(offset[0]).crossing(0.2).time[0])  # noqa: E731
    central, reverse = derivatives(first, jnp.zeros(1), jax.grad)
    np.testing.assert_allclose(reverse, central, rtol=1e-7)


class Burner(eqx.Module):
    """An upward push in proportion to the fuel, which dwindles."""

    couples: ClassVar[bool] = False
    fuel: jax.Array

    def __call__(self, t, state, mass):
        return axis_vector(self.fuel, 1, state.velocity)

    def advance(self, t, dt, state):
        return Burner(scale(1 - dt, self.fuel)), state


def test_what_is_remembered_is_as_it_was_then(tmp_path):
    still = jnp.zeros((2, 2))
    scene = Scene(Particles(still, still), forces=(Burner(jnp.asarray([1.0, 2.0])),))
    fine, coarse = (simulate(scene, methods.rk4, dt=0.01, steps=120, save_every=n) for n in (1, 40))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13), fine.crossing(0.2), coarse.crossing(0.2))
    coarse.save(tmp_path / "run.npz")
    loaded = Trajectory.load(tmp_path / "run.npz", scene=scene, method=methods.rk4)
    jax.tree.map(np.testing.assert_array_equal, loaded.crossing(0.2), coarse.crossing(0.2))
    with pytest.raises(
        ValueError, match=r"crossing: this trajectory does not know its scene and method\. Load it with"
    ):
        Trajectory.load(tmp_path / "run.npz").crossing(0.2)


def test_what_lanes_share_cannot_be_stepped_from_different_frames():
    still = jnp.zeros((2, 2))
    run = simulate(Scene(Particles(still, still), forces=(Burner(jnp.asarray(1.0)),)), methods.rk4, dt=0.01, steps=120)
    with pytest.raises(ValueError, match="remembers something that its lanes share"):
        run.crossing(0.2)


def test_lanes_may_have_steps_of_their_own_and_runs_may_be_resumed():
    dt = np.array([0.02, 0.03, 0.05])
    lanes = thrown(SPEEDS, dt=dt, steps=60, drag=0.0).crossing(-1.0)
    np.testing.assert_allclose(lanes.time[2], (8 + np.sqrt(64 + 2 * 9.8)) / 9.8, rtol=1e-13)
    first = thrown(SPEEDS, drag=0.0)
    rest = simulate(
        first.final_scene, methods.rk4, dt=0.05, steps=60, save_every=10, first_step=first.final_step
    ).crossing(-10.0)
    np.testing.assert_allclose(rest.time[1], (14 + np.sqrt(14**2 + 2 * 9.8 * 10)) / 9.8, rtol=1e-13)


def test_a_lane_that_blows_up_harms_no_other():
    springs = forces.Anchor(point=jnp.zeros(2), stiffness=jnp.asarray([1.0, 1e300]))
    x = jnp.ones((2, 2))
    at = simulate(Scene(Particles(x, 0 * x), forces=(springs,)), methods.euler, dt=0.01, steps=200).crossing(0.5)
    assert at.ok[0]
    np.testing.assert_allclose(at.time[0], np.pi / 3, rtol=1e-2)


def test_in_either_precision_the_answer_has_the_type_of_the_run(precision):
    at = thrown(np.asarray([10.0, 12.0], precision.dtype), drag=0.0).crossing(0.0)
    assert {leaf.dtype for leaf in at[:3]} == {precision.dtype}
    np.testing.assert_allclose(at.time, 24 / 9.8, rtol=50 * precision.eps)


def test_bad_input_is_told_in_plain_words(unannotated):
    flight = thrown(SPEEDS)
    with pytest.raises(ValueError, match=r"direction: got 'down', expected \+1"):
        flight.crossing(0.0, direction="down")
    with pytest.raises(ValueError, match=r"the shape \(3, 2\), expected the lanes' \(3,\)"):
        flight.crossing(lambda t, x: x - 1.0)
    with pytest.raises(TypeError, match=r"height \[m\]: got str 'floor'"):
        flight.crossing("floor")
    velocity = jnp.asarray(SPEEDS)
    told = simulate(Scene(Particles(velocity, velocity)), methods.rk4, dt=0.1, steps=2, record=lambda t, s: s.position)
    with pytest.raises(AttributeError, match=r"holds \.recorded only"):
        told.crossing(0.0)
    with pytest.raises(ValueError, match="does not know its scene and method"):
        reference(flight.scene, [0.1, 0.2]).crossing(0.0)


def test_a_height_is_along_the_axis_that_is_up():
    start = jnp.array([[5.0, -3.0, 2.0], [1.0, 1.0, 8.0]])
    fall = simulate(
        Scene(Particles(start, jnp.ones((2, 3))), forces=(forces.Gravity(up=2),)), methods.rk4, dt=0.1, steps=20
    )
    at = fall.crossing(0.5, direction=-1)
    above = np.asarray(start[:, 2]) - 0.5
    assert at.ok.all()
    np.testing.assert_allclose(at.time, (1 + np.sqrt(1 + 2 * 9.8 * above)) / 9.8, atol=1e-12)
    np.testing.assert_allclose(at.position[:, 2], 0.5, atol=1e-12)
    assert height(fall) == fall.position[..., 2].max()


def pull(t, state, mass):
    return -9.8 * mass * jnp.asarray([0.0, 1.0]) + 0.0 * state.velocity


def test_one_ball_whose_force_does_not_say_that_it_is_independent_has_its_crossing():
    fall = simulate(Scene(Particles(jnp.array([0.0, 4.9]), jnp.zeros(2)), forces=(pull,)), methods.rk4, dt=0.3, steps=5)
    assert fall.crossing(0.0).time == pytest.approx(1.0, abs=1e-12)
