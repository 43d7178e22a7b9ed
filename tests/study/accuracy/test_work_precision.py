"""Work-precision: orders found, failures kept, truths named, one compilation a method."""

import csv
from dataclasses import replace

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Pins, Scene, contacts, emitters, forces, inertia, lattices, methods, rigid, springs
from physjax.parts import as_module
from physjax.scenes import SCENES
from physjax.stepping.methods import METHODS
from physjax.stepping.simulate import sample_states
from physjax.study import accuracy
from physjax.study.accuracy import Budget, work_precision
from physjax.study.accuracy.compiled_run import compile_run, stack_copies
from physjax.study.problem import Problem
from physjax.text import format_seconds

FEW = Budget(seconds=0.02, repeats=1, refinement=2.0)


@pytest.fixture(scope="module")
def swing():
    """Two light oscillators under every method, at steps from coarse to fine."""
    springs = SCENES["oscillator"](stiffness=(1.0, 9.0))
    return work_precision(springs, dts=2.0 ** -np.arange(4, 15), rivals=(), name="oscillator", budget=FEW)


def test_every_method_shows_its_promised_order(swing):
    for name, method in METHODS.items():
        if method.promises.order <= 5:  # the errors of higher orders are rounding at all of these steps
            assert swing.observed_order(name) == pytest.approx(method.promises.order, abs=0.15), name


def test_drag_lowers_leapfrog_to_first_order_and_the_promise_says_so():
    fall = work_precision(SCENES["fall_with_drag"](), [methods.leapfrog, methods.verlet], rivals=(), budget=FEW)
    assert fall.promised == {"leapfrog": 1, "verlet": 2}
    assert fall.observed_order("leapfrog") == pytest.approx(1, abs=0.15)
    assert fall.observed_order("verlet") == pytest.approx(2, abs=0.15)


def test_runs_that_fail_are_kept_with_their_step():
    springs = SCENES["oscillator"](stiffness=(1.0, 1000.0))
    stiff = work_precision(springs, [methods.rk4], dts=2.0 ** -np.arange(2, 8), rivals=(), budget=FEW)
    rk4 = stiff.of("rk4")
    limit = 2 * np.sqrt(2) / np.sqrt(1000)
    assert {run.status for run in rk4 if run.dt > 1.02 * limit} <= {"not finite", "off the path"}
    assert all(run.status == "ok" for run in rk4 if run.dt < 0.9 * limit)
    assert rk4[0].status != "ok"
    assert format_seconds(min(run.dt for run in rk4 if run.status != "ok")) in stiff.table()


def test_steps_fit_between_the_moments_compared(swing):
    problem = SCENES["oscillator"]()
    for run in swing.of("verlet"):
        assert run.steps % problem.frames == 0
        assert run.dt * run.steps == pytest.approx(problem.duration, rel=1e-12)
        assert run.evaluations == 2 * run.steps


def test_the_closed_form_is_the_truth_where_there_is_one_else_a_reference_with_its_own_error():
    assert work_precision(SCENES["projectile"](), [methods.rk4], [0.1], rivals=(), budget=FEW).truth == "closed form"
    eight = work_precision(SCENES["figure_eight"](), [methods.rk4], [0.01], rivals=(), budget=FEW)
    assert "Dopri8" in eight.truth
    assert 0 < eight.floor < 1e-10


def test_a_projectile_is_exact_for_second_order(swing):
    throw = work_precision(
        SCENES["projectile"](), [methods.midpoint, methods.euler], [0.1, 0.05, 0.02, 0.01], rivals=(), budget=FEW
    )
    assert throw.observed_order("midpoint") == float("inf")
    assert "exact" in throw.table()
    assert throw.observed_order("euler") == pytest.approx(1, abs=0.02)


def test_diffrax_runs_in_the_same_study():
    eight = work_precision(SCENES["figure_eight"](), [methods.rk4], [0.02], tolerances=(1e-3, 1e-6, 1e-9), budget=FEW)
    assert eight.methods == ("rk4", "diffrax Tsit5", "diffrax Dopri8")
    errors = [run.path_error for run in eight.of("diffrax Tsit5")]
    assert errors[0] > errors[1] > errors[2] > eight.floor
    assert all(run.seconds > 0 and run.seconds_median >= run.seconds for run in eight.runs)


