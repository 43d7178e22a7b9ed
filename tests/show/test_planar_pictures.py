"""Bodies in the plane are drawn as their shapes, where they are and as they have turned."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Scene, animate, contacts, export, forces, inertia, methods, plot, rigid, simulate
from physjax.show import auto_plot
from physjax.show.planar import build_planar_outline, choose_colours, take_planar_bodies

SHAPES = (
    rigid.PlanarShape.box((2.0, 1.0)),
    rigid.PlanarShape.disc(0.5),
    rigid.PlanarShape.capsule(0.5, 2.0),
    rigid.PlanarShape.polygon([[-1.0, -0.5], [1.0, -0.5], [0.0, 1.0]], 0.2),
)
DISC = inertia.planar_disc(1.0, 0.5)
BODIES = rigid.planar_bodies(
    DISC, [[0.0, 3.0], [3.0, 3.0], [6.0, 3.0], [9.0, 3.0]], angle=[np.pi / 2, 0.0, 0.3, 0.0], angular_velocity=1.0
)
FLOOR = contacts.Plane((0.0, 0.0), (0.0, 1.0))
FREE = simulate(Scene(BODIES, DISC), methods.verlet, dt=0.1, steps=4)


def give_solids(run, shapes, surfaces=()):
    """The run as one of a scene with solids, which are not compiled: none of its bodies touch."""
    solids = rigid.Solids(shapes, surfaces=surfaces)
    return dataclasses.replace(run, scene=Scene(run.scene.state, DISC, contacts=(solids,)))


FILM = give_solids(FREE, SHAPES, (FLOOR,))


def area(corners):
    x, y = corners.T
    return 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))


@pytest.mark.parametrize(
    ("shape", "exact"),
    [
        (SHAPES[0], 2.0),
        (SHAPES[1], np.pi / 4),
        (SHAPES[2], 2.0 + np.pi / 4),
        (SHAPES[3], 1.5 + 0.2 * (2 + 2 * np.hypot(1.0, 1.5)) + 0.04 * np.pi),
    ],
)
def test_an_outline_goes_round_the_area_of_its_shape_once(shape, exact):
    assert area(build_planar_outline(shape).corners) == pytest.approx(exact, rel=0.003)


def test_only_a_disc_has_a_line_on_it_as_long_as_its_radius():
    lengths = [np.ptp(build_planar_outline(shape).line[:, 0]) for shape in SHAPES]
    np.testing.assert_allclose(lengths, [0.0, 0.5, 0.0, 0.0])


def test_every_body_is_drawn_where_it_is_and_as_it_has_turned():
    seen, draw = take_planar_bodies("plot.bodies", FILM, None, None)
    np.testing.assert_allclose(np.ptp(seen.position[0, :4], axis=0), [1.0, 2.0], atol=1e-6)
    figure = plot.bodies(FILM, frames=[0, -1])
    fill, lines = figure.axes[1].collections[-2:]
    assert len(fill.get_paths()) == len(lines.get_paths()) == 4
    disc = lines.get_paths()[1].vertices
    np.testing.assert_allclose(disc, [[3.0, 3.0], [3.0 + 0.5 * np.cos(0.4), 3.0 + 0.5 * np.sin(0.4)]], atol=1e-6)
    assert len({tuple(colour) for colour in draw.colours}) == 4


def test_the_surfaces_of_solids_are_drawn_behind_them():
    ax = plot.bodies(FILM, frames=0).axes[0]
    assert ax.get_ylim()[0] < 0 < ax.get_ylim()[1]  # the floor, 2 m below them
    assert len(ax.collections) == 4  # its shade, its edge, bodies and lines


def test_bodies_without_solids_are_points_with_a_direction():
    seen, draw = take_planar_bodies("plot.bodies", FREE, None, None)
    ahead = draw.tips - draw.place
    np.testing.assert_allclose(np.arctan2(ahead[..., 1], ahead[..., 0]), FREE.state.angle, atol=1e-6)
    assert seen.position.shape == (5, 8, 2)
    ax = plot.bodies(FREE, frames=-1).axes[0]
    assert sorted(len(part.get_paths()) for part in ax.collections) == [1, 4]  # dots share one path


def test_a_run_draws_itself_and_is_filmed_and_exported(tmp_path):
    assert len(auto_plot.plot_run(FILM).axes) == 1
    assert auto_plot.animate_run(FILM).save(tmp_path / "solids.html", progress=False).stat().st_size > 1000
    assert animate.bodies(FREE, fps=10).save(tmp_path / "free.gif", progress=False).stat().st_size > 1000
    assert export.gltf(FILM, tmp_path / "solids.glb", progress=False).stat().st_size > 1000


@pytest.fixture(scope="module")
def resting():
    """A disc that lies on the floor."""
    floor = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.0)
    solids = rigid.Solids(SHAPES[1], surfaces=(floor,), pairs=(), substeps=1)
    scene = Scene(rigid.planar_bodies(DISC, [[0.0, 0.5]]), DISC, (forces.Gravity(9.8),), contacts=(solids,))
    return simulate(scene, methods.verlet, dt=0.01, steps=4)


def test_contacts_are_dots_and_their_forces_arrows_in_a_scale_that_is_said(resting):
    ax = plot.bodies(resting, frames=-1, contacts=True).axes[0]
    dots, arrows = ax.collections[-2:]
    np.testing.assert_allclose(dots.get_offsets(), [[0.0, 0.0]], atol=1e-3)
    np.testing.assert_allclose([arrows.U, arrows.V], [[0.0], [9.8]], rtol=0.05, atol=1e-9)  # of 1 kg, onto the body
    assert ax.get_title() == "t = 0.0400 s\narrows: 100 N per metre"
    assert arrows.scale == 100.0  # a tenth of a metre, of a disc of 1 m
    film = animate.bodies(resting, contacts=True, fps=100)
    assert film.still(0).axes[0].collections[-1].U.size == 0  # before the first step


def test_contacts_of_what_has_none_are_refused():
    with pytest.raises(ValueError, match=r"without rigid\.Solids or without a step"):
        plot.bodies(FREE, contacts=True)
    with pytest.raises(ValueError, match="without a step"):
        plot.bodies(dataclasses.replace(FILM, dt=None), contacts=True)


def test_worlds_side_by_side_are_drawn_together():
    worlds = rigid.planar_bodies(DISC, jnp.arange(12.0).reshape(3, 2, 2) + 1.0)
    run = give_solids(simulate(Scene(worlds, DISC), methods.verlet, dt=0.1, steps=1), SHAPES[1])
    _, draw = take_planar_bodies("plot.bodies", run, None, None)
    assert len(draw.outlines) == 6


def test_colours_are_one_for_all_or_by_a_value_for_each():
    assert (choose_colours("x", "red", 3) == [1.0, 0.0, 0.0, 1.0]).all()
    same, other, again = choose_colours("x", [1.0, 2.0, 1.0], 3)
    assert (same == again).all()
    assert (same != other).any()
    with pytest.raises(ValueError, match="expected a colour or a finite number"):
        choose_colours("x", [1.0, np.nan, 1.0], 3)


def test_shapes_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="got 2 shapes"):
        plot.bodies(FILM, SHAPES[:2])
    with pytest.raises(ValueError, match="PlanarShape"):
        plot.bodies(FILM, [None] * 4)
