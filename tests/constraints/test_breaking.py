"""Joints that carry more than they bear are gone from then on, and what they held moves on as if they had never been."""

import jax.numpy as jnp
import numpy as np
import pytest

from physjax import (
    Particles,
    Scene,
    constraint_forces,
    contacts,
    emitters,
    forces,
    inertia,
    methods,
    rigid,
    simulate,
    springs,
)
from physjax.show.lines import take_lines

G = 9.8


@pytest.fixture(scope="module")
def swung():
    """A bob released level with its pivot, on a rod that bears twice its weight, and on one that bears all."""
    x = jnp.tile(jnp.array([[1.0, 0.0]]), (2, 1, 1))
    rods = springs.Rods([(-1, 0)], anchors=[(0.0, 0.0)], breaks_at=[[2 * 3.0 * G], [1e6]])
    scene = Scene(Particles(x, jnp.zeros_like(x)), 3.0, (forces.Gravity(G), rods))
    return simulate(scene, methods.verlet, dt=1e-3, steps=800)


def test_a_bob_swung_beyond_the_strength_of_its_rod_flies_off_along_the_tangent(swung):
    weak = np.asarray(swung.parts[0].unbroken)[:, 0, 0]
    first = int(np.argmin(weak))
    assert weak[:first].all()
    assert not weak[first:].any()
    # the tension is 3 m g sin φ at an angle φ below the level, the speed √(2 g sin φ)
    x, v = (np.asarray(a)[first, 0, 0] for a in (swung.position, swung.velocity))
    assert -x[1] == pytest.approx(2 / 3, abs=3e-3)
    assert abs(x @ v) < 1e-12
    assert v @ v == pytest.approx(2 * G * -x[1], rel=1e-4)
    t = (np.asarray(swung.time)[first:] - float(swung.time[first]))[:, None]
    flight = x + t * v + 0.5 * t * t * np.array([0.0, -G])
    np.testing.assert_allclose(np.asarray(swung.position)[first:, 0, 0], flight, atol=1e-10)


def test_the_same_bob_on_a_rod_that_bears_it_swings_on(swung):
    assert np.asarray(swung.parts[0].unbroken)[:, 1].all()
    np.testing.assert_allclose(np.linalg.norm(swung.position[:, 1, 0], axis=-1), 1.0, atol=1e-11)


def test_rods_are_drawn_until_they_break(swung):
    held = np.asarray(swung.parts[0].unbroken)
    rods = swung.scene.forces[1]
    np.testing.assert_array_equal(take_lines("a test", swung, rods, scene=0).held, held[:, 0])


def test_a_bridge_of_chains_cut_in_its_middle_is_two_chains():
    links, cut = 5, 2
    angle = np.arcsin(np.linspace(-0.5, 0.5, links))
    steps = 0.5 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    x = jnp.asarray(np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]))
    ends = (np.arange(links + 1) == 0) | (np.arange(links + 1) == links)
    limits = np.where(np.arange(links) == cut, 1.0, 1e6)
    rods = springs.Rods([(i, i + 1) for i in range(links)], breaks_at=limits)
    bridge = Scene(Particles(x, jnp.zeros_like(x)), forces=(forces.Gravity(G), rods), pinned=ends)
    film = simulate(bridge, methods.verlet, dt=2e-3, steps=300)
    held = np.asarray(film.parts[0].unbroken)
    assert held[0].all()
    np.testing.assert_array_equal(held[1:], np.broadcast_to(limits > 1.0, (300, links)))
    length = np.linalg.norm(np.diff(film.position, axis=1), axis=-1)
    np.testing.assert_allclose(length[:, limits > 1.0], 0.5, atol=1e-11)
    assert length[-1, cut] > 2.0
    left = Particles(film.position[1, : cut + 1], film.velocity[1, : cut + 1])
    alone = Scene(left, forces=(forces.Gravity(G), springs.Rods([(0, 1), (1, 2)], 0.5)), pinned=ends[: cut + 1])
    half = simulate(alone, methods.verlet, dt=2e-3, steps=299, save_every=299)
    np.testing.assert_allclose(film.position[-1, : cut + 1], half.position[-1], atol=1e-9)


def test_a_weld_breaks_by_its_force_and_not_by_its_torque():
    plate = inertia.planar_plate(1.0, (4.0, 0.2))
    bars = rigid.planar_bodies(plate, [[[2.0, 0.0]], [[2.0, 0.0]]])
    # it carries the weight m g with a torque of 2 m g
    welds = rigid.Welds([(-1, 0)], [[[0.0, 0.0], [-2.0, 0.0]]], breaks_at=[[1.5 * G], [0.5 * G]])
    film = simulate(Scene(bars, plate, (forces.Gravity(G), welds)), methods.verlet, dt=0.01, steps=20)
    np.testing.assert_array_equal(film.parts[0].unbroken[-1], [[True], [False]])
    np.testing.assert_allclose(film.position[-1, 0], [[2.0, 0.0]], atol=1e-11)
    np.testing.assert_allclose(film.position[-1, 1], [[2.0, -0.5 * G * 0.19**2]], atol=1e-11)


