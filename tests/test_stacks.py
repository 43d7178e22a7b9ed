"""Parts of one kind as one part: what is evaluated together is what each gives alone, in the order of the kinds."""

import jax.numpy as jnp
import numpy as np

from physjax import contacts
from physjax.stacks import map_stacks, stack_alike

PLACE = jnp.asarray([[0.3, -0.2], [1.0, 2.0], [-0.4, 0.1]])
PARTS = (
    contacts.Plane((0.0, -1.0), (0.0, 1.0)),
    contacts.Sphere((2.0, 0.0), 0.5),
    contacts.Plane((1.0, 0.0), (-3.0, 4.0), restitution=0.5),
    contacts.Plane((1.0, 0.0), (-3.0, 4.0), friction=0.5),
)


def test_kinds_differ_in_more_than_numbers():
    assert [stack.places for stack in stack_alike(PARTS)] == [(0, 2), (1,), (3,)]
    per_lane = contacts.Sphere((2.0, 0.0), jnp.full(3, 0.5))
    assert [stack.size for stack in stack_alike([PARTS[1], per_lane, PARTS[1]])] == [2, 1]


def test_what_is_evaluated_together_is_what_each_gives_alone():
    stacks = stack_alike(PARTS)
    found = map_stacks(lambda part: part.signed_distance(0.0, PLACE), stacks)
    order = [place for stack in stacks for place in stack.places]
    np.testing.assert_allclose(found, [PARTS[i].signed_distance(0.0, PLACE) for i in order], rtol=1e-15)


def test_parts_can_be_replaced_and_mapped_with_something_of_each():
    (planes, *_) = stack_alike(PARTS)
    faces = planes.replace(lambda part: part.facing(0.0, PLACE))
    np.testing.assert_allclose(faces.part.normal, [[0.0, 1.0], [-0.6, 0.8]], rtol=1e-15)
    shifted = planes.map(lambda part, shift: part.signed_distance(0.0, PLACE) + shift, jnp.asarray([1.0, 2.0]))
    plain = planes.map(lambda part: part.signed_distance(0.0, PLACE))
    np.testing.assert_allclose(shifted - plain, [[1.0] * 3, [2.0] * 3], rtol=1e-15)
