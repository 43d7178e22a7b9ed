"""Rope, cloth, jelly, bridge and meshes: shapes, masses and sets, what holds at rest, wind, and files."""

import struct

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, forces, methods, simulate
from physjax.meshes import read_mesh
from physjax.physics.springs import lattices

G = 9.8
SHEET = {"width": 1.2, "height": 0.8, "rows": 5, "columns": 7}
STIFF = {"structural": 400.0, "shear": 100.0, "bend": 5.0}
TETRAHEDRON = (
    np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
)


def some_of_each():
    x, faces = TETRAHEDRON
    return {
        "rope": lattices.rope((0, 0), (1, 1), 6, mass=0.2, stiffness=50.0, bend=1.0, damping=0.1),
        "cloth": lattices.cloth(**SHEET, mass=0.2, damping=0.05, **STIFF),
        "jelly": lattices.jelly((1.0, 2.0, 0.5), (3, 4, 3), mass=0.2, damping=0.05, **STIFF),
        "bridge": lattices.bridge(10.0, 2.0, 5, mass=0.2, stiffness=1e4, damping=1.0),
        "bridge in space": lattices.bridge(10.0, 2.0, 5, mass=0.2, stiffness=1e4, width=3.0),
        "mesh": lattices.from_mesh(x, faces, mass=0.2, structural=10.0, bend=1.0),
    }


EVERY = pytest.mark.parametrize("name", some_of_each())


@EVERY
def test_every_lattice_is_at_rest_and_has_the_mass_it_was_given(name):
    lattice = some_of_each()[name]
    scene = Scene(lattice.state, mass=lattice.mass, forces=(lattice.springs,))
    assert np.sum(lattice.mass) == pytest.approx(0.2, rel=1e-14)
    assert np.abs(jax.jit(lambda s: s.acceleration(0.0, s.state))(scene)).max() < 1e-9
    np.testing.assert_allclose(lattice.springs.strain(lattice.state), 0, atol=1e-15)
    assert lattice.springs.layout == "bands"
    pairs = np.sort(lattice.springs.pairs, axis=1)
    assert len(np.unique(pairs, axis=0)) == len(pairs)
    for mask in lattice.nodes.values():
        assert mask.dtype == bool
        assert mask.shape == lattice.mass.shape
    assert lattice.faces.shape[1] == 3


def test_a_cloth_has_its_springs_and_sets():
    sheet = lattices.cloth(**SHEET, mass=0.2, **STIFF)
    rows, columns = SHEET["rows"], SHEET["columns"]
    structural = rows * (columns - 1) + (rows - 1) * columns
    shear, bend = 2 * (rows - 1) * (columns - 1), rows * (columns - 2) + (rows - 2) * columns
    k = np.asarray(sheet.springs.stiffness)
    assert [int(np.sum(k == STIFF[kind])) for kind in STIFF] == [structural, shear, bend]
    assert {name: int(mask.sum()) for name, mask in sheet.nodes.items() if "_" not in name} == {
        "top": columns, "bottom": columns, "left": rows, "right": rows, "edge": 2 * (rows + columns) - 4, "corners": 4,
    }  # fmt: skip
    x = np.asarray(sheet.state.position)
    np.testing.assert_allclose(x[sheet.nodes["bottom_right"]], [[1.2, -0.8, 0]], rtol=1e-15)
    quarter = float(sheet.mass[0])
    np.testing.assert_allclose(sheet.mass[sheet.nodes["edge"] & ~sheet.nodes["corners"]], 2 * quarter, rtol=1e-14)
    np.testing.assert_allclose(sheet.mass[~sheet.nodes["edge"]], 4 * quarter, rtol=1e-14)
    lying = lattices.cloth(**SHEET, mass=0.2, structural=1.0, corner=(1, 2, 3), down=(0, 0, 2))
    np.testing.assert_allclose(lying.state.position[-1], [2.2, 2.0, 3.8], rtol=1e-15)
    assert lying.springs.stiffness.ndim == 0
    assert len(lying.springs.pairs) == structural


