"""Boris' method: circles in magnetic fields keep their speed, drifts are the known ones, and derivatives are right."""

import jax
import jax.numpy as jnp
import numpy as np

from physjax import Particles, RigidBodies, Scene, forces, inertia, methods, rigid, simulate

FIELD = np.array([0.3, -1.0, 2.0])


def charges():
    start = Particles(jnp.zeros((2, 3)), jnp.array([[1.0, 2.0, -1.0], [0.0, 0.5, 3.0]]))
    return Scene(start, jnp.array([1.0, 0.5]), (forces.Lorentz(jnp.array([1.0, -2.0]), FIELD),))


def test_the_speed_in_a_magnetic_field_is_kept_to_rounding_at_any_step(precision):
    """At most a unit of rounding a step, with a hundred steps for each turn of the cyclotron or with four."""
    field, start = jnp.asarray([1.0, 1.0], precision.dtype), jnp.asarray([[3.0, 4.0], [3.0, 4.0]], precision.dtype)
    scene = Scene(Particles(jnp.zeros_like(start), start), 1.0, (forces.Lorentz(1.0, field),))
    dt = np.asarray([2 * np.pi / 100, np.pi / 2])
    run = simulate(scene, methods.boris, dt=dt, steps=10_000, save_every=10_000)
    speed = np.hypot(*np.asarray(run.velocity[-1], float).T)
    np.testing.assert_allclose(speed, 5.0, rtol=10_000 * precision.eps)


def test_a_turn_is_that_of_the_tangent_and_the_same_under_vmap():
    """tan(angle/2) = ω dt/2 about the field, in space."""
    scene = charges()
    step = jax.jit(lambda scene: methods.boris(scene, 0.0, scene.state, 0.7))
    after = step(scene)
    for i, omega in enumerate((-1.0, 4.0)):
        axis = FIELD / np.linalg.norm(FIELD)
        angle = 2 * np.arctan(omega * np.linalg.norm(FIELD) * 0.35)
        v = np.asarray(scene.state.velocity[i])
        along = (v @ axis) * axis
        turned = along + np.cos(angle) * (v - along) + np.sin(angle) * np.cross(axis, v)
        np.testing.assert_allclose(after.velocity[i], turned, atol=1e-14)
    alone = lambda state: methods.boris(Scene(state, 1.0, (forces.Lorentz(1.0, FIELD),)), 0.0, state, 0.7)  # noqa: E731
    np.testing.assert_allclose(jax.jit(jax.vmap(alone))(scene.state).velocity[0], after.velocity[0], atol=1e-14)


def test_crossed_fields_drift_at_e_over_b_whatever_the_step():
    """E×B/B² is a fixed velocity of the method too."""
    electric = np.array([2.0, 0.5, 0.0])
    drift = np.cross(electric, [0.0, 0.0, 4.0]) / 16
    start = Particles(jnp.zeros(3), jnp.asarray(drift))
    scene = Scene(start, 1.0, (forces.Lorentz(1.0, (0.0, 0.0, 4.0), electric),))
    run = simulate(scene, methods.boris, dt=3.0, steps=50, save_every=50)
    np.testing.assert_allclose(run.position[-1], 150 * drift, atol=1e-11)


def test_the_derivatives_of_a_step_are_those_of_its_turn():
    """In the plane: v turned by 2 arctan(-B dt/2) about the origin."""
    start = Particles(jnp.zeros(2), jnp.array([1.0, -2.0]))

    def formula(field):
        angle = -2 * jnp.arctan(0.35 * field)
        return jnp.stack([jnp.cos(angle) + 2 * jnp.sin(angle), jnp.sin(angle) - 2 * jnp.cos(angle)])

    step = lambda field: methods.boris(Scene(start, 1.0, (forces.Lorentz(1.0, field),)), 0.0, start, 0.7).velocity  # noqa: E731
    field = jnp.asarray(1.3)
    np.testing.assert_allclose(step(field), formula(field), atol=1e-14)
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(derivative(step))(field), jax.jacfwd(formula)(field), atol=1e-14)


def test_a_body_with_a_drag_of_its_rotation_slows_as_the_mean_of_the_velocities_says():
    body = inertia.sphere(2.0, 0.5)
    spun = rigid.bodies(body, angular_velocity=(0.0, 3.0, 0.0), velocity=(1.0, 0.0, 0.0))
    scene = Scene(spun, body, (rigid.RotationalDrag(0.4),))
    after = methods.boris(scene, 0.0, spun, 0.2)
    assert isinstance(after, RigidBodies)
    x = 0.4 * 0.2 / (2 * float(body.principal[0]))
    np.testing.assert_allclose(after.angular_momentum, spun.angular_momentum * (1 - x) / (1 + x), rtol=1e-12)
    np.testing.assert_allclose(after.momentum, spun.momentum)
