"""The interactive page of a run in the plane holds its bodies, angles and surfaces, and needs no program but its own."""

import base64
import dataclasses
import json
import re
import zlib

import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, animate, contacts, inertia, methods, rigid, simulate
from physjax.show import flat_page
from physjax.show.flat_page import CONTOUR_POINTS, HALF_TURN_STEPS, ROOM_SHARE
from physjax.show.frames import take_lanes
from physjax.show.panels import build_scenery

SHAPES = (rigid.PlanarShape.box((2.0, 1.0)), rigid.PlanarShape.disc(0.5), rigid.PlanarShape.disc(0.5))
DISC = inertia.planar_disc(1.0, 0.5)
BODIES = rigid.planar_bodies(
    DISC, [[0.0, 1.0], [3.0, 1.0], [6.0, 1.0]], angle=[1.5, 0.0, -3.0], angular_velocity=[9.0, 0.0, -9.0]
)
RUN = simulate(Scene(BODIES, DISC), methods.verlet, dt=0.1, steps=10)
SOLIDS = rigid.Solids(SHAPES, surfaces=(contacts.Plane((0.0, 0.0), (0.0, 1.0)),))
FILM = dataclasses.replace(RUN, scene=Scene(BODIES, DISC, contacts=(SOLIDS,)))  # none of them touch


def read(view):
    """What the page's program reads."""
    return json.loads(re.search(r'<script type="application/json" id="film">(.*?)</script>', view.page(), re.S)[1])


def unpack(text, width):
    """As the browser does it: inflate, then add the differences up, which wrap around."""
    steps = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.int16).reshape(-1, width)
    return np.cumsum(steps, axis=0, dtype=np.int16)


def test_bodies_are_sent_with_places_angles_shapes_and_colours():
    view = animate.view(FILM)
    film, part = read(view), read(view)["part"]
    assert (part["kind"], part["nodes"], part["shape"], len(part["shapes"])) == ("bodies", 3, [0, 1, 1], 2)
    assert len({*part["colors"], *part["edges"]}) == 6
    low, high = np.array(film["reach"])
    place = (low + high) / 2 + unpack(part["places"], 6).reshape(-1, 3, 2) / 32767 * (high - low) / 2
    np.testing.assert_allclose(place, np.asarray(RUN.position)[film["frames"]], atol=1e-3)
    angle = unpack(part["angles"], 3) / HALF_TURN_STEPS * np.pi
    turn = np.exp(1j * (angle - np.asarray(RUN.state.angle)[film["frames"]]))
    np.testing.assert_allclose(turn, 1.0, atol=2e-4)  # whole turns do not matter
    mark = np.array(part["shapes"][1]["mark"])
    np.testing.assert_allclose(mark, [[0.0, 0.0], [0.5, 0.0]])
    np.testing.assert_allclose(part["shapes"][0]["corners"], SHAPES[0].corners)


def test_a_floor_is_a_line_of_two_points_as_wide_as_a_window_may_be():
    film = read(animate.view(FILM))
    (state,) = film["obstacles"][0]["states"]
    (edge,) = state["edges"]
    size = np.ptp([film["low"], film["high"]], axis=0).max()
    assert len(edge) == 2
    np.testing.assert_allclose(np.array(edge)[:, 1], 0.0, atol=1e-3 * size)
    np.testing.assert_allclose(np.ptp(edge, axis=0)[0], 2 * ROOM_SHARE * size, rtol=1e-6)
    assert len(state["areas"]) == 1


