"""Bodies attract each other as Newton says, in tiles that cost linear memory and change nothing."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, backend, forces, methods, simulate
from physjax.backend import SOURCES_PER_TILE


def bodies(*shape, dtype=float, seed=0):
    """Positions and strengths (G m) of some bodies."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=shape).astype(dtype), rng.uniform(0.1, 3.0, size=shape[:-1]).astype(dtype)


@jax.jit
def attraction(force, x, mass=1.0):
    return force.acceleration(0.0, Particles(x, x), jnp.asarray(mass, x.dtype))


@jax.jit
def attraction_and_energy(force, x, mass=1.0):
    return attraction(force, x, mass), force.potential(0.0, Particles(x, x), jnp.asarray(mass, x.dtype))


def by_hand(x, gm, softening=0.0):
    """Accelerations, potential energies for unit masses, and the sums of their terms' magnitudes, all pairs at once."""
    x, gm = np.asarray(x, float), np.asarray(gm, float)
    offsets = x[None, :, :] - x[:, None, :]
    square = np.sum(offsets**2, axis=-1)
    apart = square > 0
    near = np.where(apart, 1 / np.sqrt(np.where(apart, square, 1.0) + softening**2), 0.0)
    terms = (gm * near**3)[..., None] * offsets
    return terms.sum(axis=1), np.abs(terms).sum(axis=1), -0.5 * np.sum(gm * near, axis=1)


# fewer bodies than a tile, one tile, one more, some tiles, and a part of one
@pytest.mark.parametrize(
    ("n", "softening"),
    [
        (2, None),
        (5, 0.3),
        (SOURCES_PER_TILE, None),
        (SOURCES_PER_TILE + 1, 0.3),
        (3 * SOURCES_PER_TILE, 0.3),
        (3 * SOURCES_PER_TILE + 7, None),
    ],
)
def test_tiles_equal_the_sum_over_all_pairs(n, softening, precision):
    x, gm = bodies(n, 3, dtype=precision.dtype)
    force = forces.Gravitation(gm=gm, softening=softening)
    wanted, size, potential = by_hand(x, gm, softening or 0.0)
    found, energy = attraction_and_energy(force, jnp.asarray(x))
    assert found.dtype == energy.dtype == precision.dtype
    assert np.all(np.abs(np.asarray(found, float) - wanted) <= (8 + math.sqrt(n)) * precision.eps * size)
    np.testing.assert_allclose(energy, potential, rtol=(4 + math.sqrt(n)) * precision.eps, atol=0)


@pytest.mark.parametrize(("n", "softening"), [(5, None), (SOURCES_PER_TILE + 7, 0.3)])
def test_the_force_is_minus_the_gradient_of_the_total_energy(n, softening):
    x, mass = bodies(n, 2)
    force = forces.Gravitation(G=0.7, softening=softening)
    slope = jax.jit(jax.grad(lambda x: jnp.sum(attraction_and_energy(force, x, mass)[1])))(jnp.asarray(x))
    newtons = mass[:, None] * np.asarray(attraction(force, jnp.asarray(x), mass))
    np.testing.assert_allclose(-slope, newtons, rtol=0, atol=1e-14 * np.abs(newtons).max())


@pytest.mark.parametrize("n", [5, SOURCES_PER_TILE + 7])
def test_action_equals_reaction(n, precision):
    x, mass = bodies(n, 3, dtype=precision.dtype)
    newtons = mass[:, None].astype(float) * np.asarray(
        attraction(forces.Gravitation(G=1.0), jnp.asarray(x), mass), float
    )
    assert np.all(np.abs(newtons.sum(axis=0)) <= 4 * precision.eps * np.abs(newtons).sum(axis=0))


def test_momentum_is_conserved_to_rounding_over_a_run():
    x, mass = bodies(9, 3)
    v = bodies(9, 3, seed=1)[0]
    pull = forces.Gravitation(G=1.0, softening=0.1)
    flight = simulate(Scene(Particles(x, v), mass, (pull,)), methods.rk4, dt=0.01, steps=500)
    momentum = np.einsum("n,fnd->fd", mass, flight.velocity)
    size = np.einsum("n,fnd->f", mass, np.abs(flight.velocity)).max()
    assert np.abs(momentum - momentum[0]).max() <= 1e-14 * size
    assert np.abs(flight.velocity[-1] - v).max() > 0.5, "the bodies do pull"


