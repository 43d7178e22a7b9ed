"""What was moved otherwise is put back on its joints, with nothing else changed."""

import jax
import jax.numpy as jnp
import numpy as np

from physjax import Scene, inertia, rigid
from physjax.constraints import project_joints


def test_open_joints_are_closed_by_what_their_masses_allow():
    rod = inertia.planar_segment(2.0, 1.0)
    start = rigid.planar_bodies(rod, [[0.0, -0.5], [0.0, -1.5]])
    points = [[[0.0, 0.0], [0.0, 0.5]], [[0.0, -0.5], [0.0, 0.5]]]
    joints = rigid.Joints([(-1, 0), (0, 1)], points)
    scene = Scene(start, rod, (joints,))
    moved = start._replace(position=start.position + 0.05, momentum=start.momentum + 1.0)
    closed = jax.jit(project_joints)(scene, moved)
    assert joints.error(closed).max() < 1e-13
    arm = jnp.stack([0.5 * jnp.cos(closed.angle), 0.5 * jnp.sin(closed.angle)], axis=-1)
    velocity, turning = closed.momentum / 2.0, (closed.angular_momentum / rod.moment)[:, None]
    np.testing.assert_allclose(velocity[0], (turning * arm)[0], atol=1e-13)
    np.testing.assert_allclose(velocity[1] - velocity[0], (turning * arm).sum(axis=0), atol=1e-13)
    np.testing.assert_allclose(jax.jit(project_joints)(scene, closed).position, closed.position, atol=1e-13)
