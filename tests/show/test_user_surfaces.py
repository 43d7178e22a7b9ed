"""A shape of a user's own, which gives a signed distance and nothing else, is drawn wherever one of ours is."""

import base64
import json
import re
import zlib

import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, animate, contacts, forces, lattices, methods, plot, quantity, simulate
from physjax.show import level_sets, obstacles, outlines
from physjax.show.page_data import QUANTISATION_STEPS
from physjax.show.stage import Stage

BOX = Stage(np.array([-1.0, -0.5, -1.0]), np.array([1.0, 1.0, 1.0]))


class SineHill(contacts.Surface):
    def signed_distance(self, t, position):
        slope = 0.5 * jnp.cos(position[..., 0])
        return (position[..., 1] - 0.5 * jnp.sin(position[..., 0])) / jnp.sqrt(1 + slope * slope)


class Torus(contacts.Surface):
    tube: jnp.ndarray = quantity("radius of the tube", "m", above=0)

    def signed_distance(self, t, position):
        x, y, z = (position[..., i] for i in range(3))
        return jnp.sqrt((jnp.sqrt(x * x + z * z) - 0.5) ** 2 + y * y) - self.tube


class Bowl(contacts.Surface):
    def signed_distance(self, t, position):
        x, y, z = (position[..., i] for i in range(3))
        return y - 0.5 * (x * x + z * z)


class Waves(contacts.Surface):
    def signed_distance(self, t, position):
        return position[..., 1] - 0.2 * jnp.sin(2 * position[..., 0] - 3 * t)


TORUS = Torus(0.2)


def draped(surface):
    """A film of two frames of a cloth above a surface."""
    sheet = lattices.cloth(1.4, 1.4, 4, 4, mass=0.1, structural=1.0, corner=(-0.7, 0.6, -0.7), down=(0, 0, 1))
    scene = Scene(sheet.state, sheet.mass, (sheet.springs,), (surface,))
    return simulate(scene, methods.semi_implicit_euler, dt=1e-3, steps=1), sheet


def read_page(view):
    page = re.search(r'<script type="application/json" id="film">(.*?)</script>', view.page(), re.S)[1]
    return json.loads(page)


# the level set


def test_a_torus_is_closed_lies_on_its_level_set_and_faces_outwards():
    vertices, faces = level_sets.extract_level_set(TORUS, BOX, 0.0, 32)
    np.testing.assert_allclose(level_sets.evaluate_distance(TORUS, 0.0, vertices), 0.0, atol=1e-9)
    assert len(vertices) == len(faces)  # V - E + F = 0, as each quadrilateral has two edges of its own
    patches = vertices[faces]
    across = np.cross(patches[:, 2] - patches[:, 0], patches[:, 3] - patches[:, 1])
    area = np.linalg.norm(across, axis=1).sum() / 2
    assert area == pytest.approx(4 * np.pi**2 * 0.5 * 0.2, rel=0.02)
    middle = patches.mean(axis=1)
    outside = level_sets.evaluate_distance(TORUS, 0.0, middle + 0.02 * across / np.linalg.norm(across, axis=1)[:, None])
    assert (outside > 0).all()


def test_a_surface_that_leaves_the_box_is_cut_where_the_box_ends():
    outline = outlines.build_outline(Bowl(), BOX, 0.0)
    corners = np.concatenate(list(outline.polygons))
    assert ((corners >= BOX.low - 1e-12) & (corners <= BOX.high + 1e-12)).all()
    np.testing.assert_allclose([corners.min(axis=0), corners.max(axis=0)], [[-1, 0, -1], [1, 1, 1]], atol=5e-3)
    assert (outline.normals[:, 1] > 0).all()  # towards the legal side


def test_what_is_solid_and_what_belongs_into_the_picture_follow_from_the_distance():
    assert level_sets.is_bounded(TORUS, BOX, 0.0)
    assert not level_sets.is_bounded(Bowl(), BOX, 0.0)
    low, high = level_sets.find_corners(TORUS, BOX, 0.0)
    np.testing.assert_allclose([low, high], [[-0.7, -0.2, -0.7], [0.7, 0.2, 0.7]], atol=0.02)
    above = BOX._replace(low=np.array([-1.0, 0.3, -1.0]), high=np.array([1.0, 2.0, 1.0]))
    (foot,) = level_sets.find_corners(Waves(), above, 0.0)
    np.testing.assert_allclose(level_sets.evaluate_distance(Waves(), 0.0, foot[None]), 0.0, atol=1e-9)
    assert level_sets.find_corners(Waves(), above._replace(low=np.array([-1.0, 1.3, -1.0])), 0.0) == []


def test_whether_a_surface_moves_follows_from_the_distance():
    times = np.linspace(0.0, 1.0, 11)
    assert level_sets.moves(Waves(), BOX, times)
    assert not level_sets.moves(TORUS, BOX, times)
    piston, belt = (contacts.Plane((0, 0, 0), (0, 1, 0), velocity=v) for v in ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0)))
    assert level_sets.moves(piston, BOX, times)
    assert not level_sets.moves(belt, BOX, times)  # it moves along itself


