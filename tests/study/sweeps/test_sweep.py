"""Sweeps: every lane as it is alone, one compilation, failures that stay where they are, plain words for bad input."""

import math
import pickle
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, contacts, forces, lattices, methods, simulate, solve, state_after, sweep
from physjax.stepping.simulate import sample_states
from physjax.study.sweeps import batching

SPEED, ANGLE = np.linspace(5.0, 40.0, 7), np.linspace(0.2, 1.3, 5)


def ball(speed, angle, drag=0.35, *more):
    launch = speed * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    air = forces.QuadraticDrag(area=4.3e-3, coefficient=drag)
    return Scene(Particles(jnp.zeros(2), launch), mass=0.145, forces=(forces.Gravity(), air), contacts=more)


def landing(speed, angle):
    return simulate(ball(speed, angle), methods.rk4, dt=0.02, steps=50, save_every=50).position[-1, 0]


def quiet(measure, axes, **options):
    return sweep(measure, axes, progress=False, **options)


def compilations(run):
    """How often XLA compiled."""
    seen = []
    watch = lambda event, *_, **__: seen.append(event) if event.endswith("backend_compile_duration") else None  # noqa: E731
    jax.monitoring.register_event_duration_secs_listener(watch)
    try:
        run()
    finally:
        jax.monitoring.unregister_event_duration_listener(watch)
    return len(seen)


def test_every_point_of_a_grid_is_the_measure_there(precision):
    found = quiet(landing, {"speed": SPEED, "angle": ANGLE})
    assert found.shape == found.values.shape == (7, 5)
    assert found.values.dtype == precision.dtype
    assert found.ok.all()
    for i, j in ((0, 0), (3, 4), (6, 2)):
        alone = landing(jnp.asarray(SPEED[i], precision.dtype), jnp.asarray(ANGLE[j], precision.dtype))
        np.testing.assert_allclose(found.values[i, j], alone, rtol=200 * precision.eps)
    best = found.best(largest=True)
    assert found.values[best.index] == found.values.max() == best.score == best.values
    assert best.point == {"speed": found.axes["speed"][best.index[0]], "angle": found.axes["angle"][best.index[1]]}


def test_zipped_axes_go_side_by_side():
    found = quiet(landing, {"speed": SPEED[:5], "angle": ANGLE}, design="zip")
    grid = quiet(landing, {"speed": SPEED, "angle": ANGLE})
    np.testing.assert_allclose(found.values, np.diagonal(grid.values[:5]), rtol=1e-13)


@pytest.mark.parametrize("sampled", [sweep.sobol, sweep.latin_hypercube])
def test_sampled_designs_fill_every_slice_of_every_range(sampled):
    axes = sampled({"speed": (5.0, 40.0), "angle": (0.2, 1.3)}, 32, seed=3)
    for name, (low, high) in {"speed": (5.0, 40.0), "angle": (0.2, 1.3)}.items():
        assert sorted(((axes[name] - low) / (high - low) * 32).astype(int)) == list(range(32))
    assert quiet(landing, axes, design="zip").values.shape == (32,)


class Launch(NamedTuple):
    speed: object
    angle: object


def test_records_of_numbers_and_lists_of_scenes_are_axes(tmp_path):
    pairs = Launch(SPEED[:5], ANGLE)
    expected = quiet(landing, {"speed": SPEED[:5], "angle": ANGLE}, design="zip").values
    by_record = quiet(lambda shot: landing(*shot), {"shot": pairs}, out=tmp_path)
    np.testing.assert_array_equal(sweep.load(tmp_path).axes["shot"]["angle"], ANGLE)
    scenes = [ball(*pair) for pair in zip(*pairs, strict=True)]
    fly = lambda scene: simulate(scene, methods.rk4, dt=0.02, steps=50, save_every=50).position[-1, 0]  # noqa: E731
    by_scene = quiet(fly, {"scene": scenes})
    for found in (by_record, by_scene):
        np.testing.assert_allclose(found.values, expected, rtol=1e-13)


