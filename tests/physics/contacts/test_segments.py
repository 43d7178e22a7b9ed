"""Segments and faces against surfaces."""

import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, contacts


def ends(a, b, va, vb):
    return [Particles(jnp.asarray(x, float), jnp.asarray(v, float)) for x, v in ((a, va), (b, vb))]


@pytest.mark.parametrize(
    ("surface", "share", "gap"),
    [
        (contacts.Plane((0.0, 0.0), (0.0, 1.0)), 1.0, 0.5),
        (contacts.Sphere((0.0, -1.0), 1.0), 0.5, np.hypot(0.0, 1.75) - 1),
        (contacts.Sphere((0.0, 0.0), 3.0, inside=True), 0.0, 3 - np.sqrt(2)),
        (contacts.Sphere((9.0, 0.5), 1.0), 1.0, 7.0),
        (contacts.Slab((0.0, 0.75), (1.0, 0.0), thickness=0.2), 0.5, -0.1),
    ],
    ids=("plane", "ball", "bowl", "ball beyond the end", "slab"),
)
def test_the_deepest_point_of_a_segment(surface, share, gap):
    a, b = jnp.asarray([-1.0, 1.0]), jnp.asarray([1.0, 0.5])
    nearest = contacts.nearest_on_segment(surface, 0.0, a, b)
    dense = np.asarray(a) + np.linspace(0, 1, 100_001)[:, None] * np.asarray(b - a)
    gaps = np.asarray(surface.signed_distance(0.0, jnp.asarray(dense)))
    assert float(nearest.signed_distance) == pytest.approx(gaps.min(), abs=1e-9)
    assert float(nearest.share) == pytest.approx(np.argmin(gaps) / 100_000, abs=1e-4)
    if share in (0.0, 1.0):
        assert float(nearest.share) == share
        assert float(nearest.signed_distance) == pytest.approx(gap)


def test_an_edge_that_meets_a_ball_in_its_middle_shares_the_push():
    ball = contacts.Sphere((0.0, 0.0), 1.0, restitution=1.0)
    masses = (1.0, 3.0)
    before = ends([-1.0, 0.9], [0.5, 0.9], [0.0, -2.0], [0.0, -2.0])
    after = contacts.respond_segment(ball, 0.0, *before, masses=masses)
    # the contact point is on the ball now; the edge has rotated a little about it
    share = contacts.nearest_on_segment(ball, 0.0, *(state.position for state in before)).share
    contact_point = (1 - share) * after[0].position + share * after[1].position
    assert float(ball.signed_distance(0.0, contact_point)) == pytest.approx(0.0, abs=1e-12)
    energy = lambda pair: sum(m * float(jnp.sum(s.velocity**2)) for m, s in zip(masses, pair, strict=True))  # noqa: E731
    assert energy(after) == pytest.approx(energy(before), rel=1e-12)
    sideways = sum(m * float(s.velocity[0]) for m, s in zip(masses, after, strict=True))
    assert sideways == pytest.approx(0.0, abs=1e-12)
    clear = ends([-1.0, 2.0], [0.5, 2.0], [0.0, -2.0], [0.0, -2.0])
    for was, now in zip(clear, contacts.respond_segment(ball, 0.0, *clear), strict=True):
        np.testing.assert_array_equal(was, now)


def test_an_edge_that_meets_a_plane_with_one_end_leaves_the_other_alone():
    floor = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.5)
    before = ends([0.0, -0.1], [1.0, 0.4], [1.0, -2.0], [1.0, -2.0])
    low, high = contacts.respond_segment(floor, 0.0, *before)
    np.testing.assert_allclose(low, [[0.0, 0.0], [1.0, 1.0]], atol=1e-15)
    np.testing.assert_array_equal(high, before[1])


def test_a_face_set_down_touches_with_its_corners():
    floor = contacts.Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    square = jnp.asarray([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    flat = contacts.touching_corners(floor, 0.0, square)
    assert flat.touching.all()
    tilted = contacts.touching_corners(floor, 0.0, square.at[1:3, 1].set(0.2))
    np.testing.assert_array_equal(tilted.touching, [True, False, False, True])
    np.testing.assert_allclose(tilted.signed_distance, [0.0, 0.2, 0.2, 0.0])
