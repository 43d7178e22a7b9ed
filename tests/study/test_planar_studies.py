"""Studies take bodies in the plane, whose angles and angular momenta have no axis of components."""

import jax
import numpy as np
import pytest

from physjax import Scene, contacts, energy, forces, inertia, methods, rigid, simulate, sweep
from physjax.study.accuracy.method_facts import smallest_sizes
from physjax.study.accuracy.reference_solution import nudge_start

PLATE = inertia.planar_plate(2.0, (1.0, 1.0))
BODIES = rigid.planar_bodies(
    PLATE, [[0.0, 0.5], [0.3, 1.6], [-3.0, 4.0]], [0.0, 0.1, 0.4], (0.3, 0.0), angular_velocity=[0.0, 1.0, -2.0]
)
DRAG = (forces.Gravity(), forces.StokesDrag(0.1), rigid.RotationalDrag(0.05))
FREE = Scene(BODIES, PLATE, DRAG)
SOFT = contacts.Coulomb(0.5, 0.5)
FLOOR = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.0, coulomb=SOFT)
BOX = rigid.PlanarShape.box((1.0, 1.0))


def drop_box():
    """A box just above the floor, on its way down."""
    box = rigid.planar_bodies(PLATE, [[0.0, 0.7]], velocity=(0.0, -2.0))
    return Scene(box, PLATE, (forces.Gravity(),), contacts=(rigid.Solids(BOX, surfaces=(FLOOR,), substeps=2),))


@pytest.fixture(scope="module")
def drop():
    return simulate(drop_box(), methods.verlet, dt=1 / 60, steps=12)


def test_the_ledger_charges_solids_with_what_an_impact_takes(drop):
    ledger = energy.ledger(drop)
    assert max(account.closure_error for account in ledger.accounts.values()) < 1e-13
    speed = np.sqrt(2.0**2 + 2 * 9.8 * 0.2)
    # the kinetic energy at the floor, but for what the fall within one sub-step gives or takes
    assert float(ledger.energy.totals["Solids"]) == pytest.approx(speed**2, rel=0.06)
    assert abs(float(ledger.energy.totals["numerical"])) < 1e-12


@pytest.mark.parametrize("couples", [False, True])
def test_a_nudge_has_the_size_of_what_it_changes(couples):
    pull = (rigid.on_bodies(lambda t, bodies, inertia: rigid.Wrench(0.0 * bodies.momentum), couples=True),) * couples
    scene = Scene(BODIES, PLATE, pull)
    moved = nudge_start(scene, jax.tree.map(lambda leaf: leaf[None], scene.state), share=1e-3)
    change = np.abs(np.asarray(moved.state.angular_momentum - BODIES.angular_momentum))
    largest = np.abs(np.asarray(BODIES.angular_momentum))
    assert (change <= 5e-3 * (largest.max() if couples else largest)).all()
    assert change[1:].all()
    assert (moved.state.angle == BODIES.angle).all()


def test_a_tolerance_is_one_for_all_leaves_of_bodies_in_the_plane():
    assert smallest_sizes(FREE).shape == ()
    assert 0 < smallest_sizes(FREE) < 1


def test_gradients_and_sweeps_take_bodies_in_the_plane():
    def turn(torque):
        scene = Scene(BODIES, PLATE, (rigid.Torque(torque),))
        return simulate(scene, methods.verlet, dt=0.1, steps=5).state.angle[-1, 1]

    exact = 0.5 * 0.5**2 / float(PLATE.moment)
    assert float(jax.grad(turn)(0.3)) == pytest.approx(exact)
    assert float(jax.jvp(turn, (0.3,), (1.0,))[1]) == pytest.approx(exact)
    found = sweep(turn, {"torque": [0.0, 1.0]}, progress=False)
    np.testing.assert_allclose(np.diff(found.values), exact, rtol=1e-6)


def test_step_control_follows_a_decay_in_closed_form():
    scene = Scene(BODIES, PLATE, (rigid.RotationalDrag(0.5),))
    end = simulate(scene, methods.adaptive(methods.tsit5, 1e-10, 1e-10), dt=0.5, steps=1).state
    rate = 0.5 / float(PLATE.moment)
    turned = BODIES.angular_momentum / PLATE.moment * (1 - np.exp(-0.5 * rate)) / rate
    np.testing.assert_allclose(end.angle[-1], BODIES.angle + turned, atol=1e-9)


def test_a_run_is_saved_and_read_again(tmp_path, drop):
    drop.save(tmp_path / "drop.npz")
    again = type(drop).load(tmp_path / "drop.npz", scene=drop.scene, method=methods.verlet)
    assert (again.state.angle == drop.state.angle).all()
    assert (again.final_scene.contacts[0].impulses == drop.final_scene.contacts[0].impulses).all()
    assert "position (13, 1, 2)" in repr(drop)
