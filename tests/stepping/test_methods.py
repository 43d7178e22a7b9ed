"""Each method against its promises: order, evaluations, stability, and the exact cases."""

import math
from typing import ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, forces, methods, ode_term, reference, simulate
from physjax.parts import as_module
from physjax.physics.forces import independent
from physjax.stepping.methods import METHODS, SPECIAL_METHODS
from physjax.stepping.simulate import sample_states
from physjax.vectors import dot, norm

EVERY = {**METHODS, **{name: method for name, method in SPECIAL_METHODS.items() if name != "dprkn6"}}
"""All but the one that refuses forces that look at the velocity."""
ALL = pytest.mark.parametrize("method", EVERY.values(), ids=EVERY)


def thrown(method, dt, steps, dtype=float):
    """A ball thrown with (3, 4) m/s and the sum of its steps' position error under constant acceleration."""
    scene = Scene(Particles(jnp.zeros(2, dtype), jnp.asarray([3.0, 4.0], dtype)), forces=(forces.Gravity(),))
    return simulate(scene, method, dt=dt, steps=steps)


@pytest.mark.parametrize(
    ("name", "share"),
    [
        ("euler", 0.5),
        ("semi_implicit_euler", -0.5),
        ("midpoint", 0),
        ("verlet", 0),
        ("leapfrog", 0),
        ("rk4", 0),
        ("implicit_euler", -0.5),
        ("heun", 0),
        ("tsit5", 0),
        ("dopri8", 0),
        ("blanes_moan4", 0),
        ("kahan_li8", 0),
        ("boris", 0),
    ],
)
def test_constant_acceleration_is_exact_or_off_by_exactly_half_a_step(name, share, precision):
    dt, steps = 0.125, 64
    flight = thrown(EVERY[name], dt, steps, precision.dtype)
    t = np.asarray(flight.time, float)
    exact = 4.0 * t - 4.9 * t**2 + share * 9.8 * dt * t
    np.testing.assert_allclose(flight.position[:, 1], exact, atol=64 * 400 * precision.eps, rtol=0)


def test_the_lectures_listing():
    scene = Scene(Particles(jnp.zeros(1), jnp.zeros(1)), forces=(forces.Constant(jnp.asarray([10.0])),))
    flight = simulate(scene, methods.euler, dt=1.0, steps=10)
    assert flight.velocity[-1, 0] == 100.0
    assert flight.position[-1, 0] == 450.0


@ALL
def test_evaluations_a_step(method):
    calls = []

    def counted(t, state, mass):
        calls.append(t)
        return -state.position

    with jax.disable_jit():  # loops over stages are then taken, and the scene does not try its force
        scene = Scene(Particles(jnp.ones(1), jnp.zeros(1)), forces=(counted,))
        method(scene, 0.0, scene.state, 0.1)
    assert len(calls) == method.promises.evaluations


STRIP = {"blanes_moan4": (1.0003, 1.0006, 1.001), "kahan_li8": (1.005, 1.01)}
"""Shares of the limit where an oscillation grows: further on it is kept again."""
SLOWLY_UNSTABLE = ("tsit5", "dopri8")
"""An oscillation grows by less than 2e-4 a step, which a run does not show, long before it grows."""


@ALL
def test_stable_to_its_limit_and_not_beyond(method):
    limit = method.promises.stability_limit

    def radius(step):
        scene = Scene(Particles(jnp.zeros(1), jnp.zeros(1)), forces=(forces.Anchor(point=jnp.zeros(1), stiffness=1.0),))
        one_step = lambda y: jnp.concatenate(method(scene, 0.0, Particles(y[:1], y[1:]), step))  # noqa: E731
        return np.abs(np.linalg.eigvals(np.asarray(jax.jacfwd(one_step)(jnp.zeros(2))))).max()

    if math.isinf(limit):
        for step in (0.01, 1.0, 1e3):
            assert radius(step) <= 1 + 1e-9
            if method is methods.implicit_euler:
                assert radius(step) == pytest.approx(1 / math.hypot(1, step), rel=1e-12)
    elif method.__name__ in SLOWLY_UNSTABLE:
        assert radius(0.98 * limit) < 1 + 2e-4 < radius(1.02 * limit)
    elif limit:
        assert radius(0.98 * limit) <= 1 + 1e-12
        beyond = max(radius(share * limit) for share in STRIP.get(method.__name__, (1.02,)))
        assert beyond > 1 + 1e-3
    else:
        assert radius(0.1) > 1 + 1e-6


