"""A scene holds what it was given, in one dtype, and answers bad input in plain words before anything is compiled."""

import dataclasses
import itertools
import re

import hypothesis.extra.numpy as nps
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from physjax import Particles, Scene, forces, loads, methods, simulate

SPRING = forces.Anchor(point=np.zeros(2), stiffness=3.0)
TERMS = (
    forces.Gravity(),
    forces.StokesDrag(coefficient=0.3),
    forces.QuadraticDrag(area=0.1, coefficient=0.4),
    SPRING,
)

tried = settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
shapes = nps.array_shapes(min_dims=1, max_dims=3, max_side=4)


def still(*shape, dtype=float):
    return Particles(np.zeros(shape, dtype), np.zeros(shape, dtype))


def five(dtype=float):
    """Five balls in the plane, somewhere, moving."""
    x, v = np.random.default_rng(1).normal(size=(2, 5, 2))
    return Particles(jnp.asarray(x, dtype), jnp.asarray(v, dtype))


@pytest.mark.parametrize("shape", [(2,), (3, 2), (4, 3, 3)])
def test_every_number_becomes_an_array_of_the_states_type(shape, precision):
    scene = Scene(
        still(*shape, dtype=precision.dtype),
        mass=np.full(shape[:-1], 2, np.float16),
        forces=(forces.Gravity(g=10), forces.Constant(np.ones(shape, np.float16)), forces.StokesDrag(jnp.asarray(0.1))),
    )
    assert scene.state.lanes == scene.mass.shape == shape[:-1]
    for leaf in jax.tree.leaves(scene):
        assert leaf.dtype == precision.dtype
        assert not leaf.weak_type, "a weak number would compile anew where a strong one stood"
    assert loads(scene, 0.0).dtype == precision.dtype


def test_a_float32_state_stays_float32_beside_float64_numbers():
    scene = Scene(five(jnp.float32), mass=np.ones(5), forces=(forces.Gravity(np.full(5, 9.8)), *TERMS))
    assert {leaf.dtype for leaf in jax.tree.leaves(scene)} == {jnp.dtype("float32")}
    assert scene.acceleration(0.0, scene.state).dtype == jnp.float32


def test_lists_and_integers_are_a_state():
    state = Scene(Particles([0, 1], [2, 3])).state
    np.testing.assert_array_equal(state, [[0.0, 1.0], [2.0, 3.0]])
    assert state.dtype == state.velocity.dtype == float


def test_newtons_second_law_per_lane():
    state, mass = five(), jnp.arange(1.0, 6.0)
    scene = Scene(state, mass, TERMS)
    total = scene.acceleration(0.0, state)
    np.testing.assert_allclose(total, loads(scene, 0.0) / mass[:, None], rtol=1e-14, atol=0)
    x, v = map(np.asarray, state)
    drag = 0.3 + 0.5 * 1.225 * 0.1 * 0.4 * np.linalg.norm(v, axis=-1, keepdims=True)
    by_hand = np.array([0.0, -9.8]) - (drag * v + 3.0 * x) / np.arange(1.0, 6.0)[:, None]
    np.testing.assert_allclose(total, by_hand, rtol=0, atol=1e-14)


def test_the_total_load_is_the_sum_of_its_terms():
    scene = Scene(five(), 2.0, TERMS)
    terms = loads(scene, 0.0, per_term=True)
    assert len(terms) == len(TERMS)
    np.testing.assert_array_equal(terms[0], np.tile([0.0, -19.6], (5, 1)))
    np.testing.assert_array_equal(terms[3], -3.0 * scene.state.position)
    np.testing.assert_allclose(loads(scene, 0.0), sum(map(np.asarray, terms)), rtol=1e-15, atol=1e-15)
    elsewhere = Particles(1.0 + scene.state.position, scene.state.velocity)
    np.testing.assert_allclose(loads(scene, 0.0, elsewhere) - loads(scene, 0.0), -3.0, rtol=1e-14, atol=0)


def test_without_forces_nothing_pushes():
    scene = Scene(five())
    np.testing.assert_array_equal(scene.acceleration(0.0, scene.state), np.zeros((5, 2)))
    np.testing.assert_array_equal(loads(scene, 0.0), np.zeros((5, 2)))
    assert loads(scene, 0.0, per_term=True) == ()


def test_the_order_of_the_forces_does_not_matter_beyond_rounding(precision):
    state = five(precision.dtype)
    term_size = sum(np.abs(term) for term in loads(Scene(state, 2.0, TERMS), 0.0, per_term=True))
    totals = [Scene(state, 2.0, order).acceleration(0.0, state) for order in itertools.permutations(TERMS)]
    assert np.all(np.ptp(np.stack(totals), axis=0) <= 4 * precision.eps * term_size / 2.0)


