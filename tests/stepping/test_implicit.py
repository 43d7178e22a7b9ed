"""Implicit Euler: the equation it solves, how it says so, stiff cloth at any step, pins, batches and derivatives."""

from itertools import pairwise

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest

from physjax import Particles, Pins, Scene, forces, lattices, methods, ode_term, simulate
from physjax.parts import as_module
from physjax.physics.springs import Springs
from physjax.stepping.krylov import conjugate_gradients, stabilised_biconjugate_gradients
from physjax.stepping.methods import ImplicitEuler
from physjax.stepping.simulate import sample_states

DT = 1 / 60
CONVERGED = ImplicitEuler(tolerance=1e-11, newton=20)


def hung(count, *others, stiffness=200.0, damping=None, dtype=float):
    """A cloth of count × count nodes hung by its upper corners, 1 kg a square metre, every spring alike."""
    stiff = {"structural": stiffness, "shear": stiffness, "bend": stiffness, "damping": damping}
    sheet = lattices.cloth(1.0, 1.0, count, count, mass=1.0, **stiff)
    state = Particles(*(jnp.asarray(leaf, dtype) for leaf in sheet.state))
    pinned = sheet.nodes["top"] & sheet.nodes["corners"]
    return Scene(state, mass=sheet.mass, forces=(forces.Gravity(), sheet.springs, *others), pinned=pinned)


def rope(count, *others, stiffness=200.0, damping=None):
    """A chain of count nodes, 1 m and 1 kg, held at its first node; unevenly heavy."""
    x = np.linspace(0.0, 1.0, count)[:, None] * np.asarray([0.6, 0.0, 0.8])
    links = Springs(
        np.stack([np.arange(count - 1), np.arange(1, count)], axis=1), stiffness, 1.0 / (count - 1), damping
    )
    mass = np.linspace(0.5, 1.5, count) / count
    pinned = np.arange(count) == 0
    return Scene(
        Particles(jnp.asarray(x), jnp.zeros((count, 3))), mass, (forces.Gravity(), links, *others), pinned=pinned
    )


def crumpled(scene, size, seed=0):
    """The scene with its free nodes pushed about: half the springs are compressed."""
    random, (x, v) = np.random.default_rng(seed), scene.state
    free = 1.0 - np.asarray(scene.held)[:, None]
    push = lambda a, by: a + by * jnp.asarray(free * random.normal(size=a.shape))  # noqa: E731
    return eqx.tree_at(lambda scene: scene.state, scene, Particles(push(x, size), push(v, 1.0)))


def dense_newton(scene, dt, t=0.0):
    """The step's equation v' = v + dt a(t + dt, x + dt v', v'), solved with dense matrices; the velocity at the end."""
    x, v = scene.state

    @jax.jit
    def residual(v1):
        v1 = v1.reshape(v.shape)
        return (v1 - v - dt * scene.acceleration(t + dt, Particles(x + dt * v1, v1))).ravel()

    tangent, v1 = jax.jit(jax.jacfwd(residual)), v.ravel()
    for _ in range(12):
        v1 = v1 - np.linalg.solve(np.asarray(tangent(v1)), np.asarray(residual(v1)))
    assert np.abs(residual(v1)).max() <= 1e-11
    return np.reshape(v1, v.shape)


# what is solved


def test_the_linearised_step_solves_the_equation_of_baraff_and_witkin():
    scene, dt = rope(6, stiffness=50.0), 0.05
    x, v = jax.tree.map(lambda leaf: 1.1 * leaf, crumpled(scene, 0.0).state)  # stretched: every derivative is exact

    @jax.jit
    def derivatives(x, v):
        rate = lambda x, v: scene.acceleration(dt, Particles(x, v))  # noqa: E731
        return rate(x, v), *jax.jacfwd(rate, argnums=(0, 1))(x, v)

    a, by_x, by_v = (np.asarray(leaf).reshape(x.size, -1) for leaf in derivatives(x, v))
    matrix = np.eye(x.size) - dt * by_v - dt**2 * by_x
    dv = np.linalg.solve(matrix, dt * (a + dt * by_x @ v.reshape(-1, 1))).reshape(v.shape)
    after = jax.jit(ImplicitEuler(tolerance=1e-14))(scene, 0.0, Particles(x, v), dt)
    np.testing.assert_allclose(after.velocity, v + dv, rtol=0, atol=1e-12)
    np.testing.assert_allclose(after.position, x + dt * (v + dv), rtol=0, atol=1e-12)


@pytest.mark.slow
def test_a_converged_cloth_solves_the_whole_equation():
    scene = crumpled(hung(12), 1e-3)
    (x, v), report = scene.state, CONVERGED.report(scene, DT)
    assert report.ok
    assert report.residual <= 1e-11
    v1 = jax.jit(CONVERGED)(scene, 0.0, scene.state, DT).velocity
    wanted = v + DT * jax.jit(lambda v1: scene.acceleration(DT, Particles(x + DT * v1, v1)))(v1)
    np.testing.assert_allclose(v1, wanted, rtol=0, atol=1e-8)