def test_one_compilation_serves_all_steps():
    traces = []

    @forces.independent
    def counted(t, state, mass):
        traces.append(t)
        return -state.position

    scene = Scene(Particles(jnp.ones((3, 2)), jnp.zeros((3, 2))), forces=(counted,))
    study = lambda dts: work_precision(scene, [methods.euler], dts, duration=1.0, rivals=(), budget=FEW)  # noqa: E731
    study([0.01])
    one = len(traces)
    traces.clear()
    study([0.02, 0.01, 0.005, 0.0025, 0.001])
    assert len(traces) <= one


def test_float32_shows_its_rounding():
    swing32 = work_precision(SCENES["oscillator"](), [methods.rk4], [1e-3], dtype=np.float32, rivals=(), budget=FEW)
    assert swing32.dtype == "float32"
    assert 1e-7 < swing32.runs[0].path_error < 1e-3


def test_a_users_method_is_counted_and_unpromised():
    def heun(system, t, state, dt):
        first = system.rate(t, state)
        ahead = system.drift(system.kick(state, first, dt), dt)
        return Particles(
            *(y + dt / 2 * (a + b) for y, a, b in zip(state, first, system.rate(t + dt, ahead), strict=True))
        )

    study = work_precision(SCENES["projectile"](), [heun], [0.1], rivals=(), budget=FEW)
    assert study.runs[0].evaluations == 2 * study.runs[0].steps
    assert np.isnan(study.promised["heun"])


def test_csv_holds_every_run(swing, tmp_path):
    swing.to_csv(tmp_path / "runs.csv")
    with open(tmp_path / "runs.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(swing.runs)
    assert float(rows[0]["path_error"]) == swing.runs[0].path_error
    assert {"drift of energy", "status", "seconds_median", "compile_seconds"} <= set(rows[0])


def test_the_fastest_run_keeps_its_error(swing):
    best = swing.fastest(1e-4)
    assert best.path_error <= 1e-4
    assert all(run.seconds >= best.seconds for run in swing.runs if run.path_error <= 1e-4)
    assert swing.fastest(1e-30) is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"problem": 3}, "expected a Scene or a Problem"),
        ({}, "duration"),
        ({"duration": -1.0}, "duration"),
        ({"duration": 1.0, "dts": [0.1, -0.1]}, "dts"),
        ({"duration": 1.0, "dts": [0.1, np.nan]}, "dts"),
        ({"duration": 1.0, "batches": 3}, "unknown work_precision: option .batches.. Did you mean batch"),
    ],
)
@pytest.mark.usefixtures("unannotated")
def test_bad_input_is_refused_in_plain_words(arguments, message):
    scene = Scene(Particles(jnp.zeros(2), jnp.ones(2)), forces=(forces.Gravity(),))
    with pytest.raises((TypeError, ValueError), match=message):
        work_precision(**({"problem": scene} | arguments))


def test_diffrax_is_no_rival_where_it_would_fall_through_the_floor():
    floor = contacts.Plane((0.0,), (1.0,))
    ball = Scene(Particles(jnp.ones(1), jnp.zeros(1)), forces=(forces.Gravity(up=0),), contacts=(floor,))

    def exact(t):
        fall = np.sqrt(2 / 9.8)
        since = np.where(t < fall, t, t - 2 * fall)[:, None]  # an elastic bounce: the same parabola again
        return Particles(1 - 4.9 * since**2, -9.8 * since)

    study = work_precision(ball, [methods.verlet], [1e-3, 1e-4], duration=1.0, exact=exact, budget=FEW)
    assert study.methods == ("verlet", "verlet, projected")
    assert {(run.scheme, run.treatment) for run in study.runs} == {("verlet", "as given"), ("verlet", "projected")}
    assert study.of("verlet")[-1].path_error < 1e-12
    assert 1e-6 < study.of("verlet, projected")[-1].path_error < 2e-3
    with pytest.raises(ValueError, match="has contacts"):
        work_precision(ball, [methods.verlet], [1e-3], duration=1.0, exact=exact, rivals=accuracy.default_rivals())


