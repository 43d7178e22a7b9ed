"""What a run returns: parts that remember, lanes that fail, and files that bring all of it back."""

import subprocess
import sys
from typing import ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, Trajectory, contacts, emitters, forces, methods, reference, simulate
from physjax.stepping.methods import METHODS
from physjax.trajectory import select_stateful_parts
from physjax.vectors import axis_vector, scale

RATE, RESERVE, DT = 0.5, 0.8, 0.01


class Thruster(eqx.Module):
    """An upward push as strong as the fuel that is left, which runs out at a reserve."""

    couples: ClassVar[bool] = False
    push: jax.Array
    fuel: jax.Array
    burning: jax.Array

    def __call__(self, t, state, mass):
        return axis_vector(jnp.where(self.burning, scale(self.push, self.fuel), 0.0), 1, state.velocity)

    def advance(self, t, dt, state):
        fuel = jnp.where(self.burning, self.fuel * (1 - RATE * dt), self.fuel)
        return Thruster(self.push, fuel, fuel > RESERVE), state


def rockets(fuel=(1.0, 1.5, 3.0), push=5.0, mass=1.0):
    """Rockets in empty space, which stop burning one after the other (the third not within 1.5 s)."""
    fuel = jnp.asarray(fuel)
    still = jnp.zeros((*fuel.shape, 2))
    return Scene(Particles(still, still), mass=mass, forces=(Thruster(jnp.asarray(push), fuel, fuel > RESERVE),))


def burnt(fuel, steps):
    """Fuel and gain of speed after 0..steps steps, by hand."""
    left, speed = [np.asarray(fuel, float)], [np.zeros(len(fuel))]
    for _ in range(steps):
        burning = left[-1] > RESERVE
        speed.append(speed[-1] + DT * 5.0 * left[-1] * burning)
        left.append(np.where(burning, left[-1] * (1 - RATE * DT), left[-1]))
    return np.array(left), np.array(speed)


# parts that remember


def test_parts_show_what_changed_at_every_frame_and_nothing_else():
    scene = rockets()
    flight = simulate(scene, methods.semi_implicit_euler, dt=DT, steps=150, save_every=10)
    left, speed = burnt([1.0, 1.5, 3.0], 150)
    (part,) = flight.parts
    np.testing.assert_allclose(part.fuel, left[::10], rtol=1e-13)
    np.testing.assert_array_equal(part.burning, left[::10] > RESERVE)
    np.testing.assert_allclose(flight.velocity[..., 1], speed[::10], rtol=1e-12)
    assert part.push.shape == ()  # never changes, so it is not carried
    np.testing.assert_array_equal(part.burning[-1], [False, False, True])
    np.testing.assert_array_equal(flight.final_scene.forces[0].fuel, part.fuel[-1])
    np.testing.assert_array_equal(flight.scene.forces[0].fuel, [1.0, 1.5, 3.0])


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_parts_advance_once_a_step_under_every_method(method):
    flight = simulate(rockets(), method, dt=DT, steps=40, save_every=40)
    np.testing.assert_allclose(flight.parts[0].fuel[-1], burnt([1.0, 1.5, 3.0], 40)[0][-1], rtol=1e-13)


def test_a_resumed_run_remembers():
    whole = simulate(rockets(), methods.rk4, dt=DT, steps=120, save_every=20)
    first = simulate(rockets(), methods.rk4, dt=DT, steps=60, save_every=20)
    second = simulate(first.final_scene, methods.rk4, dt=DT, steps=60, save_every=20, first_step=first.final_step)
    for ours, theirs in ((second.state, whole.state), (second.parts[0].fuel, whole.parts[0].fuel)):
        jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b[3:]), ours, theirs)


def test_what_is_remembered_passes_through_vmap_and_grad():
    def speed(fuel):
        scene = rockets(fuel[None])
        return simulate(scene, methods.semi_implicit_euler, dt=DT, steps=150, save_every=50).velocity[-1, 0, 1]

    fuel = jnp.asarray([1.0, 1.5, 3.0])
    np.testing.assert_allclose(jax.vmap(speed)(fuel), burnt(fuel, 150)[1][-1], rtol=1e-12)
    slope = jax.vmap(jax.grad(speed))(fuel)  # while a rocket burns its speed is in proportion to its fuel
    np.testing.assert_allclose(slope, burnt(fuel, 150)[1][-1] / fuel, rtol=1e-12)


