"""What a newcomer writes first, and what the error says: paths of pins, sets of nodes, bodies and what they rest on."""

import jax
import jax.numpy as jnp
import pytest

from physjax import Particles, Pins, Scene, contacts, inertia, lattices, rigid


@pytest.mark.usefixtures("unannotated")
@pytest.mark.parametrize(
    ("build", "error", "words"),
    [
        (
            lambda: rigid.Solids(rigid.PlanarShape.disc(1.0), contacts.Room((-1.0, -1.0), (1.0, 1.0))),
            TypeError,
            "surfaces: got Room, expected a tuple of surfaces. Write surfaces=(surface,).",
        ),
        (
            lambda: rigid.Solids(inertia.planar_disc(1.0, 1.0)),
            TypeError,
            "Solids: got a PlanarInertia, expected a PlanarShape such as rigid.PlanarShape.box((1, 1)).",
        ),
        (lambda: rigid.planar_bodies(1.0), TypeError, "got the inertia 1.0, expected that of a shape in the plane"),
        (lambda: rigid.planar_bodies(inertia.sphere(1.0, 1.0)), TypeError, "Bodies in space are made by rigid.bodies"),
        (lambda: rigid.bodies(2.0), TypeError, "got the inertia 2.0, expected that of a solid"),
        (
            lambda: Pins("left", lambda t: 0.0),
            TypeError,
            "Pins: got 'left', expected a mask, booleans of the lanes' shape",
        ),
        (
            lambda: lattices.rope((0.0, 0.0), (1.0, 0.0), 3, mass=1.0, stiffness=9.0).nodes["middle"],
            KeyError,
            "'middle', exp",
        ),
    ],
)
def test_first_programs_are_answered_in_a_sentence(build, error, words):
    with pytest.raises(error) as caught:
        build()
    assert words in str(caught.value)


@pytest.mark.usefixtures("unannotated")
def test_a_scene_is_held_by_a_mask_and_not_by_a_name():
    sheet = lattices.cloth(1.0, 1.0, 2, 2, mass=1.0, structural=10.0)
    with pytest.raises(TypeError, match="pinned: got 'left', expected a mask"):
        Scene(sheet.state, sheet.mass, (sheet.springs,), pinned="left")


def test_sets_of_nodes_are_a_dictionary_to_jax():
    sheet = lattices.cloth(1.0, 1.0, 2, 2, mass=1.0, structural=10.0)
    assert dict(sheet.nodes)
    twice = jax.tree.map(lambda mask: ~~mask, sheet.nodes)
    assert type(twice) is type(sheet.nodes)
    assert {name: mask.tolist() for name, mask in twice.items()} == {n: m.tolist() for n, m in sheet.nodes.items()}
    paths = [path for path, _ in jax.tree_util.tree_flatten_with_path(sheet.nodes)[0]]
    assert paths == [path for path, _ in jax.tree_util.tree_flatten_with_path(dict(sheet.nodes))[0]]


@pytest.mark.parametrize("path", [lambda t, position: position, lambda: 0.0, lambda t, *, speed: speed * t])
def test_a_path_is_a_function_of_the_time_alone(path):
    with pytest.raises(TypeError, match="expected a function of the time alone, t -> positions"):
        Pins(jnp.array([True]), path)


def test_a_path_may_have_numbers_of_its_own():
    hand = Pins(jnp.array([True]), lambda t, speed=2.0: jnp.array([[speed, 0.0]]) * t)
    held = hand.prescribe(0.5, Particles(jnp.zeros((1, 2)), jnp.zeros((1, 2))))
    assert held.position.tolist() == [[1.0, 0.0]]
