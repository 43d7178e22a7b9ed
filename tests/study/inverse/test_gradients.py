"""How far gradients can be trusted: sensitivities whose growth is known, and chaos beside finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, contacts, forces, gradients, methods, plot, simulate


def swing(stiffness=4.0):
    point = forces.Anchor(point=jnp.zeros(1), stiffness=stiffness)
    return Scene(Particles(jnp.ones(1), jnp.zeros(1)), forces=(point,))


def test_the_sensitivity_of_an_oscillator_is_bounded():
    told = gradients.health(swing(), methods.rk4, dt=0.01, duration=60.0, save_every=10)
    np.testing.assert_allclose(told.sensitivity, np.abs(np.cos(2 * told.time)), atol=1e-6)
    assert not told.exponential
    assert abs(told.power) < 1e-3
    assert told.horizon > 1e6
    told = gradients.health(swing(), methods.rk4, dt=0.01, duration=60.0, save_every=10, of="velocity")
    np.testing.assert_allclose(told.sensitivity, np.abs(np.sin(2 * told.time)) / 2, atol=1e-6)


def test_a_falling_ball_forgets_nothing_and_adds_nothing():
    balls = Scene(Particles(jnp.zeros((3, 2)), jnp.ones((3, 2))), forces=(forces.Gravity(),))
    place = gradients.health(balls, methods.verlet, dt=0.01, steps=400, save_every=20)
    np.testing.assert_allclose(place.sensitivity, 1.0, rtol=1e-12)
    assert np.isinf(place.horizon).all() or (place.horizon > 1e9).all()
    speed = gradients.health(balls, methods.verlet, dt=0.01, steps=400, save_every=20, of="velocity", error=1e-3)
    np.testing.assert_allclose(speed.sensitivity, np.repeat(speed.time[:, None], 3, 1), atol=1e-12)
    assert not speed.exponential.any()
    np.testing.assert_allclose(speed.power, 1.0, rtol=1e-9)
    way = np.hypot(4.0, 4.0 - 4.9 * 16)
    np.testing.assert_allclose(speed.horizon, 0.1 * way / 1e-3, rtol=1e-9)  # t · 1 mm/s is a tenth of the way


@pytest.mark.slow
def test_a_ball_that_bounces_on_top_of_a_sphere_is_lost_exponentially():
    height, radius, bounces = 0.1, 0.5, 15
    flight = 2 * np.sqrt(2 * height / 9.8)
    ball = Scene(
        Particles(jnp.asarray([0.0, radius + height]), jnp.zeros(2)),
        forces=(forces.Gravity(),),
        contacts=(contacts.Sphere((0.0, 0.0), radius),),
    )
    told = gradients.health(ball, methods.leapfrog, dt=flight / 20, steps=20 * bounces, save_every=20, size=radius)
    # from bounce to bounce a deviation u, w obeys w' = w + 2vu/R, u' = u + flight w': one root is greater than 1
    k = 8 * height / radius
    root = 1 + k / 2 + np.sqrt(k + k * k / 4)
    assert told.exponential
    assert told.rate == pytest.approx(np.log(root) / flight, rel=1e-6)
    assert told.sensitivity[-1] / told.sensitivity[-2] == pytest.approx(root, rel=1e-9)
    limit = 0.1 * radius / (np.finfo(float).eps * (radius + height))
    assert told.limit == pytest.approx(limit, rel=1e-9)
    later = np.log(limit / told.sensitivity[-1]) / np.log(root)
    assert told.horizon == pytest.approx((bounces + later) * flight, rel=1e-6)
    # the bounces themselves go astray where it says
    shifted = ball.replace(state=ball.state._replace(position=ball.state.position + jnp.asarray([1e-7, 0.0])))
    run = simulate(shifted, methods.leapfrog, dt=flight / 20, steps=20 * bounces, save_every=20)
    error = gradients.health(
        ball, methods.leapfrog, dt=flight / 20, steps=20 * bounces, save_every=20, size=radius, error=1e-7
    )
    lost = np.abs(run.position[:, 0]) > 0.1 * radius
    assert float(run.time[np.argmax(lost)]) == pytest.approx(float(error.horizon), abs=flight)


def three_bodies():
    x = jnp.asarray([[1.0, 3.0], [-2.0, -1.0], [1.0, -1.0]])
    attraction = forces.Gravitation(G=1.0, softening=0.5)
    return Scene(Particles(x, jnp.zeros_like(x)), jnp.asarray([3.0, 4.0, 5.0]), (attraction,))


OPTIONS = {"dt": 0.005, "steps": 8000, "save_every": 80}


def test_three_bodies_are_chaotic_as_finite_differences_say():
    scene = three_bodies()
    told = gradients.health(scene, methods.rk4, **OPTIONS)
    assert told.exponential
    assert 0.2 < told.rate < 0.5
    assert told.horizon > told.time[-1]

    def path(x):
        return simulate(scene.replace(state=Particles(x, scene.state.velocity)), methods.rk4, **OPTIONS).position

    steps = 1e-7 * jnp.eye(6).reshape(6, 3, 2)
    x = scene.state.position
    apart = jax.vmap(lambda step: (path(x + step) - path(x - step)) / 2e-7)(steps)
    growth = np.sqrt(np.sum(np.asarray(apart) ** 2, axis=(2, 3)).mean(axis=0))
    early = told.time <= 20.0  # later the differences are no longer small
    np.testing.assert_allclose(told.sensitivity[early], growth[early], rtol=1e-3)


def test_beyond_the_horizon_paths_from_rounded_starts_have_nothing_in_common():
    scene, error = three_bodies(), 1e-5
    told = gradients.health(scene, methods.rk4, **OPTIONS, error=error)
    assert 20.0 < told.horizon < 40.0
    way = jax.random.normal(jax.random.key(0), (3, 2))
    shifted = scene.replace(state=scene.state._replace(position=scene.state.position + error * way))
    paths = [simulate(s, methods.rk4, **OPTIONS) for s in (scene, shifted)]
    apart = np.linalg.norm(paths[1].position - paths[0].position, axis=-1).max(axis=-1)
    size = float(told.limit) * error / 0.1
    assert apart[told.time < 0.5 * told.horizon].max() < 0.02 * size
    assert apart.max() > 0.1 * size


def test_what_reverse_mode_makes_not_a_number_is_not_healthy():
    """A choice between a root and zero: at zero forward mode leaves the root out, and reverse mode multiplies it by zero."""

    def trap(t, state, mass):
        x = state.position
        return jnp.where(x > 0, jnp.sqrt(jnp.abs(x)), 0.0) - 0.5 * state.velocity

    # of two lanes that move down the first starts at zero
    start = Particles(jnp.asarray([[0.0], [-1.0]]), -jnp.ones((2, 1)))
    scene = Scene(start, forces=(forces.independent(trap),))
    found, unasked = (
        gradients.health(scene, methods.semi_implicit_euler, dt=0.1, steps=20, reverse=asked) for asked in (None, False)
    )
    np.testing.assert_array_equal(found.ok, [False, True])
    assert np.isinf(found.mismatch[0])
    assert found.mismatch[1] < 1e-12
    assert found.horizon[0] == 0.0
    assert found.horizon[1] == unasked.horizon[1] > 2.0
    assert unasked.mismatch is None
    assert unasked.horizon[0] > 2.0


def test_many_directions_are_sampled():
    x = jax.random.normal(jax.random.key(1), (20, 2))
    cloud = Scene(Particles(x, 0.1 * x), 0.05, (forces.Gravitation(G=1.0, softening=0.5),))
    told = gradients.health(cloud, methods.verlet, dt=0.02, steps=50, save_every=10)
    path = lambda x: simulate(  # noqa: E731
        cloud.replace(state=Particles(x, cloud.state.velocity)), methods.verlet, dt=0.02, steps=50, save_every=50
    ).position[-1]
    whole = np.linalg.norm(jax.jacfwd(path)(cloud.state.position).reshape(40, 40)) / np.sqrt(40)
    assert told.sensitivity[-1] == pytest.approx(whole, rel=0.1)
    assert told.sensitivity[0] == pytest.approx(1.0, rel=0.1)


def test_health_goes_through_vmap_and_tells_of_runs_that_blow_up():
    told = jax.vmap(lambda k: gradients.health(swing(k), methods.euler, dt=0.1, steps=400, save_every=20))(
        jnp.asarray([1.0, 1e40])
    )
    np.testing.assert_array_equal(told.exponential[0], True)  # explicit Euler gains
    assert told.rate[0] == pytest.approx(np.log(1.01) / 0.2, rel=0.05)
    assert told.horizon[1] <= 4.0


def test_bad_input_is_told_in_plain_words():
    run = lambda **options: gradients.health(swing(), methods.rk4, dt=0.1, steps=10, **options)  # noqa: E731
    with pytest.raises(ValueError, match=r"unknown kind of deviation 'speed'"):
        run(of="speed")
    with pytest.raises(ValueError, match=r"error \[m\]: got 0\.0, expected numbers > 0"):
        run(error=0.0)
    with pytest.raises(ValueError, match=r"fraction: got -1\.0, expected numbers > 0"):
        run(fraction=-1.0)
    with pytest.raises(ValueError, match=r"size \[m\]: got 0\.0, expected numbers > 0"):
        run(size=0.0)


def test_the_picture_has_units_its_limit_and_its_horizon():
    told = gradients.health(three_bodies(), methods.rk4, **OPTIONS, error=1e-5)
    ax = told.plot()
    assert ax.get_xlabel() == "time [s]"
    assert ax.get_ylabel() == "growth of a deviation [m per m]"
    assert ax.get_title() == f"the gradient is to be trusted up to {float(told.horizon):.3g} s"
    curve, ring, limit = ax.lines
    np.testing.assert_allclose(curve.get_ydata(), told.sensitivity)
    np.testing.assert_allclose([*ring.get_xdata(), *ring.get_ydata()], [told.horizon, told.limit])
    np.testing.assert_allclose(limit.get_ydata(), told.limit)
    many = gradients.health(
        Scene(Particles(jnp.zeros((3, 2)), jnp.ones((3, 2)))), methods.euler, dt=0.1, steps=20, of="velocity"
    )
    ax = plot.gradient_health(many)
    assert ax.get_ylabel() == "growth of a deviation [m per m/s]"
    assert len(ax.lines) == 4
    assert ax.get_title() == "all gradients are to be trusted for more than a thousand such runs"
