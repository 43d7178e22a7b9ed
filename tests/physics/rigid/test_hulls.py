"""Convex hulls in space, against boxes, brute force and closed forms."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_spatial_manifolds import BOX, CAPSULE, SPHERE, measure_depth, measure_distance, place

from physjax import Scene, contacts, energy, forces, inertia, methods, rigid, simulate
from physjax.physics.rigid.space.boxes import find_box_manifolds
from physjax.physics.rigid.space.hulls import Hulls, find_hull_manifolds
from physjax.physics.rigid.space.round_hulls import find_nearest_point, find_round_manifolds
from physjax.physics.rigid.space.shapes import build_polyhedra

ROUGH = contacts.Coulomb(0.5, 0.5)
FLOOR = contacts.Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), restitution=0.0, coulomb=ROUGH)
GOLDEN = (1 + 5**0.5) / 2
ICOSAHEDRON = 0.3 * np.array(
    [c for a, b in product((1, -1), (GOLDEN, -GOLDEN)) for c in ((0, a, b), (a, b, 0), (b, 0, a))]
)
CUBE = np.array(list(product((-0.5, 0.5), repeat=3)))
BOXES = build_polyhedra([BOX], np.dtype(float))


def make_solid(points, density=500.0):
    """A hull about its center of mass, with its inertia."""
    rough = rigid.Shape.hull(points)
    solid = inertia.mesh(np.asarray(rough.corners), rough.triangles, density=density)
    return rigid.Shape.hull(np.asarray(rough.corners) - solid.center), solid.inertia


def test_a_hull_has_the_faces_and_edges_of_its_polyhedron():
    inner = np.vstack([CUBE, [[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.5, 0.5, 0.1]]])  # inside, on a face, on an edge
    for points, corners, faces, edges in ((inner, 8, 6, 12), (ICOSAHEDRON, 12, 20, 30)):
        shape = rigid.Shape.hull(points)
        places, topology = shape.polyhedron
        assert (len(places), len(topology.faces), len(topology.edges)) == (corners, faces, edges)
        normals = np.cross(*(np.diff(np.asarray(places)[shape.triangles], axis=1).transpose(1, 0, 2)))
        assert (np.sum(normals * np.asarray(places)[shape.triangles[:, 0]], axis=1) > 0).all()
    _, solid = make_solid(CUBE, density=1.0)
    np.testing.assert_allclose(solid.principal, 1 / 6, rtol=1e-12)


def test_boxes_as_hulls_touch_as_boxes_do():
    rng = np.random.default_rng(1)
    a, b = place(BOX, rng, 300, 0.6), place(BOX, rng, 300, 0.6)
    found = jax.jit(lambda a, b: find_hull_manifolds(0.0, Hulls(a, BOXES), Hulls(b, BOXES)))(a, b)
    right = jax.jit(lambda a, b: find_box_manifolds(0.0, a, b))(a, b)
    overlap = np.array([measure_depth(a, b, world) > 0 for world in range(300)])
    assert overlap.sum() > 100
    for one, other in zip(found.normal, right.normal, strict=True):
        np.testing.assert_allclose(one[0, overlap], other[0, overlap], atol=1e-12)
    np.testing.assert_allclose(found.gaps.min(0)[0, overlap], right.gaps.min(0)[0, overlap], atol=1e-6)
    assert found.is_point[0, overlap].all()


@pytest.mark.parametrize("other", [CAPSULE, SPHERE], ids=["capsule", "sphere"])
def test_balls_and_capsules_are_as_far_from_a_hull_as_their_nearest_points(other):
    rng = np.random.default_rng(3)
    a, b = place(BOX, rng, 80, 0.7), place(other, rng, 80, 0.7)
    found = jax.jit(lambda a, b: find_round_manifolds(0.0, Hulls(a, BOXES), b))(a, b)
    distance = np.array([measure_distance(a, b, world) for world in range(80)])
    apart = distance > 1e-3
    assert apart.sum() > 60
    np.testing.assert_allclose(found.gaps.min(0)[0, apart], distance[apart] - float(other.radius), atol=2e-4)


def test_the_nearest_point_of_a_box_is_found_by_clipping():
    half = np.asarray(BOX.half)[:, None]
    points = np.random.default_rng(4).uniform(-2, 2, (3, 200))
    found = jax.jit(lambda place: find_nearest_point(BOXES, place))(tuple(jnp.asarray(part)[None] for part in points))
    np.testing.assert_allclose(np.stack(found)[:, 0], np.clip(points, -half, half), atol=1e-12)


def test_a_stack_of_cubes_as_hulls_stands_as_boxes_do():
    crate, place = inertia.box(2.0, (1.0, 1.0, 1.0)), np.zeros((3, 3))
    place[:, 1], place[:, 0] = np.arange(3) + 0.5, (0.01, -0.01, 0.02)
    ends = []
    for shape in (rigid.Shape.box((1.0, 1.0, 1.0)), rigid.Shape.hull(CUBE)):
        solids = rigid.Solids(shape, (FLOOR,), coulomb=ROUGH, pairs=[(0, 1), (1, 2)])
        scene = Scene(rigid.bodies(crate, place), crate, (forces.Gravity(),), contacts=(solids,))
        ends.append(simulate(scene, methods.verlet, dt=1 / 60, steps=120, save_every=120).state)
    np.testing.assert_allclose(ends[1].position, ends[0].position, atol=1e-6)
    assert np.abs(ends[1].momentum[-1]).max() < 1e-4


def test_a_wedge_slides_down_a_slope_as_coulomb_says_and_lands_on_its_lowest_face():
    """A triangular prism, tilted with the slope of 30°: a = g (sin θ - μ cos θ)."""
    angle, mu = np.radians(30.0), 0.3
    prism = [[x, y, z] for z in (-0.4, 0.4) for x, y in ((-0.5, 0.0), (0.5, 0.0), (0.0, 0.5))]
    shape, body = make_solid(prism)
    slope = contacts.Plane(
        (0.0, 0.0, 0.0), (-np.sin(angle), np.cos(angle), 0.0), restitution=0.0, coulomb=contacts.Coulomb(mu, mu)
    )
    height = -float(np.asarray(shape.corners)[:, 1].min())
    turn = (np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2))
    start = rigid.bodies(body, [[-height * np.sin(angle), height * np.cos(angle), 0.0]], [turn])
    scene = Scene(start, body, (forces.Gravity(),), contacts=(rigid.Solids(shape, (slope,)),))
    film = simulate(scene, methods.verlet, dt=1 / 60, steps=60, save_every=30).state
    speed = np.linalg.norm(np.asarray(film.momentum[-1, 0])) / float(body.mass)
    assert abs(speed - 9.80665 * (np.sin(angle) - mu * np.cos(angle))) < 5e-3 * speed
    assert np.abs(film.angular_momentum[-1]).max() < 1e-3


def test_a_heap_of_hulls_and_others_loses_energy_and_comes_to_lie():
    rng = np.random.default_rng(0)
    solids = [make_solid(points) for points in (0.4 * CUBE[[0, 3, 5, 6]] * 2, ICOSAHEDRON)]
    shapes = [*(shape for shape, _ in solids), rigid.Shape.box((0.6, 0.4, 0.5)), rigid.Shape.capsule(0.2, 0.5)]
    own = [*(body for _, body in solids), inertia.box(60.0, (0.6, 0.4, 0.5)), inertia.capsule(50.0, 0.2, 0.5)]
    axes = [(1.0, 0.0, 0.0, 0.0) if body.axes is None else body.axes for body in own]
    masses = inertia.Inertia(np.array([float(body.mass) for body in own]), [body.principal for body in own], axes)
    place = np.stack([0.2 * rng.normal(size=4), 0.8 + 1.2 * np.arange(4), 0.2 * rng.normal(size=4)], axis=1)
    heap = rigid.bodies(masses, place, rng.normal(size=(4, 4)))
    contact = rigid.Solids(shapes, (FLOOR,), 0.2, coulomb=ROUGH)
    scene = Scene(heap, masses, (forces.Gravity(),), contacts=(contact,))
    film = simulate(scene, methods.verlet, dt=1 / 60, steps=480, save_every=8)
    stored = np.asarray(jax.vmap(lambda t, state: energy.total(scene, t, state))(film.time, film.state))
    assert np.diff(stored).max() < 1e-5 * stored[0]
    # on a face a hull is as high as its inscribed ball is wide, and it lies no deeper
    lowest = [float(np.min(build_polyhedra([shape], np.dtype(float)).heights)) for shape, _ in solids]
    assert (film.position[-1, :2, 1] > np.array(lowest) - 1e-3).all()
    np.testing.assert_allclose(film.position[-1, 0, 1], lowest[0], atol=1e-3)


def test_what_is_no_hull_is_refused_in_plain_words():
    for points, words in (
        (np.zeros((3, 3)), "expected .points, 3. of 4 to 32"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.0]], "in one plane"),
        (np.random.default_rng(0).normal(size=(33, 3)), "leave out"),
    ):
        with pytest.raises(ValueError, match=words):
            rigid.Shape.hull(points)
    with pytest.raises(TypeError, match="traced"):
        jax.jit(lambda points: rigid.Shape.hull(points).radius)(jnp.asarray(CUBE))
    with pytest.raises(ValueError, match="which is round"):
        rigid.Shape.sphere(1.0).triangles  # noqa: B018
