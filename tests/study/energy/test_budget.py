"""The books of a run close without having been made to, and say what is known: works, losses, the method's own share."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, contacts, energy, forces, inertia, lattices, methods, rigid, simulate, springs
from physjax.pins import Pins
from physjax.scene import free_motion
from physjax.scenes import SCENES

CLOSED = 1e-9


def closes(ledger):
    assert {
        name: account.closure_error for name, account in ledger.accounts.items() if account.closure_error >= CLOSED
    } == {}
    assert ledger.substep_error < CLOSED


def thrown(count=3, **parts):
    velocity = np.stack([np.linspace(8.0, 20.0, count), np.linspace(15.0, 5.0, count)], axis=-1)
    drag = forces.QuadraticDrag(4.3e-3, 0.35)
    balls = Particles(jnp.asarray(np.tile([0.0, 1.0], (count, 1))), jnp.asarray(velocity))
    return Scene(balls, mass=0.145, forces=(forces.Gravity(), drag), **parts)


def test_a_throw_with_drag_tells_what_the_air_took():
    flight = simulate(thrown(), methods.rk4, dt=0.02, steps=100, save_every=20)
    ledger = energy.ledger(flight)
    closes(ledger)
    start, end = ({k: leaf[i] for k, leaf in flight.state._asdict().items()} for i in (0, -1))
    total = lambda s: 0.0725 * np.sum(np.square(s["velocity"]), -1) + 0.145 * 9.8 * s["position"][:, 1]  # noqa: E731
    lost = total(start) - total(end)
    np.testing.assert_allclose(ledger.energy.totals["QuadraticDrag"], lost, rtol=1e-6)
    assert np.abs(ledger.energy.totals["numerical"]).max() < 1e-6 * lost.max()
    np.testing.assert_allclose(ledger.momentum.totals["Gravity"][:, 1], 0.145 * 9.8 * 2.0, rtol=1e-12)
    assert "Gravity" not in ledger.energy.received  # what is stored was not brought
    assert ledger.energy.received["kinetic"].shape == (6, 3)


@pytest.mark.parametrize("method", [methods.euler, methods.verlet, methods.rk4])
def test_the_methods_own_share_falls_with_its_order(method):
    swing = Scene(
        Particles(jnp.asarray([1.0, 0.2]), jnp.asarray([0.0, 0.7])), forces=(forces.Anchor(jnp.zeros(2), 4.0, 0.6),)
    )

    def share(steps):
        ledger = energy.ledger(simulate(swing, method, dt=1.3 / steps, steps=steps, save_every=steps))
        closes(ledger)
        return abs(float(ledger.energy.totals["numerical"]))

    steps = {1: 4096, 2: 64, 4: 64}[method.promises.order]
    slope = np.log2(share(steps) / share(2 * steps))
    assert slope == pytest.approx(method.promises.order, abs=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("response", [contacts.impact, contacts.project])
def test_a_bounce_costs_one_minus_the_square_of_the_restitution(response):
    floor = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.8, friction=0.3, response=response)
    ball = Scene(Particles(jnp.asarray([[0.0, 1.0]]), jnp.asarray([[2.0, 0.0]])), 0.5, (forces.Gravity(),), (floor,))
    ledger = energy.ledger(simulate(ball, methods.rk4, dt=1e-2, steps=60, save_every=6))
    closes(ledger)
    fall = 0.5 * 9.8 * 1.0
    lost = (1 - 0.8**2) * fall + (1 - 0.7**2) * 0.5 * 0.5 * 2.0**2
    late = 0.0 if response is contacts.impact else 0.5 * 0.5 * 9.8 * 2 * 0.1  # it falls deeper, and is lifted out
    np.testing.assert_allclose(
        ledger.energy.totals["Plane"], lost, rtol=1e-9 if response is contacts.impact else 0.1, atol=late
    )
    if response is contacts.impact:
        np.testing.assert_allclose(
            ledger.momentum.totals["Plane"], [[0.3 * 0.5 * 2.0, -0.5 * 1.8 * np.sqrt(2 * 9.8)]], rtol=1e-9
        )
        assert abs(ledger.energy.totals["numerical"]) < 1e-12


@pytest.mark.slow
def test_bounces_slides_and_walls_each_have_their_entry():
    floor = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.3, coulomb=contacts.Coulomb(0.5, 0.4))
    wall = contacts.Plane((3.0, 0.0), (-1.0, 0.0), restitution=0.9)
    drop = Particles(
        jnp.asarray([[0.0, 0.5], [0.0, 0.0], [2.0, 1.0]]), jnp.asarray([[4.0, 0.0], [3.0, 0.0], [6.0, 1.0]])
    )
    scene = Scene(drop, jnp.asarray([1.0, 2.0, 0.5]), (forces.Gravity(), forces.StokesDrag(0.02)), (floor, wall))
    ledger = energy.ledger(simulate(scene, methods.midpoint, dt=0.03, steps=30, save_every=10))
    closes(ledger)
    slides = 0.5 * 2.0 * 3.0**2
    taken = ledger.energy.totals
    assert taken["Plane 1"][1] + taken["StokesDrag"][1] == pytest.approx(slides, rel=1e-3)
    assert taken["Plane 2"][2] > 0.5 * 0.5 * (1 - 0.9**2) * 5.0**2 * 0.8
    assert taken["Plane 2"][0] == taken["Plane 2"][1] == 0.0


@pytest.mark.slow
def test_a_damped_net_that_is_led_and_breaks():
    sheet = lattices.cloth(
        width=0.6, height=0.6, rows=4, columns=4, mass=0.1, structural=60.0, shear=20.0, bend=2.0, damping=0.05
    )
    sheet = sheet._replace(
        springs=springs.Springs(
            sheet.springs.pairs,
            sheet.springs.stiffness,
            sheet.springs.rest_length,
            sheet.springs.damping,
            breaks_at=0.03,
        )
    )
    nodes = jnp.arange(16) < 4
    start = sheet.state.position
    lift = Pins(nodes, lambda t: start.at[:, 1].add(0.5 * jnp.sin(6.0 * t)))
    floor = contacts.Plane((0.0, float(start[:, 1].min()) - 0.01, 0.0), (0.0, 1.0, 0.0), restitution=0.2, friction=0.4)
    begun = lift.prescribe(0.0, sheet.state)
    scene = Scene(begun, sheet.mass, (forces.Gravity(), sheet.springs), (floor,), lift)
    ledger = energy.ledger(simulate(scene, methods.rk4, dt=2e-3, steps=90, save_every=30))
    closes(ledger)
    taken = ledger.energy.totals
    assert taken["Springs parted"] > 0 < taken["Plane"]
    assert taken["pins"] < 0
    np.testing.assert_allclose(ledger.momentum.totals["Springs"], 0.0, atol=1e-12)


@pytest.mark.slow
def test_a_kick_and_a_turning_body_on_a_pivot():
    brick = inertia.box(2.0, (0.4, 0.2, 0.6)).about((0.0, 0.5, 0.0))
    hung = rigid.bodies(brick, (0.0, -0.5, 0.0), angular_velocity=(2.0, 1.0, 0.5))
    scene = Scene(hung, brick, (forces.Gravity(), rigid.RotationalDrag(0.05), forces.Kick((1.0, 0.0, 0.0), 0.1, 0.2)))
    ledger = energy.ledger(simulate(scene, methods.rk4, dt=0.01, steps=40, save_every=8))
    closes(ledger)
    assert ledger.energy.totals["RotationalDrag"] > 0
    assert abs(ledger.energy.totals["pivots"]) < 1e-12


@pytest.mark.slow
def test_a_ball_that_slides_until_it_rolls_loses_two_sevenths():
    ball = inertia.sphere(6.0, 0.1)
    lane = contacts.Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), coulomb=contacts.Coulomb(0.2, 0.2))
    start = rigid.bodies(ball, (0.0, 0.1, 0.0), velocity=(4.0, 0.0, 0.0))
    scene = Scene(start, ball, (forces.Gravity(),), (rigid.SurfaceContact(rigid.ContactPoints.sphere(0.1), lane),))
    ledger = energy.ledger(simulate(scene, methods.rk4, dt=0.01, steps=80, save_every=20))
    closes(ledger)
    np.testing.assert_allclose(ledger.energy.totals["SurfaceContact"], 2 / 7 * 0.5 * 6.0 * 4.0**2, rtol=1e-9)
    np.testing.assert_allclose(ledger.energy.totals["numerical"], 0.0, atol=1e-9)


@pytest.mark.slow
def test_jointed_bodies_and_balls_that_hit_each_other_close_too():
    rods, balls = inertia.box(1.0, (0.05, 0.4, 0.05)), inertia.sphere(1.0, 0.5)
    floor = contacts.Plane((0.0, -0.7, 0.0), (0.0, 1.0, 0.0), coulomb=contacts.Coulomb(0.5, 0.5))
    touch = rigid.SurfaceContact(rigid.ContactPoints.box((0.05, 0.4, 0.05)), floor)
    joint = rigid.Joints([[0, 1]], [[[0.0, -0.2, 0.0], [0.0, 0.2, 0.0]]], 1e4, 100.0)
    chain = rigid.bodies(rods, [[0.0, 0.0, 0.0], [0.0, -0.4, 0.0]], velocity=(1.0, -2.0, 0.0))
    row = rigid.bodies(balls, [[0.0, 0.0, 0.0], [1.01, 0.0, 0.0]], velocity=[[2.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    hit = Scene(row, balls, contacts=(rigid.Balls(0.5, restitution=0.5),))
    for scene, dt in ((Scene(chain, rods, (forces.Gravity(), joint), (touch,)), 1e-3), (hit, 0.01)):
        ledger = energy.ledger(simulate(scene, methods.midpoint, dt=dt, steps=100, save_every=50))
        closes(ledger)
        assert ledger.energy.totals["SurfaceContact" if scene.forces else "Balls"] > 0.01
    np.testing.assert_allclose(ledger.energy.totals["Balls"], 0.5 * 0.5 * 2.0**2 * (1 - 0.5**2), rtol=1e-9)


def test_a_float32_run_is_audited_in_float64_and_its_rounding_is_the_methods():
    with jax.enable_x64(False):
        flight = simulate(thrown(), methods.rk4, dt=0.02, steps=100, save_every=20)
    assert flight.position.dtype == np.float32
    ledger = energy.ledger(flight)
    closes(ledger)
    assert 1e-9 < np.abs(ledger.energy.totals["numerical"]).max() < 1e-3


def test_printed_and_drawn():
    ledger = energy.ledger(simulate(thrown(), methods.rk4, dt=0.02, steps=100, save_every=20))
    text = str(ledger)
    assert [word for word in ("QuadraticDrag", "potential of Gravity", "energy [J]") if word not in text] == []
    over_time, bars = ledger.plot().axes
    assert (over_time.get_xlabel(), bars.get_xlabel()) == ("time [s]", "energy received [J]")
    assert len(over_time.lines) == len(ledger.energy.received) + 1


def test_bad_input_is_told_in_plain_words(unannotated):
    with pytest.raises(TypeError, match="expected the Trajectory"):
        energy.ledger(thrown())
    flight = simulate(thrown(), methods.rk4, dt=0.02, steps=10, record=lambda t, s: s.position)
    with pytest.raises(ValueError, match="its method or its states"):
        energy.ledger(flight)
    with pytest.raises(ValueError, match="got a scene with an emitter"):
        energy.ledger(simulate(SCENES["sparks"]().scene, methods.verlet, dt=0.01, steps=2))


def test_a_projecting_contact_is_resolved_before_the_prescribed_nodes_return_to_their_path():
    # euler cuts the valley of the path, below the floor that the path itself never passes
    valley = lambda t: jnp.stack([jnp.stack([3.0 * t, 0.001 + (t - 0.5) ** 2]), jnp.stack([1.0 + 0 * t, 2.0 + 0 * t])])  # noqa: E731
    nodes = np.array([True, False])
    floor = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.5, response=contacts.project)
    start = Particles(valley(0.0), jnp.asarray([[3.0, -1.0], [0.0, -2.0]]))
    tow = springs.Springs([[0, 1]], 4.0, 1.0, 0.1)
    scene = Scene(start, 0.5, (forces.Gravity(), tow), (floor,), pinned=Pins(nodes, valley))
    run = simulate(scene, methods.euler, dt=0.1, steps=10)
    ledger = energy.ledger(run)
    closes(ledger)
    received, work = np.zeros(2), 0.0
    for i in range(10):
        now, t = run.scene.replace(state=Particles(*(leaf[i] for leaf in run.state))), 0.1 * i
        moved = free_motion(methods.euler, now, t, 0.1)
        after = floor.resolve(t + 0.1, moved.state, scene.mass)
        received -= np.sum(0.5 * (after.velocity - moved.state.velocity), axis=0)
        work -= energy.total(now, t + 0.1, after) - energy.total(now, t + 0.1, moved.state)
    assert abs(received[1]) > 0.1
    np.testing.assert_allclose(ledger.momentum.totals["Plane"], received, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(ledger.energy.totals["Plane"], work, rtol=1e-9)
