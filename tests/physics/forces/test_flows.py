"""Flows are without divergence and follow their closed forms; an attractor keeps energy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, fields, forces, methods, simulate


def places(dim, count=4000):
    return jax.random.normal(jax.random.key(1), (count, dim)) * 5.0


@pytest.mark.parametrize("dim", [2, 3])
def test_turbulence_has_no_divergence_and_the_speed_it_says(dim):
    eddies = fields.Turbulence(0.1, 2.0, 0.5, key=0, dim=dim)
    x = places(dim)
    slopes = jax.vmap(jax.jacfwd(lambda x: eddies.flow(0.3, x)))(x)
    divergence = np.trace(slopes, axis1=1, axis2=2)
    assert np.abs(divergence).max() < 1e-13 * np.abs(slopes).max() * 8
    draw = lambda key: fields.Turbulence(0.1, 2.0, 0.5, key=key, dim=dim).flow(0.3, x[:500])  # noqa: E731
    many = jax.jit(jax.vmap(draw))(jax.random.split(jax.random.key(0), 20))
    squares = np.sum(np.square(many), axis=-1).mean(axis=1)
    assert abs(squares.mean() - 4.0) < 3 * squares.std() / np.sqrt(20)
    assert np.abs(eddies.flow(0.0, x) - eddies.flow(0.5, x)).max() > 0.1


def test_dust_goes_with_the_flow():
    """A speck with drag b follows b (u - v): in a uniform flow of speed zero it stops, in a vortex it is turned."""
    b, mass = 1.0, 1e-4
    whirl = fields.Vortex(b, circulation=3.0, core=0.2, center=(0.0, 0.0))
    speck = Scene(Particles(jnp.asarray([[1.0, 0.0]]), jnp.zeros((1, 2))), mass, (whirl, forces.StokesDrag(b)))
    end = simulate(speck, methods.rk4, dt=1e-4, duration=0.2, save_every=2000)
    turn = np.arctan2(end.position[-1, 0, 1], end.position[-1, 0, 0])
    expected = 3.0 / (2 * np.pi) * 0.2  # Γ/2πr² t with r = 1, but for the 1e-4 s that it takes to be carried along
    assert abs(turn - expected) < 3e-4


def test_a_vortex_is_solid_within_and_a_whirl_without():
    whirl = fields.Vortex(1.0, circulation=3.0, core=0.2, center=(0.0, 1.0, 0.0), axis=(0.0, 0.0, 2.0))
    far, near, at = whirl.flow(0.0, jnp.asarray([[4.0, 1.0, 7.0], [1e-4, 1.0, 7.0], [0.0, 1.0, 7.0]]))
    assert np.allclose(far, [0, 3.0 / (8 * np.pi), 0], rtol=1e-12, atol=1e-15)
    assert np.allclose(near, [0, 3.0 / (2 * np.pi * 0.04) * 1e-4, 0], rtol=1e-6, atol=1e-15)
    assert np.all(np.asarray(at) == 0)
    slope = jax.jacfwd(lambda x: whirl.flow(0.0, x))(jnp.asarray([0.0, 1.0, 7.0]))
    assert np.all(np.isfinite(slope))
    assert abs(np.trace(slope)) < 1e-15


def test_an_attractor_keeps_energy_and_its_force_is_the_slope_of_its_potential():
    pull = fields.Attractor(2.0, 0.1, (0.0, 0.0))
    state = Particles(places(2, 5), jnp.zeros((5, 2)))
    slope = jax.grad(lambda x: jnp.sum(pull.potential(0.0, Particles(x, x), jnp.asarray(3.0))))(state.position)
    assert np.allclose(pull(0.0, state, jnp.asarray(3.0)), -slope, rtol=1e-12, atol=1e-14)
    circle = Scene(Particles(jnp.asarray([1.0, 0.0]), jnp.asarray([0.0, (2.0 / 1.01**1.5) ** 0.5])), forces=(pull,))
    end = simulate(circle, methods.rk4, dt=1e-3, duration=5.0, save_every=500)
    assert np.allclose(np.linalg.norm(end.position, axis=-1), 1.0, atol=1e-10)


@pytest.mark.usefixtures("unannotated")
def test_bad_fields_are_refused():
    with pytest.raises(ValueError, match="expected 2 or 3"):
        fields.Turbulence(0.1, 1.0, 1.0, key=0, dim=4)
    with pytest.raises(ValueError, match="size of the eddies"):
        fields.Turbulence(0.1, 1.0, 0.0, key=0)
    with pytest.raises(ValueError, match="an axis in space, none in the plane"):
        fields.Vortex(1.0, 1.0, 1.0, (0.0, 0.0, 0.0))
