"""Files that an earlier version wrote still load, with the numbers they held: runs and sweeps outlive what made them.

The files in `data` were written by version 0.1.0, in float64, before its modules and fields got other names.
"""

import json
import shutil
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, Trajectory, contacts, forces, methods, simulate, sweep

DATA = Path(__file__).parent / "data"
NAN = np.nan


def thrown():
    velocity = jnp.array([[10.0, 10.0], [20.0, 10.0], [30.0, 20.0], [40.0, 30.0]])
    drag = forces.QuadraticDrag(area=4.3e-3, coefficient=0.35)
    mass = jnp.array([0.145, 0.2, 0.4, 1e-6])  # the last is so light that its drag makes rk4 unstable
    return Scene(Particles(jnp.zeros((4, 2)), velocity), mass, (forces.Gravity(), drag))


def dropped():
    floor = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.5, friction=0.2)
    start = Particles(jnp.array([[0.0, 0.5], [0.0, 1.0]]), jnp.array([[1.0, 0.0], [2.0, 0.0]]))
    return Scene(start, 0.5, (forces.Gravity(),), contacts=(floor,))


def close(found, expected, tolerance=1e-10):
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize("known", [False, True], ids=["alone", "with its scene"])
def test_an_old_run_loads(known):
    given = {"scene": thrown(), "method": methods.rk4} if known else {}
    run = Trajectory.load(DATA / "old_run.npz", **given)
    assert (run.steps, run.save_every, int(run.final_step), float(run.dt)) == (20, 5, 20, 0.05)
    assert run.position.shape == run.velocity.shape == (5, 4, 2)
    assert run.position.dtype == np.float64
    close(run.time, [0.0, 0.25, 0.5, 0.75, 1.0])
    assert run.ok.tolist() == [True, True, True, False]
    close(run.position[1, :3, 0], [2.4733977782417975, 4.937639566942488, 7.424097632545373], 0.0)
    close(run.position[-1, :3, 1], [4.8424677526216, 4.78628507919827, 14.466197340814196], 0.0)
    assert np.isnan(run.position[1:, 3]).all()


def test_an_old_run_reports_when_it_failed_and_goes_on():
    run = Trajectory.load(DATA / "old_run.npz", scene=thrown(), method=methods.rk4)
    assert run.first_bad_step.tolist() == [-1, -1, -1, 2]
    rest = simulate(run.final_scene, methods.rk4, dt=run.dt, steps=20, first_step=run.final_step)
    ends = [[18.661870573586583, -0.1128458909151067], [36.58647390020743, -0.22263580586394727]]
    close(rest.position[-1], [*ends, [55.83494025284889, 18.486578607858227], [NAN, NAN]])
    assert float(rest.time[-1]) == pytest.approx(2.0)


def test_an_old_run_with_a_contact_that_remembers_goes_on():
    run = Trajectory.load(DATA / "old_bounce.npz", scene=dropped(), method=methods.rk4)
    close(run.position[2], [[0.383887656499994, 0.09429710109982331], [0.8000000000000002, 0.21600000000000014]], 0.0)
    close(run.velocity[-1], [[0.512, 0.3775498173117272], [1.6, -1.1992169136464015]], 0.0)
    rest = simulate(run.final_scene, methods.rk4, dt=run.dt, steps=40, first_step=run.final_step)
    close(rest.position[-1], [[0.7436114335597706, 0.0], [2.1062113636480957, 0.0]])
    assert run.film.state.position.shape == (5, 2, 2)


@pytest.mark.parametrize("name", ["old_sweep.npz", "old_sweep"], ids=["file", "folder"])
def test_an_old_sweep_loads(name):
    found = sweep.load(DATA / name)
    assert found.shape == (3, 4)
    close(found.axes["speed"], [6.0, 11.0, 16.0], 0.0)
    close(np.rad2deg(found.axes["angle"]), [20.0, 35.0, 50.0, 65.0])
    assert found.status.tolist() == [[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 1, 1]]
    assert found.failures == {"not ok": 2}
    close(found.values["range"][0], [2.3373221953135945, 3.397871134190464, 3.550431266169885, 2.76060957559773], 0.0)
    close(found.values["time"][2], [1.0969033711596181, 1.8207333121220155, NAN, NAN], 0.0)
    best = found.best("range", largest=True)
    assert (best.index, best.score) == ((2, 1), 22.09812119592364)


# files of a newer version


@pytest.mark.parametrize(("name", "load"), [("old_run.npz", Trajectory.load), ("old_sweep.npz", sweep.load)])
@pytest.mark.parametrize(
    ("version", "expected"),
    [
        (2, r"got 2, expected at most 1: a newer physjax wrote it\. Update physjax"),
        (0, "got 0, expected a whole number"),
    ],
)
def test_a_file_of_a_newer_or_of_no_format_is_refused_whatever_else_is_in_it(tmp_path, name, load, version, expected):
    arrays = dict(np.load(DATA / name)) if version == 0 else {"a_new_array": np.ones(3)}
    np.savez(tmp_path / name, **arrays | {"format": np.array(version)})
    with pytest.raises(ValueError, match=rf"^load: .*{name}: format: {expected}"):
        load(tmp_path / name)


@pytest.mark.parametrize(
    ("version", "expected"), [(2, "got 2, expected at most 1"), ("new", "got new, expected a whole")]
)
def test_so_is_a_folder_of_a_sweep(tmp_path, version, expected):
    folder = shutil.copytree(DATA / "old_sweep", tmp_path / "sweep")
    manifest = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").write_text(
        json.dumps({"format": version} if version == 2 else {**manifest, "format": version})
    )
    with pytest.raises(ValueError, match=rf"^sweep: .*manifest\.json: format: {expected}"):
        sweep.load(folder)


def test_what_is_written_says_its_format(tmp_path):
    found = sweep(lambda x: 2.0 * x, {"x": jnp.arange(3.0)}, out=tmp_path / "sweep", progress=False)
    found.save(tmp_path / "sweep.npz")
    assert json.loads((tmp_path / "sweep" / "manifest.json").read_text())["format"] == 1
    assert np.load(tmp_path / "sweep.npz")["format"] == 1
    assert (
        sweep.load(tmp_path / "sweep.npz").values.tolist()
        == sweep.load(tmp_path / "sweep").values.tolist()
        == [0, 2, 4]
    )
