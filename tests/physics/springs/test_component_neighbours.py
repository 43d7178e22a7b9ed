"""On a GPU springs are computed by components, at both ends or once: what they do is what they do on a CPU."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Pins, Scene, backend, forces, lattices, methods, simulate
from physjax.physics.springs import Springs
from physjax.physics.springs import topology as layouts

LAYOUTS = pytest.mark.parametrize("layout", ["bands", "gather"])
TWICE = pytest.mark.parametrize("twice", [True, False], ids=["at both ends", "once"])
ROWS, COLUMNS = 3, 4


def build_sheet(layout, *, each=False, breaks_at=None, yields_at=None):
    """A crumpled cloth in motion, with pairs in either order and numbers for all springs or for each."""
    random = np.random.default_rng(3)
    sheet = lattices.cloth(1.0, 1.0, rows=ROWS, columns=COLUMNS, mass=0.6, structural=80.0, shear=50.0)
    pairs = np.asarray(sheet.springs.pairs)
    pairs = np.where(random.random((len(pairs), 1)) < 0.5, pairs, pairs[:, ::-1])
    stiffness = random.uniform(50.0, 90.0, len(pairs)) if each else 70.0
    springs = Springs(
        pairs, stiffness, 0.9 * sheet.springs.rest_length, 0.3, breaks_at, layout=layout, yields_at=yields_at
    )
    moved = np.asarray(sheet.state.position) + 0.03 * random.normal(size=sheet.state.position.shape)
    return sheet, springs, Particles(jnp.asarray(moved), jnp.asarray(random.normal(size=moved.shape)))


def compare_as_if_for_a_gpu(monkeypatch, twice, compute, *numbers, tolerance=1e-13):
    """A function of arrays traced for a CPU and as if for a GPU gives the same to rounding."""
    wanted = jax.jit(lambda *a: compute(*a))(*numbers)
    monkeypatch.setattr(backend, "device_kind", lambda: "gpu")
    monkeypatch.setattr(layouts, "SPRINGS_AT_BOTH_ENDS", twice)
    found = jax.jit(lambda *a: compute(*a))(*numbers)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * max(1.0, float(np.abs(b).max())))


def weigh(springs, state):
    """A number that depends on all that springs do, and what they do: forces [N] and energies [J] at the nodes."""
    newtons, joules = springs(0.0, state, 1.0), springs.potential(0.0, state, 1.0)
    return jnp.sum(newtons**3) + jnp.sum(joules**2), (newtons, joules)


@LAYOUTS
@TWICE
def test_forces_and_energies_are_the_same(layout, twice, monkeypatch):
    _, springs, state = build_sheet(layout, each=True)
    turned = jax.tree.map(lambda a: jnp.stack([a, 1.1 * a]), state)
    compute = lambda one, many: (weigh(springs, one), jax.vmap(partial(weigh, springs))(many))  # noqa: E731
    compare_as_if_for_a_gpu(monkeypatch, twice, compute, state, turned)


@pytest.mark.parametrize(("layout", "twice"), [("bands", True), ("gather", False)])
def test_derivatives_are_the_same(layout, twice, monkeypatch):
    _, springs, state = build_sheet(layout, each=True)
    arrays, static = eqx.partition(springs, eqx.is_inexact_array)

    def compute(arrays, state):
        linear = eqx.combine(arrays, static).linearised_at(0.0, state, 1.0)
        derive = jax.grad(lambda arrays, state: weigh(eqx.combine(arrays, static), state)[0], argnums=(0, 1))
        return derive(arrays, state), linear(0.0, jax.tree.map(lambda a: 1.01 * a, state), 1.0)

    compare_as_if_for_a_gpu(monkeypatch, twice, compute, arrays, state)


@LAYOUTS
@TWICE
def test_springs_part_in_the_same_places(layout, twice, monkeypatch):
    _, springs, state = build_sheet(layout, breaks_at=0.2)
    compute = lambda state: springs.advance(0.0, 0.1, state)[0].unbroken  # noqa: E731
    parted = np.asarray(compute(state))
    assert 0 < parted.sum() < parted.size
    compare_as_if_for_a_gpu(monkeypatch, twice, compute, state)


@pytest.mark.parametrize(("layout", "twice"), [("bands", True), ("gather", False)])
def test_springs_yield_by_as_much(layout, twice, monkeypatch):
    _, springs, state = build_sheet(layout, yields_at=0.1)

    def compute(state):
        bent = springs.advance(0.0, 0.1, state)[0]
        return bent.permanent_set, weigh(bent, state), weigh(springs, state)

    assert 0 < np.sum(np.asarray(compute(state)[0]) != 0) < len(springs.pairs)
    compare_as_if_for_a_gpu(monkeypatch, twice, compute, state)


@LAYOUTS
def test_a_run_with_wind_and_a_moving_edge_is_the_same(layout, monkeypatch):
    sheet, springs, state = build_sheet(layout, breaks_at=0.5)
    pins = Pins(sheet.nodes["left"], lambda t: state.position + jnp.array([[0.0, 2.0, 0.0]]) * t)
    scene = Scene(
        pins.prescribe(0.0, state),
        sheet.mass,
        (forces.Gravity(), springs, sheet.wind((1.0, 2.0, 3.0))),
        pinned=pins,
    )
    # stored before each evaluation, as for larger sheets
    monkeypatch.setattr("physjax.scene.needs_split_compilation", lambda couples, lanes: couples)

    def run(speed):
        moved = scene.replace(state=scene.state._replace(velocity=speed * scene.state.velocity))
        end = simulate(moved, methods.semi_implicit_euler, dt=1e-3, steps=2, save_every=2).final_scene
        return jnp.sum(end.state.position**2), (end.state, end.forces[1].unbroken)

    compute = jax.value_and_grad(run, has_aux=True)
    compare_as_if_for_a_gpu(monkeypatch, True, compute, jnp.asarray(1.0))
