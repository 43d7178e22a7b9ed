"""The policies for compiler and device: each changes how a program is built and none what it computes."""

import time
import warnings
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from physjax import Particles, Scene, backend, compaction, forces, loops, methods, simulate, xla_options
from physjax.backend import (
    LANES_PER_BLOCK,
    MAX_BATCH_LANES,
    MIN_LANES_TO_CUT,
    MIN_LANES_TO_SELECT,
    MIN_STEPS_PER_FRAME,
    SINGLE_PIECE_NODES,
)

ON_CPU = pytest.mark.skipif(jax.default_backend() != "cpu", reason="a policy for CPUs")
MANY = 2 * MIN_LANES_TO_SELECT + 7


@pytest.fixture
def elsewhere(monkeypatch):
    """As if the default device were a GPU."""
    monkeypatch.setattr(backend, "device_kind", lambda: "gpu")


# code generators


@ON_CPU
@pytest.mark.skipif(jax.__version_info__ >= (0, 11), reason="there is one generator from jax 0.11 on")
@pytest.mark.parametrize(
    ("method", "names"),
    [(methods.rk4, ("Drag", "Gravity")), (methods.verlet, ("Attraction",)), (methods.implicit_euler, ("Anchor",))],
    ids=["flight", "stars", "anchors"],
)
def test_runs_are_the_same_by_both_code_generators(method, names):
    """The tests themselves run by the older one, which compiles sooner."""
    position = jnp.asarray(np.random.default_rng(0).normal(size=(7, 3)))
    parts = {
        "Drag": forces.QuadraticDrag(0.3, 0.1, 1.2),
        "Gravity": forces.Gravity(),
        "Attraction": forces.Gravitation(1.0, softening=0.1),
        "Anchor": forces.Anchor((0.0, 1.0, 0.0), 40.0, rest_length=0.5),
    }
    scene = Scene(Particles(position, 0.1 * position), forces=tuple(parts[name] for name in names))
    run = lambda scene: simulate(scene, method, dt=1e-2, steps=50, save_every=50).position[-1]  # noqa: E731
    older, newer = (
        jax.jit(run, compiler_options={"xla_cpu_use_fusion_emitters": choice})(scene) for choice in (False, True)
    )
    np.testing.assert_allclose(newer, older, rtol=1e-11)
    assert not np.allclose(newer, position)


# what is computed once


def test_one_flag_stands_for_the_whole_batch_and_keeps_a_branch_a_branch():
    def sometimes(flag, x):
        return lax.cond(backend.any_lane(flag), lambda: jnp.sin(x), lambda: x)

    batched = jax.vmap(sometimes)
    flags, x = jnp.array([[False, True], [False, False]]), jnp.ones((2, 3))
    np.testing.assert_array_equal(batched(flags, x), jnp.sin(x))
    np.testing.assert_array_equal(batched(flags & False, x), x)
    assert "cond" in str(jax.make_jaxpr(batched)(flags, x))
    assert "select_n" not in str(jax.make_jaxpr(batched)(flags, x))


@pytest.mark.parametrize("device", ["as it is", "elsewhere"])
def test_what_is_stored_has_the_same_value_and_derivative(device, request):
    if device == "elsewhere":
        request.getfixturevalue("elsewhere")
    for wrapped in (lambda x: backend.materialise(0.0, lambda: jnp.sin(x)), lambda x: backend.block_fusion(jnp.sin(x))):
        assert jax.jit(wrapped)(0.3) == jnp.sin(0.3)
        assert jax.jit(jax.grad(wrapped))(0.3) == jnp.cos(0.3)


def test_a_device_that_asks_the_host_for_branches_gets_a_barrier_instead(elsewhere):
    program = str(jax.make_jaxpr(lambda x: backend.materialise(0.0, lambda: jnp.sin(x)))(0.3))
    assert "optimization_barrier" in program
    assert "cond" not in program


def test_where_no_lane_is_flagged_the_stand_in_comes_back():
    flag, x = jnp.zeros(3, bool), jnp.ones(3)
    np.testing.assert_array_equal(backend.materialise_where(flag, lambda: 2 * x), jnp.zeros(3))
    np.testing.assert_array_equal(backend.materialise_where(flag, lambda: 2 * x, x), x)
    np.testing.assert_array_equal(backend.materialise_where(flag.at[1].set(True), lambda: 2 * x, x), 2 * x)


# how a loop is compiled


