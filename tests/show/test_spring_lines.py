"""Springs are lines in the colour of their strain; those that broke are dashed and grey."""

import jax
import numpy as np
import pytest
from matplotlib.collections import LineCollection
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from physjax import (
    Particles,
    Scene,
    Trajectory,
    animate,
    forces,
    inertia,
    lattices,
    methods,
    plot,
    rigid,
    simulate,
    springs,
)
from physjax.show import auto_plot
from physjax.show.drawables import choose_drawable, find_default_look
from physjax.show.lines import take_lines
from physjax.show.spring_lines import SpringLines


def layers(ax):
    """The springs that hold, and those that do not; None where there are none."""
    found = {c.get_zorder(): c for c in ax.collections if isinstance(c, LineCollection) and c.get_zorder() in (2, 3)}
    return found.get(3), found.get(2)


def strain_of(sheet, film, frame):
    return np.asarray(sheet.springs.strain(Particles(film.position[frame], film.velocity[frame])))


def test_colours_are_strains_and_broken_springs_are_dashed(ruin):
    film, sheet = ruin
    figure = plot.springs(film, sheet, (0, 2, -1), limit=0.02)
    *panels, bar = figure.axes
    assert bar.get_xlabel() == "strain [%]"
    assert bar.get_xlim() == pytest.approx((-2.0, 2.0))
    held = np.asarray(film.parts[0].unbroken)
    assert held[0].all()
    assert 0 < held[-1].sum() < held[-1].size
    shade = SpringLines(sheet.springs.pairs, np.ones(1), None, 0.02).colours()
    for ax, frame in zip(panels, (0, 2, -1), strict=True):
        whole, broken = layers(ax)
        lines = np.asarray(film.position[frame])[sheet.springs.pairs[held[frame]]]
        np.testing.assert_allclose(whole.get_segments(), lines)
        strains = 100 * strain_of(sheet, film, frame)[held[frame]]
        np.testing.assert_allclose(whole.get_colors(), shade.to_rgba(strains), atol=1e-12)
        assert (0 if broken is None else len(broken.get_segments())) == (~held[frame]).sum()
    assert broken.get_linestyles()[0][1] is not None


def test_pressed_is_blue_stretched_is_orange_and_rest_is_grey():
    shade = SpringLines(np.zeros((1, 2), int), np.ones(1), None, 0.1).colours()
    pressed, rest, stretched = shade.to_rgba([-10.0, 0.0, 10.0])[:, :3]
    assert pressed[2] > pressed[0] + 0.4
    assert stretched[0] > stretched[2] + 0.4
    assert np.ptp(rest) < 0.02


def test_axes_in_the_plane_have_one_scale_and_metres(ruin):
    film, sheet = ruin
    figure = plot.springs(film, sheet.springs, (0, -1))
    upper, lower, _ = figure.axes
    assert (lower.get_xlabel(), lower.get_ylabel(), upper.get_ylabel()) == ("x [m]", "y [m]", "y [m]")
    assert upper.get_aspect() == 1.0
    assert (upper.get_xlim(), upper.get_ylim()) == (lower.get_xlim(), lower.get_ylim())
    assert upper.get_title() == "t = 0.00 s"


def test_in_space_springs_are_one_collection(drape):
    film, sheet = drape
    ax, bar = plot.springs(film, sheet, -1).axes
    lines = [c for c in ax.collections if isinstance(c, Line3DCollection)]
    assert len(lines) == 1
    assert len(lines[0].get_colors()) == len(sheet.springs.pairs)
    most = np.percentile(np.abs(strain_of(sheet, film, -1)), 99)
    assert bar.get_xlim()[1] == pytest.approx(100 * most)


def test_the_wrong_side_of_a_floor_is_shaded_in_the_plane(swarm):
    rope = lattices.rope((0.2, 0.5), (0.8, 0.5), 12, mass=1.0, stiffness=1.0)
    ax = plot.springs(swarm, rope, 0).axes[0]
    assert sum(c.get_zorder() == 0 for c in ax.collections) == 2  # the wall and its edge
    assert ax.get_xlim()[0] < 0 < 1 < ax.get_xlim()[1]


def test_a_spring_without_rest_length_and_one_at_rest():
    strain = SpringLines(np.array([[0, 1], [0, 1]]), np.array([0.0, 1.0]), None, 1.0).strain(
        np.array([[0.0, 0], [2.0, 0]])
    )
    assert strain.tolist() == [np.inf, 1.0]


def test_a_run_that_blew_up_still_has_colours(burst):
    film, sheet = burst
    bar = plot.springs(film, sheet).axes[-1]
    assert bar.get_xlim()[1] == 100.0
    with pytest.raises(ValueError, match="blown up"):
        plot.springs(film, sheet, -1)


def test_one_of_several_scenes_has_its_own_rest_and_memory():
    rope = lattices.rope((0.0, 0.0), (1.0, 0.0), 3, mass=1.0, stiffness=100.0)
    rest = np.array([[0.5], [0.4]])
    tie = springs.Springs(rope.springs.pairs, 100.0, rest, breaks_at=np.array([[0.5], [0.2]]))
    x = np.broadcast_to(rope.state.position, (2, 3, 2))
    scene = Scene(Particles(x, np.zeros_like(x)), 1.0, (tie,))
    film = simulate(scene, methods.semi_implicit_euler, dt=1e-3, steps=2)
    whole, broken = layers(plot.springs(film, tie, -1, scene=0).axes[0])
    assert (len(whole.get_segments()), broken) == (2, None)
    whole, broken = layers(plot.springs(film, tie, -1, scene=1).axes[0])
    assert (whole, len(broken.get_segments())) == (None, 2)
    one = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), film)
    with pytest.raises(ValueError, match=r"out of vmap, expected one. Pick one of them: jax.tree.map"):
        plot.springs(one, tie, scene=0)
    assert plot.springs(jax.tree.map(lambda leaf: leaf[0], one), tie, scene=0).axes


