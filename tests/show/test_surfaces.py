"""A cloth is drawn with all its faces, lit by Lambert's law, in metres, with y up and what is in its way."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from mpl_toolkits.mplot3d.proj3d import proj_transform

from physjax import Particles, Scene, contacts, forces, lattices, methods, plot, rigid, simulate
from physjax.show import obstacles, outlines
from physjax.show.obstacles import LIGHT_DIRECTION
from physjax.show.stage import Stage
from physjax.show.surfaces import AMBIENT_BRIGHTNESS, compute_brightness

CUBE = Stage(np.zeros(3), np.ones(3))


def polygons(ax, zorders=(2, 4)):
    """How many polygons stand in the given layers; the faces by default."""
    layers = [c for c in ax.collections if isinstance(c, Poly3DCollection) and c.get_zorder() in zorders]
    return sum(len(layer.get_facecolor()) for layer in layers)


def at_rest(sheet, *surfaces):
    """A film of two frames in which nothing moves."""
    scene = Scene(sheet.state, sheet.mass, (sheet.springs,), surfaces)
    return simulate(scene, methods.semi_implicit_euler, dt=1e-3, steps=1)


def area(polygon):
    turns = np.cross(polygon[1:-1] - polygon[0], polygon[2:] - polygon[0])
    return np.linalg.norm(turns, axis=1).sum() / 2


# what is drawn


def test_every_face_is_drawn_at_every_frame_that_was_asked_for(drape):
    film, sheet = drape
    figure = plot.cloth(film, sheet, frames=(0, 7, -1))
    assert [ax.get_title() for ax in figure.axes] == ["t = 0.000 s", "t = 0.233 s", "t = 0.500 s"]
    for ax in figure.axes:
        assert polygons(ax) == len(sheet.faces) == 40
        assert polygons(ax, zorders=(3,)) == len(
            obstacles.find_solids(Stage(np.full(3, -1.0), np.full(3, 1.0)), film.scene.contacts, 0.0)[
                0
            ].outline.polygons
        )
        assert polygons(ax, zorders=(0,)) == 1  # the floor
        assert len(ax.collections) <= 4  # however many faces
    assert len(plot.cloth(film, sheet, 3).axes) == 1


def test_without_frames_the_first_the_middle_and_the_last_are_drawn(drape):
    film, sheet = drape
    titles = [ax.get_title() for ax in plot.cloth(film, sheet).axes]
    assert titles == [f"t = {film.time[i]:.3f} s" for i in (0, 8, 15)]


def test_axes_are_in_metres_with_y_up_and_one_scale_and_hold_all_that_is_shown(drape):
    film, sheet = drape
    first, *others = plot.cloth(film, sheet).axes
    assert (first.get_xlabel(), first.get_ylabel(), first.get_zlabel()) == ("x [m]", "y [m]", "z [m]")
    low, high = np.array([first.get_xlim(), first.get_ylim(), first.get_zlim()]).T
    nodes = np.asarray(film.position)[[0, 8, 15]]
    assert ((nodes >= low) & (nodes <= high)).all()
    assert low[1] < 0.0  # the floor
    for ax in others:
        assert (ax.get_xlim(), ax.get_ylim(), ax.get_zlim()) == (first.get_xlim(), first.get_ylim(), first.get_zlim())
    first.set_proj_type("ortho")
    x, y, _ = proj_transform(*np.concatenate([np.zeros((3, 1)), np.eye(3)], axis=1), first.get_proj())
    paper = np.array([x[1:] - x[0], y[1:] - y[0]])
    np.testing.assert_allclose(paper @ paper.T, np.eye(2) * (paper[0] @ paper[0]), atol=1e-12)  # seen from any side
    assert paper[1, 1] > 0.9 * np.linalg.norm(paper[0])
    assert abs(paper[0, 1]) < 1e-12


def test_nothing_of_a_picture_is_cut_off(drape):
    film, sheet = drape
    figure = plot.cloth(film, sheet)
    figure.canvas.draw()
    for ax in figure.axes:
        for part in (ax.title, ax.xaxis.label, ax.yaxis.label, ax.zaxis.label):
            if not part.get_text():
                continue  # the first panel has the names for all
            box = part.get_window_extent()
            assert box.x0 >= 0
            assert box.y0 >= 0
            assert box.x1 <= figure.bbox.width
            assert box.y1 <= figure.bbox.height


def test_it_draws_into_a_given_figure(drape):
    film, sheet = drape
    figure = plt.figure()
    assert plot.cloth(film, sheet, 0, figure=figure) is figure
    assert len(figure.axes) == 1


def test_a_jelly_and_a_mesh_are_surfaces_too():
    block = lattices.jelly((1, 1, 1), (3, 3, 3), mass=1.0, structural=10.0)
    assert polygons(plot.cloth(at_rest(block), block, 0).axes[0]) == 6 * 8
    corners = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [0, 0, 0]])
    faces = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    mesh = lattices.from_mesh(corners, faces, mass=1.0, structural=10.0)
    assert polygons(plot.cloth(at_rest(mesh), mesh, 0).axes[0]) == 4


def test_one_of_a_batch_of_scenes_is_drawn():
    sheet = lattices.cloth(1.0, 1.0, 3, 3, mass=0.1, structural=10.0)
    x = np.asarray(sheet.state.position) + np.array([0.0, 5.0])[:, None, None]
    scene = Scene(Particles(x, np.zeros_like(x)), 0.1, (forces.Gravity(), sheet.springs))
    film = simulate(scene, methods.semi_implicit_euler, dt=1e-3, steps=2)
    assert plot.cloth(film, sheet, 0, scene=1).axes[0].get_ylim()[0] > 3.0
    with pytest.raises(ValueError, match=r"one scene of \(2,\): scene=0"):
        plot.cloth(film, sheet)
    with pytest.raises(ValueError, match=r"scene=2, expected numbers below \(2,\)"):
        plot.cloth(film, sheet, scene=2)


# light


def test_faces_are_lit_by_their_angle_to_the_light_from_both_sides():
    across = np.cross(LIGHT_DIRECTION, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    other = np.cross(LIGHT_DIRECTION, across)
    angles = np.array([0.0, 0.7, np.pi / 2])
    normals = np.cos(angles)[:, None] * LIGHT_DIRECTION + np.sin(angles)[:, None] * other
    triangles = np.stack([np.zeros((3, 3)), np.broadcast_to(across, (3, 3)), np.cross(normals, across)], axis=1)
    faces = np.arange(9).reshape(3, 3)
    seen = compute_brightness(triangles.reshape(9, 3), faces)
    np.testing.assert_allclose(seen, AMBIENT_BRIGHTNESS + (1 - AMBIENT_BRIGHTNESS) * np.cos(angles), atol=1e-12)
    np.testing.assert_allclose(compute_brightness(triangles.reshape(9, 3), faces[:, ::-1]), seen, atol=1e-12)


def test_a_bent_sheet_is_smooth_and_a_block_keeps_its_edges():
    def fold(angle):
        corners = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [-np.cos(angle), np.sin(angle), 0]])
        return compute_brightness(corners.astype(float), np.array([[0, 1, 2], [0, 3, 1]]))

    soft, hard = fold(0.4), fold(np.pi / 2)
    alone = [compute_brightness(np.array([[0, 0, 0], [0, 0, 1.0], [1.0, 0, 0]]), np.array([[0, 1, 2]]))[0]]
    assert abs(hard[0] - alone[0]) < 1e-12
    assert abs(soft[0] - alone[0]) > 1e-3


def test_a_face_without_area_is_no_trouble():
    assert compute_brightness(np.zeros((3, 3)), np.array([[0, 1, 2]])).tolist() == [AMBIENT_BRIGHTNESS]


# what is in the way


def test_a_plane_is_cut_to_the_box():
    floor = outlines._cut_box(CUBE, np.array([0.3, 0.5, 0.3]), np.array([0.0, 1.0, 0.0]))
    assert area(floor) == pytest.approx(1.0)
    slope = outlines._cut_box(CUBE, np.full(3, 0.5), np.full(3, 3**-0.5))
    assert len(slope) == 6
    assert area(slope) == pytest.approx(0.75 * 3**0.5)
    assert len(outlines._cut_box(CUBE, np.full(3, 2.0), np.array([0.0, 1.0, 0.0]))) == 0


def test_a_floor_that_is_near_comes_into_the_picture_and_a_far_one_does_not():
    near, far = (contacts.Plane((0, y, 0), (0, 1, 0)) for y in (-0.2, -50.0))
    assert obstacles.include_obstacles(CUBE, (near,)).low[1] == pytest.approx(-0.2)
    assert obstacles.include_obstacles(CUBE, (far,)).low[1] == 0.0
    planet = contacts.Sphere((0, -6e6, 0), 6e6)
    assert obstacles.include_obstacles(CUBE, (planet,)).low[1] == 0.0
    assert obstacles.include_obstacles(CUBE, (contacts.Room((-0.5,) * 3, (1.5,) * 3),)).high[0] == 1.5


def test_every_shape_is_drawn_in_space():
    sheet = lattices.cloth(1.0, 1.0, 3, 3, mass=0.1, structural=10.0)
    shapes = (
        (contacts.Plane((0, -1.2, 0), (0, 1, 0)), 1),
        (contacts.Plane((0, -9, 0), (0, 1, 0)), 0),  # too far
        (contacts.Slab((0, -1.5, 0), (0, 1, 0), 0.1), 0),
        (contacts.Slab((0.5, 0, 0), (1, 0, 0), 1.02, inside=True), 2),
        (contacts.Room((-1,) * 3, (2,) * 3), 6),
    )
    for shape, sides in shapes:
        assert polygons(plot.cloth(at_rest(sheet, shape), sheet, 0).axes[0], zorders=(0,)) == sides, shape
    bowl = contacts.Sphere((0.5, -0.5, 0), 1.0, inside=True)
    assert polygons(plot.cloth(at_rest(sheet, bowl), sheet, 0).axes[0], zorders=(0,)) > 100


def test_surfaces_that_move_are_drawn_where_they_are_and_those_that_differ_are_left_out():
    bat = contacts.Sphere((0, 0, 0), 0.1, velocity=(2.0, 0, 0))
    found = outlines.build_outline(bat, CUBE, 0.25)
    np.testing.assert_allclose(found.ball.center, [0.5, 0, 0])
    assert len(found.polygons) == len(found.normals) > 100
    assert len(outlines.build_outline(bat, CUBE, 1.0).polygons) == 0
    assert obstacles.include_obstacles(CUBE, (bat,), (0.0, 0.75)).high[0] == 1.6
    ramp = contacts.Plane(np.zeros((4, 3)), (0, 1, 0))
    assert obstacles.select_shared_surfaces((bat, ramp)) == (bat,)


def test_of_what_bodies_touch_the_surface_is_drawn():
    floor = contacts.Plane((0.0, 0.5, 0.0), (0.0, 1.0, 0.0))
    shown = obstacles.select_shared_surfaces(
        (rigid.SurfaceContact(rigid.ContactPoints.sphere(0.1), floor), rigid.Balls(0.1))
    )
    assert shown == (floor,)
    assert len(outlines.build_outline(floor, CUBE, 0.0).polygons) == 1


def test_what_is_behind_a_ball_is_known(drape):
    film, sheet = drape
    ax = plot.cloth(film, sheet, 0).axes[0]
    up, turn = np.radians([ax.elev, ax.azim])
    eye = np.array([np.cos(up) * np.sin(turn), np.sin(up), np.cos(up) * np.cos(turn)])
    ball = obstacles.find_solids(Stage(np.full(3, -1.0), np.full(3, 1.0)), film.scene.contacts, 0.0)
    points = ball[0].outline.ball.center + np.array([eye, -eye, -eye + [0, 1.0, 0]]) * 0.4
    assert obstacles.find_hidden(ball, points, ax).tolist() == [False, True, False]


# bad input


@pytest.fixture
def bad(unannotated, drape, ruin, swarm, burst):
    film, sheet = drape
    smaller = lattices.cloth(1.0, 1.0, 3, 3, mass=1.0, structural=1.0)
    recorded = simulate(film.scene, methods.euler, dt=1e-3, steps=1, record=lambda t, state: state.position)
    return {
        "no film": lambda: plot.cloth(film.position, sheet),
        "no sheet": lambda: plot.cloth(film, sheet.springs),
        "no faces": lambda: plot.cloth(ruin[0], ruin[1]),
        "a plane": lambda: plot.cloth(swarm, sheet._replace(state=swarm.scene.state)),
        "too few nodes": lambda: plot.cloth(film, smaller),
        "a frame too far": lambda: plot.cloth(film, sheet, 16),
        "no frame": lambda: plot.cloth(film, sheet, (0, 0.5)),
        "a bad frame": lambda: plot.cloth(burst[0], burst[1], -1),
        "only recorded": lambda: plot.cloth(recorded, sheet),
        "a batch of one": lambda: plot.cloth(film, sheet, scene=0),
    }


@pytest.mark.parametrize(
    ("case", "error", "words"),
    [
        ("no film", TypeError, "expected a film: the Trajectory that simulate returns"),
        ("no sheet", TypeError, "got Springs, expected a lattice with faces"),
        ("no faces", ValueError, "plot.springs and animate.springs draw ropes and bridges"),
        ("a plane", ValueError, "got positions with 2 components, expected 3"),
        ("too few nodes", ValueError, "a film of 30 nodes and a sheet of 9"),
        ("a frame too far", IndexError, "got frame 16, expected -16 to 15"),
        ("no frame", TypeError, r"got frames=\(0, 0.5\), expected whole numbers"),
        ("a bad frame", ValueError, "where the run has blown up; expected at most"),
        ("only recorded", ValueError, "Simulate without record="),
        ("a batch of one", ValueError, "leave scene= out"),
    ],
)
def test_bad_input_is_refused_in_plain_words(bad, case, error, words):
    with pytest.raises(error, match=words):
        bad[case]()
    assert not plt.get_fignums()
