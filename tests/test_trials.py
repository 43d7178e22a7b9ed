"""What is wrong with a force is said while the scene is built, in a few lines that name it."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, forces, simulate, springs
from physjax.parts import Force

BALL = Particles(jnp.zeros(2), jnp.ones(2))


def decide(t, state, mass):
    return state.velocity if state.position[1] < 0 else 0 * state.velocity


@pytest.mark.parametrize(
    ("force", "words"),
    [
        (lambda t, state, mass: jnp.zeros(3), r"<lambda>: got an array of shape \(3,\)"),
        (lambda t, state, mass: jnp.zeros(2, jnp.int32), "dtype int32"),
        (lambda t, state, mass: None, "NoneType"),
        (lambda t, state: state.velocity, r"takes \(t, state\), expected the three arguments"),
        (lambda t, state, mass: np.sin(state.position), "Write jnp.sin in place of np.sin"),
        (lambda t, state, mass: math.sin(t) * state.velocity, "Write jnp.sin in place of np.sin and math.sin"),
        (lambda t, state, mass: float(mass) * state.velocity, r"leave float\(\) and int\(\) out"),
        (decide, "force decide: decides by a number.*\n.*jnp.where"),
    ],
)
def test_a_force_that_cannot_work_is_named_with_what_it_must_be(force, words):
    with pytest.raises(TypeError, match=words) as raised:
        Scene(BALL, forces=(forces.Gravity(), force))
    message = str(raised.value)
    assert message.splitlines()[-1].startswith("A force is (t, state, mass) -> newtons, e.g. def drag")
    assert len(message.splitlines()) <= 5
    assert raised.value.__cause__ is raised.value.__context__ is None  # nothing of JAX behind it
    assert "scene.py" in str(raised.traceback[-1].path)


def test_errors_of_its_own_are_raised_as_they_are():
    def broken(t, state, mass):
        return undefined_name * state.velocity

    with pytest.raises(NameError, match="undefined_name"):
        Scene(BALL, forces=(broken,))


def test_a_force_is_tried_once_for_states_of_the_same_shapes():
    calls = []

    def drag(t, state, mass):
        calls.append(1)
        return -0.1 * state.velocity

    for speed in (1.0, 2.0, 3.0):
        Scene(Particles(jnp.zeros(2), speed * jnp.ones(2)), forces=(drag,))
    assert len(calls) == 1
    Scene(Particles(jnp.zeros((4, 2)), jnp.ones((4, 2))), forces=(drag,))
    assert len(calls) == 2


def test_a_module_of_the_user_is_tried_and_its_numbers_may_be_traced():
    class Pull(Force):
        strength: jax.Array

        def __call__(self, t, state, mass):
            return -self.strength * state.position

    class Wrong(eqx.Module):
        def __call__(self, t, state, mass):
            return state.position[..., 0]

    jax.jit(lambda k: Scene(BALL, forces=(Pull(k),)).acceleration(0.0, BALL))(jnp.asarray(2.0))
    with pytest.raises(TypeError, match="force Wrong: got an array of shape"):
        Scene(BALL, forces=(Wrong(),))


def test_a_debugger_meets_real_numbers_alone():
    with jax.disable_jit():
        assert np.all(Scene(BALL, forces=(decide,)).acceleration(0.0, BALL) == 0)


def test_springs_to_nodes_that_are_not_there_are_refused_when_the_scene_is_built():
    three = Particles(jnp.zeros((3, 2)), jnp.zeros((3, 2)))
    with pytest.raises(ValueError, match="the pairs join 8 nodes"):
        Scene(three, forces=(springs.Springs([(0, 7)], 10.0, 1.0),))


def test_a_class_in_place_of_a_part_and_a_table_in_place_of_a_method_are_named(unannotated):
    with pytest.raises(TypeError, match=r"got the class Gravity, .* Call it\."):
        Scene(BALL, forces=(forces.Gravity,))
    with pytest.raises(TypeError, match="got the method of type dict"):
        simulate(Scene(BALL), {"order": 4}, dt=0.1, steps=1)
