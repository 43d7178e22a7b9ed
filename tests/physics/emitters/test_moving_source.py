"""Sources that move: births along their path, at their own times and with its velocity, whatever the step."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Scene, emitters, forces, methods, simulate


class Circle(eqx.Module):
    """Round the origin at a rate [rad/s]."""

    rate: jax.Array

    def __call__(self, t):
        return 2.0 * jnp.stack([jnp.cos(self.rate * t), jnp.sin(self.rate * t)])


def ahead(t):
    return jnp.stack([10.0 * t, 0.0 * t])


def smoke(path, **options):
    return emitters.Emitter(100, emitters.Point((0.0, 1.0)), key=0, life=1.0, rate=100.0, path=path, **options)


def puff(emitter):
    return Scene(emitter.unborn(), 1.0, (forces.Gravity(),), emitter=emitter)


@pytest.mark.parametrize("dt", [0.003, 0.09])
def test_a_rocket_at_ten_meters_a_second_leaves_a_puff_every_ten_centimeters(dt):
    emitter = smoke(ahead)
    film = simulate(puff(emitter), methods.rk4, dt=dt, duration=0.9)
    age = np.asarray(film.final_scene.emitter.age(film.time[-1]))
    alive = np.asarray(film.final_scene.emitter.alive(film.time[-1]))
    assert alive.sum() >= 90  # of the one that is due at the end, rounding decides
    # it goes on with the velocity of the rocket, so that at 0.9 s all of it is at 9 m
    np.testing.assert_allclose(
        film.position[-1][alive], np.stack([0 * age + 9, 1 - 4.9 * age**2], -1)[alive], atol=1e-12
    )
    births = emitter.births(jnp.arange(100), jnp.zeros(100, int))
    np.testing.assert_allclose(np.diff(births.position[:, 0]), 0.1, atol=1e-12)


def test_births_on_a_circle_take_over_its_velocity_under_vmap_and_so_do_derivatives():
    def begin(rate):
        birth = smoke(Circle(rate), speed=3.0).births(jnp.arange(100), jnp.zeros(100, int))
        still = smoke(None, speed=3.0).births(jnp.arange(100), jnp.zeros(100, int))
        return birth.position - still.position, birth.velocity - still.velocity

    rates, t = jnp.array([1.0, 4.0]), np.arange(100) / 100
    angle = np.asarray(rates)[:, None] * t
    across = np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
    place, velocity = jax.vmap(begin)(rates)
    np.testing.assert_allclose(place, 2 * np.stack([np.cos(angle), np.sin(angle)], axis=-1), atol=1e-12)
    np.testing.assert_allclose(velocity, 2 * np.asarray(rates)[:, None, None] * across, atol=1e-12)
    slope = jax.jacfwd(lambda rate: begin(rate)[0])(rates[0])
    np.testing.assert_allclose(slope, 2 * t[:, None] * across[0], atol=1e-12)


@pytest.mark.parametrize(
    ("path", "error", "words"),
    [((1.0, 0.0), TypeError, "path: got"), (lambda t: jnp.zeros(3), ValueError, "expected the displacement")],
)
def test_what_is_no_path_is_refused(path, error, words):
    with pytest.raises(error, match=words):
        smoke(path).unborn()
