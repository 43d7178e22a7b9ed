"""The loop: frames and time, resuming, one compilation, batches, derivatives, memory, and plain words for bad numbers."""

import math
import warnings
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from physjax import Particles, Scene, contacts, forces, lattices, memory, methods, simulate
from physjax.parts import Force
from physjax.physics.forces import independent
from physjax.stepping.methods import METHODS
from physjax.stepping.simulate import state_after
from physjax.text import format_bytes

MASS = np.array([0.2, 0.5, 1.0, 2.0, 4.0])


def gust(t, state, mass):
    """A push that depends on time and place, so that a run that loses count of time is found out."""
    t = jnp.asarray(t, state.dtype)
    return jnp.stack([jnp.sin(3.0 * t + state.position[..., 1]), 0.1 * state.position[..., 0]], axis=-1)


FORCES = (forces.Gravity(), forces.QuadraticDrag(area=0.05, coefficient=0.4), independent(gust))


def balls(dtype=float, mass=MASS, **numbers):
    """Five balls of different mass, thrown upwards."""
    x, v = np.zeros((5, 2)), np.stack([np.linspace(1, 5, 5), np.linspace(9, 3, 5)], axis=-1)
    return Scene(Particles(jnp.asarray(x, dtype), jnp.asarray(v, dtype)), mass=mass, forces=FORCES, **numbers)


def bodies():
    """Two scenes of three bodies that attract each other."""
    x = np.array([[[0, 0], [1, 0], [0, 2]], [[0, 0], [3, 1], [-2, 0]]], float)
    v = np.array([[[0, 0], [0, 1], [0.7, 0]], [[0, -0.5], [0, 0.6], [0.2, 0]]])
    return Scene(Particles(jnp.asarray(x), jnp.asarray(v)), forces=(forces.Gravitation(G=1.0),))


# frames and time


def test_a_duration_is_so_many_steps():
    counted = simulate(balls(), methods.rk4, dt=0.01, steps=50, save_every=5)
    timed = simulate(balls(), methods.rk4, dt=0.01, duration=0.5, save_every=5)
    jax.tree.map(np.testing.assert_array_equal, timed.state, counted.state)
    assert timed.steps == counted.steps == 50


def test_frame_0_is_the_start_and_saving_fewer_frames_changes_none_of_them(precision):
    every = simulate(balls(precision.dtype), methods.rk4, dt=0.01, steps=92)
    some = simulate(balls(precision.dtype), methods.rk4, dt=0.01, steps=92, save_every=46)
    assert every.position.shape == (93, 5, 2)
    assert some.position.shape == (3, 5, 2)
    rounding = 64 * precision.eps
    for few, all_of_them, start in zip(some.state, every.state, balls(precision.dtype).state, strict=True):
        np.testing.assert_array_equal(all_of_them[0], start)
        np.testing.assert_allclose(few, all_of_them[::46], rtol=rounding, atol=rounding)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[-1], b), some.state, some.final_scene.state)


def test_time_is_counted_not_accumulated(precision):
    film = simulate(balls(precision.dtype), methods.euler, dt=0.1, steps=1000, save_every=10, first_step=7)
    dt = np.asarray(0.1, precision.dtype)
    np.testing.assert_array_equal(film.time, np.arange(7, 1008, 10).astype(precision.dtype) * dt)
    assert film.time.dtype == precision.dtype


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_a_resumed_run_is_the_uninterrupted_run_bit_for_bit(method):
    whole = simulate(balls(), method, dt=0.01, steps=60, save_every=10)
    first = simulate(balls(), method, dt=0.01, steps=30, save_every=10)
    second = simulate(first.final_scene, method, dt=0.01, steps=30, save_every=10, first_step=first.final_step)
    for name in ("time", "position", "velocity"):
        np.testing.assert_array_equal(getattr(second, name), getattr(whole, name)[3:])
    assert second.final_step == 60


