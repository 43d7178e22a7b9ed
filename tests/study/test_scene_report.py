"""The page on the whole of a scene."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import equinox as eqx
import jax
import pytest

from physjax.cli import main
from physjax.scenes import SCENES, title
from physjax.stepping.methods import METHODS
from physjax.study import scene_report
from physjax.study.accuracy.result import Run, WorkPrecision
from physjax.study.scene_report import NO_RUN, PARTS, TARGET_ERROR, SceneStudy


class Pictures(HTMLParser):
    """The attributes of all pictures of a page."""

    def __init__(self, page):
        super().__init__()
        self.found = []
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        if tag == "img":
            self.found.append(dict(attributes))


def small(monkeypatch):
    """Two methods, and a film of few pictures."""
    for name in set(METHODS) - {"verlet", "rk4"}:
        monkeypatch.delitem(METHODS, name)
    monkeypatch.setattr("physjax.study.problem.FILM_FRAMES", 32)


@pytest.mark.slow
def test_a_report_is_one_page_with_every_part_and_its_pictures_inside(tmp_path, capsys, monkeypatch):
    small(monkeypatch)
    assert main(["chart", "oscillator", "--report", "--out", str(tmp_path)]) == 0
    assert [file.name for file in tmp_path.iterdir()] == ["oscillator.html"]
    page = (tmp_path / "oscillator.html").read_text(encoding="utf-8")
    assert re.findall("<h2>(.*?)</h2>", page) == list(PARTS)
    assert 'name="viewport" content="width=device-width' in page
    assert not re.search(r"(https?:|src=\"(?!data:)|<script|<link)", page)
    pictures = Pictures(page).found
    assert len(pictures) == 6  # still, film, charts, map, ledger, ablation
    assert all(len(picture["alt"]) > 20 for picture in pictures)
    assert sum(picture["src"].startswith("data:image/gif;base64,R0lG") for picture in pictures) == 1
    assert title("oscillator") in page
    assert "rk4: " in page
    assert re.search(r"Springs|Anchor", page)
    assert "needed" in page
    assert page.count("Evidence: ") == 3
    captured = capsys.readouterr()
    assert "oscillator.html" in captured.out
    assert f"{len(PARTS)}/{len(PARTS)}" in captured.err


def test_a_part_that_fails_leaves_no_page(tmp_path, capsys, monkeypatch):
    small(monkeypatch)

    def broken(studied):
        raise ValueError("no ink")
        yield

    monkeypatch.setattr(scene_report, "PARTS", {"scene": broken})
    assert main(["chart", "oscillator", "--report", "--out", str(tmp_path)]) == 2
    assert "no ink" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def of(name, *runs):
    """A scene whose study found these runs."""
    with jax.enable_x64(True):
        problem = SCENES[name]()
    found = WorkPrecision(name, runs, {}, "closed form", 0.0, problem.duration, (), "float64", ([], []))
    return SceneStudy(name, title(name), problem, found)


def run_of(method, error, seconds):
    return Run(method, 0.1, None, 64, 64, seconds, seconds, 0.0, error, error, (), scheme=method)


@pytest.mark.parametrize(
    ("name", "part", "reason"),
    [
        ("free_top", "stability", "rigid bodies turn"),
        ("fountain", "stability", "born and die"),
        ("fountain", "energy ledger", "when they are born"),
        ("fountain", "ablation", "other particles would be born"),
        ("free_top", "ablation", "neither forces nor contacts"),
        ("projectile", "energy ledger", NO_RUN),
        ("projectile", "ablation", NO_RUN),
    ],
)
def test_a_part_that_is_not_available_says_why_in_one_sentence(name, part, reason):
    (said,) = PARTS[part](of(name, run_of("rk4", float("nan"), 1.0)))
    assert reason in said
    assert said.count(". ") == 0


def test_a_contact_with_a_response_of_its_own_has_no_ledger():
    studied = of("tennis_ball", run_of("rk4", 1e-9, 1.0))
    (plane,) = studied.problem.scene.contacts
    own = replace(plane, response=lambda *moment: None, touching_since=None)
    scene = eqx.tree_at(lambda scene: scene.contacts, studied.problem.scene, (own,))
    (reason,) = PARTS["energy ledger"](studied._replace(problem=studied.problem._replace(scene=scene)))
    assert "a response of its own" in reason


def test_later_parts_follow_the_cheapest_of_our_runs_that_is_accurate_enough():
    coarse, good, finer = (
        run_of("rk4", error, s) for error, s in ((3 * TARGET_ERROR, 0.1), (TARGET_ERROR, 0.2), (1e-9, 0.3))
    )
    rival, unstable = run_of("diffrax Tsit5", 1e-9, 0.01), run_of("midpoint", 1e-9, 0.01)
    projected = good._replace(method="rk4, projected", treatment="projected", seconds=0.01)
    adaptive = good._replace(method="adaptive rk4", adaptive=True, dt=None, seconds=0.01)
    assert of("projectile", coarse, rival, unstable, projected, adaptive, finer, good).run is good
    assert of("projectile", coarse, rival, run_of("verlet", 0.5, 0.01)).run is coarse
    studied = of("projectile", good)
    assert studied.stepping["dt"] * 64 == studied.problem.duration
    assert studied.stepping["save_every"] * studied.problem.frames == 64