def outward(lattice):
    a, b, c = (np.asarray(lattice.state.position)[lattice.faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a) / 2, (a + b + c) / 3


@pytest.mark.parametrize("name", ["jelly", "mesh"])
def test_the_faces_of_a_body_look_outward_and_close_it(name):
    lattice = some_of_each()[name]
    area, center = outward(lattice)
    np.testing.assert_allclose(area.sum(axis=0), 0, atol=1e-14)
    volume = np.sum(area * center) / 3
    assert volume == pytest.approx({"jelly": 1.0, "mesh": 1 / 6}[name], rel=1e-12)


@pytest.mark.parametrize("name", ["bridge", "bridge in space", "jelly"])
def test_a_truss_is_rigid(name):
    """Only translations and rotations cost no energy."""
    lattice = some_of_each()[name]
    shape = lattice.state.position.shape

    def energy(flat):
        x = flat.reshape(shape)
        return jnp.sum(lattice.springs.potential(0.0, Particles(x, x), 1.0))

    stiffness = np.linalg.eigvalsh(jax.jit(jax.hessian(energy))(lattice.state.position.ravel()))
    free = {2: 3, 3: 6}[shape[1]]
    assert np.sum(stiffness < 1e-9 * stiffness[-1]) == free


@pytest.mark.parametrize("name", ["cloth", "jelly"])
def test_a_lattice_in_free_fall_does_not_deform(name):
    lattice = some_of_each()[name]
    scene = Scene(lattice.state, mass=lattice.mass, forces=(forces.Gravity(g=G), lattice.springs))
    end = simulate(scene, methods.verlet, dt=1e-3, steps=200, save_every=200).final_scene.state
    fallen = np.asarray(lattice.state.position) - [0, G * 0.2**2 / 2, 0]
    np.testing.assert_allclose(end.position, fallen, rtol=0, atol=1e-12)


# wind


@pytest.mark.parametrize("as_mesh", [False, True], ids=["cells", "triangles"])
def test_a_flat_sheet_feels_the_wind_as_its_formula_says(as_mesh, precision):
    sheet = lattices.cloth(**SHEET, mass=0.2, structural=1.0)
    if as_mesh:
        sheet = lattices.from_mesh(np.asarray(sheet.state.position), sheet.faces, mass=0.2, structural=1.0)
    wind = sheet.wind((3.0, 0.0, 4.0), density=1.2, normal=1.1, tangential=0.1)
    state = Particles(*(jnp.asarray(a, precision.dtype) for a in sheet.state))
    scene = Scene(state, 1.0, (wind,))
    push = jax.jit(lambda s: s.acceleration(0.0, s.state))
    area = 0.5 * 1.2 * SHEET["width"] * SHEET["height"]
    expected = area * np.array([0.1 * 5 * 3, 0, 1.1 * 16])
    found = np.asarray(push(scene))
    assert found.dtype == precision.dtype
    np.testing.assert_allclose(found.sum(axis=0), expected, rtol=0, atol=20 * precision.eps * expected.max())
    if not as_mesh:  # shared as the mass is
        np.testing.assert_allclose(96 * found[0], found.sum(axis=0), rtol=1e-5, atol=1e-12)
    moving = Particles(state.position, jnp.tile(jnp.asarray([[3.0, 0, 4.0]], precision.dtype), (35, 1)))
    np.testing.assert_allclose(push(Scene(moving, 1.0, scene.forces)), 0, atol=precision.eps)


def test_wind_on_a_lattice_neither_gathers_nor_scatters_and_has_derivatives_at_nothing():
    sheet = lattices.cloth(**SHEET, mass=0.2, structural=1.0)
    scene = Scene(sheet.state, sheet.mass, (sheet.springs, sheet.wind((6.0, 0.0, 0.5))))
    text = jax.jit(lambda s: s.step(methods.semi_implicit_euler, 0.0, 1e-3).state).lower(scene).compile().as_text()
    assert " scatter(" not in text
    assert " gather(" not in text
    flat = Particles(jnp.zeros((35, 3)), jnp.zeros((35, 3)))
    for wind in (sheet.wind((0.0, 0.0, 0.0)), sheet.wind((1.0, 0.0, 0.0))):
        slope = jax.jit(jax.grad(lambda s, w: jnp.sum(w(0.0, s, 1.0) ** 2)))(flat, wind)
        assert all(np.isfinite(leaf).all() for leaf in slope)
    with pytest.raises(ValueError, match="no faces in space"):
        some_of_each()["rope"].wind((1.0, 0.0, 0.0))


def test_a_flag_in_the_wind_stays_finite_at_half_its_stable_step(precision):
    # the faces of a flat sheet that stands in the wind have areas at the border whose squares underflow
    sheet = lattices.cloth(
        1.5, 1.0, rows=8, columns=12, mass=0.15, structural=400.0, shear=100.0, bend=5.0, damping=0.02
    )
    air = sheet.wind((6.0, 0.0, 0.5))
    state = Particles(*(jnp.asarray(leaf, precision.dtype) for leaf in sheet.state))
    flag = Scene(state, sheet.mass, (forces.Gravity(), sheet.springs, air), pinned=sheet.nodes["left"])
    film = simulate(flag, methods.rk4, dt=1.1e-3, steps=100, save_every=10)
    assert film.ok
    # a tenth of a second of falling, pushed by the air no harder than a plate of its weight would be
    assert np.abs(film.velocity).max() < 10


# meshes


def test_a_mesh_has_edges_opposite_vertices_and_a_boundary():
    x = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [1, 4, 2]])
    mesh = lattices.from_mesh(x, faces, mass=3.0, structural=10.0, bend=1.0)
    pairs = {tuple(pair): float(k) for pair, k in zip(mesh.springs.pairs.tolist(), mesh.springs.stiffness, strict=True)}
    edges = {(0, 1), (1, 2), (0, 2), (2, 3), (0, 3), (1, 4), (2, 4)}
    assert pairs == {edge: 10.0 for edge in edges} | {(1, 3): 1.0, (0, 4): 1.0}
    np.testing.assert_allclose(mesh.mass, np.array([2, 2, 3, 1, 1]) / 3, rtol=1e-14)
    assert mesh.nodes["edge"].all()
    x, faces = TETRAHEDRON
    closed = lattices.from_mesh(x, faces, mass=1.0, structural=10.0, bend=1.0)
    assert len(closed.springs.pairs) == 6  # opposite vertices are neighbours already
    assert not closed.nodes["edge"].any()