def test_held_lanes_rest_and_the_others_do_not_notice(precision):
    held = np.array([True, False, False, True, False])
    state = five(precision.dtype)
    free, pinned = Scene(state, 2.0, TERMS), Scene(state, 2.0, TERMS, pinned=held)
    flights = [simulate(scene, methods.verlet, dt=0.125, steps=8) for scene in (free, pinned)]
    x, v = flights[1].position, flights[1].velocity
    np.testing.assert_array_equal(x[:, held], np.broadcast_to(state.position[held], (9, 2, 2)))
    np.testing.assert_array_equal(v[:, held], np.zeros((9, 2, 2)))
    np.testing.assert_allclose(x[:, ~held], flights[0].position[:, ~held], rtol=0, atol=64 * precision.eps)
    assert np.all(np.abs(np.diff(x[:, ~held], axis=0)).max(axis=(0, 2)) > 0.01), "the others do move"


def plain(t, state, mass):
    return -state.position


@pytest.mark.parametrize(
    ("terms", "couples"),
    [
        ((), False),
        (TERMS, False),
        ((forces.Gravitation(),), True),
        ((*TERMS, forces.Gravitation()), True),
        ((plain,), True),
        ((forces.independent(plain), *TERMS), False),
        ((forces.independent(plain), plain), True),
    ],
)
def test_status_is_per_lane_unless_a_force_couples(terms, couples):
    scene = Scene(still(4, 3, 2), forces=terms)
    assert scene.couples is couples
    assert scene.status_shape == ((4,) if couples else (4, 3))
    state = scene.state._replace(velocity=scene.state.velocity.at[1, 2, 0].set(jnp.nan))
    finite = np.ones(scene.status_shape, bool)
    finite[1 if couples else (1, 2)] = False
    np.testing.assert_array_equal(scene.finite(state), finite)


@pytest.mark.parametrize("value", [0.0, jnp.zeros(2), jnp.zeros((5, 1)), jnp.zeros((5, 2), jnp.float32)])
def test_a_force_of_another_shape_or_type_is_named(value, unannotated):
    def push(t, state, mass):
        return value

    for ask in (loads, lambda scene, t: simulate(scene, methods.euler, dt=0.1, steps=1)):
        with pytest.raises(
            TypeError, match=r"force push: got an array of shape .* expected \(5, 2\) and float64"
        ) as error:
            ask(Scene(five(), forces=(push,)), 0.0)
        assert "Build it from state and mass" in str(error.value)


def test_a_scene_can_be_built_while_tracing():
    def pull(k, x, mass):
        scene = Scene(Particles(x, jnp.zeros_like(x)), mass, (forces.Anchor(jnp.zeros(2), k), forces.Gravity()))
        return scene.acceleration(0.0, scene.state)[..., 1].sum()

    x = five().position
    assert jnp.allclose(jax.jit(pull)(3.0, x, 2.0), -1.5 * x[:, 1].sum() - 5 * 9.8, rtol=1e-14)
    by_mass = jax.vmap(pull, in_axes=(None, None, 0))(3.0, x, jnp.asarray([1.0, 2.0]))
    np.testing.assert_allclose(by_mass, [pull(3.0, x, 1.0), pull(3.0, x, 2.0)], rtol=1e-14)
    by_lane = jax.vmap(pull, in_axes=(None, 0, None))(3.0, x, 2.0)
    np.testing.assert_allclose(by_lane, -1.5 * x[:, 1] - 9.8, rtol=1e-14)
    np.testing.assert_allclose(jax.grad(pull)(3.0, x, 2.0), -x[:, 1].sum() / 2, rtol=1e-14)
    with pytest.raises(ValueError, match=r"mass \[kg\]: got shape \(3,\), expected \(\) or the lanes' shape \(5,\)"):
        jax.jit(pull)(3.0, x, jnp.ones(3))


def test_replace_makes_a_checked_copy_that_differs_in_one_thing(unannotated):
    scene = Scene(five(), 2.0, (*TERMS, plain), pinned=np.arange(5) == 0)
    heavier = dataclasses.replace(scene, mass=np.full(5, 3.0))
    assert heavier.mass.shape == (5,)
    assert jax.tree.structure(heavier) == jax.tree.structure(scene)
    np.testing.assert_array_equal(heavier.state, scene.state)
    assert dataclasses.replace(scene, forces=()).forces == ()
    with pytest.raises(ValueError, match=r"mass \[kg\]: got -1\.0, expected numbers > 0"):
        dataclasses.replace(scene, mass=-1)


@tried
@given(shapes, shapes)
def test_position_and_velocity_of_two_shapes(unannotated, one, other):
    assume(one != other)
    message = (
        f"Particles: got position {one} and velocity {other}, expected the same shape (*lanes, dim): component last"
    )
    with pytest.raises(ValueError, match=re.escape(message)):
        Scene(Particles(np.zeros(one), np.zeros(other)))


def test_numbers_are_no_vectors_and_no_lanes_no_scene(unannotated):
    with pytest.raises(
        ValueError, match=r"got position \(\) and velocity \(\), expected the same shape \(\*lanes, dim\)"
    ):
        Scene(Particles(1.0, 2.0))
    for shape in ((0, 2), (3, 0), (4, 0, 2)):
        message = re.escape(f"Particles: got the empty shape {shape}, expected at least one lane and one component")
        with pytest.raises(ValueError, match=message):
            Scene(still(*shape))


