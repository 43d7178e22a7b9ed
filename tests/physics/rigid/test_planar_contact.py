"""Bodies that touch in the plane, against momentum, friction's closed forms, and what stacks do."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Scene, contacts, forces, inertia, methods, rigid, simulate
from physjax.compaction import choose_tile_worlds

CRATE = inertia.planar_plate(1.0, (1.0, 1.0))
SQUARE = rigid.PlanarShape.box((1.0, 1.0))
BALL = inertia.planar_disc(1.0, 0.5)
DISC = rigid.PlanarShape.disc(0.5)


def rough(friction):
    return contacts.Coulomb(friction, friction)


def floor(friction=0.5, restitution=0.0):
    return contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=restitution, coulomb=rough(friction))


def stack(worlds, count=10, substeps=8, dtype=float, seed=0):
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-0.02, 0.02, (*worlds, count)), np.broadcast_to(np.arange(count) + 0.5, (*worlds, count))
    pairs = [(i, i + 1) for i in range(count - 1)]
    solids = rigid.Solids(SQUARE, (floor(),), coulomb=rough(0.5), pairs=pairs, substeps=substeps)
    pile = rigid.planar_bodies(CRATE, np.stack([x, y], axis=-1).astype(dtype))
    return Scene(pile, CRATE, (forces.Gravity(),), contacts=(solids,))


# impacts


def cradle(speeds, coming=None, count=5):
    """Five balls in a row, of which the first of each world come in with these speeds, `(worlds, balls)`."""
    coming = np.asarray(speeds) > 0 if coming is None else coming
    x = np.arange(count, dtype=float) - 0.3 * coming
    velocity = jnp.stack([speeds, jnp.zeros_like(speeds)], axis=-1)
    row = rigid.planar_bodies(BALL, np.stack([x, 0 * x], axis=-1), velocity=velocity)
    return Scene(
        row, BALL, contacts=(rigid.Solids(DISC, restitution=1.0, pairs=[(i, i + 1) for i in range(count - 1)]),)
    )


def test_as_many_balls_leave_a_cradle_as_come_in():
    coming = jnp.asarray([[1.0] * k + [0.0] * (5 - k) for k in (1, 2, 3)])
    end = simulate(cradle(coming), methods.verlet, dt=1 / 60, steps=40).state.momentum[-1]
    np.testing.assert_allclose(end[..., 0], coming[:, ::-1], atol=1e-12)
    assert np.abs(end[..., 1]).max() == 0


def test_the_last_ball_of_a_cradle_leaves_with_the_speed_of_the_first():
    def leave(speed):
        coming = jnp.zeros((1, 5)).at[0, 0].set(speed)
        return simulate(cradle(coming, np.eye(1, 5)), methods.verlet, dt=1 / 30, steps=15).state.momentum[-1, 0, -1, 0]

    assert jax.grad(leave)(1.0) == pytest.approx(1.0, abs=1e-12)


def push_stack(push):
    """Where the upper one of two boxes is [m] after a push [N] on the lower one, which slides."""
    force = jnp.zeros((2, 2)).at[0, 0].set(push)
    pile = rigid.planar_bodies(CRATE, [[0.0, 0.5], [0.02, 1.5]])
    solids = rigid.Solids(SQUARE, (floor(),), coulomb=rough(0.5))
    scene = Scene(pile, CRATE, (forces.Gravity(), forces.Constant(force)), contacts=(solids,))
    return simulate(scene, methods.verlet, dt=1 / 60, steps=40).state.position[-1, -1, 0]


def time_domino(push):
    """When the last of three dominoes has turned by 0.1 rad [s], of which the first is pushed [rad/s]."""
    size, turn = (0.1, 0.6), jnp.zeros(3).at[0].set(-push)
    stone, velocity = inertia.planar_plate(1.0, size), jnp.stack([-turn * size[1] / 2, 0 * turn], axis=-1)
    row = rigid.planar_bodies(stone, [[0.35 * i, 0.3] for i in range(3)], velocity=velocity, angular_velocity=turn)
    solids = rigid.Solids(rigid.PlanarShape.box(size), (floor(0.8),), coulomb=rough(0.4), pairs=[(0, 1), (1, 2)])
    run = simulate(Scene(row, stone, (forces.Gravity(),), contacts=(solids,)), methods.verlet, dt=1 / 60, steps=70)
    angle = -run.state.angle[:, -1]
    after = jnp.argmax(angle > 0.1)
    return (after.astype(float) + (0.1 - angle[after]) / (angle[after] - angle[after - 1])) / 60


@pytest.mark.parametrize(("measure", "push"), [(push_stack, 30.0), (time_domino, 1.0)])
def test_a_push_is_felt_at_the_other_end(measure, push):
    run = jax.jit(lambda push: jax.jvp(measure, (push,), (1.0,)))
    step = 1e-6
    difference = (run(push + step)[0] - run(push - step)[0]) / (2 * step)
    assert abs(difference) > 1e-2
    np.testing.assert_allclose(run(push)[1], difference, rtol=1e-6)


def test_a_break_keeps_energy_momentum_and_mirror_symmetry():
    places = [(i * np.sqrt(3) / 2, j - i / 2) for i in range(5) for j in range(i + 1)] + [(-3.0, 0.0)]
    velocity = np.zeros((16, 2))
    velocity[-1, 0] = 10.0
    rack = rigid.planar_bodies(BALL, places, velocity=velocity)
    scene = Scene(rack, BALL, contacts=(rigid.Solids(DISC, restitution=1.0),))
    end = simulate(scene, methods.verlet, dt=1 / 60, steps=60).state
    p, x = np.asarray(end.momentum[-1]), np.asarray(end.position[-1])
    assert (p**2).sum() == pytest.approx(100.0, rel=1e-9)
    np.testing.assert_allclose(p.sum(axis=0), [10.0, 0.0], atol=1e-12)
    mirrored = x * [1, -1]
    assert max(np.abs(mirrored - other).max(axis=1).min() for other in x) < 1e-10


def test_an_elastic_ball_keeps_its_energy_and_an_inelastic_one_stays():
    solids = rigid.Solids(DISC, (floor(0.0, restitution=1.0),), restitution=1.0)
    ball = rigid.planar_bodies(BALL, [[0.0, 1.5]])
    state = simulate(
        Scene(ball, BALL, (forces.Gravity(),), contacts=(solids,)), methods.verlet, dt=1 / 60, steps=200
    ).state
    energy = 9.8 * (state.position[:, 0, 1] - 0.5) + state.momentum[:, 0, 1] ** 2 / 2
    # what approaches slower than forces change in two sub-steps stays; nothing else is lost
    np.testing.assert_allclose(energy, 9.8, rtol=2e-3)
    assert float(state.position[:, 0, 1].min()) > 0.5 - 1e-3


def test_bounces_are_first_order_in_the_sub_steps():
    height, keeps, end = np.random.default_rng(0).uniform(0.5, 1.0, 256), 0.8, 0.75
    fall = np.sqrt(2 * height / 9.8)
    rise = keeps * 9.8 * fall
    # all have bounced once
    y = rise * (end - fall) - 9.8 * (end - fall) ** 2 / 2
    assert (end < fall + 2 * rise / 9.8).all()
    place = np.stack([0 * height, height + 0.5], axis=-1)[:, None]

    def measure_error(substeps):
        solids = rigid.Solids(DISC, (floor(0.0, restitution=keeps),), substeps=substeps)
        scene = Scene(rigid.planar_bodies(BALL, place), BALL, (forces.Gravity(),), contacts=(solids,))
        found = simulate(scene, methods.verlet, dt=1 / 60, steps=round(60 * end)).state.position[-1, :, 0, 1] - 0.5
        return np.abs(found - y).mean()

    assert np.log(measure_error(2) / measure_error(16)) / np.log(8) == pytest.approx(1.0, abs=0.15)


def test_every_one_of_many_worlds_has_its_derivative():
    place = np.stack([np.zeros(80), np.linspace(1.0, 1.5, 80)], axis=-1)[:, None]
    solids = rigid.Solids(DISC, (floor(0.0, restitution=0.8),))

    def fall(speed):
        thrown = rigid.planar_bodies(BALL, place, velocity=jnp.stack([0 * speed, speed])[None, None])
        scene = Scene(thrown, BALL, (forces.Gravity(),), contacts=(solids,))
        return simulate(scene, methods.verlet, dt=1 / 60, steps=40, save_every=40).state.position[-1, :, 0, 1]

    run = jax.jit(lambda speed: jax.jvp(fall, (speed,), (1.0,)))
    step = 1e-7
    difference = (run(0.1 + step)[0] - run(0.1 - step)[0]) / (2 * step)
    np.testing.assert_allclose(run(0.1)[1], difference, atol=1e-5)


# friction


def test_a_push_moves_what_friction_does_not_hold():
    push, friction = np.array([0.0, 0.2, 0.49, 0.51, 0.7, 2.0]) * 9.8, 0.5
    scene = Scene(
        rigid.planar_bodies(CRATE, np.tile([0.0, 0.5], (6, 1, 1))),
        CRATE,
        (forces.Gravity(), forces.Constant(np.stack([push, 0 * push], axis=-1)[:, None])),
        contacts=(rigid.Solids(SQUARE, (floor(friction),)),),
    )
    speed = simulate(scene, methods.verlet, dt=1 / 60, steps=120).state.momentum[..., 0, 0]
    gained = np.asarray(speed[-1] - speed[60])
    np.testing.assert_allclose(gained, np.maximum(push - friction * 9.8, 0.0), rtol=5e-3, atol=1e-3)
    assert np.abs(gained[:3]).max() < 1e-12


def test_what_rests_is_held_by_static_friction_and_what_slides_by_kinetic():
    push = np.array([0.5, 0.7]) * 9.8  # between μ_k and μ_s, and beyond both
    road = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.0, coulomb=contacts.Coulomb(0.6, 0.4))
    scene = Scene(
        rigid.planar_bodies(CRATE, np.tile([0.0, 0.5], (2, 1, 1))),
        CRATE,
        (forces.Gravity(), forces.Constant(np.stack([push, 0 * push], axis=-1)[:, None])),
        contacts=(rigid.Solids(SQUARE, (road,)),),
    )
    speed = simulate(scene, methods.verlet, dt=1 / 60, steps=90).state.momentum[..., 0, 0]
    np.testing.assert_allclose(speed[-1] - speed[60], [0.0, 0.3 * 9.8 / 2], atol=2e-3)


def test_a_box_on_a_slope_rests_below_the_angle_of_friction_and_slides_above():
    friction, above = 0.5, np.deg2rad(0.05)
    for angle, slides in ((np.arctan(friction) - above, False), (np.arctan(friction) + above, True)):
        along, out = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        slope = contacts.Plane((0.0, 0.0), out, restitution=0.0, coulomb=rough(friction))
        box = rigid.planar_bodies(CRATE, [0.5 * out], angle=[angle])
        scene = Scene(box, CRATE, (forces.Gravity(),), contacts=(rigid.Solids(SQUARE, (slope,)),))
        speed = -np.asarray(simulate(scene, methods.verlet, dt=1 / 60, steps=120).state.momentum[:, 0]) @ along
        expected = 9.8 * (np.sin(angle) - friction * np.cos(angle)) if slides else 0.0
        assert speed[-1] - speed[60] == pytest.approx(expected, abs=1e-3 if slides else 1e-12)


def test_a_box_that_slides_stops_after_its_distance():
    box = rigid.planar_bodies(CRATE, [[0.0, 0.5]], velocity=[[6.0, 0.0]])
    scene = Scene(box, CRATE, (forces.Gravity(),), contacts=(rigid.Solids(SQUARE, (floor(0.3),)),))
    end = simulate(scene, methods.verlet, dt=1 / 60, steps=180).state
    assert end.position[-1, 0, 0] == pytest.approx(36 / (2 * 0.3 * 9.8), rel=5e-3)
    assert np.abs(end.momentum[-1]).max() < 1e-9


def test_a_conveyor_takes_a_box_along():
    belt = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.0, coulomb=rough(0.5), velocity=(2.0, 0.0))
    box = rigid.planar_bodies(CRATE, [[0.0, 0.5]])
    scene = Scene(box, CRATE, (forces.Gravity(),), contacts=(rigid.Solids(SQUARE, (belt,)),))
    end = simulate(scene, methods.verlet, dt=1 / 60, steps=60, save_every=60).state
    # μ g until it is as fast as the belt, and with it from then on
    slips = 2.0 / (0.5 * 9.8)
    assert end.momentum[-1, 0, 0] == pytest.approx(2.0, abs=1e-12)
    assert end.position[-1, 0, 0] == pytest.approx(2.0 * (1 - slips / 2), rel=5e-3)


# rest


def test_a_stack_of_ten_boxes_stands():
    run = simulate(stack((3,)), methods.verlet, dt=1 / 60, steps=600, save_every=60)
    x = np.asarray(run.state.position)
    assert np.abs(x[1:, ..., 0] - x[1, ..., 0]).max() < 1e-3
    assert np.abs(x[-1, ..., 1] - np.arange(10) - 0.5).max() < 1e-3
    assert np.abs(run.state.momentum[-1]).max() < 1e-3


def test_a_light_box_carries_a_hundredfold_one():
    masses = inertia.planar_plate(np.array([1.0, 100.0]), np.ones((2, 2)))
    pile = rigid.planar_bodies(masses, [[0.0, 0.5], [0.0, 1.5]])
    scene = Scene(pile, masses, (forces.Gravity(),), contacts=(rigid.Solids(SQUARE, (floor(),)),))
    end = simulate(scene, methods.verlet, dt=1 / 60, steps=300, save_every=300).state
    assert np.abs(end.position[-1, :, 1] - np.array([0.5, 1.5])).max() < 5e-3
    assert np.abs(end.momentum[-1]).max() < 1e-2


def test_a_world_in_a_batch_is_the_world_alone():
    many = simulate(stack((4,), count=4), methods.verlet, dt=1 / 60, steps=10).state
    for world in range(4):
        x = many.position[0, world]
        alone = stack((), count=4)
        alone = alone.replace(state=alone.state._replace(position=x))
        one = simulate(alone, methods.verlet, dt=1 / 60, steps=10).state
        np.testing.assert_allclose(one.position, many.position[:, world], rtol=1e-12, atol=1e-13)


def test_worlds_in_tiles_are_the_worlds_alone():
    """Of 131 worlds no tile is full."""
    speeds = np.linspace(-2.0, 2.0, 131)
    velocity = np.zeros((131, 20, 2))
    velocity[:, 0, 0] = speeds

    def slide(velocity):
        x = np.broadcast_to([[1.5 * k, 0.5] for k in range(20)], velocity.shape)
        pairs = [(k, k + 1) for k in range(19)]
        solids = rigid.Solids(DISC, (floor(),), 0.5, coulomb=rough(0.3), pairs=pairs)
        scene = Scene(rigid.planar_bodies(CRATE, x, velocity=velocity), CRATE, (forces.Gravity(),), (solids,))
        return simulate(scene, methods.verlet, dt=1 / 60, steps=40, save_every=40).position[-1]

    assert choose_tile_worlds(131, 20 // 2) is not None
    together, some = slide(velocity), np.array([0, 65, 66, 130])
    np.testing.assert_allclose(together[some], slide(velocity[some]), rtol=0, atol=1e-12)
    assert np.ptp(together[:, 0, 0]) > 0.3


def test_random_drops_gain_no_energy_and_stay_out_of_each_other():
    rng = np.random.default_rng(11)
    worlds = 64
    shapes = [
        DISC,
        rigid.PlanarShape.capsule(0.2, 0.6),
        SQUARE,
        rigid.PlanarShape.polygon([[-0.5, -0.3], [0.5, -0.3], [0.0, 0.6]]),
    ]
    bodies = len(shapes)
    x = np.stack(
        [rng.uniform(-0.5, 0.5, (worlds, bodies)), 1 + 1.6 * np.arange(bodies) + rng.uniform(0, 0.2, (worlds, bodies))],
        -1,
    )
    angle, velocity = rng.uniform(-3, 3, (worlds, bodies)), rng.uniform(-1, 1, (worlds, bodies, 2))
    thrown = rigid.planar_bodies(CRATE, x, angle, velocity, rng.uniform(-3, 3, (worlds, bodies)))
    solids = rigid.Solids(shapes, (floor(0.5, restitution=0.3),), restitution=0.3, coulomb=rough(0.5))
    state = simulate(
        Scene(thrown, CRATE, (forces.Gravity(),), contacts=(solids,)), methods.verlet, dt=1 / 60, steps=150
    ).state
    energy = np.sum(state.kinetic_energy(CRATE) + 9.8 * state.position[..., 1], axis=-1)
    assert np.isfinite(energy).all()
    assert (energy / energy[:1]).max() < 1.001
    assert float(state.position[..., 1].min()) > 0.15


# refusals


def test_what_does_not_fit_is_refused_in_plain_words():
    pile = rigid.planar_bodies(CRATE, [[0.0, 0.5], [0.0, 1.5]])
    with pytest.raises(ValueError, match="3 shapes for 2 bodies"):
        Scene(pile, CRATE, contacts=(rigid.Solids([SQUARE] * 3),))
    with pytest.raises(ValueError, match="pairs"):
        Scene(pile, CRATE, contacts=(rigid.Solids(SQUARE, pairs=[(0, 2)]),))
    with pytest.raises(TypeError, match="PlanarBodies"):
        Scene(rigid.bodies(inertia.sphere(1.0, 1.0)), inertia.sphere(1.0, 1.0), contacts=(rigid.Solids(SQUARE),))
    with pytest.raises(TypeError, match="PlanarShape"):
        rigid.Solids([(1.0, 1.0)])
    led = contacts.Plane((0.0, 0.0), (0.0, 1.0), motion=contacts.Motion(lambda t: jnp.zeros(3) * t))
    with pytest.raises(ValueError, match="expected 2 components"):
        Scene(pile, CRATE, contacts=(rigid.Solids(SQUARE, (led,)),))
    many = rigid.planar_bodies(CRATE, np.zeros((65, 2)))
    with pytest.raises(ValueError, match="at most 64"):
        Scene(many, CRATE, contacts=(rigid.Solids(SQUARE),))
    steep = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=np.array([0.0, 0.5]))
    with pytest.raises(ValueError, match="restitution of Plane for each of the lanes"):
        Scene(pile, CRATE, contacts=(rigid.Solids(SQUARE, (steep,)),))
    with pytest.raises(TypeError, match=re.escape("rigid.Solids(shapes, (plane,))")):
        Scene(pile, CRATE, contacts=(floor(),))
    with pytest.raises(ValueError, match="got 2 Solids, expected one"):
        Scene(pile, CRATE, contacts=(rigid.Solids(SQUARE), rigid.Solids(SQUARE))).step(methods.verlet, 0.0, 0.1)
