"""The lecture's collision response, shape by shape."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from physjax import Particles, Scene, contacts, forces, methods, reference, simulate
from physjax.stepping.methods import METHODS

FLOOR = {"point": (0.0, 0.0), "normal": (0.0, 1.0)}


def ball(height, velocity=(0.0, 0.0), **surface):
    return Scene(
        Particles(jnp.stack([jnp.zeros(()), jnp.asarray(height, float)]), jnp.asarray(velocity)),
        forces=(forces.Gravity(),),
        contacts=(contacts.Plane(**FLOOR, response=contacts.project, **surface),),
    )


def after(surface, position, velocity, t=0.0):
    state = surface.respond(t, Particles(jnp.asarray(position, float), jnp.asarray(velocity, float)))
    return np.asarray(state.position), np.asarray(state.velocity)


numbers = st.floats(-10, 10).filter(lambda x: abs(x) > 1e-3)


@settings(max_examples=50, deadline=None)
@given(st.tuples(numbers, numbers, numbers), st.tuples(numbers, numbers, numbers), st.floats(0, 1), st.floats(0, 1))
def test_the_lectures_formula_on_any_plane(normal, v, restitution, friction):
    n = np.array(normal) / np.linalg.norm(normal)
    v = np.array(v) - (np.dot(v, n) + 1.0) * n  # one metre a second inward
    plane = contacts.Plane((1.0, 2.0, 3.0), normal, restitution=restitution, friction=friction)
    x, w = after(plane, np.array([1.0, 2.0, 3.0]) - 0.25 * n, v)
    v_n = np.dot(v, n) * n
    np.testing.assert_allclose(w, (1 - friction) * (v - v_n) - restitution * v_n, atol=1e-13)
    np.testing.assert_allclose(np.dot(x - [1.0, 2.0, 3.0], n), 0.0, atol=1e-14)


def test_only_approaching_lanes_on_the_wrong_side_are_touched(precision):
    x = jnp.asarray([[0, 0.5], [0, -0.5], [0, -0.5], [0, 0.0]], precision.dtype)
    v = jnp.asarray([[1, -2], [1, 2], [1, -2], [1, -2]], precision.dtype)
    state = contacts.Plane(**FLOOR, restitution=0.5).respond(0.0, Particles(x, v))
    assert state.position.dtype == state.velocity.dtype == precision.dtype
    np.testing.assert_array_equal(state.position[:, 1], [0.5, 0, 0, 0])
    np.testing.assert_array_equal(state.velocity[:, 1], [-2, 2, 1, -2])
    np.testing.assert_array_equal(state.velocity[:, 0], 1)


@pytest.mark.parametrize("name", METHODS)
def test_a_ball_rebounds_to_the_square_of_its_restitution_as_the_step_shrinks(name):
    restitution, h = 0.8, 1.0
    errors = []
    for dt in (1e-3, 1e-4):
        flight = simulate(ball(h, restitution=restitution), METHODS[name], dt=dt, duration=1.0)
        fall = int(np.sqrt(2 * h / 9.8) / dt) + 2
        errors.append(abs(float(flight.position[fall:, 1].max()) - restitution**2 * h))
    assert errors[1] < 1e-3
    assert errors[1] < 0.5 * errors[0] + 1e-4


def test_the_bounce_lowers_rk4_to_first_order():
    heights = jnp.linspace(0.7, 1.3, 48)
    fall = jnp.sqrt(2 * heights / 9.8)
    start = jnp.stack([jnp.zeros_like(heights), heights], axis=-1)
    scene = Scene(
        Particles(start, jnp.zeros_like(start)),
        forces=(forces.Gravity(),),
        contacts=(contacts.Plane(**FLOOR, restitution=0.7, response=contacts.project),),
    )
    t = 0.75 - fall
    exact = 0.7 * 9.8 * fall * t - 4.9 * t**2
    steps = np.array([64, 128, 256, 512, 1024])
    errors = []
    for count in steps:
        end = simulate(scene, methods.rk4, dt=0.75 / count, steps=int(count), save_every=int(count))
        errors.append(np.sqrt(np.mean(np.square(np.asarray(end.position[-1, :, 1] - exact)))))
    slope = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert slope == pytest.approx(1, abs=0.2)


def test_a_ball_at_rest_stays_on_the_floor():
    flight = simulate(ball(0.0, restitution=0.0), methods.semi_implicit_euler, dt=0.01, steps=5000)
    assert float(jnp.abs(flight.position[:, 1]).max()) == 0.0


def test_ten_thousand_balls_stay_in_their_room_and_keep_their_energy(precision):
    rng = np.random.default_rng(0)
    x, v = (jnp.asarray(a, precision.dtype) for a in (rng.uniform(-1, 1, (10_000, 3)), rng.normal(size=(10_000, 3))))
    room = contacts.Room(lower=(-1, -1, -1), upper=(1, 1, 1), response=contacts.project)
    flight = simulate(Scene(Particles(x, v), contacts=(room,)), methods.verlet, dt=0.1, steps=2000, save_every=500)
    assert float(jnp.abs(flight.position).max()) <= 1 + 4 * precision.eps
    energy = jnp.sum(flight.velocity[-1] ** 2) / jnp.sum(v**2)
    assert float(energy) == pytest.approx(1.0, abs=1000 * precision.eps)


def test_a_corner_responds_with_all_its_walls():
    x, v = after(contacts.Room((0, 0, 0), (1, 1, 1)), [-0.1, 1.2, 0.5], [-1.0, 2.0, 3.0])
    np.testing.assert_allclose(x, [0, 1, 0.5], atol=1e-15)
    np.testing.assert_allclose(v, [1, -2, 3])


@pytest.mark.parametrize(("inside", "x", "v"), [(False, 0.9, -1.0), (True, 1.1, 1.0)])
def test_a_sphere_is_an_obstacle_or_a_bowl(inside, x, v):
    sphere = contacts.Sphere((0, 0, 0), 1.0, inside=inside, restitution=0.5)
    end, out = after(sphere, [0.0, x, 0.0], [3.0, v, 0.0])
    np.testing.assert_allclose(end, [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(out, [3.0, -0.5 * v, 0.0], atol=1e-15)


def test_a_bowl_keeps_its_marble():
    bowl = contacts.Sphere((0, 0, 0), 1.0, inside=True, restitution=0.5, response=contacts.project)
    marble = Scene(Particles(jnp.asarray([0.6, 0.0, 0.1]), jnp.zeros(3)), forces=(forces.Gravity(),), contacts=(bowl,))
    flight = simulate(marble, methods.verlet, dt=1e-3, steps=5000)
    assert float(jnp.linalg.norm(flight.position, axis=-1).max()) <= 1 + 1e-12


def test_a_slab_has_two_sides():
    slab = contacts.Slab((0, 0), (0, 1), thickness=0.2)
    for side in (1.0, -1.0):
        x, v = after(slab, [0.0, 0.06 * side], [1.0, -2.0 * side])
        np.testing.assert_allclose(x, [0, 0.1 * side])
        np.testing.assert_allclose(v, [1, 2.0 * side])


def test_a_bat_gives_twice_its_speed():
    bat = contacts.Plane((0, 0), (1, 0), velocity=(5.0, 0.0))
    x, v = after(bat, [9.9, 0.0], [-3.0, 1.0], t=2.0)
    np.testing.assert_allclose(x, [10, 0])
    np.testing.assert_allclose(v, [13, 1])


@pytest.mark.parametrize(
    ("tangential", "left"),
    [(0.7, 0.0), (-0.7, 0.0), (2.0, 2.0 - 0.2 * 1.5), (-2.0, -2.0 + 0.2 * 1.5)],
)
def test_coulomb_holds_up_to_its_static_limit_and_slips_beyond(tangential, left):
    plane = contacts.Plane(**FLOOR, restitution=0.5, coulomb=contacts.Coulomb(static=0.5, kinetic=0.2))
    _, v = after(plane, [0.0, -0.01], [tangential, -1.0])
    np.testing.assert_allclose(v, [left, 0.5], atol=1e-15)


def test_friction_never_adds_energy():
    rng = np.random.default_rng(1)
    v = rng.normal(size=(2000, 3)) * 10.0 ** rng.uniform(-6, 3, (2000, 1))
    rough = contacts.Coulomb(rng.uniform(1, 2, 2000), 0.9)
    plane = contacts.Plane((0, 0, 0), (1, 2, 2), restitution=rng.uniform(size=2000), coulomb=rough)
    x = np.tile(-0.1 * np.array([1, 2, 2]) / 3, (2000, 1))
    _, w = after(plane, x, v)
    assert np.all((w**2).sum(-1) <= (v**2).sum(-1) * (1 + 1e-12))


@pytest.mark.parametrize("surface", [{}, {"friction": 0.3}, {"coulomb": (0.4, 0.2)}, {"coulomb": (4.0, 2.0)}], ids=str)
def test_derivatives_through_a_bounce_are_finite_and_right(surface):
    surface = {k: contacts.Coulomb(*v) if k == "coulomb" else v for k, v in surface.items()}

    def landing(numbers):
        height, speed, restitution = numbers
        scene = ball(height, jnp.stack([speed, jnp.zeros(())]), restitution=restitution, **surface)
        return simulate(scene, methods.rk4, dt=1e-2, steps=70, save_every=70).position[-1].sum()

    at, h = jnp.asarray([1.0, 2.0, 0.6]), 1e-6
    backward, forward = jax.grad(landing)(at), jax.jacfwd(landing)(at)
    central = [(landing(at + h * e) - landing(at - h * e)) / (2 * h) for e in jnp.eye(3)]
    np.testing.assert_allclose(backward, central, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(backward, forward, rtol=1e-10, atol=1e-12)
    straight = Particles(jnp.asarray([0.0, -0.1]), jnp.asarray([0.0, -1.0]))  # no tangential velocity at all
    slope = jax.jacrev(lambda s: contacts.Plane(**FLOOR, **surface).respond(0.0, s))(straight)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope))


def test_pinned_lanes_are_not_pushed_by_a_moving_wall():
    wall = contacts.Plane((0, 0), (1, 0), velocity=(1.0, 0.0), response=contacts.project)
    x = jnp.asarray([[0.5, 0.0], [0.5, 1.0]])
    scene = Scene(Particles(x, jnp.zeros_like(x)), contacts=(wall,), pinned=jnp.asarray([True, False]))
    flight = simulate(scene, methods.verlet, dt=0.1, steps=10)
    np.testing.assert_array_equal(flight.position[-1, 0], x[0])
    assert float(flight.position[-1, 1, 0]) > 0.9


def test_lanes_and_vmap_agree():
    def run(height):
        start = jnp.stack([jnp.zeros_like(height), height], axis=-1)
        floor = contacts.Plane(**FLOOR, restitution=0.9, response=contacts.project)
        scene = Scene(Particles(start, jnp.zeros_like(start)), forces=(forces.Gravity(),), contacts=(floor,))
        return simulate(scene, methods.verlet, dt=0.01, steps=100, save_every=100).position[-1]

    heights = jnp.linspace(0.2, 2.0, 7)
    np.testing.assert_allclose(run(heights), jax.vmap(run)(heights), rtol=1e-12)


def test_coupled_bodies_bounce_too():
    pair = Particles(jnp.asarray([[0.0, 1.0], [0.5, 1.0]]), jnp.asarray([[0.0, -3.0], [0.0, -3.0]]))
    scene = Scene(pair, forces=(forces.Gravitation(G=0.1),), contacts=(contacts.Plane(**FLOOR),))
    flight = simulate(scene, methods.verlet, dt=1e-3, steps=600)
    assert flight.ok.shape == ()
    assert float(flight.position[..., 1].min()) >= 0
    assert np.all(np.asarray(flight.velocity[-1, :, 1]) > 2.9)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: contacts.Plane((0, 0), (0, 0)), "not zero"),
        (lambda: contacts.Plane((0, 0), (0, np.nan)), "finite"),
        (lambda: contacts.Plane((0, 0), (0, 1), restitution=1.1), "from 0 to 1"),
        (lambda: contacts.Plane((0, 0), (0, 1), restitution=-0.1), "from 0 to 1"),
        (lambda: contacts.Plane((0, 0), (0, 1), friction=2.0), "from 0 to 1"),
        (lambda: contacts.Plane((0, 0), (0, 1), friction=0.1, coulomb=contacts.Coulomb(1, 1)), "at most one"),
        (lambda: contacts.Plane((0, 0), (0, 1), coulomb=0.4), r"coulomb: got 0\.4, expected contacts\.Coulomb"),
        (lambda: contacts.Plane(**FLOOR, response="impact"), "expected contacts.impact"),
        (lambda: contacts.Coulomb(0.2, 0.3), "at most the static"),
        (lambda: contacts.Coulomb(-0.2, -0.3), ">= 0"),
        (lambda: contacts.Sphere((0, 0), 0.0), "> 0"),
        (lambda: contacts.Room((0, 0), (1, 0)), "above the lower"),
        (lambda: ball(-0.5), "wrong side"),
        (lambda: Scene(Particles(jnp.zeros(2), jnp.zeros(2)), contacts=contacts.Plane(**FLOOR)), "tuple of contacts"),
        (lambda: Scene(Particles(jnp.zeros(2), jnp.zeros(2)), contacts=(forces.Gravity(),)), "expected a contact"),
        (lambda: reference(ball(1.0), [0.0, 1.0]), "has contacts"),
    ],
)
@pytest.mark.usefixtures("unannotated")
def test_bad_input_is_refused_in_plain_words(make, message):
    with pytest.raises((ValueError, TypeError), match=message):
        make()
