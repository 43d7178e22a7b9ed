"""Rockets against Tsiolkovsky and SciPy, in every setting, and what a scene with one refuses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from physjax import Particles, Scene, contacts, forces, inertia, methods, rigid, simulate, springs

M0, FLOW, EXHAUST, BURN, G = 10.0, 0.5, 800.0, 12.0, 9.8
UP = (0.0, 1.0)
DRAG = forces.QuadraticDrag(0.02, 0.5)
K = 0.5 * 1.225 * 0.02 * 0.5


def rocket(flow=FLOW, exhaust=EXHAUST, **options):
    return forces.Rocket(exhaust * flow, flow, BURN, **({"direction": UP} | options))


def pad(force=None, lanes=()):
    start = Particles(jnp.zeros((*lanes, 2)), jnp.zeros((*lanes, 2)))
    return Scene(start, M0, (forces.Gravity(G), rocket() if force is None else force))


def burnout(exhaust=EXHAUST, flow=FLOW):
    """Speed [m/s] and height [m] when the propellant is gone (Tsiolkovsky)."""
    left = M0 - flow * BURN
    speed = exhaust * jnp.log(M0 / left) - G * BURN
    return speed, exhaust * BURN * (1 - left / (M0 - left) * jnp.log(M0 / left)) - G * BURN**2 / 2


def end_of(force, dt=0.1, duration=BURN):
    return simulate(pad(force), methods.rk4, dt=dt, duration=duration, save_every=round(duration / dt))


def test_a_rocket_is_as_fast_and_as_high_as_tsiolkovsky_says(precision):
    run = end_of(rocket())
    speed, height = burnout()
    accuracy = max(1e-8, 200 * precision.eps)
    np.testing.assert_allclose(run.velocity[-1], [0.0, speed], rtol=accuracy)
    np.testing.assert_allclose(run.position[-1], [0.0, height], rtol=accuracy)


def test_it_coasts_on_with_the_mass_that_is_left():
    """Drag goes on acting on what is left of the mass, and before a late start on all of it."""

    def rate(t, s, burns):
        left = M0 - FLOW * min(max(t - 2.0, 0.0), BURN)
        v = s[2:]
        push = -K * np.hypot(*v) * v + np.array([0.0, EXHAUST * FLOW]) * burns
        return [*v, *(push / left - [0.0, G])]

    state = [0.0, 0.0, 30.0, 50.0]
    for begin, end, burns in ((0.0, 2.0, False), (2.0, 2.0 + BURN, True), (2.0 + BURN, 20.0, False)):
        state = solve_ivp(rate, (begin, end), state, args=(burns,), rtol=1e-11, atol=1e-9).y[:, -1]
    start = Particles(jnp.zeros(2), jnp.array([30.0, 50.0]))
    scene = Scene(start, M0, (forces.Gravity(G), rocket(at=2.0, forces=(DRAG,))))
    run = simulate(scene, methods.rk4, dt=0.05, duration=20.0, save_every=400)
    np.testing.assert_allclose([*run.position[-1], *run.velocity[-1]], state, rtol=1e-7)


def test_a_burn_that_ends_within_a_step_ends_to_second_order():
    speed = float(burnout()[0])
    errors = [
        abs(float(end_of(rocket(), dt=15.0 / n, duration=15.0).velocity[-1, 1]) - speed + 3.0 * G) for n in (92, 368)
    ]
    assert errors[0] < 0.05
    assert errors[1] < errors[0] / 12


def test_rockets_in_a_batch_and_under_vmap_are_as_each_alone():
    flow = jnp.array([0.0, 0.3, 0.5])
    build = lambda flow: rocket(flow, forces=(DRAG,))  # noqa: E731
    batch = simulate(pad(build(flow), (3,)), methods.rk4, dt=0.1, duration=BURN, save_every=120).velocity[-1]
    alone = lambda flow: end_of(build(flow)).velocity[-1]  # noqa: E731
    np.testing.assert_allclose(jax.vmap(alone)(flow), batch, atol=1e-10)
    np.testing.assert_allclose(alone(flow[2]), batch[2], atol=1e-10)


def test_derivatives_are_those_of_tsiolkovsky():
    flown = lambda exhaust, flow: end_of(rocket(flow, exhaust)).position[-1, 1]  # noqa: E731
    truth = lambda exhaust, flow: burnout(exhaust, flow)[1]  # noqa: E731
    found, wanted = (jax.grad(f, argnums=(0, 1))(EXHAUST, FLOW) for f in (flown, truth))
    np.testing.assert_allclose(found, wanted, rtol=1e-6)


def test_without_a_direction_it_thrusts_along_its_velocity():
    state = Particles(jnp.zeros(2), jnp.array([30.0, 40.0]))
    force = rocket(direction=None)(0.0, state, jnp.asarray(M0))
    np.testing.assert_allclose(force, EXHAUST * FLOW * np.array([0.6, 0.8]), rtol=1e-12)


def test_traced_numbers_that_leave_no_mass_are_told_by_the_status():
    run = lambda flow: simulate(pad(rocket(flow)), methods.rk4, dt=0.5, duration=BURN)  # noqa: E731
    np.testing.assert_array_equal(jax.vmap(lambda flow: run(flow).ok)(jnp.array([0.5, 1.0])), [True, False])


def test_rockets_that_hit_each_other_keep_the_momentum_of_what_is_left_of_them():
    def hit(flow):
        state = Particles(jnp.array([[0.0, 0.0], [3.0, 0.0]]), jnp.array([[2.0, 0.0], [-1.0, 0.0]]))
        crowd = forces.SoftSpheres(radius=0.5, stiffness=2e4)
        coasting = forces.Rocket(0.0, flow, 0.5, direction=(1.0, 0.0), forces=(crowd,))
        run = simulate(Scene(state, jnp.array([4.0, 4.0]), (coasting,)), methods.rk4, dt=5e-4, steps=2000)
        return run.velocity[-1, :, 0]

    # the first has lost three of its four kilogrammes before they meet
    flow = jnp.array([6.0, 0.0])
    after = hit(flow)
    np.testing.assert_allclose(after[0] + 4.0 * after[1], 2.0 - 4.0, rtol=1e-12)
    np.testing.assert_allclose(after[1] - after[0], 3.0, rtol=1e-4)


@pytest.mark.parametrize(
    ("build", "error", "message"),
    [
        (lambda: Scene(pad().state, M0, (rocket(), forces.SoftSpheres(1.0, 1.0))), ValueError, "SoftSpheres beside it"),
        (lambda: pad(rocket(1.0)), ValueError, r"got 12.0 kg of propellant .* and a mass of 10.0 kg"),
        (lambda: pad(rocket(direction=None)), ValueError, "at rest and no direction"),
        (lambda: rocket(forces=(forces.Gravity(),)), TypeError, "Gravity among its forces"),
        (lambda: rocket(forces=(springs.Springs([[0, 1]], 1.0, 1.0, breaks_at=0.1),)), TypeError, "what remembers"),
        (lambda: rocket(forces=DRAG), TypeError, r"Write forces=\(force,\)"),
        (lambda: Scene(pad().state, M0, (rocket(), DRAG)), ValueError, "QuadraticDrag beside it"),
        (lambda: rocket(-0.1), ValueError, r"thrust \[N\]: got -80.0"),
    ],
)
def test_what_would_not_be_right_is_refused(build, error, message, unannotated):
    with pytest.raises(error, match=message):
        build()


def test_a_rocket_lands_on_a_floor_and_a_body_is_none():
    floor = contacts.Plane((0.0, 0.0), UP)
    scene = pad(forces.Rocket(50.0, 0.1, 1.0, UP))  # too weak to lift off
    run = simulate(Scene(scene.state, M0, scene.forces, (floor,)), methods.rk4, dt=0.1, steps=20)
    np.testing.assert_allclose(run.position[-1], 0.0, atol=1e-6)
    plate = inertia.planar_plate(2.0, (1.0, 1.0))
    with pytest.raises(TypeError, match="bodies have an inertia, which would burn as well"):
        Scene(rigid.planar_bodies(plate), plate, (forces.Rocket(50.0, 0.1, 1.0, UP),))
