"""Moments of inertia: closed forms against each other and against sums over points, and what no body can have."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Inertia, inertia
from physjax.vectors import rotate_vector

CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
CUBE_FACES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ]
)
TILT = np.array([0.8, 0.1, -0.4, 0.3]) / np.linalg.norm([0.8, 0.1, -0.4, 0.3])


def cloud(inside, size, count=60):
    """Points of a grid that lie inside a shape, as `points` of a whole mass of 3 kg."""
    axes = [(np.arange(count) + 0.5) / count * 2 * s - s for s in size]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    grid = grid[inside(*grid.T)]
    return inertia.points(np.full(len(grid), 3.0 / len(grid)), grid)


SHAPES = {
    "box": (inertia.box(3.0, (1.0, 2.0, 0.6)), lambda x, y, z: x == x, (0.5, 1.0, 0.3)),
    "sphere": (inertia.sphere(3.0, 0.7), lambda x, y, z: x**2 + y**2 + z**2 < 0.49, (0.7, 0.7, 0.7)),
    "cylinder": (inertia.cylinder(3.0, 0.5, 1.4), lambda x, y, z: x**2 + y**2 < 0.25, (0.5, 0.5, 0.7)),
    "capsule": (
        inertia.capsule(3.0, 0.4, 1.0, axis=1),
        lambda x, y, z: x**2 + np.maximum(abs(y) - 0.5, 0) ** 2 + z**2 < 0.16,
        (0.4, 0.9, 0.4),
    ),
    "rod": (inertia.rod(3.0, 2.0, axis=0), lambda x, y, z: x == x, (1.0, 1e-9, 1e-9)),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_the_closed_form_is_the_sum_over_its_points(shape):
    body, inside, size = SHAPES[shape]
    found = cloud(inside, size)
    np.testing.assert_allclose(np.diagonal(found.inertia.tensor), body.principal, rtol=2e-3, atol=1e-9)
    np.testing.assert_allclose(found.center, 0, atol=1e-12)


def test_a_shell_is_what_a_ball_gains_by_growing():
    # dI/dr of a ball of constant density, whose mass grows as r³, is the shell's
    density, r = 3.0, 0.6
    ball = lambda r: inertia.sphere(density * 4 / 3 * np.pi * r**3, r).principal[0]  # noqa: E731
    shell = inertia.sphere(density * 4 * np.pi * r**2, r, hollow=True)
    np.testing.assert_allclose(jax.grad(ball)(jnp.asarray(r)), shell.principal[0], rtol=1e-12)


def test_a_mesh_of_a_cube_is_the_cube_wherever_it_is_and_however_it_is_turned():
    for turned_by, place in (([1.0, 0, 0, 0], (0, 0, 0)), (TILT, (5.0, -3.0, 100.0))):
        corners = (
            np.asarray(rotate_vector(jnp.asarray([turned_by] * 8, float), jnp.asarray(CUBE * [1.0, 2.0, 0.6]))) + place
        )
        middle = np.asarray(rotate_vector(jnp.asarray(turned_by, float), jnp.asarray([0.5, 1.0, 0.3]))) + place
        found = inertia.mesh(corners, CUBE_FACES, density=2.5)
        np.testing.assert_allclose(found.inertia.mass, 3.0, rtol=1e-12)
        np.testing.assert_allclose(found.center, middle, rtol=1e-13)
        box = inertia.box(3.0, (1.0, 2.0, 0.6))
        np.testing.assert_allclose(np.sort(found.inertia.principal), np.sort(box.principal), rtol=1e-10)
        oriented = Inertia(3.0, box.principal, turned_by)
        np.testing.assert_allclose(found.inertia.tensor, oriented.tensor, atol=1e-10)


def test_inside_out_is_the_same_body():
    found = inertia.mesh(CUBE, CUBE_FACES[:, ::-1], mass=6.0)
    np.testing.assert_allclose(found.inertia.principal, 1.0, rtol=1e-12)


def test_two_halves_are_the_whole_however_their_own_frames_stand():
    half = inertia.box(1.5, (0.6, 1.0, 1.0))
    quarter = [np.cos(np.pi / 4), 0, 0, np.sin(np.pi / 4)]  # x is then y
    whole = inertia.composite([(half, (3, 0, 0.5), quarter), (half, (3, 0.6, 0.5), quarter)])
    np.testing.assert_allclose(whole.center, [3, 0.3, 0.5], rtol=1e-14)
    np.testing.assert_allclose(whole.inertia.tensor, inertia.box(3.0, (1.0, 1.2, 1.0)).tensor, atol=1e-14)


def test_a_full_tensor_comes_back_for_every_lane():
    rng = np.random.default_rng(1)
    axes = rng.normal(size=(50, 4))
    tensor = Inertia(2.0, np.sort(rng.uniform(2, 3, (50, 3))), axes).tensor
    found = inertia.of_tensor(2.0, tensor)
    assert found.principal.shape == (50, 3)
    np.testing.assert_allclose(found.tensor, tensor, atol=1e-13)


def test_a_pivot_adds_by_parallel_axes():
    brick = inertia.box(3.0, (1.0, 2.0, 0.6))
    np.testing.assert_allclose(brick.about((0, 0.5, 0)).principal - brick.principal, [0.75, 0, 0.75], atol=1e-14)
    oblique = brick.about((0.3, 0.5, -0.2))
    d = np.array([0.3, 0.5, -0.2])
    np.testing.assert_allclose(oblique.tensor, brick.tensor + 3 * (d @ d * np.eye(3) - np.outer(d, d)), atol=1e-13)
    length = lambda l: inertia.rod(3.0, l).about((0, 0, 0.5 * l)).principal[0]  # noqa: E731, E741
    np.testing.assert_allclose(jax.value_and_grad(length)(jnp.asarray(2.0)), (4.0, 4.0), rtol=1e-14)  # m l²/3


def test_sizes_and_masses_are_swept():
    found = jax.vmap(lambda m, s: inertia.box(m, s).principal)(jnp.ones(5), jnp.ones((5, 3)))
    np.testing.assert_allclose(found, inertia.box(jnp.ones(5), jnp.ones((5, 3))).principal)
    assert inertia.sphere(2.0, jnp.ones(4)).principal.shape == (4, 3)
    assert inertia.cylinder(jnp.ones(4), 1.0, jnp.ones(4)).principal.shape == (4, 3)
    hung = inertia.box(jnp.arange(1.0, 5.0), (1.0, 1, 1)).about((0, 0, 0.5))
    np.testing.assert_allclose(hung.principal[:, 0], np.arange(1, 5) * (1 / 6 + 1 / 4), rtol=1e-14)
    many = inertia.box(1.0, (1.0, 1, 1)).about([[0, 0, 0.5], [0, 0.5, 0], [1.0, 0, 0.5], [0, 0, 0]])
    assert many.principal.shape == (4, 3)


@pytest.mark.usefixtures("unannotated")
@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: Inertia(1.0, (1.0, 1.0, 2.1)), "triangle inequality"),
        (lambda: Inertia(1.0, (0.0, 0.0, 0.0)), "not all zero"),
        (lambda: Inertia(1.0, (-1.0, 1.0, 1.0)), ">= 0"),
        (lambda: Inertia(-1.0, (1.0, 1.0, 1.0)), "mass"),
        (lambda: Inertia(1.0, (1.0, 1.0)), "expected \\(3,\\)"),
        (lambda: Inertia(1.0, (1.0, 1.0, 1.0), (0, 0, 0, 0.0)), "not zero"),
        (lambda: Inertia(1.0, (1.0, 1.0, 1.0), (0, 0, 1.0)), "quaternion"),
        (lambda: inertia.box(0.0, (1, 1, 1)), "mass"),
        (lambda: inertia.sphere(1.0, -1.0), "radius"),
        (lambda: inertia.rod(1.0, 1.0, axis=3), "axis"),
        (lambda: inertia.of_tensor(1.0, [[1, 2, 0], [0, 1, 0], [0, 0, 1.0]]), "symmetric"),
        (lambda: inertia.of_tensor(1.0, np.ones((2, 2))), "\\(3, 3\\)"),
        (lambda: inertia.mesh(CUBE, CUBE_FACES[1:], mass=1.0), "closed"),
        (lambda: inertia.mesh(CUBE, [*CUBE_FACES[1:], CUBE_FACES[0][::-1]], mass=1.0), "with the same orientation"),
        (lambda: inertia.mesh(CUBE * [1, 1, 0], CUBE_FACES, mass=1.0), "volume"),
        (lambda: inertia.mesh(CUBE, CUBE_FACES), "either mass= "),
        (lambda: inertia.points([1.0, 1.0], [[0, 0, 0.0]]), "positions"),
        (lambda: inertia.composite([]), "for each part"),
        (lambda: inertia.box(1.0, (1, 1, 1)).about((0, 0, 1)).about((0, 0, 1)), "with a pivot"),
        (lambda: inertia.box(1.0, (1, 1, 1)).about((0, 1)), "expected 3"),
        (lambda: jax.jit(lambda p: inertia.box(1.0, (1, 2, 3)).about(p).mass)(jnp.ones(3)), "is being traced"),
    ],
)
def test_what_no_body_can_have_is_refused_in_plain_words(build, words):
    with pytest.raises((ValueError, TypeError), match=words):
        build()