def test_record_keeps_only_what_it_is_told():
    def height(t, state):
        return {"y": state.position[..., 1], "later": t + 1.0}

    full = simulate(balls(), methods.verlet, dt=0.01, steps=40, save_every=8, first_step=3)
    film = simulate(balls(), methods.verlet, dt=0.01, steps=40, save_every=8, first_step=3, record=height)
    np.testing.assert_array_equal(film.recorded["y"], full.position[..., 1])
    np.testing.assert_array_equal(film.recorded["later"], np.asarray(full.time) + 1.0)
    jax.tree.map(np.testing.assert_array_equal, film.final_scene, full.final_scene)
    assert film.state is None
    with pytest.raises(AttributeError, match=r"holds \.recorded only"):
        film.position  # noqa: B018


# one compilation


def test_no_number_compiles_anew(precision):
    traces = []

    @independent
    def watched(t, state, mass):
        traces.append(t)
        return -state.position

    def run(dt=0.01, mass=MASS, g=9.8, area=0.1, speed=1.0, first_step=0):
        v = jnp.full((5, 2), speed, precision.dtype)
        parts = (forces.Gravity(g), forces.QuadraticDrag(area=area, coefficient=0.5), watched)
        scene = Scene(Particles(0.0 * v, v), mass=mass, forces=parts)
        return simulate(scene, methods.rk4, dt=dt, steps=20, save_every=5, first_step=first_step)

    first = run()
    count = len(traces)
    assert count > 0
    others = [
        run(dt=0.02),
        run(dt=np.float32(0.02)),
        run(dt=jnp.asarray(0.03)),
        run(dt=1),
        run(mass=2 * MASS),
        run(mass=MASS.tolist()),
        run(g=1.62),
        run(g=10),
        run(area=0.3),
        run(speed=-3.0),
        run(first_step=11),
        run(first_step=first.final_step),
    ]
    resumed = simulate(first.final_scene, methods.rk4, dt=first.dt, steps=20, save_every=5, first_step=first.final_step)
    assert len(traces) == count
    assert np.isfinite([np.abs(other.position - first.position).max() for other in (*others[:1], resumed)]).all()
    assert not np.array_equal(others[0].position, first.position)


# steps of their own, batches


def test_every_lane_may_have_a_step_of_its_own():
    dt = np.array([0.001, 0.002, 0.01, 0.02, 0.05])
    film = simulate(balls(), methods.rk4, dt=dt, steps=40, save_every=10)
    assert film.time.shape == (5, 5)
    for i, step in enumerate(dt):
        alone = simulate(balls(), methods.rk4, dt=step, steps=40, save_every=10)
        np.testing.assert_allclose(film.position[:, i], alone.position[:, i], rtol=1e-13, atol=1e-13)
        np.testing.assert_array_equal(film.time[:, i], alone.time)


def test_every_scene_of_coupled_lanes_may_have_a_step_of_its_own():
    scene, dt = bodies(), np.array([0.01, 0.03])
    film = simulate(scene, methods.verlet, dt=dt, steps=40, save_every=20)
    for i, step in enumerate(dt):
        alone = Scene(jax.tree.map(lambda leaf, i=i: leaf[i], scene.state), forces=scene.forces)
        path = simulate(alone, methods.verlet, dt=step, steps=40, save_every=20)
        np.testing.assert_allclose(film.position[:, i], path.position, rtol=1e-12, atol=1e-12)
    assert film.ok.shape == (2,)
    with pytest.raises(ValueError, match=r"expected \(\) or \(2,\): one step size per scene"):
        simulate(scene, methods.verlet, dt=np.full((2, 3), 0.01), steps=1)


