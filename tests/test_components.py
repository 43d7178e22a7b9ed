"""A step by components equals the step: for every operation, force and method, and for its derivatives."""

import importlib
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from physjax import Particles, Scene, backend, contacts, forces, inertia, methods, rigid
from physjax.backend import any_lane, block_fusion, splits_vectors
from physjax.components import compute_by_components, forget_wholes, join_vectors, split_vectors
from physjax.components.values import Split, is_stored
from physjax.parts import as_module
from physjax.scenes import SCENES
from physjax.stepping.methods import METHODS
from physjax.vectors import cross, dot, norm, scale, spin, square_root, turn_left, unit

loop = importlib.import_module("physjax.stepping.simulate")
frames = importlib.import_module("physjax.stepping.frames")


def split_all(tree):
    """Every array of a tree as its components alone."""
    return forget_wholes(split_vectors(tree, jax.tree.map(lambda _: True, tree)))


def by_components(function, *vectors):
    """What a function of vectors gives when they come by components."""
    parts = split_all(vectors)
    return compute_by_components(function, *parts, like=jax.eval_shape(function, *vectors))(*parts)


# what each operation is

MATRIX = np.random.default_rng(1).normal(size=(5, 3))
OPERATIONS = {
    "arithmetic": lambda x, v: jnp.where(x > 0, x * v, jnp.clip(x, -0.5, 0.5)) + 2.0,
    "a number per lane": lambda x, v: x[..., :1] * v + jnp.sum(x, axis=-1, keepdims=True),
    "a number for all": lambda x, v: x * v[0, 0] + jnp.broadcast_to(v[0, 1], x.shape),
    "a vector for all": lambda x, v: x + v[0],
    "vectors of a cross product": lambda x, v: cross(x, spin(v, x)),
    "the plane": lambda x, v: turn_left(x[..., :2]),
    "components in another order": lambda x, v: (x[..., ::-1], jnp.flip(v, axis=(0, 1)), x[..., 1:], x[..., ::2]),
    "a stack of components": lambda x, v: 2.0 * jnp.stack([x[..., 0], v[..., 2]], axis=-1),
    "a stack of lanes": lambda x, v: jnp.stack([x, v]) * 2.0,
    "a stack of vectors": lambda x, v: jnp.stack([x, v], axis=-1) * 2.0,
    "lanes side by side": lambda x, v: jnp.concatenate([x[:1], v, jnp.zeros((2, 3))]) + 1.0,
    "components side by side": lambda x, v: jnp.concatenate([x, v[..., :1], jnp.ones((3, 2))], axis=-1),
    "shifted lanes": lambda x, v: jnp.roll(x, 1, axis=0) + jnp.pad(v[1:], ((0, 1), (0, 0))),
    "padded components": lambda x, v: jnp.pad(x, ((0, 0), (1, 0))),
    "lanes in another order": lambda x, v: x[jnp.array([2, 0, 0])] + v[1],
    "picked components": lambda x, v: x[:, jnp.array([2, 0])],
    "written lanes": lambda x, v: x.at[jnp.array([1, 1])].add(v[:2]).at[0].set(v[1]),
    "written components": lambda x, v: x.at[:, 0].set(v[:, 1]),
    "moving windows": lambda x, v: lax.dynamic_update_slice(x, lax.dynamic_slice(v, (1, 0), (2, 3)), (0, 0)),
    "sums over lanes": lambda x, v: (jnp.sum(x, axis=0), jnp.cumsum(v, axis=0), jnp.max(x, axis=(0, 1))),
    "sums over components": lambda x, v: (jnp.sum(x, axis=-1), jnp.cumsum(v, axis=-1), jnp.all(x > -1, axis=-1)),
    "axes moved": lambda x, v: (x.T + v, jnp.moveaxis(x[None], 1, 0) * 2.0),
    "axes regrouped": lambda x, v: (x.reshape(1, 3, 3) + 1.0, x.reshape(9) + 1.0, x[..., None] * v[:, None, :]),
    "axes of length one": lambda x, v: (x[None][:, :, None] * 2.0, jnp.squeeze(x[:, :1], -1), x[:1].squeeze(0)),
    "a matrix times vectors": lambda x, v: (jnp.asarray(MATRIX) @ x, x @ v, jnp.einsum("ni,ni->n", x, v)),
    "pieces": lambda x, v: (jnp.split(x, 3), jnp.split(v, 3, axis=-1), jnp.unstack(x), jnp.tile(x, (2, 1))),
    "sorted": lambda x, v: (jnp.sort(x, axis=0), jnp.argmax(v, axis=-1)),
    "without fusion": lambda x, v: block_fusion((x * 2.0, v[:, 0], jnp.ones((3, 1)) * x[0, 0])),
    "constants": lambda x, v: x * np.arange(3.0) + jnp.arange(9.0).reshape(3, 3) * v,
    "lengths": lambda x, v: unit(x) + scale(norm(v), x),
}
EPS = np.finfo(float).eps
X, V = np.random.default_rng(0).normal(size=(2, 3, 3))  # as many lanes as components: no length tells them apart