def written(path, kind):
    x, faces = TETRAHEDRON
    if kind == "obj":
        lines = [f"v {a} {b} {c} 1.0" for a, b, c in x] + ["vt 0 0", "# a comment", "g all"]
        lines += [f"f {a + 1}/1 {b + 1}//1 {c - 4}/1/1" for a, b, c in faces]
        path.write_text("\n".join(lines))
        return
    order = {"ascii": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[kind]
    head = f"ply\nformat {order} 1.0\ncomment made by hand\nelement vertex 4\nproperty float x\nproperty float y\n"
    head += "property float z\nproperty uchar red\nelement face 4\nproperty list uchar int vertex_indices\nend_header\n"
    if kind == "ascii":
        body = "".join(f"{a} {b} {c} 7\n" for a, b, c in x) + "".join(f"3 {a} {b} {c}\n" for a, b, c in faces)
        path.write_text(head + body)
    else:
        body = b"".join(struct.pack(kind + "fffB", *row, 7) for row in x)
        path.write_bytes(head.encode() + body + b"".join(struct.pack(kind + "Biii", 3, *row) for row in faces.tolist()))


@pytest.mark.parametrize("kind", ["obj", "ascii", "<", ">"])
def test_meshes_are_read_from_files_and_truncated_ones_refused(tmp_path, kind):
    path = tmp_path / ("mesh.obj" if kind == "obj" else "mesh.ply")
    written(path, kind)
    for found, wanted in zip(read_mesh(path), TETRAHEDRON, strict=True):
        np.testing.assert_array_equal(found, wanted)
    assert lattices.from_mesh(str(path), mass=1.0, structural=1.0).state.lanes == (4,)
    content = path.read_bytes()
    for part in (0.1, 0.6, 0.95):
        path.write_bytes(content[: int(part * len(content))])
        with pytest.raises(ValueError, match=r"mesh\.(obj|ply): "):
            read_mesh(path)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n", r"a.obj: line 5 has 4 entries: faces must be triangles"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 5\n", r"a.obj: got face 0 with the vertices \[0, 1, 4\], expected 0 to 2"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 2\n", r"with a vertex twice"),
        ("a.obj", "v 0 0 zero\n", r"a.obj: line 1 is not a mesh's"),
        ("a.obj", "hello\n", r"a.obj: found 0 vertices and 0 faces"),
        ("a.ply", "hello\n", r"a.ply: is not a PLY file"),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 1\nproperty quad x\nend_header\n0\n", r"header line 'property quad x'"),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n", r"expected vertex and face"),
        ("a.step", "solid\n", r"ends in .obj or .ply"),
    ],
)  # fmt: skip
def test_files_that_are_no_meshes_are_refused(tmp_path, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(ValueError, match=message):
        lattices.from_mesh(tmp_path / name, mass=1.0, structural=1.0)
    with pytest.raises(FileNotFoundError, match="no file"):
        lattices.from_mesh(tmp_path / "none.ply", mass=1.0, structural=1.0)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: lattices.cloth(1.0, 1.0, 1, 5, mass=1.0, structural=1.0), r"rows: got 1, expected at least 2"),
        (lambda: lattices.cloth(1.0, -1.0, 3, 5, mass=1.0, structural=1.0), r"height \[m\]: got -1.0"),
        (lambda: lattices.cloth(1.0, 1.0, 3, 5, mass=0.0, structural=1.0), r"mass \[kg\]: got 0.0"),
        (lambda: lattices.cloth(1.0, 1.0, 3, 5, mass=1.0, structural=-1.0), r"stiffness \[N/m\]: got -1.0"),
        (lambda: lattices.cloth(1.0, 1.0, 3, 5, mass=1.0, structural=1.0, down=(2, 0, 0)), r"two different directions"),
        (lambda: lattices.rope((0, 0), (1, 1, 1), 5, mass=1.0, stiffness=1.0), r"expected two points"),
        (lambda: lattices.rope((0, 0), (1, 1), 1, mass=1.0, stiffness=1.0), r"nodes: got 1, expected at least 2"),
        (lambda: lattices.jelly((1, 1, 1), (2, 2), mass=1.0, structural=1.0), r"jelly: got 2 counts"),
        (lambda: lattices.bridge(1.0, 1.0, 0, mass=1.0, stiffness=1.0), r"panels: got 0"),
        (lambda: lattices.from_mesh(np.eye(3), [[0, 1, 2, 0]], mass=1.0, structural=1.0), r"expected triangles"),
        (lambda: lattices.from_mesh(np.eye(4)[:, :3], [[0, 1, 2]], mass=1.0, structural=1.0), r"vertex 3 has no area"),
    ],
)
def test_bad_input_is_answered_in_plain_words(build, message, unannotated):
    with pytest.raises(ValueError, match=message):
        build()