def test_lanes_vmap_and_one_at_a_time_agree_to_rounding():
    scene = balls()

    def alone(x, v, mass):
        return simulate(Scene(Particles(x, v), mass=mass, forces=FORCES), methods.rk4, dt=0.01, steps=50).position

    together = simulate(scene, methods.rk4, dt=0.01, steps=50).position
    mapped = jax.vmap(alone, out_axes=1)(*scene.state, scene.mass)
    single = np.stack([alone(*(leaf[i] for leaf in (*scene.state, scene.mass))) for i in range(5)], axis=1)
    np.testing.assert_allclose(mapped, together, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(single, together, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_pinned_lanes_never_move(method):
    pinned = np.array([True, False, False, True, False])
    film = simulate(balls(pinned=pinned), method, dt=0.01, steps=20)
    free = simulate(balls(), method, dt=0.01, steps=20)
    assert not film.velocity[:, pinned].any()
    assert not film.position[:, pinned].any()
    np.testing.assert_allclose(film.position[:, ~pinned], free.position[:, ~pinned], rtol=1e-13)


# derivatives


def test_forward_and_reverse_derivatives_agree_with_central_differences():
    @jax.jit
    def landing(numbers):
        speed, angle, g, area, mass, dt = numbers
        v = speed * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        parts = (forces.Gravity(g), forces.QuadraticDrag(area=area, coefficient=0.4), independent(gust))
        scene = Scene(Particles(jnp.zeros(2), v), mass=mass, forces=parts)
        film = simulate(scene, methods.verlet, dt=dt, steps=66, save_every=33)
        return jnp.concatenate([film.position[1], film.velocity[2]])

    numbers, h = jnp.asarray([12.0, 0.8, 9.8, 0.05, 0.6, 0.01]), 1e-5
    reverse, forward = jax.jacrev(landing)(numbers), jax.jacfwd(landing)(numbers)
    central = [(landing(numbers + h * e) - landing(numbers - h * e)) / (2 * h) for e in np.eye(6)]
    np.testing.assert_allclose(forward, reverse, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(forward, np.transpose(central), rtol=1e-6, atol=1e-8)
    assert (np.abs(forward) > 5e-4).all()


def test_reverse_mode_memory_grows_with_the_root_of_the_steps():
    def needed(steps):
        def loss(v):
            drag = forces.QuadraticDrag(area=0.05, coefficient=0.4)
            scene = Scene(Particles(jnp.zeros_like(v), v), forces=(forces.Gravity(), drag))
            film = simulate(scene, methods.semi_implicit_euler, dt=1e-3, steps=steps, save_every=steps)
            return jnp.sum(film.position[-1])

        v = jnp.ones((1000, 2))
        return jax.jit(jax.grad(loss)).lower(v).compile().memory_analysis().temp_size_in_bytes

    state = 1000 * 2 * 2 * 8
    assert needed(4096) < 2 * 64 * state  # a plain scan keeps 4096 states
    assert needed(4096) < 4.1 * needed(256)


# bad input

BAD_INPUT = settings(deadline=None, max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
NOT_NUMBERS = st.sampled_from([None, "0.1", 1j, [0.1, None], {}, True])


@BAD_INPUT
@given(dt=st.floats(max_value=0.0) | st.sampled_from([math.nan, math.inf]))
@pytest.mark.parametrize("length", [{"steps": 3}, {"duration": 1.0}], ids=["steps", "duration"])
def test_a_step_size_is_a_finite_number_above_zero(unannotated, dt, length):
    with pytest.raises(ValueError, match=r"dt \[s\]: got .*, expected (numbers > 0|finite numbers)"):
        simulate(balls(), methods.euler, dt=dt, **length)


def test_the_lane_with_the_bad_step_size_is_named(unannotated):
    with pytest.raises(ValueError, match=r"dt \[s\]: got -0.1 at index 3 \(1 of 5 entries are wrong\)"):
        simulate(balls(), methods.euler, dt=np.array([0.1, 0.1, 0.1, -0.1, 0.1]), steps=1)


@BAD_INPUT
@given(shape=st.lists(st.integers(1, 6), min_size=1, max_size=3).map(tuple).filter(lambda shape: shape != (5,)))
def test_step_sizes_are_one_or_one_per_lane(unannotated, shape):
    with pytest.raises(ValueError, match=r"expected \(\) or \(5,\): one step size per lane"):
        simulate(balls(), methods.euler, dt=np.full(shape, 0.1), steps=1)


@BAD_INPUT
@given(dt=NOT_NUMBERS)
def test_a_step_size_is_a_number(unannotated, dt):
    with pytest.raises(TypeError, match=r"dt \[s\]: got .*, expected real"):
        simulate(balls(), methods.euler, dt=dt, steps=1)


@BAD_INPUT
@given(count=st.integers(max_value=0), name=st.sampled_from(["steps", "save_every"]))
def test_counts_are_at_least_one(unannotated, count, name):
    with pytest.raises(ValueError, match=f"{name}: got {count}, expected at least 1"):
        simulate(balls(), methods.euler, dt=0.1, **{"steps": 10, name: count})


@BAD_INPUT
@given(
    count=st.floats() | st.sampled_from(["10", True, (10,), np.float64(10)]),
    name=st.sampled_from(["steps", "save_every"]),
)
def test_counts_are_integers(unannotated, count, name):
    with pytest.raises(TypeError, match=f"{name}: got .*, expected an integer"):
        simulate(balls(), methods.euler, dt=0.1, **{"steps": 10, name: count})


@BAD_INPUT
@given(save_every=st.integers(2, 200).filter(lambda n: n != 97))
def test_save_every_divides_the_steps(unannotated, save_every):
    with pytest.raises(ValueError, match=f"save_every: got {save_every}, expected a divisor of the 97 steps"):
        simulate(balls(), methods.euler, dt=0.1, steps=97, save_every=save_every)


@pytest.mark.parametrize(("given_", "said"), [({}, "neither"), ({"steps": 3, "duration": 0.3}, "both")])
def test_steps_or_duration_is_given_and_not_both(unannotated, given_, said):
    with pytest.raises(ValueError, match=f"got {said} of steps and duration, expected exactly one"):
        simulate(balls(), methods.euler, dt=0.1, **given_)


def counted(precision, **numbers):
    """The number of steps of a run, without compiling it."""
    scene = balls(precision.dtype)
    return jax.eval_shape(lambda: simulate(scene, methods.euler, **numbers).time).shape[0] - 1


@BAD_INPUT
@given(
    steps=st.integers(1, 100_000),
    dt=st.sampled_from(["0.1", "0.01", "0.02", "0.025", "0.0005", "1e-5", "0.3", "1"]),
    kind=st.sampled_from([float, np.float32, jnp.float32]),
    span=st.sampled_from([float, np.float32]),
)
def test_a_duration_that_is_a_multiple_in_real_numbers_is_accepted(unannotated, precision, steps, dt, kind, span):
    duration = steps * float(dt)
    assert counted(precision, dt=kind(dt), duration=span(f"{duration:.10g}")) == steps


@BAD_INPUT
@given(steps=st.integers(0, 10_000), share=st.floats(1e-5, 1 - 1e-5))
def test_a_duration_between_two_multiples_is_an_error(unannotated, steps, share):
    with pytest.raises(ValueError, match=r"duration \[s\]: got .*expected a whole number of steps"):
        simulate(balls(), methods.euler, dt=0.01, duration=0.01 * (steps + share))


@pytest.mark.parametrize(
    ("numbers", "error", "said"),
    [
        ({"dt": np.array([0.1, 0.2, 0.1, 0.1, 0.1]), "duration": 1.0}, ValueError, "the same in every lane"),
        ({"dt": 0.1, "duration": -1.0}, ValueError, r"duration \[s\]: got -1.0"),
        ({"dt": 0.1, "duration": math.nan}, ValueError, r"duration \[s\]: got nan"),
        ({"dt": 0.1, "duration": np.ones(5)}, ValueError, "expected one number"),
        ({"dt": 0.1, "steps": 5, "first_step": 2.5}, TypeError, "first_step"),
        ({"dt": 0.1, "steps": 5, "record": "height"}, TypeError, "record"),
    ],
)
def test_numbers_that_make_no_run(unannotated, numbers, error, said):
    with pytest.raises(error, match=said):
        simulate(balls(), methods.euler, **numbers)


def test_a_duration_cannot_be_counted_while_dt_is_traced(unannotated):
    with pytest.raises(TypeError, match=r"the number of steps is unknown\. Give steps= instead"):
        jax.jit(lambda dt: simulate(balls(), methods.euler, dt=dt, duration=1.0).time)(0.1)
    with pytest.raises(TypeError, match="counts are shape"):
        jax.jit(lambda n: simulate(balls(), methods.euler, dt=0.1, steps=n).time)(10)


def test_a_scene_and_a_method_are_needed(unannotated):
    with pytest.raises(TypeError, match="got a Particles, expected a Scene"):
        simulate(balls().state, methods.euler, dt=0.1, steps=1)
    with pytest.raises(TypeError, match=r"got the method 'rk4', expected a function .* e\.g\. methods\.rk4"):
        simulate(balls(), "rk4", dt=0.1, steps=1)


def test_plain_functions_may_close_over_what_is_differentiated():
    def stretched(system, t, state, dt, factor):
        return methods.euler(system, t, state, factor * dt)

    def swing(k):
        scene = Scene(Particles(jnp.ones(1), jnp.zeros(1)), forces=(lambda t, state, mass: -k * state.position,))
        slow = lambda system, t, state, dt: stretched(system, t, state, dt, k)  # noqa: E731
        run = partial(simulate, dt=0.1, steps=5)
        told = run(scene, methods.rk4, record=lambda t, state: k * state.position).recorded
        return told[-1, 0] + run(scene, slow).position[-1, 0]

    h = 1e-6
    central = (swing(2.0 + h) - swing(2.0 - h)) / (2 * h)
    np.testing.assert_allclose(jax.grad(swing)(2.0), central, rtol=1e-8)
    np.testing.assert_allclose(jax.jit(swing)(2.0), swing(2.0), rtol=1e-12)


@pytest.mark.parametrize("differentiated", [False, True])
def test_a_cloths_loop_is_compiled_in_pieces(differentiated):
    """XLA on CPU would make one function of it, which takes ten times as long: minutes for the gradient of rk4."""
    sheet = lattices.cloth(1.0, 1.0, 9, 9, mass=0.1, structural=100.0)
    scene = Scene(sheet.state, mass=sheet.mass, forces=(forces.Gravity(), sheet.springs))

    def lowest(speed):
        thrown = scene.replace(state=Particles(scene.state.position, scene.state.velocity + speed))
        return simulate(thrown, methods.rk4, dt=1e-3, steps=40, save_every=40).position[-1, :, 1].min()

    program = jax.jit(jax.grad(lowest) if differentiated else lowest).lower(0.1).compile().as_text()
    loops = [line for line in program.splitlines() if " while(" in line or "small_call" in line]
    with_state = [line for line in loops if "[81,3]" in line]
    assert with_state
    assert not [line for line in with_state if "small_call" in line]


# looking into a run


class Seen(Force):
    """Drag that notes what it is shown: a number or a tracer."""

    notes: list = eqx.field(static=True)

    def __call__(self, t, state, mass):
        self.notes.append(isinstance(state.position, jax.core.Tracer))
        return -0.1 * state.velocity


@pytest.mark.parametrize("save_every", [1, 20])
def test_without_jit_a_force_sees_numbers_and_the_run_is_the_same(save_every):
    seen = Seen([])
    ball = Scene(Particles(jnp.zeros(2), jnp.ones(2)), forces=(forces.Gravity(), seen))
    run = partial(simulate, ball, methods.rk4, dt=0.1, steps=20, save_every=save_every)
    compiled = run().position[-1]
    seen.notes.clear()
    with jax.disable_jit():
        plain, end = run(), state_after(ball, methods.rk4, dt=0.1, duration=0.4)
    assert len(seen.notes) == 4 * 24
    assert not any(seen.notes)
    np.testing.assert_allclose(plain.position[-1], compiled, rtol=1e-13)
    assert end.steps == 4


def test_a_run_is_not_held_up_by_the_transfer_guard():
    """What a call is given it sends on purpose; scenes, resumed runs and crossings as well."""
    start = Particles(jnp.array([0.0, 1.0]), jnp.ones(2))
    plane = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.5, response=contacts.project)
    with jax.transfer_guard("disallow"):
        scene = Scene(start, 1.0, (forces.Gravity(), forces.QuadraticDrag(0.1, 0.4)), (plane,))
        run = simulate(scene, methods.verlet, dt=0.1, duration=1.0)
        rest = simulate(run.final_scene, methods.verlet, dt=0.1, steps=2, first_step=run.final_step)
        at = run.crossing(0.5)
    assert rest.final_step == 12
    assert at.ok


# functions made anew


def throw(force, **more):
    ball = Particles(jnp.zeros(2), jnp.ones(2))
    return simulate(Scene(ball, forces=(force,)), methods.euler, dt=0.1, steps=2, **more)


def pulled(k):
    return independent(lambda t, state, mass: -k * state.velocity)


def kept(k):
    return lambda t, state: k * state.position


def test_a_closure_made_at_every_call_is_told_once():
    throw(pulled(1.0), record=kept(1.0))
    with pytest.warns(UserWarning, match=r"<lambda>.*redefined at each call.*Define it once") as told:
        throw(pulled(2.0), record=kept(2.0))
    assert [Path(one.filename).name for one in told] == ["test_simulate.py"] * 2  # the force, and what is recorded
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        throw(pulled(3.0), record=kept(3.0))


def gust_of_wind(t, state, mass):
    return -state.velocity


def test_a_function_that_stays_and_one_inside_of_jit_are_not_told():
    class Fan:
        def blow(self, t, state, mass):
            return -state.velocity

    fan = Fan()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(2):
            throw(gust_of_wind)
            throw(fan.blow)
        jax.jit(lambda: [throw(partial(lambda k, t, s, m: -k * s.velocity, k)).position for k in (1.0, 2.0)])()


def test_frames_that_cannot_fit_are_refused_before_anything_is_computed(monkeypatch):
    monkeypatch.setattr("physjax.memory.read_memory_limit", lambda: 10_000)
    drop = Scene(Particles(jnp.zeros((10, 3)), jnp.zeros((10, 3))), forces=(forces.Gravity(),))
    kind = drop.state.dtype.itemsize
    frame = 2 * 60 * kind
    fitting = 10_000 // frame - 1
    with pytest.raises(
        MemoryError, match=rf"got 401 frames of .*expected at most 10 kB.*save_every={-(-400 // fitting)} or more"
    ):
        simulate(drop, methods.rk4, dt=0.1, steps=400)
    assert simulate(drop, methods.rk4, dt=0.1, steps=400, save_every=100).ok.all()
    assert simulate(
        drop, methods.rk4, dt=0.1, steps=400, record=lambda t, state: state.position[0, 1]
    ).recorded.shape == (401,)


def test_the_memory_of_this_machine_is_known_or_said_to_be_unknown():
    limit = memory.read_memory_limit()
    assert limit is None or limit > 2**28
    assert [format_bytes(n) for n in (0, 999, 48_000, 4_800_000_000_000)] == ["0 B", "999 B", "48 kB", "4.8 TB"]
