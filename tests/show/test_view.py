"""The interactive page holds what was simulated, to a part in 65 534 of the box, and fetches nothing."""

import base64
import json
import re
import subprocess
import sys
import zlib

import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, animate, contacts, forces, inertia, lattices, methods, rigid, simulate
from physjax.show import solids
from physjax.show.page_data import HIDDEN_CODE, QUANTISATION_STEPS


def content(view):
    """What the page's program reads."""
    return json.loads(re.search(r'<script type="application/json" id="film">(.*?)</script>', view.page(), re.S)[1])


def unpacked(text, dtype, *shape):
    """As the browser does it: inflate, then add the differences up, which wrap around."""
    steps = np.frombuffer(zlib.decompress(base64.b64decode(text)), dtype).reshape(shape)
    return np.cumsum(steps, axis=0, dtype=dtype)


def positions(film):
    part, (low, high) = film["part"], np.array(film["reach"])
    whole = unpacked(part["places"], np.int16, -1, part["nodes"], 3)
    place = (low + high) / 2 + whole / QUANTISATION_STEPS * (high - low) / 2
    return np.where(whole[..., :1] == HIDDEN_CODE, np.nan, place), (high - low) / 2 / QUANTISATION_STEPS


def test_a_cloth_is_sent_to_the_last_step_of_sixteen_bits(drape):
    run, sheet = drape
    view = animate.view(run, sheet)
    film = content(view)
    found, step = positions(film)
    error = np.abs(found - np.asarray(run.position)[list(view.frames)])
    assert (error <= 0.51 * step).all()
    assert error.max() > 0.2 * step.min()  # rounded, not passed along
    np.testing.assert_array_equal(unpacked(film["part"]["faces"], np.int32, -1, 3), sheet.faces)
    assert film["titles"][-1] == "t = 0.500 s"
    np.testing.assert_allclose(film["time"], np.asarray(run.time)[list(view.frames)])
    ball, floor = film["obstacles"]
    assert (ball["kind"], ball["radius"], ball["center"]) == ("ball", 0.25, [0.0, 0.25, 0.0])
    assert len(floor["sheets"]) == 1
    np.testing.assert_allclose(np.array(floor["sheets"][0])[:, 1], 0.0, atol=1e-12)


def test_the_page_fetches_nothing_and_a_notebook_frames_it(drape, tmp_path):
    view = animate.view(*drape)
    path = view.save(tmp_path / "page.html")
    page = path.read_text(encoding="utf-8")
    assert [file.name for file in tmp_path.iterdir()] == ["page.html"]
    assert "://" not in page
    assert not re.search(r"__[A-Z]+__|<link|src=|import\(", page)
    assert 'name="viewport"' in page
    assert '<iframe srcdoc="&lt;!doctype html&gt;' in view._repr_html_()
    library = zlib.decompress(base64.b64decode(re.search(r'inflated\("([^"]+)"\)', page)[1])).decode()
    assert library.startswith("var THREE=")
    assert all(name in library for name in ("OrbitControls", "WebGLRenderer", "LineSegments2"))
    assert repr(view) == f"<View of 16 frames, a page of {len(page) / 1e6:.2g} MB>"


def test_sixty_frames_of_a_cloth_of_a_thousand_nodes_are_well_under_two_megabytes():
    sheet = lattices.cloth(1.0, 1.0, 32, 32, mass=0.2, structural=80.0, damping=0.02)
    scene = Scene(sheet.state, sheet.mass, (forces.Gravity(), sheet.springs), pinned=sheet.nodes["top_left"])
    film = simulate(scene, methods.semi_implicit_euler, dt=1 / 1200, steps=59 * 40, save_every=40)
    for shown in (sheet, sheet.springs):
        view = animate.view(film, shown)
        assert len(view.frames) == 60
        assert len(view.page()) < 1_000_000


def test_springs_have_the_colours_of_their_strain_and_those_that_parted_are_told():
    net = lattices.cloth(1.0, 1.0, 4, 4, mass=1.0, structural=100.0, damping=0.5, breaks_at=0.05)
    scene = Scene(net.state, net.mass, (forces.Gravity(), net.springs), pinned=net.nodes["top"])
    run = simulate(scene, methods.semi_implicit_euler, dt=1e-3, steps=500, save_every=50)
    view = animate.view(run)  # the scene's own springs
    part, frames = content(view)["part"], list(view.frames)
    pairs = unpacked(part["pairs"], np.int32, -1, 2)
    np.testing.assert_array_equal(pairs, net.springs.pairs)
    held = unpacked(part["held"], np.uint8, len(frames), -1)
    np.testing.assert_array_equal(held, np.asarray(run.parts[0].unbroken)[frames])
    assert 0 < held[-1].sum() < len(pairs)
    line = np.asarray(run.position)[frames][:, pairs[:, 1]] - np.asarray(run.position)[frames][:, pairs[:, 0]]
    strain = np.linalg.norm(line, axis=-1) / np.asarray(net.springs.rest_length) - 1
    expected = np.clip((100 * strain / part["limit"] + 1) / 2, 0, 1) * 255
    assert np.abs(unpacked(part["shades"], np.uint8, len(frames), -1) - expected).max() <= 0.51
    assert part["ramp"][0] == [0, 114, 178]


