"""Absolute time: what follows the clock is the same at any time of day in float32, and the count of steps does not wrap."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, contacts, emitters, forces, inertia, methods, rigid, simulate
from physjax.loops import LAST_STEP, cast_remainder, exact_multiple, exact_quotient, float32_remainder, moment_at

DT = 1 / 120
AGAIN = 2**24
FIRSTS = [0, 216_000, 1_080_000, 10_368_000, AGAIN - 100, AGAIN + 4321, 2**30 + 7]
"""Steps at which a run begins: at once, after half an hour, 2.5 h and a day; where float32 counts no more; after 100 days."""
STEP = float(np.float32(DT))


@pytest.fixture(autouse=True)
def single():
    """Float32 throughout, the dtype in which time is coarse."""
    with jax.enable_x64(False):
        yield


def timed(start, lasts):
    """Four lanes at rest: one is kicked, one blasted, two are under control, in steps and along a line."""
    only = np.eye(4, dtype=np.float32)
    values = np.array([[1.0, 0.0], [-1.0, 0.0], [2.0, 0.0]]) * 5
    own = lambda lane: only[lane][:, None, None] * values[None]  # noqa: E731
    return Scene(
        Particles(jnp.zeros((4, 2)), jnp.zeros((4, 2))),
        1.0,
        (
            forces.Kick(only[0][:, None] * np.array([1.0, 0.0]), at=start + 0.503, duration=lasts),
            forces.Blast((-1e-3, 0.0), only[1], 1e3, at=start + 0.503, duration=lasts),
            forces.Control(own(2), duration=0.3, at=start + 0.503),
            forces.Control(own(3), duration=0.3, at=start + 0.503, linear=True),
        ),
    )


@pytest.mark.parametrize("first", FIRSTS)
def test_impulses_and_moments_are_the_same_at_any_time_of_day(first):
    """To rounding of the impulse, and in the step in which it was asked for.

    What runs along a line is sampled by the method, which misses 1.6e-3 at its bends; at all times the same.
    """
    for lasts in (0.001, 0.005, 0.05):
        run = simulate(timed(first * STEP, lasts), methods.rk4, dt=DT, steps=240, first_step=first, save_every=240)
        way, speed = np.asarray(run.position[-1, :, 0], float), np.asarray(run.velocity[-1, :, 0], float)
        np.testing.assert_allclose(speed, [1.0, 1.0, 1.0, 0.3756], rtol=2e-5, atol=0)
        arrived = 240 * STEP - way[:2] / speed[:2]
        np.testing.assert_allclose(arrived, 0.503 + lasts / 2, rtol=0, atol=0.5 * STEP)


def test_a_kick_is_where_it_is_asked_for_within_its_step():
    """The part of a time that float32 cannot hold is kept: of two kicks 2 ms apart after a day each is in its place."""
    first = 10_368_000

    def mean(at):
        kick = forces.Kick((1.0,), at=first * STEP + at, duration=0.001)
        scene = Scene(Particles(jnp.zeros(1), jnp.zeros(1)), forces=(kick,))
        assert scene.forces[0].at.dtype == jnp.float32
        seen = [
            scene.averaged_over_step(moment_at(jnp.int32(first + i), jnp.float32(DT), np.dtype(np.float32)), STEP / 4)
            for i in (0, 1)
        ]
        return [float(part.forces[0].force[0]) * STEP / 4 for part in seen]

    np.testing.assert_allclose(mean(0.0005), [1.0, 0.0], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(mean(STEP - 0.0005), [0.0, 0.5], rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("first", FIRSTS[:-1])
def test_births_come_one_by_one_at_any_time_of_day(first):
    """From a source that starts then, and from one that has run since t = 0."""
    for start, rate in ((first * STEP, 100.0), (0.0, 100.0)):
        jet = emitters.Emitter(
            512, emitters.Point((0.0, 0.0)), key=0, life=2.5, speed=5.0, rate=rate, start=start, drop_oldest=True
        )
        scene = Scene(jet.unborn(), forces=(forces.Gravity(),), emitter=jet)
        run = simulate(scene, methods.rk4, dt=DT, steps=240, first_step=first, save_every=40)
        seen = run.film.emitter
        number = np.asarray(seen.generation).astype(np.int64) * 512 + np.arange(512)
        last = number.max(axis=1)
        came = np.diff(last[1:])
        assert np.all(np.abs(came - 100 * 40 * STEP) <= 1)
        assert np.all(np.sort(number[-1][number[-1] >= 0])[1:] - np.sort(number[-1][number[-1] >= 0])[:-1] == 1)
        # each flies for its own age, which the closed form knows
        final, end = run.final_scene.emitter, (first + 240) * STEP
        slot = int(np.argmax(number[-1] == last[-1] - 30))
        age = end - (start + (last[-1] - 30) / rate)
        birth = final.births(final.slot, final.generation)
        fall = np.asarray(birth.velocity[slot]) * age - np.array([0.0, 4.9]) * age**2
        np.testing.assert_allclose(run.position[-1, slot], np.asarray(birth.position[slot]) + fall, rtol=0, atol=2e-4)


@pytest.mark.parametrize("first", [0, 10_368_000])
def test_a_belt_carries_alike_at_any_time_of_day(first):
    """A slope that moves along itself is where it was; what static friction holds rides at the belt's speed."""
    slope, v = 0.3, 2.0
    along, up = np.array([np.cos(slope), np.sin(slope)]), np.array([-np.sin(slope), np.cos(slope)])
    dry = {"restitution": 0.0, "coulomb": contacts.Coulomb(0.8, 0.6)}
    belt = contacts.Plane((0.0, 0.0), up, velocity=v * along, **dry)
    rider = Scene(Particles(jnp.zeros(2), jnp.asarray(v * along, jnp.float32)), 1.0, (forces.Gravity(),), (belt,))
    x = np.asarray(simulate(rider, methods.rk4, dt=DT, steps=120, save_every=12, first_step=first).position, float)
    assert np.abs(x @ up).max() < 1e-5
    assert abs(x[-1] @ along - v * 120 * DT) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("first", [0, 10_368_000])