@pytest.mark.usefixtures("unannotated")
def test_a_scene_with_joints_and_births_is_refused_while_it_is_built():
    source = emitters.Emitter(2, emitters.Point((0.0, 0.0)), key=0, life=1.0)
    with pytest.raises(ValueError, match="got an emitter and joints"):
        Scene(source.unborn(), forces=(springs.Rods([(0, 1)], 1.0),), emitter=source)


@pytest.mark.usefixtures("unannotated")
def test_strengths_that_do_not_fit_are_refused():
    x = jnp.array([[0.0, 0.0], [1.0, 0.0]])
    with pytest.raises(ValueError, match=r"breaks_at of shape \(3,\), expected \(\) or one for each joint, \(1,\)"):
        Scene(Particles(x, 0 * x), forces=(springs.Rods([(0, 1)], breaks_at=[1.0, 2.0, 3.0]),))
    with pytest.raises(ValueError, match=r"breaks_at \[N\]: got 0.0, expected numbers > 0"):
        springs.Rods([(0, 1)], breaks_at=0.0)
    with pytest.raises(ValueError, match="springs do not break"):
        rigid.Joints([(0, 1)], jnp.zeros((1, 2, 3)), 1.0, breaks_at=1.0)


def rest_a_box_on_a_beam(drop, breaks_at=None):
    """A beam of two welded planks of 2 kg on two pins 2 m apart, and a box of 10 kg above it, 0.8 m from the first."""
    plank, box = inertia.planar_plate(2.0, (1.0, 0.1)), inertia.planar_plate(10.0, (0.4, 0.4))
    bodies = rigid.PlanarInertia(
        jnp.stack([plank.mass, plank.mass, box.mass]), jnp.stack([plank.moment, plank.moment, box.moment])
    )
    pins = rigid.Joints([(-1, 0), (1, -1)], [[[0.0, 0.0], [-0.5, 0.0]], [[0.5, 0.0], [2.0, 0.0]]], breaks_at=breaks_at)
    weld = rigid.Welds([(0, 1)], [[[0.5, 0.0], [-0.5, 0.0]]])
    shapes = [rigid.PlanarShape.box((1.0, 0.1))] * 2 + [rigid.PlanarShape.box((0.4, 0.4))]
    solids = rigid.Solids(shapes, coulomb=contacts.Coulomb(0.5, 0.5), pairs=[(0, 2), (1, 2)])
    start = rigid.planar_bodies(bodies, [[0.5, 0.0], [1.5, 0.0], [0.8, 0.25 + drop]])
    return Scene(start, bodies, (forces.Gravity(9.8), pins, weld), (solids,))


def test_joints_carry_what_lies_on_the_bodies():
    film = simulate(rest_a_box_on_a_beam(0.0), methods.leapfrog, dt=1 / 60, steps=60)
    pins, weld = constraint_forces(film.final_scene)
    np.testing.assert_allclose(pins, [[0.0, -78.4], [0.0, 58.8]], atol=1e-6)
    np.testing.assert_allclose(weld, [[0.0, 39.2, 49.0]], atol=1e-6)


def test_a_hit_breaks_joints_that_hold_the_same_box_at_rest():
    for drop, holds in ((0.0, True), (1.0, False)):
        film = simulate(rest_a_box_on_a_beam(drop, 100.0), methods.leapfrog, dt=1 / 60, steps=60)
        assert (np.asarray(film.final_scene.forces[1].unbroken) == holds).all()
        assert (film.position[-1, 0, 1] > -0.01) == holds


def test_joints_in_space_carry_what_lies_on_the_bodies():
    plank, box = inertia.box(2.0, (1.0, 0.4, 0.1)), inertia.box(10.0, (0.3, 0.3, 0.3))
    bodies = inertia.Inertia(np.array([2.0, 10.0]), np.stack([plank.principal, box.principal]))
    weld = rigid.Welds([(-1, 0)], [[[0.0, 0.0, 0.0], [-0.5, 0.0, 0.0]]])
    shapes = [rigid.Shape.box((1.0, 0.4, 0.1)), rigid.Shape.box((0.3, 0.3, 0.3))]
    solids = rigid.Solids(shapes, coulomb=contacts.Coulomb(0.5, 0.5))
    start = rigid.bodies(bodies, [[0.5, 0.0, 0.0], [0.6, 0.03, 0.2]])
    scene = Scene(start, bodies, (forces.Gravity(9.8, up=2), weld), (solids,))
    film = simulate(scene, methods.leapfrog, dt=1 / 60, steps=60)
    ((found,),) = constraint_forces(film.final_scene)
    # of the box the force 98 N at (0.6, 0.03), of the plank 19.6 N in its middle
    np.testing.assert_allclose(np.abs(found), [0, 0, 117.6, 98 * 0.03, 98 * 0.6 + 19.6 * 0.5, 0], atol=1e-5)
