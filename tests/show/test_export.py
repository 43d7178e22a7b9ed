"""What is written for other programs is read back by one of them, and by hand, with the same numbers."""

import json
import struct

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from physjax import Particles, Scene, export, forces, inertia, methods, rigid, simulate
from physjax.show import solids


def parsed(path):
    """The JSON of a .glb file, and a function from the number of an accessor to its array."""
    data = path.read_bytes()
    magic, version, size = struct.unpack_from("<4sII", data)
    assert (magic, version, size) == (b"glTF", 2, len(data))
    length, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    content = json.loads(data[20 : 20 + length])
    _, kind = struct.unpack_from("<I4s", data, 20 + length)
    assert kind == b"BIN\0"
    binary = data[28 + length :]

    def array(number):
        accessor = content["accessors"][number]
        view = content["bufferViews"][accessor["bufferView"]]
        dtype = {5126: "<f4", 5125: "<u4"}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        found = np.frombuffer(binary, dtype, accessor["count"] * width, view["byteOffset"]).reshape(-1, width)
        assert found.nbytes == view["byteLength"]
        np.testing.assert_array_equal(found.min(axis=0), np.asarray(accessor["min"], dtype))
        np.testing.assert_array_equal(found.max(axis=0), np.asarray(accessor["max"], dtype))
        return found

    return content, array


def played(content, array):
    """Positions of the only mesh at each key of its animation, `(frames, nodes, 3)`, and the keys [s]."""
    (primitive,) = content["meshes"][0]["primitives"]
    (channel,) = content["animations"][0]["channels"]
    sampler = content["animations"][0]["samplers"][channel["sampler"]]
    assert channel["target"] == {"node": 0, "path": "weights"}
    times = array(sampler["input"]).ravel()
    weights = array(sampler["output"]).reshape(len(times), -1)
    targets = np.stack([array(target["POSITION"]) for target in primitive["targets"]])
    return array(primitive["attributes"]["POSITION"]) + np.einsum("ft,tni->fni", weights, targets), times


def test_a_cloth_goes_through_its_frames(drape, tmp_path):
    run, sheet = drape
    path = export.gltf(run, tmp_path / "drape.glb", sheet, progress=False)
    content, array = parsed(path)
    places, times = played(content, array)
    np.testing.assert_allclose(places, run.position, atol=2e-7)
    np.testing.assert_allclose(times, run.time, atol=1e-6)
    (mesh,) = trimesh.load_scene(path, process=False).geometry.values()
    np.testing.assert_allclose(mesh.vertices, run.position[0], atol=1e-7)
    np.testing.assert_array_equal(mesh.faces, sheet.faces)
    assert [file.name for file in tmp_path.iterdir()] == ["drape.glb"]


def test_bodies_move_and_turn_the_short_way(tmp_path):
    brick = inertia.box(2.0, (0.1, 0.2, 0.3))
    start = rigid.bodies(brick, [[0.0, 0, 0], [1, 2, 3]], angular_velocity=[[1.0, 20, 3], [0, 0, 25]])
    run = simulate(Scene(start, brick, (forces.Gravity(),)), methods.rk4, dt=0.01, steps=60)
    shapes = [solids.box((0.1, 0.2, 0.3)), solids.sphere(0.1)]
    path = export.gltf(run, tmp_path / "bodies.glb", shapes, fps=100, speed=0.5, progress=False)
    content, array = parsed(path)
    samplers = content["animations"][0]["samplers"]
    for channel in content["animations"][0]["channels"]:
        sampler = samplers[channel["sampler"]]
        body = channel["target"]["node"]
        np.testing.assert_allclose(array(sampler["input"]).ravel(), np.asarray(run.time) / 0.5, atol=1e-6)
        values = array(sampler["output"])
        if channel["target"]["path"] == "translation":
            np.testing.assert_allclose(values, run.position[:, body], atol=1e-6)
            continue
        q = np.asarray(run.state.orientation)[:, body][:, [1, 2, 3, 0]]
        np.testing.assert_allclose(np.abs(np.sum(values * q, axis=-1)), 1.0, atol=1e-6)
        assert (np.sum(values[1:] * values[:-1], axis=-1) > 0.9).all()
    loaded = trimesh.load_scene(path, process=False)
    assert len(loaded.geometry) == 2
    matrix, _ = loaded.graph["body 1"]
    np.testing.assert_allclose(matrix[:3, 3], [1, 2, 3], atol=1e-6)


