"""Aiming through bounces: against a fan of closed forms as fine as a hair, and its derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, aim_at, contacts, forces, methods, simulate

pytestmark = pytest.mark.slow
HEIGHT, SPEED, G = 1.5, 8.0, 9.8
TARGETS = jnp.array([[5.0, 1.2], [3.0, 0.5], [2.0, 6.0]])


def bounce_passes(numbers, targets=TARGETS):
    """Passes over a floor, from 1.5 m above it, for drag coefficient, restitution and speed."""
    drag, restitution, speed = numbers
    floor = contacts.Plane(point=(0.0, 0.0), normal=(0.0, 1.0), restitution=restitution)
    ball = Scene(
        Particles(jnp.array([0.0, HEIGHT]), jnp.zeros(2)),
        mass=0.6,
        forces=(forces.Gravity(), forces.QuadraticDrag(0.045, drag)),
        contacts=(floor,),
    )
    return aim_at(ball, targets, speed=speed, bounces=1)


def times_of_all_hits(target, restitution):
    """Without drag, from 400 001 directions: when the height at the target's distance, once bounced, is the target's."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 400_001)[1:-1]
    v_x, v_y = SPEED * np.cos(angle), SPEED * np.sin(angle)
    down = np.sqrt(v_y**2 + 2 * G * HEIGHT)
    first, up = (v_y + down) / G, restitution * down
    time = target[0] / v_x
    since = time - first
    once = (since > 0) & (since < 2 * up / G)
    above = up * since - 0.5 * G * since**2 - target[1]
    crosses = once[1:] & once[:-1] & (above[1:] * above[:-1] < 0)
    share = above[:-1] / (above[:-1] - above[1:])
    return np.sort((time[:-1] + share * (time[1:] - time[:-1]))[crosses])


def test_the_soonest_and_the_latest_hit_are_found_and_none_is_invented():
    aimed = bounce_passes(jnp.array([0.0, 0.9, SPEED]))
    np.testing.assert_array_equal(aimed.ok, [True, True, False])
    np.testing.assert_array_equal(aimed.high.ok, [True, True, False])
    assert len(times_of_all_hits(np.asarray(TARGETS[2]), 0.9)) == 0
    for lane in (0, 1):
        times = times_of_all_hits(np.asarray(TARGETS[lane]), 0.9)
        assert aimed.low.time[lane] == pytest.approx(times[0], abs=1e-6)
        assert aimed.high.time[lane] == pytest.approx(times[-1], abs=1e-6)
    assert max(aimed.low.miss[:2].max(), aimed.high.miss[:2].max()) < 1e-11
    assert aimed.low.miss[2] > 0.1


def test_derivatives_through_a_bounce_are_central_differences():
    """By drag, restitution and speed, of both arcs to the first two targets."""
    numbers, step = jnp.array([0.47, 0.8, SPEED]), 1e-4

    @jax.jit
    def angles(numbers):
        aimed = bounce_passes(numbers)
        return jnp.stack([aimed.low.angle[:2], aimed.high.angle[:2]])

    assert bounce_passes(numbers).high.ok[:2].all()
    shifts = step * np.eye(3)
    expected = np.stack([(angles(numbers + s) - angles(numbers - s)) / (2 * step) for s in shifts], axis=-1)
    found = jax.jacfwd(angles)(numbers)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert np.abs(expected).max() > 0.1


def test_bounces_that_cannot_be_are_told():
    ball = Scene(Particles(jnp.zeros(2), jnp.zeros(2)), forces=(forces.Gravity(),))
    lecture = contacts.Plane(point=(0.0, -1.0), normal=(0.0, 1.0), response=contacts.project)
    for scene in (ball, Scene(ball.state, forces=ball.forces, contacts=(lecture,))):
        with pytest.raises(ValueError, match="moment of impact"):
            aim_at(scene, (3.0, 1.0), speed=8.0, bounces=1)
    with pytest.raises(ValueError, match="expected a speed"):
        aim_at(ball, (3.0, 1.0), bounces=1)


def passes_made(ball, bounced_axis, count, seed):
    """Places where random flights are once they have bounced once: right targets, every one of them."""
    random = np.random.default_rng(seed)
    angle, time = random.uniform(-1.2, 1.4, 8 * count), random.uniform(0.3, 2.2, 8 * count)
    velocity = jnp.asarray(SPEED * np.stack([np.cos(angle), np.sin(angle)], axis=-1), ball.state.dtype)
    many = Scene(
        Particles(jnp.broadcast_to(ball.state.position, velocity.shape), velocity),
        ball.mass,
        ball.forces,
        ball.contacts,
    )
    run = simulate(many, methods.rk4, dt=jnp.asarray(time / 200, velocity.dtype), steps=200)
    kicks = np.abs(np.diff(np.asarray(run.velocity)[..., bounced_axis], axis=0)) > 1.0
    return run.position[-1][kicks.sum(axis=0) == 1][:count]


@pytest.mark.parametrize(("what", "precision"), [("floor", "float64")], indirect=["precision"])
def test_no_right_arc_is_denied(what, precision):
    """Of 20 targets that a bounce leads to: all are hit to rounding, lane by lane and mapped, and move with them."""
    place, normal, axis = {"floor": ((0.0, 0.0), (0.0, 1.0), 1), "board": ((4.0, 0.0), (-1.0, 0.0), 0)}[what]
    start = jnp.array([0.0, 2.0], precision.dtype)
    loads = (forces.Gravity(), forces.QuadraticDrag(0.045, 0.3))
    surface = contacts.Plane(point=place, normal=normal, restitution=0.8)
    ball = Scene(Particles(start, jnp.zeros_like(start)), 0.6, loads, (surface,))
    targets = passes_made(ball, axis, 20, 3)

    def aimed(targets):
        shots = aim_at(ball, targets, speed=SPEED, bounces=1)
        return jnp.stack([shots.low.angle, shots.high.angle]), (shots.low, shots.high)

    along = jnp.zeros_like(targets).at[:, 0].set(1.0)
    _, moves, shots = jax.jit(lambda t: jax.jvp(aimed, (t,), (along,), has_aux=True))(targets)
    for shot in shots:
        extent = np.linalg.norm(targets - start[None], axis=-1) + SPEED * np.asarray(shot.time)
        assert shot.ok.all()
        assert (np.asarray(shot.miss) / extent).max() < 64 * precision.eps
    assert (np.asarray(moves) != 0).all()
    assert jax.jit(jax.vmap(lambda target: aimed(target)[1][0].ok))(targets[::4]).all()