def test_a_loop_that_is_split_computes_the_same_and_has_a_sort_in_reverse_mode_too():
    def run(x, split):
        def turn(carry, i):
            return jnp.sin(backend.split_compilation(carry, i) if split else carry), None

        return lax.scan(turn, x, jnp.arange(4, dtype=jnp.int32))[0]

    x = jnp.asarray(0.7)
    assert run(x, True) == run(x, False)
    np.testing.assert_allclose(jax.grad(run)(x, True), jax.grad(run)(x, False), rtol=1e-6)
    if jax.default_backend() == "cpu":
        assert str(jax.make_jaxpr(jax.grad(lambda x: run(x, True)))(x)).count("sort[") == 2


def test_elsewhere_nothing_is_split(elsewhere):
    state = (jnp.ones(3),)
    assert backend.split_compilation(state, jnp.int32(1)) is state


def test_only_many_coupled_nodes_are_split():
    assert backend.needs_split_compilation(True, (SINGLE_PIECE_NODES + 1,))
    assert not backend.needs_split_compilation(True, (1000, SINGLE_PIECE_NODES))
    assert not backend.needs_split_compilation(False, (10**6,))
    assert not backend.needs_split_compilation(True, ())


@pytest.mark.parametrize("lanes", [3, MANY])
def test_a_loop_ends_by_its_condition_or_by_its_bound(lanes):
    def run(most):
        return loops.bounded_while_loop(lambda x: jnp.any(x < 10), lambda x: x + 1, jnp.arange(lanes), most=most)

    np.testing.assert_array_equal(run(4), np.arange(lanes) + 4)
    np.testing.assert_array_equal(run(100), np.arange(lanes) + 10)


@pytest.mark.parametrize("count", [1, 6, 16, 17, 50, 200])
@pytest.mark.parametrize("unrolled", [2, 4, 16])
def test_several_steps_a_turn_are_the_same_steps(count, unrolled):
    step = lambda i, x: 0.9 * x + i.astype(x.dtype)  # noqa: E731
    start, first = jnp.asarray(1.0), jnp.int32(3)
    wanted, slope = jax.value_and_grad(loops.repeat_steps, argnums=1)(step, start, first, count)
    found, other = jax.value_and_grad(partial(loops.repeat_steps, unrolled=unrolled), argnums=1)(
        step, start, first, count
    )
    assert found == wanted
    np.testing.assert_allclose(other, slope, rtol=1e-12)


def test_a_turn_takes_several_steps_where_each_is_a_launch(elsewhere):
    steps = [backend.choose_unrolled_steps(operations) for operations in (10, 150, 300, 700, 10_000)]
    assert steps == [16, 16, 8, 2, 2]  # an even number, so that none needs a copy of what it reads


def test_on_a_cpu_a_turn_takes_one_step():
    if jax.default_backend() == "cpu":
        assert backend.choose_unrolled_steps(10) == 1


# which lanes are computed


def test_a_card_is_filled_before_lanes_are_picked(elsewhere):
    assert backend.choose_group_lanes(100_000) is None
    assert backend.choose_group_lanes(1_000_000) == 65_536


def halve(state, divisor):
    return jax.tree.map(lambda leaf: leaf / divisor.reshape(divisor.shape + (1,) * (leaf.ndim - divisor.ndim)), state)


@pytest.mark.parametrize("flagged", ["none", "one", "some", "all"])
@pytest.mark.parametrize("shape", [(5,), (MANY,), (3, MANY)])
def test_the_flagged_lanes_are_computed_and_no_others(shape, flagged):
    rng = np.random.default_rng(0)
    share = {"none": 0.0, "one": 0.0, "some": 0.1, "all": 1.0}[flagged]
    flag = rng.random(shape) < share
    if flagged == "one":
        flag.flat[-1] = True
    state = {"x": jnp.asarray(rng.normal(size=(*shape, 2))), "n": jnp.asarray(rng.normal(size=shape))}
    divisor = jnp.where(jnp.asarray(flag), 2.0, 1.0)
    found = compaction.compact_and_apply(halve, jnp.asarray(flag), state, divisor, masks=(True,), cut=True)
    for name, leaf in halve(state, divisor).items():
        np.testing.assert_array_equal(found[name], leaf)


def test_derivatives_go_through_the_flagged_lanes():
    flag = jnp.arange(MANY) % 50 == 0
    divisor = jnp.where(flag, 2.0, 1.0)

    def cost(x):
        return jnp.sum(compaction.compact_and_apply(halve, flag, x, divisor, masks=(True,), cut=True) ** 2)

    x = jnp.linspace(-1.0, 1.0, MANY)
    np.testing.assert_allclose(jax.grad(cost)(x), 2 * x / divisor**2, rtol=1e-12)


