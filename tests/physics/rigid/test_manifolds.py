"""Where two shapes touch, against distances found by brute force."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import rigid
from physjax.physics.rigid.planar.manifolds import Outline, find_manifolds
from physjax.physics.rigid.planar.shapes import tabulate_shapes
from physjax.physics.rigid.solids.pairs import group_contacts

SHAPES = {
    "disc": rigid.PlanarShape.disc(0.4),
    "capsule": rigid.PlanarShape.capsule(0.2, 0.8),
    "box": rigid.PlanarShape.box((1.0, 0.6)),
    "pentagon": rigid.PlanarShape.polygon(
        0.5 * np.stack([np.cos(2 * np.pi * np.arange(5) / 5), np.sin(2 * np.pi * np.arange(5) / 5)], axis=-1),
        radius=0.05,
    ),
}


def place(shape, corners, position, angle):
    """A shape at places `(worlds, 2)` and angles, as one pair of many worlds."""
    table = tabulate_shapes([shape, corners], np.dtype(float))
    c, s = np.cos(angle)[None, None], np.sin(angle)[None, None]
    turn = lambda v: (c * v[..., :1] - s * v[..., 1:], s * v[..., :1] + c * v[..., 1:])  # noqa: E731
    own = lambda rows: rows[:, :1]  # noqa: E731
    (x, y), normals = turn(own(table.corners)), turn(own(table.normals))
    is_edge = jnp.broadcast_to(jnp.asarray(table.is_edge[:, :1])[..., None], x.shape)
    return Outline(
        (x + position[None, None, :, 0], y + position[None, None, :, 1]),
        normals,
        is_edge,
        jnp.full(x.shape[1:], table.radius[0]),
    )


def measure_distance(a, b):
    """The distance of the cores of two convex outlines, by every corner against every edge; valid where they are disjoint."""
    best = np.inf
    for p, q in ((a, b), (b, a)):
        px, py = (np.asarray(part)[:, 0] for part in p.corners)
        qx, qy = (np.asarray(part)[:, 0] for part in q.corners)
        for i in range(len(px)):
            for j in range(len(qx)):
                k = (j + 1) % len(qx)
                ex, ey = qx[k] - qx[j], qy[k] - qy[j]
                share = ((px[i] - qx[j]) * ex + (py[i] - qy[j]) * ey) / np.where(ex**2 + ey**2 > 0, ex**2 + ey**2, 1)
                share = np.clip(share, 0, 1)
                best = np.minimum(best, np.hypot(px[i] - qx[j] - share * ex, py[i] - qy[j] - share * ey))
    return best


def find_disjoint(a, b):
    """Whether an edge of one has all of the other outside; cores without edges are points, and always disjoint."""
    apart = np.zeros(a.corners[0].shape[-1], bool)
    edges = 0
    for p, q in ((a, b), (b, a)):
        for i in np.flatnonzero(np.asarray(p.is_edge)[:, 0, 0]):
            edges += 1
            nx, ny = (np.asarray(part)[i, 0] for part in p.normals)
            px, py = (np.asarray(part)[i, 0] for part in p.corners)
            qx, qy = (np.asarray(part)[:, 0] for part in q.corners)
            apart |= (nx * (qx - px) + ny * (qy - py) > 0).all(axis=0)
    return apart if edges else ~apart


@pytest.mark.parametrize(
    ("first", "second"), [("disc", "disc"), ("disc", "box"), ("capsule", "capsule"), ("box", "pentagon")]
)
def test_gaps_and_normals_are_those_of_the_nearest_points(first, second):
    rng = np.random.default_rng(3)
    where = rng.uniform(-1, 1, (400, 2)) * 1.6
    one, other = SHAPES[first], SHAPES[second]
    a = place(one, other, np.zeros((400, 2)), rng.uniform(-3, 3, 400))
    b = place(other, one, where, rng.uniform(-3, 3, 400))
    found = jax.jit(find_manifolds)(0.0, a, b)
    gap = np.where(found.is_point, found.gaps, np.inf).min(axis=0)[0]
    core = measure_distance(a, b)
    apart = find_disjoint(a, b)
    expected = core - np.asarray(a.radius + b.radius)[0]
    assert apart.sum() > 150
    # an edge that a corner of the other faces is found exactly; of two corners, nearly always the nearest
    assert np.quantile(np.abs(gap - expected)[apart], 0.97) < 1e-9
    assert (gap >= expected - 1e-9)[apart].all()
    nx, ny = (np.asarray(part)[0] for part in found.normal)
    np.testing.assert_allclose(nx**2 + ny**2, 1.0, rtol=1e-12)
    assert (nx * where[:, 0] + ny * where[:, 1] > -0.2)[apart].all()


def test_no_body_comes_up_twice_in_a_group():
    pairs = np.array([(i, j) for i in range(7) for j in range(i)])
    groups = group_contacts(pairs, 2, 7)
    for a, b in zip(groups.a, groups.b, strict=True):
        rows = np.concatenate([a, b])
        assert len(np.unique(rows)) == len(rows)
    contacts = groups.contact[groups.contact < len(pairs) + 14]
    assert sorted(contacts.tolist()) == list(range(len(pairs) + 14))