def test_when_a_bounce_is_resolved_decides_the_order():
    """Forty-eight drop heights with drag: timed, a method keeps its order; at the end of the step, all are first order."""
    dts = 2.0 / 32 / 2.0 ** np.arange(11)
    study = work_precision(SCENES["bouncing_ball"](), [methods.verlet, methods.rk4], dts, budget=FEW)
    assert study.truth == "closed form"
    assert study.promised == {"verlet": 2, "verlet, projected": 1, "rk4": 4, "rk4, projected": 1}
    assert study.observed_order("verlet") == pytest.approx(2, abs=0.15)
    assert study.observed_order("rk4") == pytest.approx(4, abs=0.15)
    assert study.observed_order("verlet, projected") == pytest.approx(1, abs=0.2)
    assert study.observed_order("rk4, projected") == pytest.approx(1, abs=0.2)
    assert "rk4, projected" in study.table()


def test_contacts_without_a_closed_form_are_measured_against_our_own_fine_steps():
    study = work_precision(SCENES["free_kick"](), [methods.rk4], [1e-3, 1e-2], budget=FEW)
    assert "own rk4" in study.truth
    assert 0 < study.floor < 1e-12
    timed, projected = study.of("rk4"), study.of("rk4, projected")
    assert timed[0].path_error < 1e-9 < 1e-5 < projected[0].path_error


def test_what_is_projected_already_has_one_treatment():
    floor = contacts.Plane((0.0,), (1.0,), response=contacts.project)
    ball = Scene(Particles(jnp.ones(1), jnp.zeros(1)), forces=(forces.Gravity(up=0),), contacts=(floor,))
    study = work_precision(ball, [methods.verlet], [1e-3], duration=1.0, budget=FEW)
    assert study.promised == {"verlet": 1}
    # finer steps than the run's by far, but not the 1e-13 of a reference that keeps its order
    assert study.floor > 1e-9, "the reference is first order too, and says so"


@pytest.fixture(scope="module")
def both_kinds():
    """An oscillator in both float types, by steps and by tolerances, with another norm and its gradient."""
    spring = Scene(Particles(jnp.ones(1), jnp.zeros(1)), forces=(forces.Anchor((0.0,), 9.0),))
    return work_precision(
        spring,
        [methods.verlet, methods.adaptive(methods.rk4)],
        2.0 ** -np.arange(4, 9),
        duration=4.0,
        rivals=(),
        norms=(accuracy.energy,),
        dtype=(np.float64, np.float32),
        tolerances=(1e-3, 1e-5, 1e-7),
        gradient=True,
        budget=FEW,
    )


def test_float_types_and_adaptive_methods_stand_side_by_side(both_kinds):
    names = ("verlet", "verlet, float32", "adaptive rk4", "adaptive rk4, float32")
    assert both_kinds.methods == names
    assert {run.dtype for run in both_kinds.of("verlet, float32")} == {"float32"}
    assert {(run.scheme, run.adaptive) for run in both_kinds.runs} == {("verlet", False), ("rk4", True)}
    assert {run.treatment for run in both_kinds.runs} == {"as given"}
    assert both_kinds.observed_order("verlet") == pytest.approx(2, abs=0.15)
    runs = both_kinds.of("adaptive rk4")
    assert [run.tolerance for run in runs] == [1e-3, 1e-5, 1e-7]
    assert runs[0].path_error > runs[1].path_error > runs[2].path_error
    assert runs[0].evaluations < runs[1].evaluations < runs[2].evaluations


def test_other_norms_fall_with_the_step_too(both_kinds, tmp_path):
    errors = [run.errors[0] for run in both_kinds.of("verlet")]
    assert np.log2(errors[0] / errors[-1]) / 4 == pytest.approx(2, abs=0.2)
    both_kinds.to_csv(tmp_path / "runs.csv")
    with open(tmp_path / "runs.csv", newline="") as file:
        assert float(next(csv.DictReader(file))["error of energy"]) == errors[0]


def test_the_error_of_the_gradient_falls_with_the_order_of_the_method(both_kinds):
    """The derivative of x(t) by the start's velocity is sin(ωt)/ω; verlet's is that at a shifted frequency."""
    runs = [run for run in both_kinds.gradients if run.method == "verlet"]
    assert np.log2(runs[0].path_error / runs[-1].path_error) / 4 == pytest.approx(2, abs=0.2)
    dt, t = runs[0].dt, np.linspace(0.0, 4.0, 33)
    swing = np.arccos(1 - 4.5 * dt**2) / dt
    # the step's own matrix: x after n steps from a unit velocity is dt sin(nφ)/sin φ
    slopes = dt * np.sin(swing * t) / np.sin(swing * dt)
    true = np.sin(3 * t) / 3
    assert runs[0].path_error == pytest.approx(np.abs(slopes - true).max() / np.abs(true).max(), rel=1e-6)


