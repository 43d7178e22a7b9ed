"""Rigid bodies under every method: orders, what is conserved, closed forms, pivots, loads and bad input."""

import functools
import math

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import (
    Inertia,
    Particles,
    Pins,
    RigidBodies,
    Scene,
    contacts,
    forces,
    inertia,
    loads,
    methods,
    reference,
    rigid,
    simulate,
    springs,
)
from physjax.parts import as_module
from physjax.stepping.methods import METHODS
from physjax.stepping.simulate import sample_states
from physjax.study import energy
from physjax.vectors import norm, rotate_vector, rotate_vector_back

ALL = pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
BRICK = inertia.box(2.0, (1.0, 2.0, 3.0))
TILT = np.array([0.8, 0.1, -0.4, 0.3])
ASKEW = Inertia(2.0, (1.0, 1.5, 2.2), TILT)
OMEGA = (0.4, 2.0, 0.3)


def angle(q, other):
    """The angle between two orientations [rad]."""
    return 2 * np.linalg.norm(np.asarray(q) - np.asarray(other), axis=-1)


@functools.cache
def truth(name):
    """The orientation of a scene after two seconds."""
    return reference(SCENES[name], [2.0], rtol=1e-13, atol=1e-13).state.orientation[-1]


def errors(name, method, counts):
    """The error of the orientation after two seconds, for runs with n steps."""
    scene, true = SCENES[name], truth(name)
    ends = [
        sample_states(scene, as_module(method), jnp.asarray(2.0 / n), jnp.asarray(n), 1).orientation[-1] for n in counts
    ]
    return np.array([angle(q, true).max() for q in ends])


FREE = Scene(rigid.bodies(ASKEW, orientation=TILT, angular_velocity=OMEGA), ASKEW)
HUNG = Scene(
    rigid.bodies(ASKEW.about((0.2, 0.5, -0.3)), orientation=TILT, angular_velocity=OMEGA),
    ASKEW.about((0.2, 0.5, -0.3)),
    (forces.Gravity(), rigid.Torque((0.3, 0.1, -0.2), "body")),
)
DRAGGED = Scene(HUNG.state, HUNG.mass, (*HUNG.forces, rigid.RotationalDrag(0.6)))
# the drift alone turns a free body, and it is of second order
WITHOUT_TORQUE = {"semi_implicit_euler": 2, "implicit_euler": 2}
SCENES = {"free": FREE, "on a pivot": HUNG, "with drag": DRAGGED}
LONG = pytest.param("on a pivot", "implicit_euler", marks=pytest.mark.slow)
CASES = [("free", method) for method in (*WITHOUT_TORQUE, "verlet", "rk4")]
CASES += [LONG if method == "implicit_euler" else ("on a pivot", method) for method in METHODS]
CASES += [("with drag", method) for method in ("verlet", "leapfrog", "rk4")]


@pytest.mark.parametrize(("name", "method"), CASES)
def test_the_orientation_has_the_order_that_the_method_promises(name, method):
    promises = METHODS[method].promises
    order = promises.order_with_drag if name == "with drag" else promises.order
    if name == "free":
        order = WITHOUT_TORQUE.get(method, order)
    # of a high order rounding is all that is left of the error of short steps
    found = errors(name, METHODS[method], (12, 24) if order > 5 else (200, 400))
    assert np.log2(found[0] / found[1]) == pytest.approx(order, abs=0.3)
    assert found[1] < (0.3 if order == 1 else 1e-3)


