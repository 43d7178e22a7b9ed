"""Rods and ropes between bodies are lines from point to point, as the bodies move and turn, and until they break."""

import base64
import dataclasses
import json
import re
import struct
import zlib

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.colors import to_rgba

from physjax import Scene, animate, export, inertia, methods, plot, rigid, simulate
from physjax.show.links import find_links
from physjax.show.surfaces import find_covered_points

DISC, BALL = inertia.planar_disc(1.0, 0.5), inertia.sphere(1.0, 0.5)
FLAT = simulate(
    Scene(rigid.planar_bodies(DISC, [[0.0, 0.0], [3.0, 0.0]], angular_velocity=[np.pi / 2, 0.0]), DISC),
    methods.verlet,
    dt=0.25,
    steps=4,
)
SPACE = simulate(
    Scene(
        rigid.bodies(BALL, [[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]], angular_velocity=[[0.0, 0.0, np.pi / 2], [0.0] * 3]),
        BALL,
    ),
    methods.verlet,
    dt=0.25,
    steps=4,
)


def tie(run, *links, solids=()):
    """The run as one of a scene with links, which do not pull; of those that can break the last does after two frames."""
    scene = Scene(run.scene.state, run.scene.mass, links, contacts=solids)
    held = jnp.ones((len(run.time), *run.scene.state.lanes[:-1], len(links[-1].pairs)), bool).at[2:, ..., -1].set(False)
    parts = tuple(eqx.tree_at(lambda part: part.unbroken, part, held) for part in scene.forces if part.remembers)
    return dataclasses.replace(run, scene=scene, parts=parts)


def add_depth(points):
    return [[[*point, 0.0] for point in pair] for pair in points]


RODS = [(0, 1), (-1, 0)], [[[0.5, 0.0], [-0.5, 0.0]], [[0.0, 2.0], [0.0, 0.5]]]
TIED = tie(FLAT, rigid.Rods(*RODS), rigid.Ropes([(0, 1)], [[[0.0, 0.0], [0.0, 0.0]]], length=9.0, breaks_at=1.0))
HUNG = tie(
    SPACE,
    rigid.Rods(RODS[0], add_depth(RODS[1])),
    rigid.Ropes([(0, 1)], [[[0.0] * 3, [0.0] * 3]], length=9.0, breaks_at=1.0),
)
WAYS = np.array([[[0.5, 0.0], [2.5, 0.0]], [[0.0, 2.0], [0.0, 0.5]], [[0.0, 0.0], [3.0, 0.0]]])
"""At the start; at the end, after a quarter turn, the two points of the first body are elsewhere."""
TURNED = np.array([[[0.0, 0.5], [2.5, 0.0]], [[0.0, 2.0], [-0.5, 0.0]], [[0.0, 0.0], [3.0, 0.0]]])


@pytest.mark.parametrize("film", [TIED, HUNG])
def test_lines_go_from_point_to_point_of_bodies_that_turn(film):
    links = find_links(film)
    np.testing.assert_allclose(links.ends[0, ..., :2], WAYS, atol=1e-9)
    np.testing.assert_allclose(links.ends[-1, ..., :2], TURNED, atol=1e-9)
    np.testing.assert_array_equal(links.held[:, :2], True)
    np.testing.assert_array_equal(links.held[:, 2], [True, True, False, False, False])
    assert find_links(FLAT) is None


def test_worlds_side_by_side_have_lines_of_their_own():
    worlds = rigid.planar_bodies(DISC, [[[0.0, 0.0], [3.0, 0.0]], [[0.0, 5.0], [3.0, 5.0]]])
    run = simulate(Scene(worlds, DISC), methods.verlet, dt=0.1, steps=1)
    rope = rigid.Ropes([(0, 1)], [[[0.5, 0.0], [-0.5, 0.0]]], length=9.0, breaks_at=1.0)
    links = find_links(tie(run, rope))
    np.testing.assert_allclose(links.ends[0], [[[0.5, 0.0], [2.5, 0.0]], [[0.5, 5.0], [2.5, 5.0]]])
    assert links.held.shape == (2, 2)


def test_in_the_plane_they_are_in_front_of_bodies_and_dashed_where_broken():
    before, after = plot.bodies(TIED, frames=[0, -1]).axes
    assert before.get_ylim()[1] > 2.0  # the point of the world from which the first one hangs
    lines = before.collections[-1]
    np.testing.assert_allclose([path.vertices for path in lines.get_paths()], WAYS, atol=1e-9)
    assert lines.get_zorder() > max(part.get_zorder() for part in before.collections[:-1])
    whole, broken = after.collections[-2:]
    assert (len(whole.get_paths()), len(broken.get_paths())) == (2, 1)
    assert broken.get_linestyle()[0][1] is not None
    np.testing.assert_allclose(broken.get_color(), [to_rgba("0.75")])