def assert_close(found, wanted, eps=EPS, roundings=16):
    """The same trees up to some roundings of the largest number of each array."""
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        a, b = np.asarray(a, float), np.asarray(b, float)
        np.testing.assert_allclose(a, b, rtol=0, atol=roundings * eps * max(1.0, np.abs(b).max(initial=0.0)))


@pytest.mark.parametrize("name", OPERATIONS)
def test_an_operation_on_components_is_the_operation(name):
    function = OPERATIONS[name]
    with jax.numpy_rank_promotion("allow"):
        assert_close(by_components(function, jnp.asarray(X), jnp.asarray(V)), function(jnp.asarray(X), jnp.asarray(V)))


@pytest.mark.parametrize("name", ["arithmetic", "lengths", "shifted lanes"])
def test_results_stay_split_where_they_are_wanted_so_and_nothing_is_joined_on_the_way(name):
    x, v = jnp.asarray(X), jnp.asarray(V)
    parts = split_all((x, v))
    with jax.numpy_rank_promotion("allow"):
        program = compute_by_components(OPERATIONS[name], *parts, like=parts[0])
        found, text = program(*parts), str(jax.make_jaxpr(program)(*parts))
        assert isinstance(found, Split)
        assert_close(join_vectors(found), OPERATIONS[name](x, v))
    assert "concatenate" not in text or name == "shifted lanes"
    assert "f64[3,3]" not in text


def test_trees_are_split_and_joined():
    tree = {"x": jnp.asarray(X), "n": jnp.arange(3.0)}
    split = split_vectors(tree, {"x": True, "n": False})
    assert [is_stored(split["x"]), is_stored(split["n"])] == [True, False]
    assert_close(join_vectors(forget_wholes(split)), tree)


# loops and branches


def turn(x, v):
    return x + 0.1 * scale(norm(v), v), v - 0.1 * unit(x)


def loops(x, v):
    """A scan with a vector that begins as zero, a loop with an end that it finds, a branch and a replayed call."""

    def follow(carry, share):
        (x, v), total = carry
        x, v = turn(x, share * v)
        return ((x, v), total + x), x

    (end, total), path = lax.scan(follow, ((x, v), jnp.zeros_like(x)), jnp.arange(1.0, 4.0))
    x, v = lax.while_loop(lambda now: jnp.max(norm(now[0])) < 9.0, lambda now: (1.5 * now[0], now[1]), end)
    x = lax.cond(any_lane(norm(x) > 8.0), lambda: x - v, lambda: jnp.zeros_like(x))
    x, v = jax.checkpoint(turn)(x, v)
    _, slides = lax.scan(lambda carry, row: (carry, 2.0 * row), 0.0, path)
    return jax.jit(turn)(x, v), total, slides


def test_loops_and_branches_carry_components():
    x, v = jnp.asarray(X), jnp.asarray(V)
    assert_close(by_components(loops, x, v), loops(x, v))
    parts = split_all((x, v))
    like = jax.tree.map(lambda a: Split((a,)), jax.eval_shape(loops, x, v))
    text = str(jax.make_jaxpr(compute_by_components(loops, *parts, like=like))(*parts))
    assert "concatenate" not in text
    for name in ("scan[", "while[", "cond[", "remat2[", "custom_jvp_call[", "custom_vmap_call["):
        assert name in text


