"""The command line, as a person uses it."""

import subprocess
import sys

import jax
import numpy as np
import pytest

from physjax.cli import main
from physjax.cli.chart import _choose_scenes
from physjax.compiling import name_compiler_target
from physjax.stepping.methods import METHODS


def test_chart_writes_picture_csv_and_page(tmp_path, capsys):
    assert main(["chart", "projectile", "--quick", "--out", str(tmp_path / "new" / "folder")]) == 0
    folder = tmp_path / "new" / "folder"
    assert {file.name for file in folder.iterdir()} == {"projectile.png", "projectile.csv", "index.html"}
    assert (folder / "projectile.png").stat().st_size > 20_000
    page = (folder / "index.html").read_text()
    assert "semi_implicit_euler" in page.replace("<wbr>", "")
    assert "Pareto front" in page
    assert "<img" in page
    printed = capsys.readouterr().out
    assert f"Chart: {folder / 'projectile.png'}" in printed
    assert "error 1e-04" in printed
    assert "closed form" in printed
    assert "jax" in printed


def test_chart_of_a_scene_with_contacts_shows_both_treatments(tmp_path, monkeypatch):
    for name in set(METHODS) - {"verlet"}:
        monkeypatch.delitem(METHODS, name)
    assert main(["chart", "tennis_ball", "--quick", "--out", str(tmp_path)]) == 0
    page = (tmp_path / "index.html").read_text()
    assert "verlet, projected" in page
    assert "diffrax Tsit5" not in page


def test_chart_has_a_few_scenes_by_default_and_all_smooth_ones_when_asked():
    """The default tells the story in two minutes; what is smooth is known without building a scene."""
    few, smooth = _choose_scenes([], False), _choose_scenes([], True)
    assert few == ["fall_with_drag", "oscillator", "kepler", "bouncing_ball"]
    assert set(few) < set(smooth)
    assert {"flag", "t_handle", "solar_system"} < set(smooth)
    assert not {"tennis_ball", "fountain", "breaking_bridge", "car"} & set(smooth)


def test_chart_takes_names_or_all(capsys):
    assert main(["chart", "kepler", "--all"]) == 2
    assert "expected no names" in capsys.readouterr().err


def test_unknown_scene_names_the_nearest(tmp_path, capsys):
    assert main(["chart", "keppler", "--out", str(tmp_path / "out")]) == 2
    assert "Did you mean kepler" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_written_is_refused_before_the_work(tmp_path, capsys):
    (tmp_path / "file").write_text("in the way")
    assert main(["chart", "kepler", "--out", str(tmp_path / "file")]) == 2
    captured = capsys.readouterr()
    assert "cannot write into" in captured.err
    assert "method" not in captured.err  # no progress bar was begun


def test_scenes_lists_what_a_scene_is_its_size_and_its_truth(capsys):
    assert main(["scenes", "--only", "kepler", "hanging_rope"]) == 0
    printed = capsys.readouterr().out
    assert "kepler: 2 " in printed
    assert "truth: closed form" in printed
    assert "hanging_rope: " in printed


def test_aim_prints_both_arcs_and_draws_them(tmp_path, capsys):
    aim = ["aim", "--speed", "30", "--target", "40", "0", "--drag", "0.0", "--out", str(tmp_path)]
    assert main([*aim, "--wind", "-5", "0"]) == 0
    printed = capsys.readouterr().out
    assert "12.9103" in printed  # ½ asin(40 g/30²) = 12.910325°
    assert "77.0897" in printed
    assert "out of reach" not in printed
    assert (tmp_path / "aim.png").stat().st_size > 10_000
    assert main([*aim, "--wind", "-5", "0", "--target", "400", "0"]) == 0
    assert "needs at least 62.61 m/s" in capsys.readouterr().out


