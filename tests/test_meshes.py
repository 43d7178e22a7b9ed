"""Meshes as people write them: other encodings, extra data, faults of every kind, and faces that share no vertices."""

import struct
import sys
import warnings

import numpy as np
import pytest

from physjax import inertia, lattices
from physjax.meshes import read_mesh, weld

CORNERS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
SQUARE = [[0, 1, 2], [0, 2, 3]]
V = "".join("v {:g} {:g} {:g}\n".format(*corner) for corner in CORNERS)
PLACES = "".join("{:g} {:g} {:g}\n".format(*corner) for corner in CORNERS)
XYZ = "property float x\nproperty float y\nproperty float z\n"
LIST = "property list uchar int vertex_indices\n"


def ply(body, *, kind="ascii", vertex=XYZ, face=LIST, counts=(4, 2), after="", version="1.0"):
    vertices, faces = f"element vertex {counts[0]}\n{vertex}", f"element face {counts[1]}\n{face}"
    head = f"ply\nformat {kind} {version}\n{vertices}{faces}{after}end_header\n"
    return head.encode() + (body.encode() if isinstance(body, str) else body)


def binary(order="<", index="i", extra=b""):
    places = b"".join(struct.pack(order + "3f", *corner) for corner in CORNERS)
    return places + b"".join(struct.pack(f"{order}B3{index}", 3, *face) + extra for face in SQUARE)


FACES = "3 0 1 2\n3 0 2 3\n"
UV = "property list uchar float texcoord\n"
GOOD = {
    "plain.obj": V + "f 1 2 3\nf 1 3 4\n",
    "bom.obj": b"\xef\xbb\xbf" + (V + "f 1 2 3\nf 1 3 4").encode(),
    "utf16.obj": (V + "f 1 2 3\nf 1 3 4\n").encode("utf-16"),
    "utf16be.obj": b"\xfe\xff" + (V + "f 1 2 3\nf 1 3 4\n").encode("utf-16-be"),
    "utf32.obj": (V + "f 1 2 3\nf 1 3 4\n").encode("utf-32"),
    "crlf.obj": (V + "f 1 2 3\nf 1 3 4\n").replace("\n", "\r\n"),
    "cr.obj": (V + "f 1 2 3\nf 1 3 4\n").replace("\n", "\r"),
    "continued.obj": V.replace("v 1 1 0", "v 1 \\\n1 0") + "f 1/1/1 2/2/2 \\\r\n 3/3/3\nf 1//1 \\\n3//1 \\\n4//1\n",
    "path.obj": "# made from C:\\models\\\n" + V + "f 1 2 3 # a\\\nf 1 3 4\n",
    "negative.obj": V + "f -4 -3 -2\nf -4/-1 -2/-1 -1/-1\n",
    "colours.obj": V.replace("\n", " 0.5 0.5 1\n")
    + "vt 0 0\nvn 0 0 1\no a\ng b\ns off\nusemtl \xe9t\xe9\nf 1/ 2/ 3/\nf 1 3 4\n",
    "late.obj": "f 1 2 3\n" + V + "f 1 3 4\n",
    "latin.obj": "# \xe9t\xe9\n".encode("latin-1") + (V + "f 1 2 3\nf 1 3 4\n").encode(),
    "plain.ply": ply(PLACES + FACES),
    "bom.ply": b"\xef\xbb\xbf" + ply(PLACES + FACES),
    "utf16.ply": ply(PLACES + FACES).decode().encode("utf-16"),
    "crlf.ply": ply(PLACES + FACES).replace(b"\n", b"\r\n"),
    "cr.ply": ply(PLACES + FACES).replace(b"\n", b"\r"),
    "texture.ply": ply(PLACES + "3 0 1 2 6 0 0 1 0 1 1\n3 0 2 3 6 0 0 1 0 1 1\n", face=LIST + UV),
    "ragged.ply": ply(PLACES + "3 0 1 2 6 0 0 1 0 1 1\n3 0 2 3 0\n", face=LIST + UV),
    "first.ply": ply(PLACES + "2 .5 .5 3 0 1 2\n0 3 0 2 3\n", face=UV + LIST),
    "little.ply": ply(binary(), kind="binary_little_endian"),
    "big.ply": ply(binary(">"), kind="binary_big_endian"),
    "texture_binary.ply": ply(binary(extra=struct.pack("<B2f", 2, 0, 1)), kind="binary_little_endian", face=LIST + UV),
    "unsigned.ply": ply(binary(index="I"), kind="binary_little_endian", face=LIST.replace("int", "uint")),
    "feed.ply": ply(binary() + b"\n", kind="binary_little_endian"),
    "comment.ply": ply(PLACES + FACES, vertex="comment see end_header\ncomment\n" + XYZ),
    "others.ply": ply(
        PLACES + FACES + "0 1\n2 7 8\n",
        after="obj_info x\nelement edge 1\nproperty int a\nproperty int b\nelement odd 1\nproperty list uchar int c\n",
    ),
}