def test_derivatives_of_loops_are_theirs():
    x, v = jnp.asarray(X), jnp.asarray(V)

    def end(way, x, v):
        def follow(carry, _):
            return turn(*carry), None

        return way(lambda x, v: lax.scan(follow, (x, v), None, length=3)[0][0], x, v)

    split, whole = partial(end, by_components), partial(end, lambda function, *vectors: function(*vectors))
    batch = jnp.stack([x, v, x + v])

    @jax.jit
    def differentiate(x, v, batch):
        weigh = lambda f: jax.grad(lambda x, v: jnp.sum(f(x, v) ** 2), argnums=(0, 1))(x, v)  # noqa: E731
        return [(weigh(f), jax.jvp(f, (x, v), (v, x)), jax.vmap(f)(batch, batch)) for f in (split, whole)]

    assert_close(*differentiate(x, v, batch))


def test_second_derivatives_keep_the_rules_at_zero_in_any_nesting_of_the_modes():
    def end(v):
        push = lambda v, _: (v - scale(norm(v), v) + 0.1 * unit(v) + square_root(dot(v, v)), None)  # noqa: E731
        return by_components(lambda v: lax.scan(push, v, None, length=3)[0][0], v)

    forward, backward = jax.jacfwd, jax.jacrev
    nestings = [(forward, forward), (forward, backward), (backward, backward), (backward, forward)]
    for second in jax.jit(lambda v: [outer(inner(end))(v) for outer, inner in nestings])(jnp.zeros(2)):
        np.testing.assert_array_equal(second, np.zeros((2, 2)))


def test_a_rule_does_not_see_what_does_not_move():
    seen = []

    @jax.custom_jvp
    def push(x, v, count):
        return x + v, count

    def rule(primals, tangents):
        seen.append([type(tangent).__name__ for tangent in tangents])
        return push(*primals), (tangents[0], np.zeros((), jax.dtypes.float0))

    push.defjvp(rule, symbolic_zeros=True)
    x, v = jnp.asarray(X), jnp.asarray(V)
    along = lambda x: by_components(lambda x, v: push(x, v, jnp.int32(2))[0], x, v)  # noqa: E731
    assert_close(jax.jvp(along, (x,), (v,)), (x + v, v))
    assert [kinds[1:] for kinds in seen] == [["SymbolicZero", "SymbolicZero"]]


# a step


def run(monkeypatch, split, scene, method, steps=2, dt=0.05):
    """The states of a run whose vectors are split or not; the policy is not asked."""
    monkeypatch.setattr(frames, "splits_vectors", lambda: split)
    dt = jnp.asarray(dt, scene.state.dtype)
    return loop._run_steps(scene, as_module(method), dt, jnp.int32(0), 1, steps, None).state


def throws(dim, dtype=float, lanes=3):
    x, v = np.random.default_rng(2).normal(size=(2, lanes, dim))
    return Particles(jnp.asarray(x, dtype), jnp.asarray(v, dtype))


def assert_same_run(monkeypatch, scene, method, eps, **options):
    """A run with vectors split and whole."""
    both = jax.jit(lambda scene: [run(monkeypatch, split, scene, method, **options) for split in (True, False)])
    assert_close(*both(scene), eps, roundings=256)


def assert_same_derivatives(monkeypatch, scene, method, forward=True):
    """A run's derivatives, reverse and forward too, by the state and all numbers of the scene."""

    def differentiate(scene, split):
        end = lambda scene: run(monkeypatch, split, scene, method, steps=2)  # noqa: E731
        weigh = lambda scene: sum(jnp.sum(leaf[-1] ** 2) for leaf in jax.tree.leaves(end(scene)))  # noqa: E731
        pushed = jax.jvp(end, (scene,), (jax.tree.map(jnp.ones_like, scene),))[1] if forward else None
        return pushed, jax.tree.leaves(jax.grad(weigh)(scene))

    both = jax.jit(lambda scene: [differentiate(scene, split) for split in (True, False)])
    assert_close(*both(scene), roundings=256)