def test_nothing_beats_the_front(both_kinds):
    front = both_kinds.front
    assert front
    for run in both_kinds.runs:
        assert not any(run.seconds < best.seconds and run.path_error < best.path_error for best in front)


def test_chaos_is_marked_where_rounding_has_grown():
    """Three bodies from rest (Burrau's problem): in float32 rounding decides the path, an oscillator's is not."""
    place = jnp.asarray([[1.0, 3.0], [-2.0, -1.0], [1.0, -1.0]])
    attraction = forces.Gravitation(G=1.0, softening=0.02)
    bodies = Scene(Particles(place, jnp.zeros_like(place)), mass=jnp.asarray([3.0, 4.0, 5.0]), forces=(attraction,))
    study = work_precision(bodies, [methods.rk4], [0.1], duration=40.0, rivals=(), dtype=np.float32, budget=FEW)
    assert 5.0 < study.horizon < 40.0
    assert any("chaos: beyond" in text.get_text() for text in study.plot().axes[0].texts)


def test_times_are_those_of_the_batch_and_errors_those_of_one(both_kinds):
    spring = Scene(Particles(jnp.ones(1), jnp.zeros(1)), forces=(forces.Anchor((0.0,), 9.0),))
    study = lambda batch: work_precision(  # noqa: E731
        spring, [methods.verlet], [2.0**-8], duration=4.0, rivals=(), batch=batch, budget=FEW
    ).runs[0]
    one, many = study(1), study(20_000)
    assert many.path_error == one.path_error
    assert many.seconds > 10 * one.seconds


@pytest.mark.parametrize("name", ["oscillator", "kepler", "hanging_rope"])
def test_copies_of_a_scene_move_as_it_does(name):
    problem = SCENES[name]()
    run = lambda scene: sample_states(scene, as_module(methods.euler), problem.duration / 640, jnp.asarray(2), frames=4)  # noqa: E731
    one, many = run(problem.scene), run(stack_copies(problem.scene, 3))
    assert many.position.shape[1] == 3
    np.testing.assert_allclose(many.position[:, 2], one.position, rtol=1e-12, atol=1e-12)


def ball_on_a_floor():
    """One particle with a contact that remembers nothing."""
    one = ball_in_a_room()
    return Scene(
        one.state,
        forces=one.forces,
        contacts=[replace(one.contacts[0], response=contacts.project, touching_since=None)],
    )


def ball_in_a_room():
    """One particle, whose contact remembers since when it touches which wall."""
    room = contacts.Room((-1.0, 0.0), (1.0, 2.0), restitution=0.8)
    return Scene(Particles(jnp.array([0.0, 0.3]), jnp.array([3.0, 0.0])), forces=(forces.Gravity(),), contacts=(room,))


def balls_in_a_room():
    """Three, each with a memory and a mass of its own."""
    one = ball_in_a_room()
    thrice = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf, leaf]), one.state)
    return Scene(thrice, jnp.array([1.0, 2.0, 3.0]), one.forces, [replace(one.contacts[0], touching_since=None)])


def breaking_rope():
    """Springs that remember which of them broke: the middle one is stretched too far."""
    rope = lattices.rope((0.0, 0.0), (1.0, 0.0), 4, mass=1.0, stiffness=100.0, breaks_at=0.05)
    return Scene(Particles(rope.state.position.at[2:, 0].add(0.1), rope.state.velocity), rope.mass, (rope.springs,))


@pytest.mark.parametrize(
    "build",
    [
        ball_on_a_floor,
        breaking_rope,
        *(pytest.param(b, marks=pytest.mark.slow) for b in (ball_in_a_room, balls_in_a_room)),
    ],
)
def test_copies_remember_each_on_its_own(build):
    run = lambda scene: sample_states(scene, as_module(methods.verlet), 0.02, jnp.asarray(10), frames=4)  # noqa: E731
    one, many = run(build()), run(stack_copies(build(), 3))
    assert many.position.shape[1] == 3
    np.testing.assert_allclose(many.position[:, 2], one.position, rtol=1e-12, atol=1e-12)