def test_mass_with_its_constant_and_gm_agree():
    x, mass = bodies(6, 2)
    together = attraction(forces.Gravitation(G=6.673e-11), jnp.asarray(x), mass)
    np.testing.assert_allclose(together, by_hand(x, 6.673e-11 * mass)[0], rtol=1e-13, atol=0)
    by_gm = attraction(forces.Gravitation(gm=6.67430e-11 * mass), jnp.asarray(x), 5.0)
    by_mass = attraction(forces.Gravitation(), jnp.asarray(x), mass)
    np.testing.assert_allclose(by_gm, by_mass, rtol=1e-14, atol=0)


def test_two_bodies_return_after_keplers_period():
    a, e, masses, G = 2.0, 0.9, np.array([3.0, 1.0]), 0.5
    mu = G * masses.sum()
    period = 2 * math.pi * math.sqrt(a**3 / mu)
    shares = np.array([[-0.25], [0.75]])  # of the distance from the centre of mass
    x = shares * [a * (1 - e), 0.0]
    v = shares * [0.0, math.sqrt(mu / a * (1 + e) / (1 - e))]
    scene = Scene(Particles(x, v), masses, (forces.Gravitation(G=G),))
    steps = 40000
    flight = simulate(scene, methods.rk4, dt=period / steps, steps=steps, save_every=steps // 2)
    np.testing.assert_allclose(flight.position[1], shares * [-a * (1 + e), 0.0], rtol=0, atol=1e-8)
    np.testing.assert_allclose(flight.position[2], x, rtol=0, atol=1e-8)


@pytest.mark.parametrize(("n", "softening"), [(4, 0.3), (SOURCES_PER_TILE + 7, None)])
def test_coincident_bodies_do_not_act_on_each_other_and_everything_stays_finite(n, softening):
    x, gm = bodies(n, 3, dtype=np.float32)
    x[[0, 1, 2, -1]] = 0.0
    others = np.arange(2, n - 1)

    def weighed(force, x):
        parts = attraction_and_energy(force, x)
        return sum(jnp.vdot(part, jnp.arange(part.size, dtype=part.dtype)) for part in parts), parts[0][0]

    @jax.jit
    def derivatives(*at):
        forward = jax.jvp(weighed, at, jax.tree.map(jnp.ones_like, at), has_aux=True)
        return jax.value_and_grad(weighed, argnums=(0, 1), has_aux=True)(*at), forward

    with jax.enable_x64(False):  # float32, where a derivative leaves the range first
        ((_, pull), _), _ = found = derivatives(forces.Gravitation(gm=gm, softening=softening), jnp.asarray(x))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
    terms, size, _ = by_hand(x[[0, *others]], gm[[0, *others]], softening or 0.0)
    assert np.all(np.abs(np.asarray(pull, float) - terms[0]) <= 16 * np.finfo(np.float32).eps * size[0])


def test_a_body_beside_the_origin_keeps_its_gradient_where_tiles_are_filled_up():
    with jax.enable_x64(False):
        x, gm = bodies(SOURCES_PER_TILE + 7, 2, dtype=np.float32)
        x[0] = 1e-13, 0.0
        force = forces.Gravitation(gm=gm)
        slope = jax.jit(jax.grad(lambda x: jnp.sum(attraction(force, x) ** 2)))(jnp.asarray(x))
        assert np.isfinite(slope).all()


@pytest.mark.parametrize("distance", [1.5e11, 5.9e12], ids=["earth", "pluto"])
def test_float32_is_enough_for_gradients_across_the_solar_system(distance):
    x = distance * np.array([[0.0, 0.0], [0.6, 0.8]], np.float32)
    gm = np.array([1.327e20, 8.7e11], np.float32)
    along = np.array([0.6, 0.8])
    exact = 1.327e20 / distance**3 * (3 * np.outer(along, along) - np.eye(2))
    with jax.enable_x64(False):
        force = forces.Gravitation(gm=gm)
        for jacobian in (jax.jacrev, jax.jacfwd):
            slope = jax.jit(jacobian(lambda x: attraction(force, x)))(jnp.asarray(x))[1, :, 1]
            np.testing.assert_allclose(slope, exact, rtol=0, atol=1e-6 * np.abs(exact).max())


def test_scenes_side_by_side_do_not_see_each_other():
    x, mass = map(jnp.asarray, bodies(3, SOURCES_PER_TILE + 7, 3))
    force = forces.Gravitation(G=0.7, softening=0.05)
    ways = jax.jit(
        lambda *a: (attraction_and_energy(force, *a), jax.vmap(lambda *b: attraction_and_energy(force, *b))(*a))
    )
    for pull, energy in ways(x, mass):
        for i in range(3):
            alone = attraction_and_energy(force, x[i], mass[i])
            size = by_hand(x[i], 0.7 * mass[i], 0.05)[1]
            assert np.all(np.abs(pull[i] - alone[0]) <= 4e-16 * size)
            np.testing.assert_allclose(energy[i], alone[1], rtol=1e-14, atol=0)


def test_numbers_can_be_swept_by_vmap():
    x, mass = bodies(4, 2)
    constants, softenings = jnp.asarray([0.5, 1.0, 2.0]), jnp.asarray([0.0, 0.1, 0.2])
    swept = jax.vmap(lambda G, e: attraction(forces.Gravitation(G=G, softening=e), jnp.asarray(x), mass))
    for found, G, e in zip(swept(constants, softenings), constants, softenings, strict=True):
        np.testing.assert_allclose(found, by_hand(x, float(G) * mass, float(e))[0], rtol=0, atol=1e-13)


@pytest.mark.parametrize("reverse", [False, True], ids=["value", "gradient"])
def test_memory_is_linear_in_the_number_of_bodies(reverse):
    def pull(x):
        return attraction(forces.Gravitation(G=1.0), x)

    def needed(n):
        function = jax.grad(lambda x: jnp.sum(pull(x) ** 2)) if reverse else pull
        x = jax.ShapeDtypeStruct((n, 3), jnp.float32)
        return jax.jit(function).lower(x).compile().memory_analysis().temp_size_in_bytes

    # so many that blocks of a size that suits a card, which may be stored, are few beside all pairs
    with jax.enable_x64(False):
        small, large = needed(16_384), needed(32_768)
    assert large < 32_768 * 32_768 * 4 / 8
    assert large < 2.2 * small + 4096


def compare_as_if_for_a_gpu(monkeypatch, way, compute, *numbers):
    """What is traced for a CPU and as if for a GPU, in one of its ways, gives the same to rounding."""
    wanted = jax.jit(lambda *a: compute(*a))(*numbers)
    monkeypatch.setattr(backend, "device_kind", lambda: "gpu")
    monkeypatch.setattr(backend, "MIN_BODIES_FOR_KERNEL", 1 if way == "kernel" else 10**9)
    monkeypatch.setattr(backend, "TARGETS_PER_BLOCK", 16 if way == "blocks" else 4096)
    found = jax.jit(lambda *a: compute(*a))(*numbers)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * np.abs(b).max())