@pytest.mark.slow
def test_a_converged_rope_is_the_solution_of_dense_newton():
    scene = crumpled(rope(10, damping=0.1), 0.02)
    after = jax.jit(CONVERGED)(scene, 0.0, scene.state, DT)
    np.testing.assert_allclose(after.velocity, dense_newton(scene, DT), rtol=0, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["rope", "drag"])
def test_converged_steps_equal_those_of_diffrax(case):
    air = forces.QuadraticDrag(area=0.01, coefficient=1.0, wind=jnp.asarray([2.0, 0.0, 1.0]))
    if case == "rope":
        scene = crumpled(rope(6, air, damping=0.05), 0.01)
    else:
        state = Particles(jnp.zeros((5, 3)), 20.0 * jnp.ones((5, 3)))
        scene = Scene(state, mass=jnp.linspace(0.01, 1.0, 5), forces=(forces.Gravity(), air))
    finder = optimistix.Newton(rtol=1e-12, atol=1e-12)
    solver = diffrax.ImplicitEuler(root_finder=finder)
    steps = 4
    theirs = diffrax.diffeqsolve(ode_term(scene), solver, 0.0, steps * DT, DT, scene.state, max_steps=steps).ys
    ours = simulate(scene, CONVERGED, dt=DT, steps=steps).final_scene.state
    for mine, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(mine, other[-1], rtol=0, atol=1e-8)


@pytest.mark.parametrize("method", [methods.implicit_euler, CONVERGED], ids=["linearised", "converged"])
def test_order_1_on_a_damped_rope(method):
    scene = crumpled(rope(5, stiffness=20.0, damping=0.1), 0.02)
    ends = [sample_states(scene, as_module(method), 0.2 / n, n, frames=1).position[-1] for n in (256, 512, 1024, 2048)]
    steps = [np.abs(a - b).max() for a, b in pairwise(ends)]
    np.testing.assert_allclose(np.log2(np.divide(steps[:-1], steps[1:])), 1.0, rtol=0, atol=0.15)


# stiff scenes, long steps


@pytest.mark.parametrize("dt", [1 / 60, 0.1, 1.0])
def test_a_crumpled_cloth_stays_bounded_at_any_step(dt):
    scene = crumpled(hung(24), 0.02)
    film = simulate(scene, methods.implicit_euler, dt=dt, steps=60)
    assert film.ok
    assert np.abs(film.position).max() < 3.0
    assert np.abs(film.velocity[-1]).max() < np.abs(film.velocity[0]).max()


def test_the_tangent_of_springs_is_their_derivative_but_for_what_pushes_sideways():
    springs = Springs([(0, 1)], 50.0, 1.0, nodes=2)
    for stretch in (1.4, 0.6):
        state = Particles(jnp.asarray([[0.0, 0.0], [stretch, 0.0]]), jnp.zeros((2, 2)))
        tangent = springs.linearised_at(0.0, state, 1.0)
        of = lambda force: jax.jacfwd(lambda x: force(0.0, Particles(x, 0 * x), 1.0))(state.position)  # noqa: E731, B023
        exact, found = of(springs), of(tangent)
        np.testing.assert_allclose(tangent(0.0, state, 1.0), springs(0.0, state, 1.0), rtol=1e-15)
        np.testing.assert_allclose(found[:, 0, :, 0], exact[:, 0, :, 0], rtol=0, atol=1e-12)
        np.testing.assert_allclose(found[:, 1, :, 1], exact[:, 1, :, 1] if stretch > 1 else 0.0, rtol=0, atol=1e-12)


def test_drag_cannot_turn_a_body_around_however_long_the_step():
    scene = Scene(
        Particles(jnp.zeros(2), jnp.asarray([100.0, 0.0])), forces=(forces.QuadraticDrag(area=1.0, coefficient=1.0),)
    )
    for method in (methods.implicit_euler, CONVERGED):
        speed = simulate(scene, method, dt=10.0, steps=5).velocity[:, 0]
        assert np.all(np.diff(speed) < 0)
        assert speed[-1] > 0


# held and led nodes


def test_held_nodes_stay_and_led_nodes_follow_their_path_exactly():
    scene = rope(8)
    first, x = scene.pinned, scene.state.position
    film = simulate(scene, methods.implicit_euler, dt=0.1, steps=10)
    np.testing.assert_array_equal(film.position[:, 0], np.tile(x[0], (11, 1)))
    np.testing.assert_array_equal(film.velocity[:, 0], 0.0)

    def path(t):
        return x + 0.3 * jnp.sin(2.0 * t) * jnp.asarray([[1.0, 0.0, 0.5]])

    moving = Particles(x, jnp.where(first[:, None], jnp.asarray([[0.6, 0.0, 0.3]]), 0.0))
    led = Scene(moving, scene.mass, scene.forces, pinned=Pins(first, path))
    film = simulate(led, CONVERGED, dt=0.05, steps=10)
    for t, frame in zip(film.time, film.position, strict=True):
        np.testing.assert_allclose(frame[0], path(t)[0], rtol=0, atol=1e-15)
    # the free nodes see the led one where it arrives
    np.testing.assert_allclose(film.velocity[1][1:], dense_newton(led, 0.05)[1:], rtol=0, atol=1e-8)