def test_surfaces_that_differ_from_lane_to_lane_are_left_out_and_a_mistake_is_not_hidden():
    several = Torus(np.array([0.1, 0.2]))
    bounces = Torus(0.2, restitution=np.array([0.1, 0.2]))
    assert obstacles.select_shared_surfaces((several, bounces, TORUS)) == (bounces, TORUS)

    class Mistake(contacts.Surface):
        def signed_distance(self, t, position):
            return position[..., 1] - jnp.ones(7)[:, None] @ position

    with pytest.raises((TypeError, ValueError)):
        obstacles.select_shared_surfaces((Mistake(),))


def test_a_subclass_with_a_distance_of_its_own_is_drawn_from_that():
    class Dune(contacts.Plane):
        def signed_distance(self, t, position):
            return position[..., 1] - 0.2 * jnp.cos(3 * position[..., 0])

    assert outlines.build_outline(contacts.Plane((0, 0, 0), (0, 1, 0)), BOX, 0.0).normals is None
    corners = np.concatenate(list(outlines.build_outline(Dune((0, 0, 0), (0, 1, 0)), BOX, 0.0).polygons))
    np.testing.assert_allclose(corners[:, 1], 0.2 * np.cos(3 * corners[:, 0]), atol=5e-3)


# pictures


def test_a_hill_in_the_plane_is_drawn_where_it_is():
    ball = Particles(jnp.array([[0.0, 2.0], [3.0, 2.5]]), jnp.array([[1.0, 0.0], [0.5, 0.0]]))
    hill = SineHill(response=contacts.project)
    run = simulate(Scene(ball, forces=(forces.Gravity(),), contacts=(hill,)), methods.verlet, dt=0.05, steps=20)
    _wrong_side, edge, _trail, _dots = animate.paths(run).still(-1).axes[0].collections
    x, y = np.concatenate([path.vertices for path in edge.get_paths()]).T
    np.testing.assert_allclose(y, 0.5 * np.sin(x), atol=1e-3)
    assert np.ptp(x) > 2.0


def test_a_solid_shape_hides_the_cloth_behind_it_and_a_bowl_hides_nothing():
    film, sheet = draped(TORUS)
    ax = plot.cloth(film, sheet, 0).axes[0]
    assert [c.get_zorder() for c in ax.collections].count(3) == 1
    solids = obstacles.find_solids(BOX, (TORUS, Bowl()), 0.0)
    assert len(solids) == 1
    up, turn = np.radians([ax.elev, ax.azim])
    eye = np.array([np.cos(up) * np.sin(turn), np.sin(up), np.cos(up) * np.cos(turn)])
    ring = np.array([0.5, 0.0, 0.0])
    points = np.array([ring - 0.3 * eye, ring + 0.3 * eye, [0.0, 0.3, 0.0]])
    assert obstacles.find_hidden(solids, points, ax).tolist() == [True, False, False]
    film, sheet = draped(Bowl())
    assert [c.get_zorder() for c in plot.cloth(film, sheet, 0).axes[0].collections] == [0, 4]


def test_the_page_holds_the_shape_and_every_shape_of_one_that_moves():
    film, sheet = draped(TORUS)
    content = read_page(animate.view(film, sheet, fps=10, speed=0.01))
    (what,) = content["obstacles"]
    assert (what["kind"], what["solid"], len(what["states"])) == ("mesh", True, 1)
    vertices = unpack_places(content, what["states"][0])
    step = (np.ptp(content["reach"], axis=0) / 2 / QUANTISATION_STEPS).max()
    np.testing.assert_allclose(level_sets.evaluate_distance(TORUS, 0.0, vertices), 0.0, atol=2 * step)
    drops = Particles(jnp.array([[0.0, 1.0, 0.0], [0.5, 1.0, 1.0]]), jnp.zeros((2, 3)))
    scene = Scene(drops, forces=(forces.Gravity(),), contacts=(Waves(response=contacts.project),))
    content = read_page(animate.view(simulate(scene, methods.verlet, dt=0.1, steps=5), fps=10))
    (what,) = content["obstacles"]
    assert [state["frame"] for state in what["states"]] == [0, 1, 2, 3, 4, 5]
    assert not what["solid"]
    for state in what["states"][::5]:
        x, y, _ = unpack_places(content, state).T
        np.testing.assert_allclose(y, 0.2 * np.sin(2 * x - 3 * content["time"][state["frame"]]), atol=0.01)


def unpack_places(content, state):
    steps = np.frombuffer(zlib.decompress(base64.b64decode(state["places"])), np.int16).reshape(-1, 3)
    low, high = np.array(content["reach"])
    share = np.cumsum(steps, axis=0, dtype=np.int16) / QUANTISATION_STEPS
    return (low + high) / 2 + share * (high - low) / 2