def fountain():
    """An emitter, whose slots are the one axis of its lanes."""
    spray = emitters.Emitter(8, emitters.Point((0.0, 0.0)), key=0, life=1.0, speed=5.0, rate=7.0, cone=0.3)
    return Scene(spray.unborn(), forces=(forces.Gravity(),), emitter=spray)


def loaded_pair():
    """Two masses on a spring, and a plain function that names its lanes and holds an array of them."""
    pull = jnp.asarray([[0.0, -1.0], [0.5, 0.0]])
    spring = springs.Springs([[0, 1]], stiffness=10.0, rest_length=1.0)
    load = lambda t, s, m: pull * t + (s.position[::-1] - s.position)  # noqa: E731
    return Scene(Particles(jnp.asarray([[0.0, 0.0], [1.2, 0.0]]), jnp.zeros((2, 2))), forces=(spring, load))


def shaken_rope():
    """Springs, a node with prescribed motion, and a drag per node."""
    rope = lattices.rope((0.0, 0.0), (1.0, 0.0), 4, mass=1.0, stiffness=100.0)
    hand = Pins(jnp.arange(4) == 0, path=lambda t: rope.state.position + jnp.array([[0.0, 1.0]]) * t)
    drag = forces.StokesDrag(jnp.array([0.1, 0.2, 0.3, 0.4]))
    return Scene(hand.prescribe(0.0, rope.state), rope.mass, (rope.springs, drag), pinned=hand)


def spinning_body():
    """A body under its weight, over a plane."""
    brick = inertia.box(2.0, (1.0, 2.0, 3.0))
    return Scene(rigid.bodies(brick, jnp.zeros((2, 3)), angular_velocity=(1.0, 2.0, 3.0)), brick, (forces.Gravity(),))


@pytest.mark.parametrize("build", [fountain, loaded_pair, shaken_rope, spinning_body, ball_on_a_floor])
def test_every_copy_of_a_batch_moves_as_the_scene_alone(build):
    problem = Problem(build(), 0.6, frames=4)
    with jax.enable_x64(True):
        one, many = (compile_run(problem, methods.verlet, copies=copies)(8.0) for copies in (1, 3))
    for alone, batch in zip(jax.tree.leaves(one), jax.tree.leaves(many), strict=True):
        assert batch.shape == (alone.shape[0], 3, *alone.shape[1:])
        for copy in range(3):
            np.testing.assert_allclose(batch[:, copy], alone, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("build", "rivals"),
    [(loaded_pair, (diffrax.Tsit5(),)), pytest.param(fountain, (), marks=pytest.mark.slow)],
)
def test_a_batch_of_a_scene_that_cannot_be_stacked_is_timed(build, rivals):
    options = accuracy.Options(batch=5, rivals=rivals, tolerances=(1e-3,))
    study = work_precision(build(), [methods.euler], [0.02], duration=0.4, budget=FEW, options=options)
    assert all(run.seconds > 0 and np.isfinite(run.path_error) for run in study.runs)
    assert study.batch == 5


def test_keywords_come_before_the_options():
    options = accuracy.Options(name="spring", dtype=np.float32, rivals=())
    spring = Scene(Particles(jnp.ones(1), jnp.zeros(1)), forces=(forces.Anchor((0.0,), 9.0),))
    few = {"duration": 1.0, "budget": FEW, "options": options}
    study = work_precision(spring, [methods.verlet], [0.1], name="other", **few)
    assert (study.name, study.methods) == ("other", ("verlet, float32",))


def test_rivals_can_be_chosen():
    assert [type(solver).__name__ for solver in accuracy.default_rivals()] == ["Tsit5", "Dopri8"]


def test_chaos_is_found_beyond_where_neighbouring_paths_have_separated():
    place = Particles(jnp.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]), jnp.zeros((3, 2)))
    rods = springs.Springs([[0, 1], [1, 2]], stiffness=500.0, rest_length=1.0)
    double = Scene(place, pinned=jnp.array([True, False, False]), forces=(forces.Gravity(), rods))
    study = work_precision(double, [methods.rk4], [0.01], duration=40.0, rivals=(), budget=FEW)
    assert 20.0 < study.horizon < 38.0  # the growth of a deviation itself is 1e14 at 26 s
    assert work_precision(double, [methods.rk4], [0.01], duration=5.0, rivals=(), budget=FEW).horizon == np.inf