@ALL
def test_a_quaternion_stays_of_length_one_and_angular_momentum_what_it_was(method):
    film = simulate(FREE, method, dt=0.02, steps=2000, save_every=100)
    np.testing.assert_allclose(np.linalg.norm(film.state.orientation, axis=-1), 1, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(film.state.angular_momentum, np.tile(FREE.state.angular_momentum, (21, 1)))


def test_adaptive_steps_turn_bodies_as_well():
    film = simulate(FREE, methods.adaptive(methods.rk4, 1e-10, 1e-10), dt=0.5, steps=4)
    assert angle(film.state.orientation[-1], truth("free")) < 1e-8


# ten thousand turns


def test_the_energy_of_a_free_body_does_not_drift_in_ten_thousand_turns_and_swings_as_the_square_of_the_step():
    tumbling = Scene(rigid.bodies(BRICK, angular_velocity=OMEGA), BRICK)
    turn_time = 2 * math.pi / float(np.linalg.norm(OMEGA))

    def energies(scene, dt, steps):
        film = simulate(scene, methods.verlet, dt=dt, steps=steps)
        return np.asarray(jax.vmap(lambda s: s.kinetic_energy(BRICK))(film.state))

    dt = turn_time / 100
    late = simulate(tumbling, methods.verlet, dt=dt, steps=1_000_000, save_every=1_000_000).final_scene
    early, late = (energies(scene, dt, 8000) for scene in (tumbling, late))
    # a window that fades in and out, or what is cut off a swing would pass for a drift
    drift = np.average(late, weights=np.hanning(8001)) / np.average(early, weights=np.hanning(8001)) - 1
    assert abs(drift) < 1e-8
    swing = np.ptp(early) / early[0]
    assert np.ptp(late) / early[0] == pytest.approx(swing, rel=1e-3)
    finer = energies(tumbling, dt / 2, 16_000)
    assert np.log2(swing / (np.ptp(finer) / finer[0])) == pytest.approx(2, abs=0.02)


def test_the_drift_runs_back_to_where_it_began():
    state = FREE.state
    there = FREE.drift(state, 0.3)
    back = FREE.drift(there, -0.3)
    np.testing.assert_allclose(back.orientation, state.orientation, rtol=0, atol=1e-15)


def test_about_a_principal_axis_the_turn_is_exact_at_any_step():
    spun = Scene(rigid.bodies(BRICK, angular_velocity=(0, 3.0, 0)), BRICK)
    end = simulate(spun, methods.verlet, dt=0.5, steps=10, save_every=10).state.orientation[-1]
    np.testing.assert_allclose(end, [math.cos(7.5), 0, math.sin(7.5), 0], rtol=0, atol=1e-14)


# closed forms


@ALL
def test_a_constant_torque_spins_up_evenly(method):
    spun = Scene(rigid.bodies(BRICK), BRICK, (rigid.Torque((0, 0, 0.7)),))
    film = simulate(spun, method, dt=1e-3, steps=1000, save_every=1000)
    omega = rigid.angular_velocity(jax.tree.map(lambda a: a[-1], film.state), BRICK)
    np.testing.assert_allclose(omega, [0, 0, 0.7 / BRICK.principal[2]], rtol=0, atol=1e-12)


def test_a_pivot_never_moves_and_the_body_falls_as_newton_says():
    for method in (methods.euler, methods.rk4):
        film = simulate(HUNG, method, dt=0.01, steps=500, save_every=10)
        pivot = film.position - np.asarray(rotate_vector(film.state.orientation, jnp.tile(HUNG.mass.arm, (51, 1))))
        np.testing.assert_allclose(pivot, np.tile(pivot[:1], (51, 1)), rtol=0, atol=1e-12)
        still = jax.vmap(lambda s: rigid.point_velocity(s, HUNG.mass, (0.2, 0.5, -0.3)))(film.state)
        np.testing.assert_allclose(still, 0, atol=1e-12)
    still = rigid.point_acceleration(HUNG, 0.0, (0.2, 0.5, -0.3))
    np.testing.assert_allclose(still, 0, atol=1e-12)


def test_a_pivot_keeps_the_energy_of_a_swing():
    swing = Scene(HUNG.state, HUNG.mass, (forces.Gravity(),))
    film = simulate(swing, methods.rk4, dt=1e-3, steps=3000, save_every=100)
    totals = jax.vmap(lambda t, s: energy.total(swing, t, s))(film.time, film.state)
    np.testing.assert_allclose(totals, totals[0], rtol=0, atol=1e-9 * float(energy.kinetic(swing, 0.0, swing.state)))


# both frames


def test_the_body_feels_eulers_equations():
    torque = np.array([0.3, -0.5, 0.2])
    principal, omega = np.asarray(BRICK.principal), np.array(OMEGA)
    seen = (torque - np.cross(omega, principal * omega)) / principal
    state = rigid.bodies(BRICK, orientation=TILT, angular_velocity=omega, frame="body")
    found = rigid.angular_acceleration(state, BRICK, rotate_vector(state.orientation, jnp.asarray(torque)))
    np.testing.assert_allclose(rotate_vector_back(state.orientation, found), seen, rtol=1e-13)

    def euler(t, omega, args):
        i, w = jnp.asarray(principal), omega
        bend = jnp.stack([w[1] * i[2] * w[2] - w[2] * i[1] * w[1], w[2] * i[0] * w[0] - w[0] * i[2] * w[2], 0 * w[0]])
        bend = bend + jnp.stack([0 * w[0], 0 * w[0], w[0] * i[1] * w[1] - w[1] * i[0] * w[0]])
        return (jnp.asarray(torque) - bend) / i

    truth_by_diffrax = diffrax.diffeqsolve(
        diffrax.ODETerm(euler), diffrax.Dopri8(), 0.0, 2.0, None, jnp.asarray(omega),
        stepsize_controller=diffrax.PIDController(1e-12, 1e-12),
    ).ys[-1]  # fmt: skip
    end = reference(Scene(state, BRICK, (rigid.Torque(torque, "body"),)), [2.0], rtol=1e-12, atol=1e-12).state
    last = RigidBodies(*(jnp.asarray(a[-1]) for a in end))
    found = rotate_vector_back(last.orientation, rigid.angular_velocity(last, BRICK))
    np.testing.assert_allclose(found, truth_by_diffrax, rtol=0, atol=1e-9)


def test_points_of_a_body_move_as_their_derivatives_say():
    place = (0.3, -0.2, 0.7)
    scene = Scene(
        rigid.bodies(ASKEW, velocity=(1, 2, 3), orientation=TILT, angular_velocity=OMEGA),
        ASKEW,
        (forces.Gravity(), rigid.Thrust((0.0, 1.0, 0.4), (0.1, 0, 0.2)), rigid.RotationalDrag(0.3)),
    )
    change = scene.rate(0.0, scene.state)
    where = lambda state: rigid.point(state, place)  # noqa: E731
    fast = lambda state: rigid.point_velocity(state, ASKEW, place)  # noqa: E731
    np.testing.assert_allclose(fast(scene.state), jax.jvp(where, (scene.state,), (change,))[1], rtol=0, atol=1e-14)
    acceleration = rigid.point_acceleration(scene, 0.0, place)
    np.testing.assert_allclose(acceleration, jax.jvp(fast, (scene.state,), (change,))[1], rtol=0, atol=1e-14)


# loads


def test_loads_are_reported_with_force_and_torque_and_each_separately():
    state = rigid.bodies(BRICK, position=(1, 2, 3), angular_velocity=OMEGA)
    off = rigid.AtPoint((0, 0, 1.0), forces.Constant(jnp.asarray([2.0, 0, 0])))
    scene = Scene(state, BRICK, (forces.Gravity(10.0), off, rigid.RotationalDrag(0.5), rigid.Torque((1.0, 0, 0))))
    total = loads(scene, 0.0)
    np.testing.assert_allclose(total.force, [2, -20, 0])
    np.testing.assert_allclose(total.torque, np.array([1, 2, 0]) - 0.5 * np.array(OMEGA))
    weight, *_, twist = loads(scene, 0.0, per_term=True)
    np.testing.assert_allclose(weight.force, [0, -20, 0])
    assert (weight.torque, twist.force) == (None, None)


def test_a_force_on_particles_moves_the_centre_of_mass_as_it_moves_a_particle():
    rng = np.random.default_rng(0)
    x, v, q, omega = (jnp.asarray(rng.normal(size=(5, n))) for n in (3, 3, 4, 3))
    acting = (forces.Gravity(), forces.QuadraticDrag(0.1, 0.5), forces.Anchor((0, 0, 0.0), 3.0, 0.2, 0.1))
    acting = (*acting, forces.Kick((1.0, 0, 0), 0.105, 0.1), forces.Gravitation(1.0, 0.1))
    bodies = simulate(Scene(rigid.bodies(BRICK, x, q, v, omega), BRICK, acting), methods.rk4, dt=0.01, steps=100)
    balls = simulate(Scene(Particles(x, v), 2.0, acting), methods.rk4, dt=0.01, steps=100)
    np.testing.assert_allclose(bodies.position, balls.position, rtol=0, atol=1e-13)
    np.testing.assert_allclose(bodies.velocity, balls.velocity, rtol=0, atol=1e-13)


def test_a_kick_off_centre_gives_its_impulse_and_the_moment_of_it():
    kick = rigid.AtPoint((0, 0, 0.5), forces.Kick((3.0, 0, 0), 0.013, 1e-6))
    for method in (methods.leapfrog, methods.rk4):
        struck = Scene(rigid.bodies(BRICK), BRICK, (kick,))
        end = simulate(struck, method, dt=1e-3, steps=20, save_every=20).final_scene.state
        np.testing.assert_allclose(end.momentum, [3, 0, 0], atol=1e-12)
        np.testing.assert_allclose(end.angular_momentum, [0, 1.5, 0], atol=5e-3)


def test_a_spring_between_points_of_two_bodies_keeps_momentum_angular_momentum_and_energy():
    hook = rigid.AtPoint([[0.5, 1.0, 0], [-0.5, 0, 1.5]], springs.Springs([[0, 1]], 40.0, 0.5))
    pair = Scene(
        rigid.bodies(BRICK, position=[[0.0, 0, 0], [0, 4, 0]], velocity=[[0.0, 0, 1], [0, 0, -1]], angular_velocity=OMEGA),
        BRICK,
        (hook,),
    )  # fmt: skip
    assert pair.couples
    film = simulate(pair, methods.rk4, dt=1.25e-4, steps=16_000, save_every=800)
    for quantity in (energy.ENERGY, energy.MOMENTUM, energy.ANGULAR_MOMENTUM):
        values = np.asarray(jax.vmap(lambda t, s, q=quantity: q.value(pair, t, s))(film.time, film.state))
        assert np.abs(values - values[0]).max() < 1e-9 * float(quantity.size(pair, 0.0, pair.state)), quantity.name
    assert np.ptp(jax.vmap(lambda t, s: energy.kinetic(pair, t, s))(film.time, film.state)) > 1.0


def test_rotational_drag_stops_a_ball_as_it_should():
    ball = inertia.sphere(2.0, 0.3)
    spun = Scene(rigid.bodies(ball, angular_velocity=(0, 0, 4.0)), ball, (rigid.RotationalDrag(0.1),))
    end = simulate(spun, methods.rk4, dt=0.01, steps=100).final_scene.state
    np.testing.assert_allclose(end.angular_momentum[2], 4 * 0.072 * math.exp(-0.1 / 0.072), rtol=1e-6)


def test_a_plain_function_is_a_load_when_it_is_wrapped():
    @rigid.on_bodies
    def magnet(t, bodies, inertia):
        return rigid.Wrench(
            torque=jnp.stack([0 * t, 0 * t, 0.7 + 0 * t]) - 0.1 * rigid.angular_velocity(bodies, inertia)
        )

    end = simulate(Scene(rigid.bodies(BRICK), BRICK, (magnet,)), methods.rk4, dt=0.01, steps=100).final_scene
    assert float(end.state.angular_momentum[2]) > 0.6
    assert not end.couples


def test_a_plain_load_that_closes_over_what_is_traced_runs_inside_jit():
    @jax.jit
    def spun(strength):
        twist = rigid.on_bodies(
            lambda t, bodies, inertia: rigid.Wrench(torque=jnp.stack([0 * strength, 0 * strength, strength]))
        )
        pull = rigid.AtPoint((0.0, 0, 0), forces.independent(lambda t, state, mass: strength + 0 * state.position))
        run = simulate(Scene(rigid.bodies(BRICK), BRICK, (twist, pull)), methods.rk4, dt=0.1, steps=10)
        return run.final_scene.state

    end = spun(jnp.asarray(0.5))
    np.testing.assert_allclose(end.angular_momentum, [0, 0, 0.5], atol=1e-14)
    np.testing.assert_allclose(end.momentum, 0.5, atol=1e-14)


# lanes, derivatives


def test_lanes_and_one_by_one_agree_in_both_precisions(precision):
    rng = np.random.default_rng(3)
    x, q, v, omega = (jnp.asarray(rng.normal(size=(4, n)), precision.dtype) for n in (3, 4, 3, 3))
    bricks = inertia.box(jnp.ones(4, precision.dtype), jnp.asarray(rng.uniform(0.5, 2, (4, 3)), precision.dtype))

    def run(state, body):
        fall = Scene(state, body, (forces.Gravity(),))
        return simulate(fall, methods.verlet, dt=0.03, steps=16, save_every=16).final_scene.state

    together = run(rigid.bodies(bricks, x, q, v, omega), bricks)
    mapped = jax.vmap(lambda m, p, *s: run(rigid.bodies(Inertia(m, p), *s), Inertia(m, p)))(
        bricks.mass, bricks.principal, x, q, v, omega
    )
    for a, b in zip(together, mapped, strict=True):
        assert a.dtype == precision.dtype
        np.testing.assert_allclose(a, b, rtol=0, atol=200 * precision.eps)


def test_a_gradient_under_a_users_jit_computes_each_cosine_of_a_turn_once():
    spins = np.random.default_rng(0).normal(size=(8, 3))
    body = inertia.box(1.0, (1.0, 0.5, 0.3))
    scene = Scene(rigid.bodies(body, jnp.zeros((8, 3)), angular_velocity=spins), body)
    run = lambda state: simulate(scene.replace(state=state), methods.verlet, dt=0.01, steps=10).final_scene.state  # noqa: E731
    gradient = jax.jit(jax.grad(lambda state: jnp.sum(run(state).orientation[..., 1])))
    # forward and recomputed; each of its readers would compute it again where the time step is a constant: 134
    assert gradient.lower(scene.state).compile().as_text().count(" cosine(") <= 8


@pytest.mark.parametrize("method", [methods.verlet, methods.rk4])
def test_gradients_through_a_free_turn_agree_with_differences(method):
    @jax.jit
    def outcome(numbers):
        body = Inertia(1.0, numbers[:3])
        scene = Scene(rigid.bodies(body, angular_velocity=numbers[3:]), body)
        q = simulate(scene, method, dt=0.1, steps=16, save_every=16).final_scene.state.orientation
        return jnp.vdot(q, jnp.asarray([0.3, -0.7, 0.2, 0.9]))

    at, h = jnp.asarray([1.0, 1.5, 2.0, *OMEGA]), 1e-5
    differences = [(outcome(at + h * e) - outcome(at - h * e)) / (2 * h) for e in jnp.eye(6)]
    np.testing.assert_allclose(jax.grad(outcome)(at), differences, rtol=1e-5, atol=1e-8)


def test_a_line_turns_about_what_it_can():
    stick = inertia.rod(1.0, 2.0)
    scene = Scene(rigid.bodies(stick, angular_velocity=(1.0, 0, 5.0)), stick)
    end = simulate(scene, methods.rk4, dt=0.01, steps=100).final_scene.state
    np.testing.assert_allclose(end.orientation, [math.cos(0.5), math.sin(0.5), 0, 0], atol=1e-9)


def test_held_bodies_stay_and_a_bad_lane_harms_no_other():
    x = jnp.asarray([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    scene = Scene(
        rigid.bodies(BRICK, x, angular_velocity=OMEGA), BRICK, (forces.Gravity(),), pinned=jnp.asarray([True, False, False])
    )  # fmt: skip
    bad = scene.replace(
        state=scene.state._replace(momentum=scene.state.momentum * jnp.asarray([[1.0], [1.0], [jnp.nan]]))
    )
    film = simulate(bad, methods.rk4, dt=0.01, steps=10)
    np.testing.assert_array_equal(film.ok, [True, True, False])
    np.testing.assert_array_equal(film.state.orientation[-1, 0], scene.state.orientation[0])
    np.testing.assert_array_equal(film.position[-1, 0], x[0])
    assert float(norm(film.velocity[-1, 1])) > 0.9


def test_a_run_is_saved_loaded_and_resumed(tmp_path):
    from physjax import Trajectory

    whole = simulate(HUNG, methods.rk4, dt=0.01, steps=20)
    half = simulate(HUNG, methods.rk4, dt=0.01, steps=10)
    half.save(tmp_path / "half.npz")
    half = Trajectory.load(tmp_path / "half.npz", scene=HUNG, method=methods.rk4)
    rest = simulate(half.final_scene, methods.rk4, dt=0.01, steps=10, first_step=half.final_step)
    np.testing.assert_array_equal(rest.state.orientation[-1], whole.state.orientation[-1])


# bad input


def initial(**changes):
    state = dict(position=jnp.zeros(3), orientation=jnp.asarray([1.0, 0, 0, 0]), momentum=jnp.zeros(3))
    return RigidBodies(**(state | dict(angular_momentum=jnp.zeros(3)) | changes))


@pytest.mark.usefixtures("unannotated")
@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: Scene(initial()), "expected an Inertia"),
        (lambda: Scene(initial(), 2.0), "expected an Inertia"),
        (lambda: Scene(initial(orientation=jnp.zeros(4)), BRICK), "not zero"),
        (lambda: Scene(initial(position=jnp.zeros(2)), BRICK), "vectors in space"),
        (lambda: Scene(initial(orientation=jnp.ones((2, 4))), BRICK), "expected \\(4,\\)"),
        (lambda: Scene(initial(momentum=jnp.full(3, jnp.nan)), BRICK), "finite"),
        (lambda: Scene(initial(), inertia.box(jnp.ones(3), (1, 1, 1))), "Inertia: got mass"),
        (lambda: Scene(initial(), BRICK, contacts=(contacts.Plane((0, 0, 0), (0, 1, 0)),)), "expected Particles"),
        (lambda: Scene(initial(), BRICK, pinned=Pins(jnp.asarray(True), lambda t: jnp.zeros(3))), "held by a mask"),
        (lambda: loads(Scene(Particles(jnp.zeros(3), jnp.zeros(3)), 1.0, (rigid.Torque((1, 0, 0.0)),)), 0.0), "RigidBodies"),
        (lambda: rigid.Torque((1, 0, 0.0), frame="moon"), "'world' or 'body'"),
        (lambda: rigid.AtPoint((0, 0, 0), rigid.Torque((1, 0, 0.0))), "force on particles"),
        (lambda: rigid.AtPoint((0, 0, 0), springs.Springs([[0, 1]], 1.0, 1.0, breaks_at=0.1)), "forgets"),
        (lambda: rigid.bodies(BRICK, position=(0, 0)), "expected \\(\\*lanes, 3\\)"),
        (lambda: loads(Scene(initial(), BRICK, (lambda t, s, m: jnp.zeros(2),)), 0.0), "expected \\(3,\\)"),
    ],
)  # fmt: skip
def test_bad_input_is_refused_in_plain_words(build, words):
    with pytest.raises((ValueError, TypeError), match=words):
        build()


def test_a_quaternion_of_any_length_is_brought_to_one():
    scene = Scene(initial(orientation=jnp.asarray([2.0, 0, 0, 0])), BRICK)
    np.testing.assert_array_equal(scene.state.orientation, [1, 0, 0, 0])
