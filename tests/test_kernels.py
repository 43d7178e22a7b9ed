"""Steps in one kernel equal steps in a loop, in Pallas' interpreter; and a card's compiler gets a program it can read."""

import importlib
from contextlib import contextmanager
from unittest import mock

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from physjax import Particles, Scene, backend, contacts, forces, inertia, methods, rigid, simulate, xla_options
from physjax.checks import quantity
from physjax.kernels import LaneKernel
from physjax.parts import Force
from physjax.programs import iterate_operations

loop = importlib.import_module("physjax.stepping.simulate")
LANES = 133
"""More than a block, and not a multiple of one."""


@contextmanager
def as_if_on_a_gpu():
    """The policies of a GPU, on the CPU: kernels run in Pallas' interpreter, options that only a card has are left out."""
    gpu = mock.patch.object(backend, "device_kind", return_value="gpu")
    loop._get_standalone_run.cache_clear()
    with gpu, mock.patch.object(xla_options, "COMMAND_BUFFER_OPTIONS", {}):
        yield
    loop._get_standalone_run.cache_clear()


def numbers(*shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape))


# what each operation does


def short_loop(x, v):
    return lax.scan(lambda c, p: (c + p, c * p), x[0], jnp.stack([x, v]).ravel())


def find_root(x, v):
    return lax.custom_root(
        lambda y: y * y * y + y - x[0],
        x[0],
        lambda f, y: lax.fori_loop(0, 40, lambda _, y: y - f(y) / (3 * y * y + 1), y),
        lambda g, b: b / g(jnp.ones_like(b)),
    )


OPERATIONS = {
    "arithmetic": lambda x, v: jnp.where(x > v, jnp.sin(x) * v, jnp.clip(x, -0.5, 0.5)) + 2.0,
    "a known number": lambda x, v: x * (np.arange(3) + 1.0) + v[1] * jnp.sqrt(2.0),
    "axes": lambda x, v: (jnp.stack([x, v]).T[::-1], jnp.pad(x, (1, 2))[1:], jnp.roll(v, 1), jnp.tile(x, 2)),
    "sums and extremes": lambda x, v: (x.sum(), x.prod(), v.max(), v.min(), (x > 0).any(), (v > -1).all()),
    "running sums": lambda x, v: (jnp.cumsum(x), lax.cumsum(v, reverse=True), lax.cummax(x)),
    "the first extreme": lambda x, v: (jnp.argmin(x), jnp.argmax(v), jnp.argmin(x.at[1].set(jnp.nan))),
    "products of matrices": lambda x, v: (jnp.outer(x, v) @ v, jnp.einsum("ij,j->i", jnp.outer(v, x), x)),
    "a place that each lane chooses": lambda x, v: (x[jnp.argmin(v)], v.at[jnp.argmax(x)].set(7.0)),
    "a slice that each lane chooses": lambda x, v: lax.dynamic_slice(x, (jnp.argmin(v) - 1,), (2,)),
    "a slice replaced": lambda x, v: lax.dynamic_update_slice(x, v[:2], (jnp.argmax(v),)),
    "either branch": lambda x, v: lax.cond(x[0] > 0, lambda: (x * v, 1.0), lambda: (v, jnp.sum(jnp.sqrt(x * x)))),
    "a branch by a known number": lambda x, v: lax.cond(np.float64(1) > 0, lambda: x, lambda: v),
    "a loop with an end of its own": lambda x, v: lax.while_loop(
        lambda s: s[0] < 20, lambda s: (2 * s[0] + 1, s[1] + 1), (x[0] * x[0], 0)
    ),
    "turns along an array": short_loop,
    "many turns": lambda x, v: lax.fori_loop(0, 50, lambda i, y: 0.9 * y + v[0], x),
    "a root": find_root,
    "integers": lambda x, v: (jnp.round(2 * x), jnp.round(jnp.floor(9 * v) / 2), lax.round(jnp.floor(9 * v) / 2)),
    "fewer digits": lambda x, v: lax.reduce_precision(jnp.concatenate([x, v * 1e30]), 11, 20),
}


@pytest.mark.parametrize("name", OPERATIONS)
def test_an_operation_is_the_same_number_by_number(name):
    function, x, v = OPERATIONS[name], numbers(LANES, 3), numbers(LANES, 3, seed=1)
    wanted = jax.vmap(lambda x, v: function(x, v))(x, v)
    # what a step returns is what it is given, so that what the function returns takes part in it
    start = jax.tree.map(jnp.zeros_like, wanted)
    masks = jax.tree.map(lambda _: True, (start, (x, v)))

    def run(x, v):
        kernel = LaneKernel.of(lambda i, _, rest: function(*rest), (LANES,), start, (x, v), masks)
        return kernel.moving.join(kernel.advance(kernel.start(start), jnp.int32(0), 1))

    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13), jax.jit(run)(x, v), wanted)


