"""Led lanes are where their path is, with its velocity; a method keeps its order; bad pins are refused in plain words."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Pins, Scene, contacts, forces, lattices, methods, reference, simulate
from physjax.stepping.methods import METHODS

LINE = lattices.rope((0.0, 0.0), (1.0, 0.0), 5, mass=0.5, stiffness=100.0, damping=0.3)
START = LINE.nodes["start"]
HERE, REST = np.zeros((5, 2)), np.zeros((5, 2))


def swing(t):
    """Where the led end goes; the other lanes' numbers do not count."""
    return jnp.stack([0.1 * jnp.sin(3 * t), 0.2 * (1 - jnp.cos(4 * t))], axis=-1)


class Swing(eqx.Module):
    """The same with numbers that can be changed; NaN for every lane but the first."""

    reach: jax.Array

    def __call__(self, t):
        end = self.reach * jnp.stack([0.1 * jnp.sin(3 * t), 0.2 * (1 - jnp.cos(4 * t))], axis=-1)
        return jnp.full((5, 2), jnp.nan, end.dtype).at[0].set(end)


def rope(path=swing, state=LINE.state, **parts):
    pins = Pins(START, path)
    terms = (forces.Gravity(), LINE.springs)
    return Scene(pins.prescribe(0.0, state), LINE.mass, terms, pinned=pins, **parts)


@pytest.mark.parametrize(
    ("method", "precision"),
    [(method, ("float32", "float64")[i % 2]) for i, method in enumerate(METHODS.values())],
    indirect=["precision"],
    ids=METHODS,
)
def test_led_nodes_are_on_their_path_under_every_method(method, precision):
    state = Particles(*(jnp.asarray(a, precision.dtype) for a in LINE.state))
    flight = simulate(rope(state=state), method, dt=1e-3, steps=300, save_every=30)
    x, v = jax.vmap(lambda t: jax.jvp(swing, (t,), (jnp.ones_like(t),)))(flight.time)
    assert flight.position.dtype == precision.dtype
    np.testing.assert_allclose(flight.position[:, 0], x, rtol=0, atol=8 * precision.eps)
    np.testing.assert_allclose(flight.velocity[:, 0], v, rtol=0, atol=8 * precision.eps)
    assert np.abs(flight.position[-1, 1] - flight.position[0, 1]).max() > 0.01


@pytest.mark.parametrize(("method", "order"), [(methods.verlet, 2), (methods.rk4, 4)])
def test_a_method_keeps_its_order_with_a_led_node(method, order):
    scene = rope()
    truth = reference(scene, [0.0, 1.0], rtol=1e-13, atol=1e-13).position[-1]
    ends = [simulate(scene, method, dt=1 / n, steps=n, save_every=n).position[-1] for n in (400, 800, 1600)]
    errors = np.array([np.abs(end - truth).max() for end in ends])
    assert np.all(np.log2(errors[:-1] / errors[1:]) > order - 0.25), errors


def test_the_reference_follows_the_path_too():
    times = np.linspace(0, 1, 5)
    flight = reference(rope(), times)
    np.testing.assert_allclose(flight.position[:, 0], jax.vmap(swing)(jnp.asarray(times)), rtol=0, atol=1e-15)


def test_dampers_and_drag_feel_the_path_s_velocity():
    pins = Pins(np.array([True, False]), lambda t: jnp.array([2.0, 0.0]) * t)
    start = pins.prescribe(0.0, Particles(jnp.array([[0.0, 0.0], [1.0, 0.0]]), jnp.zeros((2, 2))))
    damper = lattices.rope((0.0, 0.0), (1.0, 0.0), 2, mass=1.0, stiffness=0.0, damping=3.0).springs
    scene = Scene(start, 1.0, (damper,), pinned=pins)
    np.testing.assert_array_equal(scene.state.velocity, [[2.0, 0.0], [0.0, 0.0]])
    np.testing.assert_allclose(scene.acceleration(0.0, scene.state), [[0.0, 0.0], [6.0, 0.0]], atol=1e-14)


def test_a_path_with_a_kink_is_followed_by_forces_and_reference_alike():
    there = lambda t: jnp.stack([jnp.interp(t, jnp.array([0.0, 0.3, 1.0]), jnp.array([0.0, 0.15, 0.15])), 0.0 * t])  # noqa: E731
    scene = rope(there)
    end = simulate(scene, methods.rk4, dt=1e-3, steps=500, save_every=500).final_scene.state
    truth = reference(scene, [0.0, 0.3, 0.5])
    np.testing.assert_allclose(end.position, truth.position[-1], rtol=0, atol=2e-5)


def test_numbers_of_a_path_are_swept_and_differentiated():
    def height(reach):
        run = simulate(rope(Swing(reach)), methods.verlet, dt=2e-3, steps=100, save_every=100)
        return run.final_scene.state.position[-2, 1]

    reach = jnp.asarray(1.0)
    slope, forward = jax.jit(jax.grad(height))(reach), jax.jit(jax.jacfwd(height))(reach)
    low, high = (float(height(jnp.asarray(r))) for r in (1 - 1e-5, 1 + 1e-5))
    assert slope == pytest.approx((high - low) / 2e-5, rel=1e-6)
    assert forward == pytest.approx(float(slope), rel=1e-10)
    swept = jax.vmap(height)(jnp.array([0.5, 1.0]))
    assert swept[1] == pytest.approx(float(height(reach)), rel=1e-12)


