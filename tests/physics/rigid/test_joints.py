"""Joints hold two points together: what they keep, how far they part, a hinge's one freedom, bad input."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Scene, contacts, energy, forces, inertia, methods, rigid, simulate

ROD = inertia.box(1.0, (0.05, 0.4, 0.05))
ENDS = [[0.0, -0.2, 0.0], [0.0, 0.2, 0.0]]


def chain(n=4, stiffness=1e5, damping=0.0, acting=(), pinned=None, **start):
    place = np.zeros((n, 3))
    place[:, 1] = -0.4 * np.arange(n)
    joints = rigid.Joints([[i, i + 1] for i in range(n - 1)], [ENDS] * (n - 1), stiffness, damping)
    return Scene(rigid.bodies(ROD, place, **start), ROD, (*acting, joints), pinned=pinned), joints


def test_a_free_chain_keeps_momentum_angular_momentum_and_energy():
    rng = np.random.default_rng(0)
    scene, joints = chain(velocity=rng.normal(size=(4, 3)), angular_velocity=rng.normal(size=(4, 3)))
    assert scene.couples
    film = simulate(scene, methods.rk4, dt=1e-4, steps=4000, save_every=200)
    for quantity, off in ((energy.MOMENTUM, 1e-13), (energy.ANGULAR_MOMENTUM, 1e-8), (energy.ENERGY, 1e-5)):
        values = np.asarray(jax.vmap(lambda t, s, q=quantity: q.value(scene, t, s))(film.time, film.state))
        assert np.abs(values - values[:1]).max() < off * float(quantity.size(scene, 0.0, scene.state)), quantity.name
    assert jax.vmap(joints.error)(film.state).max() < 0.02


def test_a_hanging_chain_separates_by_its_weight_over_the_stiffness():
    held = jnp.asarray([True, False, False, False])
    scene, joints = chain(damping=300.0, acting=(forces.Gravity(),), pinned=held)
    end = simulate(scene, methods.rk4, dt=1e-3, steps=2000, save_every=2000).final_scene.state
    np.testing.assert_allclose(joints.error(end), 9.8 * np.array([3, 2, 1]) / 1e5, rtol=1e-6)


def test_a_hinge_turns_about_its_axis_alone():
    pairs, points = rigid.hinge((0, 1), ENDS, (0.0, 0.0, 1.0), 0.1)
    hinge = rigid.Joints(pairs, points, 1e5, 20.0)
    place, held = np.array([[0.0, 0, 0], [0, -0.4, 0]]), jnp.asarray([True, False])
    start = rigid.bodies(ROD, place, angular_velocity=np.array([[0.0, 0, 0], [0.3, 0.3, 0.0]]))
    film = simulate(Scene(start, ROD, (hinge,), pinned=held), methods.rk4, dt=5e-4, steps=1000, save_every=1000)
    _, x, y, _ = film.state.orientation[-1, 1]
    assert max(abs(float(x)), abs(float(y))) < 1e-3
    start = rigid.bodies(
        ROD, place, velocity=np.array([[0.0, 0, 0], [0.2, 0, 0]]), angular_velocity=np.array([[0.0, 0, 0], [0, 0, 1.0]])
    )
    film = simulate(Scene(start, ROD, (hinge,), pinned=held), methods.rk4, dt=5e-4, steps=1000, save_every=1000)
    angle = 2 * math.asin(float(film.state.orientation[-1, 1, 3]))
    assert angle == pytest.approx(0.5, rel=1e-3)


@pytest.mark.slow
def test_a_chain_that_falls_on_the_floor_runs_adaptively_too():
    scene, _ = chain(n=2, damping=300.0, acting=(forces.Gravity(),), orientation=(1.0, 0.0, 0.0, 0.1))
    floor = contacts.Plane((0.0, -0.7, 0.0), (0.0, 1.0, 0.0), coulomb=contacts.Coulomb(0.5, 0.5))
    scene = scene.replace(contacts=(rigid.SurfaceContact(rigid.ContactPoints.box((0.05, 0.4, 0.05)), floor),))
    fine = simulate(scene, methods.rk4, dt=2e-4, steps=1500, save_every=1500)
    own = simulate(scene, methods.adaptive(methods.rk4, 1e-8, 1e-8), dt=2e-3, steps=150, save_every=150)
    assert own.ok
    np.testing.assert_allclose(own.position[-1], fine.position[-1], atol=2e-3)
    assert float(fine.position[-1, 1, 1]) < -0.48  # it lies there


@pytest.mark.usefixtures("unannotated")
@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: rigid.Joints([[0, 0]], [ENDS], 1.0), "different bodies"),
        (lambda: rigid.Joints([[0.0, 1.0]], [ENDS], 1.0), "indices of different bodies"),
        (lambda: rigid.Joints([[0, 1]], ENDS, 1.0), "one on each body"),
        (lambda: rigid.Joints([[0, 1]], [ENDS], 0.0), "numbers > 0"),
        (lambda: rigid.hinge((0, 1), ENDS, (0, 0, 0), 0.1), "a direction"),
    ],
)
def test_bad_input_is_refused_in_plain_words(build, words):
    with pytest.raises(ValueError, match=words):
        build()