def test_surfaces_that_move_are_sent_as_they_are_at_each_frame_and_round_ones_are_round():
    lift = contacts.Plane((0.0, -1.0), (0.0, 1.0), velocity=(0.0, 0.3))
    ball = contacts.Sphere((2.0, 0.0), 0.5)
    still = Particles(jnp.array([[-1.0, 0.0], [1.0, 2.0]]), jnp.zeros((2, 2)))
    run = simulate(Scene(still), methods.verlet, dt=0.1, steps=4)
    run = dataclasses.replace(run, scene=Scene(still, contacts=(lift, ball)))  # which it does not touch
    film = read(animate.view(run, fps=10))
    assert (film["part"]["kind"], film["part"]["paths"]) == ("dots", True)
    rising, round_one = (obstacle["states"] for obstacle in film["obstacles"])
    assert [state["frame"] for state in rising] == [0, 1, 2, 3, 4]
    heights = [np.mean(np.array(state["edges"][0])[:, 1]) for state in rising]
    np.testing.assert_allclose(heights, -1.0 + 0.3 * np.arange(5) * 0.1, atol=1e-3)
    assert len(round_one) == 1
    radius = np.hypot(*(np.array(round_one[0]["edges"][0]) - [2.0, 0.0]).T)
    assert len(radius) < CONTOUR_POINTS / 3
    np.testing.assert_allclose(radius, 0.5, rtol=5e-3)


def drive(t):
    return 3.0 * t


@pytest.mark.parametrize(
    "moved",
    [{"motion": contacts.Motion(angle=drive, pivot=(0.3, 0.2))}, {"velocity": (0.5, 0.2)}],
    ids=["turns", "slides"],
)
def test_a_driven_surface_is_found_once_and_placed_where_it_would_be_found(moved, monkeypatch):
    room = contacts.Room((-1.0, -1.0), (1.0, 2.0), **moved)
    still = Particles(jnp.array([[-0.5, 0.0], [0.5, 0.5]]), jnp.zeros((2, 2)))
    run = simulate(Scene(still), methods.verlet, dt=0.1, steps=2)
    run = dataclasses.replace(run, scene=Scene(still, contacts=(room,)))  # which it does not touch
    scenery, calls, trace = build_scenery(take_lanes("test", run, (2,)), [0, 1, 2]), [], flat_page._trace_contours
    monkeypatch.setattr(flat_page, "_trace_contours", lambda *args: calls.append(args) or trace(*args))
    placed = flat_page.describe_flat_obstacle(room, scenery, [0, 1, 2], points=61)["states"]
    assert len(calls) == 1
    monkeypatch.setattr(flat_page, "_drive_contours", lambda *args: None)
    found = flat_page.describe_flat_obstacle(room, scenery, [0, 1, 2], points=61)["states"]
    assert len(calls) == 4
    for number, (one, other) in enumerate(zip(placed, found, strict=True)):
        assert one["frame"] == other["frame"] == number
        assert len(one["areas"]) == len(other["areas"]) > 0
        for state in (one, other):
            edge = np.concatenate([np.array(line) for line in state["edges"]])
            distance = room.signed_distance(jnp.asarray(0.1 * number), jnp.asarray(edge))
            assert float(jnp.abs(distance).max()) < 0.05  # corners are cut off by a cell


def test_springs_and_bodies_without_a_shape_are_seen_as_well(ruin):
    run, bridge = ruin
    assert read(animate.view(run, bridge))["part"]["kind"] == "lines"
    part = read(animate.view(RUN))["part"]
    assert (part["kind"], part["shape"]) == ("bodies", [0, 0, 0])
    angle = unpack(part["angles"], 3)[0] / HALF_TURN_STEPS * np.pi
    np.testing.assert_allclose(angle, BODIES.angle, atol=1e-3)


def test_the_page_fetches_nothing_and_is_small(tmp_path):
    page = animate.view(FILM).save(tmp_path / "page.html").read_text(encoding="utf-8")
    assert not re.search(r"://|__[A-Z]+__|<link|src=|import\(|THREE", page)
    assert len(page) < 30_000


def test_colours_and_shapes_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="got 2 shapes"):
        animate.view(FILM, SHAPES[:2])
    with pytest.raises(ValueError, match="expected a colour or a finite number"):
        animate.view(FILM, color=[1.0, 2.0])
