"""The step that bodies bear that spin fast: within it free bodies keep their energy, beyond it they do not."""

import jax
import numpy as np
import pytest

from physjax import Scene, inertia, methods, rigid, simulate, stability

NEEDLE = inertia.cylinder(1.0, 0.01, 2.0, axis=0), (300.0, 20.0, 5.0)
PLATE = inertia.box(1.0, (1.0, 0.02, 0.6)), (40.0, 60.0, 30.0)
NEAR_ROD = inertia.box(1.0, (2.0, 0.02, 0.03)), (500.0, 3.0, 1.0)


def spinning(body, spin):
    return Scene(rigid.bodies(body, angular_velocity=spin, frame="body"), body)


def change_energy(scene, method, dt):
    """The largest share by which the energy changes in 3600 steps."""
    run = simulate(scene, method, dt=dt, steps=3600, save_every=30)
    energy = np.asarray(jax.vmap(lambda state: state.kinetic_energy(scene.mass))(run.state))
    return np.abs(energy / energy[0] - 1).max()


@pytest.mark.parametrize("name", ["semi_implicit_euler", "verlet", "leapfrog", "rk4"])
def test_at_half_the_limit_free_bodies_keep_their_energy_and_at_twice_not_all_do(name):
    method = methods.METHODS[name]
    for body in (NEEDLE, PLATE, NEAR_ROD):
        scene = spinning(*body)
        assert change_energy(scene, method, stability.limit(scene, method).dt / 2) < 0.1
    scenes = [spinning(*body) for body in (NEEDLE, PLATE)]
    lost = [change_energy(scene, method, 2 * stability.limit(scene, method).dt) for scene in scenes]
    # whichever resonates first sets the limit of a method; a rate beyond all numbers is lost as well
    assert not max(lost) < 1.0


@pytest.mark.parametrize("name", ["semi_implicit_euler", "verlet", "leapfrog"])
def test_what_drifts_turns_needles_coins_and_balls_exactly_at_any_step(name):
    bodies = inertia.box(1.0, np.array([[2.0, 0.02, 0.02], [0.02, 1.0, 1.0], [1.0, 1.0, 1.0]]))
    scene = spinning(bodies, np.array([[300.0, 20.0, 5.0], [100.0, 20.0, 5.0], [1.0, 2.0, 3.0]]))
    whole, fine = (simulate(scene, methods.METHODS[name], dt=0.5 / n, steps=n).state.orientation[-1] for n in (30, 600))
    np.testing.assert_allclose(whole, fine, rtol=0, atol=1e-9)


@pytest.mark.parametrize("method", [methods.euler, methods.midpoint])
def test_no_step_is_stable_where_the_energy_grows_at_any(method):
    found = stability.limit(spinning(*NEEDLE), method)
    assert (found.dt, found.cause) == (0.0, "spin")
    assert "no step is stable, set by the spin of a body, 300.7 rad/s" in str(found)


def test_the_fastest_spin_is_that_on_the_way_and_lanes_have_their_own():
    sizes, spins = np.array([[1.0, 0.02, 0.6], [1.0, 1.0, 1.0]]), np.array([[1.0, 20.0, 0.0], [0.0, 0.0, 0.0]])
    scene = spinning(inertia.box(1.0, sizes), spins)
    found = stability.limit(scene, methods.verlet)
    assert np.isinf(found.each[1])
    assert found.node == (0,)
    # about the middle axis it is unstable, and tumbles
    run = simulate(scene, methods.rk4, dt=1e-3, steps=4000)
    on_the_way = np.linalg.norm(jax.vmap(lambda s: rigid.angular_velocity(s, scene.mass))(run.state)[:, 0], axis=-1)
    np.testing.assert_allclose(abs(found.rate), on_the_way.max(), rtol=1e-3)
