"""The numbers of the gallery's scenes: each has a unit and a range, and what makes no sense is refused by name."""

import jax
import pytest

from physjax import scenes
from physjax.scenes.parameters import BOUNDS, OWN_RANGES, OWN_UNITS, read_parameters

NUMBERS = [(name, p) for name, build in scenes.SCENES.items() for p in read_parameters(build)]


def test_every_number_is_listed_once_and_every_listed_one_is_used():
    assert {p.name for _, p in NUMBERS} - {"angles"} == set(BOUNDS)
    used = {f"{name}.{p.name}" for name, p in NUMBERS}
    assert set(OWN_RANGES) | set(OWN_UNITS) <= used


def test_defaults_are_inside_of_their_ranges():
    for name, p in NUMBERS:
        if p.low is not None:
            assert p.low <= p.default <= p.high, name
            assert p.low < p.high, name


@pytest.mark.slow
@pytest.mark.parametrize("name", ["comet", "heavy_rope", "kepler", "projectile"])
def test_a_scene_can_be_built_at_the_ends_of_its_ranges(name):
    build = scenes.SCENES[name]
    with jax.enable_x64(True):
        for p in read_parameters(build):
            for end in (p.low, p.high):
                assert end is None or build(**{p.name: end}).duration > 0


@pytest.mark.parametrize(
    ("name", "numbers", "error", "words"),
    [
        ("kepler", {"eccentricity": 1.5}, ValueError, "kepler: eccentricity: got 1.5, expected from 0 to 0.999"),
        ("projectile", {"g": 0}, ValueError, r"projectile: g \[m/s²\]: got 0, expected from 0.1 to 100, e.g. g=9.8"),
        ("projectile", {"speed": float("nan")}, ValueError, "got nan"),
        ("projectile", {"speed": "fast"}, TypeError, "expected a number, e.g. speed=30.0"),
        ("projectile", {"velocity": 3.0}, TypeError, "expected one of its own: speed, angle, g"),
        ("flag", {"rows": 2.5}, TypeError, "expected a whole number, e.g. rows=6"),
        ("hanging_rope", {"span": 2.0}, ValueError, "expected a rope longer than its span"),
        ("heavy_top", {"spin": 10.0}, ValueError, "too slow to hold the top up"),
    ],
)
def test_a_number_that_makes_no_sense_is_refused_in_a_sentence(name, numbers, error, words):
    with pytest.raises(error, match=words):
        scenes.SCENES[name](**numbers)
