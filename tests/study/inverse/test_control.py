"""Forces as parameters over time: what a step feels of them, and the best of them where it is known."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest

from physjax import Particles, Scene, forces, methods, reference, simulate

VALUES = np.array([[3.0, -1.0], [0.5, 2.0], [-2.0, 1.0], [1.0, 0.0]])


def pushed(control, method=methods.rk4, dt=0.05, steps=60, mass=2.0):
    body = Scene(Particles(jnp.zeros(2), jnp.zeros(2)), mass=mass, forces=(control,))
    return simulate(body, method, dt=dt, steps=steps)


# the force


@pytest.mark.parametrize("dt", [0.05, 0.04, 0.7, 3.0], ids=["aligned", "not aligned", "few", "one step"])
@pytest.mark.parametrize("method", [methods.euler, methods.verlet, methods.rk4])
def test_the_whole_impulse_arrives_at_every_step_size(method, dt):
    run = pushed(forces.Control(VALUES, duration=2.0, at=0.3), method, dt=dt, steps=int(3.0 / dt) + 1)
    np.testing.assert_allclose(run.velocity[-1], VALUES.sum(0) * 0.5 / 2.0, rtol=1e-13)


def test_constant_pieces_move_a_body_exactly_where_steps_end_with_them():
    run = pushed(forces.Control(VALUES, duration=2.0, at=0.5), dt=0.25, steps=14)
    x, v = np.zeros(2), np.zeros(2)
    for value in VALUES:
        x, v = x + 0.5 * v + 0.125 * value / 2.0, v + 0.5 * value / 2.0
    np.testing.assert_array_equal(run.position[2], 0.0)
    np.testing.assert_allclose(run.position[10], x, rtol=1e-13)
    np.testing.assert_allclose(run.position[-1], x + 1.0 * v, rtol=1e-13)


def test_a_linear_course_is_followed_exactly_by_rk4_and_ends():
    run = pushed(forces.Control(VALUES, duration=1.5, at=0.5, linear=True), dt=0.125, steps=24)
    x, v, h = np.zeros(2), np.zeros(2), 0.5
    for before, after in zip(VALUES[:-1] / 2.0, VALUES[1:] / 2.0, strict=True):
        x, v = x + h * v + h**2 * (before / 3 + after / 6), v + h * (before + after) / 2
    np.testing.assert_allclose(run.velocity[16], v, rtol=1e-13)
    np.testing.assert_allclose(run.position[16], x, rtol=1e-13)
    np.testing.assert_allclose(run.velocity[-1], v, rtol=1e-13)


@pytest.mark.parametrize("linear", [False, True])
def test_diffrax_sees_the_same_force(linear):
    spring = forces.Anchor(point=jnp.zeros(2), stiffness=5.0)
    control = forces.Control(VALUES, duration=2.0, linear=linear)
    body = Scene(Particles(jnp.zeros(2), jnp.ones(2)), forces=(spring, control))
    run = simulate(body, methods.rk4, dt=0.5 / 96 if linear else 1 / 200, steps=480, save_every=480)
    truth = reference(body, [float(run.time[-1])])
    np.testing.assert_allclose(run.position[-1], truth.position[-1], atol=1e-8 if linear else 1e-5)


def test_each_lane_may_have_its_own_course():
    values = np.stack([VALUES, 2.0 * VALUES[::-1]])
    still = jnp.zeros((2, 2))
    both = simulate(
        Scene(Particles(still, still), forces=(forces.Control(values, duration=2.0),)), methods.rk4, dt=0.1, steps=25
    )
    for lane, own in enumerate(values):
        alone = pushed(forces.Control(own, duration=2.0), dt=0.1, steps=25, mass=1.0)
        np.testing.assert_allclose(both.position[:, lane], alone.position, rtol=1e-13)


def test_bad_courses_are_told_in_plain_words(unannotated):
    with pytest.raises(ValueError, match=r"force over time \[N\]: got the shape \(2,\), expected \(pieces, dim\)"):
        forces.Control([1.0, 2.0], duration=1.0)
    with pytest.raises(ValueError, match="at least 2 of them"):
        forces.Control([[1.0, 2.0]], duration=1.0, linear=True)
    with pytest.raises(ValueError, match=r"duration \[s\]: got 0\.0, expected numbers > 0"):
        forces.Control([[1.0, 2.0]], duration=0.0)


# the best of them

PIECES, DURATION, MASS, G = 100, 2.0, 1.5, 9.8
START, SPEED, TARGET = np.array([0.0, 10.0]), np.array([4.0, -1.0]), np.array([12.0, 3.0])


def glide(thrust):
    """A glider under its weight and a thrust over time."""
    parts = (forces.Gravity(G), forces.Control(thrust, duration=DURATION))
    glider = Scene(Particles(jnp.asarray(START), jnp.asarray(SPEED)), mass=MASS, forces=parts)
    return simulate(glider, methods.rk4, dt=DURATION / 400, steps=400, save_every=400)


def cost(thrust, weight=1e5):
    """The energy of the thrust, and a weight on ending anywhere but at rest at the target."""
    end = glide(thrust).final_scene.state
    miss = jnp.sum((end.position - TARGET) ** 2) + jnp.sum(end.velocity**2)
    return jnp.sum(thrust**2) * DURATION / PIECES + weight * miss


def best_thrust(weight):
    """The same by hand: the thrust is linear in time at the middles of its pieces, two unknowns in each component.

    Along each axis x_T = x₀ + v₀T + g T²/2 + Σ a(T - t_i)u_i and v_T = v₀ + g T + Σ a u_i, with a = h/m; where the cost
    is level, h u_i = -w a ((x_T - x*)(T - t_i) + v_T).
    """
    left = DURATION - (np.arange(PIECES) + 0.5) * DURATION / PIECES
    gain = np.stack([left, np.ones(PIECES)]) / MASS  # of (x_T, v_T), for a unit of thrust and time
    fall = np.array([0.0, -G])
    miss = np.stack([START + SPEED * DURATION + fall * DURATION**2 / 2 - TARGET, SPEED + fall * DURATION])
    end = np.linalg.solve(np.eye(2) + weight * gain @ gain.T * DURATION / PIECES, miss)
    return -weight * gain.T @ end


def test_a_glider_comes_to_rest_at_its_target_by_the_thrust_of_least_energy():
    solver = optimistix.BFGS(rtol=1e-12, atol=1e-12)
    found = optimistix.minimise(lambda u, _: cost(u), solver, jnp.zeros((PIECES, 2)), max_steps=400, throw=False)
    exact = best_thrust(1e5)
    np.testing.assert_allclose(found.value, exact, atol=1e-6 * np.abs(exact).max())
    end = glide(found.value).final_scene.state
    np.testing.assert_allclose(end.position, TARGET, atol=1e-3)
    np.testing.assert_allclose(end.velocity, 0.0, atol=1e-3)
    # the limit of many pieces and of a heavy weight, as in the books: the path is a cubic, the force linear in time
    s = (np.arange(PIECES) + 0.5) / PIECES
    way = TARGET - START
    acceleration = np.outer(1 - 2 * s, 6 * way / DURATION**2) - np.outer(4 - 6 * s, SPEED / DURATION)
    books = MASS * (acceleration + np.array([0.0, G]))
    np.testing.assert_allclose(found.value, books, atol=3e-4 * np.abs(books).max())


def test_the_gradient_by_every_thrust_is_that_of_central_differences():
    thrust = jnp.asarray(np.random.default_rng(0).normal(size=(PIECES, 2)))
    way = jnp.asarray(np.random.default_rng(1).normal(size=(PIECES, 2)))
    slope = jnp.sum(jax.grad(cost)(thrust) * way)
    central = (cost(thrust + 1e-4 * way) - cost(thrust - 1e-4 * way)) / 2e-4
    np.testing.assert_allclose(slope, central, rtol=1e-9)


def test_the_gradient_of_many_steps_takes_memory_like_their_root():
    def end(thrust, steps):
        air = forces.QuadraticDrag(area=0.1, coefficient=0.5)
        body = Scene(
            Particles(jnp.zeros((64, 2)), jnp.ones((64, 2))), forces=(air, forces.Control(thrust, duration=1.0))
        )
        return jnp.sum(simulate(body, methods.rk4, dt=1.0 / steps, steps=steps, save_every=steps).position[-1])

    def memory(steps):
        program = jax.jit(jax.grad(lambda u: end(u, steps))).lower(jnp.ones((PIECES, 2))).compile()
        return program.memory_analysis().temp_size_in_bytes

    state = 64 * 4 * 8
    few, many = memory(256), memory(4096)
    assert many / few < 5.0  # 16 times the steps: 4 by their root
    assert many < 4096 * state / 4  # a quarter of what the states alone would take