def test_in_space_bodies_hide_what_is_behind_them_and_in_them():
    shapes = rigid.Solids(rigid.Shape.sphere(0.5))
    film = tie(SPACE, rigid.Rods([(0, 1)], [[[0.0] * 3, [0.0] * 3]]), solids=(shapes,))
    ax = plot.bodies(film, frames=0).axes[0]
    (lines,) = (part for part in ax.collections if part.get_zorder() == 5)
    ((start, end),) = lines._segments3d  # one line, from ball to ball
    np.testing.assert_allclose([*start, *end], [0.5, 0.0, 0.0, 2.5, 0.0, 0.0], atol=0.2)
    triangle = np.array([[[-5.0, -5.0, 0.0], [5.0, -5.0, 0.0], [0.0, 5.0, 0.0]]])
    assert find_covered_points(
        np.array([[0.0, 0.0, -0.1], [0.0, 0.0, 0.1], [9.0, 0.0, -0.1]]), triangle, ax
    ).tolist() == [
        True,
        False,
        False,
    ]


@pytest.mark.parametrize("film", [TIED, HUNG])
def test_the_page_has_the_lines_of_every_frame(film):
    page = animate.view(film, fps=4.0).page()
    data = json.loads(re.search(r'<script type="application/json" id="film">(.*?)</script>', page, re.S)[1])
    links, dim = data["part"]["links"], len(data["low"])
    unpack = lambda text, dtype: np.frombuffer(zlib.decompress(base64.b64decode(text)), dtype)  # noqa: E731
    steps = unpack(links["places"], np.int16).reshape(5, links["nodes"], dim)
    low, high = np.array(data["reach"])
    places = (low + high) / 2 + np.cumsum(steps, axis=0, dtype=np.int16) / 32767 * (high - low) / 2
    np.testing.assert_allclose(places.reshape(5, 3, 2, dim), find_links(film).ends, atol=1e-4)
    held = np.cumsum(unpack(links["held"], np.uint8).reshape(5, 3), axis=0, dtype=np.uint8)
    np.testing.assert_array_equal(held, find_links(film).held)


@pytest.mark.parametrize("film", [TIED, HUNG])
def test_a_gltf_file_puts_turns_and_stretches_one_line_for_each(film, tmp_path):
    code = export.gltf(film, tmp_path / "tied.glb", fps=4.0, progress=False).read_bytes()
    (length,) = struct.unpack_from("<I", code, 12)
    content, binary = json.loads(code[20 : 20 + length]), code[28 + length :]

    def read(number):
        accessor = content["accessors"][number]
        start = content["bufferViews"][accessor["bufferView"]]["byteOffset"]
        width = {"VEC3": 3, "VEC4": 4}[accessor["type"]]
        return np.frombuffer(binary, "<f4", accessor["count"] * width, start).reshape(-1, width)

    animation, links = content["animations"][0], find_links(film)
    paths = {
        (channel["target"]["node"], channel["target"]["path"]): read(
            animation["samplers"][channel["sampler"]]["output"]
        )
        for channel in animation["channels"]
    }
    for link in range(3):
        node = next(i for i, node in enumerate(content["nodes"]) if node.get("name") == f"link {link}")
        start, turn, scale = (paths[node, path] for path in ("translation", "rotation", "scale"))
        x, y, z, w = turn.T
        along = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)], axis=-1)
        ends = np.pad(links.ends, [(0, 0)] * 3 + [(0, 3 - links.ends.shape[-1])])[:, link]
        shown = np.where(links.held[:, link, None], ends[:, 1], ends[:, 0])  # a broken one has no length
        np.testing.assert_allclose(start, ends[:, 0], atol=1e-6)
        np.testing.assert_allclose(start + scale[:, :1] * along, shown, atol=1e-6)


def test_ply_files_have_the_lines_that_are_intact_as_edges(tmp_path):
    files = export.ply(HUNG, tmp_path / "hung", rigid.Shape.box((1.0, 1.0, 1.0)), fps=4.0, progress=False)
    for file, count in zip(files, [3, 3, 2, 2, 2], strict=True):
        header, _, body = file.read_bytes().partition(b"end_header\n")
        assert b"element vertex 22\n" in header  # two boxes and six ends
        assert f"element edge {count}\n".encode() in header
        edges = np.frombuffer(body[-8 * count :], "<i4").reshape(-1, 2)
        np.testing.assert_array_equal(edges, np.arange(16, 16 + 2 * count).reshape(-1, 2))
    places = np.frombuffer(body[: 12 * 22], "<f4").reshape(-1, 3)
    np.testing.assert_allclose(places[16:], find_links(HUNG).ends[-1].reshape(-1, 3), atol=1e-6)
