"""Equations of first order as scenes, against diffrax (`reference`) and closed forms; what splits a rate refuses them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from physjax import Particles, Scene, backend, methods, ode_scene, reference, simulate
from physjax.first_order import Variables

WHOLE = ("euler", "midpoint", "heun", "rk4", "tsit5", "dopri8")
RHO = np.linspace(0.0, 21.0, 5)
STARTS = np.stack([1.0 + 0.1 * np.arange(5), 0.5 * np.arange(5), np.ones(5)], axis=-1)


def lorenz(t, y, rho):
    return jnp.stack([10.0 * (y[1] - y[0]), y[0] * (rho - y[2]) - y[1], y[0] * y[1] - 8.0 / 3.0 * y[2]])


def decay(t, y):
    """y' = -2 t y: y = y0 exp(-t²)."""
    return -2.0 * t * y


class Rotation(eqx.Module):
    """A rate with a table that all lanes share."""

    matrix: jax.Array

    def __call__(self, t, y):
        return self.matrix @ y


def test_lorenz_under_error_control_is_diffrax_and_no_lane_is_anothers_business():
    careful = methods.adaptive(methods.tsit5, 1e-10, 1e-10)
    run = lambda y0: simulate(ode_scene(lorenz, y0, jnp.asarray(RHO)), careful, dt=0.5, steps=2)  # noqa: E731
    ours, truth = run(jnp.asarray(STARTS)).state.y, reference(ode_scene(lorenz, STARTS, RHO), [0.0, 1.0])
    np.testing.assert_allclose(ours[-1], truth.state.y[-1], rtol=1e-7, atol=1e-7)
    spoiled = run(jnp.asarray(STARTS).at[2].set(1e100))
    assert np.array_equal(spoiled.ok, np.arange(5) != 2)
    np.testing.assert_array_equal(np.delete(spoiled.state.y, 2, axis=1), np.delete(ours, 2, axis=1))


@pytest.mark.parametrize("name", WHOLE)
def test_every_method_of_the_whole_rate_keeps_its_order(name):
    method, scene = methods.METHODS[name], ode_scene(decay, jnp.array([1.0, 2.0]))
    sizes = (4, 8) if method.promises.order > 5 else (16, 32)
    ends = [simulate(scene, method, dt=1.0 / n, steps=n, save_every=n).state.y[-1] for n in sizes]
    coarse, fine = (abs(float(end[0]) - np.exp(-1.0)) for end in ends)
    assert np.log2(coarse / fine) > method.promises.order - 0.35


def test_a_batch_is_what_vmap_makes_of_one(precision):
    starts, rho = jnp.asarray(STARTS, precision.dtype), jnp.asarray(RHO, precision.dtype)
    run = lambda y0, rho: simulate(ode_scene(lorenz, y0, rho), methods.rk4, dt=0.01, steps=20).state.y  # noqa: E731
    batch, mapped = run(starts, rho), jax.vmap(run, out_axes=1)(starts, rho)
    assert batch.dtype == precision.dtype
    np.testing.assert_allclose(batch, mapped, rtol=100 * precision.eps, atol=100 * precision.eps)


def test_two_axes_of_lanes_and_parameters_in_a_tree():
    def rate(t, y, given):
        return given["k"] * y + jnp.stack([given["c"], t])

    y0, k, c = jnp.ones((2, 3, 2)), jnp.linspace(-1.0, 1.0, 6).reshape(2, 3), jnp.asarray(0.5)
    batch = simulate(ode_scene(rate, y0, {"k": k, "c": c}), methods.rk4, dt=0.1, steps=4).state.y
    for i in range(2):
        alone = simulate(ode_scene(rate, y0[i, 1], {"k": k[i, 1], "c": c}), methods.rk4, dt=0.1, steps=4).state.y
        np.testing.assert_allclose(batch[:, i, 1], alone, rtol=1e-13)