def test_a_belt_carries_a_box_alike_at_any_time_of_day(first):
    slope, v, side = 0.3, 2.0, 0.2
    along, up = np.array([np.cos(slope), np.sin(slope)]), np.array([-np.sin(slope), np.cos(slope)])
    dry = {"restitution": 0.0, "coulomb": contacts.Coulomb(0.8, 0.6)}
    belt = contacts.Plane(np.zeros(3), (*up, 0.0), velocity=(*(v * along), 0.0), **dry)
    brick, turn = inertia.box(1.0, (side, side, side)), (np.cos(slope / 2), 0.0, 0.0, np.sin(slope / 2))
    body = rigid.bodies(brick, (*(up * side / 2 * 1.0001), 0.0), turn, (*(v * along), 0.0))
    hull = rigid.ContactPoints.box((side, side, side))
    scene = Scene(body, brick, (forces.Gravity(),), (rigid.SurfaceContact(hull, belt),))
    x = np.asarray(simulate(scene, methods.rk4, dt=DT, steps=120, save_every=12, first_step=first).position, float)
    assert np.abs(x[:, :2] @ up - side / 2).max() < 5e-5
    assert abs(x[-1, :2] @ along - v * 120 * DT) < 1e-3


def test_what_moves_along_its_normal_moves_and_is_differentiated():
    """Rounding of a velocity along the surface is none; a slow speed of the surface's own is kept, and so is its slope."""
    place = jnp.asarray([3.0, 1.0])
    lift = contacts.Plane((0.0, 0.0), (0.0, 1.0), velocity=(10.0, 1e-6))
    assert float(lift.signed_distance(1000.0, place)) == np.float32(1.0) - np.float32(1e-3)
    belt = lambda v: contacts.Plane((0.0, 0.0), (-0.6, 0.8), velocity=v).signed_distance(1000.0, place)  # noqa: E731
    assert float(belt(jnp.asarray([0.8, 0.6]) * 3)) == pytest.approx(-1.0)
    np.testing.assert_allclose(jax.grad(belt)(jnp.asarray([0.8, 0.6])), [600.0, -800.0], rtol=1e-6)