def strip(rows, columns, **more):
    """A strip of 0.4 m by 1 m of 50 N/m, hung up at its upper edge."""
    more = {"structural": 50.0, "continuum": True} | more
    return lattices.cloth(0.4, 1.0, rows, columns, mass=0.1, **more)


@pytest.mark.parametrize(("rows", "columns"), [(5, 3), (20, 4)])
def test_a_strip_under_its_weight_and_a_load_stretches_as_its_material_however_fine_it_is(rows, columns):
    sheet, weight, load = strip(rows, columns), 0.1 * G, 0.7
    s = -sheet.state.position[:, 1]
    # with EA = 50 N/m times 0.4 m: what hangs below each place stretches it
    drop = (weight * (s - s * s / 2) + load * s) / 20.0
    hanging = Particles(sheet.state.position.at[:, 1].add(-drop), sheet.state.velocity)
    pull = sheet.springs(0.0, hanging, sheet.mass)[:, 1] - sheet.mass * G
    share = np.where(sheet.nodes["bottom"], sheet.mass, 0.0)
    pull = pull - load * share / share.sum()
    np.testing.assert_allclose(pull[~sheet.nodes["top"]], 0.0, atol=1e-12)
    np.testing.assert_allclose(pull[sheet.nodes["top"]].sum(), -weight - load, rtol=1e-12)


def test_with_shear_springs_a_strip_stretches_alike_too():
    def stretch(rows):
        columns = 2 * (rows - 1) // 5 + 1
        sheet = strip(rows, columns, shear=30.0, damping=0.5)
        load = np.where(sheet.nodes["bottom"], sheet.mass, 0.0)
        pull = forces.Constant(np.outer(load / load.sum(), [0.0, -1.0, 0.0]))
        scene = Scene(sheet.state, sheet.mass, (sheet.springs, pull), pinned=sheet.nodes["top"])
        end = simulate(scene, methods.implicit_euler, dt=0.05, steps=200, save_every=200).position[-1]
        return -1.0 - end[sheet.nodes["bottom"], 1].mean()

    found = [stretch(rows) for rows in (6, 21)]
    np.testing.assert_allclose(found, found[-1], rtol=0.03)
    # between that of the structural springs alone and that of both side by side
    assert 1 / (0.4 * 80.0) < found[-1] < 1 / (0.4 * 50.0)


def test_a_rope_and_a_block_have_the_stiffness_of_their_material():
    for nodes in (3, 9):
        rope = lattices.rope((0, 0), (2, 0), nodes, mass=1.0, stiffness=60.0, damping=6.0, length=3.0, continuum=True)
        np.testing.assert_allclose(1 / (1 / rope.springs.stiffness).sum(), 60.0 / 3.0)
        np.testing.assert_allclose(rope.springs.damping, 0.1 * rope.springs.stiffness)
    block = lattices.jelly((0.5, 2.0, 0.4), (3, 3, 4), mass=1.0, structural=70.0, continuum=True)
    longer = Particles(block.state.position.at[:, 1].multiply(1.1), block.state.velocity)
    pull = block.springs(0.0, longer, block.mass)
    np.testing.assert_allclose(pull[block.nodes["bottom"], 1].sum(), 70.0 * 0.5 * 0.4 * 0.1, rtol=1e-12)
    stiffness = lambda k: lattices.rope((0, 0), (2, 0), 5, mass=1.0, stiffness=k, continuum=True).springs.stiffness  # noqa: E731
    np.testing.assert_allclose(jax.jacfwd(stiffness)(60.0), 2.0)
    np.testing.assert_allclose(stiffness(np.array([[10.0], [60.0]])), [[20.0] * 4, [120.0] * 4])
