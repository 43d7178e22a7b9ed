"""Contacts of solids in the plane, asked for between steps: where they are, and what is pressed with."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, contacts, forces, inertia, methods, rigid, simulate

G, MASS, SLOPE = 9.8, 2.0, 0.3
CRATE = inertia.planar_plate(MASS, (1.0, 1.0))
BOX, DISC = rigid.PlanarShape.box((1.0, 1.0)), rigid.PlanarShape.disc(0.5)
FLOOR = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.0)
WALL = contacts.Plane((-3.0, 0.0), (1.0, 0.0), restitution=0.0)
FALL = (forces.Gravity(G),)


def test_pairs_come_first_and_then_each_surface_with_every_body():
    places = [[0.0, 0.75], [0.2, 2.0], [5.0, 0.5]]
    solids = rigid.Solids((BOX, BOX, DISC), surfaces=(FLOOR, WALL), pairs=[(0, 1), (2, 0)])
    found = rigid.find_planar_contacts(Scene(rigid.planar_bodies(CRATE, places), CRATE, contacts=(solids,)))
    np.testing.assert_array_equal(found.first, [0, 2, 0, 1, 2, 0, 1, 2])
    np.testing.assert_array_equal(found.second, [1, 0, -1, -1, -1, -1, -1, -1])
    np.testing.assert_array_equal(found.surface, [-1, -1, 0, 0, 0, 1, 1, 1])
    np.testing.assert_allclose(found.gaps[:, 0], [0.25, 4.0, 0.25, 1.5, 0.0, 2.5, 2.7, 7.5], atol=1e-12)
    np.testing.assert_allclose(np.asarray(found.normal)[[0, 2, 5]], [[0.0, 1.0], [0.0, -1.0], [-1.0, 0.0]], atol=1e-12)
    np.testing.assert_array_equal(found.is_point.sum(axis=-1), [2, 1, 2, 2, 1, 2, 2, 1])
    # halfway between the boxes, where they face each other
    np.testing.assert_allclose(np.sort(found.points[0], axis=0), [[-0.3, 1.375], [0.5, 1.375]], atol=1e-12)
    assert not found.impulses.any()


def test_a_surface_that_moves_is_where_it_is_at_the_time():
    lift = contacts.Plane((0.0, 0.0), (0.0, 1.0), velocity=(0.0, 0.5))
    scene = Scene(
        rigid.planar_bodies(CRATE, [[0.0, 2.5]]), CRATE, contacts=(rigid.Solids(BOX, surfaces=(lift,), pairs=()),)
    )
    np.testing.assert_allclose(rigid.find_planar_contacts(scene, 3.0).gaps, [[0.5, 0.5]], atol=1e-12)


def test_impulses_are_the_weight_over_a_sub_step():
    """Two worlds of two crates on a slope that friction holds, of 1 and 2 times the mass."""
    up, along = np.array([np.sin(SLOPE), np.cos(SLOPE)]), np.array([np.cos(SLOPE), -np.sin(SLOPE)])
    rough = contacts.Coulomb(0.9, 0.9)
    slope = contacts.Plane((0.0, 0.0), tuple(up), restitution=0.0, coulomb=rough)
    crates = inertia.planar_plate(MASS * jnp.array([[1.0, 1.0], [2.0, 2.0]]), (1.0, 1.0))
    solids = rigid.Solids(BOX, surfaces=(slope,), coulomb=rough)
    pile = rigid.planar_bodies(crates, np.stack([0.5 * up, 1.5 * up]) + 0.0 * along, angle=-SLOPE)
    run = simulate(Scene(pile, crates, FALL, contacts=(solids,)), methods.verlet, dt=1 / 60, steps=90)
    found = rigid.find_planar_contacts(run.final_scene, run.time[-1])
    forces_on_second = found.impulses.sum(axis=-2) / (run.dt / solids.substeps)
    weight = MASS * G * jnp.array([[1.0], [2.0]])
    # the upper crate presses the lower one: on the upper, second, its weight upwards; on the slope both, downwards
    np.testing.assert_allclose(forces_on_second[:, 0, 1:], weight, rtol=2e-3)
    np.testing.assert_allclose(forces_on_second[:, 1, 1:], -2 * weight, rtol=2e-3)
    np.testing.assert_allclose(forces_on_second[..., 0], 0.0, atol=0.02 * MASS * G)
    np.testing.assert_allclose(found.impulses[:, 2], 0.0, atol=1e-12)
    assert float(jnp.abs(found.gaps[:, :2]).max()) < 1e-3


def test_it_works_mapped_and_differentiated():
    plain = Scene(
        rigid.planar_bodies(CRATE, [[0.0, 0.75]]), CRATE, contacts=(rigid.Solids(BOX, surfaces=(FLOOR,), pairs=()),)
    )

    def gap(height, angle):
        state = plain.state._replace(position=jnp.array([[0.0, 1.0]]) * height, angle=angle[None])
        return rigid.find_planar_contacts(plain.replace(state=state)).gaps[0].min()

    up, turn = jax.grad(gap, argnums=(0, 1))(jnp.asarray(2.0), jnp.asarray(0.3))
    # the lowest corner of a box turned by θ is (sin θ + cos θ)/2 below its middle
    np.testing.assert_allclose([up, turn], [1.0, -(np.cos(0.3) - np.sin(0.3)) / 2], atol=1e-12)
    heights = jnp.array([1.0, 2.0])
    gaps = jax.vmap(gap, in_axes=(0, None))(heights, jnp.asarray(0.3))
    np.testing.assert_allclose(gaps, heights - (np.sin(0.3) + np.cos(0.3)) / 2, atol=1e-12)


def test_other_scenes_are_refused():
    with pytest.raises(ValueError, match=r"got a scene of Particles with 0 rigid\.Solids"):
        rigid.find_planar_contacts(Scene(Particles(jnp.zeros(2), jnp.zeros(2))))
    with pytest.raises(ValueError, match="without pairs or surfaces"):
        rigid.find_planar_contacts(
            Scene(rigid.planar_bodies(CRATE, [[0.0, 0.0]]), CRATE, contacts=(rigid.Solids(BOX, pairs=()),))
        )