def test_a_film_must_remember_what_broke(ruin, tmp_path, unannotated):
    film, sheet = ruin
    film.save(tmp_path / "film.npz")
    with pytest.raises(ValueError, match="load it with scene="):
        plot.springs(Trajectory.load(tmp_path / "film.npz"), sheet)
    again = Trajectory.load(tmp_path / "film.npz", scene=film.scene)
    assert layers(plot.springs(again, sheet, -1).axes[0])[1] is not None
    with pytest.raises(TypeError, match=r"got ndarray, expected springs\.Springs, springs\.Rods or a lattice"):
        plot.springs(film, sheet.springs.pairs)
    with pytest.raises(ValueError, match="expected a strain > 0"):
        plot.springs(film, sheet, limit=-1.0)


def test_springs_on_a_line_are_refused():
    tie = springs.Springs([[0, 1]], 1.0, 1.0)
    scene = Scene(Particles(np.array([[0.0], [1.0]]), np.zeros((2, 1))), 1.0, (tie, forces.Gravity(up=0)))
    film = simulate(scene, methods.euler, dt=1e-3, steps=1)
    with pytest.raises(ValueError, match="got positions with 1 component, expected 2 or 3"):
        plot.springs(film, tie)


def test_all_parts_of_a_scene_that_are_lines_are_drawn():
    x = np.array([[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]])
    parts = (
        springs.Rods([(-1, 0)], anchors=[(0.0, 0.0)]),
        springs.Springs([(0, 1)], 10.0, 0.8, nodes=3),
        springs.Ropes([(1, 2), (-2, 2)], [1.5, 2.0], anchors=[(9.0, 9.0), (3.0, 1.0)], breaks_at=1e9),
    )
    film = simulate(Scene(Particles(x, np.zeros((3, 2))), forces=parts), methods.verlet, dt=0.01, steps=1)
    lines = take_lines("a test", film, find_default_look(film))
    np.testing.assert_array_equal(lines.run.position[0], [*x, [0.0, 0.0], [9.0, 9.0], [3.0, 1.0]])
    np.testing.assert_array_equal(lines.pairs, [[3, 0], [0, 1], [1, 2], [5, 2]])
    np.testing.assert_allclose(lines.rest, [1.0, 0.8, 1.5, 2.0])
    assert lines.held.shape == (2, 4)
    assert lines.held.all()


def test_rods_are_lines_without_a_strain_by_default_and_reach_their_anchors():
    x = np.array([[0.5, -0.5], [1.0, -1.5], [2.0, -1.0]])
    rods = springs.Rods([(-1, 0), (0, 1), (1, 2)], anchors=[(0.0, 0.0)])
    film = simulate(Scene(Particles(x, np.zeros((3, 2))), forces=(rods,)), methods.verlet, dt=0.01, steps=1)
    assert find_default_look(film) is film.scene.forces[0]
    (panel,) = auto_plot.plot_run(film).axes
    lines = layers(panel)[0].get_segments()
    np.testing.assert_allclose(lines, [[(0.0, 0.0), x[0]], x[:2], x[1:]], atol=1e-12)
    drawn = choose_drawable("a test", film, None, dims=(2, 3))
    assert drawn.run.position.shape == (2, 4, 2)
    page = animate.view(film, speed=0.1).page()
    assert '"limit":null' in page  # rods have no bar of colours
    with pytest.raises(ValueError, match=r"got rods .* and 3 nodes, expected rods between them"):
        plot.springs(film, springs.Rods([(2, 3)]))


def test_bodies_without_a_shape_are_bars_between_their_joints():
    plate = inertia.planar_plate(1.0, (1.0, 0.2))
    nail = rigid.Joints([(-1, 0)], [[[0.0, 0.0], [-0.5, 0.0]]])
    hung = Scene(rigid.planar_bodies(plate, [[0.5, 0.0]]), plate, (nail,))
    film = simulate(hung, methods.verlet, dt=0.01, steps=1)
    (bar,) = find_default_look(film)
    np.testing.assert_allclose(bar.corners, [[0.5, 0.0], [-0.5, 0.0]])


@pytest.mark.parametrize("scene", [None, 0, 1])
def test_cut_springs_are_broken_ones_without_a_strain(scene):
    rope = lattices.rope((0.0, 0.0), (3.0, 0.0), 4, mass=1.0, stiffness=100.0)
    cut = np.array([False, True, False])
    cuts = cut if scene is None else np.stack([cut, ~cut])
    x = rope.state.position if scene is None else np.broadcast_to(rope.state.position, (2, 4, 2))
    tie = rope.springs.cut(cuts)
    whole = Scene(Particles(x, np.zeros_like(x)), 0.25, (forces.Gravity(), tie))
    film = simulate(whole, methods.verlet, dt=0.01, steps=2)
    lines = take_lines("plot.springs", film, tie, scene)
    assert lines.held.tolist() == [(cut if scene == 1 else ~cut).tolist()] * 3
    intact, broken = layers(plot.springs(film, tie, -1, scene=scene).axes[0])
    assert len(intact.get_segments()) == lines.held[0].sum()
    assert len(broken.get_segments()) == (~lines.held[0]).sum()
