"""Second derivatives of whole runs that start where a vector has no length: the same in every nesting of the two modes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, forces, methods, simulate, springs


def push(f):
    """The derivative of a function of one number, by forward mode."""
    return lambda s: jax.jvp(f, (s,), (jnp.ones(()),))[1]


NESTINGS = {
    "forward of forward": lambda f: push(push(f)),
    "forward of reverse": lambda f: push(jax.grad(f)),  # as `jax.hessian` has it
    "reverse of reverse": lambda f: jax.grad(jax.grad(f)),
    "reverse of forward": lambda f: jax.grad(push(f)),
}
WIND, ORIGIN = jnp.asarray([1.0, 2.0]), jnp.zeros(2)


def alone(*acting, velocity=ORIGIN):
    """A ball at the origin; the argument moves it and gives it speed."""
    return lambda p: Scene(Particles(p[:2], velocity + p[2:]), 2.0, acting)


def joined(*acting):
    """Two bodies at one point; the argument moves the second and gives it speed."""
    second = jnp.asarray([[0.0], [1.0]])
    return lambda p: Scene(Particles(second * p[None, :2], second * p[None, 2:]), 2.0, acting)


STARTS = {
    "quadratic drag, at rest": alone(forces.QuadraticDrag(0.1, 0.4)),
    "quadratic drag, with the wind": alone(forces.QuadraticDrag(0.1, 0.4, wind=WIND), velocity=WIND),
    "sphere drag, at rest": alone(forces.SphereDrag(1e-3)),
    "sphere drag, with the wind": alone(forces.SphereDrag(1e-3, wind=WIND), velocity=WIND),
    "lift, at rest": alone(forces.Magnus(0.1, 0.3, axis=1.0)),
    "lift, with the wind": alone(forces.Magnus(0.1, 0.3, axis=1.0, wind=WIND), velocity=WIND),
    "a rope at its anchor": alone(forces.Anchor(ORIGIN, 5.0, rest_length=1.0, damping=0.3)),
    "an anchor without a length": alone(forces.Anchor(ORIGIN, 5.0, rest_length=0.0)),
    "a blast at its center": alone(forces.Blast(ORIGIN, 0.3, reach=0.5, at=0.0, duration=0.1)),
    "a spring whose ends meet": joined(springs.Springs([[0, 1]], 5.0, 1.0, damping=0.2)),
    "a spring without a length": joined(springs.Springs([[0, 1]], 5.0, 0.0)),
    "a spring without a length that breaks": joined(springs.Springs([[0, 1]], 5.0, 0.0, breaks_at=0.1)),
    "a spring without a length that yields": joined(springs.Springs([[0, 1]], 5.0, 0.0, yields_at=0.1)),
    "attraction at one point": joined(forces.Gravitation(G=1.0, softening=0.5)),
}


def second_derivatives(start, method, steps):
    """The second derivative of a mixture of the end's numbers along one direction of the start, in every nesting."""

    def end(s):
        state = simulate(start(s * jnp.asarray([1.0, -0.5, 2.0, 3.0])), method, dt=0.01, steps=steps).final_scene.state
        return sum(jnp.vdot(leaf, jnp.arange(1.0, 1 + leaf.size)) for leaf in state)

    return jax.jit(lambda s: jnp.stack([nest(end)(s) for nest in NESTINGS.values()]))(jnp.zeros(()))


def demand_alike(found):
    assert np.isfinite(found[0])
    np.testing.assert_allclose(found, np.full(4, found[0]), rtol=1e-13, atol=1e-14)


def test_a_ball_at_rest_has_second_derivatives_of_drag_and_of_its_rope():
    rope = forces.Anchor(ORIGIN, 5.0, rest_length=1.0)
    demand_alike(second_derivatives(alone(forces.QuadraticDrag(0.1, 0.4), rope), methods.semi_implicit_euler, 3))


@pytest.mark.slow
@pytest.mark.parametrize("start", STARTS.values(), ids=STARTS)
def test_a_run_from_where_a_length_is_zero_has_second_derivatives(start):
    demand_alike(second_derivatives(start, methods.semi_implicit_euler, 3))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["quadratic drag, at rest", "a spring whose ends meet"])
def test_a_run_with_checkpoints_of_steps_with_stages_has_them_too(name):
    demand_alike(second_derivatives(STARTS[name], methods.rk4, 20))