def test_bodies_keep_their_shape_and_their_turn():
    brick = inertia.box(2.0, (0.1, 0.2, 0.3))
    spun = rigid.bodies(brick, [[0.0, 0, 0], [1, 0, 0]], angular_velocity=[[1.0, 2, 3], [0, 0, 5]])
    run = simulate(Scene(spun, brick), methods.rk4, dt=0.01, steps=30)
    film = content(animate.view(run, fps=100, shown=[solids.box((0.1, 0.2, 0.3)), solids.sphere(0.1)]))
    turns = unpacked(film["part"]["turns"], np.int16, -1, 2, 4) / QUANTISATION_STEPS
    np.testing.assert_allclose(np.roll(turns, 1, axis=-1), run.state.orientation, atol=0.51 / QUANTISATION_STEPS)
    found, step = positions(film)
    assert (np.abs(found - run.position) <= 0.51 * step).all()
    own = content(animate.view(run))["part"]["shapes"][0]  # no shape given: the box of the same inertia
    np.testing.assert_allclose(np.ptp(np.reshape(own["vertices"], (-1, 3)), axis=0), [0.1, 0.2, 0.3], rtol=1e-6)


@pytest.mark.parametrize("about", [False, True])
def test_a_body_without_a_shape_is_the_box_of_its_inertia(about):
    turn = np.array([0.8, 0.0, 0.6, 0.0])
    body = inertia.composite([(inertia.box(3.0, (0.3, 0.1, 0.2)), (0.0, 0.0, 0.0), turn)]).inertia
    solid = solids.build_inertia_box(body.about((0.1, 0.2, 0.0)) if about else body)
    again = inertia.mesh(solid.vertices, solid.faces, mass=3.0).inertia
    np.testing.assert_allclose(again.tensor, body.tensor, rtol=1e-6, atol=1e-9)


def test_dots_have_paths_and_vanish_where_they_blew_up():
    wild = forces.independent(lambda t, state, mass: jnp.where(state.position > 0.5, jnp.nan, 0.0))
    state = Particles(np.array([[0.0, 0, 0], [1.0, 0, 0]]), np.zeros((2, 3)))
    run = simulate(Scene(state, 1.0, (wild, forces.Gravity())), methods.semi_implicit_euler, dt=0.01, steps=20)
    film = content(animate.view(run, fps=100))
    found, _ = positions(film)
    assert film["part"]["paths"]
    assert np.isnan(found[-1, 1]).all()
    np.testing.assert_allclose(found[-1, 0], run.position[-1, 0], atol=1e-4)


def test_a_wall_that_moves_says_from_when_and_how_fast():
    piston = contacts.Plane((0.0, 0, 0), (1.0, 0, 0), velocity=(1.0, 0, 0), response=contacts.project)
    state = Particles(np.array([[0.05, 0, 0], [2.0, 1, 1]]), np.zeros((2, 3)))
    film = content(animate.view(simulate(Scene(state, contacts=(piston,)), methods.verlet, dt=0.1, steps=10)))
    (wall,) = film["obstacles"]
    assert wall["velocity"] == [1.0, 0.0, 0.0]
    np.testing.assert_allclose(np.array(wall["sheets"][0])[:, 0], wall["since"])


def test_a_run_that_blew_up_ends_at_its_last_good_frame(burst):
    run, sheet = burst
    film = content(animate.view(run, sheet))
    good = np.isfinite(run.position).all(axis=(1, 2)).sum()
    assert film["frames"][-1] == good - 1
    assert "blew up" in film["titles"][0]
    assert np.ptp(film["reach"], axis=0).max() < 1e3


@pytest.mark.usefixtures("unannotated")
def test_what_does_not_fit_is_refused_in_plain_words(drape, swarm, tmp_path):
    run, sheet = drape
    line = simulate(Scene(Particles(jnp.zeros((2, 1)), jnp.ones((2, 1)))), methods.verlet, dt=0.1, steps=2)
    with pytest.raises(ValueError, match="got positions with 1 component, expected 2 or 3"):
        animate.view(line)
    with pytest.raises(TypeError, match=r"animate.view: got str, expected springs.Springs, springs.Rods or a lattice"):
        animate.view(run, "cloth")
    with pytest.raises(TypeError, match="expected RigidBodies"):
        animate.view(run, solids.sphere(1.0))
    with pytest.raises(ValueError, match="got scene=0, expected none: all lanes are drawn side by side"):
        animate.view(swarm, scene=0)
    with pytest.raises(ValueError, match="plays for"):
        animate.view(run, sheet, speed=1e-6)
    with pytest.raises(ValueError, match=r"got a.gif, expected a name that ends in .html"):
        animate.view(run, sheet).save(tmp_path / "a.gif")
    pair = Particles(*(jnp.stack([leaf] * 2) for leaf in run.scene.state))
    both = Scene(pair, jnp.stack([sheet.mass] * 2), run.scene.forces)
    batch = simulate(both, methods.semi_implicit_euler, dt=1 / 600, steps=20, save_every=10)
    with pytest.raises(ValueError, match="expected the number of one scene"):
        animate.view(batch, sheet)
    assert animate.view(batch, sheet, scene=1, fps=60).frames == (0, 1, 2)


def test_the_page_s_program_is_shipped_with_the_package():
    listed = "from importlib.resources import files; w = files('physjax.show') / 'web'; "
    program = listed + "print(*sorted(f.name for f in w.iterdir()), *sorted(f.name for f in (w / 'vendor').iterdir()))"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert {"view.html", "plane.html", "film.html", "tools.html", "data.js", "three.min.js", "three.LICENSE"} <= set(
        run.stdout.split()
    )