WIND = {"wind": (1.0, -2.0, 0.5)}
FORCES = {
    "Constant": (2, lambda: forces.Constant((3.0, -1.0))),
    "Kick": (2, lambda: forces.Kick((2.0, 1.0), at=0.02, duration=0.04)),
    "Blast": (3, lambda: forces.Blast(impulse=2.0, center=(0.1, 0.2, -0.3), reach=0.7, at=0.02, duration=0.04)),
    "Control": (2, lambda: forces.Control(np.array([[2.0, 1.0], [-1.0, 3.0], [4.0, 0.5]]), at=0.0, duration=0.1)),
    "StokesDrag": (3, lambda: forces.StokesDrag(0.3, **WIND)),
    "QuadraticDrag": (3, lambda: forces.QuadraticDrag(0.1, 0.4, **WIND)),
    "SphereDrag": (3, lambda: forces.SphereDrag(0.1, **WIND)),
    "Magnus": (3, lambda: forces.Magnus(0.1, 0.4, (1.0, 2.0, -3.0), **WIND)),
    "SpinLift": (3, lambda: forces.SpinLift(0.3, (1.0, 2.0, -3.0), **WIND)),
    "Rocket": (
        2,
        lambda: forces.Rocket(3.0, flow=0.1, duration=5.0, direction=(0.6, 0.8), forces=(forces.StokesDrag(0.2),)),
    ),
    "InAir": (
        3,
        lambda: forces.InAir(
            forces.QuadraticDrag(0.1, 0.4), wind=lambda t, x: 0.5 * x, thinning=lambda t, x: jnp.exp(-0.2 * x[..., 1])
        ),
    ),
    "Magnus in the plane": (2, lambda: forces.Magnus(0.1, 0.4, -2.0)),
    "Buoyancy": (2, lambda: forces.Buoyancy(density=1e3, radius=0.8, surface=0.1)),
    "RotatingFrame": (3, lambda: forces.RotatingFrame((0.4, 1.0, -0.3), omega_rate=(0.2, 0.0, 0.5))),
    "RotatingFrame in the plane": (2, lambda: forces.RotatingFrame(0.7, omega_rate=0.2)),
    "Anchor": (3, lambda: forces.Anchor(stiffness=5.0, point=(0.2, -0.1, 0.4), damping=0.3, rest_length=0.9)),
    "Gravitation": (3, lambda: forces.Gravitation(1.0, softening=0.1)),
    "SoftSpheres": (3, lambda: forces.SoftSpheres(1.5, 30.0, 0.5)),
    "Lorentz": (3, lambda: forces.Lorentz(0.5, (0.3, -1.0, 2.0), (1.0, 0.2, -0.4))),
    "TabulatedDrag": (
        3,
        lambda: forces.TabulatedDrag([0.0, 1.0, 3.0], [0.4, 1.2, 0.6], area=0.1, density=1.2, speed_of_sound=5.0),
    ),
}


def test_no_public_force_is_forgotten():
    named = {name.split()[0] for name in FORCES} | {"Gravity"}
    assert named == set(forces.__all__) - {"independent", "loads"}


@pytest.mark.parametrize("precision", ["float32"], indirect=True)  # derivatives are taken in float64
@pytest.mark.parametrize("name", FORCES)
def test_a_run_under_every_force_is_the_same(name, precision, monkeypatch):
    dim, build = FORCES[name]
    scene = Scene(throws(dim, precision.dtype), 2.0, (forces.Gravity(), build()))
    assert_same_run(monkeypatch, scene, methods.midpoint, precision.eps)


@pytest.mark.parametrize("name", FORCES)
def test_derivatives_under_every_force_are_the_same(name, monkeypatch):
    dim, build = FORCES[name]
    scene = Scene(throws(dim), 2.0, (forces.Gravity(), build()))
    # the reverse mode goes through every rule of the forward one
    assert_same_derivatives(monkeypatch, scene, methods.semi_implicit_euler, forward=False)