def test_each_scene_may_have_a_step_of_its_own():
    many = jnp.broadcast_to(LINE.state.position, (3, 5, 2))
    pins = Pins(np.tile(START, (3, 1)), swing)
    state = pins.prescribe(0.0, Particles(many, jnp.zeros_like(many)))
    scene = Scene(state, LINE.mass[None] * jnp.ones((3, 1)), (forces.Gravity(), LINE.springs), pinned=pins)
    flight = simulate(scene, methods.rk4, dt=jnp.array([1e-3, 2e-3, 4e-3]), steps=50, save_every=50)
    np.testing.assert_allclose(flight.position[-1, :, 0], swing(flight.time[-1][:, None])[:, 0], rtol=0, atol=1e-15)
    alone = simulate(rope(), methods.rk4, dt=4e-3, steps=50, save_every=50)
    np.testing.assert_allclose(flight.position[-1, 2], alone.position[-1], rtol=0, atol=1e-12)


def test_what_is_led_passes_contacts_and_the_rest_does_not():
    down = lambda t: jnp.stack([0.0 * t, -2.0 * t])  # noqa: E731
    floor = contacts.Plane((0.0, -0.1), (0.0, 1.0), restitution=0.0)
    flight = simulate(rope(down, contacts=(floor,)), methods.verlet, dt=1e-3, steps=200, save_every=20)
    np.testing.assert_allclose(flight.position[:, 0, 1], -2 * flight.time, rtol=0, atol=1e-15)
    assert flight.position[-1, 1, 1] == pytest.approx(-0.1, abs=1e-12)
    assert np.min(flight.position[:, 1:, 1]) > -0.1 - 1e-12


def test_a_mask_is_held_and_pins_say_who_is(unannotated):
    held = Scene(LINE.state, LINE.mass, (LINE.springs,), pinned=START)
    assert held.prescribed_motion is None
    assert Scene(LINE.state, LINE.mass).held is None
    np.testing.assert_array_equal(held.held, START)
    led = rope()
    np.testing.assert_array_equal(led.held, START)
    again = dataclasses.replace(led, mass=1.0)
    assert jax.tree.structure(again) == jax.tree.structure(led)


@pytest.mark.parametrize(
    ("nodes", "path", "error", "message"),
    [
        (np.arange(5), swing, ValueError, r"Pins: got nodes of dtype int64, expected booleans"),
        (np.ones(4, bool), swing, ValueError, r"nodes of shape \(4,\), expected booleans of the lanes' shape \(5,\)"),
        (START, HERE, TypeError, r"expected a function t -> positions\. To hold lanes .* pinned=nodes"),
        (START, None, TypeError, r"got the path None, expected a function"),
        (START, lambda t: jnp.zeros(3), ValueError, r"path returns float64 of shape \(3,\) .*shape \(5, 2\)"),
        (START, lambda t: jnp.zeros((2, 5, 2)), ValueError, r"path returns float64 of shape \(2, 5, 2\)"),
        (START, lambda t: jnp.array([t / 0.0, t]), ValueError, r"path\(0\) \[m\] is .* at lane \[0\], expected finite"),
        (START, lambda t: jnp.array([jnp.sqrt(t), t]), ValueError, r"velocity of the path at t = 0 .* expected finite"),
        (
            START,
            lambda t: jnp.array([t, t + 1.0]),
            ValueError,
            r"1 of 1 nodes .* lane \[0\] is at .* pins\.prescribe\(",
        ),
    ],
)
def test_bad_pins_are_answered_in_plain_words(nodes, path, error, message, unannotated):
    with pytest.raises(error, match=message):
        Scene(Particles(HERE, REST), pinned=Pins(nodes, path))


def test_a_led_lane_passes_what_others_bounce_off_in_time():
    """Impacts of independent lanes are timed; a led lane follows its path through the floor."""
    floor = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.8)
    still = jnp.zeros((2, 2))
    start = Particles(still.at[1, 1].set(1.0), still)
    path = lambda t: jnp.stack([0.5 * t, -jnp.sin(t)], axis=-1)  # noqa: E731
    pins = Pins(jnp.asarray([True, False]), path)
    both = Scene(pins.prescribe(0.0, start), forces=(forces.Gravity(),), contacts=(floor,), pinned=pins)
    alone = Scene(Particles(start.position[1], start.velocity[1]), forces=(forces.Gravity(),), contacts=(floor,))
    one, other = (simulate(scene, methods.rk4, dt=0.01, steps=200) for scene in (both, alone))
    np.testing.assert_allclose(one.position[:, 0], path(one.time), rtol=0, atol=1e-14)
    np.testing.assert_allclose(one.position[:, 1], other.position, rtol=0, atol=1e-12)
    assert other.position[:, 1].min() > -1e-14
    assert one.position[-1, 0, 1] < -0.8