@pytest.mark.parametrize("lanes", [50, MANY])
@pytest.mark.parametrize("run", [(0, 0), (10, 30), (45, 5)])
def test_a_run_of_flags_is_cleared_wherever_it_begins_and_comes_round(lanes, run):
    first, length = run
    flag = (np.arange(lanes) - first) % lanes < length * lanes // 50
    birth = lambda state, age: {"age": jnp.where(state["age"] < 0, age, state["age"])}  # noqa: E731
    state, age = {"age": jnp.where(flag, -1.0, 1.0)}, jnp.arange(lanes, dtype=float)
    found = compaction.compact_and_apply_runs(birth, lambda state, age: state["age"] < 0, state, age)
    np.testing.assert_array_equal(found["age"], np.where(flag, age, 1.0))


# how much is computed at once


@ON_CPU
def test_lanes_are_cut_where_that_pays():
    assert backend.count_lane_blocks(MIN_LANES_TO_CUT, MIN_STEPS_PER_FRAME) == 6
    assert backend.count_lane_blocks(MIN_LANES_TO_CUT + 1, MIN_STEPS_PER_FRAME) == 7
    assert backend.count_lane_blocks(MIN_LANES_TO_CUT - 1, MIN_STEPS_PER_FRAME) is None
    assert backend.count_lane_blocks(MIN_LANES_TO_CUT, MIN_STEPS_PER_FRAME - 1) is None


def test_elsewhere_all_lanes_stay_together(elsewhere):
    assert backend.count_lane_blocks(10**6, 100) is None


def test_a_sweeps_block_fits_a_cpus_cache_and_fills_anything_else(unannotated):
    cpu, gpu = SimpleNamespace(platform="cpu"), SimpleNamespace(platform="gpu")
    assert backend.choose_block_lanes(cpu, 1) == LANES_PER_BLOCK
    assert backend.choose_block_lanes(cpu, 640) == 64 * LANES_PER_BLOCK // 640
    assert backend.choose_block_lanes(gpu, 640) == MAX_BATCH_LANES


# what the compiler is asked for


@pytest.fixture
def unknown_option(monkeypatch):
    """An option that no compiler has among those that a run asks for."""
    monkeypatch.setattr(xla_options, "WIDE_VECTOR_OPTIONS", {"xla_no_such_option": 1})
    xla_options._is_known_option.cache_clear()
    yield
    xla_options._is_known_option.cache_clear()


@ON_CPU
def test_an_unknown_option_stops_no_run_and_is_said_once(unknown_option, monkeypatch):
    from physjax.stepping import simulate as loop

    monkeypatch.setattr(loop, "_get_standalone_run", loop._get_standalone_run.__wrapped__)  # made anew for this test
    scene = Scene(Particles(jnp.zeros(2), jnp.ones(2)), forces=(forces.Gravity(),))
    with pytest.warns(UserWarning, match="xla_no_such_option") as said:
        end = simulate(scene, methods.rk4, dt=0.1, steps=3).final_scene.state
    assert len(said) == 1
    assert bool(jnp.isfinite(end.position).all())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert xla_options.jit_untransformed(jnp.sin)(0.3) == jnp.sin(0.3)


@ON_CPU
def test_the_compiler_takes_the_options_that_runs_ask_for():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert xla_options.jit_untransformed(jnp.sin, many_small_kernels=True)(0.3) == jnp.sin(0.3)


def test_elsewhere_no_option_of_a_cpu_is_asked_for(unknown_option, unannotated):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        xla_options.jit_untransformed(jnp.sin, SimpleNamespace(platform="gpu"))


# which clock


@ON_CPU
def test_waiting_takes_no_processor_time():
    began = backend.read_work_clock()
    time.sleep(0.2)
    assert backend.read_work_clock() - began < 0.1


def test_waiting_for_another_device_counts(elsewhere):
    began = backend.read_work_clock()
    time.sleep(0.05)
    assert backend.read_work_clock() - began >= 0.04


@pytest.mark.skipif(jax.__version_info__ >= (0, 11), reason="a fault of jax 0.10")
@pytest.mark.parametrize(
    ("before", "after"),
    [
        (None, xla_options.LOOP_EMITTER_FLAG),
        ("--xla_dump_to=x", f"--xla_dump_to=x {xla_options.LOOP_EMITTER_FLAG}"),
        ("--xla_backend_extra_options=other", "--xla_backend_extra_options=other"),
    ],
)
def test_the_loop_emitter_is_asked_for_unless_such_options_are_given(before, after):
    environment = {} if before is None else {"XLA_FLAGS": before}
    xla_options.ask_for_loop_emitter(environment)
    xla_options.ask_for_loop_emitter(environment)
    assert environment == {"XLA_FLAGS": after}
