"""Bodies in space that touch: rest, friction, impacts and derivatives against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Scene, contacts, forces, inertia, methods, rigid, simulate

SIZE, GRAVITY = (1.0, 0.4, 0.7), 9.8
GRAVITATION = forces.Gravity()
BRICK = inertia.box(2.0, SIZE)
FLOOR = contacts.Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), restitution=0.0, coulomb=contacts.Coulomb(0.4, 0.4))


def slide(velocity, angular_velocity, load=GRAVITATION):
    """Bricks on a floor, one a world, that begin with these velocities `(worlds, 3)`."""
    velocity, spin = (np.asarray(part, float)[:, None] for part in (velocity, angular_velocity))
    place = np.broadcast_to([0.0, 0.2, 0.0], velocity.shape)
    solids = rigid.Solids(rigid.Shape.box(SIZE), surfaces=(FLOOR,))
    bricks = rigid.bodies(BRICK, place, velocity=velocity, angular_velocity=spin)
    return Scene(bricks, BRICK, (load,), contacts=(solids,))


def test_a_stack_stands_where_it_was_put_and_still(precision):
    dtype = precision.dtype
    crate, size = inertia.box(jnp.asarray(2.0, dtype), jnp.ones(3, dtype)), jnp.ones(3, dtype)
    pile = rigid.bodies(crate, jnp.asarray([[0.0, 0.5 + n, 0.0] for n in range(3)], dtype))
    solids = rigid.Solids(rigid.Shape.box(size), (FLOOR,), coulomb=FLOOR.coulomb, pairs=[(0, 1), (1, 2)])
    end = simulate(
        Scene(pile, crate, (forces.Gravity(),), contacts=(solids,)), methods.verlet, dt=1 / 60, steps=180
    ).state
    height = np.asarray(end.position[-1, :, 1])
    # under n m g each contact gives way by F h²/(2π² m_eff)
    assert (height - [0.5, 1.5, 2.5] < 1e-6).all()
    assert (height - [0.5, 1.5, 2.5] > -1e-4).all()
    speed = np.abs(np.asarray(end.momentum[-1])).max() / 2
    assert speed < (1e-9 if dtype == np.float64 else 1e-5)
    np.testing.assert_allclose(end.position[-1, :, [0, 2]], 0, atol=1e-5)


def test_a_brick_slides_spins_and_stops_as_coulomb_says():
    start = slide([[3.0, 0, 0], [0, 0, 0]], [[0, 0, 0], [0, 4.0, 0]])
    run = simulate(start, methods.verlet, dt=1 / 60, steps=70)
    np.testing.assert_allclose(run.position[-1, 0, 0, 0], 3.0**2 / (2 * 0.4 * GRAVITY), rtol=1e-5)
    assert np.abs(run.state.momentum[-1]).max() < 1e-12
    # four corners press alike at a distance r: τ = μ m g r
    spin, torque = np.asarray(run.state.angular_momentum[:, 1, 0, 1]), 0.4 * 2 * GRAVITY * np.hypot(0.5, 0.35)
    np.testing.assert_allclose(spin[10], spin[0] - torque * 10 / 60, rtol=1e-3)
    assert abs(spin[-1]) < 1e-12


def test_bricks_rest_below_the_angle_of_friction_and_slide_above():
    angle = np.arctan(0.4) + np.radians([-10, -0.5, -0.05, 0.05, 0.5, 10])
    pull = 2.0 * GRAVITY * np.stack([np.sin(angle), -np.cos(angle), 0 * angle], axis=-1)[:, None]
    start = slide(np.zeros((6, 3)), np.zeros((6, 3)), forces.Constant(pull))
    run = simulate(start, methods.verlet, dt=1 / 60, steps=60)
    speed = np.asarray(run.state.momentum[-1, :, 0, 0]) / 2
    np.testing.assert_allclose(speed[:3], 0, atol=1e-12)
    # gravity changes speeds by 0.04 m/s in a sub-step, and the first one begins without any friction
    np.testing.assert_allclose(speed[3:], GRAVITY * (np.sin(angle) - 0.4 * np.cos(angle))[3:], atol=1e-3)


def test_the_last_ball_of_a_cradle_leaves_with_the_speed_of_the_first():
    ball, place = inertia.sphere(1.0, 0.5), np.arange(5.0)[:, None] * [1.0, 0, 0]
    place[0, 0] -= 1.0
    row = rigid.bodies(ball, place, velocity=np.eye(5)[0][:, None] * [2.0, 0, 0])
    solids = rigid.Solids(rigid.Shape.sphere(0.5), restitution=1.0, pairs=[(k, k + 1) for k in range(4)])
    run = simulate(Scene(row, ball, contacts=(solids,)), methods.verlet, dt=1 / 60, steps=60)
    np.testing.assert_allclose(run.state.momentum[-1, :, 0], [0, 0, 0, 0, 2.0], atol=1e-12)


SHAPES = [rigid.Shape.box((0.8, 0.5, 0.6)), rigid.Shape.capsule(0.2, 0.7), rigid.Shape.sphere(0.35)]
PARTS = [inertia.box(1.0, (0.8, 0.5, 0.6)), inertia.capsule(2.0, 0.2, 0.7), inertia.sphere(1.5, 0.35)]


def collide(worlds, coulomb, restitution):
    """A box, a capsule and a ball that tumble towards each other in free space, in several worlds."""
    rng, shape = np.random.default_rng(5), (worlds, 3)
    mass = inertia.Inertia(
        jnp.broadcast_to(jnp.stack([part.mass for part in PARTS]), shape),
        jnp.broadcast_to(jnp.stack([part.principal for part in PARTS]), (*shape, 3)),
    )
    place = np.broadcast_to([[-1.2, 0, 0], [1.2, 0.1, 0], [0, 1.2, 0.1]], (*shape, 3))
    velocity, turn = -1.5 * place + 0.2 * rng.normal(size=place.shape), rng.normal(size=(*shape, 4))
    bodies = rigid.bodies(mass, place, turn, velocity=velocity, angular_velocity=rng.normal(size=place.shape))
    return Scene(bodies, mass, contacts=(rigid.Solids(SHAPES, coulomb=coulomb, restitution=restitution),))


def collide_alone(state, mass):
    """One of these worlds."""
    return Scene(state, mass, contacts=(rigid.Solids(SHAPES, coulomb=FLOOR.coulomb, restitution=0.3),))


def test_impacts_keep_momentum_and_angular_momentum_and_gain_no_energy():
    scene = collide(12, contacts.Coulomb(0.4, 0.4), 0.3)
    state = simulate(scene, methods.verlet, dt=1 / 60, steps=90, save_every=10).state
    momentum = np.asarray(state.momentum.sum(-2))
    np.testing.assert_allclose(momentum, np.broadcast_to(momentum[0], momentum.shape), atol=1e-13)
    turning = np.asarray((jnp.cross(state.position, state.momentum) + state.angular_momentum).sum(-2))
    np.testing.assert_allclose(turning, np.broadcast_to(turning[0], turning.shape), atol=2e-3)
    energy = np.asarray(jax.vmap(lambda each: each.kinetic_energy(scene.mass))(state).sum(-1))
    assert (energy[-1] < 0.9 * energy[0]).all()
    assert (energy <= energy[0] * (1 + 1e-6)).all()


def test_a_world_in_a_batch_and_under_vmap_is_the_same():
    batch = collide(3, contacts.Coulomb(0.4, 0.4), 0.3)
    run = lambda scene: simulate(scene, methods.verlet, dt=1 / 60, steps=45, save_every=45).position[-1]  # noqa: E731
    together = run(batch)
    mapped = jax.vmap(lambda state, mass: run(collide_alone(state, mass)))(batch.state, batch.mass)
    np.testing.assert_allclose(mapped, together, atol=1e-9)


def test_derivatives_of_a_throw_with_a_bounce_are_those_of_differences():
    ground = contacts.Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), restitution=0.5, coulomb=FLOOR.coulomb)
    solids = rigid.Solids(rigid.Shape.box(SIZE), (ground,))
    turn, spin = jnp.array([[0.9, 0.1, 0.2, 0.3]]), jnp.array([[0.3, 0.2, 1.0]])

    def throw(speed):
        velocity = jnp.stack([speed, 0 * speed, 0.2 + 0 * speed])[None]
        brick = rigid.bodies(BRICK, jnp.array([[0.0, 0.8, 0.0]]), turn, velocity=velocity, angular_velocity=spin)
        end = simulate(
            Scene(brick, BRICK, (forces.Gravity(),), contacts=(solids,)), methods.verlet, dt=1 / 60, steps=24
        )
        return jnp.concatenate([end.position[-1, 0], end.state.orientation[-1, 0]])

    speed, small, run = jnp.array(0.7), 1e-5, jax.jit(throw)
    differences = (run(speed + small) - run(speed - small)) / (2 * small)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(throw))(speed), differences, atol=1e-8)


def test_what_does_not_fit_is_refused_in_plain_words():
    brick = rigid.bodies(BRICK, [[0.0, 0.2, 0.0]])
    with pytest.raises(TypeError, match="PlanarShape, expected PlanarBodies"):
        Scene(brick, BRICK, contacts=(rigid.Solids(rigid.PlanarShape.disc(0.5)),))
    with pytest.raises(TypeError, match="expected a Shape"):
        rigid.Solids([rigid.Shape.sphere(0.5), rigid.PlanarShape.disc(0.5)])
    with pytest.raises(ValueError, match="three edges"):
        rigid.Shape.box((1.0, 2.0))
    hung, solids = BRICK.about((0.0, 0.2, 0.0)), rigid.Solids(rigid.Shape.box(SIZE))
    turning = rigid.bodies(hung, [[0.0, 0.2, 0.0]])
    with pytest.raises(ValueError, match="on a pivot"):
        Scene(turning, hung, contacts=(solids,))