def test_a_part_may_change_the_state():
    class Floor(eqx.Module):
        couples: ClassVar[bool] = False

        def __call__(self, t, state, mass):
            return jnp.zeros_like(state.velocity)

        def advance(self, t, dt, state):
            bounce = jnp.where(state.position < 0, -1.0, 1.0)
            return self, Particles(bounce * state.position, bounce * state.velocity)

    scene = Scene(Particles(jnp.ones((1, 1)), -jnp.ones((1, 1))), forces=(Floor(),))
    fall = simulate(scene, methods.verlet, dt=0.25, steps=8)
    np.testing.assert_array_equal(fall.position[:, 0, 0], [1.0, 0.75, 0.5, 0.25, 0.0, 0.25, 0.5, 0.75, 1.0])
    assert jax.tree.leaves(fall.parts) == []


# lanes that fail


def springs(stiffness, couples=False, steps=60, save_every=10, first_step=0):
    """Springs under a method that cannot hold the stiff ones."""
    stiffness = jnp.asarray(stiffness)
    x = scale(1.0 + jnp.arange(stiffness.size, dtype=float).reshape(stiffness.shape), jnp.ones((*stiffness.shape, 2)))
    point = forces.Anchor(point=jnp.zeros(2), stiffness=stiffness)
    extra = (forces.Gravitation(G=1e-3),) if couples else ()
    scene = Scene(Particles(x, 0.0 * x), forces=(point, *extra))
    return simulate(scene, methods.euler, dt=0.1, steps=steps, save_every=save_every, first_step=first_step)


WILD = [1.0, 1e40, 2.0, 1e15, 3.0, 1e300]


def test_a_lane_that_blows_up_is_told_with_its_step_and_harms_no_other():
    film, calm = springs(WILD, first_step=7), springs([1.0, 4.0, 2.0, 4.0, 3.0, 4.0], first_step=7)
    every = springs(WILD, save_every=1, first_step=7)
    finite = np.isfinite(np.concatenate(every.state, axis=-1)).all(-1)
    first = np.where(finite.all(0), -1, 7 + np.argmin(finite, axis=0))
    np.testing.assert_array_equal(film.ok, [True, False, True, False, True, False])
    np.testing.assert_array_equal(film.first_bad_step, first)
    np.testing.assert_array_equal(every.first_bad_step, first)
    assert len(set(first[1::2])) == 3
    np.testing.assert_array_equal(film.position[:, ::2], calm.position[:, ::2])
    np.testing.assert_array_equal(calm.first_bad_step, [-1] * 6)


@forces.independent
def overdue(t, state, mass):
    """An endless force on all that are nearer than t."""
    return jnp.where(state.position < t, jnp.inf, 0.0)


def test_a_run_tells_itself_in_one_line():
    flight = simulate(rockets(push=jnp.array([5.0, jnp.nan, 5.0])), methods.rk4, dt=DT, steps=10)
    told = "11 frames from t = 0 to 0.1 s, position (11, 3, 2) float64, 1 of 3 blew up"
    assert repr(flight) == f"<Trajectory: rk4, {told}>"
    assert "10 steps" in repr(
        jax.vmap(lambda push: simulate(rockets(push=push), methods.rk4, dt=DT, steps=10))(jnp.ones(2))
    )
    times = np.linspace(0.0, 0.1, 3)
    assert repr(reference(Scene(Particles(jnp.zeros(2), jnp.ones(2))), times)).startswith("<Trajectory: 3 frames")


def test_the_watch_for_a_failure_counts_time_as_the_run_did():
    x = jnp.asarray([[0.75], [1.35], [9.0]])
    run = simulate(Scene(Particles(x, 0.0 * x), forces=(overdue,)), methods.euler, dt=0.1, steps=10, first_step=5)
    np.testing.assert_array_equal(run.first_bad_step, [9, 15, -1])  # the steps from t = 0.8 and 1.4


