"""Rods keep their length under every method: pendulums and chains move as their equations say, with the tensions of statics."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from physjax import (
    Particles,
    Pins,
    Scene,
    constraint_forces,
    energy,
    forces,
    methods,
    simulate,
    springs,
    stability,
    state_after,
)
from physjax.select import select_lane

G = 9.8


def place_bobs(angles):
    """Where the bobs of a pendulum of unit rods hang, given the angle of each rod."""
    steps = jnp.stack([jnp.sin(angles), -jnp.cos(angles)], axis=-1)
    return jnp.cumsum(steps, axis=-2)


def pendulum(angles, mass=1.0, acting=(), **options):
    """A pendulum of unit rods, one after the other, that hangs from the origin."""
    x = place_bobs(jnp.asarray(angles))
    pairs = [(i - 1, i) for i in range(x.shape[-2])]
    rods = springs.Rods(pairs, anchors=[(0.0, 0.0)], **options)
    return Scene(Particles(x, jnp.zeros_like(x)), mass, (forces.Gravity(G), *acting, rods))


def chain(links, load, length, sag=0.0, substeps=1):
    """A chain of links of 1 kg between pinned ends, or hanging askew from one, with a load at its middle, or its end."""
    angle = np.full(links, -1.0) if sag == 0 else np.arcsin(np.linspace(-sag, sag, links))
    steps = length * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    x = jnp.asarray(np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]))
    mass, pinned = np.ones(links + 1), np.arange(links + 1) == 0
    mass[links if sag == 0 else links // 2] = load
    pinned[-1] = sag > 0
    rods = springs.Rods([(i, i + 1) for i in range(links)], substeps=substeps)
    return Scene(Particles(x, jnp.zeros_like(x)), mass, (forces.Gravity(G), rods), pinned=pinned)


def find_openings(scene, film):
    """By how much rods are longer than they should be, relative, and how fast they lengthen, frame by frame."""
    rods = scene.forces[-1]
    first, second = np.asarray(rods.pairs).T
    ends = [np.asarray(a) for a in (film.position, film.velocity)]
    if rods.anchors is not None:
        places = np.broadcast_to(rods.anchors, (*ends[0].shape[:-2], *rods.anchors.shape))
        ends = [
            np.concatenate([ends[0], places[..., ::-1, :]], axis=-2),
            np.concatenate([ends[1], 0 * places], axis=-2),
        ]
    apart, opening = (a[..., second, :] - a[..., first, :] for a in ends)
    length = np.linalg.norm(apart, axis=-1)
    return length / np.asarray(rods.length) - 1, np.sum(apart * opening, axis=-1) / length


@functools.cache
def solve_double_pendulum(duration):
    """Where the bobs of two unit rods from (1, 0.5) rad are, by DOP853 of the equations of the angles."""

    def rate(t, y):
        a, b, u, v = y
        matrix = [[2.0, np.cos(a - b)], [np.cos(a - b), 1.0]]
        right = [-np.sin(a - b) * v * v - 2 * G * np.sin(a), np.sin(a - b) * u * u - G * np.sin(b)]
        return [u, v, *np.linalg.solve(matrix, right)]

    end = solve_ivp(rate, (0, duration), [1.0, 0.5, 0.0, 0.0], method="DOP853", rtol=1e-12, atol=1e-12).y[:2, -1]
    return np.asarray(place_bobs(jnp.asarray(end)))


def test_a_double_pendulum_is_that_of_its_angles_to_order_2_and_to_order_4():
    scene = pendulum([1.0, 0.5])
    off = lambda scene, dt: np.abs(  # noqa: E731
        state_after(scene, methods.verlet, duration=5.0, dt=dt).state.position - solve_double_pendulum(5.0)
    ).max()
    errors = [off(scene, dt) for dt in (1e-3, 5e-4)]
    assert errors[0] < 2e-5
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.01)
    assert off(pendulum([1.0, 0.5], order=4), 4e-3) < 1e-6


def test_rods_are_closed_after_each_step_of_an_implicit_method():
    scene = pendulum([1.0, 0.5, 2.0], acting=(forces.StokesDrag(0.1),))
    film = simulate(scene, methods.implicit_midpoint, dt=0.01, steps=100)
    stretch, opening = find_openings(scene, film)
    assert np.abs(stretch).max() < 1e-11
    assert np.abs(opening).max() < 1e-12


def test_energy_is_kept_without_a_trend():
    scene = pendulum([1.0, 0.5])
    film = simulate(scene, methods.verlet, dt=1e-3, steps=40_000, save_every=10)
    stored = np.asarray(jax.vmap(lambda t, s: energy.total(scene, t, s))(film.time, film.state))
    trend = np.polyfit(film.time, stored - stored[0], 1)[0] * float(film.time[-1])
    assert np.ptp(stored) < 1e-4 * 2 * G
    assert abs(trend) < 1e-6 * 2 * G


def test_a_rope_whipped_by_a_load_of_1800_times_a_link_stays_closed_and_keeps_its_energy():
    links = 20
    x = jnp.linspace(0.0, 2.0, links + 1)[:, None] * jnp.array([[1.0, 0.0]])
    mass = np.where(np.arange(links + 1) < links, 1.0, 1800.0)
    rods = springs.Rods([(i, i + 1) for i in range(links)], substeps=None)
    scene = Scene(Particles(x, jnp.zeros_like(x)), mass, (forces.Gravity(G), rods), pinned=np.arange(links + 1) == 0)
    film = simulate(scene, methods.verlet, dt=1 / 120, steps=1200, save_every=40)
    assert np.abs(find_openings(scene, film)[0]).max() < 1e-10
    stored = np.asarray(jax.vmap(lambda t, s: energy.total(scene, t, s))(film.time, film.state))
    # of what the load falls from its height to the bottom
    assert np.abs(stored - stored[0]).max() < 2e-3 * 1800.0 * G * 2.0


def test_no_mass_ratio_opens_a_rod():
    scene = chain(30, 100.0, 0.3, sag=0.5, substeps=8)
    film = simulate(scene, methods.verlet, dt=1 / 120, steps=120)
    stretch, opening = find_openings(scene, film)
    pinned = np.asarray(scene.pinned)
    assert np.abs(stretch).max() < 1e-6
    assert np.abs(opening).max() < 1e-9
    assert (film.position[:, pinned] == scene.state.position[None, pinned]).all()


def test_a_conical_pendulum_circles_at_its_height():
    angle = 0.7
    omega = np.sqrt(G / np.cos(angle))
    x = jnp.asarray([[np.sin(angle), -np.cos(angle), 0.0]])
    v = jnp.asarray([[0.0, 0.0, omega * np.sin(angle)]])
    rods = springs.Rods([(-1, 0)], anchors=[(0.0, 0.0, 0.0)], order=4)
    cone = Scene(Particles(x, v), 3.0, (forces.Gravity(G), rods))
    film = simulate(cone, methods.verlet, dt=2 * np.pi / omega / 64, steps=64)
    np.testing.assert_allclose(film.position[-1], x, atol=1e-6)
    np.testing.assert_allclose(film.position[:, 0, 1], -np.cos(angle), atol=1e-6)
    np.testing.assert_allclose(constraint_forces(cone)[0].ravel(), [3.0 * G / np.cos(angle)], rtol=1e-12)


def test_a_chain_at_rest_is_the_catenary_of_its_links():
    links, pull = 9, 20.0
    # the weight of half of the inner nodes hangs on the first link, one less on the next: tan θ is that over the pull
    lift = G * (np.arange(links) - (links - 1) / 2)
    angle = np.arctan2(lift, pull)
    steps = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    x = jnp.asarray(np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]))
    ends = (np.arange(links + 1) == 0) | (np.arange(links + 1) == links)
    hung = Scene(
        Particles(x, jnp.zeros_like(x)),
        forces=(forces.Gravity(G), springs.Rods([(i, i + 1) for i in range(links)])),
        pinned=ends,
    )
    film = simulate(hung, methods.verlet, dt=0.01, steps=100, save_every=100)
    np.testing.assert_allclose(film.position[-1], x, atol=1e-10)


def test_a_free_dumbbell_keeps_momentum_angular_momentum_and_energy():
    x, v = jnp.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), jnp.array([[0.0, 1.0, 0.3], [0.0, -2.0, 0.5]])
    scene = Scene(Particles(x, v), mass=jnp.array([1.0, 3.0]), forces=(springs.Rods([(0, 1)]),))
    film = simulate(scene, methods.rk4, dt=0.01, steps=400, save_every=50)
    for quantity in (energy.MOMENTUM, energy.ANGULAR_MOMENTUM, energy.ENERGY):
        values = np.asarray(jax.vmap(lambda t, s, q=quantity: q.value(scene, t, s))(film.time, film.state))
        assert np.abs(values - values[:1]).max() < 1e-11, quantity.name


def test_a_moving_pivot_leads_its_pendulum():
    x = jnp.array([[0.0, 0.0], [0.0, -1.0]])
    path = lambda t: x + jnp.array([[0.1, 0.0]]) * jnp.sin(3.0 * t) ** 2  # noqa: E731
    pins = Pins(np.array([True, False]), path)
    led = Scene(Particles(x, jnp.zeros_like(x)), forces=(forces.Gravity(G), springs.Rods([(0, 1)])), pinned=pins)
    film = simulate(led, methods.verlet, dt=1e-3, steps=1000, save_every=100)
    stretch, opening = find_openings(led, film)
    assert np.abs(stretch).max() < 1e-11
    assert np.abs(opening).max() < 1e-11

    def rate(t, y):
        push = 0.1 * 18.0 * np.cos(6.0 * t)
        return [y[1], -G * np.sin(y[0]) - push * np.cos(y[0])]

    angle = solve_ivp(rate, (0, 1), [0.0, 0.0], method="DOP853", rtol=1e-11, atol=1e-11).y[0, -1]
    expected = np.asarray(path(1.0))[0] + [np.sin(angle), -np.cos(angle)]
    np.testing.assert_allclose(film.position[-1, 1], expected, atol=1e-5)


def differ(function, at, step=1e-5):
    return (function(at + step) - function(at - step)) / (2 * step)


def test_the_end_of_a_pendulum_has_a_gradient_by_its_start_and_its_mass():
    def end(angle, mass):
        scene = pendulum(jnp.stack([angle, 0.5 * angle]), jnp.stack([mass, 1.0]), (forces.StokesDrag(0.1),))
        return simulate(scene, methods.verlet, dt=0.01, steps=50).position[-1, 1, 0]

    found = jax.jit(jax.grad(end, (0, 1)))(1.0, 2.0)
    run = jax.jit(end)
    assert found[0] == pytest.approx(float(differ(lambda a: run(a, 2.0), 1.0)), rel=1e-6)
    assert found[1] == pytest.approx(float(differ(lambda m: run(1.0, m), 2.0)), rel=1e-6)


def test_the_sag_of_a_bridge_has_a_derivative_by_the_mass_of_a_link():
    scene = chain(8, 5.0, 0.5, sag=0.4)

    def sag(mass):
        loaded = scene.replace(mass=scene.mass.at[2].set(mass))
        return simulate(loaded, methods.verlet, dt=0.01, steps=50).position[-1, 4, 1]

    found = jax.jit(lambda mass: jax.jvp(sag, (mass,), (1.0,))[1])(1.0)
    assert found == pytest.approx(float(differ(jax.jit(sag), 1.0)), rel=1e-6)


def test_lengths_are_swept_over_scenes_which_are_run_side_by_side():
    lengths = jnp.array([[1.0, 2.0], [1.5, 0.5], [0.7, 0.7]])
    x = jnp.cumsum(lengths, axis=1)[..., None] * jnp.array([[[1.0, 0.0]]])
    still = jnp.zeros_like(x)
    rods = springs.Rods([(-1, 0), (0, 1)], lengths, anchors=[(0.0, 0.0)])
    batch = Scene(Particles(x, still), forces=(forces.Gravity(G), rods))
    together = simulate(batch, methods.verlet, dt=0.01, steps=50, save_every=50).final_scene
    np.testing.assert_allclose(find_openings(batch, together.state)[0], 0.0, atol=1e-11)
    for number in (0, 2):
        alone = select_lane(batch, number)
        np.testing.assert_array_equal(alone.forces[1].length, lengths[number])
        end = simulate(alone, methods.verlet, dt=0.01, steps=50, save_every=50).final_scene.state
        np.testing.assert_allclose(end.position, together.state.position[number], atol=1e-13)


def test_rods_are_kept_in_float32():
    with jax.enable_x64(False):
        scene = pendulum(jnp.asarray([1.0, 0.5], jnp.float32))
        film = simulate(scene, methods.verlet, dt=0.01, steps=200)
        assert bool(film.ok)
        assert film.position.dtype == scene.forces[1].length.dtype == np.float32
        assert np.abs(find_openings(scene, film)[0]).max() < 64 * np.finfo(np.float32).eps


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda x: springs.Rods([(0, 2)]), "up to the index 2, but the scene has 2 bodies"),
        (lambda x: springs.Rods([(0, 1)], 1.2), r"rod 0 between \(0, 1\) is 0.183 off at the start"),
        (lambda x: springs.Rods([(0, 1)], [1.0, 1.0]), r"got lengths \(2,\)"),
        (lambda x: springs.Rods([(0, 1)], 0.0), r"length \[m\]: got 0.0, expected numbers > 0"),
        (lambda x: springs.Rods([(-1, 1)]), "there are 0 places in the world"),
        (
            lambda x: springs.Rods([(-1, 1)], anchors=[(0.0, 0.0, 0.0)]),
            r"anchors of shape \(1, 3\), expected \(anchors, 2\)",
        ),
        (lambda x: springs.Rods([(1, 1)]), "expected two different bodies"),
        (lambda x: springs.Rods([(0.5, 1)]), "indices of different bodies"),
        (lambda x: springs.Rods([(0, 1)], order=3), "got order=3, expected one of"),
        (lambda x: springs.Rods([(0, 1)], substeps=0), "substeps: got 0"),
        (lambda x: springs.Rods([(-1, 0)], anchors=x[:1]), "distance between the ends of rods"),
    ],
)
@pytest.mark.usefixtures("unannotated")
def test_bad_rods_are_refused_in_plain_words(build, message):
    x = jnp.array([[0.0, 0.0], [1.0, 0.0]])
    with pytest.raises(ValueError, match=message):
        Scene(Particles(x, jnp.zeros_like(x)), forces=(build(x),))


def test_rods_add_no_stiffness_the_limit_is_that_of_the_swing():
    fastest = np.sqrt(G * (2 + np.sqrt(2)))
    limit = stability.limit(pendulum([0.0, 0.0]), methods.verlet)
    assert limit.dt == pytest.approx(2 / fastest, rel=1e-6)
    assert (limit.cause, limit.force) == ("stiffness", "Rods")
    assert limit.rate == pytest.approx(-1j * fastest, rel=1e-6)