def test_aim_takes_the_axis_that_is_up(tmp_path, capsys):
    aim = ["aim", "--speed", "30", "--target", "24", "32", "0", "--up", "z", "--out", str(tmp_path)]
    assert main(aim) == 0
    printed = capsys.readouterr().out
    assert "12.9103" in printed
    assert "53.1301" in printed  # the azimuth, from x towards y


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--speed", "0"], "numbers > 0"),
        (["--speed", "30", "--wind", "1", "0"], "without --drag"),
        (["--speed", "30", "--start", "1"], "expected 2"),
        (["--speed", "30", "--start", "40", "0"], "away from the launch"),
        (["--speed", "30", "--up", "z"], "expected x or y"),
    ],
)
def test_aim_refuses_what_cannot_be(options, words, tmp_path, capsys):
    assert main(["aim", "--target", "40", "0", "--out", str(tmp_path), *options]) == 2
    assert words in capsys.readouterr().err


def test_python_m_physjax_is_the_same_command():
    run = subprocess.run([sys.executable, "-m", "physjax", "--help"], capture_output=True, text=True, check=True)
    assert "chart" in run.stdout


def test_sweep_goes_over_the_numbers_of_a_scene_and_draws(tmp_path, capsys):
    command = ["sweep", "projectile", "--over", "speed=10:20:3", "angle=0.3:1.2:4", "--outcome", "distance"]
    assert main([*command, "--steps", "64", "--out", str(tmp_path)]) == 0
    captured = capsys.readouterr()
    assert "most: 39.7489 at speed = 20, angle = 0.9" in captured.out  # v² sin 2θ / g
    assert "12.0/12.0" in captured.err
    assert (tmp_path / "sweep.png").stat().st_size > 10_000
    with np.load(tmp_path / "sweep.npz") as kept:
        speed, angle = kept["axis.speed"][:, None], kept["axis.angle"]
        np.testing.assert_allclose(kept["value.distance"], speed**2 * np.sin(2 * angle) / 9.8, rtol=1e-9)
    assert main([*command, "--steps", "96", "--out", str(tmp_path)]) == 2
    assert "holds another sweep" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("over", "outcome", "words"),
    [
        ("nodes=5:7:3", "height", "differ in more than numbers"),
        ("nodes=5:6:3", "height", "expected whole numbers: it counts something"),
        ("notes=5:7:3", "height", "unknown number of hanging_rope 'notes'. Did you mean nodes"),
        ("mass=1:2", "height", "--over: got 'mass=1:2', expected NAME=LOW:HIGH:COUNT"),
        ("mass=1:2:3", "hight", "Did you mean height"),
    ],
)
def test_sweep_refuses_in_plain_words(tmp_path, capsys, over, outcome, words):
    command = ["sweep", "hanging_rope", "--over", over, "--outcome", outcome, "--out", str(tmp_path)]
    assert main(command) == 2
    assert words in capsys.readouterr().err


def test_a_command_keeps_its_programs_where_it_is_told(tmp_path, capsys):
    before = jax.config.jax_compilation_cache_dir
    assert main(["scenes", "--only", "kepler", "--cache", str(tmp_path / "compiled")]) == 0
    assert [folder.name for folder in (tmp_path / "compiled").iterdir()] == [name_compiler_target()]
    assert jax.config.jax_compilation_cache_dir == before
    assert main(["warm", "keppler", "--cache", str(tmp_path)]) == 2
    assert "Did you mean kepler" in capsys.readouterr().err


@pytest.mark.slow
def test_a_class_compiles_nothing_that_its_teacher_has_warmed(tmp_path):
    compiled = str(tmp_path / "compiled")
    warm = [sys.executable, "-m", "physjax", "warm", "projectile", "--cache", compiled]
    run = subprocess.run(warm, capture_output=True, text=True, check=True)
    assert f"physjax chart --cache {compiled}" in run.stdout
    lesson = f"""
import jax, sys
events = []
jax.monitoring.register_event_listener(lambda event, **_: events.append(event.rpartition("/")[2]))
from physjax.cli import main
main(["chart", "projectile", "--quick", "--cache", {compiled!r}, "--out", {str(tmp_path / "chart")!r}])
print(events.count("cache_hits"), events.count("cache_misses"))
"""
    run = subprocess.run([sys.executable, "-c", lesson], capture_output=True, text=True, check=True)
    hits, misses = map(int, run.stdout.split()[-2:])
    assert hits > 20
    assert misses == 0