def test_equal_shapes_are_written_once(tmp_path):
    ball = inertia.sphere(1.0, 0.1)
    run = simulate(Scene(rigid.bodies(ball, np.eye(3)), ball), methods.verlet, dt=0.1, steps=4)
    content, _ = parsed(export.gltf(run, tmp_path / "balls.glb", solids.sphere(0.1), progress=False))
    assert (len(content["meshes"]), len(content["nodes"])) == (1, 3)


def test_springs_and_dots_of_the_plane_lie_at_zero_depth(swarm, ruin, tmp_path):
    content, array = parsed(export.gltf(swarm, tmp_path / "swarm.glb", progress=False))
    places, _ = played(content, array)
    assert content["meshes"][0]["primitives"][0]["mode"] == 0
    np.testing.assert_allclose(places[..., :2], swarm.position, atol=1e-6)
    assert (places[..., 2] == 0).all()
    assert len(trimesh.load_scene(tmp_path / "swarm.glb").geometry) == 1
    run, bridge = ruin
    with pytest.raises(ValueError, match="got springs that break"):
        export.gltf(run, tmp_path / "ruin.glb", bridge)
    assert not (tmp_path / "ruin.glb").exists()


def test_a_sequence_of_surfaces_is_read_back(drape, tmp_path, capsys):
    run, sheet = drape
    files = export.ply(run, tmp_path / "drape", sheet)
    assert "/16 [" in capsys.readouterr().err
    assert [file.name for file in (files[0], files[-1])] == ["frame_0000.ply", "frame_0015.ply"]
    for frame in (0, 7, 15):
        mesh = trimesh.load(files[frame], process=False)
        np.testing.assert_allclose(mesh.vertices, run.position[frame], atol=1e-7)
        np.testing.assert_array_equal(mesh.faces, sheet.faces)
    assert [path.name for path in tmp_path.iterdir()] == ["drape"]


def test_a_sequence_of_springs_has_those_that_hold(ruin, tmp_path):
    run, bridge = ruin
    files = export.ply(run, tmp_path / "ruin", bridge, progress=False)
    held = np.asarray(run.parts[0].unbroken)
    for frame in (0, len(files) - 1):
        header, _, body = files[frame].read_bytes().partition(b"end_header\n")
        assert f"element edge {held[frame].sum()}".encode() in header
        nodes = run.position.shape[1]
        pairs = np.frombuffer(body, "<i4", offset=12 * nodes).reshape(-1, 2)
        np.testing.assert_array_equal(pairs, bridge.springs.pairs[held[frame]])
        assert trimesh.load(files[frame]).vertices.shape[-1] == 3


def test_lanes_that_blew_up_are_left_out_of_points_and_refused_in_gltf(tmp_path):
    wild = forces.independent(lambda t, state, mass: jnp.where(state.position > 0.5, jnp.nan, 0.0))
    state = Particles(np.array([[0.0, 0, 0], [1.0, 0, 0], [0.2, 0, 0]]), np.ones((3, 3)))
    run = simulate(Scene(state, 1.0, (wild,)), methods.semi_implicit_euler, dt=0.01, steps=4)
    files = export.ply(run, tmp_path / "points", progress=False)
    cloud = trimesh.load(files[-1])
    np.testing.assert_allclose(cloud.vertices, run.position[-1, [0, 2]], atol=1e-6)
    with pytest.raises(ValueError, match="got 1 of 3 lanes that blew up, first 1"):
        export.gltf(run, tmp_path / "points.glb")


def test_too_many_frames_and_bad_places_are_refused_before_anything_is_written(swarm, tmp_path):
    long = simulate(swarm.scene, methods.verlet, dt=1 / 300, steps=3000, save_every=10)
    with pytest.raises(ValueError, match=r"got 301 frames of 12 nodes.*lower fps=, a higher speed=, or export.ply"):
        export.gltf(long, tmp_path / "long.glb")
    with pytest.raises(ValueError, match=r"got a.gltf, expected a name that ends in .glb"):
        export.gltf(swarm, tmp_path / "a.gltf")
    with pytest.raises(FileNotFoundError, match="Create it first"):
        export.gltf(swarm, tmp_path / "nowhere" / "a.glb")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    with pytest.raises(FileExistsError, match="Choose a new or an empty folder"):
        export.ply(swarm, tmp_path / "full")
    assert [path.name for path in tmp_path.iterdir()] == ["full"]


def test_a_sequence_that_fails_leaves_no_folder(swarm, tmp_path, monkeypatch):
    monkeypatch.setattr("physjax.show.export._encode_ply", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        export.ply(swarm, tmp_path / "frames", progress=False)
    assert not list(tmp_path.iterdir())
