"""The largest stable step of bodies in the plane: of what swings and of what turns, with and without sub-steps."""

import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Scene, forces, inertia, methods, rigid, springs, stability
from physjax.study.stability.cures import list_resolution_cures

MASS, STIFFNESS, DRAG, TWIST = 2.0, 800.0, 5.0, 12.0
DISC = inertia.planar_disc(MASS, 0.5)  # its moment is 0.25 kg m²
PAIR = rigid.planar_bodies(DISC, [[0.0, 2.0], [1.0, 2.0]])
SPRING = springs.Springs([(0, 1)], rest_length=1.0, stiffness=STIFFNESS)
SOLIDS = rigid.Solids(rigid.PlanarShape.disc(0.3), substeps=4)
SWINGING = Scene(PAIR, DISC, (forces.Gravity(), SPRING))
TOUCHING = Scene(PAIR, DISC, (forces.Gravity(), SPRING), contacts=(SOLIDS,))
SWING_LIMIT = 2 / np.sqrt(2 * STIFFNESS / MASS)


def twist(t, bodies, inertia):
    """A spring that turns each body back."""
    return rigid.Wrench(None, -TWIST * bodies.angle)


def test_a_spring_between_bodies_sets_the_limit_it_sets_between_particles():
    found = stability.limit(SWINGING, methods.verlet)
    np.testing.assert_allclose(found.dt, SWING_LIMIT, rtol=1e-9)
    assert (found.cause, found.force, found.spring) == ("stiffness", "Springs", (0, 1))
    np.testing.assert_allclose(stability.measure_limit(SWINGING, methods.verlet, steps=400), SWING_LIMIT, rtol=5e-3)
    assert not stability.grows_by_itself(SWINGING)


def test_what_turns_has_a_limit_of_its_own():
    turned = Scene(PAIR, DISC, (forces.Gravity(), rigid.on_bodies(twist)))
    found = stability.limit(turned, methods.verlet)
    np.testing.assert_allclose(found.each, 2 / np.sqrt(TWIST / 0.25) * np.ones(2), rtol=1e-9)
    assert found.cause == "stiffness"
    slowed = Scene(PAIR, DISC, (forces.Gravity(), rigid.RotationalDrag(DRAG)))
    found = stability.limit(slowed, methods.euler)
    np.testing.assert_allclose(found.dt, 2 * 0.25 / DRAG, rtol=1e-9)
    assert (found.cause, found.force) == ("damping", "RotationalDrag")


def test_a_step_of_solids_is_as_many_of_the_method_as_they_have_sub_steps():
    np.testing.assert_allclose(stability.limit(TOUCHING, methods.verlet).dt, 4 * SWING_LIMIT, rtol=1e-9)
    growth = float(stability.growth(TOUCHING, methods.verlet, 0.3))
    np.testing.assert_allclose(growth, float(stability.growth(SWINGING, methods.verlet, 0.3 / 4)) ** 4, rtol=1e-9)
    np.testing.assert_allclose(stability.measure_growth(TOUCHING, methods.verlet, 0.3, steps=200), growth, rtol=1e-6)


def test_another_state_is_that_of_bodies():
    apart = PAIR._replace(position=jnp.array([[0.0, 2.0], [0.5, 2.0]]))  # a spring that is pressed pushes sideways
    assert stability.grows_by_itself(SWINGING, at=apart)
    np.testing.assert_allclose(stability.limit(SWINGING, methods.verlet, at=apart).dt, SWING_LIMIT, rtol=1e-9)
    with pytest.raises(TypeError, match="expected the scene's PlanarBodies"):
        stability.limit(SWINGING, methods.verlet, at=PAIR[:2])  # pyright: ignore[reportArgumentType]


def test_a_run_says_what_is_too_fast_for_its_step():
    found = stability.explain(SWINGING, methods.verlet, dt=0.05, steps=24)
    assert (found.cause, found.force, found.first_bad_step) == ("resolution", "Springs", -1)
    np.testing.assert_allclose(found.limit, SWING_LIMIT, rtol=1e-6)


def test_what_is_too_fast_for_the_sub_step_asks_for_a_finer_one():
    cures = list_resolution_cures(0.2, stability.limit(TOUCHING, methods.verlet), SOLIDS.substeps)
    assert cures[0].startswith(f"dt = {1e3 * 4 * 0.1 / np.sqrt(2 * STIFFNESS / MASS):.3g} ms")