@pytest.mark.parametrize(
    "function",
    [
        lambda x: x + jax.random.normal(jax.random.wrap_key_data(jnp.zeros(2, jnp.uint32)), (3,)) * x[0],
        lambda x: jnp.sort(x),
        lambda x: lax.switch(jnp.argmin(x), [lambda: x, lambda: -x, lambda: 2 * x]),
        lambda x: x * numbers(1000)[jnp.argmin(x)],
    ],
    ids=["random", "sorted", "three branches", "a table"],
)
def test_what_is_not_for_a_kernel_is_known_before_it_runs(function):
    x = numbers(LANES, 3)
    assert LaneKernel.of(lambda i, x, _: function(x), (LANES,), x, (), (True, ())) is None


# what scenes do


def throws(dtype, lanes=(LANES,), dim=3):
    x, v = np.random.default_rng(0).normal(size=(2, *lanes, dim))
    return Particles(jnp.asarray(0.3 * x + 2 * np.eye(dim)[1], dtype), jnp.asarray(v, dtype))


def floor(**options):
    return (contacts.Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), restitution=0.8, **options),)


def build_bricks(dtype):
    brick = inertia.box(2.0, (1.0, 2.0, 3.0))
    turn = numbers(LANES, 3).astype(dtype)
    return Scene(rigid.bodies(brick, np.zeros((LANES, 3), dtype), angular_velocity=turn), brick, (forces.Gravity(),))


def build_squalls(dtype):
    """A mass, a wind and a moment of each lane's own, far from t = 0."""
    at = np.linspace(0.01, 0.08, LANES).astype(dtype)
    wind = forces.QuadraticDrag(0.01, 0.5, wind=numbers(LANES, 3).astype(dtype))
    kick = forces.Kick((1.0, 2.0, 0.0), at=at, duration=0.03)
    return Scene(throws(dtype), np.linspace(0.5, 2.0, LANES).astype(dtype), (forces.Gravity(), wind, kick))


DRAG = (
    forces.Gravity(),
    forces.QuadraticDrag(0.01, 0.5, wind=(1.0, 0.0, 0.0)),
    forces.Magnus(1e-3, 0.2, (0.0, 0.0, 1.0)),
)
SCENES = {
    "a flight": (lambda f: Scene(throws(f), 1.0, DRAG), methods.rk4),
    "one lane": (lambda f: Scene(throws(f, ()), 1.0, DRAG), methods.verlet),
    "two axes of lanes": (lambda f: Scene(throws(f, (7, 5)), 1.0, DRAG), methods.midpoint),
    "the plane": (lambda f: Scene(throws(f, dim=2), 1.0, (forces.Gravity(), forces.StokesDrag(0.1))), methods.leapfrog),
    "numbers per lane": (build_squalls, methods.rk4),
    "contact at the end": (lambda f: Scene(throws(f), 1.0, DRAG, floor(response=contacts.project)), methods.rk4),
    "held lanes": (lambda f: Scene(throws(f), 1.0, DRAG, pinned=np.arange(LANES) % 2 == 0), methods.rk4),
    "implicit steps": (lambda f: Scene(throws(f), 1.0, DRAG), methods.implicit_euler),
    "bodies": (build_bricks, methods.rk4),
    "steps of their own": (lambda f: Scene(throws(f), 1.0, DRAG), None),
    "impacts": (lambda f: Scene(throws(f), 1.0, DRAG, floor()), methods.rk4),
    "impacts with friction": (
        lambda f: Scene(throws(f), 1.0, DRAG, floor(coulomb=contacts.Coulomb(0.5, 0.4))),
        methods.semi_implicit_euler,
    ),
}


def run(scene, method, **options):
    return simulate(scene, method, dt=0.02, steps=60, save_every=15, **options)


