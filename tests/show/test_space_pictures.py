"""Bodies in space that may not pass each other are drawn as their shapes, in many colours, in front of their surfaces."""

import dataclasses
import json
import re

import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Scene, animate, contacts, export, inertia, methods, plot, rigid, simulate
from physjax.show import auto_plot, solids
from physjax.show.bodies import check_shapes, choose_body_colours
from physjax.show.drawables import choose_drawable
from physjax.show.planar import find_planar_shapes

SHAPES = (
    rigid.Shape.sphere(0.5),
    rigid.Shape.capsule(0.2, 1.0, axis=0),
    rigid.Shape.box((1.0, 2.0, 3.0)),
    rigid.Shape.sphere(0.5),
)
BALL = inertia.sphere(1.0, 0.5)
START = rigid.bodies(BALL, [[0.0, 4.0, 0.0], [3.0, 4.0, 0.0], [6.0, 4.0, 0.0], [9.0, 4.0, 0.0]])
FLOOR = contacts.Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
FREE = simulate(Scene(START, BALL), methods.verlet, dt=0.1, steps=4)


def give_solids(run, shapes, surfaces=(FLOOR,)):
    """The run as one of a scene with solids, which are not compiled: none of its bodies touch."""
    scene = Scene(run.scene.state, BALL, contacts=(rigid.Solids(shapes, surfaces=surfaces),))
    return dataclasses.replace(run, scene=scene)


FILM = give_solids(FREE, SHAPES)


@pytest.mark.parametrize(
    ("shape", "extent", "faces"),
    [
        (rigid.Shape.sphere(0.5), (1.0, 1.0, 1.0), len(solids.sphere(0.5).faces)),
        (rigid.Shape.capsule(0.2, 1.0, axis=0), (1.4, 0.4, 0.4), len(solids.capsule(0.2, 1.0).faces)),
        (rigid.Shape.capsule(0.2, 1.0, axis=1), (0.4, 1.4, 0.4), len(solids.capsule(0.2, 1.0).faces)),
        (rigid.Shape.capsule(0.2, 1.0), (0.4, 0.4, 1.4), len(solids.capsule(0.2, 1.0).faces)),
        (rigid.Shape.box((1.0, 2.0, 3.0)), (1.0, 2.0, 3.0), 12),
    ],
)
def test_a_shape_of_a_scene_is_drawn_as_large_as_it_is_and_along_its_axis(shape, extent, faces):
    drawn = solids.triangulate_shape(shape)
    np.testing.assert_allclose(np.ptp(drawn.vertices, axis=0), extent, rtol=1e-6)
    assert len(drawn.faces) == faces


def test_each_body_is_drawn_as_the_shape_that_keeps_it_apart():
    _, _, found = check_shapes("plot.bodies", FILM, None)
    extents = [np.ptp(shape.vertices, axis=0) for shape in found]
    np.testing.assert_allclose(extents, [[1, 1, 1], [1.4, 0.4, 0.4], [1, 2, 3], [1, 1, 1]], rtol=1e-6)
    # without solids they are boxes of their inertia
    assert all(len(shape.faces) == 12 for shape in check_shapes("plot.bodies", FREE, None)[2])
    own = check_shapes("plot.bodies", FREE, rigid.Shape.capsule(0.2, 1.0))[2]
    np.testing.assert_allclose([np.ptp(shape.vertices, axis=0) for shape in own], [[0.4, 0.4, 1.4]] * 4, rtol=1e-6)


def test_worlds_side_by_side_each_have_all_shapes():
    worlds = rigid.bodies(BALL, jnp.arange(24.0).reshape(2, 4, 3))
    run = give_solids(simulate(Scene(worlds, BALL), methods.verlet, dt=0.1, steps=1), SHAPES)
    found = check_shapes("plot.bodies", run, None)[2]
    assert [len(shape.faces) for shape in found] == 2 * [len(solids.triangulate_shape(s).faces) for s in SHAPES]


def test_bodies_have_many_colours_and_their_surfaces_are_behind_them():
    (ax,) = plot.bodies(FILM, frames=0).axes
    assert ax.get_ylim()[0] < 0 < ax.get_ylim()[1]  # the floor, 4 m below them
    glass, far, near = (next(c for c in ax.collections if c.get_zorder() == order) for order in (0, 1, 4))
    assert len(glass.get_facecolor()) == 1
    hues = {tuple(np.round(c[:3] / c[:3].max(), 6)) for part in (far, near) for c in part.get_facecolor()}
    assert len(hues) == 4
    assert len({tuple(c) for c in choose_body_colours("plot.bodies", FREE, None, 4)}) == 1
    assert len({tuple(c) for c in choose_body_colours("plot.bodies", FILM, "red", 4)}) == 1


def test_a_run_draws_itself_is_filmed_and_exported(tmp_path):
    assert len(auto_plot.plot_run(FILM).axes) == 1
    assert auto_plot.animate_run(FILM).save(tmp_path / "solids.html", progress=False).stat().st_size > 1000
    path = export.gltf(FILM, tmp_path / "solids.glb", progress=False)
    code = path.read_bytes()
    content = json.loads(code[20 : 20 + int.from_bytes(code[12:16], "little")])
    assert len(content["materials"]) == len(content["nodes"]) == len(content["meshes"]) == 4
    both = [mesh["primitives"][0]["attributes"]["POSITION"] for mesh in content["meshes"]]
    assert both[0] == both[3]  # two balls of one size share their vertices


def test_the_page_has_each_shape_once_and_a_colour_for_each_body():
    page = animate.view(FILM).page()
    film = json.loads(re.search(r'<script type="application/json" id="film">(.*?)</script>', page, re.S)[1])
    part = film["part"]
    assert (part["kind"], part["shape"], len(part["shapes"])) == ("bodies", [0, 1, 2, 0], 3)
    assert len(set(part["colors"])) == 4
    assert [what["kind"] for what in film["obstacles"]] == ["sheets"]
    assert "links" not in part


def test_shapes_in_space_are_none_of_the_plane():
    assert find_planar_shapes(FILM) is None
    assert len(choose_drawable("animate.view", FILM, None).shapes) == 4
