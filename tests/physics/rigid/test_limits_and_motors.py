"""Limits stop hinges, sliders and ball joints where they are, and motors drive them with what they can, as closed forms say."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Scene, constraint_forces, energy, forces, inertia, methods, rigid, simulate

G = 9.8
BAR, WHEEL, PLATE = (
    inertia.planar_segment(2.0, 1.0),
    inertia.planar_disc(2.0, 0.5),
    inertia.planar_plate(1.0, (0.2, 0.2)),
)


@functools.cache
def run_bars():
    """Three bars on hinges at their ends, released level: one falls on its limit, one is driven, one is led to an angle."""
    limits = (np.array([[-1.0], [-9.0], [-9.0]]), np.array([[2.0], [9.0], [9.0]]))
    hinges = rigid.Hinges(
        [(-1, 0)],
        [[[0.0, 0.0], [-0.5, 0.0]]],
        limits=limits,
        servo=np.array([[0.0], [0.0], [1.5]]),
        response_time=0.25,
        torque=np.array([[0.0], [1.0], [1e4]]),
    )
    start = rigid.planar_bodies(BAR, [[[0.5, 0.0]]] * 3)
    scene = Scene(start, BAR, (forces.Gravity(G), hinges))
    return scene, simulate(scene, methods.verlet, dt=0.005, steps=200)


def test_a_bar_falls_on_its_limit_and_stays_there():
    scene, film = run_bars()
    angle = np.asarray(film.state.angle)[:, 0, 0]
    assert angle.min() > -1.0 - 1e-10
    # it gets there when a physical pendulum does, whose time is that of energy: ∫ dφ/√(3 g sin φ)
    φ = np.linspace(0.0, 1.0, 200_001)[1:] ** 2
    fall = np.sum(np.diff(φ) / np.sqrt(3 * G * np.sin((φ[1:] + φ[:-1]) / 2))) + 2 * np.sqrt(φ[0] / (3 * G))
    reached = np.argmax(angle < -1.0 + 1e-9)
    assert float(film.time[reached]) == pytest.approx(fall, abs=0.005)
    np.testing.assert_allclose(angle[reached:], -1.0, atol=1e-10)
    end = jax.tree.map(lambda leaf: leaf[-1], film.state)
    # the hinge carries the weight, its limit the torque of it
    held = np.asarray(constraint_forces(scene, state=end)[0])[0, 0]
    np.testing.assert_allclose(held[1:], [-2.0 * G, -2.0 * G * 0.5 * np.cos(1.0)], rtol=1e-9)


def test_a_servo_comes_to_its_angle_exponentially_and_one_too_weak_falls():
    _, film = run_bars()
    angle = np.asarray(film.state.angle)[..., 0]
    np.testing.assert_allclose(angle[:, 2], 1.5 * (1 - np.exp(-np.asarray(film.time) / 0.25)), atol=1e-10)
    assert angle[:, 1].min() < -1.5


def test_a_motor_spins_a_wheel_with_all_its_torque_until_it_has_its_speed_and_the_books_know_its_work():
    axle = rigid.Hinges([(-1, 0)], [[[0.0, 0.0], [0.0, 0.0]]], motor=3.0, torque=0.5)
    scene = Scene(rigid.planar_bodies(WHEEL, [[0.0, 0.0]]), WHEEL, (axle,))
    film = simulate(scene, methods.verlet, dt=0.02, steps=100, save_every=10)
    speed = film.state.angular_momentum[:, 0] / WHEEL.moment
    np.testing.assert_allclose(speed, np.minimum(0.5 / WHEEL.moment * np.asarray(film.time), 3.0), atol=1e-12)
    book = energy.ledger(film).energy
    assert float(book.totals["Hinges"]) == pytest.approx(float(-0.5 * WHEEL.moment * 3.0**2), rel=1e-5)
    assert abs(book.totals["numerical"]) < 1e-4


def slide(force, high):
    """How far plates on rails get that motors of 1 m/s push up a slope of 3:4, with limits of their travel."""
    sliders = rigid.Sliders([(-1, 0)], jnp.zeros((1, 2, 2)), (3.0, 4.0), limits=(-0.2, high), motor=1.0, force=force)
    start = rigid.planar_bodies(PLATE, jnp.zeros((*jnp.shape(force), 2)))
    scene = Scene(start, PLATE, (forces.Gravity(G), sliders))
    return jax.vmap(sliders.travel)(simulate(scene, methods.verlet, dt=0.01, steps=60, save_every=20).state)[..., 0]


def test_motors_of_sliders_push_up_a_slope_what_they_can():
    pull = G * 0.8
    found = slide(jnp.array([[2 * pull], [2 * pull], [0.5 * pull]]), jnp.array([[2.0], [0.3], [2.0]]))
    # a = g sin θ until 1 m/s are reached, then steadily; or down to the limit
    gained = 1 / pull
    time = np.array([0.0, 0.2, 0.4, 0.6])
    up = np.where(time < gained, 0.5 * pull * time**2, time - gained / 2)
    np.testing.assert_allclose(found[:, 0], up, atol=1e-3)
    np.testing.assert_allclose(found[:, 1], np.minimum(up, 0.3), atol=1e-3)
    np.testing.assert_allclose(found[:, 2], np.maximum(-0.25 * pull * time**2, -0.2), atol=1e-12)


def test_where_a_slider_ends_has_a_derivative_by_the_force_or_the_limit():
    end = lambda force, high: slide(force[:, None], high[:, None])[-1]  # noqa: E731
    at, change = (jnp.array([8.5, 8.5]), jnp.array([2.0, 0.05])), (jnp.array([1.0, 1.0]), jnp.array([1.0, 1.0]))
    value, found = jax.jit(lambda: jax.jvp(end, at, change))()
    # half of the square of the time of acceleration and then 1 m/s less what that takes; or where the limit is
    step = 1e-5
    moved = end(*(a + step for a in at))
    np.testing.assert_allclose(found, (moved - value) / step, rtol=1e-3)
    np.testing.assert_allclose(found[1], 1.0, rtol=1e-9)


def test_limits_in_space_hold_in_float32():
    brick = inertia.box(1.0, (0.3, 0.1, 0.2))
    with jax.enable_x64(False):
        start = rigid.bodies(
            brick, [[0.15, 0.0, 0.0], [0.15, 0.0, 1.0]], angular_velocity=[[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]]
        )
        hinge = rigid.Hinges(
            [(-1, 0)], [[[0.0, 0.0, 0.0], [-0.15, 0.0, 0.0]]], axis=(0.0, 0.0, 2.0), limits=(-0.5, None)
        )
        points = [[[0.0, 0.0, 1.0], [-0.15, 0.0, 0.0]]]
        ball = rigid.Joints([(-1, 1)], points, axis=[[[1.0, 0.2, 0.0], [1.0, 0.0, 0.0]]], cone=0.8)
        film = simulate(Scene(start, brick, (forces.Gravity(G), hinge, ball)), methods.verlet, dt=0.01, steps=60)
        along = jax.vmap(lambda state: ball.measure(*ball.find_ends(ball.reader.read_places(state))))(film.state)[
            :, 3, 0, 0
        ]
        angle = jax.vmap(hinge.angle)(film.state)[:, 0]
    np.testing.assert_allclose([angle.min(), angle[-1]], -0.5, atol=1e-5)
    assert film.position.dtype == np.float32
    np.testing.assert_allclose(np.arccos(along).max(), 0.8, atol=1e-5)


def test_a_servo_gives_way_to_a_rope_that_jerks_it_and_only_the_world_that_is_too_fast_fails():
    bodies = rigid.PlanarInertia(jnp.broadcast_to(jnp.array([80.0, 150.0]), (2, 2)), jnp.full((2, 2), 27.0))
    start = rigid.planar_bodies(bodies, [[[1.0, 0.0], [2.0, -1.65]]] * 2)
    # the load of the second world would be a kilometre away after a step, on a rope of 1.5 m
    start = start._replace(momentum=start.momentum.at[1, 1, 0].set(150 * 3e5))
    shoulder = rigid.Hinges(
        [(-1, 0)], [[[0.0, 0.0], [-1.0, 0.0]]], limits=(-0.2, 1.5), servo=1.2, response_time=0.3, torque=1e3
    )
    rope = rigid.Ropes([(0, 1)], [[[1.0, 0.0], [0.0, 0.25]]], 1.5)
    film = simulate(Scene(start, bodies, (forces.Gravity(G), shoulder, rope)), methods.verlet, dt=0.004, steps=40)
    angle, x = np.asarray(film.state.angle), np.asarray(film.position)
    assert np.isfinite(x[:, 0]).all()
    assert not np.isfinite(x[1:, 1]).any()
    tip = x[:, 0, 0] + np.stack([np.cos(angle[:, 0, 0]), np.sin(angle[:, 0, 0])], axis=-1)
    top = x[:, 0, 1] + 0.25 * np.stack([-np.sin(angle[:, 0, 1]), np.cos(angle[:, 0, 1])], axis=-1)
    assert np.linalg.norm(tip - top, axis=-1).max() < 1.5 + 1e-9
    assert angle[-1, 0, 0] < 0.0  # what the servo asks for is 0.5


@pytest.mark.usefixtures("unannotated")
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"limits": (1.0, 0.5)}, "upper minus lower limits .rad.: got -0.5, expected numbers > 0"),
        ({"motor": 1.0}, "the most that it exerts, torque .N m."),
        ({"motor": 1.0, "servo": 1.0, "torque": 1.0}, "a speed or a target, not both"),
        ({"servo": 1.0, "torque": 1.0}, "expected both: the time"),
        ({"limits": (0.0, 1.0), "order": 4}, "got order=4, expected 2"),
    ],
)
def test_limits_and_motors_that_make_no_sense_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        rigid.Hinges([(-1, 0)], jnp.zeros((1, 2, 2)), **options)


@pytest.mark.usefixtures("unannotated")
def test_what_starts_beyond_a_limit_is_refused():
    hinges = rigid.Hinges([(-1, 0)], jnp.zeros((1, 2, 2)), limits=(0.1, 1.0))
    with pytest.raises(ValueError, match=r"is 0\.1 off at the start"):
        Scene(rigid.planar_bodies(WHEEL, [[0.0, 0.0]]), WHEEL, (hinges,))