def test_constant_velocity_is_exact_to_rounding_under_every_method(precision):
    x, v = jnp.asarray([[1.0, 2.0, 3.0]], precision.dtype), jnp.asarray([[3.0, -4.0, 0.5]], precision.dtype)
    for method in METHODS.values():
        film = simulate(Scene(Particles(x, v)), method, dt=0.125, steps=64)
        exact = np.asarray(x) + np.asarray(v) * np.asarray(film.time)[:, None, None]
        roundings = 32 * max(1, method.promises.evaluations // 8)  # a composition drifts twice a stage
        np.testing.assert_allclose(film.position, exact, atol=64 * roundings * precision.eps, rtol=0)
        np.testing.assert_array_equal(film.velocity, np.tile(v, (65, 1, 1)))


def test_the_momentum_form_is_semi_implicit_euler():
    x, v = np.array([[0.0, 1.0], [2.0, -1.0]]), np.array([[1.0, 0.0], [-3.0, 2.0]])
    mass, dt, b, k = np.array([0.5, 2.0]), 0.01, 0.3, 7.0
    scene = Scene(
        Particles(jnp.asarray(x), jnp.asarray(v)),
        mass=mass,
        forces=(forces.Gravity(), forces.StokesDrag(b), forces.Anchor(point=jnp.zeros(2), stiffness=k)),
    )
    p = mass[:, None] * v
    for _ in range(500):
        p = p + (mass[:, None] * np.array([0.0, -9.8]) - b * p / mass[:, None] - k * x) * dt
        x = x + p / mass[:, None] * dt
    final = simulate(scene, methods.semi_implicit_euler, dt=dt, steps=500, save_every=500)
    np.testing.assert_allclose(final.position[-1], x, rtol=0, atol=1e-12)
    np.testing.assert_allclose(final.velocity[-1] * mass[:, None], p, rtol=0, atol=1e-12)


@independent
def wave(t, state, mass):
    """A push that changes with time: a method that looks at the wrong moment loses its order."""
    return jnp.stack([jnp.cos(2.0 * t), jnp.sin(3.0 * t)])


CONSERVATIVE = (forces.Gravity(), forces.Anchor(point=jnp.zeros(2), stiffness=9.0, rest_length=0.6), wave)
WITH_DRAG = (
    *CONSERVATIVE,
    forces.StokesDrag(0.3),
    forces.QuadraticDrag(area=1.0, coefficient=0.5, wind=jnp.asarray([1.0, 0.5])),
)


@pytest.fixture(scope="module", params=[CONSERVATIVE, WITH_DRAG], ids=["position-only", "drag"])
def pendulum(request):
    """An elastic pendulum, shaken, with and without drag, and its state at 2 s."""
    state = Particles(jnp.asarray([0.8, -0.3]), jnp.asarray([0.4, 0.9]))
    scene = Scene(state, mass=0.7, forces=request.param)
    truth = reference(scene, [2.0], rtol=1e-13, atol=1e-13).state
    return scene, jax.tree.map(lambda leaf: leaf[-1], truth), request.param is WITH_DRAG


COARSE = {"tsit5": (64, 128, 256), "blanes_moan4": (64, 128, 256), "dopri8": (16, 32), "kahan_li8": (16, 32)}
"""Steps, where more of them would leave an error of rounding."""


@ALL
def test_order_is_the_promised_one(method, pendulum):
    scene, truth, drag = pendulum
    promised = method.promises.order_with_drag if drag else method.promises.order
    errors = []
    fine = (256, 512, 1024)
    for steps in fine if promised == 1 else COARSE.get(method.__name__, fine):
        found = sample_states(scene, as_module(method), 2.0 / steps, steps, frames=1)
        errors.append(max(np.abs(a[-1] - b).max() for a, b in zip(found, truth, strict=True)))
    found = np.log2(np.divide(errors[:-1], errors[1:]))
    if promised <= 4:
        np.testing.assert_allclose(found, promised, rtol=0, atol=0.15)
    else:  # terms of higher order are still seen where that of the order itself is small
        assert found.min() > promised - (0.15 if promised < 6 else 0.3)


class Classical(diffrax.AbstractERK):
    """The classical tableau, which diffrax does not ship."""

    tableau: ClassVar = diffrax.ButcherTableau(
        c=np.array([0.5, 0.5, 1.0]),
        a_lower=(np.array([0.5]), np.array([0.0, 0.5]), np.array([0.0, 0.0, 1.0])),
        b_sol=np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6]),
        b_error=np.zeros(4),
    )
    interpolation_cls: ClassVar = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

    def order(self, terms):
        return 4


PAIRS = [
    (methods.euler, diffrax.Euler()),
    (methods.midpoint, diffrax.Midpoint()),
    (methods.heun, diffrax.Heun()),
    (methods.rk4, Classical()),
    (methods.tsit5, diffrax.Tsit5()),
    (methods.dopri8, diffrax.Dopri8()),
]


@pytest.mark.parametrize(("method", "solver"), PAIRS)
def test_runge_kutta_methods_equal_diffrax_after_1000_steps(method, solver):
    dt, steps = 1 / 256, 1000
    state = Particles(jnp.asarray([0.8, -0.3]), jnp.asarray([0.4, 0.9]))
    scene = Scene(state, mass=0.7, forces=WITH_DRAG)
    ours = simulate(scene, method, dt=dt, steps=steps, save_every=steps).final_scene.state
    solution = diffrax.diffeqsolve(ode_term(scene), solver, 0.0, steps * dt, dt, state, max_steps=steps)
    for mine, theirs in zip(ours, solution.ys, strict=True):
        np.testing.assert_allclose(mine, theirs[-1], rtol=0, atol=1e-12)