@pytest.mark.parametrize("name", GOOD)
def test_a_square_is_read_however_it_is_written(name, tmp_path):
    content = GOOD[name]
    (tmp_path / name).write_bytes(content.encode() if isinstance(content, str) else content)
    vertices, faces = read_mesh(tmp_path / name)
    np.testing.assert_array_equal(vertices, CORNERS)
    assert faces.tolist() == SQUARE


def test_lists_of_several_lengths_are_read_from_bytes_row_by_row(tmp_path):
    rows = struct.pack("<B3iBf", 3, 0, 1, 2, 1, 0.5) + struct.pack("<B4iB2f", 4, 0, 1, 2, 3, 2, 0.5, 0.5)
    content = ply(binary()[:48] + rows, kind="binary_little_endian", face=LIST + UV)
    (tmp_path / "a.ply").write_bytes(content)
    assert read_mesh(tmp_path / "a.ply", triangulate=True)[1].tolist() == [[0, 1, 2], *SQUARE]


BAD = [
    ("a.obj", V + "f 0 1 2\n", r"line 5 has the index 0"),
    ("a.obj", V + "f 1/0 2/1 3/1\n", r"line 5 has the index 0"),
    ("a.obj", V + "f 1 2 -5\n", r"line 5 has the index -5, expected at least -4"),
    ("a.obj", "v 0 0 0\nf -1 -2 -3\n" + V, r"line 2 has the index -3, expected at least -1"),
    ("a.obj", V + "f 1 2 9\n", r"face 0 with the vertices \[0, 1, 8\], expected 0 to 3"),
    ("a.obj", V + "f 1 2\n", r"line 5 has 2 entries: faces must be triangles"),
    ("a.obj", V + "f\n", r"line 5 has 0 entries"),
    ("a.obj", V + "f 1 2 3 4\n", r"line 5 has 4 entries: faces must be triangles.* triangulate=True"),
    ("a.obj", V + "f 1.0 2 3\n", r"line 5 is not a mesh's: 'f 1.0 2 3'"),
    ("a.obj", V + "f 1/1/1/1 2 3\n", r"line 5 is not a mesh's"),
    ("a.obj", V + "f 1 2 1_0\n", r"line 5 is not a mesh's"),
    ("a.obj", V + "f 1 2 \\", r"line 5 is not a mesh's"),
    ("a.obj", "v 0,5 0 0\n", r"line 1 is not a mesh's: 'v 0,5 0 0', expected numbers"),
    ("a.obj", "v 0 0\n", r"line 1 has 2 entries: a vertex needs 3 numbers"),
    ("a.obj", "v 0 0 0 1 1\n", r"line 1 has 5 entries"),
    ("a.obj", "\nv 0 nan 0\n", r"line 2 has the vertex \[0.0, nan, 0.0\], expected finite"),
    ("a.obj", "v 0 0 1e999\n", r"expected finite"),
    ("a.obj", V + "surf 0 1 0 1 1 2 3\n", r"line 5 begins with 'surf', expected vertices \(v\) and flat faces"),
    ("a.obj", (V + "f 1 2 3\n").encode("utf-16-le"), r"holds zero bytes, expected text"),
    ("a.obj", "", r"found 0 vertices and 0 faces"),
    ("a.ply", ply(PLACES + "3 0 1 4\n3 0 2 3\n"), r"face 0 with the vertices \[0, 1, 4\], expected 0 to 3"),
    ("a.ply", ply(PLACES + "3 0 1 -1\n3 0 2 3\n"), r"face 0 with the vertices \[0, 1, -1\]"),
    ("a.ply", ply(PLACES + "3 0 1 1.7\n3 0 2 3\n"), r"holds 1.7 in the element 'face', expected whole numbers"),
    (
        "a.ply",
        ply(PLACES + "3 0 1 300\n3 0 2 3\n", face=LIST.replace("int", "uchar")),
        r"holds 300 in .* from 0 to 255",
    ),
    ("a.ply", ply(PLACES + "3 0 1 2\n2 0 2\n"), r"face 1 has 2 corners: faces must be triangles"),
    (
        "a.ply",
        ply(PLACES + "3 0 1 2\n4 0 1 2 3\n"),
        r"face 1 has 4 corners: faces must be triangles.* triangulate=True",
    ),
    ("a.ply", ply(PLACES + "3 0 1 2\n3 0 2\n"), r"is truncated: the element 'face' does not fit"),
    ("a.ply", ply(PLACES + FACES + "3 0 1 3\n"), r"holds 4 numbers more than its header says"),
    ("a.ply", ply(PLACES + FACES, counts=(3, 2)), r"holds"),
    ("a.ply", ply(PLACES.replace("1 1 0", "1 nan 0") + FACES), r"vertices that are not finite"),
    ("a.ply", ply(PLACES.replace("1 1 0", "1 1_0 0") + FACES), r"holds '1_0', which is not a number"),
    ("a.ply", ply(binary()[:-1], kind="binary_little_endian"), r"is truncated"),
    ("a.ply", ply(binary() + b"abc", kind="binary_little_endian"), r"holds 3 bytes more than its header says"),
    ("a.ply", ply(binary(">"), kind="binary_little_endian"), r"got face 0 with the vertices"),
    ("a.ply", ply(PLACES + FACES, version="2.0"), r"header line 'format ascii 2.0'"),
    ("a.ply", ply(PLACES + FACES, kind="text"), r"header line 'format text 1.0'"),
    ("a.ply", ply(PLACES + FACES, counts=(4, -2)), r"header line 'element face -2'"),
    ("a.ply", ply(PLACES + FACES, vertex=XYZ + "property float x\n"), r"header line 'property float x'"),
    ("a.ply", ply(PLACES + FACES, vertex=XYZ.replace("z", "w")), r"vertices with x, y, w, expected x, y and z"),
    ("a.ply", ply(PLACES + FACES, face=LIST.replace("int v", "float v")), r"expected one list of whole numbers"),
    ("a.ply", ply(PLACES, counts=(4, 0)), r"has no faces"),
    ("a.ply", ply(PLACES + FACES)[:60], r"header is truncated"),
    ("a.ply", ply(PLACES + FACES).replace(b"format ascii 1.0\n", b""), r"does not say its format"),
]