def test_batches_change_nothing_and_compile_once():
    axes = {"speed": np.linspace(5, 40, 101), "angle": ANGLE}
    gravity = 9.7 + np.random.default_rng().random()  # a constant that no other test has

    def measure(speed, angle):
        scene = Scene(Particles(jnp.zeros(2), speed * jnp.stack([angle, angle])), forces=(forces.Gravity(gravity),))
        return simulate(scene, methods.rk4, dt=0.02, steps=20, save_every=20).position[-1]

    parts = []
    count = compilations(lambda: parts.append(quiet(measure, axes, batch=64)))
    assert count == 1  # 505 lanes in batches of 64, the last one of 57
    assert compilations(lambda: parts.append(quiet(measure, axes, batch=64))) == 0
    np.testing.assert_array_equal(parts[0].values, parts[1].values)
    whole = quiet(measure, axes)
    np.testing.assert_allclose(parts[0].values, whole.values, rtol=1e-13)


def test_memory_decides_the_size_of_batches_and_bounds_what_xla_takes():
    def film(speed, angle):
        return simulate(ball(speed, angle), methods.rk4, dt=0.02, steps=200).position

    point = {name: jax.ShapeDtypeStruct((), np.float64) for name in ("speed", "angle")}
    program = batching.trace_measure(film, point)
    for memory in (1 << 20, 1 << 24):
        cut = batching.choose_layout(program, 10**6, memory, jax.local_devices()[:1])
        one = jax.vmap(jax.extend.core.jaxpr_as_fun(program.jaxpr))
        shape = jax.ShapeDtypeStruct((cut.count, cut.size), np.float64)
        needs = (
            jax.jit(lambda *flat, one=one: jax.lax.map(lambda block: one(*block), flat)).lower(shape, shape).compile()
        )
        taken = needs.memory_analysis()
        total = taken.temp_size_in_bytes + taken.argument_size_in_bytes + taken.output_size_in_bytes
        assert memory / 16 < total < memory
    with pytest.raises(ValueError, match=r"memory: got 1,000 bytes, expected at least .* one lane"):
        quiet(film, {"speed": SPEED, "angle": ANGLE}, memory=1000)


# failures


def test_a_run_that_blows_up_a_search_that_fails_and_a_number_that_is_none_have_their_reasons():
    def measure(stiffness):
        spring = forces.independent(lambda t, state, mass: -stiffness * state.position)
        flight = simulate(Scene(Particles(jnp.ones(1), jnp.zeros(1)), forces=(spring,)), methods.rk4, dt=1.0, steps=900)
        root = solve(lambda x: x * x + 1.0 - jnp.minimum(stiffness, 2.0), 3.0)
        return {"flight": flight, "root": root, "log": jnp.log(2.0 - stiffness)}

    found = quiet(measure, {"stiffness": [-9.0, 0.5, 1.5, 3.0, 90.0]})
    assert found.reason(0) == "blew up: the run's state is not finite at its end (at flight)"
    assert found.reason(1) == "not solved: the search ended without a root (at root)"
    assert found.reason(2) == "ok"
    assert found.reason(3) == "not finite (at log)"
    assert found.reason(4).startswith("blew up")
    assert sum(found.failures.values()) == 4
    assert found.best("log").index == (2,)
    assert found.values["root"].value.shape == (5,)
    assert found.values["flight"].state.position.shape == (5, 901, 1)