@pytest.mark.parametrize(
    ("name", "dtype"),
    [
        *((name, (np.float64, np.float32)[i % 2]) for i, name in enumerate(SCENES)),
        ("a flight", np.float32),
    ],
)
def test_a_run_in_kernels_is_the_run_in_a_loop(name, dtype):
    build, method = SCENES[name]
    with jax.enable_x64(dtype is np.float64):
        scene, method = build(dtype), method or methods.adaptive(methods.rk4, atol=1e-4)
        wanted = run(scene, method, first_step=1000)
        with (
            as_if_on_a_gpu(),
            mock.patch.object(LaneKernel, "advance", autospec=True, side_effect=LaneKernel.advance) as used,
        ):
            found = run(scene, method, first_step=1000)
        assert used.call_count
    assert (found.ok == wanted.ok).all()
    assert (found.time == wanted.time).all()
    digits = 200 * np.finfo(dtype).eps
    for a, b in zip(jax.tree.leaves(found.state), jax.tree.leaves(wanted.state), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        np.testing.assert_allclose(a, b, rtol=digits, atol=digits * float(jnp.abs(b).max()))


def holds_kernel(program):
    return any(eqn.primitive.name == "pallas_call" for eqn in iterate_operations(program))


def test_derivatives_and_runs_within_others_take_the_loop():
    scene = Scene(throws(float), 1.0, DRAG)

    def height(velocity):
        return run(scene.replace(state=scene.state._replace(velocity=velocity)), methods.rk4).position[-1, :, 1].sum()

    with as_if_on_a_gpu():
        assert not holds_kernel(jax.make_jaxpr(height)(scene.state.velocity))
        assert not holds_kernel(jax.make_jaxpr(jax.grad(height))(scene.state.velocity))


def is_run_in_kernels(scene, method=methods.rk4):
    with (
        as_if_on_a_gpu(),
        mock.patch.object(LaneKernel, "advance", autospec=True, side_effect=LaneKernel.advance) as used,
    ):
        simulate(scene, method, dt=0.01, steps=2)
    return used.call_count > 0


def test_lanes_that_see_each_other_take_the_loop():
    assert not is_run_in_kernels(Scene(throws(float), 1.0, (forces.Gravitation(1.0),)))
    assert is_run_in_kernels(Scene(throws(float), 1.0, (forces.Gravity(),)))


class Push(Force):
    """A force of a user's own, with a number that is declared."""

    strength: jax.Array = quantity("strength", "N")

    def __call__(self, t, state, mass):
        return self.strength * jnp.ones_like(state.velocity)


def test_a_force_of_ones_own_runs_in_a_kernel_unless_it_may_know_all_lanes():
    push = numbers(LANES, 3)
    assert is_run_in_kernels(Scene(throws(float), 1.0, (Push(2.0),)))
    assert not is_run_in_kernels(Scene(throws(float), 1.0, (lambda t, state, mass: push,)))


class Slowed(eqx.Module):
    """A method whose steps leave a share of the velocity."""

    share: jax.Array

    def __call__(self, system, t, state, dt):
        end = methods.rk4(system, t, state, dt)
        return end._replace(velocity=end.velocity * self.share)


def test_a_method_with_an_array_takes_the_loop():
    scene = Scene(throws(float), 1.0, (forces.Gravity(),))
    assert is_run_in_kernels(scene, Slowed(jnp.asarray(0.9)))
    assert not is_run_in_kernels(scene, Slowed(jnp.linspace(0.5, 0.9, LANES)[:, None]))


def test_a_long_step_takes_the_loop(monkeypatch):
    monkeypatch.setattr("physjax.kernels.flights.MAX_KERNEL_OPERATIONS", 100)
    assert not is_run_in_kernels(Scene(throws(float), 1.0, DRAG))


def test_arrays_elsewhere_take_the_loop():
    with as_if_on_a_gpu():
        assert backend.runs_as_kernel([numbers(3)])
        with mock.patch.object(jax, "default_backend", return_value="gpu"):
            assert not backend.runs_as_kernel([numbers(3)])
    assert not backend.runs_as_kernel([numbers(3)])


# what a card's compiler gets


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", ["a flight", "numbers per lane", "bodies", "steps of their own", "impacts"])
def test_a_kernel_is_written_for_a_card(name, dtype):
    gpu_info = pytest.importorskip("jax._src.pallas.triton.gpu_info", reason="this jax asks the card itself")
    triton = importlib.import_module("jax.experimental.pallas.triton")
    hopper = gpu_info.GpuInfo(gpu_version=None, arch_name="9.0", compute_capability=90)
    shape = backend.KernelShape(128, {"compiler_params": triton.CompilerParams(num_warps=4)})
    build, method = SCENES[name]
    with (
        jax.enable_x64(dtype is np.float64),
        as_if_on_a_gpu(),
        mock.patch("physjax.kernels.flights.choose_kernel_shape", return_value=shape),
        mock.patch.object(gpu_info, "get_gpu_info", return_value=hopper),
    ):
        scene, method = build(dtype), method or methods.adaptive(methods.rk4, atol=1e-4)
        step, first = jnp.asarray(0.01, dtype), jnp.zeros((), jnp.int32)
        whole = jax.jit(lambda scene: loop._run_steps(scene, method, step, first, 1, 8, None, in_kernel=True).state)
        text = whole.trace(scene).lower(lowering_platforms=("cuda",)).as_text()
    assert text.count("xla.gpu.triton") == 1