# reports


def test_a_solve_that_does_not_converge_is_a_status_with_its_residual():
    scene = crumpled(rope(20), 0.02)
    good, cut = (ImplicitEuler(tolerance=1e-6, iterations=n).report(scene, DT) for n in (500, 5))
    assert good.ok
    assert good.residual <= 1e-6
    assert 5 < good.products < 100
    assert not cut.ok
    assert cut.products == 5
    assert 1e-6 < cut.residual < 1.0
    assert simulate(scene, ImplicitEuler(iterations=1), dt=DT, steps=2).ok  # poor, not broken
    assert not ImplicitEuler(tolerance=1e-14, newton=1).report(scene, 0.3).ok


def test_bad_settings_are_named(unannotated):
    for bad in ({"tolerance": 0.0}, {"tolerance": 2.0}, {"iterations": 0}, {"newton": -1}, {"newton": 1.5}):
        with pytest.raises(ValueError, match=f"{next(iter(bad))}=.*expected"):
            ImplicitEuler(**bad)


# batches


def test_scenes_in_a_batch_solve_by_themselves_and_a_broken_one_harms_no_other():
    scene = crumpled(rope(6), 0.02)
    states = [crumpled(scene, size, seed).state for size, seed in ((0.0, 1), (0.05, 2), (0.02, 3))]
    states[2] = states[2]._replace(velocity=states[2].velocity.at[4].set(np.nan))
    many = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    step = jax.jit(lambda state: methods.implicit_euler(scene, 0.0, state, DT))
    pinned = jnp.broadcast_to(scene.pinned, many.lanes)
    side_by_side = Scene(
        many._replace(velocity=jnp.nan_to_num(many.velocity)),
        jnp.broadcast_to(scene.mass, many.lanes),
        scene.forces,
        pinned=pinned,
    )
    together = {
        "vmap": jax.jit(jax.vmap(step))(many),
        "lanes": jax.jit(methods.implicit_euler)(side_by_side, 0.0, many, DT),
    }
    for after in together.values():
        for i in (0, 1):
            alone = step(states[i])
            np.testing.assert_allclose(after.position[i], alone.position, rtol=0, atol=1e-9)
        assert np.isnan(after.velocity[2]).any()
    steps = jnp.asarray([1e-3, 0.1, 0.02])
    reports = ImplicitEuler().report(side_by_side, steps)
    assert reports.ok.all()
    assert reports.products[0] < reports.products[1]


def test_float32_converges_as_far_as_float32_goes():
    with jax.enable_x64(False):
        scene = hung(24, dtype=np.float32)
        assert methods.implicit_euler.report(scene, DT).ok
        film = simulate(scene, methods.implicit_euler, dt=DT, steps=10)
        assert film.ok
        assert film.position.dtype == np.float32


@pytest.mark.parametrize("solver", [conjugate_gradients, stabilised_biconjugate_gradients])
def test_the_iterative_solvers_solve(solver):
    random = np.random.default_rng(0)
    root = random.normal(size=(30, 30))
    matrix = np.eye(30) + root @ root.T / 10
    if solver is stabilised_biconjugate_gradients:
        matrix = matrix + np.triu(root) / 10
    b = random.normal(size=30)
    x, solved = solver(lambda v: [jnp.asarray(matrix) @ v[0]], [jnp.asarray(b)], lambda a, b: a[0] @ b[0], 1e-12, 400)
    assert solved.ok
    np.testing.assert_allclose(x[0], np.linalg.solve(matrix, b), rtol=0, atol=1e-10)


# derivatives


def demand_derivatives(start, method, modes):
    """Derivatives of a measure of three steps, by stiffness and by the speed at the start, against central differences."""

    @jax.jit
    def measure(numbers):
        stiff, push = numbers
        parts = lambda s: (s.forces[1].k, s.state.velocity)  # noqa: E731
        k, v = parts(start)
        scene = eqx.tree_at(parts, start, (k * stiff, v * push))
        x, v = simulate(scene, method, dt=DT, steps=3, save_every=3).final_scene.state
        return jnp.sum(x[..., 1] ** 2) + 0.1 * jnp.sum(v[..., 0] * x[..., 2])

    at, h = np.asarray([1.0, 1.0]), 1e-5
    central = [(measure(at + h * e) - measure(at - h * e)) / (2 * h) for e in np.eye(2)]
    for mode in modes:
        np.testing.assert_allclose(mode(measure)(at), central, rtol=1e-5)


@pytest.mark.slow
def test_the_gradient_through_a_cloth_agrees_with_central_differences():
    demand_derivatives(crumpled(hung(12), 2e-3), ImplicitEuler(tolerance=1e-13), [jax.grad])


@pytest.mark.slow
def test_derivatives_through_converged_steps_agree_with_central_differences_in_both_modes():
    rope_in_air = crumpled(rope(8, damping=0.02), 2e-3)
    demand_derivatives(rope_in_air, ImplicitEuler(tolerance=1e-12, newton=20), [jax.grad, jax.jacfwd])