@pytest.mark.parametrize(
    ("name", "dim", "precision"),
    [(name, *((3, "float64") if i % 2 else (2, "float32"))) for i, name in enumerate(METHODS)],
    indirect=["precision"],
)
def test_a_run_by_every_method_is_the_same(name, dim, precision, monkeypatch):
    drag = forces.QuadraticDrag(0.1, 0.4, wind=WIND["wind"][:dim])
    scene = Scene(
        throws(dim, precision.dtype), 2.0, (forces.Gravity(), drag, forces.Anchor(stiffness=2.0, point=(0.5,) * dim))
    )
    assert_same_run(monkeypatch, scene, METHODS[name], precision.eps)


def build_box():
    brick = inertia.box(2.0, (1.0, 2.0, 3.0))
    return Scene(rigid.bodies(brick, np.zeros((3, 3)), angular_velocity=(1.0, 2.0, 3.0)), brick, (forces.Gravity(),))


def build_balls(**options):
    state = Particles(
        jnp.asarray([[0.0, 0.1], [0.2, 0.3], [1.0, 2.0]]), jnp.asarray([[1.0, -9.0], [0.0, -4.0], [0.0, 0.0]])
    )
    floor = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.8, **options)
    return Scene(state, 1.0, (forces.Gravity(), forces.QuadraticDrag(0.1, 0.4)), (floor,))


@pytest.mark.parametrize(
    ("build", "method"),
    [
        (build_box, methods.rk4),
        (build_box, methods.verlet),
        (partial(build_balls, response=contacts.project), methods.rk4),
        (build_balls, methods.verlet),
        (
            lambda: Scene(throws(3), 2.0, (forces.Gravity(), forces.QuadraticDrag(0.1, 0.4))),
            methods.adaptive(methods.rk4),
        ),
        (lambda: SCENES["flag"]().scene, methods.semi_implicit_euler),
    ],
    ids=["free bodies", "free bodies, verlet", "a projected contact", "timed impacts", "adaptive steps", "a flag"],
)
def test_other_scenes_run_the_same(build, method, monkeypatch):
    assert_same_run(monkeypatch, build(), method, EPS, steps=4)


def test_gradients_through_impacts_are_the_same(monkeypatch):
    assert_same_derivatives(monkeypatch, build_balls(), methods.semi_implicit_euler)


def test_runs_in_a_batch_are_the_same(monkeypatch):
    scene = Scene(throws(3), 2.0, (forces.Gravity(), forces.QuadraticDrag(0.1, 0.4, **WIND)))

    def end(split, push):
        moved = scene.replace(state=scene.state._replace(velocity=scene.state.velocity * push))
        return run(monkeypatch, split, moved, methods.rk4)

    pushes = jnp.arange(1.0, 4.0)
    assert_close(jax.vmap(partial(end, True))(pushes), jax.vmap(partial(end, False))(pushes))


@pytest.mark.parametrize("way", ["frames", "blocks of lanes", "a record"])
def test_frames_are_whole_again(way, monkeypatch):
    scene = Scene(throws(3, lanes=5), 2.0, (forces.Gravity(), forces.QuadraticDrag(0.1, 0.4, **WIND)))
    if way == "blocks of lanes":
        monkeypatch.setattr("physjax.stepping.blocks.count_lane_blocks", lambda lanes, steps: 2)
    record = (lambda t, state: (t, state.position)) if way == "a record" else None

    def frames(scene, split):
        monkeypatch.setattr("physjax.stepping.frames.splits_vectors", lambda: split)
        flight = loop._run_steps(scene, as_module(methods.midpoint), jnp.asarray(0.05), jnp.int32(0), 3, 2, record)
        return flight.recorded if record else flight.state, flight.final_scene.state

    assert_close(*jax.jit(lambda scene: [frames(scene, split) for split in (True, False)])(scene))


def test_vectors_are_split_where_the_device_is_no_cpu(monkeypatch):
    monkeypatch.setattr(backend, "device_kind", lambda: "gpu")
    assert splits_vectors()
    with jax.disable_jit():
        assert not splits_vectors()


def test_on_a_cpu_vectors_stay_whole():
    assert splits_vectors() is (jax.default_backend() != "cpu")