def clean_and_with_bad_lanes(measure, lanes, bad, **options):
    """The same sweep without and with 1 % of bad values on its axis."""
    axis = np.linspace(1.0, 2.0, lanes)
    spoilt = axis.copy()
    places = np.random.default_rng(0).choice(lanes, lanes // 100, replace=False)
    spoilt[places] = np.resize(bad, places.size)
    clean, dirty = (quiet(measure, {"x": values}, batch=lanes // 2, **options) for values in (axis, spoilt))
    assert clean.ok.all()
    np.testing.assert_array_equal(np.flatnonzero(~dirty.ok), np.sort(places))
    same = np.delete(np.arange(lanes), places)
    for one, other in zip(jax.tree.leaves(clean.values), jax.tree.leaves(dirty.values), strict=True):
        np.testing.assert_array_equal(one[same], other[same])


def test_one_per_cent_of_bad_lanes_leave_the_roots_of_the_others():
    """To rounding: on two threads the same search of the same roots differs by a last digit once in 150 000 lanes."""
    spoilt = np.linspace(1.0, 2.0, 1000)
    spoilt[::100] = np.resize((np.nan, np.inf), 10)
    clean, dirty = (quiet(found_roots, {"x": x}, batch=500) for x in (np.linspace(1.0, 2.0, 1000), spoilt))
    assert clean.ok.all()
    np.testing.assert_array_equal(dirty.ok, np.isfinite(spoilt))
    np.testing.assert_allclose(clean.values.value[dirty.ok], dirty.values.value[dirty.ok], rtol=4e-16)


def fixed_steps(x):
    return simulate(ball(10 * x, 0.5), methods.rk4, dt=0.02, steps=50, save_every=50).position[-1]


def chosen_steps(x):
    method = methods.adaptive(methods.rk4, rtol=1e-6, atol=1e-6)
    return simulate(ball(10 * x, 0.5), method, dt=0.5, steps=2)


def bounces(x):
    ground = contacts.Plane(point=(0.0, 0.0), normal=(0.0, 1.0), restitution=0.7)
    return simulate(ball(10 * x, 0.5, 0.35, ground), methods.rk4, dt=0.02, steps=80, save_every=80)


def found_roots(x):
    return solve(lambda y: y**3 + y - x, 1.0)


@pytest.mark.parametrize("measure", [fixed_steps, chosen_steps, bounces])
def test_one_per_cent_of_bad_lanes_leave_the_others_bit_equal(measure):
    clean_and_with_bad_lanes(measure, 1000, (np.nan, np.inf))


@pytest.mark.slow
@pytest.mark.parametrize("measure", [fixed_steps, chosen_steps])
def test_lanes_that_blow_up_on_the_way_leave_the_others_bit_equal(measure):
    clean_and_with_bad_lanes(measure, 1000, (1e200,))


# the method's parameters


def test_dt_at_a_fixed_duration_sweeps_by_step_counts_of_each_lane():
    def wind_up(dt):
        spring = forces.independent(lambda t, state, mass: -4.0 * state.position)
        scene = Scene(Particles(jnp.ones(1), jnp.zeros(1)), forces=(spring,))
        end = state_after(scene, methods.rk4, duration=2.0, dt=dt)
        return end, jnp.abs(end.state.position[0] - math.cos(4.0))

    before = sample_states._cache_size()
    dts = 2.0 / np.array([20, 40, 80, 160, 320])
    end, error = quiet(wind_up, {"dt": dts}).values
    assert sample_states._cache_size() <= before + 1
    np.testing.assert_array_equal(end.steps, [20, 40, 80, 160, 320])
    np.testing.assert_allclose(end.dt, dts)
    orders = np.log2(error[:-1] / error[1:])
    np.testing.assert_allclose(orders, 4.0, atol=0.15)


def test_the_tolerance_of_an_adaptive_method_sweeps():
    def error(tolerance):
        method = methods.adaptive(methods.rk4, rtol=tolerance, atol=tolerance)
        spring = forces.independent(lambda t, state, mass: -4.0 * state.position)
        scene = Scene(Particles(jnp.ones(1), jnp.zeros(1)), forces=(spring,))
        end = simulate(scene, method, dt=2.0, steps=1).position[-1, 0]
        return jnp.abs(end - math.cos(4.0))

    found = quiet(error, {"tolerance": np.geomspace(1e-9, 1e-3, 4)}).values
    assert (np.diff(np.log(found)) > 1).all()


# bad input


def test_axes_that_are_empty_unequal_or_no_numbers_are_refused():
    with pytest.raises(ValueError, match=r"axis angle: .*expected at least one value"):
        quiet(landing, {"speed": SPEED, "angle": []})
    with pytest.raises(ValueError, match=r"axes: got lengths \{'speed': 7, 'angle': 5\}, expected equal ones"):
        quiet(landing, {"speed": SPEED, "angle": ANGLE}, design="zip")
    with pytest.raises(TypeError, match="axis angle: got dtype <U1, expected real numbers"):
        quiet(landing, {"speed": SPEED, "angle": np.array(["a"])})
    with pytest.raises(TypeError, match=r"axes: got {}, expected names and arrays"):
        quiet(landing, {})
    with pytest.raises(ValueError, match=r"unknown design 'gird'. Did you mean grid"):
        quiet(landing, {"speed": SPEED, "angle": ANGLE}, design="gird")
    with pytest.raises(ValueError, match=r"count: got 100, expected a power of two, e.g. 128"):
        sweep.sobol({"speed": (1, 2)}, 100)


def branching(speed):
    if speed > 3:
        return speed
    return 2 * speed


def counted(speed):
    steps = int(speed)
    return steps


def roped(nodes):
    rope = lattices.rope(start=(0.0, 0.0), end=(1.0, 0.0), nodes=nodes, mass=1.0, stiffness=1.0)
    return rope.state.position[-1, 0]


@pytest.mark.parametrize(
    ("measure", "axis", "line"),
    [
        (branching, "speed", "if speed > 3:"),
        (counted, "speed", "steps = int(speed)"),
        (roped, "nodes", "rope = lattices.rope"),
    ],
)
@pytest.mark.usefixtures("unannotated")
def test_a_measure_that_cannot_be_traced_is_told_by_its_line(measure, axis, line):
    with pytest.raises(TypeError) as caught:
        quiet(measure, {axis: np.arange(3, 6)})
    told = str(caught.value)
    assert line in told
    number = next(n for n, text in enumerate(open(__file__), 1) if line in text)  # noqa: SIM115
    assert f"test_sweep.py, line {number}:" in told
    assert measure.__name__ in told


def test_a_measure_without_an_axis_of_that_name_is_told():
    with pytest.raises(TypeError, match=r"branching cannot be called with wind, one number each: .*'wind'"):
        quiet(branching, {"wind": SPEED})


def test_scenes_of_different_shape_are_refused_with_the_reason():
    fly = lambda scene: scene.state.position  # noqa: E731
    scenes = [Scene(Particles(jnp.zeros((n, 2)), jnp.ones((n, 2)))) for n in (3, 3, 4)]
    with pytest.raises(ValueError, match=r"values 0 and 2 have different shapes, \(3, 2\) and \(4, 2\) at .*position"):
        quiet(fly, {"scene": scenes})
    scenes[2] = Scene(Particles(jnp.zeros((3, 2)), jnp.ones((3, 2))), forces=(forces.Gravity(),))
    with pytest.raises(ValueError, match="values 0 and 2 differ in more than numbers"):
        quiet(fly, {"scene": scenes})


# keeping and passing on


def test_a_saved_sweep_is_read_with_numpy_and_comes_back(tmp_path):
    both = lambda speed, angle: {"range": landing(speed, angle), "cos": jnp.cos(jnp.where(speed > 30, jnp.nan, angle))}  # noqa: E731
    found = quiet(both, {"speed": SPEED, "angle": ANGLE})
    found.save(tmp_path / "kept.npz")
    with np.load(tmp_path / "kept.npz") as archive:
        np.testing.assert_array_equal(archive["axis.speed"], SPEED)
        np.testing.assert_array_equal(archive["value.range"], found.values["range"])
        assert archive["reasons"][archive["status"][6, 0]] == "not finite (at cos)"
    again = sweep.load(tmp_path / "kept.npz")
    np.testing.assert_array_equal(again.values["cos"], found.values["cos"])
    assert again.failures == found.failures == {"not finite (at cos)": 5 * (SPEED > 30).sum()}
    assert again.best("range") == found.best("range")
    with pytest.raises(FileNotFoundError, match="load: there is no file"):
        sweep.load(tmp_path / "none.npz")
    (tmp_path / "kept.npz").write_bytes(b"PK\x03\x04 no")
    with pytest.raises(ValueError, match=r"damaged or not an .npz file"):
        sweep.load(tmp_path / "kept.npz")


def test_xarray_has_names_coordinates_and_status():
    pytest.importorskip("xarray")
    data = quiet(landing, {"speed": SPEED, "angle": ANGLE}).to_xarray()
    assert data["value"].dims == ("speed", "angle")
    assert float(data["value"].sel(speed=SPEED[2], angle=ANGLE[3])) == data["value"].values[2, 3]
    zipped = quiet(landing, {"speed": SPEED[:5], "angle": ANGLE}, design="zip").to_xarray()
    assert zipped["value"].dims == ("lane",)
    np.testing.assert_array_equal(zipped["angle"], ANGLE)


def test_progress_counts_lanes(capsys):
    sweep(landing, {"speed": SPEED, "angle": ANGLE}, batch=10)
    told = capsys.readouterr().err
    assert "35.0/35.0" in told
    assert "lane/s" in told


class Pair(NamedTuple):
    sum: jax.Array
    product: jax.Array


def paired(x, y):
    return Pair(x + y, jnp.stack([x, y]) * x * y)


def test_a_sweep_can_be_pickled_from_memory_from_a_folder_and_from_a_file(tmp_path):
    axes = {"x": np.linspace(0.0, 1.0, 3), "y": np.linspace(1.0, 2.0, 4)}
    kept = sweep(paired, axes, progress=False)
    kept.save(tmp_path / "kept.npz")
    for found in (kept, sweep(paired, axes, progress=False, out=tmp_path / "out"), sweep.load(tmp_path / "kept.npz")):
        again = pickle.loads(pickle.dumps(pickle.loads(pickle.dumps(found))))
        assert jax.tree.structure(again.values) == jax.tree.structure(found.values)
        for a, b in zip(
            jax.tree.leaves((again.values, again.axes)), jax.tree.leaves((found.values, axes)), strict=True
        ):
            np.testing.assert_array_equal(a, b)
        assert again.ok.all()
        assert again.reason((0, 0)) == "ok"
        assert again.best("sum").point == {"x": 0.0, "y": 1.0}
        again.save(tmp_path / "again.npz")
        np.testing.assert_array_equal(sweep.load(tmp_path / "again.npz").values["sum"], kept.values.sum)


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("status", lambda s: s + 7, r"expected -1 to 2, the places of the reasons"),
        ("status", lambda s: s.astype(float), r"expected whole numbers of shape \(3, 4\)"),
        ("status", lambda s: s[:2], r"expected a shape that begins with that of the axes, \(3, 4\)"),
        ("value.sum", lambda v: v.T, r"expected a shape that begins with that of the axes, \(3, 4\)"),
        ("axis.x", lambda x: x[:2], r"expected a shape that begins with that of the axes, \(2, 4\)"),
        ("axis.x", lambda x: x[0], r"expected at least one number"),
        ("design", lambda _: "spiral", r"got spiral, expected grid or zip"),
        ("reasons", lambda r: np.arange(len(r)), r"expected words"),
    ],
)
def test_an_array_that_no_sweep_could_have_written_is_told_by_file_and_name(name, value, expected, tmp_path):
    axes = {"x": np.linspace(0.0, 1.0, 3), "y": np.linspace(1.0, 2.0, 4)}
    sweep(paired, axes, progress=False).save(tmp_path / "kept.npz")
    arrays = dict(np.load(tmp_path / "kept.npz"))
    arrays[name] = np.asarray(value(arrays[name]))
    np.savez(tmp_path / "other.npz", **arrays)
    with pytest.raises(ValueError, match=rf"load: .*other\.npz: .*{expected}"):
        sweep.load(tmp_path / "other.npz")