@pytest.mark.parametrize(("name", "content", "message"), BAD)
def test_a_fault_is_told_by_its_file_and_place(name, content, message, tmp_path):
    (tmp_path / name).write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(ValueError, match=f"^{name}: .*{message}"):
        read_mesh(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "content"),
    [("a.obj", V + "f 1 2 3 4\n"), ("a.ply", ply(PLACES + "4 0 1 2 3\n", counts=(4, 1)))],
)
def test_quads_are_cut_where_that_is_asked_for(name, content, tmp_path):
    (tmp_path / name).write_bytes(content.encode() if isinstance(content, str) else content)
    assert read_mesh(tmp_path / name, triangulate=True)[1].tolist() == SQUARE
    net = lattices.from_mesh(tmp_path / name, mass=1.0, structural=1.0, triangulate=True)
    assert len(net.springs.pairs) == 5


# faces that share no vertices


def apart(vertices, faces):
    """Every triangle with three vertices of its own, as STL has them."""
    return np.asarray(vertices)[np.ravel(faces)], np.arange(np.size(faces)).reshape(-1, 3)


def cube():
    """Eight corners and twelve triangles that look outward."""
    corners = np.array([[x, y, z] for x in (0.0, 2.0) for y in (0.0, 2.0) for z in (0.0, 2.0)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners, [(q[0], q[i], q[i + 1]) for q in quads for i in (1, 2)]


def test_a_mesh_whose_faces_share_no_vertices_is_welded_and_that_is_said():
    whole = lattices.from_mesh(*cube(), mass=1.2, structural=10.0, bend=1.0)
    with pytest.warns(UserWarning, match="36 vertices stand in 8 places and were welded"):
        joined = lattices.from_mesh(*apart(*cube()), mass=1.2, structural=10.0, bend=1.0)
    assert len(joined.springs.pairs) == len(whole.springs.pairs)
    for name, mesh in {"whole": whole, "joined": joined}.items():
        assert not mesh.nodes["edge"].any(), name
        np.testing.assert_allclose(mesh.mass.sum(), 1.2, rtol=1e-14)
    found = weld(*apart(*cube()))
    np.testing.assert_array_equal(found.vertices[found.index], apart(*cube())[0])
    np.testing.assert_array_equal(np.sort(joined.mass), np.sort(whole.mass))


def test_a_mesh_that_shares_its_vertices_stays_as_it_is():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        net = lattices.from_mesh(*cube(), mass=1.0, structural=1.0)
        loose = lattices.from_mesh(*apart(*cube()), mass=1.0, structural=1.0, weld=0.0)
        tiny = lattices.from_mesh(
            np.array([[0.0, 0, 0], [1e-9, 0, 0], [0, 1, 0]]), [[0, 1, 2]], mass=1.0, structural=1.0
        )
    np.testing.assert_array_equal(net.state.position, cube()[0])
    assert loose.state.lanes == (36,)
    assert tiny.state.lanes == (3,)


def test_a_seam_of_rounding_is_closed_within_the_tolerance_and_a_gap_is_refused():
    vertices, faces = apart(CORNERS, SQUARE)
    vertices[3:] += [1e-8, -1e-8, 1e-8]
    with pytest.warns(UserWarning, match="6 vertices stand in 4 places"):
        assert lattices.from_mesh(vertices, faces, mass=1.0, structural=1.0).state.lanes == (4,)
    vertices[3:] += [1e-3, 0.0, 0.0]
    with pytest.raises(ValueError, match=r"none of the 2 triangles shares a vertex.*Give weld="):
        lattices.from_mesh(vertices, faces, mass=1.0, structural=1.0)
    with pytest.warns(UserWarning, match="6 vertices stand in 4 places"):
        assert lattices.from_mesh(vertices, faces, mass=1.0, structural=1.0, weld=2e-3).state.lanes == (4,)
    with pytest.raises(ValueError, match="leaves no triangle"), pytest.warns(UserWarning, match="1 places"):
        lattices.from_mesh(vertices, faces, mass=1.0, structural=1.0, weld=5.0)
    with pytest.raises(ValueError, match=r"weld \[m\]: got -1"):
        lattices.from_mesh(vertices, faces, mass=1.0, structural=1.0, weld=-1.0)


def test_a_face_with_two_corners_in_one_place_is_left_out_and_that_is_said():
    vertices = np.concatenate([CORNERS, CORNERS[:1]])
    with pytest.warns(UserWarning, match="5 vertices stand in 4 places .*1 faces without area were left out"):
        net = lattices.from_mesh(vertices, [*SQUARE, [0, 4, 3]], mass=1.0, structural=1.0)
    assert net.faces.tolist() == SQUARE


# with trimesh


@pytest.mark.parametrize("ending", ["stl", "glb", "gltf", "text.stl"])
def test_trimesh_reads_other_files_and_what_it_reads_is_welded(ending, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    mesh, path = trimesh.Trimesh(*apart(*cube()), process=False), tmp_path / f"cube.{ending}"
    if ending == "gltf":
        for name, content in trimesh.exchange.gltf.export_gltf(trimesh.Scene(mesh)).items():
            (tmp_path / name).write_bytes(content)
        (tmp_path / "model.gltf").rename(path)
    else:
        mesh.export(path, **({"file_type": "stl_ascii"} if ending == "text.stl" else {}))
    vertices, faces = read_mesh(path)
    assert vertices.shape == (8, 3)
    np.testing.assert_allclose(inertia.mesh(vertices, faces, density=1.0).inertia.mass, 8.0, rtol=1e-6)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(lattices.from_mesh(path, mass=1.0, structural=1.0).springs.pairs) == 18
    content = path.read_bytes()
    for part in (0.3, 0.7, 0.97):
        path.write_bytes(content[: int(part * len(content))])
        with pytest.raises(ValueError, match=rf"cube\.{ending}: "):
            read_mesh(path)


def test_parts_of_a_file_stand_where_it_puts_them(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    scene = trimesh.Scene()
    for x in (0.0, 5.0):
        scene.add_geometry(
            trimesh.Trimesh(*cube(), process=False), transform=trimesh.transformations.translation_matrix((x, 0, 0))
        )
    scene.export(tmp_path / "two.glb")
    vertices, faces = read_mesh(tmp_path / "two.glb")
    assert (vertices.shape, faces.shape) == ((16, 3), (24, 3))
    np.testing.assert_allclose([vertices.min(axis=0), vertices.max(axis=0)], [[0, 0, 0], [7, 2, 2]], atol=1e-6)


def test_without_trimesh_its_files_say_what_is_missing(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    (tmp_path / "a.stl").write_text("solid\nendsolid\n")
    with pytest.raises(ImportError, match=r"a.stl needs trimesh: pip install 'physjax\[mesh\]'"):
        read_mesh(tmp_path / "a.stl")


DART = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 2.0, 0.0], [1.8, 0.2, 0.0]])


@pytest.mark.parametrize("turn", range(4))
def test_a_hollow_quad_keeps_its_area_whichever_corner_comes_first(turn, tmp_path):
    lines = "".join("v {:g} {:g} {:g}\n".format(*corner) for corner in np.roll(DART, turn, axis=0))
    (tmp_path / "a.obj").write_text(lines + "f 1 2 3 4\n")
    vertices, faces = read_mesh(tmp_path / "a.obj", triangulate=True)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    np.testing.assert_allclose(np.cross(b - a, c - a)[:, 2].sum() / 2, 0.4)
    np.testing.assert_allclose(np.abs(np.cross(b - a, c - a)[:, 2]).sum() / 2, 0.4)


def test_a_star_that_no_fan_covers_is_refused(tmp_path):
    angle = np.arange(10) * np.pi / 5
    star = np.stack([np.cos(angle), np.sin(angle)], -1) * np.where(np.arange(10) % 2, 0.2, 1.0)[:, None]
    lines = "".join(f"v {x:g} {y:g} 0\n" for x, y in star)
    (tmp_path / "a.obj").write_text(lines + "f 1 2 3 4 5 6 7 8 9 10\n")
    with pytest.raises(ValueError, match=r"a.obj: face 0 has no corner that sees all its others.* Triangulate"):
        read_mesh(tmp_path / "a.obj", triangulate=True)


def test_pieces_that_were_rounded_apart_are_warned_of():
    quads = np.array([CORNERS, CORNERS + np.array([1, 1e-4, 0])]).reshape(-1, 3)
    faces = np.array([*SQUARE, *(np.array(SQUARE) + 4)])
    with pytest.warns(UserWarning, match=r"2 pieces of the mesh share no vertex.* within 0.0001 m.* weld=0.000101"):
        lattices.from_mesh(quads, faces, mass=1.0, structural=1.0)
    with pytest.warns(UserWarning, match=r"8 vertices stand in 6 places"):
        assert lattices.from_mesh(quads, faces, mass=1.0, structural=1.0, weld=1.01e-4).state.position.shape == (
            6,
            3,
        )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        lattices.from_mesh(quads, faces, mass=1.0, structural=1.0, weld=0)
        lattices.from_mesh(quads + 5 * (np.arange(8) > 3)[:, None], faces, mass=1.0, structural=1.0)


@pytest.mark.parametrize("name", ["x", "facet vertex", ""])
@pytest.mark.parametrize("change", [str, str.upper, lambda text: text.replace("\n", "\r\n")])
def test_text_stl_is_read_whatever_its_name_and_case(name, change, tmp_path):
    facet = lambda face: "".join("vertex {:g} {:g} {:g}\n".format(*CORNERS[i]) for i in face)  # noqa: E731
    facets = [f"facet normal 0 0 1\nouter loop\n{facet(face)}endloop\nendfacet\n" for face in SQUARE]
    (tmp_path / "a.stl").write_bytes(change(f"solid {name}\n{''.join(facets)}endsolid {name}\n").encode())
    assert read_mesh(tmp_path / "a.stl")[1].tolist() == SQUARE