def test_many_lanes_are_cut_into_blocks_that_end_where_all_at_once_do(monkeypatch):
    lanes = 37
    y0 = jnp.asarray(np.random.default_rng(0).normal(size=(lanes, 3)))
    whole = simulate(scene := ode_scene(lorenz, y0, jnp.linspace(0.0, 21.0, lanes)), methods.rk4, dt=0.01, steps=9)
    assert scene.may_be_cut()
    monkeypatch.setattr("physjax.stepping.blocks.count_lane_blocks", lambda lanes, steps: 4)
    cut = simulate(scene, methods.rk4, dt=0.01, steps=9, save_every=3)
    np.testing.assert_allclose(cut.state.y[-1], whole.state.y[-1], rtol=1e-12)
    assert backend.count_lane_blocks(lanes, 9) is None


def test_gradients_by_starts_parameters_and_tables_are_those_of_differences():
    def end(y0, rho):
        return jnp.sum(
            simulate(ode_scene(lorenz, y0, rho), methods.rk4, dt=0.01, steps=20, save_every=5).state.y[-1] ** 2
        )

    at = jnp.asarray(STARTS), jnp.asarray(RHO)
    check_grads(end, at, order=1, modes=("fwd", "rev"), eps=1e-6)

    def turned(matrix):
        return simulate(ode_scene(Rotation(matrix), jnp.ones((4, 2))), methods.rk4, dt=0.1, steps=3).state.y[-1, 0, 0]

    check_grads(turned, (jnp.array([[0.0, -1.0], [1.0, 0.0]]),), order=1, modes=("rev",), eps=1e-6)


def test_another_parameter_recompiles_nothing():
    run = jax.jit(lambda scene: simulate(scene, methods.rk4, dt=0.1, steps=3).state.y)
    for rho in (1.0, 2.0):
        run(ode_scene(lorenz, jnp.ones(3), rho))
    assert run._cache_size() == 1


@pytest.mark.parametrize("name", sorted({*methods.list_all_methods()} - {*WHOLE}))
def test_what_splits_a_rate_is_refused_before_anything_is_compiled(name):
    method, scene = methods.find_method(name), ode_scene(decay, jnp.ones(2))
    with pytest.raises(
        ValueError, match=r"ode_scene: got a method that kicks velocities .* Use methods.euler, midpoint"
    ):
        jax.eval_shape(lambda scene: method(scene, 0.0, scene.state, 0.1), scene)


@pytest.mark.parametrize(
    ("make", "kind", "words"),
    [
        (lambda: ode_scene("decay", jnp.ones(2)), TypeError, "got f of type str, expected a function"),
        (lambda: ode_scene(lorenz, jnp.ones(3)), TypeError, r"lorenz takes \(t, y, rho\), expected f\(t, y\), or"),
        (
            lambda: ode_scene(lambda t, y: y[0], jnp.ones(3)),
            TypeError,
            r"returned an array of shape \(\).*expected \(3,\)",
        ),
        (lambda: ode_scene(lambda t, y: [y], jnp.ones(3)), TypeError, "returned list, expected"),
        (lambda: ode_scene(decay, 1.0), ValueError, r"y0: got the shape \(\), expected \(dim,\)"),
        (lambda: ode_scene(decay, jnp.array([1.0, jnp.nan])), ValueError, "y0: got nan at index 1"),
        (
            lambda: ode_scene(lorenz, jnp.ones((4, 3)), jnp.ones(3)),
            ValueError,
            r"parameters: got the shape \(3,\), expected",
        ),
        (lambda: Scene(Variables(jnp.ones(2)), pinned=jnp.asarray(False)), ValueError, "pinned: got it for equations"),
    ],
)
def test_bad_input_is_refused_in_plain_words(make, kind, words, unannotated):
    with pytest.raises(kind, match=words):
        make()


def test_a_scene_of_first_order_says_what_it_is():
    scene = ode_scene(lorenz, jnp.ones((4, 3)), jnp.asarray(2.0))
    assert repr(scene).startswith("<Scene: 4 systems, first order in 3 variables")
    assert "lorenz(t, y, 2)" in repr(scene)
    assert "particle" in repr(Scene(Particles(jnp.ones(2), jnp.ones(2))))