def test_coupled_lanes_fail_together_and_scenes_apart():
    film = springs([[1.0, 2.0], [1.0, 1e40]], couples=True)
    every = springs([[1.0, 2.0], [1.0, 1e40]], couples=True, save_every=1)
    bad = ~np.isfinite(np.concatenate(every.state, axis=-1)).all((2, 3))
    np.testing.assert_array_equal(film.ok, [True, False])
    np.testing.assert_array_equal(film.first_bad_step, [-1, np.argmax(bad[:, 1])])


def test_failure_is_told_under_vmap():
    films = jax.vmap(lambda k: springs(k[None]))(jnp.asarray(WILD))
    together = springs(WILD)
    np.testing.assert_array_equal(films.ok[:, 0], together.ok)
    np.testing.assert_array_equal(films.first_bad_step[:, 0], together.first_bad_step)


# files


def same(mine, theirs):
    assert jax.tree.structure(mine) == jax.tree.structure(theirs)
    for a, b in zip(jax.tree.leaves(mine), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_array_equal(a, b)
        assert a.dtype == b.dtype


def height(t, state):
    return state.position[..., 1]


def both(t, state):
    return {"height": state.position[..., 1], "later": [t, t + 1.0]}


@pytest.fixture
def flight():
    return simulate(rockets(), methods.verlet, dt=DT, steps=120, save_every=20, first_step=3)


def test_a_saved_run_comes_back_whole_with_its_scene(flight, tmp_path):
    flight.save(tmp_path / "run.npz")
    loaded = Trajectory.load(tmp_path / "run.npz", scene=flight.scene, method=methods.verlet)
    same(loaded, flight)
    assert loaded.method is methods.verlet
    further = [simulate(f.final_scene, f.method, dt=f.dt, steps=20, first_step=f.final_step) for f in (flight, loaded)]
    same(*further)


def test_a_saved_run_comes_back_without_its_scene(flight, tmp_path):
    flight.save(tmp_path / "run.npz")
    loaded = Trajectory.load(tmp_path / "run.npz")
    for name in ("time", "position", "velocity", "ok", "dt", "first_step", "steps", "save_every", "final_step"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(flight, name))
    assert (loaded.scene, loaded.final_scene, loaded.method, loaded.parts) == (None, None, None, ())
    np.testing.assert_array_equal(loaded.first_bad_step, [-1, -1, -1])
    loaded.save(tmp_path / "again.npz")
    same(Trajectory.load(tmp_path / "again.npz"), loaded)


@pytest.mark.parametrize(
    ("record", "names"), [(height, None), (both, ["['height']", "['later'][0]", "['later'][1]"])], ids=["array", "dict"]
)
def test_what_was_recorded_comes_back(record, names, tmp_path):
    film = simulate(rockets(), methods.verlet, dt=DT, steps=40, save_every=20, record=record)
    film.save(tmp_path / "run.npz")
    for scene in (None, film.scene):
        loaded = Trajectory.load(tmp_path / "run.npz", scene=scene).recorded
        if names is None:
            np.testing.assert_array_equal(loaded, film.recorded)
        else:
            assert list(loaded) == names
            for a, b in zip(loaded.values(), jax.tree.leaves(film.recorded), strict=True):
                np.testing.assert_array_equal(a, b)
    same(Trajectory.load(tmp_path / "run.npz", scene=film.scene).final_scene, film.final_scene)


def test_a_failed_run_comes_back_with_its_failure(tmp_path):
    film = springs(WILD)
    film.save(tmp_path / "run.npz")
    np.testing.assert_array_equal(np.load(tmp_path / "run.npz")["first_bad_step"], film.first_bad_step)
    loaded = Trajectory.load(tmp_path / "run.npz", scene=film.scene, method=methods.euler)
    np.testing.assert_array_equal(loaded.first_bad_step, film.first_bad_step)
    with pytest.raises(ValueError, match="does not know its scene and method"):
        _ = Trajectory.load(tmp_path / "run.npz").first_bad_step


def test_a_reference_comes_back_in_float64_even_to_a_float32_program(tmp_path):
    scene = Scene(Particles(jnp.zeros((2, 2)), jnp.ones((2, 2))), forces=(forces.Gravity(),))
    truth = reference(scene, [0.1, 1 / 3], rtol=1e-3, solver=diffrax.Heun())
    truth.save(tmp_path / "truth.npz")
    with jax.enable_x64(False):
        for given in (None, scene):
            loaded = Trajectory.load(tmp_path / "truth.npz", scene=given)
            np.testing.assert_array_equal(loaded.position, truth.position)
            np.testing.assert_array_equal(loaded.time, truth.time)
            assert loaded.position.dtype == np.float64


def test_numpy_alone_reads_the_file(flight, tmp_path):
    flight.save(tmp_path / "run.npz")
    program = "import sys, numpy; f = numpy.load(sys.argv[1]); print(*(f'{n}{f[n].shape}' for n in f), f['method'], sep='\\n')"
    told = subprocess.run(
        [sys.executable, "-I", "-c", program, tmp_path / "run.npz"], capture_output=True, text=True, check=True
    )
    lines = told.stdout.splitlines()
    assert lines[-1] == "verlet"
    assert {"time(7,)", "state.position(7, 3, 2)", "parts[0].fuel(7, 3)", "ok(3,)", "dt()", "steps()"} <= set(lines)


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(flight, tmp_path, monkeypatch):
    file = tmp_path / "run.npz"
    flight.save(file)
    before = file.read_bytes()

    def full(file, **arrays):
        file.write(b"half of it")
        raise OSError("No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(OSError, match="No space left"):
        flight.save(file)
    assert file.read_bytes() == before
    assert list(tmp_path.iterdir()) == [file]
    with pytest.raises(FileNotFoundError, match=r"the folder .*nowhere does not exist"):
        flight.save(tmp_path / "nowhere" / "run.npz")


def test_files_that_are_no_runs_are_told_in_plain_words(flight, tmp_path):
    file, other = tmp_path / "run.npz", tmp_path / "other"
    with pytest.raises(FileNotFoundError, match=r"there is no file .*run\.npz"):
        Trajectory.load(file)
    flight.save(file)
    whole = file.read_bytes()
    for length in (0, 1, 100, len(whole) // 2, len(whole) - 1):
        other.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"other is damaged or not an \.npz file"):
            Trajectory.load(other)
    middle = whole.index(b"state.velocity.npy") + 60
    other.write_bytes(whole[:middle] + bytes(b ^ 0xFF for b in whole[middle : middle + 8]) + whole[middle + 8 :])
    with pytest.raises(ValueError, match=r"other is damaged or not an \.npz file"):
        Trajectory.load(other)
    other.write_text("time,x,y\n0,1,2\n")
    with pytest.raises(ValueError, match=r"other is damaged or not an \.npz file"):
        Trajectory.load(other)
    np.save(tmp_path / "one.npy", np.ones(3))
    with pytest.raises(ValueError, match=r"one\.npy is damaged or not an \.npz file"):
        Trajectory.load(tmp_path / "one.npy")
    np.savez(tmp_path / "foreign.npz", time=np.ones(3), ok=np.ones(3))
    with pytest.raises(ValueError, match="is not a saved run: it lacks first_step, method, save_every, steps"):
        Trajectory.load(tmp_path / "foreign.npz")


def test_a_run_of_another_scene_is_refused(flight, tmp_path):
    flight.save(tmp_path / "run.npz")
    with pytest.raises(ValueError, match=r"the run has the shape \(3, 2\), the given scene \(2, 2\)"):
        Trajectory.load(tmp_path / "run.npz", scene=rockets((1.0, 2.0)))
    film = springs([1.0, 2.0, 3.0])
    film.save(tmp_path / "springs.npz")
    with pytest.raises(
        ValueError, match=r"lacks 'final_parts\[0\]\.push', which the scene has\. Give the scene the run was made with"
    ):
        Trajectory.load(tmp_path / "springs.npz", scene=flight.scene)


TAMPERED = {
    "dt": [
        (-DT, "finite numbers > 0"),
        (0.0, "> 0"),
        (np.nan, "> 0"),
        (2 * DT, "120 steps to take as long"),
        (1, "real"),
    ],
    "time": [
        (lambda t: t[::-1], "finite and ascending numbers"),
        (lambda t: np.where(t > 1.0, np.nan, t), "finite and ascending"),
        (lambda t: t[:-1], "7 frames, as steps and save_every have it"),
        (lambda t: t.astype(str), "numbers"),
    ],
    "save_every": [(0, "a whole number from 1 on"), (20.0, "a whole number from 1 on"), (10, "7 frames|13 frames")],
    "steps": [(-120, "a whole number of steps"), (121, "a multiple of save_every, 20"), (140, "8 frames")],
    "first_step": [(3.0, "whole numbers"), (4, "the step at which time begins")],
    "ok": [(lambda ok: 1 * ok, "booleans"), (lambda ok: ok[:2], r"one for each lane or scene, \(3,\)")],
    "method": [(7, "the name of a method")],
    "format": [(2, "at most 1: a newer physjax wrote it"), (0, "a whole number from 1 on")],
    "first_bad_step": [(lambda step: step[:1], r"whole numbers of ok's shape, \(3,\)")],
    "state.position": [
        (lambda x: x[:5], "7 frames"),
        (lambda x: x.astype(int), "real numbers"),
        (lambda x: np.where(np.arange(7)[:, None, None] > 5, np.inf, x), "finite numbers at the end, since ok is true"),
    ],
    "state.velocity": [(lambda v: v[..., :1], r"float64 of shape \(7, 3, 2\), as state.position")],
    "final_state.position": [(lambda x: x + 1e-9, "the position of the last frame")],
    "final_state.velocity": [
        (lambda v: v * np.nan, "finite numbers, since ok is true"),
        (lambda v: v + 1e-9, "the velocity of the last frame"),
    ],
}


@pytest.mark.parametrize(
    ("name", "value", "expected"), [(name, *case) for name, all in TAMPERED.items() for case in all]
)
def test_an_array_that_no_run_could_have_written_is_told_by_file_and_name(flight, tmp_path, name, value, expected):
    flight.save(tmp_path / "run.npz")
    arrays = dict(np.load(tmp_path / "run.npz"))
    arrays[name] = value(arrays[name]) if callable(value) else np.asarray(value)
    np.savez(tmp_path / "other.npz", **arrays)
    for given in ({}, {"scene": flight.scene, "method": methods.verlet}):
        with pytest.raises(ValueError, match=rf"load: .*other\.npz: [\w.]+: got .*, expected .*({expected})"):
            Trajectory.load(tmp_path / "other.npz", **given)


def test_a_file_of_the_first_edition_is_read_and_a_memory_of_another_shape_is_not(flight, tmp_path):
    flight.save(tmp_path / "run.npz")
    arrays = dict(np.load(tmp_path / "run.npz"))
    del arrays["format"]
    np.savez(tmp_path / "old.npz", **arrays)
    same(Trajectory.load(tmp_path / "old.npz", scene=flight.scene, method=methods.verlet), flight)
    np.savez(tmp_path / "old.npz", **arrays | {"final_parts[0].fuel": np.ones(2)})
    with pytest.raises(
        ValueError, match=r"final_parts\[0\]\.fuel: the file has float64 of shape \(2,\).* of shape \(3,\)"
    ):
        Trajectory.load(tmp_path / "old.npz", scene=flight.scene)


def test_what_parts_remembered_at_frames_has_the_shape_and_type_of_the_scenes(flight, tmp_path):
    flight.save(tmp_path / "run.npz")
    arrays = dict(np.load(tmp_path / "run.npz"))
    load = lambda: Trajectory.load(tmp_path / "other.npz", scene=flight.scene, method=methods.verlet)  # noqa: E731
    for fuel in (np.ones((7, 2)), np.ones((6, 3)), arrays["parts[0].fuel"].astype(np.float16)):
        np.savez(tmp_path / "other.npz", **arrays | {"parts[0].fuel": fuel})
        with pytest.raises(ValueError, match=r"parts\[0\]\.fuel: the file has float"):
            load()
    del arrays["dt"]
    np.savez(tmp_path / "other.npz", **arrays)
    with pytest.raises(ValueError, match=r"is not a saved run: it lacks dt\."):
        load()


def test_a_run_of_another_method_or_contact_is_refused(flight, tmp_path):
    flight.save(tmp_path / "run.npz")
    with pytest.raises(ValueError, match="made with the method verlet, got rk4"):
        Trajectory.load(tmp_path / "run.npz", scene=flight.scene, method=methods.rk4)
    bouncing = lambda k: Scene(  # noqa: E731
        Particles(jnp.ones(2), jnp.zeros(2)),
        forces=(forces.Gravity(),),
        contacts=(contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=k),),
    )
    scene = bouncing(0.8)  # put in the place of a scene without contacts, which compiles in a moment
    run = simulate(Scene(scene.state, forces=scene.forces), methods.verlet, dt=DT, steps=2)
    final = eqx.tree_at(lambda scene: scene.state, scene, run.final_scene.state)
    parts = lambda run: (run.scene, run.final_scene, run.parts)  # noqa: E731
    run = eqx.tree_at(parts, run, (scene, final, select_stateful_parts(scene)))
    run.save(tmp_path / "bounce.npz")
    same(Trajectory.load(tmp_path / "bounce.npz", scene=bouncing(0.8)).final_scene, run.final_scene)
    with pytest.raises(ValueError, match=r"restitution was 0\.8, in the given scene it is 0\.5"):
        Trajectory.load(tmp_path / "bounce.npz", scene=bouncing(0.5))


def test_a_run_of_float32_goes_on_in_a_float64_session_as_it_would_have(tmp_path):
    """The scene is built anew, in float64, which is what a session with 64-bit types makes of Python's numbers."""
    build = lambda: rockets((1.0, 1.5), 5.1)  # noqa: E731
    with jax.enable_x64(False):
        whole = simulate(build(), methods.verlet, dt=DT, steps=40, save_every=20)
        simulate(build(), methods.verlet, dt=DT, steps=20, save_every=20).save(tmp_path / "run.npz")
    half = Trajectory.load(tmp_path / "run.npz", scene=build(), method=methods.verlet)
    assert half.position.dtype == half.final_scene.state.dtype == half.scene.state.dtype == np.float32
    rest = simulate(half.final_scene, half.method, dt=half.dt, steps=20, first_step=half.final_step)
    np.testing.assert_array_equal(rest.position[-1], whole.position[-1])
    np.testing.assert_array_equal(rest.parts[0].fuel[-1], whole.parts[0].fuel[-1])


def test_a_run_of_float64_is_never_rounded(tmp_path):
    run = simulate(rockets(), methods.verlet, dt=DT, steps=20)
    run.save(tmp_path / "run.npz")
    with jax.enable_x64(False):
        loaded = Trajectory.load(tmp_path / "run.npz")
        assert loaded.position.dtype == np.float64
        np.testing.assert_array_equal(loaded.velocity, run.velocity)
        with pytest.raises(ValueError, match=r"in float64, the given scene in float32.*jax_enable_x64"):
            Trajectory.load(tmp_path / "run.npz", scene=rockets())


def test_a_file_from_before_rests_of_moments_were_kept_still_loads(tmp_path):
    jet = emitters.Emitter(4, emitters.Point((0.0, 0.0)), key=0, life=1.0, speed=5.0, rate=4.0)
    spray = Scene(jet.unborn(), forces=(forces.Gravity(),), emitter=jet)
    flight = simulate(spray, methods.euler, dt=0.1, steps=4, save_every=2)
    flight.save(tmp_path / "new.npz")
    with np.load(tmp_path / "new.npz") as file:
        np.savez(tmp_path / "old.npz", **{name: file[name] for name in file.files if not name.endswith("_rest")})
    old, new = (Trajectory.load(tmp_path / name, scene=spray, method=methods.euler) for name in ("old.npz", "new.npz"))
    again = [
        simulate(run.final_scene, methods.euler, dt=0.1, steps=4, first_step=run.final_step).position
        for run in (old, new)
    ]
    np.testing.assert_array_equal(*again)