def test_a_run_resumed_after_a_day_has_the_same_bits():
    scene, first = timed(10_368_000 * STEP, 0.005), 10_368_000
    whole = simulate(scene, methods.euler, dt=DT, steps=122, first_step=first, save_every=61)
    half = simulate(scene, methods.euler, dt=DT, steps=61, first_step=first, save_every=61)
    rest = simulate(half.final_scene, methods.euler, dt=DT, steps=61, first_step=half.final_step, save_every=61)
    assert all(np.array_equal(a[-1], b[-1]) for a, b in zip(whole.state, rest.state, strict=True))


def test_traced_starts_of_a_kick_are_mapped_and_differentiated():
    """x(T) = J (T - at - duration/2): its slope by `at` is -J, for kicks within steps and on their ends, at any time."""
    first = 1_080_000

    def end(at):
        kick = forces.Kick((2.0,), at=at, duration=0.1)
        scene = Scene(Particles(jnp.zeros(1), jnp.zeros(1)), forces=(kick,))
        return simulate(scene, methods.verlet, dt=0.01, steps=60, first_step=first, save_every=60).position[-1, 0]

    begun = np.float32(first * float(np.float32(0.01)))
    starts = jnp.asarray(begun + np.arange(1, 5, dtype=np.float32) * 0.1, jnp.float32)
    x, slope = jax.jit(jax.vmap(jax.value_and_grad(end)))(starts)
    late = first * float(np.float32(0.01)) + 60 * float(np.float32(0.01)) - np.asarray(starts, float) - 0.05
    np.testing.assert_allclose(x, 2.0 * late, rtol=0, atol=2e-3)
    np.testing.assert_allclose(slope, -2.0, rtol=1e-4)


def test_the_count_of_steps_does_not_wrap():
    """A concrete count is refused, a traced one is a status."""
    scene = Scene(Particles(jnp.zeros(1), jnp.ones(1)))
    run = lambda first: simulate(scene, methods.euler, dt=DT, steps=10, first_step=first)  # noqa: E731
    assert run(LAST_STEP - 10).ok
    with pytest.raises(ValueError, match="steps are counted in"):
        run(LAST_STEP - 9)
    with pytest.raises(ValueError, match="steps are counted in"):
        run(2**40)
    traced = jax.jit(jax.vmap(lambda first: run(first).ok))(jnp.asarray([0, LAST_STEP - 10, LAST_STEP - 9], jnp.int32))
    assert traced.tolist() == [True, True, False]


def test_products_and_quotients_of_a_count_leave_out_nothing():
    rng = np.random.default_rng(0)
    count = np.concatenate([rng.integers(0, LAST_STEP, 300), [0, 1, AGAIN + 1, LAST_STEP]]).astype(np.int32)
    number = (10 ** rng.uniform(-5, 2, count.size)).astype(np.float32)
    for function, exact in (
        (exact_multiple, count * number.astype(float)),
        (exact_quotient, count / number.astype(float)),
    ):
        whole, rest = jax.jit(function)(count, number)
        found = np.asarray(whole, float) + np.asarray(rest, float)
        np.testing.assert_allclose(found, exact, rtol=2**-46, atol=0)


def test_the_rest_of_a_number_follows_it_or_is_dropped():
    """It is of a number that is given in float64, and none of one that was put in its place or is float64 itself."""
    at = 86400.503
    whole, rest = jnp.float32(at), float32_remainder(at)
    assert float(np.float64(whole) + np.float64(cast_remainder(whole, rest))) == pytest.approx(at, abs=1e-9)
    assert float(cast_remainder(jnp.float32(1.0), rest)) == 0.0
    assert float(float32_remainder(jnp.float32(0.1))) == 0.0
    with jax.enable_x64(True):
        assert float(cast_remainder(jnp.float64(at), rest)) == 0.0
        assert float(jax.jit(float32_remainder)(jnp.float64(at))) == float(rest)