@tried
@given(st.data(), st.sampled_from([np.nan, np.inf, -np.inf]), st.sampled_from(["position [m]", "velocity [m/s]"]))
def test_a_state_that_is_not_finite(unannotated, data, bad, field):
    shape = data.draw(shapes)
    index = tuple(data.draw(st.integers(0, n - 1)) for n in shape)
    arrays = {"position [m]": np.zeros(shape), "velocity [m/s]": np.zeros(shape)}
    arrays[field][index] = bad
    where = index if len(index) > 1 else index[0]
    message = re.escape(f"{field}: got {bad} at index {where} (1 of ") + ".*expected finite numbers"
    with pytest.raises(ValueError, match=message):
        Scene(Particles(*arrays.values()))


@tried
@given(st.integers(0, 4), st.one_of(st.just(0.0), st.floats(max_value=-1e-300, allow_nan=False, allow_infinity=False)))
def test_a_mass_that_is_not_positive(unannotated, lane, bad):
    mass = np.ones(5)
    mass[lane] = bad
    with pytest.raises(ValueError, match=rf"mass \[kg\]: got .* at index {lane} .*expected numbers > 0"):
        Scene(five(), mass)
    with pytest.raises(ValueError, match=r"mass \[kg\]: got .*expected numbers > 0"):
        Scene(five(), bad)


@tried
@given(st.sampled_from([np.nan, np.inf]), st.integers(0, 4))
def test_a_mass_that_is_not_finite(unannotated, bad, lane):
    mass = np.ones(5)
    mass[lane] = bad
    with pytest.raises(ValueError, match=rf"mass \[kg\]: got {bad} at index {lane} .*expected finite numbers"):
        Scene(five(), mass)


@tried
@given(nps.array_shapes(min_dims=1, max_dims=3, max_side=6), shapes)
def test_a_mass_of_another_shape_than_the_lanes(unannotated, shape, state):
    assume(shape != state[:-1])
    message = re.escape(f"mass [kg]: got shape {shape}, expected () or the lanes' shape {state[:-1]}.")
    with pytest.raises(ValueError, match=message):
        Scene(still(*state), np.ones(shape))


@pytest.mark.parametrize("bad", [np.ones(2, bool), np.ones(2, complex), np.array(["a", "b"]), None, "ab"])
def test_what_is_no_real_vector_or_number(unannotated, bad):
    for field in ("position", "velocity"):
        state = Particles(np.zeros(2), np.zeros(2))._replace(**{field: bad})
        with pytest.raises(TypeError, match=rf"^{field}: got .*, expected real"):
            Scene(state)
    with pytest.raises(TypeError, match=r"^mass \[kg\]: got .*, expected real"):
        Scene(still(2), bad)


def test_one_dtype_for_the_state(unannotated):
    with pytest.raises(
        TypeError, match=r"got position float64 and velocity float32, expected one dtype\. Cast one of them"
    ):
        Scene(Particles(np.zeros(2), np.zeros(2, np.float32)))


@pytest.mark.parametrize("bad", [np.zeros((3, 2)), None, 1.0])
def test_a_state_that_is_no_record(unannotated, bad):
    with pytest.raises(TypeError, match=r"Scene: got a state of type \w+, expected Particles\(position, velocity\)"):
        Scene(bad)


@pytest.mark.parametrize(
    "bad", [np.zeros(5, int), np.zeros(4, bool), np.zeros((5, 2), bool), np.array(True), [0, 3], np.zeros(5)]
)
def test_a_mask_that_does_not_fit_the_lanes(unannotated, bad):
    with pytest.raises(ValueError, match=r"pinned: got \w+ of shape .*, expected booleans of the lanes' shape \(5,\)"):
        Scene(five(), pinned=bad)


@pytest.mark.parametrize("bad", [forces.Gravity(), plain, None, 3.0])
def test_forces_that_are_no_tuple(unannotated, bad):
    with pytest.raises(TypeError, match=r"forces: got \w+, expected a tuple of forces\. Write forces=\(force,\)\."):
        Scene(five(), forces=bad)


@pytest.mark.parametrize("bad", [9.8, None, "gravity", np.zeros(2), forces.Gravity])
def test_a_force_that_cannot_be_one(unannotated, bad):
    with pytest.raises(
        TypeError, match=r"forces: got .*, expected a force: a callable \(t, state, mass\) -> newtons\."
    ):
        Scene(five(), forces=(forces.Gravity(), bad))


def test_up_is_the_axis_of_the_weight_else_of_what_has_one_else_y():
    space, line = Particles(jnp.zeros(3), jnp.zeros(3)), Particles(jnp.zeros(1), jnp.zeros(1))
    lift = forces.Buoyancy(1.2, volume=1.0, up=2)
    assert Scene(space).up == 1
    assert Scene(space, forces=(lift,)).up == 2
    assert Scene(space, forces=(lift, forces.Gravity(up=2))).up == 2
    assert Scene(line).up == 0
    assert Scene(line, forces=(forces.Gravity(up=0),)).up == 0
