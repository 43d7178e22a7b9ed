"""What every force must be, whatever its law: the same in lanes and alone, smooth at rest, in the scene's dtype."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, forces


class Case(NamedTuple):
    """A force with its numbers and vectors, for a few lanes in `dim` dimensions."""

    build: Callable
    numbers: dict
    vectors: dict
    dim: int


WIND = {"wind": [1.0, -2.0, 0.5]}
CASES = {
    "Gravity": Case(forces.Gravity, {"g": 9.8}, {}, 2),
    "Gravity along z": Case(lambda **n: forces.Gravity(**n, up=2), {"g": 9.8}, {}, 3),
    "Constant": Case(forces.Constant, {}, {"force": [3.0, -1.0]}, 2),
    "Kick": Case(forces.Kick, {"at": 0.3, "duration": 0.4}, {"impulse": [2.0, 1.0]}, 2),
    "Blast": Case(
        forces.Blast, {"impulse": 2.0, "reach": 0.7, "at": 0.3, "duration": 0.4}, {"center": [0.1, 0.2, -0.3]}, 3
    ),
    "Control": Case(forces.Control, {"at": 0.3, "duration": 2.0}, {"values": [[2.0, 1.0], [-1.0, 3.0], [4.0, 0.5]]}, 2),
    "Control, linear": Case(
        lambda **n: forces.Control(**n, linear=True),
        {"at": 0.3, "duration": 2.0},
        {"values": [[2.0, 1.0], [-1.0, 3.0], [4.0, 0.5]]},
        2,
    ),
    "Rocket": Case(
        lambda **n: forces.Rocket(flow=0.1, forces=(forces.StokesDrag(0.2),), **n),
        {"thrust": 3.0, "at": 0.3, "duration": 0.4},
        {"direction": [1.0, 2.0, -0.5]},
        3,
    ),
    "StokesDrag": Case(forces.StokesDrag, {"coefficient": 0.3}, WIND, 3),
    "StokesDrag in still air": Case(forces.StokesDrag, {"coefficient": 0.3}, {}, 2),
    "QuadraticDrag": Case(forces.QuadraticDrag, {"area": 0.1, "coefficient": 0.4, "density": 1.2}, WIND, 3),
    "QuadraticDrag in still air": Case(forces.QuadraticDrag, {"area": 0.1, "coefficient": 0.4}, {}, 2),
    "SphereDrag": Case(forces.SphereDrag, {"radius": 0.1, "density": 1.2, "viscosity": 1.8e-5}, WIND, 3),
    "TabulatedDrag": Case(
        lambda **n: forces.TabulatedDrag([0.0, 1.0, 3.0], [0.4, 0.9, 0.6], **n),
        {"area": 0.1, "density": 1.2, "speed_of_sound": 1.5},
        WIND,
        3,
    ),
    "Magnus": Case(forces.Magnus, {"area": 0.1, "coefficient": 0.4, "density": 1.2}, WIND | {"axis": [1.0, 2, -3]}, 3),
    "Magnus in the plane": Case(forces.Magnus, {"area": 0.1, "coefficient": 0.4, "axis": -2.0}, {}, 2),
    "SpinLift": Case(forces.SpinLift, {"radius": 0.3, "density": 1.2}, WIND | {"angular_velocity": [1.0, 2, -3]}, 3),
    "SpinLift in the plane": Case(forces.SpinLift, {"radius": 0.3, "angular_velocity": -2.0}, {}, 2),
    "InAir": Case(
        lambda **n: forces.InAir(
            forces.QuadraticDrag(**n),
            wind=lambda t, x: 0.5 * x,
            thinning=lambda t, x: jnp.exp(-0.2 * x[..., 1]),
        ),
        {"area": 0.1, "coefficient": 0.4},
        WIND,
        3,
    ),
    "Buoyancy": Case(forces.Buoyancy, {"density": 1e3, "volume": 1e-3, "g": 9.8}, {}, 2),
    "Buoyancy at a surface": Case(forces.Buoyancy, {"density": 1e3, "radius": 0.8, "surface": 0.1, "g": 9.8}, {}, 2),
    "Lorentz": Case(forces.Lorentz, {"charge": 0.3}, {"magnetic": [1.0, 2.0, -3.0], "electric": [0.2, 0.0, 0.5]}, 3),
    "Lorentz in the plane": Case(forces.Lorentz, {"charge": 0.3, "magnetic": -2.0}, {}, 2),
    "RotatingFrame": Case(forces.RotatingFrame, {}, {"omega": [0.4, 1.0, -0.3]}, 3),
    "RotatingFrame, changing": Case(
        forces.RotatingFrame, {}, {"omega": [0.4, 1.0, -0.3], "omega_rate": [0.2, 0.0, 0.5]}, 3
    ),
    "RotatingFrame in the plane": Case(forces.RotatingFrame, {"omega": 0.7, "omega_rate": 0.2}, {}, 2),
    "Anchor": Case(forces.Anchor, {"stiffness": 5.0, "damping": 0.3}, {"point": [0.2, -0.1]}, 2),
    "Anchor with a rest length": Case(
        forces.Anchor, {"stiffness": 5.0, "damping": 0.3, "rest_length": 0.9}, {"point": [0.2, -0.1, 0.4]}, 3
    ),
}
EVERY = pytest.mark.parametrize("case", CASES.values(), ids=CASES)
LANES = 3
SHARES = np.array([1.0, 1.5, 0.7])


def some_state(dim, dtype=float):
    x, v = np.random.default_rng(2).normal(size=(2, LANES, dim))
    return Particles(jnp.asarray(x, dtype), jnp.asarray(v, dtype))


def arguments(case, spread=np.asarray):
    """All numbers and vectors of a force, each spread over the lanes as told."""
    return {name: spread(np.array(value, float)) for name, value in (case.numbers | case.vectors).items()}


def pick(tree, i):
    return jax.tree.map(lambda leaf: leaf[i], tree)


def test_no_public_force_is_forgotten():
    tested_elsewhere = {"Gravitation", "SoftSpheres", "independent", "loads"}
    assert {name.split()[0].strip(",") for name in CASES} == set(forces.__all__) - tested_elsewhere


@EVERY
@pytest.mark.parametrize("shared", [False, True], ids=["a number per lane", "numbers for all lanes"])
def test_lanes_vmap_and_one_by_one_agree(case, shared):
    given = arguments(case, np.asarray if shared else lambda value: np.multiply.outer(SHARES, value))

    def lane(given, t, state, mass):
        return case.build(**given)(t, state, mass)

    def one_by_one(given, *lanes):
        return jnp.stack([lane(given if shared else pick(given, i), *pick(lanes, i)) for i in range(LANES)])

    ways = jax.jit(lambda *a: (lane(*a), jax.vmap(lane, (None if shared else 0, 0, 0, 0))(*a), one_by_one(*a)))
    together, mapped, alone = map(np.asarray, ways(given, 0.5 * SHARES, some_state(case.dim), 2.0 * SHARES))
    assert np.abs(alone).max() > 0.01
    np.testing.assert_allclose(together, alone, rtol=0, atol=1e-15 * np.abs(alone).max())
    np.testing.assert_allclose(mapped, alone, rtol=0, atol=1e-15 * np.abs(alone).max())


def smallest(case):
    """The force with all vectors zero, and all numbers that may be."""
    given = {name: np.zeros(np.shape(vector)) for name, vector in case.vectors.items()} | case.numbers
    for name in case.numbers:
        try:
            case.build(**{**given, name: 0.0})
        except ValueError:
            continue
        given[name] = 0.0
    return case.build(**given)


@EVERY
def test_value_and_derivatives_are_finite_at_rest_and_at_nothing(case):
    @jax.jit
    def derivatives(scene):
        """Value, gradient by reverse mode, derivative by forward mode and second derivative, in one direction of all."""

        def weighed(scene):
            t = jnp.zeros((), jnp.float32)
            parts = [scene.acceleration(t, scene.state)]
            if scene.forces[0].jumps:
                parts += [scene.averaged_over_step(t, t + 0.1).acceleration(t, scene.state)]
            return sum(jnp.vdot(part, jnp.arange(1.0, 1 + part.size, dtype=part.dtype)) for part in parts)

        return jax.jvp(jax.value_and_grad(weighed), (scene,), (jax.tree.map(jnp.ones_like, scene),))

    vectors = {name: np.zeros(np.shape(vector)) for name, vector in case.vectors.items()}
    with jax.enable_x64(False):  # float32, where a derivative leaves the range first
        nothing = jnp.zeros((1, case.dim))
        for force in (case.build(**case.numbers, **vectors), smallest(case)):
            found = derivatives(Scene(Particles(nothing, nothing), 2.0, (force,)))
            for path, leaf in jax.tree.leaves_with_path(found):
                assert np.isfinite(leaf).all(), jax.tree_util.keystr(path)
                assert leaf.dtype == np.float32


@EVERY
def test_values_have_the_dtype_and_the_shape_of_the_state(case, precision):
    state = some_state(case.dim, precision.dtype)
    scene = Scene(state, 2.0, (case.build(**arguments(case)),))
    (force,) = scene.forces
    value = jax.eval_shape(force, 0.5, state, scene.mass)
    assert (value.shape, value.dtype) == ((LANES, case.dim), precision.dtype)
    if force.has_potential:
        energy = jax.eval_shape(force.potential, 0.5, state, scene.mass)
        assert (energy.shape, energy.dtype) == ((LANES,), precision.dtype)


CONSERVATIVE = {name: case for name, case in CASES.items() if case.build(**arguments(case)).has_potential}


@pytest.mark.parametrize("case", CONSERVATIVE.values(), ids=CONSERVATIVE)
def test_a_conservative_force_is_minus_the_gradient_of_its_potential(case):
    force = case.build(**{name: value for name, value in arguments(case).items() if name != "damping"})
    # above the surface, at both edges of a ball that crosses it (0.1 ± 0.8), in between, and below
    height = np.array([2.0, 0.9, 0.6, 0.1, -0.1, -0.5, -0.66, -0.7, 0.1 - 0.8, -3.0])

    def energy(x):
        return jnp.sum(force.potential(0.0, Particles(x, x), jnp.asarray(2.0)))

    x = jnp.asarray(np.tile(height[:, None], case.dim))
    value = np.asarray(force(0.0, Particles(x, jnp.zeros_like(x)), jnp.asarray(2.0)))
    assert np.abs(value).max() > 0.1
    np.testing.assert_allclose(-jax.grad(energy)(x), value, rtol=0, atol=4e-15 * np.abs(value).max())
