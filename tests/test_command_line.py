"""What the command line says where nothing is computed: examples, versions, numbers of scenes, and how it ends."""

import subprocess
import sys

import pytest

import physjax
from physjax import cli
from physjax.cli import chart
from physjax.cli.aim import describe_reach


def test_alone_it_shows_five_examples(capsys):
    assert cli.main([]) == 0
    shown = capsys.readouterr().out.splitlines()
    assert sum(line.startswith("physjax ") and "COMMAND" not in line for line in shown) == 5
    assert max(map(len, shown)) <= 80


def test_it_knows_its_version(capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out.strip() == f"physjax {physjax.__version__}"


def test_scenes_fit_a_terminal_of_80_columns(capsys):
    assert cli.main(["scenes"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert "euler_on_a_spring" in lines[lines.index("Runs that must fail:") :]


def test_a_scene_is_listed_with_its_numbers_units_and_ranges(capsys):
    assert cli.main(["scenes", "projectile"]) == 0
    shown = capsys.readouterr().out
    assert [line.split() for line in shown.splitlines() if "m/s²" in line] == [
        ["g", "9.8", "m/s²", "4.9", "to", "19.6"]
    ]
    assert 'scenes.SCENES["projectile"](speed=30.0)' in shown
    assert cli.main(["scenes", "pythagorean"]) == 0
    assert "no numbers" in capsys.readouterr().out


def test_a_pipe_that_closes_ends_it_quietly():
    program = "import sys; from physjax.cli import main; sys.exit(main(['scenes']))"
    run = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert run.stdout.readline().startswith("bouncing_ball")
    run.stdout.close()
    assert run.wait(60) == 0
    assert "rror" not in run.stderr.read()


def test_ctrl_c_ends_a_chart_in_one_line_with_what_is_done(monkeypatch, capsys, tmp_path):
    def study(name, folder, quick, label):
        assert label == "1/2 kepler"
        raise KeyboardInterrupt

    monkeypatch.setattr(chart, "_study_scene", study)
    assert cli.main(["chart", "kepler", "comet", "--out", str(tmp_path)]) == 130
    assert capsys.readouterr().err.strip() == "physjax chart: stopped by Ctrl-C; none is done"


def test_explore_serves_the_scene_that_is_named(monkeypatch, capsys):
    served = []
    monkeypatch.setattr(
        "physjax.live.explorer.Explorer.serve", lambda self, port, browser: served.append((port, browser))
    )
    assert cli.main(["explore", "kepler", "--no-browser", "--port", "0"]) == 0
    assert served == [(0, False)]
    assert cli.main(["explore", "keppler"]) == 2
    assert "kepler" in capsys.readouterr().err
    assert cli.main(["explore", "kepler", "--port", "70000"]) == 2


def test_out_of_reach_says_how_near_it_comes_and_what_it_takes(monkeypatch, unannotated):
    options = type("Options", (), {"speed": 10.0, "target": [92.0, 0.0]})
    shot = type("Shot", (), {"speed": 30.03, "ok": True})
    monkeypatch.setattr("physjax.study.inverse.aim.aim_at", lambda scene, target: type("Aimed", (), {"low": shot}))
    told = describe_reach(None, options, 72.0)
    assert told == "The target is out of reach: 10 m/s comes within 72 m of it; it needs at least 30.03 m/s."
