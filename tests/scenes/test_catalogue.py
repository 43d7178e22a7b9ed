"""The gallery is listed and drawn from what its scenes are, and a scene that fails stops none of the others."""

import functools
import re

import numpy as np
import pytest
from PIL import Image

from physjax import Particles, Scene, forces, lattices
from physjax.cli import main
from physjax.scenes import FAILURES, SCENES
from physjax.scenes.catalogue import build_scene, describe_problem, list_scene
from physjax.show.pages import read_web_file
from physjax.study.problem import Problem, Truth


def fall() -> Problem:
    """Three stones that fall side by side in space, without anything in their way."""
    start = Particles(np.eye(3), np.zeros((3, 3)))
    still = Truth("keeps to its line [m]", lambda flight: flight.position[-1, :, 0], np.eye(3)[:, 0], 1e-12)
    return Problem(Scene(start, forces=(forces.Gravity(),)), 0.4, truths=(still,), frames=8)


def swing() -> Problem:
    """A small cloth that swings from its upper edge, drawn as a surface."""
    sheet = lattices.cloth(0.2, 0.2, 3, 3, mass=0.1, structural=50.0, damping=0.1)
    scene = Scene(sheet.state, sheet.mass, (forces.Gravity(), sheet.springs), pinned=sheet.nodes["top"])
    return Problem(scene, 0.2, frames=8, looks=sheet)


def ruin() -> Problem:
    """A scene that cannot be built, to see that nobody minds."""
    raise RuntimeError("no such bridge")


@pytest.fixture
def gallery(monkeypatch):
    for name in list(SCENES):
        monkeypatch.delitem(SCENES, name)
    for build in (fall, ruin, swing):
        monkeypatch.setitem(SCENES, build.__name__, build)
    monkeypatch.setattr("physjax.study.problem.FILM_FRAMES", 16)


def test_a_scene_is_listed_with_its_size_and_its_truths():
    entry = list_scene("balls_in_a_box")
    assert entry.size == "64 particles in 2-D, 2 s"
    assert entry.truth.startswith("closed form; every |velocity component| is conserved")
    assert not entry.smooth
    assert list_scene("heavy_top").size == "2 bodies in 3-D, 1.96 s"
    entry = list_scene("hanging_rope")
    assert entry.size == "25 particles in 2-D, 24 springs, 4 s"
    assert entry.smooth
    assert "catenary" in str(entry)
    assert max(map(len, str(entry).splitlines())) <= 110


def demand_listed_as_built(name):
    built = describe_problem(name, build_scene(name))
    assert list_scene(name) == built, "run physjax.scenes.catalogue.write_table()"


@pytest.mark.parametrize("name", ["projectile", "bouncing_ball", "rolling"])
def test_what_the_list_says_is_so(name):
    demand_listed_as_built(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_what_the_list_says_of_each_scene_is_so(name):
    demand_listed_as_built(name)


def test_the_gallery_is_listed_without_building_a_scene(monkeypatch, capsys):
    for name, build in SCENES.items():
        unbuildable = functools.wraps(build)(lambda: pytest.fail("not in the table: run write_table()"))
        monkeypatch.setitem(SCENES, name, unbuildable)
    assert main(["scenes"]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in (*SCENES, *FAILURES))


@pytest.mark.slow
@pytest.mark.usefixtures("gallery")
def test_every_scene_is_drawn_and_one_that_fails_is_named_at_the_end(tmp_path, capsys):
    folder = tmp_path / "gallery"
    assert main(["scenes", "--render", str(folder)]) == 1
    printed = capsys.readouterr()
    assert printed.err.splitlines()[-1] == "physjax: ruin could not be drawn: RuntimeError: no such bridge"
    assert "3/3" in printed.err
    expected = {"fall.png", "fall.gif", "swing.png", "swing.gif", "index.html"}
    assert {file.name for file in folder.iterdir()} == expected
    page = (folder / "index.html").read_text(encoding="utf-8")
    assert "://" not in page
    assert 'name="viewport"' in page
    assert "prefers-color-scheme: dark" in page
    style = re.search(r"<style>(.*?)</style>", page, re.S)[1].replace(read_web_file("colors.css"), "")
    assert "background: var(--page)" in style
    assert not re.search(r"#[0-9a-f]{3}\b", style), "every colour is one of the themes"
    assert all(f'<article id="{name}">' in page for name in SCENES)
    assert page.count("<img") == 2
    assert "keeps to its line [m]" in page
    for name in ("fall", "swing"):
        with Image.open(folder / f"{name}.gif") as film:
            assert film.n_frames >= 12  # 16 moments were simulated
        picture = np.asarray(Image.open(folder / f"{name}.png").convert("RGB")).astype(int)
        assert (picture.min(axis=(0, 1)) < 120).all()  # drawn on
        assert (picture == 255).all(axis=-1).mean() < 0.99
    blue = picture[..., 2] - picture[..., 0] > 60
    assert blue.mean() > 0.02  # a surface, not lines


@pytest.mark.usefixtures("gallery")
def test_only_some_are_listed_or_drawn(tmp_path, capsys):
    assert main(["scenes", "--only", "fall"]) == 0
    printed = capsys.readouterr().out
    assert "3 particles in 3-D" in printed
    assert "swing" not in printed
    assert main(["scenes", "--only", "fal", "--render", str(tmp_path / "out")]) == 2
    assert "Did you mean fall" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