def test_on_kepler_09_verlet_bounds_the_energy_for_100_periods_and_euler_loses_the_planet():
    e, steps = 0.9, 2000
    perihelion, speed = 1 - e, ((1 + e) / (1 - e)) ** 0.5
    state = Particles(jnp.asarray([[0.0, 0.0], [perihelion, 0.0]]), jnp.asarray([[0.0, 0.0], [0.0, speed]]))
    scene = Scene(state, forces=(forces.Gravitation(gm=jnp.asarray([1.0, 0.0])),))

    def energy(t, state):
        return 0.5 * dot(state.velocity[1], state.velocity[1]) - 1.0 / norm(state.position[1] - state.position[0])

    def energies(method):
        run = simulate(scene, method, dt=2 * math.pi / steps, steps=100 * steps, save_every=steps // 200, record=energy)
        return np.asarray(run.recorded)

    kept, lost = energies(methods.verlet), energies(methods.euler)
    error = np.abs(kept + 0.5)
    assert error.max() < 0.0125  # 2.5 % of the energy, at every perihelion
    assert error[-2000:].max() <= 1.1 * error[:2000].max()  # the last ten periods are no worse than the first ten
    assert lost[200:].min() > 0.0  # unbound within the first period, for good


def test_the_figure_eight_comes_back_after_one_period():
    a, v = np.array([0.97000436, -0.24308753]), np.array([-0.93240737, -0.86473146])
    state = Particles(jnp.asarray([a, -a, 0 * a]), jnp.asarray([-v / 2, -v / 2, v]))
    scene = Scene(state, forces=(forces.Gravitation(G=1.0),))
    steps = 6326  # dt = 1e-3 to five digits
    run = simulate(scene, methods.rk4, dt=6.32591398 / steps, steps=steps, save_every=steps)
    for start, end in zip(state, run.final_scene.state, strict=True):
        np.testing.assert_allclose(end, start, rtol=0, atol=1e-6)


def test_midpoint_lets_an_oscillation_grow_by_its_known_factor_a_step():
    step, omega = np.asarray([0.01, 0.1, 0.5, 1.0]), 2.0
    state = Particles(jnp.zeros((4, 1)), jnp.ones((4, 1)))
    scene = Scene(state, forces=(forces.Anchor(point=jnp.zeros(1), stiffness=omega**2),))
    x, v = simulate(scene, methods.midpoint, dt=step / omega, steps=10).state
    amplitude = np.hypot(omega * x, v)[..., 0]
    np.testing.assert_allclose(amplitude[1:] / amplitude[:-1], np.tile(np.sqrt(1 + step**4 / 4), (10, 1)), rtol=1e-14)


def growth(method, stiffness, damping, dt):
    """Largest factor by which one step stretches an oscillation of unit mass."""
    spring = forces.Anchor(point=jnp.zeros(1), stiffness=stiffness, damping=damping)
    scene = Scene(Particles(jnp.zeros(1), jnp.zeros(1)), forces=(spring,))
    step = lambda y: jnp.concatenate(method(scene, 0.0, Particles(y[:1], y[1:]), dt))  # noqa: E731
    return np.abs(np.linalg.eigvals(np.asarray(jax.jacfwd(step)(jnp.zeros(2))))).max()


@pytest.mark.parametrize("k", [1.0, 50.0])
@pytest.mark.parametrize("c", [0.5, 3.0, 20.0])
def test_damped_limits_are_those_of_the_closed_forms(k, c):
    semi_implicit = (-c + math.sqrt(c * c + 4 * k)) / k  # k dt² + 2c dt = 4
    explicit = c / k if c * c < 4 * k else 4 / (c + math.sqrt(c * c - 4 * k))
    for method, limit in ((methods.semi_implicit_euler, semi_implicit), (methods.euler, explicit)):
        assert growth(method, k, c, 0.999 * limit) < 1
        assert growth(method, k, c, 1.001 * limit) > 1


@ALL
def test_a_method_moves_any_state_that_can_kick_and_drift(method):
    """A pendulum of its own making, a dict of numbers, moves like the same pendulum told as a scene."""

    class Pendulum:
        def rate(self, t, y):
            return {"angle": y["rate"], "rate": -jnp.sin(y["angle"])}

        def kick(self, y, slope, dt):
            return y | {"rate": y["rate"] + dt * slope["rate"]}

        def drift(self, y, dt):
            return y | {"angle": y["angle"] + dt * y["rate"]}

    y, told = {"angle": jnp.asarray(1.0), "rate": jnp.asarray(0.0)}, Particles(jnp.asarray([1.0]), jnp.asarray([0.0]))
    scene = Scene(told, forces=(lambda t, state, mass: -jnp.sin(state.position),))
    for i in range(5):
        y, told = method(Pendulum(), 0.1 * i, y, 0.1), method(scene, 0.1 * i, told, 0.1)
    np.testing.assert_allclose([y["angle"], y["rate"]], np.ravel(told), rtol=1e-13)