@pytest.mark.parametrize("way", ["kernel", "reduction", "blocks"])
def test_a_gpu_finds_the_same_as_a_cpu(way, monkeypatch):
    find = partial(attraction_and_energy.__wrapped__, forces.Gravitation(G=0.7, softening=0.05))
    x, mass = map(jnp.asarray, bodies(2, SOURCES_PER_TILE + 7, 3))
    compare_as_if_for_a_gpu(monkeypatch, way, lambda *a: (find(*a), jax.vmap(find)(*a)), x, mass)


def test_its_derivatives_are_those_of_the_sum_by_tiles(monkeypatch):
    def weigh(softening, x, mass):
        force = forces.Gravitation(G=0.7, softening=softening)
        return sum(jnp.sum(part**3) for part in attraction_and_energy.__wrapped__(force, x, mass))

    (x, u), (mass, _) = map(jnp.asarray, bodies(2, SOURCES_PER_TILE + 7, 2))
    compute = lambda *a: (  # noqa: E731
        jax.grad(weigh, argnums=(0, 1, 2))(*a),
        jax.jvp(jax.grad(lambda x: weigh(a[0], x, a[2])), (x,), (u,)),
    )
    compare_as_if_for_a_gpu(monkeypatch, "reduction", compute, jnp.asarray(0.05), x, mass)


def test_a_single_point_is_no_system_of_bodies():
    scene = Scene(Particles(np.zeros(2), np.zeros(2)), forces=(forces.Gravitation(),))
    with pytest.raises(
        ValueError, match=r"Gravitation: got a state without lanes, expected positions \(\*scenes, nodes, dim\)"
    ):
        scene.acceleration(0.0, scene.state)
