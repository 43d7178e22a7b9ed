"""Where two shapes in space touch, against distances and depths found by brute force."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from physjax import rigid
from physjax.physics.rigid.space.boxes import find_box_manifolds
from physjax.physics.rigid.space.manifolds import Boxes
from physjax.physics.rigid.space.segments import find_segment_manifolds
from physjax.physics.rigid.space.turning import find_rotation

SIGNS = np.array(list(product((-1.0, 1.0), repeat=3)))
BOX, CAPSULE, SPHERE = rigid.Shape.box((0.9, 0.5, 1.3)), rigid.Shape.capsule(0.2, 0.8), rigid.Shape.sphere(0.3)


def place(shape, rng, count, spread):
    """A shape at random places, as one pair of many worlds."""
    turn = rng.normal(size=(4, count))
    matrix = find_rotation(jnp.asarray(turn / np.linalg.norm(turn, axis=0)))
    center = rng.normal(size=(3, count)) * spread
    axes = tuple(row[:, None] for row in matrix)
    return Boxes(tuple(jnp.asarray(c)[None] for c in center), axes, shape.half[:, None, None], shape.radius[None, None])


def read(box, world):
    """Centre, axes as columns, and half edges, of one world."""
    center = np.array([part[0, world] for part in box.center])
    return center, np.stack([part[:, 0, world] for part in box.axes]), np.asarray(box.half[:, 0, 0])


def measure_distance(a, b, world):
    """The distance of two boxes without their radii, by a bounded quadratic programme."""
    (ca, ra, ha), (cb, rb, hb) = read(a, world), read(b, world)

    def square(x):
        way = ca + ra @ x[:3] - cb - rb @ x[3:]
        return way @ way, np.concatenate([2 * ra.T @ way, -2 * rb.T @ way])

    bounds = [(-h, h) for h in (*ha, *hb)]
    found = minimize(square, np.zeros(6), jac=True, bounds=bounds, options={"ftol": 1e-16, "gtol": 1e-12})
    return np.sqrt(found.fun)


def measure_depth(a, b, world):
    """By how much two boxes overlap along the best of the fifteen axes [m]; negative where they are apart."""
    (ca, ra, ha), (cb, rb, hb) = read(a, world), read(b, world)
    corners = [c + (SIGNS * h) @ r.T for c, r, h in ((ca, ra, ha), (cb, rb, hb))]
    axes = [*ra.T, *rb.T, *(np.cross(x, y) for x in ra.T for y in rb.T)]
    return min(measure_along(x / np.linalg.norm(x), *corners) for x in axes if np.linalg.norm(x) > 1e-3)


def measure_along(axis, first, second):
    return min((first @ axis).max() - (second @ axis).min(), (second @ axis).max() - (first @ axis).min())


def test_boxes_overlap_by_the_least_depth_and_touch_at_their_deepest_point():
    rng = np.random.default_rng(1)
    a, b = place(BOX, rng, 300, 0.6), place(BOX, rng, 300, 0.6)
    found = jax.jit(lambda a, b: find_box_manifolds(0.0, a, b))(a, b)
    normal = np.stack([part[0] for part in found.normal])
    np.testing.assert_allclose(np.linalg.norm(normal, axis=0), 1, rtol=1e-12)
    size = 2 * float(BOX.half.sum())
    overlapping = 0
    for world in range(300):
        depth = measure_depth(a, b, world)
        if depth <= 0:
            continue
        overlapping += 1
        corners = [c + (SIGNS * h) @ r.T for c, r, h in (read(a, world), read(b, world))]
        along = (corners[0] @ normal[:, world]).max() - (corners[1] @ normal[:, world]).min()
        # faces are preferred to edges by a thousandth of the size
        assert -1e-12 <= along - depth <= 2e-3 * size
        assert bool(found.is_point[0, world])
        assert abs(-float(found.gaps[:, 0, world].min()) - along) <= 2e-3 * size
    assert overlapping > 100


@pytest.mark.parametrize(("first", "second"), [("box", "capsule"), ("capsule", "capsule"), ("box", "sphere")])
def test_balls_and_capsules_are_as_far_as_their_nearest_points(first, second):
    rng = np.random.default_rng(2)
    kinds = {"box": BOX, "capsule": CAPSULE, "sphere": SPHERE}
    a, b = place(kinds[first], rng, 80, 0.7), place(kinds[second], rng, 80, 0.7)
    found = jax.jit(lambda a, b: find_segment_manifolds(0.0, a, b, first == "box"))(a, b)
    gap = np.asarray(found.gaps.min(axis=0)[0])
    distance = np.array([measure_distance(a, b, world) for world in range(80)])
    apart = distance > 1e-3
    radii = float(kinds[first].radius + kinds[second].radius)
    # at both ends of the line along which it touches a capsule may be further by a share of the radii
    np.testing.assert_allclose(gap[apart], distance[apart] - radii, atol=1e-4)
    assert apart.sum() > 40


def test_a_box_on_a_box_touches_with_the_four_corners_of_the_smaller_face():
    box = lambda half, height: Boxes(  # noqa: E731
        tuple(jnp.full((1, 1), c) for c in (0.1, height, 0.2)),
        tuple(jnp.eye(3)[k][:, None, None] for k in range(3)),
        jnp.asarray(half)[:, None, None],
        jnp.zeros((1, 1)),
    )
    found = find_box_manifolds(0.0, box((1.0, 0.5, 1.0), 0.5), box((0.3, 0.2, 0.4), 1.21))
    np.testing.assert_allclose(np.ravel(found.normal), [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(np.ravel(found.gaps), 0.01, rtol=1e-12)
    corners = {
        (round(float(x), 9), round(float(z), 9))
        for x, z in zip(found.points[0].ravel(), found.points[2].ravel(), strict=True)
    }
    assert corners == {(0.4, 0.6), (-0.2, 0.6), (0.4, -0.2), (-0.2, -0.2)}


def test_a_capsule_along_a_face_or_another_touches_with_two_points():
    lying = lambda shape, height: Boxes(  # noqa: E731
        tuple(jnp.full((1, 1), c) for c in (0.0, height, 0.0)),
        tuple(jnp.eye(3)[k][:, None, None] for k in range(3)),
        shape.half[:, None, None],
        shape.radius[None, None],
    )
    for lower, sides, top in ((BOX, True, 0.25), (CAPSULE, False, 0.2)):
        found = find_segment_manifolds(0.0, lying(lower, 0.0), lying(CAPSULE, top + 0.2), sides)
        assert sorted({round(float(z), 9) for z in found.points[2].ravel()}) == [-0.4, 0.4]
        np.testing.assert_allclose(np.ravel(found.gaps), 0, atol=1e-15)
