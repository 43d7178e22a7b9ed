"""Steps that choose their own length: their errors, their counts, where they land, and how they give up."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Force, Particles, Scene, contacts, emitters, energy, forces, methods, simulate, springs
from physjax.scenes import SCENES
from physjax.stepping import reference

RK4 = methods.adaptive(methods.rk4, 1e-8, 1e-8)


def thrown():
    return Scene(Particles(jnp.zeros(2), jnp.asarray([3.0, 10.0])), forces=(forces.Gravity(),))


def final_error(problem, method, steps):
    exact = problem.exact(np.array([problem.duration])).position[0]
    run = simulate(problem.scene, method, dt=problem.duration / steps, steps=steps, save_every=steps)
    return np.abs(np.asarray(run.position[-1]) - exact).max()


def test_kepler_takes_a_third_of_the_evaluations_of_fixed_steps():
    problem, frames = SCENES["kepler"](), 4
    fixed = 20_000
    assert final_error(problem, methods.rk4, fixed) > 1e-6
    method = methods.adaptive(methods.rk4, 3e-10, 3e-10)
    assert final_error(problem, method, frames) < 1e-6
    counts = methods.count_steps(problem.scene, method, dt=problem.duration / frames, steps=frames)
    tries = int(jnp.sum(counts.accepted + counts.rejected))
    assert int(jnp.sum(counts.rejected)) <= 0.05 * tries
    assert 3 * (3 * 4 * tries + 2 * frames) <= 4 * fixed


# the gallery's scenes without contacts, and into how many parts a run is cut so that the first is a few dozen steps
SMOOTH = {"projectile": 10, "fall_with_drag": 40, "raindrop": 2000, "kepler": 800, "figure_eight": 80}
SMOOTH |= {"solar_system": 4000, "oscillator": 800, "oscillator_chain": 800, "hanging_rope": 10000}
SMOOTH |= {"hanging_cloth": 1000, "flag": 800}
STIFF = {"hanging_rope", "hanging_cloth", "flag"}
SLOW = STIFF | {"raindrop", "solar_system", "oscillator_chain", "figure_eight"}


def accepted_steps(problem, chooser, duration):
    """Start, length and end of each accepted step and its lanes, seen by running the method without compiling it."""
    tried = []

    def spy(system, t, state, dt):
        end = chooser.method(system, t, state, dt)
        if not isinstance(dt, jax.core.Tracer):  # shapes are asked for once
            tried.append((t, state, dt, end))
        return end

    watched = methods.adaptive(spy, chooser.atol, chooser.rtol, order=chooser.order)
    with jax.disable_jit():
        final = watched.report(problem.scene, jnp.zeros(()), problem.scene.state, duration).state
    wholes, halves = tried[::3], tried[2::3]
    for (t, start, dt, _), (*_, end), kept in zip(wholes, halves, [w[1] for w in wholes[1:]] + [final], strict=True):
        accepted = jnp.all(kept.position == end.position, axis=-1) & jnp.any(kept.position != start.position, axis=-1)
        yield t, start, dt, end, accepted


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in SMOOTH])
def test_the_local_error_of_accepted_steps_stays_within_twice_the_tolerance(name):
    problem = SCENES[name]()
    assert problem.is_ode

    @jax.jit
    def fine(t, state, dt):
        step = lambda i, state: methods.rk4(problem.scene, t + i * dt / 32, state, dt / 32)  # noqa: E731
        return jax.lax.fori_loop(0, 32, step, state)

    each = ((methods.euler, 1e-4), (methods.verlet, 1e-5), (methods.rk4, 1e-5))
    method, tolerance = each[list(SMOOTH).index(name) % 3]  # scene by scene another
    chooser = methods.adaptive(method, tolerance, tolerance)
    worst = 0.0
    for t, start, dt, end, accepted in accepted_steps(problem, chooser, problem.duration / SMOOTH[name]):
        truth = fine(t, start, dt)
        for got, right, was in zip(end, truth, start, strict=True):
            allowed = tolerance * (1 + jnp.maximum(jnp.abs(was), jnp.abs(got)))
            worst = max(worst, float(jnp.max(jnp.where(accepted[..., None], jnp.abs(got - right) / allowed, 0.0))))
    # a method that is exact here makes no error at all
    assert worst <= 2
    assert worst > 1e-3 or name == "projectile" or method is methods.rk4


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in SMOOTH if n not in STIFF]
)
def test_at_most_one_try_in_twenty_is_rejected(name):
    problem = SCENES[name]()
    each = ((methods.euler, 1e-4), (methods.verlet, 1e-4), (methods.rk4, 1e-4), (methods.rk4, 1e-6))
    for method, tolerance in each[list(SMOOTH).index(name) % 2 :: 2]:  # scene by scene others
        chooser = methods.adaptive(method, tolerance, tolerance)
        counts = methods.count_steps(problem.scene, chooser, dt=problem.duration / 4, steps=4)
        accepted, rejected = int(jnp.sum(counts.accepted)), int(jnp.sum(counts.rejected))
        assert rejected <= 0.05 * (accepted + rejected), (method.__name__, tolerance, accepted, rejected)


@pytest.mark.parametrize("method", [methods.rk4, methods.tsit5])
def test_frames_within_steps_cost_nothing_and_lie_on_the_path(method):
    problem = SCENES["kepler"]()
    chooser = methods.adaptive(method, 1e-8, 1e-8)
    counted, errors = [], []
    for frames in (1, 512):
        steps = methods.count_steps(problem.scene, chooser, dt=problem.duration / frames, steps=frames)
        counted.append(int(jnp.sum(steps.accepted + steps.rejected)))
        exact = problem.exact(problem.duration * np.arange(1, frames + 1) / frames).position
        errors.append(np.abs(np.asarray(steps.state.position) - exact).max())
    assert counted[0] == counted[1] < 512
    assert errors[1] < 1.01 * errors[0]


def test_a_run_and_the_counts_of_its_steps_are_of_the_same_steps():
    scene, chooser = SCENES["oscillator"]().scene, methods.adaptive(methods.tsit5, 1e-6, 1e-6)
    counted = methods.count_steps(scene, chooser, dt=0.1, steps=7)
    run = simulate(scene, chooser, dt=0.1, steps=7)
    np.testing.assert_allclose(run.position[1:], counted.state.position, rtol=1e-14)


def test_a_pair_takes_the_evaluations_of_one_step_a_try():
    problem, works = SCENES["kepler"](), {}
    for method, each in ((methods.rk4, 11), (methods.tsit5, 6)):
        chooser = methods.adaptive(method, 8e-10, 8e-10)
        steps = methods.count_steps(problem.scene, chooser, dt=problem.duration, steps=1)
        works[method] = each * int(steps.accepted[0] + steps.rejected[0])
        exact = problem.exact(np.array([problem.duration])).position[0]
        assert np.abs(np.asarray(steps.state.position[-1]) - exact).max() < 1e-6
    assert works[methods.tsit5] < 0.45 * works[methods.rk4]


def test_lanes_that_differ_in_speed_wait_for_the_slowest_alone():
    omega = jnp.asarray([1.0, 3.0, 10.0, 30.0])

    def count(stiffness):
        spring = forces.Anchor(point=jnp.zeros(1), stiffness=stiffness)
        scene = Scene(Particles(jnp.ones((*stiffness.shape, 1)), jnp.zeros((*stiffness.shape, 1))), forces=(spring,))
        counted = methods.count_steps(scene, methods.adaptive(methods.tsit5, 1e-6, 1e-6), dt=0.05, steps=200)
        tries = counted.accepted + counted.rejected
        return int(jnp.sum(jnp.max(tries, axis=1) if stiffness.ndim else tries))

    assert count(omega**2) <= 1.05 * count(omega[-1] ** 2)


def test_it_lands_on_the_end_and_lanes_have_steps_of_their_own():
    scene = SCENES["oscillator"]().scene
    report = RK4.report(scene, 0.0, scene.state, 1.0)
    assert report.accepted.shape == (4,)
    assert np.all(np.diff(report.accepted) > 0)
    assert bool(report.ok.all())
    omega = np.sqrt([1.0, 10.0, 100.0, 1000.0])
    np.testing.assert_allclose(report.state.position[:, 0], np.cos(omega), atol=1e-5)


def test_the_lectures_error_does_not_see_where_a_throw_goes():
    sound = methods.adaptive(methods.euler, 1e-3, 1e-3)
    blind = methods.adaptive(methods.euler, 1e-3, 1e-3, error="velocity")
    exact = np.array([6.0, 20.0 - 0.5 * 9.8 * 4.0])
    ends = [simulate(thrown(), method, dt=2.0, steps=1).position[-1] for method in (blind, sound)]
    assert np.abs(ends[0] - exact).max() > 4.0
    assert np.abs(ends[1] - exact).max() < 0.25
    told = methods.count_steps(thrown(), blind, dt=2.0, steps=1)
    assert int(told.rejected[0]) == 0


def test_a_floor_ends_the_lane_that_needs_less_and_no_other():
    scene = SCENES["oscillator"]().scene
    method = methods.adaptive(methods.euler, 1e-5, 1e-5, dt_min=1.5e-3)
    flight = simulate(scene, method, dt=0.1, steps=3)
    np.testing.assert_array_equal(flight.ok, [True, True, False, False])
    np.testing.assert_array_equal(flight.first_bad_step, [-1, -1, 1, 1])


def test_a_force_that_is_not_a_number_ends_in_a_status():
    scene = Scene(
        Particles(jnp.zeros(1), jnp.ones(1)), forces=(forces.independent(lambda t, s, m: s.velocity * jnp.nan),)
    )
    assert not bool(simulate(scene, RK4, dt=0.1, steps=2).ok)


@pytest.mark.slow
def test_a_bounded_number_of_tries_can_be_differentiated():
    bounded = methods.adaptive(methods.rk4, 1e-9, 1e-9, tries=40)

    def end(stiffness):
        spring = forces.Anchor(point=jnp.zeros(1), stiffness=stiffness)
        scene = Scene(Particles(jnp.ones(1), jnp.zeros(1)), forces=(spring,))
        return simulate(scene, bounded, dt=0.5, steps=4).position[-1, 0]

    assert end(2.0) == pytest.approx(np.cos(2 * np.sqrt(2.0)), abs=1e-7)
    assert jax.grad(end)(2.0) == pytest.approx(-np.sin(2 * np.sqrt(2.0)) / np.sqrt(2.0), abs=1e-6)
    few = methods.adaptive(methods.rk4, 1e-9, 1e-9, tries=2)
    assert not bool(simulate(SCENES["kepler"]().scene, few, dt=1.0, steps=1).ok)


@pytest.mark.parametrize("method", [methods.tsit5, methods.rk4])
def test_derivatives_need_no_bound_of_tries(method):
    chooser = methods.adaptive(method, 1e-10, 1e-10)

    def end(stiffness):
        spring = forces.Anchor(point=jnp.zeros(1), stiffness=stiffness)
        scene = Scene(Particles(jnp.ones(1), jnp.zeros(1)), forces=(spring,))
        return simulate(scene, chooser, dt=0.5, steps=4).position[-1, 0]

    right = -np.sin(2 * np.sqrt(2.0)) / np.sqrt(2.0)
    assert jax.grad(end)(2.0) == pytest.approx(right, abs=1e-8)
    assert jax.jvp(end, (2.0,), (1.0,))[1] == pytest.approx(right, abs=1e-8)


def test_the_derivative_by_dt_is_the_velocity():
    scene = SCENES["oscillator"]().scene
    end = lambda dt: simulate(scene, methods.adaptive(methods.tsit5, 1e-9, 1e-9), dt=dt, steps=3).position[-1, :2, 0]  # noqa: E731
    omega = np.sqrt([1.0, 10.0])
    np.testing.assert_allclose(jax.jvp(end, (0.2,), (1.0,))[1], -3 * omega * np.sin(0.6 * omega), atol=1e-6)


def test_too_few_tries_leave_no_derivatives_and_harm_no_other_lane():
    few = methods.adaptive(methods.euler, 1e-6, 1e-6, tries=2)

    def ends(stiffness):
        spring = forces.Anchor(point=jnp.zeros(1), stiffness=stiffness)
        scene = Scene(Particles(jnp.ones((2, 1)), jnp.zeros((2, 1))), forces=(spring,))
        return simulate(scene, few, dt=0.5, steps=1).position[-1, :, 0]

    @jax.jit
    def told(stiffness):
        forward = jax.jvp(ends, (stiffness,), (jnp.ones(2),))
        return *forward, jax.grad(lambda k: jnp.sum(ends(k)))(stiffness)

    for found in told(jnp.asarray([1e-9, 50.0])):  # the slow spring is through in two tries
        np.testing.assert_array_equal(np.isfinite(found), [True, False])


def test_it_works_in_both_precisions(precision):
    scene = Scene(Particles(jnp.ones(1, precision.dtype), jnp.zeros(1, precision.dtype)), forces=(
        forces.Anchor(point=jnp.zeros(1, precision.dtype), stiffness=1.0),
    ))  # fmt: skip
    flight = simulate(scene, methods.adaptive(methods.rk4, 1e-5, 1e-5), dt=0.5, steps=8)
    assert flight.position.dtype == precision.dtype
    np.testing.assert_allclose(flight.position[:, 0], np.cos(flight.time), atol=1e-4)


def test_bad_input_is_refused(unannotated):
    with pytest.raises(ValueError, match="atol"):
        methods.adaptive(methods.rk4, atol=0.0)
    with pytest.raises(ValueError, match="rtol"):
        methods.adaptive(methods.rk4, rtol=-1.0)
    with pytest.raises(ValueError, match="more than dt_max"):
        methods.adaptive(methods.rk4, dt_min=1.0, dt_max=0.1)
    with pytest.raises(TypeError, match=r"such as methods\.rk4"):
        methods.adaptive("rk4")
    with pytest.raises(ValueError, match="Give order="):
        methods.adaptive(lambda system, t, state, dt: state)
    with pytest.raises(ValueError, match="lecture"):
        methods.adaptive(methods.rk4, error="speed")
    with pytest.raises(TypeError, match=r"expected methods\.adaptive"):
        methods.count_steps(thrown(), methods.rk4, dt=1.0, steps=1)


# what jumps, from rest on 1 kg, and where it is after 1 s in closed form
JUMPS = [
    (lambda: forces.Kick((1.0,), at=0.1, duration=0.01), 0.895),
    (lambda: forces.Control([[1.0], [-1.0], [3.0]], duration=0.9), 0.315),
    # its means over the whole and over both halves tell nothing
    (lambda: forces.Control([[1.0], [-1.0], [-1.0], [1.0], [1.0], [-1.0], [-1.0], [1.0], [2.0]], duration=0.9), 0.03),
    (lambda: forces.Control([[0.0], [2.0], [0.0]], duration=0.8, at=0.1, linear=True), 0.4),
]


@pytest.mark.parametrize(("build", "right"), JUMPS)
def test_what_jumps_arrives_whole_and_on_time_however_long_the_dt(build, right):
    scene = Scene(Particles(jnp.zeros(1), jnp.zeros(1)), forces=(build(),))
    loose = methods.adaptive(methods.rk4, 1e-3, 1e-3)
    for method, dt in ((loose, 1.0), (RK4, 0.5)):
        run = simulate(scene, method, dt=dt, steps=round(1 / dt))
        assert run.ok
        assert float(run.position[-1, 0]) == pytest.approx(right, abs=1e-9)


def test_a_blast_under_error_control_is_that_of_fine_equal_steps():
    blast = forces.Blast((-1.0,), 4.0, 1.0, at=0.1, duration=0.01)
    scene = Scene(Particles(jnp.zeros(1), jnp.zeros(1)), forces=(blast,))
    fine = simulate(scene, methods.rk4, dt=2e-3, steps=500, save_every=500)
    assert float(simulate(scene, RK4, dt=1.0, steps=1).position[-1, 0]) == pytest.approx(
        float(fine.position[-1, 0]), abs=1e-7
    )


def test_each_lane_stops_at_its_own_jumps_alone():
    at = np.array([0.1, 0.2, 0.5])
    # as many knots as lanes: they belong to all of them
    push, kick = forces.Control([[1.0], [-1.0]], duration=0.9), forces.Kick((1.0,), at=at, duration=0.01)
    scene = Scene(Particles(jnp.zeros((3, 1)), jnp.zeros((3, 1))), forces=(push, kick))
    told = methods.count_steps(scene, methods.adaptive(methods.rk4, 1e-8, 1e-8), dt=1.0, steps=1)
    np.testing.assert_allclose(told.state.position[0, :, 0], 0.45**2 + 1 - at - 0.005, atol=1e-9)
    assert int(told.accepted.max()) <= 12
    many = Scene(
        Particles(jnp.zeros((300, 1)), jnp.zeros((300, 1))),
        forces=(forces.Kick((1.0,), at=jnp.linspace(0.1, 0.9, 300), duration=0.01),),
    )
    assert int(methods.count_steps(many, RK4, dt=1.0, steps=1).accepted.max()) <= 8


def test_a_force_of_ones_own_that_tells_its_mean_but_no_times_is_seen_by_the_error():
    class Tap(Force):
        def __call__(self, t, state, mass):
            return jnp.where((t >= 0.1) & (t < 0.11), 100.0, 0.0) * jnp.ones_like(state.velocity)

        def averaged_over_step(self, t, dt, state):
            share = jnp.clip(0.11, t, t + dt) - jnp.clip(0.1, t, t + dt)
            return forces.Constant(100 * share / dt * jnp.ones_like(state.velocity))

    scene = Scene(Particles(jnp.zeros(1), jnp.zeros(1)), forces=(Tap(),))
    run = simulate(scene, methods.adaptive(methods.rk4, 1e-7, 1e-7), dt=1.0, steps=1)
    assert run.ok
    assert float(run.position[-1, 0]) == pytest.approx(0.895, abs=1e-6)


def test_a_force_of_ones_own_may_list_its_jumps_as_plain_numbers():
    class Push(Force):
        def __call__(self, t, state, mass):
            return jnp.where(t >= 0.25, 2.0, 0.0) * jnp.ones_like(state.velocity)

        def discontinuities(self):
            return [0.25]

    scene = Scene(Particles(jnp.zeros(1), jnp.zeros(1)), forces=(Push(),))
    assert reference.discontinuities(scene).tolist() == [0.25]
    run = simulate(scene, methods.adaptive(methods.rk4, 1e-5, 1e-5), dt=1.0, steps=1)
    assert run.ok
    assert float(run.position[-1, 0]) == pytest.approx(0.75**2, abs=1e-4)


@pytest.mark.slow
def test_the_derivative_by_when_a_kick_comes_is_minus_its_velocity():
    def end(at, tries):
        scene = Scene(Particles(jnp.zeros(1), jnp.zeros(1)), forces=(forces.Kick((2.0,), at=at, duration=0.01),))
        method = methods.adaptive(methods.rk4, 1e-6, 1e-6, tries=tries)
        return simulate(scene, method, dt=1.0, steps=1).position[-1, 0]

    assert jax.jvp(lambda at: end(at, None), (0.1,), (1.0,))[1] == pytest.approx(-2.0, abs=1e-9)
    assert jax.grad(end)(0.1, 12) == pytest.approx(-2.0, abs=1e-9)


def overstretched():
    """Two masses that a spring lets go at a tenth of its length, which they pass in the middle of a swing of 1 s."""
    swing = Particles(jnp.asarray([[0.0, 0.0], [1.0, 0.0]]), jnp.asarray([[-1.0, 0.0], [1.0, 0.0]]))
    return Scene(swing, forces=(springs.Springs([[0, 1]], 2 * np.pi**2, 1.0, breaks_at=0.1),))


def tied_over_a_floor():
    tied = Particles(jnp.asarray([[0.0, 1.0], [1.0, 1.0]]), jnp.zeros((2, 2)))
    floor = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.8)
    return Scene(tied, forces=(forces.Gravity(), springs.Springs([[0, 1]], 10.0, 1.0)), contacts=(floor,))


def test_a_pool_whose_contacts_act_at_the_ends_of_steps_is_refused_plainly():
    floor = contacts.Plane((0.0, 0.0), (0.0, 1.0), response=contacts.project)
    fountain = emitters.Emitter(4, emitters.Point((0.0, 0.0)), key=0, life=1.0, speed=1.0, rate=2.0)
    pool = Scene(fountain.unborn(), forces=(forces.Gravity(),), contacts=(floor,), emitter=fountain)
    with pytest.raises(ValueError, match="equal steps"):
        simulate(pool, RK4, dt=0.3, steps=4)


def test_a_spring_breaks_within_a_dt():
    run = simulate(overstretched(), RK4, dt=1.0, steps=1)
    assert not bool(run.final_scene.forces[0].unbroken[0])
    # relative x = sin(2πt)/π reaches 0.1 at t, and from there both fly on
    t = np.arcsin(0.1 * np.pi) / (2 * np.pi)
    away = 0.05 + np.cos(2 * np.pi * t) * (1 - t)
    np.testing.assert_allclose(run.position[-1, :, 0], [-away, 1 + away], atol=1e-5)


@pytest.mark.slow
def test_what_is_done_between_its_steps_cannot_be_audited():
    run = simulate(tied_over_a_floor(), methods.adaptive(methods.rk4, 1e-4, 1e-4), dt=0.3, steps=1)
    with pytest.raises(ValueError, match="under error control"):
        energy.ledger(run)


def test_balls_that_are_tied_bounce_within_a_dt():
    run = simulate(tied_over_a_floor(), RK4, dt=0.3, steps=4)
    # down, up and down again with 0.8 of the speed, and up with 0.64
    down = np.sqrt(2 / 9.8)
    since = 1.2 - 2.6 * down
    np.testing.assert_allclose(run.position[-1, :, 1], 0.64 * 9.8 * down * since - 4.9 * since**2, atol=1e-4)


@pytest.mark.parametrize("method", [methods.tsit5, methods.rk4])
def test_alone_in_a_batch_and_under_vmap_lanes_take_the_same_steps(method):
    chooser, omega = methods.adaptive(method, 1e-6, 1e-6), jnp.asarray([1.0, 3.0, 10.0])

    def run(stiffness):
        shape = (*stiffness.shape, 1)
        spring = forces.Anchor(point=jnp.zeros(1), stiffness=stiffness)
        scene = Scene(Particles(jnp.ones(shape), jnp.zeros(shape)), forces=(spring, forces.StokesDrag(0.1)))
        return simulate(scene, chooser, dt=0.25, steps=8).position

    together = run(omega**2)
    alone = jnp.stack([run(k) for k in omega**2], axis=1)
    np.testing.assert_allclose(together, alone, rtol=1e-12, atol=1e-14)
    mapped = jax.vmap(run, out_axes=1)(omega**2)
    np.testing.assert_allclose(mapped, alone, rtol=1e-12, atol=1e-14)
