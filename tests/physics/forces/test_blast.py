"""A blast gives each lane the impulse of its closed form, under every method and at every step."""

import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, forces, methods, simulate
from physjax.stepping.methods import METHODS

CENTER, J, REACH = np.array([0.2, -0.1, 0.3]), np.array([1.0, 2.0, 0.5, 3.0]), 0.7
PLACES = np.array([[0.2, -0.1, 1.0], [1.5, 0.4, 0.0], [-3.0, 2.0, 9.0], [0.2, -0.1, 0.3]])


def closed_form(x):
    d = x - CENTER
    length = np.linalg.norm(d, axis=-1, keepdims=True)
    return J[:, None] / (1 + (length / REACH) ** 2) * d / np.where(length > 0, length, 1.0)


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_every_lane_gets_the_impulse_of_its_distance(method, precision):
    heavy = 1e20  # so that none moves while the blast lasts
    state = Particles(jnp.asarray(PLACES, precision.dtype), jnp.zeros((4, 3), precision.dtype))
    blast = forces.Blast(CENTER, J, REACH, at=0.031, duration=0.02)
    scene = Scene(state, heavy, (blast,))
    for dt in (0.01, 0.05, 1 / 300):
        end = simulate(scene, method, dt=dt, steps=30, save_every=30).final_scene.state
        found = heavy * np.asarray(end.velocity, float)
        np.testing.assert_allclose(found, closed_form(PLACES), rtol=0, atol=64 * precision.eps * J.max())
    np.testing.assert_array_equal(end.velocity[3], 0)  # in the center


def test_half_of_it_arrives_at_the_reach_and_it_thins_as_a_wave_that_spreads():
    blast = forces.Blast((0.0, 0.0), 4.0, 2.0, at=0.0, duration=1.0)
    x = jnp.array([[2.0, 0.0], [0.0, -2e6], [0.0, 1e-9]])
    got = np.asarray(blast.lane_impulse(Particles(x, x)))
    np.testing.assert_allclose(got, [[2.0, 0], [0, -4.0 / 1e12], [0, 4.0]], rtol=1e-11)


def test_a_blast_lasts_from_its_start_to_just_before_its_end():
    blast = forces.Blast((0.0, 0.0), 4.0, 2.0, at=0.25, duration=0.5)
    here = Particles(jnp.array([2.0, 0.0]), jnp.zeros(2))
    seen = [float(blast(t, here, jnp.ones(()))[0]) for t in (0.0, np.nextafter(0.25, 0.0), 0.25, 0.5, 0.75, 9.0)]
    np.testing.assert_allclose(seen, [0, 0, 4, 4, 0, 0], rtol=1e-15)
    assert blast.discontinuities() == (0.25, 0.75)


def test_a_blast_that_meets_the_steps_keeps_the_order_of_the_method():
    state = Particles(jnp.array([[0.1, 0.0], [1.0, 0.5]]), jnp.array([[1.0, 2.0], [0.0, 0.0]]))
    scene = Scene(state, 1.0, (forces.Blast((0.0, 0.0), 3.0, 0.5, at=0.25, duration=0.5), forces.Gravity()))
    ends = [simulate(scene, methods.rk4, dt=1 / n, steps=n, save_every=n).position[-1] for n in (16, 32, 64, 1024)]
    errors = np.array([np.abs(end - ends[-1]).max() for end in ends[:-1]])
    assert np.all(np.log2(errors[:-1] / errors[1:]) > 3.5), errors


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"reach": 0.0}, r"reach of the blast \[m\]: got 0\.0, expected numbers > 0"),
        ({"duration": -1.0}, r"duration of the blast \[s\]: got -1\.0, expected numbers > 0"),
        ({"center": np.array([0.0, np.nan])}, r"center of the blast \[m\]: got nan at index 1"),
    ],
)
def test_bad_input_is_answered_in_plain_words(numbers, message, unannotated):
    with pytest.raises(ValueError, match=message):
        forces.Blast(**{"center": (0.0, 0.0), "impulse": 1.0, "reach": 1.0, "at": 0.0, "duration": 1.0} | numbers)
